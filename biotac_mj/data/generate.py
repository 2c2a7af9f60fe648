"""`biotac generate`: plans, simulates, reads and stores synthetic interactions, one shard for each batch of worlds."""

import dataclasses
import json
import os
import pathlib
import time

import numpy as np
import tqdm

from ..geometry import load_skin
from ..geometry.indenters import INDENTERS
from ..press_record import replacing
from .objects import OBJECTS
from .plan import KINDS, plan_motions
from .schema import Interaction
from .splits import assign
from .store import TactileSet, shard_path, write_shard

__all__ = ["GenerateOptions", "Report", "generate"]


@dataclasses.dataclass(frozen=True)
class GenerateOptions:
    """What is generated. All of it but `device` is kept with the set and must be the same when an interrupted run goes on.

    Attributes:
      count: interactions. labelled: of them, how many also get the readings of the synthetic measured sensor; the paper's indenters only.
      steps: time steps of each. rate: of them [Hz].
      seed: of everything.
      objects, kinds: to draw from.
      skin, tier, material, element, liquid: of the simulated sensor, as in `biotac press`; element and liquid None: the material's.
      sensor: whose published rest counts the simulated electrodes show.
      batch: worlds at most in a batch; a shard holds one batch.
      measured_seed, measured_skin: number and mesh of the synthetic measured sensor.
      device: "cpu" or "cuda:0".
    """

    count: int = 2600
    labelled: int = 359
    steps: int = 20
    rate: float = 20.0
    seed: int = 0
    objects: tuple = OBJECTS
    kinds: tuple = KINDS
    skin: str = "default"
    tier: str = "full"
    material: str = "default"
    element: str | None = None
    liquid: bool | None = None
    sensor: str = "1"
    batch: int = 160
    measured_seed: int = 0
    measured_skin: str = "fine"
    device: str = "cpu"

    def __post_init__(self):
        object.__setattr__(self, "objects", tuple(self.objects))
        object.__setattr__(self, "kinds", tuple(self.kinds))
        if self.count < 1 or self.batch < 1:
            raise ValueError(f"count is {self.count} and batch is {self.batch}: both must be at least 1")
        if not 0 <= self.labelled <= self.count:
            raise ValueError(f"labelled is {self.labelled}: it must lie between 0 and the count, {self.count}")
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise ValueError(f"rate is {self.rate} Hz: it must be a positive number")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}: it must not be negative")
        if self.tier not in ("full", "condensed"):
            raise ValueError(f"unknown tier {self.tier!r}: choose full or condensed")
        unknown = [name for name in self.objects if name not in OBJECTS]
        if unknown or not self.objects:
            raise ValueError(f"unknown object {', '.join(map(repr, unknown)) or 'list: it is empty'}: choose from {', '.join(OBJECTS)}")
        if self.labelled and not set(self.objects) & set(INDENTERS):
            raise ValueError("labelled interactions are made with the eight indenters: add one of them to the objects, or take 0 labelled")


@dataclasses.dataclass(frozen=True)
class Report:
    """What a run did.

    Attributes:
      interactions, steps: in the set. nonconverged: of these steps. made: shards made by this run; those that were there are kept.
      seconds: wall time of this run, once and per stage. bytes: of the shards. device: its name.
    """

    interactions: int
    steps: int
    nonconverged: int
    made: int
    seconds: dict
    bytes: int
    device: str


@dataclasses.dataclass(frozen=True)
class _Batch:
    number: int
    name: str
    labelled: bool
    members: list  # numbers of interactions


def batches(options: GenerateOptions) -> list[_Batch]:
    """Interactions 0..labelled-1 are labelled; objects take turns, so that a part of a set is a smaller set of the same kind."""
    indenters = [name for name in options.objects if name in INDENTERS]
    groups = {}
    for i in range(options.count):
        names = indenters if i < options.labelled else options.objects
        groups.setdefault((i < options.labelled, names[i % len(names)]), []).append(i)
    out = []
    for (labelled, name), members in groups.items():
        for part in np.array_split(members, -(-len(members) // options.batch)):
            out.append(_Batch(len(out), name, labelled, part.tolist()))
    return out


def generate(out, options: GenerateOptions = GenerateOptions(), workers: int | None = None, progress: bool = True) -> Report:  # noqa: B008 - frozen
    """Makes a set in folder `out`, or what is missing of it.

    Args:
      out: folder.
      options: see GenerateOptions.
      workers: processes for film and readings; None takes the cores there are, 0 this process.
      progress: whether to show a bar.

    Raises:
      ValueError: the folder holds a set with other options, or an option is not possible.
      FileNotFoundError: no such skin.
    """
    from ..skin import SkinModel, SkinOptions

    out = pathlib.Path(out)
    geometry = load_skin(options.skin)
    settings = {k: v for k, v in dataclasses.asdict(options).items() if k != "device"} | {"device": options.device.split(":")[0]}
    settings = json.loads(json.dumps(settings))
    todo = [batch for batch in batches(options) if not _is_there(shard_path(out, batch.number), settings)]
    begin = time.perf_counter()
    if workers is None:
        workers = len(os.sched_getaffinity(0)) if len(os.sched_getaffinity(0)) > 1 else 0
    model = None
    seconds = {"plan": 0.0, "skin": 0.0, "measured skin": 0.0}
    if todo:
        model = SkinModel(geometry, options.material, SkinOptions(element=options.element, liquid=options.liquid), options.device)
        attributes = {"settings": settings, "skin": options.skin, "material": dataclasses.asdict(model.material), "element": model.element,
                      "tier": options.tier, "liquid": model.has_liquid, "device": _device_name(model.device)}  # fmt: skip
        maker = _Maker(out, options, model, attributes, seconds)
        maker.run(todo, workers, progress)
    seconds["all"] = time.perf_counter() - begin
    with TactileSet(out) as data:
        report = Report(
            interactions=len(data),
            steps=data.nstep,
            nonconverged=int((~data["converged"][:]).sum()),
            made=len(todo),
            seconds={name: round(value, 1) for name, value in seconds.items()},
            bytes=sum(path.stat().st_size for path in out.glob("shard-*.h5")),
            device=data.attributes["device"],
        )
    if todo:
        with replacing(out / "generate.json") as temporary:
            temporary.write_text(json.dumps({**dataclasses.asdict(report), "settings": settings}, indent=1) + "\n")
    return report


def _is_there(path, settings):
    """Whether a shard is there; ValueError where it belongs to another run."""
    if not path.is_file():
        return False
    with TactileSet(path) as data:
        found = data.attributes.get("settings", {})
    different = [f"{k} {found.get(k)!r} there, {v!r} now" for k, v in settings.items() if found.get(k) != v]
    if different:
        raise ValueError(f"{path} was generated with other options ({'; '.join(different)}): use another --out, or delete that set")
    return True


def _device_name(device):
    if device.is_cuda:
        return device.name
    import platform

    return platform.processor() or platform.machine()


class _Maker:
    """The pipeline: while workers read one batch, the next one is planned and simulated."""

    def __init__(self, out, options, model, attributes, seconds):
        self.out, self.options, self.geometry, self.model = out, options, model.geometry, model
        self.attributes, self.seconds = attributes, seconds
        self.time = np.arange(options.steps) / options.rate
        self.split = np.empty(options.count, "<U10")
        for k, (low, high) in enumerate(((0, options.labelled), (options.labelled, options.count))):
            self.split[low:high] = assign(high - low, [options.seed, k])
        self.measured = None

    def run(self, todo, workers, progress):
        from . import readings, synthetic_sensor

        o = self.options
        labelled = any(batch.labelled for batch in todo)
        if labelled:
            self.measured = synthetic_sensor.SyntheticSensor(o.measured_seed, o.measured_skin, self.model.device)
        args = (self.geometry, o.sensor, self.measured.meter() if labelled else None)
        total = sum(o.steps * (1 + batch.labelled) for batch in todo)
        bar = tqdm.tqdm(total=total, desc="generate", unit="step", disable=not progress, leave=False)
        with bar, readings.readings_pool(self.geometry, o.sensor, workers, synthetic_sensor.start_worker, args) as pool:
            waiting = []
            for batch in todo:
                waiting.append(self._begin(batch, pool, bar))
                if len(waiting) > 1:
                    self._end(*waiting.pop(0), pool)
            for one in waiting:
                self._end(*one, pool)

    def _begin(self, batch, pool, bar):
        """Plans and simulates a batch and hands its readings to the workers."""
        from . import readings, simulate, synthetic_sensor

        o = self.options
        clock = time.perf_counter()
        seeds = [[o.seed, number] for number in batch.members]
        motions = plan_motions(self.geometry, batch.name, seeds, o.steps, o.kinds, self.model.device)
        clock = self._count("plan", clock)
        walk = simulate.simulate if o.tier == "full" else simulate.simulate_condensed
        fields = walk(self.model, batch.name, motions, bar.update)
        clock = self._count("skin", clock)
        noise = [int(np.random.SeedSequence([o.seed, number, 1]).generate_state(1, np.uint64)[0]) for number in batch.members]
        jobs = [pool.submit(readings._read, fields.displacement[k], self.time, fields.pressure[k], noise[k]) for k in range(len(motions))]
        if not batch.labelled:
            return batch, motions, fields, jobs, None, None
        answer = self.measured.simulate(batch.name, motions, bar.update)
        self._count("measured skin", clock)
        # each contact of the session begins some seconds after the last one, while the sensor warms up
        labels = [
            pool.submit(synthetic_sensor.measure_in_worker, answer.displacement[k], self.time, answer.pressure[k], number, noise[k])
            for k, number in enumerate(batch.members)
        ]
        return batch, motions, fields, jobs, answer, labels

    def _count(self, stage, since):
        now = time.perf_counter()
        self.seconds[stage] += now - since
        return now

    def _end(self, batch, motions, fields, jobs, answer, labels, pool):
        """Waits for the readings of a batch and writes its shard."""
        from .schema import DISPLACEMENT_SCALE

        interactions = []
        for k, (number, motion, job) in enumerate(zip(batch.members, motions, jobs)):
            read = job.result()
            extra = {}
            if labels is not None:
                extra = {"measured_counts": labels[k].result(), "measured_wrench": answer.wrench[k].astype(np.float32)}
            interactions.append(
                Interaction(
                    id=f"{number:06d}",
                    object=batch.name,
                    kind=motion.kind,
                    split=str(self.split[number]),
                    seed=self.options.seed,
                    parameters=motion.parameters,
                    time=self.time,
                    displacement=fields.displacement[k] * np.float32(DISPLACEMENT_SCALE),
                    wrench=fields.wrench[k],
                    contact_force=None if fields.contact_force is None else fields.contact_force[k],
                    pressure=fields.pressure[k],
                    impedance=read.impedance,
                    counts=read.counts,
                    indenter_pos=motion.pos,
                    indenter_quat=_quaternions(motion.mat),
                    converged=fields.converged[k] & ~read.failed & (True if answer is None else answer.converged[k]),
                    **extra,
                )
            )
        write_shard(shard_path(self.out, batch.number), interactions, self.geometry, self.attributes)


def _quaternions(mat):
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(mat).as_quat(), 1, axis=-1)
