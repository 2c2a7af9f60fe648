"""The sensor of a recording as a file that a simulation can run: what it has of its own, what was found."""

import numpy as np

from ...effects.catalogue import by_id
from ...effects.sensor_file import SensorFile
from ...effects.sensors import RUNNING
from ...recordings.own import rest_of
from .search import RecordingDiagnosis

__all__ = ["amended_sensor"]

_MATERIAL = "calibrated"  # the rubber that real sensors were matched with


def amended_sensor(diagnosis: RecordingDiagnosis) -> tuple[SensorFile, list[str]]:
    """The recording's sensor and the named effects that a sensor can run with; and ids of those that it
    cannot: of the logger, of the force beside it, or of the moment.

    Rest, noise and warm-up are measured over the whole recording; the warm-up acts only where it was named.
    """
    session = diagnosis.session
    r, findings = session.recording, {f.id: f for f in diagnosis.findings}
    own = rest_of(session.filled(), r.rate, r.force)
    rest, mixing = own["rest"].copy(), np.eye(19)
    sensor = {"like": "1", "rest": rest, "noise": rest_of(r.electrodes, r.rate, r.force)["noise"]}
    effects, left = [], []
    for finding in diagnosis.findings:
        if finding.id == "warmup":
            measured = rest_of(r.electrodes, r.rate, r.force)
            sensor |= {"warm_up": measured["warm_up"], "warm_time": measured["warm_time"]}
            if "share" in finding.clues:
                sensor["warm_share"] = finding.clues["share"]
        elif finding.id in ("stuck", "gain"):
            for k in finding.channels:
                value = finding.parameters.get("value", finding.parameters.get(f"e{k + 1}", (0.0,)))[0]
                mixing[k, k] = 0.0 if finding.id == "stuck" else 1 + value
                if finding.id == "stuck":
                    rest[k] = np.clip(value, 1.0, 4094.0)
        else:
            theta = _theta(finding)
            if theta is None:
                left.append(finding.id)
            else:
                effects.append((by_id(finding.id), theta))
    if "warmup" in findings:
        rest[:] = np.where(np.diag(mixing) == 0, rest, measured["rest"])
    if (mixing != np.eye(19)).any():
        sensor["mixing"] = mixing
    plain = {k: np.asarray(v).tolist() if isinstance(v, np.ndarray) else v for k, v in sensor.items()}
    base = {"skin": "default", "tier": "full", "material": _MATERIAL, "sensor": plain}
    return SensorFile(base, effects, {}), left


def _theta(finding):
    """Parameters of the catalogue's effect, None where a sensor cannot run with it."""
    if finding.id not in RUNNING:
        return None
    effect = by_id(finding.id)
    if not set(effect.params) <= set(finding.parameters):
        return None
    return {n: float(np.clip(finding.parameters[n][0], p.low, p.high)) for n, p in effect.params.items()}
