"""Weights of trained models as safetensors files with a description: mesh, channels, settings."""

import dataclasses
import hashlib
import json
import pathlib
from collections.abc import Callable, Sequence

import numpy as np
import torch

from ..fields import check_entries
from ..files import replacing
from ..geometry.skin_geometry import SkinGeometry
from ..geometry.skins import design_of
from ..reading import reading
from .networks.pointnet import PointNet
from .networks.points import SkinPoints
from .predictor import ForwardModel, PointsModel
from .training.config import LearningConfig
from .training.features import Pod
from .training.inverse import InverseHead
from .training.local import MODES
from .training.paper import LatentProjection, make_pointnet

_DAMAGED = "it is damaged: train again, or copy it again"
FORMAT = "biotac_mj.learning.weights/1"
SHIPPED = ("forward", "inverse", "latent_projection")
# entries of a file's description
_DESCRIPTION = {"channels": list}
_DESCRIPTION_OF = {
    "forward": {
        "mesh": str,
        "skin": str,
        "nvert": int,
        "kind": dict,
        "members": int,
        "width": int,
        "scale": float,
    },
    "inverse": {"mesh": str, "skin": str, "nvert": int, "nouter": int},
    "points": {"kind": dict, "config": dict, "reference": str},
}
# kinds that read the skin at `SkinPoints`, and their directions
_AT_POINTS = {"latent_projection": ("forward", "inverse"), "pointnet": ("forward",)}


def mesh_key(geometry: SkinGeometry) -> str:
    """Fingerprint of a skin's rest nodes, rounded to a micrometre."""
    return hashlib.sha256(np.rint(geometry.vert * 1e6).astype(np.int32).tobytes()).hexdigest()[:16]


def shipped(name: str = "forward") -> pathlib.Path:
    """Path of weights in the package, one of SHIPPED.

    Raises:
      FileNotFoundError: there are none of that name.
    """
    import importlib.resources

    path = (
        pathlib.Path(str(importlib.resources.files("biotac_mj.assets"))) / "weights" / f"{name}.safetensors"
    )
    if not path.is_file():
        raise FileNotFoundError(
            f"no weights {path}: train some with `biotac learn train` and pass their file"
        )
    return path


def find_weights(weights: pathlib.Path | str | None, direction: str = "forward") -> pathlib.Path:
    """Path of weights: a file, a name in SHIPPED, or None for the direction's default."""
    if weights is None or str(weights) in SHIPPED:
        return shipped(str(weights or direction))
    return pathlib.Path(weights)


def save_forward(
    path: pathlib.Path | str,
    members: Sequence[Callable],
    pod: Pod,
    config: LearningConfig,
    geometry: SkinGeometry,
    about: dict,
) -> None:
    """Writes an ensemble of results of `local.train_head` (half precision, without buffers that follow from
    the mesh)."""
    tensors = {"pod.basis": pod.basis[:, :MODES], "pod.scale": pod.scale[:MODES]}
    for k, member in enumerate(members):
        tensors |= {f"member{k}.{name}": value for name, value in member.head.state_dict().items()}
    meta = about | {
        "direction": "forward",
        "kind": {"kind": "local"},
        "members": len(members),
        "width": config.width,
        "scale": config.scale,
    }
    _save(path, tensors, geometry, meta)


def save_inverse(path: pathlib.Path | str, head: InverseHead, geometry: SkinGeometry, about: dict) -> None:
    """Writes an `inverse.InverseHead`."""
    _save(
        path,
        dict(head.state_dict()),
        geometry,
        about | {"direction": "inverse", "nouter": head.force_basis.shape[0]},
    )


def save_points_model(
    path: pathlib.Path | str,
    net: LatentProjection | PointNet,
    points: SkinPoints,
    config: LearningConfig,
    about: dict,
) -> None:
    """Writes a `LatentProjection`, with both directions, or a `PointNet`, with the points at which it reads
    any skin."""
    kind = "latent_projection" if hasattr(net, "inverse") else "pointnet"
    more = {"direction": "points", "kind": {"kind": kind}, "config": dataclasses.asdict(config)}
    graph = {f"points.{k}": torch.from_numpy(np.asarray(v)) for k, v in points.arrays().items()}
    graph = {k: v.float() if v.is_floating_point() else v.int() for k, v in graph.items()}
    more |= {"reference": points.reference, "channels": list(design_of(points.reference).electrodes)}
    _write(path, net.state_dict(), about | more, graph)


def _save(path, tensors, geometry, meta):
    where = {"mesh": mesh_key(geometry), "skin": geometry.name, "channels": list(geometry.design.electrodes)}
    _write(path, tensors, meta | where)


def _write(path, tensors, meta, graph=()):
    big = lambda v: v.half() if v.is_floating_point() and v.numel() > 4096 else v  # noqa: E731
    write_tensors(path, {k: big(v.detach()).cpu() for k, v in tensors.items()} | dict(graph), meta)


def write_tensors(path: pathlib.Path | str, tensors: dict[str, torch.Tensor], meta: dict) -> None:
    """Writes a file for `read_tensors`; meta: its description, JSON types."""
    from safetensors.torch import save

    tensors = {name: value.contiguous() for name, value in tensors.items()}
    meta = meta | {"format": FORMAT, "checksum": _checksum(tensors)}
    with replacing(path) as temporary:
        temporary.write_bytes(save(tensors, {"biotac_mj": json.dumps(meta, sort_keys=True)}))


def _checksum(tensors: dict[str, torch.Tensor]) -> str:
    """Checksum of names, shapes, types and numbers: permuted or exchanged tensors may have the same shape."""
    found = hashlib.sha256()
    for name in sorted(tensors):
        value = tensors[name].contiguous().numpy()
        found.update(f"{name} {value.shape} {value.dtype.str};".encode())
        found.update(value.tobytes())
    return found.hexdigest()[:16]


def is_inverse(weights: pathlib.Path | str) -> bool:
    """Whether weights, a file or a name in SHIPPED, map electrodes to the deformation of the skin.

    Raises:
      FileNotFoundError, ValueError: as `read_tensors`.
    """
    return "inverse" in _directions(describe(find_weights(weights)))


def describe(path: pathlib.Path | str) -> dict:
    """Description in a file of weights: direction, skin, nvert, channels, kind ..."""
    return read_tensors(path, ())[0]


def read_tensors(path: pathlib.Path | str, names: Sequence[str] | None = None) -> tuple[dict, dict]:
    """Description and tensors (all, or of these names) of a file.

    Raises:
      FileNotFoundError, ValueError: no such file, a damaged one, or weights that are not finite or differ
        from the checksum.
    """
    from safetensors import safe_open

    remedy = f"give a *.safetensors that `biotac learn train` wrote, or a name: {', '.join(SHIPPED)}"
    with reading(path, "file of weights", remedy), safe_open(str(path), framework="pt") as file:
        meta = json.loads((file.metadata() or {}).get("biotac_mj", "{}"))
        tensors = {k: file.get_tensor(k) for k in (file.keys() if names is None else names)}
    if not isinstance(meta, dict):
        raise ValueError(f"{path} is no file of weights (it describes itself by {meta!r:.50}): {remedy}")
    if names is None and meta.get("checksum", "") not in ("", _checksum(tensors)):
        raise ValueError(
            f"{path} holds other weights than were written (its checksum differs): train again, or copy it "
            "again"
        )
    tensors = {name: value.float() for name, value in tensors.items()}
    for name, value in tensors.items():
        if not torch.isfinite(value).all():
            raise ValueError(
                f"{name} of {path} has weights that are not finite: train again, or copy it again"
            )
    return meta, tensors


def _load(path, geometry, direction):
    meta, tensors = read_tensors(path)
    _refuse_other(meta, path, geometry, direction)
    return meta, tensors


def _kind(meta):
    kind = meta.get("kind")
    return kind.get("kind") if isinstance(kind, dict) else None


def _directions(meta):
    stated = meta.get("direction")
    return _AT_POINTS.get(_kind(meta), ()) if stated == "points" else (stated,)


def _refuse_other(meta, path, geometry, direction):
    stated = meta.get("direction")
    if stated == "reader" and direction == "forward":
        raise ValueError(
            f"{path} reads force from electrodes, and a signal needs a model that predicts electrodes: train "
            "one with `biotac learn train FOLDER`"
        )
    if meta.get("format") != FORMAT or direction not in _directions(meta):
        raise ValueError(
            f"{path} holds no {direction} model of {FORMAT}: it says {meta.get('format')}, {stated}, "
            f"{_kind(meta)}"
        )
    check_entries(f"the description of {path}", meta, _DESCRIPTION | _DESCRIPTION_OF[stated])
    if meta["channels"] != list(geometry.design.electrodes):
        raise ValueError(
            f"{path} was trained with channels {' '.join(meta['channels'])}, and skin {geometry.name!r} is "
            f"of {geometry.design.title}: take a skin of those electrodes, or train on a set of this one"
        )
    if stated == "points":  # they fit any skin of the shape, which is checked on first use
        if not meta["config"].get("logarithm"):
            raise ValueError(
                f"{path} was trained on counts and serves no sensor: train with logarithm true in the config"
            )
        return
    if meta["nvert"] != geometry.nvert or meta["mesh"] != mesh_key(geometry):
        raise ValueError(
            f"{path} was trained on skin {meta['skin']!r} with {meta['nvert']} nodes and cannot read skin "
            f"{geometry.name!r} with {geometry.nvert}: take that skin, or train on this one"
        )


def load_forward(path: pathlib.Path | str, geometry: SkinGeometry) -> ForwardModel | PointsModel:
    """A `predictor.ForwardModel`, or, for a network that reads `SkinPoints`, a `predictor.PointsModel`.

    Raises:
      FileNotFoundError: no such file.
      ValueError: another mesh, other channels, or tensors that do not fit.
    """
    meta, tensors = _load(path, geometry, "forward")
    if meta["direction"] == "points":
        return _points_model(path, meta, tensors, geometry)
    with reading(path, "file of weights that fit together", _DAMAGED):
        model = ForwardModel(geometry, meta, tensors["pod.scale"].numel())
    _fill(
        model,
        {k.replace("member", "members.", 1) if k.startswith("member") else k: v for k, v in tensors.items()},
        path,
    )
    return model.eval()


def check_forward(path: pathlib.Path | str, geometry: SkinGeometry) -> None:
    """Raises like `load_forward` if a file's header is of another skin."""
    _refuse_other(describe(path), path, geometry, "forward")


def _points_model(path, meta, tensors, geometry):
    graph = {k.removeprefix("points."): v for k, v in tensors.items() if k.startswith("points.")}
    with reading(path, "file of weights that fit together", _DAMAGED):
        config = LearningConfig(**meta["config"])
        points = SkinPoints.of_arrays({k: v.double().numpy() for k, v in graph.items()}, meta["reference"])
        make = LatentProjection if _kind(meta) == "latent_projection" else make_pointnet
        net = make(points, config, geometry.design.nelectrode)
    _fill(net, {k: v for k, v in tensors.items() if not k.startswith("points.")}, path)
    return PointsModel(net, points, geometry, config, meta).eval()


def load_inverse(path: pathlib.Path | str, geometry: SkinGeometry) -> InverseHead | PointsModel:
    """An `inverse.InverseHead`, or a latent projection's `predictor.PointsModel`, from weights; raises like
    `load_forward`."""
    meta, tensors = _load(path, geometry, "inverse")
    if meta["direction"] == "points":
        return _points_model(path, meta, tensors, geometry)
    with reading(path, "file of weights that fit together", _DAMAGED):
        modes = tensors["pod.scale"].numel(), tensors["force_scale"].numel()
        outer = len(np.unique(geometry.outer_face))
        if meta["nouter"] != outer:
            raise ValueError(f"{meta['nouter']} outer nodes, the skin has {outer}")
        head = InverseHead(Pod(geometry.nvert, modes[0]), modes[1], outer, geometry.design.nelectrode)
    _fill(head, tensors, path)
    return head.eval()


def _fill(module, tensors, path):
    try:
        module.load_state_dict({k: v.to(torch.float32) for k, v in tensors.items()})
    except RuntimeError as error:
        raise ValueError(
            f"{path} does not fit its own description ({str(error).splitlines()[-1].strip()}): it is damaged"
        ) from error
