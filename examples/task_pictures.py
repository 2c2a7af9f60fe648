"""Every task with its scripted controller, which acts on touch alone: prints the score so far and writes a
picture of each.

python examples/task_pictures.py --out docs/gallery [--tasks press,lift] [--seconds 2]
"""

import argparse
import pathlib

import mujoco
import numpy as np

from biotac_mj.tasks import load, make_controller, tasks
from biotac_mj.view import Offscreen, find_gl

VIEWS = {  # where to look: point [m], distance [m], azimuth, elevation [deg]
    "press": ((-0.01, 0, -0.008), 0.075, 60, -18),
    "follow_edge": ((-0.02, 0.02, -0.01), 0.16, 60, -35),
    "roll_ball": ((-0.01, 0, -0.012), 0.075, 60, -15),
    "explore": ((-0.01, 0, -0.01), 0.075, 60, -12),
    "hold": ((0, 0, -0.008), 0.13, 35, -12),
    "lift": ((0, 0, 0.005), 0.16, 35, -14),
}
SEED = {"explore": 23}  # a cube lies there
SECONDS = {"press": 1.0, "follow_edge": 2.5, "roll_ball": 1.2, "explore": 0.7, "hold": 1.4, "lift": 2.4}


def camera(task):
    view, out = VIEWS[task], mujoco.MjvCamera()
    out.lookat[:], out.distance, out.azimuth, out.elevation = view
    return out


def run(domain, task, seconds, seed=0):
    """Acts for some seconds; the environment, and the mean reward."""
    env, rewards = load(domain, task, task_kwargs={"random": seed}), []
    controller = make_controller(task, env)
    step = env.reset()
    controller.reset()
    while env.physics.data.time < seconds and not step.last():
        step = env.step(controller.act(step.observation))
        rewards.append(step.reward)
    return env, float(np.mean(rewards))


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/tasks"))
    parser.add_argument("--tasks", help="comma-separated; default all")
    parser.add_argument(
        "--seconds", type=float, help="how long each acts (default: until there is something to see)"
    )
    options = parser.parse_args(arguments)
    written = {}
    for domain, task in tasks():
        if options.tasks and task not in options.tasks.split(","):
            continue
        env, score = run(domain, task, options.seconds or SECONDS[task], SEED.get(task, 0))
        gl = find_gl()
        if gl is not None:
            from matplotlib.image import imsave

            model, data = env.physics.model.ptr, env.physics.data.ptr
            with Offscreen(model, 640, 480, gl) as screen:
                picture = screen.render(data, camera(task))
            path = options.out / f"task_{task}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            imsave(path, np.ascontiguousarray(picture))
            written[task] = path
        print(
            f"{domain}/{task}: mean reward {score:.2f} in the first {env.physics.data.time:.1f} s", flush=True
        )
        env.close()
    return written


if __name__ == "__main__":
    main()
