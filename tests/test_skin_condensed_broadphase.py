"""The condensed tier's broad phase against looking at every sample."""

import dataclasses

import numpy as np
import pytest
import trimesh
import warp as wp

from biotac_mj.geometry import load_skin
from biotac_mj.skin import PRESETS, SkinModel, SkinOptions
from biotac_mj.skin.condensed import LinearSkin
from biotac_mj.skin.condensed.broadphase import _may_meet_core, _meets_core, may_be_touched
from biotac_mj.skin.condensed.states import Increment
from biotac_mj.skin.condensed.structs import Constants, Scratch
from biotac_mj.skin.contact.meshes import mesh_distance
from biotac_mj.skin.contact.posed import Geoms
from biotac_mj.skin.types import real, vec3


@wp.kernel(enable_backward=False)
def look(
    share: real,
    c: Constants,
    x: wp.array2d(dtype=vec3),
    found_out: wp.array2d(dtype=int),
    true_out: wp.array2d(dtype=int),
):
    f, w = wp.tid()
    if _may_meet_core(f, w, share, x, c):
        for i in range(c.sample.shape[0]):
            if _meets_core(f, i, w, share, x, c):
                found_out[f, w] = 1
    face = c.inner_face[f]
    moved = real(0.0)
    for k in range(3):
        moved = wp.max(moved, wp.length(x[face[k], w] - c.rest[face[k], 0]))
    for i in range(c.sample.shape[0]):
        b = c.sample[i]
        p = b[0] * x[face[0], w] + b[1] * x[face[1], w] + b[2] * x[face[2], w]
        if mesh_distance(c.core.grids, c.core.grid[0], p)[3] - c.inner_rest[f, i] < share * moved:
            true_out[f, w] = 1


def pushed(rest, nworld, farthest):
    """Nodes (nvert, nworld, 3) of skins that are pushed about, as a whole and by waves [m]."""
    draw, x = np.random.default_rng(1), np.empty((len(rest), nworld, 3))
    for w in range(nworld):
        wave = np.sin(rest @ draw.normal(0, 400, (3, 3)) + draw.uniform(0, 6, 3))
        u = draw.standard_normal(3) + wave * draw.standard_normal(3)
        x[:, w] = rest + draw.uniform(0.2e-3, farthest) * u / np.linalg.norm(u, axis=1).max()
    return x


def near_core(share, c, x):
    """Which inner faces [face, world] are found to be nearer to the core than a share of their displacement,
    and which are."""
    shape = len(c.inner_face), x.shape[1]
    found, true = (wp.zeros(shape, dtype=int, device="cpu") for _ in range(2))
    known = [float(share), c, wp.array(x, dtype=vec3, device="cpu")]
    wp.launch(look, shape, known, [found, true], device="cpu")
    return found.numpy(), true.numpy()


@pytest.mark.law
@pytest.mark.parametrize("name", ["coarse", "ring", pytest.param("biotac_sp/coarse", marks=pytest.mark.slow)])
@pytest.mark.parametrize("share", [0.0, 0.3])
def test_no_face_that_meets_the_core_is_passed_over(name, share):
    """Skins that are pushed about by millimetres."""
    skin = load_skin("coarse" if name == "ring" else name)
    if name == "ring":  # concave, and far below the skin
        ring = trimesh.creation.torus(4e-3, 1.2e-3)
        skin = dataclasses.replace(skin, core_vert=ring.vertices - [8e-3, 0, 0], core_face=ring.faces)
    model = SkinModel(skin, PRESETS["default"], SkinOptions())
    linear = LinearSkin.of(model)
    c = linear.constants(model)
    x = pushed(model.rest.vert, 60, 6e-3 if name == "ring" else 2.5e-3)
    found, true = near_core(share, c, x)
    assert 0.01 < true.mean() < 0.7
    np.testing.assert_array_equal(found, true)


def test_slopes_foretell_how_gaps_to_the_core_change():
    """So that most faces need no look: for half of them what is left of a motion is at most 0.6 of it."""
    model = SkinModel(load_skin("coarse"), PRESETS["default"], SkinOptions())
    assert np.median(LinearSkin.of(model).constants(model).inner_bend.numpy()) < 0.6


@wp.kernel(enable_backward=False)
def ask(
    share: real,
    c: Constants,
    geoms: Geoms,
    s: Scratch,
    may_out: wp.array(dtype=bool),
):
    w = wp.tid()
    o = Increment()
    o.reach = real(1.0)
    o.fraction = share
    may_out[w] = may_be_touched(w, 0, o, geoms, c, s)


def test_faces_that_come_to_the_core_unsought_were_candidates():
    """Nodes that move by a little less than the bound, and in half of the worlds by a little more."""
    share, model = 0.3, SkinModel(load_skin("coarse"), PRESETS["default"], SkinOptions())
    c, rest = LinearSkin.of(model).constants(model), model.rest.vert[:, None]
    last = pushed(model.rest.vert, 60, 2.5e-3)
    way = np.random.default_rng(2).standard_normal(last.shape)
    way *= np.linalg.norm(last - rest, axis=2, keepdims=True) / np.linalg.norm(way, axis=2, keepdims=True)
    x = last + share / 3**0.5 * np.where(np.arange(60) < 30, 0.999, 1.001)[:, None] * way
    s, may = Scratch(), wp.zeros(60, dtype=bool, device="cpu")
    s.x, s.sought_x = (wp.array(a, dtype=vec3, device="cpu") for a in (x, last))
    wp.launch(ask, 60, [share, c, Geoms(), s], [may], device="cpu")
    np.testing.assert_array_equal(may.numpy(), np.arange(60) >= 30)
    candidate, before, now = near_core(share, c, last)[0], near_core(0, c, last)[1], near_core(0, c, x)[1]
    assert (now > before).sum() > 20
    assert (candidate >= now)[:, :30].all()
