"""The skin solved along trajectories by the settings of a sensor that can be compared with data."""

import copy
import dataclasses
import typing
import weakref
from collections.abc import Callable

import numpy as np

from ....cache import Entry
from ....data.objects import make_object
from ....effects.amended import with_liquid
from ....effects.effect import Whole
from ....fields import check_types
from ....geometry.design import Design
from ....geometry.skins import design_of, load_skin
from ....sensor.channels import counts_from_impedance
from ....sensor.film import read_film
from ....sensor.presets import SENSORS, Sensor, read_sensor
from ....skin.settings import plain, read_dict, read_material, read_settings
from ..trajectory import Trajectory

if typing.TYPE_CHECKING:
    from ....sensor.film import FilmConduction

TIERS = ("condensed", "full")
_WORLDS = 64  # trajectories solved at once
_LAST = weakref.WeakKeyDictionary()  # what a skin was solved for last, and its fields
# what changes a sensor's answer to a touch, or its course in time: comparisons about the rest see no other
_ACTING = "mixing pdc_gain warm_up relaxation loss drift power saturation lowpass latency".split()


@dataclasses.dataclass
class Solver:
    """The part of a `Simulator` that solves the skin; its settings are described there."""

    skin: str = "coarse"
    tier: str = "condensed"
    material: str | dict = "default"
    sensor: str | dict | None = None
    effects: list = dataclasses.field(default_factory=list)
    modulus: float = 1.0
    cache: str | None = None
    device: str = "cpu"
    intervals: dict = dataclasses.field(default_factory=dict)
    options: dict = dataclasses.field(default_factory=dict)
    log_rest: np.ndarray | float = 0.0

    constitutive: typing.ClassVar[str] = "reduced"  # where constitutive effects act: on what the rubber bears

    def __post_init__(self):
        check_types(self, ("skin", "tier", "sensor", "modulus", "device"))
        if self.sensor is None:
            self.sensor = self.design.sensor
        sensors = tuple(self.design.sensors)
        for name, value, known in (("tier", self.tier, TIERS), ("sensor", self.sensor, sensors)):
            if isinstance(value, str) and value not in known:
                raise ValueError(f"{name} is {value!r}: choose one of {', '.join(known)}")
        if not 0 < self.modulus < np.inf:
            raise ValueError(f"the factor on the modulus is {self.modulus}: pass a positive finite number")
        self._read()  # refuses what cannot be
        own, plain_one = self._numbers(), SENSORS["1"]
        other = [n for n in _ACTING if own is not None and getattr(own, n) != getattr(plain_one, n)]
        if other and isinstance(self.sensor, str):  # so that it is written, and run, without them too
            self.sensor = {"like": self.sensor, **{n: getattr(plain_one, n) for n in other}}
        elif other:
            raise ValueError(
                f"sensor has {', '.join(other)}, which the diagnosis does not simulate: leave that out "
                "of the sensor's numbers, DATA is searched for it"
            )

    @property
    def design(self) -> Design:
        """Design of the skin."""
        return design_of(self.skin)

    def but(self, models: dict | None = None, **changes: object) -> typing.Self:
        """A copy with other fields.

        Args:
          models: its skins by bubble, and its "film", where they are made; None makes them on first use.
        """
        other = copy.copy(self)
        other.__dict__.update(changes, _models={} if models is None else models)
        return other

    def rested(self, log_rest: np.ndarray) -> typing.Self:
        """A copy whose sensor rests where its impedances are exp(log_rest) (nelectrode,) times what they
        were."""
        if not np.any(log_rest):
            return copy.copy(self)
        rest = counts_from_impedance(self._read_sensor(self.sensor).impedance * np.exp(log_rest))
        given = dict(self.sensor) if isinstance(self.sensor, dict) else {"like": self.sensor}
        return self.but(sensor={**given, "rest": rest.round(2).tolist()})

    @property
    def _like(self):
        """Name of the sensor with whose rests solved fields are kept."""
        return self.sensor if isinstance(self.sensor, str) else self.sensor.get("like", self.design.sensor)

    def _own_rest(self):
        """(nelectrode,) ln of its impedances at rest over those of the sensor that it is like: a constant
        factor on each, whatever the skin does."""
        if isinstance(self.sensor, str):
            return np.zeros(self.design.nelectrode)
        own, like = map(self._read_sensor, (self.sensor, self._like))
        return np.log(own.impedance / like.impedance)

    def _read_sensor(self, given) -> Sensor:
        return read_sensor(given, design=self.design)

    def _numbers(self):
        """The sensor's own, where they are not those of a published one."""
        published = isinstance(self.sensor, str) and self.sensor in self.design.published
        return None if published else self._read_sensor(self.sensor)

    def _read(self, **defaults):
        """Settings of the skin, and of its film."""
        settings = read_settings(self.material, self.options, ("film",), **defaults)
        given = read_dict(self.options, "options").get("film")
        on = load_skin(self.skin) if given else None  # whose excitation it moves
        return settings, read_film(given, settings.material.electrode_radius, on)

    def solve(
        self,
        trajectories: list[Trajectory],
        offset: list | None = None,
        log_radius: list | None = None,
        log_friction: float = 0.0,
        bubble: float = 0.0,
        progress: Callable[[], object] | None = None,
    ) -> list:
        """Per trajectory a dict: force (n, 3) of the skin on the object [N], pressure (n,) [Pa], log_z (n,
        nelectrode); kept in `cache`.

        Args:
          offset: list of (n, 3) [m], or None; log_radius: list of floats, or None.
        """
        out, todo = [None] * len(trajectories), []
        for i, (t, (tool, pos)) in enumerate(zip(trajectories, placed(trajectories, offset, log_radius))):
            entry = None if self.cache is None else self._entry(t, tool, pos, log_friction, bubble)
            out[i] = None if entry is None else entry.load()
            if out[i] is None:
                todo.append((i, tool, pos, t.mat, t.time, entry))
                continue
            out[i]["log_z"] = out[i]["log_z"] + self._own_rest()
            if progress:
                progress()
        for part in range(0, len(todo), _WORLDS):
            self._walk(todo[part : part + _WORLDS], out, log_friction, bubble, progress)
        return out

    def _entry(self, trajectory, tool, pos, log_friction, bubble):
        """Cache entry of a solution; poses are rounded, so that another order of sums has no influence."""
        material = read_material(self.material)
        inputs = [load_skin(self.skin), self.tier, material, plain(self.options), self._like]
        inputs += [make_object(tool), round(log_friction, 9), round(bubble * 1e12, 6)]
        inputs += [np.round(pos, 9), np.round(trajectory.mat, 9)]
        if material.prony or self.options:  # else a solution does not depend on time
            inputs.append(trajectory.time)
        code = "geometry", "skin", "sensor", "data/generation/simulate", "discrepancy/trajectories/model"
        return Entry("field", inputs, code, self.cache)

    def _walk(self, todo, out, log_friction, bubble, progress):
        """Solves trajectories (index, tool, pos, mat, time, entry of the cache), each one world, and files
        what they gave."""
        from ....data.generation.plan import Motion
        from ....data.generation.simulate import simulate

        model, film = self.skin_and_film(log_friction, bubble)  # kept: made once
        longest = max(len(pos) for _, _, pos, _, _, _ in todo)
        # shorter trajectories wait at their end
        rows = [np.minimum(np.arange(longest), len(pos) - 1) for _, _, pos, _, _, _ in todo]
        motions = [Motion("recorded", {}, pos[r], mat[r]) for r, (_, _, pos, mat, _, _) in zip(rows, todo)]
        times = [_waiting(time, longest) for *_, time, _ in todo]
        tools = [tool for _, tool, *_ in todo]
        poses = [a.tobytes() for m, time in zip(motions, times) for a in (m.pos, m.mat, time)]
        asked = self.tier, tools, poses  # one skin under several films is solved once
        known, fields = _LAST.get(model, (None, None))
        if known != asked:
            fields = simulate(model, tools, motions, time=times, tier=self.tier)
            _LAST[model] = asked, fields
        for w, (i, _, pos, _, _, entry) in enumerate(todo):
            n = len(pos)
            impedance = impedance_of(film, fields.vert_xpos(model.geometry.vert, w)[:n])
            out[i] = {
                "force": fields.wrench[w, :n, :3].copy(),
                "pressure": fields.pressure[w, :n].copy(),
                "log_z": np.log(impedance),
            }
            if entry is not None:
                entry.save(out[i] | {"log_z": out[i]["log_z"] - self._own_rest()})
            if progress:
                progress()

    def skin_and_film(self, log_friction: float, bubble: float) -> tuple:
        """SkinModel with friction times exp(log_friction) and a bubble [m^3], and its FilmConduction."""
        from ....sensor.film import FilmConduction
        from ....skin.model import SkinModel

        store = self.__dict__.setdefault("_models", {})
        if bubble not in store:
            geometry = load_skin(self.skin)
            rubber, options, modulus = self._read(liquid=True)[0]
            if bubble:
                options = with_liquid(options, Whole(air=bubble), geometry)
            device = "cpu" if self.tier == "condensed" else self.device
            model = store[bubble] = SkinModel(geometry, rubber, options, device, modulus=modulus)
        model = store[bubble]
        if "film" not in store:
            (_, options, _), film = self._read(liquid=True)
            filled = options.fill_volume or options.rest_pressure
            solved = model.geometry  # with all nodes that are solved
            rest = dataclasses.replace(solved, vert=model.rest.vert) if filled else solved
            store["film"] = FilmConduction(rest, sensor=self._numbers() or self.sensor, **film)
        if log_friction:
            model = copy.copy(model)
            model.material = dataclasses.replace(
                model.material, friction=model.material.friction * float(np.exp(log_friction))
            )
        return model, store["film"]


def placed(
    trajectories: list[Trajectory], offset: list | None, log_radius: list | None
) -> list[tuple[str, np.ndarray]]:
    """Tool and positions (n, 3) of each trajectory (`Solver.solve`); a larger sphere keeps its tip."""
    out = []
    for i, t in enumerate(trajectories):
        tool, pos = t.tool, t.pos + (0.0 if offset is None else offset[i])
        if log_radius is not None and log_radius[i] and "sphere" in tool:
            radius = _sphere_radius(tool)
            tip = pos if not tool.startswith("geom:") else pos + radius * t.mat[:, :, 1]
            radius *= np.exp(float(log_radius[i]))
            tool, pos = f"geom:sphere:{radius:.9g}", tip - radius * t.mat[:, :, 1]
        out.append((tool, pos))
    return out


def impedance_of(film: "FilmConduction", vert_xpos: np.ndarray) -> np.ndarray:
    """(n, nelectrode) [ohm]; a row whose film has no solution keeps the last one, as does one that has not
    moved."""
    rows, last = [], None
    for x, before in zip(vert_xpos, [None, *vert_xpos]):
        try:
            if before is None or not np.array_equal(x, before):
                last = film.impedance(x)
        except ValueError:
            if last is None:
                raise
        rows.append(last)
    return np.array(rows)


def _sphere_radius(tool):
    if tool.startswith("geom:sphere:"):
        return float(tool.split(":")[2])
    return float(tool.removeprefix("sphere_").removesuffix("mm").replace("-", ".")) * 0.5e-3


def _waiting(time, count):
    """Times (count,) of a trajectory that waits at its end, as often as it came."""
    more = time[-1] + (time[-1] - time[-2]) * np.arange(1, count - len(time) + 1)
    return np.concatenate([time, more])
