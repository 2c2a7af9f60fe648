"""Figures of the report of data with poses."""

import numpy as np

from ..report import plots
from ..report.verdict import Picture, Verdict
from .where import residual_cells

_SHOWN = 4  # trajectories, of each of two channels


def pictures_of(diagnosis: Verdict) -> list[Picture]:
    """Curves and channels on held-out trajectories, and where the model is off."""
    return [
        Picture("curves", "curves", _curves(diagnosis)),
        Picture("channels", "gap", plots.channels(list(diagnosis.gap.values()))),
        Picture("where", "where", _where(diagnosis)),
    ]


def _curves(diagnosis):
    """Panels of the two channels with the largest error, in some of the held-out trajectories."""
    c, panels, proof = diagnosis.comparison, [], diagnosis.proof
    names = c.channels
    for channel in np.argsort(-np.array(proof.before["channels"]) / c.sigma)[:2]:
        for k, i in enumerate(diagnosis.locked[:_SHOWN]):
            measured = c.measured[i][:, channel]
            panels.append(
                plots.Panel(
                    f"{names[channel]}, {c.trajectories[i].id}",
                    "N" if names[channel].startswith("F") else "counts",
                    c.trajectories[i].time,
                    measured,
                    *(measured - part[k][:, channel] for part in proof.residuals),
                )
            )
    return plots.curves(panels, columns=min(_SHOWN, len(diagnosis.locked)))


def _where(diagnosis):
    """Mean residual of the model without effects, in noise and resolution, or its trend over trajectories."""
    c = diagnosis.comparison
    columns = {name: slice(k, k + 1) for k, name in enumerate(c.channels)}
    cells = residual_cells(c, diagnosis.null, diagnosis.selection, columns)
    asked, column = list(cells.conditions), {"force": "Fy"}
    dots = [
        (asked.index(one["condition"]), c.channels.index(column.get(one["channel"], one["channel"])))
        for one in diagnosis.where
    ]
    return plots.matrix(cells.overall, asked, c.channels, dots, "mean residual, or trend [sigma]")
