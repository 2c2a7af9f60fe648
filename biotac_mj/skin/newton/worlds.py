"""What decides: one thread for each world begins its step, judges its balance, steers its line
search and ends its step."""

import warp as wp

from ..contact.posed import Geoms, LoadPath
from ..contact.touch import LAGGED, OWN
from ..types import real, sum_of_block, vec3, vec6

__all__ = [
    "BALANCED",
    "BLOCK",
    "CONVERGED",
    "INSIDE_CORE",
    "NOT_CONVERGED",
    "NOT_FINITE",
    "Worlds",
    "all_on",
    "begin_try",
    "begin_worlds",
    "choose_viscosity",
    "choose_length",
    "end_worlds",
    "find_lost",
    "judge_balance",
    "modulus_of",
    "set_viscosity",
    "start_at_rest",
    "total_of",
    "totals_of",
]

wp.set_module_options({"enable_backward": False})

# reason of a world's last step
CONVERGED, NOT_FINITE, INSIDE_CORE, NOT_CONVERGED = (wp.constant(i) for i in range(4))

BALANCED = 1e-9  # [N] of residual on all nodes: rounding, where nothing touches
_PRESSURE_TOLERANCE = wp.constant(wp.float64(0.01))
_PRESSURE_NOISE = wp.constant(wp.float64(1.0))  # [Pa] a thirtieth of the sensor's resolution
# times what a pressure may be off, if it is corrected by volume alone; `give` of liquid that is stiff enough
_CORRECTED, _STIFFER = (wp.constant(wp.float64(x)) for x in (4.0, 0.1))
_LAGGED_TO = wp.constant(wp.float64(0.05))  # of the error at which a round of lagged friction began
_REFERENCE = wp.constant(wp.float64(1e3))  # [Pa] least pressure that sets where skin and core part
_PATIENCE = wp.constant(40)  # iterations in which the error must halve
_TRIES = wp.constant(12)  # of a line search
_SLOW = wp.constant(8)  # iterations of a try after which artificial viscosity may begin
# by which the viscosity shrinks after a good full step, and grows after a bad one
_QUICKER, _SLOWER = (wp.constant(wp.float64(x)) for x in (3.0, 4.0))
# viscosity that counts as none, and with which skin is stiffer than contact
_AT_ONCE, _FIXED = (wp.constant(wp.float64(x)) for x in (0.01, 1e5))
_AS_STIFF = wp.constant(wp.float64(40.0))  # E, as which liquid is in a line search
# error below which no viscosity begins, since rounding is no circle, and none is pulled ever further
_NEAR = wp.constant(wp.float64(0.01))


@wp.struct
class Worlds:
    """Scalars of every world (nworld,). Flags are 0 or 1."""

    mu: wp.array(dtype=real)
    lam: wp.array(dtype=real)
    contact_stiffness: wp.array(dtype=real)  # pressure per overclosure [Pa/m]
    density: wp.array(dtype=real)  # [kg/m^3], of implicit dynamics
    softness: wp.array(dtype=real)  # E of the model over E of the world, less where it is viscous
    elastic: wp.array(dtype=real)  # where it does, what it is otherwise
    viscosity: wp.array(
        dtype=real
    )  # artificial: rubber resists an iteration as if it were stiffer by so much
    viscous_work: wp.array(dtype=real)  # work of the artificial viscosity along a direction [J]
    kappa: wp.array(dtype=real)  # K / natural volume [Pa/m^3]
    natural: wp.array(dtype=real)  # volume of the liquid without pressure [m^3]
    holds: wp.array(dtype=int)  # the volume is kept: the liquid is incompressible
    offset: wp.array(dtype=real)  # pressure at the natural volume [Pa]
    reference: wp.array(dtype=real)  # of `wet_faces` [Pa]
    last_pressure: wp.array(dtype=real)  # when the last step ended, above the surroundings [Pa]
    pressure: wp.array(dtype=real)  # at the last evaluation [Pa]
    before: wp.array(dtype=real)  # where the linear solve began [Pa]
    foreseen: wp.array(dtype=real)  # where it leads to, see `choose_length` [Pa]
    borne: wp.array(dtype=real)  # that the tangent has: the one foreseen, as far as the skin went there [Pa]
    give: wp.array(dtype=real)  # some E over K, 1 at most
    stiff: wp.array(dtype=real)  # fraction of the liquid's stiffness that the line search knows
    volume: wp.array(dtype=real)  # of the liquid there [m^3]
    wanted: wp.array(dtype=int)  # takes part in this step; who does not stays as the last one left it
    asked: wp.array(dtype=int)  # its input can be solved, and its load path has not ended
    active: wp.array(dtype=int)  # not yet in balance
    running: wp.array(dtype=int)  # its linear solve goes on
    moving: wp.array(dtype=int)  # its line search goes on
    failed: wp.array(dtype=int)
    deep: wp.array(dtype=int)  # a geom is inside the core
    touched: wp.array(dtype=int)  # a geom or the core touches
    slips: wp.array(dtype=int)  # how friction is bounded: OWN, FIXED or LAGGED, see `contact.touch`
    pulls: wp.array(dtype=int)  # geoms pull: adhesion has no tangent where it softens
    by_load: wp.array(dtype=int)  # its friction depends on load
    inverted: wp.array(dtype=int)  # a tetrahedron is at the last evaluation, see `ElementForces.push_corners`
    reason: wp.array(dtype=int)
    nonconverged: wp.array(dtype=int)  # steps since reset
    iterations: wp.array(dtype=int)
    began: wp.array(dtype=int)  # iterations before the present try
    limit: wp.array(dtype=int)  # of iterations, at which the present try ends
    allowed: wp.array(dtype=int)  # work, at which it ends
    error: wp.array(dtype=real)
    last_error: wp.array(dtype=real)  # of the iteration before
    best: wp.array(dtype=real)  # square of the error that this try has not halved since iteration `since`
    since: wp.array(dtype=int)
    load_factor: wp.array(dtype=real)  # fraction of the load path at which the skin is in equilibrium
    trial_factor: wp.array(dtype=real)  # load factor that is tried
    increment: wp.array(dtype=real)  # between both; 0: the first try
    cut_back: wp.array(dtype=int)  # 1: the last increment was too long, and none grows; 2: an earlier one
    lagged: wp.array(dtype=int)  # the bound of friction is to be that of a balance
    kept: wp.array(dtype=int)  # the last increment converged: the next one begins there
    returns: wp.array(dtype=int)  # the next try begins where the increment does, not where the last try ended
    rounds: wp.array(dtype=int)  # equilibria with lagged friction bounds, in this increment
    opened: wp.array(dtype=real)  # error at which the try began
    rests: wp.array(dtype=int)  # 1: it tries to rest, after a first try that found no balance; 2: it has
    # this step begins where the last motion leads, whatever the geoms' motion, and is never cut back
    guessed: wp.array(dtype=int)
    repeat: wp.array(dtype=real)  # how much of the last motion this step repeats
    alpha: wp.array(dtype=real)  # step length
    longer: wp.array(dtype=real)  # than the one before it in this search
    beta: wp.array(dtype=real)
    swell: wp.array(dtype=real)  # kappa times the change of volume along a direction [Pa]
    pressure_correction: wp.array(dtype=real)  # times the liquid's direction it corrects the volume; 0: none
    first: wp.array(dtype=real)
    rz: wp.array(dtype=real)
    loose: wp.array(dtype=real)  # twice the energy by which bodies are not where wrenches bring them [J]
    norm: wp.array(dtype=real)  # of the residual [N]
    slope: wp.array(dtype=real)
    low: wp.array(dtype=real)
    high: wp.array(dtype=real)
    slope_low: wp.array(dtype=real)
    slope_high: wp.array(dtype=real)
    side: wp.array(dtype=int)
    tries: wp.array(dtype=int)
    iterations_cg: wp.array(dtype=int)
    work: wp.array(dtype=int)  # evaluations and products of this step so far, and what counts like them
    spent: wp.array(dtype=int)  # work done before the step, where it is one of several tries of a caller


BLOCK = 128  # threads that share the sums of one world


@wp.func
def total_of(part: wp.array3d(dtype=real), k: int, w: int, t: int):
    """Sum of part[k, :, w] by the threads t of a block, always in the same order; all of them get it."""
    s = real(0.0)
    for c in range(t, part.shape[1], wp.block_dim()):
        s += part[k, c, w]
    return sum_of_block(s)


@wp.func
def totals_of(part: wp.array3d(dtype=real), w: int, t: int):
    """The first three such sums, at once."""
    own = vec3()
    for c in range(t, part.shape[1], wp.block_dim()):
        own += vec3(part[0, c, w], part[1, c, w], part[2, c, w])
    return sum_of_block(own)


@wp.func
def clear_line(st: Worlds, w: int):
    st.low[w] = real(0.0)
    st.high[w] = real(-1.0)  # none yet
    st.side[w] = 0
    st.tries[w] = 0
    st.alpha[w] = real(1.0)
    st.inverted[w] = 0


@wp.func
def set_viscosity(st: Worlds, w: int, viscosity: real):
    if st.viscosity[w] == real(0.0):
        st.elastic[w] = st.softness[w]
    st.softness[w] = st.elastic[w] / (real(1.0) + viscosity)
    st.viscosity[w] = viscosity


@wp.func
def begin_try(st: Worlds, w: int, limit: int, max_work: int):
    """A try may take half of what is left: the next one, of a shorter increment, takes less."""
    st.borne[w] = st.last_pressure[w]
    st.began[w] = st.iterations[w]
    st.inverted[w] = 0
    st.limit[w] = st.iterations[w] + limit
    st.allowed[w] = st.work[w] + (max_work - st.work[w]) / 2
    st.since[w] = st.iterations[w]
    st.best[w] = real(1.0e300)


@wp.func
def modulus_of(law: int, m: real, l: real):
    """Young's modulus by the constants of a law [Pa]."""
    E = m * (real(3.0) * l + real(2.0) * m) / (l + m)
    if law == 2:
        E = real(9.0) * l * m / (real(3.0) * l + m)
    return E


@wp.kernel
def begin_worlds(
    # In:
    law: int,
    youngs_modulus: real,
    limit: int,
    max_work: int,
    geoms: Geoms,
    motion: wp.array2d(dtype=vec3),
    st: Worlds,
    # In and out:
    touched_by: wp.array2d(dtype=int),
    # Out:
    path: LoadPath,
    flags: wp.array(dtype=int),
):
    """Looks at the input; finds how far each touching geom repeats its last motion."""
    w = wp.tid()
    if w == 0:
        for k in range(flags.shape[0]):
            flags[k] = 0
    m = st.mu[w]
    l = st.lam[w]
    E = modulus_of(law, m, l)
    st.softness[w] = youngs_modulus / E
    st.give[w] = wp.min(_AS_STIFF * E / wp.max(st.kappa[w] * st.natural[w], E), real(1.0))
    st.viscosity[w] = real(0.0)
    if st.wanted[w] == 0:
        st.asked[w] = 0
        st.active[w] = 0
        return
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
        path.pos_start[g, w] = last
        path.mat_start[g, w] = geoms.mat_last[g, w]
        path.pos_end[g, w] = p
        path.mat_end[g, w] = R
        if finite == 1 and not wp.isfinite(last[0] + last[1] + last[2]):
            geoms.pos_last[g, w] = p
            geoms.mat_last[g, w] = R
            last = p
        if touched_by[g, w] == 1:
            was = motion[g, w]
            now_last += wp.dot(p - last, was)
            square += wp.dot(was, was)
        touched_by[g, w] = 0
    if not (wp.isfinite(E + st.kappa[w] + st.natural[w]) and E > real(0.0)):
        finite = 0
    repeat = real(0.0)
    if square > real(0.0):
        repeat = wp.clamp(now_last / square, real(0.0), real(2.0))
    if st.guessed[w] == 1:
        repeat = real(1.0)
    st.repeat[w] = repeat
    if finite == 0:
        st.reason[w] = NOT_FINITE
    st.asked[w] = finite
    st.active[w] = finite
    st.failed[w] = 0
    st.deep[w] = 0
    st.iterations[w] = 0
    st.work[w] = st.spent[w]
    st.slips[w] = OWN
    begin_try(st, w, limit, max_work)
    if st.guessed[w] == 1:  # no increment comes after it
        st.allowed[w] = max_work
    st.load_factor[w] = real(0.0)
    st.trial_factor[w] = real(1.0)
    st.increment[w] = real(0.0)
    st.cut_back[w] = 0
    st.rounds[w] = 0
    st.rests[w] = 0
    st.offset[w] = real(0.0)
    if st.holds[w] == 1:
        st.offset[w] = st.last_pressure[w]
    st.reference[w] = wp.max(wp.abs(st.last_pressure[w]), _REFERENCE)


@wp.func
def _finishes(error: real, last: real, tolerance: real, left: int):
    """Whether a try whose error goes on falling as it did in its last iteration ends with so much work: two
    for each iteration, of Newton's method with whole steps."""
    return error < last and wp.log(tolerance / error) * real(2.0) > real(left) * wp.log(error / last)


@wp.kernel
def judge_balance(
    # In:
    tolerance: real,
    max_work: int,
    has_liquid: int,
    rest_pressure: wp.array(dtype=real),
    part: wp.array3d(dtype=real),
    worth: wp.array3d(dtype=real),
    st: Worlds,
    # Out:
    any_active: wp.array(dtype=int),
):
    """Ends the worlds that are in balance. part: residual . z and gradient . z; worth: see
    `nodes.residuals`. The sensor reads pressure above rest, so that is what must be known well: a skin that
    has lost half of its liquid rests at minus 20 kPa.

    Where nothing but the pressure is missing, and not much, no iteration is needed: it becomes the one that z
    leads to, which is known several times better. The volume that belongs to it is picometres away in stiff
    liquid, see `nodes.correct_pressure`."""
    w, t = wp.tid()
    if st.active[w] == 0:
        if t == 0:
            st.pressure_correction[w] = real(0.0)
        return
    # read before the sums, which takes as long as they do: a read behind a write waits for it
    viscosity = st.viscosity[w]
    best = st.best[w]
    iterations = st.iterations[w]
    began = st.began[w]
    opened = st.opened[w]
    since = st.since[w]
    limit = st.limit[w]
    done = st.work[w]
    allowed = st.allowed[w]
    touched = st.touched[w]
    kappa = st.kappa[w]
    rest = rest_pressure[w]
    pressure = st.pressure[w] - rest
    volume = st.volume[w]
    error = st.error[w]
    slips = st.slips[w]
    give = st.give[w]
    increment = st.increment[w]
    loose = st.loose[w]
    own = vec6()
    for c in range(t, part.shape[1], wp.block_dim()):
        own += vec6(
            worth[0, c, w], part[0, c, w], worth[1, c, w], worth[3, c, w], part[1, c, w], worth[2, c, w]
        )
    total = sum_of_block(own)
    if t > 0:
        return
    rr = total[0]
    rz = total[1]
    load = total[2]
    fly = total[3]
    gz = total[4]
    gg = total[5]
    st.pressure_correction[w] = real(0.0)
    if not wp.isfinite(rr + rz):
        st.active[w] = 0
        st.failed[w] = 1
        return
    if touched == 0 and rr < real(BALANCED) * real(BALANCED) and loose == real(0.0):
        st.active[w] = 0
        st.error[w] = real(0.0)
        return
    # single precision leaves more residual than nothing, so a vibration without contact is measured by the
    # work of its inertia
    work = wp.abs(load) + wp.abs(fly) + real(1.0e-12)
    stiffer = real(1.0) + viscosity
    off = wp.abs(rz) + loose
    far = stiffer * stiffer * off  # stiffer rubber goes less far for the same force
    st.last_error[w] = error
    st.error[w] = wp.sqrt(far / work)
    enough = tolerance
    needs_wrench = has_liquid  # for the pressure
    if iterations == began:
        st.opened[w] = wp.sqrt(far / work)
    elif slips == LAGGED:  # friction's bounds are not known better
        enough = wp.max(tolerance, _LAGGED_TO * opened)
        needs_wrench = 0
    if far < real(0.25) * best:
        st.best[w] = far
        since = iterations
        st.since[w] = since
    # stiffer rubber's answer is less than the tangent's, at most by `stiffer`: a bound of the error
    settled = wp.where(viscosity == real(0.0) or increment > real(0.0), 1, 0)
    corrects = int(0)
    if needs_wrench == 1:
        pushes = stiffer * kappa * wp.abs(gz)
        allowed_off = _PRESSURE_TOLERANCE * wp.abs(pressure) + _PRESSURE_NOISE
        if pushes > allowed_off:
            if viscosity == real(0.0) and pushes <= _CORRECTED * allowed_off and give <= _STIFFER:
                corrects = 1
            else:
                settled = 0
    # what has not halved the error in so many iterations will hardly do so in the fewer left
    patience = wp.min(_PATIENCE, limit - iterations)
    # where the preconditioner is indefinite by rounding, a negative product is as far from balance
    if stiffer * off <= enough * enough * work and settled == 1:
        st.active[w] = 0
        if corrects == 1:
            st.pressure_correction[w] = gz / gg
            st.swell[w] = kappa * gz
            st.pressure[w] = pressure + rest - kappa * gz
            st.volume[w] = volume + gz
    elif iterations - since >= patience or (
        done >= allowed and not _finishes(wp.sqrt(far / work), error, enough, max_work - done)
    ):
        st.active[w] = 0
        st.failed[w] = 1
    else:
        st.iterations[w] = iterations + 1
        st.rz[w] = rz
        st.first[w] = rz
        any_active[0] = 1


@wp.kernel
def choose_viscosity(tolerance: real, st: Worlds):
    """Where Newton's method goes round in circles, as where friction turns or skin snaps off a small geom,
    the skin is viscous: an iteration is a time step of rubber whose viscosity makes it resist as if it were
    stiffer by that factor. It goes to where real skin comes to rest; near there the steps are good, and
    Newton's again, so that what is found is a balance without viscosity."""
    w = wp.tid()
    if st.active[w] == 0:
        return
    if st.iterations[w] - st.began[w] < _SLOW:
        return
    viscosity = st.viscosity[w]
    good = int(0)
    if st.alpha[w] == real(1.0) and st.tries[w] < _TRIES:
        if viscosity > real(0.0) or st.error[w] < st.last_error[w]:
            good = 1
    stale = st.iterations[w] - st.since[w]
    if good == 0 and viscosity == real(0.0) and st.error[w] < _NEAR and stale < _SLOW:
        return
    if good == 0:
        viscosity = _SLOWER * wp.max(viscosity, real(1.0))
    elif viscosity > _AT_ONCE and st.error[w] > tolerance:
        viscosity = viscosity / _QUICKER
    else:
        viscosity = real(0.0)
    set_viscosity(st, w, viscosity)
    if viscosity > _FIXED:
        st.active[w] = 0
        st.failed[w] = 1


@wp.kernel
def find_lost(st: Worlds, any_lost: wp.array(dtype=int)):
    """Worlds whose first try found no balance: the skin may have been left by what touched it. What pulls
    may hold it all the same, however far it is from there to rest."""
    w = wp.tid()
    st.moving[w] = 0
    if st.asked[w] == 0 or st.failed[w] == 0 or st.rests[w] > 0 or st.increment[w] > real(0.0):
        return
    if st.deep[w] == 0 and st.pulls[w] == 0:
        st.moving[w] = 1
        any_lost[0] = 1


@wp.kernel
def start_at_rest(max_work: int, st: Worlds):
    """Those that nothing touches at rest are all but in balance there: they try it next."""
    w = wp.tid()
    if st.moving[w] == 1:
        st.rests[w] = 1
        st.failed[w] = 0
        set_viscosity(st, w, real(0.0))
        begin_try(st, w, _SLOW, max_work)


@wp.kernel
def choose_length(part: wp.array3d(dtype=real), st: Worlds, any_active: wp.array(dtype=int)):
    """Looks for the length where the residual has (nearly) no component along the step, by regula falsi.

    Liquid is so stiff that the curvature of its volume along a step makes megapascals, and no step would be
    long. So the search takes the pressure that the linear solve leads to, which is Newton's method for skin
    and pressure together, and of what is off from there a share: as if the liquid were not much stiffer than
    the skin. What volume is wrong after a step, the next one corrects.

    part: force . direction after the step, and before it where this is the first try; gradient . direction.
    """
    w, t = wp.tid()
    if st.moving[w] == 0:
        return
    # as in `judge_balance`
    alpha = st.alpha[w]
    viscous_work = st.viscous_work[w]
    done = st.work[w]
    tries = st.tries[w]
    inverted = st.inverted[w]
    pulls = st.pulls[w]
    viscosity = st.viscosity[w]
    error = st.error[w]
    highest = st.high[w]
    total = totals_of(part, w, t)
    if t > 0:
        return
    now = total[0]
    slope = total[1]
    swell = total[2]
    st.work[w] = done + 1
    if tries == 0:
        bulk = real(0.0)  # the liquid's share of the slope
        if st.kappa[w] > real(0.0):
            change = st.foreseen[w] - st.before[w]
            bulk = change * change / st.kappa[w]
        st.stiff[w] = st.give[w]
        if not (bulk < real(0.99) * slope):  # without it there is no way down
            st.stiff[w] = real(1.0)
        slope -= (real(1.0) - st.stiff[w]) * bulk
    now += (real(1.0) - st.stiff[w]) * (st.foreseen[w] - st.pressure[w]) * swell
    now -= alpha * viscous_work
    if tries == 0:
        st.slope[w] = slope
        st.slope_low[w] = slope
        st.slope_high[w] = slope
    else:
        slope = st.slope[w]
    valid = int(0)
    if wp.isfinite(now) and inverted % 2 == 0:  # from inside out most laws find their way
        valid = 1
    if viscosity > real(0.0) or error < _NEAR:
        pulls = 0
    has_high = int(0)
    if highest >= real(0.0):
        has_high = 1
    enough = int(0)
    if valid == 1 and now >= real(-0.5) * slope:
        if pulls == 1:
            if now <= real(0.2) * slope:
                enough = 1
        elif has_high == 0 or now <= real(0.5) * slope:
            enough = 1
    st.tries[w] = tries + 1
    if enough == 1 or tries + 1 == _TRIES:
        st.moving[w] = 0
        st.borne[w] = st.borne[w] + wp.min(alpha, real(1.0)) * (st.foreseen[w] - st.borne[w])
        return
    st.inverted[w] = 0
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
    if pulls == 1 and st.high[w] < real(0.0):
        # a pull that falls as the gap opens is in no tangent: it is solved again
        further = wp.clamp(slope / wp.max(slope - now, slope / real(4.0)), real(1.25), real(4.0))
        st.alpha[w] = alpha * further
        st.longer[w] = st.alpha[w] - alpha
        any_active[0] = 1
        return
    low = st.low[w]
    high = st.high[w]
    guess = real(0.5) * (low + high)
    if st.slope_high[w] > real(-1.0e299):
        guess = low + (high - low) * st.slope_low[w] / (st.slope_low[w] - st.slope_high[w])
    margin = real(0.05) * (high - low)
    st.alpha[w] = wp.clamp(guess, low + margin, high - margin)
    st.longer[w] = st.alpha[w] - alpha
    any_active[0] = 1


@wp.kernel
def end_worlds(st: Worlds):
    w = wp.tid()
    # as in `judge_balance`
    wanted = st.wanted[w]
    reason = st.reason[w]
    nonconverged = st.nonconverged[w]
    failed = st.failed[w]
    pressure = st.pressure[w]
    st.active[w] = 0
    if wanted == 0:
        return
    if reason != CONVERGED:
        st.nonconverged[w] = nonconverged + 1
    # of a liquid that keeps its volume, what volume is off makes pressure once, not again in every step in
    # which nothing moves
    still = int(0)
    if st.iterations[w] == 0 and st.repeat[w] == real(0.0) and st.guessed[w] == 0:
        still = st.holds[w]
    st.guessed[w] = 0
    if failed == 0 and still == 0:
        st.last_pressure[w] = pressure


@wp.kernel
def all_on(flag: wp.array(dtype=int)):
    flag[wp.tid()] = 1
