"""Candidate models of presses of a flat plate: the base model, and the base model with one effect added. Each
is fitted on one half of the blocks of time and judged on the other."""

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np
from scipy.signal import lfilter

from ...effects.plate import PlateEffect
from ...matching.fit import Constants, Rows, Setup, fit_constants, fit_states, rows_of
from ...matching.response import Response
from ...sensor.channels import counts_from_log_impedance
from ..evidence import log_ratio
from ..recordings.recording import PlainRecording

BASE = Setup(gains=0.0)
_DEVELOPED = 0.7  # of the rows, in time, on which everything is found and chosen; the rest is held out
_ROWS = 300  # loaded rows that are looked at: time to fit goes with them
_BLOCKS = 16  # of time: rows of one press are one piece of evidence
_MEMORY = 0.5, 5.0  # [s] of a grip's relaxation, as measured on holds (docs/lab/memory.md)


def press_rows(recording: PlainRecording) -> tuple[Rows, Rows]:
    """Loaded rows of a recording with what pressed before: of the first 70 %, and the held-out ones.

    Raises:
      ValueError: no force, or too few loaded rows.
    """
    loaded = 0 if recording.force is None else (np.linalg.norm(recording.force, axis=1) > 0.5).sum()
    rows = rows_of(recording.electrodes, recording.force, max(1, int(loaded / _ROWS)))
    cut = int(_DEVELOPED * len(rows))
    return rows[:cut], rows[cut:]


@dataclasses.dataclass(frozen=True, eq=False)
class Model:
    """The base model with one effect.

    Attributes:
      effect: in words, and what attaches it. response, setup: of the fit. value: of its parameter by
        constants. tau: of the load's memory [s], or None.
    """

    effect: PlateEffect
    response: Response
    setup: Setup
    value: Callable[[Constants], float]
    tau: float | None = None

    def of(self, recording: PlainRecording, rows: Rows) -> Rows:
        """Rows with the pressing force as the model's memory has it."""
        if self.tau is None:
            return rows
        pressing, keep = -recording.force[:, 2], np.exp(-1 / (recording.rate * self.tau))
        past = lfilter([1 - keep], [1, -keep], pressing, zi=keep * pressing[:1])[0]
        return dataclasses.replace(rows, past=past[np.rint(rows.time * len(pressing)).astype(int)])


def models(response: Response, effects: tuple[PlateEffect, ...]) -> Iterator[Model]:
    """All that are tried; response: the base model's, with a change for each of `effects`, in their order."""
    plain = response.amended(np.zeros(len(response.changes)))
    for tau in _MEMORY:
        one = PlateEffect(f"memory_{tau:g}s", f"relaxation within {tau:g} s", "C", "", "fraction of the load")
        setup = dataclasses.replace(BASE, memory=0.3)
        yield Model(one, plain, setup, lambda c: c.memory, tau)
    for k, one in enumerate(effects):
        setup = dataclasses.replace(BASE, amount=1.0)
        yield Model(one, response.only(k), setup, lambda c, one=one: one.value(float(c.amount[0])))


@dataclasses.dataclass(frozen=True, eq=False)
class Judged:
    """A model on both halves of n rows, each by constants that the other half gave.

    Attributes:
      constants: of the first and of the second half. state: (n, 4). error: (n, nelectrode) modelled less
        measured [counts]. own: (n, nelectrode) error by the half's own constants. change: (n, nelectrode)
        modelled change of the counts from rest.
    """

    constants: tuple[Constants, Constants]
    state: np.ndarray
    error: np.ndarray
    own: np.ndarray
    change: np.ndarray

    @property
    def uncertainty(self) -> np.ndarray:
        """(n, nelectrode) standard deviation of a prediction: the constants of both halves, compared on the
        same rows."""
        return np.abs(self.error - self.own) / np.sqrt(2)

    def square(self) -> np.ndarray:
        """(blocks,) mean squared error of each block."""
        return np.array([(self.error[b] ** 2).mean() for b in blocks(len(self.error))])

    def gain(self, smaller: "Judged", noise: np.ndarray) -> np.ndarray:
        """(blocks,) [nats] by which it makes each block likelier than a smaller model does, errors of rows of
        one block alike; noise: (nelectrode,) of the electrodes [counts]."""
        return log_ratio(smaller.square(), self.square(), len(noise), np.mean(noise**2))


def blocks(n: int) -> list[np.ndarray]:
    """Row numbers of the blocks of n rows, in order."""
    return np.array_split(np.arange(n), _BLOCKS)


def judge(response: Response, rows: Rows, setup: Setup, begin: Judged | None = None) -> Judged:
    """Fits a model to every other block and judges it on the others: no drift is carried beyond where it was
    seen.

    Args:
      begin: a smaller model from whose constants and states the search goes on; None begins anew.
    """
    parts = [np.concatenate(blocks(len(rows))[k::2]) for k in (0, 1)]
    constants = []
    for k, part in enumerate(parts):
        start = begin and (begin.constants[k], begin.state[part])
        constants.append(fit_constants(response, rows[part], setup, start)[0])
    state, error = np.zeros((len(rows), 4)), np.zeros((len(rows), rows.counts.shape[1]))
    own, change = np.zeros_like(error), np.zeros_like(error)
    for k, part in enumerate(parts):
        other, mine = constants[1 - k], constants[k]
        also = None if begin is None else begin.state[part]
        found = fit_states(response, rows[part], other, setup, also=also)
        again = fit_states(response, rows[part], mine, setup, also=found.state)
        rest = counts_from_log_impedance(other.offset + other.drifted(rows[part].time)[:, None])
        state[part], error[part] = found.state, found.counts - rows[part].counts
        own[part], change[part] = again.counts - rows[part].counts, found.counts - rest
    return Judged(tuple(constants), state, error, own, change)
