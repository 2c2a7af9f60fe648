"""Diagnosis of plain recordings: what the sensor's model misses, found on the first part, checked on the part
kept aside."""

import dataclasses
import math

import numpy as np
import tqdm

from ...quality.check import Checked, lost_rows, sample_faults
from ...quality.confidence import clear
from ...quality.confidence import confidence as confidence_of
from ...recordings import Recording
from ...recordings.recording import REST_LIKE
from ..evidence import benjamini_hochberg
from ..report.verdict import Gap
from .apart import apart
from .candidates import Candidate
from .confidence import NAMED, confidence, family
from .connected import part_connected
from .families.latency import delayed
from .families.levels.jumps import jumped
from .families.levels.levels import levels, settle
from .families.order import exchanged, reversed_sign, slipped
from .faults import as_candidates, as_log
from .model import LEAST, WINDOW
from .proof import prove, views
from .recording import FORCE_MOVED, PlainRecording, as_plain
from .rest import Rest, rest
from .session import Session
from .tared import untold

__all__ = ["RecordingDiagnosis", "diagnose_recording"]

_MOST = 8  # of courses over time
_FALSE = 0.05  # of the names of a report
_LAST = 0.9  # of the rows fitted, after which what begins is no course in them
_LATE = 0.73  # confidence from which it is named there: nothing is left to confirm it
_FEW = 4  # electrodes that drift or jump each by itself: what more do under load has another cause
_P = 0.02  # of sign flips of blocks: more is no finding, whatever its size


@dataclasses.dataclass
class RecordingDiagnosis:
    """What was found.

    Attributes:
      recording: with upper bits put back where counts overflowed; locked: share kept aside at the end;
      verdict: one line; findings: named, the largest gap closed first; rejected: those that the part kept
      aside contradicts or that are too weak to be named; late: those that begin in the part kept aside;
      gap: views with before and after; rest: what is left; notes: what the data cannot tell; session: counts
      without the effects.
    """

    recording: PlainRecording
    locked: float
    verdict: str
    findings: list[Candidate]
    rejected: list[Candidate]
    late: list[Candidate]
    gap: dict[str, Gap]
    rest: Rest
    notes: list[str]
    session: Session


def diagnose_recording(
    recording: PlainRecording | Recording,
    locked: float | None = None,
    progress: bool = False,
    named: float = NAMED,
) -> RecordingDiagnosis:
    """Finds what the model misses in one recording.

    Args:
      recording: with electrodes; force and TDC take part where they are there, poses do not.
      locked: share of the rows at the end that takes no part; None: 0.4 without force, 0.3 with force.
      progress: whether to show a bar.
      named: confidence from which a finding is named.

    Raises:
      ValueError: a share that leaves too little on one side; a recording without electrodes, or with too few
        rows. TypeError: no recording.
    """
    recording = as_plain(recording)
    locked = (0.4 if recording.force is None else 0.3) if locked is None else locked
    n = len(recording)
    if not 0.1 <= locked <= 0.6:
        raise ValueError(f"locked is {locked}: keep between 0.1 and 0.6 of the rows aside")
    fit = np.arange(n) < round(n * (1 - locked))
    with tqdm.tqdm(total=5, desc="diagnose", disable=not progress or None, leave=False) as bar:
        checked = sample_faults(as_log(recording), named)
        recording = dataclasses.replace(recording, electrodes=checked.log.counts)
        session, weak = Session(recording, fit), []
        _faults(session, weak, checked)
        many = _search(session, weak, checked, named, bar)
        late = _late(session, named)
        bar.update()
        for finding in session.findings:
            prove(session, finding)
        # of all that was tested here, one in twenty of those named may be false (Benjamini and Hochberg 1995)
        tested = [*session.findings, *weak]
        q = dict(zip(map(id, tested), benjamini_hochberg(np.array([f.p for f in tested]))))
        # what is wrong with the log is said whatever else was tested
        chance = {id(f) for f in session.findings if q[id(f)] > _FALSE and "detector" not in f.clues}
        contradicted = [f for f in session.findings if f.verified is False or id(f) in chance]
        if contradicted:
            session = session.without(*contradicted)
        session.findings.sort(key=lambda f: -_taken(f))
        left = rest(session, [*contradicted, *weak], many)
        result = RecordingDiagnosis(
            recording,
            locked,
            "",
            session.findings,
            [*contradicted, *weak],
            late,
            views(session),
            left,
            _notes(recording, session),
            session,
        )
        result.verdict = _verdict(result)
        bar.update()
    return result


def _faults(session, weak, checked: Checked):
    """Takes over what is wrong with the log, whatever the sensor did."""
    found, session.unnamed = as_candidates(checked.faults)
    for finding in found:
        session.accept(finding)
    weak += as_candidates(checked.weak)[0]


def _lost_rows(session, weak, checked, named):
    """Takes over rows that are missing: an exchange or a jump is none, nor what begins on all electrodes."""
    begun = (f.start for f in session.findings if len(f.channels) > 12 and "course" not in f.clues)
    log = as_log(session.recording, session.counts, session.masked)
    for fault in lost_rows(log, checked.faults, tuple(t for t in begun if t > 0)):
        fault.confidence = confidence_of(fault)
        found, unnamed = as_candidates([fault])
        if clear(fault, named):
            session.unnamed += unnamed
            for finding in found:
                session.accept(finding)
        else:
            weak += found


def _search(session, weak, checked, named, bar):
    def sure(finding):
        return confidence(finding, _beside(finding, session, weak))

    def take(finding):
        alone = "course" in finding.clues and len(finding.channels) == 1
        if alone and finding.p < _P:  # judged as it is beside all others
            session.accept(finding)
            settle(session)
            finding.confidence = sure(finding)
            if finding.confidence >= named:
                return True
            session.findings.remove(finding)
            session.replay()
            settle(session)
        finding.confidence = sure(finding)
        if finding.confidence >= named and finding.p < _P and not alone:
            session.accept(finding)
            return True
        weak.append(finding)
        return False

    part_connected(session)
    signs = (reversed_sign,) if session.recording.signed else ()
    for find in (slipped, exchanged, *signs):
        finding = find(session)
        if finding is not None:
            take(finding)
    bar.update()
    for finding in jumped(session):
        take(finding)
    _courses(session, take)
    settle(session)
    for finding in [f for f in session.findings if "share" in f.clues]:
        finding.confidence = sure(finding)  # it may have another name now
        if finding.confidence < named:
            session.findings.remove(finding)
            session.replay()
            weak.append(finding)
    many = _withdraw_many(session, weak)
    bar.update()
    _lost_rows(session, weak, checked, named)
    bar.update()
    # where the force is of another time nothing lies between the two
    finding = None if apart(session) else delayed(session)
    if finding is not None:
        take(finding)
    _judge_together(session, weak, named)
    bar.update()
    return many


def _courses(session, take):
    """Courses over time, the strongest first."""
    refused = set()
    for _ in range(_MOST + 4):
        finding = levels(session, refused)
        if finding is None:
            return
        same = [f for f in session.findings if f.channels == finding.channels]
        again = any("edge" in f.clues for f in same)
        if again or _more_of_the_same(session, finding) or not take(finding):
            refused.add((None,) if len(finding.channels) > 12 else finding.channels)


def _beside(finding, session, weak):
    """Number of other candidates of a finding's family; what jumps at the same row is one."""
    kind, row = family(finding), finding.start if "edge" in finding.clues else None
    others = (f for f in (*session.findings, *weak) if f is not finding and family(f) == kind)
    return sum(row is None or f.start != row for f in others)


def _judge_together(session, weak, named):
    """Takes back what is too little to be named beside all that was found after it."""
    for finding in session.findings:
        finding.confidence = confidence(finding, _beside(finding, session, weak))
    refused = [f for f in session.findings if f.confidence < named]
    for finding in refused:
        session.findings.remove(finding)
        weak.append(finding)
    if refused:
        session.replay()


def _withdraw_many(session, weak):
    """Takes back drifts and jumps of single electrodes where many of a loaded sensor's have one: what lags
    behind the load, for instance, moves each by its own share. Returns those taken back, and jumps that are
    too little to be named."""
    single = [f for f in session.findings if f.id == "drift" and len(f.channels) == 1]
    # too little each, but as many as there are
    jumps = [f for f in weak if "edge" in f.clues and f.p < _P]
    if not session.loaded or len({f.channels for f in (*single, *jumps)}) <= _FEW:
        return []
    for finding in single:
        session.findings.remove(finding)
        weak.append(finding)
    session.replay()
    return [*single, *jumps]


def _more_of_the_same(session, finding):
    """Whether a course refines one that is there already: both are then fitted together (`settle`)."""
    course = finding.clues.get("course")
    known = [f for f in session.findings if "course" in f.clues and f.channels == finding.channels]
    if len(finding.channels) > 12:  # a jump of the supply beside a warm-up is an effect of its own
        known = [f for f in known if (f.clues["course"].kind == "step") == (course.kind == "step")]
    if not known:
        return False
    return _refine(session, known[0], finding)


def _refine(session, known, finding):
    """Adds a course to a finding."""
    first, second = known.correct, finding.correct
    known.correct = lambda counts, at: second(first(counts, at), at)
    session.replay()
    return True


def _late(session, named):
    """Effects of single electrodes or all that begin in the part kept aside: searched in the whole record,
    less what was found; nothing is left to confirm them."""
    r = session.recording
    begin = r.time[~session.fit][0]
    whole = Session(r, np.ones(len(r), bool), session.findings, session.unread)
    found, refused = [], set()
    for _ in range(4):
        finding = levels(whole, refused)
        if finding is None:
            break
        finding.confidence = confidence(finding)
        refused.add((None,) if len(finding.channels) > 12 else finding.channels)
        course = finding.clues["course"]
        if (
            finding.confidence >= max(named, _LATE)
            and course.kind != "smooth"
            and course.onset > _LAST * begin
        ):
            finding.verified, finding.start = None, float(course.onset)
            finding.note += "; it begins so late that nothing is left to confirm it"
            found.append(finding)
            whole.accept(finding)
    return found


def _notes(recording, session):
    loads = "saturation, the sign of an electrode"
    out = [f"{recording.rate:.1f} Hz: {recording.rate_source}"]
    if recording.force is None:
        out.append("no force: how late the electrodes follow it")
    if recording.tdc is None:
        out.append("no TDC: whether a warm-up is the liquid's temperature")
    if not session.model().parted:
        out.append(
            f"too short to tell touches from drift, record {math.ceil(LEAST / session.fit.mean())} s or "
            f"more: slow changes of single electrodes, {loads}"
        )
    elif not session.loaded and recording.force is not None and recording.force.std(0).max() > FORCE_MOVED:
        out.append(
            "touches could not be told from drift, record some at several places that each change electrodes "
            f"by tens of counts within {WINDOW[0]:g} s: {loads}"
        )
    elif not session.loaded:
        out.append(f"not loaded: {loads}")
    out += untold(recording.unit)
    if recording.absolute and recording.rest_correlation < REST_LIKE:
        out.append(
            "rest levels unlike those of published sensors: an order of channels that is wrong all the time"
        )
    return out


def _verdict(d):
    if not (d.findings or d.late or d.rest.significant):
        return "no significant disagreement"
    parts = []
    if d.findings or d.late:
        names = dict.fromkeys(
            f.kind.name
            + ("" if len(f.channels) > 12 else " " + ", ".join(f"e{k + 1}" for k in f.channels[:4]))
            for f in (*d.findings, *d.late)
        )
        parts.append("found: " + "; ".join(names))
    if d.rest.significant:
        parts.append(("remainder " if parts else "") + "unknown: " + d.rest.text)
    return "; ".join(parts)


def _taken(finding):
    """Counts RMS that a candidate takes away from rows kept aside, 0 of what is measured in another unit."""
    gap = finding.gap
    return gap.taken if gap is not None and gap.unit == "counts" and np.isfinite(gap.after) else 0.0
