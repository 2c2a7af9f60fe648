"""Wiring that is wrong through the whole recording or a long part of it: exchanged channels, reversed signs,
gains, and channels that hear the one before in the multiplexer's order.

Nothing in the recording changes with them, or too slowly to be seen, so there is no before and after. They
are told by what sound sensors have in common (`sound.py`): which electrodes answer alike, by how much, at
which levels they rest and how loud they are. Undoing what is wrong makes a recording likelier."""

import dataclasses
import itertools

import numpy as np

from .....quality.noise import noise_level, sound_noise
from .....sensor.channels import counts_from_log_impedance, log_impedance
from ...findings import Finding
from ...session import Session
from ...sound import PAD, Answers, Levels, Loudness, answers_of

__all__ = ["Evidence", "Wiring", "again", "earlier", "miswired", "missed"]

# correlation with sound sensors of how electrodes answer, below which this is another sensor or another
# press: as it is, and with what is wrong undone; the latter of levels where nothing moves
_LIKE, _UNDONE, _UNDONE_REST = 0.2, 0.6, 0.75
_LEVELS = 0.35  # of levels under a load: pressed BioTacs have 0.45 at least, a BioTac SP 0.05
_LIVELY = 3.0  # [counts] within windows, of half of the electrodes: with less there is nothing to answer
_LOUD = 1.5  # [counts] of noise, below which rounding hides what a gain makes of it
_WINDOWS = 10  # of a recording that is looked at
_LONG = 16  # of a part of it
_PARTS = 6  # of the rows fitted, at whose edges something may begin or end
_BLOCKS = 8
_GAINS = np.exp([-2.0, -1.6, -1.3, -1.05, -0.8, -0.6, 0.6, 0.8, 1.05, 1.3])
_HEARD = (0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)
# nats that each has to be worth: several above the most that recordings without it reach when their sensor
# was left out of what sound sensors have in common (`benchmarks/sound_sensors.py`)
_NEEDED = {"swap": 15.0, "flip": 15.0, "gain": 8.0, "crosstalk": 20.0}
_RESTING = 9.1  # of levels alone, which reach 4.6 without
_PAD = 30.0  # of signs and exchanges of E17 to E19 alone, and in a few seconds
_MORE = 8.0  # of one exchange more
_LATER = 4.0  # of one that is not there all the time
_EACH = 3.0  # of a gain, that answers and noise are each worth
_MOST = 6  # channels exchanged
_RIDGE = 0.05  # of the mean square: sensors differ by as much
_FEWEST = 6  # windows on either side of a time, that say which side is wrong
_SIDE = 4.0  # nats, for the one and against the other
_AGREE = 0.6  # of the parts of a recording, that are for it


@dataclasses.dataclass(frozen=True)
class Wiring:
    """What may be wrong, as what undoes it. id: of KINDS; channels: electrode numbers from 0; size: the
    factor of a gain, or what is heard; order: (19,) columns that belong in each place."""

    id: str
    channels: tuple
    size: float = 1.0
    order: tuple = tuple(range(19))

    def undone(self, used: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """(c, c) that makes of changes of ln Z of the electrodes used those of a sound sensor."""
        c = len(used)
        out = np.eye(c)
        if self.id == "swap":
            place = {int(k): i for i, k in enumerate(used)}
            return out[[place[self.order[k]] for k in used]]
        if self.id == "crosstalk":
            heard = (1 - self.size) * out + self.size * out[np.roll(np.arange(c), 1)]
            return np.linalg.inv(heard * slope / slope[:, None])
        i = int(np.flatnonzero(used == self.channels[0])[0])
        out[i, i] = -1.0 if self.id == "flip" else 1 / self.size
        return out


def _candidates(used, parted, taken, clipped):
    """parted: whether the rows are long enough for amplitudes; taken: channels with a fault that is known;
    clipped: those at a limit, to which a sign or a gain may have brought them."""
    free = [int(k) for k in used if int(k) not in taken]
    out = [Wiring("flip", (k,)) for k in [*free, *clipped]]
    out += [_exchange(tuple(range(19)), a, b) for a, b in itertools.combinations(free, 2)]
    if parted:
        out += [Wiring("gain", (k,), float(g)) for k in free for g in _GAINS]
        out += [Wiring("gain", (k,), float(g)) for k in clipped for g in _GAINS if g > 1]
    if parted and len(used) == 19:
        out += [Wiring("crosstalk", tuple(range(19)), a) for a in _HEARD]
    return out


def _exchange(order, a, b):
    order = list(order)
    order[a], order[b] = order[b], order[a]
    return Wiring("swap", tuple(k for k in range(19) if order[k] != k), 1.0, tuple(order))


class Evidence:
    """What a recording says of its wiring, less what was found. aside: of the rows kept aside, else of those
    fitted.

    Attributes:
      used (c,) electrodes; absolute: whether levels and the noise they go with are known; moves: whether they
        answer a load as sound sensors do; level (c,) ln Z; moment (w, c, c) of the windows' changes, middle
        (w,) [s].
    """

    def __init__(self, session: Session, aside: bool = False):
        m = session.model()
        rows = ~session.fit if aside else session.fit
        self.used, self.slope, c = m.used, m.slope, len(m.used)
        self.absolute = session.recording.absolute
        bins = ~m.inside if aside else m.inside
        value = m.value[bins] if bins.any() else m.value
        self.value = value + m.mean
        self.level = self.value.mean(0)
        span, moment, floor, middle = m.moments(every=True)
        self.span, self.period = span, m.period
        mine = np.isin(np.arange(len(middle)), np.flatnonzero(bins[: len(middle) * span : span]))
        moment, self.middle = moment[mine][:, :c, :c], middle[mine]
        energy = np.einsum("wii->wi", moment)
        energy = (energy / np.maximum(energy.mean(0), 1e-12)).max(1) if len(moment) else np.zeros(0)
        calm = energy <= np.quantile(energy, 0.97) if len(moment) else np.zeros(0, bool)
        self.moment, self.middle = moment[calm], self.middle[calm]
        self.floor = np.diag(floor[:c])
        self.answers = Answers(m.used)
        self.levels = Levels(m.used, value.std(0))
        self.loudness, self.loud = None, np.zeros(c)
        self.parted = m.parted
        self.moves = m.moved and len(self.moment) >= _WINDOWS
        self.moves = self.moves and np.median(m.activity * m.slope) >= _LIVELY
        if self.moves:
            self.moves = self.answers.alike(answers_of(self.square())) >= _LIKE
            x = session.counts[rows & ~session.recording.repeated & ~session.masked.any(1)]
            noise = noise_level(x[:, m.used]) if len(x) > 100 and self.absolute else np.zeros(c)
            if np.median(noise) > _LOUD and not any(f.id == "quantise" for f in session.findings):
                self.loudness = Loudness(m.used)
                self.loud = np.log(np.maximum(noise, 0.3) / sound_noise(np.median(x[:, m.used], axis=0)))

    def square(self, rows: slice | np.ndarray = slice(None)) -> np.ndarray:
        """(c, c) mean squares and products of changes in windows."""
        return self.moment[rows].mean(0) + self.floor

    def answered(self, wirings: list[Wiring], rows: slice | np.ndarray = slice(None)) -> np.ndarray:
        """(k,) nats by which answers in windows are likelier when each wiring is undone."""
        undo = np.array([w.undone(self.used, self.slope) for w in wirings])
        square = self.square(rows)
        out = np.empty(len(undo))
        for a in range(0, len(undo), 64):
            part = undo[a : a + 64]
            out[a : a + 64] = self.answers(answers_of(part @ square @ part.transpose(0, 2, 1)))
        return out - self.answers(answers_of(square))

    def sound(self, wiring: Wiring, rows: slice | np.ndarray = slice(None)) -> bool:
        """Whether it is a sound sensor's once something is undone."""
        undo = wiring.undone(self.used, self.slope)
        level, usual = undo @ self.level if wiring.id == "swap" else self.level, self.levels.mean
        if wiring.id == "flip":  # a word that is inverted has another level, too
            others = ~np.isin(self.used, wiring.channels)
            level, usual = level[others], usual[others]
        levels = float(np.corrcoef(level, usual)[0, 1]) if self.absolute else _LEVELS
        if not self.moves:
            return levels >= _UNDONE_REST
        return (
            levels >= _LEVELS and self.answers.alike(answers_of(undo @ self.square(rows) @ undo.T)) >= _UNDONE
        )

    def rested(self, wirings: list[Wiring]) -> np.ndarray:
        """(k,) nats by which levels are likelier: exchanges move them."""
        straight, out = self.levels(self.level), np.zeros(len(wirings))
        for i, w in enumerate(wirings):
            if w.id == "swap" and self.absolute:
                out[i] = self.levels(w.undone(self.used, self.slope) @ self.level) - straight
        return out

    def loudness_of(self, wirings: list[Wiring]) -> np.ndarray:
        """(k,) nats by which noises are likelier: a gain is one of noise, too."""
        out = np.zeros(len(wirings))
        if self.loudness is not None:
            straight = self.loudness(self.loud)
            for i, w in enumerate(wirings):
                if w.id == "gain":
                    less = np.where(self.used == w.channels[0], np.log(w.size), 0.0)
                    out[i] = self.loudness(self.loud - less) - straight
        return out


def miswired(session: Session, refused: set = frozenset()) -> Finding | None:
    """The wiring that is likeliest wrong. refused: (id, channels) that are none."""
    if not session.recording.signed:
        return None
    e = Evidence(session)
    best = _best(e, session.findings, refused)
    return None if best is None else _finding(session, e, *best)


def _best(e, findings=(), refused=frozenset()):
    """Wiring, nats, nats of the likeliest other on none of its channels, windows (w,) bool in which it is
    wrong, ids that are as likely on the same channels; or None."""
    # one electrode has one fault: what changes its level or answers, or clips it, is told by itself
    single = [f for f in findings if len(f.channels) < 12]
    taken = {k for f in single if f.id in _FAULTS for k in f.channels}
    clipped = {k for f in single if f.id in _LIMITS for k in f.channels} & {int(k) for k in e.used}
    clipped -= {k for f in single if f.id in _FAULTS - _LIMITS for k in f.channels}
    refused = refused | {("crosstalk", f.channels) for f in findings if f.id == "crosstalk"}
    tried = [w for w in _candidates(e.used, e.parted, taken, clipped) if (w.id, w.channels) not in refused]
    rest, loud = e.rested(tried), e.loudness_of(tried)
    spans, w = [np.ones(len(e.moment), bool)], len(e.moment)
    if e.moves:
        edges = np.arange(1, _PARTS) * w // _PARTS
        spans += [s for k in edges for s in (np.arange(w) >= k, np.arange(w) < k) if s.sum() >= _LONG]
    needed = np.array([_needed(t, e) for t in tried])
    best = None
    for number, rows in enumerate(spans):
        answer = e.answered(tried, rows) if e.moves else np.zeros(len(tried))
        if not number:
            nats = answer + rest + loud
            gain = np.array([t.id == "gain" for t in tried])
            weak = np.minimum(answer, loud) < _EACH if e.loudness is not None else answer < 2 * _EACH
            nats[gain & weak] = 0.0
        else:  # levels and noise are of all rows; what gains some rows have the recording itself says
            nats = np.where([t.id in ("swap", "flip") for t in tried], answer - _LATER, 0.0)
            k = int((nats - needed).argmax())
            if not rows.all() and e.answered([tried[k]], ~rows)[0] > -_LATER:  # the rest has to be against it
                continue
        sure = nats - needed
        k = int(sure.argmax())
        if sure[k] > 0 and (best is None or sure[k] > best[0]):
            others = [n for t, n in zip(tried, nats) if not set(t.channels) & set(tried[k].channels)]
            best = sure[k], tried[k], nats[k], max([*others, 0.0]), rows, nats
    if best is None:
        return None
    _, one, nats, other, rows, each = best
    ties = tuple(
        dict.fromkeys(
            t.id
            for t, n in zip(tried, each)
            if t.channels == one.channels and t.id != one.id and n > nats - _LATER
        )
    )
    if one.id == "swap" and (e.parted or not e.moves):
        one, nats = _further(e, one, nats, rows)
    if not e.sound(one, rows):
        return None
    if e.moves and one.id in ("swap", "flip"):
        halves = np.array_split(np.flatnonzero(rows), 2)
        if np.mean(_by_block(e, one, rows) > 0) < _AGREE or min(e.answered([one], h)[0] for h in halves) < 0:
            return None
    return one, nats, other, rows, ties


_TRIED = {"swap": 171, "flip": 19, "gain": 19, "crosstalk": 1}
_LIMITS = {"stuck", "saturate"}
_FAULTS = {"swap", "flip", "gain", "drift", "stuck", "saturate"}


def _needed(t, e):
    if not e.moves:
        return _RESTING
    pad = t.id in ("swap", "flip") and (set(t.channels) <= set(PAD) or not e.parted)
    return _PAD if pad else _NEEDED[t.id]


def _further(e, one, nats, rows):
    """Exchanges more that each make it likelier, so that cycles are found as well."""
    for _ in range(_MOST):
        tried = [_exchange(one.order, int(a), int(b)) for a, b in itertools.combinations(e.used, 2)]
        tried = [t for t in tried if t.channels and len(t.channels) <= _MOST]
        total = (e.answered(tried, rows) if e.moves else 0.0) + (e.rested(tried) if rows.all() else 0.0)
        k = int(np.argmax(total))
        if total[k] < nats + _MORE:
            break
        one, nats = tried[k], float(total[k])
    return one, nats


def _finding(session, e, one, nats, other, rows, ties):
    last = float(session.recording.time[-1])
    begins, ends = 0.0, last
    if not rows.all():
        at = np.flatnonzero(rows)
        half = 0.5 * (e.middle[1] - e.middle[0])
        begins = 0.0 if at[0] == 0 else float(e.middle[at[0]] - half)
        ends = last if at[-1] == len(rows) - 1 else float(e.middle[at[-1]] + half)
    channels = np.array(one.channels)
    source = np.array([one.order[k] for k in one.channels])
    if one.id == "flip":
        turned = counts_from_log_impedance(_unloaded(e, int(channels[0])))
    centre = np.median(session.counts[session.fit], axis=0)
    heard = None
    if one.id == "crosstalk":
        heard = np.linalg.inv((1 - one.size) * np.eye(19) + one.size * np.eye(19)[np.roll(np.arange(19), 1)])

    def correct(counts, at):
        out, on = counts.copy(), (at >= begins) & (at <= ends)
        if one.id == "swap":
            out[np.ix_(on, channels)] = counts[np.ix_(on, source)]
        elif one.id == "crosstalk":
            out[on] = centre + (counts[on] - centre) @ heard.T
        elif one.id == "flip":
            k = channels[0]
            z = log_impedance(counts[on, k])
            out[on, k] = counts_from_log_impedance(2 * log_impedance(turned) - z)
        else:
            k = channels[0]
            out[on, k] = centre[k] + (counts[on, k] - centre[k]) / one.size
        return out

    nan, name = float("nan"), f"e{channels[0] + 1}"
    always = "through the whole recording" if rows.all() else f"from {begins:.0f} s to {ends:.0f} s"
    parameters, note = {
        "swap": (
            {"onset": (begins, nan, nan)},
            " ".join(f"e{a + 1} carries e{b + 1}" for a, b in zip(source, channels)),
        ),
        "flip": ({"factor": (-1.0, nan, nan)}, f"{name} answers the load with the other sign"),
        "gain": (
            {name: (one.size - 1, nan, nan)},
            f"{name} answers the load about {one.size:.1f} times as a sound sensor's does",
        ),
        "crosstalk": (
            {"kappa": (one.size, one.size - 0.05, one.size + 0.05)},
            f"each channel hears {one.size:.0%} of the one before in the multiplexer's order",
        ),
    }[one.id]
    return Finding(
        one.id,
        tuple(int(k) for k in channels),
        parameters,
        float(nats),
        # Markov: nats so far above others have this chance at most, of all channels that were tried
        min(1.0, _TRIED[one.id] * float(np.exp(-nats))),
        begins,
        ends,
        note=f"{note}, {always}, by what sound sensors have in common",
        ties=ties,
        clues={"whole": float(nats - _needed(one, e)), "apart": float(nats - other), "wiring": one},
        correct=correct,
    )


def _by_block(e, one, rows):
    """(blocks,) nats of parts of the windows in which something is wrong; of levels alone, which are the same
    all the time, of one part each."""
    at = np.flatnonzero(rows)
    if not e.moves:
        parts = np.array_split(np.arange(len(e.value)), _BLOCKS)
        undo = one.undone(e.used, e.slope)
        levels = np.array([e.value[p].mean(0) for p in parts])
        return e.levels(levels @ undo.T) - e.levels(levels)
    parts = [p for p in np.array_split(at, _BLOCKS) if len(p)]
    return np.array([e.answered([one], p)[0] for p in parts])


def _unloaded(e, k):
    """ln Z of electrode k where the others are nearest to how sound sensors rest."""
    i = int(np.flatnonzero(e.used == k)[0])
    others = np.delete(np.arange(len(e.used)), i)
    d = (e.value - e.levels.mean)[:, others]
    away = np.sqrt(np.mean((d - d.mean(1, keepdims=True)) ** 2, axis=1))
    return float(np.median(e.value[away <= np.quantile(away, 0.06), i]))


def earlier(session: Session, one: Wiring, at: float) -> bool:
    """Whether something is wrong before a time [s] and not after it, as sound sensors say: that the two parts
    differ, which the recording says itself, leaves that open."""
    e = Evidence(session)
    before = e.middle < at
    if e.moves and min(before.sum(), (~before).sum()) >= _FEWEST:
        first, then = (e.answered([one], rows)[0] for rows in (before, ~before))
    elif one.id == "swap" and not e.moves and e.absolute:
        row = np.arange(len(e.value)) < at / e.period
        if row.all() or not row.any():
            return False
        level = np.array([e.value[row].mean(0), e.value[~row].mean(0)])
        first, then = e.levels(level @ one.undone(e.used, e.slope).T) - e.levels(level)
    else:
        return False
    return bool(first > _SIDE and then < -_SIDE)


def again(session: Session, finding: Finding) -> float:
    """Nats of a finding of `miswired` in the rows kept aside, of a session without it; nan where these say
    nothing."""
    e, one = Evidence(session, aside=True), finding.clues["wiring"]
    if not {int(k) for k in finding.channels} <= {int(k) for k in e.used}:
        return float("nan")
    if e.moves:
        return float((e.answered([one]) + e.loudness_of([one]))[0])
    return float(e.rested([one])[0]) if one.id == "swap" and e.absolute else float("nan")


def missed(session: Session, channels: tuple) -> float:
    """RMS [counts] by which electrodes miss, in the rows kept aside, what sound sensors' other
    electrodes would say of them: changes within windows, or levels where nothing moves."""
    e = Evidence(session, aside=True)
    mine = np.flatnonzero(np.isin(e.used, channels))
    if not len(mine):
        return float("nan")
    if not e.moves:
        off = e.level - e.levels.mean
        return float(np.sqrt(np.mean(((off - np.median(off)) * e.slope)[mine] ** 2)))
    square, moment, out = e.answers.square(), e.moment.mean(0), []
    for i in mine:
        o = np.delete(np.arange(len(e.used)), i)
        ridge = _RIDGE * np.trace(square) / len(square) * np.eye(len(o))
        weight = np.zeros(len(e.used))
        weight[i], weight[o] = 1.0, -np.linalg.solve(square[np.ix_(o, o)] + ridge, square[o, i])
        out.append(weight @ moment @ weight / e.span * e.slope[i] ** 2)
    return float(np.sqrt(np.mean(np.maximum(out, 0))))
