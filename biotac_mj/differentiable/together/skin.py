"""A skin in many worlds on one device, for presses of all at once: dry and elastic."""

import contextlib
import dataclasses
from collections.abc import Iterator

import numpy as np
import torch
import warp as wp

from ...skin import GeomSet, SkinData, SkinModel, step
from ...skin.newton.krylov import krylov_kernels
from ...skin.program import Launcher
from ...skin.rubber.element_forces import ElementForces
from ...skin.step import prepare_step
from ...skin.types import DOUBLE
from ..record import Changes
from ..skin import Skin
from ..touching import Held, at_sharp_edges, flat, look, numbers_of_touching, rows

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
      held: what stuck when it began.
      touches, geoms: samples that touch when it ends, and the geoms, by the numbers of `touching`. slips:
        those that slip. on_core: samples of the inner surface that touch the core.
      weight, plane, area: of the samples, see `Touching`.
    """

    held: Held
    touches: np.ndarray
    geoms: np.ndarray
    slips: np.ndarray
    on_core: np.ndarray
    weight: np.ndarray
    plane: np.ndarray
    area: np.ndarray


class SkinOfWorlds:
    """The worlds of a `Skin`.

    Args:
      skin: whose geometry, material, options and geoms they have.
      nworld: number of worlds.
      device: "cpu" or a CUDA device of Warp.

    Attributes:
      softness: of the worlds that were pressed last, see `newton.worlds.Worlds`.
      single: whether directions of its steps are in single precision. double: the elements in double, whose
        memory is the steps' where these are in double, too.

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
        self.double = self.steps.k.elements
        with wp.ScopedDevice(self.device):
            if self.single:  # residuals of a gradient take double products
                parts = self.model.elements, self.data.rubber, self.data.options
                self.double = ElementForces(*parts, DOUBLE)
            self.on = wp.ones(nworld, dtype=int)

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
    ) -> tuple[torch.Tensor, list[RecordOfWorlds], list[np.ndarray], list[list[Changes]]]:
        """Takes the geoms along paths, from skins at rest.

        Args:
          pos, mat: (nworld, nstep, ngeom, 3) [m], (nworld, nstep, ngeom, 3, 3) in the BioTac frame.
          friction: (nworld, ngeom). numbers: (nworld, 3) of NUMBERS.

        Returns:
          Nodes (nstep + 1, nvert, nworld, 3) before each step and after the last, records of the steps,
          wrenches (nworld, ngroup, 6) after each, and `Changes` of each world's steps.
        """
        data, outer = self.data, self.data.outer
        self.write(friction, numbers)
        data.reset()
        records, wrenches, changes, before = [], [], [[] for _ in range(self.nworld)], None
        nodes = wp.to_torch(data.x)
        x = nodes.new_empty((pos.shape[1] + 1, *nodes.shape))
        x[0] = nodes
        for t in range(pos.shape[1]):
            held = Held.of(outer)
            self.place(pos, mat, t)
            step(self.model, data, self.geoms, 1.0)
            self.place(pos, mat, t)  # the step makes the last poses these
            x[t + 1] = nodes
            seen = self._look(x[t + 1], x[t], held)
            slips = (rows(outer.trial_anchor, seen.sample) != seen.stick).any(1)
            slips &= flat(self.geoms.struct.friction)[seen.geom] > 0
            on_core = numbers_of_touching(data.core.trial_geom)[0] if data.core else np.zeros(0, int)
            touches = seen.sample, seen.geom, seen.sample[slips], on_core
            records.append(RecordOfWorlds(held, *touches, seen.weight, seen.plane, seen.area))
            wrenches.append(data.wrench)
            for own, change in zip(changes, self._changes(records[-1], before, seen)):
                own.append(change)
            before = records[-1]
        self.softness = wp.clone(data.worlds.softness)
        return x, records, wrenches, changes

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

    def _look(self, x, x_last, held):
        """Samples that touch the geoms."""
        ends = (a.cpu().numpy().reshape(-1, 3) for a in (x, x_last))
        return look(self.data.outer, self.weights, self.geoms.struct, *ends, held)

    def _changes(self, now, before, seen):
        """Of every world."""

        def count(numbers):
            return np.bincount(numbers % self.nworld, minlength=self.nworld)

        lost = ~self.data.converged | (self.data.worlds.increment.numpy() > 0)
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

    # --- backwards ---

    def put_product_in_double(self, program: Launcher, p: wp.array, q: wp.array, held: wp.array) -> None:
        """Into a program, in running worlds: q = tangent times p, of what `double` has by corners and of what
        is in `touching` and `block` of the surfaces; held: (nvert, nworld) double, of no account."""
        m, d, e, k = self.model, self.data, self.double, self.steps.k
        e.multiply_corners(program, d.x, p, d.worlds.running)
        contact = []
        for state in (d.outer, d.core):
            if state is None:
                contact += [k.no_face, k.no_list, k.no_list, k.no_flag, k.no_block]
            else:
                s = state.surface
                contact += [s.face, s.start, s.slot, state.touching, state.block]
        dry = [k.no_face, k.no_list, k.no_list, k.no_vector]
        inputs = [1, e.start, e.slot, e.corner, *contact, *dry, m.free_mask, wp.vec3d(0.0, 0.0, 0.0)]
        inputs += [k.node_volume, d.dt, d.x, p, d.worlds]
        program.launch(krylov_kernels(DOUBLE).assemble_product, (*q.shape, 1), inputs, [q, held])
