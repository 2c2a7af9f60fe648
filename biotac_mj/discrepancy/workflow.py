"""The workflow: is there a disagreement, where, what is it, added, proved on trajectories that took no part, and what cannot be known."""

import dataclasses
import hashlib
import json

import numpy as np
import tqdm

from .catalogue import CATALOGUE
from .evidence import benjamini_hochberg, sign_flip
from .fitting import Fit, evidence, fit_effects, mean_square
from .simulator import Simulator
from .trajectories import FEWEST, measurement_noise
from .where import depends_on, phases, where
from .whitening import REPEATABILITY, Comparison

__all__ = ["THRESHOLDS", "Report", "diagnose", "threshold_hash"]

# Frozen before the blind cases of benchmarks/discrepancy.py were drawn; chosen on its development seeds.
THRESHOLDS = {
    "p": 0.02,  # sign flips over trajectories
    "gain": 1.0,  # [nats per trajectory] mean gain of evidence on trajectories left out
    "share": 0.15,  # of the closable log mean square that one effect has to close
    "named": 0.7,  # of it that all have to close, else the rest is unknown
    "significant": 2.0,  # mean square of whitened residuals beyond which something is wrong even if nothing has a name (1: noise, repeatability)  # noqa: E501
    "most": 3,  # effects
    "refit": 6,  # effects that are refitted after the screen
}
_SETUP = {"misalign", "depth0"}


def threshold_hash() -> str:
    """Names the thresholds that a verdict was reached with."""
    return hashlib.sha256(json.dumps(THRESHOLDS, sort_keys=True).encode()).hexdigest()[:12]


@dataclasses.dataclass
class Report:
    """What `diagnose` found.

    Attributes:
      verdict: one line. effects: list of dicts (id, name, stage, parameters, confidence, ties, p, nats). ranking: list of (id, nats per
      trajectory left out, p) of the first round. where: list of cells. before, after: dicts of mean square and RMS per channel on the
      locked
      trajectories. closed: share S on them. isolability: dict ids, matrix, nats. next_experiment: text. notes: what cannot be known.
      fit: Fit. comparison, selection, locked: what it was made of.
    """

    verdict: str
    effects: list
    ranking: list
    where: list
    before: dict
    after: dict
    closed: float
    isolability: dict
    next_experiment: str
    notes: list
    fit: Fit
    comparison: Comparison
    selection: np.ndarray
    locked: np.ndarray
    remainder: str = ""

    def apply(self, sim: Simulator) -> Simulator:
        """The simulator with the effects found as further stages, and the modulus that was fitted with them."""
        new = sim.with_effects(self.fit.effects, sim.modulus * float(np.exp(self.fit.log_modulus)))
        for k, (effect, name) in enumerate(self.fit.names):
            new.intervals.setdefault(effect, {})[name] = self.fit.interval(k)
        return new


def diagnose(
    sim: Simulator, data, *, effects=CATALOGUE, repeatability=REPEATABILITY, locked=0.25, seed=0, progress=True, fields=None
) -> Report:
    """Compares a simulator with measured trajectories and names what it misses.

    Args:
      sim: Simulator. data: list of Trajectory. effects: the catalogue to choose from.
      repeatability: standard deviation of a pose from trial to trial [m]. locked: share of the trajectories opened once, at the end.
      seed: of the split. fields: what `sim.fields(data)` gave, to use again.

    Raises:
      ValueError: too few trajectories, or a share that leaves none.
    """
    n = len(data)
    if n < FEWEST:
        raise ValueError(
            f"{n} trajectories are too few: the trajectory is the unit of evidence and some are kept aside; measure at least {FEWEST}, better 24"  # noqa: E501
        )
    if not 0 < locked < 0.6:
        raise ValueError(f"locked is {locked}: keep a share between 0 and 0.6 of the trajectories aside")
    order = np.random.default_rng(seed).permutation(n)
    aside = np.sort(order[: max(2, round(locked * n))])
    chosen = np.sort(order[len(aside) :])
    fields = sim.fields(data, progress) if fields is None else fields
    comparison = Comparison(sim, data, fields, measurement_noise(data), repeatability)
    usable, notes = [], _notes(data, comparison)
    for effect in effects:
        why = effect.applicable([data[i] for i in chosen])
        if why:
            notes.append(f"{effect.name} cannot be known: {why}")
        else:
            usable.append(effect)
    with tqdm.tqdm(total=2 + THRESHOLDS["most"], desc="diagnose", disable=not progress, leave=False) as bar:
        null = fit_effects(comparison, [], chosen)
        base = null.residuals(comparison)
        bar.update()
        current, found, ranking = null, [], []
        significant = _significant(base, chosen)
        while len(found) < THRESHOLDS["most"]:
            step = _round(comparison, current, usable, chosen, seed)
            bar.update()
            if not ranking:
                ranking = [(c["effect"].id, c["nats"], c["p"]) for c in step]
            best = _accept(comparison, step, current, null, chosen)
            if best is None:
                break
            found.append(best)
            current = best["fit"]
        current, found = _backward(comparison, current, found, chosen, seed)
        significant = significant or bool(found)
        report = _settle(comparison, null, current, found, ranking, chosen, aside, significant, notes, usable)
        bar.update()
    return report


def _significant(residuals, chosen):
    return bool(np.mean(np.log(np.maximum(mean_square(residuals)[chosen], 0.05))) > np.log(THRESHOLDS["significant"]))


def _columns(comparison, current, effect, shape, base, chosen):
    """Signature columns of an effect about the present model, whitened and stacked: secants at a realistic size."""
    out = []
    present = {e.id: dict(th) for e, th in current.effects}
    for name in effect.free:
        p = effect.params[name]
        theta = {**effect.default(), **shape, **present.get(effect.id, {})}
        sign = 1.0 if p.high > 0 else -1.0
        theta[name] = theta[name] + sign * min(p.scale, 0.5 * max(abs(p.high), abs(p.low)))
        others = [(e, th) for e, th in current.effects if e.id != effect.id]
        r = comparison.residuals([*others, (effect, theta)], float(np.exp(current.log_modulus)), current.log_friction)
        out.append(np.concatenate([(base[i] - r[i]).ravel() for i in chosen]))
    return np.stack(out, axis=1)


def _nuisance(comparison, current, base, chosen):
    columns = []
    for log_modulus, log_friction in ((0.05, 0.0), (0.0, 0.1)):
        r = comparison.residuals(current.effects, float(np.exp(current.log_modulus + log_modulus)), current.log_friction + log_friction)
        columns.append(np.concatenate([(base[i] - r[i]).ravel() for i in chosen]))
    q, _ = np.linalg.qr(np.stack(columns, axis=1))
    return q


def _screen(comparison, current, effects, chosen):
    """Linearised, cross-validated by trajectory: mean share of log c removed, and the shape values that did best, best first."""
    base = current.residuals(comparison)
    q = _nuisance(comparison, current, base, chosen)
    sizes = [base[i].size for i in chosen]
    edges = np.concatenate([[0], np.cumsum(sizes)])
    weight = np.concatenate([np.full(s, 1 / np.sqrt(max(m, 0.5))) for s, m in zip(sizes, mean_square(base)[chosen])])
    y = np.concatenate([base[i].ravel() for i in chosen]) * weight
    q, _ = np.linalg.qr(q * weight[:, None])
    y = y - q @ (q.T @ y)
    folds = np.arange(len(chosen)) % 4
    out = []
    for effect in effects:
        for shape in effect.grid:
            S = _columns(comparison, current, effect, shape, base, chosen) * weight[:, None]
            S = S - q @ (q.T @ S)
            gain = []
            for f in range(4):
                train = np.concatenate([np.arange(a, b) for a, b, g in zip(edges[:-1], edges[1:], folds) if g != f])
                ridge = np.eye(S.shape[1]) * 0.2
                w = np.linalg.solve(S[train].T @ S[train] + ridge, S[train].T @ y[train])
                for a, b, g in zip(edges[:-1], edges[1:], folds):
                    if g == f:
                        gain.append(np.log(max((y[a:b] ** 2).mean(), 1e-9)) - np.log(max(((y[a:b] - S[a:b] @ w) ** 2).mean(), 1e-9)))
            out.append((float(np.mean(gain)), effect, shape))
    best = {}
    for score, effect, shape in sorted(out, key=lambda o: -o[0]):
        best.setdefault(effect.id, (score, effect, shape))
    return sorted(best.values(), key=lambda o: -o[0])


def _round(comparison, current, effects, chosen, seed):
    """Screen, then refit the short list with cross-validation by trajectory; candidates with evidence, best first."""
    known = {e.id for e, _ in current.effects}
    ranked = _screen(comparison, current, [e for e in effects if e.id not in known], chosen)
    short = ranked[: THRESHOLDS["refit"]] + [r for r in ranked[THRESHOLDS["refit"] :] if r[1].id in _SETUP]
    reference = evidence(current.residuals(comparison))
    out = []
    for _, effect, shape in short:
        trial = [*current.effects, (effect, {**effect.default(), **shape})]
        held = _left_out(comparison, trial, current, chosen, seed)
        gain = held[chosen] - reference[chosen]
        fit = fit_effects(comparison, trial, chosen, current)
        out.append({"effect": effect, "gain": gain, "nats": float(gain.mean()), "p": sign_flip(gain), "fit": fit})
    q = benjamini_hochberg([o["p"] for o in out])
    for o, value in zip(out, q):
        o["q"] = float(value)
    return sorted(out, key=lambda o: -o["nats"])


def _left_out(comparison, effects, start, chosen, seed, folds=3):
    """Evidence of every chosen trajectory with parameters fitted on the other folds."""
    out = np.full(len(comparison.trajectories), np.nan)
    fold = np.random.default_rng(seed + 1).permutation(len(chosen)) % folds
    for f in range(folds):
        fit = fit_effects(comparison, effects, chosen[fold != f], start, shapes=False)
        values = evidence(fit.residuals(comparison))
        out[chosen[fold == f]] = values[chosen[fold == f]]
    return out


def _accept(comparison, step, current, null, chosen):
    """The best candidate if it passes all tests, with its ties; None otherwise."""
    if not step:
        return None
    excess = float(np.log(np.maximum(mean_square(current.residuals(comparison))[chosen], 1.0)).mean())
    for best in step[:3]:
        rows = np.mean([len(comparison.trajectories[i].time) for i in chosen])
        share = best["nats"] / max(0.5 * rows * excess, 1e-9)
        theta = dict(next(th for e, th in best["fit"].effects if e is best["effect"]))
        at_bound = all(
            abs(theta[n] - best["effect"].params[n].low) < 1e-3 * best["effect"].params[n].scale
            or abs(theta[n] - best["effect"].params[n].high) < 1e-3 * best["effect"].params[n].scale
            for n in best["effect"].free
        )
        small = best["effect"].id in _SETUP and all(
            abs(theta[n]) < comparison.repeatability / np.sqrt(len(chosen)) * 2 for n in best["effect"].free
        )
        if best["p"] < THRESHOLDS["p"] and best["nats"] > THRESHOLDS["gain"] and share > THRESHOLDS["share"] and not at_bound and not small:
            ties = []
            for other in step:
                if other is best or other["nats"] < THRESHOLDS["gain"]:
                    continue
                lead = best["gain"] - other["gain"]
                if lead.mean() < lead.std(ddof=1) / np.sqrt(len(lead)):
                    ties.append(other["effect"].id)
            return {**best, "ties": ties, "share": share}
    return None


def _backward(comparison, current, found, chosen, seed):
    """Drops every effect whose removal costs nothing significant."""
    if len(found) < 2:
        return current, found
    for item in list(found):
        rest = [(e, th) for e, th in current.effects if e is not item["effect"]]
        reduced = fit_effects(comparison, rest, chosen, current)
        loss = evidence(current.residuals(comparison))[chosen] - evidence(reduced.residuals(comparison))[chosen]
        if sign_flip(loss) > THRESHOLDS["p"] or loss.mean() < THRESHOLDS["gain"]:
            current, found = reduced, [f for f in found if f is not item]
    return current, found


def _settle(comparison, null, current, found, ranking, chosen, aside, significant, notes, usable):
    # The proof: the skin is solved again with the effects in place, on trajectories that took no part.
    before = _gap(comparison, null, aside)
    after = _gap(comparison, current, aside)
    closable = max(float(np.mean(np.log(np.maximum(before["mean_square"], 1.0)))), 1e-9)
    closed = float(1 - np.mean(np.log(np.maximum(after["mean_square"], 1.0))) / closable) if significant else float("nan")
    inside = mean_square(current.residuals(comparison))[chosen]
    residual_closed = 1 - np.mean(np.log(np.maximum(inside, 1.0))) / max(
        np.mean(np.log(np.maximum(mean_square(null.residuals(comparison))[chosen], 1.0))), 1e-9
    )
    effects = []
    for item in found:
        theta = next(th for e, th in current.effects if e is item["effect"])
        parameters = []
        for name, value in theta.items():
            p = item["effect"].params[name]
            k = current.names.index((item["effect"].id, name))
            low, high = current.interval(k)
            parameters.append(
                {"name": name, "value": value, "unit": p.unit, "interval95": [low, high], "bounds": [p.low, p.high], "source": p.source}
            )
        effects.append(
            {
                "id": item["effect"].id, "name": item["effect"].name, "stage": item["effect"].stage, "physics": item["effect"].physics,
                "parameters": parameters, "ties": item["ties"], "p": item["p"], "q": item["q"], "nats": item["nats"], "share": item["share"],  # noqa: E501
                "confidence": _confidence(item, residual_closed), "confusable": item["effect"].confusable,
            }
        )  # fmt: skip
    named = residual_closed >= THRESHOLDS["named"] or not _significant(current.residuals(comparison), chosen)
    if not significant:
        verdict, remainder = "no significant disagreement", "noise, the model's resolution and the set-up's repeatability explain the data"
    else:
        parts = []
        for e in effects:
            tie = f" (behaves like {', '.join(e['ties'])} too: not distinguished)" if e["ties"] else ""
            parts.append(e["name"] + tie)
        remainder = "" if named else depends_on(comparison, current, chosen)
        if effects and named:
            verdict = ("named: " if len(parts) == 1 else "several: ") + "; ".join(parts)
        elif effects:
            verdict = "partly: " + "; ".join(parts) + f"; remainder unknown ({remainder})"
        else:
            verdict = f"unknown ({remainder})"
    isolability = _isolability(comparison, current, usable, effects, chosen)
    return Report(verdict, effects, ranking, where(comparison, null, chosen), before, after, closed, isolability, _next(comparison, effects, isolability),  # noqa: E501
                  notes + isolability.pop("notes"), current, comparison, chosen, aside, remainder)  # fmt: skip


def _confidence(item, closed):
    x = -1.0 + 0.8 * np.log1p(max(item["nats"], 0)) + 1.5 * (closed - 0.5)
    p = 1 / (1 + np.exp(-x))
    return float(p / (1 + len(item["ties"])))


def _gap(comparison, fit, rows):
    residual = fit.raw(comparison, exact=True)
    white = [comparison.whiten(i, r) for i, r in enumerate(residual)]
    out = {"mean_square": mean_square(white)[rows].tolist()}
    for name, part in comparison.groups.items():
        out[name] = float(np.sqrt(np.mean([(residual[i][:, part] ** 2).mean() for i in rows])))
    out["channels"] = np.sqrt(np.mean([(residual[i] ** 2).mean(0) for i in rows], axis=0)).tolist()
    return out


def _isolability(comparison, current, usable, found, chosen):
    """M[i, j]: share of effect i's signature that effect j cannot mimic, on these trajectories; nats that i makes at a realistic size."""
    base = current.residuals(comparison)
    q = _nuisance(comparison, current, base, chosen)
    ids, spaces, size = [], [], []
    for effect in usable:
        shape = effect.grid[len(effect.grid) // 2]
        S = _columns(comparison, current, effect, shape, base, chosen)
        S = S - q @ (q.T @ S)
        norms = np.linalg.norm(S, axis=0)
        size.append(0.5 * float(norms.max() ** 2) / comparison.width / len(chosen))
        ids.append(effect.id)
        spaces.append(S)
    n = len(ids)
    M = np.ones((n, n))
    for j in range(n):
        basis, _ = np.linalg.qr(spaces[j] + 1e-12)
        for i in range(n):
            s = spaces[i][:, np.argmax(np.linalg.norm(spaces[i], axis=0))]
            M[i, j] = np.linalg.norm(s - basis @ (basis.T @ s)) ** 2 / max(s @ s, 1e-30)
    notes = [
        f"your data cannot show {e.name}: {v:.1f} nats per trajectory at a realistic size"
        for e, v in zip(usable, size)
        if v * len(chosen) < 3
    ]
    return {"ids": ids, "matrix": M.tolist(), "nats": size, "notes": notes}


def _next(comparison, effects, isolability):
    pairs = [(e, t) for e in effects for t in e["ties"]]
    if not pairs:
        pairs = [(e, next((o for o in e["confusable"] if o in isolability["ids"]), None)) for e in effects[:1]]
    out = []
    for effect, other in pairs[:3]:
        if other is None:
            continue
        text = effect["confusable"].get(other) or next((e.confusable.get(effect["id"]) for e in CATALOGUE if e.id == other), None)
        ids = isolability["ids"]
        nats = ""
        if effect["id"] in ids and other in ids:
            share = isolability["matrix"][ids.index(effect["id"])][ids.index(other)]
            left = share * isolability["nats"][ids.index(effect["id"])]
            nats = f" (here {share:.0%} of its signature is its own, {left:.1f} nats per trajectory: {int(np.ceil(3 / max(left, 1e-3)))} trajectories make 3 nats)"  # noqa: E501
        out.append(f"{effect['name']} or {other}: {text or 'vary load, speed and hold together less'}{nats}")
    return "; ".join(out) or "none needed: nothing was named, or nothing is tied"


def _notes(data, comparison):
    notes = []
    if len(data) < 12:
        notes.append(f"{len(data)} trajectories: p-values cannot fall below {2.0 ** -len(data):.3g}, small effects stay unseen")
    unloading = any(phases(t)["unload"].any() for t in data)
    if not unloading:
        notes.append("no unloading was recorded: hysteresis, adhesion and Mullins softening cannot be known")
    if not any(phases(t)["free"].sum() > 1 for t in data):
        notes.append("no free segment: drift and warm-up cannot be told from load; begin each trajectory before the touch")
    if not any(phases(t)["hold"].sum() > 3 for t in data):
        notes.append("no holds: relaxation cannot be told from hysteresis")
    if not comparison.has_force:
        notes.append("no force: the rubber's modulus shows in the liquid's pressure alone")
    return notes
