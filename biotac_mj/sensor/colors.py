"""Colours of electrodes, the same in all pictures: of a change by its size, of a line by its number."""

import typing

import numpy as np

if typing.TYPE_CHECKING:
    from matplotlib.colors import Colormap

FULL_CHANGE = 300.0  # change of an electrode at full colour [counts]
_NEUTRAL, _LESS, _MORE = np.array([0.85, 0.85, 0.85]), np.array([0.8, 0.15, 0.1]), np.array([0.1, 0.3, 0.85])


def electrode_colors(change: np.ndarray) -> np.ndarray:
    """(n, 4) RGBA for (n,) changes in counts: red if the film gets thinner (counts fall), blue if it gets
    thicker, grey at rest."""
    amount = np.clip(np.abs(change) / FULL_CHANGE, 0.0, 1.0)[:, None]
    end = np.where(np.asarray(change)[:, None] < 0, _LESS, _MORE)
    return np.concatenate([_NEUTRAL + amount * (end - _NEUTRAL), np.ones_like(amount)], axis=1)


def change_map() -> "Colormap":
    """Colormap of `electrode_colors` for matplotlib, from the most negative change to the most positive."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("electrodes", [_LESS, _NEUTRAL, _MORE])


def line_color(electrode: int, n: int) -> tuple:
    """RGBA of the line of electrode 0..n - 1: n different colours, similar for neighbours."""
    from matplotlib import colormaps

    return colormaps["turbo"](electrode / (n - 1))
