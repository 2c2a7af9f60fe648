"""The state that batches carry from step to step, as one row of words for each world: for callers that keep
the states themselves, as JAX does."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from ..skin.transfer import Transfer, words_of
from ..skin.types import real
from .batch import Batch


class Draws(NamedTuple):
    """Random draws of one BioTac: the word where its seed begins, the words (n,) of what the seed draws, and
    their values (n,) as a function of it; n is 0 if it draws nothing."""

    seed: int
    places: np.ndarray
    words: Callable[[int], np.ndarray]


class Rows:
    """Rows of batches of `nworld` worlds, on their device.

    Attributes:
      row: (nworld, n) wp.array uint32; n depends on the model and the settings alone.
      draws: [Draws] of the batches with sensors.
    """

    def __init__(self, batches: Sequence[Batch]):
        nworld, device = batches[0].nworld, batches[0].device
        parts = []  # words of an array [item, world, word]
        for batch in batches:
            last, first = batch.lasting()
            for array in (*last, *first):
                wide = wp.types.type_size_in_bytes(array.dtype) % 8 == 0
                dtype, size = (real, 2) if wide else (wp.float32, 1)
                if any(array is one for one in last):
                    words = words_of(array, dtype)
                else:  # [world, ...]: one item
                    total = array.size * wp.types.type_size_in_bytes(array.dtype)
                    shape = 1, nworld, total // (4 * size * nworld)
                    words = wp.array(ptr=array.ptr, dtype=dtype, shape=shape, device=device, copy=False)
                parts.append((size, words, array))
        parts.sort(key=lambda part: -part[0])  # wide words are aligned
        count = sum(size * words.shape[0] * words.shape[2] for size, words, _ in parts)
        count += count % 2
        self._parts = parts  # whose memory it is
        self.row = wp.zeros((nworld, count), dtype=wp.uint32, device=device)
        begin, pairs, at = 0, [], {}
        for size, words, array in parts:
            at[array.ptr] = begin
            items, _, each = words.shape
            there = wp.array(
                ptr=self.row.ptr + 4 * begin,
                dtype=words.dtype,
                shape=words.shape,
                strides=(4 * size * each, 4 * count, 4 * size),
                device=device,
                copy=False,
            )
            pairs.append((there, words))
            begin += size * items * each
        self._read = Transfer(pairs, nworld, device, words=True)
        self._write = Transfer([pair[::-1] for pair in pairs], nworld, device, words=True)
        self._all = wp.full(nworld, True, dtype=bool, device=device)
        self.draws = [
            Draws(at[senses.acquisition.seed.ptr], *_drawn(senses, at))
            for batch in batches
            if (senses := batch.senses)
        ]

    def read(self) -> None:
        """Copies the states in `row` into the batches. Launches only."""
        self._read.launch_where(self._all)

    def write(self) -> None:
        """Writes their states into `row`. Launches only."""
        self._write.launch_where(self._all)


def _drawn(senses, at):
    def words(seed):
        values = [np.ravel(value).view(np.uint32) for _, value in senses.drawn(int(seed))]
        return np.concatenate([np.zeros(0, np.uint32), *values])

    places = [at[array.ptr] + np.arange(2 * np.size(value)) for array, value in senses.drawn(0)]
    return np.concatenate([np.zeros(0, int), *places]), words
