"""Geoms in the browser's page: where MuJoCo's own rays hit them."""

import mujoco
import numpy as np
import pytest
import trimesh

from biotac_mj.view import web_scene

XML = """<mujoco><asset>
  <mesh name="wedge" vertex="0 0 0  .02 0 0  0 .03 0  0 0 .04"/>
  <material name="red" rgba="1 0 0 1"/></asset><worldbody>
  <geom type="plane" size="1 1 .1" pos="0 0 -1"/>
  <body name="hidden"><geom name="inside" size=".01" pos="9 0 0"/></body>
  <body name="moving" pos=".1 .2 .3" euler="20 30 40"><freejoint/>
    <geom name="{kind}" type="{kind}" {size} pos=".01 0 .02" euler="10 0 50" material="red"/>
  </body></worldbody></mujoco>"""

SIZES = {
    "sphere": 'size=".02"',
    "ellipsoid": 'size=".01 .02 .03"',
    "box": 'size=".01 .02 .03"',
    "capsule": 'size=".01 .02"',
    "cylinder": 'size=".01 .02"',
    "mesh": 'mesh="wedge"',
}


@pytest.mark.parametrize("kind", SIZES)
def test_surface_is_where_rays_hit_it(kind):
    model = mujoco.MjModel.from_xml_string(XML.format(kind=kind, size=SIZES[kind]))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    g = model.geom(kind).id
    vert, face = web_scene.geom_mesh(model, g)
    R, p = data.geom_xmat[g].reshape(3, 3), data.geom_xpos[g]
    surface = trimesh.Trimesh(vert @ R.T + p, face, process=False)
    middle, rng, hits, found = surface.vertices.mean(0), np.random.default_rng(0), 0, np.zeros(1, np.int32)
    for _ in range(60):
        ray = rng.standard_normal(3)
        ray /= np.linalg.norm(ray)
        start = middle - 0.2 * ray + 0.004 * rng.standard_normal(3)
        distance = mujoco.mj_ray(model, data, start, ray, None, 1, -1, found)
        if found[0] != g:
            continue
        where, _, _ = surface.ray.intersects_location([start], [ray])
        assert len(where) and abs(np.linalg.norm(where - start, axis=1).min() - distance) < 4e-4
        hits += 1
    assert hits > 30


def test_planes_and_what_is_shown_otherwise_are_left_out():
    viser = pytest.importorskip("viser", reason="needs viser (extra web)")
    model = mujoco.MjModel.from_xml_string(XML.format(kind="box", size=SIZES["box"]))
    data = mujoco.MjData(model)
    server = viser.ViserServer(port=8961, verbose=False)
    try:
        scene = web_scene.Scene(server, model, ["hidden"])
        assert list(scene._frames) == [model.body("moving").id]
        data.qpos[:3] = [1, 2, 3]
        mujoco.mj_forward(model, data)
        scene.update(data)
        np.testing.assert_allclose(scene._frames[model.body("moving").id].position, [1, 2, 3])
    finally:
        server.stop()
    np.testing.assert_allclose(web_scene.geom_color(model, model.geom("box").id), [1, 0, 0, 1])
    assert web_scene.geom_mesh(model, 0) is None
