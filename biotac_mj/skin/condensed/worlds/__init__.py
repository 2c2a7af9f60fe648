"""The condensed tier for many worlds at once: a block of threads for each skin, which goes its own way
through Newton's method without waiting for the others. On the CPU one thread does the same.

`step` is what others use; `way` follows the geoms, `balance` has Newton's method, `candidates` and `results`
what comes before and after it, `lanes` what the threads of a block do together."""

from .step import CondensedStep

__all__ = ["CondensedStep"]
