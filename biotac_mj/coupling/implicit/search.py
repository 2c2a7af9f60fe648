"""Where the next round of a coupled step goes: by Anderson's acceleration, or back where the last round went
too far."""

import numpy as np

from ..instance import LEVER
from .rules import FixedPoint, share_back

__all__ = ["Search"]

_SCALE = np.array([1.0] * 3 + [LEVER] * 3)  # of motions: compares turning with going
_FAR, _FAR_AFTER_BACK = 6.0, 2.0  # of Newton's own way: acceleration goes no further
_SINGULAR = 1e-10


class Search:
    """Rounds x -> g(x) of motions x (n, 6) [m], where g(x) - x is Newton's way under the model at x.

    An edge or a corner that meets the skin stiffens over micrometres: from where it hardly touches Newton's
    way leads deep into it, and from there off it. What is sought is where a potential has its least value, of
    the bodies' inertia and of the skin together; a round that has passed it along its way is followed by one
    between, by the potential's slopes at both ends. Friction has no such potential, but no slope that turns
    far either.
    """

    def __init__(self, n: int):
        self._seen = FixedPoint(n)

    def begin(self, compliance: np.ndarray) -> None:
        """compliance: (6 n, 6 n) motions of the bodies over the step by wrenches on them."""
        scale = np.tile(_SCALE, len(compliance) // 6)
        self._inertia = np.linalg.pinv(scale[:, None] * compliance * scale, _SINGULAR, hermitian=True)
        self._scale, self._base, self._went_back = scale, None, False
        self._seen.begin()

    def forget(self) -> None:
        """Forgets the rounds so far."""
        self._base = None
        self._seen.begin()

    def next(self, done: np.ndarray, left: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
        """The motion (n, 6) to try after `done` (n, 6), under whose model `left` (n, 6) is left; stiffness:
        the tangents (n, 6, 6) there."""
        slope = self._inertia @ left.ravel()
        for k, one in enumerate(stiffness):
            part, scale = slice(6 * k, 6 * k + 6), self._scale[:6]
            slope[part] += one @ (left[k] / scale) / scale
        if self._base is not None:
            start, begun = self._base
            way = done - start
            share = share_back(float(way.ravel() @ begun), float(way.ravel() @ slope))
            if share < 1.0:
                self._went_back = True
                self._seen.begin()
                return start + share * way
        self._base = done, slope
        to, far = self._seen.next(done, left), _FAR_AFTER_BACK if self._went_back else _FAR
        if np.abs(to - done).max() > far * np.abs(left).max():
            self._seen.begin()
            return done + left
        return to
