"""Weights with a model card: `biotac learn judge DIR --ship FOLDER`."""

import json
import pathlib
import shutil

from ..files import replacing
from .report import UNIT
from .weights import describe

__all__ = ["check_shippable", "ship"]

_MOST = 16 * 2**20  # bytes, all weights together
_DIRECTION = {
    "forward": "deformed skin -> electrodes",
    "inverse": "electrodes -> deformed skin and contact force",
}


def check_shippable(folder: pathlib.Path | str) -> dict[str, pathlib.Path]:
    """Direction -> weights of the trajectory split in a folder of `biotac learn train`.

    Raises:
      FileNotFoundError: seed 0 of that split was not trained, or only without our models (`--only`).
    """
    folder = pathlib.Path(folder)
    sources = {name: folder / f"{name}-trajectory.safetensors" for name in ("forward", "inverse")}
    for path in sources.values():
        if not path.is_file():
            raise FileNotFoundError(f"no {path}: train seed 0 of the split trajectory")
    return sources


def ship(folder: pathlib.Path | str, result: dict, target: pathlib.Path | str) -> list[pathlib.Path]:
    """Copies the weights of the trajectory split (all objects seen) and writes a card for each.

    Args:
      folder: of `biotac learn train`. result: of `report.evaluate_models`. target: folder, such as
        biotac_mj/assets/weights.

    Raises:
      FileNotFoundError: seed 0 of the trajectory split was not trained. ValueError: more than 16 MB.
    """
    folder, target = pathlib.Path(folder), pathlib.Path(target)
    if result.get("data", "synthetic") != "synthetic":
        raise ValueError(
            "--ship is for models of synthetic data, as its cards say: keep this with `biotac learn train "
            "DIR --out FILE.safetensors`"
        )
    sources = check_shippable(folder)
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
            row = found["inverse_mm"][meta.get("model", "pod_inverse")]
            centre = (
                f", patch centre {row['centre_median']:.2f} mm (median)" if "centre_median" in row else ""
            )
            lines.append(
                f"- unseen {split}: nodes {row['mean']:.4f} mm, "
                f"where the skin moves {row['moved']:.4f} mm{centre}"
            )
    return "\n".join(lines) + "\n"
