"""Seven directions of slip of a real BioTac SP, told by a classifier that saw simulated ones alone.

    python benchmarks/sp_slips.py --data DIR --json OUT [--simulated FILE] [--series 24] [--seed 0]
        [--grasps FILE FILE]
    python benchmarks/sp_slips.py --patterns

DIR has a series a file, DIR_OBJECTn.csv.gz: 24 raw counts a row at 100 Hz, 3 s, of a slip n, e, s, w, cw, aw
or of a touch without slip, t (BioTacSP-DoS, Zapata-Impata et al. 2019). They begin in touch.

Simulated series are made by the condensed tier on the coarse skin: a box, or a cylinder along its way,
touches the pad about its middle, is pulled along the skin or turned about its normal before the series
begins, as what slips has been, and after a while moves on, or stays; two in three are led by a hand, which
tilts them and pushes unevenly. Drawn for each: place, shape, tilt, depth and how it changes, friction, way
and speed, when it moves; and for each of several sensors that read all of them: electrodes' gains, rest
counts (`presets.draw_sensor`), noise, drift. --simulated keeps them.

A classifier (linear, on moments about the finger of ln Z in the mean and of its change, and on how much it
moves from window to window) is trained on these and on their mirror images. A sensor's rest is not in the
data: levels are from the median of all its series, and features are standardised in each set by themselves;
neither needs a label. Place and pull of the simulated series, features, classifier and COMPASS were chosen
with the real series of PRACTICE alone; `accuracy` is of the series of all other objects.

--grasps are a second task: tables of grasps by three fingers (object, slipped, 3 x 24 raw counts in one
moment before the lift; slipped: whether it fell). A classifier that saw single moments of simulated series,
of objects that stay or slip, judges each finger; their log odds are added. Changes are from a finger's median
over a table, as no rest is there. Beside it: real grasps of other objects, of the other table, and real ones
that judge simulated moments.
"""

import argparse
import json
import pathlib
import re
import sys

import mujoco
import numpy as np
import tqdm
from records import write_json

import biotac_mj
from biotac_mj.files import replacing
from biotac_mj.geometry import load_skin
from biotac_mj.geometry.design import read_design
from biotac_mj.recordings import load_one
from biotac_mj.sensor.channels import counts_from_log_impedance, log_impedance
from biotac_mj.sensor.presets import draw_sensor, sensors_of

SKIN = "biotac_sp/coarse"
MOTIONS = ("tip", "base", "left", "right", "turn", "turn_back", "stay")  # of the object; left is -z, to E1
# compass of the data -> motion: as before somebody whose finger points away, palm up
COMPASS = {"n": "tip", "s": "base", "e": "right", "w": "left", "cw": "turn_back", "aw": "turn", "t": "stay"}
PRACTICE = ("bottle", "brush", "cardboard", "case", "plate", "striped")  # objects that choices were made with
DT, ROWS = 0.06, 50  # of a simulated series of 3 s
PRESS = 8  # steps in which the object comes
BEFORE = 12  # steps before the series, in which it is pulled along: what slips has been sheared
PLACE = 1.5e-3  # [m] of places of contact about the middle of the pad
TILT = 0.08  # [rad] of the object at first
WINDOWS = 6
SENSORS = 6  # that read each simulated series
ROCK = 0.03  # [rad] by which a hand tilts an object that it leads
DRIFT = 0.006  # of ln Z in 3 s, of electrodes that nothing moves over
REACH = 8.0  # [mm] of moments
BOOTSTRAP = 10_000


def frame_of(normal: np.ndarray) -> np.ndarray:
    """Columns: towards the tip, to -z, out of the skin."""
    tip = np.array([-1.0, 0.0, 0.0]) + normal[0] * normal
    tip /= np.linalg.norm(tip)
    side = np.cross(normal, tip)
    return np.stack([tip, side, normal], axis=1)


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    quat, mat = np.empty(4), np.empty(9)
    mujoco.mju_axisAngle2Quat(quat, axis, angle)
    mujoco.mju_quat2Mat(mat, quat)
    return mat.reshape(3, 3)


class Finger:
    """A BioTac SP that is fixed, and an object that is led."""

    def __init__(self, kind: str, size: list[float], friction: float, **skin: object):
        spec = mujoco.MjSpec()
        spec.option.timestep = DT
        spec.option.gravity = np.zeros(3)
        body = spec.worldbody.add_body(name="object", mocap=True, pos=[0, -0.1, 0])
        shape = mujoco.mjtGeom.mjGEOM_BOX if kind == "box" else mujoco.mjtGeom.mjGEOM_CYLINDER
        body.add_geom(name="object", type=shape, size=size, friction=[friction, 0.005, 1e-4])
        self.handle = biotac_mj.attach(
            spec, body="world", design="biotac_sp", coupling="one-way", geoms=["object"], friction=friction,
            rounding={"object": 1e-3}, readings={"noise": False},
            **{"skin": "coarse", "tier": "condensed"} | skin,
        )  # fmt: skip
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)

    def follow(self, pos: np.ndarray, mat: np.ndarray) -> tuple[np.ndarray, bool]:
        """ln Z (n, 24) along poses, and whether all steps converged."""
        out, quat = [], np.empty(4)
        for p, R in zip(pos, mat):
            mujoco.mju_mat2Quat(quat, R.ravel())
            self.data.mocap_pos[0], self.data.mocap_quat[0] = p, quat
            mujoco.mj_step(self.model, self.data)
            out.append(log_impedance(self.handle.read(self.data, "electrodes")))
        return np.array(out), self.handle.read(self.data, "status")[1] == 0


def simulate(motion: str, rng: np.random.Generator, skin: dict) -> np.ndarray | None:
    """ln Z (ROWS, 24) of one series, None where it could not be solved."""
    i = rng.choice(len(skin["point"]), p=skin["weight"])
    point, frame = skin["point"][i], frame_of(skin["normal"][i])
    frame = rotation(frame[:, 0], rng.normal(0, TILT)) @ rotation(frame[:, 1], rng.normal(0, TILT)) @ frame
    turn, angle = motion.startswith("turn"), rng.normal(0, 0.2)
    heading = {"tip": 0.0, "left": np.pi / 2, "base": np.pi, "right": -np.pi / 2}.get(motion, 0.0) + angle
    way = frame[:, :2] @ [np.cos(heading), np.sin(heading)]
    if motion in ("stay", "turn", "turn_back"):
        way = frame[:, :2] @ rng.normal(size=2)
        way /= np.linalg.norm(way)
    kind, friction = rng.choice(["box", "box", "cylinder"]), rng.uniform(0.4, 1.5)
    across = np.cross(frame[:, 2], way)
    if kind == "box":
        half = np.array([0.03, rng.uniform(2e-3, 0.02), 5e-3])
        size, top, own = half.tolist(), half[2], np.stack([way, across, frame[:, 2]], axis=1)
    else:  # its axis is its frame's z
        radius = np.exp(rng.uniform(np.log(3e-3), np.log(0.03)))
        size, top, own = [radius, 0.03], radius, np.stack([frame[:, 2], across, way], axis=1)
        own[:, 1] = np.cross(own[:, 2], own[:, 0])
    begin, time = rng.uniform(0.0, 1.5), DT * np.arange(1, ROWS + 1)
    share = np.clip((time - begin) / (rng.uniform(0.3, 1.0) * (3 - begin)), 0, 1)
    pulled, share = np.r_[np.linspace(0, 1, BEFORE), np.ones(ROWS)], np.r_[np.zeros(BEFORE), share]
    time = np.r_[np.zeros(BEFORE), time]
    by_hand, stays = rng.random() < 2 / 3, motion == "stay"
    drift = rng.normal(0, (0.04 if stays else 0.15) if by_hand else (0.02 if stays else 0.08)) * share
    rock = rng.normal(0, ROCK if by_hand and not stays else 0.0, 2)
    depth = rng.uniform(0.3e-3, 1.3e-3) * (1 + drift + 0.01 * np.sin(3 * time))
    travel = 0.0 if motion == "stay" else 0.1 * way if turn else rng.uniform(2e-3, 15e-3) * way
    travel = rng.uniform(0, 2e-3) * way if turn else travel
    before = rng.uniform(0, 0.2e-3) if stays else 0.0 if turn else rng.uniform(1e-3, 5e-3)
    twist = rng.uniform(0.05, 0.6) if turn else 0.0
    spin = {"turn": 1.0, "turn_back": -1.0}.get(motion, 0.0) * rng.uniform(0.35, 1.6)
    off = frame[:, :2] @ rng.normal(0, 1e-3, 2)  # of the axis of a turn from the place of contact
    turned = spin * share + np.sign(spin) * twist * pulled
    tilts = [rotation(frame[:, :2] @ rock, np.linalg.norm(rock) * s) for s in share]
    mats = np.array([tilt @ rotation(frame[:, 2], angle) for tilt, angle in zip(tilts, turned)])
    foot = point + off + np.einsum("nij,j->ni", mats, -off)
    path = share[:, None] * travel + pulled[:, None] * before * way
    pos = foot + path + (top - depth)[:, None] * frame[:, 2]
    mat = mats @ own
    come = np.linspace(-2e-4, depth[0], PRESS)
    pos = np.concatenate([foot[:1] + (top - come)[:, None] * frame[:, 2], pos])
    mat = np.concatenate([np.repeat(mat[:1], PRESS, axis=0), mat])
    log_z, solved = Finger(str(kind), size, friction).follow(pos, mat)
    return log_z[PRESS + BEFORE :] if solved or np.isfinite(log_z).all() else None


def drag(motion: str, **skin: object) -> np.ndarray:
    """(24,) change of ln Z when a wide plate that is pressed 0.8 mm into the pad is dragged 3 mm."""
    finger, frame = Finger("box", [0.03, 0.03, 5e-3], 0.8, **skin), frame_of(np.array([0.0, -1.0, 0.0]))
    rest = finger.handle.vert_xpos(finger.model, finger.data)[:, 1].min()
    depth = np.concatenate([np.linspace(-2e-4, 8e-4, PRESS), np.full(10, 8e-4)])
    travel = np.concatenate([np.zeros(PRESS), np.linspace(0, 3e-3, 10)])
    way = frame[:, {"tip": 0, "left": 1}[motion]]
    pos = [0.0, rest, 0.0] + (5e-3 - depth)[:, None] * frame[:, 2] + travel[:, None] * way
    log_z, _ = finger.follow(pos, np.repeat(frame[None], len(pos), axis=0))
    return log_z[-1] - log_z[PRESS - 1]


def print_patterns() -> None:
    """Of plates that are dragged, over tiers and rubbers."""
    soft = {"law": "neo_hookean", "poissons_ratio": 0.499}
    for name, skin in (
        ("condensed", {}), ("full", {"tier": "full"}),
        ("0.9 MPa, 1750 Pa", {"material": soft | {"youngs_modulus": 0.9e6, "rest_pressure": 1750.0}}),
        ("0.3 MPa, 3000 Pa", {"material": soft | {"youngs_modulus": 0.3e6, "rest_pressure": 3000.0}}),
    ):  # fmt: skip
        for motion in ("tip", "left"):
            print(f"{name:18} {motion:5}", *(f"{one:+.2f}" for one in drag(motion, **skin)), flush=True)


def places() -> dict:
    """Where objects touch: points of the outer skin on the pad, their normals and weights."""
    skin = load_skin(SKIN)
    corner = skin.vert[skin.outer_face]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2
    area = np.linalg.norm(normal, axis=1)
    point, normal = corner.mean(1), normal / area[:, None]
    weight = area * (normal[:, 1] < -0.75) * np.exp(-(point[:, 0] ** 2 + point[:, 2] ** 2) / (2 * PLACE**2))
    return {"point": point, "normal": normal, "weight": weight / weight.sum()}


def make(series: int, seed: int, path: pathlib.Path | None) -> tuple[np.ndarray, np.ndarray]:
    """Simulated ln Z (n, ROWS, 24) and motions (n,), from a file where it has as many."""
    kept = {}
    if path is not None and path.is_file():
        kept = dict(np.load(path))
        if len(kept["motion"]) >= series * len(MOTIONS):
            return kept["log_z"], kept["motion"]
    skin, rng = places(), np.random.default_rng(seed)
    log_z, motion = [], []
    for _ in tqdm.trange(series, desc="series of each", disable=None):
        for name in MOTIONS:
            found = simulate(name, rng, skin)
            if found is not None:
                log_z.append(found), motion.append(name)
        if path is not None:
            with replacing(path) as temporary, open(temporary, "wb") as file:
                np.savez_compressed(file, log_z=np.array(log_z, np.float32), motion=np.array(motion))
    return np.array(log_z), np.array(motion)


def mirrored(log_z: np.ndarray, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Series and their motions, and behind them the same in the mirror of the finger's middle plane."""
    swap = {"left": "right", "right": "left", "turn": "turn_back", "turn_back": "turn"}
    other = np.array([swap.get(name, name) for name in motion])
    there = log_z[:, :, read_design("biotac_sp").mirror]
    return np.concatenate([log_z, there]), np.concatenate([motion, other])


def measured(log_z: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Simulated series (n, ROWS, 24) as another sensor reads them."""
    design = read_design("biotac_sp")
    rest = log_impedance(sensors_of(design)[design.sensor].rest)
    sensor = draw_sensor(rng, design)
    gain = np.exp(rng.normal(0, 0.15, design.nelectrode)) * np.exp(rng.normal(0, 0.2))
    counts = counts_from_log_impedance(log_impedance(sensor.rest) + gain * (log_z - rest))
    counts = counts + rng.normal(size=counts.shape) * sensor.electrode_noise(counts)
    walk = DRIFT * np.cumsum(rng.normal(size=log_z.shape), axis=1) / np.sqrt(ROWS)
    return log_impedance(np.rint(counts)) + walk


def features(series: list[np.ndarray] | np.ndarray) -> np.ndarray:
    """Of n series of ln Z (rows, 24) of one sensor, standardised: moments about the finger of their levels
    and of their changes, which no single electrode decides, and how much changes from window to window."""
    window = np.array([[part.mean(0) for part in np.array_split(one, WINDOWS)] for one in series])
    window -= np.median(window.mean(1), axis=0)
    x, y, z = np.array(read_design("biotac_sp").electrodes_mm).T / REACH
    basis = np.stack([np.ones_like(x), x, y, z, x * y, x**2 - y**2], axis=1)
    step = np.abs(np.diff(window, axis=1)).mean((1, 2))
    found = [window.mean(1) @ basis, (window[:, -1] - window[:, 0]) @ basis, np.log(step + 1e-3)[:, None]]
    found = np.concatenate(found, axis=1)
    return (found - found.mean(0)) / found.std(0)


def read_series(folder: pathlib.Path) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """ln Z (n, 24) of each file, its direction and its object."""
    series, direction, thing = [], [], []
    for path in sorted(folder.glob("*.csv*")):
        named = re.fullmatch(r"([a-z]+)_([a-z]+)\d+\.csv(\.gz)?", path.name)
        if named is None or named[1] not in COMPASS:
            sys.exit(f"sp_slips: {path.name} is no DIR_OBJECTn.csv, DIR one of {', '.join(COMPASS)}")
        series.append(log_impedance(load_one(path)[0].electrodes))
        direction.append(named[1]), thing.append(named[2])
    if len(set(thing) - set(PRACTICE)) == 0 or len(set(thing)) < 2:
        sys.exit(
            f"sp_slips: {folder} has {len(series)} series of {len(set(thing))} objects: give a folder with "
            f"series of two objects or more, not all of {', '.join(PRACTICE)}"
        )
    return series, np.array(direction), np.array(thing)


def classifier():
    from sklearn.linear_model import LogisticRegression

    return LogisticRegression(C=0.03, max_iter=5000)


def interval(right: np.ndarray, rng: np.random.Generator) -> list[float]:
    """95 % of the share of right answers, by bootstrap over series."""
    draws = rng.choice(right, (BOOTSTRAP, len(right))).mean(1)
    return np.quantile(draws, [0.025, 0.975]).tolist()


def read_grasps(path: pathlib.Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """ln Z (n, 3, 24) less each finger's median, whether it slipped (n,), the object (n,)."""
    table = np.genfromtxt(path, delimiter=",", dtype=str, skip_header=1)
    log_z = log_impedance(table[:, 2:].astype(float)).reshape(len(table), 3, -1)
    return log_z - np.median(log_z, axis=0), table[:, 1] == "1", table[:, 0]


def moment_features(change: np.ndarray) -> np.ndarray:
    """Of changes of ln Z in one moment (..., 24): moments about the finger, and how large they are."""
    size = np.sqrt((change**2).mean(-1, keepdims=True)) + 0.01
    x, y, z = np.array(read_design("biotac_sp").electrodes_mm).T / REACH
    basis = np.stack([np.ones_like(x), x, np.abs(y), z, x**2 - y**2], axis=1) / len(x)
    return np.concatenate([change / size @ basis, np.log(size)], axis=-1)


def judge_grasps(paths: list, log_z: np.ndarray, motion: np.ndarray, rng: np.random.Generator) -> dict:
    """Stable grasps told from those that slip; log_z (n, ROWS, 24), motion (n,): simulated series, as several
    sensors read them."""
    from sklearn.metrics import roc_auc_score
    from sklearn.model_selection import LeaveOneGroupOut, cross_val_predict

    tables = {path.name: read_grasps(path) for path in paths}
    row = ROWS * 2 // 3
    here = log_z[:, row] - np.median(log_z[:, row], axis=0)
    moving = motion != "stay"
    F = moment_features(here)
    simulated = grasp_classifier().fit(F, moving)

    def odds(model, change):
        return model.decision_function(moment_features(change).reshape(-1, F.shape[1])).reshape(-1, 3).sum(1)

    def whole(change):
        return moment_features(change).reshape(len(change), -1)

    out = {}
    for name, (change, slipped, thing) in tables.items():
        said = odds(simulated, change)
        own = cross_val_predict(
            grasp_classifier(), whole(change), slipped, cv=LeaveOneGroupOut(), groups=thing,
            method="decision_function",
        )  # fmt: skip
        of_finger = grasp_classifier().fit(
            moment_features(change).reshape(-1, F.shape[1]), np.repeat(slipped, 3)
        )
        out[name] = {
            "grasps": len(slipped),
            "objects": len(np.unique(thing)),
            "slipped": float(slipped.mean()),
        }
        for key, score in (("simulated", said), ("real_other_objects", own)):
            right = (score > 0) == slipped
            of_object = np.array([right[thing == one].mean() for one in np.unique(thing)])
            out[name][key] = {
                "accuracy": float(right.mean()),
                "interval": interval(of_object, rng),
                "auc": float(roc_auc_score(slipped, score)),
            }
        for other, (there, fell, _) in tables.items():
            if other != name:
                score = grasp_classifier().fit(whole(there), fell).decision_function(whole(change))
                auc = roc_auc_score(slipped, score)
                out[name][f"real_of_{other}"] = {
                    "accuracy": float(((score > 0) == slipped).mean()),
                    "auc": auc,
                }
        out[name]["real_to_simulated_auc"] = float(roc_auc_score(moving, of_finger.decision_function(F)))
    return out


def grasp_classifier():
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    return make_pipeline(StandardScaler(), LogisticRegression(C=0.1, class_weight="balanced", max_iter=5000))


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=pathlib.Path, help="folder of real series")
    parser.add_argument("--json", type=pathlib.Path, help="where the result goes")
    parser.add_argument("--simulated", type=pathlib.Path, help=".npz that keeps the simulated series")
    parser.add_argument("--series", type=int, default=24, help="simulated series of each motion")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--grasps", type=pathlib.Path, nargs="*", default=[], help="tables of grasps")
    parser.add_argument("--patterns", action="store_true", help="what dragged plates change, and no more")
    given = parser.parse_args(argv)
    if given.patterns:
        print_patterns()
        return
    if given.data is None or given.json is None:
        parser.error("give --data and --json, or --patterns")
    from sklearn.model_selection import GroupKFold, LeaveOneGroupOut, cross_val_predict

    real, direction, thing = read_series(given.data)
    log_z, motion = make(given.series, given.seed, given.simulated)
    rng = np.random.default_rng([given.seed, 1])
    both, named = mirrored(log_z, motion)
    read = [measured(both, rng) for _ in range(SENSORS)]
    X, y, F = np.concatenate([features(one) for one in read]), np.tile(named, SENSORS), features(real)
    done = np.array([COMPASS[name] for name in direction])
    said = classifier().fit(X, y).predict(F)
    own = cross_val_predict(classifier(), F, done, cv=LeaveOneGroupOut(), groups=thing)
    groups = np.tile(np.arange(len(motion)), 2 * SENSORS)
    within = cross_val_predict(classifier(), X, y, cv=GroupKFold(5), groups=groups)
    judged = ~np.isin(thing, PRACTICE)

    def right(hit):
        return {"accuracy": float(hit.mean()), "interval": interval(hit, rng), "series": len(hit)}

    found = {
        **right((said == done)[judged]),
        "trained_on": f"{len(motion)} simulated series and their mirror images, {SENSORS} sensors each",
        "chance": 1 / len(MOTIONS),
        "practice": right((said == done)[~judged]) if not judged.all() else None,
        "all_series": right(said == done),
        "trained_on_real_other_objects": right((own == done)[judged]),
        "real_to_simulated": float((classifier().fit(F, done).predict(X) == y).mean()),
        "within_simulation": float((within == y).mean()),
        "labels": MOTIONS,
        "confusion": [[int(((done == a) & (said == b))[judged].sum()) for b in MOTIONS] for a in MOTIONS],
        "by_object": {str(o): float((said == done)[thing == o].mean()) for o in np.unique(thing)},
    }
    if given.grasps:
        found["grasps"] = judge_grasps(given.grasps, np.concatenate(read), y, rng)
    write_json(given.json, found)
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
