"""Why the coupling is what it is: ways to tie two free masses by a stiff spring, by the eigenvalues of one
step.

Run as a script for the table of docs/lab/coupling.md.
"""

import numpy as np
import pytest


def _accelerations(scheme, m1, m2, k, h, x, v1, v2, last):
    """Accelerations of object and finger; last is the force that the object felt in the step before."""
    y = x + h * (v1 - v2)
    stiff = h * h * k
    if scheme == "explicit":
        return -k * x / m1, k * x / m2
    if scheme == "own inertia":  # h^2 k added to each block of the mass matrix
        return -k * y / (m1 + stiff), k * y / (m2 + stiff)
    if scheme == "own inertia, twice":
        return -k * y / (m1 + 2 * stiff), k * y / (m2 + 2 * stiff)
    if (
        scheme == "reaction one step late"
    ):  # h^2 k added to the object's block; the finger gets what the object felt
        return -k * y / (m1 + stiff), -last / m2
    if scheme == "rows":  # h^2 k added across both trees
        return np.linalg.solve([[m1 + stiff, -stiff], [-stiff, m2 + stiff]], [-k * y, k * y])
    raise ValueError(scheme)


SCHEMES = ("explicit", "own inertia", "own inertia, twice", "reaction one step late", "rows")


def _step(scheme, m1, m2, k, h, state):
    x, v1, v2, last = state
    a1, a2 = _accelerations(scheme, m1, m2, k, h, x, v1, v2, last)
    v1, v2 = v1 + h * a1, v2 + h * a2
    return np.array([x + h * (v1 - v2), v1, v2, m1 * a1])


def growth(scheme, m1, m2, k, h):
    """Largest modulus of an eigenvalue of one step: 1 (free motion of the pair) or less is stable."""
    matrix = np.stack([_step(scheme, m1, m2, k, h, e) for e in np.eye(4)], axis=1)
    return abs(np.linalg.eigvals(matrix)).max()


def momentum_error(scheme, m1, m2, k, h):
    """Largest change of momentum in an impact at 0.3 m/s, relative to the object's momentum."""
    state = np.array([0.0, -0.3, 0.0, 0.0])
    start, worst = -0.3 * m1, 0.0
    for _ in range(50):
        state = _step(scheme, m1, m2, k, h, state)
        worst = max(worst, abs(m1 * state[1] + m2 * state[2] - start))
    return worst / abs(start)


CASES = [
    (m1, m2, k, h)
    for m1 in (1e-3, 0.03, 1.0)
    for m2 in (0.02, 0.05)
    for k in (1e3, 2e4)
    for h in (5e-4, 1e-3, 2e-3, 4e-3)
]


@pytest.mark.parametrize("case", CASES)
def test_rows_are_stable_and_conserve_momentum(case):
    assert growth("rows", *case) <= 1 + 1e-7
    assert momentum_error("rows", *case) < 1e-10


@pytest.mark.parametrize("scheme", ["explicit", "own inertia", "reaction one step late"])
def test_the_simpler_ways_fail_somewhere(scheme):
    assert any(growth(scheme, *case) > 1.01 for case in CASES)


def test_inflated_inertia_is_stable_but_loses_momentum():
    assert all(growth("own inertia, twice", *case) <= 1 + 1e-7 for case in CASES)
    assert max(momentum_error("own inertia, twice", *case) for case in CASES) > 0.3


if __name__ == "__main__":
    for scheme in SCHEMES:
        unstable = sum(growth(scheme, *case) > 1 + 1e-7 for case in CASES)
        errors = [momentum_error(scheme, *case) for case in CASES if growth(scheme, *case) <= 1 + 1e-7]
        steps = [
            max(
                (h for h in np.geomspace(1e-5, 8e-3, 300) if growth(scheme, m1, 0.02, 1e4, h) <= 1 + 1e-7),
                default=0,
            )
            for m1 in (1e-3, 0.03, 1.0)
        ]
        print(
            f"{scheme:24s} unstable in {unstable:2d} of {len(CASES)}; largest stable step "
            f"{['%.2f' % (1e3 * s) for s in steps]} ms; "
            f"momentum error where stable {max(errors, default=np.nan):.1e}"
        )
