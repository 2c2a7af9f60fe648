"""The arrays of a skin's state, declared in `state`: resets of some worlds on the device, and transfer of one
world to the host and back."""

import functools
import operator
import typing

import numpy as np
import warp as wp

from ..launches import in_a_row, recorded
from .data import SkinData
from .geoms import GeomSet
from .state import FULL, SavedState, StateLayout, options_of, saved_variables, variables_of
from .transfer import Transfer
from .types import real

__all__ = ["StateArrays"]

wp.set_module_options({"enable_backward": False})

# indices of the six numbers of a symmetric 3 x 3 matrix, and back
_ROW, _COLUMN, _WHOLE = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2], [0, 1, 2, 1, 3, 4, 2, 4, 5]


@wp.kernel
def _save_rows(
    # In:
    number: wp.array2d(dtype=typing.Any),
    reset: typing.Any,
    others: wp.array2d(dtype=real),
    first: int,
    begin: int,
    end: int,
    # Out:
    row_out: wp.array(dtype=real),
):
    """Appends the items that are not reset, of which the first has the number `first`, to the table at
    `begin`, which counts those beyond its `end`, too."""
    if first == 0:
        row_out[begin] = real(0.0)
    for i in range(number.shape[0]):
        if number[i, 0] != reset:
            at = begin + 1 + (2 + others.shape[1]) * int(row_out[begin])
            row_out[begin] += real(1.0)
            if at < end:
                row_out[at] = real(first + i)
                row_out[at + 1] = real(number[i, 0])
                for k in range(others.shape[1]):
                    row_out[at + 2 + k] = others[i, k]


@wp.kernel
def _load_rows(
    # In:
    row: wp.array(dtype=real),
    first: int,
    begin: int,
    reset: typing.Any,
    # Out:
    number_out: wp.array2d(dtype=typing.Any),
    others_out: wp.array2d(dtype=real),
):
    """The inverse: items without a row are reset."""
    for i in range(number_out.shape[0]):
        number_out[i, 0] = reset
    for r in range(int(row[begin])):
        at = begin + 1 + (2 + others_out.shape[1]) * r
        i = int(row[at]) - first
        if i >= 0 and i < number_out.shape[0]:
            number_out[i, 0] = number_out.dtype(row[at + 1])
            for k in range(others_out.shape[1]):
                others_out[i, k] = row[at + 2 + k]


for _kind in (int, real):
    wp.overload(_save_rows, {"number": wp.array2d(dtype=_kind), "reset": _kind})
    wp.overload(_load_rows, {"reset": _kind, "number_out": wp.array2d(dtype=_kind)})


class StateArrays:
    """The declared arrays of a skin and its geoms.

    Args:
      data, geoms: of the skin.
      tier: FULL or CONDENSED.
      layout: of the rows of numbers; None: with room for all.
      holders: other holders of arrays by name. Variables of missing holders are omitted.

    Attributes:
      arrays: by variable name.
      layout: of the rows of numbers.
    """

    def __init__(
        self,
        data: SkinData,
        geoms: GeomSet,
        tier: str = FULL,
        layout: StateLayout | None = None,
        **holders: typing.Any,
    ):
        model = data.model
        self.nworld, self._device, self._tier = data.nworld, model.device, tier
        self._data, self._geoms, self._nsample = data, geoms, len(model.sample)
        holders |= {"data": data, "outer": data.outer, "worlds": data.worlds, "geoms": geoms.struct}
        holders |= {"touched": data.touched(geoms.count)}
        if data.core:
            holders["core"] = data.core
        if data.memory:
            holders["rubber"] = data.rubber
        options = options_of(model.material.extensions, model.options)
        there = [v for v in variables_of(tier, options) if v.holder in holders]
        found = [(v, operator.attrgetter(v.attribute)(holders[v.holder])) for v in there]
        self._found = [(v, array) for v, array in found if array.size]
        self.arrays = {v.name: array for v, array in self._found}
        sources = {name: getattr(data, name) for name in ("rest_vert", "rest_pressure")}
        self._sources, self._kappa = sources, data.worlds.kappa
        variables, rows = saved_variables(tier, options)
        self._plain = [v for v in variables if v.name in self.arrays]
        self._rows = {name: _blocks(of, self.arrays) for name, of in rows.items()}
        if layout is None:
            sizes = {axis: 0 for v in variables for axis in v.axes}
            sizes |= {axis: n for v, array in self._found for axis, n in zip(v.axes, array.shape)}
            room = {
                name: sum(self.arrays[v.name].shape[0] * int(np.prod(v.item)) for v, *_ in blocks)
                for name, blocks in self._rows.items()
            }
            layout = StateLayout(tier, options, sizes, room)
        self.layout = layout

    # --- some of the worlds, on the device ---

    def prepare(self) -> None:
        """Prepares `reset` and `reset_skin`; call it before a capture."""
        self._all = self._resets(lambda v: True)
        self._at_rest = self._resets(lambda v: not v.outlives_rest)

    def _resets(self, wanted):
        """Transfer of reset values to the arrays of wanted variables."""
        pairs, gates = [], {}
        with wp.ScopedDevice(self._device):
            for v, array in self._found:
                if v.reset is None or v.reset == "virgin" or not wanted(v):
                    continue
                if isinstance(v.reset, str):
                    value = self._sources[v.reset]
                    if v.reset == "rest_pressure":  # zero in worlds without liquid
                        gates[len(pairs)] = self._kappa
                else:
                    value = wp.full((1,) * array.ndim, v.reset, dtype=v.dtype)
                pairs.append((value, array))
        return Transfer(pairs, self.nworld, self._device, gates=gates)

    def reset(self, mask: wp.array) -> None:
        """Resets the worlds of mask, (nworld,) of bool, after `prepare`. Launches only."""
        self._all.launch_where(mask)
        if self._data.memory:
            self._data.memory.forget(self._data.x, mask)

    def reset_skin(self, mask: wp.array) -> None:
        """Resets the skin of the worlds of mask, and keeps variables of geoms and steps."""
        self._at_rest.launch_where(mask)

    def of_role(self, *roles: str) -> list[wp.array]:
        """Arrays of the variables with some roles."""
        return [array for v, array in self._found if v.role in roles]

    # --- a single world, on the host ---

    def save(self) -> SavedState:
        """State of the first world, without the variables of the host."""
        row = self.save_row()
        names = *(v.name for v in self._plain), *self._rows
        return SavedState(**{name: self.layout.value(row, name) for name in names})

    def save_of(self, holder: str) -> dict:
        """State of one holder, by variable name."""
        saved = self.save()
        return {v.name: getattr(saved, v.name) for v in self._plain if v.holder == holder}

    def save_row(self) -> np.ndarray:
        """State of the first world as a row of numbers, with zeros for the variables of the host.

        Raises:
          ValueError: more contact than the layout has room for.
        """
        row, plain, save, _ = self._transfers
        if self._device.is_cuda:
            for name, copy in self._host.items():
                wp.copy(copy, self.arrays[name])
        for v, numbers, array in plain:
            numbers[...] = array[..., _ROW, _COLUMN] if v.symmetric else array
        for launch in save:
            launch()
        for name in self._rows:
            self.layout.check_room(name, int(self.layout.part(row, name)[0]))
        return self.layout.copy(row)

    def load(self, saved: SavedState) -> None:
        """Sets the state of a single world; the inverse of `save`, with rows in ascending order of items.
        Missing values are unchanged."""
        row = self.save_row()
        self.layout.write(saved, row)
        self.load_row(row)

    def load_row(self, state: np.ndarray) -> None:
        """Sets the state of a single world from a row of numbers."""
        row, plain, _, load = self._transfers
        row[:], self._geoms.posed = state, True
        for v, numbers, array in plain:
            array[...] = numbers[..., _WHOLE].reshape(array.shape) if v.symmetric else numbers
        for launch in load:
            launch()
        sample, geom = self.layout.rows(row, "contacts")[:, :2].astype(int).T
        for name, marked in (("kept", sample // self._nsample), ("touched_by", geom)):
            if name in self._marks:
                self._marks[name][:] = 0
                self._marks[name][marked] = 1
        if self._device.is_cuda:
            for name, copy in self._host.items():
                wp.copy(self.arrays[name], copy)
        if self._tier == FULL:
            wp.copy(self._data.x_last, self._data.x)
        if self._data.memory:
            self._data.memory.recall(self._data.x)

    @functools.cached_property
    def _host(self):
        """Arrays on the CPU that a row is saved from and loaded to: on CUDA copies."""
        names = [v.name for v in self._plain]
        names += [v.name for blocks in self._rows.values() for block in blocks for v in block]
        names += [name for name in ("kept", "touched_by") if name in self.arrays]
        found = {name: self.arrays[name] for name in names}
        found = {n: wp.empty_like(a, device="cpu") if a.device.is_cuda else a for n, a in found.items()}
        self._marks = {name: found[name].numpy()[:, 0] for name in ("kept", "touched_by") if name in found}
        return found

    @functools.cached_property
    def _transfers(self):
        """A row of numbers; variables, their parts of it and their arrays; launches that write the tables of
        the row, and that read them."""
        host, layout = self._host, self.layout
        with wp.ScopedDevice("cpu"):
            row, save, load = wp.zeros(layout.size, dtype=real), [], []
            for name, blocks in self._rows.items():
                first, part = 0, layout.slices[name]
                for v, *others in blocks:
                    items, more = _numbers(host[v.name], True), wp.zeros((1, 0), dtype=real)
                    for other in others:
                        more = _numbers(host[other.name])
                    reset, known = items.dtype(v.reset), (first, part.start)
                    save.append(recorded(_save_rows, 1, [items, reset, more, *known, part.stop], [row]))
                    load.append(recorded(_load_rows, 1, [row, *known, reset], [items, more]))
                    first += len(items)
        numbers, plain = row.numpy(), []
        for v in self._plain:
            first = (*[slice(None)] * len(v.axes), 0) if v.axes else slice(1)
            array = host[v.name].numpy()[first]
            part = layout.part(numbers, v.name).reshape(*array.shape[: len(v.axes) or 1], *v.item)
            plain.append((v, part, array))
        return numbers, plain, in_a_row(save), in_a_row(load)


def _numbers(array, single=False):
    """Numbers of the first world of an array [item, world] on the CPU, (item, number); `single`: each is an
    item."""
    kind = getattr(array.dtype, "_wp_scalar_type_", array.dtype)
    size, item = (wp.types.type_size_in_bytes(t) for t in (kind, array.dtype))
    (n, _), (stride, _) = array.shape, array.strides
    shape, strides = ((n * item // size, 1), (size, size)) if single else ((n, item // size), (stride, size))
    return wp.array(ptr=array.ptr, dtype=kind, shape=shape, strides=strides, device="cpu", copy=False)


def _blocks(variables, arrays):
    """Groups the variables of a table; each group begins with a variable that starts a table."""
    blocks = []
    for v in variables:
        if v.name not in arrays:
            continue
        if v.starts:
            blocks.append([v])
        else:
            blocks[-1].append(v)
    return blocks
