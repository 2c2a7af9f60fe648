"""Load increments: the path of the geoms within a step, which increment of it a world tries next, poses at a
load factor, and the load factor at the end. Most worlds take the whole path in one increment."""

import warp as wp

from ...kernels import kernel_module
from ..bodies import Bodies, follow_wrench
from ..contact.posed import Geoms, LoadPath
from ..contact.touch import CURRENT, LAGGED, RECORDED
from ..types import mat33, real, vec3
from .worlds import (
    CONVERGED,
    CUT_BACK_BEFORE,
    INSIDE_CORE,
    LAST_CUT_BACK,
    NO_CUTBACK,
    NOT_CONVERGED,
    NOT_FINITE,
    Worlds,
    begin_try,
    set_viscosity,
)

kernel_module(__name__)

_FIRST_INCREMENT = wp.constant(wp.float64(0.25))  # load increment after a first try that failed
_FAR = wp.constant(wp.float64(1e3))  # [m] coordinate of a geom that touches nothing


@wp.kernel
def end_try(st: Worlds, any_open: wp.array(dtype=int)):
    """Ends a try: worlds in equilibrium at the end of their load path are finished. An equilibrium with an
    inverted element counts as a failure."""
    w = wp.tid()
    st.active[w] = 0
    st.moving[w] = 0
    if st.unfinished[w] == 0:
        return
    if st.inverted[w] >= 2:
        st.failed[w] = 1
    if st.failed[w] == 0 and st.trial_factor[w] == real(1.0) and _bound_is_current(st, w):
        set_viscosity(st, w, real(0.0))
        st.friction_mode[w] = CURRENT
        st.load_factor[w] = real(1.0)
        st.reason[w] = CONVERGED
        st.unfinished[w] = 0
    else:
        any_open[0] = 1


@wp.func
def _bound_is_current(st: Worlds, w: int):
    """Whether the friction bound is that of the present equilibrium. A lagged bound is, if no iteration was
    needed."""
    return st.friction_mode[w] != LAGGED or st.iterations[w] == st.start_iterations[w]


@wp.func
def _bounds_converge(st: Worlds, w: int):
    """Whether the rounds of lagged friction bounds converge with fixed anchors: from the second round on, the
    error at the start of a round must halve from round to round."""
    rounds = st.rounds[w]
    most = wp.where(rounds < 3, real(1.0), real(0.8) * wp.pow(real(0.5), real(rounds)))
    return rounds < 2 or st.start_error[w] < most


@wp.kernel
def choose_increment(
    shortest: real,
    max_work: int,
    keeps_iterate: int,
    st: Worlds,
    any_open: wp.array(dtype=int),
    any_increment: wp.array(dtype=int),
):
    """Accepts or cuts back the load increment of each unfinished world and chooses the next one. Worlds that
    continue are moving.

    The first try takes the whole load path. Increments start short, since together they cost little more than
    the whole path, and converged ones are kept. Anchors are committed at the end of each increment. Where
    a try of the whole path is not lost (keeps_iterate), the second one takes it, too, with the bounds below.

    Where friction is several times the normal force, Newton's method cycles, since the normal force bounds
    the slip and depends on it. After a failed increment, and always for load-dependent friction, the bound is
    therefore lagged: it is computed from the normal forces of the last equilibrium. With fixed bounds the
    forces have a potential (except adhesion), also if samples leave the geom. The bounds are updated until
    they repeat. If they do not, the anchors are committed at each equilibrium; slip then dissipates energy,
    so that the iteration ends.

    any_open: the flag of `end_try`, which is cleared.
    """
    w = wp.tid()
    if w == 0:
        any_open[0] = 0
    st.active[w] = 0
    st.moving[w] = 0
    st.accepted[w] = 0
    st.restores[w] = 0
    if st.unfinished[w] == 0:
        return
    set_viscosity(st, w, real(0.0))
    again = st.failed[w] == 0 and not _bound_is_current(st, w)
    st.friction_mode[w] = CURRENT
    if again:
        st.rounds[w] = st.rounds[w] + 1
        if _bounds_converge(st, w):  # the same increment, with the bounds of the equilibrium that was found
            if max_work - st.work[w] < max_work / 10:
                st.unfinished[w] = 0
                return
            st.moving[w] = 1
            any_increment[0] = 1
            return
    else:
        st.rounds[w] = 0
    increment = st.increment[w]
    if st.failed[w] == 0:
        st.accepted[w] = 1
        st.load_factor[w] = st.trial_factor[w]
        if st.cut_back[w] == LAST_CUT_BACK and not again:
            st.cut_back[w] = CUT_BACK_BEFORE
        elif not again:
            increment = real(2.0) * increment
    elif st.load_factor[w] == real(1.0):  # the friction bounds did not converge
        increment = real(0.0)
    elif increment == real(0.0):
        st.reason[w] = NOT_CONVERGED
        increment = _FIRST_INCREMENT
        if st.deep[w] == 1:
            st.reason[w] = INSIDE_CORE
        elif keeps_iterate == 1:
            increment = real(1.0)
            st.cut_back[w] = LAST_CUT_BACK
        if st.guessed[w] == 1:
            increment = real(0.0)
    else:
        increment = wp.min(real(0.5) * increment, _FIRST_INCREMENT)
        st.cut_back[w] = LAST_CUT_BACK
    if increment < shortest or max_work - st.work[w] < max_work / 10:
        st.unfinished[w] = 0
        return
    if not again:
        st.increment[w] = wp.min(increment, real(1.0) - st.load_factor[w])
        st.trial_factor[w] = st.load_factor[w] + st.increment[w]
    st.restores[w] = 1
    st.moving[w] = 1
    any_increment[0] = 1


@wp.kernel
def start_increment(
    limit: int, max_work: int, st: Worlds, any_increment: wp.array(dtype=int), any_lagged: wp.array(dtype=int)
):
    """Starts the next load increment of the moving worlds."""
    w = wp.tid()
    if w == 0:
        any_increment[0] = 0
    st.lagged[w] = 0
    if st.moving[w] == 1:
        st.active[w] = 1
        st.failed[w] = 0
        st.deep[w] = 0
        begin_try(st, w, limit, max_work)
        if st.cut_back[w] != NO_CUTBACK or st.load_dependent[w] == 1:
            st.friction_mode[w] = RECORDED
            st.lagged[w] = 1
            any_lagged[0] = 1


@wp.kernel
def lag_friction(st: Worlds, any_lagged: wp.array(dtype=int)):
    """Fixes the friction bounds that an evaluation has recorded."""
    w = wp.tid()
    if w == 0:
        any_lagged[0] = 0
    if st.lagged[w] == 1:
        st.work[w] = st.work[w] + 1
        st.friction_mode[w] = LAGGED


@wp.func
def partial_turn(begin: mat33, end: mat33, fraction: real):
    """Rotation at a fraction of the turn from `begin` to `end`, about one axis."""
    turn = wp.quat_from_matrix(wp.transpose(begin) * end)
    u = vec3(turn[0], turn[1], turn[2])
    half = wp.atan2(wp.length(u), wp.abs(turn[3]))
    u = wp.where(turn[3] < real(0.0), -u, u)
    return begin * wp.quat_to_matrix(wp.quat_from_axis_angle(wp.normalize(u), real(2.0) * fraction * half))


@wp.kernel
def place_geoms(
    # In:
    path: LoadPath,
    fraction: wp.array(dtype=real),
    on: wp.array(dtype=int),
    b: Bodies,
    # Out:
    geoms: Geoms,
):
    """Places geom g at a load factor of its path, along a line and about one axis. A compliant body is moved
    further by the wrench `posed`."""
    g, w = wp.tid()
    if on[w] == 0:
        return
    f = fraction[w]
    begin = path.pos_start[g, w]
    if f == real(1.0):
        geoms.pos[g, w] = path.pos_end[g, w]
        geoms.mat[g, w] = path.mat_end[g, w]
    elif not wp.isfinite(begin[0] + begin[1] + begin[2]):  # bad input, and no previous pose
        geoms.pos[g, w] = vec3(_FAR, _FAR, _FAR)
        geoms.mat[g, w] = wp.identity(n=3, dtype=real)
    elif f == real(0.0):
        geoms.pos[g, w] = begin
        geoms.mat[g, w] = path.mat_start[g, w]
    else:
        geoms.pos[g, w] = begin + f * (path.pos_end[g, w] - begin)
        geoms.mat[g, w] = partial_turn(path.mat_start[g, w], path.mat_end[g, w], f)
    if b.posed.shape[0] > 0:
        h = geoms.group[g]
        m = wp.spatial_vectord()
        for k in range(b.posed.shape[0]):
            more = b.posed[k, w] - (real(1.0) - f) * b.begun[k, w] - f * b.predicted[k, w]
            m += b.compliance[h, k, w] * more
        pos, mat = follow_wrench(h, w, b, m, geoms.pos[g, w], geoms.mat[g, w])
        geoms.pos[g, w] = pos
        geoms.mat[g, w] = mat


@wp.kernel
def end_path(keeps_iterate: int, st: Worlds, any_short: wp.array(dtype=int)):
    """Ends the load path of world w. Worlds that did not reach its end are moving; they have failed if no
    increment converged.

    keeps_iterate: 1 where bodies give way: there a step ends with the iterate at the end of its path whose
    error was least, if that is less than the remaining fraction of the path. Its forces are those of the
    contact law at the bodies' target poses, and so push."""
    w = wp.tid()
    f = st.load_factor[w]
    st.cut_off[w] = 0
    if keeps_iterate == 1 and st.wanted[w] == 1 and st.reason[w] != NOT_FINITE:
        if st.least_error[w] < real(1.0) - f:
            st.cut_off[w] = 1
            st.load_factor[w] = real(1.0)
            st.error[w] = st.least_error[w]
            f = real(1.0)
    st.moving[w] = 0
    st.failed[w] = 1 - st.wanted[w]
    if st.wanted[w] == 0:
        return
    if f < real(1.0) or st.reason[w] != CONVERGED:
        st.moving[w] = 1
        any_short[0] = 1
        if f == real(0.0):
            st.failed[w] = 1
        if st.reason[w] != NOT_FINITE:
            st.active[w] = 1


@wp.kernel
def end_geoms(geoms: Geoms, path: LoadPath, st: Worlds, motion_out: wp.array2d(dtype=vec3)):
    """Stores the poses that geom g reached and its motion in this step [m], and restores the poses that the
    caller set."""
    g, w = wp.tid()
    if st.wanted[w] == 0:
        return
    motion_out[g, w] = vec3()
    begin = path.pos_start[g, w]
    if st.load_factor[w] > real(0.0) and wp.isfinite(begin[0] + begin[1] + begin[2]):
        motion_out[g, w] = geoms.pos[g, w] - begin
    if st.reason[w] != NOT_FINITE:
        geoms.pos_last[g, w] = geoms.pos[g, w]
        geoms.mat_last[g, w] = geoms.mat[g, w]
    geoms.pos[g, w] = path.pos_end[g, w]
    geoms.mat[g, w] = path.mat_end[g, w]
