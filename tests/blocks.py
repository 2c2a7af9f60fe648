"""Small bodies with known answers: boxes, bars and thick spherical shells of tetrahedra, as skins without a
core."""

import itertools

import numpy as np
import trimesh

from biotac_mj.geometry import TetMesh, load_skin
from biotac_mj.geometry.making.assembly import assemble
from biotac_mj.geometry.skin_geometry import SkinGeometry


def box(axes, jitter=0.0, seed=0):
    """A box of tetrahedra, six to a cell.

    Args:
      axes: three increasing arrays of grid coordinates [m].
      jitter: how far inner nodes are moved at random, in shares of the smallest cell.

    Returns:
      vert (n, 3) [m], elem (m, 4).
    """
    axes = [np.asarray(a, float) for a in axes]
    shape = np.array([len(a) for a in axes])
    vert = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    node = np.arange(len(vert)).reshape(shape)
    cell = np.stack(np.meshgrid(*[np.arange(n - 1) for n in shape], indexing="ij"), -1).reshape(-1, 3)
    elem = []
    for order in itertools.permutations(
        range(3)
    ):  # Kuhn's split: from corner to opposite corner along the three axes in every order
        corner, path = cell.copy(), []
        path.append(node[tuple(corner.T)])
        for axis in order:
            corner[:, axis] += 1
            path.append(node[tuple(corner.T)])
        even = np.linalg.det(np.eye(3)[list(order)]) > 0
        elem.append(np.stack(path if even else [path[0], path[2], path[1], path[3]], 1))
    low, high = [a[0] for a in axes], [a[-1] for a in axes]
    inner = ((vert > low) & (vert < high)).all(1)
    size = min(np.diff(a).min() for a in axes)
    vert[inner] += jitter * size * np.random.default_rng(seed).uniform(-1, 1, (inner.sum(), 3))
    return vert, np.concatenate(elem).astype(np.int32)


def shell(outer, inner, subdivisions=2, layers=3):
    """A thick spherical shell of radii `outer` and `inner` [m] about the origin: vert, elem, inner_face."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    n = len(ball.vertices)
    vert = np.concatenate([r * ball.vertices for r in np.linspace(outer, inner, layers + 1)])
    f = np.sort(ball.faces, axis=1)  # prisms split by their lowest vertex fit together
    elem = np.concatenate(
        [
            np.concatenate(
                [
                    np.stack([f[:, 0], f[:, 1], f[:, 2], f[:, 2] + n], 1),
                    np.stack([f[:, 0], f[:, 1], f[:, 1] + n, f[:, 2] + n], 1),
                    np.stack([f[:, 0], f[:, 0] + n, f[:, 1] + n, f[:, 2] + n], 1),
                ]
            )
            + k * n
            for k in range(layers)
        ]
    )
    flipped = np.linalg.det(vert[elem[:, 1:]] - vert[elem[:, :1]]) < 0
    elem[flipped] = elem[flipped][:, [0, 1, 3, 2]]
    return vert, elem.astype(np.int32), (ball.faces[:, ::-1] + layers * n).astype(np.int32)


def finger(subdivisions, fixed, tip, radius):
    """A closed shell of a finger's size, one layer thick. Nodes with x > fixed are fixed; 19 electrodes lie
    on a helix of this radius from x = tip on [m]."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    n, center = len(ball.vertices), np.array([-8e-3, 0, 0])
    outer, inner, core = (
        ball.vertices * size + center
        for size in ([13e-3, 7e-3, 7e-3], [11.5e-3, 5.5e-3, 5.5e-3], [10e-3, 4.5e-3, 4.5e-3])
    )
    f = np.sort(ball.faces, axis=1)  # prisms split by their lowest vertex fit together
    elem = np.concatenate([np.stack([f[:, 0], f[:, 1], f[:, 2], f[:, 2] + n], 1),
                           np.stack([f[:, 0], f[:, 1], f[:, 1] + n, f[:, 2] + n], 1),
                           np.stack([f[:, 0], f[:, 0] + n, f[:, 1] + n, f[:, 2] + n], 1)])  # fmt: skip
    vert = np.concatenate([outer, inner])
    inverted = np.linalg.det(vert[elem[:, 1:]] - vert[elem[:, :1]]) < 0
    elem[inverted] = elem[inverted][:, [0, 1, 3, 2]]
    angle = np.linspace(-1.0, 1.0, 19)
    normal = np.stack([0 * angle, -np.cos(angle), np.sin(angle)], 1)
    electrode = np.stack([np.linspace(tip, -2e-3, 19), 0 * angle, 0 * angle], 1) + radius * normal
    empty, no_face = np.zeros((0, 3)), np.zeros((0, 3), int)
    inside, nail, clamp = ball.faces[:, ::-1] + n, (empty, no_face), (empty, no_face)
    end = np.flatnonzero(vert[:, 0] > fixed)
    return SkinGeometry(
        "synthetic", vert, elem, ball.faces, inside, end, core, ball.faces, *nail, *clamp, electrode, normal
    )


def boundary(elem):
    """Faces (m, 3) that belong to one tetrahedron only, normals outwards."""
    faces = np.concatenate([elem[:, [0, 2, 1]], elem[:, [0, 1, 3]], elem[:, [1, 2, 3]], elem[:, [0, 3, 2]]])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[first[count == 1]]


def faces_on(vert, face, axis, value):
    """The faces that lie in a plane x[axis] = value."""
    return face[(abs(vert[face][..., axis] - value) < 1e-12).all(1)]


def nodal_areas(vert, face):
    """A third of each face's area to each of its corners (nvert,): the nodal loads of a uniform traction of
    one."""
    edge = vert[face[:, 1:]] - vert[face[:, :1]]
    out = np.zeros(len(vert))
    np.add.at(out, face.ravel(), np.repeat(np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=1) / 6, 3))
    return out


def half_space(cells, radius, fine, touched):
    """Block below z = 0 that reaches 4.5 radii: `cells` cells per radius within `fine` radii of the origin,
    coarser away from it.

    Returns:
      vert, elem, held (nodes of sides and bottom), and the faces on top within `touched` radii.
    """
    grid = list(np.arange(0, fine, 1 / cells))
    while grid[-1] < 4.5:
        grid.append(grid[-1] + (1 + 1.6 / cells) * (grid[-1] - grid[-2]))
    grid = np.array(grid) * radius
    lateral = np.concatenate([-grid[:0:-1], grid])
    vert, elem = box([lateral, lateral, -grid[::-1]])
    held = np.flatnonzero((abs(vert[:, :2]) == grid[-1]).any(1) | (vert[:, 2] == -grid[-1]))
    top = faces_on(vert, boundary(elem), 2, 0.0)
    return vert, elem, held, top[np.linalg.norm(vert[top].mean(1), axis=1) < touched * radius]


def skin(vert, elem, fixed, outer_face=None, inner_face=None, name="block", core=None):
    """A SkinGeometry; without `outer_face` the whole boundary less `inner_face` can be touched."""
    none, no_face = np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    inner_face = no_face if inner_face is None else inner_face
    if outer_face is None:
        outer_face = boundary(elem)
        if len(inner_face):
            known = {tuple(f) for f in np.sort(inner_face, axis=1)}
            outer_face = np.array([f for f in outer_face if tuple(np.sort(f)) not in known])
    core_vert, core_face = (none, no_face) if core is None else core
    plates, electrodes = (none, no_face, none, no_face), (np.zeros((19, 3)), np.zeros((19, 3)))
    return SkinGeometry(
        name, vert, elem, outer_face, inner_face, fixed, core_vert, core_face, *plates, *electrodes
    )


def place(data, nodes, position):
    """Puts nodes of all worlds at `position` (n, 3) [m]: fixed ones stay there, which is how tests prescribe
    displacements."""
    for array in (data.x, data.x_last):
        array.numpy()[nodes] = np.asarray(position)[:, None]


def four_nodes(name):
    """A shipped skin of four-node tetrahedra: the corners of its own."""
    shipped = load_skin(name)
    elem = shipped.elem[:, :4]
    mesh = TetMesh(shipped.vert[: elem.max() + 1], elem)
    rigid = [
        (getattr(shipped, f"{part}_vert"), getattr(shipped, f"{part}_face"))
        for part in ("core", "nail", "clamp")
    ]
    return assemble(name, mesh, *rigid)
