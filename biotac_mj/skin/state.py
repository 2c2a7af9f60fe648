"""The state of a skin: every array that outlives a step is declared here once.

`VARIABLES` gives the place, shape, type, value after a reset and role of each array. It is used to make the
arrays (`allocate`) and the fields of structs (`declared`), to reset some worlds and restore arrays
(`state_arrays`), to save one world on the host (`SavedState`), and to convert that to a row of numbers
(`StateLayout`) for `mjData.plugin_state`. A new array is one line here.

Arrays are [item, world], with the declared axes before the world."""

import dataclasses
import operator
import types
import typing
from collections.abc import Callable, Iterable

import numpy as np
import warp as wp

from .types import mat33, real, vec3

FULL, CONDENSED = "full", "condensed"  # tiers
_BOTH = FULL, CONDENSED

# role of a variable in the next step: state; initial guess; result of the last step; scratch that a reset
# clears
MEMORY, GUESS, OUTCOME, WORK = "memory", "guess", "outcome", "work"

# most rows of a saved state's tables, by tier: touching samples, contact coordinates with a force
ROOM = {"contacts": {FULL: 4096, CONDENSED: 2048}, "forces": {CONDENSED: 1024}}


@dataclasses.dataclass(frozen=True)
class Variable:
    """An array of a skin's state.

    Attributes:
      name: in a saved state.
      place: holder of the array, and its attribute there; "host": no array, only a saved number.
      axes: names of its axes before the world; `allocate` and `StateLayout` take their sizes.
      dtype: Warp type.
      reset: value after a reset: a number; the name of an array of SkinData [item or one, world or one];
        "virgin": set by `RubberMemory.forget`; None: unchanged.
      role: MEMORY, GUESS, OUTCOME or WORK.
      tiers: that have it. saved: tiers in which it is saved; by default all if its role is MEMORY or GUESS.
        Memory that is not saved is computed from other variables, see `StateArrays.load`.
      needs: options (see `options_of`) any of which adds it; (): it always exists.
      rows: table of a saved state, for arrays that are zero except for a few items. starts: whether it
        determines the items of the table; the variables after it have the same items.
      symmetric: six of nine numbers are saved.
      outlives_rest: whether a skin that is reset to rest by itself keeps it, since it describes geoms or
        steps.
    """

    name: str
    place: str
    axes: tuple[str, ...]
    dtype: typing.Any
    reset: float | str | None
    role: str
    tiers: tuple[str, ...] = _BOTH
    saved: tuple[str, ...] | None = None
    needs: tuple[str, ...] = ()
    rows: str | None = None
    starts: bool = False
    symmetric: bool = False
    outlives_rest: bool = False

    @property
    def holder(self) -> str:
        return self.place.partition(".")[0]

    @property
    def attribute(self) -> str:
        return self.place.partition(".")[2]

    def is_there(self, options: Iterable[str]) -> bool:
        """Whether a state with these options has the variable."""
        return not self.needs or not set(self.needs).isdisjoint(options)

    def is_saved(self, tier: str) -> bool:
        """Whether it is in the saved state of a tier."""
        saved = self.saved
        if saved is None:
            saved = self.tiers if self.role in (MEMORY, GUESS) else ()
        return tier in saved

    @property
    def item(self) -> tuple[int, ...]:
        """Shape of the saved numbers of an item."""
        return (6,) if self.symmetric else tuple(getattr(self.dtype, "_shape_", ()))


def _of_contact(surface: str) -> tuple[Variable, ...]:
    """Variables of the contact of a surface, see `data.ContactState`. The core has no friction."""
    role, more = (MEMORY, {}) if surface == "outer" else (WORK, {"saved": ()})
    name = "" if surface == "outer" else f"{surface}_"

    def variable(attribute, axes, dtype, reset, role=WORK, **how):
        return Variable(
            name + attribute.rpartition(".")[2], f"{surface}.{attribute}", axes, dtype, reset, role, **how
        )

    rows = {"rows": "contacts"} if surface == "outer" else {}
    first = rows and {"starts": True}
    return (
        # geom that each sample touched at the end of the last step, and anchor in that geom's frame [m]
        variable("anchor_geom", ("sample",), int, -1, role, **rows, **first, **more),
        variable("anchor", ("sample",), vec3, None, role, **rows, **more),
        variable("kept", ("face",), int, 0, role, saved=()),  # faces with anchors
        # geom of each sample at the last evaluation
        variable("trial_geom", ("sample",), int, -1),
        # geom that a sample touches, or has touched and is still in the range of its adhesion
        variable("bond", ("sample",), int, -1, needs=("contact_law",)),
        variable("touching", ("face",), int, 0),
        variable("node_force", ("vert",), vec3, 0.0),
        variable("clearances.clearance", ("face",), real, 0.0),
    )


_INERTIA = {"tiers": (FULL,), "needs": ("implicit",)}
_RELAXES = {"tiers": (FULL,), "needs": ("prony",), "symmetric": True}
_SETTLES = {"tiers": (FULL,), "needs": ("prony", "mullins")}
_SLIPS = {"tiers": (FULL,), "needs": ("hysteresis",), "symmetric": True}
_CONDENSED = {"tiers": (CONDENSED,)}
_FORCES = _CONDENSED | {"rows": "forces"}
_STARTS = _FORCES | {"starts": True}
_OF_STEPS = {"outlives_rest": True}

VARIABLES = (
    # 1: a step was made since the reset; 1: the skin is exactly in its state without contact
    Variable("started", "host.started", (), real, 0.0, MEMORY, outlives_rest=True),
    Variable("resting", "host.resting", (), real, 0.0, MEMORY, tiers=(FULL,)),
    # nodes at the end of the last step [m], and their motion in it; in the condensed tier they follow from
    # the contact forces
    Variable("x", "data.x", ("vert",), vec3, "rest_vert", MEMORY, saved=(FULL,)),
    Variable("x_last", "data.x_last", ("vert",), vec3, "rest_vert", MEMORY, saved=()),
    Variable("increment", "data.increment", ("vert",), vec3, 0.0, GUESS, tiers=(FULL,)),
    Variable("total_force", "data.force", ("vert",), vec3, 0.0, WORK),
    # of implicit dynamics at the end of the last step: velocities of the nodes [m/s], pose of the BioTac
    # frame
    Variable("velocity", "data.velocity", ("vert",), vec3, 0.0, MEMORY, **_INERTIA),
    Variable("frame_pos", "data.frame_pos_last", (), vec3, None, MEMORY, **_INERTIA),
    Variable("frame_mat", "data.frame_mat_last", (), mat33, None, MEMORY, **_INERTIA),
    # geoms at the end of the last step: poses [m], and motion in it; NaN: the next step takes its own poses
    Variable("geom_pos", "geoms.pos_last", ("geom",), vec3, np.nan, MEMORY, **_OF_STEPS),
    Variable("geom_mat", "geoms.mat_last", ("geom",), mat33, None, MEMORY, **_OF_STEPS),
    Variable("motion", "touched.motion", ("geom",), vec3, 0.0, GUESS, tiers=(FULL,), **_OF_STEPS),
    Variable("touched_by", "touched.touched_by", ("geom",), int, 0, GUESS, saved=(), **_OF_STEPS),
    *_of_contact("outer"),
    *_of_contact("core"),
    # pressure of the liquid above the surroundings [Pa]: at the end of the last step, at the last evaluation
    Variable("last_pressure", "worlds.last_pressure", (), real, "rest_pressure", MEMORY, saved=(FULL,)),
    Variable("world_pressure", "worlds.pressure", (), real, "rest_pressure", OUTCOME),
    # outcome of the last step, see `newton.worlds.Worlds`
    Variable("nonconverged", "worlds.nonconverged", (), int, 0, MEMORY, saved=(), **_OF_STEPS),
    Variable("reason", "worlds.reason", (), int, 0, OUTCOME, **_OF_STEPS),
    Variable("load_factor", "worlds.load_factor", (), real, 1.0, OUTCOME, **_OF_STEPS),
    Variable("iterations", "worlds.iterations", (), int, 0, OUTCOME, **_OF_STEPS),
    Variable("full_tier", "worlds.tier", (), int, 0, OUTCOME, tiers=(FULL,), **_OF_STEPS),
    Variable("error", "worlds.error", (), real, 0.0, OUTCOME, **_OF_STEPS),
    # history of the rubber's points, see `rubber.points`: overstress Q [Pa], relaxing stress S eta [Pa]
    # (which follows from nodes and W_max), largest energy density W_max [J/m^3], slip of friction branches
    Variable("overstress", "rubber.overstress", ("term", "point"), mat33, 0.0, MEMORY, **_RELAXES),
    Variable("last", "rubber.last", ("point",), mat33, "virgin", MEMORY, saved=(), **_SETTLES),
    Variable("worst", "rubber.worst", ("point",), real, "virgin", MEMORY, **_SETTLES),
    Variable("slip", "rubber.slip", ("branch", "point"), mat33, "virgin", MEMORY, **_SLIPS),
    # contact forces of the condensed tier on the outer nodes, and on the inner nodes that can touch the core,
    # in the direction away from it [N]
    Variable("force", "condensed.force", ("outer_node",), vec3, 0.0, MEMORY, **_STARTS),
    Variable("core_force", "condensed.core_force", ("inner_node",), real, 0.0, MEMORY, **_STARTS),
    # pressure of the liquid above that without contact [Pa]; nonlinear part of the cavity's volume [m^3]
    Variable("pressure", "condensed.pressure", (), real, 0.0, MEMORY, **_CONDENSED),
    Variable("bulge", "condensed.bulge", (), real, 0.0, MEMORY, **_CONDENSED),
    # softening and swelling at which the forces were computed, and at the end of the step
    Variable("solved", "condensed.solved", (), wp.vec2d, 1.0, MEMORY, **_CONDENSED),
    Variable("after", "condensed.after", (), wp.vec2d, 1.0, MEMORY, **_CONDENSED),
    # tier of the last step, for the sensor `status`, as `full_tier`
    Variable("tier", "step.tier", (), int, 1, OUTCOME, **_CONDENSED),
    # of `batch.skin.BatchSkin`: 1: no step was made since the reset; number of steps without motion of the
    # skin; 1: it rests; results of the last step
    Variable("fresh", "batch.fresh", (), int, 1, MEMORY, saved=(), needs=("implicit",), **_OF_STEPS),
    Variable("unsettled", "rest.unsettled", (), int, 0, MEMORY, saved=(), **_OF_STEPS),
    Variable("undeformed", "rest.undeformed", (), int, 1, MEMORY, saved=()),
    Variable("batch_pressure", "batch.pressure", (), real, 0.0, OUTCOME),
    Variable("batch_wrench", "batch.wrench", ("group",), wp.spatial_vectord, 0.0, OUTCOME, **_OF_STEPS),
    Variable("batch_tangent", "batch.tangent", ("group",), wp.spatial_matrixd, 0.0, OUTCOME, **_OF_STEPS),
)


def _of(holder):
    return [v for v in VARIABLES if v.holder == holder]


def options_of(extensions: Iterable[str], options: typing.Any) -> frozenset[str]:
    """Options that add variables: names of a material's extensions (`Material.extensions`), and "implicit"
    and "contact_law" of SkinOptions."""
    found = {"implicit"} if options.dynamics == "implicit" else set()
    if options.contact_law is not None:
        found.add("contact_law")
    return frozenset(found | set(extensions))


def declared(holder: str) -> Callable[[type], type]:
    """Class decorator, to be used below wp.struct: adds the declared arrays of a holder as fields."""

    def add(cls):
        cls.__annotations__ = dict(getattr(cls, "__annotations__", {})) | {
            v.attribute: wp.array(dtype=v.dtype, ndim=len(v.axes) + 1) for v in _of(holder)
        }
        return cls

    return add


def zeros(shape: tuple[int, ...], dtype: type, tier: str = FULL) -> wp.array:
    """An array [item, world] on the current device. In the condensed tier, where a block of threads has one
    world, the numbers of a world are contiguous; in the full tier, where neighbouring threads have
    neighbouring worlds, those of an item."""
    if tier == CONDENSED and len(shape) == 2 and min(shape) > 1:
        return wp.zeros(shape[::-1], dtype=dtype).transpose()
    return wp.zeros(shape, dtype=dtype)


def allocate(
    holder: str,
    owner: typing.Any,
    sizes: dict[str, int],
    options: Iterable[str] = (),
    tier: str = FULL,
) -> None:
    """Makes the arrays of a holder on the current device, with the values of a reset; arrays that `options`
    do not add have no items.

    Args:
      sizes: of the axes by name, and of "world". tier: of the skin, for `zeros`.
    """
    for v in _of(holder):
        shape = [sizes[axis] for axis in (*v.axes, "world")]
        if v.axes and not v.is_there(options):
            shape[0] = 0
        array = zeros(tuple(shape), v.dtype, tier)
        if array.size and isinstance(v.reset, (int, float)) and v.reset:
            array.fill_(v.reset)
        path, _, name = v.attribute.rpartition(".")
        setattr(operator.attrgetter(path)(owner) if path else owner, name, array)


def clear(holder: str, owner: typing.Any, data: typing.Any) -> None:
    """Resets the arrays of a holder in all worlds, except the history of rubber (`RubberMemory.forget`)."""
    for v in _of(holder):
        array = operator.attrgetter(v.attribute)(owner)
        if v.reset is None or v.reset == "virgin" or not array.size:
            continue
        if isinstance(v.reset, str):
            value = getattr(data, v.reset).numpy()
            if v.reset == "rest_pressure":
                value = np.where(data.worlds.kappa.numpy() == 0, 0.0, value)
            array.assign(np.ascontiguousarray(np.broadcast_to(value, array.numpy().shape)))
        else:
            array.fill_(v.reset)


class SavedState(types.SimpleNamespace):
    """State of one world on the host, by the names of `VARIABLES`: arrays without the axis of worlds,
    numbers, and tables (k, n), whose rows have the index of an item and the values of the table's variables.
    `contacts` (k, 5) has sample, geom and anchor (in the geom's frame) [m] of touching samples."""

    def replace(self, **changes: typing.Any) -> typing.Self:
        """A state with some values replaced."""
        return type(self)(**(vars(self) | changes))


def variables_of(tier: str, options: Iterable[str]) -> list[Variable]:
    """Variables of a tier with these options."""
    return [v for v in VARIABLES if tier in v.tiers and v.is_there(options)]


def saved_variables(tier: str, options: Iterable[str]) -> tuple[list[Variable], dict[str, list[Variable]]]:
    """Saved variables of a tier: those outside tables, and those of each table by its name."""
    found = [v for v in variables_of(tier, options) if v.is_saved(tier)]
    rows = {}
    for v in found:
        if v.rows:
            rows.setdefault(v.rows, []).append(v)
    return [v for v in found if not v.rows], rows


class StateLayout:
    """Layout of a saved state as a row of numbers.

    Args:
      tier: FULL or CONDENSED. options: see `options_of`.
      sizes: of the axes by name, except those of tables.
      room: most rows of the tables by name; None: those of the plugin state, `ROOM`.

    Attributes:
      size: number of numbers. slices: of each variable and table.
      of_steps, of_skin: names of variables outside tables that a skin keeps, and does not keep, when it is
        reset to rest by itself.
      columns: numbers in a row of each table.
    """

    def __init__(
        self, tier: str, options: Iterable[str], sizes: dict[str, int], room: dict[str, int] | None = None
    ):
        variables, rows = saved_variables(tier, options)
        self._shapes = {v.name: tuple(sizes[axis] for axis in v.axes) + v.item for v in variables}
        self._rest = {v.name: v.reset for v in variables}
        self.of_steps = tuple(v.name for v in variables if v.outlives_rest)
        self.of_skin = tuple(v.name for v in variables if not v.outlives_rest)
        self.columns = {name: _columns(of) for name, of in rows.items()}
        self._room = room or {name: ROOM[name][tier] for name in rows}
        counts = {name: int(np.prod(shape)) for name, shape in self._shapes.items()}
        self._used = sum(counts.values())  # the tables follow, and are mostly empty
        counts |= {name: 1 + self._room[name] * n for name, n in self.columns.items()}
        ends = np.cumsum(list(counts.values())).tolist()
        self.slices = {
            name: slice(end - count, end) for (name, count), end in zip(counts.items(), ends, strict=True)
        }
        self.size = ends[-1]

    def part(self, state: np.ndarray, name: str) -> np.ndarray:
        """View of the numbers of a variable in a state (size,)."""
        return state[self.slices[name]]

    def table(self, state: np.ndarray, name: str) -> np.ndarray:
        """View (most rows, n) of a table in a state (size,)."""
        return self.part(state, name)[1:].reshape(-1, self.columns[name])

    def rows(self, state: np.ndarray, name: str) -> np.ndarray:
        """View (k, n) of a table's rows in a state (size,)."""
        return self.table(state, name)[: int(self.part(state, name)[0])]

    def value(self, state: np.ndarray, name: str) -> np.ndarray | float:
        """A variable or a table of a state (size,): a view, or a number."""
        if name in self.columns:
            return self.rows(state, name)
        shape, part = self._shapes[name], state[self.slices[name]]
        return part.reshape(shape) if shape else float(part[0])

    def rest(self) -> np.ndarray:
        """State (size,) after a reset; variables whose reset is no number are zero."""
        out = np.zeros(self.size)
        for name, value in self._rest.items():
            if isinstance(value, (int, float)) and np.isfinite(value):
                self.part(out, name)[:] = value
        return out

    def read(self, state: np.ndarray) -> SavedState:
        """The saved state of a state (size,), as views of it."""
        return SavedState(**{name: self.value(state, name) for name in self.slices})

    def write(self, saved: SavedState, state: np.ndarray) -> None:
        """Inverse of `read`. Missing values and unused rows of tables are unchanged.

        Raises:
          ValueError: more rows than a table can have.
        """
        for name, value in vars(saved).items():
            begin, value = self.slices[name].start, np.asarray(value)
            if name in self.columns:
                self.check_room(name, len(value))
                state[begin] = len(value)
                begin += 1
            state[begin : begin + value.size] = value.ravel()

    def check_room(self, name: str, count: int) -> None:
        """Raises ValueError for more rows than a table can have."""
        if count > self._room[name]:
            raise ValueError(
                f"{count} contact samples touch, the state holds {self._room[name]}: does a body "
                "swallow the finger (sizes are in metres)? Else take a coarser skin, or fewer samples= "
                "in options['skin']"
            )

    def key(self, state: np.ndarray) -> bytes:
        """Bytes of a state without unused rows, as a key."""
        return state[: self._used].tobytes() + b"".join(self.rows(state, n).tobytes() for n in self.columns)


def _columns(variables):
    """Columns of a table: the index of an item, and the numbers of each variable. The variable that starts a
    table has one number; if it is a vector, its components are the items."""
    first = next(i for i, v in enumerate(variables) if v.starts)
    of = [variables[first]]
    for v in variables[first + 1 :]:
        if v.starts:
            break
        of.append(v)
    each = int(np.prod(of[0].item))
    return 2 + sum(int(np.prod(v.item)) // each for v in of[1:])
