"""What develops over time: a drift that all electrodes share, each with a share of its own; offsets, jumps,
gains and signs of single electrodes; exchanged channels.

Directions are ranked by the energy that a course over time explains in units of the joint model (`model.py`),
so that an effect is charged to the channel that has it, and judged on blocks of time left out."""

import numpy as np

from ...geometry.electrodes import electrode_positions
from ...sensor.channels import FULL_SCALE, counts_from_log_impedance, log_impedance, temperature_from_counts
from ..evidence import sign_flip
from .courses import BLOCKS, Course, compare, courses
from .findings import Finding
from .model import Model
from .session import Session

__all__ = ["exchanged", "gains", "levels", "settle"]

# of a shared drift's shares about their mean: 8-15 % seen in a real unloaded sensor
_SHARES = 0.12
# off their median at most: the weakest of a real unloaded sensor has 65 % of it
_ALONE = 0.7
_NAN = float("nan")
# logarithm of a gain in ln Z that an offset in counts looks like: the divider's curve, over 300 counts
_CURVED = 0.18
_DEAD = 0.1  # of its answer to the load: an electrode with less does not answer


# --- levels


def levels(session: Session, refused: set) -> Finding | None:
    """The strongest course over time that one electrode or all have, none of those refused."""
    m = session.model()
    number = len(m.used)
    everyone = np.ones(number)
    level, time = m.levels(m.shared(everyone))
    weight = everyone @ m.precision[:number, :number] @ everyone
    options = [(_energy(courses(level, time)[0], time) * weight, None, level)]
    alone, _ = m.levels(m.alone())
    for i, k in enumerate(m.used):
        best = courses(alone[:, i], time)[0]
        options.append((_energy(best, time) * m.precision[i, i], int(k), alone[:, i]))
    options.sort(key=lambda o: -o[0])
    for energy, k, level in options[:6]:
        if (k,) in refused:
            continue
        course = courses(level, time, thorough=True)[0]
        if course.p > 0.02 or course.nats < 6 or energy < 30:
            continue
        if k is not None and course.kind == "smooth" and not m.parted:
            continue  # in so short a time an electrode creeps with the load as well
        if k is None and course.kind == "both":  # a jump of the supply beside a warm-up: one after the other
            course = course.parts()[0]
        return _shared(session, course, options) if k is None else _single(session, course, k, options)
    return None


def _energy(course, time):
    y = course(time)
    return float(((y - y.mean()) ** 2).sum())


def _single(session, course, k, options):
    m = session.model()
    i = int(np.flatnonzero(m.used == k)[0])
    time = session.recording.time
    before = course(time[:1])[0]

    def correct(counts, at):
        out = counts.copy()
        out[:, k] = counts_from_log_impedance(log_impedance(counts[:, k]) - (course(at) - before))
        return out

    change = -float(course.sampled()[-1] - course.sampled()[0]) * m.slope[i]
    lead = next(o[0] for o in options if o[1] == k) / max(o[0] for o in options if o[1] != k)
    error = 2 * m.slope[i] * float(np.median(np.abs(np.diff(m.levels(m.alone())[0][:, i]))))
    return Finding(
        "drift",
        (k,),
        {"change": (change, change - error, change + error)},
        course.nats,
        course.p,
        course.start,
        time[-1],
        note=f"{'a step' if course.kind == 'step' else 'a course over time'} of "
        f"{course.size * m.slope[i]:.0f} counts against what the other electrodes say",
        clues=_clues(session, course, course.size * m.slope[i], m.activity[i] * m.slope[i])
        | {"lead": float(np.log(lead)), "stands": _stands(m, i), "course": course},
        correct=correct,
    )


def _stands(m, i):
    """Logarithm of how much more the levels of electrode i wander about their mean than those of the
    others, in counts."""
    level, _ = m.levels(m.alone())
    size = level.std(0) * m.slope + 0.3
    return float(np.log(size[i] / np.median(np.delete(size, i))))


def _clues(session, course, size, activity):
    m = session.model()
    return {
        "nats": course.nats / len(course.gain),
        "size": float(np.log(size / (activity + 2 * np.median(m.noise * m.slope) + 1))),
        "counts": float(np.log(max(size, 0.1))),
        "turns": float(np.log(max(course.turns, 1.0))),
        "blocks": float(np.mean(course.gain > 0)),
        "seconds": float(np.log(session.fit.sum() / session.recording.rate)),
    }


def _shared(session, course, options):
    m, time = session.model(), session.recording.time
    share = np.ones(19)
    own = {f.channels[0] for f in session.findings if len(f.channels) == 1 and f.correct is not None}
    share[m.used] = _shares(m, course, np.isin(m.used, list(own)))
    before = course(time[:1])[0]

    def correct(counts, at):
        return counts_from_log_impedance(log_impedance(counts) - np.outer(course(at) - before, share))

    sampled = course.sampled()
    change = float(sampled[-1] - sampled[0])
    size = course.size * float(m.slope.mean())
    others = max((o[0] for o in options if o[1] is not None), default=1.0)
    finding = Finding(
        "warmup",
        tuple(range(19)),
        {},
        course.nats,
        course.p,
        course.start,
        time[-1],
        note=f"ln Z of all electrodes changes by {change:+.3f} ({size:.0f} counts); shares "
        f"{share[m.used].min():.2f} to {share[m.used].max():.2f}",
        clues=_clues(session, course, size, float((m.activity * m.slope).mean()))
        | {
            "lead": float(np.log(options_energy(options) / max(others, 1e-9))),
            "course": course,
            "share": share,
        },
        correct=correct,
    )
    _name_shared(session, finding, course, change)
    return finding


def options_energy(options: list) -> float:
    """Energy of the direction that all electrodes share."""
    return next(o[0] for o in options if o[1] is None)


def _shares(m: Model, course: Course, own: np.ndarray) -> np.ndarray:
    """(c,) of a drift, about one: generalised least squares on the cells' levels, drawn towards their mean;
    where an electrode has a change of its own (c,) bool, the mean of its three neighbours'."""
    number = len(m.used)
    level, time = m.levels(m.value)
    g = course(time)
    g = g - g.mean()
    marginal = np.linalg.inv(np.linalg.inv(m.precision)[:number, :number])
    change = np.diff(m.levels(m.alone())[0], axis=0)
    # the cells' levels scatter more than the changes within them
    worse = np.median((np.median(np.abs(change), axis=0) / 0.6745) ** 2 / 2 * np.diag(m.precision)[:number])
    worse = max(worse, 1e-9)
    share = np.ones(number)
    for _ in range(
        3
    ):  # shares far off belong to a change of one electrode: they are drawn to the mean all the more
        off = (share - np.median(share)) / _SHARES
        pull = (1 / (1 + (off / 4) ** 2)) / _SHARES**2
        pull = (
            np.maximum(pull, 1 / _SHARES**2 * 0.05) if m.dimensions == 0 else np.full(number, 1 / _SHARES**2)
        )
        A = g @ g / worse * marginal + np.diag(pull)
        share = np.linalg.solve(A, marginal @ (level.T @ g) / worse + pull * np.median(share))
    if not m.dimensions:  # unloaded: a share that far off is a change of that electrode alone
        own = own | (np.abs(share - np.median(share)) > _ALONE)
    place = electrode_positions()[m.used]
    for i in np.flatnonzero(own):
        near = np.argsort(np.linalg.norm(place - place[i], axis=1) + 1e3 * own)[:3]
        share[i] = share[near].mean()
    return share


def _name_shared(session, finding, course, change):
    """Which of the shared effects it is: temperature if TDC follows it, else by pattern, sign and course."""
    m = session.model()
    number = len(m.used)
    e = np.clip(np.median(session.counts[session.fit][:, m.used], axis=0), 1, FULL_SCALE - 1)
    level, time = m.levels(m.whole)
    block = np.arange(len(time)) * min(BLOCKS, len(time) // 2) // len(time)
    y = course(time)
    y = (y - y.mean()) / max(np.sqrt(((y - y.mean()) ** 2).sum()), 1e-12)
    amplitude = (level - level.mean(0)).T @ y  # (c + products,) of the course in every channel
    P = m.precision
    misfit = {}
    for name, pattern in (
        ("warmup", np.ones(number)),
        ("count_offset", 1 / m.slope),
        ("count_gain", e / m.slope),
    ):
        filtered = P[:, :number] @ pattern
        size = amplitude @ filtered / (pattern @ filtered[:number])
        # every electrode has its own share: what is beyond that
        spread = np.diag(1 / (np.diag(P)[:number] ** -1 + (_SHARES * size * pattern) ** 2))
        left = (
            amplitude[:number] - size * pattern
            if not m.dimensions
            else (P @ (amplitude - size * np.r_[pattern, np.zeros(len(P) - number)]))[:number]
            / np.diag(P)[:number]
        )
        misfit[name] = float(left @ spread @ left)
    rising = change > 0
    sudden = course.kind == "step"
    order = ["fluidloss", "warmup"] if rising else ["warmup"]
    order = [*order, "count_offset", "count_gain"] if not sudden else ["count_offset", "count_gain", *order]
    best = min(misfit.values())
    close = [i for i in order if misfit.get("warmup" if i == "fluidloss" else i) < 2 * best + 12]
    tdc = session.recording.tdc
    ties = close[1:]
    finding.id = close[0]
    if tdc is not None:
        clock = session.recording.time
        warm = np.interp(time, clock, temperature_from_counts(tdc))
        if np.ptp(warm) > 0.05:
            series, _ = m.levels(m.shared(np.ones(number)))
            null = series - series.mean()
            A = np.column_stack([np.ones(len(warm)), warm])
            out = np.empty(len(series))
            for b in range(block[-1] + 1):
                rest = block != b
                out[~rest] = (series - A @ np.linalg.lstsq(A[rest], series[rest], rcond=None)[0])[~rest]
            scale = max(1.4826 * np.median(np.abs(np.diff(series))) / np.sqrt(2), 1e-9)
            gain = compare(null, out, block, scale)
            slope = float(np.linalg.lstsq(A, series, rcond=None)[0][1])
            told = sign_flip(gain) < 0.02
            if told and gain.sum() <= 0.5 * finding.nats:
                ties = [*ties, "thermal"]
            elif told:
                ties, finding.id = [finding.id, *ties], "thermal"
                spread = float(np.sqrt(np.mean(out**2)) / (np.std(warm) * np.sqrt(len(warm))))
                finding.parameters = {"alpha": (-slope, -slope - 2 * spread, -slope + 2 * spread)}
                share, heat = finding.clues["share"], temperature_from_counts(tdc)

                def by_temperature(counts, at):
                    warmer = np.interp(at, clock, heat) - heat[0]
                    return counts_from_log_impedance(log_impedance(counts) - np.outer(slope * warmer, share))

                finding.correct = by_temperature
    finding.ties = tuple(ties)
    if finding.id == "warmup":
        finding.parameters = _warm_up(course)
    elif finding.id == "fluidloss":
        lost = 1 - np.exp(-np.array([change, 0.9 * change, 1.1 * change]))
        finding.parameters = {"rate": tuple(3600 / course.knots[-1] * lost)}
    elif finding.id == "count_offset":
        value = -change * float(m.slope.mean())
        finding.parameters = {"change": (value, _NAN, _NAN)}
    elif finding.id == "count_gain":
        value = -change * float((m.slope / e).mean())
        finding.parameters = {"change": (value, _NAN, _NAN)}


def _warm_up(course: Course) -> dict:
    """a, tau of a (1 - exp(-t / tau)) that is next to a course."""
    time = np.linspace(course.knots[0], course.knots[-1], 200)
    y = course(time) - course(time[:1])
    span = time[-1]
    fits = []
    for tau in np.geomspace(0.05, 20, 60) * span:
        basis = np.column_stack([1 - np.exp(-time / tau), np.ones(len(time))])
        w, *_ = np.linalg.lstsq(basis, y, rcond=None)
        fits.append((float(((y - basis @ w) ** 2).sum()), tau, w[0]))
    least = min(fits)
    near = [f for f in fits if f[0] < 1.5 * least[0] + 1e-4 * (y**2).sum()]
    return {
        name: (least[i], min(f[i] for f in near), max(f[i] for f in near))
        for name, i in (("a", 2), ("tau", 1))
    }


def settle(session: Session) -> None:
    """Fits the courses again, each with all others taken out: what was found first had the others in it."""
    for _ in range(2):
        for finding in [f for f in session.findings if "course" in f.clues]:
            other = session.without(finding)
            m = other.model()
            if "share" in finding.clues:
                pattern = finding.clues["share"][m.used]
                series = m.shared(pattern)
            elif finding.channels[0] in m.used:
                series = m.alone()[:, int(np.flatnonzero(m.used == finding.channels[0])[0])]
            else:
                continue
            shared = "share" in finding.clues
            kinds = ("step", "smooth", "both") if not shared else (finding.clues["course"].kind,)
            course = courses(*m.levels(series), thorough=True, kinds=kinds)[0]
            options = [(1.0, None, None), (1.0, finding.channels[0], None)]
            again = (
                _shared(other, course, options)
                if shared
                else _single(other, course, finding.channels[0], options)
            )
            finding.correct, finding.parameters, finding.start = again.correct, again.parameters, again.start
            finding.nats, finding.p, finding.note = again.nats, again.p, again.note
            finding.clues |= {k: v for k, v in again.clues.items() if k != "lead"}
            if "share" in finding.clues:
                finding.id, finding.ties = again.id, again.ties
            session.replay()


# --- gains and signs of single electrodes


def gains(session: Session, refused: set) -> Finding | None:
    """The strongest change of what one electrode makes of the load, from some time on.

    An electrode's changes within windows are c times what the others say of them after a time s, and once
    before: c, s and the regression are fitted together, on moments of windows, and judged on blocks left
    out."""
    m = session.model()
    if (
        m.dimensions < 2 or m.time[m.inside][-1] < BLOCKS
    ):  # a block of less than a second holds no load change
        return None
    whole = m.whole[m.inside]
    span = max(4, int(min(2.0 / m.period, len(whole) // 32)))
    w = len(whole) // span
    cells = whole[: w * span].reshape(w, span, -1)
    cells = cells - cells.mean(1, keepdims=True)
    moment = np.einsum("wsi,wsj->wij", cells, cells)
    block = np.arange(w) * BLOCKS // w
    size = moment.shape[1]
    floor = np.concatenate([m.noise**2, np.full(size - len(m.used), 0.02)]) * span * w
    splits = range(max(2, int(0.06 * w)), int(0.94 * w))
    total = moment.sum(0)
    early = np.cumsum(moment, axis=0)
    options = []
    for i in range(len(m.used)):
        one = min(
            (_gain_fit(early[s - 1], total - early[s - 1], i, floor, 1) + (s,) for s in splits),
            key=lambda o: o[0],
        )
        plain = _gain_fit(total, 0 * total, i, floor, 0)
        options.append((0.5 * w * np.log(plain[0] / one[0]), i, one))
    options.sort(key=lambda o: -o[0])
    for nats, i, (_, _, split) in [(o[0], o[1], o[2]) for o in options[:4]]:
        k = int(m.used[i])
        if (k,) in refused or nats < 4:
            continue
        fine = np.unique(np.clip(np.arange(split - w // 12, split + w // 12 + 1), 2, w - 3))
        split = min(fine, key=lambda s: _gain_fit(early[s - 1], total - early[s - 1], i, floor, 3)[0])
        late = np.arange(w) >= split
        gain, factors = np.empty(block[-1] + 1), []
        noise = span / m.precision[i, i]
        for b in range(block[-1] + 1):
            rest = block != b
            _, c, beta = _gain_fit(moment[rest & ~late].sum(0), moment[rest & late].sum(0), i, floor, 4, True)
            plain = _gain_fit(moment[rest].sum(0), 0 * total, i, floor, 0, True)[2]
            left = [
                sum(_rest(moment[j], i, plain) for j in np.flatnonzero(~rest)),
                sum(_rest(moment[j], i, (c if late[j] else 1.0) * beta) for j in np.flatnonzero(~rest)),
            ]
            inside = int((~rest).sum())
            gain[b] = 0.5 * inside * np.log((left[0] + inside * noise) / (left[1] + inside * noise))
            factors.append(c)
        p, c = sign_flip(gain), float(np.median(factors))
        if (
            p > 0.02
            or gain.sum() < 5
            or np.ptp(factors) > 0.8 * max(abs(c), 0.25 * abs(1 - c))
            or c > 0
            and abs(np.log(c)) < _CURVED
        ):
            continue
        if abs(c) < _DEAD:
            return _dead(session, k, split * span * m.period, gain, p)
        return _gain_finding(session, k, i, c, np.ptp(factors) / 2, split * span * m.period, gain, p)
    return None


def _gain_fit(early, late, i, floor, rounds, full=False):
    """Residual square, factor (and regression) of x_i = beta's others before, c beta's others after."""
    o = np.delete(np.arange(len(early)), i)
    G, H, g, h = early[np.ix_(o, o)], late[np.ix_(o, o)], early[o, i], late[o, i]
    ridge = np.diag(floor[o])
    c = 1.0
    if not rounds:
        beta = np.linalg.solve(G + H + ridge, g + h)
    else:
        # the larger side says what is normal
        first, other = (G, g), (H, h)
        swap = np.trace(H) > np.trace(G)
        (A, a), (B, b) = (other, first) if swap else (first, other)
        beta = np.linalg.solve(A + ridge, a)
        c = float(beta @ b / max(beta @ B @ beta, 1e-12))
        if swap:
            c, beta = 1 / (c if abs(c) > 0.05 else 0.05), beta * c
    for _ in range(rounds):
        beta = np.linalg.solve(G + c**2 * H + ridge, g + c * h)
        c = float(beta @ h / max(beta @ H @ beta, 1e-12))
    square = early[i, i] + late[i, i] - 2 * beta @ (g + c * h) + beta @ (G + c**2 * H) @ beta
    if not full:
        return max(float(square), 1e-12), c
    whole = np.zeros(len(early))
    whole[o] = beta
    return max(float(square), 1e-12), c, whole


def _rest(moment, i, beta):
    """Square of x_i less beta's others."""
    v = -beta
    v = v.copy()
    v[i] = 1.0
    return float(v @ moment @ v)


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
        clues={"nats": float(gain.mean()), "blocks": float(np.mean(gain > 0))},
        mask=mask,
    )


def _gain_finding(session, k, i, c, spread, onset, gain, p):
    m, time = session.model(), session.recording.time
    middle = float(m.mean[i])
    holder = {"offset": 0.0}

    def correct(counts, at):
        out, late = counts.copy(), at > onset
        z = log_impedance(counts[late, k])
        out[late, k] = counts_from_log_impedance(middle + (z - middle - holder["offset"]) / c)
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
        time[-1],
        note=f"from {onset:.1f} s on it answers the load {c:.2f} times as before",
        clues={
            "nats": float(gain.mean()),
            "factor": float(abs(np.log(max(abs(c), 0.02)))) if c > 0 else 2.0,
            "blocks": float(np.mean(gain > 0)),
            "seconds": float(np.log(m.time[m.inside][-1])),
            "explained": float(m.activity[i] * np.sqrt(m.precision[i, i])),
        },
        correct=correct,
    )
    # about which count: the one at which nothing jumps
    again = Session(session.recording, session.fit, [*session.findings, finding])
    m = again.model()
    if k in m.used:
        level, at = m.levels(m.alone()[:, int(np.flatnonzero(m.used == k)[0])])
        late = at > onset
        if late.any() and (~late).any():
            near = np.argsort(np.abs(at - onset))[: max(8, len(at) // 3)]
            late_near = late & np.isin(np.arange(len(at)), near)
            early_near = ~late & np.isin(np.arange(len(at)), near)
            if late_near.any() and early_near.any():
                holder["offset"] = float(c * (level[late_near].mean() - level[early_near].mean()))
    if c > 0:
        finding.ties = ("drift",) if abs(np.log(c)) < 0.25 else ()
    return finding


# --- exchanged channels


def exchanged(session: Session) -> Finding | None:
    """Channels that carry each other's signal on one side of a time: exchanges that lower the misfit to the
    Gaussian of the other side, one after another, so that cycles are found as well."""
    m = session.model()
    x, number = m.value[m.inside], len(m.used)
    if not m.dimensions:  # what all do alike, a warm-up, is no order
        x = x - m.shared(np.ones(number))[m.inside][:, None]
    n, best = len(x), None
    if m.dimensions and m.time[m.inside][-1] < BLOCKS:
        return None
    for cut in np.unique(np.linspace(0.08 * n, 0.92 * n, 22).astype(int)):
        late = cut > n / 2
        gap = max(2, n // 44)
        normal, other = (x[: cut - gap], x[cut + gap :]) if late else (x[cut + gap :], x[: cut - gap])
        if len(other) < 10 or len(normal) < 2 * number:
            continue
        mean, P = _usual(m, normal)
        order, cost = _reorder(other, mean, P)
        if (order != np.arange(number)).any():
            ratio = np.log(cost[0] / cost[1])
            if best is None or ratio * len(other) > best[0]:
                best = ratio * len(other), cut, late, order, mean, P, normal, other
    if best is None:
        return None
    _, cut, late, order, mean, P, normal, other = best

    def misfit(rows, by):
        d = rows[:, by] - mean
        return ((d @ P) * d).sum(1) / number

    straight = np.arange(number)
    # the row at which exchanging turns from worse to better, and what lies on its side
    cost = np.clip(misfit(x, straight) - misfit(x, order), -200, 200)
    total = np.cumsum(cost)
    edge = int(np.argmin(total) if late else np.argmax(total))
    normal, other = (x[:edge], x[edge + 1 :]) if late else (x[edge + 1 :], x[:edge])
    if min(len(normal), len(other)) < 10:
        return None
    usual = float(np.mean(misfit(normal, straight)))
    block = np.arange(len(other)) * min(BLOCKS, len(other)) // len(other)
    number_of = np.bincount(block)
    now, then = (np.bincount(block, misfit(other, by)) / number_of for by in (straight, order))
    gain = 0.5 * number * np.log((now + usual) / (then + usual))
    moved = np.flatnonzero(order != straight)
    p = sign_flip(gain)

    def off(by):
        return np.sqrt((((other[:, by] - mean) @ P / np.diag(P)) ** 2).mean(0))[moved]

    # every one of them has to fit better in its new place: one that jumped beside another's level does not
    if p > 0.01 or len(moved) > 8 or (off(order) > 0.9 * off(straight)).any():
        return None
    onset = float(m.time[edge] + m.period / 2)
    # which side is right nothing says: the channels were in order first
    order = order if late else np.argsort(order)
    channels, source = m.used[moved], m.used[order[moved]]
    last = session.recording.time[-1]

    def correct(counts, at):
        out = counts.copy()
        rows = at > onset
        out[np.ix_(rows, channels)] = counts[np.ix_(rows, source)]
        return out

    return Finding(
        "swap",
        tuple(int(k) for k in channels),
        {"onset": (onset, onset - m.period, onset + m.period)},
        float(gain.sum()),
        p,
        onset,
        float(last),
        note=" ".join(f"e{a + 1} carries e{b + 1}" for a, b in zip(source, channels)),
        clues={
            "nats": float(gain.mean()) / number,
            "left": float(np.log(then.mean() / usual)),
            "ratio": float(np.log(now.mean() / then.mean())),
            "moved": float(len(moved)),
            "blocks": float(np.mean(gain > 0)),
            "seconds": float(np.log(m.time[m.inside][-1])),
        },
        correct=correct,
    )


def _usual(m, normal):
    """Mean and precision of levels and changes of the side that is taken as normal."""
    mean = normal.mean(0)
    centred = normal - mean
    floor = m.noise**2 + (0.02 if m.dimensions else 0.005) ** 2  # ln Z: warm-up goes on between the sides
    return mean, np.linalg.inv(centred.T @ centred / len(normal) + np.diag(floor))


def _reorder(other, mean, P):
    """Greedy exchanges: order (c,) of columns, and mean misfit before and after."""
    n, number = other.shape
    second, first = other.T @ other / n, other.mean(0)

    def cost(order):
        return float((P * second[np.ix_(order, order)]).sum() - 2 * mean @ P @ first[order] + mean @ P @ mean)

    order = np.arange(number)
    now = start = cost(order)
    for _ in range(4):
        best = None
        for a in range(number):
            for b in range(a + 1, number):
                trial = order.copy()
                trial[a], trial[b] = order[b], order[a]
                value = cost(trial)
                if best is None or value < best[0]:
                    best = value, trial
        if best[0] > 0.75 * now:
            break
        now, order = best
    return order, (start, now)
