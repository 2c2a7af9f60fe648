"""Convergence test of Newton's method in each world, by a block of threads that sum over nodes, and
artificial viscosity."""

import warp as wp

from ...kernels import kernel_module
from ..block import block_sum
from ..contact.touch import LAGGED
from ..types import real, vec6
from .line_search import MAX_TRIES
from .worlds import NEGLIGIBLE_RESIDUAL, VISCOUS_AFTER, Worlds, set_viscosity

kernel_module(__name__)

_PRESSURE_TOLERANCE = wp.constant(wp.float64(0.01))
_PRESSURE_NOISE = wp.constant(wp.float64(1.0))  # [Pa] a thirtieth of the sensor's resolution
# a pressure error of up to this many tolerances is corrected without an iteration, if `compliance_ratio` is
# at most the second number
_CORRECTED, _STIFF_LIQUID = (wp.constant(wp.float64(x)) for x in (4.0, 0.1))
_LAGGED_TOLERANCE = wp.constant(wp.float64(0.05))  # of the error at which a round of lagged friction starts
_PATIENCE = wp.constant(40)  # iterations in which the error must halve
# error below which a bad iteration may be rounding: no viscosity starts
_SMALL_ERROR = wp.constant(wp.float64(0.01))
# the viscosity is divided by the first after a good full step, and multiplied by the second after a bad one
_DECREASE, _INCREASE = (wp.constant(wp.float64(x)) for x in (3.0, 4.0))
# a lower viscosity is set to zero; a higher one makes the skin stiffer than contact, and the try fails
_LEAST_VISCOSITY, _MOST_VISCOSITY = (wp.constant(wp.float64(x)) for x in (0.01, 1e5))


@wp.func
def _finishes(error: real, last: real, tolerance: real, left: int):
    """Whether a try converges within the work `left` if its error keeps falling at the rate of the last
    iteration. A full Newton step costs a work of two."""
    return error < last and wp.log(tolerance / error) * real(2.0) > real(left) * wp.log(error / last)


@wp.kernel
def check_convergence(
    # In:
    tolerance: real,
    passing: real,
    max_work: int,
    has_liquid: int,
    rest_pressure: wp.array(dtype=real),
    partial: wp.array3d(dtype=real),
    norms: wp.array3d(dtype=real),
    st: Worlds,
    # Out:
    any_active: wp.array(dtype=int),
):
    """Convergence test of each active world: in the energy norm, and of the pressure above rest, which the
    sensor reads. partial: residual . z and gradient . z; norms: see `nodes.residuals`.

    A world converges with the pressure that z predicts, which balances the forces better, also where this
    alone is above its tolerance, by at most a factor of `_CORRECTED`. In a stiff liquid the nodes move by
    picometres for it, see `nodes.correct_pressure`.

    passing: tolerance of load increments within the path."""
    w, t = wp.tid()
    if st.active[w] == 0:
        if t == 0:
            st.pressure_correction[w] = real(0.0)
            st.improved[w] = 0
        return
    # read before the sums, so that both take place at the same time: a read after a write waits for it
    viscosity = st.viscosity[w]
    best = st.best_square[w]
    iterations = st.iterations[w]
    start_iterations = st.start_iterations[w]
    start_error = st.start_error[w]
    since = st.since[w]
    limit = st.iteration_limit[w]
    done = st.work[w]
    allowed = st.work_limit[w]
    touched = st.touched[w]
    kappa = st.kappa[w]
    rest = rest_pressure[w]
    pressure = st.pressure[w] - rest
    volume = st.volume[w]
    error = st.error[w]
    friction_mode = st.friction_mode[w]
    compliance_ratio = st.compliance_ratio[w]
    increment = st.increment[w]
    body_residual = st.body_residual[w]
    own = vec6()
    for c in range(t, partial.shape[1], wp.block_dim()):
        own += vec6(
            norms[0, c, w], partial[0, c, w], norms[1, c, w], norms[3, c, w], partial[1, c, w], norms[2, c, w]
        )
    total = block_sum(own)
    if t > 0:
        return
    rr = total[0]
    rz = total[1]
    load = total[2]
    fly = total[3]
    gz = total[4]
    gg = total[5]
    st.pressure_correction[w] = real(0.0)
    st.improved[w] = 0
    if not wp.isfinite(rr + rz):
        st.active[w] = 0
        st.failed[w] = 1
        return
    free = touched == 0 and body_residual == real(0.0)
    if free and rr < real(NEGLIGIBLE_RESIDUAL) * real(NEGLIGIBLE_RESIDUAL):
        st.active[w] = 0
        st.error[w] = real(0.0)
        return
    # in single precision the residual of a vibration without contact is not zero: the work of inertia is its
    # scale
    work = wp.abs(load) + wp.abs(fly) + real(1.0e-12)
    stiffer = real(1.0) + viscosity
    off = wp.abs(rz) + body_residual
    far = stiffer * stiffer * off  # stiffer rubber moves less by the same force
    st.last_error[w] = error
    st.error[w] = wp.sqrt(far / work)
    enough = tolerance
    if st.trial_factor[w] < real(1.0):
        enough = passing
    elif st.error[w] < st.least_error[w] and st.inverted[w] < 2 and iterations > start_iterations:
        st.least_error[w] = st.error[w]
        st.improved[w] = 1
    needs_pressure = has_liquid
    if iterations == start_iterations:
        st.start_error[w] = wp.sqrt(far / work)
    elif friction_mode == LAGGED:  # the friction bounds are not known more accurately
        enough = wp.max(enough, _LAGGED_TOLERANCE * wp.min(start_error, real(1.0)))
        needs_pressure = 0
    if far < real(0.25) * best:
        st.best_square[w] = far
        since = iterations
        st.since[w] = since
    # viscous rubber moves less than the tangent says, at most by the factor `stiffer`: this bounds the error
    settled = wp.where(viscosity == real(0.0) or increment > real(0.0), 1, 0)
    corrects = int(0)
    if needs_pressure == 1:
        stiff = compliance_ratio <= _STIFF_LIQUID
        pushes = stiffer * kappa * wp.abs(gz)
        allowed_off = _PRESSURE_TOLERANCE * wp.abs(pressure) + _PRESSURE_NOISE
        off_by = wp.where(pushes > allowed_off, 1, 0)
        if viscosity == real(0.0) and pushes <= _CORRECTED * allowed_off and stiff:
            corrects = wp.where(
                iterations > start_iterations, 1, off_by
            )  # where nothing moves, nothing changes
        elif off_by == 1:
            settled = 0
    # an error that did not halve in more iterations than are left will not do so in these
    patience = wp.min(_PATIENCE, limit - iterations)
    # rz may be negative where rounding makes the preconditioner indefinite: its size is the error
    if stiffer * off <= enough * enough * work and settled == 1:
        st.active[w] = 0
        if corrects == 1:
            st.pressure_correction[w] = gz / gg
            st.pressure_response[w] = kappa * gz
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
        st.start_rz[w] = rz
        any_active[0] = 1


@wp.kernel
def choose_viscosity(tolerance: real, st: Worlds):
    """Adds artificial viscosity where Newton's method cycles, as when friction reverses or skin snaps off a
    small geom. An iteration is then an implicit time step of rubber whose viscosity is proportional to its
    elasticity. Near equilibrium the viscosity falls to zero, so that results contain none."""
    w = wp.tid()
    if st.active[w] == 0:
        return
    if st.iterations[w] - st.start_iterations[w] < VISCOUS_AFTER:
        return
    viscosity = st.viscosity[w]
    good = int(0)
    if st.alpha[w] == real(1.0) and st.tries[w] < MAX_TRIES:
        if viscosity > real(0.0) or st.error[w] < st.last_error[w]:
            good = 1
    stale = st.iterations[w] - st.since[w]
    if good == 0 and viscosity == real(0.0) and st.error[w] < _SMALL_ERROR and stale < VISCOUS_AFTER:
        return
    if good == 0:
        viscosity = _INCREASE * wp.max(viscosity, real(1.0))
    elif viscosity > _LEAST_VISCOSITY and st.error[w] > tolerance:
        viscosity = viscosity / _DECREASE
    else:
        viscosity = real(0.0)
    set_viscosity(st, w, viscosity)
    if viscosity > _MOST_VISCOSITY:
        st.active[w] = 0
        st.failed[w] = 1
