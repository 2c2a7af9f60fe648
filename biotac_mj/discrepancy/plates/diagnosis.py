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
from ...matching.fit import Rows, fit_constants, fit_states
from ...matching.response import Response
from ...quality.noise import noise_level
from ...skin import Material
from ...skin.rubber.material import PRESETS
from ...skin.settings import plain
from ..evidence import RATE, asked, discoveries, sign_flip
from ..recordings.diagnosis import RecordingDiagnosis
from ..recordings.recording import PlainRecording
from ..report import plots
from ..report.verdict import Estimate, Finding, Gap, Picture, Verdict, electrode_names
from .models import BASE, Judged, Model, judge, models, press_rows
from .where import leading, missing, press_cells

_TIMES = 4000  # permutations of the electrodes
_BLOCKS = "blocks of time that took no part in the fit"


@dataclasses.dataclass(frozen=True, eq=False)
class Sensor:
    """One recording with the base model.

    Attributes:
      recording; rows: of the first 70 %; locked: the held-out ones; judged; noise: (nelectrode,) [counts];
        cells: see `press_cells`; worst: electrodes that lead, from 0; slope, error: (nelectrode,) see
        `missing`.
    """

    recording: PlainRecording
    rows: Rows
    locked: Rows
    judged: Judged
    noise: np.ndarray
    cells: list[dict]
    worst: list[int]
    slope: np.ndarray
    error: np.ndarray

    @classmethod
    def of(cls, recording: PlainRecording, response: Response) -> "Sensor":
        rows, locked = press_rows(recording)
        # every model goes on from here: what going on alone brings must not count for it
        judged = judge(response, rows, BASE, judge(response, rows, BASE))
        noise = noise_level(recording.electrodes, recording.repeated)
        cells = press_cells(rows, judged, noise)
        return cls(recording, rows, locked, judged, noise, cells, leading(judged), *missing(judged))

    @property
    def name(self) -> str:
        return self.recording.name


@dataclasses.dataclass(frozen=True, eq=False)
class Tested:
    """A model against the smaller one on one recording, on rows that neither was fitted on.

    Attributes:
      gain: (blocks,) [nats] by which the larger model makes each block likelier.
      rms: "worst" or "all" electrodes -> (smaller, larger) [counts]; locked: the same on held-out rows,
        None without held-out rows.
      value: of the parameter by the constants of either half; modulus: their mean Young's modulus [Pa].
    """

    gain: np.ndarray
    rms: dict
    value: tuple[float, ...]
    modulus: float
    locked: dict | None = None

    @classmethod
    def of(cls, sensor: Sensor, model: Model) -> "Tested":
        small, rows = sensor.judged, model.of(sensor.recording, sensor.rows)
        large = judge(model.response, rows, model.setup, small)
        value = tuple(model.value(c) for c in large.constants)
        modulus = float(np.mean([c.modulus for c in large.constants]))
        return cls(large.gain(small, sensor.noise), _rms(sensor, small.error, large.error), value, modulus)

    @property
    def nats(self) -> float:
        return float(self.gain.sum())

    @property
    def p(self) -> float:
        return sign_flip(self.gain)

    def closed(self, which: str = "worst") -> float:
        """Share of the squared error that the larger model takes away; below 0 where it adds to it."""
        before, after = self.rms[which]
        return 1 - (after / max(before, 1e-12)) ** 2


def _rms(sensor, *errors):
    """RMS of errors (n, nelectrode) at the electrodes that lead and at all."""
    return {
        "worst": tuple(float(np.sqrt((e[:, sensor.worst] ** 2).mean())) for e in errors),
        "all": tuple(float(np.sqrt((e**2).mean())) for e in errors),
    }


@dataclasses.dataclass(frozen=True, eq=False)
class Tried:
    """A model that was tried on all sensors.

    Attributes:
      model. tested: by sensor. significant: by sensor, of all models one in twenty-one false. whose: "base
        model", "sensor NAME", "nobody", or "unknown" where there is but one sensor.
    """

    model: Model
    tested: tuple[Tested, ...]
    significant: tuple[bool, ...]
    whose: str

    @property
    def id(self) -> str:
        return self.model.effect.id

    @property
    def name(self) -> str:
        return self.model.effect.name

    @property
    def evidence(self) -> float:
        """[nats] of the sensor that has least."""
        return min(t.nats for t in self.tested)

    @property
    def further_off(self) -> bool:
        """Whether it is further off than the base model from what a sensor held out."""
        rms = [t.locked["all"] for t in self.tested if t.locked]
        return any(after > before for before, after in rms)

    @property
    def attached(self) -> list[dict] | None:
        """Arguments of `biotac_mj.attach` for a sensor with the effect, by sensor; None if no running sensor
        can have it."""
        attach = self.model.effect.attach
        return attach and [attach(sum(t.value) / len(t.value)) for t in self.tested]


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlateDiagnosis(Verdict):
    """A verdict on flat presses.

    Attributes:
      sensors; models: those with most evidence first; named: those that the evidence names, all of them tied
        where it cannot part them; alike: correlation of the sensors' `slope` and its p, None with one sensor;
        first: what was found in the first recording alone, see `beside`.
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

    def beside(self, first: RecordingDiagnosis) -> "PlateDiagnosis":
        """This one with what was found in its first recording alone."""
        joined = {
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
            **joined,
        )

    def pictures(self) -> list[Picture]:
        """Error by electrode, what each electrode's change lacks, what each model takes away."""
        figure = plots.plates(
            [s.name for s in self.sensors],
            [_listed(s.worst) for s in self.sensors],
            [np.sqrt((s.judged.error**2).mean(0)) for s in self.sensors],
            [(s.slope, s.error) for s in self.sensors],
            [f"{f.name}{' *' if f in self.named else ''}" for f in self.models],
            [[f.tested[i].closed() for f in self.models] for i in range(len(self.sensors))],
        )
        own = Picture("simulated", "tried", figure)
        return [*self.first.pictures(), own] if self.first else [own]

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
        rubber = Material(youngs_modulus=float(tested.modulus), electrode_radius=radius)
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
    tested = {id(model): [] for model in some}
    total = len(recordings) * (1 + len(some))
    with tqdm(total=total, desc="models", unit="model", disable=quiet or None) as bar:
        for recording in recordings:
            sensors.append(Sensor.of(recording, base))
            bar.update()
            for model in some:
                tested[id(model)].append(Tested.of(sensors[-1], model))
                bar.update()
    tried = _tried(some, [tuple(tested[id(model)]) for model in some], sensors)
    named = _named(tried)
    proved = {id(f): _proved(f, sensors, base) for f in named}
    tried, named = ([proved.get(id(f), f) for f in fs] for fs in (tried, named))
    return _concluded(sensors, tried, named, _alike(sensors))


def _tried(some, tested, sensors):
    enough = discoveries([[t.p for t in parts] for parts in tested])
    out = []
    for model, parts, by_chance in zip(some, tested, enough):
        significant = tuple(bool(b and t.nats > asked(len(some))) for b, t in zip(by_chance, parts))
        # an amount to one side on one sensor and to the other on the other is not the base model's
        side = {np.sign(t.value[0] - model.effect.base) for t in parts}
        if not any(significant):
            whose = "nobody"
        elif len(sensors) == 1:
            whose = "unknown"
        elif all(significant) and len(side) == 1:
            whose = "base model"
        else:
            whose = "sensor " + ", ".join(s.name for s, yes in zip(sensors, significant) if yes)
        out.append(Tried(model, parts, significant, whose))
    return sorted(out, key=lambda f: -f.evidence)


def _named(tried):
    """The model with most evidence in every sensor, and those that no sensor distinguishes from it."""
    good = [f for f in tried if f.whose in ("base model", "unknown")]

    def tied(other):
        return all(sign_flip(b.gain - o.gain) > RATE for b, o in zip(good[0].tested, other.tested))

    return [f for f in good if f is good[0] or tied(f)]


def _proved(tried, sensors, base):
    """With what it does on the held-out rows by constants of all others."""
    model, tested = tried.model, []
    for s, t in zip(sensors, tried.tested):
        rows, locked = (model.of(s.recording, r) for r in (s.rows, s.locked))
        small = fit_constants(base, rows, BASE)
        large = fit_constants(model.response, rows, model.setup, (small[0], small[1].state))
        errors = [
            fit_states(response, locked, constants, setup).counts - locked.counts
            for response, (constants, _), setup in (
                (base, small, BASE),
                (model.response, large, model.setup),
            )
        ]
        tested.append(dataclasses.replace(t, locked=_rms(s, *errors)))
    return dataclasses.replace(tried, tested=tuple(tested))


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
        data=f"{', '.join(str(len(s.rows)) for s in sensors)} loaded rows, each with a fitted pose",
        verdict=_in_words(sensors, named, alike) if red else "no significant disagreement",
        significant=bool(red),
        effects=[_finding(f, named, sensors) for f in named],
        gap=dict(_gap(s, named, k) for k, s in enumerate(sensors)),
        aside=_BLOCKS,
        where=[{"sensor": s.name} | {k: v for k, v in c.items() if k != "red"} for s, c in red],
        where_note="electrodes and conditions of simulated presses that are off; RMS [counts], and expected",
        remainder="" if named or not red else "no effect that was tried takes the gap away",
        unknown=bool(red) and not named,
        tried=[_row(f, s, t) for f in tried for s, t in zip(sensors, f.tested)],
        tried_note=(
            f"RMS [counts] without -> with it on {_BLOCKS}, how much likelier it makes them, and how often "
            "chance gives as much; its value by either half of the rows"
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
    """Name and Gap of the electrodes of sensor k that lead."""
    worst = electrode_names(sensor.worst)
    phases = [c for c in sensor.cells if c["channel"] in worst and c["condition"].startswith("phase")]
    before = float(np.sqrt((sensor.judged.error[:, sensor.worst] ** 2).mean()))
    after = named[0].tested[k].rms["worst"][1] if named else before
    noise = float(np.sqrt(np.mean([c["expected"] ** 2 for c in phases]))) if phases else np.nan
    gap = Gap("counts", before, after, noise, f"{_listed(sensor.worst)} of {sensor.name}")
    return f"worst electrodes of {sensor.name} in simulated presses", gap


def _finding(f, named, sensors):
    effect, locked = f.model.effect, np.square([t.locked["worst"] for t in f.tested])
    before, after = np.sqrt(locked.mean(0)).tolist()
    parameters = {
        effect.parameter + (f" of {s.name}" if len(sensors) > 1 else ""): Estimate(
            float(np.mean(t.value)), unit=effect.unit
        )
        for s, t in zip(sensors, f.tested)
    }
    return Finding.of(
        effect,
        channels=tuple(sorted({k for s in sensors for k in s.worst})),
        parameters=parameters,
        evidence=f.evidence,
        p=max(t.p for t in f.tested),
        confirmed=bool((locked[:, 1] < locked[:, 0]).all()),
        ties={one.id: one.name for one in named if one is not f},
        gap=Gap("counts", before, after, name="worst electrodes, RMS on held-out rows"),
        note=f"of the {f.whose}" if f.whose == "base model" else "",
    )


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
        "by_halves": ", ".join(f"{v:.3g}" for v in t.value),
        **{f"{which}_electrodes": "{:.0f} -> {:.0f}".format(*rms) for which, rms in t.rms.items()},
        "kept_aside": "{:.0f} -> {:.0f}".format(*t.locked["worst"]) if t.locked else "",
        "nats": t.nats,
        "p": t.p,
        "whose": f.whose,
        "closed": t.closed(),
        "attach": attach and attach(sum(t.value) / len(t.value)),
    }


def _where(s):
    """Location of the disagreement of one sensor, as numbers."""
    return {
        "worst": electrode_names(s.worst),
        "rms": float(np.sqrt((s.judged.error**2).mean())),
        "missing": dict(zip(electrode_names(range(len(s.slope))), s.slope.tolist())),
        "missing_error": s.error.tolist(),
        "cells": s.cells,
    }
