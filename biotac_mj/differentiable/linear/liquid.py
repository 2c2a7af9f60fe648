"""The liquid's volume and the area vectors on which its pressure acts, as functions of the core's contact
forces: Warp's adjoint of `skin.liquid.wet_faces`.

The volume is a scalar: one backward pass gives its gradient. The nine components of a face on the core use
one world each, so that one pass gives all Jacobians. The rotation of the area vectors with the corners is
explicit: the wet area of a face depends on the core's contact forces only."""

import numpy as np
import torch
import warp as wp

from ...geometry.rigid import skew
from ...kernels import kernel_module, set_fields
from ...skin.liquid import InnerFaces, wet_faces
from ...skin.types import real, vec3
from ..record import Record
from ..skin import Skin
from ..tensors import add_rows
from .inverse import FaceBlocks
from .samples import LinearSurface

_NUMBERS = 9
_adjoint = wp.kernel(wet_faces.func, module=kernel_module(f"{__name__}.adjoint"), enable_backward=True)


class LinearLiquid:
    """Linearised liquid of a single world at the end of a step (`record.restore`). Its pressure is
    p = offset - kappa (V - natural), and acts on the area vectors G of the wet surface.

    Args:
      core: samples in contact with the core, or None; their forces on nodes include the loss of wet area.

    Attributes:
      push: (nvert, 1, 3) G [m^2]. by_node: (nvert, 1, 3) derivative of the pressure [Pa/m].
      turn: blocks of the pressure force's rotation with the faces, for constant wet area.
    """

    def __init__(self, skin: Skin, record: Record, core: LinearSurface | None):
        world, model, data = skin.read("pressure", "volume"), skin.model, skin.data
        kappa, natural, reference, stiffness = (
            float(record.numbers[name]) for name in ("kappa", "natural", "reference", "contact_stiffness")
        )
        pressure, volume = (float(world[name]) for name in ("pressure", "volume"))
        self._kappa, self._lacks, self._pressure, self._core = kappa, natural - volume, pressure, core
        self.push = wp.to_torch(data.gradient).clone()
        x, none = record.x[:, 0].numpy(), (np.zeros((0, 3)), np.zeros(0, int))
        area = model.inner.area
        if data.core:
            none = data.core.sample_force.numpy()[:, 0], data.core.trial_geom.numpy()[:, 0]
            area = data.core.surface.area
        by_node, by_force, *numbers = differentiate_volume(
            x, model.inner.face, model.core_slot, area, model.sample, *none, stiffness, reference
        )
        self._by = dict(zip(("contact_stiffness", "reference"), numbers))
        by_area = np.zeros(0)
        if data.core:  # only pressures matter: a larger area is like a smaller force
            lost = (by_force * np.where(none[1][:, None] >= 0, none[0], 0.0)).sum(1)
            by_area = -lost.reshape(len(area), -1).sum(1) / area.numpy()
        self._by_area = torch.from_numpy(by_area)
        by_node = torch.from_numpy(by_node)[:, None].contiguous()
        if core:
            self._by_force = torch.from_numpy(by_force)[core.at.sample]
            felt = torch.einsum("mij,mi->mj", core.by_node, self._by_force)
            add_rows(by_node.view(-1, 3), core.at.node, felt)
            self._dry(skin, x, stiffness, reference)
        self.by_node = -kappa * by_node
        self.turn = self._turning(skin, record, x)

    def _dry(self, skin, x, stiffness, reference):
        """Loss of pressure force where the core dries the skin."""
        state, at, s = skin.data.core, self._core.at, len(skin.weights)
        face, place = np.unique(at.face.numpy(), return_inverse=True)
        samples = s * face[:, None] + np.arange(s)
        forces, geom = state.sample_force.numpy()[samples, 0], state.trial_geom.numpy()[samples, 0]
        forces = np.where(geom[..., None] >= 0, forces, 0.0)
        node, area = state.surface.face_np[face], state.surface.area.numpy()[face]
        by_force, by_reference = differentiate_push(
            x[node], area, skin.model.sample, forces, geom, stiffness, reference
        )
        own = by_force[place, :, at.sample.numpy() % s]
        self._core.spread = self._core.spread + self._pressure * torch.from_numpy(own)
        by_area = -np.einsum("mnsk,msk->mn", by_force, forces) / area[:, None]  # as for the volume
        self._dry_face, self._dry_node = torch.from_numpy(face), torch.from_numpy(node.astype(np.int64))
        self._dry_by_area = self._pressure * torch.from_numpy(by_area)
        self._dry_by_reference = torch.zeros_like(self.push)
        by_reference = self._pressure * torch.from_numpy(by_reference)
        add_rows(self._dry_by_reference.view(-1, 3), self._dry_node, by_reference)

    def _turning(self, skin, record, x):
        face = skin.model.inner.face_np
        corner, wet = x[face], skin.solver(record.geoms).k.wet.numpy()[:, 0]
        second = 0.5 * skew(corner[:, 2] - corner[:, 0])
        third = -0.5 * skew(corner[:, 1] - corner[:, 0])
        turn = np.concatenate([-second - third, second, third], 2)  # of -(x1 - x0) x (x2 - x0) / 2
        turn = self._pressure * np.einsum("fa,fij->faij", wet, turn).reshape(len(face), 9, 9)
        node = torch.from_numpy(face.astype(np.int64))
        return FaceBlocks(torch.arange(len(face)), node, torch.from_numpy(turn))

    def change(self, given: dict, core_force: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
        """Tangents of the pressure (1,) and of its force on nodes (nvert, 1, 3) at fixed nodes, from those of
        the step's inputs and of the core samples' forces."""
        volume = sum(given[name] * slope for name, slope in self._by.items())
        volume = volume + (given["core_area"][:, 0] * self._by_area).sum()
        if self._core:
            volume = volume + (self._by_force * core_force).sum()
        pressure = given["offset"] + given["kappa"] * self._lacks + given["natural"] * self._kappa
        pressure = pressure - self._kappa * volume
        force = self.push * pressure[:, None]
        if self._core:
            force = force + self._dry_by_reference * given["reference"][:, None]
            area = given["core_area"][self._dry_face]
            add_rows(force.view(-1, 3), self._dry_node, self._dry_by_area * area)
        return pressure, force


def differentiate_volume(
    x: np.ndarray, face: wp.array, slot: wp.array, area: wp.array, sample: wp.array, force: np.ndarray,
    geom: np.ndarray, stiffness: float, reference: float,
) -> tuple[np.ndarray, np.ndarray, float, float]:  # fmt: skip
    """Derivatives of the liquid's volume under the inner faces.

    Args:
      x: (nvert, 3) nodes [m].
      face, slot: (nface,) inner faces and their numbers among those that can touch the core.
      area: (ncore,) of these at rest [m^2]. sample: (s,) barycentric coordinates.
      force: (ncore s, 3) of the core on their samples [N]; geom: (ncore s,) -1 without contact.
      stiffness: of the contact [Pa/m]. reference: `Worlds.reference` [Pa].

    Returns:
      by nodes (nvert, 3) [m^2], by the core's force on each sample (ncore s, 3) [m^3/N], by the stiffness of
      the contact, and by the reference.
    """
    n = len(face)
    inputs = _Inputs(1, x, force, geom, len(sample), stiffness, reference)
    inputs.pull(n, face, slot, area, sample, volume=wp.ones((1, n, 1), dtype=real, device="cpu"))
    of_items = (array.grad.numpy()[:, 0].copy() for array in (inputs.x, inputs.force))
    return *of_items, *(float(array.grad.numpy()[0]) for array in (inputs.stiffness, inputs.reference))


def differentiate_push(
    corner: np.ndarray,
    area: np.ndarray,
    sample: wp.array,
    force: np.ndarray,
    geom: np.ndarray,
    stiffness: float,
    reference: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the area vectors of faces on the core.

    Args:
      corner: (m, 3, 3) positions [m]. area: (m,) at rest [m^2].
      force: (m, s, 3), geom: (m, s), others: see `differentiate_volume`.

    Returns:
      by_force (m, 9, s, 3) of the three corners' vectors [m^2/N] and by_reference (m, 9) [m^2/Pa].
    """
    (m, s), k = geom.shape, _NUMBERS
    inputs = _Inputs(k, corner.reshape(-1, 3), force.reshape(-1, 3), geom.ravel(), s, stiffness, reference)
    with wp.ScopedDevice("cpu"):
        face = wp.array(np.arange(3 * m, dtype=np.int32).reshape(m, 3), dtype=wp.vec3i)
        seed = np.zeros((m, 3, k, 3))
        for i in range(k):
            seed[:, i // 3, i, i % 3] = 1
        slot, area = wp.array(np.arange(m), dtype=int), wp.array(area, dtype=real)
        inputs.pull(m, face, slot, area, sample, corner=wp.array(seed.reshape(3 * m, k, 3), dtype=vec3))
    by_force = inputs.force.grad.numpy().reshape(m, s, k, 3).swapaxes(1, 2).copy()
    # scaling forces and reference together does not change the wet area
    return by_force, -np.einsum("mnsk,msk->mn", by_force, force) / reference


class _Inputs:
    """Copies of the inputs, one per output number."""

    def __init__(self, k, x, force, geom, s, stiffness, reference):
        def copies(value, dtype):
            value = np.ascontiguousarray(np.repeat(np.asarray(value)[:, None], k, 1))
            return wp.array(value, dtype=dtype, device="cpu", requires_grad=dtype is not int)

        self.k = k
        self.x, self.force, self.geom = copies(x, vec3), copies(force, vec3), copies(geom, int)
        self.touching = copies((np.reshape(geom, (-1, s)) >= 0).any(1).astype(np.int32), int)
        self.stiffness, self.reference = (
            wp.full(k, value, dtype=real, device="cpu", requires_grad=True)
            for value in (stiffness, reference)
        )

    def pull(self, n, face, slot, area, sample, volume=None, corner=None):
        """Gradients of the inputs from those of volumes (1, n, k) or corners (3n, k), one chunk per face. The
        adjoint kernel includes the forward pass, which a tape would repeat."""
        k = self.k
        with wp.ScopedDevice("cpu"):
            shapes = ((1, n, k), real), ((n, k), vec3), ((3 * n, k), vec3)
            outputs = [wp.zeros(shape, dtype=dtype) for shape, dtype in shapes]
            slopes = [wp.zeros_like(a) if given is None else given for a, given in zip(
                outputs, (volume, None, corner)
            )]  # fmt: skip
            law = [self.stiffness, self.reference, self.touching, self.geom, self.force, self.x]
            inner = set_fields(InnerFaces(), face=face, slot=slot, sample=sample, area=area)
            inputs = [1, inner, *law, wp.ones(k, dtype=int)]
            given = [self.stiffness.grad, self.reference.grad, None, None, self.force.grad, self.x.grad]
            wp.launch(
                _adjoint, (n, k), inputs, outputs, adjoint=True,
                adj_inputs=[1, InnerFaces(), *given, None], adj_outputs=slopes,
            )  # fmt: skip
