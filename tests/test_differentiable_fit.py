"""A fit by gradients: the forces of the fit by differences, and the constants that made the data."""

import dataclasses
import inspect
import json

import numpy as np
import pytest

from biotac_mj import cli
from biotac_mj.calibration import calibrate, configuration, parameter, plan_indentation, simulate
from biotac_mj.calibration.fit import forces_and_jacobian
from biotac_mj.calibration.indentation import write_indentation
from biotac_mj.differentiable.fit import Forces, forces_of
from biotac_mj.differentiable.record import follow
from biotac_mj.skin import Material
from biotac_mj.skin.settings import read_material

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


@pytest.mark.slow
def test_forces_are_those_of_the_fit_by_differences(shell, data):
    wanted = [parameter("E"), parameter("mu")]
    force, slopes, lost = Forces()(shell, TRUTH, wanted, np.array([1.2e6, 0.5]), data)
    assert not lost
    assert force == pytest.approx(data.force, abs=2e-5)
    assert np.abs(slopes).max((0, 1)).min() > 1e-2


@pytest.mark.slow  # quick: the verb finds friction
def test_recovers_stiffness_and_friction(shell, data):
    found = calibrate(shell, START, data, ["E", "mu"], max_iterations=8, forces=Forces())
    assert found.success and not found.nonconverged
    assert found.value == pytest.approx([TRUTH.youngs_modulus, TRUTH.friction], rel=1e-3)


@pytest.mark.slow
def test_slopes_of_rubber_that_relaxes(shell, data):
    """It relaxes between the samples, in the times that these have."""
    relaxing = dataclasses.replace(TRUTH, prony=((0.5, 0.05),))
    wanted, at = [parameter("E"), parameter("mu")], np.array([1.2e6, 0.5])
    exact = dataclasses.replace(shell.options, tolerance=1e-6, max_newton=200)
    shell = dataclasses.replace(shell, options=exact)
    force, slopes, lost = Forces()(shell, relaxing, wanted, at, data)
    expected, differences, _ = forces_and_jacobian(shell, relaxing, wanted, at, data)
    assert not lost and np.abs(force - data.force).max() > 0.1 * np.abs(data.force).max()
    assert force == pytest.approx(expected, abs=2e-5)
    assert slopes == pytest.approx(differences, abs=1e-2 * np.abs(slopes).max())  # of the first order


def test_slopes_are_cached_bit_for_bit(shell, data, tmp_path, monkeypatch):
    monkeypatch.setenv("BIOTAC_CACHE", str(tmp_path))
    short = dataclasses.replace(data, **{name: getattr(data, name)[:4] for name in ("time", "tip", "force")})
    wanted, followed = [parameter("E"), parameter("mu")], []
    counted = lambda *args, **more: followed.append(1) or follow(*args, **more)  # noqa: E731
    monkeypatch.setattr("biotac_mj.differentiable.fit.follow", counted)
    first, again, other = (Forces()(shell, TRUTH, wanted, at, short) for at in ([1e6, 1], [1e6, 1], [2e6, 1]))
    assert len(followed) == 2 and again[2] == first[2]
    for one, two, three in zip(first[:2], again, other):
        np.testing.assert_array_equal(one, two)
        assert not np.array_equal(one, three)


def test_what_has_no_gradient_is_named(shell, data):
    with pytest.raises(ValueError, match="gradients by stick_ratio are not there: fit with calibration"):
        calibrate(shell, START, data, ["E", "stick_ratio:0.01:0.5"], forces=Forces())


def test_differences_where_there_is_no_gradient(shell, data):
    """And what the verb says of it."""
    E, other = parameter("E"), parameter("stick_ratio:0.01:0.5")
    moving = dataclasses.replace(shell, options=dataclasses.replace(shell.options, dynamics="implicit"))
    for body, wanted, device, said in (
        (shell, E, "cpu", "gradients"),
        (shell, other, "cpu", "differences (gradients by stick_ratio are not there)"),
        (moving, E, "cpu", "differences (gradients of implicit dynamics are not there)"),
        (shell, E, "cuda:0", "differences (gradients on cuda:0 are not there)"),
    ):
        forces, how = forces_of(body, TRUTH, [wanted], data, device)
        assert how == said and (forces is None) == how.startswith("differences")


@pytest.mark.parametrize("name", ["solid", "solid_with_core"])
def test_solids_have_no_inner_surface_and_yet_gradients(name):
    """Which `biotac lab compare` and `biotac lab calibrate` ask for by default."""
    body, E = configuration(name), parameter("E")
    way = plan_indentation(depth=0.2e-3, slide=0.0, samples=4)
    forces, how = forces_of(body, TRUTH, [E], way)
    assert how == "gradients"
    _, slopes, lost = forces(body, TRUTH, [E], np.array([1.2e6]), way)
    more, less = (forces(body, TRUTH, [E], np.array([one]), way)[0] for one in (1.21e6, 1.19e6))
    assert not lost
    assert np.squeeze(slopes) / 60 == pytest.approx(more - less, rel=0.02, abs=1e-6)  # by the logarithm
    assert np.abs(more - less).max() > 1e-5


def test_the_verb_fits_by_gradients(data, tmp_path, capsys):
    write_indentation(data, tmp_path / "way.csv")
    command = f"lab calibrate {tmp_path / 'way.csv'} --indenter sphere_7mm --fit mu --quiet --out {tmp_path}"
    exact = '{"skin": {"contact_stiffness": 2e11}}'
    start = {"youngs_modulus": TRUTH.youngs_modulus, "poissons_ratio": 0.38, "friction": 0.6, "liquid": False}
    assert cli.main([*command.split(), "--options", exact, "--material", json.dumps(start)]) == 0
    said = capsys.readouterr().out
    assert "slopes by gradients" in said and "the fit converged" in said
    fitted = read_material(tmp_path / "calibration.json")
    assert fitted.friction == pytest.approx(TRUTH.friction, rel=2e-3)


def test_several_starts_leave_a_jump_behind(shell, data):
    """Forces that jump where friction passes a value just beside the best on the wrong side."""
    draw = np.random.default_rng(1)
    wanted = [parameter("E"), parameter("mu")]
    slopes = draw.normal(size=(*data.force.shape, 2))
    best = np.array([p.scaled(v) for p, v in zip(wanted, (1.2e6, 0.5))])
    flat = slopes.reshape(-1, 2)
    step = draw.normal(size=len(flat))
    step -= flat @ np.linalg.lstsq(flat, step, rcond=None)[0] - flat @ [0.0, 0.02]
    edge = best[1] - 0.01

    def forces(_configuration, _material, parameters, values, _indentation, _device):
        at = np.array([p.scaled(v) for p, v in zip(parameters, values)])
        force = data.force + slopes @ (at - best)
        return force + (at[1] < edge) * step.reshape(force.shape), slopes, 0

    start = dataclasses.replace(TRUTH, friction=0.4)
    once = calibrate(shell, start, data, wanted, forces=forces)
    several = calibrate(shell, start, data, wanted, forces=forces, starts=6)
    assert once.rms > 0.5 and several.rms < 1e-3 and several.evaluations > once.evaluations
    assert several.value == pytest.approx([1.2e6, 0.5], rel=1e-4)


def test_a_start_that_promises_nothing_is_left(shell, data):
    wanted = [parameter("E"), parameter("mu")]
    slopes = np.random.default_rng(1).normal(size=(*data.force.shape, 2))
    noisy = dataclasses.replace(
        data, force=data.force + np.random.default_rng(2).normal(size=data.force.shape)
    )

    def forces(_configuration, _material, parameters, values, _indentation, _device):
        at = np.log(values / [1.2e6, 0.5])
        return data.force + slopes @ at, slopes, 0

    once, several = (calibrate(shell, START, noisy, wanted, forces=forces, starts=n) for n in (1, 4))
    assert several.evaluations == once.evaluations + 3
    assert (several.value == once.value).all()


def test_a_fit_takes_the_rest_by_name():
    parameters = inspect.signature(calibrate).parameters.values()
    placed = [one.name for one in parameters if one.kind is one.POSITIONAL_OR_KEYWORD]
    assert placed == ["configuration", "material", "indentation", "parameters"]
