"""Constitutive effects inside the finite elements instead of on the forces that they bear: the exact proof.

    sim = InSkinSimulator(skin="coarse", tier="full") sim.run(trajectories, effects=[(by_id("relax"), {"g":
    0.3, "tau": 2.0})])         # the skin itself relaxes

It takes the place of a Simulator wherever the skin is solved anew (`exact`); with `exact=False` it is one.
`docs/discrepancy.md` says how much the reduced forms differ."""

import dataclasses
import typing

import numpy as np

from .in_film import RoughFilm, drain, left
from .simulator import Simulator, _impedance, placed

__all__ = ["Inside", "InSkinSimulator", "memory_of", "solve_with_memory"]

_TAUS = (
    0.03,
    0.1,
    0.3,
    1.0,
    3.0,
    10.0,
    30.0,
)  # [s] of the Prony series that stands for a power law, as in `catalogue.PowerCreep`
# what benchmarks/discrepancy_in_skin_maps.py measured on presses of the coarse skin (docs/memory.md):
# the c2 that the force of a stiffening c2 / c1 of the rubber looks like
_STIFFENING = (-120, -40, -12, -4, -1, 0, 1, 4, 12, 40, 120, 400, 1000)
_C2 = (
    -0.7168,
    -0.3972,
    -0.1518,
    -0.0522,
    -0.0131,
    0.0,
    0.0128,
    0.0470,
    0.1197,
    0.2990,
    0.6382,
    1.3962,
    2.4646,
)
# and for widths of the hysteresis [m] the strain at which a friction branch slips and its modulus over the
# fraction
_WIDTH = (0.05e-3, 0.1e-3, 0.2e-3, 0.3e-3, 0.4e-3, 0.6e-3)
_STRAIN = (0.00030, 0.00105, 0.00319, 0.00436, 0.00683, 0.01297)
_BRANCH = (41.20, 12.36, 4.95, 3.86, 2.77, 1.81)
_PARTING = 3.0  # work of parting over that of joining, as in `effects_skin.Adhesion`
# under a 7 mm sphere on the coarse skin (benchmarks/discrepancy_contact.py) the nodes' pressure [Pa] is the
# second times force^the first: force^-n is pressure^(-n / the first), and at 1 N mu is the material's
_PRESSURE = 0.70, 1.65e5
_ENERGY, _SHARE = (
    1.0,
    0.6,
)  # m [J/m^3] and, where the effect has no width, beta of Ogden and Roxburgh: W_max is of kJ/m^3


class Inside(typing.NamedTuple):
    """What effects become inside the skin: changes of its `Material`, of its `SkinOptions` (the contact),
    arguments of its `SkinModel`, the liquid's `loss` [1/h] and the `power` of its film's conductance; and the
    effects [(Effect, theta)] that are left to act as they do without the skin."""

    material: dict
    contact: dict
    model: dict
    film: dict
    rest: list


def memory_of(effects) -> Inside:
    """What effects [(Effect, theta)] change of a skin in which they act themselves."""
    inside = Inside({"prony": ()}, {}, {}, {}, [])
    for effect, theta in effects:
        becomes = _BECOMES.get(effect.id)
        if becomes is None:
            inside.rest.append((effect, theta))
        else:
            becomes(inside, theta)
    return inside


def _relax(inside, theta):
    if theta["g"] > 0:
        inside.material["prony"] += ((theta["g"], theta["tau"]),)


def _creep(inside, theta):
    for tau in _TAUS:
        _relax(inside, {"g": theta["n"] * np.log(10**0.5), "tau": tau})


def _mullins(inside, theta):
    if theta["softening"] > 0:
        inside.material["mullins"] = 1 / theta["softening"], _ENERGY, theta.get("width", _SHARE)


def modulus_of(theta):
    """Function of positions (n, 3) [m] that gives the factors (n,) on Young's modulus of
    `effects_skin.Inhomogeneity`."""

    def modulus(at):
        return np.maximum(
            1 + theta["along"] * 100 * (at[:, 0] + 8e-3) + theta["across"] * 100 * at[:, 2], 0.1
        )

    return modulus


def _inhomog(inside, theta):
    mine, other = modulus_of(theta), inside.model.get("modulus")
    inside.model["modulus"] = mine if other is None else lambda at: mine(at) * other(at)


def _stiffen(inside, theta):
    c2 = theta["c2"] + np.interp(inside.material.get("stiffening", 0.0), _STIFFENING, _C2)
    inside.material["stiffening"] = float(np.interp(c2, _C2, _STIFFENING))


def _hyster(inside, theta):
    if theta["fraction"] > 0:
        width = np.log(theta["width"])
        strain, ratio = (
            np.exp(np.interp(width, np.log(_WIDTH), np.log(table))) for table in (_STRAIN, _BRANCH)
        )
        inside.material["hysteresis"] = (
            *inside.material.get("hysteresis", ()),
            (float(ratio * theta["fraction"]), float(strain)),
        )


def _adhesion(inside, theta):
    if theta["W"] > 0:
        inside.contact.setdefault("contact_law", {}).update(adhesion=theta["W"], adhesion_hysteresis=_PARTING)
        inside.contact["tolerance"] = 1e-4  # it pulls with millinewtons


def _fric_load(inside, theta):
    if theta["exponent"]:
        inside.contact.setdefault("contact_law", {}).update(
            friction_exponent=theta["exponent"] / _PRESSURE[0], friction_pressure=_PRESSURE[1]
        )


def _fluidloss(inside, theta):
    if theta["rate"] > 0:
        inside.film["loss"] = inside.film.get("loss", 0.0) + theta["rate"]


def _asper(inside, theta):
    if theta["log_p"]:
        inside.film["power"] = inside.film.get("power", 1.0) * float(np.exp(theta["log_p"]))


_BECOMES = {
    "relax": _relax,
    "creep": _creep,
    "mullins": _mullins,
    "hyster": _hyster,
    "stiffen": _stiffen,
    "inhomog": _inhomog,
    "adhesion": _adhesion,
    "fric_load": _fric_load,
    "fluidloss": _fluidloss,
    "asper": _asper,
}  # effect id -> function that writes it into an Inside


def solve_with_memory(model, film, trajectories, poses=None, progress=None, loss=0.0) -> list:
    """Walks trajectories in their order through a skin that remembers.

    Overstress and slip are forgotten between trajectories, the largest energy of every point is not.

    Args:
      model: SkinModel on the CPU; film: FilmConduction.
      poses: [(tool, pos (n, 3))] to use instead of the trajectories' own.
      loss: of liquid, as a share of what there was at the session's beginning [1/h].

    Returns:
      per trajectory a dict: force (n, 3) of the skin on the object [N], pressure (n,) [Pa], log_z (n, 19),
        converged (n,).
    """
    from ..data.simulate import Scene, _walk
    from ..skin import SkinData, step

    data, out = SkinData(model), []
    for i, t in enumerate(trajectories):
        tool, pos = (t.tool, t.pos) if poses is None else poses[i]
        worst = data.memory.worst.copy() if data.memory else None
        data.reset()
        if data.memory:
            np.maximum(worst, data.memory.worst, out=data.memory.worst)
        scene = Scene([tool], model.device, model.material.friction)
        at, turn, row = _walk(pos, t.mat)
        ends = np.flatnonzero(row >= 0)
        count = np.diff(ends, prepend=-1)  # steps to each row
        dt = np.repeat(np.diff(t.time, prepend=t.time[0] - 1.0) / count, count)
        scene.place(at[:1], turn[:1])
        clock = t.clock + t.time[0] + np.cumsum(dt) - dt[0]
        if loss:
            drain(model, data, left(loss, clock[0]))
        one = {"force": [], "pressure": [], "x": [], "converged": []}
        for p, R, r, h, now in zip(at, turn, row, dt, clock):
            scene.place(p[None], R[None])
            if loss:
                data.set_liquid(fill_volume=(left(loss, now) - 1) * model.liquid_volume)
            step(model, data, scene.geoms, h)
            if r >= 0:
                one["force"].append(data.wrench[0, 0, :3]), one["pressure"].append(data.pressure[0])
                one["x"].append(data.vert_xpos[0]), one["converged"].append(data.converged[0])
        out.append(
            {
                "force": np.array(one["force"]),
                "pressure": np.array(one["pressure"]),
                "converged": np.array(one["converged"]),
                "log_z": np.log(_impedance(film, one["x"])),
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

    def __post_init__(self):
        if self.tier != "full":
            raise ValueError(
                f"the {self.tier} tier is elastic: constitutive effects inside the elements need tier='full'"
            )

    def run(self, trajectories, fields=None, exact=True, effects=None, *more, **kw):
        """See `Simulator.run`; where the skin is solved anew, what `memory_of` knows is inside it."""
        effects = self.effects if effects is None else effects
        inside = memory_of(effects)
        if exact is False or len(inside.rest) == len(effects):
            return super().run(trajectories, fields, exact, effects, *more, **kw)
        inner = _Remembering(
            **{f.name: getattr(self, f.name) for f in dataclasses.fields(Simulator) if f.init}
            | {"cache": None}
        )
        inner.inside, inner._models = inside, {}
        runs = inner.run(trajectories, None, True, inside.rest, *more, **kw)
        if exact is True:
            return runs
        listed = set(np.atleast_1d(exact).tolist())
        others = super().run(trajectories, fields, False, effects, *more, **kw)
        return [runs[i] if i in listed else other for i, other in enumerate(others)]


class _Remembering(Simulator):
    """Solves the skin with what is `inside`; nothing is cached, since the past decides."""

    def solve(
        self, trajectories, offset=None, log_radius=None, log_friction=0.0, bubble=0.0, progress=None
    ) -> list:
        poses = [
            placed(
                t, None if offset is None else offset[i], 0.0 if log_radius is None else float(log_radius[i])
            )
            for i, t in enumerate(trajectories)
        ]
        model, film = self._model(log_friction, bubble)
        power = self.inside.film.get("power")
        film = film if power is None else RoughFilm(film, power)
        return solve_with_memory(
            model, film, trajectories, poses, progress, self.inside.film.get("loss", 0.0)
        )

    def _model(self, log_friction, bubble):
        from ..skin.rubber.material import material
        from ..skin.model import SkinModel

        if bubble not in self._models:
            super()._model(0.0, bubble)
            plain = self._models[bubble]
            rubber = dataclasses.replace(material(self.material), **self.inside.material)
            options = dataclasses.replace(plain.options, **self.inside.contact)
            self._models[bubble] = SkinModel(plain.geometry, rubber, options, **self.inside.model)
        return super()._model(log_friction, bubble)
