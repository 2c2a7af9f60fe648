"""Figures of a plain recording's report."""

import numpy as np

from ...sensor.channels import counts_from_log_impedance
from ..report import plots
from ..report.verdict import Picture, Verdict

_SHOWN = 4  # channels


def pictures_of(diagnosis: Verdict) -> list[Picture]:
    """The channels that change most over time; RMS by channel; the whole recording with and without what was
    found."""
    d, r = diagnosis, diagnosis.recording
    views = {"as measured": r.electrodes, "without the effects found": d.session.filled()}
    curves = plots.curves(_panels(d), simulated="simulated: rest and load, as the others say it")
    overview = plots.overview(r.time, views, r.force, _aside(d))
    return [
        Picture("curves", "curves", curves),
        Picture("channels", "gap", plots.channels(list(d.gap.values()))),
        Picture("overview", "unknown", overview),
    ]


def _aside(d):
    time = d.recording.time
    return time[~d.session.fit][0], time[-1]


def _worst(diagnosis: Verdict) -> list[int]:
    """Electrodes that the effects change most on the held-out part, by number from 0; of an empty verdict
    those with the largest residual."""
    s = diagnosis.session
    change = np.sqrt(((s.recording.electrodes - s.filled())[~s.fit] ** 2).mean(0))
    if not diagnosis.findings:
        return [int(c["channel"][1:]) - 1 for c in diagnosis.rest.cells][:2] or [0]
    return [int(k) for k in np.argsort(-change)[:_SHOWN] if change[k] > 0.2 * change.max()] or [0]


def _panels(d):
    """Panels of the worst channels; "simulated" is baseline and load as predicted from the other
    electrodes."""
    s, r, m = d.session, d.recording, d.session.model()
    said = counts_from_log_impedance(m.value - (m.residual() if m.dimensions else m.value) + m.mean)
    measured, effect = (
        x[: len(m.time) * m.width].reshape(len(m.time), m.width, -1).mean(1)
        for x in (r.electrodes, r.electrodes - s.filled())
    )
    panels = []
    for k in _worst(d):
        simulated = said[:, np.flatnonzero(m.used == k)[0]] if k in m.used else None
        names = dict.fromkeys(
            f.kind.name
            for f in d.findings
            if k in f.channels and (f.correct is not None or f.mask is not None)
        )
        panels.append(
            plots.Panel(
                f"e{k + 1}" + (": " + "; ".join(names) if names else ""),
                "counts",
                m.time,
                measured[:, k],
                simulated,
                None if simulated is None else simulated + effect[:, k],
                _aside(d),
            )
        )
    return panels
