"""Export to the directory layout of LeRobotDataset v3.0 (Parquet and JSON) with pyarrow only; the skin's
nodes stay in HDF5.

An interaction is an episode. Layout as `lerobot` 0.4 reads it: meta/info.json, meta/stats.json,
meta/tasks.parquet, meta/episodes/chunk-000/file-000.parquet and data/chunk-000/file-000.parquet."""

import json
import pathlib
from collections.abc import Sequence

import numpy as np
import tqdm

from ..fields import check_choice
from ..files import refuse_existing, replacing
from ..geometry.design import SINGLES
from .schema import SPLITS

VERSION = "v3.0"
_FILE_MB = 100  # of one data file, lerobot's default
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_CONTACT = {"pos": ("x", "y", "z"), "normal": ("x", "y", "z"), "depth": ("depth",), "area": ("area",)}
_WRENCH = ("fx", "fy", "fz", "tx", "ty", "tz")
_REAL = ("recorded", "resimulated")  # kinds with measured counts of a real sensor
_INDEX = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_STATS = ("min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99")


def export_lerobot(
    data: pathlib.Path | str,
    out: pathlib.Path | str,
    counts: str = "counts",
    progress: bool = True,
    rate: float | None = None,
) -> pathlib.Path:
    """Writes the folder `out` (built under another name, then renamed).

    Features: observation.state (pose of the object's frame, 7), observation.tactile.electrodes (those of the
      design), .pdc, .tdc, .tac (1 each), .pac (of a frame, or the latest if the set has no more) [counts],
      observation.force (6, of the skin on the object, in the BioTac frame, the torque about its origin; of a
      recording in the file's frame) [N, N m], observation.contact.pos, .normal (3), .depth and .area (1; all
      0 without contact: LeRobot normalises every row), action (7), the pose at the next time step, and
      converged, if the set has it: false where the skin kept its last good state.
    The task names action and object: "press with ring_7mm". `source.json` maps each episode to its
    interaction, so that (episode_index, frame_index) leads to the nodes in the HDF5 shards.

    Args:
      data: TactileSet with poses.
      counts: "counts" for simulated readings of all interactions, "measured_counts" for those of interactions
        that have measured ones.
      rate: [Hz] of the frames, which take the nearest row. None: the set's own, if its clock is even, or that
        of a recording with missing rows.

    Episodes are in the order train, validation, test, and meta/info.json has the set's splits.

    Raises:
      ValueError: no poses or counts in the set, nothing to export, uneven time steps, a single row without a
        rate, or an existing folder.
      ImportError: no pyarrow; the text says how to get it.
    """
    _pyarrow()
    recorded = counts == "measured_counts" and bool(np.isin(data.kind, _REAL).all())
    needed = () if recorded else ("indenter_pos", "indenter_quat", "wrench")
    chosen = interactions_to_export(data, out, counts, needed)
    with replacing(out, folder=True) as building:
        _Export(data, building, counts, chosen, recorded, rate).write(progress)
    return pathlib.Path(out)


def interactions_to_export(
    data: "TactileSet",  # noqa: F821 - of the store, which opens files
    out: pathlib.Path | str,
    counts: str,
    needed: Sequence[str],
) -> np.ndarray:
    """Numbers of the interactions that have counts, in the order train, validation, test.

    Raises:
      ValueError: `out` exists, or the set is unfinished or lacks counts or needed columns.
    """
    refuse_existing(out)
    if data.unfinished:
        raise ValueError(
            f"{data.path} is unfinished ({data.unfinished}): run its `biotac data generate` again, which "
            "goes on"
        )
    check_choice("unknown counts", counts, ("counts", "measured_counts"))
    for name in (counts, *needed):
        data[name]  # raises if it is missing
    chosen = np.flatnonzero(data.labelled) if counts == "measured_counts" else np.arange(len(data))
    if not len(chosen):
        raise ValueError(f"no interaction of {data.path} has {counts}: there is nothing to export")
    return np.concatenate([chosen[data.split[chosen] == name] for name in SPLITS])


def _pyarrow():
    try:
        import pyarrow
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        raise ImportError("the LeRobot export needs pyarrow: pip install 'biotac-mj[lerobot]'") from None
    return pyarrow


class _Export:
    def __init__(self, data, folder, counts, chosen, recorded, rate):
        self.data, self.folder, self.counts, self.chosen = data, folder, counts, chosen
        self.recorded = recorded
        self.fps, self.even = self._rate(rate)
        self.pac = {"counts": "pac", "measured_counts": "measured_pac"}[counts]
        whole = self.pac in data.columns and np.isfinite(data[self.pac][self.data.steps(chosen)]).all()
        self.pac = self.pac if whole else None
        pac = [f"pac{i + 1}" for i in range(data.design.npac)]
        self.features = {
            "observation.state": _feature(_POSE),
            "observation.force": _feature(self._axes()),
            **{f"observation.contact.{name}": _feature(axes) for name, axes in self._contact().items()},
            "observation.tactile.electrodes": _feature(data.design.electrodes),
            **{f"observation.tactile.{name}": _feature((name,)) for name in SINGLES},
            **({"observation.tactile.pac": _feature(pac)} if self.pac else {}),
            "action": _feature(_POSE),
        }
        if "converged" in data.columns:  # no `observation.`, which LeRobot would give to networks
            self.features["converged"] = _single("bool")
        index = {name: _single("int64") for name in _INDEX[1:]}
        self.all_features = {**self.features, "timestamp": _single("float32"), **index}
        tasks = [f"{kind} with {name}" for kind, name in zip(data.kind[chosen], data.object[chosen])]
        self.tasks = sorted(set(tasks))
        self.task = [self.tasks.index(task) for task in tasks]
        if recorded:  # not simulated: columns with missing rows are no features
            episodes = [self._episode(number, int(i), 0) for number, i in enumerate(chosen)]
            for name in list(self.features):
                if not all(np.isfinite(one[name]).all() for one in episodes):
                    del self.features[name], self.all_features[name]

    def _contact(self):
        """Names of the contact's numbers that the set has."""
        return {name: axes for name, axes in _CONTACT.items() if f"contact_{name}" in self.data.columns}

    def _axes(self):
        """Names of the force's numbers: three for a recording without torques."""
        if not self.recorded or "measured_wrench" not in self.data.columns:
            return _WRENCH
        return _WRENCH if np.isfinite(self.data["measured_wrench"][:][:, 3:]).any() else _WRENCH[:3]

    def _rate(self, wanted):
        """Frames per second, and whether rows can be used as frames."""
        steps = [np.diff(self.data["time"][self.data.start[i] : self.data.stop[i]]) for i in self.chosen[:50]]
        step = np.concatenate(steps)
        # a real clock jitters; half a step off means a missing row
        shaken = 0.5 * np.median(step) if self.recorded and len(step) else 1e-4
        even = len(step) > 0 and np.ptp(step) <= shaken
        if not len(step) and wanted is None:
            raise ValueError("one row is too few to tell the frame rate by: give it with --rate")
        if not even and wanted is None and not (self.recorded and len(step)):
            raise ValueError(
                "the time steps of the set are not even: LeRobot's layout has one frame rate; "
                "give it with --rate, frames hold the nearest rows"
            )
        own = 1 / (step.mean() if even else np.median(step)) if len(step) else wanted
        tolerance = 1e-2 if self.recorded else 1e-3  # tolerance for a real clock
        own = int(round(own)) if abs(own - round(own)) < tolerance * own else float(own)
        if wanted is None:
            return own, even
        return int(wanted) if wanted == int(wanted) else wanted, even and wanted == own

    def write(self, progress):
        pa, rows, episodes, moments = _pyarrow(), [], [], []
        first, file_index, size = 0, 0, 0
        for number, i in enumerate(
            tqdm.tqdm(
                self.chosen, desc="export", unit="interaction", disable=not progress or None, leave=False
            )
        ):
            columns = self._episode(number, int(i), first)
            n = len(columns["index"])
            rows.append(columns)
            size += sum(value.nbytes for value in columns.values())
            statistics = {name: _statistics(value) for name, value in columns.items()}
            moments.append(statistics)
            episodes.append(self._row(number, n, first, file_index, statistics))
            first += n
            if size > _FILE_MB * 2**20 or number == len(self.chosen) - 1:
                self._parquet(f"data/{_chunk(file_index)}", self._table(pa, rows))
                rows, size, file_index = [], 0, file_index + 1
        self._parquet(f"meta/episodes/{_chunk(0)}", pa.Table.from_pylist(episodes))
        self._tasks(pa)
        self._json(
            "meta/stats.json", {name: _merge([m[name] for m in moments]) for name in self.all_features}
        )
        self._json("meta/info.json", self._info(len(episodes), first))
        source = {
            "set": self.data.path.name,
            "interaction": self.data.id[self.chosen].tolist(),
            "counts": self.counts,
            "frame": self.data.frame,
            "force": "as recorded" if self.recorded else "of the skin on the object",
        }
        synthetic = not self.recorded
        self._json("source.json", source | {"synthetic": synthetic, "versions": self.data.versions})

    def _episode(self, number, i, first):
        """Columns of one episode: name -> (n, k) or (n,)."""
        data = self.data
        rows = self._rows(i)
        n = len(rows)
        columns = [self._column(f"indenter_{name}", rows, k) for name, k in (("pos", 3), ("quat", 4))]
        pose = np.concatenate(columns, axis=1)
        pose = pose.astype(np.float32)
        wrench = "measured_wrench" if self.recorded else "wrench"
        counts = data[self.counts][rows].astype(np.float32)
        out = {
            "observation.state": pose,
            "observation.force": self._column(wrench, rows, 6)[:, : len(self._axes())].astype(np.float32),
            **{f"observation.contact.{name}": self._touch(name, rows) for name in self._contact()},
            "observation.tactile.electrodes": counts[:, : -len(SINGLES)],
            **{f"observation.tactile.{name}": counts[:, k - len(SINGLES)] for k, name in enumerate(SINGLES)},
            **({"observation.tactile.pac": data[self.pac][rows].astype(np.float32)} if self.pac else {}),
            "action": pose[np.minimum(np.arange(1, n + 1), n - 1)],
            "converged": data["converged"][rows] if "converged" in self.features else None,
            "timestamp": (np.arange(n) / self.fps).astype(np.float32),
            "frame_index": np.arange(n),
            "episode_index": np.full(n, number),
            "index": first + np.arange(n),
            "task_index": np.full(n, self.task[number]),
        }
        return {name: out[name] for name in self.all_features}

    def _rows(self, i):
        """(n,) rows of the set for the frames of interaction i."""
        rows = np.arange(self.data.start[i], self.data.stop[i])
        if self.even:
            return rows
        time = self.data["time"][rows] - self.data["time"][rows[:1]]
        due = np.arange(int(np.floor(time[-1] * self.fps + 1e-6)) + 1) / self.fps
        after = np.clip(np.searchsorted(time, due), 1, max(len(time) - 1, 1))
        return rows[np.where(due - time[after - 1] <= time[after % len(time)] - due, after - 1, after)]

    def _column(self, name, rows, width):
        """(n, width) of a column; NaN if the set has none."""
        if name in self.data.columns:
            return self.data[name][rows]
        return np.full((len(rows), width), np.nan)

    def _touch(self, name, rows):
        """(n, k) or (n,) of the contact; 0 without: LeRobot normalises all rows."""
        value = self.data[f"contact_{name}"][rows].astype(np.float32)
        return value if self.recorded else np.nan_to_num(value)

    def _row(self, number, n, first, file_index, statistics):
        row = {
            "episode_index": number,
            "tasks": [self.tasks[self.task[number]]],
            "length": n,
            "data/chunk_index": file_index // 1000,
            "data/file_index": file_index % 1000,
            "dataset_from_index": first,
            "dataset_to_index": first + n,
        }
        row |= {
            f"stats/{name}/{key}": statistics[name][key].tolist() for name in statistics for key in _STATS
        }
        return row | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}

    def _table(self, pa, rows):
        arrays = []
        for name, feature in self.all_features.items():
            kind, width = pa.type_for_alias(feature["dtype"]), feature["shape"][0]
            flat = pa.array(np.concatenate([r[name] for r in rows]).ravel(), kind)
            arrays.append(flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width))
        return pa.Table.from_arrays(arrays, names=list(self.all_features))

    def _tasks(self, pa):
        """The tasks' texts are the index of a pandas frame, as the metadata that pandas reads says."""
        table = pa.table({"task_index": pa.array(range(len(self.tasks)), pa.int64()), "task": self.tasks})
        text = dict(field_name="task", name="task", pandas_type="unicode", numpy_type="object", metadata=None)
        pandas = {
            "index_columns": ["task"],
            "column_indexes": [],
            "columns": [text],
            "pandas_version": "2.0.0",
        }
        self._parquet("meta/tasks", table.replace_schema_metadata({"pandas": json.dumps(pandas)}))

    def _info(self, episodes, frames):
        return {
            "codebase_version": VERSION,
            "robot_type": "biotac_mj",
            "total_episodes": episodes,
            "total_frames": frames,
            "total_tasks": len(self.tasks),
            "chunks_size": 1000,
            "data_files_size_in_mb": _FILE_MB,
            "video_files_size_in_mb": 200,
            "fps": self.fps,
            "splits": self._splits(),
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": None,
            "features": self.all_features,
        }

    def _splits(self):
        """Ranges of episodes, one split after the other."""
        split, out, begin = self.data.split[self.chosen], {}, 0
        for name in SPLITS:
            count = int((split == name).sum())
            if count:
                out[name] = f"{begin}:{begin + count}"
            begin += count
        return out

    def _parquet(self, name, table):
        import pyarrow.parquet as parquet

        path = self.folder / f"{name}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(table, path, compression="snappy")

    def _json(self, name, value):
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(value, indent=4) + "\n")


def _chunk(number):
    return f"chunk-{number // 1000:03d}/file-{number % 1000:03d}"


def _feature(names):
    return {"dtype": "float32", "shape": [len(names)], "names": list(names)}


def _single(kind):
    return {"dtype": kind, "shape": [1], "names": None}


def _statistics(value):
    """Statistics of a column (n, k) or (n,): each (k,) or (1,)."""
    value = np.asarray(value, float).reshape(len(value), -1)
    quantile = np.quantile(value, (0.01, 0.10, 0.50, 0.90, 0.99), axis=0)
    return {
        "min": value.min(0),
        "max": value.max(0),
        "mean": value.mean(0),
        "std": value.std(0),
        "count": np.array([len(value)]),
        **dict(zip(_STATS[5:], quantile)),
    }


def _merge(moments):
    """Statistics of all episodes; mean and standard deviation are exact, quantiles are means of the episodes'
    (as in lerobot)."""
    count = np.array([p["count"][0] for p in moments], float)[:, None]
    mean = np.array([p["mean"] for p in moments])
    total = (count * mean).sum(0) / count.sum()
    square = np.array([p["std"] for p in moments]) ** 2 + (mean - total) ** 2
    variance = (count * square).sum(0) / count.sum()
    out = {
        "min": np.min([p["min"] for p in moments], 0),
        "max": np.max([p["max"] for p in moments], 0),
        "mean": total,
        "std": np.sqrt(variance),
    }
    out |= {key: (count * np.array([p[key] for p in moments])).sum(0) / count.sum() for key in _STATS[5:]}
    return {key: value.tolist() for key, value in out.items()} | {"count": [int(count.sum())]}
