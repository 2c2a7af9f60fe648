"""Film conduction against closed forms, an axisymmetric finite-element solution and a tube whose resistance
is known."""

import dataclasses

import numpy as np
import pytest
import scipy.sparse.linalg as sparse_linalg
import trimesh
import warp as wp
from scipy.sparse import coo_matrix

from biotac_mj.geometry.core_surface import CoreSurface
from biotac_mj.geometry.skin_geometry import SkinGeometry
from biotac_mj.geometry.skins import load_skin
from biotac_mj.sensor.channels import REST_COUNTS, counts_from_impedance
from biotac_mj.sensor.film import FilmConduction, kernels, spreading_resistance, spreading_table
from biotac_mj.sensor.film.systems import edges

RADIUS, LENGTH, GAP, SIGMA = 5.325e-3, 100e-3, 0.4e-3, 0.5
EXCITATION = tuple((-0.045, angle) for angle in np.radians([-135, -45, 45, 135]))


def grid(nu, nv):
    """Faces of a nu x nv grid of nodes, the triangles' diagonals alternating."""
    i, j = (k.ravel() for k in np.meshgrid(np.arange(nu - 1), np.arange(nv - 1), indexing="ij"))
    a, b, c, d = i * nv + j, (i + 1) * nv + j, (i + 1) * nv + j + 1, i * nv + j + 1
    even = ((i + j) % 2 == 0)[:, None]
    first = np.where(even, np.stack([a, b, c], 1), np.stack([a, b, d], 1))
    second = np.where(even, np.stack([a, c, d], 1), np.stack([b, c, d], 1))
    return np.concatenate([first, second])


def tube(naround=56, nalong=121, gap=GAP):
    """A skin of which only the inner surface exists: a tube around a cylindrical core, E1..E19 on it at x =
    -30 .. 40 mm, pad side."""
    core = trimesh.creation.cylinder(RADIUS, LENGTH + 10e-3, sections=512)
    core.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    x, angle = np.meshgrid(
        np.linspace(-LENGTH / 2, LENGTH / 2, nalong), np.linspace(0, 2 * np.pi, naround + 1), indexing="ij"
    )
    vert = np.stack([x, -(RADIUS + gap) * np.cos(angle), (RADIUS + gap) * np.sin(angle)], axis=-1).reshape(
        -1, 3
    )
    face = grid(nalong, naround + 1)
    seam = np.arange(len(vert))
    seam[naround :: naround + 1] = seam[0 :: naround + 1]  # the last column is the first one
    position = np.zeros((19, 3))
    position[:, 0] = np.linspace(-30e-3, 40e-3, 19)
    position[:, 1] = -RADIUS
    none = np.zeros((0, 3))
    return SkinGeometry(
        "tube",
        vert,
        np.zeros((0, 4)),
        none,
        seam[face],
        [],
        core.vertices,
        core.faces,
        none,
        none,
        none,
        none,
        position,
        np.tile([0.0, -1.0, 0.0], (19, 1)),
    )


@pytest.fixture(scope="module")
def tube_film():
    return FilmConduction(tube(), conductivity=SIGMA, excitation=EXCITATION, sensor=None)


def sheet_laplacian(point, face, conductance):
    """P1 finite-element matrix (n, n) [S] of div(s grad u) on a surface, by the film's kernel; conductance:
    (m,) s of each face [S]."""
    i, j = edges(face)
    with wp.ScopedDevice("cpu"):
        edge = wp.zeros((3 * len(face), 1), dtype=wp.float64)
        surface = wp.array(point[:, None], dtype=wp.vec3d, ndim=2), wp.ones((len(point), 1), dtype=wp.float64)
        sheet = [wp.ones(1, dtype=int), wp.array(face, dtype=wp.vec3i), 1.0, *surface]
        wp.launch(kernels.face_conductance, (len(face), 1), sheet, [edge])
    off = np.repeat(conductance, 3) * edge.numpy()[:, 0]
    rows, columns = np.concatenate([i, j, i, j]), np.concatenate([j, i, i, j])
    return coo_matrix(
        (np.concatenate([-off, -off, off, off]), (rows, columns)), shape=(len(point),) * 2
    ).tocsr()


def test_a_strip_conducts_as_its_closed_form():
    x, y = np.meshgrid(np.linspace(0, 6e-3, 13), np.linspace(0, 2e-3, 5), indexing="ij")
    point = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    face = grid(13, 5)
    matrix = sheet_laplacian(point, face, np.full(len(face), SIGMA * GAP)).toarray()
    left, right = x.ravel() == 0, x.ravel() == x.max()
    potential = np.where(right, 1.0, 0.0)
    free = ~(left | right)
    potential[free] = np.linalg.solve(matrix[np.ix_(free, free)], -matrix[free] @ potential)
    current = matrix[right] @ potential
    np.testing.assert_allclose(1 / current.sum(), 6e-3 / (SIGMA * GAP * 2e-3), rtol=1e-10)


def annulus_error(n):
    inner, outer = 1e-3, 4e-3
    rho, angle = np.meshgrid(
        np.linspace(inner, outer, n + 1), np.linspace(0, np.pi / 2, n + 1), indexing="ij"
    )
    point = np.stack([rho * np.cos(angle), rho * np.sin(angle), np.zeros_like(rho)], axis=-1).reshape(-1, 3)
    face = grid(n + 1, n + 1)
    matrix = sheet_laplacian(point, face, np.full(len(face), SIGMA * GAP)).tocsc()
    rho = rho.ravel()
    low, high = rho <= inner, rho >= outer
    free = ~(low | high)
    potential = np.where(low, 1.0, 0.0)
    potential[free] = sparse_linalg.spsolve(matrix[free][:, free], -(matrix[free] @ potential))
    resistance = 1 / (matrix[low] @ potential).sum() / 4  # a quarter of the annulus
    return abs(resistance * 2 * np.pi * SIGMA * GAP / np.log(outer / inner) - 1)


def test_annulus_converges_with_second_order():
    coarse, fine = annulus_error(8), annulus_error(16)
    assert fine < 3e-3
    assert 3.3 < coarse / fine < 4.7


def test_tube_resistance_per_length(tube_film):
    """Far from the excitation discs Z grows by 1 / (sigma h 2 pi R) per length, R the radius of the film's
    middle."""
    impedance = tube_film.impedance(tube_film.geometry.vert)
    x = tube_film.geometry.electrode_pos[:, 0]
    far = x < 30e-3  # the discs' own near field is the same everywhere, but for the tube's open end
    slope = np.polyfit(x[far], impedance[far], 1)[0]
    assert slope == pytest.approx(1 / (SIGMA * GAP * 2 * np.pi * (RADIUS + GAP / 2)), rel=5e-3)


def test_a_finer_mesh_gives_the_same_impedances(tube_film):
    finer = FilmConduction(tube(84, 181), conductivity=SIGMA, excitation=EXCITATION, sensor=None)
    np.testing.assert_allclose(
        finer.impedance(finer.geometry.vert), tube_film.impedance(tube_film.geometry.vert), rtol=0.02
    )


def test_spreading_resistance_against_finite_elements():
    """A disc in a slab, axisymmetric, grounded at r = b: the sheet's ln(b / a) + 1/4 plus the spreading
    resistance."""
    skfem = pytest.importorskip("skfem")
    a, b = 1.0, 8.0
    for thickness in (0.5, 2.0):
        r = np.unique(np.concatenate([np.linspace(0, 2 * a, 49), np.geomspace(2 * a, b, 20)]))
        mesh = skfem.MeshQuad.init_tensor(r, np.linspace(0, thickness, 21))
        basis = skfem.Basis(mesh, skfem.ElementQuad2())
        stiffness = skfem.BilinearForm(
            lambda u, v, w: 2 * np.pi * w.x[0] * (u.grad[0] * v.grad[0] + u.grad[1] * v.grad[1])
        ).assemble(basis)
        disc = skfem.FacetBasis(
            mesh, skfem.ElementQuad2(), facets=mesh.facets_satisfying(lambda x: (x[1] == 0) & (x[0] <= a))
        )
        load = skfem.LinearForm(lambda v, w: 2 * np.pi * w.x[0] / (np.pi * a**2) * v).assemble(disc)
        ground = basis.get_dofs(mesh.facets_satisfying(lambda x: np.isclose(x[0], b)))
        potential = skfem.solve(*skfem.condense(stiffness, load, D=ground))
        sheet = (np.log(b / a) + 0.25) / (2 * np.pi * thickness)
        assert load @ potential - sheet == pytest.approx(
            float(spreading_resistance(np.array([thickness / a]))[0]) / a, rel=0.01
        )


def test_spreading_resistance_of_a_thin_film():
    np.testing.assert_allclose(
        spreading_resistance(np.array([0.01, 0.03])), np.array([0.01, 0.03]) / (3 * np.pi), rtol=0.03
    )


def moved(geometry, where, radial):
    """vert with a smooth radial bump of 3 mm width at x = `where` on the pad side; positive = away from the
    core [m]."""
    vert = geometry.vert.copy()
    axis = vert * [0, 1, 1]
    unit = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    distance2 = ((vert - [where, -RADIUS, 0]) ** 2).sum(1)
    return vert + radial * np.exp(-distance2 / (2 * 1.5e-3**2))[:, None] * unit


def test_thinner_film_raises_and_more_liquid_lowers(tube_film):
    geometry = tube_film.geometry
    rest = tube_film.impedance(geometry.vert)
    k = 8
    pressed = tube_film.impedance(moved(geometry, geometry.electrode_pos[k, 0], -0.3e-3))
    bulged = tube_film.impedance(moved(geometry, geometry.electrode_pos[k, 0], 0.3e-3))
    change = np.log(pressed / rest)
    assert np.argmax(change) == k and change[k] > 0.1
    assert np.argmin(np.log(bulged / rest)) == k and bulged[k] < 0.98 * rest[k]


def test_skin_on_the_core_leaves_the_residual_film(tube_film):
    geometry = tube_film.geometry
    deep = moved(geometry, geometry.electrode_pos[8, 0], -0.8e-3)
    assert tube_film.film(deep)[1].min() == tube_film.residual_film
    thin = FilmConduction(
        geometry, conductivity=SIGMA, excitation=EXCITATION, sensor=None, residual_film=20e-6
    )
    impedance = tube_film.impedance(deep)
    assert np.all(np.isfinite(impedance)) and thin.impedance(deep)[8] > 1.3 * impedance[8]


def test_sliding_along_the_core_changes_nothing(tube_film):
    """Electrodes are on the core: a skin that turns about the core's axis carries its mesh past them."""
    turn = trimesh.transformations.rotation_matrix(0.13, [1, 0, 0])[:3, :3]
    vert = tube_film.geometry.vert
    np.testing.assert_allclose(tube_film.impedance(vert @ turn.T), tube_film.impedance(vert), rtol=4e-3)


def test_rest_counts_are_the_published_ones():
    geometry = tube()
    for sensor, counts in REST_COUNTS.items():
        film = FilmConduction(geometry, excitation=EXCITATION, sensor=sensor)
        np.testing.assert_allclose(counts_from_impedance(film.impedance(geometry.vert)), counts, rtol=1e-12)


def disc_means(film, middle):
    """(nnode, 23): weights of the nodes in the mean over each disc, sample by sample."""
    weight = np.zeros((len(middle), len(film._pos)))
    for e, (position, tangent) in enumerate(zip(film._pos, film._tangent)):
        face = film.face[film._pair[1][film._pair[0] == e]]
        corner = np.concatenate([(middle - position) @ tangent.T, np.ones((len(middle), 1))], axis=1)[face]
        at = [
            (face, np.linalg.solve(np.swapaxes(corner, 1, 2), np.tile([*p, 1.0], (len(face), 1))[..., None]))
            for p in film._disc
        ]
        covered = [(f[(b >= 0).all((1, 2))], b[(b >= 0).all((1, 2)), :, 0]) for f, b in at]
        covered = [(f, b) for f, b in covered if len(f)]
        for f, b in covered:
            np.add.at(weight[:, e], f, b / len(f) / len(covered))
    return weight


def test_against_a_sparse_solution(tube_film):
    """The same film solved by scipy, the excitation discs held together by equations of their own."""
    film, vert = tube_film, moved(tube_film.geometry, -2e-3, -0.25e-3)
    middle, thickness = film.film(vert)
    weight = disc_means(film, middle)
    matrix = sheet_laplacian(middle, film.face, SIGMA * thickness[film.face].mean(1)).tocsc()
    solved = sparse_linalg.splu(matrix[1:, 1:]).solve(weight[1:])
    resistance = weight[1:].T @ solved  # against node 0
    a, local = film.electrode_radius, thickness @ weight
    step, table = spreading_table()
    slab = np.interp(local / (local + a), step * np.arange(len(table)), table) / a
    resistance += np.diag(np.log(0.8e-3 / a) / (2 * np.pi * local) + slab) / SIGMA
    ground = np.block([[resistance[19:, 19:], np.ones((4, 1))], [np.ones((1, 4)), 0]])
    expected = np.empty(19)
    for e in range(19):
        # currents into X1..X4 and the potential that all four then have
        out = np.linalg.solve(ground, np.append(-resistance[19:, e], -1.0))
        expected[e] = resistance[e, e] + resistance[e, 19:] @ out[:4] + out[4]
    np.testing.assert_allclose(film.impedance(vert), expected, rtol=1e-9)


def test_worlds_equal_the_loop(tube_film):
    vert = tube_film.geometry.vert
    other = moved(tube_film.geometry, 0.0, -0.2e-3)
    batch = tube_film.impedance(np.stack([vert, other]))
    assert np.array_equal(batch, np.stack([tube_film.impedance(vert), tube_film.impedance(other)]))


def test_bad_vertices_are_refused(tube_film):
    vert = tube_film.geometry.vert
    with pytest.raises(ValueError, match=r"vert_xpos has shape \(5, 3\): the skin 'tube' needs"):
        tube_film.impedance(np.zeros((5, 3)))
    broken = vert.copy()
    broken[tube_film.node[3], 1] = np.nan
    with pytest.raises(ValueError, match="not finite at 1 inner node"):
        tube_film.impedance(broken)
    with pytest.raises(ValueError, match="no liquid film over E1, E2"):
        tube_film.impedance(vert + [0.2, 0, 0])
    with pytest.raises(ValueError, match="conductivity is -1: give a finite number > 0"):
        FilmConduction(tube_film.geometry, conductivity=-1)
    with pytest.raises(ValueError, match="sensor is '9': pass one of '1', '2', '3'"):
        FilmConduction(tube_film.geometry, sensor="9")
    with pytest.raises(ValueError, match=r"excitation is array.*: pass \(4, 2\) finite numbers"):
        FilmConduction(tube_film.geometry, excitation=np.zeros((3, 3)))
    with pytest.raises(ValueError, match="no free inner face"):
        FilmConduction(dataclasses.replace(tube_film.geometry, fixed=np.arange(len(vert))))


def test_core_distance_against_all_triangles():
    mesh = trimesh.creation.icosphere(3, 5e-3)
    box = trimesh.creation.box([20e-3, 8e-3, 3e-3])  # two triangles a side: long, few
    rng = np.random.default_rng(0)
    for body in (mesh, box):
        point = trimesh.sample.sample_surface(body, 300, seed=1)[0] + rng.normal(scale=0.7e-3, size=(300, 3))
        distance, foot, _ = CoreSurface(body.vertices, body.faces).closest(point)
        # closest_point drops small triangles in metres
        scaled = trimesh.Trimesh(body.vertices * 1e3, body.faces, process=False)
        expected = scaled.nearest.signed_distance(point * 1e3) * -1e-3
        np.testing.assert_allclose(distance, expected, atol=2e-6)
        np.testing.assert_allclose(np.linalg.norm(point - foot, axis=1), np.abs(distance), atol=1e-12)


@pytest.mark.parametrize("sensor", ["", None])
def test_another_residual_film_is_that_of_a_film_made_with_it(sensor):
    skin = load_skin("coarse")
    own = FilmConduction(skin, sensor=sensor)
    made, other = FilmConduction(skin, residual_film=1.5e-4, sensor=sensor), own.with_residual_film(1.5e-4)
    pressed = skin.vert + [0.0, 3e-4, 0.0]
    np.testing.assert_array_equal(other.impedance(pressed), made.impedance(pressed))
    np.testing.assert_array_equal(other.rest, made.rest)
    assert own.residual_film == 50e-6 and not np.allclose(own.impedance(pressed), made.impedance(pressed))
    with pytest.raises(ValueError, match="residual_film is 0.0: give a finite number > 0"):
        own.with_residual_film(0.0)


def test_a_skin_that_is_as_it_was_is_not_solved_again():
    """What lays a film in between, or what is none, leaves no impedance behind."""
    film, made = FilmConduction(load_skin("coarse")), []
    film._solve_single = [lambda: made.append(0), *film._solve_single]
    at_rest = film.geometry.vert
    moved = at_rest + [0.0, 1e-5, 0.0]
    first, rest = film.impedance(moved), film.impedance(at_rest)
    assert len(made) == 2 and (first != rest).all()
    assert (film.impedance(at_rest.copy()) == rest).all() and len(made) == 2
    film.film(moved)
    assert (film.impedance(moved) == first).all() and len(made) == 3
    with pytest.raises(ValueError, match="not finite"):
        film.impedance(np.full_like(moved, np.nan))
    assert (film.impedance(moved) == first).all()
