"""Calibrates the scripted controllers' estimators: python -m biotac_mj.tasks.calibrate [--estimators
press,grip] [--episodes 8]

Episodes are made by the controllers themselves, acting on the truth with a random error added, so that touch
is recorded around where it will be used. Their seeds start at 100000, the benchmark's at 0. Recordings are
kept in out/calibration, for each kind of BioTac its own, so that an interrupted run goes on."""

import argparse
import functools
import json
import pathlib

import numpy as np
from tqdm import tqdm

from ..cache import Entry
from ..data.objects import OBJECTS
from ..files import write_npz
from ..geometry.skins import load_skin
from ..reading import read_npz
from . import suite
from .biotac import BioTac
from .scripted import SCRIPTED, make_controller
from .touch import Estimator, fitted_on

__all__ = ["main", "record", "record_explore"]

_SEED = 100000
_CODE = ("geometry", "skin", "sensor", "coupling", "tasks")  # by which recordings are made
_HOLD = 40  # frames that a random error lasts
# standard deviation of the error that is added to the truth, per estimated quantity
_ERRORS = {
    "press": [0.6],
    "follow_edge": [8e-4, 0.12, 0.2],
    "roll_ball": [1.2e-3, 0.6e-3, 0.2],
    "hold": [0.25, 0.15],
    "lift": [0.25, 0.15],
}
# most is to be learnt where the finger first lands: many short episodes
_SECONDS = {"follow_edge": 0.9}
_TIMES = {"follow_edge": 5}


def record(domain: str, task: str, seed: int, biotac: dict | None = None) -> tuple[np.ndarray, np.ndarray]:
    """One episode: touch (n, 20) while something touches, and the hidden values (n, k) with it, one row per
    BioTac and frame."""
    env = _environment(domain, task, json.dumps(biotac))
    env.random_state.seed(seed)
    controller, rng = make_controller(task), np.random.RandomState(seed)
    controller.reset()
    step, touch, hidden = env.reset(), [], []
    while not step.last():
        truth = env.task.hidden(env.physics)
        if controller.frame % _HOLD == 0:
            error = rng.standard_normal(truth.shape[1]) * _ERRORS[task]
        action = controller.act(step.observation, truth + error)
        if np.abs(controller.felt).max() > 0.6:
            touch.append(controller.felt)
            hidden.append(truth)
        step = env.step(action)
    return np.concatenate(touch), np.concatenate(hidden)


@functools.lru_cache(maxsize=1)
def _environment(domain, task, biotac):
    return suite.load(
        domain, task, task_kwargs={"time_limit": _SECONDS.get(task), "biotac": json.loads(biotac)}
    )


def record_explore(seed: int, name: str, biotac: dict | None = None) -> np.ndarray:
    """The presses (100,) of one exploration of an object."""
    env = suite.load("finger", "explore", task_kwargs={"random": seed, "objects": [name], "biotac": biotac})
    controller = make_controller("explore")
    controller.decide = lambda: None
    controller.reset()
    step = env.reset()
    while not step.last() and controller.stage != "done":
        step = env.step(controller.act(step.observation))
    env.close()
    if controller.stage != "done":
        raise ValueError(f"exploring {name} with seed {seed} did not end in time")
    return np.ravel(controller.felt_at)


def _recording(folder, inputs, make):
    """Arrays of a recording, made if it is not there."""
    entry = Entry("recording", inputs, _CODE, folder)
    found = entry.load()
    if found is None:
        made = make()
        found = {f"arr_{i}": a for i, a in enumerate(made if isinstance(made, tuple) else (made,))}
        entry.save(found)
    return list(found.values())


def _discriminant(presses, label, shrink=0.05):
    """Weights (100, 17) and bias (17,) of Fisher's linear discriminant, with the classes' common covariance
    shrunk to its diagonal."""
    mean = np.stack([presses[label == k].mean(0) for k in range(len(OBJECTS))])
    rest = presses - mean[label]
    covariance = rest.T @ rest / len(rest)
    diagonal = np.diag(np.diag(covariance) + 1e-3)
    weight = np.linalg.solve((1 - shrink) * covariance + shrink * diagonal, mean.T)
    return weight, -0.5 * np.einsum("kf,fk->k", mean, weight)


def _explore(folder, kind, episodes, biotac):
    rows = [(k, i) for i in range(episodes) for k in range(len(OBJECTS))]
    presses = np.stack(
        [
            _recording(
                folder,
                [kind, "explore", OBJECTS[k], i],
                lambda k=k, i=i: record_explore(_SEED + 17 * i + k, OBJECTS[k], biotac),
            )[0]
            for k, i in tqdm(rows, desc="explore", disable=None)
        ]
    )
    label, fold = np.array([k for k, _ in rows]), np.array([i for _, i in rows]) % 4
    right = 0
    for left_out in range(4):
        weight, bias = _discriminant(presses[fold != left_out], label[fold != left_out])
        guess = np.argmax(presses[fold == left_out] @ weight + bias, axis=1)
        right += (guess == label[fold == left_out]).sum()
    print(f"explore: {right} of {len(rows)} right in four-fold cross-validation")
    weight, bias = _discriminant(presses, label)
    return {"explore/weight": weight, "explore/bias": bias, "explore/accuracy": right / len(rows)}


def _add(path, found):
    """Adds arrays to a file of others."""
    stored = read_npz(path, "calibration", "remove it: it is made again") if path.exists() else {}
    write_npz(path, **stored | found)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--estimators",
        help="comma-separated: press, follow_edge, roll_ball, explore, grip (of hold and lift); default all",
    )
    parser.add_argument("--episodes", type=int, default=8, help="of each task, and of each object of explore")
    parser.add_argument(
        "--folder", type=pathlib.Path, default=pathlib.Path("out/calibration"), help="of the recordings"
    )
    parser.add_argument(
        "--out",
        type=pathlib.Path,
        default=pathlib.Path(__file__).with_name("calibration.npz"),
        help="file to write",
    )
    parser.add_argument(
        "--skin", default="coarse", help="of the BioTac: coarse, default, fine or a stored skin"
    )
    parser.add_argument("--tier", default="condensed", help="condensed or full")
    parser.add_argument("--material", help="name of a preset")
    options = parser.parse_args(arguments)
    biotac = {"skin": options.skin, "tier": options.tier, "material": options.material}
    config = BioTac(**biotac).handle.config
    kind = json.dumps(fitted_on(config), sort_keys=True)
    skin = load_skin(config.skin)
    domain = {task: domain for domain, task in suite.tasks()}
    groups = {}  # estimator -> the tasks that share it
    for task, controller in SCRIPTED.items():
        groups.setdefault(controller.calibration or task, []).append(task)
    for name in groups if options.estimators is None else options.estimators.split(","):
        if name not in groups:
            raise ValueError(f"no estimator {name!r} to calibrate: choose from {', '.join(groups)}")
        if name == "explore":
            found = _explore(options.folder, [kind, skin], options.episodes, biotac)
        else:
            made = [
                _recording(
                    options.folder,
                    [kind, skin, task, i],
                    lambda i=i, task=task: record(domain[task], task, _SEED + i, biotac),
                )
                for i, task in tqdm(
                    [(i, t) for i in range(options.episodes * _TIMES.get(name, 1)) for t in groups[name]],
                    desc=name,
                    disable=None,
                )
            ]
            touch, hidden = (np.concatenate([m[j] for m in made]) for j in range(2))
            fit = Estimator.fit(touch, hidden, np.repeat(range(len(made)), [len(m[0]) for m in made]))
            print(
                f"{name}: {len(touch)} frames, RMS error on held-out episodes {fit.error}, "
                f"spread {hidden.std(0)}"
            )
            found = {f"{name}/{part}": getattr(fit, part) for part in ("scale", "weight", "error")}
        _add(options.out, found | {f"{name}/fitted_on": np.array(kind)})


if __name__ == "__main__":
    main()
