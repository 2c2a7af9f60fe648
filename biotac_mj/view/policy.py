"""Plays a task by touch with a policy: scores, a GIF, MuJoCo's viewer or the page in the browser (`biotac
play TASK`)."""

import inspect
import pathlib
import time as clock
from collections.abc import Callable
from json import dumps

import mujoco
import numpy as np
import torch

from ..files import replacing
from ..geometry import load_skin
from ..sensor.colors import electrode_colors
from ..skin.settings import read_dict
from ..tasks.batched import TASKS
from ..tasks.batched.playing import HELD_OUT, acting, agree, env_of, interval, play
from ..tasks.batched.task import BatchTask
from .maps import Maps
from .offscreen import Offscreen, find_gl

_SIZE = 480, 360  # of a GIF [pixel]
_SHOWN, _LAST = 2.2, 0.6  # duration of the episodes in a GIF, and of the last picture of each [s]


def play_task(
    task: str,
    policy: pathlib.Path | str | None = None,
    episodes: int | None = None,
    json: bool = False,
    render: pathlib.Path | str | None = None,
    window: bool = False,
    port: int | None = None,
    device: str = "cpu",
    seed: int = 0,
    hand: pathlib.Path | str | None = None,
    biotac: dict | None = None,
) -> dict | None:
    """Plays a task of `biotac_mj.tasks.batched` with a policy.

    Args:
      policy: a file; None: the shipped one; "electrodes": that of `roll_rod` without PAC; "script": a script
        that uses the true state; "random".
      episodes: number of episodes to score, in parallel worlds; None: show episodes one after the other.
      json: print scores as JSON. render: GIF of episodes. window: MuJoCo's viewer instead of the page at
        `port` (8080).
      seed: of initial states. hand: for the rod's task.
      biotac: settings of the BioTacs, as `batch.attach` has them, in place of those that the policy learned
        with; its card is not compared then.

    Returns:
      The scores of `episodes`.

    Raises:
      ValueError: the task has no hand, or of episodes, render, window and port several are given.
    """
    if hand and "hand" not in inspect.signature(TASKS[task]).parameters:
        raise ValueError(f"hand is not of {task}: leave it out")
    displays = dict(episodes=episodes, render=render, window=window, port=port)
    given = [name for name, value in displays.items() if value]
    if len(given) > 1:
        raise ValueError(f"{' and '.join(given)} exclude each other: give one of them")
    if json and not episodes:
        raise ValueError("json is of scores: give episodes too, or leave it out")
    _, act, card = acting(task, policy, device)
    biotac = dict(biotac or {})
    if "options" in biotac:
        biotac["options"] = read_dict(biotac["options"], "options")
    own = ({"hand": hand} if hand else {}) | biotac
    env = env_of(card, episodes or 1, device=device, seed=seed, **own)
    if episodes:
        (score,) = play(env, [(slice(None), act)], HELD_OUT + seed)
        score = {"task": task, "policy": str(policy or "shipped")} | score
        score |= {"biotac": biotac, "card": card, "agrees": None if biotac else agree(score, card)}
        print(dumps(score, indent=1) if json else _said(score))
        return score
    if render is not None:
        save_gif(env, act, render)
    elif window:
        show_window(env, act)
    else:
        show_page(env, act, port or 8080)
    return None


def _said(score):
    text = f"{score['task']}, {score['policy']}: success {score['success']:.2f} ({score['low']:.2f} to "
    text += f"{score['high']:.2f}) of {score['episodes']} episodes"
    if score["agrees"] is None:
        return text
    card, n = score["card"], score["episodes"]
    alike = [k / n for k in range(n + 1) if agree(interval(k, n), card)]
    meets = "agrees with" if score["agrees"] else "does NOT agree with"
    text += f"; that {meets} its card: {card['success']:.2f} ({card['low']:.2f} to {card['high']:.2f})"
    return f"{text} of {card['episodes']}, as {min(alike):.2f} to {max(alike):.2f} would in {n} episodes"


class Mirror:
    """The first world of an environment in an MjData of its model, with skins and electrodes' colours."""

    def __init__(self, env: BatchTask):
        self.env, self.model, self.data = env, env.model, mujoco.MjData(env.model)
        self.geometry = load_skin(env.biotac["skin"])
        self.node = np.unique(self.geometry.outer_face)

    def update(self) -> None:
        """Copies the present state of the world."""
        env, model, data = self.env, self.model, self.data
        data.qpos[:] = env.qpos[0].cpu().numpy()
        data.mocap_pos[:] = env.mocap_pos[0].cpu().numpy()
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        data.sensordata[:] = env.sensordata[0].cpu().numpy()
        for finger, batch in env.batches.items():
            prefix = env.prefixes[finger]
            start = model.skin_vertadr[model.skin(f"{prefix}skin").id]
            model.skin_vert[start : start + len(self.node)] = batch.vert_xpos[0][self.node]
            sites = [model.site(f"{prefix}{name}").id for name in self.geometry.design.electrodes]
            model.site_rgba[sites] = electrode_colors(self.change(finger))

    def change(self, finger: str) -> np.ndarray:
        """Counts (nelectrode,) of a finger over those without contact; 0 before these are known."""
        tare = self.env.rest_counts[0, list(self.env.batches).index(finger)].cpu().numpy()
        rest = tare[: len(self.geometry.electrode_pos)]
        counts = self.data.sensor(f"{self.env.prefixes[finger]}electrodes").data
        return counts - rest if rest.any() else np.zeros_like(counts)

    def point(self, camera: mujoco.MjvCamera) -> None:
        """Points a camera at the task."""
        camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = self.env.camera


def _decisions(env, act, mirror):
    """Plays for ever; yields the index of the next decision."""
    env.reset()
    while True:
        mirror.update()
        yield int(env.episode_length_buf[0])
        with torch.no_grad():
            env.step(act(env))


def save_gif(env: BatchTask, act: Callable, path: pathlib.Path | str) -> None:
    """Writes a GIF of `_SHOWN` seconds of episodes of the first world, in real time, with the electrodes of
    each finger."""
    mirror, frames, lasts = Mirror(env), [], []
    maps, each = Maps(env.biotac["skin"]), round(1e3 * env.cfg.substeps * env.cfg.timestep)
    camera = mujoco.MjvCamera()
    mirror.point(camera)
    with Offscreen(env.model, *_SIZE, find_gl()) as screen:
        for number in _decisions(env, act, mirror):
            if frames and number == 0:
                lasts[-1] = round(1e3 * _LAST)
                if sum(lasts) > 1e3 * _SHOWN:
                    break
            changes = {finger: mirror.change(finger) for finger in env.batches}
            frames.append(maps.below(screen.render(mirror.data, camera), changes))
            lasts.append(each)
    few = maps.quantize(frames, 64)
    with replacing(path) as temporary:
        few[0].save(temporary, format="GIF", save_all=True, append_images=few[1:], duration=lasts, loop=0)
    print(f"  wrote {path}: {len(frames)} decisions")


def show_window(env: BatchTask, act: Callable) -> None:
    """MuJoCo's viewer, until it is closed."""
    from mujoco import viewer

    mirror = Mirror(env)
    with viewer.launch_passive(env.model, mirror.data) as window:
        mirror.point(window.cam)
        for _ in _decisions(env, act, mirror):
            if not window.is_running():
                return
            window.sync()


def show_page(env: BatchTask, act: Callable, port: int = 8080, seconds: float = np.inf) -> object:
    """Shows the page in the browser until Ctrl-C, or for `seconds` of the task; returns the page."""
    from .web import Finger, Moment, Page
    from .web_scene import Scene

    mirror = Mirror(env)
    rest = np.zeros(len(mirror.geometry.electrode_pos))  # of changes
    fingers = {f: Finger.of(mirror.geometry, rest) for f in env.batches}
    page = Page(fingers, port=port)
    print(f"  the page is at {page.url} until Ctrl-C", flush=True)
    mirror.point(camera := mujoco.MjvCamera())
    page.point_camera(camera, env.model.vis.global_.fovy)
    scene = Scene(page.server, env.model, [f"{p}core" for p in env.prefixes.values()])
    time, each = 0.0, env.cfg.substeps * env.cfg.timestep
    for _ in _decisions(env, act, mirror):
        begin = clock.perf_counter()
        scene.update(mirror.data)
        moments = {}
        for i, (finger, batch) in enumerate(env.batches.items()):
            prefix, data = env.prefixes[finger], mirror.data
            body = data.body(f"{prefix}core")
            pdc = float(data.sensor(f"{prefix}pdc").data[0])
            tare = float(env.rest_counts[0, i, len(rest)])
            shown = batch.vert_xpos[0][mirror.node], mirror.change(finger), pdc - tare if tare else 0.0
            pose = body.xpos.copy(), body.xquat.copy()
            moments[finger] = Moment(*shown, float(env.force[0, i]), *pose)
        page.update(time, moments)
        time += each
        if time > seconds:
            return page
        clock.sleep(max(0.0, each - (clock.perf_counter() - begin)))
    return page
