"""`biotac learn predict inverse`: deformation and contact patch of a BioTac from its electrodes, drawn from
below like the paper's figure."""

import pathlib
import typing

import numpy as np
import torch

from ..files import save_figure, write_json
from ..geometry import load_skin
from ..geometry.design import check_nelectrode
from ..geometry.skin_geometry import SkinGeometry
from ..geometry.surface import face_areas, node_areas
from ..recordings import load_one
from .predictor import PointsModel
from .training.inverse import PATCH, contact_centre, log_change_of
from .weights import find_weights, load_inverse

if typing.TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable

_UNTOUCHED = 0.05  # [N]
# thresholds of a drift note: number of rows, correlation with TDC, and counts above noise and a light touch
_ROWS, _CORRELATED, _FEW_COUNTS = 20, 0.9, 20


class Estimate(typing.NamedTuple):
    """Estimate of the skin from electrodes.

    Attributes:
      displacement: (n, nvert, 3) [m].
      contact: (n, nouter) on the nodes of the outer surface, sorted: contact force [N] or, for a latent
        projection, which has no force, indentation [m].
      is_force: whether it is a force. patch: fraction of the largest contact above which a node is in the
        patch.
    """

    displacement: np.ndarray
    contact: np.ndarray
    is_force: bool
    patch: float


def estimate(
    counts: np.ndarray, tare: np.ndarray, geometry: SkinGeometry, weights: pathlib.Path | str | None = None
) -> Estimate:
    """Displacements and contact of raw counts.

    Args:
      counts: (n, nelectrode) raw; tare: (nelectrode,) the sensor at rest. geometry: the skin. weights:
        file, a name of `weights.SHIPPED`; None is "inverse", for the default skin.

    Raises:
      ValueError: another number of electrodes, values that are not finite or not raw counts, or weights
        of another skin.
    """
    check_nelectrode(geometry.design, np.shape(counts)[-1], "a row")
    change = log_change_of(counts, tare)
    head = load_inverse(find_weights(weights, "inverse"), geometry)
    with torch.no_grad():
        outputs = [head(x) for x in torch.as_tensor(change, dtype=torch.float32).split(256)]
    field, contact = (torch.cat(output).double().numpy() for output in zip(*outputs))
    if isinstance(head, PointsModel):
        return Estimate(1e-3 * field, 1e-3 * contact, False, float(head.meta.get("patch", PATCH)))
    return Estimate(1e-3 * field, contact, True, PATCH)


def contact_patch(
    source: pathlib.Path | str,
    out: pathlib.Path | str = "out/contact",
    tare: int = 1,
    row: int | None = None,
    skin: str = "default",
    weights: pathlib.Path | str | None = None,
) -> dict:
    """Estimates every row of a recording and draws one; writes contact.png and contact.json into `out`.

    Args:
      source: a recording, or readings.csv of `biotac press`. tare: number of first rows whose mean is the
        sensor at rest.
      row: row to draw and return; None: the one with the largest force or, without recorded force, the
        largest change from rest.

    Raises:
      FileNotFoundError: no such file.
      ValueError: an invalid table, or a tare or row outside the recording.
    """
    recording, notes = load_one(source)
    counts, assumed = recording.counts()
    if not 1 <= tare < len(counts):
        raise ValueError(
            f"--tare {tare}: the recording has {len(counts)} rows, of which some must be left to look at: "
            "give fewer, and 1 at least"
        )
    rest, force = counts[:tare].mean(0), recording.force
    recorded = None if force is None else np.linalg.norm(force, axis=1)  # NaN in rows without
    if row is None:
        row = int(np.nanargmax(np.abs(counts - rest).sum(1) if recorded is None else recorded))
    if not -len(counts) <= row < len(counts):
        raise ValueError(
            f"--row {row}: the recording has {len(counts)} rows, give 0 to {len(counts) - 1}, or -1 for the "
            "last"
        )
    geometry = load_skin(skin)
    row = row % len(counts)
    field, contact, is_force, fraction = estimate(counts, rest, geometry, weights)
    outer = np.unique(geometry.outer_face)
    place = geometry.vert[outer]
    area = _node_area(geometry, outer)
    patch = contact > fraction * contact.max(1, keepdims=True)
    centre = contact_centre(contact, place, fraction)
    table = {
        "schema": "biotac_mj.learning.contact_patch/1",
        "weights": "trained on synthetic data",
        "source": str(source),
        "notes": [*notes, *assumed, *_drift(recording.tdc, counts - rest, recorded)],
        "centre_mm": [None if np.isnan(c).any() else (1e3 * c).tolist() for c in centre],
        "force_N": contact.sum(1).tolist() if is_force else [None] * len(contact),
        "area_mm2": (1e6 * (patch * area).sum(1)).tolist(),
        "deepest_mm": (1e3 * np.linalg.norm(field[:, outer], axis=2).max(1)).tolist(),
    }
    out = pathlib.Path(out)
    write_json(out / "contact.json", table, None)
    force_here = None if recorded is None or np.isnan(recorded[row]) else float(recorded[row])
    one = {"row": row, "notes": table["notes"], "recorded": force_here} | {
        k: table[name][row]
        for k, name in (("force", "force_N"), ("area_mm2", "area_mm2"), ("deepest_mm", "deepest_mm"))
    }
    one["centre_mm"] = table["centre_mm"][row] or [float("nan")] * 3
    here = Estimate(field[row], contact[row], is_force, fraction)
    _figure(geometry, outer, here, centre[row], counts[row] - rest, one, out / "contact.png")
    return one


def _drift(tdc, change, force):
    """A note if electrodes correlate with TDC without contact, or, if there is no force, in all rows."""
    if tdc is None:
        return []
    free = np.isfinite(tdc)
    if force is not None:
        free &= force < _UNTOUCHED
    tdc, level = tdc[free], np.median(change[free], axis=1)  # a touch changes few electrodes
    if len(tdc) < _ROWS or not np.ptp(tdc) or not np.ptp(level):
        return []
    drift = abs(np.polyfit(tdc, level, 1)[0]) * np.ptp(tdc)
    if abs(np.corrcoef(tdc, level)[0, 1]) < _CORRELATED or drift < _FEW_COUNTS:
        return []
    return [
        f"electrodes drift with TDC, by about {drift:.0f} counts, as a sensor does that warms up, and this "
        "reads as force: cut the recording so that it begins just before the touch"
    ]


def _node_area(geometry, outer):
    """(nouter,) area per node [m2]."""
    area = np.linalg.norm(face_areas(geometry.vert, geometry.outer_face), axis=1)
    return node_areas(geometry.outer_face, area, geometry.nvert)[outer]


def draw_skin(
    axis: "Axes",
    vert: np.ndarray,
    face: np.ndarray,
    value: np.ndarray,
    limit: float,
    title: str,
    cmap: str = "viridis",
) -> "ScalarMappable":
    """Draws a surface as seen from the pad's side (along +y): faces coloured by the mean of nodal values,
    shaded, far ones first.

    Args:
      axis: of matplotlib. vert: (n, 3) [m]; face: (m, 3); value: (n,); limit: of the colours.

    Returns:
      the collection, for a colour bar.
    """
    import matplotlib
    from matplotlib.collections import PolyCollection

    corner = vert[face]
    normal = face_areas(vert, face)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-30
    seen = normal[:, 1] < 0
    order = np.flatnonzero(seen)[np.argsort(-corner[seen][:, :, 1].mean(1))]
    colour = matplotlib.colormaps[cmap](np.clip(value[face[order]].mean(1) / limit, 0, 1))
    light = 0.35 + 0.65 * np.clip(normal[order] @ (np.array([-0.35, -0.85, 0.4]) / 1.003), 0, 1)
    colour[:, :3] *= light[:, None]
    axis.add_collection(
        PolyCollection(
            1e3 * corner[order][:, :, [0, 2]], facecolors=colour, edgecolors=colour, linewidths=0.3
        )
    )
    axis.set_xlim(-23, 3), axis.set_ylim(-8.5, 8.5)
    axis.set_aspect("equal")
    axis.set_title(title, fontsize=10)
    axis.set_xlabel("x [mm], tip on the left"), axis.set_ylabel("z [mm]")
    return matplotlib.cm.ScalarMappable(matplotlib.colors.Normalize(0, limit), cmap)


def _figure(geometry, outer, here, centre, change, one, path):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 3.9), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=[1, 1, 0.8])
    shape, face = geometry.vert + here.displacement, geometry.outer_face
    depth = 1e3 * np.linalg.norm(here.displacement, axis=1)
    limit, title = max(depth[outer].max(), 1e-3), "displacement from electrodes [mm]"
    figure.colorbar(draw_skin(left, shape, face, depth, limit, title), ax=left, shrink=0.8)
    nodal, title = np.zeros(geometry.nvert), "push from electrodes [mm]"
    nodal[outer] = 1e3 * here.contact
    if here.is_force:
        nodal[outer] *= 1e-6 / _node_area(geometry, outer)
        title = "contact pressure from electrodes [kPa]"
    bar = draw_skin(middle, shape, face, nodal, max(nodal.max(), 1e-6), title, "inferno")
    figure.colorbar(bar, ax=middle, shrink=0.8)
    if np.isfinite(centre).all():
        middle.plot(1e3 * centre[0], 1e3 * centre[2], "+", color="c", ms=12, mew=2)
    e = 1e3 * geometry.electrode_pos
    for axis in (left, middle):
        axis.plot(e[:, 0], e[:, 2], ".", color="w", ms=3)
    right.bar(np.arange(1, len(change) + 1), change, color="C0")
    right.set_xlabel("electrode"), right.set_title("measured change [counts]", fontsize=10)
    force = f"force about {one['force']:.2f} N, " if here.is_force else ""
    what = f"row {one['row']}: {force}patch {one['area_mm2']:.1f} mm2"
    figure.suptitle(f"{what} (network trained on synthetic data)", fontsize=10)
    save_figure(path, figure, 120)
