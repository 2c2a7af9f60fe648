"""`biotac data resimulate`: synthetic recordings of our own skin, whose deformations are known."""

import dataclasses
import json

import numpy as np
import pytest
from blocks import four_nodes
from made_up_plate import made_up_states

from biotac_mj import cli
from biotac_mj.data import TactileSet
from biotac_mj.data.generation.plan import plan_motions
from biotac_mj.data.generation.readings import read_motion
from biotac_mj.data.generation.simulate import simulate
from biotac_mj.data.schema import DISPLACEMENT_SCALE
from biotac_mj.geometry import load_skin
from biotac_mj.geometry.rigid import matrix, quaternion
from biotac_mj.geometry.skins import skin_reference
from biotac_mj.matching.fit import SIGNS
from biotac_mj.matching.response import Response
from biotac_mj.matching.states import frame
from biotac_mj.recordings import Recording, write
from biotac_mj.resimulation import fitted
from biotac_mj.resimulation.fitted import plate_path
from biotac_mj.resimulation.resimulate import ResimulateOptions, resimulate
from biotac_mj.resimulation.touch import biotac_poses, touches_of
from biotac_mj.sensor.channels import REST_COUNTS, counts_from_log_impedance, log_impedance
from biotac_mj.sensor.film import FilmConduction
from biotac_mj.skin import Material, SkinModel, SkinOptions

STEPS, REST = 12, 6
MOUNT = (0.01, -0.02, 0.03, *np.array([1.0, 0.3, -0.2, 0.1]) / np.linalg.norm([1.0, 0.3, -0.2, 0.1]))


SKIN, _ = skin_reference(four_nodes("coarse"))  # its file; a quarter of the work of ten nodes an element


@pytest.fixture(scope="module")
def truth():
    """A synthetic recording of two presses, the sensor's pose moving meanwhile, and the skin's fields."""
    model = SkinModel(load_skin(SKIN), Material())
    motions = plan_motions(model.geometry, "sphere_7mm", [[3, 6], [3, 7]], STEPS, ("press",))
    fields = simulate(model, "sphere_7mm", motions, time=np.arange(STEPS) / 20.0)
    film = FilmConduction(model.geometry)
    pos, mat, counts, pac = [], [], [], []
    for k, motion in enumerate(motions):
        at = motion.pos[0] - 1e-3 * np.arange(REST, 0, -1)[:, None] * motion.mat[0][:, 1]
        pos += [at, motion.pos]
        mat += [np.tile(motion.mat[0], (REST, 1, 1)), motion.mat]
        vert = fields.vert_xpos(model.geometry.vert, k)
        read = read_motion(film, vert, np.arange(STEPS) / 20.0, fields.pressure[k], k)
        counts += [np.tile(read.counts[0], (REST, 1)), read.counts]
        pac += [np.tile(read.pac[0], (REST, 1)), read.pac]
    pos, mat, counts = np.concatenate(pos), np.concatenate(mat), np.concatenate(counts)
    n = len(pos)
    angle = np.linspace(0, 1, n)
    base = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle, 0 * angle])
    place = np.column_stack([angle, -angle, 0 * angle])
    # world <- sensor's pose <- mount <- BioTac <- object
    turn = matrix(base) @ matrix(np.array(MOUNT[3:]))
    origin = place + matrix(base) @ MOUNT[:3]
    recording = Recording(
        np.arange(n) / 20.0,
        electrodes=np.rint(counts[:, :19]),
        pac=np.concatenate(pac),
        object_pos=origin + np.einsum("nij,nj->ni", turn, pos),
        object_quat=quaternion(turn @ mat),
        sensor_pos=place,
        sensor_quat=base,
        name="synthetic",
        object="sphere_7mm",
        source="synthetic",
    )
    return recording, pos, mat, fields


def test_poses_come_back_through_sensor_and_mount(truth):
    recording, pos, mat, _ = truth
    found, turn, notes = biotac_poses(recording, MOUNT)
    np.testing.assert_allclose(found, pos, atol=1e-12)
    np.testing.assert_allclose(turn, mat, atol=1e-9)
    assert not notes
    still = dataclasses.replace(recording, object_pos=None, object_quat=None)
    with pytest.raises(ValueError, match="no pose of the object: record object_pos, give --object-pose"):
        biotac_poses(still, MOUNT)


def test_forces_that_are_left_out_are_said(truth):
    """In the file's frame they are of no use to the set; in the BioTac frame they are taken."""
    recording, pos, _, _ = truth
    pushed = dataclasses.replace(recording, force=np.full(pos.shape, 0.5))
    said = {}
    for named in ("the file's", "BioTac"):
        one = dataclasses.replace(pushed, frame=named)
        touches, notes = touches_of(one, "sphere_7mm", MOUNT, None, 20.0, load_skin("coarse"))
        taken = np.concatenate([touch.wrench[:, :3] for touch in touches])
        said[named] = any("forces are in the file's frame" in note for note in notes)
        assert np.isfinite(taken).all() == (named == "BioTac")
    assert said == {"the file's": True, "BioTac": False}


@pytest.mark.slow
def test_processes_of_ray_make_the_same_set(truth, tmp_path):
    pytest.importorskip("ray")
    recording = truth[0]
    options = ResimulateOptions(object="sphere_7mm", mount=MOUNT, skin="coarse", batch=1)
    for out, ray in (("here", None), ("ray", "local")):
        assert resimulate(recording, tmp_path / out, options, 0, False, ray).made == 2
    for path in (tmp_path / "here").glob("shard-*.h5"):
        assert path.read_bytes() == (tmp_path / "ray" / path.name).read_bytes()


def test_a_recording_becomes_a_labelled_set_and_goes_on(truth, tmp_path, capsys):
    recording, _, _, fields = truth
    write(tmp_path / "rec.h5", [recording])
    words = ["data", "resimulate", str(tmp_path / "rec.h5"), "--skin", SKIN, "--batch", "1", "--workers", "0"]
    words += ["--out", str(tmp_path / "set"), "--quiet", "--mount", *map(str, MOUNT)]
    assert cli.main(words) == 0
    assert "2 touches" in capsys.readouterr().out
    shards = sorted((tmp_path / "set").glob("shard-*.h5"))
    with TactileSet(tmp_path / "set") as data:
        assert set(data.kind) == {"resimulated"} and data.labelled.all()
        one = data.interaction(1)
        n = len(one.time)
        assert n >= STEPS // 2 and one.measured_pac.shape == (n, 22)
        # the same skin along the same way: what it did then is what it does now
        begun = one.parameters["rows"][0] - STEPS - 2 * REST
        known = fields.displacement[1, begun : begun + n] * DISPLACEMENT_SCALE
        assert np.abs(known).max() > 2e-4
        assert np.abs(one.displacement[: len(known)] - known).max() < 0.02 * np.abs(known).max()
        changed = one.measured_counts[1:, :19] - one.measured_counts[0, :19]
        ours = one.counts[1:, :19] - one.counts[0, :19]
        assert np.abs(changed).max() > 150 and np.sqrt(((changed - ours) ** 2).mean()) < 10  # noise of both
    before = [path.read_bytes() for path in shards]
    shards[0].unlink()
    assert cli.main(words) == 0
    assert "1 shards made" in capsys.readouterr().out
    assert [path.read_bytes() for path in shards] == before
    report = json.loads((tmp_path / "set" / "resimulate.json").read_text())
    assert report["agreement"] > 0.98 and report["interactions"] == 2


def test_what_cannot_be_resimulated_is_named(truth, tmp_path):
    recording = truth[0]
    far = dataclasses.replace(recording, object_pos=recording.object_pos + [0.1, 0, 0])

    def refused(text, one, **options):
        with pytest.raises(ValueError, match=text):
            resimulate(one, tmp_path / "o", ResimulateOptions(skin="coarse", **options), progress=False)

    refused("never meets the skin", far, mount=MOUNT)
    few = r"2 have fewer than 8 rows at 4 Hz, \d at most: take a higher --at-most, or log more [a-z ]+$"
    refused(few, recording, mount=MOUNT, rate=4.0)
    refused("give --object, one of", dataclasses.replace(recording, object="cork"), mount=MOUNT)
    refused("a match needs the force", recording, poses="fitted")
    refused("is no pose", recording, mount=(1.0, 2.0))
    refused("unknown poses", recording, poses="guessed")
    assert not (tmp_path / "o").exists()


@pytest.mark.slow
def test_a_hand_pressed_plate_is_found_from_force_and_electrodes(monkeypatch):
    """A made-up sensor whose table is known: poses, rest and force of what its recording was made of."""
    states, log_z = made_up_states()
    monkeypatch.setattr(fitted, "plate_states", lambda *args, **kwargs: states)
    monkeypatch.setattr(fitted, "log_changes", lambda *args: log_z)
    n, modulus = 1200, 1e6
    time = np.arange(n) / 100
    state = np.column_stack(
        [0.25 + 0.2 * np.sin(time), 0.4 * np.sin(0.7 * time), 0.5 * np.sin(1.1 * time), 0 * time]
    )
    pressing = 3 + 2 * np.sin(2 * time)
    pressing[500:600] = 0.0  # two presses
    value, _ = Response(states, log_z).at_load(pressing / modulus)(state, False)
    rest = log_impedance(REST_COUNTS["2"])
    force = np.column_stack([value[:, 19:] * modulus, pressing]) @ np.linalg.inv(SIGNS)
    counts = np.rint(counts_from_log_impedance(rest + value[:, :19]))
    one = Recording(time, electrodes=counts, force=force, name="synthetic", source="synthetic")
    geometry = load_skin("coarse")
    found, material, notes = fitted.fitted_touches(
        one, geometry, Material(), SkinOptions(), rate=50.0, block=4.0, progress=False
    )
    assert len(found) == 4 and any("neither was measured" in note for note in notes)
    assert material.youngs_modulus == pytest.approx(modulus, rel=0.1)
    outer = geometry.vert[np.unique(geometry.outer_face)]
    for touch in found:
        first, last = touch.motion.parameters["rows"]
        rows = np.searchsorted(one.time, touch.time[1:] - 1e-9)
        assert rows[0] == first and rows[-1] == last and touch.time[-1] - touch.time[0] < 4.1
        assert np.abs(touch.counts[0, :19] - counts_from_log_impedance(rest)).max() < 60
        inwards = touch.motion.mat[1:, :, 1]
        wanted = np.array([frame(*angles)[2] for angles in state[rows, :2]])
        assert np.median(np.degrees(np.arccos(np.clip((inwards * wanted).sum(1), -1, 1)))) < 3
        np.testing.assert_allclose(-(touch.wrench[1:, :3] * inwards).sum(1), pressing[rows], atol=1e-3)
        # how deep the plate is, is what the table has for that force (here as much as the load itself)
        sunk = (touch.motion.pos[1:] * inwards).sum(1) - (inwards @ outer.T).min(1)
        np.testing.assert_allclose(sunk, pressing[rows] / material.youngs_modulus, rtol=0.05, atol=1e-7)


def test_a_plate_rolls_without_sliding():
    """Where the plate touches, its own material stands still from row to row, but for the drag."""
    geometry = load_skin("coarse")
    n = 40
    state = np.column_stack([np.linspace(0.1, 0.4, n), np.linspace(-0.3, 0.2, n), np.zeros(n), np.zeros(n)])
    depth = np.full(n, 1e-3)
    pos, mat, axes = plate_path(geometry, state, depth)
    outer = geometry.vert[np.unique(geometry.outer_face)]
    for k in range(1, n):
        inwards = axes[k, 2]
        np.testing.assert_allclose(mat[k][:, 1], inwards, atol=1e-12)
        assert (pos[k] @ inwards) == pytest.approx((outer @ inwards).min() + 1e-3)
        here = outer[(outer @ inwards).argmin()]
        moved = pos[k] + mat[k] @ mat[k - 1].T @ (here - pos[k - 1]) - here
        assert np.linalg.norm(moved - (moved @ inwards) * inwards) < 2e-4
    assert np.linalg.norm(pos[-1] - pos[0]) > 1e-3
    state[:, 2] = np.linspace(0, 0.5, n)  # dragged along by half its depth
    other, _, _ = plate_path(geometry, state, depth)
    assert (other[-1] - pos[-1]) @ axes[-1, 0] == pytest.approx(5e-4, rel=0.2)
