"""The fast tier: a skin that is linear but for its contact, solved over the nodes that touch.

Displacements are u = C (s f + c p g): C the inverse of the stiffness at rest, f the contact forces of outer
nodes (Coulomb friction) and of inner nodes against the core (normal only), p the liquid's pressure above that
at rest, g the gradient of its volume at rest, s >= 1 and c <= 1 corrections, fitted to the full FEM
(`correction`). The liquid's pressure follows in closed form from p = -K (g.u + q) / V0, with q what the exact
volume of the deformed cavity adds to its linear part. What is left is the contact law f = F(u) over the
candidates, tens of coordinates, solved by Newton's method with a search along the step (a semi-smooth Newton
method; the contact law is that of the full skin, `contact.touch_faces`).

A block of threads has a skin, which goes its own way through Newton's method without waiting for others; on
the CPU one thread does the same. `step` is what others use of it, for many worlds or one (`skin`); `way`
follows the geoms, `balance` has Newton's method and `system` its equations, `candidates` and `results` what
comes before and after it, `lanes` what the threads of a block do together; `linear` is what they know of a
model."""

import typing

from ...lazy import lazy

if typing.TYPE_CHECKING:
    from .linear import LinearSkin as LinearSkin
    from .memory import Memory as Memory
    from .memory import Outcome as Outcome
    from .skin import CondensedSkin as CondensedSkin
    from .step import CondensedStep as CondensedStep

# loaded when they are first used: the full tier takes `refusals` alone
_HOME = {
    "CondensedSkin": ".skin",
    "CondensedStep": ".step",
    "LinearSkin": ".linear",
    "Memory": ".memory",
    "Outcome": ".memory",
}

__all__ = list(_HOME)
__getattr__, __dir__ = lazy(__name__, _HOME)
