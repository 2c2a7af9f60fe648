"""Makes biotac_mj/assets/weights/latent_projection.safetensors, which `signal="latent_projection"` reads, and
its card. Everything is synthetic.

    O="--steps 12 --measured-skin coarse --measured-batch 4"  # small shards: each core makes its own
    biotac data generate $O --count 448 --labelled 448 --skin coarse --out out/sets/coarse
    biotac data generate $O --count 128 --labelled 128 --skin default --seed 10 --out out/sets/default
    O="$O --count 40 --labelled 40 --skin coarse --seed 500"
    biotac data generate $O --measured-seed 1 --out out/sets/other-1
    python scripts/make_weights.py out/sets/coarse out/sets/default --other out/sets/other-* --device cuda

All sets but those of --other are of one synthetic sensor. Their interactions are divided by chance into parts
that train, choose and judge; PointNet++ learns from the same, with the same settings.
"""

import argparse
import dataclasses
import json
import pathlib
import time

import numpy as np
import torch

from biotac_mj.files import replacing
from biotac_mj.geometry import load_skin
from biotac_mj.learning.networks.points import SkinPoints
from biotac_mj.learning.predictor import PointsModel
from biotac_mj.learning.protocol import interaction_errors, paired_test, quartiles
from biotac_mj.learning.training.arrays import join, load_arrays
from biotac_mj.learning.training.config import LearningConfig
from biotac_mj.learning.training.inverse import inverse_errors, patch_of_push
from biotac_mj.learning.training.local import counts_change, film_with_gains
from biotac_mj.learning.training.paper import train_latent_projection, train_pointnet
from biotac_mj.learning.weights import save_points_model

OUT = pathlib.Path(__file__).parents[1] / "biotac_mj" / "assets" / "weights"
# What differs from the paper's: d ln Z, no dropout and a projection that is trained through the decoder, all
# of which are better (docs/lab/learning.md), and half the channels, since 686 points stand for the mesh.
CONFIG = dict(
    mesh_first=64,
    mesh_channels=(64, 64, 128, 64),
    mesh_hidden=256,
    dropout=0.0,
    projection_loss="decoded",
    decay=0.8,
    batch=128,
    mesh_steps=4000,
    paper_steps=4000,
)
JUDGED, CHOOSING = 60, 0.15  # interactions, a quarter at most; and of the others


def divide(arrays, seed=0):
    """Numbers of the interactions that train (those without readings, too), choose and judge."""
    order = np.random.default_rng([seed, 11]).permutation(np.flatnonzero(arrays.labelled))
    judge, rest = np.split(order, [min(JUDGED, len(order) // 4)])
    choose, train = np.split(rest, [round(CHOOSING * len(rest))])
    return np.r_[train, np.flatnonzero(~arrays.labelled)], choose, judge


@torch.no_grad()
def judged(arrays, rows, predictions):
    """{name: RMS of each interaction [counts]}; predictions: change of counts of the rows."""
    truth, owner = arrays.change(rows).cpu().numpy(), arrays.owner[rows].cpu().numpy()
    return {k: interaction_errors(v.cpu().numpy(), truth, owner)[1] for k, v in predictions.items()}


@torch.no_grad()
def forward(arrays, nets, rows, config, fit=None):
    """Change of counts of rows by all models; arrays: at the points."""
    unit = 1e-3 / config.mesh_scale
    film = arrays.simulated[rows] - arrays.simulated[arrays.first[rows]]
    out = {"no change": torch.zeros_like(film), "film": film}
    if fit is not None:
        out["film with gains"] = film_with_gains(arrays, fit, rows)
    for name, net in nets.items():
        rest = net(torch.zeros_like(arrays.field[:1].float()))
        u = [unit * arrays.field[r].float() for r in rows.split(256)]
        out[name] = counts_change(torch.cat([net(x) - rest for x in u]), arrays.tare[rows])
    return out


def speed(model, config, device, repeats=20):
    """Median seconds of one reading of so many sensors, of one alone on a CPU."""
    out = {}
    for n in (1,) if device == "cpu" else (1, 64, 1024):
        u = 0.05 * torch.randn(n, model.nvert, 3, device=device)
        times = []
        for _ in range(repeats + 3):
            if device != "cpu":
                torch.cuda.synchronize()
            begun = time.perf_counter()
            model.log_change(u)
            if device != "cpu":
                torch.cuda.synchronize()
            times.append(time.perf_counter() - begun)
        out[str(n)] = float(np.median(times[3:]))
    return out


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="+", help="labelled sets of one synthetic sensor, on any skins")
    parser.add_argument("--other", nargs="*", default=[], help="labelled sets of other synthetic sensors")
    parser.add_argument("--device", default="cpu", help="of torch")
    parser.add_argument("--config", default="{}", help="JSON of fields that differ from CONFIG")
    parser.add_argument("--out", type=pathlib.Path, default=OUT, help="folder of weights, card and numbers")
    args = parser.parse_args()
    begun = time.time()
    config = LearningConfig(**CONFIG | json.loads(args.config))
    points = SkinPoints.choose(config.mesh_points, config.mesh_factors)
    sets = [load_arrays(path, args.device) for path in args.sets]
    arrays = join([a.at_points(points) for a in sets])
    train, choose, judge = divide(arrays)
    rows, fit = arrays.rows(judge, labelled=True), arrays.rows(train, labelled=True)
    print(
        f"{len(arrays.objects)} interactions, {len(train)} train, {len(choose)} choose, {len(judge)} judge; "
        f"{len(arrays.owner)} time steps, {time.time() - begun:.0f} s",
        flush=True,
    )

    net, curves = train_latent_projection(arrays, points, train, choose, config)
    print(f"latent projection after {time.time() - begun:.0f} s", flush=True)
    other = train_pointnet(arrays, points, train, choose, config)
    print(f"PointNet++ after {time.time() - begun:.0f} s", flush=True)
    args.out.mkdir(parents=True, exist_ok=True)
    skins = np.concatenate([np.full(len(a.objects), a.geometry.name) for a in sets])
    about = {"set": "synthetic", "labelled": int(arrays.labelled.sum()), "skins": sorted(set(skins))}
    path = args.out / "latent_projection.safetensors"
    save_points_model(path, net, points, config, about)
    nets = {"latent projection": net, "PointNet++": other}
    errors = judged(arrays, rows, forward(arrays, nets, rows, config, fit))
    with torch.no_grad():
        y = arrays.log_change(rows)
        bound = counts_change(net.electrode(y)[0], arrays.tare[rows])
    errors |= judged(arrays, rows, {"bound: the electrodes' code": bound})

    shift, inverse, patches = 0, [], []
    served = [PointsModel(net, points, a.geometry, config, {}).to(args.device).eval() for a in sets]
    parts = []
    for a in sets:  # numbers of each set's own interactions
        here = np.arange(shift, shift + len(a.objects))
        parts.append([np.intersect1d(part, here) - shift for part in (train, judge)])
        shift += len(a.objects)
    for a, model, (mine, _) in zip(sets, served, parts):
        if not a.labelled[mine].any():
            continue
        r = a.rows(mine, labelled=True)
        push = torch.cat([model(a.log_change(x))[1] for x in r.split(256)]).cpu().numpy()
        patches.append(patch_of_push(push, a.force[r].float().cpu().numpy()))
    patch = float(np.median(patches))
    for a, model, (_, mine) in zip(sets, served, parts):
        if len(mine):
            rows_of = a.rows(mine, labelled=True)
            inverse.append(inverse_errors(a, lambda r: model(a.log_change(r)), rows_of, patch))  # noqa: B023
    inverse = {k: np.concatenate([f[k] for f in inverse]) for k in inverse[0]}
    with torch.no_grad():
        u = arrays.field[rows].float() * (1e-3 / config.mesh_scale)
        code = torch.cat([net.mesh(x)[0] - x for x in u.split(256)]).norm(dim=2).mean()
    strangers = {}
    for folder in args.other:
        a = load_arrays(folder, args.device).at_points(points)
        r = a.rows(np.flatnonzero(a.labelled), labelled=True)
        own = judged(a, r, forward(a, nets, r, config))
        strangers[pathlib.Path(folder).name] = {k: quartiles(v) for k, v in own.items()}

    of_skin = {
        skin: {k: quartiles(np.array(v)[skins[np.sort(judge)] == skin]) for k, v in errors.items()}
        for skin in np.unique(skins)
    }
    result = {
        "data": "synthetic",
        "device": torch.cuda.get_device_name() if args.device != "cpu" else "cpu",
        "interactions": len(arrays.objects),
        "labelled": int(arrays.labelled.sum()),
        "train": int(arrays.labelled[train].sum()),
        "choose": len(choose),
        "judge": len(judge),
        "errors_counts": {k: quartiles(v) for k, v in errors.items()},
        "errors_counts_each": {k: np.round(v, 3).tolist() for k, v in errors.items()},
        "of_skin": of_skin,
        "ratio_to_pointnet": float(np.median(errors["latent projection"]) / np.median(errors["PointNet++"])),
        "test": paired_test(errors["latent projection"], errors["PointNet++"]),
        "other_sensors": strangers,
        "mesh_code_mm": float(code) * 1e3 * config.mesh_scale,
        "inverse": {k: quartiles(v[np.isfinite(v)]) for k, v in inverse.items()} | {"patch": patch},
        "speed_s": speed(PointsModel(net, points, load_skin("default"), config, {}).to(args.device).eval(),
                         config, args.device),
        "curves": curves,
        "config": dataclasses.asdict(config),
        "seconds": round(time.time() - begun),
    }  # fmt: skip
    save_points_model(path, net, points, config, about | {"patch": patch})
    with replacing(args.out / "latent_projection.md") as temporary:
        pathlib.Path(temporary).write_text(card(result))
    with replacing(args.out / "latent_projection.json") as temporary:
        pathlib.Path(temporary).write_text(json.dumps(result, indent=1))
    print(card(result))


def card(result):
    """What the weights are and how they were judged, as Markdown."""
    config, inverse = result["config"], result["inverse"]
    differs = ", ".join(f"{k} {config[k]}" for k in CONFIG)
    lines = [
        "# Weights `latent_projection.safetensors`",
        "",
        "The networks of Narang et al. (ICRA 2021): mesh VAE, electrode VAE, forward and inverse projection.",
        "Trained on **synthetic** data: touches of the simulated skin, counts of a synthetic sensor with",
        "another material, conduction and electronics (`docs/lab/data.md`). No real sensor was involved;",
        "expect more error on one. Made by `scripts/make_weights.py`, which has the commands.",
        "",
        "| | |",
        "|---|---|",
        "| reads | every skin of the BioTac's shape, at 686 points |",
        f"| set | {result['interactions']} interactions on skins {', '.join(result['of_skin'])}, "
        f"{result['labelled']} labelled: {result['train']} train, {result['choose']} choose, "
        f"{result['judge']} judge |",
        f"| settings | {differs} |",
        f"| trained on | {result['device']} |",
        "",
        f"RMS of an interaction in counts, {result['judge']} unseen ones of the same synthetic sensor:",
        "",
        "| | median | quartiles |",
        "|---|---|---|",
    ]
    for name, (middle, low, high) in result["errors_counts"].items():
        lines.append(f"| {name} | {middle:.1f} | {low:.1f} .. {high:.1f} |")
    lines += ["", f"Latent projection errs {result['ratio_to_pointnet']:.2f} times as much as PointNet++ "
              "(medians; same data, parts and settings)."]  # fmt: skip
    for name, found in result["other_sensors"].items():
        text = ", ".join(f"{k} {v[0]:.1f}" for k, v in found.items())
        lines += ["", f"Another synthetic sensor ({name}), medians: {text}."]
    lines += ["", f"Inverse projection on the unseen ones, medians: nodes {1e3 * inverse['mean'][0]:.0f} "
              f"um, where the skin moves {1e3 * inverse['moved'][0]:.0f} um; patch centre "
              f"{inverse['centre'][0]:.2f} mm, overlap {inverse['overlap'][0]:.2f}."]  # fmt: skip
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
