"""Gains and signs of single electrodes: what one makes of the load, from some time on or more and more."""

import numpy as np
from scipy.ndimage import uniform_filter1d

from .....quality.noise import sound_noise
from .....sensor.channels import counts_from_log_impedance, log_impedance
from ....evidence import sign_flip
from ...findings import Finding
from ...session import Session
from ..courses import BLOCKS
from ..levels.jumps import edges
from .wiring import Wiring, earlier

__all__ = ["gains", "louder", "undecided"]

# logarithm of a gain in ln Z that an offset in counts looks like: the divider's curve, over 300 counts
_CURVED = 0.18
_LIVELY = 3.0  # [counts] within windows, of half of the electrodes: with less there is nothing to answer
_DEAD = 0.1  # of its answer to the load: an electrode with less does not answer
_SPLITS = 28  # times tried
_LARGEST = 5.0  # factor: more comes of a side in which nothing moves
# factors tried of an electrode whose answers and whose noise change alike
_FACTORS = np.exp(np.r_[np.linspace(-2.4, -0.3, 11), np.linspace(0.3, 1.2, 6)])
_LOUD = 1.5  # [counts] of noise, below which rounding hides what a gain makes of it
_CELL = 0.4  # [s] of whose noise the quietest quarter counts: in others the load moves
_CELLS = 8  # on either side of a change
_SECTIONS = 8  # of the rows fitted, whose noises a slow change is told by
_OTHERS = 0.1  # logarithm of noise by which electrodes change by themselves
_TAIL = 6.0  # degrees of freedom of it
_EACH = (1.5, 2.0)  # nats that answers and noise are each worth
# nats of both: sound pieces of two sensors reach 8.6, and p by Markov's inequality is 0.02 at 10.2
_BOTH = 10.3
_SEEN = 0.15  # spread of a slow course where noise is seen: rows may be held or lost
_SLOW = 2.0  # nats by which a slow change has to be likelier than a sudden one
_ROUNDS = 4  # of reweighting: an electrode that changes is an outlier for as long


def gains(session: Session, refused: set) -> Finding | None:
    """The strongest change of what one electrode makes of the load, from some time on.

    Within windows an electrode is what the others say (a regression), and c times that from a time s on: c,
    s and the regression are fitted together on the windows' moments. A window counts by the logarithm of
    its misfit, so that none decides alone; all is judged on blocks left out."""
    m, sharp = session.model(), edges(session)
    # a block of less than a second holds no load change: only when it changed is known then
    blind = m.dimensions < 2 or m.time[m.inside][-1] < BLOCKS
    if blind and not sharp or not m.inside.sum() > 64 or np.median(m.activity * m.slope) < _LIVELY:
        return None
    whole = m.whole[m.inside]
    span, moment, floor, middle = m.moments()
    w = len(moment)
    block = np.arange(w) * BLOCKS // w
    fits = {}
    for i, k in enumerate(m.used):
        if not blind or k in sharp:
            fits[i] = _Regression(moment, i, floor, _changed(sharp.get(int(k), ()), middle), blind)
    order = sorted(fits, key=lambda i: -fits[i].nats)
    for i in order[:4]:
        fit, k = fits[i], int(m.used[i])
        if (k,) in refused or fit.nats < 4:
            continue
        late = fit.late
        gain, factors = np.empty(w), []  # by window: all but a few may lie before the change
        for b in range(block[-1] + 1):
            mine, rest = block == b, block != b
            c, beta = fit.changed(rest & ~late, rest & late)
            plain = fit.cost(fit.plain(rest), mine)
            gain[mine] = plain - np.where(late[mine], fit.cost(c * beta, mine), fit.cost(beta, mine))
            factors.append(c)
        p, c = sign_flip(gain), float(np.median(factors))
        if p > 0.02 or gain.sum() < 4 or c > 0 and abs(np.log(c)) < _CURVED:
            continue
        spread = float(np.std(factors) * np.sqrt(len(factors) - 1))  # jackknife
        gain = np.bincount(block, gain)
        _, beta = fit.changed(~late, late)
        when, edge = fit.when, 0.0
        if when is None:
            when = _onset(m, whole, i, beta, c, span, int(np.argmax(late))), np.inf
        else:
            edge = float(np.log(max(e.times for e in sharp[k])))
        if c < 0 and when[0] > 0 and np.isinf(when[1]) and earlier(session, Wiring("flip", (k,)), when[0]):
            c, when = 1 / min(c, -1 / _LARGEST), (0.0, when[0])  # it was reversed first
        if abs(c) < _DEAD:
            finding = _dead(session, k, when[0], gain, p)
        else:
            finding = _gain_finding(session, k, i, c, spread, when, gain, p, edge)
        # where the load goes elsewhere all electrodes change what they make of it
        others = [max(fits[j].nats, 1.0) for j in order if j != i]
        finding.clues |= {
            "lead": float(np.log(fit.nats / max(others, default=1.0))),
            "side": float(np.log(min(late.mean(), 1 - late.mean()))),  # what a few windows say is little
        }
        return finding
    return None


def louder(session: Session, refused: set = frozenset()) -> Finding | None:
    """The electrode whose answers to the load and whose noise change by one factor: from some time on, or
    more and more. What amplifies the one amplifies the other, no load does both, so less of each is needed.
    """
    m = session.model()
    if not m.dimensions or any(f.id in ("quantise", "lowpass") for f in session.findings):
        return None
    span, moment, floor, middle = m.moments()
    w, found = len(moment), _noises(session, m.used)
    if found is None:
        return None
    at, noise = found
    courses = [
        np.where(np.arange(w) >= k, 1.0, 0.0)
        for k in np.unique(np.linspace(max(2, 0.06 * w), 0.94 * w - 1, _SPLITS).astype(int))
        if min((at < middle[k]).sum(), (at >= middle[k]).sum()) >= _CELLS
    ]
    slow = [np.clip((np.arange(w) - k) / (w - 1 - k), 0, 1) for k in (0, w // 4, w // 2)]
    courses += [u for u in slow if np.interp(at, middle, u).std() > _SEEN]
    changes = [_louder_by(at, noise, np.interp(at, middle, u), np.isin(u, (0, 1)).all()) for u in courses]
    best = None
    for i, k in enumerate(m.used):
        if (int(k),) in refused:
            continue
        # noise first: it is said at once
        loud = np.array([_likelier(change, i) for change in changes])
        if loud.max() < _EACH[1]:
            continue
        fit = _Regression(moment, i, floor, [], True)
        plain = fit.cost(fit.plain(np.ones(w, bool))).sum()
        for u, mine in zip(courses, loud):
            if mine.max() < _EACH[1]:
                continue
            answer = np.array([plain - fit.answering(np.exp(np.log(c) * u)).sum() for c in _FACTORS])
            both = np.where((answer > _EACH[0]) & (mine > _EACH[1]), answer + mine, 0.0)
            j, slow = int(both.argmax()), not np.isin(u, (0, 1)).all()
            if both[j] > _BOTH and (best is None or both[j] - _SLOW * slow > best[0]):
                best = both[j] - _SLOW * slow, both[j], i, u, float(_FACTORS[j]), fit, answer[j]
    if best is None:
        return None
    _, nats, i, u, c, fit, answer = best
    each = fit.cost(fit.plain(np.ones(w, bool))) - fit.answering(np.exp(np.log(c) * u))
    late, slow = u > 0, not np.isin(u, (0, 1)).all()
    split = int(np.argmax(late))
    if slow:
        when, rise = (float(middle[split]), np.inf), float(middle[-1] - middle[split])
    else:
        own, beta = fit.changed(~late, late)
        c = float(np.clip(own, 0.8 * c, 1.25 * c))  # what the answers say is finer than what was tried
        when, rise = (_onset(m, m.whole[m.inside], i, beta, c, span, split), np.inf), 0.0
    p = min(1.0, len(m.used) * len(courses) * float(np.exp(-nats)))
    finding = _gain_finding(session, int(m.used[i]), i, c, 0.15 * abs(1 - c), when, each, p, 0.0, rise)
    finding.nats = float(nats)
    finding.note += ", and is as much louder or quieter"
    finding.clues["both"] = float(nats - _BOTH)
    return finding


def _noises(session, used):
    """Times (b,) [s] of cells, and logarithms (b, c) of their noise over a sound electrode's; None where
    rounding hides it."""
    r = session.recording
    rows = np.flatnonzero(session.fit & ~r.repeated & ~session.masked.any(1))
    size = max(20, int(_CELL * r.rate))
    b = (len(rows) - 2) // size
    if b < 2 * _CELLS:
        return None
    x = session.counts[rows][:, used]
    square = (np.diff(x, n=2, axis=0)[: b * size] ** 2).reshape(b, size, -1).mean(1) / 6
    if np.median(np.quantile(square, 0.25, axis=0)) < _LOUD**2:
        return None
    law = sound_noise(x[: b * size].reshape(b, size, -1).mean(1))
    at = r.time[rows][: b * size].reshape(b, size).mean(1)
    return at, 0.5 * np.log(np.maximum(square, 0.09) / law**2)


def _louder_by(at, noise, u, sudden):
    """(c,) logarithms by which noises change along a course u (b,), less what all do."""
    if sudden:
        change = np.quantile(noise[u > 0.5], 0.25, axis=0) - np.quantile(noise[u <= 0.5], 0.25, axis=0)
    else:
        parts = np.array_split(np.arange(len(at)), _SECTIONS)
        quiet = np.array([np.quantile(noise[p], 0.25, axis=0) for p in parts])
        v = np.array([u[p].mean() for p in parts])
        v = v - v.mean()
        change = v @ quiet / (v @ v)
    return change - np.median(change)


def _likelier(change, i):
    """(factors,) nats by which the noise of electrode i is likelier to have changed by a factor than not, by
    how far the others' (all but two) have."""
    others = np.sort(np.delete(change, i) ** 2)[:-2]
    spread = np.sqrt(others.mean() + _OTHERS**2)

    def likely(x):
        return -0.5 * (_TAIL + 1) * np.log1p((x / spread) ** 2 / _TAIL)

    return likely(change[i] - np.log(_FACTORS)) - likely(change[i])


def _fitted(m, session, i, k):
    """Regression of electrode k, and its windows (w,) bool after its jumps that explain most, or None."""
    _, moment, floor, middle = m.moments()
    fit = _Regression(moment, i, floor, _changed(edges(session).get(k, ()), middle), True)
    return fit, fit.late


def undecided(session: Session, k: int) -> tuple:
    """What the jumps of electrode k may be besides a level that has changed: what it makes of the load
    afterwards, as far as the rows fitted say."""
    m = session.model()
    if k not in m.used or np.median(m.activity * m.slope) < _LIVELY:
        return ()  # nothing moves: an offset, and a gain that nobody sees
    fit, late = _fitted(m, session, int(np.flatnonzero(m.used == k)[0]), k)
    if late is None:
        return ("gain", "flip")
    c, beta = fit.changed(~late, late)
    said = np.einsum("wij,i,j->w", fit.G[late], beta, beta)
    each = (fit.g[late] @ beta) / np.maximum(said, 1e-12)
    error = np.sqrt(np.average((each - c) ** 2, weights=said) / len(each)) + 0.05
    if abs(c - 1) < 2 * error + 1 - np.exp(-_CURVED) and error > 0.5:
        return ("gain", "flip")
    # no less than an offset makes of the divider's curve: what a gain does to a level is a jump, too
    if c > 0 and error < 0.2 and abs(np.log(c)) < _CURVED:
        return ()
    return ("gain",) if c > 0 else ("flip",)


class _Regression:
    """Column i on all others, from moments of windows (w, q, q); floor (q,) of a window's noise; sides: what
    may be changed, by jumps (`_changed`), and unless blind all from any window on.

    Attributes:
      late: (w,) bool, windows after the change; when: (from, until) [s] where jumps say it, else None; nats:
        what a factor there gains.
    """

    def __init__(self, moment, i, floor, sides, blind):
        o = np.delete(np.arange(moment.shape[1]), i)
        self.G = np.ascontiguousarray(moment[:, o][:, :, o])
        self.g, self.y = moment[:, o, i], moment[:, i, i]
        self.ridge, self.least = np.diag(floor[o]), floor[i]
        w = len(moment)
        everything = np.ones(w, bool)
        self.weight = np.ones(w)
        for _ in range(_ROUNDS):
            square = self.square(self.plain(everything))
            self.least = max(floor[i], float(np.quantile(square, 0.25)))
            self.weight = self.least / (square + self.least)
        plain = self.cost(self.plain(everything)).sum()
        splits = np.unique(np.linspace(max(2, 0.06 * w), 0.94 * w - 1, _SPLITS).astype(int))
        tried = [*sides, *([] if blind else ((np.arange(w) >= split, None) for split in splits))]
        self.nats, self.late, self.when = -np.inf, None, None
        for late, when in tried:
            c, beta = self.changed(~late, late)
            if abs(c) > _LARGEST:
                continue
            nats = plain - self.cost(beta)[~late].sum() - self.cost(c * beta)[late].sum()
            if nats > self.nats:
                self.nats, self.late, self.when = nats, late, when

    def _sum(self, rows):
        v = self.weight * rows  # windows that are left out cost less than a copy of the others
        return np.tensordot(v, self.G, 1), v @ self.g

    def plain(self, rows):
        """(q - 1,) weights from some windows (w,) bool."""
        G, g = self._sum(rows)
        return np.linalg.solve(G + self.ridge * rows.sum(), g)

    def changed(self, early, late):
        """Factor and weights (q - 1,): the side with more in it says what is normal."""
        (G, g), (H, h) = self._sum(early), self._sum(late)
        ridge = self.ridge * (early | late).sum()
        swap = np.trace(H) > np.trace(G)
        (A, a), (B, b) = ((H, h), (G, g)) if swap else ((G, g), (H, h))
        beta = np.linalg.solve(A + ridge, a)
        c = float(beta @ b / max(beta @ B @ beta, 1e-12))
        if swap:
            c, beta = 1 / (c if abs(c) > 0.05 else 0.05), beta * c
        for _ in range(2):
            beta = np.linalg.solve(G + c**2 * H + ridge, g + c * h)
            c = float(beta @ h / max(beta @ H @ beta, 1e-12))
        return c, beta

    def scaled(self, factor):
        """(q - 1,) weights where windows answer by factors (w,)."""
        v = self.weight
        G = np.tensordot(v * factor**2, self.G, 1) + self.ridge * len(v)
        return np.linalg.solve(G, (v * factor) @ self.g)

    def answering(self, factor):
        """(w,) half the logarithm of the misfit where windows answer by factors (w,)."""
        beta = self.scaled(factor)
        said = np.einsum("wij,i,j->w", self.G, beta, beta)
        square = np.maximum(self.y - 2 * factor * (self.g @ beta) + factor**2 * said, 0)
        return 0.5 * np.log1p(square / self.least)

    def square(self, beta, rows=slice(None)):
        """(w,) residual squares of windows."""
        G, g = self.G[rows], self.g[rows]
        said = G.reshape(len(G), -1) @ np.outer(beta, beta).ravel()
        return np.maximum(self.y[rows] - 2 * g @ beta + said, 0)

    def cost(self, beta, rows=slice(None)):
        """(w,) half the logarithm of the misfit."""
        return 0.5 * np.log1p(self.square(beta, rows) / self.least)


def _changed(mine, middle):
    """What may be changed by an electrode's jumps, all from the first on or up to where it jumps back:
    windows (w,) bool by their middles [s], and (from, until) [s]."""
    back = [e.time for e in mine[1:] if e.step * mine[0].step < 0]
    whens = [(mine[0].time, until) for until in (*back, np.inf)] if mine else []
    sides = [((middle > when[0]) & (middle < when[1]), when) for when in whens]
    return [side for side in sides if 2 <= side[0].sum() <= len(middle) - 2]


def _onset(m, whole, i, beta, c, span, split):
    """[s] of the row around a window from which on the factor fits better."""
    said = np.delete(whole, i, axis=1) @ beta
    x, said = (v - uniform_filter1d(v, span, mode="nearest") for v in (whole[:, i], said))
    rows = slice(max((split - 2) * span, 0), (split + 2) * span)
    total = np.concatenate([[0], np.cumsum((x - said)[rows] ** 2 - (x - c * said)[rows] ** 2)])
    return float(m.time[rows][0] + (int(total.argmin()) - 0.5) * m.period)


def _dead(session, k, onset, gain, p):
    """An electrode that no longer answers, whatever its noise: from then on it measures nothing."""
    counts, time = session.recording.electrodes, session.recording.time
    late = time > onset
    value = float(np.median(counts[late & session.fit, k]))
    mask = np.zeros(counts.shape, bool)
    mask[late, k] = True
    return Finding(
        "stuck",
        (k,),
        {"value": (value, value, value)},
        float(gain.sum()),
        p,
        onset,
        time[-1],
        note=f"from {onset:.1f} s on it does not answer the load, at {value:.0f} counts",
        clues={
            "nats": float(gain.mean()),
            "factor": float(-np.log(_DEAD)),
            "spread": float(np.log(_DEAD)),
            "blocks": float(np.mean(gain > 0)),
        },
        mask=mask,
    )


def _gain_finding(session, k, i, c, spread, when, gain, p, edge, rise=0.0):
    """rise: [s] that the factor takes to become c; where it takes long it goes on as it went."""
    onset, until = when
    m, time = session.model(), session.recording.time
    middle = float(m.mean[i])
    holder = {"offset": 0.0}
    ends = f"to {until:.1f} s" if until < time[-1] else "on"

    def correct(counts, at):
        out, late = counts.copy(), (at >= onset) & (at < until)
        z = log_impedance(counts[late, k])
        factor = c ** np.clip((at[late] - onset) / rise, 0, 2) if rise else c
        out[late, k] = counts_from_log_impedance(middle + (z - middle - holder["offset"]) / factor)
        return out

    finding = Finding(
        "flip" if c < 0 else "gain",
        (k,),
        {"factor": (c, c - spread, c + spread)}
        if c < 0
        else {f"e{k + 1}": (c - 1, c - 1 - spread, c - 1 + spread)},
        float(gain.sum()),
        p,
        onset,
        min(until, time[-1]),
        note=f"from {onset:.1f} s {ends} it answers the load {c:.2f} times as else"
        + (f", after {rise:.0f} s" if rise else ""),
        clues={
            "nats": float(gain.mean()),
            "factor": float(abs(np.log(max(abs(c), 0.02)))) if c > 0 else 2.0,
            "sharp": edge,
            "blocks": float(np.mean(gain > 0)),
            "seconds": float(np.log(m.time[m.inside][-1])),
            "spread": float(np.log(min(spread / abs(1 - c), 2.0) + 0.01)),
            "explained": float(m.activity[i] * np.sqrt(m.precision[i, i])),
        },
        correct=correct,
    )
    # about which count: the one at which nothing jumps
    again = Session(session.recording, session.fit, [*session.findings, finding])
    m = again.model()
    if k in m.used:
        level, at = m.levels(m.alone()[:, int(np.flatnonzero(m.used == k)[0])])
        late = (at > onset) & (at < until)
        if late.any() and (~late).any() and not rise:
            near = np.argsort(np.abs(at - onset))[: max(8, len(at) // 3)]
            late_near = late & np.isin(np.arange(len(at)), near)
            early_near = ~late & np.isin(np.arange(len(at)), near)
            if late_near.any() and early_near.any():
                holder["offset"] = float(c * (level[late_near].mean() - level[early_near].mean()))
    if c > 0:
        finding.ties = ("drift",) if abs(np.log(c)) < 0.25 else ()
    return finding
