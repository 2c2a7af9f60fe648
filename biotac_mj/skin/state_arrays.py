"""The arrays of a skin's state, declared in `state`: resets of some worlds on the device, and transfer of one
world to the host and back."""

import operator
import typing

import numpy as np
import warp as wp

from .data import SkinData
from .geoms import GeomSet
from .state import FULL, SavedState, options_of, saved_variables, variables_of
from .transfer import Transfer

__all__ = ["StateArrays"]

# indices of the six numbers of a symmetric 3 x 3 matrix, and back
_ROW, _COLUMN, _WHOLE = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2], [0, 1, 2, 1, 3, 4, 2, 4, 5]


class StateArrays:
    """The declared arrays of a skin and its geoms.

    Args:
      data, geoms: of the skin.
      tier: FULL or CONDENSED.
      holders: other holders of arrays by name. Variables of missing holders are omitted.

    Attributes:
      arrays: by variable name.
    """

    def __init__(self, data: SkinData, geoms: GeomSet, tier: str = FULL, **holders: typing.Any):
        model = data.model
        self.nworld, self._device, self._tier = data.nworld, model.device, tier
        self._memory, self._nsample, self._x = data.memory, len(model.sample), data.x
        self._geoms = geoms
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
        self._values = [(v.name, _value_of(v)) for v in self._plain]
        self._rows = {name: _blocks(of, self.arrays) for name, of in rows.items()}
        of_rows = [v.name for blocks in self._rows.values() for block in blocks for v in block]
        follow = [name for name in ("x_last", "kept", "touched_by") if name in self.arrays]
        self._loaded, self._views = [*(v.name for v in self._plain), *of_rows, *follow], None

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
        if self._memory:
            self._memory.forget(self._x, mask)

    def reset_skin(self, mask: wp.array) -> None:
        """Resets the skin of the worlds of mask, and keeps variables of geoms and steps."""
        self._at_rest.launch_where(mask)

    def of_role(self, *roles: str) -> list[wp.array]:
        """Arrays of the variables with some roles."""
        return [array for v, array in self._found if v.role in roles]

    # --- a single world, on the host ---

    def save(self, kind: type[SavedState] = SavedState) -> SavedState:
        """State of the first world, without the variables of the host."""
        host = self._host()
        saved = {name: value(host[name]) for name, value in self._values}
        for name, blocks in self._blocks.items():
            tables, begin = [_rows(block) for block in blocks], 0
            for table, block in zip(tables, blocks, strict=True):
                table[:, 0] += begin
                begin += len(block[0][1])
            saved[name] = tables[0] if len(tables) == 1 else np.concatenate(tables)
        return kind(**saved)

    def save_of(self, holder: str) -> dict:
        """State of one holder, by variable name."""
        host = self._host()
        names = {v.name for v in self._plain if v.holder == holder}
        return {name: value(host[name]) for name, value in self._values if name in names}

    def load(self, saved: SavedState) -> None:
        """Sets the state of a single world; the inverse of `save`, with rows in ascending order of items.
        Missing values are reset."""
        values, host, self._geoms.posed = vars(saved), self._host(), True
        for v in self._plain:
            value = values.get(v.name)
            if value is None:
                value = self._sources[v.reset].numpy()[_first(v)] if v.reset in self._sources else v.reset
            elif v.symmetric:
                value = value[..., _WHOLE].reshape(host[v.name].shape)
            if value is not None and not isinstance(value, str):
                host[v.name][...] = value
        for name, blocks in self._blocks.items():
            _put_rows(values.get(name, np.zeros((0, 2))), blocks)
        if self._tier == FULL:
            host["x_last"][:] = host["x"]
        contacts = values.get("contacts", np.zeros((0, 2))).astype(int)
        host["kept"][:] = 0
        host["kept"][contacts[:, 0] // self._nsample] = 1
        if "touched_by" in host:
            host["touched_by"][:] = 0
            host["touched_by"][contacts[:, 1]] = 1
        if self._device.is_cuda:
            for name, value in host.items():
                array = self.arrays[name]
                array.assign(value.reshape(*array.shape, *getattr(array.dtype, "_shape_", ())))
        if self._memory:
            self._memory.recall(self._x)

    def view(self, name: str) -> np.ndarray:
        """Array of a variable in the first world on the host; a view on the CPU."""
        v = next(v for v, _ in self._found if v.name == name)
        return self.arrays[name].numpy()[_first(v)]

    def _host(self):
        """Arrays of the first world that `save` and `load` use."""
        if self._views is None or self._device.is_cuda:
            self._views = {name: self.view(name) for name in self._loaded}
            self._blocks = {name: _tables(blocks, self._views) for name, blocks in self._rows.items()}
        return self._views


def _first(v):
    """Index of the first world; a slice for a number per world, so that the result is a view."""
    if not v.axes and not v.item:
        return slice(0, 1)
    return (*[slice(None)] * len(v.axes), 0)


def _value_of(v):
    """Function from a variable's array in a world to its saved value."""
    if v.symmetric:
        return lambda view: view[..., _ROW, _COLUMN]
    return np.copy if v.axes or v.item else lambda view: float(view[0])


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


def _tables(blocks, host):
    """For each variable of each block its reset and its array in one world, a row for each item."""
    sizes = (host[block[0].name].size for block in blocks)
    return [[(v.reset, host[v.name].reshape(n, -1)) for v in block] for n, block in zip(sizes, blocks)]


def _rows(block):
    """Rows of a block: indices of its items, and their values."""
    reset, column = block[0]
    at = (column[:, 0] != reset).nonzero()[0]
    return np.concatenate([at[:, None], *(items[at] for _, items in block)], axis=1, dtype=float)


def _put_rows(table, blocks):
    """Inverse of `_rows` for all blocks; items without a row are reset."""
    begin, number = 0, table[:, 0]
    for (reset, column), *others in blocks:
        end = begin + len(column)
        rows = table
        if len(blocks) > 1:
            rows = table[np.searchsorted(number, begin) : np.searchsorted(number, end)]
        at, done = rows[:, 0].astype(int) - begin, 2
        column[:] = reset
        column[at, 0] = rows[:, 1]
        for reset, items in others:
            if reset is not None:
                items[:] = reset
            if len(at):
                items[at] = rows[:, done : done + items.shape[1]]
            done += items.shape[1]
        begin = end
