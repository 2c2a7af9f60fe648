"""Loss of liquid and rough walls as changes of the skin and the film: less liquid under the skin, a sunk
skin, another law of the film's conductance."""

import functools
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..sensor.film import FilmConduction
from ..skin import SkinData, SkinModel

_MOST = 0.8  # largest lost fraction of the liquid, as in `sensing.FluidLoss`
_DRAINED_PER_STEP = 0.02  # fraction of the liquid lost in one step of the skin
_THINNEST = 0.3  # fraction of the film at rest that remains under a sunk skin
_LONG = 1e6  # [s] relaxation of the rubber while the liquid drains


class RoughFilm(FilmConduction):
    """A film whose conductance is a power of its thickness: sigma h0 (h / h0)^power with h0 at rest, so that
    impedances at rest are unchanged.

    Args:
      film: FilmConduction; power: 1 is a smooth film.
    """

    def __init__(self, film: FilmConduction, power: float):
        self.__dict__.update(film.__dict__)
        self._power = power
        self._set_single()


class SunkFilm(FilmConduction):
    """A film whose skin is closer to the core than solved, by the same depth everywhere.

    Args:
      film: FilmConduction; depth: [m], where the film at rest is thick enough.
    """

    def __init__(self, film: FilmConduction, depth: float):
        self.__dict__.update(film.__dict__)
        at = film.geometry.vert[film.node]
        to_core = film.core.closest(at)[1] - at
        gap = np.linalg.norm(to_core, axis=1, keepdims=True)
        self._sunk = to_core / np.maximum(gap, 1e-9) * np.minimum(depth, (1 - _THINNEST) * gap)
        self._set_single()

    def impedance(self, vert_xpos: ArrayLike) -> np.ndarray:
        sunk = np.array(vert_xpos, float)
        sunk[..., self.node, :] += self._sunk
        return super().impedance(sunk)


class SeveralFilms:
    """Films under one skin that differ in their least thickness alone: impedances (nfilm, ...) of each.

    Args:
      films: smooth ones, from the thinnest on, by which the others are laid.
    """

    def __init__(self, films: Sequence[FilmConduction]):
        self._films = films
        for one in films[1:]:
            one._solve_single[0] = functools.partial(_lay_as, films[0]._single, one)

    def impedance(self, vert_xpos: ArrayLike) -> np.ndarray:
        return np.stack([one.impedance(vert_xpos) for one in self._films])


def _lay_as(laid, film):
    """Lays a film as a thinner one is laid."""
    film._single.middle.assign(laid.middle)
    np.maximum(laid.thickness.numpy(), film.residual_film, out=film._single.thickness.numpy())


def remaining_liquid(rate: float, clock: float, before: float = 0.0) -> float:
    """Remaining fraction of the liquid at the session's clock [s], for a loss of `rate` per hour after the
    fraction `before` was lost."""
    return 1 - min(before + rate * clock / 3600, _MOST)


def drain(model: SkinModel, data: SkinData, fraction: float) -> None:
    """Brings an untouched skin to equilibrium with a fraction of its liquid."""
    from ..skin import GeomSet, step

    nothing = GeomSet([], [], device=model.device)
    for part in np.linspace(1, fraction, int(np.ceil((1 - fraction) / _DRAINED_PER_STEP)) + 1)[1:]:
        data.set_liquid(fill_volume=(part - 1) * model.liquid_volume)
        step(model, data, nothing, _LONG)
