"""Tetrahedral meshes between parametric bodies, made with fTetWild (development extras `pytetwild` and `pyvista`). Millimetres throughout.

fTetWild keeps within an envelope of the surfaces it is given; afterwards boundary nodes are moved onto the parametric surfaces, and all nodes move,
along the surfaces and inside, to round the worst tetrahedra.
"""

import numpy as np

from biotac_mj.geometry.tet_mesh import TetMesh

__all__ = ["improve", "mesh_between", "surface_mesh"]

# Edge matrix (columns) of the regular tetrahedron, inverted: the rest shape of the mean-ratio measure.
_REGULAR = np.linalg.inv(np.array([[1.0, 0.5, 0.5], [0.0, np.sqrt(3) / 2, np.sqrt(3) / 6], [0.0, 0.0, np.sqrt(2.0 / 3.0)]]))


def surface_mesh(body, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Closed triangle mesh of a `Body`: vert (n, 3), face (m, 3), a contour on a grid of `spacing` [mm] projected onto the surface; symmetric in z."""
    import pyvista

    low, high = np.array([-22.0, -9.0, -8.0]), np.array([7.5, 6.0, 8.0])
    count = np.ceil((high - low) / spacing).astype(int) + 1
    low[2] = -(count[2] - 1) / 2 * spacing
    grid = pyvista.ImageData(dimensions=count, spacing=(spacing,) * 3, origin=low)
    surface = grid.contour([0.0], scalars=body.field(grid.points)).clean()
    face = surface.regular_faces
    vert = body.project(surface.points)
    volume = np.einsum("ij,ij->", np.cross(vert[face[:, 0]], vert[face[:, 1]]), vert[face[:, 2]])
    return vert, face if volume > 0 else face[:, ::-1]


def mesh_between(outer, inner, edge: float, spacing: float, epsilon: float, coarsen: bool = True) -> TetMesh:
    """Tetrahedra (here in mm) between two bodies: fTetWild, then `improve`.

    Args:
      outer, inner: `Body`; inner may be None for a solid.
      edge: wanted edge length [mm].
      spacing: grid of the input surfaces [mm].
      epsilon: fTetWild's envelope, as a share of the diagonal of the box.
    """
    import pytetwild

    bodies = [outer] if inner is None else [outer, inner]
    surfaces = [surface_mesh(body, spacing) for body in bodies]
    vert, face = surfaces[0]
    if inner is not None:
        face = np.concatenate([face, surfaces[1][1][:, ::-1] + len(vert)])
        vert = np.concatenate([vert, surfaces[1][0]])
    vert, elem = pytetwild.tetrahedralize(
        vert, face.astype(np.int32), edge_length_abs=edge, epsilon=epsilon, stop_energy=8.0, coarsen=coarsen, num_threads=1
    )
    mesh = TetMesh(vert, elem)
    inverted = mesh.volumes < 0
    mesh.elem[inverted] = mesh.elem[inverted][:, [0, 2, 1, 3]]
    return improve(TetMesh(mesh.vert, mesh.elem), bodies)


def improve(mesh: TetMesh, bodies, rounds: int = 12, power: float = 2.0) -> TetMesh:
    """Moves nodes to round the tetrahedra; nodes of the boundary part i stay on bodies[i] (parts by decreasing enclosed volume).

    Minimises the sum over tetrahedra of (|F|^2 / (3 det(F)^(2/3)))^power, F the map from the regular tetrahedron: 1 for a regular one, infinite
    for a flat one (mean ratio). L-BFGS in the surfaces' tangent planes alternates with projection onto the surfaces.
    """
    from scipy.optimize import minimize

    vert, elem = mesh.vert.copy(), mesh.elem
    owner = np.full(len(vert), -1)
    for i, part in enumerate(mesh.boundary_components()):
        owner[part] = i
    vert = _project(vert, owner, bodies, elem)
    for _ in range(rounds):
        normal = np.zeros_like(vert)
        for i, body in enumerate(bodies):
            normal[owner == i] = body.normal(vert[owner == i])
        start = vert

        def energy(step, start=start, normal=normal):
            step = step.reshape(-1, 3)
            step = step - np.sum(step * normal, axis=1, keepdims=True) * normal
            value, gradient = _roundness(start + step, elem, power)
            return value, (gradient - np.sum(gradient * normal, axis=1, keepdims=True) * normal).ravel()

        result = minimize(energy, np.zeros(vert.size), jac=True, method="L-BFGS-B", bounds=[(-0.1, 0.1)] * vert.size, options={"maxiter": 30})
        step = result.x.reshape(-1, 3)
        vert = _project(start + step - np.sum(step * normal, axis=1, keepdims=True) * normal, owner, bodies, elem, start)
    return TetMesh(vert, elem)


def _roundness(vert, elem, power):
    """Energy of `improve` and its gradient (nvert, 3); infinite when a tetrahedron is inverted."""
    corner = vert[elem]
    edges = np.swapaxes(corner[:, 1:] - corner[:, :1], 1, 2)
    shape = edges @ _REGULAR
    det = np.linalg.det(shape)
    if det.min() <= 0:
        return 1e300, np.zeros_like(vert)
    norm = np.sum(shape**2, axis=(1, 2))
    ratio = norm / (3 * det ** (2 / 3))
    slope = (power * ratio ** (power - 1))[:, None, None] * (
        2 * shape / (3 * det ** (2 / 3))[:, None, None] - (2 / 3) * ratio[:, None, None] * np.swapaxes(np.linalg.inv(shape), 1, 2)
    )
    force = np.swapaxes(slope @ _REGULAR.T, 1, 2)  # (nelem, 3 corners, 3)
    gradient = np.zeros_like(vert)
    for k in range(3):
        np.add.at(gradient, elem[:, k + 1], force[:, k])
    np.add.at(gradient, elem[:, 0], -force.sum(axis=1))
    return float(np.sum(ratio**power)), gradient


def _project(vert, owner, bodies, elem, fallback=None):
    """Nodes moved onto their surfaces; nodes of tetrahedra that this inverts go part of the way (or back to `fallback`)."""
    target = vert.copy()
    for i, body in enumerate(bodies):
        target[owner == i] = body.project(vert[owner == i])
    origin = vert if fallback is None else fallback
    share = np.ones(len(vert))
    for _ in range(30):
        moved = origin + share[:, None] * (target - origin)
        bad = TetMesh(moved, elem).volumes <= 0
        if not bad.any():
            break
        share[elem[bad]] *= 0.5
    return moved
