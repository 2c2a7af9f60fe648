"""What sound sensors have in common under a load, from pressed ones: `discrepancy/recordings/sound.json`.

    python benchmarks/sound_sensors.py DATA --out biotac_mj/discrepancy/recordings/sound.json
    python benchmarks/sound_sensors.py DATA --judge [--full]

DATA is a folder of recordings (`epfl_flat_press`, `epfl_f2`; `phac_hold`, `scraping` to judge). Of each
sensor pieces of 8 to 70 s, of each piece what `sound.answers_of` says of its changes, and its noise over the
law's.

--judge hides wrong wiring in pieces of each sensor and looks for it with what the other sensors have in
common: no number of a sensor's own, of answers, noise or levels, takes part. It is looked for by
`families/wiring/wiring.py` and by what noise says of gains; --full: by all of `biotac diagnose`."""

import argparse
import gzip
import json
import pathlib
import time
import zlib

import numpy as np
import scipy.io

from biotac_mj.discrepancy import PlainRecording, diagnose_recording
from biotac_mj.discrepancy.recordings import sound
from biotac_mj.discrepancy.recordings.families.wiring.gains import louder
from biotac_mj.discrepancy.recordings.families.wiring.wiring import miswired
from biotac_mj.discrepancy.recordings.session import Session
from biotac_mj.discrepancy.recordings.sound import PAD, answers_of
from biotac_mj.quality.noise import noise_level, sound_noise

FILES = {"F1": "epfl_flat_press/SynImpF1.txt", "F2": "epfl_f2/SynImpF2.txt.gz"}
RATE = 118.0
PIECES = 24
DIRECTIONS = 8
# by how much a number of another sensor differs from the mean besides: F1 from F2 by 0.34 RMS; of a pad's
# electrodes presses of one sensor do so by as much already
SENSOR, SENSOR_PAD = 0.3, 0.6
WIDER = 1.5  # times the variance between pieces: others press elsewhere
OTHER_NOISE = 0.1
PRESS = 0.05  # of a number from press to press, beside what was seen


def pieces(counts: np.ndarray) -> list:
    """Pieces (n, 19) spread evenly, of lengths spread evenly in their logarithms."""
    seconds = np.geomspace(8, 70, 6)[np.random.default_rng(0).permutation(np.arange(PIECES) % 6)]
    out = []
    for i, length in enumerate(seconds):
        n = int(length * RATE)
        first = int((i + 0.5) / PIECES * (len(counts) - n))
        out.append(counts[first : first + n])
    return out


def read(data: pathlib.Path, name: str) -> np.ndarray:
    path = data / FILES[name]
    with (gzip.open if path.suffix == ".gz" else open)(path, "rt") as file:
        return np.loadtxt(file)


def numbers(counts: np.ndarray) -> tuple:
    """(f,) of a piece, as `answers_of`, and (19,) logarithms of noise over the law's; None where an electrode
    cannot be used."""
    recording = PlainRecording(counts, rate=RATE)
    model = Session(recording, np.ones(len(counts), bool)).model()
    if len(model.used) < 19:
        return None
    _, moment, floor, _ = model.moments()
    x = counts[~recording.repeated]
    noise = np.log(noise_level(x) / sound_noise(np.median(x, axis=0)))
    return answers_of(moment[:, :19, :19].mean(0) + np.diag(floor[:19])), noise - noise.mean()


def statistics(sensors: dict) -> dict:
    """Of sensors, name -> (answers (n, f), noise (n, 19))."""
    mean = np.array([a.mean(0) for a, _ in sensors.values()])
    number = len(sensors)
    within = np.concatenate([(a - a.mean(0)) / np.sqrt(len(a) * number / WIDER) for a, _ in sensors.values()])
    _, size, axes = np.linalg.svd(within, full_matrices=False)
    directions = size[:DIRECTIONS, None] * axes[:DIRECTIONS]
    left = np.maximum((within**2).sum(0) - (directions**2).sum(0), 0)
    if number > 1:
        directions = np.concatenate([directions, (mean - mean.mean(0)) / np.sqrt(number - 1)])
    i, j = np.triu_indices(19, 1)
    pad = np.concatenate([np.isin(i, PAD) | np.isin(j, PAD), np.isin(np.arange(19), PAD)])
    own = np.sqrt(left + np.where(pad, SENSOR_PAD, SENSOR) ** 2)
    # of one sensor: how its answers differ from press to press
    change = {"change_directions": directions[:DIRECTIONS], "change_own": np.sqrt(left + PRESS**2)}
    loud = [n.mean(0) for _, n in sensors.values()]
    spread = np.sqrt(np.mean([n.var(0) for _, n in sensors.values()], axis=0) + OTHER_NOISE**2)
    out = {
        "mean": mean.mean(0),
        "directions": directions,
        "own": own,
        "noise": np.mean(loud, axis=0),
        "noise_spread": spread,
    }
    out |= change
    return {"sensors": list(sensors)} | {k: np.round(v, 4).tolist() for k, v in out.items()}


# --- judging: what is hidden (counts (n, 19), rest (19,), generator) -> counts, channels


def lively(x, rng, number):
    swing = np.quantile(x, 0.97, 0) - np.quantile(x, 0.03, 0)
    return int(rng.choice(np.argsort(swing)[-number:]))


def flip(x, rest, rng):
    k = lively(x, rng, 8)
    about = rest[k] if rng.random() < 0.5 else np.median(x[:, k])
    x[:, k] = about - rng.uniform(0.7, 1.3) * (x[:, k] - about)
    return [k]


def gain(x, rest, rng):
    k = lively(x, rng, 10)
    x[:, k] = rest[k] + min(np.exp(rng.choice([-1, 1]) * rng.uniform(0.7, 1.4)), 2.5) * (x[:, k] - rest[k])
    return [k]


def pair(x, rest, rng):
    a = lively(x, rng, 12)
    b = int(rng.choice(np.delete(np.arange(19), a)))
    x[:, [a, b]] = x[:, [b, a]]
    return [a, b]


def three(x, rest, rng):
    p = rng.choice(19, 3, replace=False)
    x[:, p] = x[:, np.roll(p, 1)]
    return list(p)


def block(x, rest, rng):
    """A connector that sits one contact beside its place."""
    p = int(rng.integers(14)) + np.arange(int(rng.integers(3, 6)))
    x[:, p] = x[:, np.roll(p, 1)]
    return list(p)


def heard(x, rest, rng):
    """The multiplexer has not settled: a part of the channel before."""
    x += rng.uniform(0.2, 0.45) * (np.roll(x - rest, 1, 1) - (x - rest))
    return list(range(19))


def _later(act):
    def begun(x, rest, rng):
        wrong = x.copy()
        channels = act(wrong, rest, rng)
        first = int(rng.uniform(0.2, 0.5) * len(x))
        x[first:] = wrong[first:]
        return channels

    return begun


def fading(x, rest, rng):
    k = lively(x, rng, 8)
    course = np.linspace(0, 1, len(x)) ** rng.uniform(0.6, 1.6)
    x[:, k] = rest[k] + rng.uniform(0.2, 0.45) ** course * (x[:, k] - rest[k])
    return [k]


ALWAYS = {
    "flip": ("flip", flip),
    "gain": ("gain", gain),
    "pair": ("swap", pair),
    "three": ("swap", three),
    "block": ("swap", block),
    "heard": ("crosstalk", heard),
}
WITHIN = {
    "flip later": ("flip", _later(flip)),
    "gain later": ("gain", _later(gain)),
    "pair later": ("swap", _later(pair)),
    "gain fading": ("gain", fading),
}
RESTING = ("pair", "three", "block")
# of the base signals: what they have by themselves, and levels that must not be known
OWN = {
    "F1": ({"warmup", "latency", "freeze"}, {"epfl_f1"}),
    "F2": ({"warmup", "latency", "freeze"}, {"epfl_f2"}),
    "N": ({"warmup", "freeze"}, {"epfl_f2"}),
    "hold": ({"warmup", "thermal", "fluidloss"}, {"phac_f0", "phac_f1"}),
    "scrape": ({"freeze"}, {"epfl_f1"}),
}


def signals(data: pathlib.Path, number: int):
    """(base, counts (n, 19), force (n, 3) or None, rest (19,), rate) of clean pieces, `number` of each
    sensor."""
    force = {
        "F1": data / "epfl_flat_press/ForceData.txt",
        "F2": data / "epfl_f2/ForceData.txt.gz",
        "N": None,
    }
    for name, path in force.items():
        counts = np.loadtxt(data / (FILES | {"N": "epfl_flat_press/SynImpF2.txt"})[name])
        load = None if path is None else np.loadtxt(path)[: len(counts)]
        counts = counts[: None if load is None else len(load)]
        rng = np.random.default_rng([8, len(name), number])
        for i in range(number):
            n = int(np.exp(rng.uniform(np.log(14), np.log(110))) * RATE)
            a = int((i + 0.5) / number * (len(counts) - n))
            x, f = counts[a : a + n], None if load is None else load[a : a + n]
            least = slice(None) if f is None else np.abs(f[:, 2]) <= np.quantile(np.abs(f[:, 2]), 0.06)
            yield name, x, f, np.median(x[least], axis=0), RATE
    holds = sorted((data / "phac_hold").glob("*_HOLD.mat"))
    for i in range(number):
        x = scipy.io.loadmat(holds[i % len(holds)])[f"F{i // len(holds) % 2}Electrodes"].T.astype(float)
        yield "hold", x, None, np.median(x, axis=0), 100.0
    rest = sound.SENSORS["epfl_f1"].rest
    for i in range(number // 4):
        tared = np.loadtxt(data / "scraping" / f"sense_R_{('RF', 'LF')[i % 2]}.txt.gz")
        part = np.array_split(np.round(rest + tared), 2)[i // 2 % 2]
        yield "scrape", part, None, np.median(part, axis=0), 100.0


def named(x, force, rate, full):
    """Findings, and the session without their effects."""
    if full:
        d = diagnose_recording(PlainRecording(x, force, rate=rate))
        found, session = [*d.findings, *d.late], d.session
    else:
        session, found = Session(PlainRecording(x, rate=rate), np.arange(len(x)) < 0.6 * len(x)), []
        for find in (
            lambda: louder(session, {f.channels for f in found}),
            lambda: miswired(session, {(f.id, f.channels) for f in found}),
        ):
            while len(found) < 3 and (one := find()) is not None:
                found.append(one)
                session.accept(one)
    return found, session


def closed(session, right, x, clean, channels):
    """Share of the change of the hidden channels' counts that the right findings take out, of the rows kept
    aside."""
    aside = np.ix_(~session.fit, channels)
    left = session.without(*(f for f in session.findings if f not in right)).filled()
    rms = [np.sqrt(np.mean((y - clean)[aside] ** 2)) for y in (left, x)]
    return 1 - rms[0] / max(rms[1], 1e-9)


def judge(data: pathlib.Path, number: int, full: bool) -> None:
    """Prints names right, wrong and missed, by what is hidden."""
    measure = {name: [n for p in pieces(read(data, name)) if (n := numbers(p)) is not None] for name in FILES}
    others = {}
    for name in ("F1", "F2", "N", "hold", "scrape"):
        kept = {k: tuple(map(np.array, zip(*v))) for k, v in measure.items() if k != name}
        others[name] = statistics(kept)
    patterns, table, most = sound.PATTERNS, {}, 0.0
    for number_of, (base, clean, force, rest, rate) in enumerate(signals(data, number)):
        natural, hidden_levels = OWN[base]
        sound.measured = lambda known=others[base]: known
        sound.PATTERNS = tuple(p for p in patterns if p not in hidden_levels)
        loaded = base in FILES
        kinds = {"nothing": (None, None)} | (ALWAYS | WITHIN if loaded else {})
        if base in ("N", "hold"):
            kinds |= {k: ALWAYS[k] for k in RESTING}
        for kind, (name, act) in kinds.items():
            rng = np.random.default_rng(zlib.crc32(f"{kind}{number_of}".encode()))
            x = clean.copy()
            channels = act(x, rest, rng) if act else []
            x = np.clip(np.round(x), 0, 4095)
            began = time.process_time()
            found, session = named(x, force if rng.random() < 0.5 else None, rate, full)
            most = max(most, time.process_time() - began)
            right = [f for f in found if name in (f.id, *f.ties) and set(f.channels) & set(channels)]
            wrong = [f for f in found if f not in right and f.id not in natural]
            row = table.setdefault((kind, "pressed" if loaded else "resting"), [0, 0, 0, 0, []])
            exact = any(set(f.channels) == set(channels) for f in right)
            for i, counted in enumerate((1, bool(right), exact, bool(wrong))):
                row[i] += counted
            if right:
                row[4].append(closed(session, right, x, clean, channels))
            for f in wrong:
                print(
                    f"  {base} {number_of} {kind} {channels}: {f.id} {f.channels} {f.confidence:.2f}",
                    flush=True,
                )
    print(f"{'hidden':<14}{'':<9}pieces  named  same channels  wrong name  closed, median")
    for (kind, loaded), (pieces_of, right, exact, wrong, shares) in table.items():
        share = f"{np.median(shares):>14.0%}" if shares else ""
        print(f"{kind:<14}{loaded:<9}{pieces_of:>6}{right:>7}{exact:>15}{wrong:>12}{share}")
    print(f"processor time of a piece: most {most:.1f} s")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=pathlib.Path)
    parser.add_argument("--out", type=pathlib.Path)
    parser.add_argument("--judge", action="store_true")
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--number", type=int, default=12, help="pieces of each sensor")
    given = parser.parse_args()
    if given.judge:
        judge(given.data, given.number, given.full)
        return
    if given.out is None:
        parser.error("give --out FILE or --judge")
    sensors = {}
    for name in FILES:
        found = [n for piece in pieces(read(given.data, name)) if (n := numbers(piece)) is not None]
        sensors[name] = tuple(np.array(part) for part in zip(*found))
    given.out.write_text(json.dumps(statistics(sensors)) + "\n")


if __name__ == "__main__":
    main()
