"""`biotac learn judge FOLDER`: predictions of `biotac learn train` over all seeds, with the paper's numbers;
JSON, a table and figures."""

import pathlib

import numpy as np

from ..fields import check_entries
from ..files import save_figure, write_json
from ..reading import Array, check_arrays, read_json, read_npz
from ..sensor.channels import electrode_noise
from .protocol import conformal_width, interaction_errors, paired_test, quartiles

# Median RMS errors, tared counts / 2048: Narang et al., ICRA 2021, their data, real sensor.
PAPER = {
    "trajectory": {"latent_projection": 0.010, "pointnet": 0.012},
    "object": {"latent_projection": 0.015, "pointnet": 0.016},
}
UNIT = 2048.0
_SURE = 0.05  # p of a paired test below which one model is better than another
# rows to compare with, nothing that is served
_REFERENCES = ("tare", "linear", "physics", "physics_gain", "electrode_vae")


def evaluate_models(folder: pathlib.Path | str, out: pathlib.Path | str | None = None) -> dict:
    """Reads a folder of `biotac learn train`, writes `out` (JSON, default FOLDER/evaluation.json) and figures
    next to it.

    Errors of an interaction are averaged over the seeds whose test split has it; medians and tests are over
    interactions.

    Raises:
      FileNotFoundError: no predictions in the folder.
      ValueError: seeds that were trained on different sets.
    """
    folder = pathlib.Path(folder)
    reports = [report_of(p) for p in sorted(folder.glob("*-*.json")) if p.with_suffix(".npz").is_file()]
    if not reports:
        is_set = any(folder.glob("shard-*.h5"))
        first = f"{folder} --out trained" if is_set else f"SET --out {folder}"
        then = ", then judge the folder trained" if is_set else ""
        raise FileNotFoundError(f"no predictions in {folder}: run `biotac learn train {first}` first{then}")
    if len({(r["set"], r["interactions"], r["labelled"]) for r in reports}) > 1:
        raise ValueError(f"{folder} holds predictions on different sets: give every set its own folder")
    sensor = reports[0].get("sensor", "synthetic")
    result = {"schema": "biotac_mj.learning.evaluation/1", "data": sensor, "unit": "tared counts",
              "folder": str(folder), "paper": PAPER, "splits": {},
              **{k: reports[0][k] for k in ("set", "interactions", "labelled")}}  # fmt: skip
    drawn = {}
    for split in dict.fromkeys(r["split"] for r in reports):
        mine = [r for r in reports if r["split"] == split]
        result["splits"][split], drawn[split] = _split(folder, split, mine)
    ours = [n for n in next(iter(result["splits"].values()))["models"] if n not in _REFERENCES]
    unseen = _judging(result["splits"])
    result["default"] = min(
        ours, key=lambda n: np.mean([result["splits"][s]["models"][n]["median"] for s in unseen])
    )
    for split, found in result["splits"].items():
        found["tests"] = _tests(drawn[split]["errors"], result["default"])
    out = pathlib.Path(out or folder / "evaluation.json")
    figures = [out.with_name(f"{out.stem}_{what}.png") for what in ("errors", "traces")]
    draw_errors(result, figures[0])
    _traces(result, drawn, list(result["splits"]), figures[1])
    result["figures"] = [str(path) for path in figures]
    write_json(out, result)
    return result


_AGAIN = "remove it and run `biotac learn train` again"
_REPORT = {
    "split": str,
    "seed": int,
    "set": str,
    "interactions": int,
    "labelled": int,
    "device": str,
    "mesh": dict[str, dict],
    "inverse": dict[str, dict[str, float | list[float]]],
    "seconds": dict[str, float],
}
_MESH = {"all": dict[str, float], "objects": dict[str, dict[str, float]]}
_ERRORS = {"mean": float, "moved": float}  # [mm]
_PREDICTIONS = {
    "truth": Array(("n", "nelectrode")),
    "tare": Array(("n", "nelectrode")),
    "time": Array(("n",)),
    "owner": Array(("n",), "index"),
    "object": Array(("n",), "text"),
    "test": Array(("n",), "flag"),
}


def report_of(path: pathlib.Path) -> dict:
    """Result of `biotac learn train` for one split and seed."""
    report = check_entries(str(path), read_json(path, "result of `biotac learn train`", _AGAIN), _REPORT)
    for code, found in report["mesh"].items():
        check_entries(f"mesh {code} of {path}", found, _MESH)
        check_entries(f"all of mesh {code} of {path}", found["all"], _ERRORS)
    for code, found in report["inverse"].items():
        check_entries(f"inverse {code} of {path}", found, _ERRORS)
    if path.stem != f"{report['split']}-{report['seed']}":
        raise ValueError(f"{path} says it is {report['split']}-{report['seed']}: {_AGAIN}")
    return report


def predictions_of(path: pathlib.Path) -> dict[str, np.ndarray]:
    """Its predictions, each (n, nelectrode)."""
    what = "file of predictions"
    found = read_npz(path, what, _AGAIN)
    wanted = {name: Array(("n", "nelectrode")) for name in found if name.startswith("predicted_")}
    check_arrays(path, found, _PREDICTIONS | wanted, _AGAIN)
    if not wanted or not found["test"].any() or found["test"].all():
        raise ValueError(f"{path} has no predictions, or none of both parts: {_AGAIN}")
    return found


def table(result: dict) -> str:
    """Result of `evaluate_models` as text."""
    lines = []
    for split, found in result["splits"].items():
        kind = "trajectory" if split == "trajectory" else "object"
        where = kind if kind == split else f"{kind}: {split}"
        seeds = " ".join(map(str, found["seeds"]))
        lines.append(
            f"unseen {where}, {result['data']} sensor: {found['interactions']} interactions, seeds {seeds}; "
            "RMS per interaction, counts"
        )
        lines.append(
            f"  {'':<20}{'median':>9}{'quartiles':>20}{'/ 2048':>9}{'medians of seeds':>20}{'covered':>9}"
            f"{'+-':>8}{'paper':>8}"
        )
        for name, row in sorted(found["models"].items(), key=lambda item: item[1]["median"]):
            low, high = row["quartiles"]
            least, most = min(row["seed_medians"]), max(row["seed_medians"])
            spread, between = f"{low:.2f} .. {high:.2f}", f"{least:.2f} .. {most:.2f}"
            half = "-" if row["interval_half_width"] is None else round(row["interval_half_width"], 1)
            lines.append(
                f"  {name:<20}{row['median']:>9.2f}{spread:>20}{row['median'] / UNIT:>9.4f}{between:>20}"
                f"{row['interval_coverage']:>9.2f}{half:>8}{PAPER[kind].get(name, ''):>8}"
            )
        lines.append(f"  noise of the sensor {found['noise_floor']:.2f} counts")
        for name, test in found["tests"].items():
            better, middle = 100 * test["better"], test["median_difference"]
            lines.append(
                f"  {name}: better on {better:.0f} % of {test['n']}, median of differences {middle:+.2f}, "
                f"p = {test['p']:.2g}"
            )
        for name, error in found["mesh_mm"].items():
            lines.append(
                f"  mesh, {name}: {error['all']['mean']:.4f} mm mean, "
                f"{error['all']['moved']:.4f} mm where it moves more than 0.05"
            )
        lines += _objects(found["mesh_mm"])
        for name, error in found["inverse_mm"].items():
            centre = f", patch centre {error['centre_median']:.2f} mm" if "centre_median" in error else ""
            lines.append(
                f"  inverse, {name}: {error['mean']:.4f} mm mean, "
                f"{error['moved']:.4f} mm where it moves{centre}"
            )
    lines += [_choice(result), f"figures: {', '.join(result['figures'])}"]
    return "\n".join(lines)


def _choice(result):
    """Recommended model, its basis, and simpler ones that are better or not significantly worse."""
    judged = _judging(result["splits"])
    medians = {
        name: np.mean([result["splits"][split]["models"][name]["median"] for split in judged])
        for name in result["splits"][judged[0]]["models"]
    }
    own = medians[result["default"]]
    better = [name for name in ("tare", "physics", "physics_gain", "linear") if medians.get(name, own) < own]
    on = ", ".join("interactions" if split == "trajectory" else f"object {split}" for split in judged)
    seeds = min(len(result["splits"][split]["seeds"]) for split in judged)
    text = f"best of the networks on unseen {on} ({seeds} seed{'s' * (seeds > 1)}): {result['default']}"
    if better:
        return f"{text}; {', '.join(better)} is better here, so attach no network of this set: train on more"
    tests = [result["splits"][split]["tests"] for split in judged]
    unsure = [
        name
        for name in ("linear", "physics_gain")
        if name in medians
        and any(one.get(f"{result['default']} against {name}", {"p": 1.0})["p"] >= _SURE for one in tests)
    ]
    return text + (f"; not significantly better than {', '.join(unsure)}: train on more" if unsure else "")


def _judging(splits):
    """Splits that decide the recommendation: unseen objects if there are any."""
    return [name for name in splits if name != "trajectory"] or list(splits)


def _objects(codes):
    """Lines with the mesh codes' mean node error by object, if there are several."""
    names = sorted(set().union(*(error["objects"] for error in codes.values())))
    if len(names) < 2:
        return []
    lines = [f"  {'mean node error [mm]':<24}" + "".join(f"{code:>12}" for code in codes)]
    for name in names:
        values = (error["objects"].get(name, {}).get("mean") for error in codes.values())
        lines.append(
            f"  {name:<24}" + "".join(f"{'' if v is None else format(v, '.4f'):>12}" for v in values)
        )
    return lines


def _split(folder, split, reports):
    errors, intervals, noise, example = {}, {}, [], None
    for report in reports:
        data = predictions_of(folder / f"{split}-{report['seed']}.npz")
        test = data["test"].astype(bool)
        truth, owner = data["truth"][test].astype(float), data["owner"][test]
        raw = truth + data["tare"][test]
        noise.append(np.sqrt((electrode_noise(raw) ** 2).mean(1)))
        for key in (k for k in data if k.startswith("predicted_")):
            name = key[len("predicted_") :]
            got = data[key].astype(float)
            try:
                which, value = interaction_errors(got[test], truth, owner)
            except ValueError as error:
                raise ValueError(f"{folder}/{split}-{report['seed']}.npz, {name}: {error}") from error
            errors.setdefault(name, {}).setdefault("seed", []).append(float(np.median(value)))
            for k, v in zip(which.tolist(), value.tolist()):
                errors[name].setdefault("each", {}).setdefault(k, []).append(v)
            width = conformal_width(got[~test] - data["truth"][~test], data["owner"][~test])
            inside = (np.abs(got[test] - truth) <= width).mean()
            intervals.setdefault(name, []).append((float(inside), float(np.mean(width))))
        if report["seed"] == min(r["seed"] for r in reports):
            example = {k: data[k][test] for k in data if k.startswith("predicted_")} | {
                "truth": truth, "owner": owner, "time": data["time"][test], "object": data["object"][test],
            }  # fmt: skip
    models = {}
    for name, e in errors.items():
        value = np.array([np.mean(v) for v in e["each"].values()])
        q50, q25, q75 = quartiles(value)
        inside, width = np.mean(intervals[name], axis=0)
        models[name] = {
            "median": q50, "quartiles": [q25, q75], "median_2048": q50 / UNIT, "seed_medians": e["seed"],
            "interval_coverage": inside, "interval_half_width": float(width) if np.isfinite(width) else None,
        }  # fmt: skip
    found = {
        "seeds": [r["seed"] for r in reports],
        "interactions": len(next(iter(errors.values()))["each"]),
        "models": models,
        "noise_floor": float(np.median(np.concatenate(noise))),
        "mesh_mm": _average([r["mesh"] for r in reports]),
        "inverse_mm": _average([r["inverse"] for r in reports]),
    }
    return found, {"errors": {n: e["each"] for n, e in errors.items()}, "example": example}


def _tests(errors, default):
    pairs = [
        ("latent_projection", "pointnet"),
        *((default, other) for other in ("latent_projection", "pointnet", "linear", "physics_gain")),
    ]
    out = {}
    for a, b in pairs:
        if a in errors and b in errors and a != b:
            keys = sorted(set(errors[a]) & set(errors[b]))
            if len(keys) >= 5:
                out[f"{a} against {b}"] = paired_test(
                    [np.mean(errors[a][k]) for k in keys], [np.mean(errors[b][k]) for k in keys]
                )
    return out


def _average(reports):
    """Means over equal trees of numbers."""
    first = reports[0]
    if isinstance(first, dict):
        return {k: _average([r[k] for r in reports if k in r]) for k in first}
    return np.mean(reports, axis=0).tolist()


def draw_errors(result: dict, path: pathlib.Path | str) -> None:
    """A picture of medians and quartiles over interactions: a row for each model, a column for each split.

    Args:
      result: of `evaluate_models`; used: data, default, and per split noise_floor and the models' median and
        quartiles [counts].
    """
    from matplotlib.figure import Figure

    splits = result["splits"]
    last = list(splits.values())[-1]["models"]
    names = sorted(last, key=lambda name: last[name]["median"])
    figure = Figure(figsize=(1.7 + 4.8 * len(splits), 1.2 + 0.32 * len(names)), layout="constrained")
    for axis, (split, found) in zip(
        figure.subplots(1, len(splits), sharey=True, squeeze=False)[0], splits.items()
    ):
        paper = PAPER["trajectory" if split == "trajectory" else "object"]
        for row, name in enumerate(names):
            one = found["models"][name]
            color = "C1" if name == result["default"] else "C7" if name in _REFERENCES else "C0"
            axis.axhspan(row - 0.5, row + 0.5, color="0.95" if row % 2 else "1", zorder=0)
            axis.plot(one["quartiles"], [row, row], color=color, lw=7, alpha=0.35, solid_capstyle="butt")
            axis.plot(one["median"], row, "o", color=color)
            axis.annotate(
                f"{one['median']:.1f}", (1.02, row), xycoords=("axes fraction", "data"), va="center"
            )
            if name in paper:
                axis.plot(UNIT * paper[name], row, "k*", ms=9)
        axis.axvline(found["noise_floor"], color="C2", ls="--", lw=1)
        axis.set(xscale="log", xlabel="RMS error of an interaction [counts]", ylim=(len(names) - 0.5, -0.5))
        axis.set_yticks(range(len(names)), names)
        axis.set_xticks(ticks := [3, 10, 30, 100], map(str, ticks))
        axis.set_title(
            f"unseen {'trajectory' if split == 'trajectory' else 'object: ' + split}, {result['data']} sensor"
        )
    figure.suptitle(
        "Medians (dots, numbers) and quartiles (bars). Orange: the best to be served; grey: to compare\n"
        "with. Star: the paper's own, of a real sensor. Dashed: noise of the sensor.",
        fontsize=9,
    )
    save_figure(path, figure)


def _traces(result, drawn, splits, path):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.4 * len(splits)), layout="constrained")
    axes = figure.subplots(len(splits), 2, squeeze=False)
    shown = [
        n
        for n in (result["default"], "latent_projection", "pointnet")
        if f"predicted_{n}" in drawn[splits[0]]["example"]
    ]
    for row, split in zip(axes, splits):
        data = drawn[split]["example"]
        size = {k: np.abs(data["truth"][data["owner"] == k]).max() for k in np.unique(data["owner"])}
        one = sorted(size, key=size.get)[int(0.75 * len(size))]  # a strong touch, not the strongest
        mine = data["owner"] == one
        strong = np.argsort(np.abs(data["truth"][mine]).max(0))[::-1][:2]
        for axis, e in zip(row, strong):
            axis.plot(data["time"][mine], data["truth"][mine][:, e], "k.-", label=f"{result['data']} sensor")
            for name in shown:
                axis.plot(data["time"][mine], data[f"predicted_{name}"][mine][:, e], lw=1.2, label=name)
            axis.set_title(f"{split}: E{e + 1}, {data['object'][mine][0].decode()}", fontsize=9)
            axis.set_xlabel("time [s]"), axis.set_ylabel("change [counts]")
            axis.legend(fontsize=7)
    save_figure(path, figure)
