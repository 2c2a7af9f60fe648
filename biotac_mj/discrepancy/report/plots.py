"""Figures of reports, made from arrays."""

import dataclasses
import typing
from collections.abc import Sequence

import numpy as np

if typing.TYPE_CHECKING:
    from .verdict import Gap

_UNAMENDED, _AMENDED = "0.6", "tab:blue"


@dataclasses.dataclass(frozen=True)
class Panel:
    """One channel over time, n rows.

    Attributes:
      title; unit of the values. time: (n,) [s]. measured: (n,). simulated, amended: (n,) or None.
      aside: from and to [s] of what was held out, or None.
    """

    title: str
    unit: str
    time: np.ndarray
    measured: np.ndarray
    simulated: np.ndarray | None = None
    amended: np.ndarray | None = None
    aside: tuple[float, float] | None = None


@dataclasses.dataclass(frozen=True)
class Table:
    """Values (r, c) about zero, names of rows and columns, (row, column) of those with dots, and what they
    are."""

    values: np.ndarray
    rows: Sequence[str]
    columns: Sequence[str]
    dots: Sequence[tuple[int, int]]
    label: str


def _figure(width, height, rows=1, columns=1):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def curves(panels: Sequence[Sequence[Panel]], simulated: str = "simulated") -> object:
    """Measured, simulated (by this name) and amended over time; panels: rows of as many each."""
    columns = len(panels[0])
    figure, axes = _figure(9, 2.2 * len(panels), len(panels), columns)
    for ax, one in zip(axes.flat, (one for row in panels for one in row)):
        dots = len(one.time) < 200
        style = {"color": "k", "ls": "", "marker": ".", "ms": 3} if dots else {"color": "0.6", "lw": 2.6}
        ax.plot(one.time, one.measured, label="measured", **style)
        for values, color, label in (
            (one.simulated, _UNAMENDED if dots else "tab:orange", simulated),
            (one.amended, _AMENDED, "amended"),
        ):
            if values is not None:
                ax.plot(one.time, values, color=color, lw=1.0, label=label)
        if one.aside is not None:
            ax.axvspan(*one.aside, color="0.92", zorder=0)
        ax.set_title(one.title, fontsize=8)
        ax.set_ylabel(one.unit, fontsize=8)
        ax.set_xlabel("time [s]" + ("; grey: held out" if one.aside else ""), fontsize=8)
        ax.label_outer()
        ax.tick_params(labelsize=7, labelleft=True)  # every panel has a scale of its own
    axes[0, 0].legend(fontsize=7, ncols=3 if columns == 1 else 1)
    return figure


def channels(gaps: Sequence["Gap"]) -> object:
    """RMS of every channel without and with what was found, beside the noise."""
    figure, axes = _figure(9, 2.6 * len(gaps), len(gaps))
    for ax, one in zip(axes[:, 0], gaps):
        x = np.arange(len(one.channels))
        ax.bar(x - 0.2, one.channels_before, 0.4, label="simulated", color=_UNAMENDED)
        ax.bar(x + 0.2, one.channels_after, 0.4, label="amended", color=_AMENDED)
        for k in np.flatnonzero(np.isnan(one.channels_before)):
            ax.text(k, 0, " no measurement", fontsize=7, rotation=90, ha="center", va="bottom")
        if np.isfinite(one.noise):
            ax.axhline(one.noise, color="k", lw=0.7, ls=":", label="noise and resolution")
        ax.set_xticks(x, one.channels, fontsize=7)
        ax.set_ylabel(f"RMS [{one.unit}]", fontsize=8)
        ax.set_title(f"{one.name}, held out", fontsize=9)
        ax.legend(fontsize=7)
    return figure


def matrix(table: Table) -> object:
    """A table in colours."""
    figure, axes = _figure(9, 0.8 + 0.28 * len(table.rows))
    ax, limit = axes[0, 0], max(np.nanmax(np.abs(table.values), initial=1.0), 1.0)
    image = ax.imshow(table.values, cmap="RdBu", vmin=-limit, vmax=limit, aspect="auto")
    for row, column in table.dots:
        ax.plot(column, row, "k.", ms=4)
    ax.set_xticks(np.arange(len(table.columns)), table.columns, fontsize=7)
    ax.set_yticks(np.arange(len(table.rows)), table.rows, fontsize=7)
    figure.colorbar(image, label=table.label)
    return figure
