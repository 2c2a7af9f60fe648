"""The pipeline behind `biotac generate`: while workers read one batch, the next one is planned and simulated.

With several GPUs there is one such pipeline in a process for each; they take the batches one after another.
"""

import dataclasses
import gc
import multiprocessing
import os
import pathlib
import platform
import queue
import signal
import time
import traceback
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import tqdm

from ..geometry.rigid import quaternion
from .plan import plan_motions
from .schema import DISPLACEMENT_SCALE, Interaction
from .splits import assign
from .store import write_shard
from .vary import draw_sense, draw_worlds, refuse_impossible

__all__ = ["Maker", "make_shards"]

_VISIBLE = "CUDA_VISIBLE_DEVICES"
_AHEAD = 4  # batches that wait for their readings at most: they lie in memory


def make_shards(
    out: pathlib.Path, options: Any, settings: dict, todo: Iterable, workers: int, progress: bool
) -> dict:
    """Makes the shards of batches `todo` in folder `out`, on all of the options' devices.

    Args:
      settings: kept with every shard. workers: processes for film and readings, shared by the devices.
        progress: whether to show a bar.

    Returns:
      seconds of each stage, of all devices together.

    Raises:
      ValueError: an option is not possible.
      RuntimeError: a device's process failed; the text is its error.
    """
    total = options.steps * sum(len(batch.members) * (batch.simulated + batch.measured) for batch in todo)
    with tqdm.tqdm(total=total, desc="generate", unit="step", disable=not progress, leave=False) as bar:

        def tell(text):
            if progress:
                bar.write(text)

        if len(options.devices) == 1:
            maker = Maker(out, options, settings, options.device, bar.update, tell)
            maker.run(iter(todo), workers)
            return maker.seconds
        return _make_on_all(out, options, settings, todo, workers, bar.update, tell)


def _make_on_all(out, options, settings, todo, workers, update, tell, seen="cuda:0"):
    """A process for each device, in which it is the only one and called `seen`; what they tell comes through
    one queue."""
    context = multiprocessing.get_context("spawn")
    batches, news = context.Queue(), context.Queue()
    heavy_first = sorted(todo, key=lambda batch: not batch.measured)
    for batch in [*heavy_first, *[None] * len(options.devices)]:
        batches.put(batch)
    share = -(-workers // len(options.devices))
    visible = os.environ.get(_VISIBLE)
    names = visible.split(",") if visible else None
    running, seconds = {}, {}
    try:
        for device in options.devices:
            number = int(device.split(":")[1])
            os.environ[_VISIBLE] = names[number] if names else str(number)
            args = (out, options, settings, seen, batches, news, share, device)
            running[device] = context.Process(target=_make_on_one, args=args)
            running[device].start()
        while running:
            try:
                device, what, value = news.get(timeout=2.0)
            except queue.Empty:
                gone = [
                    f"{d} (exit code {p.exitcode})" for d, p in running.items() if p.exitcode not in (None, 0)
                ]
                if gone:
                    raise RuntimeError(
                        f"the process of {', '.join(gone)} ended: "
                        "run the command again, what is there is kept"
                    ) from None
                continue
            if what == "step":
                update(value)
            elif what == "text":
                tell(f"{device}: {value}")
            elif what == "error":
                raise (ValueError if value[0] == "ValueError" else RuntimeError)(f"{device}: {value[1]}")
            else:
                running.pop(device).join()
                seconds = {name: seconds.get(name, 0) + s for name, s in value.items()}
    finally:
        os.environ.pop(_VISIBLE, None)
        if visible is not None:
            os.environ[_VISIBLE] = visible
        for process in running.values():
            process.terminate()
    return seconds


def _make_on_one(out, options, settings, device, batches, news, workers, name):
    """What the process of one device does."""
    signal.signal(signal.SIGTERM, _leave)
    try:
        maker = Maker(
            out,
            options,
            settings,
            device,
            lambda n: news.put((name, "step", n)),
            lambda text: news.put((name, "text", text)),
        )
        maker.run(iter(batches.get, None), workers)
        news.put((name, "end", maker.seconds))
    except ValueError as error:
        news.put((name, "error", ("ValueError", str(error))))
    except Exception:
        news.put((name, "error", ("RuntimeError", traceback.format_exc())))


def _leave(*_):
    """A process that is told to stop takes its workers with it."""
    for child in multiprocessing.active_children():
        child.terminate()
    os._exit(1)


@dataclasses.dataclass
class _Running:
    """A batch whose readings the workers compute."""

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
      out: folder of the set.
      options: GenerateOptions. settings: what of them is kept with every shard.
      device: of Warp.
      update: called with time steps done. tell: called with a line on each batch.

    Attributes:
      seconds: of each stage. film: settings of the skin's FilmConduction.
    """

    def __init__(
        self,
        out: pathlib.Path,
        options: Any,
        settings: dict,
        device: str = "cpu",
        update: Callable[[int], object] = lambda n: None,
        tell: Callable[[str], object] = lambda text: None,
    ):
        from ..geometry import load_skin
        from ..sensor.film import read_film
        from ..skin import SkinModel
        from ..skin.condensed.refusals import refuse
        from ..skin.per_world import NAMES, make_room
        from ..skin.settings import read_settings

        self.out, self.options, self.update, self.tell = out, options, update, tell
        self.seconds = {
            "start": 0.0,
            "plan": 0.0,
            "skin": 0.0,
            "measured skin": 0.0,
            "waiting for readings": 0.0,
        }
        clock = time.perf_counter()
        self.geometry = load_skin(options.skin)
        chosen = {name: getattr(options, name) for name in ("element", "liquid")}
        rubber, skin, modulus = read_settings(options.material, options.options, ("film",), **chosen)
        self.film = read_film((options.options or {}).get("film"), rubber.electrode_radius, self.geometry)
        self.vary = options.vary or {}
        refuse_impossible(self.vary, rubber)
        between = {name: self.vary[name] for name in NAMES if name in self.vary}
        skin, modulus = make_room(skin, modulus, between, len(self.geometry.elem))
        if self.vary.get("stiffening") and not rubber.stiffening:  # zero has no place for others
            rubber = dataclasses.replace(rubber, stiffening=sum(self.vary["stiffening"]) / 2)
        model = self.model = SkinModel(self.geometry, rubber, skin, device, modulus=modulus)
        self.geometry = model.geometry  # with all nodes that are solved
        if options.tier == "condensed":
            refuse(model.rubber_options, skin, model.has_liquid, model.device.is_cuda)
        self.attributes = {
            "settings": settings,
            "skin": options.skin,
            "material": dataclasses.asdict(model.material),
            "element": model.element,
            "tier": options.tier,
            "liquid": model.has_liquid,
            "device": _device_name(model.device),
        }
        self.modes = self.few = None
        if options.texture is not None:
            from ..sensor.vibration import Modes
            from ..skin.modes import skin_modes

            self.modes = skin_modes(model)
            self.few = Modes(self.modes.rate, self.modes.share)
        self.time = np.arange(options.steps) / options.rate
        ends = np.cumsum([options.labelled, options.count - options.labelled, options.recordings])
        parts = [
            assign(end - first, [options.seed, k]) for k, (first, end) in enumerate(zip([0, *ends], ends))
        ]
        self.split = np.concatenate(parts)
        self.measured = None
        if options.labelled or options.recordings:
            from .synthetic_sensor import SyntheticSensor

            self.measured = SyntheticSensor(options.measured_seed, options.measured_skin, model.device)
        filled = model.options.fill_volume or model.options.rest_pressure
        self._rest = self.geometry  # what an object meets first
        if filled:
            self._rest = dataclasses.replace(self.geometry, vert=model.rest.vert)
        self._count("start", clock)

    def run(self, todo: Iterable, workers: int) -> None:
        """Makes the shards of an iterator of batches with that many worker processes."""
        from . import readings, synthetic_sensor

        rest = None if self._rest is self.geometry else self._rest.vert
        args = (self.geometry, self.measured and self.measured.meter(), rest, self.film)
        with readings.readings_pool(self.geometry, workers, synthetic_sensor.start_worker, args) as pool:
            waiting, written = [], []
            for batch in todo:
                waiting.append(self._begin(batch, pool))
                while waiting and (len(waiting) > _AHEAD or waiting[0].done()):
                    written.append(self._end(waiting.pop(0), pool))
                for one in written:  # a shard that could not be written stops the run now, not at its end
                    if one.done():
                        one.result()
            written += [self._end(one, pool) for one in waiting]
            for one in written:
                one.result()

    def _begin(self, batch, pool) -> _Running:
        """Plans and simulates a batch and hands its readings to the workers."""
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
                mine, plan_motions(self._rest, name, seeds, o.steps, o.kinds, self.model.device)
            ):
                motions[k] = motion
        running = _Running(batch, motions)
        clock = self._count("plan", clock)
        noise = [
            int(np.random.SeedSequence([o.seed, i, 1]).generate_state(1, np.uint64)[0]) for i in batch.members
        ]
        if batch.simulated:
            walk = simulate.simulate if o.tier == "full" else simulate.simulate_condensed
            skins = None, {}
            if self.vary:
                *skins, drawn = draw_worlds(
                    self.vary, self.model.material, [[o.seed, i, 2] for i in batch.members]
                )
                for motion, one in zip(motions, drawn):
                    motion.parameters["skin"] = one
            senses = []
            for i, motion in zip(batch.members, motions):
                sense, drawn = draw_sense(o, [o.seed, i, 3], self.few)
                senses.append(sense)
                motion.parameters.update(drawn)
            fields = running.fields = walk(
                self.model, batch.names, motions, self.update, self.time, *skins, modes=self.modes
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
                    fields.touch(k),
                    None if fields.rest is None else fields.rest[k],
                )
                for k in range(len(motions))
            ]
        if batch.measured:
            self._free()
            answer = running.answer = self.measured.simulate(batch.names, motions, self.update)
            self._count("measured skin", clock)
            # each contact of the session begins some seconds after the last one, while the sensor warms up
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
        self.tell(f"{batch.path}: {len(motions)} worlds, {spent}")
        return running

    def _free(self):
        """Gives the device memory of the last batch back: its data and graphs refer to each other, and torch
        keeps what it once had."""
        gc.collect()
        if self.model.device.is_cuda:
            import torch

            torch.cuda.empty_cache()

    def _count(self, stage, since):
        now = time.perf_counter()
        self.seconds[stage] += now - since
        return now

    def _end(self, running, pool):
        """Waits for the readings of a batch and has its shard written: compressing it takes a core some
        seconds."""
        batch, ones = running.batch, []
        clock = time.perf_counter()
        for k, (number, name, motion) in enumerate(zip(batch.members, batch.names, running.motions)):
            columns = {
                "indenter_pos": motion.pos,
                "indenter_quat": quaternion(motion.mat),
                "converged": np.ones(len(self.time), bool),
            }
            if batch.simulated:
                fields, read = running.fields, running.reads[k].result()
                columns |= {
                    "displacement": fields.displacement[k] * np.float32(DISPLACEMENT_SCALE),
                    "wrench": fields.wrench[k],
                    "contact_force": None if fields.contact_force is None else fields.contact_force[k],
                    "pressure": fields.pressure[k],
                    "impedance": read.impedance,
                    "counts": read.counts,
                    "pac": read.pac,
                }
                columns["converged"] &= fields.converged[k] & ~read.failed
            if batch.measured:
                columns |= {
                    "measured_counts": running.labels[k].result(),
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
        return pool.submit(
            write_shard,
            self.out / batch.path,
            ones,
            self.geometry if batch.simulated else None,
            self.attributes,
        )


def _device_name(device):
    return device.name if device.is_cuda else platform.processor() or platform.machine()
