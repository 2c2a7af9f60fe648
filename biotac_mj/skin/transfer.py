"""Copies between arrays [item, world] of any type in some worlds, by one launch for all arrays."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import warp as wp

from ..kernels import kernel_module
from .types import real

kernel_module(__name__)

_CHUNK = 8  # items that a thread writes at a time on CUDA; on the CPU one thread writes an array
_THREADS = 2**17  # on CUDA, about: most launches find little to write, and ending threads takes time too


@wp.struct
class Pair:
    """Two arrays as words [item, world, word] of 64 bits or, if the size of an item is no multiple of that,
    of 32 bits; the arrays of the other size are empty. A source with one item or one world is used for all.
    Words are copied as floating-point numbers, so that the compiler knows that a store does not change the
    arrays' strides, and keeps them in registers."""

    source: wp.array3d(dtype=real)
    target: wp.array3d(dtype=real)
    half_source: wp.array3d(dtype=wp.float32)
    half_target: wp.array3d(dtype=wp.float32)
    gate: wp.array(dtype=real)  # [world], perhaps empty; zero is written in worlds where it is zero
    guess: int  # 1: unchanged in worlds whose last step converged


@wp.func
def write_words(source: wp.array3d(dtype=Any), target: wp.array3d(dtype=Any), first: int, last: int, w: int):
    here = wp.where(source.shape[1] == 1, 0, w)
    each = wp.where(source.shape[0] == 1, 0, 1)
    for i in range(first, last):
        for k in range(target.shape[2]):
            target[i, w, k] = source[each * i, here, k]


@wp.func
def write(pair: Pair, first: int, last: int, w: int):
    if pair.gate.shape[0] > 0:
        if pair.gate[w] == real(0.0):
            for i in range(first, last):
                for k in range(pair.target.shape[2]):
                    pair.target[i, w, k] = real(0.0)
            return
    if pair.target.shape[0] > 0:
        write_words(pair.source, pair.target, first, last, w)
    else:
        write_words(pair.half_source, pair.half_target, first, last, w)


@wp.kernel
def write_where(
    pairs: wp.array(dtype=Pair), task: wp.array(dtype=wp.vec3i), stride: int, mask: wp.array(dtype=bool)
):
    """Copies the items of every stride-th task from t on in world w, if its mask is set."""
    t, w = wp.tid()
    if mask[w]:
        for k in range(t, task.shape[0], stride):
            at = task[k]
            write(pairs[at[0]], at[1], at[2], w)


@wp.kernel
def write_wanted(
    pairs: wp.array(dtype=Pair),
    task: wp.array(dtype=wp.vec3i),
    stride: int,
    wanted: wp.array(dtype=int),
    reason: wp.array(dtype=int),
):
    """Copies the items of every stride-th task from t on in a wanted world; guesses only if its last step did
    not converge."""
    t, w = wp.tid()
    if wanted[w] == 1:
        for k in range(t, task.shape[0], stride):
            at = task[k]
            if pairs[at[0]].guess == 0 or reason[w] != 0:
                write(pairs[at[0]], at[1], at[2], w)


class Transfer:
    """Copies between pairs of arrays.

    Args:
      pairs: (source, target) [..., world] of one type; a source may have one item, or one world, for all.
      words: whether the pairs are words already, of any strides, see `Pair`.
      nworld: number of worlds. device: of the arrays.
      gates: index of a pair -> array (nworld,) double; zero is written in worlds where it is zero.
      guesses: indices of pairs that `launch_wanted` skips in worlds whose last step converged.
    """

    def __init__(
        self,
        pairs: Sequence[tuple[wp.array, wp.array]],
        nworld: int,
        device: wp.DeviceLike,
        gates: Mapping[int, wp.array] | None = None,
        guesses: Collection[int] = (),
        words: bool = False,
    ):
        self._device, self._nworld, gates = wp.get_device(device), nworld, gates or {}
        self._pairs, task = list(pairs), []  # whose memory the table points to
        table = []
        for number, (source, target) in enumerate(self._pairs):
            pair = Pair()
            wide = wp.types.type_size_in_bytes(target.dtype) % 8 == 0
            both = source, target
            if not words:
                both = [words_of(array, real if wide else wp.float32) for array in both]
            if wide:
                pair.source, pair.target = both
            else:
                pair.half_source, pair.half_target = both
            if number in gates:
                pair.gate = gates[number]
            pair.guess = int(number in guesses)
            table.append(pair)
            items = both[1].shape[0]
            chunk = _CHUNK if self._device.is_cuda else items
            task += [(number, first, min(first + chunk, items)) for first in range(0, items, chunk)]
        self._gates = gates
        with wp.ScopedDevice(self._device):
            self._table = wp.array(table, dtype=Pair) if table else wp.zeros(0, dtype=Pair)
            self._task = wp.array(task, dtype=wp.vec3i) if task else wp.zeros(0, dtype=wp.vec3i)

    def launch_where(self, mask: wp.array) -> None:
        """Copies in the worlds of mask (nworld,) bool. Launches only."""
        self._launch(write_where, mask)

    def launch_wanted(self, wanted: wp.array, reason: wp.array) -> None:
        """Copies in wanted worlds (nworld,) int. reason: (nworld,) why the last step did not converge; 0: it
        did. Launches only."""
        self._launch(write_wanted, wanted, reason)

    def _launch(self, kernel, *masks):
        stride = len(self._task)
        if self._device.is_cuda:
            stride = min(stride, max(64, _THREADS // self._nworld))
        dim = stride, self._nworld
        wp.launch(kernel, dim, [self._table, self._task, stride, *masks], device=self._device)


def words_of(array: wp.array, dtype: type) -> wp.array:
    """An array [..., world], or the transpose of one [world, item], as words [item, world, word]."""
    size = wp.types.type_size_in_bytes(dtype)
    shape = (
        array.size // array.shape[-1],
        array.shape[-1],
        wp.types.type_size_in_bytes(array.dtype) // size,
    )
    strides = None if array.is_contiguous else (*array.strides, size)
    return wp.array(ptr=array.ptr, dtype=dtype, shape=shape, strides=strides, device=array.device, copy=False)
