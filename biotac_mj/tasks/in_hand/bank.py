"""States of worlds that are kept, so that an episode begins where the rod is held already: closing takes
longer than rolling."""

import math
import typing

import warp as wp

from ...batch.memory import arrays_of

if typing.TYPE_CHECKING:
    import torch

__all__ = ["Bank"]

# lengths of what all worlds share: components, sensors, electrodes, parts of the film
_TAKEN = frozenset({1, 2, 3, 4, 6, 7, 9, 16, 19, 22, 23, 24, 32, 200})


class Bank:
    """All that differs between worlds in mujoco_warp's Data and in what skins and sensors remember: kept
    once, and given to any world.

    Args:
      nworld: number of worlds, and of kept states.
      roots: objects that hold wp.arrays with an axis of worlds, of this package or mujoco_warp's Data.
      tensors: (nworld, ...) torch tensors besides, written in place.

    Raises:
      ValueError: as many worlds as tables of all worlds have rows, from which states could not be told.
    """

    def __init__(self, nworld: int, roots: list, tensors: "typing.Sequence[torch.Tensor]" = ()):
        if nworld in _TAKEN:
            raise ValueError(
                f"states of {nworld} worlds are not told from tables of that length: take one more"
            )
        arrays = [a for a in arrays_of(roots) if a.size and nworld in a.shape and a.is_contiguous]
        self._parts = [(t, 0) for t in tensors] + [_words(a, nworld) for a in arrays]
        self._kept = []

    @property
    def nbytes(self) -> int:
        """What is kept [bytes]."""
        return sum(t.nbytes for t, _ in self._parts)

    def keep(self) -> None:
        """Keeps the present state of every world."""
        if not self._kept:
            self._kept = [t.clone() for t, _ in self._parts]
        for (now, _), kept in zip(self._parts, self._kept, strict=True):
            kept.copy_(now)

    def give(self, worlds: "torch.Tensor", source: "torch.Tensor") -> None:
        """Worlds (k,) get the states that worlds `source` (k,) were in, numbers."""
        for (now, axis), kept in zip(self._parts, self._kept, strict=True):
            now.index_copy_(axis, worlds, kept.index_select(axis, source))


def _words(array, nworld):
    """A wp.array as a torch tensor (k, nworld, words), and 1: its last axis of such a length is that of
    worlds."""
    size = wp.types.type_size_in_bytes(array.dtype)
    kind, width = (wp.int32, 4) if size % 4 == 0 else (wp.uint8, 1)
    axis = max(i for i, length in enumerate(array.shape) if length == nworld)
    before, after = math.prod(array.shape[:axis]), math.prod(array.shape[axis + 1 :])
    shape = (before, nworld, after * (size // width))
    words = wp.array(ptr=array.ptr, dtype=kind, shape=shape, device=array.device, copy=False)
    words._ref = array  # whose memory it is
    return wp.to_torch(words, requires_grad=False), 1
