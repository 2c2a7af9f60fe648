"""Every finger of every hand that `attach_to_hand` knows pressed by a ball: force, electrodes, a picture.

MENAGERIE_ROOT=DIR python benchmarks/mounts.py --json out/mounts.json --pictures docs/gallery
"""

import argparse
import os
import pathlib

import mujoco
import numpy as np

import biotac_mj
from biotac_mj.geometry import load_skin
from biotac_mj.tasks.hands import HANDS
from biotac_mj.tasks.mounting import side_view
from biotac_mj.view.offscreen import Offscreen, find_gl, frame_bodies, stage

MODELS = {  # in the Menagerie
    "shadow_hand": "shadow_hand/right_hand.xml",
    "allegro_hand": "wonik_allegro/right_hand.xml",
    "leap_hand": "leap_hand/right_hand.xml",
    "robotiq_2f85": "robotiq_2f85/2f85.xml",
    "aero_hand": "tetheria_aero_hand_open/right_hand.xml",
}
RADIUS, DEPTH, PLACE = 3.5e-3, 1e-3, -12e-3  # [m] of the ball, how deep it goes, x of the BioTac frame
STEPS = 25
SIZE = 720, 540  # of a hand's picture [pixel]
EYE = -1.0, -0.8, 0.35  # looks from before a tip onto its pad: neighbours stand beside it


def model_of(hand):
    """Path of a hand's model in one of MENAGERIE_ROOT's folders, None where it is in none."""
    roots = os.environ.get("MENAGERIE_ROOT", ".").split(os.pathsep)
    return next((p for root in roots if (p := pathlib.Path(root) / MODELS[hand]).is_file()), None)


def press(path, hand, **settings):
    """{finger: dict(force (3,) [N] in the BioTac frame, change (19,) [counts], lost steps)}, model, data and
    handles of a hand that is held still, into each of whose pads a ball is pressed."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.option.timestep = 1e-3
    for finger in HANDS[hand]:
        ball = spec.worldbody.add_body(name=f"ball_{finger}", mocap=True, pos=[0, 0, 9])
        ball.add_geom(size=[RADIUS, 0, 0], rgba=[0.85, 0.45, 0.15, 1])
    stage(spec)
    handles = biotac_mj.attach_to_hand(spec, hand, **{"skin": "coarse", "tier": "condensed", **settings})
    model = spec.compile()
    data = mujoco.MjData(model)
    skin = load_skin("coarse")
    outer = skin.vert[np.unique(skin.outer_face)]
    near = outer[np.abs(outer[:, 0] - PLACE) < 2e-3]
    top = np.array([PLACE, near[:, 1].min() - RADIUS, 0.0])  # where the ball touches the pad
    mujoco.mj_forward(model, data)
    rest = {f: h.read(data, "electrodes") for f, h in handles.items()}
    for step in range(STEPS):
        deep = DEPTH * min(1.0, (step + 1) / (0.8 * STEPS))
        for finger, handle in handles.items():
            body, ball = data.body(handle.body), model.body(f"ball_{finger}").mocapid[0]
            data.mocap_pos[ball] = body.xpos + body.xmat.reshape(3, 3) @ (top + [0, deep, 0])
        data.qpos[:], data.qvel[:] = model.qpos0, 0.0  # springs and servos would carry the fingers away
        mujoco.mj_step(model, data)
    found = {
        f: dict(
            force=h.read(data, "contact_force")[:3],
            change=h.read(data, "electrodes") - rest[f],
            lost=int(h.read(data, "status")[1]),
        )
        for f, h in handles.items()
    }
    return found, model, data, handles


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--json", default="out/mounts.json")
    parser.add_argument("--pictures", help="folder of a picture for each hand (default: none)")
    parser.add_argument("--hands", nargs="+", default=list(MODELS), choices=MODELS)
    args = parser.parse_args()
    out, gl = {}, find_gl()
    for hand in args.hands:
        path = model_of(hand)
        if path is None:
            print(f"{hand}: not in MENAGERIE_ROOT")
            continue
        found, model, data, handles = press(path, hand)
        for finger, one in found.items():
            most = np.abs(one["change"]).argsort()[::-1][:3]
            force = np.linalg.norm(one["force"])
            told = ", ".join(f"E{k + 1} {one['change'][k]:+.0f}" for k in most)
            print(f"| `{hand}` | {finger} | {force:.2f} | {told} | {one['lost']} |")
        out[hand] = {f: {k: np.asarray(v).tolist() for k, v in one.items()} for f, one in found.items()}
        if args.pictures and gl:
            import matplotlib.image

            with Offscreen(model, *SIZE, gl) as screen:
                first = data.body(next(iter(handles.values())).body)
                camera = side_view(first.xpos, first.xmat.reshape(3, 3), EYE)
                frame_bodies(model, data, range(model.nbody), camera, SIZE[0] / SIZE[1])
                picture = screen.render(data, camera)
            pathlib.Path(args.pictures).mkdir(parents=True, exist_ok=True)
            matplotlib.image.imsave(pathlib.Path(args.pictures) / f"mount_{hand}.png", picture)
    from records import write_json

    write_json(args.json, out)


if __name__ == "__main__":
    main()
