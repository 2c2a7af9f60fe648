"""The pipeline behind `biotac generate`: while workers read one batch, the next one is planned and simulated."""

import dataclasses
import gc
import time

import numpy as np
import tqdm

from .plan import plan_motions
from .schema import DISPLACEMENT_SCALE, Interaction
from .splits import assign
from .store import write_shard

__all__ = ["Maker"]


@dataclasses.dataclass
class _Running:
    """A batch whose readings the workers compute."""

    batch: object
    motions: list
    fields: object = None
    reads: list = None
    answer: object = None
    labels: list = None


class Maker:
    """Makes the shards of one run.

    Args:
      out: folder of the set.
      options: GenerateOptions.
      model: SkinModel of the simulated sensor.
      attributes: of every shard.
      seconds: dict of stages, to which the time that they take is added.
    """

    def __init__(self, out, options, model, attributes, seconds):
        self.out, self.options, self.geometry, self.model = out, options, model.geometry, model
        self.attributes, self.seconds = attributes, seconds
        self.time = np.arange(options.steps) / options.rate
        ends = np.cumsum([options.labelled, options.count - options.labelled, options.recordings])
        parts = [assign(end - first, [options.seed, k]) for k, (first, end) in enumerate(zip([0, *ends], ends))]
        self.split = np.concatenate(parts)
        self.measured = None

    def run(self, todo, workers, progress):
        """Makes the shards of batches `todo` with that many worker processes."""
        from . import readings, synthetic_sensor

        o = self.options
        if any(batch.measured for batch in todo):
            self.measured = synthetic_sensor.SyntheticSensor(o.measured_seed, o.measured_skin, self.model.device)
        args = (self.geometry, o.sensor, self.measured and self.measured.meter())
        total = o.steps * sum(batch.simulated + batch.measured for batch in todo)
        bar = tqdm.tqdm(total=total, desc="generate", unit="step", disable=not progress, leave=False)
        with bar, readings.readings_pool(self.geometry, o.sensor, workers, synthetic_sensor.start_worker, args) as pool:
            waiting, written = [], []
            for batch in todo:
                waiting.append(self._begin(batch, pool, bar))
                if len(waiting) > 1:
                    written.append(self._end(waiting.pop(0), pool))
                for one in written:  # a shard that could not be written stops the run now, not at its end
                    if one.done():
                        one.result()
            written += [self._end(one, pool) for one in waiting]
            for one in written:
                one.result()

    def _begin(self, batch, pool, bar) -> _Running:
        """Plans and simulates a batch and hands its readings to the workers."""
        from . import readings, simulate, synthetic_sensor

        o = self.options
        self._free()
        clock = time.perf_counter()
        motions = plan_motions(self.geometry, batch.name, [[o.seed, i] for i in batch.members], o.steps, o.kinds, self.model.device)
        running = _Running(batch, motions)
        clock = self._count("plan", clock)
        noise = [int(np.random.SeedSequence([o.seed, i, 1]).generate_state(1, np.uint64)[0]) for i in batch.members]
        if batch.simulated:
            walk = simulate.simulate if o.tier == "full" else simulate.simulate_condensed
            fields = running.fields = walk(self.model, batch.name, motions, bar.update)
            clock = self._count("skin", clock)
            running.reads = [
                pool.submit(readings.read_in_worker, fields.displacement[k], self.time, fields.pressure[k], noise[k])
                for k in range(len(motions))
            ]
        if batch.measured:
            self._free()
            answer = running.answer = self.measured.simulate(batch.name, motions, bar.update)
            self._count("measured skin", clock)
            # each contact of the session begins some seconds after the last one, while the sensor warms up
            running.labels = [
                pool.submit(synthetic_sensor.measure_in_worker, answer.displacement[k], self.time, answer.pressure[k], i, noise[k])
                for k, i in enumerate(batch.members)
            ]
        return running

    def _free(self):
        """Gives the device memory of the last batch back: its data and graphs refer to each other, and torch keeps what it once had."""
        gc.collect()
        if self.model.device.is_cuda:
            import torch

            torch.cuda.empty_cache()

    def _count(self, stage, since):
        now = time.perf_counter()
        self.seconds[stage] += now - since
        return now

    def _end(self, running, pool):
        """Waits for the readings of a batch and has its shard written: compressing it takes a core some seconds."""
        batch, ones = running.batch, []
        for k, (number, motion) in enumerate(zip(batch.members, running.motions)):
            columns = {"indenter_pos": motion.pos, "indenter_quat": _quaternions(motion.mat), "converged": np.ones(len(self.time), bool)}
            if batch.simulated:
                fields, read = running.fields, running.reads[k].result()
                columns |= {
                    "displacement": fields.displacement[k] * np.float32(DISPLACEMENT_SCALE),
                    "wrench": fields.wrench[k],
                    "contact_force": None if fields.contact_force is None else fields.contact_force[k],
                    "pressure": fields.pressure[k],
                    "impedance": read.impedance,
                    "counts": read.counts,
                }
                columns["converged"] &= fields.converged[k] & ~read.failed
            if batch.measured:
                columns |= {"measured_counts": running.labels[k].result(), "measured_wrench": running.answer.wrench[k]}
                columns["converged"] &= running.answer.converged[k]
            ones.append(
                Interaction(
                    id=f"{number:06d}",
                    object=batch.name,
                    kind=motion.kind,
                    split=str(self.split[number]),
                    seed=self.options.seed,
                    parameters=motion.parameters,
                    time=self.time,
                    **columns,
                )
            )
        return pool.submit(write_shard, self.out / batch.path, ones, self.geometry if batch.simulated else None, self.attributes)


def _quaternions(mat):
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(mat).as_quat(), 1, axis=-1)
