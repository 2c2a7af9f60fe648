"""What decides: one thread for each world begins its step, judges its balance, steers its line
search and ends its step."""

import warp as wp

from ..contact.faces import Geoms
from ..types import mat33, real, vec3

__all__ = [
    "BALANCED",
    "BLOCK",
    "CONVERGED",
    "INSIDE_CORE",
    "NOT_CONVERGED",
    "NOT_FINITE",
    "Worlds",
    "all_on",
    "begin_worlds",
    "choose_length",
    "end_worlds",
    "hold_geoms",
    "judge_balance",
    "release_geoms",
    "retry_worlds",
    "total_of",
    "totals_of",
]

wp.set_module_options({"enable_backward": False})

# reason of a world's last step
CONVERGED, NOT_FINITE, INSIDE_CORE, NOT_CONVERGED = (wp.constant(i) for i in range(4))

BALANCED = 1e-9  # [N] of residual on all nodes: rounding, where nothing touches
_PRESSURE_TOLERANCE = wp.constant(wp.float64(0.01))
_PRESSURE_NOISE = wp.constant(wp.float64(1.0))  # [Pa] a thirtieth of the sensor's resolution
_REFERENCE = wp.constant(wp.float64(1e3))  # [Pa] least pressure that sets where skin and core part
_FAR = wp.constant(wp.float64(1e3))  # [m]


@wp.struct
class Worlds:
    """Scalars of every world (nworld,). Flags are 0 or 1."""

    mu: wp.array(dtype=real)
    lam: wp.array(dtype=real)
    contact_stiffness: wp.array(dtype=real)  # pressure per overclosure [Pa/m]
    density: wp.array(dtype=real)  # [kg/m^3], of implicit dynamics
    softness: wp.array(dtype=real)  # E of the model over E of the world
    kappa: wp.array(dtype=real)  # K / natural volume [Pa/m^3]
    natural: wp.array(dtype=real)  # volume of the liquid without pressure [m^3]
    holds: wp.array(dtype=int)  # the volume is kept: the liquid is incompressible
    offset: wp.array(dtype=real)  # pressure at the natural volume [Pa]
    reference: wp.array(dtype=real)  # of `wet_faces` [Pa]
    last_pressure: wp.array(dtype=real)  # when the last step ended, above the surroundings [Pa]
    pressure: wp.array(dtype=real)  # at the last evaluation [Pa]
    volume: wp.array(dtype=real)  # of the liquid there [m^3]
    asked: wp.array(dtype=int)  # its input can be solved, and it has not failed twice
    active: wp.array(dtype=int)  # not yet in balance
    running: wp.array(dtype=int)  # its linear solve goes on
    moving: wp.array(dtype=int)  # its line search goes on
    failed: wp.array(dtype=int)
    deep: wp.array(dtype=int)  # a geom is inside the core
    touched: wp.array(dtype=int)  # a geom or the core touches
    pulls: wp.array(dtype=int)  # geoms pull: adhesion has no tangent where it softens
    inverted: wp.array(dtype=int)  # a tetrahedron is, see `rubber.element_kernels`
    reason: wp.array(dtype=int)
    nonconverged: wp.array(dtype=int)  # steps since reset
    iterations: wp.array(dtype=int)
    error: wp.array(dtype=real)
    repeat: wp.array(dtype=real)  # how much of the last motion this step repeats
    alpha: wp.array(dtype=real)  # step length
    beta: wp.array(dtype=real)
    swell: wp.array(dtype=real)  # kappa times the change of volume along a direction [Pa]
    first: wp.array(dtype=real)
    rz: wp.array(dtype=real)
    norm: wp.array(dtype=real)  # of the residual [N]
    slope: wp.array(dtype=real)
    low: wp.array(dtype=real)
    high: wp.array(dtype=real)
    slope_low: wp.array(dtype=real)
    slope_high: wp.array(dtype=real)
    side: wp.array(dtype=int)
    tries: wp.array(dtype=int)
    iterations_cg: wp.array(dtype=int)


BLOCK = 128  # threads that share the sums of one world


@wp.func
def total_of(part: wp.array3d(dtype=real), k: int, w: int, t: int):
    """Sum of part[k, :, w] by the threads t of a block, always in the same order; all of them get it."""
    s = real(0.0)
    for c in range(t, part.shape[1], wp.block_dim()):
        s += part[k, c, w]
    return wp.tile_extract(wp.tile_sum(wp.tile(s)), 0)


@wp.func
def totals_of(part: wp.array3d(dtype=real), k: int, other: wp.array3d(dtype=real), l: int, w: int, t: int):
    """Two such sums, whose loads overlap."""
    a = real(0.0)
    b = real(0.0)
    for c in range(t, part.shape[1], wp.block_dim()):
        a += part[k, c, w]
        b += other[l, c, w]
    return wp.tile_extract(wp.tile_sum(wp.tile(a)), 0), wp.tile_extract(wp.tile_sum(wp.tile(b)), 0)


@wp.func
def clear_line(st: Worlds, w: int):
    st.low[w] = real(0.0)
    st.high[w] = real(-1.0)  # none yet
    st.side[w] = 0
    st.tries[w] = 0
    st.alpha[w] = real(1.0)


@wp.kernel
def begin_worlds(
    # In:
    law: int,
    youngs_modulus: real,
    geoms: Geoms,
    motion: wp.array2d(dtype=vec3),
    st: Worlds,
    # In and out:
    touched_by: wp.array2d(dtype=int),
    # Out:
    flags: wp.array(dtype=int),
):
    """Looks at the input; finds how far each touching geom repeats its last motion."""
    w = wp.tid()
    if w == 0:
        for k in range(flags.shape[0]):
            flags[k] = 0
    st.reason[w] = CONVERGED
    finite = int(1)
    now_last = real(0.0)
    square = real(0.0)
    for g in range(geoms.count):
        p = geoms.pos[g, w]
        R = geoms.mat[g, w]
        total = p[0] + p[1] + p[2] + geoms.friction[g, w]
        for a in range(3):
            for b in range(3):
                total += R[a, b]
        if not wp.isfinite(total):
            finite = 0
        last = geoms.pos_last[g, w]
        if finite == 1 and not wp.isfinite(last[0] + last[1] + last[2]):
            geoms.pos_last[g, w] = p
            geoms.mat_last[g, w] = R
            last = p
        if touched_by[g, w] == 1:
            was = motion[g, w]
            now_last += wp.dot(p - last, was)
            square += wp.dot(was, was)
        touched_by[g, w] = 0
    m = st.mu[w]
    l = st.lam[w]
    E = m * (real(3.0) * l + real(2.0) * m) / (l + m)
    if law == 2:
        E = real(9.0) * l * m / (real(3.0) * l + m)
    st.softness[w] = youngs_modulus / E
    if not (wp.isfinite(E + st.kappa[w] + st.natural[w]) and E > real(0.0)):
        finite = 0
    repeat = real(0.0)
    if square > real(0.0):
        repeat = wp.clamp(now_last / square, real(0.0), real(2.0))
    st.repeat[w] = repeat
    asked = int(1)
    if finite == 0:
        st.reason[w] = NOT_FINITE
        asked = 0
    elif st.deep[w] == 1:
        st.reason[w] = INSIDE_CORE
        asked = 0
    st.deep[w] = 0
    st.asked[w] = asked
    st.active[w] = asked
    st.failed[w] = 0
    st.inverted[w] = 0
    st.iterations[w] = 0
    st.offset[w] = real(0.0)
    if st.holds[w] == 1:
        st.offset[w] = st.last_pressure[w]
    st.reference[w] = wp.max(wp.abs(st.last_pressure[w]), _REFERENCE)


@wp.kernel
def judge_balance(
    # In:
    tolerance: real,
    limit: int,
    has_liquid: int,
    part: wp.array3d(dtype=real),
    worth: wp.array3d(dtype=real),
    st: Worlds,
    # Out:
    go_on: wp.array(dtype=int),
):
    """Ends the worlds that are in balance. part: residual . z and gradient . z; worth: see
    `nodes.residuals`."""
    w, t = wp.tid()
    if st.active[w] == 0:
        return
    rr, rz = totals_of(worth, 0, part, 0, w, t)
    load, fly = totals_of(worth, 1, worth, 3, w, t)
    gz = total_of(part, 1, w, t)
    if t > 0:
        return
    if not wp.isfinite(rr + rz):
        st.active[w] = 0
        st.failed[w] = 1
        return
    if st.touched[w] == 0 and rr < real(BALANCED) * real(BALANCED):
        st.active[w] = 0
        st.error[w] = real(0.0)
        return
    # single precision leaves more residual than nothing, so a vibration without contact is measured by the
    # work of its inertia
    work = wp.abs(load) + wp.abs(fly) + real(1.0e-12)
    st.error[w] = wp.sqrt(wp.abs(rz) / work)
    settled = int(1)
    if has_liquid == 1:
        if st.kappa[w] * wp.abs(gz) > _PRESSURE_TOLERANCE * wp.abs(st.pressure[w]) + _PRESSURE_NOISE:
            settled = 0
    # where the preconditioner is indefinite by rounding, a negative product is as far from balance
    if wp.abs(rz) <= tolerance * tolerance * work and settled == 1:
        st.active[w] = 0
    elif st.iterations[w] == limit:
        st.active[w] = 0
        st.failed[w] = 1
    else:
        st.iterations[w] = st.iterations[w] + 1
        st.rz[w] = rz
        st.first[w] = rz
        go_on[0] = 1


@wp.kernel
def retry_worlds(st: Worlds, again: wp.array(dtype=int)):
    """Worlds that failed although their input is sound are asked once more."""
    w = wp.tid()
    st.active[w] = 0
    if st.asked[w] == 1 and st.failed[w] == 1:
        st.active[w] = 1
        st.failed[w] = 0
        st.inverted[w] = 0
        again[0] = 1


@wp.kernel
def choose_length(part: wp.array3d(dtype=real), st: Worlds, go_on: wp.array(dtype=int)):
    """Looks for the length where the residual has (nearly) no component along the step, by regula falsi.

    part: force . direction after the step, and before it where this is the first try.
    """
    w, t = wp.tid()
    if st.moving[w] == 0:
        return
    now = total_of(part, 0, w, t)
    slope = total_of(part, 1, w, t)
    if t > 0:
        return
    if st.tries[w] == 0:
        st.slope[w] = slope
        st.slope_low[w] = slope
        st.slope_high[w] = slope
    else:
        slope = st.slope[w]
    valid = int(0)
    if wp.isfinite(now) and st.inverted[w] == 0:
        valid = 1
    st.inverted[w] = 0
    has_high = int(0)
    if st.high[w] >= real(0.0):
        has_high = 1
    enough = int(0)
    if valid == 1 and now >= real(-0.5) * slope:
        if st.pulls[w] == 1:
            if now <= real(0.2) * slope:
                enough = 1
        elif has_high == 0 or now <= real(0.5) * slope:
            enough = 1
    st.tries[w] = st.tries[w] + 1
    if enough == 1 or st.tries[w] == 12:
        st.moving[w] = 0
        return
    if valid == 0 or now < real(0.0):
        if st.side[w] == 1:  # Illinois: an end that stays twice loses half of its slope
            st.slope_low[w] = st.slope_low[w] / real(2.0)
        st.side[w] = 1
        st.high[w] = st.alpha[w]
        st.slope_high[w] = now
        if valid == 0:
            st.slope_high[w] = real(-1.0e300)
    else:
        if st.side[w] == -1:
            st.slope_high[w] = st.slope_high[w] / real(2.0)
        st.side[w] = -1
        st.low[w] = st.alpha[w]
        st.slope_low[w] = now
    if st.pulls[w] == 1 and st.high[w] < real(0.0):
        # a pull that falls as the gap opens is in no tangent: the way goes on
        further = wp.clamp(slope / wp.max(slope - now, slope / real(4.0)), real(1.25), real(4.0))
        st.alpha[w] = st.alpha[w] * further
        go_on[0] = 1
        return
    low = st.low[w]
    high = st.high[w]
    guess = real(0.5) * (low + high)
    if st.slope_high[w] > real(-1.0e299):
        guess = low + (high - low) * st.slope_low[w] / (st.slope_low[w] - st.slope_high[w])
    margin = real(0.05) * (high - low)
    st.alpha[w] = wp.clamp(guess, low + margin, high - margin)
    go_on[0] = 1


@wp.kernel
def hold_geoms(
    # In:
    geoms: Geoms,
    st: Worlds,
    # Out:
    pos_out: wp.array2d(dtype=vec3),
    mat_out: wp.array2d(dtype=mat33),
    motion_out: wp.array2d(dtype=vec3),
    any_failed: wp.array(dtype=int),
):
    """Keeps the poses as they were set; puts the geoms of failed worlds back to where the step began."""
    w = wp.tid()
    if st.asked[w] == 0:
        st.failed[w] = 1
    if st.failed[w] == 1:
        any_failed[0] = 1
    for g in range(geoms.count):
        pos_out[g, w] = geoms.pos[g, w]
        mat_out[g, w] = geoms.mat[g, w]
        if st.failed[w] == 1:
            last = geoms.pos_last[g, w]
            if wp.isfinite(last[0] + last[1] + last[2]):
                geoms.pos[g, w] = last
                geoms.mat[g, w] = geoms.mat_last[g, w]
            else:
                geoms.pos[g, w] = vec3(_FAR, _FAR, _FAR)
                geoms.mat[g, w] = wp.identity(n=3, dtype=real)
            motion_out[g, w] = vec3()
        else:
            motion_out[g, w] = geoms.pos[g, w] - geoms.pos_last[g, w]


@wp.kernel
def release_geoms(geoms: Geoms, pos: wp.array2d(dtype=vec3), mat: wp.array2d(dtype=mat33), st: Worlds):
    """Makes the poses of this step those of the last one, where it went well, and writes back what was
    set."""
    w = wp.tid()
    for g in range(geoms.count):
        if st.failed[w] == 0:
            geoms.pos_last[g, w] = geoms.pos[g, w]
            geoms.mat_last[g, w] = geoms.mat[g, w]
        geoms.pos[g, w] = pos[g, w]
        geoms.mat[g, w] = mat[g, w]


@wp.kernel
def end_worlds(st: Worlds):
    w = wp.tid()
    if st.failed[w] == 1:
        st.nonconverged[w] = st.nonconverged[w] + 1
        if st.reason[w] == CONVERGED:
            st.reason[w] = NOT_CONVERGED
    else:
        st.last_pressure[w] = st.pressure[w]


@wp.kernel
def all_on(flag: wp.array(dtype=int)):
    flag[wp.tid()] = 1
