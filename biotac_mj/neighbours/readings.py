"""Readings of a BioTac in many worlds, as tensors."""

import dataclasses
import typing

import numpy as np

if typing.TYPE_CHECKING:
    import torch


@dataclasses.dataclass
class BioTacData:
    """Readings in n worlds, in counts of the real sensor.

    Attributes:
      electrodes: (n, nelectrode), pac: (n, 22), pdc, tac, tdc: (n, 1) [counts].
      contact_force: (n, 6) force [N] and torque [N m] on the BioTac, in its frame.
      status: (n, 8), see `biotac_mj.Handle.read`.
    """

    electrodes: "torch.Tensor"
    pdc: "torch.Tensor"
    pac: "torch.Tensor"
    tac: "torch.Tensor"
    tdc: "torch.Tensor"
    contact_force: "torch.Tensor"
    status: "torch.Tensor"


def world_mask(env_ids: object, nworld: int) -> np.ndarray:
    """(nworld,) of bool from None (all), a slice, a mask, or indices, as in other frameworks."""
    mask = np.zeros(nworld, bool)
    chosen = env_ids.cpu().numpy() if hasattr(env_ids, "cpu") else env_ids
    mask[slice(None) if chosen is None else chosen if isinstance(chosen, slice) else np.asarray(chosen)] = (
        True
    )
    return mask
