"""`biotac data resimulate`: drives the skin along the touches of a recording and stores it with the sensor's
readings."""

import dataclasses
import hashlib
import json
import os
import pathlib

import numpy as np

from ..data.generation.generate import made_already
from ..data.generation.plan import Motion
from ..data.generation.readings import read_in_worker, readings_pool
from ..data.generation.simulate import describe, simulate
from ..data.objects import OBJECTS, make_object
from ..data.schema import Interaction
from ..data.splits import assign
from ..data.store import TactileSet, shard_path, write_shard
from ..fields import as_real, as_whole, check_choice
from ..files import write_json
from ..geometry import load_skin
from ..geometry.design import BIOTAC, SINGLES, check_nelectrode
from ..geometry.rigid import quaternion
from ..geometry.skins import shipped_skin
from ..recordings import Recording
from ..sensor.channels import log_impedance
from ..shards import Task, run_tasks
from ..skin import SkinModel
from ..skin.settings import plain, read_dict, read_settings
from .fitted import PLATE, fitted_touches
from .touch import Touch, touches_of

POSES = ("recorded", "fitted")


@dataclasses.dataclass(frozen=True)
class ResimulateOptions:
    """Settings of a resimulation. All except `device` are stored with the set and must be the same when an
    interrupted run continues.

    Attributes:
      object: what touches, see `data.objects.make_object`; None: as in the recording; fitted poses are those
        of a plate.
      poses: "recorded", or "fitted" from force and electrodes for a flat plate pressed by hand.
      mount: pose x y z [m], qw qx qy qz of the BioTac frame in the frame of the recorded sensor's pose.
      object_pose: of a stationary object without recorded pose.
      rate: [Hz] of the used rows, at most; rows are not interpolated.
      block: [s] of a touch with fitted poses.
      skin, material, options: of the simulated sensor, as in `biotac press`; skin None: the default of the
        recording's design.
      batch: touches per batch on a GPU; a shard holds one batch.
      seed: of the split and of the simulated noise. device: of Warp.
    """

    object: str | None = None
    poses: str = "recorded"
    mount: tuple = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    object_pose: tuple | None = None
    rate: float = 20.0
    block: float = 5.0
    skin: str | None = None
    material: str | dict = "default"
    options: str | dict | None = None
    batch: int = 8
    seed: int = 0
    device: str = "cpu"

    def __post_init__(self):
        object.__setattr__(self, "material", plain(self.material))
        if self.options is not None:
            object.__setattr__(self, "options", plain(read_dict(self.options, "options")))
        check_choice("unknown poses", self.poses, POSES)
        if self.poses == "fitted" and self.object not in (None, PLATE):
            raise ValueError(f"fitted poses are a plate's: leave --object {self.object} out")
        as_whole("batch", self.batch, 1)
        for name in ("rate", "block"):
            as_real(name, getattr(self, name), 0.0, above=True)


@dataclasses.dataclass(frozen=True)
class ResimulateReport:
    """Result of a run.

    Attributes:
      interactions, steps, nonconverged: in the set. made: shards made by this run.
      agreement: median over rows in contact of the correlation, over the electrodes, of simulated and
        measured change of ln Z; NaN without changes. force_rms: [N] between simulated and measured normal
        force, NaN without measurement. notes: assumptions and omissions.
    """

    interactions: int
    steps: int
    nonconverged: int
    made: int
    agreement: float
    force_rms: float
    notes: list[str]


def resimulate(
    recording: Recording,
    out: pathlib.Path | str,
    options: ResimulateOptions | None = None,
    workers: int | None = None,
    progress: bool = True,
    ray: str | None = None,
) -> ResimulateReport:
    """Makes a set in folder `out`, or completes it: an interaction of kind "resimulated" for each touch, with
    the simulated skin's columns and the measured ones.

    Args:
      recording: with poses, or with force for fitted ones. options: see ResimulateOptions.
      workers: processes for film and readings; None: number of cores, 0: this process.
      progress: whether to show a bar.
      ray: address of a Ray cluster, or "local": a task for each shard, with one core, one GPU if the device
        is one, and `workers` cores (None: 0). Touches are found in this process, on the CPU.

    Raises:
      ValueError: the recording lacks required data, the folder holds another set, or an invalid option.
    """
    options, out = options or ResimulateOptions(), pathlib.Path(out)
    if options.skin is None:
        options = dataclasses.replace(options, skin=shipped_skin(recording.design or BIOTAC))
    geometry = load_skin(options.skin)
    if recording.electrodes is not None:
        check_nelectrode(geometry.design, recording.electrodes.shape[1], recording.name)
    rubber, skin, modulus = read_settings(options.material, options.options)
    name = PLATE if options.poses == "fitted" else _object(recording, options.object)
    make_object(name)
    here = options.device if ray is None else "cpu"
    if options.poses == "fitted":
        touches, rubber, notes = fitted_touches(
            recording, geometry, rubber, skin, options.rate, options.block, progress=progress
        )
    else:
        model = SkinModel(geometry, rubber, skin, here, modulus=modulus)
        touches, notes = touches_of(
            recording,
            name,
            options.mount,
            options.object_pose,
            options.rate,
            dataclasses.replace(model.geometry, vert=model.rest.vert),
            here,
        )
    settings = {k: v for k, v in dataclasses.asdict(options).items() if k != "device"}
    settings |= {"count": len(touches), "recording": _fingerprint(recording), "object": name}
    settings = json.loads(json.dumps(settings))
    groups = [
        list(range(k, min(k + options.batch, len(touches)))) for k in range(0, len(touches), options.batch)
    ]
    tasks = []
    for number, group in enumerate(groups):
        path = shard_path(out, number)
        if not made_already(path, settings):
            tasks.append(Task((path.name, group), sum(len(touches[i].time) for i in group), path.name))
    if workers is None:
        cores = len(os.sched_getaffinity(0))
        workers = cores if cores > 1 and ray is None else 0
    if tasks:
        about = {"settings": settings, "source": recording.source, "poses": options.poses, "notes": notes}
        skins = geometry, rubber, skin, modulus
        work = _Drive(options, skins, name, touches, assign(len(touches), options.seed), about, workers)
        needs = dict(cpus=max(1, workers), gpus=int(options.device != "cpu"))
        for _ in run_tasks(work, tasks, out, "resimulate", "step", ray, progress=progress, **needs):
            pass
    report = _report(out, len(tasks), notes)
    write_json(out / "resimulate.json", dataclasses.asdict(report))
    return report


def _object(recording, given):
    name = given or recording.object
    if not name or (given is None and name not in OBJECTS and not name.startswith(("geom:", "mesh:"))):
        raise ValueError(
            f"{recording.name} was touched with {name or 'an unknown object'}: give --object, one "
            f"of {', '.join(OBJECTS)}, or geom:TYPE:SIZE[,SIZE...], or mesh:FILE"
        )
    return name


def _fingerprint(recording):
    """Digest of a recording's rows, which identifies its set."""
    found = hashlib.sha256(np.ascontiguousarray(recording.time))
    for field in recording.fields:
        found.update(field.encode() + np.ascontiguousarray(getattr(recording, field)).tobytes())
    return found.hexdigest()[:16]


@dataclasses.dataclass
class _Drive:
    """Work of `shards.run_tasks`: shards of touches, given as name of the file and numbers of its touches.

    Attributes:
      skins: geometry, material, options and modulus of the skin. name: of the object. touches, split: all.
      about: stored with each shard, in addition to the skin. workers: processes for film and readings.
    """

    options: ResimulateOptions
    skins: tuple
    name: str
    touches: list[Touch]
    split: np.ndarray
    about: dict
    workers: int

    def __call__(self, values, folder, report):
        if not hasattr(self, "_model"):
            *skin, modulus = self.skins
            self._model = SkinModel(*skin, self.options.device, modulus=modulus)
        model = self._model
        with readings_pool(
            model.geometry, self.workers, start_args=(model.geometry, model.rest.vert)
        ) as pool:
            waiting = None
            for value in values:
                begun = self._begin(value[1], pool, report)
                if waiting is not None:  # its readings were computed during the next solve
                    yield self._end(*waiting, folder)
                waiting = *value, begun
            if waiting is not None:
                yield self._end(*waiting, folder)

    def _begin(self, members, pool, report):
        """Simulates touches; for each: (fields, index, pending readings)."""
        groups = [members] if self._model.device.is_cuda else [[i] for i in members]
        out = []
        for group in groups:
            touches = [self.touches[i] for i in group]
            longest = max(len(touch.time) for touch in touches)
            time = [_longer(touch.time, longest) for touch in touches]
            motions = [_longer_motion(touch.motion, longest) for touch in touches]
            fields = simulate(self._model, self.name, motions, time=time)
            for k, (i, touch) in enumerate(zip(group, touches)):
                n = len(touch.time)
                seed = int(np.random.SeedSequence([i, 1]).generate_state(1, np.uint64)[0])
                read = (fields.displacement[k, :n], touch.time, fields.pressure[k, :n], seed)
                out.append((fields, k, pool.submit(read_in_worker, *read)))
                report(n)
        return out

    def _end(self, path, members, parts, folder):
        """Writes a shard; returns its file's name."""
        ones = []
        for i, (fields, k, answer) in zip(members, parts):
            touch = self.touches[i]
            ones.append(
                Interaction(
                    id=f"{i:06d}",
                    object=self.name,
                    kind="resimulated",
                    split=str(self.split[i]),
                    seed=self.options.seed,
                    parameters=touch.motion.parameters | {"clock": float(touch.time[0])},
                    time=touch.time,
                    **fields.columns(self._model, k, answer.result(), len(touch.time)),
                    indenter_pos=touch.motion.pos,
                    indenter_quat=quaternion(touch.motion.mat),
                    measured_counts=touch.counts,
                    measured_pac=touch.pac,
                    measured_wrench=touch.wrench,
                )
            )
        about = self.about | describe(self._model, self.options.skin)
        write_shard(folder / path, ones, self._model.geometry, about)
        return path


def _longer(time, n):
    """Times continued evenly to n rows, as all worlds of a batch have the same number."""
    return np.concatenate([time, time[-1] + (time[-1] - time[-2]) * np.arange(1, n - len(time) + 1)])


def _longer_motion(motion, n):
    """The motion, continued at its last pose to n rows."""
    row = np.minimum(np.arange(n), len(motion.pos) - 1)
    return Motion(motion.kind, motion.parameters, motion.pos[row], motion.mat[row])


def _report(out, made, notes):
    with TactileSet(out) as data:
        first = np.repeat(data.start, data.stop - data.start)
        good = data["converged"][:] & (first != np.arange(data.nstep))
        simulated = np.log(data["impedance"][:])
        read = log_impedance(data["measured_counts"][:][:, : -len(SINGLES)].astype(float))
        a, b = ((x - x[first])[good] for x in (simulated, read))
        a, b = (x - x.mean(1, keepdims=True) for x in (a, b))
        size = np.sqrt((a * a).sum(1) * (b * b).sum(1))
        pattern = (a * b).sum(1)[size > 0] / size[size > 0]
        loads = [np.linalg.norm(data[name][:][good, :3], axis=1) for name in ("wrench", "measured_wrench")]
        error = (loads[0] - loads[1])[np.isfinite(loads[1])]
        return ResimulateReport(
            interactions=len(data),
            steps=data.nstep,
            nonconverged=int((~data["converged"][:]).sum()),
            made=made,
            agreement=float(np.median(pattern)) if len(pattern) else float("nan"),
            force_rms=float(np.sqrt((error**2).mean())) if len(error) else float("nan"),
            notes=notes,
        )
