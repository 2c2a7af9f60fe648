"""Diagnosis of a plain recording: its verdict with figures, and its sensor."""

import dataclasses

import numpy as np

from ...effects.catalogue import name_of
from ...effects.sensor_file import SensorFile
from ...recordings.protocol import Protocol
from ...recordings.recording import REST_LIKE
from ...sensor.channels import counts_from_log_impedance
from ..report.plots import Panel
from ..report.verdict import Estimate, Finding, Verdict, experiments
from .amended import amended_sensor, running
from .blind import not_identifiable, searched
from .candidates import Candidate
from .proof import views
from .recording import PlainRecording
from .rest import Rest, rest
from .session import Session

_PANELS = 4  # channels, of the report's first figure
_REPEATED = 0.02  # of the rows: of a bus that is slower than the logger, and no fault
_CHECKUP = "three minutes of touches that isolate one effect each tell what a plain log mixes"
_ORDER = "rest levels unlike those of published sensors: an order of channels that is wrong all the time"


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordingDiagnosis(Verdict):
    """A verdict on a plain recording.

    Attributes:
      session: counts without the effects; locked: fraction held out at the end; late: named, and begun in
        the held-out part; rest: what is left.
    """

    session: Session
    locked: float
    late: list[Candidate]
    rest: Rest

    predicted = "simulated: rest and load, as the others say it"

    @property
    def recording(self) -> PlainRecording:
        """With upper bits put back where counts overflowed."""
        return self.session.recording

    @property
    def findings(self) -> list[Candidate]:
        """Named, the largest gap closed first."""
        return self.session.ordered

    def panels(self) -> list[list[Panel]]:
        """Electrodes that never measure and those that the effects change most, or those with the largest
        residual; beside each baseline and load as the other electrodes predict them."""
        s, r, m = self.session, self.recording, self.session.model()
        said = counts_from_log_impedance(m.value - (m.residual() if m.dimensions else m.value) + m.mean)
        effect = r.electrodes - s.filled()
        change = np.sqrt((effect**2).mean(0))
        some = np.flatnonzero(s.masked.all(0)).tolist()
        some += [int(k) for k in np.argsort(-change) if change[k] > 0.2 * change.max() and k not in some]
        if not self.findings:
            some = [int(c["channel"][1:]) - 1 for c in self.rest.cells][:2]
        measured, effect = (
            x[: len(m.time) * m.width].reshape(len(m.time), m.width, -1).mean(1)
            for x in (r.electrodes, effect)
        )
        aside, out = (r.time[~s.fit][0], r.time[-1]), []
        for k in some[:_PANELS] or [0]:
            simulated = said[:, np.flatnonzero(m.used == k)[0]] if k in m.used else None
            amended = None if simulated is None else simulated + effect[:, k]
            acting = [f for f in self.findings if k in f.channels and (f.correct or f.mask is not None)]
            title = ": ".join(filter(None, (f"e{k + 1}", "; ".join({f.kind.name: 0 for f in acting}))))
            out.append([Panel(title, "counts", m.time, measured[:, k], simulated, amended, aside)])
        return out

    def sensor(self) -> SensorFile:
        return amended_sensor(self.session)


def concluded(
    session: Session, locked: float, late: list[Candidate], protocol: Protocol | None = None
) -> RecordingDiagnosis:
    """The diagnosis of a session from which all that is named has been taken out."""
    r, left, found = session.recording, rest(session), [*session.ordered, *late]
    seconds = len(r) / r.rate
    data = f"read as {r.design.title}, {len(r)} rows, {seconds:.0f} s at {r.rate:.1f} Hz ({r.rate_source})"
    if (repeated := r.repeated.mean()) > _REPEATED:
        data += f", of which {repeated:.0%} repeat the one before"
    data += ", with force" if r.force is not None else ""
    further = experiments([_finding(f) for f in session.ordered])
    return RecordingDiagnosis(
        kind="plain recording",
        name=r.name,
        data=f"{data}; last {locked:.0%} held out",
        warnings=list(r.warnings),
        significant=bool(found) or left.significant,
        effects=[_finding(f) for f in found],
        not_named=[_finding(f) for f in session.weak],
        gap=views(session),
        aside="rows that took no part in any fit",
        where=left.cells,
        where_note="electrodes that depart, from and to [s], RMS [counts]",
        remainder=left.text,
        unknown=left.significant,
        tried=_tried(session, found),
        tried_note="confidence of each cause that these data can show; none where nothing looks like it",
        notes=not_identifiable(session) + [_ORDER] * (r.absolute and not r.rest_correlation >= REST_LIKE),
        next_experiment="; ".join(further + ([] if protocol else [_CHECKUP])),
        next_command="" if protocol else "biotac checkup --out protocol.yaml",
        amended=_amended(session),
        details={
            "recording": {
                "name": r.name,
                "design": r.design.name,
                "rows": len(r),
                "rate_hz": r.rate,
                "rate_source": r.rate_source,
                "seconds": seconds,
                "force": r.force is not None,
                "tdc": r.tdc is not None,
                "loaded": session.loaded,
                "locked_share": locked,
            },
        },
        session=session,
        locked=locked,
        late=late,
        rest=left,
    )


def _tried(session, found):
    """Rows of all effects that were searched, the most confident first."""
    rows = {e.id: {"id": e.id, "name": e.name, "confidence": None} for e in searched(session)}
    for f in sorted((*found, *session.weak), key=lambda f: f.confidence or 0.0):
        rows.pop(f.id, None)
        rows = {f.id: {"id": f.id, "name": f.kind.name, "confidence": f.confidence}} | rows
    return list(rows.values())


def _finding(f: Candidate) -> Finding:
    known = f.kind.params
    return Finding.of(
        f.kind,
        channels=tuple(f.channels),
        parameters={name: Estimate.of(known[name], *values) for name, values in f.parameters.items()},
        evidence=f.nats,
        p=f.p,
        confidence=f.confidence,
        confirmed=f.verified,
        ties={i: name_of(i) for i in f.ties},
        gap=f.gap,
        note=f.message,
        start=f.start,
        end=f.end,
    )


def _amended(session):
    lines = [
        "sensor_amended.yaml has calibrated rubber, as real sensors were matched with: softer than default"
    ]
    if left := running(session)[1]:
        lines.append(
            f"not in sensor_amended.yaml: {', '.join(map(name_of, left))}: of the logger, of the force or of "
            "the moment, or no running sensor has it, or held-out rows are further off with it"
        )
    return lines
