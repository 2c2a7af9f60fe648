"""Parameters that may differ between worlds besides materials: contact law, liquid, modulus of the
elements."""

import dataclasses
from collections.abc import Callable

import numpy as np

from ..fields import as_numbers, refuse_unknown
from .contact.law import ContactLaw
from .data import SkinData
from .fill import rest_worlds
from .model import SkinModel, SkinOptions
from .state import FULL

_LAW = ("friction_exponent", "friction_pressure", "adhesion", "adhesion_hysteresis")
_LIQUID = ("bulk_modulus", "fill_volume")
NAMES = (*_LAW, *_LIQUID, "modulus")


def make_room(
    options: SkinOptions, modulus: np.ndarray | Callable | None, values: dict, nelem: int
) -> tuple[SkinOptions, np.ndarray | Callable | None]:
    """Options and modulus of a model whose worlds may differ in these values.

    Args:
      options: SkinOptions. modulus: of the model, or None.
      values: names of NAMES. nelem: elements of the model's geometry.

    Raises:
      ValueError: unknown names.
    """
    refuse_unknown(values, NAMES, "worlds")
    if options.contact_law is None and any(name in values for name in _LAW):
        options = dataclasses.replace(options, contact_law=ContactLaw())
    return options, np.ones(nelem) if modulus is None and "modulus" in values else modulus


def make_worlds(
    model: SkinModel,
    nworld: int,
    materials: list | None = None,
    values: dict | None = None,
    tier: str = FULL,
) -> SkinData:
    """SkinData of worlds that differ; each has the state without contact of a single skin with its values.

    Args:
      materials: one for each world, or None.
      values: name of NAMES -> (nworld,) or a number; modulus: (nworld, nelem) factors for the elements of the
        model's geometry, in place of the model's own.
      tier: FULL or CONDENSED, see `SkinData`.

    Raises:
      ValueError: wrong shapes, or impossible values.
    """
    values = values or {}
    modulus = values.get("modulus")
    if modulus is not None:
        modulus = as_numbers("modulus", modulus)
        n = model.nelem if np.shape(modulus)[1:] == (model.nelem,) else len(model.geometry.elem)
        if modulus.shape != (nworld, n):
            raise ValueError(f"modulus has shape {modulus.shape}: pass factors of shape ({nworld}, {n})")
        modulus = np.repeat(modulus, model.nelem // n, 1)  # the parts of a ten-node element are consecutive
    data = SkinData(model, nworld, materials, modulus, tier=tier)
    law = {name: values[name] for name in _LAW if name in values}
    if law:
        data.laws.set(**law)
    liquid = {name: values[name] for name in _LIQUID if name in values}
    if liquid:
        data.set_liquid(**liquid)
    rest_worlds(data, [model.material] * nworld if materials is None else list(materials), modulus)
    return data
