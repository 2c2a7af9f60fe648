"""A fit by gradients: the forces of the fit by differences, and the constants that made the data."""

import dataclasses

import numpy as np
import pytest

from biotac_mj import differentiable
from biotac_mj.calibration import configuration, parameter, plan_indentation, simulate
from biotac_mj.differentiable.fit import Forces
from biotac_mj.skin import Material

TRUTH = Material(youngs_modulus=1.2e6, poissons_ratio=0.38, friction=0.5, liquid=False)
START = dataclasses.replace(TRUTH, youngs_modulus=1.5e6, friction=0.6)


@pytest.fixture(scope="module")
def shell():
    return configuration("shell_with_core", tolerance=1e-6, max_newton=200, contact_stiffness=2e11)


@pytest.fixture(scope="module")
def data(shell):
    short = plan_indentation(depth=0.6e-3, slide=0.6e-3, samples=8)
    true = simulate(shell.geometry, shell.options, [TRUTH], short).force[0]
    return dataclasses.replace(short, force=true)


def test_forces_are_those_of_the_fit_by_differences(shell, data):
    wanted = [parameter("E"), parameter("mu")]
    force, slopes, lost = Forces()(shell, TRUTH, wanted, np.array([1.2e6, 0.5]), data)
    assert not lost
    assert force == pytest.approx(data.force, abs=2e-5)
    assert np.abs(slopes).max((0, 1)).min() > 1e-2


def test_recovers_stiffness_and_friction(shell, data):
    found = differentiable.calibrate(shell, START, data, ["E", "mu"], max_iterations=8)
    assert found.success and not found.nonconverged
    assert found.value == pytest.approx([TRUTH.youngs_modulus, TRUTH.friction], rel=1e-3)


def test_what_has_no_gradient_is_named(shell, data):
    with pytest.raises(ValueError, match="gradients by stick_ratio are not there: fit with calibration"):
        differentiable.calibrate(shell, START, data, ["E", "stick_ratio:0.01:0.5"])
