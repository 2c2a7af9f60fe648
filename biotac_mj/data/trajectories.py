"""Export to MuJoCo's own format: a model for each object, and for each interaction the states and sensor data
for `mujoco.mj_setState`, `mujoco.rollout` and the viewer.

The models do not need this package. The BioTac in them is rigid and there are no collisions: states are for
playback. The skin's nodes stay in HDF5."""

import json
import pathlib
import re
import shutil

import mujoco
import numpy as np
import tqdm

from ..files import replacing
from ..geometry.design import BIOTAC
from ..press.indenter import add_indenter
from ..sensor.channels import CHANNELS, NELECTRODE, NPAC
from .lerobot import interactions_to_export
from .objects import make_object

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
_FOLDER = pathlib.Path(__file__).parents[1]
_MESHES = "core", "nail", "clamp"
_CONTACT = {"contact_pos": 3, "contact_normal": 3, "contact_depth": 1, "contact_area": 1}
_TIMESTEP = 1e-2  # [s] of models whose set has one row per interaction


def export_mujoco(
    data: "TactileSet",  # noqa: F821 - of the store, which opens files
    out: pathlib.Path | str,
    counts: str = "counts",
    progress: bool = True,
) -> pathlib.Path:
    """Writes the folder `out` (built under another name, then renamed): OBJECT.xml with assets/,
    INTERACTION.npz and index.json.

    A model has the BioTac at the world's origin, and the object on a free joint "object". An .npz has `state`
    (n, nstate) of mjSTATE_FULLPHYSICS (time, qpos, qvel) and `sensordata` (n, nsensordata) with the model's
    sensors: electrodes (19), pdc, pac (22), tac, tdc [counts], contact_force (6, of the object on the BioTac,
    in its frame, the torque about its origin: minus the set's `wrench`) [N, N m], contact_pos (3) [m],
    contact_normal (3), contact_depth [m], contact_area [m^2]. NaN: missing, or no contact. Velocities are
    differences of the poses. If the set has it, `converged` (n,) is False where the skin kept its last good
    state.

    Args:
      data: TactileSet with poses.
      counts: "counts", or "measured_counts" for those interactions that have measured ones.

    Raises:
      ValueError: no poses or counts in the set, nothing to export, an existing folder, or another design than
        the BioTac, whose model this is.
    """
    out = pathlib.Path(out)
    if data.design != BIOTAC:
        raise ValueError(
            f"{data.path} is of a {data.design.title}, and the exported model is a {BIOTAC.title}: export it "
            "as a LeRobotDataset, --form lerobot"
        )
    chosen = interactions_to_export(data, out, counts, ("indenter_pos", "indenter_quat"))
    with replacing(out, folder=True) as building:
        (building / "assets").mkdir()
        for mesh in _MESHES:
            shutil.copy(_FOLDER / "assets" / f"{mesh}.obj", building / "assets")
        models, index = {}, []
        for i in tqdm.tqdm(
            chosen, desc="export", unit="interaction", disable=not progress or None, leave=False
        ):
            thing, rows = str(data.object[i]), np.arange(data.start[i], data.stop[i])
            if thing not in models:
                file = re.sub(r"[^\w.-]+", "_", thing) + ".xml"
                models[thing] = file, _write_model(thing, _timestep(data, rows), building / file)
            file, model = models[thing]
            arrays = {"state": _states(model, data, rows), "sensordata": _sensors(model, data, rows, counts)}
            arrays |= {name: data[name][rows] for name in ("converged",) if name in data.columns}
            np.savez_compressed(building / f"{data.id[i]}.npz", **arrays)
            about = {"id": str(data.id[i]), "model": file, "object": thing, "kind": str(data.kind[i])}
            index.append(about | {"split": str(data.split[i]), "rows": len(rows)})
        about_set = {"state": STATE.name, "counts": counts, "versions": data.versions, "interactions": index}
        about_set |= {"frame": data.frame, "force": "of the object on the BioTac"}
        (building / "index.json").write_text(json.dumps(about_set, indent=1) + "\n", encoding="utf-8")
    return out


def _timestep(data, rows):
    """Median interval of the rows [s], for playback at their speed."""
    return float(np.median(np.diff(data["time"][rows]))) if len(rows) > 1 else _TIMESTEP


def _write_model(thing, timestep, path):
    """The BioTac and an object, as MJCF; the compiled model."""
    spec = mujoco.MjSpec.from_file(str(_FOLDER / "mjcf" / "biotac.xml"))
    spec.modelname, spec.option.timestep, spec.option.gravity = f"biotac and {thing}", timestep, np.zeros(3)
    spec.delete(spec.sensor("status"))
    for name, width in _CONTACT.items():
        sensor = spec.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_USER, dim=width)
        sensor.objtype, sensor.objname = mujoco.mjtObj.mjOBJ_SITE, "frame"
        sensor.needstage = mujoco.mjtStage.mjSTAGE_VEL
    body = spec.worldbody.add_body(name="object")
    # the centre of mass is at the pose's origin, so that velocities are those of the poses
    body.mass, body.inertia, body.ipos, body.explicitinertial = 1.0, [1e-3] * 3, np.zeros(3), True
    body.add_freejoint(name="object")
    add_indenter(spec, body, make_object(thing), rgba=[0.9, 0.6, 0.2, 0.5])
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    model = spec.compile()
    text = re.sub(r'meshdir="[^"]*"', 'meshdir="assets"', spec.to_xml())
    path.write_text(text, encoding="utf-8")
    return model


def _states(model, data, rows):
    """(n, nstate) of the object's poses."""
    physics, time = mujoco.MjData(model), data["time"][rows]
    qpos = np.column_stack([data["indenter_pos"][rows], data["indenter_quat"][rows]])
    qvel = np.zeros((len(rows), model.nv))
    for k in range(len(rows) - 1):
        mujoco.mj_differentiatePos(model, qvel[k], time[k + 1] - time[k], qpos[k], qpos[k + 1])
    states = np.zeros((len(rows), mujoco.mj_stateSize(model, STATE)))
    for k, state in enumerate(states):
        physics.time, physics.qpos[:], physics.qvel[:] = time[k], qpos[k], qvel[k]
        mujoco.mj_getState(model, physics, state, STATE)
    return states


def _sensors(model, data, rows, counts):
    """(n, nsensordata) in the order of the model."""
    prefix = "measured_" if counts.startswith("measured") else ""
    read = data[counts][rows]
    columns = {"electrodes": read[:, :NELECTRODE]}
    columns |= {name: read[:, NELECTRODE + k, None] for k, name in enumerate(CHANNELS[NELECTRODE:])}
    if f"{prefix}pac" in data.columns:
        columns["pac"] = data[f"{prefix}pac"][rows]
    elif NPAC > columns["pac"].shape[1]:  # the set has the latest value only
        columns["pac"] = np.column_stack([np.full((len(rows), NPAC - 1), np.nan), columns["pac"]])
    if f"{prefix}wrench" in data.columns:
        columns["contact_force"] = -data[f"{prefix}wrench"][rows]
    for name, width in _CONTACT.items():
        if name in data.columns:
            columns[name] = np.reshape(data[name][rows], (len(rows), width))
    out = np.full((len(rows), model.nsensordata), np.nan)
    for i in range(model.nsensor):
        name, begin = model.sensor(i).name, model.sensor_adr[i]
        if name in columns:
            out[:, begin : begin + model.sensor_dim[i]] = columns[name]
    return out
