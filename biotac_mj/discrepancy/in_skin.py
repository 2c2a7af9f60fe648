"""Relaxation, creep and Mullins softening inside the finite elements instead of on the forces that they bear: the exact proof.

    sim = InSkinSimulator(skin="coarse", tier="full")
    sim.run(trajectories, effects=[(by_id("relax"), {"g": 0.3, "tau": 2.0})])         # the skin itself relaxes

It takes the place of a Simulator wherever the skin is solved anew (`exact`); with `exact=False` it is one. `docs/discrepancy.md` says how
much the reduced forms differ.
"""

import dataclasses
import typing

import numpy as np

from .simulator import Simulator, _impedance, placed

__all__ = ["InSkinSimulator", "memory_of", "solve_with_memory"]

_TAUS = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)  # [s] of the Prony series that stands for a power law, as in `catalogue.PowerCreep`
_ENERGY, _SHARE = 1.0, 0.6  # m [J/m^3] and, where the effect has no width, beta of Ogden and Roxburgh: W_max is of kJ/m^3


def memory_of(effects):
    """What a material remembers under effects [(Effect, theta)]: dict of `prony` and `mullins`, and the effects that are left."""
    prony, mullins, rest = [], None, []
    for effect, theta in effects:
        if effect.id == "relax":
            prony.append((max(theta["g"], 0.0), theta["tau"]))
        elif effect.id == "creep":
            prony += [(max(theta["n"], 0.0) * np.log(10**0.5), tau) for tau in _TAUS]
        elif effect.id == "mullins" and theta["softening"] > 0:
            mullins = (1 / theta["softening"], _ENERGY, theta.get("width", _SHARE))
        else:
            rest.append((effect, theta))
    return {"prony": tuple(p for p in prony if p[0] > 0), "mullins": mullins}, rest


def solve_with_memory(model, film, trajectories, poses=None, progress=None) -> list:
    """Walks trajectories in their order through a skin that remembers.

    Overstress is forgotten between trajectories, the largest energy of every point is not.

    Args:
      model: SkinModel on the CPU whose material has `prony` or `mullins`; film: FilmConduction.
      poses: [(tool, pos (n, 3))] to use instead of the trajectories' own.

    Returns:
      per trajectory a dict: force (n, 3) of the skin on the object [N], pressure (n,) [Pa], log_z (n, 19), converged (n,).
    """
    from ..data.simulate import Scene, _walk
    from ..skin import SkinData, step

    data, out = SkinData(model), []
    for i, t in enumerate(trajectories):
        tool, pos = (t.tool, t.pos) if poses is None else poses[i]
        worst = data.memory.worst.copy()
        data.reset()
        np.maximum(worst, data.memory.worst, out=data.memory.worst)
        scene = Scene([tool], model.device, model.material.friction)
        at, turn, row = _walk(pos, t.mat)
        ends = np.flatnonzero(row >= 0)
        count = np.diff(ends, prepend=-1)  # steps to each row
        dt = np.repeat(np.diff(t.time, prepend=t.time[0] - 1.0) / count, count)
        scene.place(at[:1], turn[:1])
        one = {"force": [], "pressure": [], "x": [], "converged": []}
        for p, R, r, h in zip(at, turn, row, dt):
            scene.place(p[None], R[None])
            step(model, data, scene.geoms, h)
            if r >= 0:
                one["force"].append(data.wrench[0, 0, :3]), one["pressure"].append(data.pressure[0])
                one["x"].append(data.vert_xpos[0]), one["converged"].append(data.converged[0])
        out.append({"force": np.array(one["force"]), "pressure": np.array(one["pressure"]), "converged": np.array(one["converged"]),
                    "log_z": np.log(_impedance(film, one["x"]))})  # fmt: skip
        if progress:
            progress()
    return out


@dataclasses.dataclass
class InSkinSimulator(Simulator):
    """A Simulator of the full tier in which relaxation, creep and Mullins softening act inside the elements.

    Raises:
      ValueError: another tier.
    """

    tier: str = "full"
    constitutive: typing.ClassVar[str] = "in_skin"

    def __post_init__(self):
        if self.tier != "full":
            raise ValueError(f"the {self.tier} tier is elastic: relaxation inside the elements needs tier='full'")

    def run(self, trajectories, fields=None, exact=True, effects=None, **kw):
        """See `Simulator.run`; where the skin is solved anew, what the material remembers is inside it."""
        effects = self.effects if effects is None else effects
        memory, rest = memory_of(effects)
        if exact is False or len(rest) == len(effects):
            return super().run(trajectories, fields, exact, effects, **kw)
        inner = _Remembering(**{f.name: getattr(self, f.name) for f in dataclasses.fields(Simulator) if f.init} | {"cache": None})
        inner.memory, inner._models = memory, {}
        runs = inner.run(trajectories, None, True, rest, **kw)
        if exact is True:
            return runs
        listed = set(np.atleast_1d(exact).tolist())
        others = super().run(trajectories, fields, False, effects, **kw)
        return [runs[i] if i in listed else other for i, other in enumerate(others)]


class _Remembering(Simulator):
    """Solves the skin with `memory`; nothing is cached, since the past decides."""

    def solve(self, trajectories, offset=None, log_radius=None, log_friction=0.0, bubble=0.0, progress=None) -> list:
        poses = [
            placed(t, None if offset is None else offset[i], 0.0 if log_radius is None else float(log_radius[i]))
            for i, t in enumerate(trajectories)
        ]
        model, film = self._model(log_friction, bubble)
        return solve_with_memory(model, film, trajectories, poses, progress)

    def _model(self, log_friction, bubble):
        from ..skin.material import material
        from ..skin.model import SkinModel

        if bubble not in self._models:
            super()._model(0.0, bubble)
            elastic = self._models[bubble]
            self._models[bubble] = SkinModel(elastic.geometry, dataclasses.replace(material(self.material), **self.memory), elastic.options)
        return super()._model(log_friction, bubble)
