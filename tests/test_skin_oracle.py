"""The skin's answers against those that were frozen once: see `skin_oracle` for the cases.

A Young's modulus that is off by a hundred-thousandth fails every case.
"""

import functools

import numpy as np
import pytest
import warp as wp
from skin_oracle import CASES, FILE, solve

WAYS = [("cpu", "sparse"), ("cpu", "dense"), *([("cuda:0", "dense")] if wp.is_cuda_available() else [])]
# of the dense preconditioner on the CPU, which is there for tests, some are enough to be quick
QUICK = {"water", "worlds", "corotational_slide", "adhesion", "core_in_liquid", "svk_bar"}
RUNS = [
    pytest.param(
        name,
        *way,
        marks=[pytest.mark.slow] if name == "everything" or (way == WAYS[1] and name not in QUICK) else [],
    )
    for name in CASES
    for way in WAYS
]
CLOSE = {"sparse": 1e-6, "dense": 1e-4}  # of the peak; the dense preconditioner is of mixed precision
# tangents come from the preconditioner: rows of single precision, or of half
TANGENTS, CLOSE_TANGENT = ("translation", "rotation", "coupling"), {"sparse": 1e-6, "dense": 3e-3}
OPTIONS = {"sparse": {}, "dense": dict(tolerance=1e-6)}
# what counts as no answer at all: lengths, forces, torques ... of a press are a thousand times that, or zero
LEAST = dict(displacement=1e-7, force=1e-4, torque=1e-7, contact_force=1e-4, core_force=1e-4, pressure=1.0,
             volume=1e-9, translation=1.0, rotation=1e-5, coupling=1e-3)  # fmt: skip


@functools.cache
def frozen():
    with np.load(FILE) as file:
        return {name: file[name] for name in file.files}


def far(name, answers, kind):
    """Quantities that are not close to the frozen ones, with their distances in shares of the peak."""
    stored, out = frozen(), {}
    for quantity, value in answers.items():
        if quantity == "converged":
            continue
        expected = stored[f"{name}.{quantity}"]
        assert value.shape == expected.shape
        of = quantity.removeprefix("mean_")
        peak = max(abs(stored[f"{name}.{of}"]).max(initial=0), LEAST[of])
        distance = abs(value - expected).max(initial=0) / peak
        if not distance <= (CLOSE_TANGENT if quantity in TANGENTS else CLOSE)[kind]:
            out[quantity] = distance
    return out


@pytest.mark.law
@pytest.mark.parametrize("name, device, kind", RUNS)
def test_answers_are_the_frozen_ones(name, device, kind):
    answers = solve(CASES[name], device, preconditioner=kind, **OPTIONS[kind])
    assert answers["converged"].all() and answers["converged"].shape == frozen()[f"{name}.converged"].shape
    assert not far(name, answers, kind)


@pytest.mark.parametrize("name", ["plane_on_linear_pad", "svk_bar", "mullins"])
def test_a_wrong_modulus_is_seen(name):
    assert far(name, solve(CASES[name], modulus=1 + 1e-5), "sparse")


def test_every_frozen_answer_is_compared():
    assert {key.split(".")[0] for key in frozen()} == set(CASES)
