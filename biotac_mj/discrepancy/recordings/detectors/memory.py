"""What electrodes remember of touches while nothing touches them: a part of each change that decays after it
(relaxation), or stays until the next one (hysteresis), or all of it for a moment (a filter).

Where nothing touches, an electrode's level is its rest, which changes slowly with the session's clock. To
this each law adds a fraction, common to all electrodes, of what it makes of the electrode's own changes."""

import typing

import numpy as np
from scipy.signal import lfilter
from scipy.stats import chi2

from ....effects.effect import stop
from ....quality.evidence import BLOCKS, signed_root_t
from ....quality.noise import ROUNDING
from ....sensor.channels import log_impedance
from ...evidence import ODDS, log_ratio
from ..candidates import KINDS, Candidate
from ..model import slope_of
from ..session import Session

_BIN = 0.05  # [s]
_PIECE = 1.0  # [s] of a piece that is left out
_KNOTS = 60.0  # [s] between knots of the baseline
_TAUS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # [s]: what is slower is not told from drift
_FILTERS = (0.06, 0.12, 0.25, 0.5)  # [s]
_PLAYS = (0.1, 0.2, 0.4)  # of a channel's largest changes
_P = 0.02  # by chance
_LEAST = 0.03  # fraction that stays: of a sound sensor's pressure up to 5 %, of its electrodes not known


class _Law(typing.NamedTuple):
    """An effect, the name of its fraction if it has one, its shape, what it does in words, what it makes of
    changes (n, c), which part of a touch that is at most, and whether it is all of it."""

    id: str
    size: str
    shape: dict
    text: str
    values: np.ndarray
    most: float
    whole: bool = False


def remembered(session: Session, free: np.ndarray) -> Candidate | None:
    """Memory of all electrodes, by rows in which nothing touches them, free (n,) bool."""
    r = session.recording
    used = np.flatnonzero(session.masked.mean(0) < 0.02)
    width = max(1, round(_BIN * r.rate))
    m = len(r) // width
    free = free[: m * width].reshape(m, width).all(1)
    calm = int(np.argmax(free))
    begin = calm + int(np.argmin(free[calm:]))  # the first touch
    if len(used) < 7 or begin == calm or free[begin:].sum() * _BIN < BLOCKS * _PIECE / 2:
        return None
    z = log_impedance(session.counts[: m * width][:, used]).reshape(m, width, -1).mean(1)
    time, rate = (np.arange(m) + 0.5) * width / r.rate, r.rate / width
    knots = np.linspace(0, time[-1], 2 + int(time[-1] / _KNOTS))
    baseline = np.stack([np.interp(time, knots, row) for row in np.eye(len(knots))], axis=1)
    change = z - baseline @ np.linalg.lstsq(baseline[free], z[free], rcond=None)[0]
    change[free | (time < time[begin])] = 0.0  # what touches did: by what came of itself nothing is explained
    if not change.any():
        return None
    load = np.sqrt((change**2).mean(1, keepdims=True))  # and what all electrodes do with it
    press = (load * change).sum(0) / (load**2).sum()
    laws = [law for x, by in ((change, 1.0), (load, press)) for law in _laws(x, by, rate)]
    piece = (np.cumsum(np.diff(free, prepend=False)) + time // _PIECE).astype(int) % BLOCKS
    rounding = ROUNDING / slope_of(session.counts[:, used]) / np.sqrt(width)
    seen = _Rest(z[free], baseline[free], piece[free], rounding**2)
    tried = sorted(
        ((*seen.gain(law.values[free], law.whole), law) for law in laws), key=lambda one: -one[0].sum()
    )
    gain, fraction, best = tried[0]
    fraction = abs(fraction) * best.most
    rival = next(one for one in tried if one[2].id != best.id)
    p = signed_root_t(gain)
    if fraction < _LEAST or p > _P or gain.sum() <= np.log(ODDS * len(tried)):
        return None
    values = best.shape | ({} if best.whole else {best.size: fraction})
    equivalents = tuple(KINDS[best.id].equivalents)  # no log tells one law from those
    return Candidate(
        best.id,
        tuple(range(session.counts.shape[1])),
        float(time[begin]),
        float(time[-1]),
        f"{fraction:.0%} of what touches did to the electrodes is left after them, and {best.text}",
        {name: (value, np.nan, np.nan) for name, value in values.items()},
        nats=float(gain.sum()),
        p=p,
        detector="memory",
        features={"nats": float(np.log1p(gain.sum())), "size": float(np.log(fraction / _LEAST))},
        ties=(*equivalents, rival[2].id) if gain.sum() - rival[0].sum() < np.log(ODDS) else equivalents,
        verified=True,  # each piece by the others
    )


def _laws(x, by, rate):
    """Laws of changes x (n, k), each times `by`."""
    for tau in _TAUS:
        text = f"decays within {tau:g} s"
        yield _Law("relax", "g", {"tau": tau}, text, by * _slow(x, tau, rate), 1.0)
        yield _Law("relax", "g", {"tau": tau}, text, by * _recovering(x, tau, rate), 1.0)
    for tau in _FILTERS:
        text = f"decays within {tau:g} s"
        yield _Law("lowpass", "", {"tau": tau}, text, by * _slow(x, tau, rate), 1.0, whole=True)
    swing = np.quantile(np.abs(x), 0.95, axis=0)
    for part in _PLAYS:
        values = by * (x - stop(x, part * swing))  # what an element with so much play follows
        yield _Law("hyster_load", "fraction", {"width": part}, "stays until the next one", values, part)


class _Rest:
    """Levels y (n, c) while nothing touches, their baseline (n, k), the piece (n,) of each row, and the least
    variance (c,) of noise."""

    def __init__(self, y, baseline, piece, least):
        self.rest = [piece != b for b in range(BLOCKS)]
        self.fits = [np.linalg.pinv(baseline[rest], rcond=1e-6) for rest in self.rest]
        self.baseline = baseline
        self.residual = [y - baseline @ (fit @ y[rest]) for fit, rest in zip(self.fits, self.rest)]
        self.square = (
            np.median(np.diff(y, axis=0) ** 2, axis=0) / chi2.median(1) + 2 * least
        )  # twice the noise's

    def gain(self, law, whole):
        """Nats (blocks,) that a fraction of the law (n, c), or the whole, gains in each piece left out, and
        the fraction."""
        gains, fractions = [], []
        for fit, rest, residual in zip(self.fits, self.rest, self.residual):
            mine = law - self.baseline @ (fit @ law[rest])
            fraction = (mine * residual / self.square)[rest].sum() / (mine**2 / self.square)[rest].sum()
            fraction = 1.0 if whole else fraction
            before, after = ((e[~rest] ** 2).mean(0) for e in (residual, residual - fraction * mine))
            gains.append(log_ratio(before, after, (~rest).sum(), self.square / 2).mean())
            fractions.append(fraction)
        return np.array(gains), float(np.mean(fractions))


def _slow(x, tau, rate):
    """x (n, c) through a first-order filter of a time constant [s]."""
    part = 1 - np.exp(-1 / (tau * rate))
    return lfilter([part], [1, part - 1], x, axis=0)


def _recovering(x, tau, rate):
    """x (n, c) as it is followed eight times as fast while it grows as while it falls, within tau [s]."""
    up, down = (1 - np.exp(-times / (tau * rate)) for times in (8, 1))
    out = np.zeros_like(x)
    for i in range(1, len(x)):
        out[i] = out[i - 1] + np.where(np.abs(x[i]) > np.abs(out[i - 1]), up, down) * (x[i] - out[i - 1])
    return out
