"""The way of the geoms in a step, which most worlds go at once: who does not, which part of it a world tries
next, geoms put to a share of it, and how far they came in the end."""

import warp as wp

from ..bodies import Bodies, follow_wrench
from ..contact.posed import Geoms, LoadPath
from ..contact.touch import FIXED, LAGGED, OWN
from ..types import mat33, real, vec3
from .worlds import CONVERGED, INSIDE_CORE, NOT_CONVERGED, NOT_FINITE, Worlds, begin_try, set_viscosity

__all__ = [
    "end_try",
    "end_path",
    "judge_increment",
    "keep_geoms",
    "lag_friction",
    "place_geoms",
    "release_geoms",
    "partial_turn",
    "start_increment",
]

wp.set_module_options({"enable_backward": False})

_FIRST_PART = wp.constant(wp.float64(0.25))  # of a way that could not be gone at once
_FAR = wp.constant(wp.float64(1e3))  # [m]


@wp.kernel
def end_try(st: Worlds, any_open: wp.array(dtype=int)):
    """After a try: worlds that are in balance where their way ends are done, the others open. Balance with an
    element inside out is none."""
    w = wp.tid()
    st.active[w] = 0
    st.moving[w] = 0
    if st.asked[w] == 0:
        return
    if st.inverted[w] >= 2:
        st.failed[w] = 1
    if _is_there(st, w):
        _arrive(st, w)
    else:
        any_open[0] = 1


@wp.func
def _is_own(st: Worlds, w: int):
    """Whether friction is that of the balance that was found: of one with lagged bounds where it is that of
    the balance before, which is found again at once."""
    return st.slips[w] != LAGGED or st.iterations[w] == st.began[w]


@wp.func
def _comes_to_rest(st: Worlds, w: int):
    """Whether the bounds of friction come to rest while it holds on to where the part began: after two rounds
    the errors at which they begin must be small, and halve."""
    rounds = st.rounds[w]
    most = wp.where(rounds < 3, real(1.0), real(0.8) * wp.pow(real(0.5), real(rounds)))
    return rounds < 2 or st.opened[w] < most


@wp.func
def _is_there(st: Worlds, w: int):
    """Whether it is in balance at the end of its way."""
    return st.failed[w] == 0 and st.trial_factor[w] == real(1.0) and _is_own(st, w)


@wp.func
def _arrive(st: Worlds, w: int):
    set_viscosity(st, w, real(0.0))
    st.slips[w] = OWN
    st.load_factor[w] = real(1.0)
    st.reason[w] = CONVERGED
    st.asked[w] = 0


@wp.kernel
def judge_increment(
    shortest: real,
    max_work: int,
    st: Worlds,
    passed: wp.array(dtype=int),
    any_increment: wp.array(dtype=int),
):
    """Accept or cut back each open world's load increment and choose the next: they are moving.

    The first try is the whole load path from a guess. Increments cost together hardly more than the whole,
    and converged ones are kept: so they begin short. Where an increment ends the skin sticks or slips, and
    the next one slips on from there.

    Where friction is several times the push, Newton's method cycles: the push bounds what slips, and depends
    on it. So after a failed increment, and from the start for friction that depends on load, the bound is
    lagged: it is that of the push in the last equilibrium. With fixed bounds forces have a potential, but for
    adhesion, and an equilibrium is found. Bounds are renewed until they repeat; if they do not, the skin
    slips on from each equilibrium, which dissipates energy, and so comes to rest.

    passed: flags that were looked at.
    """
    w = wp.tid()
    if w == 0:
        for k in range(passed.shape[0]):
            passed[k] = 0
    st.active[w] = 0
    st.moving[w] = 0
    st.kept[w] = 0
    st.returns[w] = 0
    if st.asked[w] == 0:
        return
    if st.rests[w] == 1:  # the next try is that of a skin at rest
        st.rests[w] = 2
        st.active[w] = 1
        return
    if _is_there(st, w):
        _arrive(st, w)
        return
    set_viscosity(st, w, real(0.0))
    again = st.failed[w] == 0 and not _is_own(st, w)
    st.slips[w] = OWN
    if again:
        st.rounds[w] = st.rounds[w] + 1
        if _comes_to_rest(st, w):  # the same part, with friction of the balance that was found
            if max_work - st.work[w] < max_work / 10:
                st.asked[w] = 0
                return
            st.moving[w] = 1
            any_increment[0] = 1
            return
    else:
        st.rounds[w] = 0
    increment = st.increment[w]
    if st.failed[w] == 0:
        st.kept[w] = 1
        st.load_factor[w] = st.trial_factor[w]
        if st.cut_back[w] == 1 and not again:
            st.cut_back[w] = 2
        elif not again:
            increment = real(2.0) * increment
    elif st.load_factor[w] == real(1.0):  # friction did not come to rest
        increment = real(0.0)
    elif increment == real(0.0):
        st.reason[w] = NOT_CONVERGED
        increment = _FIRST_PART
        if st.deep[w] == 1:
            st.reason[w] = INSIDE_CORE
        if st.guessed[w] == 1:
            increment = real(0.0)
    else:
        increment = real(0.5) * increment
        st.cut_back[w] = 1
    if increment < shortest or max_work - st.work[w] < max_work / 10:
        st.asked[w] = 0
        return
    if not again:
        st.increment[w] = wp.min(increment, real(1.0) - st.load_factor[w])
        st.trial_factor[w] = st.load_factor[w] + st.increment[w]
    st.returns[w] = 1
    st.moving[w] = 1
    any_increment[0] = 1


@wp.kernel
def start_increment(
    limit: int, max_work: int, st: Worlds, any_increment: wp.array(dtype=int), any_lagged: wp.array(dtype=int)
):
    """Worlds that are moving try the next part of their way."""
    w = wp.tid()
    if w == 0:
        any_increment[0] = 0
    st.lagged[w] = 0
    if st.moving[w] == 1:
        st.active[w] = 1
        st.failed[w] = 0
        st.deep[w] = 0
        begin_try(st, w, limit, max_work)
        if st.cut_back[w] > 0 or st.by_load[w] == 1:
            st.slips[w] = FIXED
            st.lagged[w] = 1
            any_lagged[0] = 1


@wp.kernel
def lag_friction(st: Worlds, any_lagged: wp.array(dtype=int)):
    """The bounds are known: from there on they are fixed."""
    w = wp.tid()
    if w == 0:
        any_lagged[0] = 0
    if st.lagged[w] == 1:
        st.work[w] = st.work[w] + 1
        st.slips[w] = LAGGED


@wp.func
def partial_turn(begin: mat33, end: mat33, fraction: real):
    """Attitude at a share of the turn between two, about one axis."""
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
    """Puts the geoms of the worlds that are on to a share of their way: along a line, turning about one
    axis; and from there where their bodies go with the wrenches `posed`."""
    g, w = wp.tid()
    if on[w] == 0:
        return
    f = fraction[w]
    begin = path.pos_start[g, w]
    if f == real(1.0):
        geoms.pos[g, w] = path.pos_end[g, w]
        geoms.mat[g, w] = path.mat_end[g, w]
    elif not wp.isfinite(begin[0] + begin[1] + begin[2]):  # bad input, and no pose before
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
def keep_geoms(geoms: Geoms, kept: wp.array(dtype=int)):
    """From there on counts how far what touches anew has slipped."""
    g, w = wp.tid()
    if kept[w] == 1:
        geoms.pos_last[g, w] = geoms.pos[g, w]
        geoms.mat_last[g, w] = geoms.mat[g, w]


@wp.kernel
def end_path(st: Worlds, any_short: wp.array(dtype=int)):
    """Worlds that ended before their load path did are moving, those that are where they were have failed."""
    w = wp.tid()
    f = st.load_factor[w]
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
def release_geoms(geoms: Geoms, path: LoadPath, st: Worlds, motion_out: wp.array2d(dtype=vec3)):
    """Makes the poses that were reached those of the last step, tells the motion to there, and writes back
    what was set."""
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
