"""Friction whose coefficient depends on pressure: slides at several loads, Hertz's contact, Coulomb's law bit
by bit."""

import numpy as np
import pytest
from blocks import boundary, box, faces_on, skin
from test_skin_contact import pad, plane_at

from biotac_mj.skin import ContactLaw, GeomSet, Material, SkinData, SkinModel, SkinOptions, step

MU, HEIGHT, AREA = (
    0.02,
    4e-3,
    1e-4,
)  # little friction: a pad that is dragged leans, and pressure is not the same everywhere


def slide(law, depth, nworld=1, exponents=None, **options):
    """Forces (nworld, 2) [N], along x and normal, of a plane that is pressed in by `depth` and dragged until
    all slips; all positions."""
    model = pad(contact_law=law, **options)
    data, geoms = SkinData(model, nworld), GeomSet(["plane"], [()], friction=[MU], nworld=nworld)
    if exponents is not None:
        data.laws.set(friction_exponent=exponents)
    walk = []
    plane_at(geoms, 0, HEIGHT + 1e-6)
    step(model, data, geoms)
    for x in np.linspace(0, 5 * depth, 9):  # simple shear bears mu p at a drag of 2 mu depth
        plane_at(geoms, x, HEIGHT - depth)
        step(model, data, geoms)
        assert data.converged.all()
        walk.append(data.vert_xpos)
    return data.wrench[:, 0, [0, 2]] * [-1, 1], np.array(walk)


@pytest.mark.parametrize("n", [0.3, 1.0, -0.4])
def test_ratio_of_drag_to_load_follows_the_law(n):
    """nu = 0: a bar under one pressure p, so T / N = mu (p / p0)^-n, at three loads a decade apart and
    more."""
    p0 = 500.0
    law = ContactLaw(friction_exponent=n, friction_pressure=p0)
    ratios, loads = [], []
    for depth in (2e-6, 2e-5, 6e-5):
        ((drag, load),), _ = slide(law, depth)
        ratios.append(drag / load), loads.append(load)
    np.testing.assert_allclose(ratios, MU * (np.array(loads) / AREA / p0) ** -n, rtol=0.01)
    if n == 1.0:  # one shear stress whatever the pressure
        np.testing.assert_allclose(np.array(ratios) * loads, MU * p0 * AREA, rtol=0.01)


def test_the_coefficient_stays_at_small_pressures():
    law = ContactLaw(friction_exponent=0.5, friction_pressure=1e6)
    for depth in (4e-6, 2e-5):  # 1 and 5 kPa: a hundredth of 1 MPa is 10 kPa
        ((drag, load),), _ = slide(law, depth)
        assert load / AREA < 1e4 and drag / load == pytest.approx(MU * 100**0.5, rel=0.01)


def test_exponent_zero_is_coulomb_bit_by_bit():
    force, walk = slide(None, 5e-5)
    again, same = slide(ContactLaw(), 5e-5)
    np.testing.assert_array_equal(walk, same)
    np.testing.assert_array_equal(force, again)
    two, both = slide(ContactLaw(), 5e-5, nworld=2, exponents=[0.0, 0.5])
    np.testing.assert_allclose(two[0], force[0], rtol=1e-6)
    np.testing.assert_allclose(two[1, 0] / two[1, 1], MU * (two[1, 1] / AREA / 3e5) ** -0.5, rtol=0.01)
    _, twice = slide(None, 5e-5, nworld=2)
    np.testing.assert_allclose(both[:, 0], twice[:, 0], atol=1e-12)


@pytest.mark.slow
def test_under_hertz_the_ratio_falls_with_the_cube_root():
    """A sliding sphere: the integral of mu(p) p over Hertz's pressures is mu N (p_max / p0)^-n 3 / (3 - n),
    and p_max goes as N^(1/3)."""
    R, E, nu, n, p0 = 10e-3, 1e6, 0.3, 0.6, 1e4
    radius = np.sqrt(R * 6e-5)
    grid = list(np.arange(0, 1.3, 1 / 4))
    while grid[-1] < 4.5:
        grid.append(grid[-1] + 1.4 * (grid[-1] - grid[-2]))
    lateral = radius * np.concatenate([-np.array(grid[:0:-1]), grid])
    vert, elem = box([lateral, lateral, -radius * np.array(grid[::-1])])
    held = np.flatnonzero((abs(vert[:, :2]) == lateral[-1]).any(1) | (vert[:, 2] == -lateral[-1]))
    top = faces_on(vert, boundary(elem), 2, 0.0)
    top = top[np.linalg.norm(vert[top].mean(1), axis=1) < 1.5 * radius]
    law = ContactLaw(friction_exponent=n, friction_pressure=p0)
    options = SkinOptions(contact_law=law, tolerance=1e-4, max_newton=100, max_cg=200)
    data = SkinData(SkinModel(skin(vert, elem, held, outer_face=top), Material("linear", E, nu), options))
    geoms, ratio, load = GeomSet(["sphere"], [(R,)], [MU]), [], []
    for depth in (2e-5, 4e-5, 6e-5):
        data.reset()
        for x in np.linspace(0, 4e-5, 4):
            geoms.set_pose([[x, 0, R - depth]])
            step(data.model, data, geoms)
            assert data.converged.all()
        drag, _, normal = data.wrench[0, 0, :3] * [-1, 1, 1]
        ratio.append(drag / normal), load.append(normal)
    ratio, load = np.array(ratio), np.array(load)
    peak = (6 * load * (E / (1 - nu**2)) ** 2 / (np.pi**3 * R**2)) ** (1 / 3)
    np.testing.assert_allclose(
        ratio, MU * (peak / p0) ** -n * 3 / (3 - n), rtol=0.06
    )  # 8 cells a radius: 2 %
    assert np.polyfit(np.log(load), np.log(ratio), 1)[0] == pytest.approx(-n / 3, abs=0.03)


def test_no_sample_leaves_its_cone():
    law = ContactLaw(friction_exponent=0.5, friction_pressure=1e4)
    model = pad(contact_law=law, nu=0.3)
    data, geoms = SkinData(model), GeomSet(["plane"], [()], friction=[MU])
    for x in np.linspace(0, 2e-4, 6):
        plane_at(geoms, x, HEIGHT - 5e-5)
        step(model, data, geoms)
    force = data.outer.sample_force.numpy()[:, 0].reshape(len(data.outer.surface.face_np), -1, 3)
    face, area, b = data.outer.surface.face_np, data.outer.surface.area.numpy(), model.sample.numpy()
    normal, drag = -force[..., 2], np.linalg.norm(force[..., :2], axis=-1)
    touching = data.outer.trial_geom.numpy()[:, 0].reshape(normal.shape) >= 0
    node, nodal_area = np.zeros(model.nvert), np.zeros(model.nvert)
    np.add.at(node, face, np.einsum("fs,sc->fc", np.where(touching, normal, 0), b))
    np.add.at(nodal_area, face, area[:, None] / 3)
    pressure = np.einsum("sc,fc->fs", b, (node / np.where(nodal_area > 0, nodal_area, 1))[face])
    limit = MU * (np.maximum(pressure, 1e2) / 1e4) ** -0.5 * normal
    assert (drag <= limit * (1 + 1e-9) + 1e-15)[touching].all() and (drag > 0.99 * limit)[touching].any()
