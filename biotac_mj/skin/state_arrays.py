"""The arrays of a skin's state, declared in `state`: resets of some worlds on the device, and transfer of one
world to the host and back."""

import operator
import typing

import numpy as np
import warp as wp

from .data import SkinData
from .geoms import GeomSet
from .state import FULL, SavedState, StateLayout, options_of, saved_variables, variables_of
from .transfer import Transfer

# indices of the six numbers of a symmetric 3 x 3 matrix, and back
_ROW, _COLUMN, _WHOLE = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2], [0, 1, 2, 1, 3, 4, 2, 4, 5]


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
        self._rows = {name: [v for v in of if v.name in self.arrays] for name, of in rows.items()}
        if layout is None:
            sizes = {axis: 0 for v in variables for axis in v.axes}
            sizes |= {axis: n for v, array in self._found for axis, n in zip(v.axes, array.shape)}
            items = {
                name: [len(self.arrays[v.name]) * np.prod(v.item, dtype=int) for v in of if v.starts]
                for name, of in self._rows.items()
            }
            layout = StateLayout(tier, options, sizes, {name: sum(n) for name, n in items.items()})
        self.layout = layout
        of_rows = [v.name for of in self._rows.values() for v in of]
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
        host, layout = self._host(), self.layout
        row = np.zeros(layout.size)
        for v in self._plain:
            value = host[v.name]
            layout.part(row, v.name)[:] = (value[..., _ROW, _COLUMN] if v.symmetric else value).ravel()
        for name in self._rows:
            table, count = layout.table(row, name), 0
            for first, column, reset, others in self._blocks[name]:
                at = (column != reset).nonzero()[0]
                layout.check_room(name, count + len(at))
                rows, count = table[count : count + len(at)], count + len(at)
                rows[:, 0], rows[:, 1] = first + at, column[at]
                for items in others:
                    rows[:, 2:] = items[at]
            layout.part(row, name)[0] = count
        return row

    def load(self, saved: SavedState) -> None:
        """Sets the state of a single world; the inverse of `save`, with rows in ascending order of items.
        Missing values are unchanged."""
        row = self.save_row()
        self.layout.write(saved, row)
        self.load_row(row)

    def load_row(self, row: np.ndarray) -> None:
        """Sets the state of a single world from a row of numbers."""
        host, self._geoms.posed = self._host(), True
        for v in self._plain:
            value, array = self.layout.part(row, v.name), host[v.name]
            array[...] = (value.reshape(-1, 6)[:, _WHOLE] if v.symmetric else value).reshape(array.shape)
        for name, blocks in self._blocks.items():
            table = self.layout.rows(row, name)
            ends = np.searchsorted(table[:, 0], [first for first, *_ in blocks[1:]]).tolist()
            for begin, end, (first, column, reset, others) in zip([0, *ends], [*ends, None], blocks):
                at = table[begin:end, 0].astype(int) - first
                column[:] = reset
                column[at] = table[begin:end, 1]
                for items in others:
                    items[at] = table[begin:end, 2:]
        sample, geom = self.layout.rows(row, "contacts")[:, :2].astype(int).T
        for name, marked in (("kept", sample // self._nsample), ("touched_by", geom)):
            if name in host:
                host[name][:] = 0
                host[name][marked] = 1
        if self._tier == FULL:
            host["x_last"][:] = host["x"]
        if self._device.is_cuda:
            for name, value in host.items():
                array = self.arrays[name]
                array.assign(value.reshape(*array.shape, *getattr(array.dtype, "_shape_", ())))
        if self._data.memory:
            self._data.memory.recall(self._data.x)

    def _host(self):
        """Arrays of the first world that a row is saved from and loaded to: views on the CPU."""
        if self._views is None or self._device.is_cuda:
            self._views = {name: self._view(name) for name in self._loaded}
            self._blocks = {name: _blocks(of, self._views) for name, of in self._rows.items()}
        return self._views

    def _view(self, name):
        v = next(v for v, _ in self._found if v.name == name)
        # a slice for a number per world, so that the result is a view
        first = (*[slice(None)] * len(v.axes), 0) if v.axes or v.item else slice(0, 1)
        return self.arrays[name].numpy()[first]


def _blocks(variables, host):
    """(number of the first item, one number of each, its reset, further arrays) of each block of a table; a
    variable that starts a table begins one."""
    out, first = [], 0
    for v in variables:
        if v.starts:
            column = host[v.name].reshape(-1)
            out.append((first, column, v.reset, []))
            first += len(column)
        else:
            out[-1][3].append(host[v.name])
    return out
