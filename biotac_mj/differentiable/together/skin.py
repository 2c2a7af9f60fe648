"""A skin in many worlds on one device, for presses of all at once: dry and elastic."""

import contextlib
import dataclasses
from collections.abc import Iterator

import numpy as np
import torch
import warp as wp

from ...skin import GeomSet, SkinData, SkinModel, step
from ...skin.program import Launcher
from ...skin.rubber.element_forces import ElementForces
from ...skin.step import prepare_step
from ...skin.types import DOUBLE, vec3
from ..record import Changes
from ..skin import Skin, sum_corners
from ..touching import Held, Touching, at_sharp_edges, flat, look, rows

__all__ = ["RecordOfWorlds", "SkinOfWorlds", "refuse_together"]

# of `skin.NUMBERS`, what a dry skin has
NUMBERS = ("mu", "lam", "contact_stiffness")


def refuse_together(skin: Skin, device: str, rest_nodes: object = None, smoothing: float = 0.0) -> None:
    """Raises ValueError, which names the option and what to do, for worlds that can go one after another
    alone, or a device that is not there."""
    alone = "is not there for worlds that go together: leave `together` out"
    if skin.model.has_liquid:
        raise ValueError(f"liquid {alone}, or take liquid=False")
    if skin.model.material.remembers:
        raise ValueError(f"rubber with prony, mullins or hysteresis {alone}")
    if rest_nodes is not None:
        raise ValueError(f"rest_nodes {alone}")
    if smoothing:
        raise ValueError(f"smoothing {alone}")
    try:
        wp.get_device(device)
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"together is {device!r}: give 'cpu', or a CUDA device that is there") from error


@dataclasses.dataclass
class RecordOfWorlds:
    """One step of all worlds.

    Attributes:
      x: (nvert, nworld, 3) nodes when it ended, a tensor of the device [m].
      held: what stuck when it began.
      touches, slips: samples that touch, that slip, when it ends, by the numbers of `touching`.
    """

    x: torch.Tensor
    held: Held
    touches: np.ndarray
    slips: np.ndarray


class SkinOfWorlds:
    """The worlds of a `Skin`.

    Args:
      skin: whose geometry, material, options and geoms they have.
      nworld: number of worlds.
      device: "cpu" or a CUDA device of Warp.

    Attributes:
      rest: (nvert, nworld, 3) nodes where a press begins [m]. free: (nvert, 1, 1) 1 at nodes that move, else
        0. softness: of the worlds that were pressed last, see `newton.worlds.Worlds`.
      single: whether directions of its steps are in single precision.

    Raises:
      ValueError: see `refuse_together`.
    """

    def __init__(self, skin: Skin, nworld: int, device: str):
        refuse_together(skin, device)
        self.nworld, self.device, self._skin = nworld, wp.get_device(device), skin
        if self.device.is_cuda:
            geometry, modulus = skin.made_of
            options = skin.model.options
            self.model = SkinModel(geometry, skin.model.material, options, self.device, modulus=modulus)
        else:
            self.model = skin.model
        self.data = SkinData(self.model, nworld)
        self.geoms = GeomSet(**skin.made_with, nworld=nworld, device=self.device)
        self.weights, self.precision = skin.weights, skin.precision
        self.single = self.data.precision is not DOUBLE
        self.steps = prepare_step(self.model, self.data, self.geoms)
        self.elements = self.steps.k.elements
        with wp.ScopedDevice(self.device):
            if self.single:  # residuals of a gradient take double products
                parts = self.model.elements, self.data.rubber, self.data.options
                self.elements = ElementForces(*parts, DOUBLE)
            self._p, self._q = (wp.zeros((self.model.nvert, nworld), dtype=vec3) for _ in range(2))
            self.on = wp.ones(nworld, dtype=int)
        self.rest = wp.to_torch(self.data.x).clone()
        self.free = self.tensor(self.model.free_mask.numpy() > 0)[:, None, None].double()
        self._corner_node = self.tensor(self.model.elements.elem.astype(np.int64).ravel())

    # --- tensors ---

    def tensor(self, array: np.ndarray) -> torch.Tensor:
        """On the device."""
        return torch.from_numpy(np.ascontiguousarray(array)).to(self.torch_device)

    @property
    def torch_device(self) -> torch.device:
        """As PyTorch names it."""
        return torch.device(str(self.device))

    @contextlib.contextmanager
    def stream(self) -> Iterator[None]:
        """PyTorch launches where Warp does."""
        if not self.device.is_cuda:
            yield
            return
        torch.cuda.synchronize(self.torch_device)
        with torch.cuda.stream(wp.stream_to_torch(self.device)):
            yield
        torch.cuda.synchronize(self.torch_device)

    # --- forwards ---

    def follow(
        self, pos: np.ndarray, mat: np.ndarray, friction: np.ndarray, numbers: np.ndarray
    ) -> tuple[list[RecordOfWorlds], list[np.ndarray], list[list[Changes]]]:
        """Takes the geoms along paths, from skins at rest.

        Args:
          pos, mat: (nworld, nstep, ngeom, 3) [m], (nworld, nstep, ngeom, 3, 3) in the BioTac frame.
          friction: (nworld, ngeom). numbers: (nworld, 3) of NUMBERS.

        Returns:
          Records of the steps, wrenches (nworld, ngroup, 6) after each, and `Changes` of each world's steps.
        """
        data, outer = self.data, self.data.outer
        self.write(friction, numbers)
        data.reset()
        records, wrenches, changes, before = [], [], [[] for _ in range(self.nworld)], None
        for t in range(pos.shape[1]):
            held, x_last = Held.of(outer), self._nodes()
            self.place(pos, mat, t)
            step(self.model, data, self.geoms, 1.0)
            self.place(pos, mat, t)  # the step makes the last poses these
            x = self._nodes()
            seen = self.look(x, x_last, held)
            slips = (rows(outer.trial_anchor, seen.sample) != seen.stick).any(1)
            slips &= flat(self.geoms.struct.friction)[seen.geom] > 0
            records.append(RecordOfWorlds(x, held, seen.sample, seen.sample[slips]))
            wrenches.append(data.wrench)
            for own, change in zip(changes, self._changes(records[-1], before, seen)):
                own.append(change)
            before = records[-1]
        self.softness = wp.clone(data.worlds.softness)
        return records, wrenches, changes

    def write(self, friction: np.ndarray, numbers: np.ndarray) -> None:
        """What `follow` takes; the skin lies where it rests."""
        if self.model is self._skin.model:
            self._skin.rest_at(self._skin.rest)
        self.geoms.set_friction(friction)
        for name, value in zip(NUMBERS, numbers.T):
            getattr(self.data.worlds, name).assign(np.ascontiguousarray(value))

    def place(self, pos: np.ndarray, mat: np.ndarray, t: int) -> None:
        """Geoms where they are when step t ends, and were when it began."""
        self.geoms.set_pose(pos[:, max(t - 1, 0)], mat[:, max(t - 1, 0)])
        self.geoms.advance()
        self.geoms.set_pose(pos[:, t], mat[:, t])

    def look(self, x: torch.Tensor, x_last: torch.Tensor, held: Held, core: bool = False) -> Touching:
        """Samples that touch the geoms, or the core."""
        state = self.data.core if core else self.data.outer
        geoms = self.model.core(self.nworld) if core else self.geoms
        ends = (a.cpu().numpy().reshape(-1, 3) for a in (x, x_last))
        return look(state, self.weights, geoms.struct, *ends, held)

    def _nodes(self):
        return wp.to_torch(self.data.x).clone()

    def _changes(self, now, before, seen):
        """Of every world."""

        def count(numbers):
            return np.bincount(numbers % self.nworld, minlength=self.nworld)

        lost = ~self.data.converged | (self.data.worlds.stride.numpy() > 0)
        names = {
            "lost": lost.astype(int),
            "sharp": count(seen.sample[at_sharp_edges(self.geoms.struct, seen)]),
        }
        if before is not None:
            both = np.intersect1d(now.touches, before.touches)
            names |= {
                "touched": count(np.setdiff1d(now.touches, both)),
                "parted": count(np.setdiff1d(before.touches, both)),
                "slipped": count(np.setdiff1d(np.intersect1d(now.slips, both), before.slips)),
                "stuck": count(np.setdiff1d(np.intersect1d(before.slips, both), now.slips)),
            }
        return [Changes(**{k: int(v[w]) for k, v in names.items()}) for w in range(self.nworld)]

    # --- where a step ended ---

    def restore(self, record: RecordOfWorlds, x_last: torch.Tensor) -> None:
        """Puts all worlds where a step ended, geoms placed, with the contact of there; the approximate
        inverse becomes that of there."""
        data, st = self.data, self.data.worlds
        wp.copy(st.softness, self.softness)
        st.coupled.zero_()
        record.held.give(data.outer)
        wp.to_torch(data.x).copy_(record.x)
        wp.to_torch(data.x_last).copy_(x_last)
        self.steps.evaluate_forces()
        if self.single:
            self.elements.push_corners(Launcher(self.device), data.x, self.on, st.inverted)
        self.steps.update_preconditioner()

    def precondition(self, v: torch.Tensor) -> torch.Tensor:
        """The approximate inverse of the tangent times v (nvert, nworld, 3), zero at fixed nodes."""
        steps = self.steps
        wp.to_torch(steps.k.r).copy_(v)
        part = wp.to_torch(steps.k.part)
        part.zero_()
        part[0, 0] = (v * v).sum((0, 2))
        steps.precondition()
        return wp.to_torch(steps.k.z).double()

    def multiply_rubber(self, p: torch.Tensor) -> torch.Tensor:
        """Tangent of the rubber times p (nvert, nworld, 3), in double precision."""
        wp.to_torch(self._p).copy_(p)
        launcher, e = Launcher(self.device), self.elements
        e.multiply_corners(launcher, self.data.x, self._p, self.on)
        launcher.launch(sum_corners, self._q.shape, [e.start, e.slot, e.corner], [self._q])
        return wp.to_torch(self._q)

    def rubber_by_moduli(self, balance: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
        """(nworld,) slopes of balance (nvert, nworld, 3) times the forces of the rubber by mu and lam, see
        `linear.step.LinearStep`. The elements' deformation is no longer kept afterwards."""
        data, e = self.data, self.elements
        mu, lam = (a.numpy().copy() for a in (data.rubber.mu, data.rubber.lam))
        other = np.where(lam > self.model.elements.cap * mu, 2 * lam, 0.5 * np.where(lam == 0, mu, lam))
        balance, found = balance[self._corner_node], []
        for value in (other, lam):
            data.rubber.lam.assign(value)
            e.push_corners(Launcher(self.device), data.x, self.on, data.worlds.inverted)
            force = wp.to_torch(e.corner_force)
            found.append(torch.einsum("kwc,kwc->w", balance, force).cpu().numpy())
        there, here = found
        by_lam = (there - here) / (other - lam)
        return (here - lam * by_lam) / mu, by_lam


@wp.kernel(module=f"{__name__}.contact", enable_backward=False)
def push_nodes(
    # In:
    node: wp.array2d(dtype=int),
    weight: wp.array(dtype=vec3),
    block: wp.array(dtype=wp.mat33d),
    v: wp.array(dtype=vec3),
    # Out:
    out: wp.array(dtype=vec3),
):
    """Adds what samples push their faces' nodes by, of blocks (m,) on where the samples go."""
    i = wp.tid()
    b = weight[i]
    u = b[0] * v[node[i, 0]] + b[1] * v[node[i, 1]] + b[2] * v[node[i, 2]]
    f = block[i] * u
    for a in range(3):
        wp.atomic_add(out, node[i, a], b[a] * f)
