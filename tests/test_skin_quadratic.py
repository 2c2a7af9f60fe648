"""Quadratic tetrahedra: their derivatives, what they must do exactly, other codes' answers, and rubber that
must not lock."""

import pathlib
import sys

import mujoco
import numpy as np
import pytest
import skfem
import warp as wp
from blocks import box, four_nodes, place, skin
from forces import Elements, gradients
from grids import covering
from skfem.helpers import ddot, div, sym_grad

import biotac_mj
from biotac_mj.geometry import load_skin
from biotac_mj.geometry.edge_nodes import with_edge_nodes
from biotac_mj.skin import PRESETS, GeomSet, Material, SkinData, SkinModel, SkinOptions, step
from biotac_mj.skin.rubber.law import LAWS
from biotac_mj.skin.rubber.tetrahedra import Tetrahedra
from biotac_mj.skin.types import SINGLE

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "benchmarks"))
import locking  # noqa: E402

NOTHING = GeomSet([], [])
TIGHT = dict(max_newton=200, max_cg=200)
CPU = wp.get_device("cpu")


def block(law, nu=0.3, cells=2, jitter=0.25, **options):
    vert, elem = box([np.linspace(0, 1e-2, cells + 1)] * 3, jitter)
    geometry = skin(vert, elem, np.flatnonzero(vert[:, 1] == 0))
    return SkinModel(
        geometry, Material(law, 1e6, nu), SkinOptions(element="quadratic", **{**TIGHT, **options})
    )


def deformed(model, amplitude=4e-4, seed=0):
    """Positions at random about rest."""
    rng = np.random.default_rng(seed)
    return model.geometry.vert + amplitude * rng.uniform(-1, 1, (model.nvert, 3))


@pytest.mark.law
# full integration, and mostly mean dilatation
@pytest.mark.parametrize("nu, law", covering([0.4999, 0.3], LAWS))
def test_forces_and_products_are_derivatives_of_the_energy(law, nu):
    """Force is minus the energy's gradient, the product is the force's derivative: central differences along
    a random direction."""
    model = block(law, nu)
    elements = Elements(SkinData(model))
    x, h = deformed(model), 1e-8
    p = np.random.default_rng(1).standard_normal(x.shape)
    energy = [elements.energy(x + sign * h * p) for sign in (1, -1)]
    slope, work = (energy[0] - energy[1]) / (2 * h), -(elements.force(x) * p).sum()
    assert work == pytest.approx(slope, rel=1e-6)
    change = (elements.force(x + h * p) - elements.force(x - h * p)) / (2 * h)
    elements.force(x)
    product = elements.product(p)
    assert abs(product + change).max() < 1e-6 * abs(change).max()
    single = Elements(SkinData(model), SINGLE)  # what CUDA and the dense preconditioner use
    force = elements.force(x)  # to double precision both, by other ways to the rotation
    np.testing.assert_allclose(single.force(x), force, rtol=0, atol=1e-11 * abs(force).max())
    # nearly incompressible, the parts of the product are far larger than their sum
    assert abs(single.product(p) - product).max() < 1e-5 * abs(product).max()


@pytest.mark.parametrize("nu, law", covering([0.4999, 0.3], LAWS))
def test_the_assembled_matrix_is_the_tangent_at_rest(law, nu):
    """The assembled matrix is the tangent at rest, so that it can precondition."""
    model = block(law, nu)
    elements = Elements(SkinData(model))
    elements.force(model.geometry.vert)
    p = np.random.default_rng(2).standard_normal((model.nvert, 3))
    stiffness = model.elements.rest_stiffness(model.material.mu, model.material.lame)
    wanted = (stiffness @ p.ravel()).reshape(-1, 3)
    assert abs(elements.product(p) - wanted).max() < 1e-10 * abs(wanted).max()


def test_stiffness_equals_scikit_fem():
    """Compressible, integrated at Gauss's points: the energy of any nodal displacement is scikit-fem's with
    its own P2 tetrahedra."""
    vert, elem = box([np.linspace(0, 1e-2, 3)] * 3, 0.2)
    refined = with_edge_nodes(skin(vert, elem, [0]))
    material = Material("linear", 1e6, 0.3)
    basis = skfem.Basis(
        skfem.MeshTet(vert.T.copy(), elem.T.astype(np.int64)),
        skfem.ElementVector(skfem.ElementTetP2()),
        intorder=2,
    )
    mu, lame = material.mu, material.lame
    form = skfem.BilinearForm(
        lambda u, v, w: 2 * mu * ddot(sym_grad(u), sym_grad(v)) + lame * div(u) * div(v)
    )
    stiffness = form.assemble(basis)
    where = basis.doflocs.T.round(9)
    mine = {tuple(v): i for i, v in enumerate(refined.vert.round(9))}
    order = np.array([mine[tuple(v)] for v in where[::3]])
    assert (where[::3] == where[2::3]).all()  # scikit-fem's coordinates x, y, z of a node follow each other
    u = np.random.default_rng(0).standard_normal((len(refined.vert), 3))
    element = Tetrahedra(refined.vert, refined.elem, LAWS["linear"], CPU, contraction=1.0)
    ours = u.ravel() @ element.rest_stiffness(mu, lame) @ u.ravel()
    theirs = u[order].ravel()
    assert ours == pytest.approx(theirs @ stiffness @ theirs, rel=1e-12)


@pytest.mark.parametrize("law", LAWS)
def test_affine_displacements_go_on_inside(law):
    """An affine displacement of the boundary of an irregular block goes on inside, exactly, also nearly
    incompressible."""
    vert, elem = box([np.linspace(0, 1e-2, 3)] * 3, jitter=0.3)
    outside = np.flatnonzero(np.isin(vert, [0, 1e-2]).any(1))
    model = SkinModel(
        skin(vert, elem, outside),
        Material(law, 1e6, 0.49),
        SkinOptions(element="quadratic", tolerance=1e-5, **TIGHT),
    )
    data = SkinData(model)
    A = np.array([[0.05, 0.03, -0.02], [-0.04, -0.06, 0.01], [0.02, 0.05, 0.01]])
    place(data, model.fixed, model.geometry.vert[model.fixed] @ (np.eye(3) + A).T)
    step(model, data, NOTHING)
    assert data.converged.all()
    assert abs(data.vert_xpos[0] - model.geometry.vert @ (np.eye(3) + A).T).max() < 1e-9 * 1e-2


@pytest.mark.parametrize("law", [law for law in LAWS if law != "linear"])
def test_rigid_motion_makes_no_force(law):
    model = block(law, nu=0.4999)
    Q, _ = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))
    Q *= np.sign(np.linalg.det(Q))
    elements = Elements(SkinData(model))
    moved = elements.force(model.geometry.vert @ Q.T + 0.05)
    stretched = elements.force(1.01 * model.geometry.vert)
    assert abs(moved).max() < 1e-9 * abs(stretched).max()


def test_stress_of_a_stretched_block():
    """Isochoric stretch s of Neo-Hookean rubber: sigma = mu (s^2 - 1/s) along, less the same mean
    (Treloar)."""
    model, s = block("neo_hookean", nu=0.499), 1.3
    data = SkinData(model)
    data.x.numpy()[:, 0] = model.geometry.vert * [s, s**-0.5, s**-0.5]
    cauchy, mises = data.stress()
    np.testing.assert_allclose(mises[0], model.material.mu * (s**2 - 1 / s), rtol=1e-9)
    np.testing.assert_allclose(
        cauchy[0, :, 0, 0] - cauchy[0, :, 1, 1], model.material.mu * (s**2 - 1 / s), rtol=1e-9
    )


def test_cook_does_not_lock():
    """Cook's membrane, plane strain, nu 0.4999: within 2 % of Taylor-Hood elements where linear tetrahedra
    are lost."""
    wanted = locking.cook_reference(0.4999, 24)
    errors = np.array([locking.cook_tip(n, "quadratic", 0.4999) for n in (4, 8, 16)]) / wanted - 1
    assert abs(errors[-1]) < 0.02 and (np.abs(errors[:-1]) > 2 * np.abs(errors[1:])).all(), errors
    assert locking.cook_tip(16, "linear", 0.4999) / wanted - 1 < -0.5


@pytest.mark.parametrize("nu", [pytest.param(0.3, marks=pytest.mark.slow), 0.4999])
def test_quadratic_spheres_grow_as_that_of_lame(nu):
    """Lame's thick sphere; with this mesh the loads of the faceted inside are off by as much."""
    assert (abs(locking.sphere_growth(nu, "quadratic", 2, 2)) < 0.016).all()
    if nu > 0.49:
        assert (locking.sphere_growth(nu, "linear", 2, 2) < -0.5).all()


def test_refined_skins_have_the_same_volume_and_surfaces():
    """Quadratic elements on four-node tetrahedra: the given nodes come first; the new ones fill the same
    volume and the same surfaces."""
    coarse = four_nodes("coarse")
    model = SkinModel(coarse, "ansys", SkinOptions(core_contact=False, liquid=False))
    fine = model.geometry
    assert (fine.vert[: coarse.nvert] == coarse.vert).all() and set(coarse.fixed) < set(model.fixed)
    assert len(np.unique(fine.elem)) == fine.nvert == model.nvert
    for name in ("outer_face", "inner_face"):
        given, new = (np.moveaxis(g.vert[getattr(g, name)], 1, 0) for g in (coarse, fine))
        areas = [np.cross(t[1] - t[0], t[2] - t[0]) for t in (given, new)]
        np.testing.assert_allclose(
            areas[1].reshape(-1, 4, 3).sum(1), areas[0], atol=1e-12 * abs(areas[0]).max()
        )  # children in order
    corner = fine.vert[fine.tets]
    volume = np.linalg.det(corner[:, 1:] - corner[:, :1]) / 6
    assert (volume > 0).all()
    np.testing.assert_allclose(volume.reshape(-1, 8).sum(1), model.elements.mesh.volume.numpy(), rtol=1e-9)
    assert model.elements.node_volume.sum() == pytest.approx(volume.sum())


def test_ansys_preset_presses():
    """The ANSYS rubber with liquid: every step of a press converges, the liquid keeps its volume, the force
    rises."""
    model = SkinModel(load_skin("coarse"), "ansys")
    assert model.element == "quadratic" and model.has_liquid and PRESETS["paper"].element == "linear"
    data, geoms = SkinData(model), GeomSet(["sphere"], [(3.5e-3,)], [model.material.friction])
    low = model.geometry.vert[:, 1].min()
    pushed = []
    for depth in (0.0, 0.1e-3, 0.2e-3, 0.3e-3):
        geoms.set_pose(np.array([[-10e-3, low - 3.5e-3 + depth, 0]]), np.eye(3)[None])
        step(model, data, geoms)
        assert data.converged.all()
        pushed.append(-data.wrench[0, 0, 1])
    assert (np.diff(pushed) > 0).all() and pushed[-1] > 0.01
    assert abs(data.volume[0] / model.liquid_volume - 1) < 1e-6


@pytest.mark.parametrize("make, text", [
    (lambda: SkinOptions(element="cubic"), "unknown element 'cubic': choose one of linear, quadratic, or "
                                           "None for the material's choice"),
    (lambda: Material(element="cubic"), "unknown element 'cubic': choose one of linear, quadratic"),
])  # fmt: skip
def test_bad_elements_are_refused(make, text):
    with pytest.raises(ValueError, match=text):
        make()


def test_a_folded_element_is_refused():
    vert, elem = box([np.linspace(0, 1e-2, 2)] * 3)
    refined = with_edge_nodes(skin(vert, elem, [0]))
    bent, elem = refined.vert.copy(), refined.elem
    bent[elem[0, 4]] += 2 * (bent[elem[0, 2]] - bent[elem[0, 4]])  # an edge's node beyond the opposite corner
    with pytest.raises(ValueError, match="quadratic tetrahedra are folded .*: straighten their edges"):
        Tetrahedra(bent, elem, 0, CPU)


@pytest.mark.parametrize("law", ["neo_hookean", "corotational"])
def test_factor_at_a_turned_shape(law):
    """A skin that has only turned has the compliance of rest, turned with it."""
    model = block(law, nu=0.499)
    Q = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    f = np.random.default_rng(0).standard_normal((model.nvert, 1, 3))
    f[model.fixed] = 0
    turned = model.factor_at(model.geometry.vert @ Q.T).solve(f @ Q.T)
    np.testing.assert_allclose(turned, model.factor.solve(f) @ Q.T, rtol=0, atol=1e-8 * abs(turned).max())


def test_linear_elements_of_ten_nodes():
    """Linear elements on ten-node tetrahedra are their eight parts: the same nodes, the same volume but for
    curved edges."""
    geometry = load_skin("coarse")
    linear, curved = (SkinModel(geometry, "default", SkinOptions(element=e)) for e in ("linear", None))
    assert (linear.element, curved.element) == ("linear", "quadratic")
    assert linear.nvert == curved.nvert == geometry.nvert and linear.nelem == 8 * curved.nelem
    volumes = [m.elements.mesh.volume.numpy() for m in (linear, curved)]
    assert volumes[0].sum() == pytest.approx(volumes[1].sum(), rel=0.02)
    assert (linear.fixed == curved.fixed).all()


def test_coupled_skin_keeps_its_nodes(tmp_path):
    """In a simulation the sensor and the view see the geometry's own nodes; the state holds them all and
    replays exactly."""
    path = four_nodes("coarse").save(tmp_path / "corners.npz")
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep="0.002"/><worldbody><body name="finger"/>'
        '<body name="ball" mocap="true" pos="-0.01 -0.0117 0"><geom name="ball" type="sphere" '
        'size="0.0035"/></body></worldbody></mujoco>'
    )
    handle = biotac_mj.attach(spec, body="finger", skin=str(path), material="ansys", readings="none")
    model = spec.compile()
    data = mujoco.MjData(model)
    rest = four_nodes("coarse").vert
    mujoco.mj_step(model, data)
    data.mocap_pos[0, 1] += 2e-4
    mujoco.mj_step(model, data)
    biotac_mj.plugin.check()
    xpos = handle.vert_xpos(model, data)
    assert xpos.shape == rest.shape
    pressure = handle.contact_pressure(model, data, of="faces")
    assert pressure.shape == (len(four_nodes("coarse").outer_face),) and pressure.any()
    assert 5e-5 < abs(xpos - rest).max() < 5e-4


@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("law", LAWS)
def test_cuda_equals_cpu(law):
    """Four threads to an element there: forces of three worlds to rounding, products to single
    precision."""
    vert, elem = box([np.linspace(0, 1e-2, 3)] * 3, 0.25)
    results = []
    for device in ("cpu", "cuda:0"):
        geometry = skin(vert, elem, np.flatnonzero(vert[:, 1] == 0))
        model = SkinModel(
            geometry, Material(law, 1e6, 0.4999), SkinOptions(element="quadratic"), device=device
        )
        rng, elements = np.random.default_rng(0), Elements(SkinData(model, 3), SINGLE)
        x = np.repeat(model.geometry.vert[:, None], 3, 1) + 4e-4 * rng.uniform(-1, 1, (model.nvert, 3, 3))
        results.append((elements.force(x), elements.product(rng.standard_normal(x.shape))))
        folded = x.copy()
        folded[model.geometry.elem[5, 0], 1] += 0.1
        assert elements.upright(x).all()
        assert elements.upright(folded).tolist() == [True, law == "linear", True]  # small strain has no flaw
    for cpu, cuda, close in zip(*results, (1e-11, 1e-5), strict=True):
        assert abs(cpu - cuda).max() < close * abs(cpu).max()


@pytest.mark.parametrize("element", ["linear", "quadratic"])
def test_inverted_elements_are_seen(element):
    """By the determinant at the integration points, in the worlds that have one."""
    vert, elem = box([np.linspace(0, 1e-2, 3)] * 3, 0.25)
    model = SkinModel(skin(vert, elem, [0]), Material("svk", 1e6, 0.3), SkinOptions(element=element))
    elements = Elements(SkinData(model, 2))
    for fold in np.linspace(0, 1, 5) * 1e-2:
        x = np.repeat(model.geometry.vert[:, None], 2, 1)
        x[model.geometry.elem[5, 0], 1] += fold
        least = [np.linalg.det(gradients(model.elements, x[:, w])[0]).min() for w in range(2)]
        assert elements.upright(x).tolist() == [v > 0 for v in least]
    assert least[1] < 0 < least[0]
