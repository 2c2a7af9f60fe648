"""`biotac learn train`: all models on all splits and seeds of a data set; writes predictions, errors and
weights to a folder."""

import contextlib
import dataclasses
import json
import pathlib
import time
from collections.abc import Callable, Iterable

import numpy as np
import torch

from ...data import Split, TactileSet, split_by_interaction, split_by_object
from ...files import write_json, write_npz
from ...reading import read_json
from ...sensor.channels import FULL_SCALE
from ...shards import Task, run_tasks
from ..instants.linear import ridges
from ..predictor import PointsModel
from ..protocol import quartiles
from ..weights import save_forward, save_inverse, save_points_model
from .arrays import check_columns, load_arrays, spread_rows
from .config import LearningConfig
from .features import Pod
from .inverse import PATCH, field_errors, inverse_errors, patch_of_push, train_inverse
from .local import Features, film_with_gains, train_head
from .paper import network_change, network_target, train_latent_projection, train_pointnet

_HEAD, _INVERSE = "local_taught", "pod_inverse_taught"  # names of our models in reports


def train_all(
    path: pathlib.Path | str,
    out: pathlib.Path | str,
    seeds: Iterable[int] = (0, 1, 2, 3, 4),
    splits: Iterable[str] = ("trajectory", "ring_7mm"),
    config: LearningConfig | None = None,
    device: torch.device | str = "cpu",
    paper: bool = True,
    progress: bool = True,
    ray: str | None = None,
) -> None:
    """Trains and predicts for all splits and seeds. Existing results are kept, so an interrupted run
    continues at a split and seed.

    On the CPU each training uses one core: the results do not depend on the number of cores.

    Args:
      path: data set. out: folder.
      seeds: of splits, weights and batches. splits: "trajectory" (72/18/10 % of the interactions), or the
        object (or objects, with +) that is held out for the test.
      config: LearningConfig. device: of torch. paper: False skips what is slow without a GPU: latent
        projection and PointNet++.
      progress: whether to show a bar. ray: address of a Ray cluster, or "local": a task for each split and
        seed, with one core, and one GPU if the device is one. All nodes read the set at its path.
    """
    config = config or LearningConfig()
    out = pathlib.Path(out)
    settings = {
        "set": str(pathlib.Path(path).resolve()),
        "config": dataclasses.asdict(config),
        "paper": paper,
    }
    _refuse_others(out, json.loads(json.dumps(settings)))
    # steps of the heads, the inverse, and the paper's networks
    size = (2 * config.members + 3) * config.steps
    size += (config.mesh_steps + 4 * config.paper_steps) if paper else 0
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
    for split in splits:
        division_of(path, split, 0)  # raises if it cannot be split
    work = _Train(settings, str(device))
    for _ in run_tasks(
        work, tasks, out, "train", "step", ray, gpus=int(str(device) != "cpu"), progress=progress
    ):
        pass


@dataclasses.dataclass
class _Train:
    """Work of `shards.run_tasks`: all models of a split and seed.

    Attributes:
      settings: of the whole training. device: of torch.
    """

    settings: dict
    device: str

    def __call__(self, values, folder, report):
        with _one_thread():
            for split, seed in values:
                if not hasattr(self, "_features"):
                    self._features = self._read(report)
                train_split(self._features, split, seed, folder, self.settings, report)
                yield split, seed

    def _read(self, report):
        begun = time.time()
        given = self.settings
        config = LearningConfig(**given["config"])
        arrays = load_arrays(given["set"], self.device)
        features = Features(arrays, config)
        text = f"{len(arrays.objects)} interactions, {len(arrays.owner)} time steps"
        report(f"{text} read in {time.time() - begun:.0f} s")
        return features


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
    progress: Callable[[int], object] | None = None,
) -> None:
    """Trains one split and seed: writes SPLIT-SEED.npz (predictions on validation and test rows), weights of
    seed 0, and last SPLIT-SEED.json with the settings of the whole training. progress:
    called with 1 at each step."""
    arrays, config = features.arrays, features.config
    path = settings["set"]
    division = division_of(path, split, seed)
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
    pod = (basis, now, features.components(basis, mirrored=True))
    predictions["tare"] = torch.zeros_like(truth)
    predictions["linear"] = timed("linear", lambda: _linear(arrays, now, fit, check, both))
    physics = arrays.simulated[both] - arrays.simulated[arrays.first[both]]
    predictions["physics"] = physics
    predictions["physics_gain"] = film_with_gains(arrays, fit, both)

    more = config.members - 1
    members = [
        timed(name, lambda seed=k: train_head(features, train, validation, config, seed, pod, progress))
        for name, k in [(_HEAD, seed), *((f"{_HEAD} again {k}", 1000 * (k + 1) + seed) for k in range(more))]
    ]
    each = torch.stack([member(both) for member in members])
    predictions[_HEAD], predictions["ensemble"] = each[0], each.mean(0)
    inverse = timed(_INVERSE, lambda: train_inverse(arrays, train, validation, config, pod, seed, progress))
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
    back = {_INVERSE: lambda r: inverse(arrays.log_change(r))}
    patches, served = dict.fromkeys(back, PATCH), {}
    if settings["paper"]:
        points, there = features.at_points
        lp, report["curves"] = timed(
            "latent_projection",
            lambda: train_latent_projection(there, points, train, validation, config, seed, progress),
        )
        net = timed(
            "pointnet", lambda: train_pointnet(there, points, train, validation, config, seed, progress)
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
    if seed == 0:
        about = {"split": split, "seed": seed, "set": arrays.sensor, "nvert": arrays.geometry.nvert}
        weights = out / f"forward-{split}.safetensors"
        save_forward(weights, members, basis, config, arrays.geometry, about | {"model": _HEAD})
        weights = out / f"inverse-{split}.safetensors"
        save_inverse(weights, inverse, arrays.geometry, about | {"model": _INVERSE})
        for name, one in served.items():
            path = out / f"{name}-{split}.safetensors"
            save_points_model(path, one.net, points, config, about | {"patch": patches["latent_inverse"]})
    _write(out, f"{split}-{seed}", arrays, check, both, truth, predictions, report)


def division_of(path: pathlib.Path | str, split: str, seed: int) -> Split:
    """Split of a set in a training, see `train_all`."""
    with TactileSet(path) as data:
        if split == "trajectory":
            return split_by_interaction(data, seed)
        return split_by_object(data, split.split("+"), seed)


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
