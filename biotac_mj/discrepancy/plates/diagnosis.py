"""Simulation in the loop for recordings of flat presses: the pose of every row is fitted, then models with
one further parameter show in which stage the residual lies, and several sensors whether it is theirs or the
base model's."""

import dataclasses

import numpy as np
from tqdm import tqdm

from ...effects.plate import PLATE, PlateEffect
from ...effects.sensor_file import SensorFile
from ...matching.fit import SIGNS, Rows
from ...matching.response import Response
from ...quality.noise import noise_level
from ...skin import Material
from ...skin.rubber.material import PRESETS
from ...skin.settings import plain
from ..evidence import RATE, asked, by_chance, max_t, not_distinguished
from ..recordings.diagnosis import RecordingDiagnosis
from ..recordings.recording import PlainRecording
from ..recordings.search import diagnose_recording
from ..report.plots import Table
from ..report.verdict import Estimate, Finding, Gap, electrode_names
from .models import Fit, fitted, press_rows

_LEAST = 5e-3  # [N] noise of a force
_LEADS = 1.3  # times the median electrode's RMS: such electrodes lead
_BLOCKS = 16  # units of time: rows of one press are one piece of evidence
_OFF = "electrodes of simulated presses that are off; RMS [counts], and expected"
_TRIED = (
    "evidence of each over the base model, all states marginalised; RMS [counts] without -> with it on rows "
    "that took no part in any fit; its value, 95 %"
)


@dataclasses.dataclass(frozen=True, eq=False)
class Sensor:
    """One recording with the base model.

    Attributes:
      recording; rows: of the first 70 %, and the held-out ones; fit: of the base model; noise:
        (nelectrode + 2,) [counts, N].
    """

    recording: PlainRecording
    rows: tuple[Rows, Rows]
    fit: Fit
    noise: np.ndarray

    @classmethod
    def of(cls, recording: PlainRecording, response: Response) -> "Sensor":
        rows, force = press_rows(recording), (recording.force @ SIGNS)[:, :2]
        noise = noise_level(recording.electrodes, recording.repeated)
        noise = np.append(noise, noise_level(force, recording.repeated, _LEAST))
        return cls(recording, rows, fitted(response, recording, rows, noise), noise)

    @property
    def name(self) -> str:
        return self.recording.name

    @property
    def worst(self) -> list[int]:
        """Electrodes that err most, by number from 0, the worst first."""
        rms = np.sqrt((self.fit.error**2).mean(0))
        order = np.argsort(-rms)
        return [int(k) for k in order if rms[k] > _LEADS * np.median(rms)] or [int(order[0])]

    @property
    def off(self) -> list[dict]:
        """Electrodes whose error is more than noise, the worst first: RMS [counts], what noise explains of it
        (expected), and family-wise p that it is no more."""
        square, noise = self.fit.error**2, self.noise[:-2]
        t, p = max_t(np.array([part.mean(0) for part in np.array_split(square - noise**2, _BLOCKS)]))
        rms = np.sqrt(square.mean(0))
        return [
            {
                "sensor": self.name,
                "channel": f"e{k + 1}",
                "counts": float(rms[k]),
                "expected": float(noise[k]),
                "p": float(p[k]),
            }
            for k in np.argsort(-rms)
            if t[k] > 0 and p[k] < RATE
        ]

    def gap(self, fit: Fit) -> Gap:
        """Of the electrodes that lead, on held-out rows."""
        channels = electrode_names(range(self.fit.error.shape[1]))
        each = zip(*(fit.rms([i]) for i in range(len(channels))))
        noise = float(np.sqrt((self.noise[self.worst] ** 2).mean()))
        name = f"{', '.join(electrode_names(sorted(self.worst)))} of {self.name}"
        return Gap("counts", *fit.rms(self.worst), noise, name, tuple(channels), *map(tuple, each))


@dataclasses.dataclass(frozen=True, eq=False)
class Tried:
    """An effect that was tried on all sensors.

    Attributes:
      effect. tested: Fit by sensor. significant: by sensor, 20 times likelier than none. whose: "base model",
        "sensor NAME", "nobody", or "unknown" where there is but one sensor.
    """

    effect: PlateEffect
    tested: tuple[Fit, ...]
    significant: tuple[bool, ...]
    whose: str

    @property
    def id(self) -> str:
        return self.effect.id

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
        attach = self.effect.attach
        return attach and [attach(self.effect.value(t.amount)) for t in self.tested]


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlateDiagnosis(RecordingDiagnosis):
    """A verdict on the first recording of flat presses, and what simulated states show of all.

    Attributes:
      sensors; models: those with most evidence first; named: those that the evidence names, all of them tied
        where it cannot part them.
    """

    sensors: list[Sensor]
    models: list[Tried]
    named: list[Tried]

    def table(self) -> Table:
        """Percentage of the worst electrodes' squared error that each model explains, with dots at the named
        models."""
        closed = [[100 * t.closed(s.worst) for s, t in zip(self.sensors, f.tested)] for f in self.models]
        dots = [(self.models.index(f), i) for f in self.named for i in range(len(self.sensors))]
        return Table(
            closed, [f.effect.name for f in self.models], [s.name for s in self.sensors], dots, "gained [%]"
        )

    def sensor(self) -> SensorFile:
        """The first recording's sensor (rest, noise, effects), with the rubber that its poses were fitted
        with and the skin's settings that its named effect asks for, if any."""
        file, acting = super().sensor(), _acting(self.named)
        if acting is None:
            return file
        given, tested = acting.attached[0], acting.tested[0]
        radius = PRESETS["calibrated"].electrode_radius
        rubber = Material(youngs_modulus=float(tested.constants.modulus), electrode_radius=radius)
        rubber = dataclasses.replace(rubber, **given.get("material", {}))
        options = {"options": given["options"]} if "options" in given else {}
        base = {**file.base, "material": plain(rubber), **options}
        return SensorFile(base, file.effects, file.intervals)


def _acting(named):
    """The named effect with most evidence that can act in a model, tied or not, and is no further off with
    what was held out, or None."""
    some = (f for f in named if f.attached and not f.further_off)
    return max(some, key=lambda f: f.evidence, default=None)


def diagnose_presses(
    recordings: list[PlainRecording],
    response: Response,
    effects: tuple[PlateEffect, ...] = PLATE,
    quiet: bool = False,
    first: RecordingDiagnosis | None = None,
) -> PlateDiagnosis:
    """Diagnoses recordings of flat presses of one or more sensors.

    Args:
      response: the base model's, with a change for each of `effects`, in their order.
      first: what was found in the first recording alone; None: it is diagnosed.

    Raises:
      ValueError: a recording without force, or with too few loaded rows.
    """
    sensors, tested = [], [[] for _ in effects]
    base = response.amended(np.zeros(len(response.changes)))
    total = len(recordings) * (1 + len(effects))
    with tqdm(total=total, desc="models", unit="model", disable=quiet or None) as bar:
        for recording in recordings:
            one = Sensor.of(recording, base)
            sensors.append(one)
            bar.update()
            for k, parts in enumerate(tested):
                parts.append(fitted(response.only(k), recording, one.rows, one.noise, one.fit))
                bar.update()
    tried = _tried(effects, tested, sensors)
    first = diagnose_recording(recordings[0], progress=not quiet) if first is None else first
    return _concluded(first, sensors, tried, _named(tried))


def _tried(effects, tested, sensors):
    """Tried of effects with what was tested on each sensor, those with most evidence first."""
    out = []
    for effect, parts in zip(effects, tested):
        significant = tuple(t.nats > asked(len(effects)) for t in parts)
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
        out.append(Tried(effect, tuple(parts), significant, whose))
    return sorted(out, key=lambda f: -f.evidence)


def _named(tried):
    """The effect with most evidence in every sensor, and those that no sensor distinguishes from it."""
    good = [f for f in tried if f.whose in ("base model", "unknown")]

    def tied(other):
        pairs = zip(good[0].tested, other.tested)
        return all(not_distinguished(b.nats, o.nats, b.law_error) for b, o in pairs)

    return [f for f in good if f is good[0] or tied(f)]


def _concluded(first, sensors, tried, named):
    """What was found in the first recording alone, and what states show of all sensors."""
    off, acting = [one for s in sensors for one in s.off], _acting(named)
    gap = {
        f"worst electrodes of {s.name} in simulated presses": s.gap(named[0].tested[k] if named else s.fit)
        for k, s in enumerate(sensors)
    }
    lines = [f"sensor_amended.yaml has, as {sensors[0].name} has it: {acting.effect.name}"] if acting else []
    lines += [
        f"{f.effect.name} as {s.name} has it: attach(spec, **{given})"
        for f in named
        for s, given in zip(sensors, f.attached or ())
    ]
    notes = first.where_note if first.where else "", _OFF if off else ""
    left = "no effect that was tried takes the gap away" if off and not named else ""
    told = {
        "effects": [*first.effects, *(_finding(f, named, tried, sensors) for f in named)],
        "where": [*first.where, *off],
        "amended": [*first.amended, *lines],
        "significant": first.significant or bool(off),
        "gap": first.gap | gap,
        "lead": max(gap, key=lambda name: gap[name].loudness) if off else "",
        "where_note": "; ".join(filter(None, notes)),
        "remainder": "; ".join(filter(None, (first.remainder, left))),
        "unknown": first.unknown or bool(left),
        "tried": [_row(f, s, t) for f in tried for s, t in zip(sensors, f.tested)],
        "tried_note": _TRIED,
    }
    return PlateDiagnosis(**vars(first) | told, sensors=sensors, models=tried, named=named)


def _finding(f, named, tried, sensors):
    locked = np.square([t.rms(s.worst) for s, t in zip(sensors, f.tested)])
    before, after = np.sqrt(locked.mean(0)).tolist()
    name = f.effect.parameter
    parameters = {
        name + (f" of {s.name}" if len(sensors) > 1 else ""): Estimate(*_interval(f, t), f.effect.unit)
        for s, t in zip(sensors, f.tested)
    }
    return Finding.of(
        f.effect,
        channels=tuple(sorted({k for s in sensors for k in s.worst})),
        parameters=parameters,
        evidence=f.evidence,
        p=by_chance(f.evidence, len(tried)),
        confirmed=bool((locked[:, 1] < locked[:, 0]).all()),
        ties={one.id: one.effect.name for one in named if one is not f},
        gap=Gap("counts", before, after, name="worst electrodes, RMS on held-out rows"),
        note=f"of the {f.whose}" if f.whose == "base model" else "",
    )


def _interval(f, t):
    """Value of an effect's parameter by a Fit, and its interval of 95 %."""
    value = f.effect.value
    return value(t.amount), *sorted(map(value, (t.low, t.high)))


def _row(f, sensor, t):
    """A line of the table of what was tried: an effect on one sensor."""
    attach = f.effect.attach
    return {
        "id": f.id,
        "name": f.effect.name,
        "sensor": sensor.name,
        "unit": f.effect.unit,
        "value": "{:.3g} ({:.3g} .. {:.3g})".format(*_interval(f, t)),
        "worst_electrodes": "{:.0f} -> {:.0f}".format(*t.rms(sensor.worst)),
        "nats": t.nats,
        "whose": f.whose,
        "attach": attach and attach(f.effect.value(t.amount)),
    }
