"""What could be named at all: an observer who knows a hidden change exactly, for every piece of an author.

    python benchmarks/recordings_observer.py DATA --half ninth --json out/seen_ninth.json
    python benchmarks/recordings_observer.py --against out/seen_ninth.json out/ninth.json ...

DATA and --half as of `discrepancy_recordings.py`, whose verdicts (--json) follow each author's own in
--against: of each kind, the share that is detectable, and the share named of these.

The observer knows the change of every sample, and has to tell that it is there from what the sensor does by
itself. All that electrodes, squares of their principal components and force have to do with each other is one
Gaussian in each of three bands of time (levels, changes within seconds, what is left of single rows), taken
from parts of the recording without the change. The projection of the recording on the change is divided by
what that of the sensor alone would be: by blocks whose signs are drawn, or by the change put elsewhere in
time, whichever is larger. An effect
below four of these nobody can name from the recording alone. A change that is a linear map of what electrodes
and their products say is taken for another sensor, and effects that are the same from the first row on
(a sign, a gain, an exchange) may be named from what sound sensors have in common, which the observer does not
know. It knows the sensor without the change, so its share is a bound and no promise. Lost rows are left out.
"""

import argparse
import collections
import json
import pathlib

import numpy as np
from discrepancy_recordings import pieces

__all__ = ["detectable", "main"]

SEEN = 4.0  # standard deviations
_BIN, _CELL = 0.1, 2.0  # [s]
_PARTS = 6  # of the recording, each judged by what the others are like
_BLOCKS = 24
# (principal components whose squares and products are counted, ridge over a channel's variance): whichever
# tells the sensor from the change best
_LIKE = tuple((axes, ridge) for axes in (0, 3, 5, 8) for ridge in (1e-4, 1e-3, 1e-2))
_LEAST = 0.3  # [counts] of noise that rounding leaves


def _means(x, width):
    n = len(x) // width
    return x[: n * width].reshape(n, width, -1).mean(1)


def _components(clean, noise, number):
    """Function of counts (n, 19): (n, number) scores on principal components of clean, of spread one."""
    mean = clean.mean(0)
    basis = np.linalg.svd((clean - mean) / noise, full_matrices=False)[2][:number].T / noise[:, None]
    spread = np.maximum(((clean - mean) @ basis).std(0), 1e-9)
    return lambda counts: np.clip((counts - mean) @ basis / spread, -4, 4)


def _products(u):
    a, b = np.triu_indices(u.shape[1])
    return u[:, a] * u[:, b]


def _bands(x, size):
    """Bins x (m, q) themselves, levels of cells of a size, changes within these."""
    level = _means(x, size)
    return x, level, x[: len(level) * size] - np.repeat(level, size, axis=0)


def _z(clean, change, floor, ridge, said):
    """What a change (m, q) sums up to, squared, over what clean (m, q) alone does on it; said: how many
    of the columns are the electrodes' and their products."""
    m = len(clean)
    part = np.arange(m) * _PARTS // m
    signal, noise, weighted = np.empty(m), np.empty(m), np.empty_like(clean)
    change = _beyond(clean[:, :said], change - change.mean(0))
    for p in range(_PARTS):
        rest, mine = part != p, part == p
        y = clean[rest] - clean[rest].mean(0)
        S = y.T @ y / len(y)
        P = np.linalg.inv(S + np.diag(ridge * np.diag(S) + floor**2))
        weighted[mine] = (clean[mine] - clean[rest].mean(0)) @ P
        signal[mine] = np.einsum("mi,ij,mj->m", change[mine], P, change[mine])
        noise[mine] = np.einsum("mi,mi->m", change[mine], weighted[mine])
    return _ratio(signal, noise, change, weighted)


def _beyond(clean, change):
    """A change (m, q) less what is a linear map of all that the electrodes say (m, p), with their products:
    what these have to do with each other is not known beforehand, so that this is another sensor."""
    y = clean - clean.mean(0)
    return change - y @ np.linalg.lstsq(y, change, rcond=1e-9)[0]


def _ratio(signal, noise, change, weighted):
    block = np.arange(len(noise)) * min(_BLOCKS, len(noise)) // len(noise)
    by_block = np.sqrt(np.sum(np.bincount(block, noise) ** 2))
    elsewhere = np.conj(np.fft.rfft(change, axis=0)) * np.fft.rfft(weighted, axis=0)
    elsewhere = np.fft.irfft(elsewhere.sum(1), len(noise))
    return signal.sum() / max(by_block, np.sqrt(np.mean(elsewhere**2)), 1e-12)


def detectable(counts: np.ndarray, clean: np.ndarray, force: np.ndarray | None, rate: float) -> float:
    """Standard deviations by which a change stands out of what the sensor does by itself, in the band in
    which it does most. counts, clean (n, 19), force (n, 3) [N] or None, rate [Hz]."""
    clean = np.rint(clean)
    noise = np.maximum(1.48 * np.median(np.abs(np.diff(clean, axis=0)), 0) / 1.41, _LEAST)
    width = max(2, round(_BIN * rate))
    n = len(clean) // width * width
    out = [_rows(clean[:n], counts[:n], noise, width)]
    before, after = _means(clean, width), _means(counts, width)
    beside = np.zeros((len(before), 0)) if force is None else _means(force, width)
    size = max(2, min(round(_CELL / _BIN), len(before) // 36))
    for number, ridge in _LIKE:
        scores = _components(before, noise, number)
        a, b = (np.hstack([x, _products(scores(x)), beside]) for x in (before, after))
        floor = np.r_[noise, np.full(a.shape[1] - 19, 0.01)]
        for x, y, share in zip(_bands(a, size), _bands(b, size), (0.3, 0.1, 0.3)):
            said = a.shape[1] - beside.shape[1]
            if len(x) > max(2 * _BLOCKS, 3 * said):
                out.append(_z(x, y - x, share * floor, ridge, said))
    return float(max(out))


def _rows(clean, counts, noise, width):
    """Of single rows, less their bins' means: electrodes say nothing of each other there."""
    fast, other = (x.reshape(-1, width, 19) for x in (clean / noise, counts / noise))
    fast, other = (x - x.mean(1, keepdims=True) for x in (fast, other))
    quiet = np.maximum(np.mean(fast**2, axis=1, keepdims=True), 1)
    change, weighted = ((x / np.sqrt(quiet)).reshape(-1, 19) for x in (other - fast, fast))
    change = _beyond(weighted, change)
    return _ratio((change**2).sum(1), (change * weighted).sum(1), change, weighted)


def against(files: list) -> str:
    """Table of kinds: pieces, detectable, named of these, named of the others; files: what was seen and the
    verdicts, in turn."""
    count = collections.defaultdict(lambda: np.zeros(4, int))
    for seen, verdicts in zip(files[::2], files[1::2]):
        known = {tuple(r["key"]): r["z"] for r in json.loads(pathlib.Path(seen).read_text())}
        for row in json.loads(pathlib.Path(verdicts).read_text())["cases"]:
            z = known.get(tuple(row["key"]))
            if len(row["truth"]) != 1 or z is None:
                continue
            hit = any(n["right"] == row["truth"][0] for n in row["named"])
            for kind in (row["truth"][0], "all"):
                count[kind] += [1, z >= SEEN, hit and z >= SEEN, hit and z < SEEN]
    lines = ["kind          pieces  detectable  named of these  named of the others"]
    for kind, (n, seen, hit, other) in sorted(count.items()):
        lines.append(
            f"{kind:<14}{n:>6}{seen:>8} {seen / n:>4.0%}{hit:>9} {hit / max(seen, 1):>4.0%}{other:>12}"
        )
    return "\n".join(lines)


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("data", nargs="?")
    args.add_argument("--half", default="ninth")
    args.add_argument("--counts", default="9,5,20")
    args.add_argument("--json")
    args.add_argument("--against", nargs="+", metavar="JSON")
    args = args.parse_args(argv)
    if args.against:
        print(against(args.against))
        return
    rows = []
    for key, kinds, author, make in pieces(args.half, args.data, args.counts):
        if not kinds:
            continue
        case, clean = make()
        z = None
        if len(clean) == len(case.counts):
            z = detectable(case.counts, clean, case.force, case.rate)
        rows.append(
            {"key": key, "by": author, "kinds": kinds, "forms": case.forms, "base": case.base, "z": z}
        )
    pathlib.Path(args.json).write_text(json.dumps(rows))


if __name__ == "__main__":
    main()
