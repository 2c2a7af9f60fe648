"""Contact from electrodes: which press makes the simulated sensor read what was measured.

Of presses all over the skin it is asked how likely each is, given what is believed of the sensor and given
that it may come tilted. Means and spreads over them are the answer. So what the electrodes leave open, what
the sensor's own constants leave open and what nobody knows of sensors is in the intervals."""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np

from ...calibration import plan_indentation
from ...calibration.forward import steps_of
from ...geometry.skin_geometry import SkinGeometry
from ...sensor.channels import FULL_SCALE, NELECTRODE, electrode_noise, log_impedance, pressure_from_counts
from ...skin import Material, SkinModel, SkinOptions
from ..skin import Skin
from .belief import Belief, Posterior, Session, Touch, believe
from .presses import Presses

__all__ = ["WIDE", "Estimate", "Estimator", "change_of", "pressure_change", "touch_of", "typical"]

# Half widths of 95 % intervals over standard deviations, of ln of the force and of the centre: FITTED, those
# that hold for 77 presses of synthetic sensors 401 to 407, each by what its ten others tell. A normal
# distribution's 2 are too few: models miss some presses by far
WIDE = 5.7, 4.9
_PRECISION = 1e-3  # of slopes
AWAY = 3e-3  # [m] from all presses: no touch of the sensing skin
_CANDIDATES = 1500  # presses that a touch may be
_RUBBER = "neo_hookean", 0.86e6, 0.385, 0.7  # law, E [Pa], nu, friction
_FILLED = 0.0097  # rest pressure over E


@dataclasses.dataclass(frozen=True)
class Estimate:
    """One contact; errors are half widths of 95 % intervals.

    Attributes:
      centre, centre_error: (3,) of the contact on the resting skin, on the force's line [m].
      force: (3,) of the geom on the skin [N]. size: its size, most likely; low, high: its interval.
      unexplained: share of the electrodes' change that the likeliest press leaves.
    """

    centre: np.ndarray
    centre_error: np.ndarray
    force: np.ndarray
    size: float
    low: float
    high: float
    unexplained: float


def change_of(counts: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """(19,) change of ln Z from rest.

    Raises:
      ValueError: shapes, or an electrode at its end.
    """
    counts, rest = np.asarray(counts, float), np.asarray(rest, float)
    for name, value in (("counts", counts), ("rest", rest)):
        if value.shape != (NELECTRODE,) or not ((value >= 1) & (value <= FULL_SCALE - 1)).all():
            raise ValueError(
                f"{name} are not {NELECTRODE} numbers between 1 and {FULL_SCALE - 1:.0f}: an electrode "
                "at its end tells no impedance; choose another row"
            )
    return log_impedance(counts) - log_impedance(rest)


def touch_of(counts: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """`change_of` electrodes that are touched.

    Raises:
      ValueError: as `change_of`, or counts that hardly differ from rest.
    """
    change, rest = change_of(counts, rest), np.asarray(rest, float)
    noise = electrode_noise(rest) * 0.5 * np.abs(log_impedance(rest + 1) - log_impedance(rest - 1))
    changed = np.sqrt((change**2).mean())
    if changed < 3 * np.sqrt((noise**2).mean()):
        raise ValueError(
            f"ln Z differs from rest by {changed:.4f}, which may be noise: choose a row under load, or "
            "another rest"
        )
    return change


class Estimator:
    """Inverts one skin under one geom.

    Args:
      geometry: of the skin. indenter: as `biotac press --indenter`, one geom or mesh.
      material, options: of the skin; None: those in the middle of what real sensors showed, see `typical`.

    Raises:
      ValueError: what `Skin` refuses.
    """

    def __init__(
        self,
        geometry: SkinGeometry,
        indenter: str = "sphere_7mm",
        material: str | Material | None = None,
        options: SkinOptions | None = None,
    ):
        self.geometry, self.indenter = geometry, indenter
        if material is None:
            material, options = typical(geometry, options)
        _, shape = steps_of(plan_indentation(indenter, slide=0.0, samples=4, skin=geometry))
        self.skin = Skin(geometry, material, options, **shape, precision=_PRECISION)
        self._last = None

    @functools.cached_property
    def presses(self) -> Presses:
        """All over the skin; simulated when first asked for, or from disk."""
        return Presses(self.skin, self.geometry, self.indenter)

    @functools.cached_property
    def posterior(self) -> Posterior:
        """Of the presses, for any sensor."""
        return Posterior(self.presses, self.geometry)

    def learn(self, touches: Sequence[Touch]) -> Session:
        """What touches of one sensor tell of it together, labelled or not.

        Raises:
          ValueError: a centre that is given is nowhere near the sensing skin.
        """
        for touch in touches:
            if touch.centre is not None:
                off = np.linalg.norm(self.presses.outcome[:, 1:4] - touch.centre, axis=1).min()
                if not off < AWAY:
                    at = np.round(1e3 * np.asarray(touch.centre), 1).tolist()
                    raise ValueError(
                        f"the touch at {at} mm lies not within {1e3 * AWAY:g} mm of the sensing skin: give "
                        "contact_pos [m] in the BioTac frame"
                    )
        return Session(self.posterior, touches)

    def __call__(
        self,
        counts: np.ndarray,
        rest: np.ndarray,
        pdc: tuple[float, float] | None = None,
        belief: Belief | None = None,
    ) -> Estimate:
        """The contact at which electrodes read counts (19,), and untouched rest (19,).

        Args:
          pdc: counts of it, and untouched; None: not known.
          belief: of `learn`, from other touches than this; None: of any sensor.

        Raises:
          ValueError: shapes, or counts that hardly differ from rest.
        """
        pressure = np.nan if pdc is None else pressure_change(*pdc)
        return self.of(Touch(touch_of(counts, rest), pressure), belief)

    def together(self, touches: Sequence[Touch], known: Sequence[Touch] = ()) -> list[Estimate]:
        """The contacts of touches of one sensor, each by what all others tell of the sensor; known: touches
        that are labelled."""
        session = self.learn([*touches, *known])
        return [self.of(touch, session.without(i)) for i, touch in enumerate(touches)]

    def of(self, touch: Touch, belief: Belief | None = None) -> Estimate:
        """The contact of a touch, without its labels; belief: of the sensor, from other touches."""
        seen = touch.unlabelled.seen
        among = self.posterior.likely(seen, _CANDIDATES)
        given = self.posterior.given(believe() if belief is None else belief, among)
        found = given.conditioned(seen)
        mean, variance = found.outcome()
        likeliest = given.expected[found.likely.argmax(), :NELECTRODE]
        wide_force, wide = WIDE
        size, half = float(np.exp(mean[0])), wide_force * np.sqrt(variance[0])
        return Estimate(
            centre=1e-3 * mean[1:4],
            centre_error=1e-3 * wide * np.sqrt(variance[1:]),
            force=size * mean[4:] / np.linalg.norm(mean[4:]),
            size=size,
            low=float(np.exp(mean[0] - half)),
            high=float(np.exp(mean[0] + half)),
            unexplained=float(np.linalg.norm(touch.change - likeliest) / np.linalg.norm(touch.change)),
        )


def typical(geometry: SkinGeometry, options: SkinOptions | None = None) -> tuple[Material, SkinOptions]:
    """Rubber and filling in the middle of what real sensors showed (`data.generation.synthetic_sensor` names
    the sources): belief in a sensor is about it."""
    material, options = Material(*_RUBBER), options or SkinOptions()
    if options.fill_volume == 0 and not options.rest_pressure:
        filled = dataclasses.replace(options, rest_pressure=_FILLED * material.youngs_modulus)
        model = SkinModel(geometry, material, filled)
        fill = model.rest.natural_volume - model.liquid_volume
        options = dataclasses.replace(options, fill_volume=float(f"{fill:.6g}"), rest_pressure=None)
    return material, options


def pressure_change(pdc: float, rest: float) -> float:
    """Of the liquid [kPa], from counts of PDC."""
    return 1e-3 * float(pressure_from_counts(pdc) - pressure_from_counts(rest))
