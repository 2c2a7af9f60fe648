"""Makes everything in biotac_mj/assets/: the parametric BioTac's skins in three resolutions with a card
each, its rigid parts and the indenters.

    pip install -e ".[mesh]"
    python scripts/make_assets.py [--only coarse default fine rigid indenters] [--keep-tetrahedra]

fTetWild repeats itself only roughly, even on one thread: node counts differ by about 1 % from run to run; the
surfaces and the quality stay the same.
"""

import argparse
import dataclasses
import importlib.metadata
import pathlib

import numpy as np
from indenter_meshes import make_mesh
from meshing import mesh_between, write_obj
from parametric import biotac_bodies, clamp_plate, electrodes, nail_plate

from biotac_mj.files import replacing
from biotac_mj.geometry.card import skin_numbers
from biotac_mj.geometry.edge_nodes import with_edge_nodes
from biotac_mj.geometry.indenters import INDENTERS, indenter
from biotac_mj.geometry.making.assembly import assemble, fixed_nodes
from biotac_mj.geometry.making.importing import read_obj
from biotac_mj.geometry.skin_geometry import SkinGeometry
from biotac_mj.geometry.skins import load_skin
from biotac_mj.geometry.tet_mesh import TetMesh

ASSETS = pathlib.Path(__file__).parents[1] / "biotac_mj" / "assets"

# edge of the ten-node tetrahedra [mm], spacing of the input surfaces [mm], fTetWild's envelope as a share of
# the box's diagonal (32 mm)
RESOLUTIONS = {
    "coarse": {"edge": 3.5, "spacing": 0.5, "epsilon": 8e-3},
    "default": {"edge": 2.4, "spacing": 0.4, "epsilon": 6e-3},
    "fine": {"edge": 1.2, "spacing": 0.5, "epsilon": 3e-3},
}
SIDES = {"outer": "outer", "inner": "cavity"}
CORE = {"edge": 0.6, "spacing": 0.3, "epsilon": 1e-3}


def surface_only(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """The boundary of a mesh with its own numbering: vert (n, 3), face (m, 3)."""
    used, face = np.unique(mesh.boundary, return_inverse=True)
    return mesh.vert[used], face.reshape(-1, 3).astype(np.int32)


def write_card(
    path: pathlib.Path | str,
    skin: SkinGeometry,
    made: str,
    source: str = "The shape is that of `scripts/parametric.py`, which gives the source of each number.",
) -> pathlib.Path:
    """Writes the numbers of `skin` as Markdown (to a temporary name, then renamed); `made` says how it came
    about."""
    n = skin_numbers(skin)
    low, high = n.pop("box")
    gaps = n.pop("gaps")
    unit = {"angle": "deg", "volume": "mm3", "thickness": "mm"}
    rows = []
    for key, value in n.items():
        number = f"{value}" if isinstance(value, int) else f"{value:.3f}"
        rows.append(
            f"| {key} | {number} {next((u for k, u in unit.items() if k in key), '')}".rstrip() + " |"
        )
    rows += [f"| box {axis} | {lo:.3f} .. {hi:.3f} mm |" for axis, lo, hi in zip("xyz", low, high)]
    rows += [
        f"| gap E1..E{skin.design.nelectrode} to the inner skin | {' '.join(f'{g:.2f}' for g in gaps)} mm |"
    ]
    text = "\n".join([
        f"# Skin `{skin.name}`", "", "| | |", "|---|---|", *rows, "",
        f"How it was made: {made}.", source,
        "", "Licence: Apache-2.0, like the rest of the project. No part of another mesh is in it.", "",
    ])  # fmt: skip
    with replacing(path) as temporary:
        temporary.write_text(text)
    return pathlib.Path(path)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only",
        nargs="+",
        choices=[*RESOLUTIONS, "rigid", "indenters"],
        default=[*RESOLUTIONS, "rigid", "indenters"],
    )
    parser.add_argument(
        "--keep-tetrahedra",
        action="store_true",
        help="put the stored skins together again, around new rigid parts",
    )
    args = parser.parse_args()
    only = args.only
    bodies = biotac_bodies()

    if "rigid" in only:
        write_obj(ASSETS / "core.obj", *_metres(surface_only(mesh_between(bodies["core"], None, **CORE))))
        write_obj(ASSETS / "nail.obj", *_metres(nail_plate()))
        write_obj(ASSETS / "clamp.obj", *_metres(clamp_plate()))
    if "indenters" in only:
        for name in INDENTERS:
            write_obj(ASSETS / "indenters" / f"{name}.obj", *make_mesh(indenter(name)))

    rigid = {name: read_obj(ASSETS / f"{name}.obj")[0] for name in ("core", "nail", "clamp")}
    position, normal = electrodes(bodies["core"])
    for name, settings in RESOLUTIONS.items():
        if name not in only:
            continue
        if args.keep_tetrahedra:
            elem = load_skin(name).elem[:, :4]
            mesh = TetMesh(load_skin(name).vert[: elem.max() + 1], elem)
        else:
            mesh = mesh_between(bodies["outer"], bodies["cavity"], **settings)
            mesh = TetMesh(mesh.vert * 1e-3, mesh.elem)
        skin = assemble(name, mesh, **rigid, electrodes=(position * 1e-3, normal))
        skin = with_edge_nodes(skin, lambda point, side: 1e-3 * bodies[SIDES[side]].project(1e3 * point))
        skin = dataclasses.replace(skin, fixed=np.union1d(skin.fixed, fixed_nodes(skin.vert, rigid.values())))
        path = skin.save(ASSETS / "skins" / f"{name}.npz")
        made = (
            f"fTetWild (pytetwild {importlib.metadata.version('pytetwild')}), {settings}, "
            "then `improve` and `with_edge_nodes`; `scripts/make_assets.py`"
        )
        print(write_card(path.with_suffix(".md"), skin, made).read_text())


def _metres(mesh):
    return mesh[0] * 1e-3, mesh[1]


if __name__ == "__main__":
    main()
