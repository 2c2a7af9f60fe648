"""Worlds that found no balance among many, solved once more by themselves: on the CPU, in double precision,
each with a factor of its own shape. The dense preconditioner of many worlds is that of the skin at rest in
half precision, and holds so many touching nodes; what it leaves to conjugate gradients they may not find."""

import functools
import queue
from collections.abc import Iterator

import numpy as np
import warp as wp

from ..threads import cores, run_abreast
from . import step as skin_step
from .data import ContactState, SkinData
from .geoms import GeomSet
from .model import SkinModel
from .newton.worlds import CONVERGED, NOT_CONVERGED
from .step import SkinStep, prepare_step

__all__ = ["Alone"]

_AT_ONCE = 1e-6  # of the time step: rubber that remembers has lived through this step already
_OF_GEOMS = ("pos", "mat", "pos_last", "mat_last", "friction")
_GIVE_UP = 2  # steps in a row without a balance, after which a world is left alone until it finds one
_THREADS = 32  # at most: a skin for each is kept
_TOGETHER = 128  # worlds at most whose states are on the host at once


class Alone:
    """Skins of one world that go on from where a step has left worlds of another without a balance, side by
    side in as many threads as there are cores. They are made when they are first needed, and kept.

    Args:
      model, data, geoms: of the step.
    """

    def __init__(self, model: SkinModel, data: SkinData, geoms: GeomSet):
        self._model, self._twins = model.on_cpu(), []
        self._failed = np.zeros(data.nworld, int)  # steps in a row

    def solve(self, step: SkinStep, data: SkinData, geoms: GeomSet) -> None:
        """Gives the worlds that `step` left on their way what is found at its end, or nearer to it."""
        st = data.worlds
        reason, on = st.reason.numpy(), st.wanted.numpy() == 1
        self._failed[on & (reason == CONVERGED)] = 0
        lost = np.flatnonzero(on & (reason == NOT_CONVERGED) & (self._failed < _GIVE_UP))
        for first in range(0, len(lost), _TOGETHER):
            self._solve(lost[first : first + _TOGETHER].tolist(), step, data, geoms)

    def _solve(self, lost, step, data, geoms):
        threads = min(cores(), _THREADS, len(lost))
        while len(self._twins) < threads:  # by this thread: kernels are loaded
            self._twins.append(Twin(self._model, data, geoms))
        free = queue.SimpleQueue()
        for twin in self._twins[:threads]:
            free.put(twin)
        there = list(_arrays(data, geoms, self._twins[0]))
        columns = [[_world(array, w, axis) for array, axis, _ in there] for w in lost]
        states = [[_read(column) for column in of_world] for of_world in columns]

        def solve(k):
            twin = free.get()
            found = twin.go_on(states[k])
            free.put(twin)
            self._failed[lost[k]] = 0 if found else self._failed[lost[k]] + 1

        run_abreast([functools.partial(solve, k) for k in range(len(lost))], threads)
        _look(step, data, geoms, lost, columns, states)


def _look(step, data, geoms, lost, columns, states):
    """Gives worlds back to the others, with tangents as their preconditioner has them."""
    st, g = data.worlds, geoms.struct

    def write():
        for of_world, state in zip(columns, states, strict=True):
            for column, value in zip(of_world, state, strict=True):
                _write(column, value)

    write()
    for w in lost:  # as far as they came
        wp.copy(_world(g.pos, w, 1), _world(g.pos_last, w, 1))
        wp.copy(_world(g.mat, w, 1), _world(g.mat_last, w, 1))
    st.active.assign(np.isin(np.arange(data.nworld), lost).astype(np.int32))
    st.moving.assign(st.active)
    step.look()
    write()
    for w in lost:
        _forget_clearance(data, w)


class Twin:
    """A skin of one world on the CPU.

    Args:
      model: on the CPU.
      data, geoms: of many worlds, of which it is to be any.
    """

    def __init__(self, model: SkinModel, data: SkinData, geoms: GeomSet):
        self.data, self.geoms = SkinData(model, preconditioner="sparse"), geoms.alone()
        if data.external is not None:
            self.data.set_external(np.zeros((1, model.nvert, 3)))
        if data.bodies is not None:
            self.data.make_bodies_compliant(geoms.ngroup)
        self._step = prepare_step(model, self.data, self.geoms)
        self._views = [here.numpy() for _, _, here in _arrays(data, geoms, self)]

    def go_on(self, state: list[np.ndarray]) -> bool:
        """The rest of the way of a world from where it came to, whose arrays become what they are then.
        Returns whether it found a balance at its end. For any thread, one at a time."""
        for view, value in zip(self._views, state, strict=True):
            view[...] = value
        self._run()
        for view, value in zip(self._views, state, strict=True):
            value[...] = view
        return bool(self.data.worlds.reason.numpy()[0] == CONVERGED)

    def _run(self):
        """What the step says is then of all of it."""
        d, g, st = self.data, self.geoms, self.data.worlds
        moved, _, _ = d.geom_memory(g.count, g.ngroup)
        sums = [a.numpy() for a in (d.increment, moved, st.iterations, st.work)]
        before = [a.copy() for a in sums]
        dt, load_factor, count = (a.numpy().copy() for a in (d.dt, st.load_factor, st.nonconverged))
        _forget_clearance(d)
        d.dt.numpy()[:] = _AT_ONCE * dt
        st.spent.numpy()[:] = 0
        self._step.run()
        for array, value in zip(sums, before, strict=True):
            array += value
        d.dt.numpy()[:] = dt
        st.load_factor.numpy()[:] = load_factor + (1 - load_factor) * st.load_factor.numpy()
        st.increment.numpy()[:] = 1 - load_factor  # a step in parts, to gradients
        st.nonconverged.numpy()[:] = count - (st.reason.numpy() == CONVERGED)


def _arrays(data, geoms, twin) -> Iterator[tuple[wp.array, int, wp.array]]:
    """What is of each world: arrays of many, which axis of them counts worlds, and the twin's."""
    own, own_geoms = twin.data, twin.geoms
    pairs = [(getattr(data, n), getattr(own, n)) for n in vars(data)]
    pairs += zip(*(d.geom_memory(geoms.count, geoms.ngroup) for d in (data, own)), strict=True)
    pairs += [(getattr(geoms.struct, n), getattr(own_geoms.struct, n)) for n in _OF_GEOMS]
    pairs += [(data.laws.struct, own.laws.struct)]
    while pairs:
        there, here = pairs.pop()
        if isinstance(there, ContactState):
            pairs += [(getattr(there, n), getattr(here, n)) for n in vars(there) if n != "clearances"]
        elif hasattr(there, "cls"):  # a struct of arrays
            pairs += [(getattr(there, n), getattr(here, n)) for n in there.cls.__annotations__]
        elif isinstance(there, wp.array) and there.size:
            axes = [k for k, (n, m) in enumerate(zip(there.shape, here.shape)) if (n, m) == (data.nworld, 1)]
            if axes:
                yield there, axes[-1], here


def _world(array, w, axis):
    return array[(*[slice(None)] * axis, slice(w, w + 1))]


def _read(column) -> np.ndarray:
    """A copy on the host."""
    return column.numpy().copy()


def _write(column, value):
    wp.copy(column, wp.array(value, dtype=column.dtype, device=column.device))


def _forget_clearance(data, w=0):
    """What faces are known to be away from geoms by counts the motion of other steps."""
    for state in (data.outer, data.core):
        if state is not None:
            _world(state.clearances.clearance, w, 1).zero_()


skin_step.make_alone = Alone
