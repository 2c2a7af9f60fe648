"""Probabilities of the explanations of a diagnosis by held-out trajectories, and intervals of their
parameters: kept in the report's folder for the next experiment, and for the round that follows it."""

import dataclasses
import itertools
import json
import pathlib
from collections.abc import Iterator, Sequence

import numpy as np

from ...effects.catalogue import CATALOGUE, by_id
from ...effects.effect import Effect
from ...files import replacing
from ..evidence import ODDS
from .base.nuisance import Nuisance
from .fitting import parameters, sizes
from .model.sensor_file import load_simulator
from .model.simulator import Simulator
from .search import Search
from .settings import SETTINGS
from .trajectory import Trajectory, read_trajectories, write_trajectories
from .whitening import Comparison

_MOST = 6  # explanations, the likeliest ones, and the base model alone
# What the likelihood leaves out comes again in every contact. All contacts together tell explanations apart
# as this part of one would if nothing were left out; over their number it is the power of the likelihood (a
# coarsened posterior, Miller and Dunson 2019). By greatest likelihood from 299 names in 187 laboratories
# whose laws are not the catalogue's.
_CONTACTS = 0.8
_PAUSE = 60.0  # [s] between rounds, where their clocks begin anew


@dataclasses.dataclass(frozen=True)
class Explanation:
    """Effects that may be all that the base model misses.

    Attributes:
      effects: [(Effect, theta)]; none: the base model alone. nuisance: fitted with them.
      score: log evidence of all data, parameters marginalised [nats].
      weight: probability, of all explanations that are kept 1 together.
      information: (k, k) of data and priors about the parameters as `moves` gives them, in standard
        deviations of the priors.
    """

    effects: list
    nuisance: Nuisance
    score: float
    information: np.ndarray
    weight: float = float("nan")

    @property
    def ids(self) -> list[str]:
        return [effect.id for effect, _ in self.effects]

    @property
    def name(self) -> str:
        return " + ".join(effect.name for effect, _ in self.effects) or "the base model alone"

    def moves(self) -> Iterator[tuple[float, list, Nuisance]]:
        """(step in standard deviations of the prior, effects, nuisance) with one parameter moved by it."""
        for k, name, spread, step in parameters(self.effects):
            if k is None:
                yield step / spread, self.effects, self.nuisance.moved(**{name: step})
                continue
            effect, theta = self.effects[k]
            p, value = effect.params[name], theta[name]
            if not p.low <= (value * np.exp(step) if p.shape else value + step) <= p.high:
                step = -step
            moved = (effect, theta | {name: float(value * np.exp(step) if p.shape else value + step)})
            yield step / spread, [*self.effects[:k], moved, *self.effects[k + 1 :]], self.nuisance

    def residuals(
        self, comparison: Comparison, known: list[tuple[np.ndarray, np.ndarray]] | None = None
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Per trajectory (m,) what is left, and (m, k) by how much less of it one of each parameter makes it;
        squares are nats twice over. known: what the explanation without the last effect gave, whose columns
        are taken as they are."""
        rows = [np.sqrt(len(t.time)) for t in comparison.trajectories]

        def scaled(effects, nuisance):
            vectors = comparison.vectors(effects, nuisance)
            return [v * root for v, root in zip(vectors, rows)]

        here, unknown = scaled(self.effects, self.nuisance), 0 if known is None else known[0][1].shape[1]
        columns = [
            [(a - b) / step for a, b in zip(here, scaled(effects, nuisance))]
            for step, effects, nuisance in itertools.islice(self.moves(), unknown, None)
        ]
        own = [np.stack(parts, axis=1) for parts in zip(*columns)]
        if known is not None:
            own = [np.hstack([columns, more]) for (_, columns), more in zip(known, own)]
        return list(zip(here, own))

    def with_unseen(self, effect: Effect, score: float) -> "Explanation":
        """This one with a further effect of a realistic size, whose evidence is `score` [nats] and whose
        parameters have their prior."""
        theta = {**effect.default(), **effect.grid[len(effect.grid) // 2]}
        signs = np.random.default_rng(0).choice([-1.0, 1.0], len(effect.free))
        for (name, size), sign in zip(sizes(effect), signs if len(signs) > 1 else [1.0]):
            p = effect.params[name]
            theta[name] = float(np.clip(theta[name] + sign * size, p.low, p.high))
        out = dataclasses.replace(self, effects=[*self.effects, (effect, theta)], score=self.score + score)
        known = len(self.information)
        information = np.eye(len(parameters(out.effects)))
        information[:known, :known] = self.information
        return dataclasses.replace(out, information=information)


def weights(scores: Sequence[float], effects: Sequence[int], contacts: float = _CONTACTS) -> np.ndarray:
    """(explanations,) probabilities by log evidence (explanations,) of so many contacts. effects: how many
    each has; before the data one of the catalogue is there on average, whichever. contacts: by default as
    few as if nothing were left out."""
    total = np.asarray(scores) * _CONTACTS / contacts - np.log(len(CATALOGUE)) * np.asarray(effects)
    likely = np.exp(total - total.max())
    return likely / likely.sum()


@dataclasses.dataclass(frozen=True)
class Beliefs:
    """Explanations of some data, the likeliest first.

    Attributes:
      explanations: see above. unseen: the likeliest explanation with one more effect each, for effects that
        the data hardly show. further: probability that one of these effects is present, without those that no
        data of this kind show.
      repeatability: of poses [m]. noise: of `measurement_noise`. end: of the session's clock [s].
      doubts: why the diagnosis is not sure of the likeliest explanation.
    """

    explanations: list[Explanation]
    repeatability: float
    noise: dict
    end: float
    doubts: list[str] = dataclasses.field(default_factory=list)
    unseen: list[Explanation] = dataclasses.field(default_factory=list)
    further: float = 0.0

    @property
    def rivals(self) -> list[Explanation]:
        """The likeliest explanation and those that contradict it, which having more effects does not."""
        first, *others = self.explanations
        return [first, *(one for one in others if not first.effects or not set(first.ids) <= set(one.ids))]

    @property
    def odds(self) -> float:
        """Odds of the likeliest explanation, including those that add effects to it or omit some, against all
        that contradict it."""
        against = sum(one.weight for one in self.rivals[1:])
        return float((1 - against) / max(against, 1e-9))

    @property
    def distinguished(self) -> bool:
        """Whether the likeliest explanation is decided against all that contradict it."""
        return self.odds >= ODDS and not self.doubts

    @property
    def decided(self) -> bool:
        """Whether no further contact is needed: explanations are distinguished, and a further effect is
        unlikely."""
        return self.distinguished and self.further < SETTINGS.rate

    @property
    def text(self) -> str:
        """The decision as text."""
        first, *others = self.rivals
        if self.distinguished:
            text = f"decided: {first.name}, {min(self.odds, 999):.0f} times likelier than all else"
            hardly = f"; an effect that these data hardly show may be there as well, {self.further:.0%}"
            return text + ("" if self.decided else hardly)
        against = sum(one.weight for one in others)
        rest = ", ".join(f"{one.name} {one.weight:.0%}" for one in others if one.weight > 0.02)
        likely = f"{first.name} {1 - against:.0%}{', ' * bool(rest)}{rest}"
        only = "if it is one of these, " if self.doubts else ""
        return "; ".join([f"not decided: {only}{likely}", *self.doubts])

    def save(self, folder: pathlib.Path, given: Simulator, trajectories: Sequence[Trajectory]) -> None:
        """Writes beliefs.json, given.yaml (the simulator that was compared) and measured.h5."""
        folder.mkdir(parents=True, exist_ok=True)
        document = {
            "repeatability": self.repeatability,
            "end": self.end,
            "doubts": self.doubts,
            "noise": {k: None if v is None else np.asarray(v).tolist() for k, v in self.noise.items()},
            "explanations": [_written(one) for one in self.explanations],
            "unseen": [_written(one) for one in self.unseen],
            "beside": self.further,
        }
        with replacing(folder / "beliefs.json") as temporary:
            temporary.write_text(json.dumps(document, indent=1, allow_nan=False))
        given.save(folder / "given.yaml")
        write_trajectories(folder / "measured.h5", list(trajectories))

    @classmethod
    def load(cls, folder: pathlib.Path | str) -> tuple["Beliefs", Simulator]:
        """Beliefs of a report's folder, and the simulator that was compared.

        Raises:
          FileNotFoundError: no report of data with poses.
        """
        round_ = _round(folder)
        document = json.loads((round_ / "beliefs.json").read_text())
        sim = load_simulator(round_ / "given.yaml")
        explanations, unseen = (
            [
                Explanation(
                    [(_effect(e["id"], e["theta"], sim.design), e["theta"]) for e in one["effects"]],
                    Nuisance(**one["nuisance"]),
                    one["score"],
                    np.array(one["information"]),
                    one["weight"],
                )
                for one in document[key]
            ]
            for key in ("explanations", "unseen")
        )
        noise = {k: None if v is None else np.atleast_1d(v) for k, v in document["noise"].items()}
        rest = document["repeatability"], noise, document["end"], document["doubts"], unseen
        return cls(explanations, *rest, document["beside"]), sim


def _written(one):
    """An Explanation as JSON has it."""
    return {
        "effects": [{"id": effect.id, "theta": theta} for effect, theta in one.effects],
        "nuisance": dataclasses.asdict(one.nuisance),
        "score": one.score,
        "weight": one.weight,
        "information": one.information.tolist(),
    }


def _round(folder):
    """The folder of a report in which `Beliefs.save` has written."""
    found = pathlib.Path(folder) / "round"
    if not (found / "beliefs.json").exists():
        raise FileNotFoundError(
            f"no {found / 'beliefs.json'}: give the folder that `biotac diagnose` of data with poses wrote"
        )
    return found


def _effect(name, theta, design):
    effect = by_id(name).on(design).given(list(theta))
    return effect if effect.params.keys() == theta.keys() else effect.only(list(theta))


def believed(comparison: Comparison, search: Search, contacts: int) -> Beliefs:
    """Probabilities of the likeliest explanations that a search of so many contacts has tried, and of the
    base model alone."""
    fits = list(search.fits.values())
    posed = np.array([_posed(comparison, fit, fits) for fit in fits])
    evidence = [fit.own_evidence for fit in fits] - posed + posed * contacts / _CONTACTS
    probable = weights(evidence, [len(fit.effects) for fit in fits], contacts)
    likely = set(np.argsort(-probable)[:_MOST])
    out = [
        Explanation(fit.effects, fit.nuisance, fit.score, fit.information, float(weight))
        for k, (fit, weight) in enumerate(zip(fits, probable))
        if k in likely or not fit.effects
    ]
    out.sort(key=lambda one: -one.weight)
    end = max(float(t.clock + t.time[-1]) for t in comparison.trajectories)
    unseen, hidden = _unseen(out, search), {effect.id for effect in search.hidden}
    further = sum(one.weight for one in unseen if one.ids[-1] not in hidden)
    named = {one.effect.id for one in search.found}
    further += sum(one.weight for one in out if {*out[0].ids} < {*one.ids} <= named)
    further = float(further / (out[0].weight + further))
    return Beliefs(out, comparison.repeatability, comparison.noise, end, [], unseen, further)


def _posed(comparison, fit, fits):
    """The part of the evidence of a Fit that its effects which move all poses owe to errors of poses [nats]:
    these are another in every contact, by a known distribution, and no model's. Nothing where other effects
    leave poses that are as likely, and explain the data as well."""
    others = {e.id for e, _ in fit.effects if not e.pose_offset}
    if len(others) == len(fit.effects):
        return 0.0
    plain = [f for f in fits if not any(e.pose_offset for e, _ in f.effects)]
    rivals = [f for f in plain if f.score >= fit.score or {e.id for e, _ in f.effects} <= others]
    least = min(f.scatter(comparison) for f in rivals)
    return min(max(least - fit.scatter(comparison), 0.0), max(fit.own_evidence, 0.0))


def _unseen(explanations, search):
    """The likeliest explanation with each effect of the catalogue that none of the others adds to it."""
    first, known = explanations[0], {frozenset(one.ids) for one in explanations}
    out = []
    for gain, effect, _ in [*search.unseen, *((0.0, effect, 0.0) for effect in search.hidden)]:
        if effect.wiring or effect.id in first.ids or frozenset([*first.ids, effect.id]) in known:
            continue
        weight = first.weight * float(np.exp(min(gain, 0.0))) / len(CATALOGUE)
        out.append(dataclasses.replace(first.with_unseen(effect, gain), weight=weight))
    return out


def pooled(earlier: Sequence[pathlib.Path | str], data: list[Trajectory]) -> list[Trajectory]:
    """Trajectories of earlier rounds' reports and then of this one, on one clock."""
    out, clock = [], 0.0
    rounds = [read_trajectories(_round(folder) / "measured.h5") for folder in earlier] + [data]
    for k, some in enumerate(rounds):
        known = {t.id for t in out}
        new = [t for t in some if k == 0 or not _same(t, out)]
        late = max(0.0, clock - min((t.clock for t in new), default=clock))
        for t in new:
            name = f"round{k + 1}-{t.id}" if t.id in known else t.id
            out.append(dataclasses.replace(t, id=name, clock=t.clock + late))
        clock = max((t.clock + float(t.time[-1]) for t in out), default=0.0) + _PAUSE
    return out


def _same(t, others):
    """Whether a trajectory is there already, as where a report holds those of the rounds before it."""
    return any(
        len(t.time) == len(o.time)
        and np.array_equal(t.electrodes, o.electrodes)
        and np.array_equal(t.pos, o.pos)
        for o in others
    )
