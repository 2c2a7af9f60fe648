"""Preconditioners of the skin's linear solves: a sparse factor on the CPU, a dense inverse on CUDA."""

from typing import Protocol

from ..program import Launcher
from ..types import Precision

__all__ = ["Preconditioner"]


class Preconditioner(Protocol):
    """The approximate inverse of the tangent, for all worlds of one SkinData: of the rest stiffness,
    corrected for contact and liquid. Methods put what they do into a program.

    Attributes:
      precision: of directions.
    """

    precision: Precision

    def begin_step(self, program: Launcher) -> None:
        """A step begins."""

    def update(self, program: Launcher, st, worth, r, gradient, z_out, part_out, beside) -> None:
        """Takes the tangents of contact and liquid, just evaluated, in the active worlds, and marks in
        `st.touched` where something touches; z is the approximate inverse of the new tangent times r.

        Args:
          st: Worlds, of which the active ones are looked at.
          worth: (4, nchunk, nworld) squares of r and of the gradient as its first and third.
          r: [nvert, nworld] residual, zero at fixed nodes. gradient: of the liquid's volume [nvert, nworld],
            or of length zero.
          z_out: [nvert, nworld]. part_out: (2, nchunk, nworld) r . z and gradient . z.
          beside: launches functions that do not need each other's results.
        """

    def apply(self, program: Launcher, st, part, r, gradient, z_out, part_out) -> None:
        """The same for another r in the running worlds; `part` holds the square of r by chunks."""

    def watch_products(self, program: Launcher, x) -> None:
        """After a linear solve at x [nvert, nworld]: may take the factor of this shape for the rest of the
        step."""

    def renew(self, program: Launcher, x) -> None:
        """Takes the factor of the shape x, if it can, for the rest of the step."""

    def measure_tangents(self, program: Launcher, geoms, x, tangent_out) -> None:
        """Stiffness of the skin against rigid motions of each touching body after a step [group, world], see
        `body_tangent`."""
