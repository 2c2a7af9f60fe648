"""The skin's answers against those that were frozen once: see `skin_oracle` for the cases.

A Young's modulus that is off by a hundred-thousandth fails every case.
"""

import functools

import numpy as np
import pytest
import warp as wp
from skin_oracle import CASES, FILE, solve

DEVICES = ["cpu", *(["cuda:0"] if wp.is_cuda_available() else [])]
CLOSE = {"cpu": 1e-6, "cuda:0": 1e-4}  # of the peak; a step on CUDA is of mixed precision
OPTIONS = {"cpu": {}, "cuda:0": dict(tolerance=1e-6)}
# what counts as no answer at all: lengths, forces, torques ... of a press are a thousand times that, or zero
LEAST = dict(displacement=1e-7, force=1e-4, torque=1e-7, contact_force=1e-4, core_force=1e-4, pressure=1.0,
             volume=1e-9, translation=1.0, rotation=1e-5, coupling=1e-3)  # fmt: skip


@functools.cache
def frozen():
    with np.load(FILE) as file:
        return {name: file[name] for name in file.files}


def far(name, answers, close):
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
        if not distance <= close:
            out[quantity] = distance
    return out


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", CASES)
def test_answers_are_the_frozen_ones(name, device):
    try:
        answers = solve(CASES[name], device, **OPTIONS[device])
    except ValueError as error:
        if device == "cpu" or "full tier only" not in str(error):
            raise
        pytest.skip(str(error))
    assert answers["converged"].all() and answers["converged"].shape == frozen()[f"{name}.converged"].shape
    assert not far(name, answers, CLOSE[device])


@pytest.mark.parametrize("name", ["plane_on_linear_pad", "svk_bar", "mullins"])
def test_a_wrong_modulus_is_seen(name):
    assert far(name, solve(CASES[name], modulus=1 + 1e-5), CLOSE["cpu"])


def test_every_frozen_answer_is_compared():
    assert {key.split(".")[0] for key in frozen()} == set(CASES)
