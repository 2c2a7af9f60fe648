"""Simulation in the loop for recordings of flat presses: the pose of every row is fitted, then nested models
say in which stage the rest disagrees, and several sensors whether it is theirs or the base model's."""

import dataclasses

import numpy as np
from scipy.signal import lfilter
from scipy.stats import false_discovery_control
from tqdm import tqdm

from ...effects.plate import PLATE, PlateEffect
from ...matching.fit import Rows, Setup, fit_constants, fit_states
from ...matching.match import rows_of
from ...matching.response import Response
from ...quality.noise import noise_level
from ...skin import Material
from ..evidence import sign_flip
from ..recordings.recording import PlainRecording
from .nested import Compared, Judged, compare, judge
from .where import Cell, cells, leading, missing

__all__ = ["Candidate", "Sensor", "Simulated", "Tested", "diagnose_simulated", "press_rows"]

_DEVELOPED = 0.7  # of the rows, in time, on which everything is found and chosen; the rest is locked
_ROWS = 300  # loaded rows that are looked at: time to fit goes with them
_P = 0.05  # false discovery rate over the models tried
_LEAST = 0.05  # of the squared error that a finding takes away: less is no reason for what is seen
_MEMORY = 0.5, 5.0  # [s] of a grip's relaxation, as measured on holds (docs/lab/memory.md)
_TIMES = 4000  # permutations of the electrodes


@dataclasses.dataclass(frozen=True)
class Tested:
    """One model against the smaller one on one recording.

    Attributes:
      worst, all: on the electrodes that lead, and on all; rows of the other half of the first 70 %.
      value: of the parameter by the constants of either half; modulus: their mean Young's modulus [Pa].
      locked: (before, after) RMS on the locked rows for the worst electrodes and for all; None where it was
        not asked.
    """

    worst: Compared
    all: Compared
    value: tuple[float, ...]
    modulus: float
    locked: dict | None = None


@dataclasses.dataclass(frozen=True)
class _Named:
    """A model that is tried, in words."""

    id: str
    name: str
    stage: str
    parameter: str
    unit: str
    kind: str


@dataclasses.dataclass(frozen=True)
class Candidate(_Named):
    """A model that was tried on all sensors.

    Attributes:
      id, name, stage, parameter, unit. kind: "has" what the base model has, tried without it; "lacks" what it
        has not, tried with it; "fits" what no effect explains (gains). tested: by sensor.
      significant: by sensor, after the false discovery rate over all models. whose: "base model", "sensor
        NAME", "nobody", or "unknown" where there is but one sensor.
    """

    tested: tuple[Tested, ...]
    significant: tuple[bool, ...]
    whose: str


@dataclasses.dataclass(frozen=True, eq=False)
class Sensor:
    """One recording with the base model.

    Attributes:
      name; rows: of the first 70 % and locked; judged; cells; worst: electrodes that lead, from 0; slope,
        error: (19,) see `missing`; modulus: of both halves [Pa].
    """

    name: str
    rows: Rows
    locked: Rows
    judged: Judged
    cells: list[Cell]
    worst: list[int]
    slope: np.ndarray
    error: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Simulated:
    """What `diagnose_simulated` found.

    Attributes:
      sensors; tried: those that take most away first; named: ids of effects that the evidence names,
      all of them tied where it cannot part them; alike: correlation of the sensors' `slope` and its p, None
      with one sensor; verdict.
    """

    sensors: tuple[Sensor, ...]
    tried: tuple[Candidate, ...]
    named: tuple[str, ...]
    alike: tuple[float, float] | None
    verdict: str


def press_rows(recording: PlainRecording) -> tuple[Rows, Rows]:
    """Loaded rows of a recording with what pressed before: of the first 70 %, and locked.

    Raises:
      ValueError: no force, or too few loaded rows.
    """
    every = max(1, int((np.linalg.norm(recording.force, axis=1) > 0.5).sum() / _ROWS)) if (
        recording.force is not None
    ) else 1  # fmt: skip
    rows = rows_of(recording.electrodes, recording.force, every)
    cut = int(_DEVELOPED * len(rows))
    return rows[:cut], rows[cut:]


def _remembering(recording, rows, tau):
    """Rows with the pressing force as an exponential memory of tau [s] has it."""
    pressing, keep = -recording.force[:, 2], np.exp(-1 / (recording.rate * tau))
    past = lfilter([1 - keep], [1, -keep], pressing, zi=keep * pressing[:1])[0]
    at = np.rint(rows.time * len(pressing)).astype(int)
    return dataclasses.replace(rows, past=past[at])


@dataclasses.dataclass(frozen=True)
class _Model(_Named):
    """How it differs from the base (setup, response), where its value is, and the value in the base model."""

    response: Response
    setup: Setup
    tau: float | None = None
    value: object = None
    base: float = 0.0


def _models(response, straight, effects):
    base = Setup(gains=0.0)
    plain = response.amended(np.zeros(len(response.changes)))
    E = Material().youngs_modulus
    yield _Model(
        "warmup", "warm-up", "A", "change of ln Z", "1", "has", plain, dataclasses.replace(base, drift=0.0)
    )
    yield _Model(
        "drag", "drag of the plate", "K", "tangential over normal motion", "1", "has", straight, base
    )
    yield _Model(
        "modulus", "Young's modulus other than the default's", "C", "E", "Pa", "has", plain,
        dataclasses.replace(base, hold_modulus=True, modulus=E),
    )  # fmt: skip
    yield _Model(
        "gain", "gains of single electrodes", "T", "spread of the gains", "1", "fits", plain,
        dataclasses.replace(base, gains=Setup().gains), value=lambda c: float(c.gain.std()),
    )  # fmt: skip
    for tau in _MEMORY:
        yield _Model(
            f"memory_{tau:g}s", f"relaxation within {tau:g} s", "C", "share of the load as it was", "1",
            "lacks", plain, dataclasses.replace(base, memory=0.3), tau, lambda c: c.memory,
        )  # fmt: skip
    for k, one in enumerate(effects):
        yield _Model(
            one.id, one.name, one.stage, one.parameter, one.unit, "lacks", response.only(k),
            dataclasses.replace(base, amount=1.0), value=lambda c, one=one: one.value(float(c.amount[0])),
            base=one.base,
        )  # fmt: skip


def diagnose_simulated(
    recordings: list[PlainRecording],
    response: Response,
    straight: Response,
    effects: tuple[PlateEffect, ...] = PLATE,
    quiet: bool = False,
) -> Simulated:
    """Diagnoses recordings of flat presses of one or more sensors.

    Args:
      response: the base model's, with a change for each of `effects`, in their order.
      straight: the base model's without drag.

    Raises:
      ValueError: a recording without force, or with too few loaded rows.
    """
    models = list(_models(response, straight, effects))
    base, plain = Setup(gains=0.0), response.amended(np.zeros(len(response.changes)))
    sensors, tested = [], {model.id: [] for model in models}
    bar = tqdm(total=len(recordings) * (1 + len(models)), desc="models", unit="model", disable=quiet or None)
    for recording in recordings:
        rows, locked = press_rows(recording)
        # every model goes on from here: what going on alone brings must not count for it
        judged = judge(plain, rows, base, judge(plain, rows, base))
        slope, error = missing(judged)
        noise = noise_level(recording.electrodes, recording.repeated)
        worst = leading(judged)
        sensor = Sensor(recording.name, rows, locked, judged, cells(rows, judged, noise), worst, slope, error)
        sensors.append(sensor)
        bar.update()
        for model in models:
            here = rows if model.tau is None else _remembering(recording, rows, model.tau)
            new = judge(model.response, here, model.setup, None if model.kind == "has" else judged)
            small, large = (new, judged) if model.kind == "has" else (judged, new)
            value = tuple(model.value(c) for c in new.constants) if model.value else ()
            modulus = float(np.mean([c.modulus for c in new.constants]))
            tested[model.id].append(
                Tested(compare(small, large, worst), compare(small, large), value, modulus)
            )
            bar.update()
    bar.close()
    findings = _findings(models, tested, sensors)
    named = _named(findings)
    findings = [
        _with_locked(f, next(m for m in models if m.id == f.id), recordings, sensors, plain)
        if f.id in named or f.kind == "fits" else f
        for f in findings
    ]  # fmt: skip
    alike = _alike(sensors)
    return Simulated(tuple(sensors), tuple(findings), named, alike, _verdict(sensors, findings, named, alike))


def _findings(models, tested, sensors):
    # a model must help where it is worst or everywhere; both are tried, so both count
    p = np.array([[[t.worst.p, t.all.p] for t in tested[m.id]] for m in models])
    adjusted = false_discovery_control(p.swapaxes(1, 2).reshape(-1, len(sensors)), axis=0)
    adjusted = adjusted.reshape(len(models), 2, len(sensors)).swapaxes(1, 2)
    out = []
    for m, q in zip(models, adjusted):
        parts = tested[m.id]
        significant = tuple(
            bool((a[0] < _P and t.worst.closed > _LEAST) or (a[1] < _P and t.all.closed > _LEAST))
            for a, t in zip(q, parts)
        )
        # an amount to one side on one sensor and to the other on the other is not the base model's
        side = {np.sign(t.value[0] - m.base) for t in parts} if m.kind == "lacks" else {1}
        if not any(significant):
            whose = "nobody"
        elif len(sensors) == 1:
            whose = "unknown"
        elif all(significant) and len(side) == 1:
            whose = "base model"
        else:
            whose = "sensor " + ", ".join(s.name for s, yes in zip(sensors, significant) if yes)
        words = {f.name: getattr(m, f.name) for f in dataclasses.fields(_Named)}
        out.append(Candidate(**words, tested=tuple(parts), significant=significant, whose=whose))
    return sorted(out, key=lambda f: -min(t.all.closed for t in f.tested))


def _named(findings):
    """The effect that takes most away from every sensor, and those that no sensor tells from it."""
    good = [f for f in findings if f.kind == "lacks" and f.whose in ("base model", "unknown")]
    if not good:
        return ()
    best = max(good, key=lambda f: min(t.worst.closed for t in f.tested))

    def tied(other):
        pairs = ((np.array(b.worst.gain), np.array(o.worst.gain)) for b, o in zip(best.tested, other.tested))
        return all(sign_flip(b - o) > _P for b, o in pairs)

    return tuple(f.id for f in good if f is best or tied(f))


def _with_locked(finding, model, recordings, sensors, plain):
    """With what it does on the locked rows by constants of all others."""
    tested = []
    for recording, sensor, t in zip(recordings, sensors, finding.tested):
        tau = model.tau
        rows, locked = (
            r if tau is None else _remembering(recording, r, tau) for r in (sensor.rows, sensor.locked)
        )
        base = Setup(gains=0.0)
        small = fit_constants(plain, rows, base)
        large = fit_constants(model.response, rows, model.setup, (small[0], small[1].state))
        error = [
            fit_states(r, locked, c[0], s).counts - locked.counts
            for r, c, s in ((plain, small, base), (model.response, large, model.setup))
        ]
        value = {
            "worst": tuple(float(np.sqrt((e[:, sensor.worst] ** 2).mean())) for e in error),
            "all": tuple(float(np.sqrt((e**2).mean())) for e in error),
        }
        tested.append(dataclasses.replace(t, locked=value))
    return dataclasses.replace(finding, tested=tuple(tested))


def _alike(sensors):
    """Lowest correlation of two sensors' slopes, and its p under permutations of the electrodes."""
    if len(sensors) < 2:
        return None
    rng, out = np.random.default_rng(0), []
    for i, a in enumerate(sensors):
        for b in sensors[:i]:
            r = np.corrcoef(a.slope, b.slope)[0, 1]
            chance = [np.corrcoef(rng.permutation(a.slope), b.slope)[0, 1] for _ in range(_TIMES)]
            out.append((float(r), float((1 + np.sum(np.array(chance) >= r)) / (1 + _TIMES))))
    return min(out)


def names(electrodes: list[int]) -> str:
    """e7, e8 and so on."""
    return ", ".join(f"e{k + 1}" for k in sorted(electrodes))


def _verdict(sensors, findings, named, alike):
    if not any(cell.red for s in sensors for cell in s.cells):
        return "no significant disagreement"
    where = "; ".join(f"{s.name} at {names(s.worst)}" for s in sensors)
    by_id = {f.id: f for f in findings}
    if len(named) == 1:
        what = f"{by_id[named[0]].name} (of the {by_id[named[0]].whose})"
    elif named:
        what = "a tie of " + ", ".join(by_id[i].name for i in named)
    else:
        what = "unknown: no mechanism tried takes it away" + (
            " from every sensor" if len(sensors) > 1 else ""
        )
    shared = ""
    if alike:
        r, p = alike
        whose = "of the base model" if p < _P else "not shown to be of the base model"
        shared = f"; what the electrodes lack correlates {r:.2f} between sensors (p {p:.2g}): {whose}"
    return f"the simulation errs most in {where}: {what}{shared}"
