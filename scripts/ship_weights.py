"""The weights that ship, with a model card each: those of the trajectory split (all objects seen) in a folder
of `biotac learn train` on a synthetic sensor.

    python scripts/ship_weights.py out/train [--out biotac_mj/assets/weights]"""

import argparse
import json
import pathlib
import shutil

from biotac_mj.files import replacing
from biotac_mj.learning.report import UNIT, evaluate_models
from biotac_mj.learning.weights import describe

__all__ = ["ship"]

_MOST = 16 * 2**20  # bytes, all weights together
_DIRECTION = {
    "forward": "deformed skin -> electrodes",
    "inverse": "electrodes -> deformed skin and contact force",
}


def ship(folder: pathlib.Path | str, result: dict, target: pathlib.Path | str) -> list[pathlib.Path]:
    """Copies the weights and writes a card for each.

    Args:
      folder: of `biotac learn train`. result: of `report.evaluate_models`. target: folder.

    Raises:
      FileNotFoundError: seed 0 of the trajectory split was not trained. ValueError: a real sensor, or more
        than 16 MB.
    """
    folder, target = pathlib.Path(folder), pathlib.Path(target)
    if result["data"] != "synthetic":
        raise ValueError(f"{folder} saw a {result['data']} sensor: cards say that weights saw synthetic ones")
    sources = {name: folder / f"{name}-trajectory.safetensors" for name in ("forward", "inverse")}
    for path in sources.values():
        if not path.is_file():
            raise FileNotFoundError(f"no {path}: train seed 0 of the split trajectory")
    size = sum(path.stat().st_size for path in sources.values())
    if size > _MOST:
        raise ValueError(
            f"the weights are {size / 2**20:.1f} MB: 16 MB at most are shipped; "
            "take fewer members or components"
        )
    target.mkdir(parents=True, exist_ok=True)
    written = []
    for name, source in sources.items():
        with replacing(target / f"{name}.safetensors") as temporary:
            shutil.copyfile(source, temporary)
        with replacing(target / f"{name}.md") as temporary:
            pathlib.Path(temporary).write_text(_card(name, describe(source), source.stat().st_size, result))
        written += [target / f"{name}.safetensors", target / f"{name}.md"]
    return written


def _card(name, meta, size, result):
    lines = [
        f"# Weights `{name}.safetensors`",
        "",
        "Trained on **synthetic** data: "
        "touches of the simulated skin, counts of a synthetic sensor with another mesh, material and",
        "conduction (`docs/lab/data.md`). No real sensor was involved; expect more error on one.",
        "",
        "| | |",
        "|---|---|",
        f"| direction | {_DIRECTION[name]} |",
        f"| skin | `{meta['skin']}`, {meta['nvert']} nodes, fingerprint {meta['mesh']} |",
        f"| channels | {meta['channels'][0]}..{meta['channels'][-1]} |",
        f"| size | {size / 2**20:.2f} MB |",
        f"| set | {result['interactions']} interactions, {result['labelled']} labelled; "
        "seed 0, 72 % of them |",
    ]
    if name == "forward":
        lines.append(
            f"| model | {meta['model']}, mean of {meta['members']} networks; "
            f"{json.dumps(meta['kind'], sort_keys=True)} |"
        )
    lines += ["", "Errors on interactions that training did not see (synthetic sensor):", ""]
    for split, found in result["splits"].items():
        if name == "forward":
            rows = {
                k: found["models"][k]
                for k in ("ensemble", "latent_projection", "pointnet", "linear", "tare")
                if k in found["models"]
            }
            text = ", ".join(
                f"{k} {row['median']:.1f} ({row['median'] / UNIT:.4f})" for k, row in rows.items()
            )
            lines.append(
                f"- unseen {split}: median RMS per interaction in counts (/ 2048): {text}; "
                f"noise {found['noise_floor']:.1f}"
            )
        else:
            row = found["inverse_mm"][meta["model"]]
            centre = (
                f", patch centre {row['centre_median']:.2f} mm (median)" if "centre_median" in row else ""
            )
            lines.append(
                f"- unseen {split}: nodes {row['mean']:.4f} mm, "
                f"where the skin moves {row['moved']:.4f} mm{centre}"
            )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("folder", help="that `biotac learn train` wrote")
    parser.add_argument("--out", default="biotac_mj/assets/weights", help="folder of weights and cards")
    options = parser.parse_args()
    written = ship(options.folder, evaluate_models(options.folder), options.out)
    print(f"written: {', '.join(map(str, written))}")
