"""The paper's networks as they ship: on any skin, in tasks, steps, batches and sets, and back to the skin."""

import json

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")

import mujoco  # noqa: E402
from learning_set import dent  # noqa: E402

import biotac_mj  # noqa: E402
from biotac_mj import cli  # noqa: E402
from biotac_mj.geometry import load_skin  # noqa: E402
from biotac_mj.learning.networks.points import SkinPoints  # noqa: E402
from biotac_mj.learning.patch import estimate  # noqa: E402
from biotac_mj.learning.serve import LearnedBatchFilm, NetworkFilm  # noqa: E402
from biotac_mj.learning.training.local import counts_change  # noqa: E402
from biotac_mj.learning.weights import load_forward, load_inverse, shipped  # noqa: E402
from biotac_mj.sensor.channels import REST_COUNTS  # noqa: E402

NAME = "latent_projection"
SKINS = ("coarse", "default")


@pytest.fixture(scope="module")
def points():
    return SkinPoints.choose(60, (2, 2), "coarse")


def pressed(skin, x=-9e-3, depth=0.8e-3):
    """(nvert, 3) [m] of a dent in the pad."""
    return dent(skin, [x, -7e-3, 0], depth, 2e-3, 0)


@pytest.mark.parametrize("name", SKINS)
def test_points_read_linear_fields_of_every_skin(points, name):
    skin = load_skin(name)
    slope = np.array([[0.3, -0.1, 0.2], [0, 0.5, 0.1], [0.1, 0, -0.4]])
    off = np.abs(points.reading(skin) @ (skin.vert @ slope) - points.place @ slope)
    assert off.max() < 1e-4 and np.median(off) < 5e-6  # [m] where meshes of one wall differ
    back = points.spreading(skin) @ (points.place @ slope) - skin.vert @ slope
    assert np.median(np.abs(back)) < 1e-5


def test_points_survive_their_arrays(points):
    again = SkinPoints.of_arrays(points.arrays(), "coarse")
    assert len(again.levels) == len(points.levels) == 3
    for a, b in zip(again.levels, points.levels):
        assert abs(a.laplacian - b.laplacian).max() == 0
        assert (a.keep is None) == (b.keep is None) and (a.keep is None or np.array_equal(a.keep, b.keep))
    assert abs(again.spread - points.spread).max() == 0


def test_another_shape_is_refused_by_name(points):
    import dataclasses

    skin = load_skin("coarse")
    moved = dataclasses.replace(skin, vert=skin.vert + [0, 3e-3, 0])
    with pytest.raises(ValueError, match="has not the shape of the network's, 'coarse', in"):
        points.reading(moved)
    with pytest.raises(ValueError, match="and skin .biotac_sp.* is of BioTac SP .24"):
        load_forward(shipped(NAME), load_skin("biotac_sp/coarse"))


def test_skins_at_rest_and_alike_pressed_read_alike():
    change = []
    for name in SKINS:
        skin = load_skin(name)
        model = load_forward(shipped(NAME), skin)
        u = torch.tensor(1e3 * np.stack([0 * skin.vert, pressed(skin)]), dtype=torch.float32)
        rest, d = model.log_change(u).numpy()
        assert np.abs(rest).max() < 1e-6
        change.append(d)
    assert np.abs(change[0]).max() > 0.2
    assert np.abs(change[0] - change[1]).max() < 0.15 * np.abs(change[0]).max()


def test_a_task_takes_it_without_another_argument():
    pytest.importorskip("dm_control", reason="needs dm_control: pip install 'biotac-mj[control]'")
    settings = {"biotac": {"signal": NAME}, "random": 0}
    env = biotac_mj.tasks.load("finger", "press", task_kwargs=settings)
    name = next(n for n in env.observation_spec() if n.endswith("electrodes"))
    rest = np.ravel(env.reset().observation[name])[-19:]
    assert np.abs(rest - REST_COUNTS["1"]).max() < 30  # noise of the observable
    step = env.step(np.zeros(env.action_spec().shape))
    assert np.isfinite(np.ravel(step.observation[name])).all()


def test_a_step_reads_what_the_network_says_of_its_skin():
    spec = mujoco.MjSpec.from_string(
        """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><site name="tip"/>
        <body name="ball" mocap="true" pos="-0.009 -0.0115 0">
        <geom name="ball" type="sphere" size="0.0035"/></body></worldbody></mujoco>"""
    )
    handle = biotac_mj.attach(
        spec, site="tip", skin="coarse", tier="condensed", coupling="one-way", signal=NAME,
        readings={"noise": False},
    )  # fmt: skip
    model = spec.compile()
    data = mujoco.MjData(model)
    for k in range(6):
        data.mocap_pos[0, 1] = -0.0115 + 2e-4 * min(k, 4)
        mujoco.mj_step(model, data)
    skin = load_skin("coarse")
    film = NetworkFilm(skin, NAME)
    wanted = 4095 / (film.impedance(handle.vert_xpos(model, data)) / 1e4 + 1)
    got = handle.read(data, "electrodes")
    assert np.abs(got - REST_COUNTS["1"]).max() > 20
    np.testing.assert_allclose(got, wanted, atol=1.5 + 0.1 * np.abs(wanted - REST_COUNTS["1"]).max())


def test_a_batch_reads_what_single_skins_read():
    import warp as wp

    skin = load_skin("default")
    u = np.stack([0 * skin.vert, pressed(skin, -12e-3), pressed(skin, -6e-3)])
    film = LearnedBatchFilm(skin, 3, "cpu", weights=NAME)
    x = wp.array(np.ascontiguousarray((skin.vert + u).transpose(1, 0, 2)), dtype=wp.vec3d)
    film.solve_film(x, wp.array(np.ones(3, np.int32), dtype=int))
    one = NetworkFilm(skin, NAME)
    wanted = [one.impedance(skin.vert + v) for v in u]
    np.testing.assert_allclose(film.impedance.numpy(), wanted, rtol=1e-4)


def test_a_set_holds_what_the_network_reads():
    from biotac_mj.data.generation import readings
    from biotac_mj.data.schema import DISPLACEMENT_SCALE

    skin = load_skin("coarse")
    depth = np.linspace(0, 0.8e-3, 8)
    moved = np.rint(np.stack([pressed(skin, depth=d) for d in depth]) / DISPLACEMENT_SCALE).astype(np.int16)
    readings.prepare_worker(skin, signal=NAME)
    found = readings.read_in_worker(moved, 0.05 * np.arange(8), np.zeros(8), 1)
    film = NetworkFilm(skin, NAME)
    last = skin.vert + moved[-1] * DISPLACEMENT_SCALE
    np.testing.assert_allclose(found.impedance[-1], film.impedance(last))
    np.testing.assert_allclose(found.impedance[0], film.rest, rtol=1e-6)


def _counts(forward, u):
    """Counts of the first sensor for displacements [mm]."""
    tare = torch.tensor(REST_COUNTS["1"], dtype=torch.float32)
    return (counts_change(forward.log_change(u), tare) + tare).numpy()


@pytest.mark.parametrize("name", SKINS)
def test_electrodes_say_where_the_skin_is_pressed(name):
    """Forward and back: the network's own readings of a dent, at two places of the pad."""
    skin = load_skin(name)
    forward, outer = load_forward(shipped(NAME), skin), np.unique(skin.outer_face)
    centre = []
    for x in (-14e-3, -7e-3):
        u = torch.tensor(1e3 * pressed(skin, x)[None], dtype=torch.float32)
        counts = _counts(forward, u).clip(0, 4095)
        found = estimate(counts, REST_COUNTS["1"], skin, NAME)
        assert found.displacement.shape == (1, skin.nvert, 3) and not found.is_force
        push = found.contact[0]
        assert 1e-4 < push.max() < 3e-3  # [m]
        inside = push > found.patch * push.max()
        centre.append((push * inside) @ skin.vert[outer, 0] / (push * inside).sum())
    assert centre[1] - centre[0] > 3e-3


def test_predict_takes_the_inverse_projection(tmp_path, capsys):
    skin = load_skin("coarse")
    forward = load_forward(shipped(NAME), skin)
    u = torch.tensor(1e3 * np.stack([0 * skin.vert, pressed(skin)]), dtype=torch.float32)
    table = _counts(forward, u).round().clip(0, 4095)
    head = "time," + ",".join(f"e{k + 1}" for k in range(19))
    rows = [f"{0.1 * k:.2f}," + ",".join(f"{v:.0f}" for v in row) for k, row in enumerate(table)]
    (tmp_path / "log.csv").write_text("\n".join([head, *rows]) + "\n")
    out = tmp_path / "out"
    assert cli.main(["learn", "predict", NAME, str(tmp_path / "log.csv"), "--skin", "coarse",
                     "--out", str(out)]) == 0  # fmt: skip
    assert "force" not in capsys.readouterr().out
    found = json.loads((out / "contact.json").read_text())
    assert found["force_N"] == [None, None] and found["area_mm2"][1] > 1 and (out / "contact.png").is_file()


def test_a_networks_film_takes_no_settings_of_the_film():
    from biotac_mj.data.generation.generate import GenerateOptions

    with pytest.raises(ValueError, match="a network replaces the film"):
        GenerateOptions(signal=NAME, options={"film": {"residual_film": 1e-4}})
    with pytest.raises(ValueError, match="unknown signal 'telepathy'"):
        GenerateOptions(signal="telepathy")
    spec = mujoco.MjSpec.from_string('<mujoco><worldbody><site name="tip"/></worldbody></mujoco>')
    with pytest.raises(ValueError, match="take signal='learned'"):
        biotac_mj.attach(spec, site="tip", signal=NAME, readings={"weights": "other.safetensors"})


def test_pointnets_weights_know_no_way_back(tmp_path, points):
    from biotac_mj.learning.training.config import LearningConfig
    from biotac_mj.learning.training.paper import make_pointnet
    from biotac_mj.learning.weights import save_points_model

    config = LearningConfig()
    path = tmp_path / "pointnet.safetensors"
    whole = SkinPoints(np.random.default_rng(0).permutation(load_skin("coarse").vert)[:200], points.levels,
                       points.spread)  # fmt: skip
    save_points_model(path, make_pointnet(whole, config, 19), whole, config, {})
    skin = load_skin("coarse")
    u = torch.tensor(1e3 * pressed(skin)[None], dtype=torch.float32)
    assert load_forward(path, skin).log_change(u).shape == (1, 19)
    with pytest.raises(ValueError, match="holds no inverse model"):
        load_inverse(path, skin)


def test_a_sensor_with_a_network_feels_heat():
    """A ball of steel cools the core beneath it as much as that of a sensor with a film."""
    cooling = []
    for signal, thermal in (("physics", {"ball": "steel"}), (NAME, {"ball": "steel"}), (NAME, None)):
        spec = mujoco.MjSpec.from_string(
            """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><site name="tip"/>
            <body name="ball" mocap="true" pos="-0.009 -0.0115 0">
            <geom name="ball" type="sphere" size="0.0035"/></body></worldbody></mujoco>"""
        )
        handle = biotac_mj.attach(
            spec, site="tip", skin="coarse", tier="condensed", coupling="one-way", signal=signal,
            readings={"noise": False}, thermal=thermal,
        )  # fmt: skip
        model = spec.compile()
        data = mujoco.MjData(model)
        for k in range(60):
            data.mocap_pos[0, 1] = -0.0115 + 2e-4 * min(k, 4)
            mujoco.mj_step(model, data)
        cooling.append(handle.read(data, "tac")[-1])
    assert cooling[0] == cooling[1] > cooling[2]
