"""What is left: where the unamended model fails, and what the remainder depends on."""

import numpy as np
from scipy.stats import norm

from ...sensor.channels import log_impedance
from .effects.loads import force_features, lagged
from .session import Session
from .shapes import correlation_length
from .views import cross_residual, whole_line

__all__ = ["cells", "remainder"]

_PARTS = 10


def cells(session: Session) -> list:
    """Cells (channel or "all together") x tenth of the record in which the unamended recording departs from
    its own level, family-wise 5 %."""
    raw = Session(session.recording, session.fit)
    raw.masked = session.masked
    line, deviation, inside = whole_line(raw)
    one = np.ones(len(line.used))
    q = np.linalg.solve(line.covariance, one)
    series = np.column_stack([deviation @ q / (one @ q), cross_residual(line, deviation)])
    names = ["all together", *(f"e{k + 1}" for k in line.used)]
    n = len(line.time)
    edges = np.linspace(0, n, _PARTS + 1).astype(int)
    slope = np.median(session.counts * (1 - session.counts / 4095), axis=0)[line.used]
    out = []
    for j, name in enumerate(names):
        x = series[:, j] - np.median(series[:, j])
        within = np.concatenate([x[a:b] - x[a:b].mean() for a, b in zip(edges[:-1], edges[1:])])
        per = max(1.0, correlation_length(within))
        scale = max(within.std(), 1e-9)
        for a, b in zip(edges[:-1], edges[1:]):
            z = x[a:b].mean() / (scale * np.sqrt(per / (b - a)))
            p = min(1.0, 2 * norm.sf(abs(z)) * len(names) * _PARTS)
            counts = -x[a:b].mean() * (np.median(slope) if j == 0 else slope[j - 1])
            if p < 0.05 and abs(counts) > 1.0:
                out.append(
                    {
                        "channel": name,
                        "from": float(line.time[a]),
                        "to": float(line.time[b - 1]),
                        "counts": float(counts),
                        "z": float(z),
                        "p": float(p),
                    }
                )
    return sorted(out, key=lambda c: -abs(c["z"]))


def remainder(session: Session) -> dict:
    """Describes what the amended model leaves: dict with `significant`, `text` and shares."""
    out = _remainder(session)
    if session.unnamed:
        out.update(
            significant=True,
            text="; ".join([*session.unnamed, *([out["text"]] if out["significant"] else [])]),
        )
    return out


def _remainder(session):
    line, deviation, inside = whole_line(session)
    slope = np.median(session.counts * (1 - session.counts / 4095), axis=0)[line.used]
    if not line.loaded:
        common = max(
            (
                f.parameters["counts"][0]
                for f in session.findings
                if "counts" in f.parameters and len(f.channels) > 12
            ),
            default=0.0,
        )
        return _unloaded(line, deviation, slope, common)
    out = _loaded(line, deviation, slope)
    if session.force_view() is not None:
        out["force"] = _by_force(session)
    return out


def _unloaded(line, deviation, slope, common):
    """Excess over white noise of bins: of the common movement, and of every electrode."""
    one = np.ones(len(line.used))
    series = np.column_stack([deviation.mean(1), deviation - deviation.mean(1, keepdims=True)])
    noise = np.concatenate(
        [[np.sqrt((line.noise**2).sum()) / len(one)], line.noise * np.sqrt(1 - 1 / len(one))]
    )
    size = np.concatenate([[np.median(slope)], slope])
    sample = line.noise * np.sqrt(line.width) * slope
    guilty = []
    for j in range(series.shape[1]):
        x = series[:, j] - series[:, j].mean()
        excess = np.sqrt(max(x.var() - noise[j] ** 2, 0)) * size[j]
        windows = (
            np.array(
                [np.sqrt(max(w.var() + (w.mean()) ** 2 - noise[j] ** 2, 0)) for w in np.array_split(x, 24)]
            )
            * size[j]
        )
        # A shape carried on beyond the part fitted is good to some per cent of the effect.
        floor = max(1.0, 0.5 * (np.median(sample) if j == 0 else sample[j - 1]), 0.03 * common)
        if (excess > floor and x.var() > 2 * noise[j] ** 2) or windows.max() > 4 * floor:
            a = int(windows.argmax())
            name = "all together" if j == 0 else f"e{line.used[j - 1] + 1}"
            length = correlation_length(x) * line.period
            when = f"{line.time[0] + a * (line.time[-1] - line.time[0]) / 24:.0f} s"
            guilty.append(
                (
                    excess,
                    f"{name}: {excess:.1f} counts RMS beyond noise, most at {when}, "
                    f"keeps its sign for about {length:.1f} s",
                )
            )
    if not guilty:
        return {"significant": False, "text": "what is left is noise"}
    guilty.sort(reverse=True)
    return {"significant": True, "text": "; ".join(g[1] for g in guilty[:3]), "count": len(guilty)}


def _loaded(line, deviation, slope):
    """Windows in which an electrode departs from the others far more than the movement explains."""
    residual = cross_residual(line, deviation)
    parts = np.array_split(np.arange(len(line.time)), 24)
    activity = np.array([np.sqrt((deviation[p] ** 2).mean()) for p in parts])
    guilty = []
    for k in range(len(line.used)):
        size = np.array([np.sqrt((residual[p, k] ** 2).mean()) for p in parts])
        ratio = np.log(np.maximum(size, line.noise[k])) - np.log(np.maximum(activity, 3 * line.noise[k]))
        spread = 1.4826 * np.median(np.abs(ratio - np.median(ratio))) + 0.15
        odd = (ratio - np.median(ratio) > 6 * spread) & (size > 5 * np.median(size))
        if (odd[2:] & odd[1:-1] & odd[:-2]).any():
            where = np.flatnonzero(odd)
            start, end = line.time[parts[where[0]][0]], line.time[parts[where[-1]][-1]]
            guilty.append(
                (
                    size[odd].max() * slope[k],
                    f"e{line.used[k] + 1} departs from the other "
                    f"electrodes by {size[odd].max() * slope[k]:.0f} "
                    "counts"
                    f" from {start:.0f} s to {end:.0f} s",
                )
            )
    guilty.sort(reverse=True)
    text = "; ".join(g[1] for g in guilty[:3])
    return {
        "significant": bool(guilty),
        "text": text or "what each electrode does, the others explain as well as in the rest of the record",
    }


def _by_force(session):
    """Shares of the electrodes' variance explained on blocks left out: by force alone, and more by each group
    of further features."""
    r = session.recording
    rows = np.arange(0, len(r), max(1, len(r) // 6000))
    y = log_impedance(session.counts)[rows]
    force = session.force
    base = force_features(force)[rows]
    rate = np.gradient(lagged(force, 0.05, r.rate), 1 / r.rate, axis=0)[rows]
    t = (rows / len(r))[:, None]
    history = np.concatenate([(force - lagged(force, tau, r.rate))[rows] for tau in (1.0, 5.0)], axis=1)
    z = (y - y.mean(0)) / np.maximum(y.std(0), 1e-9)
    groups = {
        "time": np.concatenate([t, t**2], axis=1),
        "rate of the force": rate,
        "history of the force (1 s, 5 s)": history,
    }
    static = _score(base, z)
    out = {"force alone": static}
    for name, x in groups.items():
        out[name] = _score(np.concatenate([base, x], axis=1), z) - static
    # One electrode from the others is nearly complete where only the place of the contact is missing: a
    # state, not a fault.
    others = np.median([_score(np.delete(z, k, axis=1), z[:, [k]]) for k in range(19)])
    out["the other electrodes"] = float(others - static)
    missing = max((v, k) for k, v in out.items() if k != "force alone")[1]
    text = f"force alone explains {static:.0%} of the electrodes' variance on blocks left out"
    if missing == "the other electrodes":
        text += (
            f", the other electrodes {others:.0%}: "
            "place and torque of the contact, which the force does not say, make the rest"
        )
    else:
        text += f"; most of the rest depends on {missing} (+{out[missing]:.0%})"
    return {"shares": {k: float(v) for k, v in out.items()}, "text": text}


def _score(A, y, blocks=10):
    A = (A - A.mean(0)) / np.maximum(A.std(0), 1e-9)
    A = np.concatenate([np.ones((len(A), 1)), np.clip(A, -4, 4)], axis=1)
    block = np.arange(len(A)) * blocks // len(A)
    ridge = 1e-3 * len(A) * np.eye(A.shape[1])
    error = np.zeros(y.shape[1])
    for b in range(blocks):
        train = block != b
        w = np.linalg.solve(A[train].T @ A[train] + ridge, A[train].T @ y[train])
        error += ((y[~train] - A[~train] @ w) ** 2).sum(0)
    return float(np.median(1 - error / np.maximum(((y - y.mean(0)) ** 2).sum(0), 1e-12)))
