"""Contact that hangs on neither the time step, nor edges, nor the mesh: one table, each row against its bar.

    python benchmarks/contact_table.py [--tiers condensed,full] [--rows friction,moves] [--skin coarse]

The scenes are those of the tests (test_time_step, test_edges, test_true_contact, test_differentiable), which
hold closer bounds; here each row is measured and printed with its bar as it is done, and the exit status is
1 where one is missed.

peak, pac: an impact's peak and the RMS of PAC over three taps, at 0.5 to 4 ms, off from 0.25 ms (full tier:
0.5 ms; PAC: 0.5 ms). friction, pressure: of cycles without friction over edges and corners, work lost by way
and load, and the median of |F - sum p A| / |F| on the faces. wrist: <force> and cfrc_ext beside the weight of
a ball. around: the largest force [N] on a finger in a cup and through a ring that touch nothing. margin:
electrodes with a margin of 2 mm, off by the largest change. moves: of 400 moves by 0.2 um along five dragged
paths, those that change the force by more than three times the median."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy reads it

import argparse
import functools
import pathlib
import sys

import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))

import test_differentiable
import test_edges
import test_time_step
import test_true_contact

__all__ = ["main"]

STEPS = 5e-4, 1e-3, 2e-3, 4e-3  # [s]
# what is printed for a row, and its bar
BARS = {
    "peak": ("peak of an impact, {}", 0.1),
    "pac": ("RMS of PAC, {}", 0.15),
    "friction": ("apparent friction, {}", 0.03),
    "pressure": ("pressure times area, {}", 0.05),
    "wrist": ("force at a wrist, {}", 0.01),
    "around": ("force of what surrounds a finger, {}", 0.0),
    "margin": ("margin of 2 mm, {}", 0.02),
    "moves": ("moves of 0.2 um, {}", 4.0),
}


def peak(tier, skin):
    fine = test_time_step.peak(2.5e-4 if tier == "condensed" else 5e-4, tier, "implicitfast")
    for step in STEPS if tier == "condensed" else STEPS[1:]:
        yield f"{1e3 * step:g} ms", test_time_step.peak(step, tier, "implicitfast") / fine - 1


def pac(tier, skin):
    fine = test_time_step.loudness(STEPS[0], tier)
    for step in STEPS[1:]:
        yield f"{1e3 * step:g} ms", test_time_step.loudness(step, tier) / fine - 1


@functools.cache
def _cycle(name, tier, skin):
    return test_edges.cycle(name, tier, skin, steps=40 if skin == "coarse" else 60)


def friction(tier, skin):
    for name in test_edges.EDGES:
        yield name, test_edges.apparent_friction(_cycle(name, tier, skin)[0])


def pressure(tier, skin):
    for name in test_edges.EDGES:
        yield name, np.median(_cycle(name, tier, skin)[1])


def wrist(tier, skin):
    model, data, _ = test_true_contact.on_the_wrist(tier, steps=200)
    weight = test_true_contact.WEIGHT
    above = data.sensor("force").data[2] - test_true_contact.own_weight(model)
    yield "<force>", above / weight - 1
    yield "cfrc_ext", data.cfrc_ext[model.body("ball").id, 5] / weight - 1


def around(tier, skin):
    yield "cup and ring", test_true_contact.force_of_what_surrounds(tier)


def margin(tier, skin):
    plain, wide = (test_true_contact.change_of_electrodes(tier, m) for m in (0.0, 0.002))
    yield f"E17 {plain[16]:.0f}", np.abs(wide - plain).max() / np.abs(plain).max()


def moves(tier, skin):
    if tier == "full":  # what differentiates
        change = [test_differentiable.changes_along(*drag) for drag in test_differentiable.DRAGS]
        yield "of 400", sum(int((c >= 3 * np.median(c)).sum()) for c in change)


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--tiers", default="condensed,full", help="comma-separated")
    parser.add_argument("--rows", default=",".join(BARS), help="comma-separated")
    parser.add_argument("--skin", default="coarse", help="of friction and pressure")
    options = parser.parse_args(arguments)
    if unknown := set(options.rows.split(",")) - set(BARS):
        parser.error(f"unknown row {', '.join(sorted(unknown))}: choose from {', '.join(BARS)}")
    missed = 0
    print("| what | tier | measured | bar | |\n|---|---|---|---|---|")
    for row in options.rows.split(","):
        what, bar = BARS[row]
        for tier in options.tiers.split(","):
            for case, value in globals()[row](tier, options.skin):
                met = abs(value) <= bar
                missed += not met
                name = what.format(case)
                print(
                    f"| {name} | {tier} | {value:.3g} | {bar:g} | {'met' if met else 'missed'} |", flush=True
                )
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
