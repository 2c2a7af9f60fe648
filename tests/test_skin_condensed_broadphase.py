"""The condensed tier's broad phase against looking at every sample."""

import dataclasses

import numpy as np
import pytest
import trimesh
import warp as wp

from biotac_mj.geometry import load_skin
from biotac_mj.skin import PRESETS, SkinModel, SkinOptions
from biotac_mj.skin.condensed import LinearSkin
from biotac_mj.skin.condensed.broadphase import _may_meet_core, _meets_core
from biotac_mj.skin.condensed.structs import Constants
from biotac_mj.skin.contact.meshes import mesh_distance
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


@pytest.mark.parametrize("name", ["coarse", "ring", pytest.param("biotac_sp/coarse", marks=pytest.mark.slow)])
@pytest.mark.parametrize("share", [0.0, 0.3])
def test_no_face_that_meets_the_core_is_passed_over(name, share):
    """Skins that are pushed about by millimetres, as a whole and by waves."""
    skin = load_skin("coarse" if name == "ring" else name)
    if name == "ring":  # concave, and far below the skin
        ring = trimesh.creation.torus(4e-3, 1.2e-3)
        skin = dataclasses.replace(skin, core_vert=ring.vertices - [8e-3, 0, 0], core_face=ring.faces)
    model = SkinModel(skin, PRESETS["default"], SkinOptions())
    linear = LinearSkin.of(model)
    c, rest, draw, nworld = linear.constants(model), model.rest.vert, np.random.default_rng(1), 60
    farthest = 6e-3 if name == "ring" else 2.5e-3
    x = np.empty((len(rest), nworld, 3))
    for w in range(nworld):
        wave = np.sin(rest @ draw.normal(0, 400, (3, 3)) + draw.uniform(0, 6, 3))
        u = draw.standard_normal(3) + wave * draw.standard_normal(3)
        x[:, w] = rest + draw.uniform(0.2e-3, farthest) * u / np.linalg.norm(u, axis=1).max()
    x = wp.array(x, dtype=vec3, device="cpu")
    found, true = (wp.zeros((len(linear.core_gap), nworld), dtype=int, device="cpu") for _ in range(2))
    wp.launch(look, found.shape, [float(share), c, x], [found, true], device="cpu")
    assert 0.01 < true.numpy().mean() < 0.7
    np.testing.assert_array_equal(found.numpy(), true.numpy())
    if name != "ring":  # else nothing is saved
        assert np.median(c.inner_bend.numpy()) < 0.6
