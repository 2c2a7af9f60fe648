"""A Shadow Hand with five BioTacs closes until each fingertip feels the object, then squeezes and lifts it,
all from `mj_step`.

    python examples/shadow_hand_grasp.py --object ball --video out/grasp_ball.gif --traces out/grasp_ball.png

The hand is MuJoCo Menagerie's: set MENAGERIE_ROOT to the folder that holds shadow_hand/, or pip install
mujoco-menagerie."""

import argparse
import dataclasses
import os
import pathlib

import mujoco
import numpy as np
from scipy.optimize import least_squares

import biotac_mj

FINGERS = ("ff", "mf", "rf", "lf", "th")
NAMES = dict(zip(FINGERS, ("first", "middle", "ring", "little", "thumb")))
OBJECTS = {  # MuJoCo's geom type and sizes [m], mass [kg]
    "ball": ("sphere", (0.036, 0, 0), 0.06),
    "cube": ("box", (0.03, 0.03, 0.03), 0.06),
    "can": ("cylinder", (0.034, 0.03, 0), 0.08),
}
PAD = np.array([-0.010, -0.0082, 0.0])  # middle of the pad in the BioTac frame [m]
STAND = 0.04  # height of the post under the object, so that the thumb fits below its middle [m]
TIMESTEP = 4e-3
CLOSE, SQUEEZE, LIFT, HOLD = 0.6, 0.6, 0.8, 0.3  # [s]
CLEAR = 0.016  # of the middle links' axes from the object [m]: they are 9 to 10 mm thick
HELD = 0.05  # [N] a tip with more holds the object
FELT = 12  # counts of PDC above rest that say: this finger touches
THUMB, FINGER = 200, 18  # counts above rest with which the thumb presses, and that no finger may fall below


def menagerie():
    """Folder of the Menagerie's models.

    Raises:
      FileNotFoundError: there is none; the text says what to do.
    """
    root = os.environ.get("MENAGERIE_ROOT")
    if root is None:
        try:
            import mujoco_menagerie

            root = pathlib.Path(mujoco_menagerie.__file__).parent
        except ImportError:
            root = "mujoco_menagerie"
    if not (pathlib.Path(root) / "shadow_hand" / "right_hand.xml").is_file():
        raise FileNotFoundError(
            f"no shadow_hand/right_hand.xml in {root}: set MENAGERIE_ROOT to a clone of MuJoCo Menagerie"
        )
    return pathlib.Path(root)


def build(name, **settings):
    """The hand, palm down on a lift, over a table with an object: spec and {finger: Handle}."""
    kind, size, mass = OBJECTS[name]
    height = size[1] if kind == "cylinder" else size[0]
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.integrator = TIMESTEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.impratio, spec.option.cone = 10, mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.visual.headlight.ambient[:] = 0.3
    sky = dict(
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        width=64,
        height=384,
    )
    spec.add_texture(name="sky", rgb1=[0.95, 0.97, 1.0], rgb2=[0.6, 0.65, 0.7], **sky)
    world = spec.worldbody
    world.add_light(pos=[0, -0.3, 1], dir=[0.1, 0.3, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    world.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.2, 0.2, 0.01],
        pos=[0, 0, -0.01],
        rgba=[0.75, 0.6, 0.4, 1],
    )
    post = [0.015, STAND / 2, 0]
    world.add_geom(
        name="stand",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=post,
        pos=[0, 0, STAND / 2],
        rgba=[0.5, 0.5, 0.5, 1],
    )
    body = world.add_body(name="object", pos=[0, 0, STAND + height])
    body.add_freejoint(name="object")
    body.add_geom(
        name="object",
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"),
        size=size,
        mass=mass,
        rgba=[0.85, 0.45, 0.15, 1],
        condim=4,
    )
    carriage = world.add_body(name="carriage", gravcomp=1)
    carriage.mass, carriage.inertia, carriage.explicitinertial = 1.0, [0.01] * 3, True
    for axis, direction in (("x", [1, 0, 0]), ("y", [0, 1, 0]), ("z", [0, 0, 1])):
        carriage.add_joint(name=axis, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=direction)
        servo = spec.add_actuator(name=axis, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=axis)
        servo.gainprm[0], servo.biastype = 2e4, mujoco.mjtBias.mjBIAS_AFFINE
        servo.biasprm[:3] = [0, -2e4, -600]
    hand = mujoco.MjSpec.from_file(str(menagerie() / "shadow_hand" / "right_hand.xml"))
    for b in hand.bodies:
        b.gravcomp = 1
    frame = carriage.add_frame(quat=[0, 1, 0, 0])  # palm, which looks up in Menagerie's file, down
    spec.attach(hand, frame=frame, prefix="hand_")
    handles = biotac_mj.attach_to_hand(spec, "shadow_hand", fingers=FINGERS, **settings)
    return spec, handles


@dataclasses.dataclass
class Grasp:
    """Finds joint angles that lay the pads around the object: all fingers on one side, the thumb on the
    other.

    Attributes:
      model, data: of the scene; core: ids of the BioTacs' bodies; joint: ids of the hand's joints that may
        move, wrist and carriage apart.
    """

    model: mujoco.MjModel
    name: str
    handles: dict

    def __post_init__(self):
        m = self.model
        self.data = mujoco.MjData(m)
        self.core = np.array([m.body(h.body).id for h in self.handles.values()])
        # the link before the one that carries the BioTac
        self.link = m.body_parentid[m.body_parentid[self.core]]
        self.joint = np.array(
            [j for j in range(m.njnt) if m.joint(j).name.startswith("hand_") and "WRJ" not in m.joint(j).name]
        )
        self.address = m.jnt_qposadr[self.joint]
        self.names = [m.joint(j).name for j in self.joint]
        # the last two joints of a finger are driven by one tendon
        self.paired = np.array(
            [
                (self.names.index(n[:-1] + "2"), i)
                for i, n in enumerate(self.names)
                if n.endswith("J1") and "TH" not in n
            ]
        )
        self.lift = m.jnt_qposadr[[m.joint(a).id for a in "xyz"]]
        self.kind, self.size, _ = OBJECTS[self.name]
        self.center = np.array([0, 0, STAND + (self.size[1] if self.kind == "cylinder" else self.size[0])])

    def pads(self):
        """Middles (5, 3) and outward directions (5, 3) of the pads in the world."""
        mat = self.data.xmat[self.core].reshape(-1, 3, 3)
        return self.data.xpos[self.core] + mat @ PAD, -mat[:, :, 1]

    def surface(self, point, thumb):
        """Distances (5,) [m] of points from the object's surface and its outward normals (5, 3)."""
        away = point - self.center
        if self.kind == "box":
            normal = np.where(thumb[:, None], [-1.0, 0, 0], [1.0, 0, 0])
            return (away * normal).sum(1) - self.size[0], normal
        if self.kind == "cylinder":
            away = away * [1, 1, 0]
        radius = np.linalg.norm(away, axis=1)
        return radius - self.size[0], away / radius[:, None]

    def _place(self, x):
        self.data.qpos[self.address], self.data.qpos[self.lift] = x[:-3], x[-3:]
        mujoco.mj_kinematics(self.model, self.data)
        return self.pads()

    def solve(self, gap=0.001):
        """Angles (njoint,) and place of the carriage (3,) with all pads `gap` [m] from the surface and facing
        it."""
        low, high = self.model.jnt_range[self.joint].T
        thumb = np.array([f == "th" for f in self.handles])
        preferred = np.clip(self._preferred(), low + 1e-3, high - 1e-3)
        place = np.array([-0.36, 0.0, self.center[2] + 0.08])
        rise = -0.003 if self.kind == "sphere" else 0.004  # of the pads over the object's middle [m]
        side = np.where(thumb, -1.0, 1.0)  # the thumb comes from -x, the fingers from +x

        def residual(x):
            point, out = self._place(x)
            distance, normal = self.surface(point, thumb)
            knuckle = self.data.xpos[self.link] + 0.025 * self.data.xmat[self.link].reshape(-1, 3, 3)[:, :, 2]
            fingers = point[~thumb, 1]
            return np.concatenate(
                [
                    200 * (distance - gap),
                    1.5 * (out + normal).ravel(),
                    100 * np.minimum(side * point[:, 0] - 0.5 * self.size[0], 0),
                    200 * np.minimum(self.surface(knuckle, thumb)[0] - CLEAR, 0),
                    40 * (point[:, 2] - self.center[2] - rise),
                    200 * np.minimum(fingers[:-1] - fingers[1:] - 0.0155, 0),
                    60 * (point[thumb, 1] - fingers.mean()),
                    60 * fingers.mean()[None],
                    60 * point[thumb, 1],
                    0.1 * (x[:-3] - preferred),
                    0.7 * (x[self.paired[:, 0]] - x[self.paired[:, 1]]),
                ]
            )

        return self._least_squares(
            residual, np.append(preferred, place), np.append(low, place - 0.1), np.append(high, place + 0.1)
        )

    def move(self, near, by):
        """The same with every pad moved `by` [m] along the surface's normal, from a solution, whose place is
        kept.

        Inwards the thumb bends its last joint: what it presses against then pushes its other links away from
        the object.
        """
        point, out = self._place(near)
        thumb = np.array([f == "th" for f in self.handles])
        goal = point + by * self.surface(point, thumb)[1]
        held = np.array(["THJ" in n and not n.endswith("THJ1") for n in self.names]) & (by < 0)
        stay, face = (
            np.append(np.where(held, 10.0, 0.3), [0.3] * 3),
            np.where(thumb & (by < 0), 0.0, 1.0)[:, None],
        )

        def residual(x):
            there, facing = self._place(x)
            return np.concatenate(
                [
                    200 * (there - goal).ravel(),
                    (face * (facing - out)).ravel(),
                    stay * (x - near),
                    0.7 * (x[self.paired[:, 0]] - x[self.paired[:, 1]]),
                ]
            )

        low, high = self.model.jnt_range[self.joint].T
        return self._least_squares(
            residual, near, np.append(low, near[-3:] - 1e-5), np.append(high, near[-3:] + 1e-5)
        )

    def _least_squares(self, residual, first, low, high):
        first = np.clip(first, low + 1e-6, high - 1e-6)
        return least_squares(
            residual,
            first,
            bounds=(low, high),
            x_scale=np.append(np.ones(len(first) - 3), [0.1] * 3),
            max_nfev=300,
        ).x

    def _preferred(self):
        bent = {
            "J4": 0.0,
            "J3": 0.9,
            "J2": 0.6,
            "J1": 0.4,
            "J5": 0.0,
            "THJ5": 0.3,
            "THJ4": 1.15,
            "THJ3": 0.0,
            "THJ2": 0.3,
            "THJ1": 0.4,
        }
        names = self.names
        return np.array([bent.get(n[-4:], bent[n[-2:]]) for n in names])


def targets(model, address, angle):
    """ctrl values (nu,) of the hand's position actuators, nan elsewhere, for joint angles at qpos
    addresses."""
    at = dict(zip(address.tolist(), angle))
    out = np.full(model.nu, np.nan)
    for u in range(model.nu):
        kind, target = model.actuator_trntype[u], model.actuator_trnid[u, 0]
        if kind == mujoco.mjtTrn.mjTRN_JOINT:
            out[u] = at.get(int(model.jnt_qposadr[target]), np.nan)
        else:  # the tendon that couples two joints of a finger
            start = model.tendon_adr[target]
            joints = model.wrap_objid[start : start + model.tendon_num[target]]
            out[u] = sum(at[int(model.jnt_qposadr[j])] for j in joints)
    return out


def run(name, height=0.08, tier="condensed", skin="coarse", frame=None, progress=True):
    """Grasps and lifts. `frame(data, handles)` is called every 40 ms.

    Returns:
      dict: time (n,), height of the object (n,) [m], and per finger counts (n, 5, 19), pdc (n, 5), force (n,
        5) [N]; model, data, handles.
    """
    from tqdm import tqdm

    spec, handles = build(name, skin=skin, tier=tier)
    model = spec.compile()
    grasp = Grasp(model, name, handles)
    touch = grasp.solve()
    opened, closed = grasp.move(touch, 0.012), grasp.move(touch, -0.015)
    nj = len(grasp.address)
    data = mujoco.MjData(model)
    data.qpos[grasp.address], data.qpos[grasp.lift] = opened[:nj], touch[nj:]
    data.ctrl[[model.actuator(a).id for a in "xyz"]] = touch[nj:]
    owner = np.array(
        [
            next((i for i, f in enumerate(FINGERS) if f in model.actuator(u).name.lower()), -1)
            for u in range(model.nu)
        ]
    )
    way = np.stack([targets(model, grasp.address, angle[:nj]) for angle in (opened, touch, closed)])
    hand = np.isfinite(way[0]) & (owner >= 0)
    mujoco.mj_forward(model, data)
    rest = np.array([h.read(data, "pdc")[0] for h in handles.values()])
    thumb = np.array([f == "th" for f in FINGERS])
    closing, log = np.zeros(5), {key: [] for key in ("time", "height", "counts", "pdc", "force")}
    z, steps = model.actuator("z").id, round((CLOSE + SQUEEZE + LIFT + HOLD) / TIMESTEP)
    for i in tqdm(range(steps), desc=name, disable=not progress or None):
        pdc = np.array([h.read(data, "pdc")[0] for h in handles.values()])
        if data.time < CLOSE:  # who feels the object waits for the others
            closing += np.where(pdc - rest < FELT, 0.7 * TIMESTEP / CLOSE, 0.0)
        # then the thumb presses the object against the fingers; these stay where they are, and follow where
        # they would lose it
        else:
            wanted = np.where(thumb, THUMB, FINGER)
            closing += TIMESTEP * np.clip(
                2.5 * (wanted - pdc + rest) / wanted, np.where(thumb, -0.5, 0.0), 1.5
            )
            closing = np.minimum(closing, 2.0)
        c = closing[owner]
        data.ctrl[hand] = (
            way[1] + np.where(c < 0.5, (1 - 2 * c) * (way[0] - way[1]), (2 * c - 1) * (way[2] - way[1]))
        )[hand]
        data.ctrl[z] = touch[nj + 2] + height * np.clip((data.time - CLOSE - SQUEEZE) / LIFT, 0, 1)
        mujoco.mj_step(model, data)
        biotac_mj.plugin.check()
        log["time"].append(data.time)
        log["height"].append(float(data.body("object").xpos[2] - grasp.center[2]))
        log["counts"].append([h.read(data, "electrodes") for h in handles.values()])
        log["pdc"].append(pdc - rest)
        log["force"].append([np.linalg.norm(h.read(data, "contact_force")[:3]) for h in handles.values()])
        if frame is not None and i % round(0.04 / TIMESTEP) == 0:
            frame(data, handles)
    return {key: np.array(value) for key, value in log.items()} | {
        "model": model,
        "data": data,
        "handles": handles,
        "closing": closing,
    }


def camera():
    out = mujoco.MjvCamera()
    out.lookat[:], out.distance, out.azimuth, out.elevation = [0.0, 0, 0.15], 0.4, 152, -14
    return out


class Film:
    """Frames of a moving picture: the hand, and under it what the electrodes of each fingertip say."""

    SIZE = 720, 400  # of the render [pixel]

    def __init__(self):
        from biotac_mj.view.maps import Maps

        self.maps, self.frames, self.screen, self.rest = Maps("coarse"), [], None, None

    def __call__(self, data, handles):
        from biotac_mj.view import Offscreen, find_gl

        self.screen = self.screen or Offscreen(data.model, *self.SIZE, find_gl())
        counts = np.array([h.read(data, "electrodes") for h in handles.values()])
        self.rest = counts if self.rest is None else self.rest
        changes = {}
        for (finger, handle), change in zip(handles.items(), counts - self.rest, strict=True):
            force = np.linalg.norm(handle.read(data, "contact_force")[:3])
            changes[f"{NAMES[finger]}  {force:.1f} N"] = change
        self.frames.append(self.maps.below(self.screen.render(data, camera()), changes))

    def write(self, path):
        """An animated GIF whose frames share their colours."""
        path.parent.mkdir(parents=True, exist_ok=True)
        first, *rest = self.maps.quantize(self.frames)
        duration = [40] * len(rest) + [1500]  # the last one stays
        first.save(path, save_all=True, append_images=rest, duration=duration, loop=0, optimize=True)
        self.screen.close()


def draw_traces(result, path, name):
    """Force, PDC and electrodes of each finger over time."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(3, 1, figsize=(8, 7), sharex=True, layout="constrained")
    axes[0].plot(result["time"], 1e3 * result["height"], "k", label="height")
    axes[0].set_ylabel("height of the object [mm]")
    for i, finger in enumerate(FINGERS):
        axes[1].plot(result["time"], result["force"][:, i], label=finger)
        change = np.abs(result["counts"][:, i] - result["counts"][0, i]).max(axis=1)
        axes[2].plot(result["time"], change, label=finger)
    axes[1].set_ylabel("force on the fingertip [N]")
    axes[2].set_ylabel("largest change of\nan electrode [counts]")
    axes[2].set_xlabel("time [s]")
    axes[1].legend(ncol=5, loc="upper left")
    figure.suptitle(f"Shadow Hand with five BioTacs lifts the {name}")
    pathlib.Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--object", default="ball", choices=OBJECTS)
    parser.add_argument("--tier", default="condensed", choices=("condensed", "full"))
    parser.add_argument("--skin", default="coarse")
    parser.add_argument("--video", type=pathlib.Path, help="animated GIF to write")
    parser.add_argument("--traces", type=pathlib.Path, help="PNG to write")
    options = parser.parse_args(arguments)
    import warp

    warp.config.log_level = warp.LOG_WARNING
    film = Film() if options.video else None
    result = run(options.object, tier=options.tier, skin=options.skin, frame=film)
    if film:
        film.write(options.video)
    if options.traces:
        draw_traces(result, options.traces, options.object)
    touching = [f for f, force in zip(FINGERS, result["force"][-1]) if force > HELD]
    all_hold = (result["force"] > HELD).all(axis=1)[result["time"] > CLOSE + SQUEEZE]
    print(
        f"{options.object}: lifted by {1e3 * result['height'][-1]:.0f} mm, held by "
        f"{', '.join(touching) or 'nothing'}; "
        f"all five tips hold it in {100 * all_hold.mean():.0f} % of the lift; forces "
        f"{np.round(result['force'][-1], 2)} N"
    )
    return result


if __name__ == "__main__":
    main()
