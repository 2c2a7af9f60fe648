"""The pictures of docs/concepts/, from the simulation: python scripts/draw_concepts.py [--out docs/concepts]

A sphere of 7 mm pressed into the pad, with and without liquid and in both tiers, and a ball that is let go
over it. Half a minute on one core."""

import argparse
import pathlib

import mujoco
import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Polygon

import biotac_mj
from biotac_mj.geometry.rigid import matrix
from biotac_mj.press import PressOptions, press
from biotac_mj.press.report import draw_electrodes, unroll

SKIN, WARM, COLD, DARK = "#3d9970", "#d9722a", "#7fb7d9", "#444444"
GREENS = ListedColormap(colormaps["Greens"](np.linspace(0.3, 1.0, 256)))  # seen at rest too


def sheet(columns, width=9.0, height=3.6, rows=1):
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns)


def cut_tets(vert, elem):
    """Polygons [(3 or 4, 2)] in (x, y) [mm] in which the plane z = 0 cuts tetrahedra, and their elements."""
    z = vert[elem, 2]
    out, owner = [], []
    for e in np.flatnonzero((z.min(1) < 0) & (z.max(1) > 0)):
        p = vert[elem[e]]
        pairs = [(a, b) for a in range(4) for b in range(a) if (p[a, 2] < 0) != (p[b, 2] < 0)]
        cut = np.array([p[a] - p[a, 2] / (p[b, 2] - p[a, 2]) * (p[b] - p[a]) for a, b in pairs])[:, :2]
        around = cut - cut.mean(0)
        out.append(1e3 * cut[np.argsort(np.arctan2(around[:, 1], around[:, 0]))])
        owner.append(e)
    return out, np.array(owner)


def outline(vert, face):
    """Segments (n, 2, 2) [mm] in which the plane z = 0 cuts a surface."""
    out = []
    for p in vert[face]:
        cut = [
            p[a] - p[a, 2] / (p[b, 2] - p[a, 2]) * (p[b] - p[a])
            for a, b in ((0, 1), (1, 2), (2, 0))
            if (p[a, 2] < 0) != (p[b, 2] < 0)
        ]
        if len(cut) == 2:
            out.append(1e3 * np.array(cut)[:, :2])
    return out


def draw_section(axes, record, step, title, what=None):
    """The finger cut lengthwise, pad up: skin, liquid, core, indenter."""
    geometry = record.geometry
    xpos = np.asarray(record.vert_xpos[step], float)
    polygons, owner = cut_tets(xpos, geometry.elem[:, :4])
    moved = 1e3 * np.linalg.norm(xpos - geometry.vert, axis=1)[geometry.elem[:, :4]].mean(1)
    skin = PolyCollection(polygons, array=moved[owner], cmap=GREENS, edgecolors="face", linewidths=0.3)
    skin.set_clim(0, 1e3 * record.depth.max())
    center = np.array([-6.0, 0.0])  # sees the whole of both outlines [mm]
    for vert, face, color in (
        (xpos, geometry.outer_face, COLD),
        (geometry.core_vert, geometry.core_face, DARK),
    ):
        ring = np.concatenate(outline(vert, face))
        order = np.argsort(np.arctan2(*(ring - center).T[::-1]))
        axes.add_patch(Polygon(ring[order], color=color, lw=0, zorder=0))
    axes.add_collection(skin)
    ball = record.indenter_vert @ matrix(record.indenter_quat[step]).T + record.indenter_pos[step]
    axes.add_collection(LineCollection(outline(ball, record.indenter_face), colors=WARM, linewidths=2))
    low, high = 1e3 * geometry.vert.min(0), 1e3 * geometry.vert.max(0)
    axes.set(xlim=(low[0] - 1, high[0] + 1), ylim=(high[1] + 1, low[1] - 5), aspect="equal", title=title)
    axes.set(xlabel="x, tip on the left [mm]", ylabel="y, pad up [mm]")
    if what:
        axes.figure.colorbar(skin, ax=axes, label=what, shrink=0.8)


def draw_skin(record, path):
    figure, axes = sheet(2)
    draw_section(axes[0], record, 0, "at rest")
    draw_section(axes[1], record, record.peak, f"pressed {1e3 * record.depth.max():.1f} mm", "moved [mm]")
    figure.savefig(path, dpi=110)


def draw_liquid(wet, dry, path):
    figure, axes = sheet(2)
    for record, name, color in ((wet, "filled with liquid", SKIN), (dry, "without liquid", WARM)):
        force = np.linalg.norm(record.force, axis=1)
        axes[0].plot(1e3 * record.depth, force, color=color, label=name)
    axes[0].set(xlabel="depth [mm]", ylabel="force [N]", title="What the liquid adds")
    axes[0].legend()
    axes[0].grid(alpha=0.3)
    geometry = wet.geometry
    inner = np.unique(geometry.inner_face)
    out = geometry.vert[inner] * [0, 1, 1]
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    bulge = 1e3 * ((np.asarray(wet.vert_xpos[wet.peak], float) - geometry.vert)[inner] * out).sum(1)
    limit = np.abs(bulge).max()
    place = unroll(geometry.vert[inner])
    dots = axes[1].scatter(*place.T, c=bulge, cmap="RdBu", vmin=-limit, vmax=limit, s=12)
    figure.colorbar(dots, ax=axes[1], label="outward motion of the inner skin [mm]")
    axes[1].set(xlabel="along the finger [mm]", ylabel="around it [mm]", title="Where it goes: the bulge")
    figure.savefig(path, dpi=110)


def draw_film(record, path):
    import trimesh

    geometry, step = record.geometry, record.peak
    figure, axes = sheet(2, width=10.0)
    inner = np.unique(geometry.inner_face)
    inner = inner[np.abs(np.arctan2(geometry.vert[inner, 2], -geometry.vert[inner, 1])) < 2.0]
    core = trimesh.Trimesh(geometry.core_vert, geometry.core_face, process=False)
    xpos = np.asarray(record.vert_xpos[step], float)[inner]
    gap = 1e3 * np.abs(trimesh.proximity.closest_point(core, xpos)[1])
    fill = axes[0].tricontourf(*unroll(geometry.vert[inner]).T, gap, levels=12, cmap="Blues")
    figure.colorbar(fill, ax=axes[0], label="thickness of the film [mm]")
    axes[0].plot(*unroll(geometry.electrode_pos).T, "o", color=WARM, ms=5)
    axes[0].set(aspect="equal", xlabel="along the finger [mm]", ylabel="around the core [mm]")
    axes[0].set_title("Film under the press, and the electrodes")
    draw_electrodes(axes[1], record, step)
    axes[1].set_title("What they read")
    figure.savefig(path, dpi=110)


def draw_tiers(full, condensed, path):
    figure, axes = sheet(2)
    for record, name, style in ((full, "full", "-"), (condensed, "condensed", "--")):
        depth, change = 1e3 * record.depth, record.electrode_change
        axes[0].plot(depth, np.linalg.norm(record.force, axis=1), style, color=SKIN, label=name)
        most = np.argsort(-np.abs(full.electrode_change[full.peak]))[:3]
        for e, color in zip(most, (SKIN, WARM, DARK)):
            axes[1].plot(depth, change[:, e], style, color=color, label=f"E{e + 1}, {name}")
    axes[0].set(xlabel="depth [mm]", ylabel="force [N]", title="The same press in both tiers")
    axes[1].set(xlabel="depth [mm]", ylabel="change [counts]", title="Three electrodes")
    for one in axes:
        one.legend(fontsize=8)
        one.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


DROP = """<mujoco><option timestep="0.002"/><worldbody>
  <site name="fingertip" quat="1 -1 0 0"/>
  <body name="ball" pos="-0.01 0 0.0145"><joint type="slide" axis="0 0 1"/>
    <geom size="0.005" mass="0.1"/></body>
</worldbody></mujoco>"""


def draw_coupling(skin, path, seconds=0.3):
    spec = mujoco.MjSpec.from_string(DROP)
    handle = biotac_mj.attach(spec, site="fingertip", skin=skin)
    model = spec.compile()
    data, rows = mujoco.MjData(model), []
    while data.time < seconds:
        mujoco.mj_step(model, data)
        force = handle.read(data, "contact_force")[1]
        rows.append([data.time, 1e3 * data.qpos[0], force, handle.read(data, "pdc")[0]])
    time, height, force, _ = np.array(rows).T
    figure, axes = sheet(2)
    axes[0].plot(1e3 * time, height, color=WARM)
    axes[0].set(xlabel="time [ms]", ylabel="height [mm]", title="A ball of 100 g falls on the pad")
    axes[1].plot(1e3 * time, force, color=SKIN)
    axes[1].axhline(
        model.body("ball").mass[0] * -model.opt.gravity[2], color=DARK, ls=":", label="its weight"
    )
    axes[1].set(xlabel="time [ms]", ylabel="force on the BioTac [N]", title="The skin carries it")
    axes[1].legend()
    for one in axes:
        one.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def draw_step(path):
    """The files that one step goes through, and what travels between them."""
    groups = [
        ("MuJoCo", "mj_step", DARK),
        ("plugin", "engine.py", DARK),
        ("coupling/implicit", "world.py\ngroup.py\ncoupled.py", WARM),
        ("coupling", "instance.py\nsteppers/fem.py", WARM),
        ("skin", "step.py\nforces.py", SKIN),
        ("sensor", "readings.py\nfilm/conduction.py\nacquisition.py\nacquisition_kernels.py", COLD),
    ]
    down = ["calls", "calls", "predicted\nposes", "state,\nposes", "positions,\npressure"]
    up = ["", "forces,\nrows", "wrench,\ntangent", "wrench,\ntangent", ""]
    figure, axes = sheet(1, 11.5, 2.9)
    axes.set(xlim=(0, 6 * 1.9), ylim=(0, 2.6), aspect="equal")
    axes.axis("off")
    for i, (folder, files, color) in enumerate(groups):
        left = 1.9 * i + 0.08
        axes.add_patch(
            FancyBboxPatch((left, 0.75), 1.2, 1.3, boxstyle="round,pad=0.04", fc="white", ec=color, lw=2)
        )
        axes.text(left + 0.6, 1.94, folder, ha="center", va="center", color=color, fontsize=8, weight="bold")
        axes.text(left + 0.6, 1.3, files, ha="center", va="center", fontsize=6.5, family="monospace")
    for i, (there, back) in enumerate(zip(down, up)):
        right = 1.9 * i + 1.36
        for y, ends, text in ((1.65, (right, right + 0.52), there), (1.05, (right + 0.52, right), back)):
            if text:
                axes.annotate("", (ends[1], y), (ends[0], y), arrowprops={"arrowstyle": "->", "color": DARK})
                axes.text(right + 0.26, y + 0.1, text, ha="center", va="bottom", fontsize=6.5)
    x = [1.9 * 5 + 0.68, 0.68]
    axes.annotate(
        "",
        (x[1], 0.7),
        (x[0], 0.7),
        arrowprops={"arrowstyle": "->", "color": COLD, "connectionstyle": "bar,fraction=-0.04"},
    )
    axes.text(
        5.7, 0.12, "counts into mjData.sensordata, state into mjData.plugin_state", ha="center", fontsize=7
    )
    figure.savefig(path, dpi=130, bbox_inches="tight")


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("docs/concepts"))
    parser.add_argument("--skin", default="default")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)

    def pressed(**settings):
        return press(PressOptions(skin=options.skin, depth=2e-3, **settings), progress=False)[0]

    draw_step(options.out / "step.png")
    wet, dry = pressed(liquid=True), pressed(liquid=False)
    draw_skin(wet, options.out / "skin.png")
    draw_liquid(wet, dry, options.out / "liquid.png")
    draw_film(wet, options.out / "film.png")
    draw_tiers(wet, pressed(liquid=True, tier="condensed"), options.out / "tiers.png")
    draw_coupling(options.skin, options.out / "coupling.png")


if __name__ == "__main__":
    main()
