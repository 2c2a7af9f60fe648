"""Sparse factor that preconditions linear solves on the CPU."""

import numpy as np

from ...skin.model import SkinModel

# excess products at which a new factor, which costs 75 products and saves two to four per step, is worthwhile
_FACTOR = 150
_FEW = 16


class Factors:
    """Factor of a skin's stiffness, recomputed in the current shape if solves take too long: the steps of a
    press have similar shapes.

    Attributes:
      now: a `skin.precondition.supernodal.SupernodalFactor`. dof: free coordinates, in the order of its rows.
    """

    def __init__(self, model: SkinModel):
        self._model = model
        self.dof = (3 * model.free[:, None] + np.arange(3)).ravel()
        self.begin()

    def begin(self) -> None:
        """Resets to the factor at rest, so that a gradient does not depend on earlier ones."""
        self.now, self._products = self._model.factor, 0

    def count(self, products: int, x: np.ndarray) -> None:
        """Call after solves that took so many products with the tangent at x (nvert, 3) [m]."""
        self._products += max(products - _FEW, 0)
        if self._products > _FACTOR:
            self.now, self._products = self._model.factor_at(x), 0
