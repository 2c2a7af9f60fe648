"""Simulation in the loop for recordings of flat presses: the pose of every row is fitted, then models with
one further parameter show in which stage the residual lies, and several sensors whether it is theirs or the
base model's."""

import dataclasses
import itertools

import numpy as np
from scipy.stats import PermutationMethod, pearsonr
from tqdm import tqdm

from ...effects.effect import STAGES
from ...effects.plate import PLATE, PlateEffect
from ...effects.sensor_file import SensorFile
from ...matching.fit import SIGNS, Rows
from ...matching.response import Response
from ...quality.noise import noise_level
from ...skin import Material
from ...skin.rubber.material import PRESETS
from ...skin.settings import plain
from ..evidence import RATE, asked, by_chance, not_distinguished
from ..recordings.diagnosis import RecordingDiagnosis
from ..recordings.recording import PlainRecording
from ..report import plots
from ..report.verdict import Estimate, Finding, Gap, Picture, Verdict, electrode_names
from .models import BASE, Fit, Model, fitted, models, press_rows
from .where import leading, missing, press_cells

_TIMES = 4000  # permutations of the electrodes
_LEAST = 5e-3  # [N] noise of a force


@dataclasses.dataclass(frozen=True, eq=False)
class Sensor:
    """One recording with the base model.

    Attributes:
      recording; rows: of the first 70 %, and the held-out ones; fit: of the base model; noise:
        (nelectrode + 2,) [counts, N]; cells: see `press_cells`; worst: electrodes that lead, from 0; slope,
        error: (nelectrode,) see `missing`.
    """

    recording: PlainRecording
    rows: tuple[Rows, Rows]
    fit: Fit
    noise: np.ndarray
    cells: list[dict]
    worst: list[int]
    slope: np.ndarray
    error: np.ndarray

    @classmethod
    def of(cls, recording: PlainRecording, response: Response) -> "Sensor":
        rows, force = press_rows(recording), (recording.force @ SIGNS)[:, :2]
        noise = noise_level(recording.electrodes, recording.repeated)
        noise = np.append(noise, noise_level(force, recording.repeated, _LEAST))
        fit = fitted(Model(None, response, BASE), recording, rows, noise)
        cells = press_cells(rows[0], fit, noise[:-2])
        return cls(recording, rows, fit, noise, cells, leading(fit), *missing(fit))

    @property
    def name(self) -> str:
        return self.recording.name


@dataclasses.dataclass(frozen=True, eq=False)
class Tried:
    """A model that was tried on all sensors.

    Attributes:
      model. tested: Fit by sensor. significant: by sensor, 20 times likelier than none. whose: "base model",
        "sensor NAME", "nobody", or "unknown" where there is but one sensor.
    """

    model: Model
    tested: tuple[Fit, ...]
    significant: tuple[bool, ...]
    whose: str

    @property
    def id(self) -> str:
        return self.model.effect.id

    @property
    def name(self) -> str:
        return self.model.effect.name

    @property
    def values(self) -> list[float]:
        """Of the parameter, by sensor."""
        return [self.model.value(t.amount) for t in self.tested]

    @property
    def evidence(self) -> float:
        """[nats] of the sensor that has least."""
        return min(t.nats for t in self.tested)

    @property
    def further_off(self) -> bool:
        """Whether it is further off than the base model from what a sensor held out."""
        return any(t.closed() < 0 for t in self.tested)

    @property
    def attached(self) -> list[dict] | None:
        """Arguments of `biotac_mj.attach` for a sensor with the effect, by sensor; None if no running sensor
        can have it."""
        attach = self.model.effect.attach
        return attach and [attach(value) for value in self.values]


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlateDiagnosis(Verdict):
    """A verdict on flat presses.

    Attributes:
      sensors; models: those with most evidence first; named: those that the evidence names, all of them tied
        where it cannot part them; alike: correlation of the sensors' `slope` and its p, None with one sensor;
        first: what was found in the first recording alone, see `joined`.
    """

    sensors: list[Sensor]
    models: list[Tried]
    named: list[Tried]
    alike: tuple[float, float] | None
    first: RecordingDiagnosis | None = None

    @property
    def acting(self) -> Tried | None:
        """The named effect with most evidence that can act in a model, tied or not, and is no further off
        with what was held out."""
        some = (f for f in self.named if f.attached and not f.further_off)
        return max(some, key=lambda f: f.evidence, default=None)

    def joined(self, first: RecordingDiagnosis) -> "PlateDiagnosis":
        """This one with what was found in its first recording alone."""
        lists = {
            name: [*getattr(first, name), *getattr(self, name)]
            for name in ("warnings", "effects", "not_named", "where", "notes", "amended")
        }
        return dataclasses.replace(
            self,
            **{name: getattr(first, name) for name in ("kind", "name", "data", "aside")},
            verdict=f"{first.verdict}; {self.verdict}",
            significant=first.significant or self.significant,
            gap=first.gap | self.gap,
            lead=max(self.gap, key=lambda name: self.gap[name].loudness) if self.significant else "",
            where_note="; ".join(one.where_note for one in (first, self) if one.where),
            remainder="; ".join(filter(None, (first.remainder, self.remainder))),
            unknown=first.unknown or self.unknown,
            next_experiment=first.next_experiment,
            next_command=first.next_command,
            details=first.details | self.details,
            first=first,
            **lists,
        )

    def pictures(self) -> list[Picture]:
        """What each model takes away of the squared error of the worst electrodes, with dots for those that
        are named; what each electrode's change lacks; and its error."""
        names, models = [s.name for s in self.sensors], self.models
        closed = [[100 * f.tested[i].closed(s.worst) for i, s in enumerate(self.sensors)] for f in models]
        tried = [f.name for f in models]
        dots = [(models.index(f), i) for f in self.named for i in range(len(names))]
        lacks = np.array([100 * s.slope for s in self.sensors])
        electrodes = electrode_names(range(lacks.shape[1]))
        own = [
            Picture("models", "tried", plots.matrix(closed, tried, names, dots, "gained [%]")),
            Picture("lacking", "where", plots.matrix(lacks, names, electrodes, [], "lacks [%]")),
            Picture(
                "simulated",
                "gap",
                plots.channels([_gap(s, self.named, k) for k, s in enumerate(self.sensors)]),
            ),
        ]
        return [*self.first.pictures(), *own] if self.first else own

    def sensor(self) -> SensorFile | None:
        """The first recording's sensor (rest, noise, effects), with the rubber that its poses were fitted
        with and the skin's settings that its named effect asks for, if any."""
        if self.first is None:
            return None
        file, acting = self.first.sensor(), self.acting
        if acting is None:
            return file
        given, tested = acting.attached[0], acting.tested[0]
        radius = PRESETS["calibrated"].electrode_radius
        rubber = Material(youngs_modulus=float(tested.constants.modulus), electrode_radius=radius)
        rubber = dataclasses.replace(rubber, **given.get("material", {}))
        options = {"options": given["options"]} if "options" in given else {}
        base = {**file.base, "material": plain(rubber), **options}
        return SensorFile(base, file.effects, file.intervals)


def diagnose_presses(
    recordings: list[PlainRecording],
    response: Response,
    effects: tuple[PlateEffect, ...] = PLATE,
    quiet: bool = False,
) -> PlateDiagnosis:
    """Diagnoses recordings of flat presses of one or more sensors.

    Args:
      response: the base model's, with a change for each of `effects`, in their order.

    Raises:
      ValueError: a recording without force, or with too few loaded rows.
    """
    some, sensors = list(models(response, effects)), []
    base = response.amended(np.zeros(len(response.changes)))
    tested = [[] for _ in some]
    total = len(recordings) * (1 + len(some))
    with tqdm(total=total, desc="models", unit="model", disable=quiet or None) as bar:
        for recording in recordings:
            sensors.append(Sensor.of(recording, base))
            bar.update()
            for model, parts in zip(some, tested):
                one = sensors[-1]
                parts.append(fitted(model, recording, one.rows, one.noise, one.fit))
                bar.update()
    tried = _tried(some, tested, sensors)
    return _concluded(sensors, tried, _named(tried), _alike(sensors))


def _tried(some, tested, sensors):
    """Tried of models with what was tested on each sensor, those with most evidence first."""
    out = []
    for model, parts in zip(some, tested):
        significant = tuple(t.nats > asked(len(some)) for t in parts)
        # an amount to one side on one sensor and to the other on the other is not the base model's
        side = {np.sign(t.amount) for t in parts}
        if not any(significant):
            whose = "nobody"
        elif len(sensors) == 1:
            whose = "unknown"
        elif all(significant) and len(side) == 1:
            whose = "base model"
        else:
            whose = "sensor " + ", ".join(s.name for s, yes in zip(sensors, significant) if yes)
        out.append(Tried(model, tuple(parts), significant, whose))
    return sorted(out, key=lambda f: -f.evidence)


def _named(tried):
    """The model with most evidence in every sensor, and those that no sensor distinguishes from it."""
    good = [f for f in tried if f.whose in ("base model", "unknown")]

    def tied(other):
        pairs = zip(good[0].tested, other.tested)
        return all(not_distinguished(b.nats, o.nats, b.law_error) for b, o in pairs)

    return [f for f in good if f is good[0] or tied(f)]


def _alike(sensors):
    """Lowest correlation of two sensors' slopes, and its p under permutations of the electrodes."""
    if len(sensors) < 2:
        return None
    by = PermutationMethod(n_resamples=_TIMES, rng=np.random.default_rng(0))
    pairs = (
        pearsonr(a.slope, b.slope, alternative="greater", method=by)
        for a, b in itertools.combinations(sensors, 2)
    )
    return min((float(pair.statistic), float(pair.pvalue)) for pair in pairs)


def _listed(electrodes):
    return ", ".join(electrode_names(sorted(electrodes)))


def _concluded(sensors, tried, named, alike):
    red = [(s, c) for s in sensors for c in s.cells if c["red"]]
    out = PlateDiagnosis(
        kind="flat presses, simulated",
        name=", ".join(s.name for s in sensors),
        data=f"{', '.join(str(len(s.rows[0])) for s in sensors)} loaded rows, each with a fitted pose",
        verdict=_in_words(sensors, named, alike) if red else "no significant disagreement",
        significant=bool(red),
        effects=[_finding(f, named, tried, sensors) for f in named],
        gap={
            f"worst electrodes of {s.name} in simulated presses": _gap(s, named, k)
            for k, s in enumerate(sensors)
        },
        aside="rows that took no part in any fit",
        where=[{"sensor": s.name} | {k: v for k, v in c.items() if k != "red"} for s, c in red],
        where_note="electrodes and conditions of simulated presses that are off; RMS [counts], and expected",
        remainder="" if named or not red else "no effect that was tried takes the gap away",
        unknown=bool(red) and not named,
        tried=[_row(f, s, t) for f in tried for s, t in zip(sensors, f.tested)],
        tried_note=(
            "evidence of each over the base model, all states marginalised; RMS [counts] without -> with it "
            "on rows that took no part in any fit; its value, 95 %"
        ),
        details={
            "simulated": {
                "where": {s.name: _where(s) for s in sensors},
                "alike": alike and {"correlation": alike[0], "p": alike[1]},
            }
        },
        sensors=sensors,
        models=tried,
        named=named,
        alike=alike,
    )
    lines = [f"sensor_amended.yaml has, as {sensors[0].name} has it: {out.acting.name}"] if out.acting else []
    lines += [
        f"{f.name} as {s.name} has it: attach(spec, **{given})"
        for f in named
        for s, given in zip(sensors, f.attached or ())
    ]
    return dataclasses.replace(out, amended=lines)


def _in_words(sensors, named, alike):
    where = "; ".join(f"{s.name} at {_listed(s.worst)}" for s in sensors)
    if len(named) == 1:
        what = f"{named[0].name} (of the {named[0].whose})"
    elif named:
        what = "a tie of " + ", ".join(f.name for f in named)
    else:
        what = "unknown: no mechanism tried takes it away" + (" from every sensor" * (len(sensors) > 1))
    shared = ""
    if alike:
        r, p = alike
        whose = "of the base model" if p < RATE else "not shown to be of the base model"
        shared = f"; what the electrodes lack correlates {r:.2f} between sensors (p {p:.2g}): {whose}"
    return f"the simulation errs most in {where}: {what}{shared}"


def _gap(sensor, named, k):
    """Gap of the electrodes of sensor k that lead."""
    fit, worst = named[0].tested[k] if named else sensor.fit, sensor.worst
    noise = float(np.sqrt((sensor.noise[worst] ** 2).mean()))
    channels = electrode_names(range(len(sensor.slope)))
    each = zip(*(fit.rms([i]) for i in range(len(channels))))
    name = f"{_listed(worst)} of {sensor.name}"
    return Gap("counts", *fit.rms(worst), noise, name, tuple(channels), *map(tuple, each))


def _finding(f, named, tried, sensors):
    effect, locked = f.model.effect, np.square([t.rms(s.worst) for s, t in zip(sensors, f.tested)])
    before, after = np.sqrt(locked.mean(0)).tolist()
    parameters = {
        effect.parameter + (f" of {s.name}" if len(sensors) > 1 else ""): Estimate(
            *_interval(f.model, t), effect.unit
        )
        for s, t in zip(sensors, f.tested)
    }
    return Finding.of(
        effect,
        channels=tuple(sorted({k for s in sensors for k in s.worst})),
        parameters=parameters,
        evidence=f.evidence,
        p=by_chance(f.evidence, len(tried)),
        confirmed=bool((locked[:, 1] < locked[:, 0]).all()),
        ties={one.id: one.name for one in named if one is not f},
        gap=Gap("counts", before, after, name="worst electrodes, RMS on held-out rows"),
        note=f"of the {f.whose}" if f.whose == "base model" else "",
    )


def _interval(model, t):
    """Value of a model's parameter by a Fit, and its interval of 95 %."""
    return model.value(t.amount), *sorted(map(model.value, (t.low, t.high)))


def _row(f, sensor, t):
    """A line of the table of what was tried: a model on one sensor."""
    effect, attach = f.model.effect, f.model.effect.attach
    return {
        "id": f.id,
        "name": f.name,
        "stage": STAGES[effect.stage],
        "sensor": sensor.name,
        "parameter": effect.parameter,
        "unit": effect.unit,
        "value": "{:.3g} ({:.3g} .. {:.3g})".format(*_interval(f.model, t)),
        "worst_electrodes": "{:.0f} -> {:.0f}".format(*t.rms(sensor.worst)),
        "all_electrodes": "{:.0f} -> {:.0f}".format(*t.rms()),
        "nats": t.nats,
        "whose": f.whose,
        "closed": t.closed(sensor.worst),
        "attach": attach and attach(f.model.value(t.amount)),
    }


def _where(s):
    """Location of the disagreement of one sensor, as numbers."""
    return {
        "worst": electrode_names(s.worst),
        "rms": float(np.sqrt((s.fit.error**2).mean())),
        "missing": dict(zip(electrode_names(range(len(s.slope))), s.slope.tolist())),
        "missing_error": s.error.tolist(),
        "cells": s.cells,
    }
