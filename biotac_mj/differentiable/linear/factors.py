"""The sparse factor by which linear solves on the CPU are preconditioned."""

import numpy as np

from ...skin.model import SkinModel

__all__ = ["Factors"]

# products too many after which a factor, which costs 75 and saves two to four a step, is made
_FACTOR = 150
_FEW = 16


class Factors:
    """The factor of a skin's stiffness, made anew in the present shape where solves take too long: the steps
    of a press have much the same shape.

    Attributes:
      now: a `skin.precondition.sparse.SparseFactor`. dof: free coordinates, in the order of its rows.
    """

    def __init__(self, model: SkinModel):
        self._model = model
        self.dof = (3 * model.free[:, None] + np.arange(3)).ravel()
        self.begin()

    def begin(self) -> None:
        """Begins with the factor at rest: a gradient does not depend on those before."""
        self.now, self._products = self._model.factor, 0

    def count(self, products: int, x: np.ndarray) -> None:
        """After solves that took so many products with the tangent at x (nvert, 3) [m]."""
        self._products += max(products - _FEW, 0)
        if self._products > _FACTOR:
            self.now, self._products = self._model.factor_at(x), 0
