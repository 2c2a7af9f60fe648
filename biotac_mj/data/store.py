"""A data set on disk: a folder of HDF5 shards. `write_shard` writes one; `TactileSet` reads all of them as
one array."""

import bisect
import json
import pathlib
from collections.abc import Sequence

import h5py
import numpy as np
from numpy.typing import ArrayLike

from ..files import hdf5
from ..geometry.design import BIOTAC, Design, designs, read_design
from ..geometry.skin_geometry import STORED, SkinGeometry
from ..reading import Array, Unfit, check_arrays, reading
from ..versions import versions
from .schema import (
    COLUMNS,
    DISPLACEMENT_SCALE,
    KINDS,
    MAY_LACK,
    SCHEMA,
    SPLITS,
    Interaction,
    channel_sizes,
    frame_of,
    nodes_of,
)

_GEOMETRY = tuple(name for name in STORED if name != "name")
_TABLE = (
    "id",
    "object",
    "kind",
    "split",
    "seed",
    "labelled",
    "parameters",
    "start",
    "stop",
)  # of each interaction
_TEXT = ("id", "object", "kind", "split", "parameters")
_TYPES = dict.fromkeys(_TEXT, "text") | {"labelled": "flag", "seed": "number"}
_AGAIN = "generate or import it again"
_REMEDY = "it is damaged, or another file; delete it and run the command again"


def shard_path(folder: pathlib.Path | str, number: int) -> pathlib.Path:
    """Path of shard `number` of a set."""
    return pathlib.Path(folder) / f"shard-{number:05d}.h5"


def write_shard(
    path: pathlib.Path | str,
    interactions: Sequence[Interaction],
    geometry: SkinGeometry | None = None,
    attributes: dict | None = None,
    design: Design = BIOTAC,
) -> None:
    """Writes one shard (to a temporary name, then renamed). Its bytes depend only on the arguments and the
    versions.

    Args:
      path: see `shard_path`.
      interactions: Interactions that all have the same columns.
      geometry: the skin of displacement and contact_force; None without these.
      attributes: common to all: material, element, tier, device, settings; JSON types.
      design: of the sensor if there is no skin, which has its own.

    Raises:
      ValueError: no interactions, an invalid one (see `Interaction.check`), different columns, a duplicate
        name, or a displacement beyond 8.19 mm.
    """
    interactions = list(interactions)
    if not interactions:
        raise ValueError(f"there are no interactions to write to {path}: a shard needs at least one")
    outer, skin = None, (None, None)
    if geometry is not None:
        outer, design = nodes_of(geometry), geometry.design
        skin = geometry.nvert, len(outer)
    for one in interactions:
        one.check(*skin, design)
    names = [one.id for one in interactions]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"interaction {twice!r} occurs twice in {path}: give every interaction its own id")
    columns = [name for name in COLUMNS if getattr(interactions[0], name) is not None]
    for one in interactions:
        if [name for name in COLUMNS if getattr(one, name) is not None] != columns:
            raise ValueError(
                f"interaction {one.id!r} has other columns than {interactions[0].id!r}: "
                "write them to different sets"
            )
    length = np.array([len(one.time) for one in interactions])
    stop = np.cumsum(length)
    with hdf5(path, track_order=True) as file:
        file.attrs.update(
            {
                "schema": SCHEMA,
                "frame": frame_of(one.parameters for one in interactions),
                "channels": design.channels,
            }
        )
        if geometry is None and design not in designs():
            file.attrs["design"] = design.text
        file.attrs["attributes"] = json.dumps(attributes or {}, sort_keys=True)
        file.attrs["versions"] = json.dumps(versions(), sort_keys=True)
        table = file.create_group("interaction", track_order=True)
        values = {
            name: [getattr(one, name) for one in interactions]
            for name in ("id", "object", "kind", "split", "seed", "labelled")
        }
        values |= {
            "parameters": [json.dumps(one.parameters, sort_keys=True) for one in interactions],
            "start": stop - length,
            "stop": stop,
        }
        for name in _TABLE:
            table[name] = np.array(values[name], dtype=h5py.string_dtype() if name in _TEXT else None)
        steps = file.create_group("step", track_order=True)
        for name in columns:
            _write_column(steps, name, [getattr(one, name) for one in interactions], length)
        if geometry is not None:
            group = file.create_group("geometry", track_order=True)
            group.attrs["name"], group.attrs["design"] = geometry.name, geometry.design.text
            for name in _GEOMETRY:
                group.create_dataset(name, data=getattr(geometry, name), compression="gzip", shuffle=True)
            group["outer_node"] = outer


def _write_column(steps, name, pieces, length):
    shape, kind, unit = COLUMNS[name]
    if name == "displacement":
        pieces = [_integers(piece) for piece in pieces]
    value = np.concatenate([np.asarray(piece) for piece in pieces]).astype(kind)
    wide = value.ndim > 1 and value[0].size > 64
    chunks = (int(min(length.max(), len(value))), *value.shape[1:]) if wide else True
    steps.create_dataset(
        name, data=value, chunks=chunks, compression="gzip", compression_opts=2, shuffle=True
    )
    steps[name].attrs["unit"] = unit
    steps[name].attrs["scale"] = DISPLACEMENT_SCALE if name == "displacement" else 1.0


def _integers(displacement):
    units = np.rint(np.asarray(displacement) / DISPLACEMENT_SCALE)
    if np.abs(units).max(initial=0) > 32767:
        raise ValueError(
            f"a node is displaced by {np.abs(displacement).max() * 1e3:.2f} mm: the store reaches 8.19 mm; "
            "check units (metres) and the run"
        )
    return units.astype(np.int16)


class Column:
    """One column of all shards, read on indexing: `column[3]`, `column[10:20]`, `column[mask]`,
    `column[indices]`.

    Attributes:
      name; shape (nstep, ...); dtype of the result of indexing.
    """

    def __init__(self, name: str, pieces: list, shape: tuple, offsets: np.ndarray):
        self.name, self._pieces, self._offsets = name, pieces, offsets
        self.shape = shape
        self.dtype = (
            np.dtype("f4")
            if name == "displacement"
            else np.dtype(bool if name == "converged" else COLUMNS[name][1])
        )

    def __len__(self):
        return self.shape[0]

    def __getitem__(self, index):
        scalar = isinstance(index, (int, np.integer))
        wanted = np.arange(len(self))[index]  # numpy's rules and errors
        wanted = np.atleast_1d(wanted)
        out = np.empty((len(wanted), *self.shape[1:]), self.dtype)
        home = np.searchsorted(self._offsets, wanted, side="right") - 1
        for k in np.unique(home):
            mine = np.flatnonzero(home == k)
            out[mine] = self._read(k, wanted[mine] - self._offsets[k])
        return out[0] if scalar else out

    def _read(self, k, rows):
        piece = self._pieces[k]
        if piece is None:
            return np.full((len(rows), *self.shape[1:]), np.nan, self.dtype)
        low, high = int(rows.min()), int(rows.max()) + 1
        path = piece.file.filename
        with reading(path, "readable shard", _REMEDY):
            if high - low == len(rows):  # contiguous
                value = piece[low:high]
                value = value if (np.diff(rows) > 0).all() else value[rows - low]
            else:
                ordered, inverse = np.unique(rows, return_inverse=True)
                value = np.concatenate([piece[a:b] for a, b in _runs(ordered)])[inverse]
            if self.name not in MAY_LACK:
                check_arrays(path, {self.name: value}, {self.name: Array((None,) * value.ndim)}, _AGAIN)
        return value * np.float32(DISPLACEMENT_SCALE) if self.name == "displacement" else value


def _runs(rows):
    """Contiguous ranges (first, beyond) of sorted numbers: HDF5 reads them a hundred times faster than single
    rows."""
    cut = np.flatnonzero(np.diff(rows) > 1)
    return zip(rows[np.r_[0, cut + 1]].tolist(), (rows[np.r_[cut, len(rows) - 1]] + 1).tolist())


class TactileSet:
    """All shards of a data set as one. Use it as a context, or `close` it.

        with TactileSet("out/set") as data:
            train = data.steps(np.flatnonzero(data.split == "train"))
            x, y = data["displacement"][train], data["counts"][train]

    Args:
      path: folder of shards, or one shard.

    Attributes:
      path; geometry: SkinGeometry, or None; design: of the sensor; attributes, versions: dicts of the first
        shard.
      id, object, kind, split: (n,) str; seed (n,) int; labelled (n,) bool; start, stop (n,) int: of each
        interaction, its time steps are start..stop-1 of every column.
      columns: names of the columns in the set; "measured_counts" and "measured_wrench" are NaN in
        interactions without a label.

    Raises:
      FileNotFoundError: no such folder or file, or no shards in it.
      ValueError: a file that is not a shard, of another schema, or shards of different sets.
    """

    def __init__(self, path: pathlib.Path | str):
        self.path = pathlib.Path(path)
        files = sorted(self.path.glob("shard-*.h5")) if self.path.is_dir() else [self.path]
        if not files or not files[0].is_file():
            raise FileNotFoundError(
                f"no shards (shard-*.h5) at {self.path}: "
                "make a set with `biotac data generate` or `biotac data import`"
            )
        self._files = []
        try:
            for name in files:
                self._files.append(_open(name))
            self._read_tables()
        except BaseException:
            self.close()
            raise

    def _read_tables(self):
        first = self._files[0]
        self.attributes, self.versions = (
            json.loads(first.attrs.get(name, "{}")) for name in ("attributes", "versions")
        )
        self.geometry, self.design = _geometry(first.filename, first), _design(first)
        self.columns = tuple(name for name in COLUMNS if any(name in f["step"] for f in self._files))
        for file in self._files[1:]:
            missing = [
                c
                for c in self.columns
                if not c.startswith("measured") and (c in first["step"]) != (c in file["step"])
            ]
            if missing or not _same_skin(first, file):
                what = f"columns {', '.join(missing)}" if missing else "skin"
                raise ValueError(
                    f"{file.filename} differs from {first.filename} in its {what}: "
                    "keep different sets in different folders"
                )
        nstep = [len(f["step/time"]) for f in self._files]
        self._offsets = np.concatenate([[0], np.cumsum(nstep)])
        self.nstep = int(self._offsets[-1])
        for name in ("id", "object", "kind", "split"):
            setattr(
                self,
                name,
                np.concatenate([f["interaction"][name].asstr()[:] for f in self._files]).astype(str),
            )
        self.seed = np.concatenate([f["interaction/seed"][:] for f in self._files])
        self.labelled = np.concatenate([f["interaction/labelled"][:] for f in self._files]).astype(bool)
        for name in ("start", "stop"):
            value = [f["interaction"][name][:] + offset for f, offset in zip(self._files, self._offsets)]
            setattr(self, name, np.concatenate(value).astype(np.int64))
        names, count = np.unique(self.id, return_counts=True)
        if (count > 1).any():
            raise ValueError(
                f"interaction {str(names[count > 1][0])!r} occurs in two shards of {self.path}: "
                "delete the one of an earlier run"
            )

    @property
    def frame(self) -> str:
        """Frame of poses and forces, see `frame_of`."""
        texts = [text for f in self._files for text in f["interaction/parameters"].asstr()[:]]
        return frame_of(map(json.loads, texts))

    @property
    def unfinished(self) -> str:
        """Missing content of a generated set, "" if it is complete."""
        settings = self.attributes.get("settings")
        wanted = settings.get("count") if isinstance(settings, dict) else None
        short = self.path.is_dir() and isinstance(wanted, int) and len(self) < wanted
        return f"{len(self)} of {wanted} interactions" if short else ""

    def __len__(self):
        return len(self.id)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self) -> None:
        """Closes the files; afterwards nothing can be read."""
        for file in self._files:
            file.close()

    @property
    def rest_vert(self) -> np.ndarray:
        """(nvert, 3) reference positions of the displacements [m]."""
        return self._skin().vert

    @property
    def outer_node(self) -> np.ndarray:
        """(nouter,) nodes of `contact_force`."""
        return nodes_of(self._skin())

    def _skin(self):
        if self.geometry is None:
            raise ValueError(
                f"{self.path} has no skin: it holds recordings only; use a set made by `biotac data generate`"
            )
        return self.geometry

    def __getitem__(self, name) -> Column:
        """A column of all time steps, read lazily; see `schema.COLUMNS`.

        Raises:
          ValueError: the set has no such column.
        """
        if name not in self.columns:
            raise ValueError(f"{self.path} has no column {name!r}: it has {', '.join(self.columns)}")
        pieces = [f["step"].get(name) for f in self._files]
        shape = next(p for p in pieces if p is not None).shape[1:]
        return Column(name, pieces, (self.nstep, *shape), self._offsets[:-1])

    def vert_xpos(self, index: int | slice | np.ndarray) -> np.ndarray:
        """(..., nvert, 3) float32 positions of the nodes at time steps [m]."""
        rest = self.rest_vert.astype(np.float32)
        return self["displacement"][index] + rest

    def steps(self, interactions: ArrayLike) -> np.ndarray:
        """Time steps (k,) of interactions, given by number or mask."""
        chosen = np.atleast_1d(np.arange(len(self))[interactions])
        return np.concatenate([np.arange(self.start[i], self.stop[i]) for i in chosen] or [np.zeros(0, int)])

    def owner(self) -> np.ndarray:
        """(nstep,) number of the interaction of each time step."""
        return np.repeat(np.arange(len(self)), self.stop - self.start)

    def parameters(self, i: int) -> dict:
        """Parameters of the generation of interaction i."""
        k = bisect.bisect_right(self._offsets.tolist(), int(self.start[i])) - 1
        file = self._files[k]
        row = int(np.searchsorted(file["interaction/start"][:], self.start[i] - self._offsets[k]))
        return json.loads(file["interaction/parameters"].asstr()[row])

    def interaction(self, i: int) -> Interaction:
        """Interaction i with all columns."""
        i = range(len(self))[i]
        rows = slice(self.start[i], self.stop[i])
        columns = {
            name: self[name][rows]
            for name in self.columns
            if self.labelled[i] or not name.startswith("measured")
        }
        return Interaction(
            str(self.id[i]),
            str(self.object[i]),
            str(self.kind[i]),
            str(self.split[i]),
            int(self.seed[i]),
            self.parameters(i),
            **columns,
        )


def _open(path):
    with reading(path, "readable shard", _REMEDY):
        file = h5py.File(path)
    try:
        with reading(path, "readable shard", _REMEDY):
            _check(path, file)
    except BaseException:
        file.close()
        raise
    return file


def _check(path, file):
    """Raises ValueError for a file that is not a shard: schema, names, types, shapes and numbers of rows.
    Columns are checked when they are read."""
    schema = file.attrs.get("schema")
    if schema != SCHEMA:
        raise Unfit(f"{path} has schema {schema!r}: this version reads {SCHEMA!r}; {_AGAIN}")
    design = _design(file)
    if design is None:
        wanted = " or ".join(" ".join(one.channels) for one in _known(file))
        raise Unfit(
            f"{path} has its channels in the order {' '.join(_channels(file))}: "
            f"{wanted} is needed; reorder the counts"
        )
    for name in ("attributes", "versions"):
        if not isinstance(json.loads(file.attrs.get(name, "{}")), dict):
            raise Unfit(f"attribute {name} of {path} is no dict: {_AGAIN}")
    flat = {}
    for group in ("interaction", "step", *(("geometry",) if "geometry" in file else ())):
        if not isinstance(file.get(group), h5py.Group):
            raise Unfit(f"{path} has no group {group}: {_AGAIN}")
        flat |= {f"{group}/{name}": file[group][name] for name in file[group]}
    wanted = {f"interaction/{name}": Array(("k",), _TYPES.get(name, "index")) for name in _TABLE}
    sizes = channel_sizes(design)
    if "geometry" in file:
        stored = {name: array for name, array in STORED.items() if name != "name"}
        wanted |= {f"geometry/{name}": array for name, array in stored.items()}
        first = {"geometry/vert": Array(("nvert", 3)), "geometry/outer_face": STORED["outer_face"]}
        check_arrays(path, flat, first, _AGAIN, sizes)
        sizes["nouter"] = len(np.unique(flat["geometry/outer_face"][:]))
    for name, (shape, _, _) in COLUMNS.items():
        if name == "time" or f"step/{name}" in flat:
            wanted[f"step/{name}"] = Array(("n", *shape), "number")
    check_arrays(path, flat, wanted, _AGAIN, sizes)
    start, stop = flat["interaction/start"][:], flat["interaction/stop"][:]
    if (
        not len(start)
        or (start >= stop).any()
        or (start != np.r_[0, stop[:-1]]).any()
        or stop[-1] != sizes["n"]
    ):
        raise Unfit(
            f"start and stop of the interactions of {path} do not divide its {sizes['n']} steps: {_AGAIN}"
        )
    if not np.isfinite(flat["step/time"][:]).all():
        raise Unfit(f"step/time of {path} has values that are not finite: {_AGAIN}")
    for text in flat["interaction/parameters"].asstr()[:]:
        if not isinstance(json.loads(text), dict):
            raise Unfit(f"interaction/parameters of {path} are no dicts: {_AGAIN}")
    for name, known in (("kind", KINDS), ("split", SPLITS)):
        strange = set(flat[f"interaction/{name}"].asstr()[:]) - set(known)
        if strange:
            raise Unfit(
                f"interaction/{name} of {path} is {min(strange)!r}: one of {', '.join(known)} is needed"
            )


def _channels(file):
    return tuple(str(name) for name in file.attrs.get("channels", ()))


def _known(file):
    """Possible designs of a shard: the named one, or without a skin the shipped ones."""
    where = file["geometry"] if "geometry" in file else file
    if "design" not in where.attrs and "geometry" not in file:
        return designs()
    return (read_design(str(where.attrs.get("design", BIOTAC.name))),)


def _design(file):
    """The design whose channels a shard has, None if there is none."""
    return next((one for one in _known(file) if one.channels == _channels(file)), None)


def _geometry(path, file):
    if "geometry" not in file:
        return None
    with reading(path, "readable shard", _REMEDY):
        group = file["geometry"]
        found = {name: group[name][:] for name in _GEOMETRY}
        check_arrays(path, found, {name: STORED[name] for name in _GEOMETRY}, _AGAIN)
        return SkinGeometry(name=str(group.attrs["name"]), **found, design=_known(file)[0])


def _same_skin(a, b):
    if ("geometry" in a) != ("geometry" in b) or _channels(a) != _channels(b):
        return False
    return "geometry" not in a or (
        a["geometry/vert"].shape == b["geometry/vert"].shape
        and (a["geometry/vert"][:] == b["geometry/vert"][:]).all()
    )
