"""Bars and cubes whose homogeneous deformations are prescribed, for laws with closed forms."""

import numpy as np
from blocks import box, place, skin

from biotac_mj.skin import GeomSet, Material, SkinData, SkinModel, SkinOptions, step

__all__ = ["AREA", "E", "LENGTH", "NOTHING", "NOW", "bar", "batch", "cube", "deform", "pull", "pull_worlds"]

NOTHING = GeomSet([], [])
E = 1e6
LENGTH, AREA = 20e-3, 25e-6
NOW = 1e-9  # [s] of a step that is a jump


def bar(law="linear", element="linear", nu=0.0, held=True, modulus=None, young=E, **material):
    """20 mm long, 5 mm x 5 mm, held at x = 0 and, if asked, at the other end, which tests then move."""
    vert, elem = box([np.linspace(0, LENGTH, 5), np.linspace(0, 5e-3, 2), np.linspace(0, 5e-3, 2)])
    fixed = np.flatnonzero((vert[:, 0] == 0) | (held & (vert[:, 0] == LENGTH)))
    options = SkinOptions(element=element, tolerance=1e-7, max_newton=60, max_cg=300)
    return SkinModel(skin(vert, elem, fixed), Material(law, young, nu, **material), options, modulus=modulus)


def pull(model, data, stretch, dt):
    """Moves the end of the bar; the force that this takes [N]."""
    return pull_worlds(model, data, stretch, dt)[0]


def pull_worlds(model, data, stretch, dt=None):
    """The same (nworld,) in all worlds of a batch."""
    end = np.flatnonzero(model.geometry.vert[:, 0] == LENGTH)
    to = model.geometry.vert[end] * [stretch, 1, 1]
    place(data, end, to)
    step(model, data, NOTHING if data.nworld == 1 else GeomSet([], [], nworld=data.nworld), dt)
    assert data.converged.all()
    return -data.force.numpy()[end, :, 0].sum(0)


def cube(law, element, nu=0.3, modulus=None, young=E, **material):
    """A jittered cube whose whole surface is held: homogeneous deformations are prescribed and exact."""
    vert, elem = box([np.linspace(0, 1e-2, 3)] * 3, jitter=0.2)
    fixed = np.flatnonzero(((vert == 0) | (vert == 1e-2)).any(1))
    options = SkinOptions(element=element, tolerance=1e-8, max_newton=60, max_cg=400)
    return SkinModel(skin(vert, elem, fixed), Material(law, young, nu, **material), options, modulus=modulus)


def deform(model, data, F, dt):
    """First Piola stress (3, 3) [Pa] after a step to the homogeneous F: mean over the cube of f x X on its
    surface."""
    for array in (data.x, data.x_last):
        array.numpy()[:, 0] = model.geometry.vert @ F.T
    step(model, data, NOTHING, dt)
    assert data.converged.all()
    fixed = model.fixed
    return -np.einsum("ni,nj->ij", data.force.numpy()[fixed, 0], model.geometry.vert[fixed]) / 1e-6


def batch(model, materials, answers, modulus=None):
    """What `answers`(model, data), of shape (n, nworld), says of worlds of these materials.

    Args:
      modulus: (nworld, nelem) factors, or None.

    Returns:
      of one batch; of each world alone, in a SkinData of the same model; and of a model of its own.
    """
    factor = [None] * len(materials) if modulus is None else list(modulus)
    together = answers(model, SkinData(model, len(materials), materials, modulus))
    alone = [answers(model, SkinData(model, 1, [m], None if f is None else f[None]))
             for m, f in zip(materials, factor, strict=True)]  # fmt: skip
    models = [SkinModel(model.geometry, m, model.options, modulus=f) for m, f in zip(materials, factor)]
    own = [answers(one, SkinData(one)) for one in models]
    return np.array(together), *(np.concatenate([np.array(a) for a in one], axis=1) for one in (alone, own))
