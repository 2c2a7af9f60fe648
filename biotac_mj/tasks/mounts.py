"""Pose of a BioTac on a link of a hand, and its file."""

import dataclasses
import pathlib

import numpy as np

from ..fields import as_numbers, as_real, check_entries, check_types, refuse_unknown
from ..files import replacing
from ..geometry.rigid import quaternion, unit
from ..reading import read_yaml, reading
from ..short_repr import short_repr

TIP = 21.3e-3  # from the BioTac's origin to its tip [m]
CLAMP = 7.65e-3  # from the origin to the back end of `assets/clamp.obj` [m]
_REMEDY = "give a file that `biotac hand mount` wrote"


@dataclasses.dataclass(frozen=True)
class Mount:
    """Pose of a BioTac on a hand's link.

    Attributes:
      body: name of the link, or the end of it for a hand that was attached with a prefix.
      pos: of the BioTac frame's origin in the link's frame [m].
      tip, pad: directions of the fingertip and of the pad in that frame.
      replaces: names of the replaced geoms; None: all of the link and of the bodies fixed to it.
      shown: names of hidden geoms that remain and are drawn instead of replaced visual ones.
    """

    body: str
    pos: tuple
    tip: tuple = (0.0, 0.0, 1.0)
    pad: tuple = (0.0, -1.0, 0.0)
    replaces: tuple | None = None
    shown: tuple = ()

    def __post_init__(self):
        if not isinstance(self.body, str) or not self.body:
            raise ValueError(f"body of a Mount is {short_repr(self.body)}: give the name of a link")

    @property
    def quat(self) -> np.ndarray:
        """(w, x, y, z) of the BioTac frame in the link's: its tip is -x, its pad -y.

        Raises:
          ValueError: tip and pad are not orthogonal.
        """
        x, y = (
            -as_numbers(f"{what} of link {short_repr(self.body)}", getattr(self, what))
            for what in ("tip", "pad")
        )
        usable = x.shape == y.shape == (3,) and np.isfinite([*x, *y]).all() and x.any() and y.any()
        if usable:
            x, y = unit(x), unit(y)
        if not usable or abs(x @ y) > 1e-6:
            raise ValueError(
                f"tip {short_repr(self.tip)} and pad {short_repr(self.pad)} of link {short_repr(self.body)} "
                "must be at right angles: a BioTac's pad looks sideways"
            )
        return quaternion(np.stack([x, y, np.cross(x, y)], axis=1))


def write_mounts(path: pathlib.Path | str, mounts: dict[str, Mount]) -> None:
    """Writes {finger: Mount} as YAML for `attach_to_hand(mount=path)`."""
    import yaml

    document = {
        finger: {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(mount).items()}
        for finger, mount in mounts.items()
    }
    text = "# of BioTacs: attach_to_hand(spec, mount=FILE); metres and directions in the link's frame\n"
    with replacing(path) as temporary:
        temporary.write_text(text + yaml.safe_dump(document, sort_keys=False))


def read_mounts(path: pathlib.Path | str) -> dict[str, Mount]:
    """Reads a file of `write_mounts`.

    Raises:
      FileNotFoundError, ValueError: no such file, or an invalid one; the text has the cause.
    """
    document = read_yaml(path, "file of mounts", _REMEDY)
    names = [field.name for field in dataclasses.fields(Mount)]
    out = {}
    with reading(path, "file of mounts", _REMEDY):
        for finger, fields in document.items():
            check_entries(f"finger {finger}", fields, {"body": str, "pos": tuple})
            refuse_unknown(fields, names, f"finger {finger}")
            out[finger] = Mount(**{k: tuple(v) if isinstance(v, list) else v for k, v in fields.items()})
            check_types(out[finger])
            for number in out[finger].pos:
                as_real(f"pos of finger {finger} {out[finger].pos} has an element that", number)
            _ = out[finger].quat
    return out
