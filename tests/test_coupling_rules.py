"""The rules by which rounds of a coupled step go on (`coupling/implicit/rules.py`), each by itself: steps in
which a skin has too little energy for its push are rare."""

import numpy as np
import pytest
import warp as wp

from biotac_mj.coupling.implicit.rows import keep_held
from biotac_mj.coupling.implicit.rules import (
    beta_of,
    fraction_within,
    gamma_of,
    in_store,
    lacking,
    poorly_corrected,
    spared,
)
from biotac_mj.skin.types import mat66


def test_what_bodies_did_is_put_into_the_store():
    assert in_store(1.0, -0.3, -0.2, 10.0) == pytest.approx(1.3)  # pushed in, by the larger of both
    assert in_store(1.0, 0.4, 0.6, 10.0) == pytest.approx(0.6)  # given back, by the smaller
    assert in_store(1.0, -5.0, -5.0, 2.0) == 2.0  # at most what it holds


def test_only_corrections_beyond_both_bounds_are_poor():
    assert poorly_corrected(0.02, 1.0, 0.5, 0.01) and not poorly_corrected(0.005, 1.0, 0.5, 0.01)
    assert not poorly_corrected(0.02, 1.0, 3.0, 0.01)
    assert not poorly_corrected(np.nan, 1.0, 1.0, 0.01)


@pytest.mark.parametrize("delay", [0.0, 0.3, 3.0])
def test_newmarks_steps_are_stable(delay):
    """One body on a spring and a damper that the integrator treats implicitly: no mode grows, whatever they
    are; and what a step does not resolve dies out."""
    for pace in np.logspace(-2, 3, 61):
        gamma = gamma_of(float(pace), delay)
        ahead, beta = gamma - 0.5, beta_of(gamma)
        for damping in (0.0, *np.logspace(-3, 3, 13)):  # h c / m
            s = pace * pace
            after = np.array([-s, 1 + s * (beta - ahead)]) / (1 + damping + s * beta)  # h v', by x and h v
            growth = abs(np.linalg.eigvals([[1 + after[0], after[1]], after])).max()
            assert growth < 1 + 1e-9
            assert pace < 20 or damping or growth < 0.7
    assert beta_of(1.5) == 1.0
    assert gamma_of(0.1, 0.0) == 0.5 and beta_of(0.5) == pytest.approx(1 / 12)


def test_a_fraction_of_a_push_gives_a_body_what_it_put_in():
    """Nearly; one that something presses in against an empty account gets what stops it."""
    rng = np.random.default_rng(0)
    for without, own, part in zip(rng.normal(size=200), rng.exponential(size=200), rng.uniform(size=200)):
        store = part * (without + own)
        fraction = fraction_within(store, without, own)
        if store > 0.0:
            most = fraction / 0.99
            assert 0.0 < most < 1.0 and most * without + most**2 * own == pytest.approx(store)
            assert fraction * without + fraction**2 * own < store
    assert fraction_within(-1.0, -1.0, 4.0) == pytest.approx(0.2475) and fraction_within(0.0, 1.0, 4.0) == 0.0
    assert fraction_within(0.5, 1.0, 0.0) == pytest.approx(0.495)  # nothing moves it


def test_a_body_gets_what_it_put_in_and_what_others_do_now():
    """Of 3 J that a press left nothing, of what it puts in now as much as there is."""
    assert lacking(store=0.0, given=0.5) == 0.5 and spared(left=3.0, store=3.0, given=0.0) == 0.0
    assert spared(left=3.0, store=3.4, given=-0.1) == pytest.approx(0.5)
    assert lacking(store=-1.0, given=-0.5) == 0.0  # owes, and gives
    assert spared(left=np.inf, store=np.inf, given=-0.1) == 0.0  # not known


def test_rounding_is_no_stiffness_of_rows():
    """Of a flat side without friction, with a tangent in single precision: 4e11 N/m were held for 1e3."""
    normal = np.array([4e-11, 1.0, 0.0, -1e-4, 0.0, -6e-3])
    S = 1.1e3 * np.outer(normal, normal) + np.diag([0.0, 0.0, 0.0, 4e-3, 0.0, 0.04])
    noise = np.array([0.0, 8e-4, 0.0, 1e-6, 0.0, 1e-6])
    S[0] += noise
    S[:, 0] += noise
    tangent = wp.array(S[None, None], dtype=mat66, device="cpu")
    wp.launch(keep_held, dim=tangent.shape, outputs=[tangent], device="cpu")
    np.testing.assert_allclose(tangent.numpy()[0, 0], S, rtol=1e-9, atol=1e-3)
