"""What an effect on plain recordings is: found in a `Session`, applied to clean counts, taken out of measured
ones."""

import abc
import dataclasses

import numpy as np

from .recording import Recording
from .timeline import Timeline

__all__ = ["Finding", "Parameter", "RecordedEffect", "Session", "runs", "spans"]

STAGES = {
    "C": "constitutive",
    "B": "boundary",
    "K": "contact",
    "T": "transduction",
    "A": "acquisition",
    "S": "set-up",
}


@dataclasses.dataclass(frozen=True)
class Parameter:
    """unit; bounds low, high; source of the bounds."""

    unit: str
    low: float
    high: float
    source: str


@dataclasses.dataclass
class Finding:
    """An effect that was found.

    Attributes:
      effect: RecordedEffect. channels: electrode numbers from 0. theta: what `apply` and `correct` need.
      parameters: name -> (value, low, high) to report; low and high are nan where no interval is known.
      nats: evidence, log-likelihood of effectively independent samples less the price of the parameters. p:
        of the test, blocks in time.
      start, end: [s] when it acts. ties: ids that fit as well. note: in words.
      statistic: name, unit and value of the number that diagnoses the effect, before and after, on the part
        kept aside.
      verified: whether the part kept aside confirms it; None if it could not be checked. confidence: 0..1.
    """

    effect: "RecordedEffect"
    channels: tuple
    theta: dict
    parameters: dict
    nats: float
    start: float
    end: float
    p: float = float("nan")
    ties: tuple = ()
    note: str = ""
    statistic: dict = dataclasses.field(default_factory=dict)
    verified: bool | None = None
    confidence: float = 0.0

    @property
    def id(self):
        return self.effect.id

    def correct(self, counts, time):
        return self.effect.correct(counts, time, self.channels, self.theta)

    def apply(self, counts, time):
        return self.effect.apply(counts, time, self.channels, self.theta)


class RecordedEffect(abc.ABC):
    """One effect that recordings alone can show.

    Subclasses set id, name, stage (of STAGES), physics, params (name -> Parameter) and confusable (id -> what
    would tell them apart) and write

      find(session) -> list of Finding: on the rows `session.fit` only;
      apply(counts, time, channels, theta): counts (n, 19) as the effect changes them;
      correct(...): the inverse, as far as there is one; samples that cannot be had back are marked by `mask`;
      statistic(session, counts, rows, finding): the number that shows the effect, near zero without it.
    """

    id = name = stage = physics = unit = ""
    params: dict = {}
    confusable: dict = {}

    @abc.abstractmethod
    def find(self, session) -> list:
        """Findings in the part of the session that may be fitted."""

    def apply(self, counts, time, channels, theta):
        return counts

    def correct(self, counts, time, channels, theta):
        return counts

    def mask(self, counts, time, finding):
        """(n, 19) bool of samples that are no measurement, or None."""
        return None


class Session:
    """What the search knows. `counts` is the recording less what was found so far.

    Attributes:
      recording; fit: (n,) bool, rows that may be used; counts (n, 19); masked (n, 19) bool; findings.
    """

    def __init__(self, recording: Recording, fit):
        self.recording, self.fit = recording, fit
        self.counts = recording.electrodes.copy()
        self.masked = np.zeros(self.counts.shape, bool)
        self.findings = []
        self.force = recording.force  # as the electrodes follow it
        self._timelines = {}
        self._view = None
        self.unnamed = []  # what was seen and given up: texts
        self.events = {}  # (electrode, second) -> counts: left the others and came back, no effect

    def give_up(self, findings, text):
        """Takes findings back: what they describe belongs to something that has no name here."""
        keep = [f for f in self.findings if f not in findings]
        self.findings, self.counts, self.force = [], self.recording.electrodes.copy(), self.recording.force
        self._timelines, self._view = {}, None
        self.unnamed.append(text)
        for finding in keep:
            self.accept(finding)

    def force_view(self):
        """ForceView of the corrected counts, or None where force and electrodes are not related."""
        if self.force is None or self.force[self.fit].std(0).max() < 0.02:
            return None
        if self._view is None:
            view = self.force_view_of(self.fit)
            self._view = view if view is not None and view.explained() > 0.3 else False
        return self._view or None

    def force_view_of(self, rows):
        """ForceView of contiguous rows (n,) bool with what was found between force and electrodes, or None
        with too few electrodes."""
        from .load_search import ForceView

        usable = np.flatnonzero(~(self.masked[rows].mean(0) > 0.02))
        chain = [(f.effect, f.theta) for f in self.findings if hasattr(f.effect, "see")]
        return (
            ForceView(self.counts, self.recording.force, rows, usable, self.recording.rate, chain)
            if len(usable) >= 6
            else None
        )

    def timeline(self, rows=None, counts=None) -> Timeline:
        """Bins of the rows to fit, or of others (a slice, contiguous)."""
        if counts is not None:
            return self._make(self._slice(self.fit) if rows is None else rows, counts)
        rows = self._slice(self.fit) if rows is None else rows
        key = rows.start, rows.stop
        if key not in self._timelines:
            self._timelines[key] = self._make(rows, self.counts)
        return self._timelines[key]

    @property
    def known_jumps(self):
        """Times [s] of the jumps found so far, swaps among them."""
        steps = [
            f
            for f in self.findings
            if f.id == "swap" or f.theta.get("kind") in ("step", "pulse") or f.id == "gain"
        ]
        return [t for f in steps for t in (f.start, f.end) if 0 < t < self.recording.time[-1]]

    def accept(self, finding):
        """Takes a finding out of the counts."""
        self.findings.append(finding)
        self._take_out(finding)

    def _take_out(self, finding):
        mask = finding.effect.mask(self.counts, self.recording.time, finding)
        if mask is not None:
            self.masked |= mask
        if hasattr(finding.effect, "see"):
            self.force = finding.effect.see(self.force, self.recording.rate, finding.theta)
        else:
            self.counts = finding.correct(self.counts, self.recording.time)
        self._timelines, self._view = {}, None

    def _make(self, rows, counts):
        r = self.recording
        part = Recording(counts[rows], None, None, r.rate, r.rate_source, r.name)
        line = Timeline(part, masked=self.masked[rows])
        line.time = line.time + (rows.start or 0) / r.rate
        return line

    @staticmethod
    def _slice(mask):
        where = np.flatnonzero(mask)
        return slice(int(where[0]), int(where[-1]) + 1)


def runs(x):
    """Starts and lengths of runs of equal values."""
    edge = np.concatenate([[0], np.flatnonzero(np.diff(x) != 0) + 1, [len(x)]])
    return edge[:-1], np.diff(edge)


def spans(flag, edges, least=2):
    """Contiguous stretches [s] of windows that are True; edges (w + 1,) [s]. One window missing inside a
    stretch is bridged."""
    flag = np.asarray(flag, bool).copy()
    flag[1:-1] |= flag[:-2] & flag[2:]
    starts, lengths = runs(flag.astype(int))
    return [
        (float(edges[s]), float(edges[s + n]))
        for s, n in zip(starts, lengths)
        if flag[s] and n >= min(least, len(flag))
    ]
