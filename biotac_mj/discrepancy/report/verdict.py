"""Findings, verdicts, and their form in verdict.json (`schema.json`).

Diagnoses of recordings, of trajectories and of presses of a flat plate are each a `Verdict` with additions of
their kind of data. Text (`text.py`), page and files (`files.py`) are made from any of them."""

import dataclasses
import json
import math
import re
import typing

import numpy as np

from ...effects.catalogue import entries, name_of
from ...effects.effect import STAGES
from . import plots

if typing.TYPE_CHECKING:
    from ...effects.effect import Entry, Param
    from ...effects.sensor_file import SensorFile

SCHEMA, VERSION = "biotac_mj.verdict", 3
_NOISELESS = 2e-6  # counts or newtons: a simulated force has no noise, which is taken for half of that
_ABOVE = 1.05  # times noise and resolution, from which on something is above them
_NEXT = 3  # experiments
_EVERYWHERE, _FEW = 12, 4  # electrodes, beyond which they are not listed, and in one line


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A parameter as it was found.

    Attributes:
      value; unit. low, high: interval of 95 %, nan where none is known. bounds: of what is possible; source:
        of the bounds.
    """

    value: float
    low: float = math.nan
    high: float = math.nan
    unit: str = "1"
    bounds: tuple[float, float] = (-math.inf, math.inf)
    source: str = ""

    @classmethod
    def of(cls, param: "Param", value: float, low: float = math.nan, high: float = math.nan) -> "Estimate":
        """Estimate of a parameter of an effect."""
        bounds = param.low, param.high
        low, high = (float(np.clip(end, *bounds)) for end in (low, high))
        return cls(float(value), low, high, param.unit, bounds, param.source)

    def __str__(self):
        text = f"{self.value:.4g}" + ("" if self.unit in ("", "1") else f" {self.unit}")
        known = math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high
        return f"{text} ({self.low:.4g} .. {self.high:.4g})" if known else text

    def to_dict(self) -> dict:
        low, high = self.bounds
        return {
            "value": self.value,
            "unit": self.unit,
            "interval95": [self.low, self.high],
            "bounds": [low, high],
            "source": self.source,
            "at_bound": not low < self.value < high,
        }


@dataclasses.dataclass(frozen=True)
class Gap:
    """Difference between simulation and measurement on held-out data.

    Attributes:
      unit; before, after: RMS without and with what was found. noise: RMS that noise and the simulation's own
        resolution make, nan where it is not known.
      name: of what is compared, in words.
      channels: names; channels_before, channels_after: RMS of each.
    """

    unit: str
    before: float
    after: float
    noise: float = math.nan
    name: str = ""
    channels: tuple[str, ...] = ()
    channels_before: tuple[float, ...] = ()
    channels_after: tuple[float, ...] = ()

    @property
    def closed(self) -> float:
        """Share of the mean square above noise that is taken away, nan where nothing is above it."""
        noise = self.noise if math.isfinite(self.noise) else 0.0
        above = self.before**2 - noise**2
        return (
            min((self.before**2 - self.after**2) / above, 1.0) if self.before > _ABOVE * noise else math.nan
        )

    @property
    def taken(self) -> float:
        """RMS that is taken away, by squares, negative where it is added."""
        square = self.before**2 - self.after**2
        return math.copysign(math.sqrt(abs(square)), square)

    @property
    def gained(self) -> bool:
        """Whether what was found makes it smaller, in as many digits as a report has."""
        return float(f"{self.after:.3g}") < float(f"{self.before:.3g}")

    @property
    def loudness(self) -> float:
        """Times the noise, 0 where there is none or it is not known."""
        return self.before / self.noise if self.noise > _NOISELESS else 0.0

    @property
    def floor(self) -> str:
        """Its noise in words."""
        if not math.isfinite(self.noise):
            return "unknown"
        return f"{self.noise:.2g}" if self.noise > _NOISELESS else "none"

    def to_dict(self) -> dict:
        out = {name: getattr(self, name) for name in ("name", "unit", "before", "after", "noise", "closed")}
        more = {name: getattr(self, name) for name in ("channels", "channels_before", "channels_after")}
        return out | (more if self.channels else {})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Finding:
    """An effect that was found.

    Attributes:
      id, name, stage (of `STAGES`), physics: of the effect. confusable: id -> experiment that would
        distinguish it from that one.
      channels: numbers from 0 of the electrodes that have it; empty where it is not of single electrodes.
      parameters: name -> Estimate.
      evidence: mean log likelihood that data left out gain by it [nats], nan where it is not so measured.
      p: of as much by chance. confidence: probability that the name is right, None where it is not known.
      confirmed: whether held-out data confirm it, None where they cannot.
      ties: id -> name of effects that explain the data as well.
      gap: what it closes by itself on held-out data, or None. note: what was seen, in words.
      start, end: when it acts [s], None where it has no time.
    """

    id: str
    name: str
    stage: str
    physics: str = ""
    confusable: dict[str, str] = dataclasses.field(default_factory=dict)
    channels: tuple[int, ...] = ()
    parameters: dict[str, Estimate] = dataclasses.field(default_factory=dict)
    evidence: float = math.nan
    p: float = math.nan
    confidence: float | None = None
    confirmed: bool | None = None
    ties: dict[str, str] = dataclasses.field(default_factory=dict)
    gap: Gap | None = None
    note: str = ""
    start: float | None = None
    end: float | None = None

    @classmethod
    def of(cls, effect: "Entry", **said: object) -> "Finding":
        """Finding of an effect, the catalogue's or a user's own; said: its other attributes."""
        own = {name: getattr(effect, name) for name in ("id", "name", "stage", "physics", "confusable")}
        return cls(**own, **said)

    @property
    def where(self) -> str:
        """Electrodes that have it, in words."""
        if len(self.channels) > _EVERYWHERE:
            return "all electrodes"
        return ", ".join(electrode_names(self.channels)) or "not of single electrodes"

    @property
    def at(self) -> str:
        """The same behind a name, of few electrodes."""
        few = "" if len(self.channels) > _EVERYWHERE else ", ".join(electrode_names(self.channels[:_FEW]))
        return few and f" {few}"

    @property
    def when(self) -> str:
        return "" if self.start is None else f"{self.start:.1f} s to {self.end:.1f} s"

    @property
    def proof(self) -> str:
        """Line on the test by held-out data."""
        sign = {True: "confirmed", False: "NOT confirmed", None: "not checked"}[self.confirmed]
        if self.gap is None:
            return f"{sign} by held-out data"
        g = self.gap
        return f"{g.name}: {g.before:.3g} -> {g.after:.3g} {g.unit}, noise {g.floor} ({sign})"

    @property
    def experiments(self) -> dict[str, str]:
        """Name of each effect that it ties with -> experiment that would distinguish them."""
        return {name: self.experiment(i) for i, name in self.ties.items()}

    def experiment(self, other: str) -> str:
        """What would distinguish it from another effect, by either one's entry."""
        back = (effect.confusable.get(self.id) for effect in entries("poses") if effect.id == other)
        return self.confusable.get(other) or next(back, None) or "no experiment is known"

    @property
    def title(self) -> str:
        """Its name, with those that it ties with."""
        return self.name + (f" (or {' or '.join(self.ties.values())})" if self.ties else "")

    def to_dict(self) -> dict:
        return {
            "id": self.id,
            "name": self.name,
            "stage": STAGES[self.stage],
            "physics": self.physics,
            "channels": electrode_names(self.channels),
            "start_s": self.start,
            "end_s": self.end,
            "parameters": [{"name": name, **p.to_dict()} for name, p in self.parameters.items()],
            "confidence": self.confidence,
            "evidence_nats": self.evidence,
            "p": self.p,
            "confirmed": self.confirmed,
            "ties": list(self.ties),
            "tie_names": list(self.ties.values()),
            "note": self.note,
            "gap": {} if self.gap is None else self.gap.to_dict(),
            "confusable": self.confusable,
        }


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """Result of a diagnosis.

    Attributes:
      kind: of the data; name: of this one; data: what it consists of, a line. warnings: lines.
      significant: whether simulation and measurement disagree.
      effects: named and added, what closes most first. not_named: seen, and too weak or contradicted.
      gap: what is compared -> Gap, on held-out data. lead: which of them the headline is about; empty: the
        one that is most above noise. aside: what these data are, in words.
      closed: share that all effects close of their own part of the gap, nan where there is none or
        least and most of it are over 20 points apart; closed_within: these, less and plus a law's tenth.
      where: cells that disagree, dicts with "channel", the clearest first; where_note: what the cells are.
      remainder: what is left; unknown: whether something is left that has no name.
      tried: dicts with "name", one for each cause that was tried; tried_note: what their numbers are.
      notes: what the data cannot decide. next_experiment: one that would. next_command: the command that
        begins it.
      amended: lines on sensor_amended.yaml.
      details: what is known of this kind of data alone, as further keys of verdict.json.
    """

    kind: str
    name: str
    data: str
    significant: bool
    effects: list[Finding]
    gap: dict[str, Gap]
    aside: str
    lead: str = ""
    warnings: list[str] = dataclasses.field(default_factory=list)
    not_named: list[Finding] = dataclasses.field(default_factory=list)
    closed: float = math.nan
    closed_within: tuple[float, float] = (math.nan, math.nan)
    where: list[dict] = dataclasses.field(default_factory=list)
    where_note: str = ""
    remainder: str = ""
    unknown: bool = False
    tried: list[dict] = dataclasses.field(default_factory=list)
    tried_note: str = ""
    notes: list[str] = dataclasses.field(default_factory=list)
    next_experiment: str = ""
    next_command: str = ""
    amended: list[str] = dataclasses.field(default_factory=list)
    details: dict = dataclasses.field(default_factory=dict)

    predicted: typing.ClassVar[str] = "simulated"  # what is drawn beside the measurement

    def panels(self) -> list[list[plots.Panel]]:
        """Rows of channels that are drawn over time."""
        return []

    def table(self) -> plots.Table | None:
        """Where the model is off, or what each cause takes away."""
        return None

    def pictures(self) -> dict[str, object]:
        """Name of each figure of the report -> figure of matplotlib."""
        panels, table = self.panels(), self.table()
        gaps = [gap for gap in self.gap.values() if gap.channels]
        out = {"curves": plots.curves(panels, self.predicted)} if panels else {}
        out |= {"channels": plots.channels(gaps)} if gaps else {}
        return out | ({} if table is None else {"where": plots.matrix(table)})

    def sensor(self) -> "SensorFile | None":
        """The sensor with what was found, None where there is none to write."""
        return None

    @property
    def verdict(self) -> str:
        """What was found and what is left, in one line."""
        if not self.significant:
            return "no significant disagreement"
        names = dict.fromkeys(f.title + f.at for f in self.effects)
        parts = [f"found: {'; '.join(names)}"] if names else []
        if self.unknown:
            parts.append(f"{'remainder ' * bool(names)}unknown: {self.remainder}")
        return "; ".join(parts)

    @property
    def leading(self) -> Gap:
        """The gap that the headline is about."""
        return self.gap[self.lead] if self.lead else max(self.gap.values(), key=lambda one: one.loudness)

    @property
    def largest(self) -> str:
        """The channel in which the leading gap is largest, in words; nothing where it has no channels."""
        gap = self.leading
        known = [(b, a, name) for name, b, a in zip(gap.channels, gap.channels_before, gap.channels_after)]
        before, after, name = max((one for one in known if math.isfinite(one[0])), default=(0.0, 0.0, ""))
        return f"{name}, {before:.3g} {gap.unit} RMS, amended {after:.3g}" if name else ""

    @property
    def share(self) -> str:
        """What share is closed, in words; its interval alone where that is too wide, nothing without one."""
        low, high = self.closed_within
        if math.isnan(low):
            return ""
        what = "of the effects' own part of the gap"
        if math.isnan(self.closed):
            return f"between {low:.0%} and {high:.0%} {what} is closed: these data do not tell it closer"
        return f"{self.closed:.0%} {what} is closed ({low:.0%} .. {high:.0%})"

    @property
    def headline(self) -> str:
        """The verdict in one line: the largest gap, and what closes it, by how much, or another one."""
        gap = self.leading
        size = f"{gap.before:.3g} {gap.unit} RMS"
        size += f" where {gap.floor} {gap.unit} are noise and resolution" if gap.loudness else ""
        if not self.significant:
            begin = "Sensor and simulation agree within noise and resolution"
            if gap.loudness > _ABOVE:
                begin = "No difference is larger than the comparison itself may be off by"
            return f"{begin}; the largest difference is in {gap.name}, {size}."
        text = f"The largest gap is in {gap.name}, {size}"
        added, named = {}, set()
        for f in self.effects:  # one of several that tie speaks for all
            if f.id not in named and f.confirmed is not False:
                added[f.title], named = None, named | f.ties.keys()
        what = " and ".join(added) or " and ".join(f.title for f in self.effects)
        if not self.effects:
            return f"{text}; no known cause is sure enough for a name."
        if not added:
            return f"{text}; {what} would explain what was fitted, and held-out data contradict it."
        own = [f.gap for f in self.effects if f.gap is not None and f.confirmed]
        each = [one for one in self.gap.values() if one.before > _ABOVE * one.after] or own or [gap]
        other = max(each, key=lambda one: one.taken / max(one.before, 1e-12))
        if gap.gained:
            said = f"with {what} added it is {gap.after:.3g} {gap.unit}"
        elif other.before > _ABOVE * other.after:
            said = f"with {what} {other.before:.3g} {other.unit} in {other.name} become {other.after:.3g}"
        else:
            said = f"found beside it, with no share in it: {what}"
        return f"{text}; {said}{'; for the rest no cause is known' if self.unknown else ''}."

    def to_dict(self) -> dict:
        """Content of verdict.json: numbers, strings, lists and dicts only, no NaN."""
        document = {
            "schema": SCHEMA,
            "version": VERSION,
            "kind": self.kind,
            "name": self.name,
            "verdict": self.verdict,
            "headline": self.headline,
            "significant": self.significant,
            "effects": [f.to_dict() for f in self.effects],
            "not_named": [f.to_dict() for f in self.not_named],
            "gap": {name: gap.to_dict() for name, gap in self.gap.items()},
            "share_closed": self.closed,
            "share_closed_interval": [*self.closed_within],
            "where": self.where,
            "remainder": {"significant": self.unknown, "text": self.remainder},
            "tried": self.tried,
            "cannot_be_known": self.notes,
            "next_experiment": self.next_experiment,
            "next_command": self.next_command,
            "warnings": self.warnings,
            **self.details,
        }
        written = json.dumps(document, default=lambda array: array.tolist())
        return json.loads(written, parse_constant=lambda _: None)


def experiments(findings: typing.Sequence[Finding], known: typing.Container[str] | None = None) -> list[str]:
    """A line for each experiment that would distinguish Findings from what they tie with, or else from the
    first that each is confused with; known: ids of such, None: all."""
    out = {}
    for f in findings:
        for other in f.ties or [i for i in f.confusable if known is None or i in known][:1]:
            out[f"to tell {f.name} from {name_of(other)}: {f.experiment(other)}"] = None
    return list(out)[:_NEXT]


def electrode_names(electrodes: typing.Sequence[int]) -> list[str]:
    """e1, e2, ... of numbers from 0."""
    return [f"e{k + 1}" for k in electrodes]


def of_electrodes(names: typing.Iterable[str]) -> tuple[int, ...]:
    """Numbers from 0 of the electrodes that parameters are named after."""
    return tuple(int(name[1:]) - 1 for name in names if re.fullmatch(r"e[1-9]\d*", name))
