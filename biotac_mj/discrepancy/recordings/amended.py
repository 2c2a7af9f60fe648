"""The sensor of a recording as a file that a simulation can run: what it has of its own, what was found."""

import numpy as np

from ...effects.catalogue import by_id
from ...effects.logged import WarmUpInLog
from ...effects.sensor_file import SensorFile
from ...geometry.skins import shipped_skin
from ...recordings.own import rest_of
from ...recordings.recording import designed
from ...sensor.channels import FULL_SCALE, counts_from_log_impedance, log_impedance
from ...sensor.presets import PER_DEGREE
from .session import Session

_MATERIAL = "calibrated"  # the rubber that real sensors were matched with


def amended_sensor(session: Session) -> SensorFile:
    """The sensor of a session's recording with the effects found that a sensor can run with.

    Rest and noise are measured over the whole recording; a warm-up acts only where a warm-up, a loss of
    liquid or a drift was named, as these say it.
    """
    r = session.recording
    without, recorded = (rest_of(counts, r.rate, r.force) for counts in (session.filled(), r.electrodes))
    rest, warm = _warming(session, without["rest"])
    # what was named is no noise; and no electrode rests where it has never been
    seen = r.electrodes.min(0), r.electrodes.max(0)
    rest, mixing = np.clip(rest, *seen), np.eye(r.electrodes.shape[1])
    disturbed = any(f.kind.in_noise for f in session.findings)
    noise = np.minimum(recorded["noise"], without["noise"]) if disturbed else recorded["noise"]
    for finding in session.findings:
        if finding.kind.silent:
            for k in finding.channels:
                mixing[k, k], rest[k] = 0.0, np.clip(finding.parameters["value"][0], 1.0, FULL_SCALE - 1.0)
    design = designed(r.electrodes)
    sensor = {"like": design.sensor, "rest": rest, "noise": noise} | warm
    if not r.absolute:  # the rest is the one that was assumed
        del sensor["rest"]
    if (mixing != np.eye(len(mixing))).any():
        sensor["mixing"] = mixing
    plain = {k: np.asarray(v).tolist() if isinstance(v, np.ndarray) else v for k, v in sensor.items()}
    base = {"skin": shipped_skin(design), "tier": "full", "material": _MATERIAL, "sensor": plain}
    return SensorFile(base, running(session)[0], {})


def _warming(session, rest):
    """Counts at rest (nelectrode,) before the drifts found, and the sensor's warm-up that does what they do,
    whatever their cause: with the figures of a warm-up where one is named, else those of the largest."""
    drifts = [f for f in session.findings if f.kind.drifts and f.written]
    if not drifts:
        return rest, {}
    rows, time = np.linspace(0, session.fit.sum() - 1, 200).astype(int), session.recording.time
    warm = next((f for f in drifts if isinstance(f.kind, WarmUpInLog)), None)

    def drift_of(found):
        counts = np.tile(rest, (len(time), 1))
        for finding in found:
            counts = finding.correct(counts, time)
        return log_impedance(rest) - log_impedance(counts[rows])

    every, others = drift_of(drifts), drift_of([f for f in drifts if f is not warm])
    largest = every[:, np.ptp(every, axis=0).argmax()]
    said = warm.parameters if warm else WarmUpInLog().of_trend(time[rows], largest, None, None)
    a, tau = said["a"][0] or 1e-9, said["tau"][0]
    rise = 1 - np.exp(-time[rows] / tau)
    size = np.linalg.lstsq(np.column_stack([rise, np.ones(len(rise))]), others, rcond=None)[0][0]
    size += a * warm.fraction if warm else 0.0
    rest = counts_from_log_impedance(log_impedance(rest) + (every - np.outer(rise, size)).mean(0))
    return rest, {"warm_up": float(-a / PER_DEGREE), "warm_time": float(tau), "warm_share": size / a}


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
    beyond = any(finding.parameters[name][0] > most for name, most in kind.most.items())
    if beyond or not set((effect := by_id(finding.id)).params) <= set(finding.parameters):
        return None
    return {n: float(np.clip(finding.parameters[n][0], p.low, p.high)) for n, p in effect.params.items()}
