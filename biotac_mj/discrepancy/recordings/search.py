"""Diagnosis of plain recordings: what the sensor's model misses, found on the first part, checked on the part
kept aside.

The model is amended step by step: faults of samples, then noise, then what develops over time, then what lies
between force and electrodes; each round takes the effect with the most evidence, takes it out of the
recording and looks again.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import tqdm

from .effects.drifts import CountGain, CountOffset, SharedGain, Thermal, TimeShaped
from .effects.effect import RecordedEffect
from .effects.electrode_drifts import Drift, GainChange
from .effects.faults import Freeze, Quantise, Saturate, Spikes, Stuck, Swap
from .effects.hum import Hum
from .effects.noises import CommonNoise, CrossTalk, LowPass, Noise
from .gap import gap, statistics
from .load_search import BETWEEN, find_between
from .recording import Recording
from .rest import cells, remainder
from .session import Session

__all__ = ["EFFECTS", "RecordingDiagnosis", "diagnose_recording"]

EFFECTS = [
    Quantise(),
    Freeze(),
    Stuck(),
    Saturate(),
    Spikes(),
    Swap(),
    Hum(),
    LowPass(),
    CrossTalk(),
    CommonNoise(),
    Noise(),
    SharedGain(),
    CountOffset(),
    CountGain(),
    Thermal(),
    Drift(),
    GainChange(),
    *BETWEEN,
]
_COMMON = {"warmup", "count_offset", "count_gain", "thermal"}
_FAULTS, _NOISE = EFFECTS[:5], EFFECTS[6:11]
_MOVING = [EFFECTS[5], *EFFECTS[11:17]]
_MOST = 8
# confidence: of 42, 17 and 3 names 42, 16 and 1 right
_CONFIRMED, _AGAINST_OTHERS, _UNCHECKED = (43 / 44, 17 / 19, 2 / 5)


@dataclasses.dataclass
class RecordingDiagnosis:
    """What was found.

    Attributes:
      recording; locked: share kept aside at the end; verdict: one line; findings: accepted, the strongest
      first; rejected: those that the part kept aside does not confirm; where: list of cells (channel, from,
      to, z, p); gap: dict of views with before and after;
      remainder: dict that describes what is left; notes: what the data cannot tell; session: counts without
        the effects;
      events: (electrode, second) -> counts by which it left the others for a few seconds.
    """

    recording: Recording
    locked: float
    verdict: str
    findings: list
    rejected: list
    where: list
    gap: dict
    remainder: dict
    notes: list
    session: Session
    events: dict = dataclasses.field(default_factory=dict)


def diagnose_recording(
    recording: Recording,
    locked: float | None = None,
    effects: Sequence[RecordedEffect] = (),
    progress: bool = False,
) -> RecordingDiagnosis:
    """Finds what the model misses in one recording.

    Args:
      recording: Recording.
      locked: share of the rows at the end that takes no part; None: 0.4 without force, 0.3 with force.
      effects: further RecordedEffect objects, tried with those that develop over time.
      progress: whether to show a bar.

    Raises:
      ValueError: a share that leaves too little on one side.
    """
    locked = (0.4 if recording.force is None else 0.3) if locked is None else locked
    n = len(recording)
    if not 0.1 <= locked <= 0.6:
        raise ValueError(f"locked is {locked}: keep between 0.1 and 0.6 of the rows aside")
    fit = np.arange(n) < round(n * (1 - locked))
    with tqdm.tqdm(total=6, desc="diagnose", disable=not progress, leave=False) as bar:
        session = Session(recording, fit)
        _search(session, effects, bar)
        late = _late(session, effects)
        bar.update()
        rejected = statistics(session)
        result = RecordingDiagnosis(
            recording, locked, "", session.findings, rejected, [], {}, {}, [], session, session.events
        )
        _settle(result, late)
        result.where = cells(session)
        result.gap = gap(result.session, [f for f in result.session.findings if f not in late], late)
        result.remainder = remainder(session)
        result.notes = _notes(result)
        result.verdict = _verdict(result)
        bar.update()
    return result


def _search(session, effects, bar):
    for effect in _FAULTS:
        for finding in effect.find(session):
            session.accept(finding)
    bar.update()
    swap = _MOVING[0].find(session)
    for finding in swap:
        session.accept(finding)
    for effect in _NOISE:
        for _ in range(3):
            found = effect.find(session)
            for finding in found:
                session.accept(finding)
            if not found or not isinstance(effect, Hum):
                break
    bar.update()
    for _ in range(_MOST):
        candidates = [f for effect in (*_MOVING[1:], *effects) for f in effect.find(session)]
        chosen = _choose(session, candidates)
        if chosen is None:
            break
        alike = [
            f
            for f in session.findings
            if f.theta.get("kind") in ("step", "pulse") and f.channels == chosen.channels
        ]
        if len(alike) >= 2 and chosen.theta.get("kind") in ("step", "pulse"):
            # One jump is an event, jumps again and again are a behaviour that no effect here describes.
            session.give_up(
                alike,
                f"the level {'of all electrodes' if len(chosen.channels) > 12 else 'of one electrode'} goes "
                "up and down again and again",
            )
            break
        session.accept(chosen)
    bar.update()
    filters = [f.theta["tau"] for f in session.findings if f.id == "lowpass" and len(f.channels) > 12]
    for finding in find_between(session):
        # A low-pass that coloured the noise was named already, and it delays by its own time constant.
        known = filters and (
            finding.id == "lowpass" or finding.id == "latency" and 0 < finding.theta["delay"] < 2 * filters[0]
        )
        if not known:
            session.accept(finding)
    bar.update()


def _choose(session, candidates):
    """The strongest; common patterns are told apart by how well they fit, and tied where they fit alike."""
    if session.timeline().loaded and not any(f.id == "warmup" for f in candidates):
        # under load they are no more than ties of a shared gain
        candidates = [f for f in candidates if not f.id.startswith("count_")]
    if not candidates:
        return None
    best = max(candidates, key=lambda f: f.nats)
    common = [f for f in candidates if f.id in _COMMON]
    if common and not session.timeline().loaded:
        best = max(common, key=lambda f: f.nats)  # its pattern was checked electrode by electrode
    # A change of one electrode leaks into the common pattern and the other way round; the matched one has
    # more energy.
    if session.timeline().loaded and common and best.id in ("drift", "gain"):
        rival = max(common, key=lambda f: f.nats)
        if best.id == "gain" or _energy(session, rival) > _energy(session, best):
            best = rival if rival.nats > 0.4 * best.nats else best
    if best.id in _COMMON:
        single = [f for f in candidates if f.id == "drift" and f.nats > 0.7 * best.nats]
        if session.timeline().loaded and single and _energy(session, single[0]) > _energy(session, best):
            return single[0]
        patterns = [f for f in common if "misfit" in f.theta]
        thermal = [f for f in common if f.id == "thermal"]
        if patterns:
            order = sorted(patterns, key=lambda f: f.theta["misfit"])
            loaded = session.timeline().loaded
            # loaded, nearly parallel patterns are told apart by nothing but the load's remains
            slack = 12.0 if not loaded else 40.0
            best = order[0]
            near = [f for f in order if f.theta["misfit"] - order[0].theta["misfit"] < slack]
            preferred = [f for f in (patterns if loaded else near) if f.id == "warmup"]
            best = preferred[0] if preferred else best
            best.ties = tuple(f.id for f in near if f is not best)
        if thermal:
            if not patterns or thermal[0].nats > best.nats + 3:
                best = thermal[0]
            elif thermal[0].nats > best.nats - 3:
                best.ties = (*best.ties, "thermal")
    return best


def _energy(session, finding):
    line = session.timeline()
    pattern = finding.theta["pattern"][line.used]
    series, sd = line.amplitude(pattern)
    shape = finding.theta.get("shape")
    share = shape.explained if shape is not None else 1.0
    return float(((series - series.mean()) ** 2).sum() * share / sd**2)


def _late(session, effects):
    """Effects that begin in the part kept aside: searched in the whole record, less what was found."""
    whole = Session(session.recording, np.ones(len(session.recording), bool))
    whole.counts, whole.masked, whole.force = session.counts.copy(), session.masked.copy(), session.force
    begin = session.recording.time[~session.fit][0]
    late = []
    whole.findings = list(session.findings)
    for effect in _FAULTS:
        for finding in effect.find(whole):
            known = [
                f for f in session.findings if f.id == finding.id and set(f.channels) & set(finding.channels)
            ]
            if known:  # the same fault goes on: its samples are masked, it is no second finding
                whole.accept(finding)
                session.masked |= whole.masked
                for f in known:
                    if "mask" in f.theta:
                        f.theta["mask"] = finding.theta["mask"]
                    f.end = max(f.end, finding.end)
            elif finding.start >= begin - 1 or finding.id in ("spikes",):
                whole.accept(finding)
                late.append(finding)
    for _ in range(4):
        candidates = [f for effect in (*_MOVING, *_NOISE[:1], *effects) for f in effect.find(whole)]
        known = {(f.id, f.channels) for f in session.findings}
        # an extrapolation that is a little off is no new effect
        candidates = [f for f in candidates if (f.id, f.channels) not in known]
        if session.unnamed:
            candidates = [f for f in candidates if f.theta.get("kind") not in ("step", "pulse")]
        if any(f.id in _COMMON for f in session.findings):
            candidates = [f for f in candidates if f.id not in _COMMON or f.nats > 40]
        if whole.timeline().loaded:  # nothing is left to confirm them, so they must be plain
            candidates = [f for f in candidates if f.id not in ("gain", "drift", *_COMMON) or f.nats > 80]
        candidates = [f for f in candidates if f.start >= begin - 0.02 * session.recording.time[-1]]
        chosen = _choose(whole, [f for f in candidates if f.id != "hum"]) or next(
            (f for f in candidates if f.id == "hum"), None
        )
        if chosen is None:
            break
        whole.accept(chosen)
        late.append(chosen)
    for finding in late:
        finding.verified = None
        finding.note += "; begins in the part kept aside, so nothing is left to confirm it"
    session.late = late
    return late


def _settle(result, late):
    session = result.session
    result.rejected = [f for f in session.findings if f.verified is False]
    keep = [f for f in session.findings if f.verified is not False] + late
    session.findings = keep
    replay = Session(session.recording, session.fit)
    replay.masked = session.masked
    for finding in [*keep]:
        replay._take_out(finding)
    replay.findings = keep
    replay.unnamed = session.unnamed
    result.session = replay
    result.findings = sorted(keep, key=lambda f: -f.nats)
    for finding in result.findings:
        finding.confidence = _confidence(finding, session.timeline().loaded)


def _confidence(finding, loaded):
    """How often such a name, or one of its ties, was right on the benchmark's practice recordings (Laplace's
    rule).

    Under load what one electrode does against the others is told less surely; what no row kept aside could
    confirm least."""
    moving = isinstance(finding.effect, (TimeShaped, GainChange))
    if finding.verified is None and moving:
        return _UNCHECKED
    return _AGAINST_OTHERS if loaded and finding.id in ("drift", "gain", "crosstalk") else _CONFIRMED


def _notes(result):
    """What the recording cannot tell."""
    r, session = result.recording, result.session
    line = session.timeline()
    notes = [f"rate {r.rate:.1f} Hz ({r.rate_source})"]
    for (k, second), counts in sorted(result.events.items(), key=lambda item: -item[1])[:3]:
        notes.append(
            f"e{k + 1} leaves the others at {second} s by {counts:.0f} counts and comes back: a place "
            "pressed only then or a loose contact; press it again there"
        )
    if r.force is None:
        notes.append(
            "no force: latency, relaxation and hysteresis against the load cannot be known; "
            "give --force to see them"
        )
    elif result.session.force_view() is None:
        notes.append(
            "the electrodes do not predict the force (or it does not change): "
            "nothing between force and electrodes can be known"
        )
    if r.tdc is None:
        notes.append(
            "no TDC: a change with temperature cannot be told from one with time; "
            "give --tdc, or switch the heater off and on"
        )
    if line.loaded:
        notes.append(
            "the sensor is loaded: a gain, cross-talk or channel order that is wrong during the whole "
            "record cannot be told from its calibration"
        )
        if r.force is not None and not (np.linalg.norm(r.force, axis=1) < 0.1).any():
            notes.append(
                "no free segment: the rest values cannot be checked; leave the sensor untouched at both ends"
            )
    else:
        notes.append(
            "the sensor is not loaded: gains, saturation and cross-talk of signals cannot be known; press it"
        )
    if r.rest_correlation < 0.5:
        notes.append(
            f"the pattern of the electrodes correlates {r.rest_correlation:.2f} with that of published "
            "sensors (0.9 among them): check the channels' order"
        )
    return notes


def _verdict(result):
    if not result.findings and not result.remainder.get("significant"):
        return "no significant disagreement"
    parts = []
    for f in result.findings:
        names = {e.id: e.name for e in EFFECTS}
        tie = f" (or {', '.join(names.get(t, t) for t in f.ties)}: not distinguished)" if f.ties else ""
        where = "" if len(f.channels) >= 12 else " of " + ", ".join(f"e{k + 1}" for k in f.channels)
        parts.append(f"{f.effect.name}{where}{tie}")
    text = "; ".join(parts)
    if result.remainder.get("significant"):
        text = f"partly: {text}; remainder unknown" if parts else "unknown"
        text += f" ({result.remainder['text']})"
        return text
    return ("named: " if len(parts) == 1 else "several: ") + text
