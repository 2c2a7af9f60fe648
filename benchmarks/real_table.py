"""The table 'real against simulated': every row of recordings and of the simulated sensor as it is now.

python benchmarks/real_table.py --data DIR --json OUT --figure OUT.png

Under DIR, packed (.gz) or not, in folders of any depth: `ForceData.txt` with a pressed sensor's
`SynImpF*.txt` beside it (the first; others are unloaded neighbours), `*_HOLD.mat` of two sensors that hold
an object, `*.btd` of a sensor that rests, is pressed and let go, and is tapped. The simulated sensor is the
default one on `--skin` under a flat plate; pressed rows have the state that `matching` finds for them with
all gains 1 and the rubber's own modulus, so that both columns are of the same presses. Such a row is inside
where no simulated value is further from the real one of the same recording than the real ones are from each
other (of a single one: than 10 %); a row of what a sensor has of its own, where no simulated value leaves
the real ones' spread by more than 10 %."""

import argparse
import gzip
import pathlib
import tempfile

import mujoco
import numpy as np
import scipy.io
import scipy.signal
from real_match import table
from records import write_json
from vibration import read_rows, resting

import biotac_mj
from biotac_mj.geometry.design import electrode_positions
from biotac_mj.matching.fit import Setup, fit_constants, rows_of
from biotac_mj.matching.response import Response
from biotac_mj.recordings import load_one
from biotac_mj.sensor.acquisition import Acquisition
from biotac_mj.sensor.channels import (
    PDC_REST,
    REST_TEMPERATURE,
    counts_from_log_impedance,
    counts_from_pressure,
    counts_from_temperature,
    electrode_noise,
    impedance_from_counts,
    log_impedance,
    pressure_from_counts,
)
from biotac_mj.sensor.film import read_film
from biotac_mj.skin.rubber.material import PRESETS

_END = 400  # rows of a hold's end
_SMOOTH = 51  # rows over which slow changes are taken out of noise, half a second
_ALONE = 0.1  # of a value, beyond what real sensors differ by
_TIP = [6, 7, 8]
# [counts] of PDC: of a press that is let go; as far as a plate brings it short of the core
_PRESSED, _MOST = 100, 300
_PLATE = """<mujoco><option timestep=".002" gravity="0 0 0"/><worldbody><site name="mount" quat="1 -1 0 0"/>
<body mocap="true" pos="-.009 0 .011"><geom type="box" size=".02 .02 .002"/></body></worldbody></mujoco>"""
_BALL = """<mujoco><option timestep=".001" gravity="0 0 0"/><worldbody><site name="mount" quat="1 -1 0 0"/>
<body pos="-.009 0 .0183"><joint type="slide" axis="0 0 -1"/><geom size=".005" mass=".002"/></body>
</worldbody></mujoco>"""  # thrown at the pad
# [s] from a tap's loudest sample: what is quiet before it and after it; RMS there, of the loudest; [counts]
# of PDC from one to the other
_BEFORE, _AFTER, _QUIET, _SAME = (-0.06, -0.01), (0.04, 0.1), 0.1, 10
_NEAR, _FAR = 5e-3, 12e-3  # [m] between electrodes that are near and far


def _text(path, folder):
    """The path of a text file, unpacked into a folder where it is packed."""
    if path.suffix != ".gz":
        return path
    out = pathlib.Path(folder) / (path.parent.name + "_" + path.stem)
    out.write_bytes(gzip.decompress(path.read_bytes()))
    return out


def presses(data: pathlib.Path, folder: str) -> tuple[dict, dict]:
    """{name: Recording} of pressed sensors with their force, and of unloaded neighbours without."""
    pressed, free = {}, {}
    for force in sorted(data.rglob("ForceData.txt*")):
        own, *others = sorted(force.parent.glob("SynImp*.txt*"))
        pressed[force.parent.name] = load_one(_text(own, folder), force=_text(force, folder))[0]
        for other in others:
            free[f"{force.parent.name}/{other.name.split('.')[0]}"] = load_one(_text(other, folder))[0]
    return pressed, free


def _noise(series):
    """Standard deviation (k,) of what changes between rows of (n, k) but for what is slow."""
    kernel = np.ones(_SMOOTH) / _SMOOTH
    fast = series - np.apply_along_axis(lambda c: np.convolve(c, kernel, "same"), 0, series)
    return fast[_SMOOTH:-_SMOOTH].std(0)


def _lag(blocks):
    blocks = blocks - blocks.mean()
    return float((blocks[:, 1:] * blocks[:, :-1]).mean() / (blocks * blocks).mean())


def _held(electrodes, pac, pdc):
    """What the table says of a sensor that holds something still: counts (n, 19), (22, n), (n,)."""
    end = pac[:, -_END:].T
    return {
        "noise of an electrode [counts]": float(np.median(_noise(electrodes))),
        "noise of PDC [counts]": float(_noise(pdc[:, None])[0]),
        "PAC at rest, std [counts]": float(end.std()),
        "PAC at rest, lag-1 correlation": _lag(end.reshape(1, -1)),
    }


def _replayed(electrodes, pdc, seed):
    """The same of the default sensor, which bears the slow part of what PDC (n,) says and the electrodes'
    median counts."""
    sensor = Acquisition(seed=seed)
    state, rows = np.zeros(sensor.nstate), []
    window = scipy.signal.windows.hann(2 * _SMOOTH + 1)  # smooth, so that PDC's noise is none of PAC's
    slow = np.convolve(np.pad(pdc, _SMOOTH, "edge"), window / window.sum(), "valid")
    pressure = pressure_from_counts(PDC_REST + slow - slow[0])
    impedance = impedance_from_counts(np.median(electrodes, 0))
    sensor.reset(state, impedance, pressure[0])
    for i, now in enumerate(pressure):
        sensor.advance(state, i * 0.01, 0.01, impedance, now)
        rows.append(sensor.readings(state))
    counts = {name: np.array([row[name] for row in rows], float) for name in ("electrodes", "pac", "pdc")}
    return _held(counts["electrodes"], counts["pac"].T, counts["pdc"])


def holds(data: pathlib.Path) -> dict:
    """{finger: (rows of that finger's holds, those of the simulated sensor)}, and under None what the fingers
    share. Noise is that of the third of the holds with the least effort: what is soft keeps the gripper's
    motion from the fingers."""
    files = [scipy.io.loadmat(path) for path in sorted(data.rglob("*_HOLD.mat"))]
    files.sort(key=lambda file: abs(np.median(file["JEff"])))
    soft, found = files[: -(-len(files) // 3)], {}
    for finger in ("F0", "F1") if files else ():
        parts = []
        for number, file in enumerate(soft):
            electrodes, pac = (file[finger + name].astype(float) for name in ("Electrodes", "pac"))
            pdc = file[finger + "pdc"].ravel().astype(float)
            parts.append((_held(electrodes.T, pac, pdc), _replayed(electrodes.T, pdc, number)))
        real, mine = ({k: float(np.median([p[k] for p in one])) for k in one[0]} for one in zip(*parts))
        tdc = np.median([file[finger + "tdc"].ravel()[:20].mean() for file in files])
        real["TDC at rest [counts]"] = float(tdc)
        mine["TDC at rest [counts]"] = float(counts_from_temperature(REST_TEMPERATURE))
        found[finger] = real, mine
    if files:
        found[None] = {"soft": _shared(soft), "firm": _shared(files[len(soft) :])}
    return found


def firm_holds(data: pathlib.Path, response: Response, modulus: float) -> dict:
    """{finger: (real, simulated)}: by how much PDC is higher in the holds that are not soft, median [counts],
    and in the states of a plate that change the electrodes by as much, mean of the straight ways."""
    files = [scipy.io.loadmat(path) for path in sorted(data.rglob("*_HOLD.mat"))]
    files.sort(key=lambda file: abs(np.median(file["JEff"])))
    cut, out = -(-len(files) // 3), {}
    pdc = counts_from_pressure(response.states.pressure[:, :, 0] * modulus) - PDC_REST
    for finger in ("F0", "F1") if len(files) > cut else ():
        held = [
            [np.median(file[finger + name][..., -_END:], -1) for name in ("Electrodes", "pdc")]
            for file in files
        ]
        rest, level = (np.median([np.ravel(h[i]) for h in held[:cut]], 0) for i in (0, 1))
        change = counts_from_log_impedance(log_impedance(rest) + response.log_z[:, :, 0]) - rest
        size = np.sqrt((change * change).mean(-1)).reshape(-1, change.shape[2])
        rows = []
        for electrodes, now in held[cut:]:
            here = _rms(np.ravel(electrodes) - rest)
            at = [np.interp(here, s, p) for s, p in zip(size, pdc.reshape(size.shape), strict=True)]
            rows.append([float(np.ravel(now)[0] - level[0]), np.mean(at)])
        out[finger] = tuple(np.median(rows, 0).tolist())
    return out


def _shared(files):
    """Coherence of both fingers' PAC and its mean square [counts^2] below 20 Hz, mean of the holds."""
    rows = []
    for file in files:
        both = [file[f + "pac"].astype(float)[:, -_END:].T.ravel() for f in ("F0", "F1")]
        f, coherence = scipy.signal.coherence(*both, 22 * 100, nperseg=1024)
        power = np.mean([scipy.signal.welch(one, 22 * 100, nperseg=1024)[1] for one in both], 0)
        low = (f > 4) & (f < 20)
        rows.append([coherence[low].mean(), power[low].sum() * f[1]])
    return dict(zip(("coherence", "mean_square"), np.mean(rows, 0).tolist(), strict=True))


def release(path: pathlib.Path, skin: str) -> dict | None:
    """{row: (real, simulated)} of what a native log has after a press is let go, which is where PDC falls
    most, and the simulated sensor after a plate has pressed it; None of a log without."""
    rows = read_rows(path)
    (time, pdc), (fast, pac) = (rows[rows[:, 1] == channel][:, [0, 2]].T for channel in (1, 0))
    end = time[np.argmin(np.diff(pdc)) + 1]
    rest = np.median(pdc[: len(pdc) // 10])
    load = float(np.median(pdc[(time > end - 1.0) & (time < end - 0.2)]) - rest)
    if load < _PRESSED:
        return None
    real = _after(time - end, pdc - rest, fast - end, pac, load)
    return {name: (one, other) for (name, one), other in zip(real.items(), _lifted(skin, load).values())}


def _after(time, pdc, fast, pac, load):
    """Of PDC beyond rest and PAC (counts), by the time since a load in PDC's counts was let go."""

    def below(start, stop):
        return -float(np.median(pdc[(time >= start) & (time < stop)])) / load

    late = pac[(fast > 0.3) & (fast < 0.55)]
    return {
        "PDC below rest after let-go, 0.05 s; of its load": below(0.0, 0.05),
        "the same, 0.4 s": below(0.3, 0.5),
        "the same, 2 s": below(1.5, 2.5),
        "PAC 0.3 to 0.55 s after let-go, std [counts]": float(late.std()),
    }


def _lifted(skin, load):
    """`_after` of the default sensor: a plate on the pad goes down until PDC is `load` counts higher, or
    _MOST, stays for a second, and is lifted by 4 mm in 20 ms."""
    spec = mujoco.MjSpec.from_string(_PLATE)
    handle = biotac_mj.attach(spec, site="mount", tier="condensed", skin=skin)
    model = spec.compile()
    data = mujoco.MjData(model)
    start, rows, depth, lifted = data.mocap_pos[0].copy(), [], 0.0, 0.0
    rest, load = handle.numbers.pdc_rest, min(load, _MOST)
    begun = end = None
    while end is None or data.time < end + 2.5:
        if begun is None:
            depth += 2e-5
        elif data.time > begun + 1.0:
            lifted = min(lifted + 4e-4, 4e-3)
        data.mocap_pos[0] = start - [0, 0, depth - lifted]
        mujoco.mj_step(model, data)
        pdc = float(handle.read(data, "pdc")[0])
        if begun is None and pdc > rest + load:
            begun = data.time
        if end is None and lifted > 0 and not handle.read(data, "contact_force").any():
            end = data.time
        if model.opt.timestep > (data.time + 1e-9) % 0.01:
            rows.append((data.time, pdc - rest, *handle.read(data, "pac")))
    time, pdc, *pac = np.array(rows).T
    fast = (time[:, None] + np.arange(-len(pac), 0) / (100 * len(pac))).ravel()
    return _after(time - end, pdc, fast - end, np.array(pac).T.ravel(), load)


def tap(path: pathlib.Path, skin: str) -> dict | None:
    """{row: (real, simulated)} of the loudest tap of a native log, and of a ball of 2 g thrown so that PAC
    becomes as loud; None of a log without. What taps the real sensor is not known."""
    rows = read_rows(path)
    slow, fast = (rows[rows[:, 1] == channel][:, [0, 2]].T for channel in (1, 0))
    real = _rung(slow, fast)
    if real is None:
        return None
    name, speed = next(iter(real)), 0.05
    for _ in range(2):
        mine = _rung(*_thrown(skin, speed))
        speed *= real[name] / mine[name]
    return {name: (one, mine[name]) for name, one in real.items()}


def _rung(slow, fast):
    """Of PDC and PAC, (2, n) time [s] and counts each: how the loudest tap dies away. None without a tap."""
    time, pac = fast[0], fast[1] - np.median(fast[1])

    def around(at, series, window):
        return series[1][(series[0] >= at + window[0]) & (series[0] < at + window[1])]

    for k in np.argsort(-np.abs(pac))[: len(pac) // 20]:
        peak, at = abs(pac[k]), time[k]
        parts = [around(at, fast, window) - np.median(fast[1]) for window in (_BEFORE, _AFTER)]
        levels = [around(at, slow, window) for window in (_BEFORE, _AFTER)]
        if min(map(len, parts)) < 40 or min(map(len, levels)) < 2 or max(map(_rms, parts)) >= _QUIET * peak:
            continue
        rest, end = map(np.median, levels)
        if abs(end - rest) > _SAME:
            continue
        during, later = (time >= at) & (time < at + _AFTER[1]), around(at, slow, (0.0, _AFTER[1])) - rest
        left = [time[during & (np.abs(pac) > part * peak)][-1] - at for part in (1 / np.e, 0.1)]
        return {
            "a tap: PAC's largest [counts]": float(peak),
            "the same: PAC under 1/e of it after [ms]": 1e3 * float(left[0]),
            "the same: under a tenth after [ms]": 1e3 * float(left[1]),
            "the same: PDC's largest rise [counts]": float(later.max()),
            "the same: PDC's largest fall [counts]": float((-later).max()),
        }
    return None


def _thrown(skin, speed):
    """PDC and PAC as in `_rung` of the default sensor without noise, which a ball hits at a speed [m/s]."""
    spec = mujoco.MjSpec.from_string(_BALL)
    handle = biotac_mj.attach(spec, site="mount", tier="condensed", skin=skin, readings={"noise": False})
    model = spec.compile()
    data, rows = mujoco.MjData(model), []
    data.qvel[0] = speed
    while data.time < 0.3:
        mujoco.mj_step(model, data)
        if model.opt.timestep > (data.time + 1e-9) % 0.01:
            rows.append((data.time, handle.read(data, "pdc")[0], *handle.read(data, "pac")))
    time, pdc, *pac = np.array(rows).T
    fast = (time[:, None] + np.arange(-len(pac), 0) / (100 * len(pac))).ravel()
    return np.array([time, pdc]), np.array([fast, np.array(pac).T.ravel()])


def measures(counts: np.ndarray, rest: np.ndarray, pressing: np.ndarray) -> dict:
    """What the table says of pressed rows: counts (n, 19), at rest (n, 19), force (n,) [N]."""
    change, log_z = counts - rest, log_impedance(counts) - log_impedance(rest)
    light, firm = (pressing > 2) & (pressing < 4), (pressing > 4) & (pressing < 6)
    centred = log_z - log_z.mean(0)
    power = np.linalg.svd(centred, compute_uv=False) ** 2
    u, s, v = np.linalg.svd(change - change.mean(0), full_matrices=False)
    rest8 = u[:, 8:] * s[8:] @ v[8:]
    return {
        "RMS change at 2-4 N [counts]": _rms(change[light]),
        "RMS change at 4-6 N [counts]": _rms(change[firm]),
        "largest change [counts]": float(np.abs(change).max()),
        "lowest count": float(counts.min()),
        "mean change of ln Z at 4-6 N": _mean(log_z[firm]),
        "share with more counts than at rest, 2-4 N": _mean(change[light] > 0),
        "E7 to E9 at 4-6 N [counts]": _mean(change[firm][:, _TIP]),
        "participation dimension": float(power.sum() ** 2 / (power * power).sum()),
        "left after 8 principal components [counts]": _rms(rest8),
        **_correlations(log_z),
    }


def _correlations(log_z):
    place = electrode_positions() * 1e-3
    apart = np.linalg.norm(place[:, None] - place, axis=-1)
    pair = np.corrcoef(log_z.T)
    return {
        "correlation of near electrodes": float(pair[(apart > 0) & (apart < _NEAR)].mean()),
        "correlation of far electrodes": float(pair[apart > _FAR].mean()),
    }


def _mean(x):
    return float(np.mean(x)) if x.size else float("nan")


def _rms(x):
    return float(np.sqrt(_mean(np.square(x))))


def build(data: pathlib.Path, skin: str, every: int, calibrated: bool) -> tuple[list[dict], dict | None]:
    """Rows of the table: name, real and simulated values by recording, whether these are inside; and what
    the fingers of a gripper share."""
    rows = {}

    def add(name, where, real, simulated):
        row = rows.setdefault(name, {"name": name, "real": {}, "simulated": {}})
        row["real"][where] = real
        if simulated is not None:
            row["simulated"][where] = simulated

    held = holds(data)
    shared = held.pop(None, None)
    for finger, (real, mine) in held.items():
        for name, value in real.items():
            add(name, finger, value, mine[name])
    for path in sorted(data.rglob("*.btd*")):
        real, mine = resting(path)
        for name, one in (("std [counts]", np.std), ("lag-1 correlation", _lag)):
            add(f"PAC at rest, {name}", path.name, float(one(real)), float(one(mine)))
        for name, pair in {**(release(path, skin) or {}), **(tap(path, skin) or {})}.items():
            add(name, path.name, *pair)
    with tempfile.TemporaryDirectory() as folder:
        pressed, free = presses(data, folder)
    for name, recording in free.items():
        noise = float(np.median(_noise(recording.counts()[0])))
        add(
            "noise of an electrode [counts]",
            name,
            noise,
            float(np.median(electrode_noise(recording.counts()[0].mean(0)))),
        )
        warm = log_impedance(recording.counts()[0])
        n = max(len(warm) // 50, 1)
        add("warm-up of an unloaded sensor, ln Z", name, float((warm[-n:] - warm[:n]).mean()), 0.0)
    if pressed:
        material = "calibrated" if calibrated else "default"
        response = table(skin, material, read_film(None, PRESETS[material].electrode_radius))
        modulus = PRESETS[material].youngs_modulus
        for finger, pair in firm_holds(data, response, modulus).items():
            add("PDC in a firm hold over a soft one [counts]", finger, *pair)
    for name, recording in pressed.items():
        taken = rows_of(recording.counts()[0], recording.force, every)
        const, found = fit_constants(response, taken, Setup(gains=0.0, modulus=modulus, hold_modulus=True))
        rest = counts_from_log_impedance(const.offset + const.drifted(taken.time)[:, None])
        noise = np.random.default_rng(0).normal(0, electrode_noise(found.counts))
        real = measures(taken.counts, rest, taken.force[:, 2])
        mine = measures(np.clip(np.round(found.counts + noise), 0, 4095), rest, taken.force[:, 2])
        for key in real:
            if np.isfinite(real[key]):  # else no row has such a force
                add(key, name, real[key], mine[key])
    for row in rows.values():
        real = row["real"]
        low, high = min(real.values()), max(real.values())
        if pressed.keys() & real.keys():
            apart = high - low if len(real) > 1 else _ALONE * abs(low)
            row["inside"] = all(abs(v - real[k]) <= apart for k, v in row["simulated"].items())
        else:
            low, high = low - _ALONE * abs(low), high + _ALONE * abs(high)
            row["inside"] = all(low <= v <= high for v in row["simulated"].values())
    return list(rows.values()), shared


def draw(path: pathlib.Path, rows: list[dict]) -> None:
    """Every row as ratios to the mean real size: real values as dots, simulated ones as crosses."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(11, 0.36 * len(rows) + 1.2))
    for k, row in enumerate(rows):
        real, mine = (np.array(list(row[key].values())) for key in ("real", "simulated"))
        scale = np.abs(real).mean() or 1.0
        axes.plot(
            [real.min() / scale, real.max() / scale],
            [k, k],
            color="0.8",
            lw=8,
            solid_capstyle="butt",
            zorder=0,
        )
        axes.plot(real / scale, np.full(len(real), k), "o", color="C0", label="real" if k == 0 else None)
        axes.plot(
            mine / scale, np.full(len(mine), k), "x", color="C3", mew=2, label="simulated" if k == 0 else None
        )
        spread = [
            f"{v.min():.4g}" if np.ptp(v) == 0 else f"{v.min():.4g} .. {v.max():.4g}" for v in (real, mine)
        ]
        axes.text(
            1.01,
            k,
            f"{spread[0]}   |   {spread[1]}",
            transform=axes.get_yaxis_transform(),
            va="center",
            fontsize=8,
        )
    axes.set_yticks(range(len(rows)), [("" if r["inside"] else "* ") + r["name"] for r in rows], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel(
        "value over the mean size of the real ones; right: real | simulated; * outside the real spread"
    )
    axes.legend(loc="upper left", fontsize=8)
    axes.grid(axis="x", color="0.9")
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    plt.close(figure)


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--data", type=pathlib.Path, required=True, help="folder with the recordings")
    parser.add_argument("--json", type=pathlib.Path, default="out/benchmarks/real_table.json")
    parser.add_argument("--figure", type=pathlib.Path)
    parser.add_argument("--skin", default="coarse")
    parser.add_argument("--every", type=int, default=20, help="of the loaded rows one is taken")
    parser.add_argument("--calibrated", action="store_true", help="rubber and electrodes that were fitted")
    given = parser.parse_args(argv)
    given.json.parent.mkdir(parents=True, exist_ok=True)
    rows, shared = [], None
    if given.data.is_dir():
        rows, shared = build(given.data, given.skin, given.every, given.calibrated)
    if not rows:
        parser.error(
            f"{given.data} has no recordings: ForceData.txt with SynImp*.txt, *_HOLD.mat "
            "or *.btd are looked for"
        )
    inside = sum(r["inside"] for r in rows)
    write_json(given.json, {"rows": rows, "inside": inside, "shared": shared})
    for row in rows:
        real, mine = ([f"{v:.4g}" for v in row[key].values()] for key in ("real", "simulated"))
        print(
            f"{row['name']:46s} {', '.join(real):34s} | {', '.join(mine):34s} "
            f"{'' if row['inside'] else 'outside'}"
        )
    for what, one in (shared or {}).items():
        print(
            f"PAC below 20 Hz in {what} holds: {one['mean_square']:.1f} counts^2, "
            f"coherence of the fingers {one['coherence']:.2f}"
        )
    if given.figure:
        draw(given.figure, rows)


if __name__ == "__main__":
    main()
