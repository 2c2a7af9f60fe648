"""Nuisance parameters: uncertain constants of the base model, fitted with every effect so that they are not
mistaken for one.

Modulus and friction; the width of the contact's footprint on the electrodes; how far the answer lies between
this mesh and another one, between the full tier and the condensed one; how thick the film stays where the
skin lies on the core; when within the bus's frame the electrodes of a row were read."""

import dataclasses
import functools

import numpy as np

from ....geometry.design import Design, designs
from ....geometry.skins import shipped_skin
from ....sensor.acquisition_kernels import SLOT_RATE

# In the order of Nuisance's fields: standard deviations of the prior, bounds. Friction off by a sixth or more
# is a finding (`effects.contact.Friction`). The film has 20 to 100 um where 50 are the default
# (`sensor.film.FilmConduction`). The bus reads one electrode after another: a row's are half a frame old
# on average, and a log may stamp its rows at either end of it.
PRIOR = np.array([0.4, 0.1, 0.05, 0.7, 0.7, 0.5, 0.5, 0.5])
LOW = np.array([-1.5, -0.15, -0.1, -1.0, -1.0, -1.2, -1.0, -0.2])
HIGH = np.array([1.5, 0.15, 0.1, 2.0, 2.0, 1.2, 1.0, 1.2])
BETWEEN = "mesh", "tier"  # differences of solved skins, see `fields.Fields`
# measured on the condensed tier, whose price is seconds
OTHER_MESH = {
    shipped_skin(design, mesh): shipped_skin(design, other)
    for design in designs()
    for mesh, other in (("coarse", "default"), ("default", "coarse"), ("fine", "default"))
}


@dataclasses.dataclass(frozen=True)
class Nuisance:
    """log_modulus, log_friction: logs of factors; footprint: fraction of an electrode's ln Z that its
    neighbourhood shows; mesh: 0 this mesh, 1 the other; tier: 0 full, 1 condensed, where the skin is of the
    full tier; log_film: log of the factor on the film's least thickness; age: of the electrodes at their
    row's time, in frames of the bus; stands_off: fraction of what its rests differ by that is no matter of
    impedance, so that electrodes answer as if they rested as the model's."""

    log_modulus: float = 0.0
    log_friction: float = 0.0
    footprint: float = 0.0
    mesh: float = 0.0
    tier: float = 0.0
    log_film: float = 0.0
    age: float = 0.0
    stands_off: float = 0.0

    @property
    def modulus(self) -> float:
        return float(np.exp(self.log_modulus))

    def late(self, design: Design) -> float:
        """[s] by which the electrodes of a row of a sensor are late."""
        return self.age * _frame(design)

    @property
    def written(self) -> "Nuisance":
        """The part that a sensor file holds: the modulus, and the baselines of electrodes."""
        return Nuisance(log_modulus=self.log_modulus, stands_off=self.stands_off)

    def at_bound(self, name: str) -> bool:
        """Whether a parameter is as far off as it may be: it takes up no more of what is like it."""
        k, value = [f.name for f in dataclasses.fields(self)].index(name), getattr(self, name)
        return bool(min(value - LOW[k], HIGH[k] - value) < 0.02 * PRIOR[k])

    def moved(self, **by: float) -> "Nuisance":
        """A copy with some of it changed by so much."""
        return dataclasses.replace(self, **{k: getattr(self, k) + v for k, v in by.items()})


KNOWN = Nuisance()  # nothing is off


def ages(design: Design) -> tuple[float, float]:
    """Least and most [s] by which the electrodes of a sound log are late."""
    at = [f.name for f in dataclasses.fields(Nuisance)].index("age")
    return float(LOW[at] * _frame(design)), float(HIGH[at] * _frame(design))


def _frame(design):
    """[s] of the bus's frame."""
    return design.slots / SLOT_RATE


@functools.cache
def _neighbourhood(design, length=4.0):
    """(nelectrode, nelectrode) rows of weights that fall off with distance [mm] and sum to 1, zero on the
    diagonal."""
    from ....geometry.design import electrode_positions

    p = electrode_positions(design)
    near = np.exp(-((np.linalg.norm(p[:, None] - p[None], axis=2) / length) ** 2)) * (1 - np.eye(len(p)))
    return near / near.sum(1, keepdims=True)


def widen(log_z: np.ndarray, rest_log_z: np.ndarray, footprint: float, design: Design) -> np.ndarray:
    """(n, nelectrode) ln Z with the change from rest (nelectrode,) spread over the neighbourhood."""
    change = log_z - rest_log_z
    return log_z + footprint * (change @ _neighbourhood(design).T - change)
