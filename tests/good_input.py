"""One valid file of every kind that a verb reads, small, under the names that `test_bad_input` uses."""

import dataclasses
import json
import shutil

import h5py
import numpy as np
from learning_set import make_set
from meshing import write_obj

from biotac_mj.calibration import plan_shear, write_indentation
from biotac_mj.discrepancy.trajectories.model.simulator import Simulator
from biotac_mj.effects.catalogue import by_id
from biotac_mj.geometry import load_skin
from biotac_mj.learning.weights import shipped
from biotac_mj.press.record import write_skin
from biotac_mj.recordings.formats.text import RUPPEL as RUPPEL_COLUMNS
from biotac_mj.sensor.channels import REST_COUNTS

ROWS = 420  # of recordings: few are too few


def make_files(folder, press):
    """Writes them all into the folder.

    Args:
      press: a PressRecord.
    """
    rng = np.random.default_rng(0)
    skin = load_skin("coarse")
    skin.save(folder / "skin.npz")
    write_skin(press, folder / "press.h5")
    way = plan_shear(skin="coarse")
    force = np.column_stack([0 * way.time, -way.time, 0 * way.time])
    write_indentation(dataclasses.replace(way, force=force), folder / "way.csv")
    make_set(folder / "set", count=4, steps=8)
    (folder / "set" / "shard-00000.h5").rename(folder / "shard.h5")
    shutil.rmtree(folder / "set")
    _recordings(folder, rng)
    relaxation = by_id("relax")
    Simulator(effects=[(relaxation, relaxation.default())], intervals={}).save(folder / "sensor.yaml")
    make_mesh(folder / "mesh", skin)
    write_obj(folder / "ball.obj", press.indenter_vert, press.indenter_face)
    for name, content in (("material", {"friction": 0.5}), ("options", {"skin": {"samples": 2}})):
        (folder / f"{name}.json").write_text(json.dumps(content))
    (folder / "config.json").write_text(json.dumps({"steps": 10}))
    np.save(folder / "modulus.npy", np.ones(skin.nelem))
    for name in ("inverse", "forward"):
        shutil.copy(shipped(name), folder / f"{name}.safetensors")
    _trained(folder / "trained", rng)


def _recordings(folder, rng):
    rest = REST_COUNTS["1"]
    touch = np.clip(np.sin(np.arange(ROWS) / 20), 0, 1)
    counts = np.rint(rest - 200 * touch[:, None] + rng.normal(0, 2, (ROWS, 19)))
    force = np.column_stack([0 * touch, -touch, 0.1 * touch]) + rng.normal(0, 0.01, (ROWS, 3))
    np.savetxt(folder / "electrodes.txt", counts, "%.0f")
    np.savetxt(folder / "force.txt", force, "%.4f")
    np.savetxt(folder / "tdc.txt", np.full(ROWS, 2000), "%.0f")
    place = np.cumsum(rng.normal(0, 1e-5, (ROWS, 3)), 0)
    with h5py.File(folder / "nvidia.hdf5", "w") as file:
        for name, value in (("electrode_vals", counts), ("contact_loc", place), ("force_vec", force)):
            file[f"{name}/data"] = value
        file["indenter_type/data"] = np.zeros(ROWS)
    column = dict.fromkeys(RUPPEL_COLUMNS, np.full(ROWS, 2000.0))
    column |= {"time": 0.01 * np.arange(ROWS)}
    column |= {f"p{axis}": value for axis, value in zip("xyz", place.T)}
    column |= {f"f{axis}": value for axis, value in zip("xyz", force.T)}
    column |= {f"e{i + 1}": value for i, value in enumerate(counts.T)}
    rows = np.column_stack([column[name] for name in RUPPEL_COLUMNS])
    np.savetxt(folder / "ruppel.csv", rows, "%.6g", ",", header=",".join(RUPPEL_COLUMNS), comments="")


def make_mesh(folder, skin):
    folder.mkdir()
    corner, elem = np.unique(skin.elem[:, :4], return_inverse=True)
    lines = [f"v {x:.9g} {y:.9g} {z:.9g} 1" for x, y, z in skin.vert[corner]]
    lines += [f"t {a} {b} {c} {d}" for a, b, c, d in elem.reshape(-1, 4)]
    (folder / "skin.tet").write_text("\n".join(lines) + "\n")
    for part in ("core", "nail", "clamp"):
        write_obj(folder / f"{part}.obj", getattr(skin, f"{part}_vert"), getattr(skin, f"{part}_face"))


def _trained(folder, rng):
    """What `biotac learn train` leaves, of made-up predictions."""
    folder.mkdir()
    n = 120
    truth = rng.normal(0, 50, (n, 19)).astype(np.float32)
    content = {
        "truth": truth,
        "tare": np.full((n, 19), 2000, np.float32),
        "time": np.tile(np.arange(6) / 20, n // 6),
        "owner": np.arange(n) // 6,
        "object": np.full(n, b"sphere_7mm"),
        "test": np.arange(n) >= n // 2,
    }
    content |= {
        f"predicted_{name}": (truth + rng.normal(0, 5, (n, 19))).astype(np.float16)
        for name in ("tare", "linear", "physics", "pod_mlp")
    }
    np.savez(folder / "trajectory-0.npz", **content)
    report = {
        "split": "trajectory",
        "seed": 0,
        "settings": {},
        "set": "set",
        "interactions": 20,
        "labelled": 20,
        "device": "cpu",
        "mesh": {"pod": {"all": {"mean": 0.1, "moved": 0.2}, "objects": {}}},
        "inverse": {"pod_inverse_taught": {"mean": 0.1, "moved": 0.2}},
        "seconds": {"pod_mlp": 1.0},
    }
    (folder / "trajectory-0.json").write_text(json.dumps(report))
