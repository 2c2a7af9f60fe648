"""Locking of the skin's elements: linear and quadratic tetrahedra on the skins, Cook's membrane and an
inflated thick sphere.

    python benchmarks/locking.py --json out/locking.json [--skins coarse,default,fine]

Skin: the force of a smooth patch load (bell of 1 mm standard deviation on the pad at x = -10 mm, along +y)
that moves the patch by 0.1 mm on the load's average, small strain, for each resolution and element:
"quadratic" is the package's, "gauss" the same integrated at Gauss's points (C3D10), "nodal" linear tetrahedra
with averaged nodal pressure. "reference" is "gauss" on the same body, refined once. Factor and solve seconds
are those of the package's own factor (`skin.supernodal`): the price of a step is a few tens of solves.
Cook's membrane: plane strain slab, corner (48, 60), E 1, load 1, against Taylor-Hood elements of scikit-fem.
Sphere: Lame's closed form."""

import argparse
import dataclasses
import os
import pathlib
import sys
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))  # blocks: small meshes

import numpy as np
import scipy.sparse as sp
from blocks import boundary, box, faces_on, nodal_areas, shell, skin
from records import write_json

from biotac_mj.geometry import load_skin
from biotac_mj.geometry.edge_nodes import EDGES, with_edge_nodes
from biotac_mj.geometry.skin_geometry import PARTS
from biotac_mj.skin import Material
from biotac_mj.skin.contact.faces import face_samples
from biotac_mj.skin.precondition.supernodal import Elimination, SupernodalFactor
from biotac_mj.skin.rubber.law import LAWS
from biotac_mj.skin.rubber.tetrahedra import CONTRACTION, Tetrahedra

__all__ = ["cook_reference", "cook_tip", "main", "patch_force", "sphere_growth"]

MATERIALS = {"paper": (1.55223093e6, 0.31645428), "rubber": (2.8e5, 0.45), "ansys": (2.8e5, 0.4999)}
PATCH_CENTER, PATCH_SIZE, PATCH_MOTION = -10e-3, 1e-3, 1e-4  # [m]
_MEGA = 1e6


def discretise(geometry, element, material, project=None):
    """The geometry with all its nodes, and its stiffness at rest (3 nvert, 3 nvert) [N/m]."""
    if element == "linear":
        formulation = Tetrahedra(geometry.vert, geometry.tets, LAWS[material.law], "cpu")
        return geometry, formulation.rest_stiffness(material.mu, material.lame)
    if element == "nodal":
        return geometry, nodal_pressure(geometry, material)
    geometry = with_edge_nodes(geometry, project) if geometry.element == "linear" else geometry
    points = 1.0 if element == "gauss" else CONTRACTION
    formulation = Tetrahedra(geometry.vert, geometry.elem, LAWS[material.law], "cpu", contraction=points)
    return geometry, formulation.rest_stiffness(material.mu, material.lame)


def refined(geometry):
    """The same body, curved edges and held surface and all: each ten-node tetrahedron cut into eight, edge
    nodes where its map has them."""
    barycentric = np.vstack([np.eye(4), np.eye(4)[EDGES].mean(1)])
    middle = barycentric[PARTS][:, EDGES].mean(2)  # (8 parts, 6 edges, 4)
    shape = np.concatenate(
        [middle * (2 * middle - 1), 4 * middle[..., EDGES[:, 0]] * middle[..., EDGES[:, 1]]], axis=2
    )
    fine = with_edge_nodes(dataclasses.replace(geometry, elem=geometry.tets))
    vert = fine.vert.copy()
    vert[fine.elem.reshape(-1, 8, 10)[:, :, 4:]] = np.einsum(
        "pmn,enk->epmk", shape, geometry.vert[geometry.elem]
    )
    return dataclasses.replace(fine, vert=vert)


def nodal_pressure(geometry, material):
    """Stiffness at rest of linear tetrahedra whose dilatation is averaged at the nodes (Bonet and Burton
    1998)."""
    elem = geometry.tets
    formulation = Tetrahedra(geometry.vert, elem, LAWS[material.law], "cpu")
    inverse, volume = formulation.mesh.inverse.numpy()[:, 0], formulation.mesh.volume.numpy()
    gradient = np.concatenate([-inverse.sum(1, keepdims=True), inverse], axis=1)
    size, cells = 3 * geometry.nvert, np.arange(len(elem))
    dof = (3 * elem[:, :, None] + np.arange(3)).ravel()
    growth = sp.csr_matrix(
        ((volume[:, None, None] * gradient).ravel(), (np.repeat(cells, 12), dof)), (len(elem), size)
    )  # of each volume
    share = sp.csr_matrix(
        (np.full(elem.size, 0.25), (elem.ravel(), np.repeat(cells, 4))), (geometry.nvert, len(elem))
    )
    at_nodes = share @ growth
    pressures = material.bulk * at_nodes.T @ sp.diags(1 / (share @ volume)) @ at_nodes
    return (formulation.rest_stiffness(material.mu, -2 / 3 * material.mu) + pressures).tocsc()


def solve(stiffness, load, free, prescribed=None):
    """Displacements (3 nvert,) under nodal loads with the coordinates outside `free` held at `prescribed`, by
    CHOLMOD."""
    from cholespy import CholeskySolverD, MatrixType

    u = np.zeros(len(load)) if prescribed is None else prescribed.copy()
    u[free] = 0
    b = (load - stiffness @ u)[free]
    a = stiffness[free][:, free].tocoo()
    factor = CholeskySolverD(
        a.shape[0], a.row.astype(np.int32), a.col.astype(np.int32), a.data, MatrixType.COO
    )
    x = np.empty_like(b)
    factor.solve(b, x)
    u[free] = x
    return u


def solve_nodes(stiffness, load, vert, free):
    """Displacements (nvert, 3) under nodal loads (nvert, 3), all but the nodes `free` held; seconds of the
    factor and of one solve.

    The factor is rounded: conjugate gradients, which it preconditions, go on until the residual is 1e-9 of
      the load.
    """
    dof = (3 * free[:, None] + np.arange(3)).ravel()
    a, b = stiffness[dof][:, dof], np.zeros_like(load)
    b[free] = load[free]
    times = [time.perf_counter()]
    factor = SupernodalFactor(a, Elimination(a, vert[free]), free)
    times.append(time.perf_counter())
    x, r, p, rz = np.zeros_like(b), b.copy(), None, 1.0
    for k in range(50):
        z = factor.solve(r[:, None])[:, 0]
        if k == 0:
            times.append(time.perf_counter())
        last, rz = rz, (r * z).sum()
        p = z if p is None else z + rz / last * p
        q = (a @ p[free].ravel()).reshape(-1, 3)
        alpha = rz / (p[free] * q).sum()
        x += alpha * p
        r[free] -= alpha * q
        if np.linalg.norm(r) < 1e-9 * np.linalg.norm(b):
            return x, np.diff(times)
    raise RuntimeError(
        f"the residual is still {np.linalg.norm(r) / np.linalg.norm(b):.1e} of the load after 50 iterations"
    )


def patch_force(geometry, element, material):
    """Force of the patch load that moves it by 0.1 mm on the load's average [N]; free coordinates; seconds of
    factor and solve."""
    geometry, stiffness = discretise(geometry, element, material)
    tri = geometry.vert[geometry.outer_face]
    area = np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0])[:, 1] / 2
    sample = face_samples(4)
    point = np.einsum("sk,fkd->fsd", sample, tri)
    square = (point[..., 0] - PATCH_CENTER) ** 2 + point[..., 2] ** 2
    traction = np.exp(-square / (2 * PATCH_SIZE**2)) * (point[..., 1] < 0) * np.maximum(-area, 0)[:, None]
    load = np.zeros((geometry.nvert, 3))
    np.add.at(load[:, 1], geometry.outer_face, traction @ sample)
    load /= load.sum()
    free = np.setdiff1d(np.arange(geometry.nvert), geometry.fixed)
    u, seconds = solve_nodes(stiffness, load, geometry.vert, free)
    return PATCH_MOTION / (load * u).sum(), 3 * len(free), *seconds


def cook_tip(cells, element, nu):
    """Cook's membrane as a plane strain slab of cells x cells x 1: how far the corner (48, 60) moves up under
    a load of 1 and E 1: both a million times that, since E is in Pa."""
    thickness = 48 / cells
    vert, elem = box([np.linspace(0, 1, cells + 1)] * 2 + [[0, thickness]])
    flat = vert[:, 0].copy()
    vert[:, 0], vert[:, 1] = 48 * flat, 44 * flat + vert[:, 1] * (44 - 28 * flat)
    geometry, stiffness = discretise(
        skin(vert, elem, [0], boundary(elem)), element, Material("linear", _MEGA, nu)
    )
    load = np.zeros((geometry.nvert, 3))
    load[:, 1] = _MEGA * nodal_areas(geometry.vert, faces_on(geometry.vert, geometry.outer_face, 0, 48)) / 16
    moves = np.repeat(geometry.vert[:, :1] > 1e-9, 3, axis=1)
    moves[:, 2] = False
    u = solve(stiffness, load.ravel(), np.flatnonzero(moves.ravel()))
    corner = np.linalg.norm(geometry.vert[:, :2] - [48, 60], axis=1) < 1e-9
    return u.reshape(-1, 3)[corner, 1].mean()


def cook_reference(nu, cells=48):
    """The same by Taylor-Hood triangles (quadratic displacement, continuous linear pressure) of scikit-fem,
    which do not lock."""
    import skfem
    from scipy.sparse import bmat
    from skfem.helpers import ddot, div, sym_grad

    mesh = skfem.MeshTri.init_tensor(np.linspace(0, 1, cells + 1), np.linspace(0, 1, cells + 1))
    x, y = mesh.p
    mesh = skfem.MeshTri(np.stack([48 * x, 44 * x + y * (44 - 28 * x)]), mesh.t)
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTriP2()), intorder=4)
    pressure = basis.with_element(skfem.ElementTriP1())
    material = Material("linear", _MEGA, nu)
    a = skfem.BilinearForm(lambda u, v, w: 2 * material.mu * ddot(sym_grad(u), sym_grad(v))).assemble(basis)
    b = skfem.BilinearForm(lambda u, q, w: div(u) * q).assemble(basis, pressure)
    c = skfem.BilinearForm(lambda p, q, w: -p * q / material.lame).assemble(pressure)
    right = skfem.FacetBasis(mesh, basis.elem, facets=mesh.facets_satisfying(lambda x: abs(x[0] - 48) < 1e-9))
    load = skfem.LinearForm(lambda v, w: _MEGA * v[1] / 16).assemble(right)
    held = basis.get_dofs(lambda x: abs(x[0]) < 1e-9).all()
    solution = skfem.solve(
        *skfem.condense(bmat([[a, b.T], [b, c]], "csr"), np.concatenate([load, np.zeros(pressure.N)]), D=held)
    )
    corner = np.flatnonzero(np.linalg.norm(basis.doflocs.T - [48, 60], axis=1) < 1e-9)
    return solution[corner[1]]


def sphere_growth(nu, element, subdivisions, layers, inner=6e-3, outer=10e-3, pressure=1e3, E=1e6):
    """Relative errors of a thick sphere's growth under pressure at its inner and outer radius (Lame;
    Timoshenko and Goodier, 136)."""

    def exact(r):
        return (
            pressure
            * inner**3
            / (E * (outer**3 - inner**3))
            * ((1 - 2 * nu) * r + (1 + nu) * outer**3 / (2 * r**2))
        )

    def onto(point, name):
        return point * (outer if name == "outer" else inner) / np.linalg.norm(point, axis=1, keepdims=True)

    vert, elem, face = shell(outer, inner, subdivisions, layers)
    geometry, stiffness = discretise(
        skin(vert, elem, [0], inner_face=face), element, Material("linear", E, nu), onto
    )
    vert, face = geometry.vert, geometry.inner_face
    edge = vert[face[:, 1:]] - vert[face[:, :1]]
    load = np.zeros_like(vert)
    np.add.at(load, face.ravel(), np.repeat(-pressure * np.cross(edge[:, 0], edge[:, 1]) / 6, 3, axis=0))
    radius = np.linalg.norm(vert, axis=1)
    held = [
        np.linalg.norm(vert - outer * axis, axis=1).argmin() for axis in np.eye(3)
    ]  # they go where they belong: no other force
    prescribed = (vert / radius[:, None] * exact(radius)[:, None]).ravel()
    free = (3 * np.setdiff1d(np.arange(len(vert)), held)[:, None] + np.arange(3)).ravel()
    u = solve(stiffness, load.ravel(), free, prescribed)
    grown = (u.reshape(-1, 3) * vert).sum(1) / radius
    return np.array([grown[abs(radius - r) < 1e-9].mean() / exact(r) - 1 for r in (inner, outer)])


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", default="out/locking.json")
    parser.add_argument(
        "--skins", default="coarse,default,fine", help="which; the reference of fine has 220 000 unknowns"
    )
    options = parser.parse_args(arguments)
    out = {"skin": _skins(options.skins.split(",")), "cook": _cook(), "sphere": _spheres()}
    write_json(options.json, out)
    return 0


def _skins(skins):
    rows = []
    print(
        f"{'material':<10}{'skin':<10}{'element':<11}{'unknowns':>9}{'factor s':>10}"
        f"{'solve ms':>10}{'force N':>10}{'error':>9}"
    )
    for label, (E, nu) in MATERIALS.items():
        for name in skins:
            wanted = None
            for element in ("reference", "linear", "nodal", "gauss", "quadratic"):
                if (name, element) == ("fine", "nodal"):
                    continue
                skin, kind = (
                    (refined(load_skin(name)), "gauss")
                    if element == "reference"
                    else (load_skin(name), element)
                )
                force, unknowns, factor, once = patch_force(skin, kind, Material("neo_hookean", E, nu))
                wanted = wanted or force
                row = dict(
                    material=label,
                    nu=nu,
                    skin=name,
                    element=element,
                    unknowns=unknowns,
                    factor_s=factor,
                    solve_s=once,
                    force=force,
                )
                rows.append(row | {"error": force / wanted - 1})
                cells = (
                    f"{unknowns:>9}{factor:>10.2f}{1e3 * once:>10.1f}{force:>10.5f}{force / wanted - 1:>9.1%}"
                )
                print(f"{label:<10}{name:<10}{element:<11}" + cells, flush=True)
    return rows


def _cook(nu=0.4999):
    rows, wanted = [], cook_reference(nu)
    print(f"\nCook's membrane, plane strain, nu {nu}, corner (48, 60): Taylor-Hood {wanted:.3f}")
    for cells in (4, 8, 16):
        tips = {element: cook_tip(cells, element, nu) for element in ("linear", "quadratic")}
        rows.append(dict(cells=cells, reference=wanted, **tips))
        print(
            f"{cells:>3} cells  "
            + "  ".join(f"{e} {tip:.3f} ({tip / wanted - 1:+.1%})" for e, tip in tips.items()),
            flush=True,
        )
    return rows


def _spheres():
    rows = []
    print(
        "\nThick sphere (radii 6 and 10 mm) under internal pressure, growth against Lame, "
        "at inner and outer radius"
    )
    for nu in (0.3, 0.4999):
        for element, mesh in (
            ("linear", (2, 2)),
            ("linear", (3, 4)),
            ("quadratic", (1, 1)),
            ("quadratic", (2, 2)),
        ):
            errors = sphere_growth(nu, element, *mesh)
            rows.append(dict(nu=nu, element=element, mesh=mesh, errors=errors.tolist()))
            text = f"nu {nu:<7}{element:<10}{20 * 4 ** mesh[0]:>5} facets x {mesh[1]} layers: "
            print(text + "  ".join(f"{e:+.2%}" for e in errors), flush=True)
    return rows


if __name__ == "__main__":
    sys.exit(main())
