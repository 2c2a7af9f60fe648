"""The BioTac SP's skin against an independent finite-element model (COMSOL, github.com/bsadr/biotac).

    python benchmarks/comsol_sp.py --data DIR --json OUT [--skin biotac_sp/coarse] [--core]

DIR has a folder for each press (`001`, ...) with `config.csv` (constants), `forces_*.csv` (a row for each
step: where the contact is [mm], its normal, a pressure [Pa], the force [N]), `sensor_*.csv` (gap under each
electrode [mm]) and `sensor_[xyz]_*.csv` (point of the skin over each).

A skin of the same shape is pressed by a wide plate the same way: its outer surface, filled, is the ellipsoid
through the points of the skin at rest; its thickness is the shipped SP's, and is not in `config.csv`. From
there are the shear modulus (neo-Hookean, Poisson's ratio 0.499; there Mooney-Rivlin), friction and pressure
at rest. As there (one contact pair in its `biotac.m`, plate and skin) the skin does not touch the core.
Nothing is fitted but where contact begins, one number a press: the mean distance of the two curves of travel
over force. --skin presses a shipped skin instead, --core lets it touch its core.

Compared are, at the forces of that model's rows: changes from rest of the gaps under the three electrodes
nearest to the plate (RMS), travel at the last row, and there the force over the area of contact, which is
column 7 of `forces_*.csv` (`pc` of `biotac.m`). The liquid's pressure above rest stands beside it. A gap is
there, and here, what lies between the outer surface and the core along the ray from the frame's origin
through the electrode (`Skin.m`): of rubber and liquid together.
"""

import argparse
import dataclasses
import pathlib
import sys

import numpy as np
import warp as wp
from records import write_json
from scipy.optimize import least_squares

from biotac_mj.geometry import SkinGeometry, load_skin
from biotac_mj.geometry.design import read_design
from biotac_mj.skin import GeomSet, Material, SkinData, SkinModel, SkinOptions, step

sys.path.append(str(pathlib.Path(__file__).parents[1] / "scripts"))
from make_sp import CORE, RINGS, THICKNESS, sp_skin  # noqa: E402

DESIGN = read_design("biotac_sp")
ORIGIN = 1e-3 * DESIGN.in_biotac_frame(np.zeros((1, 3)))[0]  # of the rays
STEP = 0.1e-3  # [m] of the plate
NEAR = 3  # electrodes
POISSON = 0.499


@dataclasses.dataclass
class Case:
    """One press there: place (n, 3) [m] and direction (3,) of the plate's motion in the BioTac frame, area
    (n,) [m2] of contact, force (n,) [N], gap (n, 24) [m] change from rest, point (24, 3) [m] of the skin over
    each electrode at rest."""

    name: str
    constants: dict
    place: np.ndarray
    direction: np.ndarray
    area: np.ndarray
    force: np.ndarray
    gap: np.ndarray
    point: np.ndarray

    @property
    def ray(self) -> np.ndarray:
        """(24, 3) unit vectors from the origin through each electrode."""
        return (self.point - ORIGIN) / np.linalg.norm(self.point - ORIGIN, axis=1, keepdims=True)


def read_case(folder: pathlib.Path) -> Case:
    name = folder.name
    lines = (line.split(",") for line in (folder / "config.csv").read_text().splitlines()[1:])
    constants = {words[0]: float(words[1]) for words in lines}
    rows = _read(folder / f"forces_{name}.csv")[1:]  # the first row is rest
    point = np.stack([_read(folder / f"sensor_{axis}_{name}.csv")[0] for axis in "xyz"], axis=1)
    gap = _read(folder / f"sensor_{name}.csv")
    direction = DESIGN.in_biotac_frame(rows[:, 3:6]).mean(0)
    return Case(
        name, constants, 1e-3 * DESIGN.in_biotac_frame(rows[:, :3]), direction / np.linalg.norm(direction),
        rows[:, 7] / rows[:, 6], rows[:, 7], 1e-3 * (gap[1:] - gap[0]),
        1e-3 * DESIGN.in_biotac_frame(point),
    )  # fmt: skip


def _read(path):
    return np.loadtxt(path, delimiter=",")


def shape_through(point: np.ndarray) -> tuple[np.ndarray, float]:
    """Semi axes (3,) and height of the centre [mm] of the ellipsoid nearest to points (n, 3) [m]."""
    x = 1e3 * point

    def off(guess):
        return np.linalg.norm((x - [0, guess[3], 0]) / guess[:3], axis=1) - 1

    *axes, centre = least_squares(off, [14.0, 10.0, 10.0, 0.0]).x
    return np.array(axes), centre


def skin_like(case: Case, rings: int) -> SkinGeometry:
    """A skin which, filled, has the outer shape of that model's. Its core, which it cannot touch, is drawn in
    to leave room for liquid where that skin lies in its core."""
    inside = CORE[0] - 1.0, CORE[1]
    filled = sp_skin("as there", rings, shape_through(case.point), THICKNESS, inside)
    swelling = Press(filled, case.constants).rest(case) - np.linalg.norm(case.point - ORIGIN, axis=1)
    empty = shape_through(case.point - swelling[:, None] * case.ray)
    return sp_skin("as there", rings, empty, THICKNESS, inside)


class Press:
    """Presses of a skin by a wide plate, for constants of a `config.csv`."""

    def __init__(self, skin: SkinGeometry, constants: dict, core: bool = False):
        shear = 2e6 * (constants["c01"] + constants["c10"])
        rubber = Material("neo_hookean", 2 * shear * (1 + POISSON), POISSON, constants["mu"])
        options = SkinOptions(liquid=True, rest_pressure=constants["p_0"], core_contact=core)
        self.model = SkinModel(skin, rubber, options)
        self._face = self.model.geometry.outer_face

    def rest(self, case: Case) -> np.ndarray:
        """(24,) [m] of the outer surface from the origin along the rays."""
        return self._along(case.ray, SkinData(self.model).vert_xpos[0])

    def __call__(self, case: Case) -> dict:
        """travel (n,) [m] from where the plate touches, force (n,) [N], area (n,) [m2] of contact, liquid
        (n,) [Pa], gap (n, 24) [m] change, until the force of the case's last row."""
        data, way = SkinData(self.model), case.direction
        geoms = GeomSet(["plane"], [(0, 0, 0)], [self.model.material.friction])
        rest = data.vert_xpos[0].copy()
        # the plate's plane is z = 0 of its frame, its outside +z: it looks at the skin along its way
        frame, foot = _frame(way), case.place[0] - way * (way @ case.place[0])
        begin = (rest[np.unique(self._face)] @ way).min()
        gap0, rows, travel = self._along(case.ray, rest), [], -STEP
        while not rows or rows[-1][1] < case.force[-1]:
            travel += STEP
            geoms.set_pose([foot + (begin + travel) * way], [frame])
            step(self.model, data, geoms)
            if not data.converged.all():
                raise RuntimeError(f"press {case.name} found no balance at {1e3 * travel:.2f} mm")
            x = data.vert_xpos[0]
            force, gap = -float(data.wrench[0, 0, :3] @ way), self._along(case.ray, x) - gap0
            area = self._area(x, np.linalg.norm(data.contact_force[0], axis=1) > 0)
            rows.append((travel, force, area, float(data.pressure[0]), gap))
        columns = ("travel", "force", "area", "liquid", "gap")
        return dict(zip(columns, map(np.array, zip(*rows)), strict=True))

    def _along(self, ray, x):
        """(n,) how far from the origin rays (n, 3) meet the outer surface."""
        a, b, c = (x[self._face[:, k]] - ORIGIN for k in range(3))
        normal = np.cross(b - a, c - a)
        # a triangle is met where all three tetrahedra of the ray with its edges have the same sign
        side = np.stack([ray @ np.cross(p, q).T for p, q in ((a, b), (b, c), (c, a))])
        with np.errstate(divide="ignore", invalid="ignore"):
            length = (normal * a).sum(1) / (ray @ normal.T)
        return np.where((side >= -1e-15).all(0), length, 0.0).max(1)

    def _area(self, x, touched):
        corner = x[self._face]
        area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 2
        return float(area @ touched[self._face].mean(1))


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

    # nearest to where the plate is: electrodes whose skin lies furthest against its way
    near = np.argsort(case.point @ case.direction)[:NEAR]
    apart = at("gap", case.force)[:, near] - case.gap[:, near]
    there, here = (case.place - case.place[0]) @ case.direction, at("travel", case.force)
    begin = (here - there).mean()  # where contact begins
    last = case.force[-1]
    pressure = [float(last / area) for area in (case.area[-1], at("area", last))]
    return {
        "name": case.name,
        "gap_rms_mm": 1e3 * float(np.sqrt((apart**2).mean())),
        "travel_error_rel": float((here[-1] - begin - there[-1]) / (there[-1] + begin)),
        "pressure_error_rel": pressure[1] / pressure[0] - 1,
        "nearest": [f"e{k + 1}" for k in near],
        "force_N": float(last),
        "travel_mm": [1e3 * float(there[-1] + begin), 1e3 * float(here[-1])],
        "begin_mm": 1e3 * float(begin),
        "pressure_kPa": [1e-3 * one for one in pressure],
        "liquid_kPa": 1e-3 * float(at("liquid", last)),
        "largest_fall_mm": [1e3 * float(case.gap[-1].min()), 1e3 * float(at("gap", last).min())],
    }


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--data", type=pathlib.Path, required=True, help="folder with a folder for each press"
    )
    parser.add_argument(
        "--json", type=pathlib.Path, default="out/benchmarks/comsol_sp.json", help="where the comparison goes"
    )
    parser.add_argument("--skin", help="shipped skin that is pressed, instead of one of that model's shape")
    parser.add_argument("--core", action="store_true", help="the skin of --skin touches its core")
    given = parser.parse_args(argv)
    if given.core and given.skin is None:
        sys.exit("comsol_sp: that model's skin has no core to touch: give --skin with --core")
    given.json.parent.mkdir(parents=True, exist_ok=True)
    folders = sorted(p.parent for p in given.data.glob("*/config.csv"))
    if not folders:
        sys.exit(f"comsol_sp: {given.data} has no folder with a config.csv: give the folder `comsol`")
    cases = [read_case(folder) for folder in folders]
    skin = load_skin(given.skin) if given.skin else skin_like(cases[0], RINGS["coarse"])
    press, found = Press(skin, cases[0].constants, given.core), []
    for case in cases:
        found.append(compare(case, press))
        one = found[-1]
        print(
            f"{case.name}: to {one['force_N']:.2f} N, gap {one['gap_rms_mm']:.3f} mm RMS under "
            f"{', '.join(one['nearest'])}, travel {one['travel_error_rel']:+.1%}, pressure of contact "
            f"{one['pressure_error_rel']:+.0%}, liquid {one['liquid_kPa']:.1f} kPa",
            flush=True,
        )
    write_json(
        given.json,
        {
            "skin": given.skin or "as there",
            "thickness_mm": THICKNESS,
            "core_contact": given.core,
            "cases": found,
        },
    )


if __name__ == "__main__":
    wp.config.log_level = wp.LOG_WARNING
    main()
