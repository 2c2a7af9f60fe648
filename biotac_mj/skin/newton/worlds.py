"""The numbers of each world in a step: start of a step and of its tries, end of a step. Kernels run one
thread per world. `convergence` and `line_search` decide about iterations."""

import warp as wp

from ...kernels import kernel_module
from ..block import block_sum
from ..contact.posed import Geoms, LoadPath
from ..contact.touch import CURRENT
from ..rubber.law import Law
from ..types import real, vec3

kernel_module(__name__)

# reason of a world's last step
CONVERGED, NOT_FINITE, INSIDE_CORE, NOT_CONVERGED = (wp.constant(i) for i in range(4))

NEGLIGIBLE_RESIDUAL = 1e-9  # [N] norm of the residual that is rounding, where nothing touches
_LEAST_REFERENCE = wp.constant(wp.float64(1e3))  # [Pa] lower limit of `reference`
VISCOUS_AFTER = wp.constant(8)  # iterations of a try before artificial viscosity may start
_LIQUID_STIFFNESS = wp.constant(wp.float64(40.0))  # bulk modulus of the liquid in a line search, over E

# values of `Worlds.cut_back`: no increment was cut back; the last one was; an earlier one was
NO_CUTBACK, LAST_CUT_BACK, CUT_BACK_BEFORE = (wp.constant(i) for i in range(3))


@wp.struct
class Worlds:
    """Scalars of every world (nworld,). Flags are 0 or 1."""

    mu: wp.array(dtype=real)
    lam: wp.array(dtype=real)
    contact_stiffness: wp.array(dtype=real)  # pressure per overclosure [Pa/m]
    density: wp.array(dtype=real)  # [kg/m^3], of implicit dynamics
    softness: wp.array(dtype=real)  # E of the model over E of the world, reduced by the viscosity
    elastic_softness: wp.array(dtype=real)  # the same without viscosity
    viscosity: wp.array(dtype=real)  # artificial, over the elastic stiffness of an iteration
    viscous_work: wp.array(dtype=real)  # of the artificial viscosity along a direction [J]
    # liquid
    kappa: wp.array(dtype=real)  # K / natural volume [Pa/m^3]
    natural: wp.array(dtype=real)  # volume of the liquid without pressure [m^3]
    keeps_volume: wp.array(dtype=int)  # the liquid is incompressible, or its pressure is prescribed
    offset: wp.array(dtype=real)  # pressure at the natural volume [Pa]
    reference: wp.array(dtype=real)  # p_ref of `wet_faces` [Pa]
    last_pressure: wp.array(dtype=real)  # at the end of the last step, above the surroundings [Pa]
    pressure: wp.array(dtype=real)  # at the last evaluation [Pa]
    volume: wp.array(dtype=real)  # at the last evaluation [m^3]
    start_pressure: wp.array(dtype=real)  # at the start of the linear solve [Pa]
    predicted_pressure: wp.array(dtype=real)  # by the linear solve, see `choose_length` [Pa]
    tangent_pressure: wp.array(dtype=real)  # in the tangent: moves to the predicted one by `alpha` [Pa]
    compliance_ratio: wp.array(dtype=real)  # 40 E / K, at most 1
    bulk_fraction: wp.array(dtype=real)  # fraction of the liquid's stiffness in the line search
    # phase of the solve
    wanted: wp.array(dtype=int)  # takes part in this step; other worlds keep the state of their last step
    unfinished: wp.array(dtype=int)  # its input can be solved, and its load path has not ended
    active: wp.array(dtype=int)  # has not converged
    running: wp.array(dtype=int)  # its linear solve continues
    moving: wp.array(dtype=int)  # its line search continues
    failed: wp.array(dtype=int)
    deep: wp.array(dtype=int)  # a geom is inside the core
    touched: wp.array(dtype=int)  # a geom or the core touches
    friction_mode: wp.array(dtype=int)  # CURRENT, CONSISTENT, RECORDED or LAGGED, see `contact.touch`
    load_dependent: wp.array(dtype=int)  # its friction coefficient depends on pressure
    inverted: wp.array(dtype=int)  # by an element, at the last evaluation: `ElementForces.evaluate_corners`
    reason: wp.array(dtype=int)  # CONVERGED, NOT_FINITE, INSIDE_CORE or NOT_CONVERGED
    squeezed: wp.array(dtype=real)  # fraction by which the step has squeezed the wall
    tier: wp.array(dtype=int)  # 0; -1: the step squeezed the skin more than its error was measured for
    nonconverged: wp.array(dtype=int)  # steps that did not converge since the reset
    iterations: wp.array(dtype=int)  # of Newton's method in this step
    start_iterations: wp.array(dtype=int)  # `iterations` at the start of the try
    iteration_limit: wp.array(dtype=int)  # of `iterations` in the try
    work_limit: wp.array(dtype=int)  # of `work` in the try
    error: wp.array(dtype=real)  # estimated, relative, in the energy norm
    last_error: wp.array(dtype=real)  # of the previous iteration
    best_square: wp.array(dtype=real)  # square of the last error that halved the one before it
    since: wp.array(dtype=int)  # iteration in which that was reached
    # load path
    load_factor: wp.array(dtype=real)  # fraction of the load path at which the skin is in equilibrium
    trial_factor: wp.array(dtype=real)  # load factor of the try
    increment: wp.array(dtype=real)  # trial_factor - load_factor; 0: the first try
    cut_back: wp.array(dtype=int)  # NO_CUTBACK, LAST_CUT_BACK or CUT_BACK_BEFORE
    lagged: wp.array(dtype=int)  # the friction bound is to be that of the last equilibrium
    accepted: wp.array(dtype=int)  # the last increment converged, and the next one starts from it
    restores: wp.array(dtype=int)  # the next try starts from the last increment's equilibrium
    rounds: wp.array(dtype=int)  # equilibria with lagged friction bounds in this increment
    start_error: wp.array(dtype=real)  # `error` at the start of the try
    least_error: wp.array(dtype=real)  # of an iterate at the end of the path; bodies give way
    improved: wp.array(dtype=int)  # `least_error` is that of the present iterate
    cut_off: wp.array(dtype=int)  # the step ends with the iterate of the least error
    guessed: wp.array(dtype=int)  # the step repeats the last increment, and is not cut back
    repeat: wp.array(dtype=real)  # factor on the last increment in the initial guess
    # linear solve and line search
    alpha: wp.array(dtype=real)  # step length
    alpha_change: wp.array(dtype=real)  # step length minus the one before it in this search
    beta: wp.array(dtype=real)  # of conjugate gradients
    pressure_response: wp.array(dtype=real)  # kappa times the change of volume along a direction [Pa]
    pressure_correction: wp.array(dtype=real)  # factor on the volume's gradient that corrects the pressure
    start_rz: wp.array(dtype=real)  # `rz` at the start of the linear solve
    rz: wp.array(dtype=real)  # residual . preconditioned residual [J]
    body_residual: wp.array(dtype=real)  # twice the energy of the bodies' error of position [J]
    slope: wp.array(dtype=real)  # residual . direction at length 0 [J]
    low: wp.array(dtype=real)  # bracket of the step length
    high: wp.array(dtype=real)
    slope_low: wp.array(dtype=real)
    slope_high: wp.array(dtype=real)
    side: wp.array(dtype=int)  # end of the bracket that was replaced last: 1 high, -1 low
    tries: wp.array(dtype=int)  # evaluations of the line search
    iterations_cg: wp.array(dtype=int)
    work: wp.array(dtype=int)  # evaluations and products of this step, and equivalents of them
    spent: wp.array(dtype=int)  # work that the caller has done before, in the same step of its own


BLOCK = 128  # threads that sum over the chunks of one world


@wp.func
def total_of(partial: wp.array3d(dtype=real), k: int, w: int, t: int):
    """Sum of partial[k, :, w] by the threads t of a block, in a fixed order; all threads get it."""
    s = real(0.0)
    for c in range(t, partial.shape[1], wp.block_dim()):
        s += partial[k, c, w]
    return block_sum(s)


@wp.func
def totals_of(partial: wp.array3d(dtype=real), w: int, t: int):
    """Sums of partial[0:3, :, w], see `total_of`."""
    own = vec3()
    for c in range(t, partial.shape[1], wp.block_dim()):
        own += vec3(partial[0, c, w], partial[1, c, w], partial[2, c, w])
    return block_sum(own)


@wp.func
def set_viscosity(st: Worlds, w: int, viscosity: real):
    if st.viscosity[w] == real(0.0):
        st.elastic_softness[w] = st.softness[w]
    st.softness[w] = st.elastic_softness[w] / (real(1.0) + viscosity)
    st.viscosity[w] = viscosity


@wp.func
def begin_try(st: Worlds, w: int, limit: int, max_work: int):
    """Sets the limits of a try. It may use half of the remaining work, so that a shorter increment can
    follow."""
    st.tangent_pressure[w] = st.last_pressure[w]
    st.start_iterations[w] = st.iterations[w]
    st.inverted[w] = 0
    st.iteration_limit[w] = st.iterations[w] + limit
    st.work_limit[w] = st.work[w] + (max_work - st.work[w]) / 2
    st.since[w] = st.iterations[w]
    st.best_square[w] = real(1.0e300)


@wp.func
def modulus_of(law: int, m: real, l: real):
    """Young's modulus [Pa] from the two constants of a law."""
    E = m * (real(3.0) * l + real(2.0) * m) / (l + m)
    if law == Law.NEO_HOOKEAN:
        E = real(9.0) * l * m / (real(3.0) * l + m)
    return E


@wp.kernel
def begin_worlds(
    # In:
    law: int,
    youngs_modulus: real,
    limit: int,
    max_work: int,
    keeps_iterate: int,
    geoms: Geoms,
    motion: wp.array2d(dtype=vec3),
    st: Worlds,
    # In and out:
    touched_by: wp.array2d(dtype=int),
    # Out:
    path: LoadPath,
    flags: wp.array(dtype=int),
):
    """Starts the step of world w: checks its input, sets the load path, and finds the factor on the last
    increment for the initial guess from how closely the touching geoms repeat their last motion.

    keeps_iterate: see `load_path.end_path`: what the first try comes to is not lost, so that it may take all
    work but what increments need at least."""
    w = wp.tid()
    if w == 0:
        for k in range(flags.shape[0]):
            flags[k] = 0
    m = st.mu[w]
    l = st.lam[w]
    E = modulus_of(law, m, l)
    st.softness[w] = youngs_modulus / E
    st.compliance_ratio[w] = wp.min(_LIQUID_STIFFNESS * E / wp.max(st.kappa[w] * st.natural[w], E), real(1.0))
    st.viscosity[w] = real(0.0)
    if st.wanted[w] == 0:
        st.unfinished[w] = 0
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
    st.unfinished[w] = finite
    st.active[w] = finite
    st.failed[w] = 0
    st.deep[w] = 0
    st.least_error[w] = real(1.0e300)
    st.iterations[w] = 0
    st.work[w] = st.spent[w]
    st.friction_mode[w] = CURRENT
    begin_try(st, w, limit, max_work)
    if keeps_iterate == 1:
        st.work_limit[w] = st.work[w] + 9 * (max_work - st.work[w]) / 10
    if st.guessed[w] == 1:  # no increment follows
        st.work_limit[w] = max_work
    st.load_factor[w] = real(0.0)
    st.trial_factor[w] = real(1.0)
    st.increment[w] = real(0.0)
    st.cut_back[w] = NO_CUTBACK
    st.rounds[w] = 0
    st.offset[w] = real(0.0)
    if st.keeps_volume[w] == 1:
        st.offset[w] = st.last_pressure[w]
    st.reference[w] = wp.max(wp.abs(st.last_pressure[w]), _LEAST_REFERENCE)


@wp.kernel
def end_worlds(st: Worlds):
    """Ends the step of world w: counts it if it did not converge, and stores its pressure."""
    w = wp.tid()
    # all reads before the writes, as in `check_convergence`
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
    # an incompressible liquid turns the error of its volume into pressure once, and not again in each step
    # without motion
    still = int(0)
    if st.iterations[w] == 0 and st.repeat[w] == real(0.0) and st.guessed[w] == 0:
        still = st.keeps_volume[w]
    st.guessed[w] = 0
    if failed == 0 and still == 0:
        st.last_pressure[w] = pressure


@wp.kernel
def all_on(flag: wp.array(dtype=int)):
    flag[wp.tid()] = 1
