"""Diagnosis of plain recordings: effects beyond the sensor's model, found on the first part, checked on the
held-out part."""

import dataclasses

import numpy as np
import tqdm

from ...quality.check import less, lost_rows, sample_faults
from ...quality.confidence import NAMED, clear, confidence
from ...quality.still import at_rest, between_rests
from ...recordings import Recording
from ...recordings.protocol import Protocol
from ..evidence import discoveries
from .candidates import as_candidates, as_log
from .detectors.jumps import jumped
from .detectors.lagging import lagging
from .detectors.latency import delayed
from .detectors.levels import levels, settle
from .detectors.memory import remembered
from .detectors.order import slipped
from .diagnosis import RecordingDiagnosis, concluded
from .proof import prove
from .recording import PlainRecording, as_plain, enough
from .segments import free_rows, moved, stretches
from .session import Session

_MOST = 8  # of trends over time
_LAST = 0.9  # of the rows fitted, after which what begins is no trend in them
_LATE = 0.73  # confidence from which it is named there: nothing is left to confirm it
# [counts] beyond a limit, fraction of the rows that may be there
_LIMIT, _RARELY = 5.0, 0.01
_P = 0.02  # of sign flips of blocks: more is no finding, whatever its size


def diagnose_recording(
    recording: PlainRecording | Recording,
    locked: float | None = None,
    progress: bool = False,
    protocol: Protocol | None = None,
) -> RecordingDiagnosis:
    """Finds what the model misses in one recording.

    Args:
      recording: with electrodes; force and TDC take part where they are there, poses do not.
      locked: fraction of the rows at the end that takes no part; None: 0.4 without force, 0.3 with force.
      progress: whether to show a bar.
      protocol: when what was done with the sensor: each stretch in which it was touched, or not, is then
        searched by itself too.

    Raises:
      ValueError: `locked` leaves too little on one side; a recording without electrodes, or with too few
        rows. TypeError: no recording.
    """
    recording = as_plain(recording)
    locked = (0.4 if recording.force is None else 0.3) if locked is None else locked
    n = len(recording)
    if not 0.1 <= locked <= 0.6:
        raise ValueError(f"locked is {locked}: hold out between 0.1 and 0.6 of the rows")
    with tqdm.tqdm(total=5, desc="diagnose", disable=not progress or None, leave=False) as bar:
        checked = sample_faults(as_log(recording))
        recording = dataclasses.replace(recording, electrodes=checked.log.counts)
        session = Session(recording, np.arange(n) < round(n * (1 - locked)))
        _adopt(session, checked.faults, checked.weak)
        bar.update()
        _levels(session)
        bar.update()
        _later_faults(session, checked)
        bar.update()
        late = _late(session)
        bar.update()
        session = _proved(session)
        if protocol is not None:
            _checkup(session, protocol)
        result = concluded(session, locked, late, protocol)
        bar.update()
    return result


def _adopt(session, faults, weak):
    """Takes over what is wrong with the log, whatever the sensor did."""
    found, unnamed = as_candidates(faults)
    if unnamed:
        session.unnamed += unnamed
        session.replay()
    for finding in found:
        session.accept(finding)
    session.weak += as_candidates(weak)[0]


def _levels(session):
    """Channels that are exchanged, jumps, and trends over time, the strongest first."""
    if (finding := slipped(session)) is not None:
        _take(session, finding)
    for finding in jumped(session):
        _take(session, finding)
    rejected = set()
    for _ in range(_MOST + 4):
        finding = levels(session, rejected)
        if finding is None:
            break
        same = [f for f in session.findings if f.channels == finding.channels]
        jumps = not finding.of_all and any(f.sudden for f in same)
        if jumps or _refined(session, finding, same) or not _take(session, finding):
            rejected.add((None,) if finding.of_all else finding.channels)
    settle(session)


def _later_faults(session, checked):
    """Rows that are missing, and how late the electrodes follow the force; then all are judged together."""
    # an exchange or a jump is no lost row, nor what begins on all electrodes
    begun = [f.start for f in session.findings if f.of_all and f.trend is None and f.start > 0]
    begun += session.recording.time[list(session.recording.joints)].tolist()
    for fault in lost_rows(as_log(session.recording, session.counts, session.masked), checked.faults, begun):
        fault.confidence = confidence(fault)
        _adopt(session, *(([fault], []) if clear(fault) else ([], [fault])))
    if (finding := delayed(session)) is not None:
        _take(session, finding)
    if (finding := lagging(session)) is not None:
        _take(session, finding)
    for finding in session.findings:
        finding.confidence = _sure(session, finding)
    session.take_back(*(f for f in session.findings if f.confidence < NAMED))


def _take(session, finding):
    """Takes a finding out of the counts if it is likely enough beside all others."""
    single = finding.trend is not None and finding.fraction is None
    if finding.p >= _P or not finding.possible:
        finding.confidence = _sure(session, finding)
        session.weak.append(finding)
        return False
    session.accept(finding)
    if single:  # judged as it is beside all others
        settle(session)
    finding.confidence = _sure(session, finding)
    if finding.confidence >= NAMED:
        return True
    session.take_back(finding)
    if single:
        settle(session)
    return False


def _sure(session, finding):
    """Confidence of a finding beside the others of its detector."""
    others = (f for f in (*session.findings, *session.weak) if f is not finding)
    same = [f for f in others if f.detector == finding.detector]
    return confidence(finding, sum(not f.sudden or f.start != finding.start for f in same))


def _refined(session, finding, same):
    """Whether a trend refines one of the same electrodes: both are then fitted together (`settle`)."""
    known = [f for f in same if f.trend is not None]
    if finding.of_all:  # a jump of the supply beside a warm-up is an effect of its own
        known = [f for f in known if (f.trend.kind == "step") == (finding.trend.kind == "step")]
    if known:
        first, second = known[0].correct, finding.correct
        known[0].correct = lambda counts, at: second(first(counts, at), at)
        session.replay()
    return bool(known)


def _proved(session):
    """The session without the findings that held-out rows contradict or that exceed the false-discovery
    rate."""
    for finding in session.findings:
        prove(session, finding)
    tested = [*session.findings, *session.weak]
    sure = discoveries([f.p for f in tested])
    # faults of the log are reported whatever else was tested
    chance = [f for f, yes in zip(session.findings, sure) if not (yes or f.of_log)]
    contradicted = [
        f for f in session.findings if f.verified is False or f in chance or f in _beside(session)
    ]
    if contradicted:
        session = session.without(*contradicted)
        session.weak = [*contradicted, *session.weak]
    return session


def _checkup(session, protocol):
    """Findings of single stretches of a protocol that the whole log does not show."""
    r, found, rests = session.recording, [], []
    session.protocol = protocol
    coarse = {k for f in session.findings if f.step for k in f.channels}
    for touched, rows in stretches(r, protocol):
        # levels are of the session's clock: the whole log tells them, and all rests as one; loads make noise
        some = diagnose_recording(r.part(rows)).findings
        some = [f for f in some if f.trend is None and not (touched and f.kind.is_noise)]
        some = [f for f in some if _everywhere(f, session.counts)]
        if not touched:
            rests.append(rows)
        if not touched and not coarse:  # nothing but noise is there
            faults = [f for f in some if f.of_log]
            some += _sure_of(at_rest(less(as_log(r.part(rows)), faults), faults))
        # at rest a filtered electrode is constant, too: only the whole log shows one that is always constant
        found += [moved(f, rows, r) for f in some if not (f.kind.silent or coarse.issuperset(f.channels))]
    faults = [f for f in (*session.findings, *found) if f.trend is None]
    found += _sure_of(between_rests(as_log(r, session.counts, session.masked), rests, faults))
    free = free_rows(r, protocol, max((f.delay for f in session.findings), default=0.0))
    if (finding := remembered(session, free)) is not None:
        finding.confidence = confidence(finding)
        found.append(finding)
    elif rests and enough(free.sum(), r.design):  # all rests are one log of an unloaded sensor
        rows = np.flatnonzero(free)
        cut = dict.fromkeys(("force", "tdc", "missing", "since"), None)
        counts = session.without(*(f for f in session.findings if f.trend is not None)).counts[rows]
        still = dataclasses.replace(r, electrodes=counts, joints=(), **cut)
        found += [moved(f, rows, r) for f in diagnose_recording(still).findings if f.kind.drifts]
    sure = discoveries([f.p for f in (*session.findings, *found)])[len(session.findings) :]
    for finding, yes in zip(found, sure):
        if not (yes and finding.possible) or finding.confidence < NAMED or finding.verified is False:
            session.weak.append(finding)
        elif not any(_explains(f, finding) for f in session.findings):
            session.accept(finding)  # the first stretch with it
    session.take_back(*_beside(session))


def _beside(session):
    """Drifts of electrodes of which something else, no noise, changes what they read: one cause is likelier
    than two."""
    single = [f for f in session.findings if not f.of_all]
    others = [f for f in single if not (f.kind.drifts or f.kind.in_noise or f.kind.is_noise)]
    drifting = {k for f in others for k in f.channels}
    return [f for f in single if f.kind.drifts and drifting.intersection(f.channels)]


def _everywhere(finding, counts):
    """Whether a limit that an electrode is said to have is one in all counts (n, c)."""
    if not finding.beyond:
        return True
    beyond = finding.beyond * (counts[:, finding.channels[0]] - finding.parameters["level"][0])
    return (beyond > _LIMIT).mean() < _RARELY


def _sure_of(faults):
    """Candidates of faults that are likely enough."""
    for fault in faults:
        fault.confidence = confidence(fault)
    return as_candidates([f for f in faults if clear(f)])[0]


def _explains(one, other):
    """Whether a finding makes another one of a stretch needless: the same, or a fault of the same electrodes,
    of which one cause is likelier than two."""
    if one.of_all != other.of_all or not set(one.channels) & set(other.channels):
        return False
    return one.id == other.id or not one.of_all or one.of_log and other.of_log


def _late(session):
    """Effects of single electrodes or all that begin in the held-out part: searched in the whole record,
    less what was found; nothing is left to confirm them."""
    if not session.model().parted:
        return []
    r = session.recording
    begin = r.time[~session.fit][0]
    whole = Session(r, np.ones(len(r), bool), session.findings, session.unnamed)
    found, rejected = [], set()
    for _ in range(4):
        finding = levels(whole, rejected)
        if finding is None:
            break
        finding.confidence = confidence(finding)
        rejected.add((None,) if finding.of_all else finding.channels)
        sudden = finding.trend.kind != "smooth" and finding.trend.onset > _LAST * begin
        if sudden and finding.confidence >= _LATE:
            finding.verified, finding.start = None, float(finding.trend.onset)
            finding.message += "; it begins so late that nothing is left to confirm it"
            found.append(finding)
            whole.accept(finding)
    return found
