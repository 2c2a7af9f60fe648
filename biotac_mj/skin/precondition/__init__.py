"""Preconditioners of the skin's linear solves: a sparse factor on the CPU, a dense inverse on CUDA."""

import typing
from collections.abc import Callable
from typing import NamedTuple, Protocol

import warp as wp

from ..program import Launcher
from ..types import Precision

if typing.TYPE_CHECKING:
    from ..geoms import GeomSet

__all__ = ["Preconditioner", "Residual"]


class Residual(NamedTuple):
    """The residual to which a preconditioner is applied.

    Attributes:
      norms: (k, nchunk, nworld); the first is the square of r and, for an update, the third that of the
        gradient.
      r: [nvert, nworld] residual, zero at fixed nodes.
      gradient: of the liquid's volume [nvert, nworld]; None without a liquid.
    """

    norms: wp.array
    r: wp.array
    gradient: wp.array | None


class Preconditioner(Protocol):
    """The approximate inverse of the tangent, for all worlds of one SkinData, its argument: the inverse of
    the undeformed stiffness, corrected for contact and liquid. Methods put launches into a program.

    Attributes:
      precision: of directions.
    """

    precision: Precision

    def begin_step(self, program: Launcher, x: wp.array) -> None:
        """Starts a step whose nodes are in x [nvert, nworld]."""

    def update(
        self,
        program: Launcher,
        residual: Residual,
        z_out: wp.array,
        partial_out: wp.array,
        in_parallel: Callable[..., None],
    ) -> None:
        """Takes the tangents of contact and liquid from the last evaluation in the active worlds, marks those
        that touch, and computes z = approximate inverse of the new tangent times r.

        Args:
          z_out: [nvert, nworld]. partial_out: (2, nchunk, nworld) r . z and gradient . z.
          in_parallel: launches functions that do not need each other's results.
        """

    def apply(self, program: Launcher, residual: Residual, z_out: wp.array, partial_out: wp.array) -> None:
        """Computes z for another r in the running worlds."""

    def renew_if_due(self, program: Launcher, x: wp.array) -> None:
        """After a linear solve at x [nvert, nworld]: takes the factor of this shape if solves were long; by
        default never, as where a new inverse takes longer than the products that it saves."""

    def renew(self, program: Launcher, x: wp.array) -> None:
        """Takes the factor of the shape x, if the preconditioner supports it."""

    def measure_tangents(
        self, program: Launcher, geoms: "GeomSet", x: wp.array, tangent_out: wp.array
    ) -> None:
        """Stiffness of the skin against rigid motions of each touching body after a step [group, world], see
        `body_tangent`."""
