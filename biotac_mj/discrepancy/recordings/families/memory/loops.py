"""Hysteresis of each electrode in its own load: a loop between up and down that does not depend on speed.

Electrodes that follow one load say each other to a few counts. Where each lags behind its own turning
points, they no longer do, and say each other better once the lag is undone. Nothing has to be known of the
load, so no force is needed. A loop has a direction in time: undone backwards it has to leave more."""

import numpy as np
from scipy.ndimage import uniform_filter1d

from .....sensor.channels import counts_from_log_impedance, log_impedance
from ....evidence import sign_flip
from ...findings import Finding
from ...model import Model
from ...session import Session
from ..courses import BLOCKS
from .between import play

__all__ = ["looping", "unsaid"]

# width of the loop in an electrode's standard deviations, and how much of its elastic part is added
_TRIED = [(w, a) for w in (0.05, 0.12, 0.3, 0.7) for a in (0.3, 0.8, 2.0, 4.0) if w * a < 1]
_AXES = 5  # principal components of the load whose squares and products are used
_FAR = 3.0  # standard deviations of these, beyond which a square only extrapolates
_P = 0.02
# gain up to which what comes to rest slowly, and after a release alone, has been taken for a loop: 0.03 at
# most; loops have 0.06 to 0.25
_FADES = 0.05


def looping(session: Session) -> Finding | None:
    """Hysteresis, where the electrodes say each other better without it, on blocks left out. They do not in
    loaded recordings without one, whatever else is hidden in them (docs/lab/discrepancy.md)."""
    m = session.model()
    alive = m.value[m.inside].std(0) > m.noise
    if not m.moved or m.inside.sum() < 4 * BLOCKS or alive.sum() < 7:
        return None
    x, noise, used = m.value[np.ix_(m.inside, alive)], m.noise[alive], m.used[alive]
    spread = x.std(0)
    loops = {w: play(x, w * spread) for w, _ in _TRIED}
    tried = [_left_over(x + a * loops[w], noise) for w, a in _TRIED]
    best = int(np.argmin([t.mean() for t in tried]))
    width, share = _TRIED[best]
    gain = float((_left_over(x, noise) - tried[best]).mean())
    if gain <= 0:
        return None
    p = sign_flip(_left_over(x + share * play(x[::-1], width * spread)[::-1], noise) - tried[best])
    if p > _P:
        return None

    def correct(counts, time):
        z = log_impedance(counts[:, used])
        # noise would turn it where the load does not
        slow = uniform_filter1d(z, m.width, axis=0, mode="nearest")
        out = counts.copy()
        out[:, used] = counts_from_log_impedance(z + share * play(slow, width * spread))
        return out

    return Finding(
        "hyster",
        tuple(int(k) for k in used),
        {"fraction": (share / (1 + share), np.nan, np.nan)},
        float(0.5 * m.inside.sum() * gain),
        p,
        0.0,
        session.recording.time[-1],
        note=f"electrodes say each other by {gain:.0%} better once each is freed of a loop about its turning "
        f"points, {2 * (1 + share) * width:.2g} of its standard deviations wide",
        ties=("relax",) if gain < _FADES else (),
        clues={"looped": gain},
        correct=correct,
    )


def unsaid(m: Model) -> np.ndarray:
    """(bins kept aside, c) of the electrodes used less what the others and products of the load's principal
    components say, as the bins fitted have it [ln Z]."""
    c, x = len(m.used), m.value - m.value[m.inside].mean(0)
    _, size, axes = np.linalg.svd(x[m.inside], full_matrices=False)
    score = x @ axes[:_AXES].T / size[:_AXES] * np.sqrt(m.inside.sum())
    i, j = np.triu_indices(score.shape[1])
    score = np.clip(score, -_FAR, _FAR)
    products = score[:, i] * score[:, j]
    whole = np.column_stack([x, products - products[m.inside].mean(0)])
    floor = np.concatenate([m.noise**2, np.full(len(i), 0.02)])
    P = np.linalg.inv(np.cov(whole[m.inside].T) + np.diag(floor))[:, :c]
    return whole[~m.inside] @ P / np.diag(P)


def _left_over(x: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """(blocks,) logarithm of the share of an electrode's variance that the others and products of the load's
    principal components do not say, in blocks left out, mean over electrodes. x (n, c), noise (c,) [ln Z]."""
    x = x - x.mean(0)
    n, c = x.shape
    score = np.linalg.svd(x, full_matrices=False)[0][:, :_AXES] * np.sqrt(n)
    score = np.clip(score, -_FAR, _FAR)
    i, j = np.triu_indices(score.shape[1])
    products = score[:, i] * score[:, j]
    whole = np.column_stack([x, products - products.mean(0)])
    floor = np.concatenate([noise**2, np.full(len(i), 0.02)])
    parts = np.array_split(whole, BLOCKS)
    moment = np.stack([part.T @ part for part in parts])
    total = moment.sum(0)
    variance = np.diag(total)[:c] / n
    out = np.empty(BLOCKS)
    for b, part in enumerate(parts):
        P = np.linalg.inv((total - moment[b]) / (n - len(part)) + np.diag(floor))[:, :c]
        left = part @ P / np.diag(P)
        out[b] = np.log(((left**2).mean(0) + floor[:c]) / variance).mean()
    return out
