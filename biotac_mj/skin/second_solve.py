"""Second solve on the CPU of worlds that did not converge in a batch, in double precision and each with a
factor of its own shape. The dense preconditioner of a batch is that of the undeformed skin in half precision,
with a limited number of touching nodes; conjugate gradients may not correct the difference."""

import functools
import queue
from collections.abc import Iterator

import numpy as np
import warp as wp

from ..threads import cores, run_in_threads
from . import step as skin_step
from .data import ContactState, SkinData
from .geoms import GeomSet
from .model import SkinModel
from .newton.worlds import CONVERGED, NOT_CONVERGED
from .step import SkinStep, prepare_step

__all__ = ["SecondSolve"]

_NO_TIME = 1e-6  # factor on the time step: rubber with memory has completed the step already
_OF_GEOMS = ("pos", "mat", "pos_last", "mat_last", "friction")
_MAX_FAILURES = 2  # failed steps in a row after which a world is left out until it converges
_MAX_THREADS = 32  # each keeps a skin of its own
_MAX_STATES = 128  # worlds whose states are on the host at the same time


class SecondSolve:
    """Skins of one world that continue the steps of failed worlds, in one thread per core. They are made when
    they are first needed.

    Args:
      model, data, geoms: of the step.
    """

    def __init__(self, model: SkinModel, data: SkinData, geoms: GeomSet):
        self._model, self._single_worlds = model.on_cpu(), []
        self._failures = np.zeros(data.nworld, int)  # steps in a row

    def solve(self, step: SkinStep, data: SkinData, geoms: GeomSet) -> None:
        """Continues the worlds that `step` did not finish, and copies the results back."""
        st = data.worlds
        reason, on = st.reason.numpy(), st.wanted.numpy() == 1
        self._failures[on & (reason == CONVERGED)] = 0
        failed = np.flatnonzero(on & (reason == NOT_CONVERGED) & (self._failures < _MAX_FAILURES))
        for first in range(0, len(failed), _MAX_STATES):
            self._solve(failed[first : first + _MAX_STATES].tolist(), step, data, geoms)

    def _solve(self, failed, step, data, geoms):
        threads = min(cores(), _MAX_THREADS, len(failed))
        while len(self._single_worlds) < threads:  # in this thread, since it loads kernels
            self._single_worlds.append(SingleWorld(self._model, data, geoms))
        free = queue.SimpleQueue()
        for single in self._single_worlds[:threads]:
            free.put(single)
        batch = list(_arrays(data, geoms, self._single_worlds[0]))
        columns = [[_world(array, w, axis) for array, axis, _ in batch] for w in failed]
        states = [[_read(column) for column in of_world] for of_world in columns]

        def solve(k):
            single = free.get()
            converged = single.continue_from(states[k])
            free.put(single)
            self._failures[failed[k]] = 0 if converged else self._failures[failed[k]] + 1

        run_in_threads([functools.partial(solve, k) for k in range(len(failed))], threads)
        _write_back(step, data, geoms, failed, columns, states)


def _write_back(step, data, geoms, failed, columns, states):
    """Copies states to the batch, and computes forces and tangents with the batch's preconditioner."""
    st, g = data.worlds, geoms.struct

    def write():
        for of_world, state in zip(columns, states, strict=True):
            for column, value in zip(of_world, state, strict=True):
                _write(column, value)

    write()
    for w in failed:  # poses at the end of the load path that was reached
        wp.copy(_world(g.pos, w, 1), _world(g.pos_last, w, 1))
        wp.copy(_world(g.mat, w, 1), _world(g.mat_last, w, 1))
    st.active.assign(np.isin(np.arange(data.nworld), failed).astype(np.int32))
    st.moving.assign(st.active)
    step.refresh()
    write()
    for w in failed:
        _clear_clearances(data, w)


class SingleWorld:
    """A skin of one world on the CPU.

    Args:
      model: on the CPU.
      data, geoms: of the batch whose worlds it continues.
    """

    def __init__(self, model: SkinModel, data: SkinData, geoms: GeomSet):
        self.data, self.geoms = SkinData(model, preconditioner="sparse"), geoms.single_world()
        if data.external is not None:
            self.data.set_external(np.zeros((1, model.nvert, 3)))
        if data.bodies is not None:
            self.data.make_bodies_compliant(geoms.ngroup)
        self._step = prepare_step(model, self.data, self.geoms)
        self._views = [own.numpy() for _, _, own in _arrays(data, geoms, self)]

    def continue_from(self, state: list[np.ndarray]) -> bool:
        """Takes the rest of a world's load path from the point that it reached, and updates `state` in place.
        Returns whether it converged. Any thread may call it, one at a time."""
        for view, value in zip(self._views, state, strict=True):
            view[...] = value
        self._run()
        for view, value in zip(self._views, state, strict=True):
            value[...] = view
        return bool(self.data.worlds.reason.numpy()[0] == CONVERGED)

    def _run(self):
        """Runs a step, and makes its results those of the whole step of the batch."""
        d, g, st = self.data, self.geoms, self.data.worlds
        moved, _, _ = d.geom_memory(g.count, g.ngroup)
        sums = [a.numpy() for a in (d.increment, moved, st.iterations, st.work)]
        before = [a.copy() for a in sums]
        dt, load_factor, count = (a.numpy().copy() for a in (d.dt, st.load_factor, st.nonconverged))
        _clear_clearances(d)
        d.dt.numpy()[:] = _NO_TIME * dt
        st.spent.numpy()[:] = 0
        self._step.run()
        for array, value in zip(sums, before, strict=True):
            array += value
        d.dt.numpy()[:] = dt
        st.load_factor.numpy()[:] = load_factor + (1 - load_factor) * st.load_factor.numpy()
        st.increment.numpy()[:] = 1 - load_factor  # gradients count it as a step with load increments
        st.nonconverged.numpy()[:] = count - (st.reason.numpy() == CONVERGED)


def _arrays(data, geoms, single) -> Iterator[tuple[wp.array, int, wp.array]]:
    """Yields each array of the batch that has an axis of worlds, that axis, and the array of `single`."""
    own, own_geoms = single.data, single.geoms
    pairs = [(getattr(data, n), getattr(own, n)) for n in vars(data)]
    pairs += zip(*(d.geom_memory(geoms.count, geoms.ngroup) for d in (data, own)), strict=True)
    pairs += [(getattr(geoms.struct, n), getattr(own_geoms.struct, n)) for n in _OF_GEOMS]
    pairs += [(data.laws.struct, own.laws.struct)]
    while pairs:
        batch, one = pairs.pop()
        if isinstance(batch, ContactState):
            pairs += [
                (getattr(batch, n), getattr(one, n)) for n in vars(batch) if n not in ("clearances", "forces")
            ]
        elif hasattr(batch, "cls"):  # a struct of arrays
            pairs += [(getattr(batch, n), getattr(one, n)) for n in batch.cls.__annotations__]
        elif isinstance(batch, wp.array) and batch.size:
            axes = [k for k, (n, m) in enumerate(zip(batch.shape, one.shape)) if (n, m) == (data.nworld, 1)]
            if axes:
                yield batch, axes[-1], one


def _world(array, w, axis):
    return array[(*[slice(None)] * axis, slice(w, w + 1))]


def _read(column) -> np.ndarray:
    """A copy on the host."""
    return column.numpy().copy()


def _write(column, value):
    wp.copy(column, wp.array(value, dtype=column.dtype, device=column.device))


def _clear_clearances(data, w=0):
    """Clears the clearances of faces, which belong to the motion of another sequence of steps."""
    for state in (data.outer, data.core):
        if state is not None:
            _world(state.clearances.clearance, w, 1).zero_()


skin_step.make_second_solve = SecondSolve
