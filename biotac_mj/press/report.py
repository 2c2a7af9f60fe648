"""The picture of a press, and its table on the terminal. It uses no window and no global state of
matplotlib."""

import pathlib

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from ..coupling.show import OBJECT, SKIN
from ..files import save_figure
from ..geometry.design import BIOTAC, Design
from ..geometry.rigid import matrix
from ..sensor.colors import FULL_CHANGE, change_map
from .record import PressRecord

__all__ = [
    "draw_electrodes",
    "draw_force",
    "draw_map",
    "draw_peak_pressure",
    "draw_pressure",
    "draw_surface",
    "draw_traces",
    "table",
    "unroll",
    "write_picture",
]

_HARD = np.array([0.75, 0.75, 0.78])
_PLACES = {"aspect": "equal", "xlabel": "along the finger, tip on the left [mm]"}
# BioTac frame to a frame whose z leaves the pad
_TO_PAD_UP = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])


def unroll(points: np.ndarray, design: Design = BIOTAC) -> np.ndarray:
    """Unrolls points (n, 3) [m] of the BioTac frame to (n, 2) [mm]: along the finger, and around it as an arc
    from the pad's midline, through the electrodes. Designs on a flat backing are seen from above."""
    x, y, z = 1e3 * points.T
    across = z if design.radius is None else 1e3 * design.radius * np.arctan2(z, -y)
    return np.stack([x, across], axis=1)


def draw_electrodes(axes: Axes, record: PressRecord, step: int) -> None:
    """Draws the unrolled core (`unroll`), tip on the left, E1..E6 of a BioTac below: electrodes with numbers
    and changes, in the colours of all pictures, over contours of the skin's displacement."""
    geometry = record.geometry
    outer, moved = _outer_motion(record, step)
    if np.ptp(moved) > 0:
        place = unroll(geometry.vert[outer], geometry.design)
        lines = axes.tricontour(*place.T, moved, levels=6, colors="0.6", linewidths=0.8, zorder=1)
        axes.clabel(lines, fmt="%g", fontsize=7, zorder=1)
    draw_map(axes, geometry.electrode_pos, record.electrode_change[step], geometry.design)
    axes.set_title(f"{axes.get_title()}; lines: how far the skin moved [mm]")


def draw_pressure(axes: Axes, record: PressRecord, step: int) -> None:
    """Draws a pad without electrodes from above: the indenter's pressure under contours of the skin's
    displacement."""
    geometry = record.geometry
    outer, moved = _outer_motion(record, step)
    place = unroll(geometry.vert[outer], geometry.design)
    if record.contact_pressure is not None:
        pressure = 1e-3 * record.contact_pressure[step, outer]
        fill = axes.tricontourf(*place.T, pressure, levels=12, cmap="YlOrRd")
        axes.figure.colorbar(fill, ax=axes, label="pressure of the indenter [kPa]", shrink=0.85)
    if np.ptp(moved) > 0:
        lines = axes.tricontour(*place.T, moved, levels=6, colors="0.4", linewidths=0.8)
        axes.clabel(lines, fmt="%g", fontsize=7)
    axes.set(**_PLACES, ylabel="across [mm]", title="Lines: how far the skin moved [mm]")


def _outer_motion(record, step):
    """Nodes (n,) of the outer skin that a map shows, and how far each has moved (n,) [mm]."""
    geometry = record.geometry
    outer = np.unique(geometry.outer_face)
    outer = outer[np.abs(np.arctan2(geometry.vert[outer, 2], -geometry.vert[outer, 1])) < 2.0]
    return outer, 1e3 * np.linalg.norm(record.vert_xpos[step, outer] - geometry.vert[outer], axis=1)


def draw_map(axes: Axes, electrode_pos: np.ndarray, change: np.ndarray, design: Design = BIOTAC) -> None:
    """Draws electrodes at their places (nelectrode, 3) [m], see `unroll`, with their changes (nelectrode,)
    from the reference counts, tip on the left, E1..E6 of a BioTac below."""
    place, scale = unroll(electrode_pos, design), dict(vmin=-FULL_CHANGE, vmax=FULL_CHANGE)
    dots = axes.scatter(*place.T, c=change, cmap=change_map(), **scale, s=480, edgecolors="0.3", zorder=2)
    for i, (x, y) in enumerate(place):
        ink = "white" if abs(change[i]) > 0.6 * FULL_CHANGE else "black"
        about = dict(
            xytext=(0, 3.5), textcoords="offset points", ha="center", va="center", color=ink, zorder=3
        )
        axes.annotate(f"E{i + 1}", (x, y), fontsize=7, **about)
        axes.annotate(f"{change[i]:+.0f}", (x, y), fontsize=6, **about | {"xytext": (0, -4.5)})
    label = "change [counts]; red: less liquid over it"
    axes.figure.colorbar(dots, ax=axes, label=label, shrink=0.85, extend="both")
    axes.set(
        **_PLACES,
        ylabel="across [mm]" if design.radius is None else "around the core [mm]",
        title=f"Electrodes E1..E{len(change)}",
    )
    axes.margins(0.12)


def draw_force(axes: Axes, record: PressRecord) -> None:
    """Draws components and size of the force over depth, or over time if the indenter slides at one depth."""
    slides = bool(record.parameters.get("slide"))
    along = record.time if slides else 1e3 * record.depth
    for i, name in enumerate("xyz"):
        axes.plot(along, record.force[:, i], lw=1, label=f"$F_{name}$")
    axes.plot(along, np.linalg.norm(record.force, axis=1), "k", lw=2, label="$|F|$")
    axes.set(xlabel="time [s]" if slides else "depth [mm]", ylabel="force on the indenter [N]", title="Force")
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)


def draw_traces(axes: Axes, record: PressRecord, named: int = 6) -> None:
    """Draws the changes of the electrodes over time, with the names of those that change most."""
    change = record.electrode_change
    order = np.argsort(-np.abs(change).max(0))
    for i in order[named:]:
        axes.plot(record.time, change[:, i], color="0.75", lw=0.8)
    for i in order[:named]:
        axes.plot(record.time, change[:, i], lw=1.5, label=f"E{i + 1}")
    axes.set(xlabel="time [s]", ylabel="change [counts]", title="Electrodes over time")
    axes.legend(fontsize=8, ncols=2)
    axes.grid(alpha=0.3)


def draw_peak_pressure(axes: Axes, record: PressRecord) -> None:
    """Draws the indenter's largest pressure on the skin over time."""
    axes.plot(record.time, 1e-3 * record.contact_pressure.max(1), lw=1.5)
    axes.set(xlabel="time [s]", ylabel="largest pressure [kPa]", title="Pressure over time")
    axes.grid(alpha=0.3)


def draw_surface(axes: Axes, record: PressRecord, step: int) -> None:
    """Draws deformed outer skin, nail and indenter as shaded triangles, from the side of the pad, in place of
    MuJoCo's rendering.

    Args:
      axes: with projection "3d".
    """
    geometry = record.geometry
    indenter = record.indenter_vert @ matrix(record.indenter_quat[step]).T + record.indenter_pos[step]
    xpos = np.asarray(record.vert_xpos[step], float)
    moved = np.linalg.norm(xpos - geometry.vert, axis=1)
    # lighter where the displacement is larger, to show dimple and bulge
    glow = (moved / max(moved.max(), 1e-9))[geometry.outer_face].mean(1)[:, None]
    meshes = [
        (
            xpos,
            geometry.outer_face,
            np.hstack([SKIN + glow * (np.array([0.95, 0.85, 0.30]) - SKIN), np.ones_like(glow)]),
        ),
        (geometry.nail_vert, geometry.nail_face, np.tile([*_HARD, 1.0], (len(geometry.nail_face), 1))),
        (geometry.clamp_vert, geometry.clamp_face, np.tile([*_HARD, 1.0], (len(geometry.clamp_face), 1))),
        (indenter, record.indenter_face, np.tile([*OBJECT, 0.35], (len(record.indenter_face), 1))),
    ]
    # one collection, so that matplotlib sorts all triangles by depth together
    tri = 1e3 * np.concatenate([vert[face].reshape(-1, 3, 3) for vert, face, _ in meshes]) @ _TO_PAD_UP.T
    color = np.concatenate([c for _, _, c in meshes])
    normal = np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    azimuth, elevation = np.radians(-115), np.radians(30)
    eye = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    light = eye + np.array([-0.5, 0.2, 0.8])
    color[:, :3] *= 0.35 + 0.65 * np.clip(normal @ (light / np.linalg.norm(light)), 0, 1)[:, None]
    front = normal @ eye > -0.05
    axes.add_collection3d(
        Poly3DCollection(
            tri[front], facecolors=np.clip(color[front], 0, 1), edgecolors="none", antialiased=False
        )
    )
    low, high = 1e3 * (geometry.vert @ _TO_PAD_UP.T).min(0), 1e3 * (geometry.vert @ _TO_PAD_UP.T).max(0)
    high[2] += 5
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.1)
    axes.view_init(np.degrees(elevation), np.degrees(azimuth))
    axes.set_axis_off()


def write_picture(record: PressRecord, path: pathlib.Path | str, render: np.ndarray | None = None) -> None:
    """Writes press.png: rendering and map of electrodes, or of pressure, at the peak; force and traces.

    Args:
      record: the press.
      path: of the picture; its suffix gives the format.
      render: (height, width, 3) uint8 of the step `record.peak` from MuJoCo; None: matplotlib draws the
        surfaces.
    """
    step = record.peak
    figure = Figure(figsize=(13, 9), layout="constrained")
    FigureCanvasAgg(figure)
    if render is None:
        axes = figure.add_subplot(2, 2, 1, projection="3d")
        draw_surface(axes, record, step)
    else:
        axes = figure.add_subplot(2, 2, 1)
        axes.imshow(render)
        axes.set_axis_off()
    axes.set_title(f"Peak force: skin at {1e3 * record.depth[step]:.2f} mm, {record.time[step]:.3f} s")
    draw_force(figure.add_subplot(2, 2, 3), record)
    design = record.geometry.design
    if design.nelectrode:
        draw_electrodes(figure.add_subplot(2, 2, 2), record, step)
        draw_traces(figure.add_subplot(2, 2, 4), record)
    else:
        draw_pressure(figure.add_subplot(2, 2, 2), record, step)
        if record.contact_pressure is not None:
            draw_peak_pressure(figure.add_subplot(2, 2, 4), record)
    indenter = record.parameters.get("indenter", "indenter")
    figure.suptitle(f"{indenter} on a {design.title}, skin {record.geometry.name}", fontsize=13)
    save_figure(path, figure)


def table(record: PressRecord, files: tuple | list = ()) -> str:
    """Summary of a press in a few lines of text."""
    force = np.linalg.norm(record.force, axis=1)
    change = record.electrode_change[record.peak]
    pdc = record.counts[:, len(change)]
    order = np.argsort(-np.abs(change))[:5]
    felt = [
        ("electrodes", "  ".join(f"E{i + 1} {change[i]:+.0f}" for i in order) + "  counts at the peak"),
        ("PDC", f"{pdc[record.peak] - pdc[0]:+.0f} counts at the peak"),
    ]
    if not len(change):
        felt = [("skin moved", f"{_outer_motion(record, record.peak)[1].max():.3f} mm at most, at the peak")]
        if record.contact_pressure is not None:
            felt.append(("pressure", f"{1e-3 * record.contact_pressure[record.peak].max():.1f} kPa at most"))
    rows = [
        ("depth", f"{1e3 * record.depth.max():.3f} mm"),
        ("peak force", f"{force.max():.3f} N at {1e3 * record.depth[record.peak]:.3f} mm"),
        *felt,
        ("steps", f"{len(record.time)} saved, {int(record.nonconverged[-1])} did not converge"),
        ("steps took", f"{record.seconds:.2f} s"),
        *[("wrote" if not i else "", str(file)) for i, file in enumerate(files)],
    ]
    return "\n".join(f"  {name:<12}{value}" for name, value in rows)
