"""The fast tier: a skin that is linear but for its contact, solved over the nodes that touch.

Displacements are u = C (s f + c p g): C the inverse of the stiffness at rest, f the contact forces of outer
nodes (Coulomb friction) and of inner nodes against the core (normal only), p the liquid's pressure above that
at rest, g the gradient of its volume at rest, s >= 1 and c <= 1 corrections, fitted to the full FEM
(`correction`). The liquid's pressure follows in closed form from p = -K (g.u + q) / V0, with q what the exact
volume of the deformed cavity adds to its linear part. The unknowns that remain are those of the contact law
f = F(u) over the candidates, tens of coordinates. Newton's method with a line search solves it (a semi-smooth
Newton method; the contact law is that of the full skin, `contact.touch_faces`).

A block of threads solves a skin, and does not wait for other skins; on the CPU a block is one thread. Other
packages use `step`, for many worlds, or `skin`, for one. `stepping` moves the geoms, `broadphase` finds the
candidates, `balance` has Newton's method and `system` its equations, `results` evaluates the equilibrium.
`lanes` has the linear algebra of a block, and `linear` the constants of a model."""

import typing

from ...lazy import lazy

if typing.TYPE_CHECKING:  # loaded when they are first used: the full tier takes `refusals` alone
    from .linear import LinearSkin as LinearSkin
    from .memory import Memory as Memory
    from .memory import Outcome as Outcome
    from .skin import CondensedSkin as CondensedSkin
    from .step import CondensedStep as CondensedStep

__getattr__, __dir__ = lazy(__name__)
