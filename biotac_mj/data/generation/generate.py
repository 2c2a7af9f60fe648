"""`biotac data generate`: plans, simulates, reads and stores synthetic interactions, one shard for each batch
of worlds."""

import dataclasses
import hashlib
import json
import os
import pathlib
import time

import numpy as np

from ...effects.sensors import take_sensor
from ...fields import as_real, as_whole, check_choice, check_types, either
from ...files import write_json
from ...geometry import load_skin
from ...geometry.indenters import INDENTERS
from ...geometry.skins import design_of, mesh_of_same_design
from ...sensor.film import read_film
from ...sensor.materials import check_choices, read_thermal
from ...sensor.signals import read_signal
from ...sensor.vibration import read_texture
from ...skin.settings import plain, read_dict, read_settings
from ..objects import OBJECTS, make_object
from ..store import TactileSet, shard_path
from .plan import KINDS
from .vary import check_vary

_MOST_STEPS = 2000  # a batch is in memory with all its nodes


@dataclasses.dataclass(frozen=True)
class GenerateOptions:
    """Settings of a set. All except `device` are stored with the set and must be the same when an interrupted
    run continues.

    Attributes:
      count: interactions. labelled: number of them with readings of the synthetic measured sensor; the
        paper's indenters only.
      steps: time steps of each. rate: of them [Hz].
      seed: of everything.
      objects, kinds: to draw from.
      skin, tier, material, element, liquid: of the simulated sensor, as in `biotac press`; element and liquid
        None: the material's. The material may be a dict of Material's fields, or a .json file of them.
      options: {"skin": some of SkinOptions' fields, "modulus": factors on Young's modulus of the elements,
        or a .npy file, "film": see `sensor.film.read_film`}, or a .json file of it.
      vary: {name: (low, high)}, ranges of random values per interaction: youngs_modulus, poissons_ratio,
        friction, stiffening of the material; factors prony and hysteresis on its strengths; and properties
        that may differ between worlds except modulus (`skin.per_world.NAMES`). The values are stored in the
        interaction's parameters, under "skin".
      sensor, randomise: which sensor (None: the design's own), and random effects, see `biotac_mj.attach`;
        random values are drawn per interaction and stored in its parameters.
      signal: source of the electrodes: "physics", "latent_projection", "learned", or a file of weights, see
        `biotac_mj.attach`.
      thermal: material of all objects ("steel", see `sensor.materials.read_thermal`), texture: of their
        surface (`sensor.vibration.read_texture`); of a list one is drawn per interaction. None: no heat or
        vibration. textures: alias of texture, as in attach.
      batch, measured_batch: most worlds in a batch, and in one with the synthetic measured sensor: on a fine
        mesh a step costs a GPU the same for 20 or 100 worlds, so such a batch mixes its objects. A shard
        holds one batch.
      measured_seed, measured_skin: number and mesh of the synthetic measured sensor; None: the finest of the
        skin's design.
      device: "cpu", "cuda:0", or several as in "cuda:0,cuda:1": one process each, which take batches from a
        queue. The files do not depend on the number of devices of one kind.
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
    material: str | dict = "default"
    element: str | None = None
    liquid: bool | None = None
    sensor: str | dict | None = None
    randomise: tuple | dict = ()
    signal: str = "physics"
    thermal: str | dict | tuple | None = None
    texture: str | dict | tuple | None = None
    batch: int = 160
    measured_batch: int = 90
    measured_seed: int = 0
    measured_skin: str | None = None
    device: str = "cpu"
    options: str | dict | None = None
    vary: str | dict | None = None
    textures: dataclasses.InitVar[str | dict | tuple | None] = None

    def __post_init__(self, textures):
        texture = either("texture", self.texture, {"texture": textures}, "textures")
        object.__setattr__(self, "texture", texture)
        object.__setattr__(self, "objects", tuple(self.objects))
        object.__setattr__(self, "kinds", tuple(self.kinds))
        object.__setattr__(self, "material", plain(self.material))
        for name in ("options", "vary"):
            value = getattr(self, name)
            object.__setattr__(self, name, None if value is None else plain(read_dict(value, name)))
        check_types(self)
        check_vary(self.vary or {})
        design = design_of(self.skin)
        if not design.nelectrode:
            raise ValueError(
                f"{design.title} has no electrodes: press it with `biotac press`, which needs none"
            )
        if self.sensor is None:
            object.__setattr__(self, "sensor", design.sensor)
        if self.measured_skin is None:
            object.__setattr__(self, "measured_skin", mesh_of_same_design(self.skin, "fine"))
        take_sensor({"sensor": self.sensor, "randomise": self.randomise}, design=design)
        if read_signal(self.signal)[0] != "physics" and "film" in (self.options or {}):
            raise ValueError("a network replaces the film: leave film out of options")
        for value, read in ((self.thermal, read_thermal), (self.texture, read_texture)):
            if value is not None:
                check_choices(value, read)
        if self.vary and self.tier == "condensed":
            raise ValueError(
                "the condensed tier has one skin for all interactions: leave vary out, or choose tier='full'"
            )
        as_whole("steps", self.steps, 8, _MOST_STEPS)
        for name in ("count", "batch", "measured_batch"):
            as_whole(name, getattr(self, name), 1)
        for name in ("seed", "measured_seed"):
            as_whole(name, getattr(self, name), 0)
        as_whole("labelled", self.labelled, 0, self.count)
        kinds = {name.split(":")[0] for name in self.devices}
        if len(kinds) != 1 or not kinds <= {"cpu", "cuda"} or len(set(self.devices)) < len(self.devices):
            raise ValueError(
                f"device is {self.device!r}: "
                "choose cpu, cuda:0, or several GPUs once each, as in cuda:0,cuda:1"
            )
        as_real("rate", self.rate, 0.0, above=True, unit="Hz")
        check_choice("unknown tier", self.tier, ("full", "condensed"))
        if not self.objects:
            raise ValueError(f"unknown object list: it is empty: choose from {', '.join(OBJECTS)}")
        for name in self.objects:
            try:
                make_object(name)
            except (ValueError, FileNotFoundError) as error:
                raise ValueError(f"objects: {error}") from None
        unknown = [name for name in self.kinds if name not in KINDS]
        if unknown or not self.kinds:
            raise ValueError(f"unknown kind of interaction {unknown}: choose from {', '.join(KINDS)}")
        if self.labelled and not set(self.objects) & set(INDENTERS):
            raise ValueError(
                "labelled interactions are made with the eight indenters: "
                "add one of them to the objects, or take 0 labelled"
            )

    @property
    def devices(self) -> list[str]:
        return [name.strip() for name in self.device.split(",")]


@dataclasses.dataclass(frozen=True)
class GenerateReport:
    """Result of a run.

    Attributes:
      interactions, steps: in the set. nonconverged: of these steps.
      made: shards made by this run; existing ones are kept.
      seconds: wall time of this run, in total and per stage (summed over devices). bytes: of the shards.
        device: its name.
      devices: number of devices in parallel.
    """

    interactions: int
    steps: int
    nonconverged: int
    made: int
    seconds: dict
    bytes: int
    device: str
    devices: int


@dataclasses.dataclass(frozen=True)
class Batch:
    """Interactions that are simulated in one batch and stored in one shard.

    Attributes:
      names: object of each member. members: numbers of the interactions.
      measured: whether the synthetic measured sensor takes part.
      path: of the shard in the set's folder.
    """

    names: list
    members: list
    measured: bool
    path: str


def batches(options: GenerateOptions) -> list[Batch]:
    """Labelled interactions first, then the others. Objects alternate, so that a part of a set is
    representative."""
    indenters, out = [name for name in options.objects if name in INDENTERS], []
    roles = (0, options.labelled, indenters, True), (options.labelled, options.count, options.objects, False)
    for first, end, names, measured in roles:
        size = options.measured_batch if measured else options.batch
        for k in range(1 if measured else len(names)):
            members = np.arange(first + k, end, 1 if measured else len(names))
            for chunk in np.array_split(members, -(-len(members) // size)) if len(members) else ():
                objects = [names[(i - first) % len(names)] for i in chunk]
                out.append(Batch(objects, chunk.tolist(), measured, shard_path("", len(out)).as_posix()))
    return out


def generate(
    out: pathlib.Path | str,
    options: GenerateOptions = GenerateOptions(),
    workers: int | None = None,
    progress: bool = True,
    ray: str | None = None,
) -> GenerateReport:  # noqa: B008 - frozen
    """Makes a set in folder `out`, or completes it.

    Args:
      out: folder.
      options: see GenerateOptions.
      workers: processes, which make whole shards on the CPU, or compute film and readings for GPUs; None:
        number of cores, 0: this process.
      progress: whether to show a bar.
      ray: address of a Ray cluster, or "local": a task for each batch, with one core, one GPU if the device
        is one, and `workers` cores (None: 0).

    Raises:
      ValueError: the folder holds a set with other options, or an option is not possible.
      FileNotFoundError: no such skin.
    """
    from .making import make_shards

    out = pathlib.Path(out)
    read_settings(options.material, options.options, ("film",))  # raise for invalid or missing ones
    skin, measured = (design_of(name) for name in (options.skin, options.measured_skin))
    if options.labelled and measured != skin:
        raise ValueError(
            f"the measured sensor is a {measured.title} and the simulated one a {skin.title}: "
            "take --measured-skin of the same, or leave it out"
        )
    read_film((options.options or {}).get("film"), geometry=load_skin(options.skin))
    for name in ("element", "liquid"):
        either(name, getattr(options, name), (options.options or {}).get("skin"), "options['skin']")
    settings = {k: v for k, v in dataclasses.asdict(options).items() if k != "device"} | {
        "device": options.device.split(":")[0]
    }
    settings = json.loads(json.dumps(settings))
    settings |= _digests(settings)
    todo = [batch for batch in batches(options) if not made_already(out / batch.path, settings)]
    begin = time.perf_counter()
    if workers is None and ray is not None:
        workers = 0
    if workers is None:
        workers = len(os.sched_getaffinity(0)) if len(os.sched_getaffinity(0)) > 1 else 0
    seconds = make_shards(out, options, settings, todo, workers, progress, ray) if todo else {}
    seconds["all"] = time.perf_counter() - begin
    with TactileSet(out) as data:
        report = GenerateReport(
            interactions=len(data),
            steps=data.nstep,
            nonconverged=int((~data["converged"][:]).sum()),
            made=len(todo),
            seconds={name: round(value, 1) for name, value in seconds.items()},
            bytes=sum(path.stat().st_size for path in out.rglob("shard-*.h5")),
            device=data.attributes["device"],
            devices=len(options.devices),
        )
    if todo:
        write_json(out / "generate.json", {**dataclasses.asdict(report), "settings": settings})
    return report


def _digests(settings: dict) -> dict:
    """{"files": {path: first digits of its SHA-256}} of the files that settings name, if there are any: a set
    whose mesh or material changes between two runs would have two of them under one name."""
    found, left = {}, list(settings.values())
    while left:
        value = left.pop()
        if isinstance(value, (dict, list)):
            left += value.values() if isinstance(value, dict) else value
        elif isinstance(value, str) and (path := pathlib.Path(value.removeprefix("mesh:"))).is_file():
            found[str(path)] = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    return {"files": found} if found else {}


def made_already(path: pathlib.Path, settings: dict) -> bool:
    """Whether a shard exists; ValueError if it was made with other settings."""
    if not path.is_file():
        return False
    with TactileSet(path) as data:
        found = data.attributes.get("settings", {})
    different = [f"{k} {found.get(k)!r} there, {v!r} now" for k, v in settings.items() if found.get(k) != v]
    if different:
        raise ValueError(
            f"{path} was made with other options ({'; '.join(different)}): "
            "use another --out, or delete that set"
        )
    return True
