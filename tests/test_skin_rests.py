"""Worlds of a filled skin that differ: each rests, reads and presses as the single skin of its material and
fill."""

import dataclasses

import numpy as np
import pytest
from blocks import four_nodes

from biotac_mj.skin import GeomSet, SkinModel, SkinOptions, step
from biotac_mj.skin.per_world import make_worlds
from biotac_mj.skin.rubber.material import material

SKIN = four_nodes("coarse")
CLOSE = SkinOptions(liquid=True, tolerance=1e-6)
BASE = material("default")
RADIUS, START, INWARDS = 3.5e-3, np.array([-12e-3, -11.3e-3, 0.5e-3]), np.array([0, 2e-4, 0])
CHANNELS = ("electrodes", "pdc", "contact_force")
FILLS = [
    pytest.param({"rest_pressure": 6e3}, [0.6, 1.0, 1.7], {}, id="pressure"),
    pytest.param({"fill_volume": 4e-8}, [0.6, 1.0, 1.7], {}, id="volume", marks=pytest.mark.slow),
    pytest.param(
        {}, [1.0, 1.0, 1.3], {"fill_volume": [0.0, 2e-8, 4e-8]}, id="volumes", marks=pytest.mark.slow
    ),
    pytest.param({"fill_volume": 3e-8}, [1.0, 1.0, 0.8], {"bulk_modulus": [2e9, 2e5, np.inf]}, id="bulk"),
]


def press(model, data):
    """Forces (step, world, 3) [N], pressures [Pa], and where the skin rests."""
    n, rest = data.nworld, data.vert_xpos.copy()
    geoms = GeomSet(["sphere"], [(RADIUS,)], [0.5], nworld=n)
    rows = []
    for k in range(6):
        geoms.set_pose(np.tile(START + k * INWARDS, (n, 1, 1)))
        step(model, data, geoms)
        rows.append((data.wrench[:, 0, :3].copy(), data.pressure.copy()))
    return *(np.array(part) for part in zip(*rows, strict=True)), rest


def single(filling, factor, own):
    """The same of one skin."""
    options = dataclasses.replace(CLOSE, **filling, **own)
    rubber = dataclasses.replace(BASE, youngs_modulus=factor * BASE.youngs_modulus)
    model = SkinModel(SKIN, rubber, options)
    return press(model, make_worlds(model, 1))


@pytest.mark.parametrize("filling, factors, values", FILLS)
def test_worlds_of_a_filled_skin_are_the_single_skins(filling, factors, values):
    model = SkinModel(SKIN, BASE, dataclasses.replace(CLOSE, **filling))
    rubbers = [dataclasses.replace(BASE, youngs_modulus=f * BASE.youngs_modulus) for f in factors]
    # stiffness of contact is each material's own
    force, pressure, rest = press(model, make_worlds(model, len(factors), rubbers, values))
    for w, factor in enumerate(factors):
        own = {name: value[w] for name, value in values.items()}
        expected = single(filling, factor, own)
        peak = np.abs(expected[0]).max()
        assert peak > 0.3
        np.testing.assert_allclose(rest[w], expected[2][0], atol=2e-8)
        np.testing.assert_allclose(force[:, w], expected[0][:, 0], atol=2e-5 * peak)
        np.testing.assert_allclose(pressure[:, w], expected[1][:, 0], atol=2e-4 * np.abs(expected[1]).max())
    assert np.abs(pressure[0]).max() > 10  # they touch from the first step
    rested = make_worlds(model, len(factors), rubbers, values).liquid.rest_pressure
    # fillings that do differ [m], [Pa]
    assert np.ptp(rest, axis=0).max() > 1e-6 or np.ptp(rested) > 100


def test_a_world_without_liquid_is_not_filled():
    model = SkinModel(SKIN, BASE, dataclasses.replace(CLOSE, rest_pressure=5e3))
    data = make_worlds(model, 2, values={"bulk_modulus": [0.0, 2e9]})
    unfilled, filled = data.vert_xpos
    np.testing.assert_allclose(unfilled, model.geometry.vert, atol=1e-9)
    np.testing.assert_allclose(filled, model.rest.vert, atol=1e-9)
    np.testing.assert_array_equal(data.pressure, [0.0, 0.0])


def test_readings_of_such_worlds_begin_at_the_sensors_rest():
    mjw = pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")
    import mujoco
    import warp as wp

    import biotac_mj
    from biotac_mj import batch

    def spec():
        out = mujoco.MjSpec()
        pin = out.worldbody.add_body(name="pin", mocap=True, pos=START - [0, 5e-3, 0])
        pin.add_geom(size=[RADIUS, 0, 0])
        return out

    factors, steps = [0.7, 1.4], 18
    base = material("calibrated")
    rubbers = [dataclasses.replace(base, youngs_modulus=f * base.youngs_modulus) for f in factors]
    close = {"skin": {"tolerance": 1e-5}}
    quiet = {"readings": {"noise": False}, **close}
    singles = []
    for rubber in rubbers:
        scene = spec()
        handle = biotac_mj.attach(scene, body="world", skin=SKIN, material=rubber, options=quiet)
        model = scene.compile()
        data = mujoco.MjData(model)
        rows = []
        for k in range(steps):
            if k >= 3:
                data.mocap_pos[0] = START + (k - 15) * INWARDS / 2
            mujoco.mj_step(model, data)
            rows.append(np.concatenate([handle.read(data, c) for c in CHANNELS]))
        singles.append(rows)
    singles = np.array(singles)
    with wp.ScopedDevice("cuda:0" if wp.is_cuda_available() else "cpu"):
        scene = spec()
        batch.add(scene, body="world", skin=SKIN)
        mjm = scene.compile()
        mjd = mujoco.MjData(mjm)
        mujoco.mj_forward(mjm, mjd)
        m, d = mjw.put_model(mjm), mjw.put_data(mjm, mjd, nworld=2)
        batch.attach(mjm, m, d, skin=SKIN, material=rubbers, readings={"noise": False}, options=close)
        where = [mjm.sensor(f"biotac_{c}") for c in CHANNELS]
        found = []
        for k in range(steps):
            if k >= 3:
                d.mocap_pos.assign(np.tile(START + (k - 15) * INWARDS / 2, (2, 1, 1)).astype(np.float32))
            mjw.step(m, d)
            data = d.sensordata.numpy()
            found.append(np.concatenate([data[:, s.adr[0] : s.adr[0] + s.dim[0]] for s in where], axis=1))
    found = np.moveaxis(np.array(found), 1, 0)
    np.testing.assert_allclose(found[:, 2, 19], 2000, atol=1)  # PDC at rest
    np.testing.assert_allclose(found[..., :20], singles[..., :20], atol=4 if wp.is_cuda_available() else 1)
    found, singles = found[..., 19:23], singles[..., 19:23]
    np.testing.assert_allclose(found[..., 1:], singles[..., 1:], atol=2e-3 * np.abs(singles[..., 1:]).max())
    assert np.abs(singles[:, -1, 0] - 2000).min() > 10
