"""The simulator as stages and effects: where objects are, skin, transduction, acquisition; saved as YAML.

Poses are the input, readings the output. The skin is solved for the recorded poses (`fields`), and once more
for each small change of them: these differences make every effect of the set-up affordable, and are used with
`exact=False`. `exact=True` solves the skin anew with the effects in place.
"""

import copy
import dataclasses
import pathlib
import typing
from collections.abc import Sequence

import numpy as np

from ....effects.contact import TACKY
from ....effects.effect import STAGES, Run, shifted
from ....effects.sensor_file import SensorFile, write_sensor_file
from ....skin.contact.law import GridTooCoarse
from ....skin.settings import plain
from ..base.nuisance import BETWEEN, KNOWN, Nuisance, widen
from ..trajectory import Trajectory
from .differences import differences, softer, solved_fields, tacky
from .fields import Fields, nearest, sizes, square, squared_distance, stack
from .solver import Solver

_NEAR = 0.15  # of the parameters at which the skin was solved: differences from there reach so far
_STEP = 0.3  # of a parameter's scale, for the change by it where the skin is solved with effects
_SURE = 0.02  # of them, with `exact`


class Simulator(Solver):
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

    def with_effects(self, effects: list, modulus: float | None = None) -> typing.Self:
        """A copy with these effects added."""
        other = copy.copy(self)
        other.effects = [*self.effects, *effects]
        other.modulus = self.modulus if modulus is None else modulus
        return other

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
        session, runs, design = {}, [], self.design
        late = nuisance.late(design)
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
                run.log_z = widen(run.log_z, run.rest_log_z, nuisance.footprint, design)
        for run in runs:
            for stage in ("K", "C", "T"):
                for effect, theta in after:
                    if effect.stage != stage:
                        continue
                    effect.apply(run, theta)
            if np.ndim(run.turn) and run.turn.any():  # the force is given in the frame of the poses
                run.force = run.force - np.cross(run.turn, run.force)
            log_z = run.log_z - nuisance.stands_off * self.log_rest if nuisance.stands_off else run.log_z
            run.counts = 4095 / (np.exp(log_z) / 1e4 + 1)
            if late:
                run.counts = shifted(run.counts, run.time, late)
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
        wanted = changed if exact is True else [] if exact is False else np.atleast_1d(exact).tolist()
        anew = [i for i in changed if i in wanted]
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
                run.force, run.pressure = modulus * one["force"], modulus * one["pressure"]
                run.log_z = one["log_z"] + self.log_rest
        curves = fields.bent(moving)
        for i in sorted(set(changed) - set(anew)):
            run = runs[i]
            amounts = run.log_radius, run.log_friction, run.log_friction**2, run.bubble
            change = fields.shifted(i, run.offset) if run.offset.any() else 0.0
            for name, amount in zip(("radius", "friction", "friction2", "bubble"), amounts):
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
