"""Response of electrodes and force plate, interpolated in a table of states."""

import copy
import dataclasses

import numpy as np
from scipy.interpolate import CubicSpline

from ..sensor.film import FilmConduction
from .states import PlateStates


def log_changes(states: PlateStates, film: FilmConduction) -> np.ndarray:
    """(npitch, nroll, npath, nload, nelectrode) change of ln Z from rest in the states, by a film of their
    skin."""
    vert = film.geometry.vert.copy()
    places = states.xpos.reshape(-1, *states.xpos.shape[-2:])
    out = np.empty((len(places), film.design.nelectrode))
    rest = np.log(film.impedance(_with(vert, states.node, states.rest)))
    for i, place in enumerate(places):
        out[i] = np.log(film.impedance(_with(vert, states.node, place))) - rest
    return out.reshape(*states.xpos.shape[:-2], -1)


def _with(vert, node, place):
    vert[node] = place
    return vert


class Response:
    """Change of ln Z and tangential forces over pitch, roll and drag, at known loads.

    Cubic splines over the angles, the logarithm of the load and each drag, whose contributions add. Rolls to
    the other side are mirror images.

    Args:
      states: the table. log_z: (npitch, nroll, npath, nload, nelectrode) change of ln Z in its states.

    Attributes:
      states, log_z: as given.
      axes: nodes of pitch and roll (both sides). drag_paths: (npath, 2) drags. nodes: (ndirection, npath, 4)
        states of the table. low, high: (4,) bounds of a state. changes: (k, nload, npitch, nroll, npath,
        nelectrode + 2) partial changes of the table, see `with_changes`.
    """

    def __init__(self, states: PlateStates, log_z: np.ndarray):
        self.states, self.log_z, grid = states, log_z, states.grid
        here = np.concatenate([log_z, states.force[..., :2]], -1)
        n = log_z.shape[-1]
        order = np.concatenate([states.design.mirror, [n, n + 1]])
        other = (
            np.abs(grid.drag_paths[:, None] - grid.drag_paths * [1, -1]).sum(-1).argmin(0)
        )  # dragged to the other side
        there = here[:, :0:-1, other][..., order] * np.where(np.arange(n + 2) == n + 1, -1.0, 1.0)
        self._table = np.moveaxis(np.concatenate([there, here], 1), 3, 0)
        roll = np.array(grid.roll)
        self.axes = np.array(grid.pitch), np.concatenate([-roll[:0:-1], roll])
        most = max(grid.drag, default=0.0)
        drag = np.array([most, most])
        self.low = np.concatenate([[axis[0] for axis in self.axes], -drag])
        self.high = np.concatenate([[axis[-1] for axis in self.axes], drag])
        self.drag_paths, self.splines = grid.drag_paths, [_cardinal(axis) for axis in self.axes]
        node = np.unique(np.concatenate([[0.0], grid.drag, -np.array(grid.drag)]))
        self.over_drag = _cardinal(node) if grid.drag else None
        # positions of these nodes' spline weights among the paths, along and across
        self.path_of = [np.abs(node[:, None] - grid.drag_paths[:, i]).argmin(1) for i in (0, 1)]
        direction = np.stack(np.meshgrid(*self.axes, indexing="ij"), -1).reshape(-1, 1, 2)
        shape = len(direction), len(self.drag_paths), 2
        parts = np.broadcast_to(direction, shape), np.broadcast_to(self.drag_paths, shape)
        self.nodes = np.concatenate(parts, -1)
        self._log_load, self._first = np.log(grid.load), grid.load[0]
        self._over_load = _cardinal(self._log_load)
        self.changes = np.zeros((0, *self._table.shape))

    def with_changes(self, *pairs: tuple["Response", "Response"]) -> "Response":
        """This response with optional changes: a pair is the response on some grid, which may be coarser,
        without and with a change. An amount of 1 is the whole change."""
        out, nodes = copy.copy(self), self.nodes.reshape(-1, 4)
        new = np.empty((len(pairs), *self._table.shape))
        for change, (here, there) in zip(new, pairs):
            for k, load in enumerate(np.exp(self._log_load)):
                at = np.full(len(nodes), load)
                difference = there.at_load(at)(nodes, False)[0] - here.at_load(at)(nodes, False)[0]
                change[k] = difference.reshape(change.shape[1:])
        out.changes = np.concatenate([self.changes, new])
        return out

    def only(self, k: int) -> "Response":
        """The response with one of its changes."""
        out = copy.copy(self)
        out.changes = self.changes[k : k + 1]
        return out

    def amended(self, amount: np.ndarray) -> "Response":
        """The response with fixed amounts (k,) of its changes."""
        out = copy.copy(self)
        out._table = self._table + np.tensordot(amount, self.changes, 1)
        out.changes = self.changes[:0]
        return out

    def at_load(self, load: np.ndarray, amount: np.ndarray | tuple = ()) -> "Loaded":
        """The response at loads (n,) of normal force over Young's modulus [m^2], with amounts (k,) of its
        changes."""
        inside = np.clip(np.log(np.maximum(load, 1e-30)), self._log_load[0], self._log_load[-1])
        weight = self._over_load(inside)
        small = np.minimum(load / self._first, 1.0)  # proportional below the first load
        whole = self._table
        if np.any(amount):
            whole = whole + np.tensordot(amount, self.changes, 1)
        table = (weight @ whole.reshape(len(self._log_load), -1)) * small[:, None]
        return Loaded(self, table.reshape(len(load), *self._table.shape[1:]).astype(np.float32))


@dataclasses.dataclass(frozen=True, eq=False)
class Loaded:
    """The response at n loads: table (n, npitch, nroll, npath, nelectrode + 2)."""

    response: Response
    table: np.ndarray

    def __call__(self, state: np.ndarray, slope: bool = True) -> tuple[np.ndarray, np.ndarray | None]:
        """Values (n, nelectrode + 2) at states (n, 4) (pitch, roll, drag along and across): ln Z, then forces
        along and across over E; and derivatives (n, nelectrode + 2, 4)."""
        pitch, roll = (
            [spline(state[:, i]), spline(state[:, i], 1)] for i, spline in enumerate(self.response.splines)
        )
        here = self._sum(pitch[0], roll[0])
        drag_path, turn = self._over_paths(state[:, 2:])
        value = np.einsum("nw,nwc->nc", drag_path, here)
        if not slope:
            return value, None
        change = [self._sum(pitch[1], roll[0]), self._sum(pitch[0], roll[1])]
        angles = [np.einsum("nw,nwc->nc", drag_path, part) for part in change]
        return value, np.concatenate([np.stack(angles, -1), np.einsum("nwi,nwc->nci", turn, here)], -1)

    def _sum(self, pitch, roll):
        """(n, npath, nelectrode + 2) interpolation of the table over its directions."""
        return np.einsum("nj,njwc->nwc", roll, np.einsum("ni,nijwc->njwc", pitch, self.table)).astype(float)

    def _over_paths(self, drag):
        """Weights (n, npath) of splines in each drag (n, 2), which add, and their derivatives (n, npath,
        2)."""
        response = self.response
        drag_path, slope = (
            np.zeros((len(drag), len(response.drag_paths))),
            np.zeros((len(drag), len(response.drag_paths), 2)),
        )
        drag_path[:, 0] = 1.0
        for i in (0, 1) if response.over_drag else ():
            drag_path[:, response.path_of[i]] += response.over_drag(drag[:, i])
            slope[:, response.path_of[i], i] += response.over_drag(drag[:, i], 1)
            drag_path[:, 0] -= 1.0
        return drag_path, slope


def _cardinal(node):
    """Cardinal cubic splines: values at points (n,) are weights (n, len(node)) on the values at the nodes."""
    return CubicSpline(node, np.eye(len(node)), bc_type="not-a-knot")
