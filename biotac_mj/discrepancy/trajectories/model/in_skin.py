"""Constitutive effects inside the finite elements instead of on the forces that they bear: the exact proof.

    sim = InSkinSimulator(skin="coarse", tier="full")
    sim.run(trajectories, effects=[(by_id("relax"), {"g": 0.3, "tau": 2.0})])  # the skin itself relaxes

It replaces a Simulator wherever the skin is solved anew (`exact`); with `exact=False` it is one.
`docs/lab/discrepancy.md` has the errors of the reduced forms."""

import dataclasses
import typing
from collections.abc import Callable

import numpy as np

from ....effects.effect import Run
from ....effects.in_film import RoughFilm, drain, remaining_liquid
from ....effects.in_skin import Inside, memory_of, moduli
from ....sensor.film import FilmConduction
from ....skin.model import SkinModel
from ..trajectory import Trajectory
from .fields import Fields
from .simulator import Simulator
from .solver import impedance_of, placed


def solve_with_memory(
    model: SkinModel,
    film: FilmConduction,
    trajectories: list[Trajectory],
    poses: list | None = None,
    progress: Callable[[], object] | None = None,
    loss: float = 0.0,
    before: float = 0.0,
) -> list:
    """Walks trajectories in their order through a skin that remembers.

    Overstress and slip are forgotten between trajectories, the largest energy of every point is not.

    Args:
      model: SkinModel; film: FilmConduction.
      poses: [(tool, pos (n, 3))] to use instead of the trajectories' own.
      loss: of liquid, as a fraction of the initial amount [1/h]; before: the fraction lost before the data.

    Returns:
      per trajectory a dict: force (n, 3) of the skin on the object [N], pressure (n,) [Pa], log_z (n,
        nelectrode), converged (n,).
    """
    from ....data.generation.simulate import Scene, _walk, clock
    from ....skin import SkinData, step

    data, out = SkinData(model), []
    for i, t in enumerate(trajectories):
        tool, pos = (t.tool, t.pos) if poses is None else poses[i]
        borne = data.memory.largest_energy() if data.memory else None
        data.reset()
        if data.memory:
            data.memory.raise_energy(borne, data.x)
        scene = Scene([tool], model.device, model.material.friction)
        at, turn, row = _walk(pos, t.mat)
        dt, clocks = clock(row, t.time, 1.0)
        scene.place(at[:1], turn[:1])
        clocks = clocks + t.clock
        if loss or before:
            drain(model, data, remaining_liquid(loss, clocks[0], before))
        one = {"force": [], "pressure": [], "x": [], "converged": []}
        for p, R, r, h, now in zip(at, turn, row, dt, clocks):
            scene.place(p[None], R[None])
            if loss:
                data.set_liquid(fill_volume=(remaining_liquid(loss, now, before) - 1) * model.liquid_volume)
            step(model, data, scene.geoms, h)
            if r >= 0:
                one["force"].append(data.wrench[0, 0, :3]), one["pressure"].append(data.pressure[0])
                one["x"].append(data.vert_xpos[0]), one["converged"].append(data.converged[0])
        out.append(
            {
                "force": np.array(one["force"]),
                "pressure": np.array(one["pressure"]),
                "converged": np.array(one["converged"]),
                "log_z": np.log(impedance_of(film, one["x"])),
            }
        )
        if progress:
            progress()
    return out


@dataclasses.dataclass
class InSkinSimulator(Simulator):
    """A Simulator of the full tier in which relaxation, creep, Mullins softening, hysteresis, stiffening and
    a modulus that varies with place act inside the elements, adhesion and load-dependent friction inside the
    contact, loss and roughness of the liquid's film in it.

    Raises:
      ValueError: another tier.
    """

    tier: str = "full"
    constitutive: typing.ClassVar[str] = "in_skin"
    inside: typing.ClassVar[Inside | None] = None  # what a copy's skin is solved with, see `run`

    def __post_init__(self):
        if self.tier != "full":
            raise ValueError(
                f"the {self.tier} tier is elastic: constitutive effects inside the elements need tier='full'"
            )
        super().__post_init__()

    def run(
        self,
        trajectories: list[Trajectory],
        fields: Fields | None = None,
        exact: bool | list = True,
        effects: list | None = None,
        *more: typing.Any,
        **kw: typing.Any,
    ) -> list[Run]:
        """See `Simulator.run`; where the skin is solved anew, the effects of `memory_of` act inside it."""
        effects = self.effects if effects is None else effects
        inside = memory_of(effects)
        if exact is False or inside.rest == list(effects):  # nothing is inside
            return super().run(trajectories, fields, exact, effects, *more, **kw)
        # nothing is cached, since the past decides
        inner = self.but(cache=None, inside=inside)
        runs = inner.run(trajectories, None, True, inside.rest, *more, **kw)
        if exact is True:
            return runs
        listed = set(np.atleast_1d(exact).tolist())
        others = super().run(trajectories, fields, False, effects, *more, **kw)
        return [runs[i] if i in listed else other for i, other in enumerate(others)]

    def solve(
        self,
        trajectories: list[Trajectory],
        offset: list | None = None,
        log_radius: list | None = None,
        log_friction: float = 0.0,
        bubble: float = 0.0,
        progress: Callable[[], object] | None = None,
    ) -> list:
        """See `Solver.solve`."""
        if self.inside is None:
            return super().solve(trajectories, offset, log_radius, log_friction, bubble, progress)
        poses = placed(trajectories, offset, log_radius)
        model, film = self.skin_and_film(log_friction, bubble)
        power = self.inside.film.get("power")
        film = film if power is None else RoughFilm(film, power)
        loss, before = (self.inside.film.get(name, 0.0) for name in ("loss", "before"))
        return solve_with_memory(model, film, trajectories, poses, progress, loss, before)

    def skin_and_film(self, log_friction: float, bubble: float) -> tuple:
        """See `Solver.skin_and_film`; with what is `inside`."""
        if self.inside is not None and bubble not in self._models:
            super().skin_and_film(0.0, bubble)
            plain = self._models[bubble]
            rubber, options = self.inside.rubber(plain.material), self.inside.options(plain.options)
            factors = moduli(self._read()[0].modulus, self.inside.model.get("modulus"), plain.geometry)
            self._models[bubble] = SkinModel(plain.geometry, rubber, options, plain.device, modulus=factors)
        return super().skin_and_film(log_friction, bubble)
