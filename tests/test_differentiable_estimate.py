"""Contacts from electrodes: those of the skin's own presses are found again, and intervals hold them; touches
that are known teach what is a sensor's own."""

import copy
import csv
import dataclasses
import json

import h5py
import numpy as np
import pytest
import torch
from blocks import four_nodes
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from biotac_mj import cli
from biotac_mj.calibration import plan_indentation
from biotac_mj.data.generation.clearance import surface_samples
from biotac_mj.differentiable import Estimator, Touch, change_of, pressure_change
from biotac_mj.differentiable.estimation import fitting, presses, verbs
from biotac_mj.differentiable.estimation.belief import believe
from biotac_mj.differentiable.estimation.estimate import touch_of
from biotac_mj.differentiable.estimation.presses import capsule_of, deepest, outcome_of
from biotac_mj.differentiable.record import follow
from biotac_mj.geometry import load_skin
from biotac_mj.geometry.rigid import matrix
from biotac_mj.press import PressOptions, write_readings, write_skin
from biotac_mj.press import press as pressed_record
from biotac_mj.press.indenter import make_indenter
from biotac_mj.recordings import Recording, load_one, write
from biotac_mj.recordings.formats.pressed import settings_of
from biotac_mj.sensor.channels import (
    REST_COUNTS,
    counts_from_impedance,
    counts_from_log_impedance,
    counts_from_pressure,
    impedance_from_counts,
    log_impedance,
)
from biotac_mj.sensor.film import FilmConduction
from biotac_mj.sensor.presets import Sensor

REST = np.array(Sensor().rest)
PDC = float(counts_from_pressure(0.0))


def part_of(geometry):
    along, around = np.array([-0.0135, -0.011, -0.0085, -0.006]), np.radians([-25.0, 0, 25, 50])
    return dataclasses.replace(capsule_of(geometry), along=along, around=around)


@pytest.fixture(scope="module", autouse=True)
def small_table():
    """Presses of a part of the pad; with four nodes an element a quarter of the work of ten, which is anew
    whenever the skin's code changes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(presses, "capsule_of", part_of)
        patch.setattr(presses, "_FRACTIONS", np.linspace(0, 1, 5))
        yield


@pytest.fixture(scope="module")
def estimator():
    return Estimator(four_nodes("coarse"))


def press(estimator, along, around, share, gain=1.0):
    """Counts with PDC of a press, as a sensor with such gains reads it; the touch."""
    table = estimator.presses
    trajectory, steps = table.simulate(along, around, share)
    record, nodes = trajectory.steps[-1], len(estimator.geometry.vert)
    film = FilmConduction(estimator.geometry)
    pressed, rest = (of.x[:nodes, 0].numpy() for of in (record, trajectory.rest))
    solved = table.solved(record, trajectory.rest)
    ratio = film.impedance(pressed) / film.impedance(rest)
    counts = counts_from_impedance(impedance_from_counts(REST) * ratio**gain)
    pdc = float(counts_from_pressure(float(record.pressure - trajectory.rest.pressure)))
    truth = table.outcome_of_step(solved)
    force, pressure = float(np.exp(truth[0])), pressure_change(pdc, PDC)
    return counts, pdc, Touch(change_of(counts, REST), pressure, force, truth[1:4])


@pytest.fixture(scope="module")
def pressed(estimator):
    """A press that none of the table is."""
    return press(estimator, -0.0098, 0.17, 0.6)


def test_starts_are_the_presses_of_the_full_skin_roughly(estimator):
    """By the condensed tier: force, place and readings."""
    one = copy.copy(estimator.presses)
    along, around = one.capsule.along[:1], one.capsule.around[:1]
    one.capsule = dataclasses.replace(one.capsule, along=along, around=around)
    whole, one._slopes = one._make(), False
    alone = one._make()
    assert alone.keys() == {"signal", "outcome"} and len(whole) == 5
    off = alone["outcome"] - whole["outcome"]
    assert np.abs(off[..., 0]).max() < 0.15 and np.abs(off[..., 1:4]).max() < 0.5e-3
    change = whole["signal"][..., :19]
    assert np.linalg.norm(alone["signal"][..., :19] - change) < 0.2 * np.linalg.norm(change)


def test_a_press_is_found_again(estimator, pressed):
    counts, pdc, truth = pressed
    found = estimator(counts, REST, (pdc, PDC))
    off = np.abs(found.centre - truth.centre)
    assert np.linalg.norm(off) < 1.3e-3 and (off < found.centre_error).all()
    assert found.low < truth.force < found.high and found.unexplained < 0.6
    assert np.linalg.norm(found.force) == pytest.approx(found.size)
    assert found.force[1] > 0.9 * found.size  # into the pad
    alone = estimator(counts, REST)
    assert np.linalg.norm(alone.centre - truth.centre) < 1.3e-3


def test_a_fit_explains_more_than_the_nearest_press(estimator, pressed, monkeypatch):
    """Of the table."""
    counts, pdc, _ = pressed
    monkeypatch.setattr(fitting, "_STARTS", 1)
    found = []
    for moves in (0, 12):
        monkeypatch.setattr(fitting, "_ITERATIONS", moves)
        found.append(estimator.fit(counts.round(), REST, (pdc, PDC)))
    near, better = found
    assert better.unexplained < 0.75 * near.unexplained


@pytest.mark.slow
def test_a_press_of_the_simulated_sensor_is_fitted(estimator, pressed):
    """What it reads is explained to the noise; place and force are far better known than those of any
    sensor."""
    counts, pdc, truth = pressed
    found, blind = estimator.fit(counts.round(), REST, (pdc, PDC)), estimator(counts, REST, (pdc, PDC))
    assert np.linalg.norm(found.centre - truth.centre) < 0.4e-3
    assert found.size == pytest.approx(truth.force, rel=0.1) and found.low < truth.force < found.high
    assert found.high / found.low < 0.2 * blind.high / blind.low
    assert found.unexplained < 0.1


def test_a_fits_slopes_are_those_of_moved_presses():
    """By all seven coordinates of a press that tilts and slides: readings, force and centre. By moves before
    the next samples begin to touch, of a geom that is not round."""
    skin = four_nodes("coarse")
    table, film = Estimator(skin, "geom:capsule:3mm,5mm")._starts, FilmConduction(skin)
    start = int(np.abs(table.at - [-0.011, 0.38, 0.375]).sum(1).argmin())
    search = fitting._Search(table, film, np.zeros(20), np.full(20, 0.01), start, tqdm(disable=True))
    press = search._linear(search._simulate(np.array([0.1, -0.2, -0.3, 0.05, -0.05, 0.2, 0.1])))
    least = {"missed": 0.02, "outcome": 0.005}  # where slopes nearly vanish
    for k, move in enumerate(3e-4 * np.eye(7)):
        low, high = (search._simulate(press.at + sign * move) for sign in (-1, 1))
        for of, parts in {"missed": (slice(19), [19]), "outcome": ([0], slice(1, 4))}.items():
            slope = (getattr(high, of) - getattr(low, of)) / 6e-4
            for part in parts:
                off = np.linalg.norm((getattr(press, f"{of}_by")[:, k] - slope)[part])
                assert off < 0.02 * np.linalg.norm(slope[part]) + least[of], (k, of, part)


def test_secants_correct_gradients_that_hide_a_small_one():
    """Errors of a few percent in large gradients make the least known direction look far better known."""
    draw = np.random.default_rng(0)
    left, _, right = np.linalg.svd(draw.normal(size=(20, 7)), full_matrices=False)
    true = left * [600, 550, 500, 450, 400, 300, 10] @ right
    wrong = true + 10 * draw.normal(size=true.shape)
    by = draw.normal(size=(7, 7))

    def simulate(at):
        missed = true @ at
        return fitting._Press(at, by @ at, missed, missed @ missed)

    def spread(press, gradient):
        press = dataclasses.replace(press, outcome_by=by, missed_by=gradient)
        return np.sqrt(np.diag(by @ press.spread @ by.T))[:4]

    search = object.__new__(fitting._Search)
    search._simulate = simulate
    here = dataclasses.replace(simulate(np.zeros(7)), outcome_by=by, missed_by=wrong)
    found = search._with_secants(here)
    assert (spread(here, wrong) < 0.5 * spread(here, true)).all()
    np.testing.assert_allclose(spread(here, found.missed_by), spread(here, true), rtol=0.1)


def test_a_presss_own_settings_are_taken_from_its_file(tmp_path):
    """And only from the skin.h5 that has the same counts."""
    (one, _), (other, _) = (
        load_one(folder / "readings.csv")
        for folder in (press_into(tmp_path / "a"), press_into(tmp_path / "b", 6e-4))
    )
    assert settings_of(tmp_path / "a" / "readings.csv", one)["depth"] == 5e-4
    assert settings_of(tmp_path / "a" / "skin.h5", one)["skin"] == "coarse"
    assert settings_of(tmp_path / "a" / "readings.csv", other) is None
    assert settings_of(tmp_path / "readings.csv", one) is None


def press_into(folder, depth=5e-4, **more):
    """A folder of a light press, of four steps."""
    folder.mkdir()
    settings = {"skin": "coarse", "tier": "condensed", "indenter": "sphere_7mm", "hold": 0.0}
    settings = {"speed": depth / 16e-3, **settings, **more}
    record = pressed_record(PressOptions(depth=depth, **settings), progress=False)
    write_readings(record.record, folder / "readings.csv")
    write_skin(record.record, folder / "skin.h5")
    return folder


def test_rows_in_motion_are_read_at_their_time(tmp_path):
    """The multiplexer's are up to a frame and a step old: many times the noise at 20 mm/s."""
    folder = press_into(tmp_path / "a", depth=2e-3, slide=1e-3, speed=20e-3, hold=0.03)
    recording, _ = load_one(folder / "readings.csv")
    with h5py.File(folder / "skin.h5") as file:
        nodes = file["vert_xpos"][:].astype(float)
    film = FilmConduction(load_skin("coarse"))
    change = np.log([film.impedance(x[: film.geometry.nvert]) for x in nodes])
    counts, _ = recording.counts()
    read, noise = verbs._instants(recording, counts, recording.pdc, True), fitting.noise_of(counts[0], 1)
    raw, told = [], []
    for row in range(10, len(counts) - 5):
        found, _, moved = read(row)
        spread = np.hypot(noise, moved * fitting.slopes_at(found))[:19]
        told.append((change_of(found, counts[0]) - change[row] + change[0]) / spread)
        raw.append((change_of(counts[row], counts[0]) - change[row] + change[0]) / noise[:19])
    raw, told = (np.square(off).mean(1) for off in (raw, told))
    assert raw.max() > 10 and told.max() < 4 and np.median(told) < 1.5, (raw.round(1), told.round(1))


def test_a_tilts_slope_is_that_of_tilted_presses(estimator):
    """At a point of the table: changes of ln Z, pressure, force and centre."""
    table, skin = estimator.presses, estimator.skin
    around = np.radians(-25.0)
    straight, steps = table.simulate(-0.0085, around)
    middle = torch.from_numpy(table.middle(straight.steps[-1].touches.numpy()))
    tilt, size = table._tangents(steps, around).pose[0, 0], 0.02
    ends = []
    for h in (size, -size):
        pos = steps.pos + h * tilt[:, :, :3]
        mat = Rotation.from_rotvec(h * tilt[0, 0, 3:]).as_matrix() @ steps.mat
        trajectory = follow(skin, pos[None], mat[None], skin.friction, skin.own)
        record, nodes = trajectory.steps[-1], len(estimator.geometry.vert)
        film = FilmConduction(estimator.geometry)
        x, pressure = record.x[:nodes, 0].numpy(), float(record.pressure)
        signal = np.append(np.log(film.impedance(x)), 1e-3 * pressure)
        ends.append(np.append(signal, outcome_of(record.wrench[0, 0], middle)[:4]))
    point = (4 * 7 + 0) * 9 + 8  # third place along, first around, deepest; at others slopes jump more
    slopes = np.append(table.by_press[point, 0], table.outcome_by[point, 0, :4])
    found = (ends[0] - ends[1]) / (2 * size)
    parts = {"electrodes": (0, 19), "pressure": (19, 20), "force": (20, 21), "centre": (21, 24)}
    # the centre jumps where samples begin to touch; the force hardly changes
    near = {"electrodes": (0.1, 0), "pressure": (0.1, 0), "force": (0, 0.02), "centre": (0.1, 0)}
    for name, (begin, end) in parts.items():
        share, least = near[name]
        off = np.linalg.norm(slopes[begin:end] - found[begin:end])
        assert off < share * np.linalg.norm(found[begin:end]) + least, name


def test_what_all_electrodes_share_is_known_less_well(estimator, pressed):
    """Warmer liquid moves the contact by less than its interval."""
    counts, pdc, truth = pressed
    warm = counts_from_impedance(0.97 * impedance_from_counts(counts))
    found = estimator(warm, REST, (pdc, PDC))
    assert (np.abs(found.centre - truth.centre) < found.centre_error).all()


def test_touches_teach_a_sensors_gains(estimator, pressed):
    """A sensor whose electrodes answer half as much again, or half: ten touches tell, intervals shrink and
    hold."""
    gain = np.where(np.arange(19) % 2, 1.5, 0.6)
    draw = np.random.default_rng(0)
    touches = [
        press(
            estimator, draw.uniform(-0.0125, -0.007), draw.uniform(-0.3, 0.7), draw.uniform(0.4, 0.9), gain
        )[2]
        for _ in range(6)
    ]
    belief = estimator.learn(touches)
    told = [i for i in range(19) if np.mean([abs(t.change[i]) for t in touches]) > 0.2]
    assert len(told) > 2 and (np.sign(belief.mean[told]) == np.sign(gain[told] - 1)).all()
    assert np.trace(belief.covariance) < 0.9 * np.trace(believe(19).covariance)
    assert belief.force_variance < 0.5 * believe(19).force_variance
    counts, pdc, truth = press(estimator, -0.0098, 0.17, 0.6, gain)
    before = estimator(counts, REST, (pdc, PDC))
    found = estimator(counts, REST, (pdc, PDC), belief)
    assert found.high / found.low < before.high / before.low
    assert found.low < truth.force < found.high
    assert (np.abs(found.centre - truth.centre) < found.centre_error).all()
    without = [dataclasses.replace(touch, pressure=np.nan) for touch in touches]
    assert estimator.learn(without).force_variance < 0.5 * believe(19).force_variance


@pytest.mark.parametrize("share", [-0.25, -0.05, 0.1])
def test_a_warm_up_is_no_touch(share):
    """ln Z changes alike at all electrodes; where a touch is beside it, it is one."""
    rest, noise = REST_COUNTS["2"], np.random.default_rng(0).normal(0, 3e-3, 19)
    counts = counts_from_log_impedance(log_impedance(rest) + share + noise)
    with pytest.raises(ValueError, match="alike at all electrodes.* choose a row under load"):
        touch_of(counts, rest)
    noise[:3] -= 0.1
    touch_of(counts_from_log_impedance(log_impedance(rest) + share + noise), rest)


def test_what_is_no_contact_is_refused(estimator):
    with pytest.raises(ValueError, match="which may be noise: choose a row under load"):
        estimator(REST + 1.0, REST)
    with pytest.raises(
        ValueError, match="rest are not 19 numbers between 1 and 4094: an electrode at its end"
    ):
        estimator(REST, np.full(19, 4095.0))
    with pytest.raises(ValueError, match="ellipsoid are not there: take a mesh"):
        Estimator(load_skin("coarse"), "geom:ellipsoid:0.003,0.003,0.004")
    with pytest.raises(ValueError, match="no touch that is known lies within 1.5 mm"):
        estimator.learn([Touch(np.zeros(19), 0.0, 1.0, np.ones(3))])


def test_the_command_writes_what_the_estimator_finds(estimator, pressed, tmp_path, capsys):
    counts, _, truth = pressed
    header = ",".join(f"e{i + 1}" for i in range(19))
    lines = [",".join(f"{v:.0f}" for v in row) for row in (REST, counts)]
    (tmp_path / "two.csv").write_text("\n".join([header, *lines]) + "\n")
    (tmp_path / "one.csv").write_text("\n".join([header, lines[1]]) + "\n")
    estimator.geometry.save(tmp_path / "skin.npz")
    skin = ["--skin", str(tmp_path / "skin.npz"), "--quiet"]
    given = ["lab", "estimate", str(tmp_path / "two.csv"), *skin, "--out"]
    assert cli.main([*given, str(tmp_path / "found.csv")]) == 0
    said = capsys.readouterr().out
    assert "row 1: centre" in said and "unexplained" in said and "any sensor" in said
    assert "nearest to the middle of the contact on the undeformed skin" in said
    with open(tmp_path / "found.csv", newline="") as file:
        (row,) = csv.DictReader(file)
    assert float(row["low"]) < truth.force < float(row["high"])
    one = ["lab", "estimate", str(tmp_path / "one.csv"), *skin, "--out", str(tmp_path / "found.json")]
    assert cli.main([*one, "--sensor", "1"]) == 0
    (same,) = json.loads((tmp_path / "found.json").read_text())
    assert same["size"] == pytest.approx(float(row["size"]), rel=1e-6) and same["row"] == 0

    known = tmp_path / "known.h5"
    recording = Recording(
        time=np.arange(3) * 0.1,
        electrodes=np.array([REST, counts, REST]).round(),
        pdc=np.array([PDC, PDC, PDC]),
        force=np.array([[0, 0, 0], [0, truth.force, 0], [0, 0, 0]]),
        contact_pos=np.array([[np.nan] * 3, truth.centre, [np.nan] * 3]),
    )
    write(known, [recording])
    capsys.readouterr()
    assert cli.main([*given, str(tmp_path / "known.csv"), "--known", str(known)]) == 0
    assert "known by 10 touches at most" in capsys.readouterr().out
    with open(tmp_path / "known.csv", newline="") as file:
        (better,) = csv.DictReader(file)
    assert float(better["high"]) / float(better["low"]) < float(row["high"]) / float(row["low"])

    write(known, [dataclasses.replace(recording, contact_pos=None)])
    for wrong, said in (
        (one, "takes all of the 1 rows: leave some to look at, or name a --sensor"),
        ([*given, str(tmp_path / "no.csv"), "--row", "7"], "--row 7: two has 2 rows"),
        ([*given, str(tmp_path / "no.csv"), "--row", "0"], "which may be noise"),
        ([*given, str(tmp_path / "no.csv"), "--known", str(known)], "has no force or no contact_pos: give"),
        ([*given, str(tmp_path / "no.csv"), "--material", "calibrated"], "rest_pressure are not there"),
    ):
        capsys.readouterr()
        assert cli.main(wrong) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "no.csv").exists()


@pytest.mark.parametrize("indenter", ["ring_7mm", "sphere_7mm", "geom:capsule:0.003,0.005"])
def test_presses_stop_before_the_core(indenter):
    """At the tip, which stands in the ring, and on the pad: by the distance to the core's own vertices."""
    skin = load_skin("coarse")
    core = surface_samples(skin.core_vert, skin.core_face, "cpu")
    shape = make_indenter(indenter)
    for x, angle in ((-18e-3, 0.0), (-14e-3, 0.5), (-4e-3, -1.0)):
        way = plan_indentation(indenter, (x, angle), 2.4e-3, 0.0, samples=7, skin=skin)
        depth = deepest(way, core)
        assert 0.5e-3 < depth <= 2.4e-3
        tip = way.tip[0] + depth * (way.tip[-1] - way.tip[0]) / 2.4e-3
        inside = (skin.core_vert - tip) @ matrix(way.quat) - shape.pos
        if indenter.startswith("sphere"):
            gap = np.linalg.norm(inside, axis=1).min() - 3.5e-3
            assert 0.55e-3 < gap and (depth == 2.4e-3 or gap < 0.75e-3)
