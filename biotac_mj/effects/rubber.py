"""Effects of the skin's rubber.

Bounds and sources are those of the cited literature; "generic" means silicone in general. The effects act on
the rubber's load: for a displacement-controlled object and an elastic field of constant form, a separable law
keeps the field and changes force and pressure (correspondence principle, Lee and Radok 1960; exact for linear
materials while the contact grows)."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import erf

from ..sensor.presets import Sensor
from .effect import Effect, Param, Run, Whole, memory, stop
from .in_skin import Inside, friction_branch, stiffening

_SPOT = 4.0  # [mm] decay length of a spot's stiffness
# Fraction of the film's change that is as delayed as the load: slowly yielding rubber lets liquid pass as
# slowly. Inside the finite elements the film follows from the skin.
_FILM = Param("1", 0.0, 0.5, "0-0.2: CHOSEN", 0.05)
# The base model's film may be the instantaneous one, the final one, or in between; the modulus decides this
# for the load.
_MORE = Param("1", -0.5, 0.5, "further change of the film, delayed or not: CHOSEN", 0.08)
# Liquid and rubber share the load in constant proportion only if the skin keeps its shape; a film that creeps
# changes the liquid's part.
_LIQUID = "further relaxation of the liquid's pressure: CHOSEN"
_LOOP_OF_LIQUID = Param("1", -0.4, 0.4, "further loop of the liquid's pressure: CHOSEN", 0.08)
# [s] of the Prony series that approximates a power law: a factor of three apart, over three decades
_TAUS = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
_SLOPE = float(np.log(10**0.5))  # of each of them
_LOOP = 0.2e-3  # [m] of depth over which the branch changes, if the effect gives it for the load
# m [J/m^3] and, if the effect has no width, beta of Ogden and Roxburgh: W_max is of order kJ/m^3
_ENERGY, _WIDTH = (1.0, 0.6)
_AS_MUCH = 1.25  # ratio to the rubber's relaxation: a larger one of the pressure has another cause
SPOT = "at_"  # begins the name of a modulus at a place


class Relaxation(Effect):
    id, name, stage = "relax", "stress relaxation (Prony)", "C"
    physics = "G(t) = G (1 + g exp(-t / tau)): stress follows strain at once and relaxes"
    requires = frozenset({"protocol"})
    params = {
        "g": Param("1", 0.0, 0.8, "0.02-0.3 (Kunzemann 2024; Liao 2020)", 0.1),
        "film": _FILM,
        "tau": Param("s", 0.05, 100, "2-3 terms", 1.0, 1.0, True),
    }
    rare = {"liquid": Param("1", -0.8, 0.8, _LIQUID, 0.1), "more": _MORE}
    grid = ({"tau": 0.1}, {"tau": 0.5}, {"tau": 2.0}, {"tau": 8.0})
    equivalents = ("creep",)
    confusable = {
        "hyster": "the same depth with holds of 0, 1 and 30 s and ten times the speed",
        "creep": "a hold of 100 s",
    }

    def rejection_reason(self, theta: dict) -> str | None:
        if abs(theta.get("liquid", 0.0)) > _AS_MUCH * theta["g"] + 0.02:
            return "liquid"
        return _film_rejection(theta, theta["g"])

    def in_skin(self, inside: Inside, theta: dict) -> bool:
        return _relaxing(inside, theta["g"], theta["tau"])

    def in_sensor(self, sensor: Sensor, theta: dict) -> dict:
        """Relaxation of PDC, for a sensor without a skin."""
        return {"relaxation": (theta["g"], theta["tau"])}

    def apply(self, run: Run, theta: dict) -> None:
        run.force = run.force + theta["g"] * memory(run, run.force, theta["tau"], "force")
        liquid = theta["g"] + theta.get("liquid", 0.0)
        run.pressure = run.pressure + liquid * memory(run, run.pressure, theta["tau"], "pressure")
        if theta.get("film"):
            run.log_z = run.log_z - theta["film"] * memory(run, run.log_z, theta["tau"], "log_z")
        _scaled_film(run, theta)


class PowerCreep(Effect):
    id, name, stage = "creep", "power-law relaxation (springpot)", "C"
    physics = "G(t) ~ (t + t0)^-n: no plateau"
    requires = frozenset({"protocol"})
    params = {"n": Param("1", 0.0, 0.3, "0.01-0.15", 0.04), "film": _FILM}
    rare = {"liquid": Param("1", -0.3, 0.3, _LIQUID, 0.04), "more": _MORE}
    equivalents = ("relax",)
    confusable = {"relax": "a hold of 100 s; else the law beyond the longest hold is not known"}

    def rejection_reason(self, theta: dict) -> str | None:
        if abs(theta.get("liquid", 0.0)) > _AS_MUCH * theta["n"] + 0.005:
            return "liquid"
        return _film_rejection(theta, 8 * theta["n"])  # of all its times together

    def in_skin(self, inside: Inside, theta: dict) -> bool:
        return all(_relaxing(inside, theta["n"] * _SLOPE, tau) for tau in _TAUS)

    def apply(self, run: Run, theta: dict) -> None:
        weight, liquid = theta["n"] * _SLOPE, (theta["n"] + theta.get("liquid", 0.0)) * _SLOPE
        if theta.get("film"):
            late = sum(memory(run, run.log_z, tau, "log_z") for tau in _TAUS) / len(_TAUS)
            run.log_z = run.log_z - theta["film"] * late
        _scaled_film(run, theta)
        for tau in _TAUS:
            run.force = run.force + weight * memory(run, run.force, tau, "force")
            run.pressure = run.pressure + liquid * memory(run, run.pressure, tau, "pressure")


def _relaxing(inside, g, tau):
    """Adds a branch g that relaxes with tau inside the skin."""
    if g > 0:
        inside.material["prony"] += ((g, tau),)
    return True


class Hysteresis(Effect):
    id, name, stage = "hyster", "rate-independent hysteresis", "C"
    physics = (
        "Prandtl-Ishlinskii elements in depth: loading and unloading differ at equal depth, at any speed"
    )
    requires = frozenset({"protocol"})
    params = {
        "fraction": Param("1", 0.0, 0.5, "loops of 13-24 % of full scale (Sensors 2023)", 0.1),
        "film": _FILM,
        "width": Param(
            "m", 0.05e-3, 0.6e-3, "depth over which the branch changes, 0.05-0.4 mm", 0.2e-3, 0.2e-3, True
        ),
    }
    rare = {"liquid": _LOOP_OF_LIQUID, "more": _MORE}
    grid = ({"width": 0.1e-3}, {"width": 0.3e-3})
    equivalents = ("hyster_load",)
    confusable = {
        "relax": "the same depth at ten times the speed",
        "mullins": "a third cycle to the same depth",
    }

    def rejection_reason(self, theta: dict) -> str | None:
        return _liquid_rejection(theta)

    def in_skin(self, inside: Inside, theta: dict) -> bool:
        return _looping(inside, theta["fraction"], theta["width"])

    def apply(self, run: Run, theta: dict) -> None:
        width = theta["width"]
        z = stop(run.depth, width)
        run.force = run.force * (1 + theta["fraction"] * z / width)[:, None]
        run.pressure = run.pressure * (1 + (theta["fraction"] + theta.get("liquid", 0.0)) * z / width)
        if theta.get("film"):
            followed = 1 - theta["film"] * z[:, None] / width
            run.log_z = run.log_z[0] + followed * (run.log_z - run.log_z[0])
        _scaled_film(run, theta)


class LoadHysteresis(Effect):
    id, name, stage = "hyster_load", "hysteresis of the load", "C"
    physics = (
        "a Prandtl-Ishlinskii element in load: unloading is lower by a fraction of the press's peak, "
        "at any speed; the film follows with the same play"
    )
    requires = frozenset({"protocol"})
    params = {
        "fraction": Param("1", 0.0, 0.4, "loops of 13-24 % of full scale (Sensors 2023)", 0.08),
        "film": _FILM,
        "width": Param("1", 0.05, 0.6, "fraction of the peak over which the branch changes", 0.2, 0.2, True),
    }
    rare = {"liquid": _LOOP_OF_LIQUID, "more": _MORE}
    grid = ({"width": 0.1}, {"width": 0.3})
    equivalents = ("hyster",)
    confusable = {
        "hyster": "a small cycle on a large load",
        "relax": "the same depth at ten times the speed",
        "mullins": "a third cycle to the same depth",
    }

    def rejection_reason(self, theta: dict) -> str | None:
        return _liquid_rejection(theta)

    def in_skin(self, inside: Inside, theta: dict) -> bool:
        return _looping(inside, theta["fraction"], _LOOP)

    def apply(self, run: Run, theta: dict) -> None:
        load = run.normal_force
        peak = max(load.max(), 1e-6)
        z = stop(load / peak, theta["width"]) / theta["width"]
        loop = z / np.maximum(load / peak, 0.03)
        run.force = run.force * np.maximum(1 + theta["fraction"] * loop, 0.0)[:, None]
        run.pressure = run.pressure * np.maximum(
            1 + (theta["fraction"] + theta.get("liquid", 0.0)) * loop, 0.0
        )
        if theta.get("film"):
            change = run.log_z - run.log_z[0]
            half = theta["film"] * np.abs(change).max(0)
            run.log_z = run.log_z - stop(change, half)
        _scaled_film(run, theta)


def _looping(inside, fraction, width):
    """Adds a friction branch inside the skin."""
    if fraction > 0:
        branches = inside.material.get("hysteresis", ())
        inside.material["hysteresis"] = (*branches, friction_branch(fraction, width))
    return True


def _liquid_rejection(theta):
    """Rejection reason of a loop of the liquid's pressure without one of the force, or of its film."""
    if abs(theta.get("liquid", 0.0)) > _AS_MUCH * theta["fraction"] + 0.02:
        return "liquid"
    return _film_rejection(theta, theta["fraction"])


def _film_rejection(theta, load):
    """Rejection reason of a film that is delayed while the load is not (by its fraction `load`), or that
    changes by more than its delayed fraction: that is another effect."""
    late = theta.get("film", 0.0)
    strange = late > 2 * load + 0.03 or abs(theta.get("more", 0.0)) > 2 * late + 0.02
    return "film" if strange else None


def _scaled_film(run, theta):
    """Scales the film's change, delayed or not."""
    if theta.get("more"):
        run.log_z = run.log_z + theta["more"] * (run.log_z - run.rest_log_z)


class Mullins(Effect):
    id, name, stage = "mullins", "Mullins softening", "C"
    physics = (
        "Ogden-Roxburgh with work as depth^2: load times 1 - s erf((1 - W / Wmax) / width) "
        "below the deepest earlier press, at its place and (a fraction of s) elsewhere"
    )
    params = {
        "softening": Param("1", 0.0, 0.6, "1/r 0.05-0.4 (Ecoflex, Liao 2020)", 0.15),
        "width": Param("1", 0.1, 3, "m + b Wmax over Wmax", 1.0, 1.0, True),
        "reach": Param("m", 1e-3, 10e-3, "radius of a contact", 3e-3, 3e-3, True),
        # inside the finite elements a press of 1.5 mm takes 0.83 of the force a centimetre away, 0.62 at its
        # own place
        "whole": Param(
            "1", 0.01, 0.9, "the liquid stretches all of the skin under any press", 0.3, 0.01, True
        ),
    }
    grid = tuple(
        {"width": w, "reach": r, "whole": s}
        for w in (0.3, 1.0)
        for r, s in ((1.5e-3, 0.01), (4e-3, 0.01), (4e-3, 0.4))
    )
    equivalents = ("damage",)
    confusable = {
        "hyster": "a third cycle to the same depth",
        "adhesion": "talc on the skin",
        "damage": "a deeper press than any before: is it softer than the first ones?",
    }

    def in_skin(self, inside: Inside, theta: dict) -> bool:
        if theta["softening"] > 0:
            inside.material["mullins"] = 1 / theta["softening"], _ENERGY, theta.get("width", _WIDTH)
        return True

    def apply(self, run: Run, theta: dict) -> None:
        seen, whole = run.session.setdefault("mullins", []), theta.get("whole", 0.0)
        depth, pressure = np.maximum(run.depth, 0), np.maximum(run.pressure / run.modulus, 0)
        near = [np.exp(-((np.linalg.norm(p - run.place) / theta["reach"]) ** 2)) for p, *_ in seen]
        here = _eased(depth, max((d * w for (_, d, _), w in zip(seen, near)), default=0.0), theta["width"])
        all_ = _eased(pressure, max((p for *_, p in seen), default=0.0), theta["width"])
        run.scale_load(1 - theta["softening"] * ((1 - whole) * here + whole * all_))
        seen.append((run.place, float(depth.max()), float(pressure.max())))


class Damage(Effect):
    id, name, stage = "damage", "softening by work (continuous damage)", "C"
    physics = (
        "all of the skin softens permanently with the work done on it, at every load: "
        "load times 1 - d (1 - exp(-W / W0)) (Miehe 1995)"
    )
    params = {
        "damage": Param("1", 0.0, 0.8, "0.05-0.4 in the first cycles (Liao 2020)", 0.15),
        "work": Param("J", 1e-4, 0.1, "a press takes about 1 mJ: CHOSEN", 2e-3, 2e-3, True),
    }
    grid = ({"work": 5e-4}, {"work": 2e-3}, {"work": 8e-3})
    equivalents = ("mullins",)
    confusable = {
        "mullins": "a deeper press than any before: is it softer than the first ones?",
        "relax": "the same press again after minutes: relaxation recovers",
        "modulus": "the same press at the beginning and the end of the session",
    }

    def in_whole(self, whole: Whole, theta: dict) -> None:
        """The sensor starts in the session's final state."""
        whole.modulus *= 1 - theta["damage"]

    def apply(self, run: Run, theta: dict) -> None:
        pressed = np.maximum(np.diff(run.depth, prepend=run.depth[0]), 0)
        work = run.session.get("damage", 0.0) + np.cumsum(pressed * run.normal_force / run.modulus)
        run.session["damage"] = float(work[-1])
        run.scale_load(1 - theta["damage"] * (1 - np.exp(-work / theta["work"])))


def _eased(strain, before, width):
    """(n,) fraction of the softening at strains (n,) below the largest before, with W as strain^2."""
    largest = np.maximum(before, np.maximum.accumulate(strain))
    ratio = np.where(largest > 1e-6, strain / np.maximum(largest, 1e-6), 1.0)
    return erf(np.clip(1 - ratio**2, 0, 1) / width)


class Stiffening(Effect):
    id, name, stage = "stiffen", "hyperelastic stiffening", "C"
    physics = "the rubber's modulus rises with strain: Yeoh's second term in the mean strain depth / 1.5 mm"
    params = {"c2": Param("1", -0.5, 1.5, "c2/c1 0-1", 0.15)}
    # With the skin's own solution: rubber that stiffens everywhere, not only where it is strained most, keeps
    # its shape, and electrodes hardly change.
    rare = {"through": Param("1", -0.5, 2.0, "of the load at a mean strain of 1: CHOSEN", 0.3)}
    answers = ("stiffen",)
    confusable = {"mount": "push on a rigid block; other radii at equal force", "radius": "light load"}

    def in_skin(self, inside: Inside, theta: dict) -> bool:
        c2, already = theta["c2"] + theta.get("through", 0.0), inside.material.get("stiffening", 0.0)
        inside.material["stiffening"] = stiffening(c2, already)
        return True

    def apply(self, run: Run, theta: dict) -> None:
        load = theta.get("through", 0.0)
        if "stiffen" in run.answers:  # the skin was solved with stiffening rubber
            run.add(theta["c2"] * run.answers["stiffen"])
        else:
            load += theta["c2"]
        run.scale_load(1 + load * (np.maximum(run.depth, 0) / 1.5e-3) ** 2)


class Inhomogeneity(Effect):
    id, name, stage = "inhomog", "modulus varies with place", "C"
    physics = "stiffer towards the tip or the clamp, or towards one side"
    params = {
        "along": Param("1/cm", -1, 1, "map 0-0.3 over 3-8 mm; durometer +-5 Shore A", 0.15),
        "across": Param("1/cm", -1, 1, "the same", 0.15),
    }
    equivalents, answers = ("gain", "spots"), ("along", "across")
    confusable = {
        "misalign": "mount the sensor again: misalignment changes, the material's map moves with the sensor",
        "gain": "force over depth from place to place: gains of electrodes do not change it",
        "spots": "a row of presses along the sensor",
    }

    def in_skin(self, inside: Inside, theta: dict) -> bool:
        mine, other = modulus_of(theta), inside.model.get("modulus")
        inside.model["modulus"] = mine if other is None else lambda at: mine(at) * other(at)
        return True

    def apply(self, run: Run, theta: dict) -> None:
        if "along" not in run.answers:
            run.scale_load(float(modulus_of(theta)(run.place[None])[0]))
            return
        for direction, slope in ((w, run.answers[w]) for w in self.params if w in run.answers):
            run.add(theta[direction] * slope)  # the skin was solved with a varying modulus


class Spots(Inhomogeneity):
    """Parameters are named by positions in millimetres, such as "at_-8.0_-6.5_1.0": the logarithm of the
    modulus there. The simulator chooses the positions (`simulator.spots`)."""

    id, name = "spots", "stiff or soft spots"
    physics = "the rubber is stiffer or softer in spots of some millimetres: wear, cuts, glue"
    equivalents = ("gain", "inhomog")
    confusable = {
        "inhomog": "a row of presses along the sensor",
        "gain": "force over depth from place to place: gains of electrodes do not change it",
    }

    def __init__(self, places: Sequence[str] = ("at_-8.0_-6.5_0.0",)):
        self.params = {name: Param("1", -1.5, 1.5, "worn, glued or cut: CHOSEN", 0.3) for name in places}

    def given(self, names: Sequence[str]) -> "Spots":
        return Spots([name for name in names if name.startswith(SPOT)])

    solved = given

    def applicable(self, trajectories: list) -> str | None:
        return None if self.params else "no place is touched twice"


def modulus_of(theta: dict) -> Callable[[np.ndarray], np.ndarray]:
    """Function from positions (n, 3) [m] to factors (n,) on Young's modulus, for `Inhomogeneity` or
    `Spots`."""
    along, across = theta.get("along", 0.0), theta.get("across", 0.0)
    names = [name for name in theta if name.startswith(SPOT)]
    spots = [(np.array([float(v) for v in name.split("_")[1:]]), name) for name in names]

    def modulus(at):
        factor = np.maximum(1 + along * 100 * (at[:, 0] + 8e-3) + across * 100 * at[:, 2], 0.1)
        for centre, name in spots:
            near = np.exp(-(((1e3 * at - centre) / _SPOT) ** 2).sum(1))
            factor = factor * np.exp(theta[name] * near)
        return factor

    return modulus


class Modulus(Effect):
    """Not in the catalogue: `diagnose` calibrates the base model with it before the search for effects, and
    reports it separately."""

    id, name, stage = "modulus", "modulus of the rubber", "C"
    fits = frozenset()
    physics = "all of the skin is stiffer or softer: force and pressure are scaled, impedances are not"
    params = {"factor": Param("1", 0.2, 5.0, "10 % from batch to batch; 1.7 by the mesh", 0.3, 1.0)}
    confusable = {"pdc_gain": "force over depth: a gain of PDC does not change it", "radius": "another tool"}

    def apply(self, run: Run, theta: dict) -> None:
        run.scale_load(theta["factor"])
