"""An electrode that follows the load later than the others do: a filter, or a converter of its own.

Within a touch each electrode is compared with its prediction from the others. A delay tau adds -tau times the
rate of the prediction to the residual. On a sound sensor, too, electrodes are some milliseconds earlier or
later than the others, which explains little of their residual."""

import numpy as np
from scipy.ndimage import gaussian_filter1d

from ....quality.evidence import BLOCKS, sign_flip
from ....sensor.channels import log_impedance
from ..candidates import Candidate
from ..conditional import Conditional
from ..session import Session

_BAND = (0.015, 0.25)  # [s] of smoothing between which touches move: noise is faster, drift slower
_OWN = 1e-3  # fraction of an electrode's variance that no other predicts
_LEAST = 0.05  # fraction of the residual's variance


def lagging(session: Session) -> Candidate | None:
    """The electrode whose delay explains most of its residual given the others."""
    if not session.loaded:
        return None
    r = session.recording
    used = np.flatnonzero(session.masked.mean(0) < 0.02)
    fitted, aside = (_parts(session, rows, used) for rows in (session.fit, ~session.fit))
    if len(used) < 7 or fitted is None:
        return None
    product, square, total = fitted
    tau, fraction = _lag(product.sum(0), square.sum(0), total)
    fraction = np.where(tau > 0, fraction, 0.0)
    i = int(np.argmax(fraction))
    if fraction[i] < _LEAST:
        return None
    each = product[:, i] / np.maximum(square[:, i], 1e-30)
    error = float(each.std(ddof=1) / np.sqrt(len(each)))
    found = Candidate(
        "lowpass",
        (int(used[i]),),
        0.0,
        float(r.time[-1]),
        f"it is {1e3 * tau[i]:.0f} ms later than the others, which explains {fraction[i]:.0%} of what it "
        "lacks",
        {"tau": (float(tau[i]), float(tau[i] - 2 * error), float(tau[i] + 2 * error))},
        nats=float(-0.5 * BLOCKS * np.log1p(-fraction[i])),
        p=sign_flip(product[:, i] * tau[i] - 0.5 * square[:, i] * tau[i] ** 2),
        detector="lag",
        ties=("latency",),
        features={"explained": float(np.log(fraction[i]))},
    )
    if aside is not None:
        later, explained = _lag(aside[0].sum(0), aside[1].sum(0), aside[2])
        found.verified = bool(later[i] > 0 and explained[i] > 0.5 * fraction[i])
    return found


def _lag(product, square, total):
    """Delay [s] (c,) and the fraction (c,) that it explains of a sum of squares."""
    return product / np.maximum(square, 1e-30), product**2 / np.maximum(square * total, 1e-30)


def _parts(session, rows, used):
    """By blocks of some rows (n,) and electrodes used (c,): products (blocks, c) of each electrode's residual
    with the rate of its prediction, squares of that rate, and the sum (c,) of squared residuals; None of too
    few rows."""
    r = session.recording
    rows = np.flatnonzero(rows & ~r.repeated & ~session.masked[:, used].any(1))
    if len(rows) < BLOCKS * len(used) or r.rate * session.fresh * _BAND[0] < 1:
        return None
    z, rate = log_impedance(session.counts[np.ix_(rows, used)]), r.rate * session.fresh
    fast, slow = (gaussian_filter1d(z, s * rate, axis=0) for s in _BAND)
    y = fast - slow
    moment = y.T @ y / len(y)
    given = Conditional(moment, _OWN * np.diag(moment))
    lacking = given.residual(y)
    change = -np.gradient(y - lacking, axis=0) * rate
    moved = np.cumsum((change**2).sum(1))  # blocks in which as much moves
    first = np.searchsorted(moved, np.arange(BLOCKS) / BLOCKS * moved[-1])
    product, square = (np.add.reduceat(v, first) for v in (lacking * change, change**2))
    return product, square, (lacking**2).sum(0)
