"""The simulator as stages and effects: where objects are, skin, transduction, acquisition; saved as YAML.

Poses are the input, readings the output. The skin is solved for the recorded poses (`fields`), and once more
for each small change of them: these differences make every effect of the set-up affordable, and are used with
`exact=False`. `exact=True` solves the skin anew with the effects in place.
"""

import copy
import dataclasses
import pathlib
import typing
from collections.abc import Callable, Sequence

import numpy as np

from ....cache import Entry
from ....data.objects import make_object
from ....effects.contact import TACKY
from ....effects.effect import STAGES, Run, shifted
from ....effects.sensor_file import SensorFile, write_sensor_file
from ....fields import check_types
from ....geometry.design import Design
from ....geometry.skins import design_of, load_skin
from ....sensor.channels import counts_from_impedance
from ....sensor.film import read_film
from ....sensor.presets import SENSORS, Sensor, read_sensor
from ....skin.contact.law import GridTooCoarse
from ....skin.settings import plain, read_dict, read_material, read_settings
from ..base.nuisance import BETWEEN, KNOWN, Nuisance, widen
from ..trajectory import Trajectory
from .differences import differences, softer, solved_fields, tacky
from .fields import Fields, nearest, sizes, square, squared_distance, stack

TIERS = ("condensed", "full")
_NEAR = 0.15  # of the parameters at which the skin was solved: differences from there reach so far
_STEP = 0.3  # of a parameter's scale, for the change by it where the skin is solved with effects
_SURE = 0.02  # of them, with `exact`
_AIR = 101325.0  # [Pa]
_WORLDS = 64  # trajectories solved at once
# what changes a sensor's answer to a touch, or its course in time: comparisons about the rest see no other
_ACTING = "mixing pdc_gain warm_up relaxation loss drift power saturation lowpass latency".split()


@dataclasses.dataclass
class Simulator:
    """A sensor that can be compared with data.

    Attributes:
      skin, tier, material: as for `biotac press`; tier "condensed" or "full".
      effects: list of (Effect, theta) in any order; stages decide.
      material: may also be a dict of Material's fields or a .json file. sensor: a name as for `biotac press`
        (None: the design's own) except "random", or a dict of fields of `sensor.presets.Sensor`, whose
        counts at rest and noise may differ from the design's. A measured sensor supplies these two, but not
        its warm-up.
      options: {"skin": ..., "modulus": ...} of the skin, see `skin.settings.read_settings`, and "film", see
        `sensor.film.read_film`.
      device: of the full tier, "cpu" or "cuda:0", where trajectories are worlds of one batch.
      modulus: factor on the material's Young's modulus. cache: folder of solved fields, or None.
      intervals: {effect id: {parameter: (low, high)}} for the YAML.
      log_rest: (nelectrode,) that is added to ln Z of all that is solved, so that electrodes rest where
        those of a recording do; `rested` makes it the sensor's own, as the YAML has it.
    """

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

    def with_effects(self, effects: list, modulus: float | None = None) -> "Simulator":
        """A copy with these effects added."""
        other = copy.copy(self)
        other.effects = [*self.effects, *effects]
        other.modulus = self.modulus if modulus is None else modulus
        return other

    def but(self, models: dict | None = None, **changes: object) -> "Simulator":
        """A copy with other fields.

        Args:
          models: its skins by bubble, and its "film", where they are made; None makes them on first use.
        """
        other = copy.copy(self)
        other.__dict__.update(changes, _models={} if models is None else models)
        return other

    def rested(self, log_rest: np.ndarray) -> "Simulator":
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

    # --- the skin  ---

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
        fields = simulate(model, [tool for _, tool, *_ in todo], motions, time=times, tier=self.tier)
        for w, (i, _, pos, _, _, entry) in enumerate(todo):
            n = len(pos)
            impedance = _impedance(film, fields.vert_xpos(model.geometry.vert, w)[:n])
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
                volume = store[0.0].liquid_volume if 0.0 in store else 366e-9
                # liquid and air in series: V / K + V0 / p0
                options = dataclasses.replace(
                    options, bulk_modulus=1 / (1 / options.bulk_modulus + bubble / (_AIR * volume))
                )
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

    def fields(
        self, trajectories: list[Trajectory], progress: bool = True, places: Sequence[str] | None = None
    ) -> Fields:
        """The skin along the trajectories and its differences, see `solved_fields`."""
        return solved_fields(self, trajectories, progress, places)

    def stick(self, fields: "Fields", work: float, near: float = _NEAR) -> bool:
        """Solves the skin with a contact of this work of adhesion [J/m2], see `Adhesion`, and stores its
        effect in the fields: pull-off is not linear in the work.

        Returns: whether that was needed and could be; not where it was solved near it (by `near` of it)
        already, nor where the contact reaches farther than the distance to a tool's mesh is exact: the
        largest work that was solved is then as far as it goes."""
        solved = [float(name.removeprefix(TACKY)) for name in fields.slopes if name.startswith(TACKY)]
        if work <= 0 or any(abs(work - at) < near * at for at in solved):
            return False
        try:
            base = [one | {"log_z": one["log_z"] - self.log_rest} for one in fields.base]
            solved = differences([tacky(self, work)], fields.trajectories, base)
        except GridTooCoarse:
            return False
        for name, change in solved.items():
            fields.add(name, change)
        return True

    # --- all stages  ---

    def run(
        self,
        trajectories: list[Trajectory],
        fields: "Fields | None" = None,
        exact: bool | list = True,
        effects: list | None = None,
        modulus: float | None = None,
        offsets: list | None = None,
        nuisance: Nuisance = KNOWN,
    ) -> list[Run]:
        """Simulates the readings of the sensor, without noise and rounding.

        Args:
          fields: Fields of the trajectories; None solves them.
          exact: solve the skin anew where effects move the object; False uses the fields' differences; a list
            of indices does so for those trajectories alone.
          effects, modulus: None takes the simulator's; offsets: list of (3,) further shifts of the poses [m].
          nuisance: what the base model is off by; its modulus is a factor on the simulator's.
        """
        effects = self.effects if effects is None else effects
        modulus = (self.modulus if modulus is None else modulus) * nuisance.modulus
        if fields is None:
            base = [one | {"log_z": one["log_z"] + self.log_rest} for one in self.solve(trajectories)]
            slopes = {} if modulus == 1.0 else differences(softer(self), trajectories, base)
            fields = Fields(base, slopes, trajectories)
        for effect, theta in effects:
            work = effect.joining(theta)
            if work is None:
                continue
            if self.tier != "full":
                raise ValueError(
                    "adhesion by its work of joining acts in the contact, as in the full tier alone: "
                    "take tier='full', or leave it out"
                )
            if exact is not False:
                self.stick(fields, work, _SURE)
        ordered = sorted(effects, key=lambda item: list(STAGES).index(item[0].stage))
        before = [(e, th) for e, th in ordered if e.before_skin]
        after = [(e, th) for e, th in ordered if (e, th) not in before]
        session, runs = {}, []
        for i, begun in enumerate(fields.begun):
            run = copy.copy(begun)
            run.session, run.modulus, run.log_friction = session, modulus, nuisance.log_friction
            run.log_z = begun.log_z.copy()
            run.stiffness = modulus * begun.stiffness
            run.scale_load(modulus)
            if offsets is not None:
                run.offset = run.offset + offsets[i]
            for effect, theta in before:
                effect.apply(run, theta)
            runs.append(run)
        self._mechanics(trajectories, runs, fields, exact, modulus, before)
        weights = [(getattr(nuisance, name), name) for name in BETWEEN if name in fields.slopes]
        if "modulus" in fields.slopes:
            weights.append((np.log(modulus), "modulus"))
        for i, run in enumerate(runs):
            between = sum(by * fields.slopes[name][i] for by, name in weights if by)
            if nuisance.log_film and fields.film is not None:
                between = between + fields.film.at(i, nuisance.log_film)
            if np.ndim(between):
                run.add(between)
            if nuisance.footprint:
                run.log_z = widen(run.log_z, run.rest_log_z, nuisance.footprint, self.design)
        for i, run in enumerate(runs):
            for stage in ("K", "C", "T"):
                for effect, theta in after:
                    if effect.stage != stage:
                        continue
                    effect.apply(run, theta)
                    missed = fields.recalled(effect, theta, i)
                    if missed is not None:
                        run.add(missed)
            if np.ndim(run.turn) and run.turn.any():  # the force is given in the frame of the poses
                run.force = run.force - np.cross(run.turn, run.force)
            log_z = run.log_z - nuisance.stands_off * self.log_rest if nuisance.stands_off else run.log_z
            run.counts = 4095 / (np.exp(log_z) / 1e4 + 1)
            if nuisance.age:
                run.counts = shifted(run.counts, run.time, nuisance.late(self.design))
            run.pdc = 2000 + run.pressure / 36.5
            for effect, theta in after:
                if effect.stage == "A":
                    effect.apply(run, theta)
        return runs

    def bend(
        self, fields: "Fields", effects: list, nuisance: Nuisance, which: np.ndarray, tangents: bool = False
    ) -> bool:
        """Solves the skin of trajectories `which` with the effects in place, and keeps with the fields what
        their differences miss of those that move the object or change the contact, all together: from then on
        `exact=False` is right at their parameters.

        Args:
          tangents: solve it as well with each of their parameters changed a little: then it is right about
            them too. A sensor that is turned by a degree touches elsewhere, where a fit by the differences
            without effect does not find its way.

        Returns: whether that was needed; not where it was solved near them already."""
        moving = [(e, th) for e, th in effects if e.before_skin]
        ids, now = frozenset(e.id for e, _ in moving), sizes(moving)
        if ids in fields.curves:
            there, curve, known = nearest(fields.curves[ids], now)
            near = squared_distance(now, there) < _NEAR**2 * square(there)
            if set(which) <= set(curve) and near and (known or not tangents):
                return False
        some = [fields.trajectories[i] for i in which]
        quick = self if self.tier == "condensed" else self.but(tier="condensed")
        plain = dataclasses.replace(
            nuisance, mesh=0.0, tier=0.0, log_film=0.0, footprint=0.0, log_modulus=0.0, age=0.0
        )
        part = fields.part(which)

        def missed(of):
            near, true = (quick.run(some, part, exact, of, 1.0, None, plain) for exact in (False, True))
            return {i: stack(vars(b)) - stack(vars(a)) for i, a, b in zip(which, near, true)}

        here, changes = missed(moving), {}
        for k, (effect, theta) in enumerate(moving) if tangents else ():
            for name in effect.free:
                p = effect.params[name]
                by = _STEP if theta[name] + _STEP * p.scale < p.high else -_STEP
                nearby = (effect, theta | {name: theta[name] + by * p.scale})
                other = missed([*moving[:k], nearby, *moving[k + 1 :]])
                changes[effect.id, name] = {i: (other[i] - here[i]) / by for i in which}
        fields.curves.setdefault(ids, []).append((now, here, changes))
        return True

    def _mechanics(self, trajectories, runs, fields, exact, modulus, moving):
        """Force, pressure and ln Z of runs whose object or contact has changed."""
        changed = [
            i
            for i, r in enumerate(runs)
            if np.abs(r.offset).max() > 1e-9 or r.log_radius or r.log_friction or r.bubble
        ]
        if exact is True:
            anew = changed
        elif exact is False:
            anew = []
        else:
            anew = [i for i in changed if i in set(np.atleast_1d(exact).tolist())]
        if anew:
            kept = [runs[i] for i in anew]
            solved = self.solve(
                [_turned(trajectories[i], runs[i].turn) for i in anew],
                [r.offset for r in kept],
                [r.log_radius for r in kept],
                kept[0].log_friction,
                kept[0].bubble,
            )
            for run, one in zip(kept, solved):
                run.force, run.pressure, run.log_z = (
                    modulus * one["force"],
                    modulus * one["pressure"],
                    one["log_z"] + self.log_rest,
                )
        curves = fields.bent(moving)
        for i in sorted(set(changed) - set(anew)):
            run = runs[i]
            parts = [
                ("radius", run.log_radius),
                ("friction", run.log_friction),
                ("friction2", run.log_friction**2),
                ("bubble", run.bubble),
            ]
            change = fields.shifted(i, run.offset) if run.offset.any() else 0.0
            for name, amount in parts:
                several = np.ndim(amount) > 0
                if name in fields.slopes and (amount.any() if several else amount):
                    slope = fields.slopes[name][i]
                    change = change + slope * (amount[:, None] if several else amount)
            for curve, weight in curves:
                if i in curve:
                    change = change + weight * curve[i]
            if np.ndim(change):
                run.add(change)

    # --- YAML  ---

    @property
    def file(self) -> SensorFile:
        """The stages and effects as a sensor file has them."""
        base = {"skin": self.skin, "tier": self.tier, "material": plain(self.material)}
        base |= {"options": plain(self.options)} if self.options else {}
        base |= {"sensor": self.sensor, "constitutive": self.constitutive}
        base["modulus_factor"] = float(self.modulus)
        return SensorFile(base, self.effects, self.intervals)

    def save(self, path: pathlib.Path | str) -> None:
        """Writes the stages and effects as YAML."""
        write_sensor_file(path, self.file)


def _turned(t, turn):
    """A trajectory whose object is turned by rotation vectors (3,) or (n, 3)."""
    if not np.any(turn):
        return t
    from scipy.spatial.transform import Rotation

    return dataclasses.replace(t, mat=Rotation.from_rotvec(turn).as_matrix() @ t.mat)


def placed(
    trajectories: list[Trajectory], offset: list | None, log_radius: list | None
) -> list[tuple[str, np.ndarray]]:
    """Tool and positions (n, 3) of each trajectory (`Simulator.solve`); a larger sphere keeps its tip."""
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


def _impedance(film, vert_xpos):
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
