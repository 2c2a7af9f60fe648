"""Tetrahedral meshes between parametric bodies, made with fTetWild (development extras `pytetwild` and
`pyvista`). Millimetres throughout.

fTetWild keeps within an envelope of the surfaces it is given; afterwards boundary nodes are moved onto the
parametric surfaces, and all nodes move, along the surfaces and inside, to round the worst tetrahedra."""

import contextlib
import pathlib
import tempfile

import numpy as np

from biotac_mj.files import replacing
from biotac_mj.geometry.tet_mesh import TetMesh

__all__ = ["improve", "mesh_between", "surface_mesh", "write_obj"]

# Edge matrix (columns) of the regular tetrahedron, inverted: the rest shape of the mean-ratio measure.
_REGULAR = np.linalg.inv(
    np.array([[1.0, 0.5, 0.5], [0.0, np.sqrt(3) / 2, np.sqrt(3) / 6], [0.0, 0.0, np.sqrt(2.0 / 3.0)]])
)


def surface_mesh(body: object, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Closed triangle mesh of a `Body`: vert (n, 3), face (m, 3), symmetric in z; a contour on a grid of
    `spacing` [mm], projected."""
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


def mesh_between(
    outer: object, inner: object, edge: float, spacing: float, epsilon: float, coarsen: bool = True
) -> TetMesh:
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
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.chdir(folder),
    ):  # fTetWild leaves a file where it runs
        vert, elem = pytetwild.tetrahedralize(
            vert,
            face.astype(np.int32),
            edge_length_abs=edge,
            epsilon=epsilon,
            stop_energy=8.0,
            coarsen=coarsen,
            num_threads=1,
        )
    mesh = TetMesh(vert, elem)
    inverted = mesh.volumes < 0
    mesh.elem[inverted] = mesh.elem[inverted][:, [0, 2, 1, 3]]
    return improve(TetMesh(mesh.vert, mesh.elem), bodies)


def improve(mesh: TetMesh, bodies: object, iterations: int = 150, power: float = 8.0) -> TetMesh:
    """Moves nodes to round the tetrahedra; nodes of the boundary part i stay on bodies[i] (parts by
    decreasing enclosed volume).

    Lowers the sum over tetrahedra of (|F|^2 / (3 det(F)^(2/3)))^power, F the map from the regular
    tetrahedron: 1 for a regular one, infinite for a flat one (mean ratio); the power lets the worst count.
    Descent with a step per node in the surfaces' tangent planes, projected back onto the surfaces, halved
    until the energy falls."""
    vert, elem = mesh.vert.copy(), mesh.elem
    owner = np.full(len(vert), -1)
    for i, part in enumerate(mesh.boundary_components()):
        owner[part] = i
    vert = _project(vert, owner, bodies, elem)
    size = np.cbrt(np.abs(mesh.volumes))  # a node's stiffness goes with energy / size^2 of its tetrahedra
    value, gradient, share = _roundness(vert, elem, power)
    length = 1.0
    for _ in range(iterations):
        stiffness = np.zeros(len(vert))
        np.add.at(stiffness, elem, (share / size**2)[:, None])
        step = -gradient / (power**2 * stiffness)[:, None]
        for i, body in enumerate(bodies):
            normal = body.normal(vert[owner == i])
            step[owner == i] -= np.sum(step[owner == i] * normal, axis=1, keepdims=True) * normal
        while length > 1e-4:
            trial = _project(vert + length * step, owner, bodies, elem, vert)
            new_value, new_gradient, new_share = _roundness(trial, elem, power)
            if new_value < value:
                break
            length *= 0.5
        else:
            break
        vert, value, gradient, share, length = (
            trial,
            new_value,
            new_gradient,
            new_share,
            min(2.0 * length, 4.0),
        )
    return TetMesh(vert, elem)


def _roundness(vert, elem, power):
    """Energy of `improve`, its gradient (nvert, 3) and the tetrahedra's shares (nelem,); infinite when one is
    inverted."""
    corner = vert[elem]
    edges = np.swapaxes(corner[:, 1:] - corner[:, :1], 1, 2)
    shape = edges @ _REGULAR
    det = np.linalg.det(shape)
    if det.min() <= 0:
        return np.inf, np.zeros_like(vert), np.ones(len(elem))
    norm = np.sum(shape**2, axis=(1, 2))
    ratio = norm / (3 * det ** (2 / 3))
    slope = (power * ratio ** (power - 1))[:, None, None] * (
        2 * shape / (3 * det ** (2 / 3))[:, None, None]
        - (2 / 3) * ratio[:, None, None] * np.swapaxes(np.linalg.inv(shape), 1, 2)
    )
    force = np.swapaxes(slope @ _REGULAR.T, 1, 2)  # (nelem, 3 corners, 3)
    gradient = np.zeros_like(vert)
    for k in range(3):
        np.add.at(gradient, elem[:, k + 1], force[:, k])
    np.add.at(gradient, elem[:, 0], -force.sum(axis=1))
    return float(np.sum(ratio**power)), gradient, ratio**power


def _project(vert, owner, bodies, elem, fallback=None):
    """Nodes moved onto their surfaces; nodes of tetrahedra that this inverts go part of the way (or back to
    `fallback`)."""
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


def write_obj(path: pathlib.Path | str, vert: np.ndarray, face: np.ndarray) -> pathlib.Path:
    """Writes a triangle mesh as .obj (to a temporary name, then renamed); positions with 10 digits."""
    text = "".join(f"v {x:.10g} {y:.10g} {z:.10g}\n" for x, y, z in vert) + "".join(
        f"f {a} {b} {c}\n" for a, b, c in np.asarray(face) + 1
    )
    with replacing(path) as temporary:
        temporary.write_text(text)
    return pathlib.Path(path)
