"""Makes the filled bodies of the solid configurations (`biotac_mj.calibration.configurations`) with a card
each.

    pip install -e ".[mesh]"
    python scripts/make_solids.py [--edge 1.7] [--only solid_coarse solid_with_core_coarse]

`solid` fills everything inside the outer surface and is held by nail and clamp plate; `solid_with_core` fills
the space between the outer surface and the rigid core and is bonded to the core too. Neither has an inner
surface: there is no liquid and no gap."""

import argparse
import importlib.metadata
import os
import pathlib

import numpy as np
from meshing import mesh_between
from parametric import biotac_bodies, electrodes

from biotac_mj.geometry.making.assembly import fixed_nodes
from biotac_mj.geometry.making.importing import read_obj
from biotac_mj.geometry.skin_geometry import SkinGeometry
from biotac_mj.geometry.tet_mesh import TetMesh

ASSETS = pathlib.Path(__file__).parents[1] / "biotac_mj" / "assets"
# [mm] boundary nodes nearer to the core's surface than this are bonded to it; the outer surface is 1.5 mm
# away
BONDED = 0.05
NAMES = ("solid_coarse", "solid_with_core_coarse")


def make_solid(name: str, settings: dict) -> SkinGeometry:
    """Meshes one filled body; `settings` as in `mesh_between`."""
    bodies = biotac_bodies()
    core = bodies["core"] if "with_core" in name else None
    mesh = mesh_between(bodies["outer"], core, **settings)
    bonded = np.zeros(0, int)
    if core is not None:
        boundary = np.unique(mesh.boundary)
        bonded = boundary[np.abs(core.distance(mesh.vert[boundary])) < BONDED]
    mesh = TetMesh(mesh.vert * 1e-3, mesh.elem).check()
    rigid = {part: read_obj(ASSETS / f"{part}.obj")[0] for part in ("core", "nail", "clamp")}
    held = fixed_nodes(mesh.vert, [rigid["nail"], rigid["clamp"]])
    position, normal = electrodes(bodies["core"])
    parts = {
        f"{part}_{what}": value for part, pair in rigid.items() for what, value in zip(("vert", "face"), pair)
    }
    return SkinGeometry(
        name=name,
        vert=mesh.vert,
        elem=mesh.elem,
        outer_face=mesh.boundary_components()[0],
        inner_face=np.zeros((0, 3), np.int32),
        fixed=np.union1d(held, bonded),
        electrode_pos=position * 1e-3,
        electrode_normal=normal,
        **parts,
    )


def write_card(path: pathlib.Path, skin: SkinGeometry, made: str) -> None:
    """The numbers of a solid as Markdown, to a temporary name, then renamed."""
    mesh = TetMesh(skin.vert, skin.elem)
    lowest = np.degrees(mesh.dihedral_angles.min(axis=1))
    rows = {
        "nodes": skin.nvert,
        "tetrahedra": skin.nelem,
        "outer nodes": len(np.unique(skin.outer_face)),
        "held nodes": len(skin.fixed),
        "minimum dihedral angle": f"{lowest.min():.3f} deg",
        "minimum dihedral angle, 1st percentile over tetrahedra": f"{np.percentile(lowest, 1):.3f} deg",
        "volume": f"{mesh.volumes.sum() * 1e9:.3f} mm3",
    }
    table = "\n".join(f"| {key} | {value} |" for key, value in rows.items())
    text = f"""# Body `{skin.name}`

| | |
|---|---|
{table}

A filled body for the paper's solid configurations, not a skin around a liquid: it has no inner surface.
How it was made: {made}; `scripts/make_solids.py`.
The shape is that of `scripts/parametric.py`, which gives the source of each number.

Licence: Apache-2.0, like the rest of the project. No part of another mesh is in it.
"""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(text)
    os.replace(temporary, path)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=NAMES, default=NAMES)
    parser.add_argument("--edge", type=float, default=1.7, help="wanted edge length [mm]")
    args = parser.parse_args()
    settings = {"edge": args.edge, "spacing": 0.5, "epsilon": 4e-3}
    for name in args.only:
        skin = make_solid(name, settings)
        path = skin.save(ASSETS / "skins" / f"{name}.npz")
        made = (
            f"fTetWild (pytetwild {importlib.metadata.version('pytetwild')}), {settings}, then "
            "`improve` of `scripts/meshing.py`"
        )
        write_card(path.with_suffix(".md"), skin, made)
        print(path.with_suffix(".md").read_text())


if __name__ == "__main__":
    main()
