"""Figures of reports, made from arrays."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ...sensor.colors import line_color
from .verdict import Gap

_UNAMENDED, _AMENDED = "0.6", "tab:blue"
_ASIDE = "0.92"  # grey behind held-out rows


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


def _figure(width, height, rows=1, columns=1):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def curves(panels: Sequence[Panel], columns: int = 1, simulated: str = "simulated") -> object:
    """Measured, simulated (by this name) and amended over time; panels fill row after row."""
    rows = max(1, -(-len(panels) // columns))
    figure, axes = _figure(9, (2.4 if columns == 1 else 2.0) * rows, rows, columns)
    for ax, one in zip(axes.flat, panels):
        dots = len(one.time) < 200
        style = {"color": "k", "ls": "", "marker": ".", "ms": 3} if dots else {"color": "0.6", "lw": 2.6}
        ax.plot(one.time, one.measured, label="measured", **style)
        for values, color, label in (
            (one.simulated, _UNAMENDED if dots else "tab:orange", simulated),
            (one.amended, _AMENDED, "amended"),
        ):
            if values is not None:
                ax.plot(one.time, values, color=color, lw=1.2 if dots else 0.9, label=label)
        if one.aside is not None:
            ax.axvspan(*one.aside, color=_ASIDE, zorder=0)
        ax.set_title(one.title, fontsize=9 if columns == 1 else 8)
        ax.tick_params(labelsize=8 if columns == 1 else 7)
    for row, first in zip(axes, panels[::columns]):
        row[0].set_ylabel(first.unit, fontsize=8)
    axes[0, 0].legend(fontsize=7, ncols=3 if columns == 1 else 1)
    for ax in axes[-1]:
        shaded = any(one.aside is not None for one in panels)
        ax.set_xlabel("time [s]" + ("; grey: held out" if shaded else ""), fontsize=8)
    return figure


def channels(gaps: Sequence[Gap]) -> object:
    """RMS of every channel without and with what was found, beside the noise."""
    figure, axes = _figure(9, 2.6 * len(gaps), len(gaps))
    for ax, one in zip(axes[:, 0], gaps):
        x = np.arange(len(one.channels))
        ax.bar(x - 0.2, one.channels_before, 0.4, label="simulated", color=_UNAMENDED)
        ax.bar(x + 0.2, one.channels_after, 0.4, label="amended", color=_AMENDED)
        if np.isfinite(one.noise):
            ax.axhline(one.noise, color="k", lw=0.7, ls=":", label="noise and resolution")
        ax.set_xticks(x, one.channels, fontsize=7)
        ax.set_ylabel(f"RMS [{one.unit}]", fontsize=8)
        ax.set_title(f"{one.name}, held out", fontsize=9)
        ax.legend(fontsize=7)
    return figure


def overview(
    time: np.ndarray, views: dict[str, np.ndarray], force: np.ndarray | None, aside: tuple[float, float]
) -> object:
    """All electrodes over time, and the force.

    Args:
      time: (n,) [s]. views: title -> (n, nelectrode) counts. force: (n, 3) [N] or None. aside: see `Panel`.
    """
    width = max(1, len(time) // 1500)
    m = len(time) // width

    def binned(x):
        return x[: m * width].reshape(m, width, -1).mean(1)

    t, rows = binned(time)[:, 0], len(views) + (force is not None)
    figure, axes = _figure(9, 2.3 * rows, rows)
    axes = axes[:, 0]
    for ax, (title, counts) in zip(axes, views.items()):
        x = binned(counts)
        for k, line in enumerate((x - np.median(x[: max(3, m // 50)], axis=0)).T):
            ax.plot(t, line, lw=0.6, color=line_color(k, x.shape[1]), label=f"e{k + 1}")
        ax.set_title(f"e1..e{x.shape[1]} {title}, change since the first rows", fontsize=9)
        ax.set_ylabel("change [counts]", fontsize=8)
    axes[0].margins(y=0.25)  # room for 19 names
    axes[0].legend(ncols=10, fontsize=6, loc="upper left", handlelength=1, framealpha=0.6)
    if force is not None:
        axes[-1].plot(t, binned(force), lw=0.6, label=["Fx", "Fy", "Fz"])
        axes[-1].set_ylabel("force [N]", fontsize=8)
        axes[-1].legend(fontsize=7, ncols=3)
    for ax in axes:
        ax.axvspan(*aside, color=_ASIDE, zorder=0)
    axes[-1].set_xlabel("time [s]; grey: held out", fontsize=8)
    return figure


def matrix(
    table: np.ndarray, rows: Sequence[str], names: Sequence[str], dots: Sequence[tuple[int, int]], label: str
) -> object:
    """A table (r, c) about zero in colours, with dots at (row, column)."""
    figure, axes = _figure(9, 0.8 + 0.28 * len(rows))
    ax, limit = axes[0, 0], max(np.nanmax(np.abs(table), initial=1.0), 1.0)
    image = ax.imshow(table, cmap="RdBu", vmin=-limit, vmax=limit, aspect="auto")
    for row, column in dots:
        ax.plot(column, row, "k.", ms=4)
    ax.set_xticks(np.arange(len(names)), names, fontsize=7)
    ax.set_yticks(np.arange(len(rows)), rows, fontsize=7)
    figure.colorbar(image, label=label)
    return figure
