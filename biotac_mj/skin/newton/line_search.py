"""Line search of Newton's method in each world, by a block of threads that sum over nodes."""

import warp as wp

from ...kernels import kernel_module
from ..types import real
from .worlds import Worlds, totals_of

kernel_module(__name__)

MAX_TRIES = wp.constant(12)  # evaluations of a line search


@wp.func
def begin_line_search(st: Worlds, w: int):
    st.low[w] = real(0.0)
    st.high[w] = real(-1.0)  # no upper end yet
    st.side[w] = 0
    st.tries[w] = 0
    st.alpha[w] = real(1.0)
    st.inverted[w] = 0


@wp.kernel
def choose_length(partial: wp.array3d(dtype=real), st: Worlds, any_active: wp.array(dtype=int)):
    """Line search: finds the length at which the residual has almost no component along the direction, by
    regula falsi.

    The curvature of the liquid's volume along a step causes megapascals, so that steps with the true pressure
    would be short. The search uses the pressure that the linear solve predicts, as in Newton's method for
    nodes and pressure, plus `bulk_fraction` of the deviation from it. The next step corrects the volume.

    partial: force . direction after the step; before the step, in the first try; gradient . direction.
    """
    w, t = wp.tid()
    if st.moving[w] == 0:
        return
    # read before the sums, as in `check_convergence`
    alpha = st.alpha[w]
    viscous_work = st.viscous_work[w]
    done = st.work[w]
    tries = st.tries[w]
    inverted = st.inverted[w]
    highest = st.high[w]
    total = totals_of(partial, w, t)
    if t > 0:
        return
    now = total[0]
    slope = total[1]
    pressure_response = total[2]
    st.work[w] = done + 1
    if tries == 0:
        bulk = real(0.0)  # the liquid's part of the slope
        if st.kappa[w] > real(0.0):
            change = st.predicted_pressure[w] - st.start_pressure[w]
            bulk = change * change / st.kappa[w]
        st.bulk_fraction[w] = st.compliance_ratio[w]
        if not (bulk < real(0.99) * slope):  # without the liquid the direction would not descend
            st.bulk_fraction[w] = real(1.0)
        slope -= (real(1.0) - st.bulk_fraction[w]) * bulk
    now += (real(1.0) - st.bulk_fraction[w]) * (st.predicted_pressure[w] - st.pressure[w]) * pressure_response
    now -= alpha * viscous_work
    if tries == 0:
        st.slope[w] = slope
        st.slope_low[w] = slope
        st.slope_high[w] = slope
    else:
        slope = st.slope[w]
    valid = int(0)
    if wp.isfinite(now) and inverted % 2 == 0:  # most laws recover from an inverted element
        valid = 1
    has_high = int(0)
    if highest >= real(0.0):
        has_high = 1
    enough = int(0)
    if valid == 1 and now >= real(-0.5) * slope:
        if has_high == 0 or now <= real(0.5) * slope:
            enough = 1
    st.tries[w] = tries + 1
    if enough == 1 or tries + 1 == MAX_TRIES:
        st.moving[w] = 0
        change = st.predicted_pressure[w] - st.tangent_pressure[w]
        st.tangent_pressure[w] = st.tangent_pressure[w] + wp.min(alpha, real(1.0)) * change
        return
    st.inverted[w] = 0
    if valid == 0 or now < real(0.0):
        if st.side[w] == 1:  # Illinois method: halve the slope of an end that stays twice
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
    low = st.low[w]
    high = st.high[w]
    guess = real(0.5) * (low + high)
    if st.slope_high[w] > real(-1.0e299):
        guess = low + (high - low) * st.slope_low[w] / (st.slope_low[w] - st.slope_high[w])
    margin = real(0.05) * (high - low)
    st.alpha[w] = wp.clamp(guess, low + margin, high - margin)
    st.alpha_change[w] = st.alpha[w] - alpha
    any_active[0] = 1
