"""What the search on a plain recording knows: the recording less what was found so far."""

import typing

import numpy as np

from .load_search import ForceView
from .recording import Recording
from .timeline import Timeline

if typing.TYPE_CHECKING:
    from .effects.effect import Finding

__all__ = ["Session"]


class Session:
    """What the search knows. `counts` is the recording less what was found so far.

    Attributes:
      recording; fit: (n,) bool, rows that may be used; counts (n, 19); masked (n, 19) bool; findings.
    """

    def __init__(self, recording: Recording, fit: np.ndarray):
        self.recording, self.fit = recording, fit
        self.counts = recording.electrodes.copy()
        self.masked = np.zeros(self.counts.shape, bool)
        self.findings = []
        self.force = recording.force  # as the electrodes follow it
        self._timelines = {}
        self._view = None
        self.unnamed = []  # what was seen and given up: texts
        self.events = {}  # (electrode, second) -> counts: left the others and came back, no effect

    def give_up(self, findings: "list[Finding]", text: str) -> None:
        """Takes findings back: what they describe belongs to something that has no name here."""
        keep = [f for f in self.findings if f not in findings]
        self.findings, self.counts, self.force = [], self.recording.electrodes.copy(), self.recording.force
        self._timelines, self._view = {}, None
        self.unnamed.append(text)
        for finding in keep:
            self.accept(finding)

    def force_view(self) -> ForceView | None:
        """ForceView of the corrected counts, or None where force and electrodes are not related."""
        if self.force is None or self.force[self.fit].std(0).max() < 0.02:
            return None
        if self._view is None:
            view = self.force_view_of(self.fit)
            self._view = view if view is not None and view.explained() > 0.3 else False
        return self._view or None

    def force_view_of(self, rows: np.ndarray) -> ForceView | None:
        """ForceView of contiguous rows (n,) bool with what was found between force and electrodes, or None
        with too few electrodes."""
        usable = np.flatnonzero(~(self.masked[rows].mean(0) > 0.02))
        chain = [(f.effect, f.theta) for f in self.findings if hasattr(f.effect, "see")]
        return (
            ForceView(self.counts, self.recording.force, rows, usable, self.recording.rate, chain)
            if len(usable) >= 6
            else None
        )

    def timeline(self, rows: slice | None = None, counts: np.ndarray | None = None) -> Timeline:
        """Bins of the rows to fit, or of others (a slice, contiguous)."""
        if counts is not None:
            return self._make(self._slice(self.fit) if rows is None else rows, counts)
        rows = self._slice(self.fit) if rows is None else rows
        key = rows.start, rows.stop
        if key not in self._timelines:
            self._timelines[key] = self._make(rows, self.counts)
        return self._timelines[key]

    @property
    def known_jumps(self) -> list[float]:
        """Times [s] of the jumps found so far, swaps among them."""
        steps = [
            f
            for f in self.findings
            if f.id == "swap" or f.theta.get("kind") in ("step", "pulse") or f.id == "gain"
        ]
        return [t for f in steps for t in (f.start, f.end) if 0 < t < self.recording.time[-1]]

    def accept(self, finding: "Finding") -> None:
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
