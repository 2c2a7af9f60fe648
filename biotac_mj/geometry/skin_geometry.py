"""What a BioTac skin is: a tetrahedral shell, its surfaces, the rigid parts that hold it and the electrodes."""

import dataclasses
import os
import pathlib
import tempfile

import numpy as np

__all__ = ["SkinGeometry"]

_INT_FIELDS = ("elem", "outer_face", "inner_face", "fixed", "core_face", "nail_face", "clamp_face")


@dataclasses.dataclass(frozen=True)
class SkinGeometry:
    """A skin and the rigid parts around it, in the BioTac frame (tip at -x, pad at -y, nail at +y, clamp at +x).

    Attributes:
      name: what it is called in cards, data sets and messages.
      vert: (nvert, 3) float64, nodes at rest [m].
      elem: (nelem, 4) int32, tetrahedra with positive volume.
      outer_face: (nouter, 3) int32, the surface that touches the world; normals point out of the skin material.
      inner_face: (ninner, 3) int32, the surface towards the liquid; normals point out of the skin material, towards the core.
      fixed: (nfixed,) int32, sorted nodes held by core, nail plate and clamp.
      core_vert, core_face: (n, 3) float64 [m], (m, 3) int32, the rigid core: closed, normals outwards.
      nail_vert, nail_face, clamp_vert, clamp_face: the same for nail plate and clamp plate.
      electrode_pos: (19, 3) float64, electrodes E1..E19 on the core's surface [m].
      electrode_normal: (19, 3) float64, unit outward normals of the core there.
    """

    name: str
    vert: np.ndarray
    elem: np.ndarray
    outer_face: np.ndarray
    inner_face: np.ndarray
    fixed: np.ndarray
    core_vert: np.ndarray
    core_face: np.ndarray
    nail_vert: np.ndarray
    nail_face: np.ndarray
    clamp_vert: np.ndarray
    clamp_face: np.ndarray
    electrode_pos: np.ndarray
    electrode_normal: np.ndarray

    def __post_init__(self):
        for field in dataclasses.fields(self):
            if field.name == "name":
                continue
            dtype = np.int32 if field.name in _INT_FIELDS else np.float64
            object.__setattr__(self, field.name, np.ascontiguousarray(getattr(self, field.name), dtype=dtype))

    @property
    def nvert(self) -> int:
        return len(self.vert)

    @property
    def nelem(self) -> int:
        return len(self.elem)

    def save(self, path) -> pathlib.Path:
        """Writes an .npz file (to a temporary name, then renamed); positions as float64, so a reload is bit-equal."""
        path = pathlib.Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".npz")
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez_compressed(file, **dataclasses.asdict(self))
            os.chmod(temporary, 0o644)  # mkstemp makes files that only their owner may read
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise
        return path

    @classmethod
    def load(cls, path) -> "SkinGeometry":
        """Reads what `save` wrote.

        Raises:
          FileNotFoundError: no such file.
          ValueError: the file is not a stored skin.
        """
        path = pathlib.Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"no skin at {path}: pass 'coarse', 'default', 'fine' or a file made by `biotac import-mesh`")
        try:
            with np.load(path, allow_pickle=False) as file:
                return cls(**{f.name: file[f.name] if f.name != "name" else str(file["name"]) for f in dataclasses.fields(cls)})
        except (KeyError, OSError, ValueError) as error:
            raise ValueError(f"{path} is not a stored skin ({error}): make one with `biotac import-mesh`") from error
