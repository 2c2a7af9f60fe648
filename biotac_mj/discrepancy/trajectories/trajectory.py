"""Measured trajectories: poses of an object in the BioTac frame and what the sensor read meanwhile."""

import dataclasses
import pathlib

import numpy as np

from ...geometry.design import BIOTAC, SINGLES, design_of_channels
from ...quality.noise import noise_level
from ...sensor.channels import check_counts, check_force

# columns of a set's counts, from the end
_SINGLE = tuple(SINGLES.index(name) - len(SINGLES) for name in ("pdc", "tdc"))
FEWEST = 6  # fewer leave nothing to lock away and nothing to flip signs of
_STILL = 1e-6, 5e-6  # [m] from row to row that may be no motion: a count or less of the electrodes
_LEAST_TRAVEL = 0.1  # of the median step, where that is more: measured poses have noise of that size
_TREMBLE = 5.0  # times the tenth smallest step in a hundred


@dataclasses.dataclass
class Trajectory:
    """One contact. n rows, row 0 before first touch.

    Attributes:
      id: unique. tool: as `biotac data generate --objects` names it. clock: when it began in the session [s].
      time: (n,) [s]. pos: (n, 3) of the object's frame [m]; mat: (n, 3, 3).
      electrodes: (n, nelectrode) raw counts. pdc: (n,) counts or None. tdc: (n,) counts or None.
      force: (n, 3) of the skin on the object [N] or None.
      touch: row right before the touch, from which `depth` counts; those before it are of the way there.
    """

    id: str
    tool: str
    clock: float
    time: np.ndarray
    pos: np.ndarray
    mat: np.ndarray
    electrodes: np.ndarray
    pdc: np.ndarray | None = None
    tdc: np.ndarray | None = None
    force: np.ndarray | None = None
    touch: int = 0

    def __post_init__(self):
        n, what = len(self.time), f"trajectory {self.id!r}"
        shapes = {"pos": (n, 3), "mat": (n, 3, 3), "electrodes": (n, *np.shape(self.electrodes)[1:2])}
        shapes |= {"pdc": (n,), "tdc": (n,), "force": (n, 3)}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            if np.shape(value) != shape:
                raise ValueError(
                    f"{name} of {what} has shape {np.shape(value)}: {shape} is needed, one row per time"
                )
            if not np.isfinite(value).all():
                raise ValueError(
                    f"{name} of {what} has values that are not finite: cut the trajectory there, or leave it "
                    "out"
                )
        if n < 8:
            raise ValueError(f"{what} has {n} rows: at least 8 are needed, from before the touch on")
        step = np.diff(self.time)
        if not (step > 0).all():
            raise ValueError(f"the time of {what} does not increase: sort its rows and drop repeated ones")
        if step.max() > 100 * np.median(step):
            raise ValueError(
                f"the clock of {what} has a gap of {step.max():.3g} s where rows are {np.median(step):.3g} s "
                "apart: cut it in two there; what happened meanwhile cannot be guessed"
            )
        if np.abs(self.pos).max() > 0.5:
            raise ValueError(
                f"pos of {what} reaches {np.abs(self.pos).max():.3g}: metres are needed, these look like "
                "millimetres"
            )
        check_counts(self.electrodes, what)
        if self.force is not None:
            check_force(self.force, what)

    @property
    def heading(self) -> np.ndarray:
        """(3,) unit vector along which the object presses: its +y axis."""
        return self.mat[0][:, 1]

    @property
    def depth(self) -> np.ndarray:
        """(n,) travel along the heading from row `touch` [m], 0 before it."""
        depth = (self.pos - self.pos[self.touch]) @ self.heading
        return np.where(np.arange(len(depth)) < self.touch, 0.0, depth)


def read_trajectories(path: pathlib.Path | str) -> list[Trajectory]:
    """Labelled interactions of a data set (docs/howto/file_formats.md); `parameters` may hold their "clock"
    [s].

    Raises:
      FileNotFoundError, ValueError: the text names cause and remedy.
    """
    from scipy.spatial.transform import Rotation

    from ...data.store import TactileSet

    path = pathlib.Path(path)
    if not path.exists():
        raise FileNotFoundError(
            f"no measured data at {path}: give an HDF5 file or a folder of them (docs/howto/file_formats.md)"
        )
    out, clock = [], 0.0
    with TactileSet(path) as data:
        for i in range(len(data)):
            if not data.labelled[i]:
                continue
            one = data.interaction(i)
            counts, wrench = one.measured_counts, one.measured_wrench
            if one.indenter_pos is None:
                raise ValueError(
                    f"interaction {one.id!r} of {path} has no poses of the object: "
                    "without them nothing can be simulated"
                )
            mat = Rotation.from_quat(one.indenter_quat, scalar_first=True).as_matrix()
            begin = float(one.parameters.get("clock", clock))
            known = [None if np.isnan(counts[:, k]).any() else counts[:, k].astype(float) for k in _SINGLE]
            force = None if wrench is None or np.isnan(wrench[:, :3]).any() else wrench[:, :3].astype(float)
            out.append(
                Trajectory(
                    one.id,
                    one.object,
                    begin,
                    one.time - one.time[0],
                    one.indenter_pos,
                    mat,
                    counts[:, : -len(SINGLES)].astype(float),
                    *known,
                    force,
                    int(one.parameters.get("touch", 0)),
                )
            )
            clock = begin + float(one.time[-1] - one.time[0]) + 1.0
    if not out:
        raise ValueError(
            f"{path} has no measured counts: only labelled interactions can be compared with the simulation"
        )
    return out


def write_trajectories(path: pathlib.Path | str, trajectories: list[Trajectory]) -> None:
    """Writes one HDF5 file that `biotac diagnose` and `read_trajectories` read; what was not measured is
    stored as nan."""
    from scipy.spatial.transform import Rotation

    from ...data.schema import Interaction
    from ...data.store import write_shard

    rows = []
    for t in trajectories:
        n = len(t.time)
        width = t.electrodes.shape[1] + len(SINGLES)
        counts, wrench = (np.full((n, k), np.nan, np.float32) for k in (width, 6))
        counts[:, : -len(SINGLES)] = t.electrodes
        for column, values in zip(_SINGLE, (t.pdc, t.tdc)):
            if values is not None:
                counts[:, column] = values
        if t.force is not None:
            wrench[:, :3] = t.force
        quat = Rotation.from_matrix(t.mat).as_quat(scalar_first=True)
        rows.append(
            Interaction(
                t.id,
                t.tool,
                "recorded",
                "train",
                0,
                {"clock": float(t.clock), "touch": int(t.touch)},
                t.time,
                indenter_pos=t.pos,
                indenter_quat=quat,
                measured_counts=counts,
                measured_wrench=wrench,
            )
        )
    design = design_of_channels(trajectories[0].electrodes.shape[1])
    write_shard(pathlib.Path(path), rows, design=design or BIOTAC)


def measurement_noise(trajectories: list[Trajectory]) -> dict:
    """Standard deviations: electrodes (nelectrode,) [counts], pdc (1,) [counts], force (3,) [N].

    From second differences of rows while the object rests, in air or held; where there are too few of them,
    of all rows."""
    out = {}
    for name, least in (("electrodes", 2.0), ("pdc", 1.0), ("force", 0.005)):
        known = [(getattr(t, name), t) for t in trajectories if getattr(t, name) is not None]
        out[name] = _noise([(x.reshape(len(x), -1), t) for x, t in known], least) if known else None
    return out


def _still(t):
    """(n - 1,) whether the object stands still from row to row: its smallest steps are the noise of the
    measured pose."""
    step = np.abs(np.diff(t.pos, axis=0)).max(1)
    least, most = _STILL
    most = max(most, _LEAST_TRAVEL * np.median(step))
    return step < np.clip(_TREMBLE * np.percentile(step, 10), least, most)


def _noise(pairs, least):
    """(k,) standard deviations by values (n, k) and the trajectory of each."""
    rest = []
    for x, t in pairs:
        still, step = _still(t), np.diff(t.time)
        even = np.abs(np.diff(step)) < 0.2 * np.minimum(step[1:], step[:-1])
        rest.append(np.diff(x, n=2, axis=0)[still[1:] & still[:-1] & even])
    rest = np.concatenate(rest)
    if len(rest) >= 20:
        return np.maximum(np.median(np.abs(rest), axis=0) / (0.6745 * np.sqrt(6)), least)
    return np.maximum(np.median([noise_level(x, None, 1e-4) for x, _ in pairs], axis=0), least)
