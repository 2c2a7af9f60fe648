"""Candidate models of presses of a flat plate: the base model, and the base model with one effect added. A
model is judged by the one likelihood, the state of every row marginalised."""

import dataclasses
import types

import numpy as np

from ...matching.fit import Constants, Rows, Setup, fit_constants, fit_states, rows_of, tangent
from ...matching.response import Response
from ...matching.states import frame
from ...sensor.channels import counts_from_log_impedance
from ..recordings.recording import PlainRecording
from ..trajectories.likelihood import Likelihood, error_modes, kernel
from ..trajectories.settings import SETTINGS

_SETUP = Setup(gains=0.0, amount=1.0)  # of the changes that a response has
_DEVELOPED = 0.7  # of the rows, in time, on which everything is found and chosen; the rest is held out
_ROWS = 300  # loaded rows that are looked at: time to fit goes with them
_JUDGED = 100  # rows of the evidence, whose four columns each it marginalises
_ROUNDS = 3  # of amplitudes and errors of laws in turn


def press_rows(recording: PlainRecording) -> tuple[Rows, Rows]:
    """Loaded rows of a recording: of the first 70 %, and the held-out ones.

    Raises:
      ValueError: no force, or too few loaded rows.
    """
    loaded = 0 if recording.force is None else (np.linalg.norm(recording.force, axis=1) > 0.5).sum()
    rows = rows_of(recording.electrodes, recording.force, max(1, int(loaded / _ROWS)))
    cut = int(_DEVELOPED * len(rows))
    return rows[:cut], rows[cut:]


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """A model with the constants and states that fit n rows best.

    Attributes:
      constants. error: (n, nelectrode) modelled less measured [counts]; unseen: (m, nelectrode) of held-out
        rows. score: log evidence of the rows for the model [nats]. amount, low, high: of its effect, with
        95 %; law_error: of what this one does, as a fraction. base: Fit of the base model; None: it is.
      state: (n, 4).
    """

    constants: Constants
    state: np.ndarray
    error: np.ndarray
    unseen: np.ndarray
    score: float
    amount: float
    low: float
    high: float
    law_error: float
    base: "Fit | None"

    @property
    def nats(self) -> float:
        """Evidence over the base model."""
        return self.score - self.base.score

    def rms(self, electrodes: list | slice = slice(None)) -> tuple[float, float]:
        """RMS on held-out rows without and with the effect [counts]."""
        parts = (one.unseen[:, electrodes] for one in (self.base or self, self))
        return tuple(float(np.sqrt((part**2).mean())) for part in parts)

    def closed(self, electrodes: list | slice = slice(None)) -> float:
        """Share of the squared error that the effect takes away; below 0 where it adds to it."""
        before, after = self.rms(electrodes)
        return 1 - (after / max(before, 1e-12)) ** 2


def fitted(
    response: Response,
    recording: PlainRecording,
    rows: tuple[Rows, Rows],
    noise: np.ndarray,
    base: Fit | None = None,
) -> Fit:
    """Fits a model to rows, and finds their evidence for it by the likelihood of `trajectories.likelihood`,
    all constants and the state of every row marginalised about the fit.

    Args:
      response: the base model's, or with the change of one effect. rows: that are fitted, and held-out ones.
        noise: (nelectrode + 2,) of the electrodes [counts] and of the tangential force [N]. base: from which
        the search goes on, of a model with an effect.
    """
    rows, locked = rows
    const, match = fit_constants(response, rows, _SETUP, base and (base.constants, base.state))
    rest = counts_from_log_impedance(const.offset + const.drifted(rows.time)[:, None])
    change = match.counts - rest
    some = slice(None, None, -(-len(rows) // _JUDGED))
    residual, columns, away, scale = tangent(response, rows[some], const, match.state[some], _SETUP)
    largest = np.abs(np.hstack([change, match.force])).max(0)
    contact = _contact(response, rows, match, const.modulus, len(recording) / recording.rate)
    every = [np.arange(len(rows))[some]]
    groups = [slice(0, len(noise) - 2), slice(len(noise) - 2, len(noise))]
    own = Likelihood(kernel([contact], every), error_modes([contact], every), noise, groups, largest)
    done = [] if base is None else [columns[-1] * away[-1]]  # by the effect
    columns, here = own.turned(columns), own.turned(residual)
    y = here + np.tensordot(away, columns, 1)  # as from the priors' means
    law_errors, amplitude = np.full(len(done), SETTINGS.law), own.amplitude_of(here**2, own.size)
    for _ in range(_ROUNDS):
        whole = np.concatenate([columns, own.laws(done, law_errors)])
        amplitude = own.amplitudes(y, whole, amplitude, own.size)
        log, weights, factor = own.evidence(y, whole, own.variance(amplitude, own.size))
        known, law_errors = law_errors, own.law_errors(law_errors, weights, factor, len(columns))
    last = len(columns) - 1
    half = 1.96 * scale * np.linalg.norm(np.linalg.inv(factor)[:, last])
    amount = float(weights[last] * scale)
    return Fit(
        const,
        match.state,
        match.counts - rows.counts,
        fit_states(response, locked, const, _SETUP).counts - locked.counts,
        log + own.prior(amplitude, known),
        amount,
        amount - half,
        amount + half,
        float(known.max(initial=0.0)),
        base,
    )


def _contact(response, rows, match, modulus, seconds):
    """Rows as those of one contact of a plate, of which `trajectories.likelihood` reads the poses."""
    states, axes = response.states, np.array([frame(*turn) for turn in match.state[:, :2]])
    load = rows.force[:, 2] / modulus
    depth = np.interp(load, states.grid.load, states.depth.mean((0, 1, 2)))
    push = axes[:, 2] + np.einsum("nk,nki->ni", match.state[:, 2:], axes[:, :2])
    touched = states.rest[(axes[:, 2] @ states.rest.T).argmin(1)]  # under the plate at first touch
    return types.SimpleNamespace(
        tool="plane",
        clock=0.0,
        time=rows.time * seconds,
        pos=touched + depth[:, None] * push,
        mat=np.stack([axes[:, 0], axes[:, 2], axes[:, 1]], 2),
        depth=depth,
    )
