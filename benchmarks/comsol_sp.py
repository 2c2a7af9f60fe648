"""The BioTac SP's skin against an independent finite-element model (COMSOL, github.com/bsadr/biotac).

    python benchmarks/comsol_sp.py --data DIR --json OUT [--room MM]

DIR has a folder for each press (`001`, ...) with `config.csv` (constants), `forces_*.csv` (a row for each
step: where the contact is [mm], its normal, a pressure [Pa], the force [N]), `sensor_*.csv` (gap under each
electrode [mm]) and `sensor_[xyz]_*.csv` (point of the skin over each).

Here the shipped skin is pressed by a wide plate the same way, with what `config.csv` states: the shear
modulus (neo-Hookean, Poisson's ratio 0.49; there Mooney-Rivlin), friction and pressure at rest. Its 1.5 mm
are not of that model, which has a thin shell (0.2 mm in its `biotac.m`, not in `config.csv`). Nothing is
fitted but where contact begins, one number a press: the mean distance of the two curves of travel over force.

Compared are, at the forces of that model's rows: changes from rest of the gaps under the three electrodes
nearest to the plate (RMS), travel at the last row, and there the liquid's pressure above rest with the
pressure of `forces_*.csv`. That one is the force over the area of contact (`pc` of `biotac.m`), which the
liquid of a thin shell alone carries; this skin's rubber carries most of it.

There the gaps reach to the surface that the plate touches, 1.5 to 2.25 mm; here 1.5 mm of rubber lie between,
and the skin comes to lie on the core. --room draws the core in, so that there is as much room as there, and
tells what the rest is.
"""

import argparse
import dataclasses
import pathlib
import sys

import numpy as np
import warp as wp
from records import write_json
from scipy.spatial import cKDTree

from biotac_mj.geometry import SkinGeometry, load_skin
from biotac_mj.geometry.design import read_design
from biotac_mj.sensor.core_surface import CoreSurface
from biotac_mj.skin import GeomSet, Material, SkinData, SkinModel, SkinOptions, step

STEP = 0.1e-3  # [m] of the plate
NEAR = 3  # electrodes
LOOSE = 0.5e-3  # [m] from the core at rest: skin that may come to lie on it
POISSON = 0.49


@dataclasses.dataclass
class Case:
    """One press there: place (n, 3) [m] and normal (n, 3) of the plate in the BioTac frame, pressure (n,)
    [Pa], force (n,) [N], gap (n, 24) [m] change from rest, point (24, 3) [m] of the skin over each electrode
    at rest."""

    name: str
    constants: dict
    place: np.ndarray
    normal: np.ndarray
    pressure: np.ndarray
    force: np.ndarray
    gap: np.ndarray
    point: np.ndarray


def read_case(folder: pathlib.Path) -> Case:
    design, name = read_design("biotac_sp"), folder.name
    lines = (line.split(",") for line in (folder / "config.csv").read_text().splitlines()[1:])
    constants = {words[0]: float(words[1]) for words in lines}
    rows = _read(folder / f"forces_{name}.csv")[1:]  # the first row is rest
    point = np.stack([_read(folder / f"sensor_{axis}_{name}.csv")[0] for axis in "xyz"], axis=1)
    gap = _read(folder / f"sensor_{name}.csv")
    place, normal = (design.in_biotac_frame(rows[:, k : k + 3]) for k in (0, 3))
    return Case(
        name, constants, 1e-3 * place, normal, rows[:, 6], rows[:, 7], 1e-3 * (gap[1:] - gap[0]),
        1e-3 * design.in_biotac_frame(point),
    )  # fmt: skip


def _read(path):
    return np.loadtxt(path, delimiter=",")


class Press:
    """Presses of the shipped skin by a wide plate, for constants of a `config.csv`."""

    def __init__(self, constants: dict, skin: str, room: float = 0.0):
        shear = 2e6 * (constants["c01"] + constants["c10"])
        rubber = Material("neo_hookean", 2 * shear * (1 + POISSON), POISSON, constants["mu"])
        self.geometry = drawn_in(load_skin(skin), room)
        options = SkinOptions(liquid=True, rest_pressure=constants["p_0"])
        self.model = SkinModel(self.geometry, rubber, options)
        self._core = CoreSurface(self.geometry.core_vert, self.geometry.core_face)
        self._inner = np.unique(self.geometry.inner_face)
        apart = self._core.closest(self.geometry.vert[self._inner])[0] > LOOSE
        self._free = self._inner[apart & ~np.isin(self._inner, self.geometry.fixed)]

    def __call__(self, case: Case) -> dict:
        """travel (n,) [m] from where the plate touches, force (n,) [N], pressure (n,) [Pa], gap (n, 24) [m]
        change, room (n,) [m] that the skin has left where it is nearest to the core, until the force of the
        case's last row."""
        data = SkinData(self.model)
        geoms = GeomSet(["plane"], [(0, 0, 0)], [self.model.material.friction])
        way = case.normal.mean(0) / np.linalg.norm(case.normal.mean(0))
        rest = data.vert_xpos[0].copy()
        follow = self._inner[cKDTree(rest[self._inner]).query(self._over(rest), k=3)[1]]
        # the plate's plane is z = 0 of its frame, its outside +z: it looks at the skin along `way`
        frame = _frame(way)
        foot = case.place[0] - way * (way @ case.place[0])
        begin = (rest[np.unique(self.geometry.outer_face)] @ way).min()
        gap0, rows, travel = self._gap(rest, follow), [], -STEP
        while not rows or rows[-1][1] < case.force[-1]:
            travel += STEP
            geoms.set_pose([foot + (begin + travel) * way], [frame])
            step(self.model, data, geoms)
            if not data.converged.all():
                raise RuntimeError(f"press {case.name} found no balance at {1e3 * travel:.2f} mm")
            x = data.vert_xpos[0]
            gap = self._gap(x, follow) - gap0
            force = -float(data.wrench[0, 0, :3] @ way)
            rows.append((travel, force, float(data.pressure[0]), gap, self._room(x)))
        columns = ("travel", "force", "pressure", "gap", "room")
        return dict(zip(columns, map(np.array, zip(*rows)), strict=True))

    def _over(self, rest):
        """(24, 3) points of the inner skin on the electrodes' normals."""
        g, face = self.geometry, rest[self.geometry.inner_face].mean(1)
        off = face[None] - g.electrode_pos[:, None]
        along = np.einsum("efk,ek->ef", off, g.electrode_normal)
        beside = np.linalg.norm(off - along[..., None] * g.electrode_normal[:, None], axis=2)
        return face[np.where(along > 0, beside, np.inf).argmin(1)]

    def _room(self, x):
        return self._core.closest(x[self._free])[0].min()

    def _gap(self, x, follow):
        return self._core.closest(x[follow].mean(1))[0]


def drawn_in(skin: SkinGeometry, by: float) -> SkinGeometry:
    """A skin whose core and electrodes lie further in [m]."""
    if not by:
        return skin
    normal, corner = np.zeros_like(skin.core_vert), skin.core_vert[skin.core_face]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    np.add.at(normal, skin.core_face, across[:, None])
    normal[skin.core_vert[:, 1] > -1e-4] = 0  # its back stays on the backing
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    core = skin.core_vert - by * normal / np.maximum(length, 1e-30)
    _, place, face = CoreSurface(core, skin.core_face).closest(
        skin.electrode_pos - by * skin.electrode_normal
    )
    return dataclasses.replace(
        skin,
        core_vert=core,
        electrode_pos=place,
        electrode_normal=CoreSurface(core, skin.core_face).normal[face],
    )


def _frame(z):
    x = np.cross([0.0, 0.0, 1.0], z)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def compare(case: Case, press: Press) -> dict:
    ours = press(case)

    def at(name, force):
        if ours[name].ndim == 1:
            return np.interp(force, ours["force"], ours[name])
        return np.stack([np.interp(force, ours["force"], column) for column in ours[name].T], axis=-1)

    way = case.normal.mean(0) / np.linalg.norm(case.normal.mean(0))
    # nearest to where the plate is: electrodes whose skin lies furthest against its way
    near = np.argsort(case.point @ way)[:NEAR]
    apart = at("gap", case.force)[:, near] - case.gap[:, near]
    there, here = (case.place - case.place[0]) @ way, at("travel", case.force)
    begin = (here - there).mean()  # where contact begins
    pressure = float(at("pressure", case.force[-1]))
    return {
        "name": case.name,
        "gap_rms_mm": 1e3 * float(np.sqrt((apart**2).mean())),
        "travel_error_rel": float((here[-1] - begin - there[-1]) / (there[-1] + begin)),
        "pressure_error_rel": pressure / float(case.pressure[-1]) - 1,
        "nearest": [f"e{k + 1}" for k in near],
        "force_N": float(case.force[-1]),
        "travel_mm": [1e3 * float(there[-1] + begin), 1e3 * float(here[-1])],
        "pressure_kPa": [1e-3 * float(case.pressure[-1]), 1e-3 * pressure],
        "room_left_mm": 1e3 * float(at("room", case.force[-1])),
        "largest_fall_mm": [1e3 * float(case.gap[-1].min()), 1e3 * float(at("gap", case.force[-1]).min())],
    }


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--data", type=pathlib.Path, required=True, help="folder with a folder for each press"
    )
    parser.add_argument(
        "--json", type=pathlib.Path, default="out/benchmarks/comsol_sp.json", help="where the comparison goes"
    )
    parser.add_argument("--skin", default="biotac_sp/coarse", help="skin that is pressed")
    parser.add_argument("--room", type=float, default=0.0, help="[mm] by which the core is drawn in")
    given = parser.parse_args(argv)
    given.json.parent.mkdir(parents=True, exist_ok=True)
    folders = sorted(p.parent for p in given.data.glob("*/config.csv"))
    if not folders:
        sys.exit(f"comsol_sp: {given.data} has no folder with a config.csv: give the folder `comsol`")
    cases = [read_case(folder) for folder in folders]
    press, found = Press(cases[0].constants, given.skin, 1e-3 * given.room), []
    for case in cases:
        found.append(compare(case, press))
        one = found[-1]
        print(
            f"{case.name}: to {one['force_N']:.2f} N, gap {one['gap_rms_mm']:.3f} mm RMS under "
            f"{', '.join(one['nearest'])}, travel {one['travel_error_rel']:+.1%}, pressure "
            f"{one['pressure_error_rel']:+.0%}, {one['room_left_mm']:.2f} mm left over the core",
            flush=True,
        )
    write_json(given.json, {"skin": given.skin, "room_mm": given.room, "cases": found})


if __name__ == "__main__":
    wp.config.log_level = wp.LOG_WARNING
    main()
