"""Intervals and novelty of a model that reads electrodes, on recordings with force, in order of time.

python benchmarks/recorded.py REC.h5 [REC.h5 ...] [--until 0.7] [--json OUT]

Models of the first rows, as `biotac learn train REC --out FILE` keeps them, are judged on rows that follow:
how
many lie inside the intervals of 90 %, and whether novelty tells an electrode that is stuck at its mean, with
and without noise, from one that works. `--until` leaves the last rows alone: what is chosen is chosen there.
"""

import argparse
import pathlib

import numpy as np
from records import write_json

from biotac_mj.learning.instants.examples import from_recording
from biotac_mj.learning.instants.reader import judge_in_time
from biotac_mj.recordings import load_one

CUTS, AHEAD, PIECES = (0.5, 0.6, 0.7, 0.8), 0.2, 20  # shares of the rows that train, and that judge
NOISE = 2.0  # counts of a stuck electrode


def area(usual: np.ndarray, strange: np.ndarray) -> float:
    """Share of pairs in which the strange one has the higher score."""
    return float((strange[:, None] > usual).mean() + 0.5 * (strange[:, None] == usual).mean())


def stuck(reader, counts: np.ndarray, mean: np.ndarray, noise: float) -> dict:
    """Areas under the curve for each electrode stuck at its mean, by pieces and by rows; `over`: share of the
    rows with a novelty above one, ordinary and (the least of all electrodes) stuck."""
    rng = np.random.default_rng(0)

    def score(counts):
        novelty = reader.predict(counts).novelty
        return np.array([np.log(p).mean() for p in np.array_split(novelty, PIECES)]), novelty

    usual, usual_row = score(counts)
    pieces, rows, over = [], [], []
    for electrode in range(counts.shape[1]):
        changed = counts.copy()
        changed[:, electrode] = np.rint(mean[electrode] + rng.normal(0, noise, len(counts)))
        piece, row = score(changed)
        pieces.append(area(usual, piece))
        rows.append(area(usual_row[::5], row[::5]))
        over.append(float((row > 1).mean()))
    return {"pieces": pieces, "rows": rows, "over": [float((usual_row > 1).mean()), min(over)]}


def main(argv=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", nargs="+")
    parser.add_argument("--until", type=float, default=1.0, help="share of the rows that is looked at")
    parser.add_argument("--json", type=pathlib.Path)
    given = parser.parse_args(argv)
    out = {}
    for name in given.recordings:
        recording, _ = load_one(name)
        there = np.arange(len(recording)) < given.until * len(recording)
        recording = recording.rows(there & np.isfinite(recording.force).all(1))
        one = out[name] = {"force": [], "electrodes": [], "stuck": {}}
        for cut in CUTS:
            end, stop = (int(share * len(recording)) for share in (cut, cut + AHEAD))
            data = from_recording(recording.rows(np.arange(len(recording)) < end))
            reader, _ = judge_in_time(data)
            counts = recording.counts()[0][end:stop]
            found = reader.predict(counts)
            truth = {"force": recording.force[end:stop], "electrodes": counts}
            for what, value in truth.items():
                one[what].append(float((np.abs(found.value[what] - value) <= found.half[what]).mean()))
        for noise in (0.0, NOISE):  # of the last cut
            one["stuck"][f"{noise:g}"] = stuck(reader, counts, data.counts.mean(0), noise)
        print(name)
        for what in truth:
            print(f"  {what} inside 90 %: {np.mean(one[what]):.3f}", *[f"{x:.3f}" for x in one[what]])
        for noise, found in one["stuck"].items():
            say = [f"{what} {min(found[what]):.2f} to {max(found[what]):.2f}" for what in ("pieces", "rows")]
            over = ", ".join(f"{share:.2f}" for share in found["over"])
            print(f"  stuck, noise {noise}: area by {', '.join(say)}; share above 1 {over}")
    if given.json:
        write_json(given.json, out)


if __name__ == "__main__":
    main()
