"""The skin at rest on its filling: inflated step by step, once for each geometry, material and options."""

import copy
import dataclasses
import math

import numpy as np

from . import model as skin_model
from .cache import kept
from .data import SkinData
from .geoms import GeomSet
from .liquid import Rest
from .step import step

__all__ = ["rest_state"]

# Nothing touches, so these are fractions of the smallest load there is, 1e-12 J. The last is what leaves no
# residual for later steps.
_UNDERWAY, _ARRIVED = 1e-2, 1e-5
# Times the unstressed cavity: all lengths are then 1.26 times theirs, no fingertip any more, and a skin at a
# given pressure is about to balloon without bound. CHOSEN; real fillings are below 1.1.
_MOST = 2.0
_GENTLE = 0.02  # of Young's modulus: a rise of the pressure that skins follow in one step


def rest_state(model: skin_model.SkinModel) -> Rest:
    """The balance of skin and liquid without touching geoms.

    Raises:
      ValueError: the skin does not hold that much liquid or pressure.
    """
    options, volume = model.options, model.liquid_volume
    vert = model.geometry.vert
    if not (model.has_liquid and (options.fill_volume or options.rest_pressure)):
        return Rest(vert, 0.0, volume, volume)
    if volume + options.fill_volume <= 0:
        raise ValueError(
            f"fill_volume {options.fill_volume:g} m^3 takes more liquid out than there is ({volume:g} m^3)"
        )
    most = _most_liquid(model)
    if volume + options.fill_volume > most:
        raise ValueError(
            f"fill_volume {options.fill_volume:g} m^3 is more than this skin holds: take less than "
            f"{most - volume:g} m^3, by which its cavity is {_MOST:g} times what it was"
        )

    def inflate():
        rest = _inflated(model)
        return {"vert": rest.vert, "numbers": np.array([rest.pressure, rest.volume, rest.natural_volume])}

    found = kept("rest", _inputs(model), inflate)
    return Rest(found["vert"], *found["numbers"].tolist())


def _most_liquid(model):
    return model.liquid_volume + (_MOST - 1) * model.rest_volume


def _inputs(model):
    """All that the rest depends on."""
    g = model.geometry
    mesh = [g.vert, model._elem, model.fixed, g.inner_face, g.core_vert, g.core_face]
    core = model.core_surface.face_np if model.has_core else None
    rubber = [model.element, model.material, model.modulus]
    return [*mesh, core, *rubber, model.options, model.device.is_cuda]


def _inflated(model):
    options, volume, vert = model.options, model.liquid_volume, model.geometry.vert
    model.factor  # noqa: B018 - made here, the copy shares it
    bare = copy.copy(model)
    bare.options = dataclasses.replace(
        options,
        fill_volume=0.0,
        rest_pressure=0.0,
        dynamics="quasistatic",
        mass_damping=0.0,
        stiffness_damping=0.0,
        tolerance=_UNDERWAY,
    )
    # relaxed and virgin
    bare.material = dataclasses.replace(model.material, prony=(), mullins=None, hysteresis=())
    bare.rest = Rest(vert, 0.0, volume, volume)
    data, nothing = SkinData(bare), GeomSet([], [], device=model.device)
    liquid = data.liquid
    done, size = 0.0, 0.25
    if options.rest_pressure:
        size = min(size, _GENTLE * model.material.youngs_modulus / abs(options.rest_pressure))
    least = size / 250
    while done < 1:
        size = min(size, 1 - done)
        if done + size == 1:
            bare.options = dataclasses.replace(bare.options, tolerance=_ARRIVED)
        if options.rest_pressure:  # liquid at constant pressure
            liquid.keep_pressure((done + size) * options.rest_pressure)
        else:
            liquid.fill(volume + (done + size) * options.fill_volume)
        step(bare, data, nothing)
        if data.converged[0] and liquid.volume[0] <= _most_liquid(model):
            done += size
        elif data.converged[0] or size < 2 * least:
            which = "rest_pressure" if options.rest_pressure else "fill_volume"
            raise ValueError(
                f"no balance of skin and liquid beyond {done:.1%} of {which} {getattr(options, which):g}: "
                "this rubber does not hold it; take less"
            )
        else:
            size /= 2
            bare.options = dataclasses.replace(bare.options, tolerance=_UNDERWAY)
    pressure, filled = float(liquid.gauge_pressure[0]), float(liquid.volume[0])
    natural = float(liquid.natural_volume[0])
    if options.rest_pressure:
        natural = (
            filled if math.isinf(options.bulk_modulus) else filled / (1 - pressure / options.bulk_modulus)
        )
    return Rest(data.vert_xpos[0].copy(), pressure, filled, natural)


skin_model.solve_rest = rest_state
