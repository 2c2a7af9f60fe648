"""The filled skin without contact: inflated step by step, once for each geometry, material and options."""

import copy
import dataclasses

import numpy as np

from ..cache import cached
from . import model as skin_model
from .data import SkinData
from .geoms import GeomSet
from .liquid import Rest
from .step import step

# Tolerances of intermediate steps and of the last, which leaves no residual for later steps. Without contact
# the scale is the smallest load, 1e-12 J.
_INTERMEDIATE, _FINAL = 1e-2, 1e-5
# Largest cavity over the unstressed one: all lengths are then 1.26 times larger, and a skin at a given
# pressure is close to unbounded inflation. CHOSEN; real fillings are below 1.1.
_MOST = 2.0
# Least fraction of the liquid: with less the skin lies on its core everywhere, and the solve takes a minute.
_LEAST = 0.01
_PRESSURE_STEP = 0.02  # increase of the pressure in one step, over Young's modulus


def rest_state(model: skin_model.SkinModel) -> Rest:
    """Equilibrium of skin and liquid without contact.

    Raises:
      ValueError: no equilibrium with that much liquid or pressure.
    """
    options, volume = model.options, model.liquid_volume
    vert = model.geometry.vert
    if not (model.has_liquid and (options.fill_volume or options.rest_pressure)):
        return Rest(vert, 0.0, volume, volume)
    _refuse_filling(model, options.fill_volume, options.fill_volume)
    world = [model.material], None, np.array([options.bulk_modulus]), np.zeros(1)
    found = cached("rest", [*_inputs(model), *world], lambda: dataclasses.asdict(_inflated(model, *world)))
    numbers = (float(found[name][0]) for name in ("pressure", "volume", "natural_volume"))
    return Rest(found["vert"][0], *numbers)


def _refuse_filling(model, least, most):
    """Refuses additional liquid outside the possible range [m^3]; least, most: over all worlds."""
    empty = (_LEAST - 1) * model.liquid_volume
    if least < empty:
        raise ValueError(
            f"fill_volume {least:g} m^3 takes out nearly all the liquid there is, or more: give more than "
            f"{empty:g} m^3, which leaves {_LEAST:.0%}"
        )
    room = _most_liquid(model) - model.liquid_volume
    if most > room:
        raise ValueError(
            f"fill_volume {most:g} m^3 is more than this skin holds: take less than {room:g} m^3, by which "
            f"its cavity is {_MOST:g} times what it was"
        )


def _most_liquid(model):
    return model.liquid_volume + (_MOST - 1) * model.rest_volume


def _inputs(model):
    """All of the model that the equilibrium without contact depends on, for the cache."""
    core = model.core_surface.face_np if model.has_core else None
    rubber = [model.element, model._elem, model.material, model.modulus]
    return [model.geometry, core, *rubber, model.options, model.device.is_cuda]


def rest_worlds(data: SkinData, materials: list, modulus: np.ndarray | None) -> None:
    """Sets each world of a filled skin to its own equilibrium without contact, that of a single skin of its
    material and filling.

    Args:
      data: SkinData whose liquids are set. materials: of each world. modulus: as for `SkinData`, or None.

    Raises:
      ValueError: no equilibrium with that much liquid or pressure.
    """
    model, liquid = data.model, data.liquid
    if not model.has_liquid:
        return
    options, bulk, extra = model.options, liquid.bulk_modulus, liquid.extra
    same = all(m == model.material for m in materials) and modulus is None
    filled = options.fill_volume or options.rest_pressure
    if not extra.any() and (not filled or (same and (bulk == options.bulk_modulus).all())):
        return
    _refuse_filling(model, options.fill_volume + extra.min(), options.fill_volume + extra.max())
    worlds = [
        (m, float(k), float(v), b"" if modulus is None else modulus[w].tobytes())
        for w, (m, k, v) in enumerate(zip(materials, bulk, extra, strict=True))
    ]
    number = {world: i for i, world in enumerate(dict.fromkeys(worlds))}
    which = np.array([number[world] for world in worlds])
    first = np.unique(which, return_index=True)[1]
    chosen = [materials[w] for w in first]
    factors = None if modulus is None else np.asarray(modulus)[first]
    own = chosen, factors, bulk[first], extra[first]
    found = cached("rests", [*_inputs(model), *own], lambda: dataclasses.asdict(_inflated(model, *own)))
    data.rest_at(Rest(**{name: value[which] for name, value in found.items()}))


def _inflated(model, materials, modulus, bulk, extra):
    """`Rest` of worlds of these materials, moduli (nworld, nelem) or None, bulk moduli of the liquid
    (nworld,) [Pa] and additional fillings (nworld,) [m^3]."""
    options, volume, vert = model.options, model.liquid_volume, model.geometry.vert
    model.inverse if model.device.is_cuda else model.factor  # noqa: B018 - computed now, and shared by the copy
    bare = copy.copy(model)
    bare.options = dataclasses.replace(
        options,
        fill_volume=0.0,
        rest_pressure=0.0,
        dynamics="quasistatic",
        mass_damping=0.0,
        stiffness_damping=0.0,
        tolerance=_INTERMEDIATE,
    )
    bare.material, *relaxed = (
        dataclasses.replace(m, prony=(), mullins=None, hysteresis=()) for m in (model.material, *materials)
    )
    bare.rest = Rest(vert, 0.0, volume, volume)
    data = SkinData(bare, len(relaxed), relaxed, modulus)
    nothing, liquid = GeomSet([], [], nworld=len(relaxed), device=model.device), data.liquid
    liquid.set(bulk)
    K, target, more = liquid.bulk_modulus, options.rest_pressure, options.fill_volume
    if target and ((K > 0) & (K <= target)).any():  # the volume without pressure would be negative
        raise ValueError(
            f"rest_pressure {target:g} is not below the liquid's bulk_modulus {K[K > 0].min():g}, both in "
            "Pa: give less pressure, or a stiffer liquid"
        )
    natural = np.full(len(relaxed), volume + more)
    if target:
        pump = lambda s: liquid.keep_pressure(s * target * (K > 0))  # noqa: E731
        size = _PRESSURE_STEP * min(m.youngs_modulus for m in materials) / abs(target)
        _inflate(bare, data, nothing, f"rest_pressure {target:g}", pump, min(0.25, size))
        compressible = np.isfinite(K) & (K > 0)
        strain = liquid.gauge_pressure / np.where(compressible, K, 1.0)
        natural = data.volume / np.where(compressible, 1 - strain, 1.0)
    elif more:
        _inflate(bare, data, nothing, f"fill_volume {more:g}", lambda s: liquid.fill(volume + s * more))
    if np.any(extra):
        _inflate(
            bare, data, nothing, f"fill_volume {np.max(extra):g}", lambda s: liquid.fill(natural + s * extra)
        )
    return Rest(data.vert_xpos.copy(), liquid.gauge_pressure, data.volume, natural)


def _inflate(bare, data, nothing, what, fill, size=0.25):
    """Fills the skin, fill(fraction), in steps of at most `size`."""
    options, done, least = bare.options, 0.0, size / 250
    while done < 1:
        size = min(size, 1 - done)
        tolerance = _FINAL if done + size == 1 else _INTERMEDIATE
        bare.options = dataclasses.replace(options, tolerance=tolerance)
        fill(done + size)
        step(bare, data, nothing)
        converged = data.converged.all()
        if converged and (data.volume <= _most_liquid(bare)).all():
            done += size
        elif converged or size < 2 * least:
            raise ValueError(
                f"no equilibrium of skin and liquid beyond {done:.1%} of {what}: this rubber does not hold "
                "it; take less"
            )
        else:
            size /= 2


skin_model.solve_rest = rest_state
