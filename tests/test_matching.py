"""The match between a recording of a flat press and the simulated sensor, on synthetic recordings."""

import dataclasses
import gzip
import io
import json

import numpy as np
import pytest
from made_up_plate import MIRROR, made_up_states

from biotac_mj.geometry.design import read_design
from biotac_mj.geometry.skins import load_skin
from biotac_mj.matching.fit import SIGNS, Constants, Rows, Setup, fit_constants, fit_states, rows_of, tangent
from biotac_mj.matching.response import Response
from biotac_mj.matching.states import PlateGrid, frame, plate_states
from biotac_mj.sensor.channels import REST_COUNTS, counts_from_log_impedance, log_impedance
from biotac_mj.skin import Material

MODULUS = 0.8e6  # [Pa] of the synthetic sensor; the search begins at 1.2 MPa


@pytest.fixture(scope="module")
def response():
    return Response(*made_up_states())


@pytest.fixture(scope="module")
def truth(response):
    """Constants, states and rows of a synthetic recording with 3 counts of noise."""
    rng, n = np.random.default_rng(1), 240
    time = np.linspace(0, 0.99, n)
    state = np.column_stack(
        [
            0.25 + 0.2 * np.sin(9 * time),
            0.5 * np.sin(13 * time + 1),
            0.5 * np.sin(17 * time),
            0.5 * np.cos(11 * time),
        ]
    )
    pressing = 3 + 2 * np.sin(23 * time)
    rest = log_impedance(REST_COUNTS["2"]) + rng.normal(0, 0.02, 19)
    const = Constants(rest, 1 + rng.normal(0, 0.15, 19), np.array([-0.2, np.log(0.3)]), MODULUS)
    value, _ = response.at_load(pressing / MODULUS)(state, False)
    counts = counts_from_log_impedance(const.log_z(value[:, :19], time)) + rng.normal(0, 3, (n, 19))
    force = np.column_stack([value[:, 19:] * MODULUS, pressing])
    return const, state, Rows(np.clip(counts, 0, 4095), force, time)


def test_constants_of_an_sp_come_back():
    design, (rng, n) = read_design("biotac_sp"), (np.random.default_rng(1), 170)
    response, k = Response(*made_up_states(design=design)), design.nelectrode
    wave = np.sin(np.outer(np.linspace(0, 9, n), [1.0, 1.4, 1.9, 1.2]) + [0, 1, 0, 2])
    state, pressing = [0.25, 0, 0, 0] + [0.2, 0.5, 0.5, 0.5] * wave, 3 + 2 * wave[::-1, 0]
    rest = np.mean([log_impedance(one) for one in design.rests], axis=0) + rng.normal(0, 0.02, k)
    const = Constants(rest, 1 + rng.normal(0, 0.15, k), np.array([0.0, np.log(0.4)]), MODULUS)
    value, _ = response.at_load(pressing / MODULUS)(state, False)
    counts = counts_from_log_impedance(const.log_z(value[:, :k], np.zeros(n))) + rng.normal(0, 3, (n, k))
    force = np.column_stack([value[:, k:] * MODULUS, pressing])
    found, matched = fit_constants(response, Rows(counts, force, np.zeros(n)), Setup(drift=0.0))
    assert abs(found.modulus / MODULUS - 1) < 0.1 and np.abs(found.gain - const.gain).max() < 0.1
    assert np.sqrt(((matched.state - state) ** 2).mean(0)).max() < 0.05


def test_constants_and_states_come_back(response, truth):
    const, state, rows = truth
    found, matched = fit_constants(response, rows[:170], Setup())
    assert abs(found.modulus / MODULUS - 1) < 0.1  # gains, held near 1, trade against it
    assert np.abs(found.gain - const.gain).max() < 0.1
    assert np.abs(found.drifted(rows.time) - const.drifted(rows.time)).max() < 0.03
    assert np.sqrt(((matched.state - state[:170]) ** 2).mean(0)).max() < 0.05


def test_a_tangent_is_how_the_model_moves(response, truth):
    const, state, rows = truth
    rows, state, setup, rng = rows[:6], state[:6], Setup(gains=0.0), np.random.default_rng(0)

    def model(const, state):
        value, _ = response.at_load(rows.force[:, 2] / const.modulus)(state, False)
        counts = counts_from_log_impedance(const.log_z(value[:, :19], rows.time))
        return np.hstack([counts, value[:, 19:] * const.modulus])

    _, columns, here, scale = tangent(response, rows, const, state, setup)
    others = (
        (const, state + 1e-3 * rng.standard_normal(state.shape)),
        (dataclasses.replace(const, offset=const.offset + 1e-3 * rng.standard_normal(19)), state),
        (dataclasses.replace(const, modulus=const.modulus * np.exp(1e-2)), state),
    )
    for one in others:
        away = tangent(response, rows, *one, setup)[2] - here
        moved, predicted = model(*one) - model(const, state), np.tensordot(away, columns, 1)
        for part in (slice(19), slice(19, 21)):  # counts, and newtons
            size = np.abs(moved[:, part]).max()
            np.testing.assert_allclose(predicted[:, part], moved[:, part], atol=0.02 * size)
    assert away[-1] * scale == pytest.approx(1e-2)  # of the modulus


@pytest.mark.slow
def test_rows_kept_aside_are_predicted_to_the_noise(real_match, response, truth):
    found, _ = real_match.match(response, truth[2])
    assert found["rows"] == 72 and found["free_per_row"] == 4
    assert found["correlation_median"] > 0.999 and found["rms_counts"] < 4
    assert found["held_out"]["rms_counts"] < 10
    assert found["mean_pattern"]["rms_rel_mean"] == pytest.approx(1)
    assert found["force_alone_N"]["pressing"]["rmse"] < 0.3 * found["force_alone_N"]["pressing"]["std"]


@pytest.mark.slow
def test_a_sensor_that_is_not_the_models_is_not_matched(real_match, response, truth):
    """Electrodes in another order: the fit's freedom does not explain them."""
    rows = truth[2]
    order = np.random.default_rng(3).permutation(19)
    found, _ = real_match.match(response, Rows(rows.counts[:, order], rows.force, rows.time))
    assert found["rms_rel_mean"] > 0.3


def test_gains_of_one_are_kept(response, truth):
    found, _ = fit_constants(response, truth[2][:170:4], Setup(gains=0.0, hold_modulus=True, modulus=MODULUS))
    assert (found.gain == 1).all() and found.modulus == pytest.approx(MODULUS)


def test_states_from_some_electrodes_predict_the_others(response, truth):
    const, _, rows = truth
    seen = np.setdiff1d(np.arange(19), [3, 8, 16])
    found = fit_states(response, rows[::5], const, Setup(), electrodes=seen)
    assert np.sqrt(((found.counts - rows[::5].counts)[:, [3, 8, 16]] ** 2).mean()) < 8


def test_slopes_are_derivatives(response):
    rng = np.random.default_rng(2)
    state = rng.uniform(response.low, response.high, (5, 4))
    loaded, h = response.at_load(rng.uniform(3e-7, 1e-5, 5)), 1e-3
    _, slope = loaded(state)
    for i in range(4):
        step = h * np.eye(4)[i]
        numeric = (loaded(state + step, False)[0] - loaded(state - step, False)[0]) / (2 * h)
        assert np.allclose(slope[..., i], numeric, atol=2e-2 * np.abs(numeric).max() + 1e-5)


def test_rolls_to_the_other_side_are_the_mirror_image(response):
    loaded = response.at_load(np.full(2, 4e-6))
    value, _ = loaded(np.array([[0.2, 0.4, 0.3, 0.5], [0.2, -0.4, 0.3, -0.5]]), False)
    assert np.allclose(value[0, :19], value[1, MIRROR], atol=1e-5)
    assert np.allclose(value[0, 19:], value[1, 19:] * [1, -1])


def test_states_of_a_small_table(tmp_path, monkeypatch):
    """Real finite elements: the force is the load asked for, and a second call finds the states on disk."""
    monkeypatch.setenv("BIOTAC_CACHE", str(tmp_path))
    grid = PlateGrid(pitch=(0.1, 0.3), roll=(0.0, 0.3), drag=(), load=(1e-7, 2e-7))
    geometry, material = load_skin("coarse"), Material()
    states = plate_states(geometry, material, grid=grid, quiet=True)
    assert states.xpos.shape == (2, 2, 1, 2, len(states.node), 3)
    assert np.allclose(states.force[..., 2], grid.load, rtol=1e-5)
    assert (states.pressure[..., 1] > states.pressure[..., 0]).all() and (
        states.reached >= grid.load[-1]
    ).all()
    moved = np.linalg.norm(states.xpos[:, :, 0, 1] - states.rest, axis=-1)
    nearest = states.node[moved[0, 0].argmax()]
    assert geometry.vert[nearest] @ frame(0.1, 0.0)[2] < 0, "the skin moves most where the plate is"
    monkeypatch.setattr("biotac_mj.matching.states._press", None)
    again = plate_states(geometry, material, grid=grid, quiet=True)
    assert (again.xpos == states.xpos).all()


def test_what_cannot_be_matched_is_told(truth):
    counts = np.tile(REST_COUNTS["1"], (500, 1))
    press = np.tile([0.1, 0.2, -4.0], (500, 1))
    with pytest.raises(ValueError, match="needs the force"):
        rows_of(counts, None)
    with pytest.raises(ValueError, match="a press has it negative"):
        rows_of(counts, -press)
    with pytest.raises(ValueError, match="400 are needed"):
        rows_of(counts, np.where(np.arange(500)[:, None] < 300, press, 0))
    with pytest.raises(ValueError, match="rising numbers"):
        PlateGrid(pitch=(0.2, 0.1))
    with pytest.raises(ValueError, match="rolls from 0 on"):
        PlateGrid(roll=(0.1, 0.2))
    with pytest.raises(ValueError, match="no rate effects"):
        plate_states(load_skin("coarse"), dataclasses.replace(Material(), prony=((0.1, 1.0),)), quiet=True)


@pytest.fixture
def real_match(repo, monkeypatch):
    monkeypatch.syspath_prepend(str(repo / "benchmarks"))
    import real_match

    return real_match


@pytest.mark.slow  # quick: constants and states come back, and the table of a folder
def test_the_command_scores_a_recording(real_match, response, truth, tmp_path, monkeypatch):
    rows = truth[2]
    force = rows.force @ np.linalg.inv(SIGNS)
    np.savetxt(tmp_path / "e.txt", np.repeat(rows.counts, 2, 0), fmt="%.1f")
    np.savetxt(tmp_path / "f.txt", np.repeat(force, 2, 0), fmt="%.4f")
    monkeypatch.setattr(real_match, "table", lambda *_: response)
    files = ["--electrodes", str(tmp_path / "e.txt"), "--force", str(tmp_path / "f.txt")]
    real_match.main([*files, "--json", str(tmp_path / "out.json"), "--every", "4"])
    found = json.loads((tmp_path / "out.json").read_text())
    assert found["rows"] == 36 and found["correlation_median"] > 0.99 and found["rms_rel"] < 0.1
    # gains scatter by 0.15 in this sensor: without them the same states explain less
    assert found["rms_counts"] < found["gains_one"]["rms_counts"] < found["mean_pattern"]["rms_counts"]


def test_the_command_says_in_one_line_what_is_wrong(real_match, tmp_path):
    np.savetxt(tmp_path / "e.txt", np.tile(REST_COUNTS["1"], (500, 1)) + np.arange(500)[:, None] % 3)
    np.savetxt(tmp_path / "f.txt", np.tile([0.0, 0.0, -3.0], (499, 1)))
    files = ["--electrodes", str(tmp_path / "e.txt"), "--force", str(tmp_path / "f.txt")]
    with pytest.raises(SystemExit) as stop:
        real_match.main([*files, "--json", str(tmp_path / "out.json")])
    assert "has 499: they must be logged" in str(stop.value) and "\n" not in str(stop.value)


@pytest.fixture
def real_table(repo, monkeypatch):
    monkeypatch.syspath_prepend(str(repo / "benchmarks"))
    import real_table

    return real_table


def test_measures_of_the_table_are_those_of_made_up_counts(real_table):
    """A sensor whose electrodes all lose 100 counts, but for E7 to E9, which lose 300."""
    rng = np.random.default_rng(0)
    rest = np.tile(np.full(19, 2500.0), (200, 1))
    change = np.full((200, 19), -100.0) + rng.normal(0, 1, (200, 19))
    change[:, 6:9] -= 200
    found = real_table.measures(rest + change, rest, np.full(200, 5.0))
    assert found["RMS change at 4-6 N [counts]"] == pytest.approx(
        np.sqrt((16 * 1e4 + 3 * 9e4) / 19), rel=0.01
    )
    assert found["E7 to E9 at 4-6 N [counts]"] == pytest.approx(-300, abs=0.5)
    assert np.isnan(found["RMS change at 2-4 N [counts]"])
    # white noise has as many dimensions as channels, and near and far alike uncorrelated
    assert found["participation dimension"] > 16
    assert abs(found["correlation of near electrodes"]) < 0.1


def test_a_tap_is_told_from_presses(real_table):
    """PAC that dies away with a time constant of 4 ms; a louder push moves PDC for good."""
    rng, time = np.random.default_rng(0), np.arange(0, 3, 1 / 2200)
    pac = 2048 + rng.normal(0, 2, len(time))
    slow = np.arange(0, 3, 0.01)
    pdc = 1300.0 + 100 * (slow > 2.0)
    for start, size in ((1.0, 600), (2.0, 900)):
        after = time - start
        pac[after >= 0] += size * np.exp(-after[after >= 0] / 4e-3)
    found = list(real_table._rung(np.array([slow, pdc]), np.array([time, pac])).values())
    assert found[0] == pytest.approx(600, rel=0.02)
    assert found[1:3] == pytest.approx([4.0, 4.0 * np.log(10)], rel=0.1) and found[3:] == [0, 0]
    assert real_table._rung(np.array([slow, pdc]), np.array([time, 2048 + 0 * pac])) is None


def test_the_table_of_a_folder(real_table, response, truth, tmp_path, monkeypatch):
    rows, folder = truth[2], tmp_path / "recordings" / "sensor"
    folder.mkdir(parents=True)
    for name, values in (
        ("SynImpF1", rows.counts),
        ("SynImpF2", np.full_like(rows.counts, 3000.0)),
        ("ForceData", rows.force @ np.linalg.inv(SIGNS)),
    ):
        text = io.StringIO()
        noise = np.random.default_rng(5).normal(0, 4, (480, 19)) if name == "SynImpF2" else 0
        np.savetxt(text, np.repeat(values, 2, 0) + noise, fmt="%.3f")
        (folder / f"{name}.txt.gz").write_bytes(gzip.compress(text.getvalue().encode()))
    monkeypatch.setattr(real_table, "table", lambda *_: response)
    out = tmp_path / "table.json"
    given = ["--data", str(tmp_path), "--json", str(out), "--every", "4", "--figure", str(tmp_path / "t.png")]
    real_table.main(given)
    found = {row["name"]: row for row in json.loads(out.read_text())["rows"]}
    assert found["noise of an electrode [counts]"]["real"]["sensor/SynImpF2"] == pytest.approx(4, rel=0.1)
    change = found["RMS change at 2-4 N [counts]"]
    assert change["simulated"]["sensor"] == pytest.approx(change["real"]["sensor"], rel=0.3)
    assert (tmp_path / "t.png").stat().st_size > 10_000
    (tmp_path / "nothing").mkdir()
    with pytest.raises(SystemExit):
        real_table.main(["--data", str(tmp_path / "nothing"), "--json", str(out)])
