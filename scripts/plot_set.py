"""A look at a data set: where objects touched, how hard, and what simulated and measured electrodes said:
python scripts/plot_set.py SET"""

import argparse

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from biotac_mj.data import TactileSet
from biotac_mj.files import replacing
from biotac_mj.sensor.channels import NELECTRODE

KINDS = {"press": "tab:blue", "slide": "tab:orange", "twist": "tab:green", "tap": "tab:red"}


def places(axes, data, peak):
    """First touch along and around the finger, on the skin seen from the pad and unrolled."""
    start = np.array([data.parameters(i)["start"] for i in range(len(data))])
    axes.scatter(*unrolled(data.geometry.vert[np.unique(data.geometry.outer_face)]), s=1, c="0.85")
    axes.scatter(
        *unrolled(data.geometry.electrode_pos),
        s=60,
        marker="s",
        facecolors="none",
        edgecolors="0.4",
        label="electrodes",
    )
    for kind, colour in KINDS.items():
        mine = data.kind == kind
        axes.scatter(*unrolled(start[mine]), s=6 + 4 * peak[mine], c=colour, alpha=0.6, linewidths=0)
        axes.scatter([], [], s=30, c=colour, label=kind)
    axes.set(
        xlabel="x [mm] (tip left)", ylabel="angle round the finger [deg], 0 is the pad", ylim=(-135, 135)
    )
    axes.set_title(f"{len(data)} synthetic interactions, {data.nstep} time steps; size: largest force")
    axes.legend(loc="upper right", fontsize=8)


def unrolled(point):
    return 1e3 * point[:, 0], np.degrees(np.arctan2(point[:, 2], -point[:, 1]))


def forces(axes, data, peak):
    """Largest force of each interaction, object by object."""
    names = sorted(set(data.object.tolist()))
    axes.boxplot(
        [peak[data.object == name] for name in names],
        orientation="horizontal",
        tick_labels=names,
        flierprops={"markersize": 2},
    )
    axes.set(xlabel="largest force [N]", title="force")
    axes.grid(axis="x", alpha=0.3)


def traces(axes, data, peak):
    """The two liveliest electrodes of the strongest labelled interaction, against row 0."""
    chosen = np.flatnonzero(data.labelled)
    if not len(chosen):
        axes.set_axis_off()
        return
    one = data.interaction(int(chosen[peak[chosen].argmax()]))
    simulated, measured = (
        counts[:, :NELECTRODE] - counts[0, :NELECTRODE] for counts in (one.counts, one.measured_counts)
    )
    for k, e in enumerate(np.abs(measured).max(0).argsort()[-2:]):
        axes.plot(one.time, measured[:, e], f"C{k}o-", label=f"e{e + 1}, synthetic measured sensor")
        axes.plot(one.time, simulated[:, e], f"C{k}--", label=f"e{e + 1}, simulated")
    axes.set(
        xlabel="time [s]",
        ylabel="change [counts]",
        title=f"interaction {one.id}: {one.kind} with {one.object}",
    )
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)


def main(path, out):
    with TactileSet(path) as data:
        peak = np.maximum.reduceat(np.linalg.norm(data["wrench"][:][:, :3], axis=1), data.start)
        figure = plt.figure(figsize=(13, 8), layout="constrained")
        grid = figure.add_gridspec(2, 3)
        places(figure.add_subplot(grid[0, :2]), data, peak)
        forces(figure.add_subplot(grid[:, 2]), data, peak)
        traces(figure.add_subplot(grid[1, :2]), data, peak)
        with replacing(out) as temporary:
            figure.savefig(temporary, dpi=100)
        if data.labelled.any():
            step = data.steps(data.labelled)
            tare = np.repeat(data.start[data.labelled], (data.stop - data.start)[data.labelled])
            simulated, measured = (
                data[name][step][:, :NELECTRODE] - data[name][tare][:, :NELECTRODE]
                for name in ("counts", "measured_counts")
            )
            rms = {"no change": measured, "the simulator": measured - simulated}
            rows = {name: np.sqrt((value**2).mean(1)) for name, value in rms.items()}
            print(
                "; ".join(
                    f"{name} misses measured counts by {np.median(value):.1f} RMS (median step)"
                    for name, value in rows.items()
                )
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", help="folder of shards")
    parser.add_argument("--out", default="out/data.png")
    args = parser.parse_args()
    main(args.set, args.out)
