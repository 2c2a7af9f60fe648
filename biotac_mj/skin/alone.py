"""A world that found no balance among many, solved once more by itself: on the CPU, in double precision, with
a factor of its own shape. The dense preconditioner of many worlds is that of the skin at rest in half
precision, and holds so many touching nodes; what it leaves to conjugate gradients they may not find."""

from collections.abc import Iterator

import numpy as np
import warp as wp

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


class Alone:
    """A skin of one world that goes on from where a step has left worlds of another without a balance.

    Args:
      model, data, geoms: of the step.
    """

    def __init__(self, model: SkinModel, data: SkinData, geoms: GeomSet):
        self.data, self.geoms = SkinData(model.on_cpu(), preconditioner="sparse"), geoms.alone()
        self._step = prepare_step(self.data.model, self.data, self.geoms)
        self._failed = np.zeros(data.nworld, int)  # steps in a row

    def solve(self, step: SkinStep, data: SkinData, geoms: GeomSet) -> None:
        """Gives the worlds that `step` left on their way what is found at its end, or nearer to it."""
        st, own = data.worlds, self.data.worlds
        reason, on = st.reason.numpy(), st.wanted.numpy() == 1
        self._failed[on & (reason == CONVERGED)] = 0
        for w in np.flatnonzero(on & (reason == NOT_CONVERGED) & (self._failed < _GIVE_UP)).tolist():
            self.data.set_external(None if data.external is None else data.external.numpy()[None, :, w])
            arrays = list(_arrays(data, geoms, self.data, self.geoms, w))
            for there, here in arrays:
                _copy(there, here)
            self._go_on()
            self._failed[w] = 0 if own.reason.numpy()[0] == CONVERGED else self._failed[w] + 1
            self._look(step, data, geoms, w, arrays)

    def _go_on(self):
        """The rest of the way of the world at hand; what the step says is then of all of it."""
        d, g, st = self.data, self.geoms, self.data.worlds
        moved, _, _ = d.geom_memory(g.count, g.ngroup)
        sums = [d.increment, moved, st.iterations, st.work]
        before = [a.numpy().copy() for a in sums]
        dt, reached, count = (a.numpy().copy() for a in (d.dt, st.reached, st.nonconverged))
        _forget_clearance(d)
        d.dt.assign(_AT_ONCE * dt)
        st.spent.zero_()
        self._step.run()
        for array, value in zip(sums, before, strict=True):
            array.assign(array.numpy() + value)
        d.dt.assign(dt)
        st.reached.assign(reached + (1 - reached) * st.reached.numpy())
        st.stride.assign(1 - reached)  # a step in parts, to gradients
        st.nonconverged.assign(count - (st.reason.numpy() == CONVERGED))

    def _look(self, step, data, geoms, w, arrays):
        """Gives it back to world w of the others, with tangents as their preconditioner has them."""
        st = data.worlds
        only = (np.arange(data.nworld) == w).astype(np.int32)
        for there, here in arrays:
            _copy(here, there)
        _copy(self.geoms.struct.pos_last, _world(geoms.struct.pos, w, 1))  # as far as it came
        _copy(self.geoms.struct.mat_last, _world(geoms.struct.mat, w, 1))
        st.active.assign(only)
        st.moving.assign(only)
        step.look()
        for there, here in arrays:
            _copy(here, there)
        _forget_clearance(data, w)


def _arrays(data, geoms, own, own_geoms, w) -> Iterator[tuple[wp.array, wp.array]]:
    """What is of each world: world w of the arrays of many, and the arrays of one."""
    pairs = [(getattr(data, n), getattr(own, n)) for n in vars(data)]
    pairs += zip(*(d.geom_memory(geoms.count, geoms.ngroup) for d in (data, own)), strict=True)
    pairs += [(getattr(geoms.struct, n), getattr(own_geoms.struct, n)) for n in _OF_GEOMS]
    pairs += [(data.laws.struct, own.laws.struct)]
    while pairs:
        there, here = pairs.pop()
        if isinstance(there, ContactState):
            pairs += [(getattr(there, n), getattr(here, n)) for n in vars(there) if n != "watch"]
        elif hasattr(there, "cls"):  # a struct of arrays
            pairs += [(getattr(there, n), getattr(here, n)) for n in there.cls.__annotations__]
        elif isinstance(there, wp.array) and there.size:
            axes = [k for k, (n, m) in enumerate(zip(there.shape, here.shape)) if (n, m) == (data.nworld, 1)]
            if axes or data.nworld == 1:
                yield _world(there, w, axes[-1]) if axes else there, here


def _world(array, w, axis):
    return array[(*[slice(None)] * axis, slice(w, w + 1))]


def _copy(source, target):
    """Between a column on any device and an array on the CPU."""
    if source.device == target.device:
        wp.copy(target, source)
    elif source.is_contiguous:
        wp.copy(target, wp.clone(source, device=target.device))
    else:
        wp.copy(target, source.contiguous())


def _forget_clearance(data, w=0):
    """What faces are known to be away from geoms by counts the motion of other steps."""
    for state in (data.outer, data.core):
        if state is not None:
            _world(state.watch.clearance, w, 1).zero_()


skin_step.make_alone = Alone
