"""Files that pages take a reader to have, made in the folder where the blocks of a page run."""

import meshio
import numpy as np
from good_input import make_mesh
from meshing import write_obj
from recorded import synthetic, write_bag, write_btd, write_csv, write_mat

from biotac_mj.geometry import load_skin
from biotac_mj.geometry.making.pads import dome_core, dome_shell

SIX = [[0, 0, -6], [2, 0, -5.6], [-2, 0, -5.6], [0, 2, -5.6], [0, -2, -5.6], [3, 3, -4]]  # [mm]
GROUND = [[5, 0, -3], [-5, 0, -3]]


def lay(page, folder):
    """Writes the files of the page of this name into the folder."""
    {"mesh.md": _mesh, "pads.md": _pads, "recordings.md": _logs}.get(page, lambda folder: None)(folder)


def _mesh(folder):
    make_mesh(folder / "FOLDER", load_skin("coarse"))


def _pads(folder):
    for name, places in (("electrodes", SIX), ("excitation", GROUND)):
        np.savetxt(folder / f"{name}.csv", places, "%g", ",", header="x,y,z", comments="")
    shell = dome_shell((np.full(3, 9.0), 0.0), (np.full(3, 7.5), 0.0), 6)
    mesh = meshio.Mesh(1e-3 * shell.vert, [("tetra", shell.elem)])
    meshio.write(folder / "shell.msh", mesh, file_format="gmsh22")
    vert, face = dome_core((np.full(3, 6.0), 0.0), 12)
    write_obj(folder / "core.obj", 1e-3 * vert, face)


def _logs(folder):
    one = synthetic()
    np.savetxt(folder / "electrodes.txt", one.electrodes, "%.0f")
    np.savetxt(folder / "force.txt", one.force, "%.4f")
    write_csv(folder / "run.csv", one)
    write_mat(folder / "hold.mat", one)
    write_btd(folder / "touch.btd.gz", one, packed=True)
    write_bag(folder, one, ros=1).rename(folder / "run.bag")
