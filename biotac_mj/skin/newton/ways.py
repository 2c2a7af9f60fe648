"""The way of the geoms in a step, which most worlds go at once: who does not, which part of it a world tries
next, geoms put to a share of it, and how far they came in the end."""

import warp as wp

from ..bodies import Bodies, give_way
from ..contact.posed import Geoms, Way
from ..contact.touch import LED, OWN, TOLD
from ..types import mat33, real, vec3
from .worlds import CONVERGED, INSIDE_CORE, NOT_CONVERGED, NOT_FINITE, Worlds, begin_try, set_lag

__all__ = [
    "end_try",
    "end_way",
    "judge_way",
    "keep_geoms",
    "lead_friction",
    "place_geoms",
    "release_geoms",
    "share_of_turn",
    "start_part",
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
    """Whether friction is that of the balance that was found: of one that it was led to where it is that of
    the balance before, which is found again at once."""
    return st.slips[w] != LED or st.iterations[w] == st.began[w]


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
    return st.failed[w] == 0 and st.ahead[w] == real(1.0) and _is_own(st, w)


@wp.func
def _arrive(st: Worlds, w: int):
    set_lag(st, w, real(0.0))
    st.slips[w] = OWN
    st.reached[w] = real(1.0)
    st.reason[w] = CONVERGED
    st.asked[w] = 0


@wp.kernel
def judge_way(
    shortest: real,
    max_work: int,
    st: Worlds,
    passed: wp.array(dtype=int),
    any_part: wp.array(dtype=int),
):
    """How far the open worlds have come, and which part of the way they try next: they are moving.

    The first try is the whole way from a guess. Parts cost together hardly more than the whole, and what they
    come to is not lost: so they begin short. Friction goes with them: where a part ends the skin sticks, or
    slips, and from there the next one slips on.

    Where friction is several times the push, Newton's method goes round: what slips is held by its push, and
    that hangs on what slips. So after a part that failed, and of friction by load at once, it is led: bounded
    by the push of the balance before. Without it forces have a potential but for adhesion, and a balance is
    found. Round by round, while that comes to rest, the part has friction of its own; else it slips on from
    each balance, which loses work each time, and so comes to rest.

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
    set_lag(st, w, real(0.0))
    again = st.failed[w] == 0 and not _is_own(st, w)
    st.slips[w] = OWN
    if again:
        st.rounds[w] = st.rounds[w] + 1
        if _comes_to_rest(st, w):  # the same part, with friction of the balance that was found
            if max_work - st.work[w] < max_work / 10:
                st.asked[w] = 0
                return
            st.moving[w] = 1
            any_part[0] = 1
            return
    else:
        st.rounds[w] = 0
    stride = st.stride[w]
    if st.failed[w] == 0:
        st.kept[w] = 1
        st.reached[w] = st.ahead[w]
        if st.halved[w] == 1 and not again:
            st.halved[w] = 2
        elif not again:
            stride = real(2.0) * stride
    elif st.reached[w] == real(1.0):  # friction did not come to rest
        stride = real(0.0)
    elif stride == real(0.0):
        st.reason[w] = NOT_CONVERGED
        stride = _FIRST_PART
        if st.deep[w] == 1:
            st.reason[w] = INSIDE_CORE
        if st.guessed[w] == 1:
            stride = real(0.0)
    else:
        stride = real(0.5) * stride
        st.halved[w] = 1
    if stride < shortest or max_work - st.work[w] < max_work / 10:
        st.asked[w] = 0
        return
    if not again:
        st.stride[w] = wp.min(stride, real(1.0) - st.reached[w])
        st.ahead[w] = st.reached[w] + st.stride[w]
    st.returns[w] = 1
    st.moving[w] = 1
    any_part[0] = 1


@wp.kernel
def start_part(
    limit: int, max_work: int, st: Worlds, any_part: wp.array(dtype=int), any_led: wp.array(dtype=int)
):
    """Worlds that are moving try the next part of their way."""
    w = wp.tid()
    if w == 0:
        any_part[0] = 0
    if st.moving[w] == 1:
        st.active[w] = 1
        st.failed[w] = 0
        st.deep[w] = 0
        begin_try(st, w, limit, max_work)
        if st.halved[w] > 0 or st.by_load[w] == 1:
            st.slips[w] = TOLD
            any_led[0] = 1


@wp.kernel
def lead_friction(st: Worlds, any_led: wp.array(dtype=int)):
    """The bounds are told: from there on they stay."""
    w = wp.tid()
    if w == 0:
        any_led[0] = 0
    if st.moving[w] == 1 and st.slips[w] == TOLD:
        st.work[w] = st.work[w] + 1
        st.slips[w] = LED


@wp.func
def share_of_turn(begin: mat33, end: mat33, share: real):
    """Attitude at a share of the turn between two, about one axis."""
    turn = wp.quat_from_matrix(wp.transpose(begin) * end)
    u = vec3(turn[0], turn[1], turn[2])
    half = wp.atan2(wp.length(u), wp.abs(turn[3]))
    u = wp.where(turn[3] < real(0.0), -u, u)
    return begin * wp.quat_to_matrix(wp.quat_from_axis_angle(wp.normalize(u), real(2.0) * share * half))


@wp.kernel
def place_geoms(
    # In:
    way: Way,
    share: wp.array(dtype=real),
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
    f = share[w]
    begin = way.pos_start[g, w]
    if f == real(1.0):
        geoms.pos[g, w] = way.pos_end[g, w]
        geoms.mat[g, w] = way.mat_end[g, w]
    elif not wp.isfinite(begin[0] + begin[1] + begin[2]):  # bad input, and no pose before
        geoms.pos[g, w] = vec3(_FAR, _FAR, _FAR)
        geoms.mat[g, w] = wp.identity(n=3, dtype=real)
    elif f == real(0.0):
        geoms.pos[g, w] = begin
        geoms.mat[g, w] = way.mat_start[g, w]
    else:
        geoms.pos[g, w] = begin + f * (way.pos_end[g, w] - begin)
        geoms.mat[g, w] = share_of_turn(way.mat_start[g, w], way.mat_end[g, w], f)
    if b.posed.shape[0] > 0:
        h = geoms.group[g]
        m = wp.spatial_vectord()
        for k in range(b.posed.shape[0]):
            more = b.posed[k, w] - (real(1.0) - f) * b.begun[k, w] - f * b.predicted[k, w]
            m += b.compliance[h, k, w] * more
        pos, mat = give_way(h, w, b, m, geoms.pos[g, w], geoms.mat[g, w])
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
def end_way(st: Worlds, any_short: wp.array(dtype=int)):
    """The worlds whose way was not gone to its end are moving, those that are where they were have failed."""
    w = wp.tid()
    f = st.reached[w]
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
def release_geoms(geoms: Geoms, way: Way, st: Worlds, motion_out: wp.array2d(dtype=vec3)):
    """Makes the poses that were reached those of the last step, tells the motion to there, and writes back
    what was set."""
    g, w = wp.tid()
    if st.wanted[w] == 0:
        return
    motion_out[g, w] = vec3()
    begin = way.pos_start[g, w]
    if st.reached[w] > real(0.0) and wp.isfinite(begin[0] + begin[1] + begin[2]):
        motion_out[g, w] = geoms.pos[g, w] - begin
    if st.reason[w] != NOT_FINITE:
        geoms.pos_last[g, w] = geoms.pos[g, w]
        geoms.mat_last[g, w] = geoms.mat[g, w]
    geoms.pos[g, w] = way.pos_end[g, w]
    geoms.mat[g, w] = way.mat_end[g, w]
