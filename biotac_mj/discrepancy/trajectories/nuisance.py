"""What is never quite known about the base model and is fitted with every effect, so that none of it takes an
effect's name.

Modulus and friction; the width of the contact's footprint on the electrodes; how far the answer lies between
this mesh and another one."""

import dataclasses
import functools

import numpy as np

__all__ = ["HIGH", "KNOWN", "LOW", "OTHER_MESH", "PRIOR", "Nuisance", "widen"]

# In the order of Nuisance's fields: standard deviations of the prior, bounds. Friction off by a sixth or more
# is a finding (`skin_and_setup.Friction`).
PRIOR = np.array([0.4, 0.1, 0.05, 0.7])
LOW, HIGH = np.array([-1.5, -0.15, -0.2, -1.0]), np.array([1.5, 0.15, 0.2, 2.0])
# measured on the condensed tier, whose price is seconds
OTHER_MESH = {"coarse": "default", "default": "coarse", "fine": "default"}


@dataclasses.dataclass(frozen=True)
class Nuisance:
    """log_modulus, log_friction: logs of factors; footprint: share of an electrode's ln Z that its
    neighbourhood shows; mesh: 0 this mesh, 1 the other."""

    log_modulus: float = 0.0
    log_friction: float = 0.0
    footprint: float = 0.0
    mesh: float = 0.0

    @property
    def modulus(self) -> float:
        return float(np.exp(self.log_modulus))

    def vector(self) -> np.ndarray:
        """(4,)"""
        return np.array(dataclasses.astuple(self))

    def moved(self, **by: float) -> "Nuisance":
        """A copy with some of it changed by so much."""
        return dataclasses.replace(self, **{k: getattr(self, k) + v for k, v in by.items()})


KNOWN = Nuisance()  # nothing is off


@functools.lru_cache(maxsize=1)
def _neighbourhood(length=4.0):
    """(19, 19) rows of weights that fall off with distance [mm] and sum to 1, zero on the diagonal."""
    from ...geometry.electrodes import electrode_positions

    p = electrode_positions()
    near = np.exp(-((np.linalg.norm(p[:, None] - p[None], axis=2) / length) ** 2)) * (1 - np.eye(19))
    return near / near.sum(1, keepdims=True)


def widen(log_z: np.ndarray, rest_log_z: np.ndarray, footprint: float) -> np.ndarray:
    """(n, 19) ln Z with the change from rest (19,) spread over the neighbourhood."""
    change = log_z - rest_log_z
    return log_z + footprint * (change @ _neighbourhood().T - change)
