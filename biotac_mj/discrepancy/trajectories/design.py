"""The next experiment: of contacts within bounds those that are expected to discriminate best between
explanations, averaged over their parameters."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from ...effects.rubber import SPOT
from ..evidence import ODDS
from .beliefs import Beliefs, Explanation
from .contacts import Bounds, Contact, drawn, trajectory_of
from .model.simulator import Simulator
from .settings import SETTINGS
from .trajectory import Trajectory
from .whitening import Comparison

_PAUSE, _BETWEEN = 60.0, 4.0  # [s] after the last round, and between contacts
_BASE = 0.02  # of a nat about the effect, that one about the base model's parameters is worth
_REPEATS = 2  # of a contact: where the true law has another form, repeats give less than expected
_NOTHING = 1e-3  # [nats] below which a further contact is useless


@dataclasses.dataclass(frozen=True)
class Planned:
    """A contact of a plan: its trajectory, without readings, and why it is one."""

    contact: Contact
    trajectory: Trajectory
    reason: str


@dataclasses.dataclass(frozen=True)
class Plan:
    """Contacts in their order, and what is expected of them.

    Attributes:
      contacts. nats: {(name, other): by how much all of them together are expected to favour the first where
        it is true}. alike: (name, other) that no number of contacts within the budget distinguishes.
    """

    contacts: list[Planned]
    nats: dict[tuple[str, str], float]
    alike: list[tuple[str, str]]


class Separation:
    """Expected evidence between explanations, from what contacts would show [nats].

    With x = r_k - r_j what k leaves where j is true, k may still move its parameters, of which `information`
    is known: D = (x'x - g'(L + S'S)^-1 g) / 2 with g = S'x, all sums over contacts.

    unseen: of the first explanation with one more effect each. An effect that the data do not show yet keeps
    its prior probability, so a contact that would show it has the same value as one that separates names."""

    def __init__(
        self,
        explanations: Sequence[Explanation],
        comparison: Comparison,
        unseen: Sequence[Explanation] = (),
    ):
        residuals = [one.residuals(comparison) for one in explanations]
        residuals += [one.residuals(comparison, residuals[0]) for one in unseen]
        self.seen = len(explanations)
        explanations = [*explanations, *unseen]
        self.weight = np.array([one.weight for one in explanations])
        self.weight /= self.weight.sum()
        # those with fewer parameters have further ones that do nothing
        most = max(len(one.information) for one in explanations)
        self.known = np.array([_filled(one.information, most) for one in explanations])
        # of every contact: (true, other) x'x; of each other its S'x (k, true), and its S'S
        self.square, self.pull, self.gram = [], [], []
        for parts in zip(*residuals):
            residual = np.stack([one for one, _ in parts])
            columns = np.stack([np.pad(own, ((0, 0), (0, most - own.shape[1]))) for _, own in parts])
            difference = residual[:, None] - residual
            self.square.append((difference**2).sum(2))
            self.pull.append(np.einsum("bmk,bam->bka", columns, difference))
            self.gram.append(np.einsum("bmk,bml->bkl", columns, columns))

    def _sums(self, times):
        """x'x, S'x and L + S'S of contacts made so many `times` (contacts,)."""
        square, pull, gram = (np.tensordot(times, one, 1) for one in (self.square, self.pull, self.gram))
        return square, pull, self.known + gram

    def nats(self, times: np.ndarray) -> np.ndarray:
        """(true, other) expected evidence of contacts made so many `times` (contacts,)."""
        return self._nats(*self._sums(times))

    def _nats(self, square, pull, known):
        taken = (pull * np.linalg.solve(known, pull)).sum(1).T
        return 0.5 * np.maximum(square - taken, 0.0)

    def worth(self, times: np.ndarray) -> float:
        """Expected log odds of what is true, and a little of what is learnt about the base model's
        parameters."""
        return self._worth(*self._sums(times))

    def _worth(self, square, pull, known):
        nats, w = self._nats(square, pull, known), np.maximum(self.weight, 1e-6)
        others = np.where(np.eye(len(w), dtype=bool), 0.0, w * np.exp(-nats)).sum(1)
        odds = float(w @ (np.log(w) - np.log(np.maximum(others, 1e-300)))) if len(w) > 1 else 0.0
        more, before = (np.linalg.slogdet(one)[1] for one in (known, self.known))
        return odds + _BASE * float(w @ (0.5 * (more - before)))

    def chosen(self, budget: int) -> list[int]:
        """Contacts, one after another that which is worth most beside those before it."""
        times, out = np.zeros(len(self.gram)), []
        now = self.worth(times)
        while len(out) < budget:
            sums = self._sums(times)
            gains = [
                self._worth(*(a + b for a, b in zip(sums, more))) - now if made < _REPEATS else -np.inf
                for made, *more in zip(times, self.square, self.pull, self.gram)
            ]
            best = int(np.argmax(gains))
            if gains[best] < _NOTHING:
                break
            times[best] += 1
            now += gains[best]
            out.append(best)
        return out

    def alike(self, budget: int) -> list[tuple[int, int]]:
        """Pairs (a, b) of explanations that no contact, repeated `budget` times, distinguishes by `ODDS`."""
        most = np.max([self.nats(budget * one) for one in np.eye(len(self.gram))], axis=0)
        most = np.maximum(most, most.T)
        pairs = itertools.combinations(range(self.seen), 2)
        return [(a, b) for a, b in pairs if most[a, b] < np.log(ODDS)]


def _filled(information, count):
    """(count, count) information about parameters, of which further ones have their prior's alone."""
    out = np.eye(count)
    out[: len(information), : len(information)] = information
    return out


def planned(
    beliefs: Beliefs,
    sim: Simulator,
    bounds: Bounds,
    budget: int,
    candidates: int | list = 32,
    seed: int = 0,
    progress: bool = True,
) -> Plan:
    """The contacts within bounds, at most `budget`, with the largest expected information.

    Args:
      sim: the simulator that was compared. candidates: how many contacts to choose from, or these, as
        `contacts.drawn` gives them.

    Raises:
      ValueError: no contact is possible within the bounds.
    """
    quick = sim if sim.tier == "condensed" else sim.but(tier="condensed")
    stiffest = sim.modulus * max(one.nuisance.modulus for one in beliefs.explanations)
    some, n = candidates, sim.design.nelectrode
    if isinstance(candidates, int):
        some = drawn(quick.but(modulus=stiffest), bounds, candidates, seed)
    clock, trajectories = beliefs.end + _PAUSE, []
    for k, (contact, at, mat) in enumerate(some):
        trajectories.append(trajectory_of(contact, at, mat, clock, f"contact{k}", n))
        clock += float(trajectories[-1].time[-1]) + _BETWEEN
    # one that has a further effect is a question as much as one that contradicts the likeliest
    first, *others = beliefs.explanations
    asked = [first, *(one for one in others if one.weight >= SETTINGS.rate)]
    used = {name for one in asked for _, theta in one.effects for name in theta}
    spots = sorted(name for name in used if name.startswith(SPOT))
    fields = quick.fields(trajectories, progress, spots)
    able = [one for one in asked if _solved(one, fields)]
    unseen = [one for one in beliefs.unseen if able[:1] == [first] and _solved(one, fields)]
    unseen = [one for one in unseen if not one.effects[-1][0].applicable(trajectories)]
    runs = [
        quick.run(trajectories, fields, False, [*quick.effects, *one.effects], nuisance=one.nuisance)
        for one in able
    ]
    most = np.max([[np.linalg.norm(r.force, axis=1).max() for r in some] for some in runs], axis=0)
    within = np.flatnonzero(most <= bounds.force)
    if not len(within):
        raise ValueError(f"no contact stays below {bounds.force:g} N: give a larger --force")
    # what the model is off by grows with what a contact shows
    expected = [
        dataclasses.replace(t, electrodes=np.clip(r.counts, 0, 4095), pdc=r.pdc, force=r.force)
        for t, r in ((trajectories[u], runs[0][u]) for u in within)
    ]
    comparison = Comparison(quick, expected, fields.part(within), beliefs.noise, beliefs.repeatability)
    separation = Separation(able, comparison, unseen)
    times, contacts, clock = np.zeros(len(within)), [], beliefs.end + _PAUSE
    for u in separation.chosen(budget):
        contact, at, mat = some[within[u]]
        before = separation.nats(times)
        times[u] += 1
        reason = _reason([*able, *unseen], separation.weight, separation.nats(times) - before)
        one = trajectory_of(contact, at, mat, clock, f"contact{len(contacts) + 1}", n)
        clock += float(one.time[-1]) + _BETWEEN
        contacts.append(Planned(contact, one, reason))
    names = [one.name for one in able]
    nats = separation.nats(times)
    table = {(a, b): float(nats[i, j]) for i, a in enumerate(names) for j, b in enumerate(names) if i != j}
    return Plan(contacts, table, [(names[a], names[b]) for a, b in separation.alike(budget)])


def _solved(one, fields):
    """Whether the condensed tier has solved all that an explanation uses."""
    solved = list(fields.slopes)
    return all(
        effect.joining(theta) is None and theta.keys() <= effect.solved(solved).params.keys()
        for effect, theta in one.effects
    )


def _reason(explanations, weight, gain):
    """The two explanations that a contact distinguishes best, by their weights (explanations,)."""
    a, b = np.unravel_index(np.argmax(np.outer(weight, weight) * gain), gain.shape)
    if gain[a, b] < _NOTHING:
        return "the base model's own parameters"
    return f"{explanations[a].name} against {explanations[b].name}: {gain[a, b]:.1f} nats"
