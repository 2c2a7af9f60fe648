"""Accuracy of the skin against stored solutions of another finite-element program (CalculiX) on the same
mesh.

    python benchmarks/accuracy.py --cases ../shared/reference --json out/accuracy.json [--skin PATH]
    [--picture out/accuracy.png]

Every .npz of the folder is one case: held nodes, material, indenter, path, contact stiffness, stick slope and
friction are read from it (docs/lab/benchmarks.md says what the fields are). The same path is walked with one
step per stored increment; nothing is fitted.

force_error_rel: mean over increments of |F - F_ref|, over the largest |F_ref|.
displacement_error_rel: mean over increments of the root mean square over all nodes of |u - u_ref|, over
the largest |u_ref|; displacement_pooled_rel takes the root mean square over nodes and increments together,
which gives late increments more weight."""

import argparse
import json
import os
import pathlib
import re
import sys
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import warp as wp
from records import write_json

from biotac_mj.geometry import SkinGeometry, import_mesh, indenter, load_skin
from biotac_mj.skin import GeomSet, Material, SkinData, SkinModel, SkinOptions, bake_distance_grid, step
from biotac_mj.skin.state_arrays import StateArrays

__all__ = ["BOUNDS", "case_geoms", "main", "solve_case"]

LAWS = {"NH": "neo_hookean", "SVK": "svk", "LIN": "linear"}
# (force, displacement); the stored solutions of sliding and core contact are uncertain by 4-5 % themselves
BOUNDS = {"normal": (0.03, 0.02), "sliding or core": (0.06, 0.04)}
# [m] around the press axis: where the stored solutions let the skin meet the core, if the description is
# silent
CORE_REACH = 7e-3
MAX_HALVINGS = 5


def case_geoms(shape: dict, friction: float) -> tuple[GeomSet, np.ndarray, np.ndarray]:
    """The indenter of a case as geoms, with their positions (n, 3) [m] and rotations (n, 3, 3) in the
    indenter's frame (tip at 0, y ahead).

    Raises:
      ValueError: a shape that is not known.
    """
    kind = shape["shape"].lower()
    edge = float(shape.get("edge_radius", 1e-3))  # the paper's indenters have 1 mm
    upright = np.eye(3)[None]
    if kind.startswith("sphere"):
        r = shape["radius"]
        return GeomSet(["sphere"], [(r,)], [friction]), np.array([[0, -r, 0]]), upright
    if kind.startswith(("cube", "box")):
        h = shape["half_width"]
        return GeomSet(["box"], [(h, h, h)], [friction], rounding=[edge]), np.array([[0, -h, 0]]), upright
    if "cylinder" in kind:
        r, half = _cylinder(shape)
        along_x = np.array([[[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]])  # the geom's z to the indenter's x
        return (
            GeomSet(["cylinder"], [(r, half)], [friction], rounding=[min(edge, r)]),
            np.array([[0, -r, 0]]),
            along_x,
        )
    if "annulus" in kind or "ring" in kind:
        grid = bake_distance_grid(*_ring(shape["inner_radius"], shape["outer_radius"], edge))
        return GeomSet(["mesh"], [()], [friction], grids=[grid]), np.zeros((1, 3)), upright
    raise ValueError(
        f"unknown indenter shape {shape['shape']!r}: the case must hold a sphere, cube, cylinder or annulus"
    )


def _cylinder(shape):
    """Radius and half length [m]; from the paper's indenter of that name where the case does not say."""
    half = shape.get("half_length", shape["length"] / 2 if "length" in shape else None)
    if half is not None and "radius" in shape:
        return shape["radius"], half
    try:
        radius, known = indenter(pathlib.Path(shape.get("seed_mesh", "?")).stem).size
    except ValueError as error:
        raise ValueError(
            f"cylinder of unknown length, fields {sorted(shape)}: give radius and length [m] ({error})"
        ) from error
    return shape.get("radius", radius), known if half is None else half


def _ring(inner, outer, edge, height=6e-3):
    """Closed mesh of a ring about y with its flat top at y = 0 and rounded upper rims; within 1 um of the
    round shape."""
    import trimesh

    angle = np.linspace(0, np.pi / 2, 19)
    up = np.stack([outer - edge + edge * np.cos(angle), edge * np.sin(angle) - edge], 1)
    down = np.stack([inner + edge - edge * np.sin(angle), edge * np.cos(angle) - edge], 1)
    profile = np.concatenate([[[outer, -height]], up, down, [[inner, -height], [outer, -height]]])
    # in millimetres: trimesh drops triangles that are small in metres
    mesh = trimesh.creation.revolve(1e3 * profile, sections=256)
    if mesh.volume < 0:
        mesh.invert()
    return 1e-3 * mesh.vertices[:, [1, 2, 0]], mesh.faces  # its axis z to y, a rotation


def solve_case(
    path: pathlib.Path, geometry: SkinGeometry, samples: int = 3, substeps: int = 1, tolerance: float = 1e-3
) -> dict:
    """Solves one stored case; errors, seconds and the computed forces (n, 3) [N]."""
    case = np.load(path, allow_pickle=False)
    shape, settings, law = (json.loads(str(case[key])) for key in ("indenter", "settings", "material"))
    if law["kind"] not in LAWS:
        raise ValueError(f"unknown material kind {law['kind']!r}: use one of {', '.join(LAWS)}")
    if case["displacement"].shape[1] != geometry.nvert:
        raise ValueError(
            f"the case has {case['displacement'].shape[1]} nodes, "
            f"skin {geometry.name!r} {geometry.nvert}: pass its mesh with --skin"
        )
    friction = float(case["friction"])
    model = _model(case, geometry, law, bool(settings.get("core", False)), samples, tolerance)
    model.factor  # noqa: B018  made here, so that `seconds` is of the steps
    geoms, pos, mat = case_geoms(shape, friction)
    walk = _Walk(model, geoms, pos, mat, np.array(shape["pose_start"])[:3, :3], case["start"])
    force, wrong, squeezed = [], [], []
    begin = time.perf_counter()
    for goal, reference in zip(case["path"], case["displacement"]):
        walk.to(goal, substeps)
        force.append(walk.data.wrench[0, 0, :3])
        squeezed.append(walk.data.worlds.squeezed.numpy()[0])
        wrong.append(walk.data.vert_xpos[0] - geometry.vert - reference)
    seconds = time.perf_counter() - begin
    wanted = case["force"]
    square = (np.array(wrong) ** 2).sum(2).mean(1)
    largest = np.linalg.norm(case["displacement"], axis=2).max()
    sliding_or_core = friction > 0 or bool(settings.get("core", False))
    return {
        "name": path.stem,
        "force_error_rel": float(
            np.linalg.norm(force - wanted, axis=1).mean() / np.linalg.norm(wanted, axis=1).max()
        ),
        "displacement_error_rel": float(np.sqrt(square).mean() / largest),
        "displacement_pooled_rel": float(np.sqrt(square.mean()) / largest),
        "seconds": seconds,
        "kind": "sliding or core" if sliding_or_core else "normal",
        "stored_uncertainty_force_rel": float(case["uncertainty_force_rel"]),
        "squeezed": float(max(squeezed)),
        "steps": walk.steps,
        "iterations": walk.iterations,
        "halved": walk.halved,
        "not_converged": walk.lost,
        "force": np.array(force).tolist(),
        "force_ref": wanted.tolist(),
    }


def _model(case, geometry, law, core, samples, tolerance):
    material = Material(
        LAWS[law["kind"]], law["E"], law["nu"], friction=float(case["friction"]), liquid=False
    )
    stiffness = float(case["contact_stiffness_Pa_per_m"])
    stick = float(case["stick_slope_Pa_per_m"]) / stiffness
    options = SkinOptions(
        core_contact=core,
        contact_stiffness=stiffness,
        stick_ratio=stick if stick > 0 else 0.1,
        samples=samples,
        tolerance=tolerance,
    )
    if not core:
        return SkinModel(geometry, material, options, fixed=case["fixed_nodes"])
    # of the inner faces that start clear of the core, the stored solution looked only at those around the
    # press axis
    clear = {tuple(face) for face in SkinModel(geometry, material, options).core_surface.face_np}
    axis = np.array(json.loads(str(case["indenter"]))["press_axis"])
    said = re.search(r"([\d.]+) mm around the press axis", str(case["description"]))
    center = geometry.vert[geometry.inner_face].mean(1) - case["start"]
    away = np.linalg.norm(center - np.outer(center @ axis, axis), axis=1)
    near = (away < (float(said[1]) * 1e-3 if said else CORE_REACH)) & (center @ axis < CORE_REACH)
    faces = [i for i, face in enumerate(geometry.inner_face) if near[i] and tuple(face) in clear]
    return SkinModel(geometry, material, options, fixed=case["fixed_nodes"], core_faces=np.array(faces))


class _Walk:
    """Moves an indenter without rotation and counts what it took; steps that do not converge are halved."""

    def __init__(self, model, geoms, pos, mat, rotation, start):
        self.model, self.geoms, self.data = model, geoms, SkinData(model)
        self.offset, self.mat = pos @ rotation.T, rotation @ mat
        self.state = StateArrays(self.data, geoms)
        self.at = np.array(start)
        self.steps = self.iterations = self.halved = self.lost = 0
        self._place(self.at)  # friction counts slip from the pose before the step, so the start must be one

    def _place(self, tip):
        self.geoms.set_pose(tip + self.offset, self.mat)

    def to(self, goal, substeps):
        start = self.at
        for k in range(1, substeps + 1):
            self._step(start + (goal - start) * k / substeps)

    def _step(self, goal, level=0):
        d = self.data
        before = self.state.save()
        self._place(goal)
        step(self.model, d, self.geoms)
        self.steps += 1
        self.iterations += int(d.iterations[0])
        if d.converged[0] or level == MAX_HALVINGS:
            self.lost += int(not d.converged[0])
            self.at = goal
            return
        self.halved += 1
        start = self.at
        self.state.load(before)
        self._place(start)
        self.geoms.advance()
        self._step((start + goal) / 2, level + 1)
        self._step(goal, level + 1)


def load_geometry(skin: str | None, cases: pathlib.Path) -> SkinGeometry:
    """The skin that --skin names, else the real mesh beside the cases or beside this repository."""
    if skin is not None:
        stored = skin.endswith(".npz") or skin in ("coarse", "default", "fine")
        return load_skin(skin) if stored else import_mesh(skin)
    beside = [cases.parent / "data", pathlib.Path(__file__).resolve().parents[2] / "shared" / "data"]
    for folder in beside:
        if (folder / "nvlabs_biotac_sim").is_dir():
            return import_mesh(folder / "nvlabs_biotac_sim")
    raise FileNotFoundError(
        f"no mesh nvlabs_biotac_sim in {' or '.join(str(b) for b in beside)}: pass its folder with --skin"
    )


_HEADER = ("force", "bound", "displ.", "bound", "seconds", "steps", "iter.", "halved", "lost")


def _line(name, cells, end=""):
    return f"{name:<34}" + "".join(f"{cell:>9}" for cell in cells) + f"  {end}"


def _report(row):
    if "error" in row:
        return f"{row['name']:<34}  failed: {row['error']}"
    force, displacement = BOUNDS[row["kind"]]
    good = (
        row["force_error_rel"] <= force
        and row["displacement_error_rel"] <= displacement
        and not row["not_converged"]
    )
    cells = [
        f"{row['force_error_rel']:.2%}",
        f"{force:.0%}",
        f"{row['displacement_error_rel']:.2%}",
        f"{displacement:.0%}",
        f"{row['seconds']:.1f}",
    ]
    cells += [row[key] for key in ("steps", "iterations", "halved", "not_converged")]
    return _line(row["name"], cells, "pass" if good else "FAIL")


def draw(rows, path) -> None:
    """Force over increments, ours and stored, one panel for each case."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = [row for row in rows if "error" not in row]
    columns = min(4, len(rows))
    lines = -(-len(rows) // columns)
    figure, axes = plt.subplots(
        lines, columns, figsize=(3.4 * columns, 2.6 * lines), squeeze=False, layout="constrained"
    )
    for axis in axes.flat[len(rows) :]:
        axis.set_visible(False)
    for axis, row in zip(axes.flat, rows):
        for component, color in zip(range(3), ("tab:red", "tab:green", "tab:blue")):
            increment = np.arange(1, len(row["force"]) + 1)
            axis.plot(increment, np.array(row["force_ref"])[:, component], "o", mfc="none", color=color, ms=4)
            axis.plot(
                increment,
                np.array(row["force"])[:, component],
                "-",
                color=color,
                lw=1,
                label=f"F{'xyz'[component]}",
            )
        axis.set_title(f"{row['name']}\n{row['force_error_rel']:.2%} of the peak force", fontsize=8)
        axis.tick_params(labelsize=7)
    axes[0, 0].legend(fontsize=7)
    figure.supxlabel("increment (circles: stored solution, lines: ours)", fontsize=8)
    figure.supylabel("force on the indenter [N]", fontsize=8)
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{os.getpid()}.{path.name}")
    figure.savefig(temporary, dpi=120)
    os.replace(temporary, path)


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--cases", type=pathlib.Path, required=True, help="folder of .npz cases, or one of them"
    )
    parser.add_argument(
        "--json", type=pathlib.Path, default="out/benchmarks/accuracy.json", help="file to write"
    )
    parser.add_argument(
        "--skin",
        help="mesh folder or file, or a stored skin; else data/nvlabs_biotac_sim beside the folder of cases",
    )
    parser.add_argument("--picture", type=pathlib.Path, help=".png to draw the forces to")
    parser.add_argument(
        "--samples", type=int, default=3, help="contact is sampled at samples^2 points per face"
    )
    parser.add_argument("--substeps", type=int, default=1, help="steps per stored increment")
    options = parser.parse_args(arguments)
    options.json.parent.mkdir(parents=True, exist_ok=True)
    wp.config.log_level = wp.LOG_WARNING
    files = sorted(options.cases.glob("*.npz")) if options.cases.is_dir() else [options.cases]
    if not files or not files[0].is_file():
        parser.error(f"no .npz cases in {options.cases}: pass the folder that holds them")
    geometry = load_geometry(
        options.skin, options.cases.resolve() if options.cases.is_dir() else options.cases.resolve().parent
    )
    print(_line("case", _HEADER))
    rows = []
    for file in files:
        try:
            rows.append(solve_case(file, geometry, options.samples, options.substeps))
        except (KeyError, ValueError) as error:
            rows.append(
                {
                    "name": file.stem,
                    "force_error_rel": None,
                    "displacement_error_rel": None,
                    "seconds": None,
                    "error": str(error),
                }
            )
        print(_report(rows[-1]), flush=True)
    write_json(options.json, {"cases": rows})
    if options.picture:
        draw(rows, options.picture)
    return int(any("error" in row for row in rows))


if __name__ == "__main__":
    sys.exit(main())
