"""Contact cooling: the heat model against recordings of two BioTacs that hold objects for 10 s.

python benchmarks/thermal.py --data DIR --json OUT [--figure OUT.png]

DIR has `<object>_<id>_<trial>_HOLD.mat` (F?tdc, F?tac and the gripper's JEff at 100 Hz). Objects are looked
up by name in `assets/materials.txt`. Fitted on trials 1 to 3 of steel and acrylic, all fingers together:
heater, losses, contact conductance and area (`_START` below, with the width of what sources leave open as a
prior), TAC's gain and each finger's rest. Everything else is predicted: a trial's grip force (JEff) and first
temperature are its only input. Without such trials the sensor is `HeatParameters()`."""

import argparse
import dataclasses
import json
import pathlib
import re
import sys
import time

import numpy as np
import scipy.io
from records import write_json
from scipy.optimize import least_squares

from biotac_mj.sensor import channels
from biotac_mj.sensor.heat import THERMISTOR, Heat, HeatParameters
from biotac_mj.sensor.materials import material_of

__all__ = ["Trace", "fit", "predict", "read", "report", "tac_corner"]

CORNERS = (0.25, 0.45)  # [Hz] of TAC's filter; both stand in the manual
_RATE, _DT = 100.0, 0.05  # [1/s] of the recordings; [s] of the model's steps
_EVERY = 10  # samples of a recording that are compared, 0.1 s apart
_SIGMA_T, _SIGMA_TAC = 0.03, 6.0  # [C], [counts]: what differs between like trials
_TOGETHER = 9  # compared samples that count as one: residuals are correlated over about a second
_FORCE = 12.0  # [N] at which `area` is meant
# Value and relative width of what sources say. Of HeatParameters: docs/lab/sensor.md. area [m^2] at 12 N and
# its exponent over the force (Hertz 2/3, a cushion between plates 1); lead: time that closing takes [s].
_START = {
    "near": (1.0, 0.7),
    "spread": (0.5, 1.0),
    "conductivity": (0.2, 0.1),
    "thickness": (1.5e-3, 0.3),
    "film": (2000.0, 0.7),
    "contact": (1e4, 1.5),
    "inside": (0.06, 0.2),
    "air": (13.0, 0.2),
    "mount": (0.022, 0.4),
    "area": (8e-5, 0.7),
    "exponent": (0.8, 0.3),
    "lead": (1.0, 0.7),
}
# What this file fits to PHAC's steel and acrylic, for data that have neither; TAC: counts per C/s, at rest
_FITTED = {"area": 4.28e-5, "exponent": 0.839, "lead": 0.792}
_TAC = (1729.0, 2047.3, 2025.5)


@dataclasses.dataclass(frozen=True)
class Trace:
    """One finger in one trial, every 0.1 s.

    Attributes:
      name: of the object; trial: its number; finger: 0 or 1.
      time: (n,) since the hold began [s]; tdc: (n,) change of the temperature since then [C].
      tac: (n,) counts.
      start: temperature at the beginning [C]; force: of the grip [N].
      counts: TDC and TAC (2, 1000) as recorded.
    """

    name: str
    trial: int
    finger: int
    time: np.ndarray
    tdc: np.ndarray
    tac: np.ndarray
    start: float
    force: float
    counts: np.ndarray

    @property
    def train(self) -> bool:
        return self.trial <= 3 and bool({"steel", "acrylic"} & set(self.name.split("_")))

    @property
    def change(self) -> float:
        """Temperature after 10 s less that at the beginning [C]."""
        return float(self.tdc[-3:].mean())


def read(folder: str | pathlib.Path) -> tuple[list[Trace], dict[str, str]]:
    """All traces of a folder, and why others are left out, by file and finger.

    Raises:
      FileNotFoundError: it has no recordings that can be used.
    """
    traces, left_out = [], {}
    for path in sorted(pathlib.Path(folder).glob("*_HOLD.mat")):
        name, trial = re.fullmatch(r"(.+?)(?:_\d+)?_(\d+)_HOLD", path.stem).groups()
        try:
            material_of(name)
            data = scipy.io.loadmat(path)
        except Exception as error:  # a file's reader raises whatever it likes
            left_out[path.name] = str(error) or type(error).__name__
            continue
        for finger in (0, 1):
            try:
                traces.append(_trace(data, name, int(trial), finger))
            except ValueError as error:
                left_out[f"{path.name} F{finger}"] = str(error)
    lengths = [len(t.time) for t in traces]
    usual = max(lengths, key=lengths.count, default=0)
    for t in [t for t in traces if len(t.time) != usual]:
        left_out[f"{t.name} {t.trial} F{t.finger}"] = f"{len(t.time)} samples where most have {usual}"
    traces = [t for t in traces if len(t.time) == usual]
    if not traces:
        why = "; ".join(f"{k}: {v}" for k, v in left_out.items()) or "no *_HOLD.mat"
        raise FileNotFoundError(f"{folder} has no recording of a hold that can be used ({why})")
    return traces, left_out


def _trace(data, name, trial, finger):
    missing = [key for key in (f"F{finger}tdc", f"F{finger}tac", "JEff") if np.size(data.get(key, ())) == 0]
    if missing:
        raise ValueError(f"it has no {' and no '.join(missing)}")
    counts = [np.ravel(data[f"F{finger}{channel}"]) for channel in ("tdc", "tac")]
    if len({len(c) for c in counts}) > 1 or len(counts[0]) < _RATE:
        raise ValueError(f"TDC and TAC have {len(counts[0])} and {len(counts[1])} samples: a second at least")
    counts = np.array(counts, float)
    if not (np.isfinite(counts).all() and np.isfinite(np.asarray(data["JEff"], float)).all()):
        raise ValueError("samples are not finite")
    for which, channel in zip(("TDC", "TAC"), counts):
        if np.mean((channel <= 0) | (channel >= channels.FULL_SCALE)) > 0.05:
            raise ValueError(f"{which} is at an end of its 12 bits")
    temperature = channels.temperature_from_counts(counts[0])
    start = float(np.median(temperature[:10]))
    pick = np.arange(_EVERY // 2 - 1, counts.shape[1], _EVERY)
    return Trace(
        name=name,
        trial=trial,
        finger=finger,
        time=pick / _RATE,
        tdc=temperature[pick] - start,
        tac=counts[1, pick],
        start=start,
        force=float(abs(np.median(data["JEff"]))),
        counts=counts,
    )


def tac_corner(traces: list[Trace], corner: float) -> float:
    """RMS [counts] of what TAC has beyond a first-order low-pass of the recorded TDC's derivative, without a
    model of heat. Both are averaged over 0.5 s, so that TDC's steps do not matter."""
    tau, window = 1 / (2 * np.pi * corner), np.ones(50) / 50
    keep = np.exp(-1 / (_RATE * tau))
    rows, values = [], []
    for i, trace in enumerate(traces):
        temperature = channels.temperature_from_counts(trace.counts[0])
        low = np.empty_like(temperature)
        low[0] = temperature[0]
        for k in range(1, len(low)):
            low[k] = keep * low[k - 1] + (1 - keep) * temperature[k - 1]
        decay = keep ** np.arange(len(low))  # what the filter held before the recording
        row = np.zeros((len(low) - 49, 3 + len(traces)))
        row[:, 0] = np.convolve((low - temperature) / tau, window, "valid")
        row[:, 1 + trace.finger] = 1
        row[:, 3 + i] = np.convolve(decay, window, "valid")
        rows.append(row[::5])
        values.append(np.convolve(trace.counts[1], window, "valid")[::5])
    rows, values = np.concatenate(rows), np.concatenate(values)
    solution = np.linalg.lstsq(rows, values, rcond=None)[0]
    return float(np.sqrt(np.mean((values - rows @ solution) ** 2)))


def simulate(values: dict, traces: list[Trace], corner: float, dt: float = _DT) -> tuple:
    """Temperature's change (ntrace, n) [C] and its rate behind TAC's filter (ntrace, n) [C/s], all traces as
    worlds of one `Heat`. values: fields of HeatParameters, and area, exponent, lead."""
    own = {k: v for k, v in values.items() if k in HeatParameters.__dataclass_fields__ and k != "area"}
    own["near"] = min(own.get("near", HeatParameters.near), 0.95 * HeatParameters.core)
    sensor = HeatParameters(**own)
    sensors, bodies = [sensor.at_rest(t.start) for t in traces], [[material_of(t.name)] for t in traces]
    heat = Heat(bodies[0], sensors, len(traces))
    heat.state.assign(np.array([own.rest(touched) for own, touched in zip(sensors, bodies)]))
    force = np.array([t.force for t in traces])
    area = values["area"] * (force / _FORCE) ** values["exponent"]
    # every body has been coming nearer since `lead`: force and area grow evenly
    before, after = int(np.ceil(values["lead"] / dt)), round(10 / dt)
    state, own_area, own_force = heat.state.numpy(), heat.area.numpy(), heat.force.numpy()
    keep = np.exp(-dt * 2 * np.pi * corner)
    temperature, rate = np.empty((2, len(traces), after + 1))
    last, slow = state[:, THERMISTOR].copy(), np.zeros(len(traces))
    for k in range(1 - before, after + 1):
        grown = min(1.0, 1 + (k - 1) * dt / values["lead"]) if k <= 0 else 1.0
        own_area[:, 0], own_force[:, 0] = max(grown, 0) * area, max(grown, 0) * force
        heat.advance(dt)
        now = state[:, THERMISTOR]
        new = (now - last) / dt
        slow = new + (slow - new) * keep
        last = now.copy()
        if k >= 0:
            temperature[:, k], rate[:, k] = now, slow
    times = np.arange(after + 1) * dt
    pick = [
        np.array([np.interp(t.time, times, row) for t, row in zip(traces, x)]) for x in (temperature, rate)
    ]
    return pick[0] - temperature[:, :1], pick[1]


def _tac_terms(rate, traces):
    finger = np.array([[t.finger == 0, t.finger == 1] for t in traces], float)
    fingers = np.broadcast_to(finger[:, None], (*rate.shape, 2))
    return np.concatenate([-rate[..., None], fingers], axis=2)


def fit(traces: list[Trace], corner: float) -> tuple[dict, dict, np.ndarray]:
    """Constants of the sensor and of the grip.

    Returns:
      values by name; their 95 % intervals; TAC's gain [counts per C/s] and rest counts of both fingers (3,).
    """
    names = list(_START)
    start, width = np.array([(np.log(v), s) for v, s in _START.values()]).T
    weight = np.sqrt(_TOGETHER)

    def run(x):
        change, rate = simulate(dict(zip(names, np.exp(x), strict=True)), traces, corner)
        terms, tac = _tac_terms(rate, traces).reshape(-1, 3), np.concatenate([t.tac for t in traces])
        return change, terms, tac, np.linalg.lstsq(terms, tac, rcond=None)[0]

    def residual(x):
        change, terms, tac, gain = run(x)
        warm = (change - np.array([t.tdc for t in traces])).ravel() / _SIGMA_T
        return np.concatenate(
            [warm / weight, (terms @ gain - tac) / _SIGMA_TAC / weight, (x - start) / width]
        )

    best = least_squares(residual, start, max_nfev=40)
    deviation = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)))
    values = dict(zip(names, map(float, np.exp(best.x)), strict=True))
    ends = np.exp(best.x + 1.96 * np.array([[-1], [1]]) * deviation)
    return values, dict(zip(names, ends.T.tolist(), strict=True)), run(best.x)[3]


def predict(values: dict, gain: np.ndarray, traces: list[Trace], corner: float) -> tuple:
    """Temperature's change [C] and TAC [counts], (ntrace, n) each."""
    change, rate = simulate(values, traces, corner)
    return change, _tac_terms(rate, traces) @ gain


def report(traces: list[Trace], change: np.ndarray, tac: np.ndarray) -> dict:
    """What the model says of traces against what they say: see the file's head."""
    objects = {}
    for name in dict.fromkeys(t.name for t in traces):
        mine = [i for i, t in enumerate(traces) if t.name == name and not t.train]  # the predicted ones
        if not mine:
            continue
        fingers = {f: [i for i in mine if traces[i].finger == f] for f in (0, 1)}
        fingers = {f: chosen for f, chosen in fingers.items() if chosen}
        real = np.array([traces[i].change for i in mine])
        error = np.array([change[i] - traces[i].tdc for i in range(len(traces))])
        mean_error = {f: error[chosen].mean(0) for f, chosen in fingers.items()}
        entry = {
            "dT10_real_mean": real.mean(),
            "dT10_real_std": real.std(ddof=1) if len(real) > 1 else 0.0,
            "dT10_model": change[mine, -3:].mean(),
            # of each finger's mean curve, and of every trial by itself, with the spread of the trials in it
            "rms_rel": np.sqrt(np.mean([e**2 for e in mean_error.values()])) / abs(real.mean()),
            "rms_rel_each_trial": np.sqrt((error[mine] ** 2).mean()) / abs(real.mean()),
        }
        for f, chosen in fingers.items():
            own = np.mean([traces[i].change for i in chosen])
            entry |= {
                f"dT10_real_mean_f{f}": own,
                f"dT10_model_f{f}": change[chosen, -3:].mean(),
                f"rms_rel_f{f}": np.sqrt((mean_error[f] ** 2).mean()) / abs(own),
            }
        everything = [t.change for t in traces if t.name == name]
        entry |= {
            "dT10_real_mean_all_trials": np.mean(everything),
            "dT10_real_std_all_trials": np.std(everything),
        }
        material = material_of(name)
        entry |= {"material": material.name, "effusivity": material.effusivity, "traces": len(mine)}
        objects[name] = {k: v if isinstance(v, (str, int)) else float(v) for k, v in entry.items()}
    names = sorted(objects, key=lambda n: objects[n]["dT10_real_mean"])
    model = [objects[n]["dT10_model"] for n in names]
    pairs = [model[i] < model[j] for i in range(len(names)) for j in range(i + 1, len(names))]
    held = [i for i, t in enumerate(traces) if not t.train]
    real, mine = np.array([traces[i].tac for i in held]), tac[held]
    return {
        "objects": objects,
        "order_right": all(pairs),
        "pairs_in_order": float(np.mean(pairs)) if pairs else 1.0,
        "tac_r2": float(1 - ((real - mine) ** 2).sum() / ((real - real.mean()) ** 2).sum()),
    }


def draw(path: str, traces: list[Trace], change: np.ndarray, tac: np.ndarray) -> None:
    """Picture of recorded (thin) and modelled (thick, dashed) curves of all objects."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    names = list(dict.fromkeys(t.name for t in traces))
    figure, axes = pyplot.subplots(2, len(names), figsize=(4 * len(names), 6), sharex=True, squeeze=False)
    for column, name in zip(axes.T, names, strict=True):
        for i, trace in enumerate(traces):
            if trace.name != name:
                continue
            colour = ("tab:blue", "tab:orange")[trace.finger]
            faint = 0.35 if trace.train else 1.0
            for axis, real, mine in zip(column, (trace.tdc, trace.tac), (change[i], tac[i]), strict=True):
                axis.plot(trace.time, real, color=colour, alpha=faint, linewidth=0.8)
                axis.plot(trace.time, mine, "--", color=colour, alpha=faint, linewidth=1.8)
        column[0].set_title(f"{name} ({material_of(name).name})")
        column[1].set_xlabel("s")
    axes[0, 0].set_ylabel("change of TDC [C]")
    axes[1, 0].set_ylabel("TAC [counts]")
    figure.suptitle("recorded: thin; model: dashed; blue F0, orange F1; pale: fitted on, full: predicted")
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def _cost(steps=5000):
    heat = Heat([material_of("steel")])
    heat.area.fill_(4e-5)
    heat.force.fill_(5.0)
    heat.advance(2e-3)
    begin = time.perf_counter()
    for _ in range(steps):
        heat.advance(2e-3)
    return (time.perf_counter() - begin) / steps


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", required=True)
    parser.add_argument("--json")
    parser.add_argument("--figure")
    args = parser.parse_args()
    try:
        traces, left_out = read(args.data)
    except FileNotFoundError as error:
        parser.error(str(error))
    for which, why in left_out.items():
        print(f"left out: {which}: {why}", file=sys.stderr)
    corners = {f"{corner:g} Hz": tac_corner(traces, corner) for corner in CORNERS}
    corner = CORNERS[0]
    train = [t for t in traces if t.train]
    if {material_of(t.name).name for t in train} >= {"steel", "acrylic"}:
        values, interval, gain = fit(train, corner)
    else:
        values, interval, gain = _FITTED, {}, np.array(_TAC)
    change, tac = predict(values, gain, traces, corner)
    result = report(traces, change, tac) | {"left_out": left_out}
    sensor = HeatParameters(
        **{k: v for k, v in values.items() if k in HeatParameters.__dataclass_fields__ and k != "area"}
    )
    start = [np.mean([t.start for t in traces if t.finger == f]) for f in sorted({t.finger for t in traces})]
    result["fitted"] = {
        "values": values,
        "interval_95": interval,
        "prior": {k: {"value": v, "relative_width": s} for k, (v, s) in _START.items()},
        "loss_W_per_K": sensor.loss(),
        "heater_W": [sensor.at_rest(t).power for t in start],
        "tac_gain_counts_s_per_C": float(gain[0]),
        "tac_rest_counts": gain[1:].tolist(),
    }
    result["tac_rms_of_recorded_tdc"] = corners
    result["seconds_per_step"] = _cost()
    text = json.dumps(result, indent=1)
    print(text)
    if args.json:
        write_json(args.json, result)
    if args.figure:
        draw(args.figure, traces, change, tac)


if __name__ == "__main__":
    main()
