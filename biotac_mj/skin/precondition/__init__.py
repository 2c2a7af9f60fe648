"""Preconditioners of the skin's linear solves: a sparse factor on the CPU, a dense inverse on CUDA."""

import typing
from collections.abc import Callable
from typing import NamedTuple, Protocol

import warp as wp

from ..program import Launcher
from ..types import Precision

if typing.TYPE_CHECKING:
    from ..geoms import GeomSet
    from ..newton.worlds import Worlds

__all__ = ["Preconditioner", "Residual"]


class Residual(NamedTuple):
    """What a preconditioner is applied to.

    Attributes:
      worth: (4, nchunk, nworld) squares of r and of the gradient as its first and third.
      r: [nvert, nworld] residual, zero at fixed nodes.
      gradient: of the liquid's volume [nvert, nworld], or of length zero.
    """

    norms: wp.array
    r: wp.array
    gradient: wp.array


class Preconditioner(Protocol):
    """The approximate inverse of the tangent, for all worlds of one SkinData: of the rest stiffness,
    corrected for contact and liquid. Methods put what they do into a program.

    Attributes:
      precision: of directions.
    """

    precision: Precision

    def begin_step(self, program: Launcher, x: wp.array) -> None:
        """A step begins, of nodes that are in x [nvert, nworld] all the time."""

    def update(
        self,
        program: Launcher,
        st: "Worlds",
        residual: Residual,
        z_out: wp.array,
        partial_out: wp.array,
        in_parallel: Callable[..., None],
    ) -> None:
        """Takes the tangents of contact and liquid, just evaluated, in the active worlds, and marks in
        `st.touched` where something touches; z is the approximate inverse of the new tangent times r.

        Args:
          st: Worlds, of which the active ones are looked at.
          residual: r and the liquid's gradient, see `Residual`.
          z_out: [nvert, nworld]. part_out: (2, nchunk, nworld) r . z and gradient . z.
          beside: launches functions that do not need each other's results.
        """

    def apply(
        self,
        program: Launcher,
        st: "Worlds",
        partial: wp.array,
        r: wp.array,
        gradient: wp.array,
        z_out: wp.array,
        partial_out: wp.array,
    ) -> None:
        """The same for another r in the running worlds; `partial` holds the square of r by chunks."""

    def watch_products(self, program: Launcher, x: wp.array) -> None:
        """After a linear solve at x [nvert, nworld]: may take the factor of this shape."""

    def renew(self, program: Launcher, x: wp.array) -> None:
        """Takes the factor of the shape x, if it can."""

    def measure_tangents(
        self, program: Launcher, geoms: "GeomSet", x: wp.array, tangent_out: wp.array
    ) -> None:
        """Stiffness of the skin against rigid motions of each touching body after a step [group, world], see
        `body_tangent`."""
