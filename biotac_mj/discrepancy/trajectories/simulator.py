"""The simulator as stages and effects: where objects are, skin, transduction, acquisition; saved as YAML.

Poses go in, what the sensor would read comes out. The skin is solved for the poses as they are (`fields`),
and once more for each small change of them: these differences make every effect of the set-up affordable, and
what uses them says so (`exact=False`). `exact=True` solves the skin anew with the effects in place.
"""

import contextlib
import copy
import dataclasses
import hashlib
import pathlib
import typing
from collections.abc import Callable

import numpy as np
import tqdm

from ...effects.contact import TACKY, Adhesion
from ...effects.effect import STAGES, Run
from ...effects.in_skin import memory_of
from ...effects.rubber import Stiffening, modulus_of
from ...effects.sensor_file import SensorFile, write_sensor_file
from ...fields import check_types
from ...files import write_npz
from ...geometry.skins import load_skin
from ...reading import Array, read_npz
from ...sensor.channels import REST_COUNTS
from ...sensor.film import read_film
from ...sensor.presets import SENSORS, read_sensor
from ...skin.contact.law import GridTooCoarse
from ...skin.settings import plain, read_dict, read_material, read_settings
from .base.nuisance import BETWEEN, KNOWN, OTHER_MESH, Nuisance, aged, widen
from .fields import MAPS, Fields, apart, nearest, sizes, stack

if typing.TYPE_CHECKING:
    from .trajectory import Trajectory

__all__ = ["Simulator", "placed", "spots"]

TIERS = ("condensed", "full")
_SHIFT = 40e-6  # [m] of the poses for differences
_DEEPER = 0.12e-3  # [m] along the press, either way: load rises faster than depth
_FRICTION = -0.7, 0.4  # of its logarithm: what sticks and what slides changes
_RADIUS, _BUBBLE = 0.15, 8e-9
_NEAR = 0.15  # of the parameters at which the skin was solved: differences from there reach so far
_SURE = 0.02  # of them, where the skin itself is asked for
_FILM = 0.5  # of the logarithm of its least thickness
_SOFTER = -0.25  # of the logarithm of the modulus
_UNEVEN = 0.2  # [1/cm] of the modulus
_SPOT, _SPOTS, _NEAR_SPOT = 0.5, 3, 4e-3  # of its logarithm in a spot; at most; [m] of those touched there
_SUNK = 60e-6  # [m] of the skin towards the core
_FILL = 0.02  # of the liquid; the condensed tier takes no less than there is
_AIR = 101325.0  # [Pa]
_TACKY = 1.0, 4.0  # [J/m2] of joining, see `stick`
_STIFFER = 0.3  # c2 of `effects.rubber.Stiffening`
_WORLDS = 64  # trajectories solved at once
# what changes a sensor's answer to a touch, or its course in time: comparisons about the rest see no other
_ACTING = "mixing pdc_gain warm_up relaxation loss drift power saturation lowpass latency".split()


@dataclasses.dataclass
class Simulator:
    """A sensor that can be compared with data.

    Attributes:
      skin, tier, material, sensor: as for `biotac press`; tier "condensed" or "full".
      effects: list of (Effect, theta) in any order; stages decide.
      material: may also be a dict of Material's fields or a .json file. sensor: "1", "2", "3", or a dict of
        `sensor.presets.Sensor`'s fields, of which rests and noise may be other ones than sensor 1's.
      options: {"skin": ..., "modulus": ...} of the skin, see `skin.settings.read_settings`, and "film", see
        `sensor.film.read_film`.
      device: of the full tier, "cpu" or "cuda:0", where trajectories are worlds of one batch.
      modulus: factor on the material's Young's modulus. cache: folder of solved fields, or None.
      intervals: {effect id: {parameter: (low, high)}} for the YAML.
    """

    skin: str = "coarse"
    tier: str = "condensed"
    material: str | dict = "default"
    sensor: str | dict = "1"
    effects: list = dataclasses.field(default_factory=list)
    modulus: float = 1.0
    cache: str | None = None
    device: str = "cpu"
    intervals: dict = dataclasses.field(default_factory=dict)
    options: dict = dataclasses.field(default_factory=dict)

    constitutive: typing.ClassVar[str] = "reduced"  # where constitutive effects act: on what the rubber bears

    def __post_init__(self):
        check_types(self, ("skin", "tier", "sensor", "modulus", "device"))
        for name, value, known in (("tier", self.tier, TIERS), ("sensor", self.sensor, tuple(REST_COUNTS))):
            if isinstance(value, str) and value not in known:
                raise ValueError(f"{name} is {value!r}: choose one of {', '.join(known)}")
        if not 0 < self.modulus < np.inf:
            raise ValueError(f"the factor on the modulus is {self.modulus}: pass a positive finite number")
        self._read()  # refuses what cannot be
        own, plain_one = self._numbers(), SENSORS["1"]
        other = [n for n in _ACTING if own is not None and getattr(own, n) != getattr(plain_one, n)]
        if other:
            raise ValueError(
                f"sensor has {', '.join(other)}, which the diagnosis does not simulate: leave that out "
                "of the sensor's numbers, DATA is searched for it"
            )

    def with_effects(self, effects: list, modulus: float | None = None) -> "Simulator":
        """A copy with these effects added."""
        other = copy.copy(self)
        other.effects = [*self.effects, *effects]
        other.modulus = self.modulus if modulus is None else modulus
        return other

    def _but(self, **changes):
        """A copy with other fields, its skin not made yet."""
        other = copy.copy(self)
        other.__dict__.pop("_models", None)
        other.__dict__.update(changes)
        return other

    def _numbers(self):
        """The sensor's own, where they are not those of a published one."""
        return None if isinstance(self.sensor, str) else read_sensor(self.sensor)

    # --- the skin  ---

    def _read(self, **defaults):
        """Settings of the skin, and of its film."""
        settings = read_settings(self.material, self.options, ("film",), **defaults)
        given = read_dict(self.options, "options").get("film")
        return settings, read_film(given, settings.material.electrode_radius)

    def solve(
        self,
        trajectories: "list[Trajectory]",
        offset: list | None = None,
        log_radius: list | None = None,
        log_friction: float = 0.0,
        bubble: float = 0.0,
        progress: Callable[[], object] | None = None,
    ) -> list:
        """Per trajectory a dict: force (n, 3) of the skin on the object [N], pressure (n,) [Pa], log_z (n,
        19); kept in `cache`.

        Args:
          offset: list of (n, 3) [m], or None; log_radius: list of floats, or None.
        """
        out, todo = [None] * len(trajectories), []
        for i, t in enumerate(trajectories):
            tool, pos = placed(
                t, None if offset is None else offset[i], 0.0 if log_radius is None else float(log_radius[i])
            )
            key = hashlib.sha256(
                repr(
                    (
                        self.skin,
                        self.tier,
                        self.material,
                        self.sensor,
                        tool,
                        round(log_friction, 9),
                        round(bubble * 1e12, 6),
                        "v2",
                        *self._asked(t),
                    )
                ).encode()
                + np.round(pos, 9).tobytes()
                + np.round(t.mat, 9).tobytes()
            ).hexdigest()[:24]
            path = None if self.cache is None else pathlib.Path(self.cache) / f"{key}.npz"
            if path is not None and path.exists():
                n = len(t.time)
                shapes = {"force": Array((n, 3)), "pressure": Array((n,)), "log_z": Array((n, 19))}
                out[i] = read_npz(path, "solved field", "remove it, it is solved again", shapes)
                if progress:
                    progress()
            else:
                todo.append((i, tool, pos, t.mat, t.time, path))
        for part in range(0, len(todo), _WORLDS):
            self._walk(todo[part : part + _WORLDS], out, log_friction, bubble, progress)
        return out

    def _asked(self, trajectory):
        """What else decides a solution, for its key; skins without options keep the keys they had."""
        timed = read_material(self.material).prony or self.options
        return (repr(plain(self.options)), trajectory.time.tobytes()) if timed else ()

    def _walk(self, todo, out, log_friction, bubble, progress):
        """Solves trajectories (index, tool, pos, mat, time, path of the cache), each one world, and files
        what they gave."""
        from ...data.generation.plan import Motion
        from ...data.generation.simulate import simulate, simulate_condensed

        model, film = self._model(log_friction, bubble)  # kept: made once
        walk = simulate_condensed if self.tier == "condensed" else simulate
        longest = max(len(pos) for _, _, pos, _, _, _ in todo)
        # who has arrived waits there
        rows = [np.minimum(np.arange(longest), len(pos) - 1) for _, _, pos, _, _, _ in todo]
        motions = [Motion("recorded", {}, pos[r], mat[r]) for r, (_, _, pos, mat, _, _) in zip(rows, todo)]
        times = [_waiting(time, longest) for *_, time, _ in todo]
        fields = walk(model, [tool for _, tool, *_ in todo], motions, time=times)
        for w, (i, _, pos, _, _, path) in enumerate(todo):
            n = len(pos)
            impedance = _impedance(film, fields.vert_xpos(model.geometry.vert, w)[:n])
            out[i] = {
                "force": fields.wrench[w, :n, :3].copy(),
                "pressure": fields.pressure[w, :n].copy(),
                "log_z": np.log(impedance),
            }
            if path is not None:
                write_npz(path, **out[i])
            if progress:
                progress()

    def _model(self, log_friction, bubble):
        from ...sensor.film import FilmConduction
        from ...skin.model import SkinModel

        store = self.__dict__.setdefault("_models", {})
        if bubble not in store:
            geometry = load_skin(self.skin)
            (rubber, options, modulus), film = self._read(liquid=True)
            if bubble:
                volume = store[0.0].liquid_volume if 0.0 in store else 366e-9
                # liquid and air in series: V / K + V0 / p0
                options = dataclasses.replace(
                    options, bulk_modulus=1 / (1 / options.bulk_modulus + bubble / (_AIR * volume))
                )
            device = "cpu" if self.tier == "condensed" else self.device
            model = store[bubble] = SkinModel(geometry, rubber, options, device, modulus=modulus)
            if "film" not in store:
                filled = options.fill_volume or options.rest_pressure
                solved = model.geometry  # with all nodes that are solved
                rest = dataclasses.replace(solved, vert=model.rest.vert) if filled else solved
                store["film"] = FilmConduction(rest, sensor=self._numbers() or self.sensor, **film)
        model = store[bubble]
        if log_friction:
            model = copy.copy(model)
            model.material = dataclasses.replace(
                model.material, friction=model.material.friction * float(np.exp(log_friction))
            )
        return model, store["film"]

    def fields(self, trajectories: "list[Trajectory]", progress: bool = True) -> "Fields":
        """The skin along the trajectories and its differences: 15 solutions of the data set by the condensed
        tier, beside one of the simulator's own; kept in `cache`."""
        spheres = any("sphere" in t.tool for t in trajectories)
        # Differences are the condensed tier's, whose price is seconds; what it misses itself is one of them.
        quick = self if self.tier == "condensed" else self._but(tier="condensed")
        with tqdm.tqdm(
            total=(15 + len(spots(trajectories)) + spheres + self._inflated() + 4 * (quick is not self))
            * len(trajectories),
            desc="skin",
            disable=not progress or None,
            leave=False,
        ) as bar:
            tick, slopes = bar.update, {}
            base = self.solve(trajectories, progress=tick)
            here = base
            if quick is not self:
                here = quick.solve(trajectories, progress=tick)
                slopes["tier"] = _about_rest(_difference(here, base))
                slopes["stiffen"] = self._stiffer(trajectories, base, tick)
                # a tool of fine meshes is exact only so far: then as much adhesion as there can be
                with contextlib.suppress(GridTooCoarse):
                    for work in _TACKY:
                        slopes[f"{TACKY}{work:g}"] = self._tacky(trajectories, base, work, tick)
            if self.skin in OTHER_MESH:
                there = quick._but(skin=OTHER_MESH[self.skin]).solve(trajectories, progress=tick)
                slopes["mesh"] = _about_rest(_difference(there, here))
            film = read_dict(self.options, "options").get("film") or {}
            thicker = {"residual_film": np.exp(_FILM) * self._model(0.0, 0.0)[1].residual_film}
            thicker = quick._but(options=self.options | {"film": {**film, **thicker}})
            slopes["log_film"] = _about_rest(
                _difference(thicker.solve(trajectories, progress=tick), here, _FILM)
            )
            slopes |= quick._uneven(trajectories, here, tick)
            slopes |= quick._filled(trajectories, here, tick)
            slopes |= quick._sunk(trajectories, here, tick)
            slopes |= quick._softer(trajectories, here, tick)
            for axis in range(3):
                unit = np.zeros(3)
                unit[axis] = _SHIFT
                moved = quick.solve(
                    trajectories,
                    offset=[np.tile(unit, (len(t.time), 1)) for t in trajectories],
                    progress=tick,
                )
                slopes["xyz"[axis]] = _difference(moved, here, _SHIFT)
            slopes |= quick._bending(trajectories, here, slopes, tick)
            if spheres:
                slopes["radius"] = _difference(
                    quick.solve(trajectories, log_radius=[_RADIUS] * len(trajectories), progress=tick),
                    here,
                    _RADIUS,
                )
            less, more = (quick.solve(trajectories, log_friction=by, progress=tick) for by in _FRICTION)
            slopes["friction"], slopes["friction2"] = _parabola(less, here, more, *_FRICTION)
            slopes["bubble"] = _difference(
                quick.solve(trajectories, bubble=_BUBBLE, progress=tick), here, _BUBBLE
            )
        return Fields(base, slopes, trajectories, here)

    def _bending(self, trajectories, base, slopes, tick):
        """What linear differences miss along the press: "press" per m, "bend" per m^2."""
        deeper, shallower = (
            self.solve(
                trajectories,
                offset=[np.tile(by * t.heading, (len(t.time), 1)) for t in trajectories],
                progress=tick,
            )
            for by in (_DEEPER, -_DEEPER)
        )
        press, bend = _parabola(shallower, base, deeper, -_DEEPER, _DEEPER)
        for i, t in enumerate(trajectories):  # beyond what differences in x, y and z already say of it
            for k, slope in press[i].items():
                press[i][k] = slope - sum(h * slopes[x][i][k] for h, x in zip(t.heading, "xyz"))
        return {"press": press, "bend": bend}

    def _uneven(self, trajectories, base, tick):
        """Differences by a modulus that varies along and across the finger."""
        given = read_settings(self.material, self.options).modulus
        geometry = load_skin(self.skin)
        at = geometry.vert[geometry.elem[:, :4]].mean(1)
        own, out = 1.0 if given is None else np.asarray(given(at) if callable(given) else given), {}
        for way in (*MAPS, *spots(trajectories)):
            by = _UNEVEN if way in MAPS else _SPOT
            factor = modulus_of({way: by})(at)
            other = self._but(options=self.options | {"modulus": own * factor})
            out[way] = _difference(other.solve(trajectories, progress=tick), base, by)
        return out

    def _stiffer(self, trajectories, base, tick):
        """Difference by c2 of rubber that stiffens inside the elements, as the condensed tier cannot."""
        inside = memory_of([(Stiffening(), {"c2": _STIFFER})]).material["stiffening"]
        rubber = read_material(self.material)
        more = dataclasses.replace(rubber, stiffening=rubber.stiffening + inside)
        other = self._but(material=plain(more))
        return _difference(other.solve(trajectories, progress=tick), base, _STIFFER)

    def _tacky(self, trajectories, base, work, tick):
        """Difference by a contact that sticks, of so much work of joining [J/m2]."""
        inside = memory_of([(Adhesion().given(["joining"]), {"joining": work})]).contact
        settings = read_settings(self.material, self.options)[1]
        if settings.contact_law:  # what is said of friction stays
            inside["contact_law"] = dataclasses.replace(settings.contact_law, **inside["contact_law"])
        other = self._but(options=self.options | {"skin": plain(dataclasses.replace(settings, **inside))})
        return _difference(other.solve(trajectories, progress=tick), base)

    def stick(self, fields: "Fields", work: float, near: float = _NEAR) -> bool:
        """Solves the skin with a contact of so much work of joining [J/m2], as `Adhesion` says it, and keeps
        with the fields what that changes: pull-off is no straight line of the work.

        Returns: whether that was needed and could be; not where it was solved near it (by `near` of it)
        already, nor where the contact reaches farther than the distance to a tool's mesh is exact: the
        largest work that was solved is then as far as it goes."""
        solved = [float(name.removeprefix(TACKY)) for name in fields.slopes if name.startswith(TACKY)]
        if work <= 0 or any(abs(work - at) < near * at for at in solved):
            return False
        try:
            change = self._tacky(fields.trajectories, fields.base, work, None)
        except GridTooCoarse:
            return False
        fields.add(f"{TACKY}{work:.9g}", change)
        return True

    def _filled(self, trajectories, base, tick):
        """Difference by the share of its liquid that the fingertip has lost or won, the film as it was."""
        model, film = self._model(0.0, 0.0)
        settings = read_settings(self.material, self.options)[1]
        if not model.has_liquid or settings.rest_pressure:
            return {}
        volume = settings.fill_volume + _FILL * model.liquid_volume
        skin = {**plain(settings), "fill_volume": volume}
        folder = None if self.cache is None else str(pathlib.Path(self.cache) / "filled")
        other = self._but(options=self.options | {"skin": skin}, cache=folder)
        other._models = {"film": film}
        return {"fill": _difference(other.solve(trajectories, progress=tick), base, _FILL)}

    def _sunk(self, trajectories, base, tick):
        """Difference by the depth [m] to which the skin has sunk towards the core, all else as it was."""
        from ...effects.in_film import SunkFilm

        model, film = self._model(0.0, 0.0)
        if not model.has_liquid:
            return {}
        other = self._but(cache=None if self.cache is None else str(pathlib.Path(self.cache) / "sunk"))
        other._models = {0.0: model, "film": SunkFilm(film, _SUNK)}
        return {"sink": _difference(other.solve(trajectories, progress=tick), base, _SUNK)}

    def _inflated(self):
        """Whether the liquid bears a part of the load already at rest."""
        return bool(read_settings(self.material, self.options)[1].rest_pressure)

    def _softer(self, trajectories, base, tick):
        """Difference by the logarithm of the modulus, beyond a factor on force and pressure: there is none
        but where the liquid stands under pressure at rest, which another modulus leaves as it is."""
        if not self._inflated():
            return {}
        rubber, factor = read_material(self.material), float(np.exp(_SOFTER))
        other = self._but(
            material=plain(dataclasses.replace(rubber, youngs_modulus=factor * rubber.youngs_modulus))
        )
        solved = other.solve(trajectories, progress=tick)
        by_it = [
            {k: v if k == "log_z" else v / factor for k, v in one.items()} for one in solved
        ]  # as `run` adds differences: per unit of the factor
        return {"modulus": _difference(by_it, base, _SOFTER)}

    # --- all stages  ---

    def run(
        self,
        trajectories: "list[Trajectory]",
        fields: "Fields | None" = None,
        exact: bool | list = True,
        effects: list | None = None,
        modulus: float | None = None,
        offsets: list | None = None,
        nuisance: Nuisance = KNOWN,
    ) -> list[Run]:
        """What the sensor would read, without noise and rounding.

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
            base = self.solve(trajectories)
            slopes = {} if modulus == 1.0 else self._softer(trajectories, base, None)
            fields = Fields(base, slopes, trajectories)
        for _, theta in effects:
            if "joining" in theta and self.tier != "full":
                raise ValueError(
                    "adhesion by its work of joining acts in the contact, as in the full tier alone: "
                    "take tier='full', or leave it out"
                )
            if "joining" in theta and exact is not False:
                self.stick(fields, theta["joining"], _SURE)
        ordered = sorted(effects, key=lambda item: list(STAGES).index(item[0].stage))
        before = [(e, th) for e, th in ordered if e.stage in "SB" or e.id == "friction"]
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
        shares = [(getattr(nuisance, name), name) for name in BETWEEN if name in fields.slopes]
        if "modulus" in fields.slopes:
            shares.append((np.log(modulus), "modulus"))
        for i, run in enumerate(runs):
            between = sum(share * fields.stacked[name][i] for share, name in shares if share)
            if np.ndim(between):
                run.force = run.force + modulus * between[:, :3]
                run.pressure = run.pressure + modulus * between[:, 3]
                run.log_z = run.log_z + between[:, 4:]
            if nuisance.footprint:
                run.log_z = widen(run.log_z, run.rest_log_z, nuisance.footprint)
        for run in runs:
            for stage in ("K", "C", "T"):
                for effect, theta in after:
                    if effect.stage == stage:
                        effect.apply(run, theta)
            if np.ndim(run.turn) and run.turn.any():  # the force is given in the frame of the poses
                run.force = run.force - np.cross(run.turn, run.force)
            run.counts = 4095 / (np.exp(run.log_z) / 1e4 + 1)
            if nuisance.age:
                run.counts = aged(run.counts, run.time, nuisance.age)
            run.pdc = 2000 + run.pressure / 36.5
            for effect, theta in after:
                if effect.stage == "A":
                    effect.apply(run, theta)
        return runs

    def bend(self, fields: "Fields", effects: list, nuisance: Nuisance, which: np.ndarray) -> bool:
        """Solves the skin of trajectories `which` with the effects in place, and keeps with the fields what
        their differences miss of those that move the object or change the contact, all together: from then on
        `exact=False` is right at their parameters.

        Returns: whether that was needed; not where it was solved near them already."""
        moving = [(e, th) for e, th in effects if e.stage in "SB" or e.id == "friction"]
        ids, now = frozenset(e.id for e, _ in moving), sizes(moving)
        if ids in fields.curves:
            there, curve = nearest(fields.curves[ids], now)
            if set(which) <= set(curve) and apart(now, there) < _NEAR**2 * sum(v**2 for v in there.values()):
                return False
        some = [fields.trajectories[i] for i in which]
        quick = self if self.tier == "condensed" else self._but(tier="condensed")
        plain = dataclasses.replace(
            nuisance, mesh=0.0, tier=0.0, log_film=0.0, footprint=0.0, log_modulus=0.0, age=0.0
        )
        part = Fields(
            [fields.quick[i] for i in which],
            {k: [v[i] for i in which] for k, v in fields.slopes.items()},
            some,
        )
        near, true = (quick.run(some, part, exact, moving, 1.0, None, plain) for exact in (False, True))
        missed = {i: stack(vars(b)) - stack(vars(a)) for i, a, b in zip(which, near, true)}
        fields.curves.setdefault(ids, []).append((now, missed))
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
                    one["log_z"].copy(),
                )
        curves = fields.bent(moving)
        for i in sorted(set(changed) - set(anew)):
            run = runs[i]
            along = run.offset @ run.heading
            shift = (
                [("press", along), ("bend", along**2), *zip("xyz", run.offset.T)] if run.offset.any() else []
            )
            parts = [
                *shift,
                ("radius", run.log_radius),
                ("friction", run.log_friction),
                ("friction2", run.log_friction**2),
                ("bubble", run.bubble),
            ]
            change = 0.0
            for name, amount in parts:
                several = np.ndim(amount) > 0
                if name in fields.stacked and (amount.any() if several else amount):
                    slope = fields.stacked[name][i]
                    change = change + slope * (amount[:, None] if several else amount)
            for curve, share in curves:
                if i in curve:
                    change = change + share**2 * curve[i]
            if np.ndim(change):
                run.force = run.force + modulus * change[:, :3]
                run.pressure = run.pressure + modulus * change[:, 3]
                run.log_z = run.log_z + change[:, 4:]

    # --- YAML  ---

    def save(self, path: pathlib.Path | str) -> None:
        """Writes the stages and effects as YAML."""
        base = {"skin": self.skin, "tier": self.tier, "material": plain(self.material)}
        base |= {"options": plain(self.options)} if self.options else {}
        base |= {"sensor": self.sensor, "constitutive": self.constitutive}
        base["modulus_factor"] = float(self.modulus)
        write_sensor_file(path, SensorFile(base, self.effects, self.intervals))


def _turned(t, turn):
    """A trajectory whose object is turned by rotation vectors (3,) or (n, 3)."""
    if not np.any(turn):
        return t
    from scipy.spatial.transform import Rotation

    return dataclasses.replace(t, mat=Rotation.from_rotvec(turn).as_matrix() @ t.mat)


def spots(trajectories: "list[Trajectory]") -> list[str]:
    """Places at which the rubber may be another, as parameters of `Spots`: where most trajectories
    touch, the others of each left out, at least two each."""
    place = np.array([t.pos[np.argmax(t.depth)] for t in trajectories])
    near = np.linalg.norm(place[:, None] - place, axis=2) < _NEAR_SPOT
    out, left = [], np.ones(len(place), bool)
    while len(out) < _SPOTS and (near & left).sum(1).max() > 1:
        at = int(np.argmax((near & left).sum(1)))
        out.append("at_" + "_".join(f"{1e3 * v:.1f}" for v in place[near[at] & left].mean(0)))
        left &= ~near[at]
    return out


def placed(t: "Trajectory", shift: np.ndarray | None = None, grow: float = 0.0) -> tuple[str, np.ndarray]:
    """Tool and positions (n, 3) of a trajectory shifted by `shift` (n, 3) [m], a sphere's radius multiplied
    by exp(grow), its tip kept."""
    tool, pos = t.tool, t.pos + (0.0 if shift is None else shift)
    if grow and "sphere" in tool:
        radius = _sphere_radius(tool)
        tip = pos if not tool.startswith("geom:") else pos + radius * t.mat[:, :, 1]
        radius *= np.exp(grow)
        tool, pos = f"geom:sphere:{radius:.9g}", tip - radius * t.mat[:, :, 1]
    return tool, pos


def _impedance(film, vert_xpos):
    """(n, 19) [ohm]; a row whose film has no solution keeps the last one, as does one that has not moved."""
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


def _difference(moved, base, by=1.0):
    return [{k: (a[k] - b[k]) / by for k in b} for a, b in zip(moved, base)]


def _about_rest(slopes):
    return [{k: v - v[0] for k, v in one.items()} for one in slopes]


def _parabola(before, base, after, low, high):
    """Slopes and curvatures of solutions at low, 0 and high."""
    first, second = _difference(before, base, low), _difference(after, base, high)
    bend = [{k: (b[k] - a[k]) / (high - low) for k in a} for a, b in zip(first, second)]
    return [{k: a[k] - low * c[k] for k in a} for a, c in zip(first, bend)], bend


def _sphere_radius(tool):
    if tool.startswith("geom:sphere:"):
        return float(tool.split(":")[2])
    return float(tool.removeprefix("sphere_").removesuffix("mm").replace("-", ".")) * 0.5e-3


def _waiting(time, count):
    """Times (count,) of a trajectory that waits at its end, as often as it came."""
    more = time[-1] + (time[-1] - time[-2]) * np.arange(1, count - len(time) + 1)
    return np.concatenate([time, more])
