"""A plan of contacts as files: poses over time (CSV), ROS trajectories (YAML), a picture."""

import csv
import pathlib
import textwrap

from ...files import replacing
from .design import Plan

COLUMNS = "contact object time object_pos_x object_pos_y object_pos_z object_qw object_qx object_qy object_qz"
_WIDTH = 170  # letters in a line of the picture


def write_plan(plan: Plan, path: pathlib.Path | str) -> list[pathlib.Path]:
    """Writes PLAN.csv, PLAN.yaml and PLAN.png; returns the paths.

    Poses are those of the object in the BioTac's frame [m], times [s] are of the session; the columns are
    those that `biotac diagnose` reads beside the sensor's. PLAN.yaml holds one
    trajectory_msgs/MultiDOFJointTrajectory a contact."""
    path = pathlib.Path(path)
    files = [path, path.with_suffix(".yaml"), path.with_suffix(".png")]
    for file, write in zip(files, (write_poses, _ros, _picture)):
        with replacing(file) as temporary:
            write(plan, temporary)
    return files


def _poses(trajectory):
    """(n, 3) positions and (n, 4) quaternions w x y z."""
    from scipy.spatial.transform import Rotation

    return trajectory.pos, Rotation.from_matrix(trajectory.mat).as_quat(canonical=True, scalar_first=True)


def write_poses(plan: Plan, path: pathlib.Path) -> None:
    """Writes the poses of a plan alone, as CSV."""
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(COLUMNS.split())
        for k, one in enumerate(plan.contacts):
            pos, quat = _poses(one.trajectory)
            for t, p, q in zip(one.trajectory.clock + one.trajectory.time, pos, quat):
                rows.writerow([k + 1, one.contact.tool, f"{t:.4f}", *(f"{v:.12g}" for v in (*p, *q))])


def _ros(plan, path):
    import yaml

    documents = []
    for one in plan.contacts:
        pos, quat = _poses(one.trajectory)
        points = [
            {
                "transforms": [
                    {
                        "translation": dict(zip("xyz", map(float, p))),
                        "rotation": dict(zip("wxyz", map(float, q))),
                    }
                ],
                "time_from_start": {"sec": int(t), "nanosec": int(round(1e9 * (t % 1)))},
            }
            for t, p, q in zip(one.trajectory.time, pos, quat)
        ]
        header = {"frame_id": "biotac"}
        documents.append({"header": header, "joint_names": [one.contact.tool], "points": points})
    path.write_text(yaml.safe_dump_all(documents, sort_keys=False))


def _picture(plan, path):
    from matplotlib.figure import Figure

    lines, labels = [], {}
    for k, one in enumerate(plan.contacts):
        said = f"{k + 1}. {one.contact.text} ({one.reason})"
        lines += textwrap.wrap(said, _WIDTH, subsequent_indent="    ")
    words_height = 0.22 * len(lines)  # [inches]
    figure = Figure(figsize=(11, 3.5 + words_height), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=[3.0, max(words_height, 0.5)])
    place, time = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
    for k, one in enumerate(plan.contacts):
        t = one.trajectory
        (line,) = time.plot(t.time, 1e3 * t.depth)
        x, z = 1e3 * t.pos[:, 0], 1e3 * t.pos[:, 2]
        place.plot(x, z, color=line.get_color())
        place.plot(x[0], z[0], "o", color=line.get_color())
        labels.setdefault((x[0], z[0]), []).append(str(k + 1))
    for at, numbers in labels.items():
        place.annotate(", ".join(numbers), at, xytext=(4, 4), textcoords="offset points")
    place.set(xlabel="x along the finger, tip at -x [mm]", ylabel="z across [mm]", title="where")
    time.set(xlabel="time of a contact [s]", ylabel="depth [mm]", title="how deep", xscale="symlog")
    words = figure.add_subplot(grid[1, :])
    words.axis("off")
    words.text(0, 1, "\n".join(lines), va="top", fontsize=7)
    figure.savefig(path, dpi=110, format="png")
