"""Constitutive effects inside the finite elements instead of on the forces that they bear: what each becomes
of a skin's material, contact, model and film.

`docs/lab/discrepancy.md` says how much the reduced forms differ."""

import typing

import numpy as np

from .contact import Friction
from .rubber import modulus_of

__all__ = ["Inside", "memory_of"]

# [s] of the Prony series that stands for a power law, as in `catalogue.PowerCreep`
_TAUS = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)


# what benchmarks/discrepancy_in_skin_maps.py measured on presses of the coarse skin (docs/lab/memory.md):
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


_LOOP = 0.2e-3  # [m] of depth in which the branch is changed, where the effect says it of the load


_PARTING = 3.0  # work of parting over that of joining, as in `contact.Adhesion`


# under a 7 mm sphere on the coarse skin (benchmarks/discrepancy_contact.py) the nodes' pressure [Pa] is the
# second times force^the first: force^-n is pressure^(-n / the first), and at 1 N mu is the material's
_PRESSURE = 0.70, 1.65e5


# m [J/m^3] and, where the effect has no width, beta of Ogden and Roxburgh: W_max is of kJ/m^3
_ENERGY, _SHARE = (1.0, 0.6)


class Inside(typing.NamedTuple):
    """What effects become inside the skin: changes of its `Material`, of its `SkinOptions` (the contact),
    arguments of its `SkinModel`, the liquid's `loss` [1/h], the share of it that is gone `before`, and the
    `power` of its film's conductance; and the effects [(Effect, theta)] that are left to act as they do
    without the skin."""

    material: dict
    contact: dict
    model: dict
    film: dict
    rest: list


def memory_of(effects: list) -> Inside:
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


def _inhomog(inside, theta):
    mine, other = modulus_of(theta), inside.model.get("modulus")
    inside.model["modulus"] = mine if other is None else lambda at: mine(at) * other(at)


def _stiffen(inside, theta):
    c2 = (
        theta["c2"]
        + theta.get("through", 0.0)
        + np.interp(inside.material.get("stiffening", 0.0), _STIFFENING, _C2)
    )
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


def _hyster_load(inside, theta):
    _hyster(inside, {"fraction": theta["fraction"], "width": _LOOP})


def _adhesion(inside, theta):
    work = theta.get("joining", theta.get("W", 0.0))
    if work > 0:
        inside.contact.setdefault("contact_law", {}).update(adhesion=work, adhesion_hysteresis=_PARTING)
        inside.contact["tolerance"] = 1e-4  # it pulls with millinewtons


def _fric_load(inside, theta):
    if theta.get("log_mu"):
        inside.rest.append((Friction(), {"log_mu": theta["log_mu"]}))
    if theta["exponent"]:
        inside.contact.setdefault("contact_law", {}).update(
            friction_exponent=theta["exponent"] / _PRESSURE[0], friction_pressure=_PRESSURE[1]
        )


def _fluidloss(inside, theta):
    if theta["rate"] > 0:
        inside.film["loss"] = inside.film.get("loss", 0.0) + theta["rate"]
    if theta.get("before", 0.0) > 0:
        inside.film["before"] = inside.film.get("before", 0.0) + theta["before"]


def _asper(inside, theta):
    if theta["log_p"]:
        inside.film["power"] = inside.film.get("power", 1.0) * float(np.exp(theta["log_p"]))


# effect id -> function that writes it into an Inside
_BECOMES = {
    "relax": _relax,
    "creep": _creep,
    "mullins": _mullins,
    "hyster": _hyster,
    "hyster_load": _hyster_load,
    "stiffen": _stiffen,
    "inhomog": _inhomog,
    "spots": _inhomog,
    "adhesion": _adhesion,
    "fric_load": _fric_load,
    "fluidloss": _fluidloss,
    "asper": _asper,
}
