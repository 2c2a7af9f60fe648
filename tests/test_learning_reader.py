"""Models that are kept: synthetic electrodes that answer to force and place by a rule written here."""

import dataclasses
import json

import h5py
import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("safetensors")

from recorded import synthetic  # noqa: E402
from safetensors import safe_open  # noqa: E402

from biotac_mj import cli  # noqa: E402
from biotac_mj.geometry import load_skin  # noqa: E402
from biotac_mj.geometry.design import read_design  # noqa: E402
from biotac_mj.learning.instants.examples import Examples, from_recording  # noqa: E402
from biotac_mj.learning.instants.force import causal_average  # noqa: E402
from biotac_mj.learning.instants.novelty import NoveltyDetector, StuckDetector  # noqa: E402
from biotac_mj.learning.instants.reader import Reader, fit_reader, judge  # noqa: E402
from biotac_mj.learning.instants.terms import Terms  # noqa: E402
from biotac_mj.learning.protocol import is_better  # noqa: E402
from biotac_mj.learning.weights import load_forward, shipped  # noqa: E402
from biotac_mj.recordings import write  # noqa: E402
from biotac_mj.samples import make_samples  # noqa: E402
from biotac_mj.sensor.channels import REST_COUNTS, counts_from_log_impedance, log_impedance  # noqa: E402

STEPS = 8


def pattern(place, force, electrodes=19):
    """(n, electrodes) d ln Z of presses at places (n,) along the finger with forces (n,): near ones rise,
    far ones fall."""
    distance = np.linspace(-1, 1, electrodes) - place[:, None]
    return 0.3 * force[:, None] * (1.5 * np.exp(-(distance**2) / 0.1) - 0.4)


def touches(count, seed, second=False, rest=REST_COUNTS["1"]):
    """Examples of `count` presses, each at its own warmth; second: at two places at once."""
    rng = np.random.default_rng(seed)
    owner = np.repeat(np.arange(count), STEPS)
    force = np.tile(np.linspace(0.2, 1, STEPS), count) * np.repeat(rng.uniform(0.5, 2, count), STEPS)
    place = np.repeat(rng.uniform(-0.5, 0.5, count), STEPS)
    change = pattern(place, force, len(rest))
    if second:
        change = 0.5 * (change + pattern(np.where(place > 0, place - 0.8, place + 0.8), force))
    warmth = rng.uniform(0, 0.3, count)[owner][:, None]
    tare = np.rint(counts_from_log_impedance(log_impedance(rest) - warmth))
    counts = counts_from_log_impedance(log_impedance(tare) + change) + rng.normal(0, 2, tare.shape)
    zero = np.zeros(len(owner))
    # what no electrode tells is part of every real force: a trajectory's own error
    own = np.repeat(rng.normal(0, 0.1, count), STEPS)
    targets = {
        "force": np.column_stack([zero, force + own, zero + rng.normal(0, 0.01, len(owner))]),
        "place": np.column_stack([place, zero, zero]),
    }
    return Examples(np.clip(counts, 0, 4095), tare, owner, targets, True, "synthetic", True, 80 * force)


@pytest.fixture(scope="module")
def reader():
    return fit_reader(touches(160, 0), np.arange(100), np.arange(100, 160))


def test_unseen_touches_are_predicted_and_covered(reader):
    data = touches(300, 1)
    found = reader.predict(data.counts, data.tare)
    assert np.abs(found.value["force"] - data.targets["force"])[:, 1].mean() < 0.15
    assert np.abs(found.value["place"] - data.targets["place"])[:, 0].mean() < 0.08
    for name in ("force", "place", "electrodes"):
        truth = data.counts if name == "electrodes" else data.targets[name]
        inside = np.abs(found.value[name] - truth) <= found.half[name]
        wide = truth.std(0) > 0  # what never varies has an interval of nothing
        assert 0.85 < inside[:, wide].mean() < 0.96, name
    assert found.novelty[: 50 * STEPS].mean() < 1


def test_touches_of_an_sp_are_predicted(tmp_path):
    rest = read_design("biotac_sp").rest_counts
    fit_reader(touches(60, 0, rest=rest), np.arange(40), np.arange(40, 60)).save(tmp_path / "sp.safetensors")
    one, data = Reader.load(tmp_path / "sp.safetensors"), touches(60, 1, rest=rest)
    assert len(one.electrodes) == 24
    found = one.predict(data.counts, data.tare)
    assert np.abs(found.value["force"] - data.targets["force"])[:, 1].mean() < 0.15
    assert np.abs(found.value["place"] - data.targets["place"])[:, 0].mean() < 0.08
    with pytest.raises(ValueError, match="this model reads 24 electrodes, and the rows have 19"):
        one.predict(np.full((2, 19), 2500.0), np.full(19, 2500.0))


def test_novelty_rises_for_what_training_did_not_have(reader):
    """Two places at once, and an electrode that stays at rest or reads nothing."""
    data, two = touches(100, 2), touches(100, 3, second=True)
    usual = np.median(reader.predict(data.counts, data.tare).novelty.reshape(-1, STEPS), 1)
    nearest = np.abs(np.linspace(-1, 1, 19) - data.targets["place"][:, :1]).argmin(1)
    rows = np.arange(len(nearest))
    for reads in (data.tare[rows, nearest], 0.0, None):
        counts = data.counts.copy()
        if reads is None:
            counts = two.counts
        else:
            counts[rows, nearest] = reads
        found = reader.predict(counts, data.tare)
        strange = np.median(found.novelty.reshape(-1, STEPS), 1)
        assert (strange[:, None] > usual).mean() > 0.9
        # and an interval widens with it
        known = reader.predict(data.counts, data.tare)
        assert (found.half["force"].mean(0) > known.half["force"].mean(0))[1:].all()


def test_novelty_sees_a_rest_that_training_did_not_have(reader):
    """Warmth is one number for all electrodes and was there; another pattern was not."""
    data = touches(100, 8)
    pattern = 0.1 * np.cos(np.arange(19))
    found, other = (
        reader.predict(
            *(counts_from_log_impedance(log_impedance(x) + shift) for x in (data.counts, data.tare))
        )
        for shift in (0, pattern)
    )
    assert (found.novelty > 1).mean() < 0.12 and (other.novelty > 1).all()
    for name in found.half:  # what is read is as certain as before: it is the change from the rest
        np.testing.assert_allclose(other.half[name], found.half[name], rtol=0.2)


def test_novelty_sees_pdc_that_does_not_go_with_the_electrodes(reader):
    data = touches(100, 9)

    def area(pdc):
        found = (reader.predict(data.counts, data.tare, x).novelty for x in (data.pdc, pdc))
        usual, strange = (np.log(x).reshape(-1, STEPS).mean(1) for x in found)
        return (strange[:, None] > usual).mean()

    assert area(2 * data.pdc) > 0.9
    assert 0.4 < area(1.02 * data.pdc) < 0.7


@pytest.mark.parametrize("noise", [pytest.param(0, marks=pytest.mark.slow), 2])
def test_novelty_sees_an_electrode_that_is_stuck(noise):
    """At its mean, in a recording of which no row by itself tells: every electrode drifts for itself."""
    rng, n, cut = np.random.default_rng(0), 3000, 2000
    push, own = causal_average(rng.normal(size=(n, 3)), 10.0), causal_average(rng.normal(size=(n, 19)), 300.0)
    change = 0.05 * (push / push.std(0)) @ rng.normal(size=(3, 19)) + 0.1 * own / own.std(0)
    counts = np.rint(counts_from_log_impedance(log_impedance(REST_COUNTS["1"]) + change))
    owner, target = np.arange(cut) * 40 // cut, {"force": push[:cut]}
    data = Examples(counts[:cut], counts[:cut], owner, target, False, "synthetic", False)
    reader = fit_reader(data, np.arange(28), np.arange(28, 40))
    usual = reader.predict(counts[cut:]).novelty
    assert (usual > 1).mean() < 0.12
    for electrode in range(0, 19, 3):
        stuck = counts[cut:].copy()
        stuck[:, electrode] = np.rint(counts[:cut, electrode].mean() + rng.normal(0, noise, n - cut))
        assert (reader.predict(stuck).novelty[100:, None] > usual).mean() > 0.95, electrode
    # rows that are held as a whole, by a logger that is faster than the sensor
    held = reader.predict(np.repeat(counts[cut:], 3, axis=0)).novelty
    np.testing.assert_allclose(held, np.repeat(usual, 3))


def test_a_stuck_electrode_differs_from_a_quiet_sensor():
    rng = np.random.default_rng(0)
    x = np.cumsum(rng.normal(size=(4000, 1)), 0) * rng.uniform(0.5, 1.5, 5) + rng.normal(0, 0.3, (4000, 5))
    moving = StuckDetector.fit(x[:2000], np.arange(2000) < 1400)
    quiet = x[[1999]] + rng.normal(0, 0.3, (500, 5))
    assert (moving(np.concatenate([x[:2000], quiet])) <= 1).all() and (moving(x[2000:]) <= 1).mean() > 0.98
    stuck = x.copy()
    stuck[3000:3500, 2] = x[2999, 2] + rng.normal(0, 0.1, 500)
    found = moving(stuck)
    assert (found[3100:3500] > 3).all() and (found[3800:] <= 1).all()


def test_distance_is_one_where_rows_lie_as_known_ones_do():
    rng = np.random.default_rng(0)
    x, owner = np.repeat(rng.normal(size=(200, 3)), 5, 0), np.repeat(np.arange(200), 5)
    x = x + 0.01 * rng.normal(size=x.shape)
    known = NoveltyDetector.fit(x, owner)
    assert 0.7 < np.median(known(rng.normal(size=(400, 3)))) < 1.3
    far = np.array([[8.0, 0, 0], [0, 8, 0]])
    assert (known(far) > 3).all()


def test_a_model_comes_back_from_its_file(reader, tmp_path):
    reader.save(tmp_path / "m.safetensors")
    back, data = Reader.load(tmp_path / "m.safetensors"), touches(5, 4)
    ours, theirs = (one.predict(data.counts, data.tare) for one in (reader, back))
    for name in ours.value:
        np.testing.assert_allclose(theirs.value[name], ours.value[name], rtol=1e-3, atol=2e-2)
    np.testing.assert_allclose(theirs.novelty, ours.novelty, rtol=1e-2)
    with pytest.raises(ValueError, match="--tare ROWS says how many rows are at rest"):
        back.predict(data.counts)
    with pytest.raises(ValueError, match="holds no model that reads electrodes"):
        Reader.load(shipped("forward"))
    with pytest.raises(ValueError, match="m.safetensors reads force from electrodes, and a signal needs"):
        load_forward(tmp_path / "m.safetensors", load_skin("coarse"))
    tensors = dict(reader.tensors)
    del tensors["rows.apart"]
    dataclasses.replace(reader, tensors=tensors).save(tmp_path / "less.safetensors")
    with pytest.raises(ValueError, match="does not fit together"):
        Reader.load(tmp_path / "less.safetensors")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"level": None}, "has no level"),
        ({"level": "zzz"}, "level .* is 'zzz': pass a number"),
        ({"level": -3.0}, "is -3: a share"),
        ({"tared": None}, "has no tared"),
    ],
)
def test_a_description_that_lacks_what_is_read_is_refused(reader, tmp_path, change, said):
    meta = {name: value for name, value in (reader.meta | change).items() if value is not None}
    Reader(meta, reader.tensors).save(tmp_path / "m.safetensors")
    with pytest.raises(ValueError, match=said):
        Reader.load(tmp_path / "m.safetensors")


def test_turned_weights_of_the_same_shape_are_refused(reader, tmp_path):
    """A square matrix fits either way: only the checksum tells."""
    from safetensors.numpy import load_file, save_file

    path = tmp_path / "m.safetensors"
    reader.save(path)
    Reader.load(path)
    with safe_open(str(path), framework="np") as file:
        said = file.metadata()
    found = load_file(path)
    found["axes"] = np.ascontiguousarray(found["axes"].T)
    save_file(found, path, said)
    with pytest.raises(ValueError, match="its checksum differs"):
        Reader.load(path)


def test_too_few_touches_are_refused():
    few = touches(20, 5)
    with pytest.raises(ValueError, match="intervals of 90 % need 9 aside"):
        fit_reader(few, np.arange(12), np.arange(12, 20))
    with pytest.raises(ValueError, match="the set has 20 interactions: .* needs 49, of which 9"):
        judge(few)


def test_terms_without_the_common_mode_do_not_see_it():
    x = touches(20, 6).log_change
    terms = Terms.fit(x, products=3, common=True, length=1.0)
    np.testing.assert_allclose(terms(x + 0.3), terms(x), atol=1e-9)
    assert np.abs(Terms.fit(x, products=3, length=1.0)(x + 0.3) - terms(x)).max() > 0.1


def test_a_force_of_noise_is_not_offered_for_use(tmp_path, capsys):
    """The ridges of noise gain what chance gives them."""
    one, out = synthetic(n=1200), str(tmp_path / "m.safetensors")
    train = ["learn", "train", str(tmp_path / "rec.h5"), "--out", out]
    write(tmp_path / "rec.h5", [dataclasses.replace(one, object_pos=None, object_quat=None)])
    assert cli.main(train) == 0
    said = capsys.readouterr().out
    assert "; use fx, fz with `biotac learn predict" in said and "use it" not in said
    assert "note: fy: no better than the mean: do not use these" in said
    y = one.force[:, 1]  # white noise
    assert abs(np.corrcoef(y[1:], y[:-1])[0, 1]) < 0.1
    assert Reader.load(out).meta["useless"] == ["fy"]
    predict = ["learn", "predict", out, str(tmp_path / "rec.h5"), "--out", str(tmp_path / "p.csv")]
    assert cli.main(predict) == 0
    assert "note: fy: no better than the mean" in capsys.readouterr().out
    noise = np.random.default_rng(5).normal(size=one.force.shape)  # RMSE 2e-4 N below the mean's
    write(tmp_path / "rec.h5", [dataclasses.replace(one, force=noise, object_pos=None, object_quat=None)])
    assert cli.main(train) == 0
    said = capsys.readouterr().out
    assert "note: fx, fy, fz: no better than the mean" in said and "learn predict" not in said
    write(tmp_path / "rec.h5", [dataclasses.replace(one, force=np.ones_like(noise))])
    assert cli.main(train) == 2
    assert "synthetic: the force never changes, so that it cannot be learned" in capsys.readouterr().err


def test_better_is_what_trajectories_tell():
    owner, other = np.repeat(np.arange(10), 20), np.ones((200, 2))
    part = np.repeat(np.linspace(-1, 1, 10), 20)[:, None]
    assert is_better(0.9 * other, other, owner) and not is_better(other, other, owner)
    assert not is_better((0.99 + 0.1 * part) * other, other, owner)  # one or the other, by trajectory
    assert not is_better(0.5 * other, other, 0 * owner)


def test_commands_keep_a_model_and_use_it(tmp_path, capsys):
    one = synthetic(n=1200)
    one = dataclasses.replace(one, time=one.time + 1.7e9)  # a clock of ROS, since 1970
    write(tmp_path / "rec.h5", [one])
    rec, model = str(tmp_path / "rec.h5"), str(tmp_path / "m.safetensors")
    assert cli.main(["learn", "train", rec, "--out", model]) == 0
    assert "held out calibrate the intervals and give the errors" in capsys.readouterr().out
    assert cli.main(["learn", "predict", model, rec, "--out", str(tmp_path / "p.csv")]) == 0
    table = np.genfromtxt(tmp_path / "p.csv", delimiter=",", names=True)
    assert len(table) == len(one) and {"time", "fz", "fz_half", "e19", "novelty"} <= set(table.dtype.names)
    np.testing.assert_allclose(table["time"] - 1.7e9, one.time - 1.7e9, atol=1e-5)
    assert np.sqrt(((table["fz"] - one.force[:, 2]) ** 2).mean()) < 0.3
    assert cli.main(["learn", "predict", model, rec, "--out", str(tmp_path / "p.h5")]) == 0
    with h5py.File(tmp_path / "p.h5") as file:
        np.testing.assert_allclose(file["force"][:, 2], table["fz"], rtol=1e-4, atol=1e-5)
        assert file["electrodes_half"].shape == (len(one), 19) and file["force"].attrs["unit"] == "N"
    assert "never changes" not in capsys.readouterr().out
    dead = dataclasses.replace(one, electrodes=np.where(np.arange(19) == 4, 4095, one.electrodes))
    write(tmp_path / "dead.h5", [dead])
    assert (
        cli.main(["learn", "predict", model, str(tmp_path / "dead.h5"), "--out", str(tmp_path / "d.csv")])
        == 0
    )
    assert "note: e5 never changes" in capsys.readouterr().out
    assert cli.main(["learn", "predict", model, rec, "--out", str(tmp_path / "p.txt")]) == 2
    assert "ends in none of .csv" in capsys.readouterr().err
    assert cli.main(["learn", "predict", str(shipped("forward")), rec, "--out", str(tmp_path / "q.csv")]) == 2
    assert "holds no model that reads electrodes" in capsys.readouterr().err
    with pytest.raises(ValueError, match="neither force nor contact place"):
        from_recording(dataclasses.replace(one, force=None))


@pytest.mark.slow
def test_a_model_of_a_log_is_judged_on_a_set_and_back(tmp_path, capsys, monkeypatch):
    """A force has one sign in logs and sets; what a log lacks is not judged."""
    monkeypatch.chdir(tmp_path)
    electrodes, forces, _, made = map(str, make_samples("samples"))
    cli.main(["learn", "train", electrodes, "--force", forces, "--out", "log.safetensors"])
    cli.main(["learn", "train", made, "--out", "set.safetensors"])
    assert cli.main(["learn", "judge", made, "--model", "log.safetensors", "--json", "judged.json"]) == 0
    force = json.loads((tmp_path / "judged.json").read_text())["targets"]["force"]
    assert force["rmse"] < 0.3 * force["rmse_of_mean"] and not force["useless"]
    back = ["learn", "judge", electrodes, "--force", forces, "--model", "set.safetensors"]
    capsys.readouterr()
    assert cli.main(back) == 2 and "--tare ROWS" in capsys.readouterr().err
    assert cli.main([*back, "--tare", "20"]) == 0
    said = capsys.readouterr().out
    assert "place" not in said and "no better than the mean here" in said
    assert "the model learned from 5% of these rows" in said  # the log has the touches of the set
    (tmp_path / made).rename("another")
    assert cli.main(["learn", "judge", "another", "--model", "set.safetensors"]) == 0
    said = capsys.readouterr().out
    assert "the model learned from 9" in said and "unseen" not in said  # a tenth was its test
    assert cli.main([*back[:-2], "--tare", "20"]) == 2 and "goes with --model" in capsys.readouterr().err


def test_rows_that_a_model_learned_from_are_known(reader, tmp_path):
    reader.save(tmp_path / "m.safetensors")
    one, learned, new = Reader.load(tmp_path / "m.safetensors"), touches(160, 0), touches(160, 1)
    assert one.known(learned.counts) == 1 and one.known(new.counts) == 0
    mixed = np.concatenate([new.counts, np.repeat(learned.counts[::-1], 2, 0)])  # another order, some twice
    assert abs(one.known(mixed) - 0.5) < 0.05 and one.known(learned.counts.astype(np.float32)[:80]) == 1
