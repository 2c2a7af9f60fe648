"""Poses and Jacobians of the bodies that touch BioTacs in one mjData: the kernels of `poses` on MuJoCo's own
arrays."""

import types
from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from ...launches import in_a_row, recorded
from ...skin.types import mat33, real, vec3, vec6
from ..structs import DataView, ModelView
from ..touching import Touching
from .poses import Bodies


class Kinematics:
    """Poses and Jacobians of the bodies of some `Touching`s, one after the other, each in the frame of its
    BioTac and about its origin.

    Attributes:
      parts: slices of the bodies of each.
      bodies: `poses.Bodies` of each. m, d: what they read of mjModel and mjData: arrays of Warp on their
        memory.
      jacobian: (nbody, 1, nv) wp.array of vec6.
    """

    def __init__(self, model: ModelView, data: DataView, touchings: Sequence[Touching]):
        self._touchings, nbody, nv = touchings, model.nbody, model.nv
        ends = np.cumsum([0, *(len(one.body) for one in touchings)]).tolist()
        self.parts, shape = [slice(a, b) for a, b in zip(ends, ends[1:])], (ends[-1], 1)
        moves = np.zeros((nbody, nv), np.int32)  # whether a body is moved by a degree of freedom
        for b in range(1, nbody):
            moves[b] = moves[model.body_parentid[b]]
            moves[b, model.body_dofadr[b] : model.body_dofadr[b] + model.body_dofnum[b]] = 1
        with wp.ScopedDevice("cpu"):
            root = wp.array(model.body_rootid, dtype=int)
            self.m = types.SimpleNamespace(body_rootid=root, body_isdofancestor=wp.array(moves, dtype=int))
            numbers = [wp.array(one.body.astype(np.int32), dtype=int) for one in touchings]
            self.bodies = [Bodies(one.core, of_one) for one, of_one in zip(touchings, numbers)]
            self._horizon, self._qacc = wp.zeros(shape, dtype=real), wp.zeros((1, nv), dtype=real)
            self._pos, self._mat = wp.zeros(shape, dtype=vec3), wp.zeros(shape, dtype=mat33)
            self._core = [wp.zeros(1, dtype=kind) for kind in (vec3, mat33, vec3, mat33)]
            self.jacobian = wp.zeros((*shape, nv), dtype=vec6)
        self.d = types.SimpleNamespace(cdof=_own(data, "cdof", vec6, nv), qvel=_own(data, "qvel", real, nv))
        for name, kind in (("xpos", vec3), ("xmat", mat33), ("subtree_com", vec3), ("cvel", vec6)):
            setattr(self.d, name, _own(data, name, kind, nbody))
        self._seen = [a.numpy()[:, 0] for a in (self._horizon, self._pos, self._mat)]
        self._columns = self.jacobian.numpy()[:, 0].transpose(0, 2, 1)
        m, d, here = self.m, self.d, (self._pos, self._mat)
        self._advance = row(*self.each(lambda one, *of: one.ahead(m, d, *of), self._horizon, *here))
        self._find_jacobians = row(
            *self.each(lambda one, *of: one.here(d, *of), *here),
            *self.each(lambda one, *of: one.jacobians(m, d, *of), *here, self.jacobian),
        )

    def each(self, launch: Callable[..., tuple], *arrays: wp.array) -> list[tuple]:
        """launch(bodies, parts of the arrays) for the bodies of each."""
        both = zip(self.bodies, self.parts)
        return [launch(one, *(rows_of(array, part) for array in arrays)) for one, part in both]

    def check(self, pos: np.ndarray, mat: np.ndarray) -> None:
        """Raises ValueError for poses (nbody, 3), (nbody, 3, 3) that are not finite, or huge."""
        for one, part in zip(self._touchings, self.parts):
            one.check(pos[part], mat[part])

    def predict(self, horizon: float | np.ndarray) -> tuple:
        """Poses (nbody, 3) [m], (nbody, 3, 3) of the touching bodies after `horizon` [s] at the present
        velocities.

        Raises:
          ValueError: a pose or a velocity is not finite, or huge.
        """
        wanted, pos, mat = self._seen
        wanted[:] = horizon
        self._advance()
        self.check(pos, mat)
        return pos.copy(), mat.copy()

    def jacobians(self) -> np.ndarray:
        """(nbody, 6, nv) of the touching bodies relative to their BioTac, a copy."""
        self._find_jacobians()
        return np.array(self._columns, order="C")

    def core_motion(self, horizon: float, square: float, acceleration: np.ndarray) -> tuple:
        """Poses (2, 3), (2, 3, 3) of the first BioTac in the world, now and after `horizon` [s] at its
        present velocity, moved by accelerations (nv,) times `square` [s^2]."""
        self._qacc.numpy()[0] = acceleration
        launch = self.bodies[0].core_motion(self.m, self.d, horizon, square, self._qacc, self._core)
        wp.launch(*launch, device="cpu")
        pos, mat, pos_end, mat_end = (a.numpy() for a in self._core)
        return np.concatenate([pos, pos_end]), np.concatenate([mat, mat_end])


def row(*launches: tuple) -> Callable[[], None]:
    """One call for launches (kernel, dim, arguments) on the CPU, with numbers as they are now."""
    # none over no bodies
    runs = in_a_row([recorded(kernel, dim, given) for kernel, dim, given in launches if np.prod(dim)])
    return runs[0] if len(runs) == 1 else lambda: [run() for run in runs]


def rows_of(array: wp.array, part: slice) -> wp.array:
    """Rows of an array, on its memory. Warp slices nothing that is empty."""
    count = part.stop - part.start
    if 0 in (count, *array.shape):
        return wp.zeros((count, *array.shape[1:]), dtype=array.dtype, device=array.device)
    return array[part]


def _own(data, name, kind, count):
    """MuJoCo's memory as an array (1, count)."""
    if not count:
        return wp.zeros((1, 0), dtype=kind, device="cpu")
    address = getattr(data, name).ctypes.data
    return wp.array(ptr=address, dtype=kind, shape=(1, count), device="cpu", copy=False)
