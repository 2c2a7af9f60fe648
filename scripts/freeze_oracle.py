"""Freezes the skin's answers to the presses of `tests/skin_oracle.py` into `tests/skin_oracle.npz`.

    python scripts/freeze_oracle.py [--check] [CASE ...]

Only once, before the step is written anew: a file made by the code that it is to judge judges nothing. Where
the law of a case changes, name it; the answers of the others stay. With --check nothing is written; the cases
are solved more tightly, by other iterations and, where the past does not matter, in half steps, and the
largest differences are printed in shares of the peak.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy reads it

# ruff: noqa: E402
import argparse
import pathlib
import sys
import time

import numpy as np
import warp as wp

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))
from skin_oracle import CASES, FILE, halved, solve

WELL_POSED = 1e-7  # of the peak
STEEPEST = dict(max_cg=1, max_newton=2000)


def sound(name, answers):
    """The answers, if all steps converged; else RuntimeError."""
    if not answers["converged"].all():
        failed = np.flatnonzero(~answers["converged"].all(1)).tolist()
        raise RuntimeError(f"{name}: steps {failed} did not converge")
    return answers


def freeze(names):
    with np.load(FILE) as file:
        out = {key: file[key] for key in file.files if key.split(".")[0] not in names}
    for name in names:
        for quantity, value in sound(name, solve(CASES[name])).items():
            out[f"{name}.{quantity}"] = value
    np.savez_compressed(FILE, **out)
    print(f"{FILE}: {len(names)} cases, {FILE.stat().st_size / 1e3:.0f} kB, {time.process_time():.0f} s")


def apart(one, other):
    """Largest difference in shares of each quantity's peak."""
    one, other = ({k: v for k, v in a.items() if k != "converged" and v.size} for a in (one, other))
    return max(abs(one[k] - other[k]).max() / max(abs(one[k]).max(), 1e-9) for k in one)


def check(names):
    """Prints how far the answers depend on how they are found; whether they do."""
    worst = 0.0
    for name in names:
        case = CASES[name]
        base = sound(name, solve(case))
        others = {"tighter": solve(case, tolerance=1e-10), "other iterations": solve(case, **STEEPEST)}
        if case.elastic:
            others["half steps"] = solve(halved(case))
        distance = {way: apart(base, sound(name, answers)) for way, answers in others.items()}
        worst = max(worst, *distance.values())
        print(f"{name:30s}", ", ".join(f"{way} {value:.0e}" for way, value in distance.items()), flush=True)
    return worst < WELL_POSED


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="whether answers depend on how they are found")
    parser.add_argument("cases", nargs="*", help="instead of all")
    arguments = parser.parse_args()
    wp.set_device("cpu")
    if arguments.check:
        sys.exit(0 if check(arguments.cases or list(CASES)) else "some answers depend on how they are found")
    freeze(arguments.cases or list(CASES))
