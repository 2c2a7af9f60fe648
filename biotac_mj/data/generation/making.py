"""Pipeline of `biotac data generate`: while workers read one batch, the next one is planned and simulated.

With several GPUs each has such a pipeline in a process, and takes batches from a common queue. On a Ray
cluster each batch is a task.
"""

import dataclasses
import gc
import pathlib
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from ...geometry.rigid import quaternion
from ...shards import Task, one_per_gpu, run_tasks
from ..schema import Interaction
from ..splits import assign
from ..store import write_shard
from .plan import plan_motions
from .vary import draw_sense, draw_worlds, refuse_impossible

_STAGES = ("start", "plan", "skin", "measured skin", "waiting for readings")
_LOOKAHEAD = 4  # most batches in memory that wait for their readings


def make_shards(
    out: pathlib.Path,
    options: Any,
    settings: dict,
    todo: Iterable,
    workers: int,
    progress: bool,
    ray: str | None = None,
) -> dict:
    """Makes the shards of batches `todo` in folder `out`, on all of the options' devices, or on a cluster.

    Args:
      settings: stored with every shard. workers: on the CPU, processes that each make whole batches; with
        GPUs, processes for film and readings, shared by the devices; on Ray those of each task. progress:
        whether to show a bar. ray: see `shards.run_tasks`.

    Returns:
      seconds of each stage, summed over devices.

    Raises:
      ValueError: an invalid option.
      RuntimeError: a device's process failed; the text is its error.
    """
    from .readings import THREADS

    cuda, several = options.devices[0] != "cpu", len(options.devices) > 1
    own_gpu = cuda and (several or ray is not None)  # with a GPU of its own, whatever its number
    cores = workers if ray is not None else -(-workers // len(options.devices))
    processes = one_per_gpu(options.devices) if several else None
    steps = [options.steps * len(batch.members) * (1 + batch.measured) for batch in todo]
    tasks = [Task(batch, size, batch.path) for batch, size in zip(todo, steps)]
    if not cuda and ray is None and min(workers, len(tasks)) > 1:  # each core solves, reads and stores
        processes = {f"process {k}": dict.fromkeys(THREADS, "1") for k in range(min(workers, len(tasks)))}
        cores = 0
    if processes or ray is not None:
        tasks.sort(key=lambda task: not task.value.measured)  # longest first
    work = MakeShards(options, settings, "cuda:0" if own_gpu else options.device, cores)
    seconds = {}
    for spent in run_tasks(
        work,
        tasks,
        out,
        "generate",
        "step",
        ray,
        processes,
        cpus=max(1, cores),
        gpus=int(cuda),
        progress=progress,
    ):
        seconds = {name: seconds.get(name, 0) + value for name, value in spent.items()}
    return seconds


@dataclasses.dataclass
class MakeShards:
    """Work of `shards.run_tasks`: makes shards of batches on a Warp device with that many worker processes; a
    result is the seconds of each stage."""

    options: Any
    settings: dict
    device: str
    workers: int

    def __call__(self, values: Iterable, folder: pathlib.Path, report: Callable) -> Iterator[dict]:
        if not hasattr(self, "_maker"):
            self._maker = Maker(self.options, self.settings, self.device)
        return self._maker.run(values, folder, self.workers, report)


@dataclasses.dataclass
class _Running:
    """A batch whose readings are being computed by the workers."""

    batch: object
    motions: list
    fields: object = None
    reads: list = None
    answer: object = None
    labels: list = None

    def done(self):
        return all(one.done() for one in [*(self.reads or []), *(self.labels or [])])


class Maker:
    """Makes shards on one device.

    Args:
      options: GenerateOptions. settings: stored with every shard.
      device: of Warp.

    Attributes:
      film: settings of the skin's FilmConduction.
    """

    def __init__(self, options: Any, settings: dict, device: str = "cpu"):
        from ...geometry import load_skin
        from ...sensor.film import read_film
        from ...skin import SkinModel
        from ...skin.condensed.refusals import refuse
        from ...skin.per_world import NAMES, make_room
        from ...skin.settings import read_settings
        from .simulate import describe

        self.options, self.seconds = options, dict.fromkeys(_STAGES, 0.0)
        clock = time.perf_counter()
        self.geometry = load_skin(options.skin)
        chosen = {name: getattr(options, name) for name in ("element", "liquid")}
        rubber, skin, modulus = read_settings(options.material, options.options, ("film",), **chosen)
        self.film = read_film((options.options or {}).get("film"), rubber.electrode_radius, self.geometry)
        self.vary = options.vary or {}
        refuse_impossible(self.vary, rubber)
        between = {name: self.vary[name] for name in NAMES if name in self.vary}
        skin, modulus = make_room(skin, modulus, between, len(self.geometry.elem))
        if self.vary.get("stiffening") and not rubber.stiffening:  # zero disables it for all worlds
            rubber = dataclasses.replace(rubber, stiffening=sum(self.vary["stiffening"]) / 2)
        model = self.model = SkinModel(self.geometry, rubber, skin, device, modulus=modulus)
        self.geometry = model.geometry  # with all solved nodes
        if options.tier == "condensed":
            refuse(model.material.extensions, skin, model.has_liquid, model.device.is_cuda)
        self.attributes = {"settings": settings, **describe(model, options.skin, options.tier)}
        self.modes = self.few = None
        if options.texture is not None:
            from ...sensor.vibration import Modes
            from ...skin.modes import skin_modes

            self.modes = skin_modes(model)
            self.few = Modes(self.modes.rate, self.modes.static_pressure)
        self.time = np.arange(options.steps) / options.rate
        counts = options.labelled, options.count - options.labelled
        self.split = np.concatenate([assign(n, [options.seed, k]) for k, n in enumerate(counts)])
        self.measured = None
        if options.labelled:
            from .synthetic_sensor import SyntheticSensor

            self.measured = SyntheticSensor(options.measured_seed, options.measured_skin, model.device)
        filled = model.options.fill_volume or model.options.rest_pressure
        self._untouched = self.geometry  # the surface for first touch
        if filled:
            self._untouched = dataclasses.replace(self.geometry, vert=model.rest.vert)
        self._count("start", clock)

    def run(
        self, todo: Iterable, out: pathlib.Path, workers: int, report: Callable[[int | str], object]
    ) -> Iterator[dict]:
        """Makes the shards of an iterator of batches in folder `out` with that many worker processes; yields
        the seconds of each stage. report: gets completed time steps, and a line on each batch."""
        from . import readings, synthetic_sensor

        rest = None if self._untouched is self.geometry else self._untouched.vert
        meter = self.measured and self.measured.meter()
        args = (self.geometry, meter, rest, self.film, self.options.signal)
        with readings.readings_pool(self.geometry, workers, synthetic_sensor.start_worker, args) as pool:
            waiting, written = [], []
            for batch in todo:
                waiting.append(self._begin(batch, pool, report))
                while waiting and (len(waiting) > _LOOKAHEAD or waiting[0].done()):
                    written.append(self._end(waiting.pop(0), pool, out))
                for one in written:  # a failed write stops the run now, not at its end
                    if one.done():
                        one.result()
                yield self._spent()
            written += [self._end(one, pool, out) for one in waiting]
            for one in written:
                one.result()
            yield self._spent()

    def _spent(self):
        """Seconds of each stage since the last call."""
        seconds, self.seconds = self.seconds, dict.fromkeys(_STAGES, 0.0)
        return seconds

    def _begin(self, batch, pool, report) -> _Running:
        """Plans and simulates a batch and submits its readings to the workers."""
        from . import readings, simulate, synthetic_sensor

        o = self.options
        self._free()
        before = dict(self.seconds)
        clock = time.perf_counter()
        motions = [None] * len(batch.members)
        for name in dict.fromkeys(batch.names):
            mine = [k for k, other in enumerate(batch.names) if other == name]
            seeds = [[o.seed, batch.members[k]] for k in mine]
            for k, motion in zip(
                mine, plan_motions(self._untouched, name, seeds, o.steps, o.kinds, self.model.device)
            ):
                motions[k] = motion
        running = _Running(batch, motions)
        clock = self._count("plan", clock)
        noise = [
            int(np.random.SeedSequence([o.seed, i, 1]).generate_state(1, np.uint64)[0]) for i in batch.members
        ]
        skins = None, {}
        if self.vary:
            *skins, drawn = draw_worlds(
                self.vary, self.model.material, [[o.seed, i, 2] for i in batch.members]
            )
            for motion, one in zip(motions, drawn):
                motion.parameters["skin"] = one
        senses = []
        for i, motion in zip(batch.members, motions):
            sense, drawn = draw_sense(o, [o.seed, i, 3], self.few, self.geometry.design)
            senses.append(sense)
            motion.parameters.update(drawn)
        fields = running.fields = simulate.simulate(
            self.model, batch.names, motions, report, self.time, *skins, self.modes, o.tier
        )
        clock = self._count("skin", clock)
        running.reads = [
            pool.submit(
                readings.read_in_worker,
                fields.displacement[k],
                self.time,
                fields.pressure[k],
                noise[k],
                senses[k],
                fields.touch(self.model, k),
                None if fields.rest is None else fields.rest[k],
            )
            for k in range(len(motions))
        ]
        if batch.measured:
            self._free()
            answer = running.answer = self.measured.simulate(batch.names, motions, report)
            self._count("measured skin", clock)
            # contacts of the session follow each other after some seconds, while the sensor warms up
            running.labels = [
                pool.submit(
                    synthetic_sensor.measure_in_worker,
                    answer.displacement[k],
                    self.time,
                    answer.pressure[k],
                    i,
                    noise[k],
                )
                for k, i in enumerate(batch.members)
            ]
        spent = ", ".join(
            f"{name} {s - before[name]:.1f} s" for name, s in self.seconds.items() if s - before[name] > 0.05
        )
        report(f"{batch.path}: {len(motions)} worlds, {spent}")
        return running

    def _free(self):
        """Frees the device memory of the last batch: its data and graphs refer to each other, and torch
        caches memory."""
        gc.collect()
        if self.model.device.is_cuda:
            import torch

            torch.cuda.empty_cache()

    def _count(self, stage, since):
        now = time.perf_counter()
        self.seconds[stage] += now - since
        return now

    def _end(self, running, pool, out):
        """Waits for the readings of a batch and submits its shard for writing: compression takes some seconds
        on a core."""
        batch, ones = running.batch, []
        clock = time.perf_counter()
        for k, (number, name, motion) in enumerate(zip(batch.members, batch.names, running.motions)):
            columns = {"indenter_pos": motion.pos, "indenter_quat": quaternion(motion.mat)}
            columns |= running.fields.columns(self.model, k, running.reads[k].result())
            if batch.measured:
                counts, pac = running.labels[k].result()
                columns |= {
                    "measured_counts": counts,
                    "measured_pac": pac,
                    "measured_wrench": running.answer.wrench[k],
                }
                columns["converged"] &= running.answer.converged[k]
            ones.append(
                Interaction(
                    id=f"{number:06d}",
                    object=name,
                    kind=motion.kind,
                    split=str(self.split[number]),
                    seed=self.options.seed,
                    parameters=motion.parameters,
                    time=self.time,
                    **columns,
                )
            )
        self._count("waiting for readings", clock)
        return pool.submit(write_shard, out / batch.path, ones, self.geometry, self.attributes)
