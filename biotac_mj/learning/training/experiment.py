"""`biotac train`: every model on every split and seed of a data set; predictions, errors and the weights
worth keeping go to a folder."""

import dataclasses
import json
import pathlib
import time
from collections.abc import Callable, Iterable

import numpy as np
import torch

from ...data import Split, TactileSet, split_by_interaction, split_by_object
from ...fields import refuse_unknown
from ...files import replacing, write_npz
from ...reading import read_json
from ...sensor.channels import FULL_SCALE
from ..instants.force import ridge
from ..weights import save_forward, save_inverse
from .arrays import Arrays, load_arrays
from .config import LearningConfig
from .features import Pod
from .inverse import contact_centre, field_errors, patch_overlap, train_inverse
from .local import Features, train_head
from .paper import train_latent_projection, train_pointnet

__all__ = ["FORWARD", "division_of", "train_all", "train_split"]

# name -> arguments of `local.train_head`; from simple to full, each line adds one thing
FORWARD = {
    "pod_mlp": dict(kind="pod", log=False, teach=False, mirror=False, window=False),
    "pod_log": dict(kind="pod", log=True, teach=False, mirror=True, window=False),
    "pod_taught": dict(kind="pod", log=True, teach=True, mirror=True, window=False),
    "local": dict(kind="local", log=True, teach=False, mirror=False, window=False),
    "local_mirror": dict(kind="local", log=True, teach=False, mirror=True, window=False),
    "local_taught": dict(kind="local", log=True, teach=True, mirror=True, window=False),
    "local_window": dict(kind="local", log=True, teach=True, mirror=True, window=True),
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
) -> None:
    """Trains and predicts for all splits and seeds; what is there already is kept, so an interrupted run goes
    on.

    Args:
      path: data set. out: folder.
      seeds: of divisions, weights and batches. splits: "trajectory" (72/18/10 % of the interactions), or the
        object (or objects, with +) that only the test sees.
      config: LearningConfig. device: of torch. paper: False leaves out what is slow without a GPU: latent
        projection and PointNet++.
      only: names of our models to train; None takes all of FORWARD. limit: interactions to read.
    """
    from tqdm import tqdm

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
    jobs = [(s, k) for s in splits for k in seeds if not (out / f"{s}-{k}.json").exists()]
    if not jobs:
        return
    begun = time.time()
    arrays = load_arrays(path, device, limit)
    for split in splits:
        division_of(path, split, 0, len(arrays.objects))  # refuses what cannot be divided
    features = Features(arrays, config)
    print(
        f"{len(arrays.objects)} interactions, "
        f"{len(arrays.owner)} time steps read in {time.time() - begun:.0f} s"
    )
    with tqdm(jobs, disable=not progress, desc="train") as bar:
        for split, seed in bar:
            bar.set_postfix_str(f"{split}, seed {seed}")
            train_split(
                arrays,
                features,
                path,
                split,
                seed,
                config,
                out,
                names,
                paper,
                settings=settings,
                step=lambda text: bar.set_postfix_str(text),
            )


def _refuse_others(out, settings):
    """Refuses a folder that holds results of other settings (ValueError)."""
    for path in sorted(out.glob("*-*.json")):
        found = read_json(path, "result of `biotac train`", f"remove it, or choose another folder than {out}")
        found = found.get("settings", {})
        differ = [name for name, value in settings.items() if not found or found.get(name) != value]
        if differ:
            raise ValueError(
                f"{path} is of other settings ({', '.join(differ)}): "
                "choose another --out, or remove that folder"
            )


def train_split(
    arrays: Arrays,
    features: Features,
    path: pathlib.Path | str,
    split: str,
    seed: int,
    config: LearningConfig,
    out: pathlib.Path,
    names: list[str],
    paper: bool = True,
    settings: dict | None = None,
    step: Callable[[str], object] | None = None,
) -> None:
    """One split and seed: writes SPLIT-SEED.npz (predictions on validation and test rows), weights of seed 0,
    and last SPLIT-SEED.json, which keeps the settings of the whole training."""
    division = division_of(path, split, seed, len(arrays.objects))
    train, validation, test = division.train, division.validation, division.test
    rows, check = arrays.rows(test, labelled=True), arrays.rows(validation, labelled=True)
    fit = arrays.rows(train, labelled=True)
    both = torch.cat([check, rows])
    truth = arrays.change(both)
    predictions, seconds, device = {}, {}, arrays.device

    def timed(name, work):
        begun = time.time()
        if step:
            step(f"{split}, seed {seed}: {name}")
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
    predictions["physics_gain"] = _physics_gain(arrays, fit, both)

    models = {}
    for name in names:
        models[name] = timed(
            name,
            lambda name=name: train_head(
                features, train, validation, config, seed=seed, pod=pod, **FORWARD[name]
            ),
        )
        predictions[name] = models[name](both)
    if names:
        # what the validation interactions like best, several times over. Windows stay out: interactions of a
        # second do not teach what a long hold is, and a simulation may hold for as long as it likes
        steady = [name for name in names if not FORWARD[name]["window"]] or names
        errors = {
            name: _median(predictions[name][: len(check)], truth[: len(check)], arrays.owner[check])
            for name in steady
        }
        best = min(errors, key=errors.get)
        more = [
            timed(
                f"{best} again {k}",
                lambda k=k: train_head(
                    features, train, validation, config, seed=1000 * (k + 1) + seed, pod=pod, **FORWARD[best]
                ),
            )
            for k in range(config.members - 1)
        ]
        members = [models[best], *more]
        predictions["ensemble"] = torch.stack([m(both) for m in members]).mean(0)

    inverses = {
        name: timed(
            name, lambda teach=teach: train_inverse(arrays, train, validation, config, pod, seed, teach)
        )
        for name, teach in (("pod_inverse", False), ("pod_inverse_taught", True))
    }
    best_inverse = min(inverses, key=lambda name: inverses[name].validation)
    report = {
        "split": split,
        "seed": seed,
        "settings": settings or {},
        "config": dataclasses.asdict(config),
        "set": str(path),
        "sensor": arrays.sensor,
        "interactions": len(arrays.objects),
        "labelled": int(arrays.labelled.sum()),
        "test_interactions": len(np.unique(arrays.owner[rows].cpu())),
        "device": str(device) if device.type == "cpu" else torch.cuda.get_device_name(device),
    }
    every = arrays.rows(test)
    codes = {"pod": lambda u: basis.decode(basis(u))}
    back = {name: lambda r, head=head: head(arrays.log_change(r)) for name, head in inverses.items()}
    if paper:
        lp = timed(
            "latent_projection", lambda: train_latent_projection(arrays, train, validation, config, seed)
        )
        unit = 1e-3 / config.mesh_scale
        predictions["latent_projection"] = _in_parts(
            lambda r: config.scale * lp(unit * arrays.field[r].float()), both
        )
        predictions["electrode_vae"] = config.scale * lp.electrode(truth / config.scale)[0].detach()
        net = timed("pointnet", lambda: train_pointnet(arrays, train, validation, config, seed))
        predictions["pointnet"] = _in_parts(
            lambda r: config.scale * net(unit * arrays.field[r].float()), both
        )
        codes["mesh_vae"] = lambda u: lp.mesh.decode(lp.mesh.encode(unit * u)[0]) / unit
        back["latent_inverse"] = lambda r: (lp.inverse(arrays.change(r) / config.scale) / unit, None)
    report["mesh"] = {name: _mesh_errors(arrays, code, every) for name, code in codes.items()}
    report["inverse"] = {name: _inverse_errors(arrays, model, rows) for name, model in back.items()}
    report["seconds"] = seconds
    if names:
        report["ensemble_of"] = best
    if seed == 0:
        kept = {"split": split, "seed": seed, "set": arrays.sensor, "nvert": arrays.geometry.nvert}
        if names:
            save_forward(
                out / f"forward-{split}.safetensors",
                members,
                basis,
                config,
                FORWARD[best],
                arrays.geometry,
                kept | {"model": best},
            )
        save_inverse(
            out / f"inverse-{split}.safetensors",
            inverses[best_inverse],
            arrays.geometry,
            kept | {"model": best_inverse},
        )
    _write(out, f"{split}-{seed}", arrays, check, rows, both, truth, predictions, report)


def division_of(path: pathlib.Path | str, split: str, seed: int, count: int) -> Split:
    """How a set was divided in a training: see `train_all`; count: interactions that were read."""
    with TactileSet(path) as data:
        whole = (
            split_by_interaction(data, seed)
            if split == "trajectory"
            else split_by_object(data, split.split("+"), seed)
        )
    return Split(*(part[part < count] for part in (whole.train, whole.validation, whole.test))).check()


def _linear(arrays, now, fit, check, both):
    """Ridge from components to tared counts; its strength is chosen on the validation rows."""
    x, y = now[fit].double().cpu().numpy(), arrays.change(fit).double().cpu().numpy()
    xc, yc = now[check].double().cpu().numpy(), arrays.change(check).double().cpu().numpy()
    fits = [ridge(x, y, s) for s in (1e-3, 1e-2, 1e-1, 1.0, 10.0)]
    w, b = min(fits, key=lambda f: ((xc @ f[0] + f[1] - yc) ** 2).mean())
    return torch.as_tensor(
        now[both].double().cpu().numpy() @ w + b, dtype=torch.float32, device=arrays.device
    )


def _physics_gain(arrays, fit, both):
    """The simulation's own d ln Z, times one gain for each electrode."""
    from ...sensor.channels import log_impedance
    from .local import counts_change

    z = torch.as_tensor(
        log_impedance(arrays.simulated.cpu().numpy()), dtype=torch.float32, device=arrays.device
    )
    z = z - z[arrays.first]
    y = arrays.log_change(fit)
    gain = (z[fit] * y).sum(0) / z[fit].square().sum(0).clamp(min=1e-9)
    return counts_change(gain * z[both], arrays.tare[both])


@torch.no_grad()
def _in_parts(work, rows):
    return torch.cat([work(r) for r in rows.split(512)])


def _median(got, truth, owner):
    rms = (got - truth).square().mean(1).sqrt()
    return float(np.median([float(rms[owner == k].mean()) for k in torch.unique(owner)]))


@torch.no_grad()
def _mesh_errors(arrays, code, rows, most=3000):
    """Mean node error of the code on test rows by object [mm]."""
    rows = rows[arrays.time[rows] > 0]
    if len(rows) > most:
        rows = rows[torch.linspace(0, len(rows) - 1, most, device=rows.device).long()]
    parts = [field_errors(code(arrays.field[r].float()), arrays.field[r].float()) for r in rows.split(256)]
    errors = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
    owner = arrays.objects[arrays.owner[rows].cpu().numpy()]
    table = {str(o): {k: float(v[owner == o].mean()) for k, v in errors.items()} for o in np.unique(owner)}
    return {"all": {k: float(v.mean()) for k, v in errors.items()}, "objects": table}


@torch.no_grad()
def _inverse_errors(arrays, model, rows):
    """Errors of the field [mm], of the patch's centre [mm] and its overlap, where at least 0.1 N touch."""
    place = arrays.geometry.vert[arrays.outer]
    fields, centres, overlaps, touching = [], [], [], []
    for r in rows.split(512):
        field, force = model(r)
        fields.append(field_errors(field, arrays.field[r].float()))
        truth = arrays.force[r].float().cpu().numpy()
        touching.append(truth.sum(1) > 0.1)
        if force is None:
            force = torch.zeros_like(arrays.force[r].float())
        force = force.cpu().numpy()
        centres.append(np.linalg.norm(contact_centre(force, place) - contact_centre(truth, place), axis=1))
        overlaps.append(patch_overlap(force, truth))
    out = {k: float(np.mean(np.concatenate([f[k] for f in fields]))) for k in fields[0]}
    touching, centres, overlaps = (np.concatenate(x) for x in (touching, centres, overlaps))
    known = touching & np.isfinite(centres)
    if known.any():
        q25, q50, q75 = np.percentile(1e3 * centres[known], [25, 50, 75])
        out |= {
            "centre_median": float(q50),
            "centre_quartiles": [float(q25), float(q75)],
            "overlap_mean": float(overlaps[known].mean()),
        }
    return out


def _write(out, name, arrays, check, rows, both, truth, predictions, report):
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
    # no reading lies outside 0..4095, whatever a model says
    content |= {
        f"predicted_{k}": torch.minimum(torch.maximum(v, -tare), FULL_SCALE - tare).half()
        for k, v in predictions.items()
    }
    content = {k: v.detach().cpu().numpy() if torch.is_tensor(v) else v for k, v in content.items()}
    write_npz(out / f"{name}.npz", **content)
    with replacing(out / f"{name}.json") as temporary:
        pathlib.Path(temporary).write_text(json.dumps(report, indent=1))
