"""One indentation: the path of an indenter and the measured force, from CSV or from a press's skin.h5."""

import csv
import dataclasses
import json
import pathlib

import numpy as np

from ..fields import check_entries
from ..files import replacing
from ..geometry.skin_geometry import SkinGeometry
from ..reading import Array, read_hdf5, reading
from ..recordings.formats.columns import open_bytes, parse_table
from ..sensor.channels import check_force

COLUMNS = ("time_s", "tip_x_m", "tip_y_m", "tip_z_m", "force_x_N", "force_y_N", "force_z_N")
_ORIENTATION = ("quat_w", "quat_x", "quat_y", "quat_z")
_PRESS = {"time": Array(("n",)), "force": Array(("n", 3)), "indenter_pose": Array(("n", 7))}
_REACH = 0.2  # [m] largest distance of a tip from the BioTac's origin; larger ones are not in metres


@dataclasses.dataclass(frozen=True)
class Indentation:
    """Path of an indenter that only translates, and the measured force; n samples.

    Attributes:
      name: in tables.
      indenter: as in `biotac press --indenter`.
      time: (n,) [s].
      tip: (n, 3) origin of the indenter's frame in the BioTac frame [m].
      quat: (4,) orientation of that frame, w x y z; its +y points forward.
      force: (n, 3) of the skin on the indenter [N].
      peak_norm, mean_norm: (n,) largest nodal displacement of the outer surface and its mean over the area
        [m]; None if unknown.
    """

    name: str
    indenter: str
    time: np.ndarray
    tip: np.ndarray
    quat: np.ndarray
    force: np.ndarray
    peak_norm: np.ndarray | None = None
    mean_norm: np.ndarray | None = None

    def __post_init__(self):
        n = len(self.time)
        for name, shape in dict(tip=(n, 3), quat=(4,), force=(n, 3)).items():
            value = np.asarray(getattr(self, name), float)
            if value.shape != shape:
                raise ValueError(
                    f"{name} of indentation {self.name!r} has shape {value.shape}: {shape} is needed"
                )
            if not np.isfinite(value).all():
                raise ValueError(
                    f"{name} of indentation {self.name!r} contains NaN or infinite numbers: "
                    "remove those samples"
                )
            object.__setattr__(self, name, value)
        if n < 4:
            raise ValueError(
                f"indentation {self.name!r} has {n} samples: at least 4 are needed, some of them under load"
            )
        check_force(self.force, f"indentation {self.name!r}")
        if not (np.isfinite(self.time).all() and (np.diff(self.time) > 0).all()):
            raise ValueError(
                f"time_s of indentation {self.name!r} does not increase: "
                "sort the rows and remove repeated ones"
            )
        if np.abs(self.tip).max() > _REACH:
            raise ValueError(
                f"the tip of indentation {self.name!r} is up to {np.abs(self.tip).max():g} m from the "
                "BioTac's origin: positions must be "
                "in metres (divide millimetres by 1000) and in the BioTac frame"
            )


def plan_indentation(
    indenter: str = "sphere_7mm",
    location: tuple | None = None,
    depth: float = 1.2e-3,
    slide: float = 1.2e-3,
    slide_direction: tuple | np.ndarray = (1, 0, 0),
    direction: tuple | np.ndarray | None = None,
    samples: int = 24,
    skin: str | SkinGeometry = "coarse",
) -> Indentation:
    """An indentation for simulation, with zero forces: a press from first touch of the skin at rest, then a
    slide.

    Args:
      indenter: as in `biotac press --indenter`.
      location: x [m] and angle about the finger [rad], or a point (3,) [m]; None: beside the midline of a
        finger, or the middle of a pad.
      depth, slide: travel along `direction`, then along `slide_direction` [m].
      direction: (3,); None is the skin's inward normal.
      samples: rows along the path, without the one before first touch.
      skin: the mesh for first touch.

    Raises:
      ValueError: see `press.plan_path`.
    """
    from ..geometry.skins import load_skin, place_of
    from ..press.indenter import make_indenter
    from ..press.path import PressOptions, plan_path

    geometry = skin if isinstance(skin, SkinGeometry) else load_skin(skin)
    location = place_of(geometry, (-0.010, 0.3)) if location is None else location
    largest_step = (depth + slide) / samples
    options = PressOptions(
        indenter=indenter,
        location=tuple(location),
        depth=depth,
        slide=slide,
        slide_direction=tuple(slide_direction),
        direction=direction,
        speed=largest_step,
        timestep=1.0,
        hold=0.0,
    )
    path = plan_path(geometry, make_indenter(indenter), options)
    tip = np.array([path.position(*travel) for travel in zip(path.depth, path.slid)])
    time = 0.02 * np.arange(len(tip))
    return Indentation(indenter, indenter, time, tip, path.quat, np.zeros((len(tip), 3)))


def plan_shear(
    indenter: str = "sphere_7mm",
    corners: tuple = ((1.0e-3, 0), (1.0e-3, 2.0e-3), (2.2e-3, 2.0e-3)),
    largest_step: float = 2e-4,
    **place: object,
) -> Indentation:
    """The indentation that identifies E, nu and mu, with zero forces: a light press, a slide with slip, and a
    press that compresses the skin on the core, where the force hardly depends on nu.

    Args:
      corners: (depth, slid) [m] of the tip after first touch, in sequence.
      largest_step: longest displacement between two samples [m].
      place: location, slide_direction, direction and skin as for `plan_indentation`.
    """
    plan = plan_indentation(indenter, depth=1e-3, slide=1e-3, samples=8, **place)
    axes = np.array(
        [step / np.linalg.norm(step) for step in (plan.tip[1] - plan.tip[0], plan.tip[-1] - plan.tip[-2])]
    )
    travel = [np.zeros((1, 2))]
    for corner in np.asarray(corners, float):
        at = travel[-1][-1]
        count = max(1, int(np.ceil(np.linalg.norm(corner - at) / largest_step - 1e-9)))
        travel.append(at + (corner - at) * np.arange(1, count + 1)[:, None] / count)
    tip = plan.tip[0] + np.concatenate(travel) @ axes
    return dataclasses.replace(plan, time=0.02 * np.arange(len(tip)), tip=tip, force=np.zeros_like(tip))


def read_indentation(
    path: pathlib.Path | str, indenter: str | None = None, direction: tuple | np.ndarray | None = None
) -> Indentation:
    """Reads force-deflection data.

    CSV: a header with COLUMNS (others are ignored) and a row per sample. The indenter points along
    `direction`, or has the orientation in columns quat_w to quat_z, or else points along the pad's inward
    normal, +y. A press's skin.h5 has all of it.

    Args:
      path: .csv or .h5.
      indenter: shape, required for CSV.
      direction: (3,) of the indenter's tip.

    Raises:
      FileNotFoundError: no such file.
      ValueError: a column is missing, has another unit or an invalid number; the text has its name.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"no force-deflection data at {path}: "
            f"give a CSV file with columns {', '.join(COLUMNS)}, or a press's skin.h5"
        )
    return _read_press(path, indenter) if path.suffix == ".h5" else _read_csv(path, indenter, direction)


def write_indentation(indentation: Indentation, path: pathlib.Path | str) -> None:
    """Writes COLUMNS and the orientation as CSV (to a temporary name, then renamed)."""
    n = len(indentation.time)
    rows = np.column_stack(
        [indentation.time, indentation.tip, indentation.force, np.tile(indentation.quat, (n, 1))]
    )
    with replacing(path) as temporary, open(temporary, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*COLUMNS, *_ORIENTATION])
        writer.writerows([f"{value:.9g}" for value in row] for row in rows)


def _read_csv(path, indenter, direction):
    if indenter is None:
        raise ValueError(
            f"{path} does not say what pressed: name it with --indenter, as in --indenter sphere_7mm"
        )
    table = parse_table(path, open_bytes(path), f"columns {', '.join(COLUMNS)}")
    value, quat = _columns(table, COLUMNS), _orientation(table, direction)
    return Indentation(path.stem, indenter, value[:, 0], value[:, 1:4], quat, value[:, 4:])


def _columns(table, names):
    """(n, len(names)) numbers of the columns of these names."""
    header = table.names or []
    for name in names:
        if name in header:
            continue
        stem, _, unit = name.rpartition("_")
        other = next((h for h in header if h.rpartition("_")[0] == stem or h == stem), None)
        if other:
            given = other[len(stem) :].lstrip("_") or "none"
            raise ValueError(
                f"column {other!r} of {table.path} has unit {given}: it must be {name!r}, in {unit}; "
                "convert the numbers and rename it"
            )
        raise ValueError(
            f"{table.path} has no column {name!r}: its header must have {', '.join(COLUMNS)}; "
            f"it has {', '.join(header)}"
        )
    return table.numbers([header.index(name) for name in names], list(names))


def _orientation(table, direction):
    from ..geometry.rigid import quaternion_from_y

    if direction is not None:
        direction = np.asarray(direction, float)
        if direction.shape != (3,) or not np.isfinite(direction).all() or not np.linalg.norm(direction):
            raise ValueError(
                f"direction {np.asarray(direction).tolist()} is no direction: "
                "give three numbers that are not all zero"
            )
        return quaternion_from_y(direction / np.linalg.norm(direction))
    if "quat_w" not in (table.names or []):
        return np.array([1.0, 0, 0, 0])
    quat = _columns(table, _ORIENTATION)
    if np.abs(quat - quat[0]).max() > 1e-3 or abs(np.linalg.norm(quat[0]) - 1) > 1e-3:
        raise ValueError(
            f"the quaternions of {table.path} turn or are not of length one: the indenter must only translate"
        )
    return quat[0] / np.linalg.norm(quat[0])


def _read_press(path, indenter):
    remedy = "give the skin.h5 that `biotac press` writes"
    found, said = read_hdf5(path, "recorded press", remedy, _PRESS, ["parameters"])
    with reading(path, "recorded press", remedy):
        known = check_entries("parameters", json.loads(said["parameters"]), {"indenter": str})
    pose = found["indenter_pose"]
    if not len(pose):
        raise ValueError(f"{path} has no steps: {remedy}")
    name = indenter or known["indenter"]
    return Indentation(path.stem, name, found["time"], pose[:, :3], pose[0, 3:], found["force"])
