"""Effects of the contact between the skin and what it touches. Bounds and sources are those of the cited
literature."""

import copy
from collections.abc import Sequence

import numpy as np

from .effect import Effect, Param, Run, Whole
from .in_skin import Inside

_PARTING = 3.0  # ratio of the works of separation and adhesion, as in `Adhesion`
# under a 7 mm sphere on the coarse skin the nodes' pressure [Pa] is the second times force^the first, so that
# force^-n is pressure^(-n / the first), and at 1 N mu is the material's (measured by
# benchmarks/discrepancy_in_skin_maps.py)
_PRESSURE = 0.70, 1.65e5
TACKY = "tacky_"  # prefix of a Run's answers to adhesive contact, before the work of adhesion [J/m2]


class Friction(Effect):
    id, name, stage = "friction", "friction level", "K"
    physics = "Coulomb's coefficient times a factor"
    params = {"log_mu": Param("1", -1.6, 1.0, "mu 0.2-1.5", 0.3)}
    equivalents = ("fric_load",)
    before_skin = True
    instead_of = ("log_friction",)
    confusable = {"fric_load": "slides at three normal loads with two radii"}

    def applicable(self, trajectories: list) -> str | None:
        slide = max(np.ptp((t.pos - t.pos[0]) - np.outer(t.depth, t.heading)) for t in trajectories)
        return None if slide > 0.3e-3 else "no slides"

    def in_whole(self, whole: Whole, theta: dict) -> None:
        whole.friction *= float(np.exp(theta.get("log_mu", 0.0)))

    def apply(self, run: Run, theta: dict) -> None:
        run.log_friction = run.log_friction + theta["log_mu"]


class FrictionLoad(Effect):
    id, name, stage = "fric_load", "friction that saturates with load", "K"
    physics = (
        "tangential force tau0 A rather than mu F: "
        "its ratio to the normal force falls with load (Trejo 2017; Sahli 2018)"
    )
    params = {
        "exponent": Param("1", -0.2, 0.7, "0-1 of the pressure", 0.1),
        "log_mu": Param("1", -1.6, 1.0, "mu 0.2-1.5, at a newton", 0.3),
    }
    equivalents = ("friction",)
    answers = ("friction", "friction2")
    instead_of = ("log_friction",)
    confusable = {"friction": "slides at three normal loads"}
    applicable = Friction.applicable

    def in_whole(self, whole: Whole, theta: dict) -> dict:
        whole.friction *= float(np.exp(theta.get("log_mu", 0.0)))
        return {**theta, "log_mu": 0.0}

    def in_skin(self, inside: Inside, theta: dict) -> bool:
        if theta.get("log_mu"):
            inside.rest.append((Friction(), {"log_mu": theta["log_mu"]}))
        if theta["exponent"]:
            inside.contact.setdefault("contact_law", {}).update(
                friction_exponent=theta["exponent"] / _PRESSURE[0], friction_pressure=_PRESSURE[1]
            )
        return True

    def apply(self, run: Run, theta: dict) -> None:
        if "friction" in run.answers:  # the skin was solved with more and less of it
            log_mu = theta.get("log_mu", 0.0) - theta["exponent"] * np.log(np.maximum(run.normal_force, 0.05))
            log_mu = np.clip(log_mu, -1.6, 1.0)
            square = log_mu * (log_mu + 2 * run.log_friction)
            run.add(log_mu[:, None] * run.answers["friction"] + square[:, None] * run.answers["friction2"])
            return
        normal = -np.outer(run.force @ run.heading, run.heading)
        tangential = run.force + normal
        run.force = (
            run.force + tangential * ((np.maximum(run.normal_force, 0.05) ** -theta["exponent"]) - 1)[:, None]
        )


class Adhesion(Effect):
    """Its "W" acts on the force alone, if the skin was solved without adhesion. "joining" is the work of
    adhesion of the contact itself; the skin was solved for some values of it (`Simulator.stick`)."""

    id, name, stage = "adhesion", "adhesion (JKR)", "K"
    physics = "F = F_H - sqrt(8 pi W E* a^3) with a^2 = R d; more during retraction"
    params = {"W": Param("J/m2", 0.0, 0.5, "0.02-0.1 approaching, up to ten times that retracting", 0.05)}
    confusable = {"mullins": "talc on the skin", "depth0": "pull off slowly: only adhesion pulls"}

    def given(self, names: Sequence[str]) -> "Adhesion":
        if "joining" not in names and not any(name.startswith(TACKY) for name in names):
            return self
        other = copy.copy(self)
        other.params = {"joining": Param("J/m2", 0.0, 30.0, "0.02-10, tacky films: CHOSEN", 1.0)}
        return other

    solved = given

    def joining(self, theta: dict) -> float | None:
        return theta.get("joining")

    def in_skin(self, inside: Inside, theta: dict) -> bool:
        work = theta.get("joining", theta.get("W", 0.0))
        if work > 0:
            law = {"adhesion": work, "adhesion_hysteresis": _PARTING}
            inside.contact.setdefault("contact_law", {}).update(law)
            inside.contact["tolerance"] = 1e-4  # adhesive forces are millinewtons
        return True

    def apply(self, run: Run, theta: dict) -> None:
        if "joining" in theta:
            for weight, answer in _between(theta["joining"], run.answers):
                run.add(weight * answer)
            return
        radius, modulus = 3.5e-3, 1e6
        a = np.sqrt(radius * np.maximum(run.depth, 0))
        out = np.gradient(run.depth, run.time) < -1e-9
        W = theta["W"] * np.where(out, _PARTING, 1.0)
        run.force = run.force + np.outer(
            np.sqrt(8 * np.pi * W * modulus * a**3) * (run.normal_force > 0), run.heading
        )


def _between(work, answers):
    """[(weight, answer)] for linear interpolation between the solutions with the nearest works; beyond the
    largest one, that one."""
    solved = sorted((float(name.removeprefix(TACKY)), name) for name in answers if name.startswith(TACKY))
    above = next((k for k, (at, _) in enumerate(solved) if at >= work), len(solved) - 1)
    if not solved or work <= 0:
        return []
    if above == 0 or work > solved[above][0]:
        return [(work / solved[above][0], answers[solved[above][1]])]
    (low, first), (high, second) = solved[above - 1 : above + 1]
    weight = (work - low) / (high - low)
    return [(1 - weight, answers[first]), (weight, answers[second])]
