"""Constants of rubber with memory as one vector, for gradients."""

import numpy as np

from ..skin import Material, SkinData


def constants_of(material: Material) -> np.ndarray:
    """(c,) concatenated: fraction and time [s] of each Prony term, three of Mullins, fraction and strain of
    each friction element; only those that the material has."""
    parts = material.prony, material.mullins or (), material.hysteresis
    return np.concatenate([np.ravel(np.array(part, float)) for part in parts])


def relaxed(material: Material, constants: np.ndarray) -> np.ndarray:
    """Constants of the fully relaxed rubber, without softening or friction."""
    prony, mullins, branch = split_constants(material, constants)
    return np.concatenate([(prony * [0.0, 1.0]).ravel(), 0 * mullins, 0 * branch.ravel()])


def write_constants(data: SkinData, constants: np.ndarray) -> None:
    """Sets the constants of the rubber of a `SkinData` with one world."""
    prony, mullins, branch = split_constants(data.model.material, constants)
    for array, value in (
        (data.rubber.prony, prony[:, None]),
        (data.rubber.mullins, mullins[None]),
        (data.rubber.branch, (branch * [1, 1.5**0.5])[:, None]),
    ):
        if value.size:
            array.assign(value)


def split_constants(material: Material, constants: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Prony (nterm, 2), Mullins (3,) or (0,), friction elements (nbranch, 2)."""
    k = 2 * len(material.prony)
    m = k + 3 * (material.mullins is not None)
    return constants[:k].reshape(-1, 2), constants[k:m], constants[m:].reshape(-1, 2)
