"""`biotac learn train`: all models on all splits and seeds of a data set; writes predictions, errors and
weights to a folder."""

import contextlib
import dataclasses
import hashlib
import json
import pathlib
import shutil
import time
from collections.abc import Iterable

import numpy as np
import torch

from ...data import Split, TactileSet, split_by_interaction, split_by_object
from ...fields import refuse_unknown
from ...files import write_json, write_npz
from ...reading import read_json
from ...sensor.channels import FULL_SCALE
from ...shards import Task, run_tasks
from ..instants.linear import ridges
from ..predictor import PointsModel
from ..protocol import interaction_errors, quartiles
from ..weights import save_forward, save_inverse, save_points_model
from .arrays import check_columns, load_arrays, spread_rows
from .config import LearningConfig, without_obsolete
from .features import Pod
from .fitting import Checkpoints
from .inverse import PATCH, field_errors, inverse_errors, patch_of_push, train_inverse
from .local import Features, film_with_gains, train_head
from .paper import network_change, network_target, train_latent_projection, train_pointnet

__all__ = ["FORWARD", "division_of", "train_all", "train_split"]

# name -> arguments of `local.train_head`, an ablation: each line adds one thing; local_mirror adds mirrored
# touches to local_taught
FORWARD = {
    "pod_mlp": dict(kind="pod", log=False, teach=False, mirror=False, window=False),
    "pod_log": dict(kind="pod", log=True, teach=False, mirror=False, window=False),
    "pod_taught": dict(kind="pod", log=True, teach=True, mirror=False, window=False),
    "local": dict(kind="local", log=True, teach=False, mirror=False, window=False),
    "local_mirror": dict(kind="local", log=True, teach=False, mirror=True, window=False),
    "local_taught": dict(kind="local", log=True, teach=True, mirror=False, window=False),
    "local_window": dict(kind="local", log=True, teach=True, mirror=False, window=True),
}


def train_all(
    path: pathlib.Path | str,
    out: pathlib.Path | str,
    seeds: Iterable[int] = (0, 1, 2, 3, 4),
    splits: Iterable[str] = ("trajectory", "ring_7mm"),
    config: LearningConfig | None = None,
    device: torch.device | str = "cpu",
    paper: bool = True,
    only: Iterable[str] | None = None,
    limit: int | None = None,
    progress: bool = True,
    ray: str | None = None,
) -> None:
    """Trains and predicts for all splits and seeds. Existing results are kept, so an interrupted run
    continues, also within a network's training (on Ray: at a split and seed).

    On the CPU each training uses one core: the results do not depend on the number of cores.

    Args:
      path: data set. out: folder.
      seeds: of splits, weights and batches. splits: "trajectory" (72/18/10 % of the interactions), or the
        object (or objects, with +) that is held out for the test.
      config: LearningConfig. device: of torch. paper: False skips what is slow without a GPU: latent
        projection and PointNet++.
      only: names of our models to train; None: all of FORWARD. limit: number of interactions to read.
      progress: whether to show a bar. ray: address of a Ray cluster, or "local": a task for each split and
        seed, with one core, and one GPU if the device is one. All nodes read the set at its path.
    """
    config = config or LearningConfig()
    out = pathlib.Path(out)
    names = list(FORWARD) if only is None else list(only)
    refuse_unknown(names, FORWARD, "the list of models")
    settings = {
        "set": str(pathlib.Path(path).resolve()),
        "config": dataclasses.asdict(config),
        "models": names,
        "paper": paper,
        "limit": limit,
    }
    _refuse_others(out, json.loads(json.dumps(settings)))
    size = _steps_of(config, names, paper)
    tasks = [
        Task((split, seed), size, f"{split}-{seed}.json")
        for split in splits
        for seed in seeds
        if not (out / f"{split}-{seed}.json").exists()
    ]
    if not tasks:
        return
    with TactileSet(path) as data:
        check_columns(data)
        count = min(len(data), limit or len(data))
    for split in splits:
        division_of(path, split, 0, count)  # raises if it cannot be split
    # time the steps for the estimate
    timed_steps = size * len(tasks) if progress and ray is None and str(device) == "cpu" else 0
    work = _Train(settings, str(device), size, timed_steps)
    for _ in run_tasks(
        work, tasks, out, "train", "step", ray, gpus=int(str(device) != "cpu"), progress=progress
    ):
        pass


def _steps_of(config, names, paper):
    """Most steps of all networks of a split and seed."""
    head = {
        name: config.steps * (2 if kind["teach"] and kind["log"] else 1) for name, kind in FORWARD.items()
    }
    ours = [head[name] for name in names]
    again = (config.members - 1) * max(ours, default=0)
    papers = config.mesh_steps + 4 * config.paper_steps
    return sum(ours) + again + (1 + 3) * config.steps + (papers if paper else 0)


@dataclasses.dataclass
class _Train:
    """Work of `shards.run_tasks`: all models of a split and seed; size: their steps.

    Attributes:
      settings: of the whole training. device: of torch. timed_steps: steps to time for an estimate, 0: none.
    """

    settings: dict
    device: str
    size: int
    timed_steps: int

    def __call__(self, values, folder, say):
        with _one_thread():
            for split, seed in values:
                if not hasattr(self, "_features"):
                    self._features = self._read(say)
                given = self.settings
                name = hashlib.sha256(json.dumps([given, self.device, split, seed]).encode()).hexdigest()[:16]
                checkpoints = Checkpoints(folder / f"unfinished-{name}", say)
                train_split(self._features, split, seed, folder, given, checkpoints)
                say(self.size - checkpoints.steps)  # if a network with fewer steps was the best
                shutil.rmtree(checkpoints.folder, ignore_errors=True)
                yield split, seed

    def _read(self, say):
        begun = time.time()
        given = self.settings
        config = LearningConfig(**given["config"])
        arrays = load_arrays(given["set"], self.device, given["limit"])
        features = Features(arrays, config)
        text = f"{len(arrays.objects)} interactions, {len(arrays.owner)} time steps"
        say(f"{text} read in {time.time() - begun:.0f} s")
        if self.timed_steps:
            minutes = self.timed_steps * _step_time(features, given["models"], given["paper"]) / 60
            say(f"about {max(1, round(minutes))} minutes on one core; stopped, it goes on where it was")
        return features


def _step_time(features, names, paper, steps=4):
    """[s] per step, mean over all networks, from a short training. Components are zero, since their values do
    not affect the time."""
    arrays, config = features.arrays, features.config
    labelled = np.flatnonzero(arrays.labelled)
    rows = arrays.rows(labelled)
    basis = Pod.fit(arrays.field, rows[: 4 * config.pod], min(config.pod, len(rows)))
    flat = torch.zeros(len(arrays.owner), len(basis.scale))
    pod = (basis, flat, flat if config.mirror else None)
    papers = {
        name: max(1, getattr(config, name) * steps // config.steps) for name in ("paper_steps", "mesh_steps")
    }
    short = dataclasses.replace(config, steps=steps, **papers)
    parts = labelled, labelled[:8], short
    for checkpoints in (Checkpoints(), Checkpoints()):  # the first calls are slow
        for name in names:
            train_head(features, *parts, pod=pod, checkpoints=checkpoints, **FORWARD[name])
        for teach in (False, True):
            train_inverse(arrays, *parts, pod, 0, teach, checkpoints)
    if paper:
        points, there = features.at_points
        train_latent_projection(there, points, *parts, checkpoints=checkpoints)
        train_pointnet(there, points, *parts, checkpoints=checkpoints)
    return checkpoints.seconds / checkpoints.steps


@contextlib.contextmanager
def _one_thread():
    """Limits the CPU to one thread: the last bits of sums depend on the number of threads, and these small
    networks hardly gain by more."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _refuse_others(out, settings):
    """Raises ValueError if a folder holds results of other settings."""
    for path in sorted(out.glob("*-*.json")):
        found = read_json(
            path, "result of `biotac learn train`", f"remove it, or choose another folder than {out}"
        )
        found = found.get("settings", {})
        if "config" in found:
            found = found | {"config": without_obsolete(found["config"])}
        differ = [name for name, value in settings.items() if not found or found.get(name) != value]
        if differ:
            raise ValueError(
                f"{path} is of other settings ({', '.join(differ)}): "
                "choose another --out, or remove that folder"
            )


def train_split(
    features: Features,
    split: str,
    seed: int,
    out: pathlib.Path,
    settings: dict,
    checkpoints: Checkpoints | None = None,
) -> None:
    """Trains one split and seed: writes SPLIT-SEED.npz (predictions on validation and test rows), weights of
    seed 0, and last SPLIT-SEED.json with the settings of the whole training. checkpoints: of all networks."""
    arrays, config = features.arrays, features.config
    path, names, checkpoints = settings["set"], settings["models"], checkpoints or Checkpoints()
    division = division_of(path, split, seed, len(arrays.objects))
    train, validation, test = division.train, division.validation, division.test
    rows, check = arrays.rows(test, labelled=True), arrays.rows(validation, labelled=True)
    fit = arrays.rows(train, labelled=True)
    both = torch.cat([check, rows])
    truth = arrays.change(both)
    predictions, seconds, device = {}, {}, arrays.device

    def timed(name, work):
        begun = time.time()
        result = work()
        if device.type == "cuda":
            torch.cuda.synchronize()
        seconds[name] = round(time.time() - begun, 2)
        return result

    basis = timed("pod", lambda: Pod.fit(arrays.field, arrays.rows(train), config.pod, seed=seed))
    now = features.components(basis)
    pod = (basis, now, features.components(basis, True) if config.mirror else None)
    predictions["tare"] = torch.zeros_like(truth)
    predictions["linear"] = timed("linear", lambda: _linear(arrays, now, fit, check, both))
    physics = arrays.simulated[both] - arrays.simulated[arrays.first[both]]
    predictions["physics"] = physics
    predictions["physics_gain"] = film_with_gains(arrays, fit, both)

    def head(label, name, seed):
        work = lambda: train_head(  # noqa: E731
            features, train, validation, config, seed=seed, pod=pod, checkpoints=checkpoints, **FORWARD[name]
        )
        return timed(label, work)

    models = {}
    for name in names:
        models[name] = head(name, name, seed)
        predictions[name] = models[name](both)
    if names:
        # ensemble of the best model on validation. Windows are excluded: interactions of a second do not
        # represent long holds, which occur in simulations
        steady = [name for name in names if not FORWARD[name]["window"]] or names
        errors = {
            name: _median(predictions[name][: len(check)], truth[: len(check)], arrays.owner[check])
            for name in steady
        }
        best = min(errors, key=errors.get)
        more = [head(f"{best} again {k}", best, 1000 * (k + 1) + seed) for k in range(config.members - 1)]
        members = [models[best], *more]
        predictions["ensemble"] = torch.stack([m(both) for m in members]).mean(0)

    inverses = {
        name: timed(
            name,
            lambda teach=teach: train_inverse(
                arrays, train, validation, config, pod, seed, teach, checkpoints
            ),
        )
        for name, teach in (("pod_inverse", False), ("pod_inverse_taught", True))
    }
    best_inverse = min(inverses, key=lambda name: inverses[name].validation)
    report = {
        "split": split,
        "seed": seed,
        "settings": settings,
        "config": dataclasses.asdict(config),
        "set": path,
        "sensor": arrays.sensor,
        "interactions": len(arrays.objects),
        "labelled": int(arrays.labelled.sum()),
        "test_interactions": len(np.unique(arrays.owner[rows].cpu())),
        "device": str(device) if device.type == "cpu" else torch.cuda.get_device_name(device),
    }
    every = arrays.rows(test)
    codes = {"pod": lambda u: basis.decode(basis(u))}
    back = {name: lambda r, head=head: head(arrays.log_change(r)) for name, head in inverses.items()}
    patches, served = dict.fromkeys(back, PATCH), {}
    if settings["paper"]:
        points, there = features.at_points
        lp, report["curves"] = timed(
            "latent_projection",
            lambda: train_latent_projection(there, points, train, validation, config, seed, checkpoints),
        )
        net = timed(
            "pointnet", lambda: train_pointnet(there, points, train, validation, config, seed, checkpoints)
        )
        served = {
            name: PointsModel(one, points, arrays.geometry, config, {}).to(device).eval()
            for name, one in (("latent_projection", lp), ("pointnet", net))
        }
        for name, one in served.items():
            predictions[name] = _in_batches(lambda r, one=one: one.change(arrays, r), both)
        signal = network_target(arrays, both, config)
        through = lp.electrode(signal)[0].detach()
        predictions["electrode_vae"] = network_change(through, arrays.tare[both], config)
        codes["mesh_vae"] = served["latent_projection"].through_code
        back["latent_inverse"] = lambda r: served["latent_projection"](network_target(arrays, r, config))
        fit_patch = spread_rows(fit, 2000)
        patches["latent_inverse"] = patch_of_push(
            _in_batches(lambda r: back["latent_inverse"](r)[1], fit_patch).cpu().numpy(),
            arrays.force[fit_patch].float().cpu().numpy(),
        )
    report["mesh"] = {name: _mesh_errors(arrays, code, every) for name, code in codes.items()}
    report["inverse"] = {
        name: _inverse_summary(inverse_errors(arrays, model, rows, patches[name]))
        for name, model in back.items()
    }
    report["seconds"] = seconds
    if names:
        report["ensemble_of"] = best
    if seed == 0:
        about = {"split": split, "seed": seed, "set": arrays.sensor, "nvert": arrays.geometry.nvert}
        forward = {name: ([model], name) for name, model in models.items()}
        if names:
            forward["forward"] = members, best
        for file, (ones, name) in forward.items():
            path = out / f"{file}-{split}.safetensors"
            save_forward(path, ones, basis, config, FORWARD[name], arrays.geometry, about | {"model": name})
        for file, name in [*((name, name) for name in inverses), ("inverse", best_inverse)]:
            path = out / f"{file}-{split}.safetensors"
            save_inverse(path, inverses[name], arrays.geometry, about | {"model": name})
        for name, one in served.items():
            path = out / f"{name}-{split}.safetensors"
            save_points_model(path, one.net, points, config, about | {"patch": patches["latent_inverse"]})
    _write(out, f"{split}-{seed}", arrays, check, both, truth, predictions, report)


def division_of(path: pathlib.Path | str, split: str, seed: int, count: int) -> Split:
    """Split of a set in a training, see `train_all`; count: interactions that were read."""
    with TactileSet(path) as data:
        whole = (
            split_by_interaction(data, seed)
            if split == "trajectory"
            else split_by_object(data, split.split("+"), seed)
        )
    return Split(*(subset[subset < count] for subset in (whole.train, whole.validation, whole.test))).check()


def _linear(arrays, now, fit, check, both):
    """Ridge from components to tared counts; its strength is chosen on the validation rows."""
    x, y = now[fit].double().cpu().numpy(), arrays.change(fit).double().cpu().numpy()
    xc, yc = now[check].double().cpu().numpy(), arrays.change(check).double().cpu().numpy()
    fits = ridges(x, y, (1e-3, 1e-2, 1e-1, 1.0, 10.0))
    w, b = min(fits, key=lambda f: ((xc @ f[0] + f[1] - yc) ** 2).mean())
    return torch.as_tensor(
        now[both].double().cpu().numpy() @ w + b, dtype=torch.float32, device=arrays.device
    )


@torch.no_grad()
def _in_batches(work, rows):
    return torch.cat([work(r) for r in rows.split(512)])


def _median(got, truth, owner):
    got, truth, owner = (x.cpu().numpy() for x in (got, truth, owner))
    return float(np.median(interaction_errors(got, truth, owner)[1]))


@torch.no_grad()
def _mesh_errors(arrays, code, rows):
    """Mean node error of the code on test rows by object [mm]."""
    rows = spread_rows(rows[arrays.time[rows] > 0], 3000)
    parts = [field_errors(code(arrays.field[r].float()), arrays.field[r].float()) for r in rows.split(256)]
    errors = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
    owner = arrays.objects[arrays.owner[rows].cpu().numpy()]
    table = {str(o): {k: float(v[owner == o].mean()) for k, v in errors.items()} for o in np.unique(owner)}
    return {"all": {k: float(v.mean()) for k, v in errors.items()}, "objects": table}


def _inverse_summary(errors):
    """Means of the field's errors [mm], and medians of the patch's centre error [mm] and overlap, from
    `inverse_errors`."""
    out = {k: float(np.mean(errors[k])) for k in ("mean", "moved", "largest")}
    known = np.isfinite(errors["centre"])
    if known.any():
        median, *others = quartiles(errors["centre"][known])
        out |= {
            "centre_median": median,
            "centre_quartiles": others,
            "overlap_mean": float(errors["overlap"][known].mean()),
        }
    return out


def _write(out, name, arrays, check, both, truth, predictions, report):
    owner = arrays.owner[both].cpu().numpy()
    content = {
        "truth": truth,
        "tare": arrays.tare[both],
        "time": arrays.time[both],
        "owner": owner,
        "object": arrays.objects[owner].astype("S32"),
        "test": np.arange(len(both)) >= len(check),
    }
    tare = arrays.tare[both]
    # clip to 0..4095
    content |= {
        f"predicted_{k}": torch.minimum(torch.maximum(v, -tare), FULL_SCALE - tare).half()
        for k, v in predictions.items()
    }
    content = {k: v.detach().cpu().numpy() if torch.is_tensor(v) else v for k, v in content.items()}
    write_npz(out / f"{name}.npz", **content)
    write_json(out / f"{name}.json", report)
