"""Weighted electrodes (Lin, Fishel and Loeb 2013): where their formula can be told by hand."""

import numpy as np
import pytest
import trimesh

from biotac_mj.geometry import load_skin
from biotac_mj.geometry.skins import skin_of_design, skin_reference
from biotac_mj.sensor import WeightedElectrodes


@pytest.fixture(scope="module")
def formula():
    return WeightedElectrodes(load_skin("coarse"))


def test_one_electrode_says_the_skin_above_it(formula):
    """By trimesh's rays."""
    g, change = formula.geometry, np.diag(np.full(19, -100.0))
    mesh = trimesh.Trimesh(g.vert, g.outer_face, process=False)
    hit, ray, _ = mesh.ray.intersects_location(g.electrode_pos, g.electrode_normal, multiple_hits=False)
    found = formula.place(change)
    assert len(ray) >= 17
    np.testing.assert_allclose(found[ray], hit, atol=1e-7)
    np.testing.assert_array_equal(np.isnan(found).all(axis=1), ~np.isin(np.arange(19), ray))


def test_a_place_lies_between_the_electrodes_that_fall(formula):
    """E2 and E12 lie in each other's mirror; rises are left out; nothing that fell says nothing."""
    change = np.zeros((2, 1, 19))
    change[0, 0, [1, 11]], change[0, 0, 16] = -50.0, 300.0
    found = formula.place(change)
    assert found.shape == (2, 1, 3) and np.isnan(found[1]).all()
    assert abs(found[0, 0, 2]) < 2e-4
    assert abs(found[0, 0, 0] - formula.geometry.electrode_pos[[1, 11], 0].mean()) < 1e-3


def test_the_fit_finds_the_scale_of_forces(formula):
    rng = np.random.default_rng(0)
    change, scale = rng.uniform(-500, 200, (40, 19)), np.array([1e-3, 2e-3, 5e-4])
    force = -(np.maximum(0, -change) @ formula.geometry.electrode_normal) * scale
    own = formula.fitted(change, force)
    np.testing.assert_allclose(own.scale, scale, rtol=1e-12)
    np.testing.assert_allclose(own.force(change), force, rtol=1e-12)


def test_what_cannot_be_is_refused(formula):
    with pytest.raises(ValueError, match=r"change has shape \(18,\): give \(..., 19\) counts from rest"):
        formula.place(np.zeros(18))
    with pytest.raises(ValueError, match="presses in which electrodes fall"):
        formula.fitted(np.zeros((3, 19)), np.zeros((3, 3)))
    other = WeightedElectrodes(skin_reference(skin_of_design("biotac_sp", "coarse"))[1])
    with pytest.raises(
        ValueError, match="no scale of force is known of a BioTac SP .24 electrodes.: give scale"
    ):
        other.force(-np.ones(24))
    assert np.isfinite(other.place(-np.ones(24))).all()
