"""The sensor of a recording as a file that a simulation can run: what it has of its own, what was found."""

import numpy as np

from ...effects.catalogue import by_id
from ...effects.sensor_file import SensorFile
from ...geometry.skins import shipped_skin
from ...recordings.own import rest_of
from ...recordings.recording import designed
from ...sensor.channels import FULL_SCALE
from .session import Session

_MATERIAL = "calibrated"  # the rubber that real sensors were matched with


def amended_sensor(session: Session) -> SensorFile:
    """The sensor of a session's recording with the effects found that a sensor can run with.

    Rest, noise and the trend that drifts have in common are measured over the whole recording; the trend
    acts only where a warm-up, a loss of liquid or a drift was named.
    """
    r = session.recording
    without, recorded = (rest_of(counts, r.rate, r.force) for counts in (session.filled(), r.electrodes))
    drifts = any(f.kind.drifts and f.written for f in session.findings)
    own = recorded if drifts else without
    # what was named is no noise; and no electrode rests where it has never been
    seen = r.electrodes.min(0), r.electrodes.max(0)
    rest, mixing = np.clip(own["rest"], *seen), np.eye(r.electrodes.shape[1])
    disturbed = any(f.kind.in_noise for f in session.findings)
    noise = np.minimum(recorded["noise"], without["noise"]) if disturbed else recorded["noise"]
    for finding in session.findings:
        if finding.kind.silent:
            for k in finding.channels:
                mixing[k, k], rest[k] = 0.0, np.clip(finding.parameters["value"][0], 1.0, FULL_SCALE - 1.0)
    design = designed(r.electrodes)
    sensor = {"like": design.sensor, "rest": rest, "noise": noise}
    if not r.absolute:  # the rest is the one that was assumed
        del sensor["rest"]
    if drifts:  # whatever its cause: by its trend, and each electrode's fraction of it
        sensor |= {name: own[name] for name in ("warm_up", "warm_time", "warm_share")}
    if (mixing != np.eye(len(mixing))).any():
        sensor["mixing"] = mixing
    plain = {k: np.asarray(v).tolist() if isinstance(v, np.ndarray) else v for k, v in sensor.items()}
    base = {"skin": shipped_skin(design), "tier": "full", "material": _MATERIAL, "sensor": plain}
    return SensorFile(base, running(session)[0], {})


def running(session: Session) -> tuple[list, list[str]]:
    """[(Effect, theta)] of the effects found that act in a running sensor, without its baseline, trend and
    noise; and ids of the others: faults of the logger or of the force sensor, single events, and what
    held-out rows are further off with."""
    design, effects, left = designed(session.recording.electrodes), [], []
    for finding in session.findings:
        if finding.written and (finding.kind.drifts or finding.kind.silent or finding.kind.is_noise):
            continue
        theta = _theta(finding) if finding.written else None
        if theta is None:
            left.append(finding.id)
        else:
            effects.append((by_id(finding.id).on(design), theta))
    return effects, left


def _theta(finding):
    """Parameters of the catalogue's effect, None where a sensor cannot run with it."""
    kind = finding.kind
    if not kind.runs or kind.alike and not finding.of_all:
        return None
    if any(finding.parameters[name][0] > most for name, most in kind.most.items()):
        return None
    effect = by_id(finding.id)
    if not set(effect.params) <= set(finding.parameters):
        return None
    return {n: float(np.clip(finding.parameters[n][0], p.low, p.high)) for n, p in effect.params.items()}
