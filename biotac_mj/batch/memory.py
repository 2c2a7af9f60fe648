"""Memory on the device: which arrays objects hold; and for code that allocates as it goes, inside loops of a
CUDA graph, which may not allocate."""

from collections.abc import Iterable, Iterator

import warp as wp

from ..skin import SkinModel


def arrays_of(roots: Iterable) -> Iterator[wp.array]:
    """Every wp.array with memory that objects hold, once: themselves, in containers, in structs and in
    objects of this package; not those of a SkinModel, which all worlds share."""
    roots = list(roots)
    seen, stack = set(), list(roots)
    while stack:
        thing = stack.pop()
        if id(thing) in seen:
            continue
        seen.add(id(thing))
        if isinstance(thing, wp.array):
            if thing.ptr and (thing.ptr, thing.shape) not in seen:
                seen.add((thing.ptr, thing.shape))
                yield thing
        elif isinstance(thing, (list, tuple)):
            stack.extend(thing)
        elif isinstance(thing, dict):
            stack.extend(thing.values())
        elif hasattr(thing, "cls"):  # a struct
            stack.extend(getattr(thing, name) for name in thing.cls.__annotations__)
        elif any(thing is root for root in roots) or (
            type(thing).__module__.startswith("biotac_mj") and not isinstance(thing, SkinModel)
        ):
            stack.extend(getattr(thing, "__dict__", {}).values())


class Scratch:
    """Warp's allocator on one CUDA device while it is entered; on the CPU nothing changes.

    Freed memory is reused for requests of the same size: code that ran once outside of a loop allocates
    nothing when it runs inside.
    """

    def __init__(self, device: wp.DeviceLike):
        self._device, self._free, self._blocks = wp.get_device(device), {}, {}
        self._scopes = []

    def __enter__(self) -> "Scratch":
        if self._device.is_cuda:
            self._scopes.append(wp.ScopedAllocator(self._device, self))
            self._scopes[-1].__enter__()
        return self

    def __exit__(self, *error) -> None:
        if self._device.is_cuda:
            self._scopes.pop().__exit__(*error)

    def allocate(self, size_in_bytes: int) -> int:
        """Device pointer to as many bytes."""
        free = self._free.setdefault(size_in_bytes, [])
        if free:
            return free.pop()
        with wp.ScopedAllocator(self._device, self._scopes[-1].saved):
            block = wp.empty(size_in_bytes, dtype=wp.uint8, device=self._device)
        self._blocks[block.ptr] = block
        return block.ptr

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        self._free[size_in_bytes].append(ptr)
