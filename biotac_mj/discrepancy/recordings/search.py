"""Diagnosis of plain recordings: what the sensor's model misses, found on the first part, checked on the part
kept aside."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import tqdm

from ...recordings import Recording
from ..evidence import benjamini_hochberg
from .apart import apart
from .confidence import NAMED, confidence, family
from .connected import part_connected
from .families.levels.jumps import jumped
from .families.levels.levels import levels, settle
from .families.memory.beside import lagging
from .families.memory.between import find_between
from .families.memory.loops import looping
from .families.noise.colour import coloured, muted
from .families.noise.correlated import correlated
from .families.noise.dull import dulled
from .families.noise.heard import heard
from .families.noise.lines import humming
from .families.noise.size import noisy
from .families.samples.lost import dropped, lost
from .families.samples.sampling import sampling_faults
from .families.wiring.gains import gains, louder, undecided
from .families.wiring.order import exchanged, slipped
from .families.wiring.wiring import miswired
from .findings import Finding
from .model import LEAST, WINDOW
from .overflow import unwrapped
from .proof import prove, views
from .recording import FORCE_MOVED, PlainRecording, as_plain
from .rest import Rest, rest
from .session import Session
from .tared import untold

__all__ = ["RecordingDiagnosis", "diagnose_recording", "electronics"]

_MOST = 8  # of courses over time
_WIRES = 4  # of faults of the wiring or gains
_FALSE = 0.05  # of the names of a report
_ONE = ("gain", "flip")  # that may come with a drift of the same electrode
_LAST = 0.9  # of the rows fitted, after which what begins is no course in them
_LATE = 0.73  # confidence from which it is named there: nothing is left to confirm it
_FEW = 4  # electrodes that drift or jump each by itself: what more do under load has another cause
_TURNED = {"flip", "hyster"}  # what an electrode that crosses its rest looks like where it has no sign
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
    findings: list[Finding]
    rejected: list[Finding]
    late: list[Finding]
    gap: dict
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
    recording, overflow = unwrapped(recording) if recording.absolute else (recording, None)
    n = len(recording)
    if not 0.1 <= locked <= 0.6:
        raise ValueError(f"locked is {locked}: keep between 0.1 and 0.6 of the rows aside")
    fit = np.arange(n) < round(n * (1 - locked))
    with tqdm.tqdm(total=5, desc="diagnose", disable=not progress or None, leave=False) as bar:
        session, weak = Session(recording, fit), []
        session.unnamed += [overflow] if overflow else []
        many = _search(session, weak, named, bar)
        late = _late(session, named)
        bar.update()
        for finding in session.findings:
            prove(session, finding)
        # of all that was tested here, one in twenty of those named may be false (Benjamini and Hochberg 1995)
        tested = [*session.findings, *weak]
        q = dict(zip(map(id, tested), benjamini_hochberg(np.array([f.p for f in tested]))))
        contradicted = [f for f in session.findings if f.verified is False or q[id(f)] > _FALSE]
        if contradicted:
            session = session.without(*contradicted)
        session.findings.sort(key=lambda f: -f.gap.get("closed", 0.0))
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


def electronics(session: Session, take: Callable[[Finding], bool]) -> None:
    """Offers to `take` what needs no model of the load: faults of samples, and of the noise."""

    def offer(finding):
        return finding is not None and take(finding)

    sampling_faults(session, take)
    part_connected(session)
    offer(humming(session))
    # held rows have a colour, and what is left of a wave is common, by themselves
    if not {f.id for f in session.findings} & {"freeze", "hum"}:
        offer(coloured(session)) or offer(muted(session))
        offer(correlated(session))
        # a filter leaves of noise what electrodes have in common
        if not {f.id for f in session.findings} & {"lowpass", "crosstalk", "common_noise"}:
            offer(heard(session))
    for finding in noisy(session):
        if take(finding):
            _tails(session, finding)
    offer(dulled(session))


def _search(session, weak, named, bar):
    def sure(finding):
        return confidence(finding, _beside(finding, session, weak))

    def take(finding):
        if finding.id in _TURNED and not session.recording.signed:
            return False
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

    electronics(session, take)
    bar.update()
    for find in (looping, lagging):
        finding = find(session)
        if finding is not None and not _filtered(session, finding):
            take(finding)
    bar.update()
    for find in (slipped, exchanged):
        finding = find(session)
        if finding is not None:
            take(finding)
    for find in (gains, levels):
        refused = set()
        for _ in range(_MOST + 4):
            finding = find(session, refused)
            if finding is None:
                break
            mine = (None,) if len(finding.channels) > 12 else finding.channels
            same = [f for f in session.findings if f.channels == finding.channels]
            again = any(find is gains or "edge" in f.clues for f in same)
            if again or _more_of_the_same(session, finding) or not take(finding):
                refused.add(mine)
        if find is gains:
            _amplify(session, take)
            for finding in jumped(session):
                finding.ties = undecided(session, finding.channels[0])
                take(finding)
            _wire(session, take)
        else:
            settle(session)
            for finding in [f for f in session.findings if "share" in f.clues]:
                finding.confidence = sure(finding)  # it may have another name now
                if finding.confidence < named:
                    session.findings.remove(finding)
                    session.replay()
                    weak.append(finding)
    many = _withdraw_many(session, weak)
    for finding in session.findings:  # what an answer to the load and a level that changes have in common
        if finding.id in ("drift", "gain", "flip"):
            rivals = (f.id for f in weak if f.channels == finding.channels and f.p < _P and f.id in _ONE)
            finding.ties = tuple(dict.fromkeys((*finding.ties, *(i for i in rivals if i != finding.id))))
            # what is heard from some time on, or more and more, changes levels and answers, too
            heard_of = [f for f in session.findings if "heard" in f.clues and f.start > 0]
            if any(len(f.channels) < 12 and set(finding.channels) <= set(f.channels) for f in heard_of):
                finding.ties = tuple(dict.fromkeys((*finding.ties, "crosstalk")))
    clock = dropped(session)
    for finding in clock or lost(session):  # an exchange or a jump is none
        take(finding)
    bar.update()
    # where the force is of another time nothing lies between the two
    for finding in () if apart(session) else find_between(session):
        # a low-pass that coloured the noise was named already
        coloured_by = any(f.id == "lowpass" and len(f.channels) > 12 for f in session.findings)
        looped = any("looped" in f.clues for f in session.findings)
        if not (finding.id in ("lowpass", "latency") and coloured_by or finding.id == "hyster" and looped):
            take(finding)
    _judge_together(session, weak, named)
    bar.update()
    return many


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


def _amplify(session, take):
    """Electrodes whose answers and noise change alike, one after another."""
    refused = {f.channels for f in session.findings if f.id in ("gain", "flip", "stuck", "saturate")}
    for _ in range(_WIRES):
        finding = louder(session, refused)
        if finding is None:
            break
        refused.add(finding.channels)
        if take(finding):
            _explained(session, finding)


def _wire(session, take):
    """Wiring that is wrong all the time or for long, one after another."""
    clipped = {k for f in session.findings if f.id == "saturate" for k in f.channels}
    refused = set()
    for _ in range(_WIRES):
        finding = miswired(session, refused)
        if finding is None:
            break
        refused.add((finding.id, finding.channels))
        if finding.id == "gain" and clipped & {*finding.channels}:
            # what takes a level to where it is clipped takes it to another answer, too
            finding.ties = tuple(dict.fromkeys((*finding.ties, "saturate", "drift")))
        if take(finding) and finding.id == "gain":
            _explained(session, finding)


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


def _explained(session, gain):
    """Leaves out noise of an electrode that is louder by its gain."""
    for finding in [f for f in session.findings if f.id == "noise" and f.channels == gain.channels]:
        session.findings.remove(finding)


def _filtered(session, lag):
    """Whether what lags is filtered, as its noise has said already: how it lags is how that is undone."""
    mine = [f for f in session.findings if "dull" in f.clues and set(lag.channels) <= set(f.channels)]
    for finding in mine:
        finding.correct = lag.correct
        if lag.id == finding.id:  # as the others say it
            finding.parameters, finding.clues = lag.parameters, finding.clues | lag.clues
        session.replay()
    return bool(mine)


def _tails(session, noise):
    """Leaves out spikes of an electrode that is noisy: large samples among others are the tails of its noise,
    or the noise is what is left of the spikes."""
    spikes = [f for f in session.findings if f.id == "spikes" and f.channels == noise.channels]
    if spikes:
        noise.ties = ("spikes",)
    for finding in spikes:
        session.findings.remove(finding)
    session.replay()


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
    loads = "gains, saturation, the sign of an electrode"
    out = [f"{recording.rate:.1f} Hz: {recording.rate_source}"]
    if recording.force is None:
        out.append("no force: latency, relaxation and hysteresis between force and electrodes")
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
    if recording.absolute and recording.rest_correlation < 0.3:
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
