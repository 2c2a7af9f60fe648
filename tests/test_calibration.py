"""Calibration: recovery of known parameters, columns of a batch against single runs, statistics against
closed forms, error texts."""

import dataclasses

import numpy as np
import pytest

from biotac_mj import cli
from biotac_mj.calibration import (
    CONFIGURATIONS,
    calibrate,
    comparison_table,
    configuration,
    evaluate,
    forward,
    parameter,
    plan_indentation,
    plan_shear,
    read_indentation,
    refined,
    simulate,
    stand_in,
    write_indentation,
)
from biotac_mj.calibration.fit import forces_and_jacobian
from biotac_mj.calibration.report import write_json
from biotac_mj.calibration.statistics import covariance, ljung_box
from biotac_mj.geometry.tet_mesh import TetMesh
from biotac_mj.skin import Material
from biotac_mj.skin.settings import read_material

TRUTH = Material(youngs_modulus=1.2e6, poissons_ratio=0.38, friction=0.5, liquid=False)


@pytest.fixture(scope="module")
def way():
    return plan_indentation(depth=1.2e-3, slide=1.2e-3, samples=12)


@pytest.fixture(scope="module")
def shell():
    return configuration("shell_with_core", tolerance=1e-6, max_newton=200, contact_stiffness=2e11)


@pytest.mark.slow
def test_recovers_stiffness_and_friction_quickly(shell):
    short = plan_indentation(depth=0.6e-3, slide=0.6e-3, samples=8)
    true = simulate(shell.geometry, shell.options, [TRUTH], short).force[0]
    data = dataclasses.replace(
        short, force=true + 0.001 * np.random.default_rng(1).standard_normal(true.shape)
    )
    found = calibrate(
        shell,
        dataclasses.replace(TRUTH, youngs_modulus=1.5e6, friction=0.6),
        data,
        ["E", "mu"],
        max_iterations=8,
    )
    assert found.success and not found.nonconverged
    assert found.value == pytest.approx([TRUTH.youngs_modulus, TRUTH.friction], rel=0.02)
    assert (found.interval[:, 0] < found.value).all() and (found.value < found.interval[:, 1]).all()


@pytest.mark.slow
def test_recovers_known_parameters_from_noisy_forces(way, shell):
    """Same mesh, noise of half a per cent of the peak; docs/lab/calibration.md has what another mesh does."""
    true = simulate(shell.geometry, shell.options, [TRUTH], way).force[0]
    noise = 0.002
    data = dataclasses.replace(way, force=true + noise * np.random.default_rng(1).standard_normal(true.shape))
    found = calibrate(
        shell, Material(liquid=False, youngs_modulus=1.5e6, poissons_ratio=0.32, friction=0.6), data
    )
    wanted = np.array([TRUTH.youngs_modulus, TRUTH.poissons_ratio, TRUTH.friction])
    assert found.success and not found.nonconverged and not found.at_bound.any()
    # 2 %, 2 %, 5 %, or what the noise allows: no fit can be expected within three standard errors of a poorer
    # measurement
    error = np.maximum(found.standard_error, found.standard_error_robust)
    assert (np.abs(found.value - wanted) <= np.maximum([0.02, 0.02, 0.05] * wanted, 3 * error)).all(), (
        found.value / wanted
    )
    assert abs(found.value[0] / wanted[0] - 1) < 0.05 and abs(found.value[2] / wanted[2] - 1) < 0.05
    assert found.rms < 1.1 * np.sqrt(
        (np.linalg.norm(data.force - true, axis=1) ** 2).mean()
    )  # no worse than the truth itself


@pytest.mark.slow
def test_correction_takes_the_mesh_out_of_the_fit(shell):
    """Forces made on the default skin, fitted on the coarse one, which is 8 % stiffer there: alone it takes
    that for the material."""
    short = plan_indentation(depth=0.4e-3, slide=0.0, samples=4)
    finer = configuration("shell_with_core", "default")
    data = dataclasses.replace(short, force=simulate(finer.geometry, shell.options, [TRUTH], short).force[0])
    start = dataclasses.replace(TRUTH, youngs_modulus=1.5e6)
    alone = calibrate(shell, start, data, ["E"], max_iterations=4)
    corrected = calibrate(shell, start, data, ["E"], max_iterations=4, finer=finer.geometry)
    assert alone.value[0] < 0.95 * TRUTH.youngs_modulus
    assert corrected.value == pytest.approx([TRUTH.youngs_modulus], rel=0.002)
    assert corrected.rms < 0.2 * alone.rms and "corrected by" in corrected.skin


def test_refined_skin_is_the_same_body():
    skin = configuration("shell_with_core").geometry
    fine = refined(skin)
    assert len(fine.elem) == 8 * len(skin.elem) and np.isin(skin.fixed, fine.fixed).all()
    once, twice = (TetMesh(g.vert, g.tets).check().volumes.sum() for g in (skin, fine))
    assert (
        once < twice < 1.005 * once and fine.name == "refined:coarse"
    )  # both are polyhedra inside the curved body
    with pytest.raises(ValueError, match="four-node tetrahedra"):
        refined(dataclasses.replace(skin, elem=skin.tets))


def test_a_path_that_separates_the_parameters():
    way = plan_shear(corners=((1.0e-3, 0), (1.0e-3, 2.0e-3), (2.2e-3, 2.0e-3)), largest_step=2e-4)
    assert len(way.tip) == 1 + 5 + 10 + 6 and np.diff(way.tip, axis=0).shape == (21, 3)
    np.testing.assert_allclose(np.linalg.norm(np.diff(way.tip, axis=0), axis=1), 2e-4, rtol=1e-9)
    press, slide = way.tip[5] - way.tip[0], way.tip[15] - way.tip[5]
    np.testing.assert_allclose(way.tip[-1] - way.tip[15], 1.2 * press, atol=1e-12)
    assert abs(press @ slide) < 1e-3 * np.linalg.norm(press) * np.linalg.norm(slide)


def test_batch_columns_equal_single_runs(shell):
    way = plan_indentation(depth=0.4e-3, slide=0.4e-3, samples=3)
    names = [parameter(name) for name in ("nu", "mu")]
    values = np.array([0.38, 0.5])
    force, jacobian, _ = forces_and_jacobian(shell, TRUTH, names, values, way)
    alone = simulate(shell.geometry, shell.options, [TRUTH], way).force[0]
    np.testing.assert_allclose(force, alone, atol=1e-5)
    for i, change in enumerate((dict(poissons_ratio=0.38 + 0.00245), dict(friction=0.5 * np.exp(0.01)))):
        moved = simulate(shell.geometry, shell.options, [dataclasses.replace(TRUTH, **change)], way).force[0]
        column = (moved - alone) / 0.01
        assert np.linalg.norm(jacobian[..., i] - column) < 0.02 * np.linalg.norm(column), names[i].name


@pytest.mark.slow
def test_force_scales_with_youngs_modulus_and_contact_stiffness(way):
    """Dimensions: E and contact stiffness times two are forces times two, without the liquid."""
    one = configuration("deformable_shell", tolerance=1e-6, contact_stiffness=2e11)
    two = dataclasses.replace(one, options=dataclasses.replace(one.options, contact_stiffness=4e11))
    force = simulate(one.geometry, one.options, [TRUTH], way).force
    double = simulate(
        two.geometry, two.options, [dataclasses.replace(TRUTH, youngs_modulus=2.4e6)], way
    ).force
    np.testing.assert_allclose(double, 2 * force, atol=1e-3 * np.abs(force).max())


@pytest.mark.slow
def test_four_configurations_order_of_stiffness():
    """More material and more core are stiffer: shell < shell on its core < solid, and shell < solid < solid
    on its core."""
    deep = plan_indentation(depth=1.8e-3, slide=0.0, samples=11)
    peak = {}
    for name in CONFIGURATIONS:
        body = configuration(name)
        answer = simulate(body.geometry, body.options, [TRUTH], deep)
        assert not answer.nonconverged.any(), name
        peak[name] = np.linalg.norm(answer.force[0, -1])
    assert peak["deformable_shell"] < 0.98 * peak["shell_with_core"]
    assert peak["deformable_shell"] < peak["solid"] < peak["solid_with_core"]


@pytest.mark.parametrize("name", ["solid", "solid_with_core"])
def test_solids_fill_what_they_should(name):
    skin = configuration(name).geometry
    shell = configuration("deformable_shell").geometry
    # the coarse skin and the cavity of its card [mm^3]
    outside = 1e9 * (TetMesh(shell.vert, shell.tets).volumes.sum()) + 1751.130
    wanted = outside - (1395.597 if name == "solid_with_core" else 0.0)
    mesh = TetMesh(skin.vert, skin.elem).check()
    assert 1e9 * mesh.volumes.sum() == pytest.approx(wanted, rel=0.02)
    assert not len(skin.inner_face)


def test_robust_covariance_of_autocorrelated_noise():
    """A constant fitted to AR(1) noise of coefficient a: the mean's variance is (1 + a) / (1 - a) times that
    of white noise."""
    rng, a, n = np.random.default_rng(0), 0.6, 20000
    noise = np.zeros(n)
    for t, shock in enumerate(rng.standard_normal(n)):
        noise[t] = a * noise[t - 1] + shock
    white, robust, lags = covariance(np.ones((n, 1, 1)), noise[:, None])
    assert white[0, 0] == pytest.approx(1 / (1 - a**2) / n, rel=0.05)
    # Bartlett's share of (1 + a) / (1 - a)
    weights = 1 + 2 * sum((1 - k / (lags + 1)) * a**k for k in range(1, lags + 1))
    assert robust[0, 0] / white[0, 0] == pytest.approx(weights, rel=0.1)


def test_ljung_box_level_and_power():
    rng = np.random.default_rng(0)
    rejected = np.mean([ljung_box(rng.standard_normal((100, 1)))["p_value"][0] < 0.05 for _ in range(400)])
    assert 0.02 < rejected < 0.09
    assert not ljung_box(np.sin(np.linspace(0, 6, 60))[:, None])["white"]


@pytest.mark.slow
def test_comparison_of_a_skin_with_itself_is_zero(way):
    body = configuration("deformable_shell")
    truth = simulate(body.geometry, body.options, [TRUTH], way)
    case = dataclasses.replace(
        way, force=truth.force[0], peak_norm=truth.peak_norm[0], mean_norm=truth.mean_norm[0]
    )
    same, softer = (
        evaluate(body, m, [case]) for m in (TRUTH, dataclasses.replace(TRUTH, youngs_modulus=0.6e6))
    )
    assert same.force_mean < 1e-3 and same.nodal_peak < 1e-7 and same.nodal_mean < 1e-8
    mean_force = np.linalg.norm(case.force, axis=1).mean()
    assert softer.force_mean == pytest.approx(0.5 * mean_force, rel=0.05)
    assert "0.0876" in comparison_table([same, softer], "itself")


def test_stand_in_noise_is_what_was_asked(way):
    short = dataclasses.replace(way, time=way.time[:5], tip=way.tip[:5], force=way.force[:5])
    a, b = (stand_in(short, "paper", "coarse", noise) for noise in (0.0, 0.5))
    assert 0.2 < (b.force - a.force).std() < 0.8


def test_csv_round_trip_and_errors(way, tmp_path):
    path = tmp_path / "press.csv"
    write_indentation(way, path)
    again = read_indentation(path, "sphere_7mm")
    for name in ("time", "tip", "force", "quat"):
        np.testing.assert_allclose(getattr(again, name), getattr(way, name), atol=1e-9)
    text = path.read_text()

    def refused(changed, match, **options):
        path.write_text(changed)
        with pytest.raises(ValueError, match=match):
            read_indentation(path, **{"indenter": "sphere_7mm", **options})

    refused(text, "what pressed", indenter=None)
    refused(text.replace("tip_x_m", "tip_x_mm"), "'tip_x_mm' .* has unit mm: it must be 'tip_x_m', in m")
    refused(text.replace("force_y_N,", "push,"), "no column 'force_y_N'")
    refused(text.replace("\n0.02,", "\nsoon,"), "line 3: time_s is 'soon', not a finite number")
    refused("\n".join(text.splitlines()[:3]), "at least 4")
    refused(text, "no direction", direction=(0, 0, 0))
    rows = [line.split(",") for line in text.splitlines()]
    far = [rows[0], *([r[0], str(1e3 * float(r[1])), *r[2:]] for r in rows[1:])]
    refused("\n".join(",".join(r) for r in far), "must be in metres")
    with pytest.raises(FileNotFoundError, match="columns time_s"):
        read_indentation(tmp_path / "none.csv")


def test_parameters_that_cannot_be_fitted_are_refused(way, shell, tmp_path):
    for text, match in (
        ("hardness", "cannot fit 'hardness'"),
        ("E:2:1", "no interval"),
        ("E:a:b", "not two numbers"),
        ("fill_volume", "no bounds are known"),
    ):
        with pytest.raises(ValueError, match=match):
            parameter(text)
    with pytest.raises(ValueError, match="unknown configuration"):
        configuration("gel")
    with pytest.raises(ValueError, match="no space for a liquid"):
        configuration("solid", liquid=True)
    with pytest.raises(ValueError, match="coarse mesh only"):
        configuration("solid", "fine")
    with pytest.raises(ValueError, match="has no force"):
        calibrate(shell, TRUTH, way)
    with pytest.raises(ValueError, match="starts at .* outside"):
        calibrate(shell, TRUTH, dataclasses.replace(way, force=way.force + 1), ["E:1000:2000"])
    with pytest.raises(ValueError, match="fewer"):
        covariance(np.ones((5, 3, 2)), np.ones((5, 3)))
    with pytest.raises(FileNotFoundError, match="no material"):
        read_material(tmp_path / "none.json")
    write_json({"material": TRUTH}, tmp_path / "fit.json")
    assert read_material(tmp_path / "fit.json") == TRUTH


def test_commands_name_the_missing_argument(capsys):
    assert cli.main(["lab", "calibrate"]) == 2
    assert "--synthetic" in capsys.readouterr().err
    assert cli.main(["lab", "compare", "--data", "press.csv"]) == 2
    assert "INDENTER=FILE" in capsys.readouterr().err
    assert tuple(CONFIGURATIONS) == cli.CONFIGURATIONS


def test_a_stopped_comparison_goes_on(tmp_path, monkeypatch):
    """What was simulated is not simulated again, and the result is that of a run in one go."""
    made = []

    def response(geometry, options, materials, indentation, *rest):
        made.append((geometry.name, indentation.name))
        if len(made) == stop:
            raise KeyboardInterrupt
        norm = np.full((1, len(indentation.time)), options.tolerance)
        force = np.stack([norm, norm, indentation.tip[None, :, 0]], -1)
        return forward.Response(force, norm, norm, np.zeros(1, int), 7)

    monkeypatch.setattr(forward, "_simulate", response)
    given = ["lab", "compare", "--material", "paper", "--indenters", "sphere_7mm", "--count", "2", "--quiet"]
    given += ["--configurations", "deformable_shell", "shell_with_core", "--out", str(tmp_path)]
    reports = []
    for folder, stop in (("stopped", 4), ("whole", 0)):
        monkeypatch.setenv("BIOTAC_CACHE", str(tmp_path / folder))
        assert (cli.main(given) == 0) is (stop == 0)
        assert len(made) == (stop or 6)
        if stop:
            assert not (tmp_path / "compare.json").exists()
            assert cli.main(given) == 0 and made[3:4] == made[4:5] and len(made) == 7
        reports.append((tmp_path / "compare.json").read_text())
        if not stop:
            assert cli.main([*given, "--seed", "1"]) == 0 and len(made) == 12
        made.clear()
    assert reports[0] == reports[1]


def test_responses_are_cached_bit_for_bit(shell, way, tmp_path, monkeypatch):
    monkeypatch.setenv("BIOTAC_CACHE", str(tmp_path))
    short = dataclasses.replace(way, **{name: getattr(way, name)[:4] for name in ("time", "tip", "force")})
    softer = dataclasses.replace(TRUTH, youngs_modulus=1e6)
    one = shell.geometry, shell.options, [TRUTH], short
    first = simulate(*one)
    stepped, step = [], forward.step
    monkeypatch.setattr(forward, "step", lambda *given: stepped.append(given) or step(*given))
    again = simulate(*one)
    assert not stepped and again.steps == first.steps
    for field in dataclasses.fields(first):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(first, field.name))
    for other in ((*one[:2], [softer], short), (*one[:3], dataclasses.replace(short, tip=short.tip * 1.01))):
        before = len(stepped)
        simulate(*other)
        assert len(stepped) > before
