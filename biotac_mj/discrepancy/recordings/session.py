"""State of the search on a plain recording: the recording without the effects found so far."""

import numpy as np

from .candidates import Candidate
from .model import Model
from .recording import PlainRecording


class Session:
    """The recording less what was found.

    Attributes:
      recording; fit: (n,) bool, rows that may be used, from row 0 on; counts (n, nelectrode); masked
      (n, nelectrode) bool; findings; weak: those that are too little to be named, or contradicted; unnamed:
      faults of the log that no effect of the catalogue is; protocol: of a checkup, or None.
    """

    def __init__(
        self,
        recording: PlainRecording,
        fit: np.ndarray,
        findings: tuple | list = (),
        unnamed: tuple | list = (),
    ):
        self.recording, self.fit = recording, fit
        self.findings, self.weak, self.unnamed = list(findings), [], list(unnamed)
        self.fresh, self.protocol = 1 - recording.repeated.mean(), None
        self.replay()

    def replay(self) -> None:
        """Counts and mask from the recording and the findings."""
        r = self.recording
        self.counts, self.masked = r.electrodes.copy(), np.zeros(r.electrodes.shape, bool)
        for finding in (*self.unnamed, *self.findings):
            self._take_out(finding)
        self._model = None

    @property
    def ordered(self) -> list[Candidate]:
        """Findings, the largest gap closed first; they are taken out in the order they were found in."""
        return sorted(self.findings, key=_taken, reverse=True)

    def accept(self, finding: Candidate) -> None:
        self.findings.append(finding)
        self._take_out(finding)
        self._model = None

    def take_back(self, *findings: Candidate) -> None:
        """Findings that are too little to be named after all."""
        for finding in findings:
            self.findings.remove(finding)
            self.weak.append(finding)
        if findings:
            self.replay()

    def without(self, *left_out: Candidate) -> "Session":
        """A session in which some findings are not taken out."""
        out = Session(self.recording, self.fit, [f for f in self.findings if f not in left_out], self.unnamed)
        out.weak = list(self.weak)
        return out

    def model(self) -> Model:
        """The joint model of the corrected counts."""
        if self._model is None:
            self._model = Model(self.counts, ~self.masked, self.fit, self.recording.rate, self.fresh)
        return self._model

    @property
    def step(self) -> float:
        """[counts] between values that are coarse, 0 where none are."""
        return max((f.parameters["step"][0] for f in self.findings if "step" in f.parameters), default=0.0)

    @property
    def loaded(self) -> bool:
        return self.model().dimensions >= 2

    def filled(self) -> np.ndarray:
        """(n, nelectrode) counts without the effects; samples that are no measurement are predicted from the
        other electrodes."""
        from ...sensor.channels import counts_from_log_impedance

        if not self.masked.any():
            return self.counts
        m, out = self.model(), self.counts.copy()
        said = m.value + m.mean - np.where(m.known, 0, m.residual() if m.dimensions else 0)
        time, rows = self.recording.time, np.arange(len(self.counts))
        for k in np.flatnonzero(self.masked.any(0)):
            hole = self.masked[:, k]
            if hole.all():
                continue
            out[hole, k] = np.interp(rows[hole], rows[~hole], self.counts[~hole, k])
            # across more than a few bins the other electrodes predict better than a line does
            edge = np.flatnonzero(np.diff(np.concatenate([[False], hole, [False]])))
            place = np.flatnonzero(m.used == k)
            for first, last in zip(edge[::2], edge[1::2]):
                if last - first > 3 * m.width and len(place) and not self.masked[first:last].all(1).any():
                    z = np.interp(time[first:last], m.time, said[:, place[0]])
                    out[first:last, k] = counts_from_log_impedance(z)
        for finding in self.findings:
            if finding.beyond:
                limit = np.maximum if finding.beyond > 0 else np.minimum
                out = np.where(finding.mask, limit(out, self.recording.electrodes), out)
        return out

    def _take_out(self, finding):
        if finding.mask is not None:
            self.masked |= finding.mask
        if finding.correct is not None:
            self.counts = finding.correct(self.counts, self.recording.time)


def _taken(finding):
    """Decrease of the held-out rows' RMS by a finding [counts]; 0 for findings in other units."""
    gap = finding.gap
    return gap.taken if gap is not None and gap.unit == "counts" and np.isfinite(gap.after) else 0.0
