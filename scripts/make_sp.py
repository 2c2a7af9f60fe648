"""Makes the BioTac SP's skins in biotac_mj/assets/designs/biotac_sp: a dome on a flat backing, over a core
with a facet.

    python scripts/make_sp.py [--check]

Sources of the numbers (millimetres, published frame: x to the fingertip, z out of the nail):
  [table]  places of electrodes and excitation on the core and on the skin (github.com/bsadr/biotac). The core
           is the ellipsoid through its 24 places beside the facet, within 0.01 mm; the facet is the plane
           through E21 to E24, at 14 degrees to the axis; the outer skin is the ellipsoid through all 28
           places on the skin, within 0.1 mm.
  [axes]   the skin's thickness, which is not published: what lies between the semi axes of the unfilled skin
           (14.03, 9.74, 9.74) and of the core (12.437, 8.153, 8.153) of the finite-element model there
           (`biotac.m`), since an unfilled skin lies on its core. It explains the rest counts of three sensors
           as well as any thickness (`--check` prints it for each) and that model's presses
           (`benchmarks/comsol_sp.py`).
  [chosen] the backing's.
"""

import argparse
import dataclasses
import pathlib

import numpy as np
from make_assets import write_card

from biotac_mj.geometry.design import read_design
from biotac_mj.geometry.edge_nodes import with_edge_nodes
from biotac_mj.geometry.making.assembly import assemble, fixed_nodes
from biotac_mj.geometry.making.pads import dome_core, dome_shell, on_ellipsoid, plate
from biotac_mj.geometry.skin_geometry import SkinGeometry
from biotac_mj.geometry.tet_mesh import TetMesh

ASSETS = pathlib.Path(__file__).parents[1] / "biotac_mj" / "assets" / "designs" / "biotac_sp"
# semi axes along x, z, y of the published frame and height of the centre [mm]
CORE = (np.array([12.32, 7.93, 7.98]), -0.07)  # [table]
SKIN = (np.array([14.07, 9.63, 9.72]), -1.06)  # [table]
FACET = (np.array([-0.2419, -0.9703, 0.0]), 7.809)  # [table], unit normal and distance from the origin
THICKNESS = 1.59  # [axes]
BACKING = 1.0  # thickness of the plate on which the skin is held [chosen]
RINGS = {"coarse": 8, "default": 11, "fine": 18}


def sp_skin(
    name: str, rings: int, outer: tuple = SKIN, thickness: float = THICKNESS, core: tuple = CORE
) -> SkinGeometry:
    """The skin with so many rings of ten-node tetrahedra; ellipsoids as (semi axes, height of the centre),
    lengths in millimetres."""
    design = read_design("biotac_sp")
    inner = outer[0] - thickness, outer[1]
    mesh = dome_shell(outer, inner, rings)
    solid = dome_core(core, 40, FACET)
    angle = 2 * np.pi * (np.arange(64) + 0.5) / 64
    rim = 1.05 * np.take(outer[0], [0, 2]) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    backing = plate(rim, BACKING)
    metres = [(1e-3 * vert, face) for vert, face in (solid, backing)]
    skin = assemble(name, TetMesh(1e-3 * mesh.vert, mesh.elem), *metres, design=design)

    def project(point, side):
        return 1e-3 * on_ellipsoid(1e3 * point, *(outer if side == "outer" else inner))

    skin = with_edge_nodes(skin, project)
    return dataclasses.replace(skin, fixed=np.union1d(skin.fixed, fixed_nodes(skin.vert, metres)))


def correlations():
    """Prints how ln Z of the film at rest goes with that of the three sensors, for several thicknesses."""
    from biotac_mj.sensor.channels import log_impedance
    from biotac_mj.sensor.film import FilmConduction
    from biotac_mj.sensor.presets import sensors_of

    known = sensors_of(read_design("biotac_sp"))
    goal = np.array([log_impedance(sensor.rest) for sensor in known.values()])
    scatter = np.corrcoef(goal)
    print("between the sensors:", scatter[np.triu_indices(len(goal), 1)].round(2))
    for thickness in (0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.5, 1.59, 1.7):
        film = FilmConduction(sp_skin("try", RINGS["default"], thickness=thickness), sensor=None)
        log_z = np.log(film.rest / 1e4)
        own = [np.corrcoef(row, log_z)[0, 1] for row in (*goal, goal.mean(0))]
        apart = goal.mean(0) - log_z
        left = f"RMS {apart.std():.3f}, mean {apart.mean():+.3f}"
        print(f"{thickness:.1f} mm: correlation {np.round(own, 3)}, {left}")


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="print what thicknesses explain, write nothing")
    if parser.parse_args().check:
        correlations()
        return
    for name, rings in RINGS.items():
        skin = sp_skin(f"biotac_sp/{name}", rings)
        path = skin.save(ASSETS / f"{name}.npz")
        source = "Its docstring has the source of each number."
        card = write_card(path.with_suffix(".md"), skin, f"{rings} rings; `scripts/make_sp.py`", source)
        print(card.read_text())


if __name__ == "__main__":
    main()
