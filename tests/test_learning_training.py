"""Training on a small set whose rule is known, files of weights, use in MuJoCo, and everything that can be
wrong with the input."""

import copy
import dataclasses
import json
import re
import shutil
import sys

import h5py
import mujoco
import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")

from learning_set import dent, log_change, make_set  # noqa: E402
from readers_files import GROUND, SIX  # noqa: E402
from ship_weights import ship  # noqa: E402

import biotac_mj  # noqa: E402
from biotac_mj import cli  # noqa: E402
from biotac_mj.data import TactileSet  # noqa: E402
from biotac_mj.geometry import load_skin  # noqa: E402
from biotac_mj.learning.patch import contact_patch, estimate  # noqa: E402
from biotac_mj.learning.report import evaluate_models, table  # noqa: E402
from biotac_mj.learning.serve import LearnedBatchFilm, NetworkFilm  # noqa: E402
from biotac_mj.learning.training import experiment  # noqa: E402
from biotac_mj.learning.training.arrays import load_arrays  # noqa: E402
from biotac_mj.learning.training.config import LearningConfig  # noqa: E402
from biotac_mj.learning.training.experiment import train_all  # noqa: E402
from biotac_mj.learning.training.features import mirror_order  # noqa: E402
from biotac_mj.learning.training.few_shot import evaluate_new_sensor, fit_gains, fit_mixing, simplest_mixing  # noqa: E402
from biotac_mj.learning.training.inverse import contact_centre, log_change_of, patch_overlap  # noqa: E402
from biotac_mj.learning.weights import load_forward, load_inverse  # noqa: E402
from biotac_mj.sensor import PhysicsReadings  # noqa: E402
from biotac_mj.sensor.acquisition import BatchAcquisition  # noqa: E402
from biotac_mj.sensor.acquisition_kernels import SAMPLED, SAMPLED_PDC  # noqa: E402
from biotac_mj.sensor.channels import REST_COUNTS  # noqa: E402
from biotac_mj.sensor.own_design import PadShape, new_design  # noqa: E402

SMALL = LearningConfig(steps=120, batch=64, width=16, members=1, pod=32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_set(tmp_path_factory.mktemp("set"), count=80, labelled=60)


@pytest.fixture(scope="module")
def trained(folder, tmp_path_factory):
    """One training of our models on both kinds of split."""
    out = tmp_path_factory.mktemp("trained")
    torch.set_num_threads(1)
    train_all(folder, out, (0,), ("trajectory", "ring_7mm"), SMALL, paper=False, progress=False)
    return out


@pytest.fixture(scope="module")
def evaluated(trained):
    return evaluate_models(trained)


@pytest.fixture(scope="module")
def weights(trained):
    return trained / "forward-ring_7mm.safetensors"


def test_local_head_recovers_the_rule_on_an_unseen_object(trained, evaluated):
    result = evaluated
    rows = result["splits"]["ring_7mm"]["models"]
    assert rows["local_taught"]["median"] < 3.0  # counts; the noise of this set is 1, its touches are tens
    assert rows["tare"]["median"] > 5 * rows["local_taught"]["median"]
    assert result["default"] in ("local_taught", "ensemble")
    assert 0.8 <= rows["local_taught"]["interval_coverage"] <= 1
    text = table(result)
    assert "unseen object: ring_7mm" in text and f"{result['default']} against linear" in text
    for p in (0.001, 0.2):  # a median alone does not recommend
        changed = copy.deepcopy(result)
        found = changed["splits"]["ring_7mm"]
        for name in {"tare", "physics", "physics_gain", "linear"} & set(rows):
            found["models"][name]["median"] = 100.0
        for test in found["tests"].values():
            test["p"] = p
        assert ("not significantly better than linear" in table(changed)) == (p > 0.05)
    for picture in result["figures"]:
        assert (trained / picture.split("/")[-1]).stat().st_size > 10_000
    with TactileSet(result["set"]) as data:
        ring = np.flatnonzero((data.object == "ring_7mm") & data.labelled)
    with np.load(trained / "ring_7mm-0.npz") as file:
        assert set(file["owner"][file["test"]]) == set(ring)
        assert not set(file["owner"][~file["test"]]) & set(ring)


def test_weights_are_shipped_with_a_card(trained, evaluated, tmp_path):
    written = ship(trained, evaluated, tmp_path / "weights")
    assert sorted(p.name for p in written) == [
        "forward.md",
        "forward.safetensors",
        "inverse.md",
        "inverse.safetensors",
    ]
    card = (tmp_path / "weights/forward.md").read_text()
    assert "**synthetic**" in card and "`coarse`" in card and "unseen ring_7mm" in card
    assert (
        load_forward(tmp_path / "weights/forward.safetensors", load_skin("coarse")).nvert
        == load_skin("coarse").nvert
    )
    with pytest.raises(FileNotFoundError, match="seed 0"):
        ship(tmp_path, {"data": "synthetic"}, tmp_path / "other")


def test_training_goes_on_where_it_was_interrupted(trained, folder):
    stamp = (trained / "trajectory-0.json").stat().st_mtime_ns
    same = dict(paper=False, progress=False)
    train_all(folder, trained, (0,), ("trajectory",), SMALL, **same)
    assert (trained / "trajectory-0.json").stat().st_mtime_ns == stamp
    other = dataclasses.replace(SMALL, steps=SMALL.steps + 1)
    for name, config, paper in (("paper", SMALL, True), ("config", other, False)):
        with pytest.raises(ValueError, match=rf"json is of other settings \({name}\): choose another --out"):
            train_all(folder, trained, (0,), ("trajectory",), config, paper=paper, progress=False)


@pytest.mark.slow
def test_a_stopped_training_goes_on_to_the_same_bits(trained, folder, tmp_path, monkeypatch):
    stopped, begin = [], experiment.train_split

    def counted(*args):
        if args[1] == "ring_7mm" and not stopped:
            stopped.append(True)
            raise KeyboardInterrupt
        return begin(*args)

    on, same = ((0,), ("trajectory", "ring_7mm"), SMALL), dict(paper=False, progress=False)
    monkeypatch.setattr(experiment, "train_split", counted)
    with pytest.raises(KeyboardInterrupt):
        train_all(folder, tmp_path, *on, **same)
    stamp = (tmp_path / "trajectory-0.json").stat().st_mtime_ns
    train_all(folder, tmp_path, *on, **same)
    assert (tmp_path / "trajectory-0.json").stat().st_mtime_ns == stamp  # is not trained again
    for split in on[1]:
        for name in (f"{split}-0.npz", f"forward-{split}.safetensors", f"inverse-{split}.safetensors"):
            assert (tmp_path / name).read_bytes() == (trained / name).read_bytes()


@pytest.mark.slow
def test_the_bar_reaches_its_end(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)  # elsewhere no bar is drawn
    begin, steps = experiment.train_split, []

    def counted(*args):
        begin(*args[:-1], lambda n: [steps.append(n), args[-1](n)])

    monkeypatch.setattr(experiment, "train_split", counted)
    train_all(folder, tmp_path, (0,), ("trajectory",), SMALL, paper=False)
    said, bar = capsys.readouterr()
    total = 120 * (2 + 3)  # the head, the inverse
    assert "80 interactions" in said and f"0/{total}" in bar and sum(steps) == total
    assert (tmp_path / "trajectory-0.json").is_file()


@pytest.mark.slow
def test_the_papers_networks_train_too(folder, tmp_path):
    config = LearningConfig(
        steps=60,
        batch=64,
        mesh_steps=6,
        mesh_batch=4,
        mesh_first=8,
        mesh_channels=(8, 8, 8, 8),
        mesh_last=8,
        pod=16,
        members=1,
        paper_steps=60,
    )
    train_all(folder, tmp_path, (0,), ("trajectory",), config, progress=False)
    report = json.loads((tmp_path / "trajectory-0.json").read_text())
    assert {"pod", "mesh_vae"} == set(report["mesh"]) and {"pod_inverse_taught", "latent_inverse"} == set(
        report["inverse"]
    )
    assert {"latent_projection", "pointnet", "electrode_vae"} <= set(
        evaluate_models(tmp_path)["splits"]["trajectory"]["models"]
    )
    skin = load_skin("coarse")
    u = torch.tensor(1e3 * dent(skin, [-9e-3, -7e-3, 0], 0.6e-3, 2e-3, 0)[None], dtype=torch.float32)
    for name in ("forward", "latent_projection", "pointnet"):  # every network is kept and reads
        model = load_forward(tmp_path / f"{name}-trajectory.safetensors", skin)
        assert torch.isfinite(model.log_change(u)).all() and not model.log_change(0 * u).abs().max() > 1e-5
    for name in ("inverse", "latent_projection"):
        field, _ = load_inverse(tmp_path / f"{name}-trajectory.safetensors", skin)(torch.zeros(1, 19))
        assert field.shape == (1, skin.nvert, 3) and field.abs().max() < 1e-4  # [mm]


def test_a_set_is_no_folder_of_predictions(tmp_path):
    (tmp_path / "shard-00000.h5").touch()
    with pytest.raises(FileNotFoundError, match="learn train .* --out trained"):
        evaluate_models(tmp_path)


def test_weights_survive_the_file_and_refuse_another_skin(weights, folder):
    skin = load_skin("coarse")
    model = load_forward(weights, skin)
    u = dent(skin, [-9e-3, -7e-3, 1e-3], 0.8e-3, 2e-3, 0)
    d = model.log_change(torch.tensor(1e3 * u[None], dtype=torch.float32))[0].numpy()
    wanted = log_change(skin, u)
    assert np.abs(d - wanted).max() < 0.15 * np.abs(wanted).max()
    with pytest.raises(ValueError, match=r"trained on skin 'coarse' with .* cannot read skin 'default'"):
        load_forward(weights, load_skin("default"))
    with pytest.raises(ValueError, match="holds no inverse model"):
        load_inverse(weights, skin)
    with pytest.raises(FileNotFoundError, match="no file of weights"):
        load_forward(weights.with_name("none.safetensors"), skin)
    with pytest.raises(ValueError, match=r"reads \(n, 2741, 3\)|this model reads"):
        model.log_change(torch.zeros(1, 5, 3))
    bad = torch.zeros(1, skin.nvert, 3)
    bad[0, 3, 1] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        model.log_change(bad)


def test_damaged_weights_are_named(weights, tmp_path):
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(weights.read_bytes()[:2000])
    with pytest.raises(ValueError, match="is no file of weights"):
        load_forward(broken, load_skin("coarse"))


def test_channels_in_another_order_are_named(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "set")
    for path in copy.glob("*.h5"):
        with h5py.File(path, "a") as file:
            names = list(file.attrs["channels"])
            file.attrs["channels"] = [names[1], names[0], *names[2:]]
    with pytest.raises(ValueError, match="order"):
        load_arrays(copy)


def test_an_empty_part_is_named(folder):
    arrays = load_arrays(folder)
    unlabelled = np.flatnonzero(~arrays.labelled)
    with pytest.raises(ValueError, match="no labelled time steps"):
        arrays.rows(unlabelled, labelled=True)
    with pytest.raises(ValueError, match="no time steps"):
        arrays.rows([])


def test_network_counts_in_a_step_of_mujoco(weights):
    spec = mujoco.MjSpec.from_string(
        """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><site name="tip"/>
        <body name="ball" mocap="true" pos="-0.009 -0.0130 0">
        <geom name="ball" type="sphere" size="0.0035"/></body>
        </worldbody></mujoco>"""
    )
    readings = {"signal": "learned", "weights": str(weights), "noise": False}
    handle = biotac_mj.attach(
        spec, site="tip", skin="coarse", tier="condensed", coupling="one-way", readings=readings
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    np.testing.assert_allclose(handle.read(data, "electrodes"), REST_COUNTS["1"], atol=1)
    for k in range(6):
        data.mocap_pos[0, 1] = -0.0115 + 2e-4 * k
        mujoco.mj_step(model, data)
    u = handle.vert_xpos(model, data) - load_skin("coarse").vert
    assert np.abs(u).max() > 3e-4
    skin = load_skin("coarse")
    network = PhysicsReadings(skin, film=NetworkFilm(skin, weights), noise=False)
    state = np.zeros(network.nstate)
    network.reset(state)
    for k in range(6):
        network.advance(state, 0.01 * k, 0.01, load_skin("coarse").vert + u, 0.0)
    got = handle.read(data, "electrodes")
    assert np.abs(got - REST_COUNTS["1"]).max() > 20
    change = np.abs(network.readings(state)["electrodes"] - got)
    assert (
        change.max() <= 0.15 * np.abs(got - REST_COUNTS["1"]).max() + 1
    )  # the held last step against a motion: nearly the same skin
    with pytest.raises(ValueError, match="weights"):
        biotac_mj.attach(spec, site="tip", prefix="b_", readings={"weights": "a"})


def test_attach_takes_the_file_of_a_model(weights):
    spec = mujoco.MjSpec.from_string('<mujoco><worldbody><site name="tip"/></worldbody></mujoco>')
    handle = biotac_mj.attach(spec, site="tip", skin="coarse", signal=str(weights))
    assert handle.config.readings == "learned" and handle.config.options["readings"]["weights"] == str(
        weights
    )


def test_a_batch_takes_the_file_of_a_model(weights):
    """By the argument that `attach` has, as by `readings`; not by both."""
    from biotac_mj import batch
    from biotac_mj.learning.serve import LearnedBatchFilm

    spec = mujoco.MjSpec.from_string('<mujoco><worldbody><site name="tip"/></worldbody></mujoco>')
    batch.add(spec, site="tip", skin="coarse", coupling="one-way")
    model = spec.compile()
    for given in ({"signal": str(weights)}, {"readings": {"signal": str(weights)}}):
        made = batch.make(model, 2, "cpu", skin="coarse", **given)
        assert isinstance(made.senses.film, LearnedBatchFilm)
    for given, text in (
        ({"signal": "telepathy"}, "unknown signal 'telepathy'"),
        ({"signal": "learned", "readings": {"signal": "physics"}}, "signal is 'learned' and readings has"),
        ({"signal": "learned", "readings": False}, "readings is False: leave signal"),
    ):
        with pytest.raises(ValueError, match=text):
            batch.make(model, 2, "cpu", skin="coarse", **given)


def test_a_batch_gives_what_single_sensors_give(weights):
    import warp as wp

    skin = load_skin("coarse")
    u = np.stack([dent(skin, [x, -7e-3, 0], 0.6e-3, 2e-3, 0) for x in (-12e-3, -9e-3, -5e-3)])
    film = LearnedBatchFilm(skin, 3, "cpu", weights=weights)
    x = wp.array(np.ascontiguousarray((skin.vert + u).transpose(1, 0, 2)), dtype=wp.vec3d)
    film.solve_film(x, wp.array(np.array([1, 0, 1], np.int32), dtype=int))
    one = NetworkFilm(skin, weights)
    got = film.impedance.numpy()
    np.testing.assert_allclose(got[1], film.rest)
    change = one.model.log_change(torch.tensor(1e3 * u, dtype=torch.float32)).double().numpy()
    np.testing.assert_allclose(got[[0, 2]], (film.rest * np.exp(change))[[0, 2]], rtol=1e-5)


def test_few_touches_bring_another_sensors_gains(weights, tmp_path):
    """A sensor of other gains, by network and film; what is written reads like it."""
    import biotac_mj
    from biotac_mj.effects.amended import Model, amend
    from biotac_mj.sensor.presets import read_sensor

    other = make_set(tmp_path / "other", count=24, seed=5, gain=1.4)
    file = tmp_path / "sensor.yaml"
    found = evaluate_new_sensor(other, weights, tmp_path / "new.json", touches=(0, 5), draws=3, sensor=file)
    table = found["median_rms_counts"]
    assert table["weights with mixing"]["5"] < 0.5 * table["weights"]["0"] < table["no change"]["0"]
    assert table["weights with gains"]["5"] < 0.5 * table["weights"]["0"]
    sensor = read_sensor(amend(Model(None, None, None, None, None), file).sensor)
    with pytest.raises(ValueError, match="signal is 'latent_projection' and .*sensor.yaml has 'physics'"):
        amend(Model(None, None, None, None, None, "latent_projection"), file)
    with biotac_mj.data.TactileSet(other) as data:
        rest = data["measured_counts"][data.start][:, :19]
    np.testing.assert_allclose(sensor.rest, rest[data.labelled].mean(0), atol=1e-3)
    assert np.shape(sensor.mixing) == (19, 19)
    assert json.loads((tmp_path / "new.json").read_text())["adapted"] == "mixing"
    assert 0.5 < found["largest_force"] < 1.5  # deepest of the touches in mm, as make_set has it


@pytest.mark.parametrize("seed", range(4))
def test_a_new_sensor_is_changed_no_more_than_it_differs(seed):
    """By nothing, gains (or a mixing as near to them) or cross-talk; and what only weak touches show, a rise
    that ends at 60 counts, does not change strong ones."""
    from biotac_mj.data.generation.synthetic_sensor import SensorVariation

    rng, mixing = np.random.default_rng(seed), SensorVariation.draw(seed).mixing
    owner = np.repeat(np.arange(40), 12)
    x = (rng.normal(size=(40, 19)) * np.exp(rng.normal(5, 0.8, (40, 1))))[owner]
    x *= rng.uniform(0, 1, (480, 1)) * (1 + 0.2 * rng.normal(size=x.shape))
    noise, gain = 4 * rng.normal(size=x.shape), np.diag(np.diag(mixing))
    for matrix, names in ((np.eye(19), ["no change"]), (gain, ["gains", "mixing"]), (mixing, ["mixing"])):
        got, fitted = simplest_mixing(x, x @ matrix.T + noise, owner)
        assert got in names and np.abs(fitted - matrix).max() < 0.02
    got, fitted = simplest_mixing(x, x + 60 * np.tanh(x / 60) + noise, owner)
    assert got == "no change" and np.array_equal(fitted, np.eye(19))


@pytest.mark.parametrize("touches", [5, 20])
def test_a_mixing_of_few_touches_beats_gains(touches):
    """Gains, cross-talk and common coupling of sensors drawn at random, touches of all sizes and places,
    noise of 4 counts; judged on 40 other touches."""
    from biotac_mj.data.generation.synthetic_sensor import SensorVariation

    error = np.zeros(3)
    for seed in range(8):
        rng, mixing = np.random.default_rng(seed), SensorVariation.draw(seed).mixing
        owner = np.repeat(np.arange(touches + 40), 12)
        basis = rng.normal(size=(touches + 40, 19)) * np.exp(rng.normal(5, 0.8, (touches + 40, 1)))
        x = basis[owner] * rng.uniform(0, 1, (len(owner), 1)) * (1 + 0.2 * rng.normal(size=(len(owner), 19)))
        y = x @ mixing.T + 4 * rng.normal(size=x.shape)
        seen = owner < touches
        fits = np.eye(19), np.diag(fit_gains(x[seen], y[seen])), fit_mixing(x[seen], y[seen], owner[seen])
        error += [np.sqrt(((x[~seen] @ m.T - y[~seen]) ** 2).mean()) for m in fits]
    assert error[2] < error[1] < error[0]
    assert touches == 5 or error[2] < 0.6 * error[1]


def test_two_touches_teach_one_gain_alone():
    rng = np.random.default_rng(0)
    x, owner = rng.normal(size=(20, 38)), np.repeat([0, 1], 10)
    got = fit_mixing(x, 1.4 * x[:, :19], owner)
    np.testing.assert_allclose(got, 1.4 * np.eye(19, 38), atol=1e-6)
    with pytest.raises(ValueError, match="the same rows"):
        fit_mixing(x, x[:3, :19], owner)


def test_contact_patch_finds_the_touch(trained, tmp_path):
    skin = load_skin("coarse")
    rest = REST_COUNTS["2"]
    z0 = np.log(4095 / rest - 1)
    places = np.array([[-12e-3, -6.5e-3, 0], [-6e-3, -6.5e-3, 3e-3]])
    rows = [rest] + [
        4095 / (1 + np.exp(z0 + log_change(skin, dent(skin, p, 0.8e-3, 2.5e-3, 0)))) for p in places
    ]
    source = tmp_path / "counts.txt"
    np.savetxt(source, rows, "%.3f")
    one = contact_patch(
        source, tmp_path / "out", skin="coarse", weights=trained / "inverse-trajectory.safetensors", row=2
    )
    saved = json.loads((tmp_path / "out/contact.json").read_text())
    centre = np.array(saved["centre_mm"][1:]) * 1e-3
    assert (
        np.linalg.norm(centre - places, axis=1).max() < 4e-3
        and centre[0, 0] < centre[1, 0]
        and centre[1, 2] > centre[0, 2]
    )
    assert one["row"] == 2 and (tmp_path / "out/contact.png").stat().st_size > 20_000
    with pytest.raises(ValueError, match="--row 9"):
        contact_patch(source, tmp_path / "out", row=9)
    with pytest.raises(ValueError, match="raw counts 0..4095 are needed"):
        log_change_of(np.full((1, 19), np.nan), rest)
    with pytest.raises(ValueError, match="give the same electrodes of both"):
        log_change_of(np.zeros((1, 18)), rest)


@pytest.fixture(scope="module")
def dome(tmp_path_factory):
    """A pad of six electrodes, one of them without a mirror image."""
    folder = tmp_path_factory.mktemp("pads") / "dome"
    places = [*SIX[:3], [3.5, 2.0, -4.4], *SIX[4:]]
    new_design(folder, PadShape(dome=(9.0, 9.0, 9.0), core=(6.0, 6.0, 6.0), edge=2.4), places, GROUND)
    return str(folder)


@pytest.mark.parametrize("skin", [pytest.param("biotac_sp/coarse", marks=pytest.mark.slow), "dome"])
def test_networks_of_other_designs_are_trained_and_serve_them(skin, dome, tmp_path):
    skin = dome if skin == "dome" else skin
    geometry = load_skin(skin)
    assert (mirror_order(geometry) is None) == (skin == dome)
    folder = make_set(tmp_path / "set", count=40, labelled=30, skin=skin)
    small = {"paper_steps": 3, "mesh_steps": 3, "mesh_points": 150, "mesh_factors": (2, 2)}
    small |= {"mesh_channels": (4, 4), "mesh_first": 4}
    config, out = LearningConfig(**dataclasses.asdict(SMALL) | small), tmp_path / "trained"
    train_all(folder, out, (0,), ("trajectory",), config, paper=True, progress=False)
    rows = evaluate_models(out)["splits"]["trajectory"]["models"]
    assert rows["tare"]["median"] > 2 * rows["local_taught"]["median"]
    assert rows["tare"]["median"] > 1.5 * rows["physics"]["median"]
    vert = geometry.vert + dent(geometry, geometry.vert[geometry.vert[:, 1].argmin()], 6e-4, 2e-3, 0.0)
    for weights in ("forward-trajectory", "latent_projection-trajectory"):
        film = NetworkFilm(geometry, out / f"{weights}.safetensors")
        assert film.impedance(vert).shape == film.rest.shape == (geometry.design.nelectrode,)
    counts = np.array(geometry.design.rests[0])
    found = estimate(counts[None] - 20, counts, geometry, out / "inverse-trajectory.safetensors")
    assert found.displacement.shape == (1, geometry.nvert, 3)
    with pytest.raises(ValueError, match="was trained with channels e1 .* is of BioTac .19 electrodes"):
        load_forward(out / "forward-trajectory.safetensors", load_skin("coarse"))


@pytest.mark.parametrize("with_force", [True, False])
def test_contact_patch_takes_the_touch_and_tells_of_a_warm_up(with_force, trained, tmp_path, capsys):
    """The touch is at row 20, the sensor warms up until the last one."""
    skin, rest = load_skin("coarse"), REST_COUNTS["2"]
    place = np.array([-12e-3, -6.5e-3, 0])
    z0 = np.log(4095 / rest - 1)
    counts = np.tile(rest.astype(float), (40, 1))
    counts[20] = 4095 / (1 + np.exp(z0 + log_change(skin, dent(skin, place, 0.8e-3, 2.5e-3, 0))))
    force = np.zeros((40, 3))
    force[20] = 0, 2, 0
    weights = trained / "inverse-trajectory.safetensors"
    for warm, name in ((0, "cold.csv"), (3, "warm.csv"))[0 if with_force else 1 :]:
        table = {f"e{i + 1}": counts[:, i] + warm * np.arange(40) for i in range(19)}
        table |= {"time": np.arange(40) / 10, "tdc": 2000 + np.arange(40)}
        table |= {f"F{axis}": force[:, i] for i, axis in enumerate("xyz") if with_force}
        head = ",".join(table)
        np.savetxt(tmp_path / name, np.stack(list(table.values()), 1), "%.6g", ",", header=head, comments="")
        words = f"learn predict {weights} {tmp_path / name} --skin coarse --out {tmp_path / 'out'}"
        assert cli.main(words.split()) == 0
        said = capsys.readouterr().out
        assert ("(recorded: 2.00 N)" in said) == with_force
        assert ("drift with TDC, by about 1" in said) == bool(warm), said
        if with_force:  # else what differs most from rest is the last row
            assert said.startswith("row 20: ")
    if with_force:
        assert cli.main([*words.split(), "--row", "-1"]) == 0
        assert "(recorded: 0.00 N)" in capsys.readouterr().out


def test_weak_nodes_are_no_part_of_a_patch():
    place = np.array([[0.0, 0, 0], [1e-3, 0, 0], [5e-3, 0, 0]])
    force = np.array([[1.0, 1.0, 0.1], [0, 0, 0]])
    centre = contact_centre(force, place)
    np.testing.assert_allclose(centre[0], [0.5e-3, 0, 0])  # the weak node is no part of the patch
    assert np.isnan(centre[1]).all()
    np.testing.assert_allclose(patch_overlap(np.array([[1.0, 0, 0]]), np.array([[1.0, 1.0, 0]])), [0.5])


def test_a_batch_of_mujoco_warp_shows_the_networks_counts(weights):
    pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")
    import warp as wp

    skin = load_skin("coarse")
    film = LearnedBatchFilm(skin, 2, "cpu", str(weights))
    acquisition = BatchAcquisition(film.rest, 2, noise=False)
    u = dent(skin, [-9e-3, -7e-3, 0], 0.6e-3, 2e-3, 0)
    x = wp.array(np.stack([skin.vert, skin.vert + u], axis=1), dtype=wp.vec3d)
    pressure = wp.zeros(2, dtype=wp.float64)
    for _ in range(3):
        film.solve_film(x, acquisition.find_due(0.01))
        acquisition.advance(0.01, film.impedance, film.valid, pressure)
    got = acquisition.state.numpy()[:, SAMPLED:SAMPLED_PDC]  # the held counts of the electrodes
    np.testing.assert_allclose(got[0], REST_COUNTS["1"], atol=1)
    z = film.impedance.numpy()
    np.testing.assert_allclose(got[1], 4095 / (z[1] / 1e4 + 1), atol=1)
    assert np.abs(got[1] - REST_COUNTS["1"]).max() > 20


def test_trained_weights_are_attached_as_they_are(trained, capsys):
    model = str(trained / "forward-trajectory.safetensors")
    spec = mujoco.MjSpec.from_string('<mujoco><worldbody><site name="tip"/></worldbody></mujoco>')
    assert biotac_mj.attach(spec, site="tip", skin="coarse", signal=model).config.readings == "learned"
    assert cli.main(["learn", "train", str(trained), "--out", "m.safetensors"]) == 2
    assert "holds trained networks: attach(signal=FILE)" in capsys.readouterr().err


def test_each_labelled_interaction_of_a_set_has_a_part(folder, tmp_path, capsys):
    assert cli.main(["learn", "train", str(folder), "--out", str(tmp_path / "r.safetensors")]) == 0
    said = capsys.readouterr().out
    with TactileSet(folder) as data:  # each labelled interaction has its part
        assert "place" in said and data.labelled.sum() == sum(
            map(int, re.findall(r"(\d+) (?:traj|held|more)", said))
        )
