"""Export to MuJoCo's form: MuJoCo alone reads it, and steps from one state to the next."""

import json

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biotac_mj import cli
from biotac_mj.data import Interaction, shard_path, write_shard

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
DT = 0.02


@pytest.fixture(scope="module")
def made():
    """Two interactions with two objects; the second is labelled, and nothing touches in its first row."""
    rng, out = np.random.default_rng(0), []
    for k, thing in enumerate(("sphere_7mm", "cube_14mm")):
        n, label = 5 + k, {}
        if k:
            label = {"measured_counts": rng.uniform(0, 4095, (n, 23))}
        columns = dict(
            wrench=rng.normal(size=(n, 6)),
            counts=rng.integers(0, 4096, (n, 23)),
            pac=rng.integers(0, 4096, (n, 22)),
            contact_pos=np.where(np.arange(n)[:, None] >= k, rng.normal(size=(n, 3)), np.nan),
            contact_depth=rng.random(n),
            converged=np.arange(n) != 3 * k,
            indenter_pos=np.cumsum(1e-3 * rng.normal(size=(n, 3)), axis=0),
            indenter_quat=Rotation.from_rotvec(0.3 * rng.normal(size=(n, 3))).as_quat(scalar_first=True),
        )
        time = 0.5 + DT * np.arange(n)
        out.append(Interaction(f"{k:03d}", thing, "press", "train", k, {}, time, **columns, **label))
    return out


@pytest.fixture(scope="module")
def exported(made, tmp_path_factory):
    folder = tmp_path_factory.mktemp("set")
    for number, one in enumerate(made):
        write_shard(shard_path(folder / "set", number), [one])
    words = ["data", "export", str(folder / "set"), "--form", "mujoco", "--quiet", "--out"]
    assert cli.main([*words, str(folder / "out")]) == 0
    return folder


def test_states_are_poses_and_lead_to_one_another(made, exported):
    """The model, its time step and the velocities: a step of MuJoCo is the next row."""
    index = json.loads((exported / "out" / "index.json").read_text())
    assert index["frame"].startswith("BioTac: tip at -x") and index["force"] == "of the object on the BioTac"
    assert index["state"] == STATE.name and [one["id"] for one in index["interactions"]] == ["000", "001"]
    for one, about in zip(made, index["interactions"], strict=True):
        model = mujoco.MjModel.from_xml_path(str(exported / "out" / about["model"]))
        data, states = mujoco.MjData(model), np.load(exported / "out" / f"{one.id}.npz")["state"]
        assert len(states) == about["rows"] == len(one.time)
        for k, state in enumerate(states):
            mujoco.mj_setState(model, data, state, STATE)
            mujoco.mj_forward(model, data)
            assert data.time == pytest.approx(one.time[k])
            np.testing.assert_allclose(data.body("object").xpos, one.indenter_pos[k], atol=1e-9)
            np.testing.assert_allclose(data.body("object").xquat, one.indenter_quat[k], atol=1e-9)
            assert data.ncon == 0
            if k + 1 < len(states):
                mujoco.mj_step(model, data)
                np.testing.assert_allclose(data.qpos[:3], one.indenter_pos[k + 1], atol=1e-6)
                turned = abs(data.qpos[3:] @ one.indenter_quat[k + 1])
                assert turned == pytest.approx(1, abs=1e-6)


def test_sensor_data_have_the_models_names(made, exported):
    for one in made:
        model = mujoco.MjModel.from_xml_path(str(exported / "out" / f"{one.object}.xml"))
        data, rows = mujoco.MjData(model), np.load(exported / "out" / f"{one.id}.npz")["sensordata"]
        for k, row in enumerate(rows):
            data.sensordata[:] = row
            np.testing.assert_array_equal(data.sensor("electrodes").data, one.counts[k, :19])
            np.testing.assert_array_equal(data.sensor("pac").data, one.pac[k])
            np.testing.assert_allclose(data.sensor("contact_force").data, -one.wrench[k], rtol=1e-6)
            np.testing.assert_allclose(data.sensor("contact_pos").data, one.contact_pos[k], rtol=1e-6)
            np.testing.assert_allclose(data.sensor("contact_depth").data, one.contact_depth[k], rtol=1e-6)
            assert np.isnan(data.sensor("contact_area").data).all()  # not in the set
        kept = np.load(exported / "out" / f"{one.id}.npz")["converged"]
        np.testing.assert_array_equal(kept, one.converged)


def test_measured_counts_are_exported(made, exported, capsys):
    words = ["data", "export", str(exported / "set"), "--form", "mujoco", "--quiet", "--out"]
    assert cli.main([*words, str(exported / "measured"), "--measured"]) == 0
    assert sorted(p.name for p in (exported / "measured").glob("*.npz")) == ["001.npz"]
    assert "note: 1 of 6 time steps of the set did not converge" in capsys.readouterr().out
    model = mujoco.MjModel.from_xml_path(str(exported / "measured" / "cube_14mm.xml"))
    data = mujoco.MjData(model)
    data.sensordata[:] = np.load(exported / "measured" / "001.npz")["sensordata"][2]
    np.testing.assert_allclose(data.sensor("electrodes").data, made[1].measured_counts[2, :19], rtol=1e-6)
    assert cli.main([*words, str(exported / "other"), "--rate", "50"]) == 2
    assert "--rate is of --form" in capsys.readouterr().err
