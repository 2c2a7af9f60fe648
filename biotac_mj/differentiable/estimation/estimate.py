"""Contact from electrodes: the press for which the simulated sensor has the measured readings.

If the sensor is the simulated one, a press is fitted (`fitting.py`). If it is unknown, the likelihood of
presses all over the skin is computed, given the belief about the sensor and a possible tilt. The estimate is
the posterior mean and spread, so the intervals include the ambiguity of the electrodes, the uncertainty of
the sensor's constants and the variation between sensors."""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np

from ...calibration import plan_indentation
from ...calibration.forward import steps_of
from ...geometry.design import check_nelectrode
from ...geometry.skin_geometry import SkinGeometry
from ...sensor.channels import FULL_SCALE, electrode_noise, log_impedance, pressure_from_counts
from ...sensor.film import FilmConduction
from ...skin import Material, SkinOptions
from ..skin import Skin
from .belief import FORCE, PLACE, Belief, Posterior, Touch, believe, learn
from .fitting import fit, noise_of, slopes_at
from .presses import Presses

# Ratio of half widths of 95 % intervals to standard deviations, of ln of the force and of the centre: FITTED
# to the coverage of 110 presses of 11 synthetic sensors. A normal distribution's 2 is too small: some presses
# have large model errors
WIDE = 3.4, 3.0
# The same for a fit. FITTED to the coverage of nine presses of the simulated sensor, tilted, with noise
# (docs/lab/differentiable.md): signals have kinks, so errors are not normal
OWN_WIDE = 3.2, 5.0
_PRECISION = 1e-4  # of gradients


@dataclasses.dataclass(frozen=True)
class Estimate:
    """One contact; errors are half widths of 95 % intervals.

    Attributes:
      centre, centre_error: (3,) of the contact, in the BioTac frame [m]: the point of the line of force that
        is nearest to the middle of the samples in contact, where these lie on the skin at rest.
      force: (3,) of the geom on the skin [N]. size: its norm, most likely; low, high: its interval.
      unexplained: fraction of the electrodes' change that the most likely press does not explain. deepest:
        whether that is the deepest simulated press there, so that the true one may be deeper.
    """

    centre: np.ndarray
    centre_error: np.ndarray
    force: np.ndarray
    size: float
    low: float
    high: float
    unexplained: float
    deepest: bool

    @classmethod
    def of(
        cls, outcome: np.ndarray, wide: float, error: np.ndarray, unexplained: float, deepest: bool
    ) -> "Estimate":
        """The contact with an `outcome_of` (7,), half widths of ln of the force and of the centre (3,)."""
        size, factor = float(np.exp(outcome[0])), float(np.exp(wide))
        force = size * outcome[4:] / np.linalg.norm(outcome[4:])
        return cls(outcome[1:4], error, force, size, size / factor, size * factor, unexplained, deepest)


def change_of(counts: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """(nelectrode,) change of ln Z from rest.

    Raises:
      ValueError: wrong shapes, or a saturated electrode.
    """
    counts, rest = np.asarray(counts, float), np.asarray(rest, float)
    for name, value in (("counts", counts), ("rest", rest)):
        if (
            value.shape != rest.shape
            or value.ndim != 1
            or not ((value >= 1) & (value <= FULL_SCALE - 1)).all()
        ):
            raise ValueError(
                f"{name} are not {rest.size} numbers between 1 and {FULL_SCALE - 1:.0f}: an electrode "
                "at its end tells no impedance; choose another row"
            )
    return log_impedance(counts) - log_impedance(rest)


def at_instant(
    time: np.ndarray, values: np.ndarray, row: int, period: float, late: np.ndarray | float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Values (n, k) of channels at the time of a row, and how far off they may be by motion, (k,) each.

    A multiplexer holds a value for a frame: in a row it is half a frame old in the mean. So a mean over the
    frame that follows is of the row's time. While a geom slides, what is a frame old may be off by ten times
    the noise.

    Args:
      time: (n,) [s]. period: of a frame [s]. late: (k,) mean age of the values beyond half a frame [s].
    """
    begin = time[row] + late + np.zeros(values.shape[1])
    inside = (time[:, None] > begin - 1e-6) & (time[:, None] < begin + period + 1e-6)
    inside[-1] |= ~inside.any(0)
    value = np.where(inside, values, 0).sum(0) / inside.sum(0)
    first = max(np.searchsorted(time, time[row] - period + 1e-6, "right") - 1, 0)
    last = len(time) - 1 - inside[::-1].argmax(0)
    rate = np.abs(values[last, np.arange(values.shape[1])] - values[first]) / np.maximum(
        time[last] - time[first], 1e-6
    )
    unsure = period if len(time) < 2 else min(period, float(np.median(np.diff(time))))
    return value, rate * unsure / np.sqrt(12)


def touch_of(counts: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """`change_of` electrodes in contact.

    Raises:
      ValueError: as `change_of`, or counts that hardly differ from rest, or equally at all electrodes.
    """
    change, rest = change_of(counts, rest), np.asarray(rest, float)
    noise = electrode_noise(rest) * 0.5 * np.abs(log_impedance(rest + 1) - log_impedance(rest - 1))
    changed, least = np.sqrt((change**2).mean()), 3 * np.sqrt((noise**2).mean())
    if changed < least:
        raise ValueError(
            f"ln Z differs from rest by {changed:.4f}, which may be noise: choose a row under load, or "
            "another rest"
        )
    # the spread over electrodes is at least 0.8 of their mean for touches, at most 0.3 for warm-up
    # (docs/lab/differentiable.md)
    if change.std() < min(least, 0.5 * abs(change.mean())):
        raise ValueError(
            f"ln Z differs from rest by {change.mean():.4f}, alike at all electrodes: this is a sensor that "
            "warms up, not a touch; choose a row under load, or a rest shortly before it"
        )
    return change


class Estimator:
    """Inverts one skin under one geom.

    Args:
      geometry: of the skin. indenter: as in `biotac press --indenter`, one geom or mesh.
      material, options: of the skin; force scales with its modulus. progress: whether to show bars.

    Raises:
      ValueError: as for `Skin`.
    """

    def __init__(
        self,
        geometry: SkinGeometry,
        indenter: str = "sphere_7mm",
        material: str | Material = "default",
        options: SkinOptions | None = None,
        progress: bool = False,
    ):
        self.geometry, self.indenter, self.progress = geometry, indenter, progress
        _, shape = steps_of(plan_indentation(indenter, slide=0.0, samples=4, skin=geometry))
        self.skin = Skin(geometry, material, options, **shape, precision=_PRECISION)
        self._last = None

    @functools.cached_property
    def presses(self) -> Presses:
        """Presses all over the skin; simulated on first use, or read from disk."""
        return Presses(self.skin, self.geometry, self.indenter, self.progress)

    @functools.cached_property
    def _starts(self):
        """The presses without derivatives, which a fit begins from."""
        return Presses(self.skin, self.geometry, self.indenter, self.progress, slopes=False)

    def learn(self, touches: Sequence[Touch]) -> Belief:
        """Belief about the sensor after known touches, see `belief.learn`."""
        return learn(self.presses, self.geometry, touches)

    def fit(
        self,
        counts: np.ndarray,
        rest: np.ndarray,
        pdc: tuple[float, float] | None = None,
        rows: int = 1,
        film: dict | None = None,
        moved: np.ndarray | None = None,
    ) -> Estimate:
        """The contact for which the simulated sensor itself reads counts (nelectrode,), and `rest` without
        contact.

        Args:
          pdc: its counts, with and without contact; None: unknown. rows: number of rows averaged for `rest`.
          film: settings of `sensor.film.FilmConduction`, if changed.
          moved: (nelectrode,), with pdc and its own, standard deviations by motion, see `at_instant`.

        Raises:
          ValueError: shapes, counts that hardly differ from rest, or a press that cannot be simulated.
        """
        change = touch_of(counts, rest)
        signal = change if pdc is None else np.append(change, pressure_change(*pdc))
        film = FilmConduction(self.geometry, **(film or {}))
        noise = noise_of(np.asarray(rest, float), rows)[: len(signal)]
        if moved is not None:
            noise = np.hypot(noise, moved * slopes_at(np.asarray(counts, float))[: len(signal)])
        found = fit(self._starts, film, signal, noise, self.progress)
        spread = np.sqrt(np.diag(found.covariance))
        wide_force, wide = OWN_WIDE
        wide = wide_force * spread[0], wide * spread[1:4]
        return Estimate.of(found.outcome, *wide, found.unexplained, False)

    def __call__(
        self,
        counts: np.ndarray,
        rest: np.ndarray,
        pdc: tuple[float, float] | None = None,
        belief: Belief | None = None,
    ) -> Estimate:
        """The contact for counts (nelectrode,) of the electrodes, with rest (nelectrode,) without contact.

        Args:
          pdc: its counts, with and without contact; None: unknown.
          belief: of `learn`; None: prior.

        Raises:
          ValueError: shapes, or counts that hardly differ from rest.
        """
        n = self.geometry.design.nelectrode
        check_nelectrode(self.geometry.design, np.size(counts), "a row")
        change = touch_of(counts, rest)
        signal = change if pdc is None else np.append(change, pressure_change(*pdc))
        posterior = self._posterior(belief, pdc is not None)
        likely, outcome = posterior(signal)
        p = np.exp(likely - likely.max())
        p /= p.sum()
        mean = p @ outcome
        spread = np.sqrt(p @ ((outcome - mean) ** 2 + posterior.variance))
        known = belief or believe(n)
        wide_force, wide = WIDE
        force = wide_force * np.sqrt(spread[0] ** 2 + FORCE**2 + known.force_variance)
        centre, best = wide * np.sqrt(spread[1:4] ** 2 + PLACE**2), int(p.argmax())
        unexplained, deepest = posterior.unexplained(best, signal), bool(self.presses.deepest[best])
        return Estimate.of(mean, force, centre, unexplained, deepest)

    def _posterior(self, belief, pressed):
        """Posterior, cached for many rows of a sensor."""
        if self._last is None or self._last[:2] != (belief, pressed):
            made = Posterior(
                self.presses, self.geometry, belief or believe(self.geometry.design.nelectrode), pressed
            )
            self._last = belief, pressed, made
        return self._last[2]


def pressure_change(pdc: float, rest: float) -> float:
    """Change of the liquid's pressure [kPa], from counts of PDC."""
    return 1e-3 * float(pressure_from_counts(pdc) - pressure_from_counts(rest))
