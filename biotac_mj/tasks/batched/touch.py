"""Observations of touch, by the choices of `observe`, from the sensors of all worlds."""

import functools

import mujoco
import numpy as np
import torch
import warp as wp

from ...batch import Batch
from ...fields import as_numbers, check_choice
from ...geometry import load_skin
from ...geometry.design import BIOTAC
from ...sensor.film import BatchFilm
from ...sensor.weighted import WeightedElectrodes
from ...short_repr import short_repr

OBSERVE = ("none", "binary", "force", "electrodes", "electrodes+pac", "learned")
_CHANNELS = ("electrodes", "pdc", "pac")
_COUNTS = 100.0  # unit of changes
_SIGMA = 50.0  # PDC beyond so many deviations of its noise is a touch, as drivers of real sensors have it


def as_deviations(value: object) -> tuple[float, ...]:
    """Deviations for electrodes, PDC and PAC, of one number or three.

    Raises:
      ValueError: others.
    """
    given = as_numbers("model_error", value)
    if given.shape not in ((), (3,)) or not (np.isfinite(given).all() and (given >= 0).all()):
        raise ValueError(f"model_error is {short_repr(value)}: give a number of 0 or more, or three of them")
    return tuple(np.broadcast_to(given, 3).tolist())


class Touch:
    """The fingers' channels, as changes from the frame in which nothing was touched.

    Args:
      mjm: the MjModel. sensordata: (nworld, nsensordata) tensor of it.
      batches: {prefix: Batch}. skin: of all of them, a BioTac's.
    """

    def __init__(
        self, mjm: mujoco.MjModel, sensordata: torch.Tensor, batches: dict[str, Batch], skin: object
    ):
        tensor = functools.partial(torch.as_tensor, device=sensordata.device)
        sensors = [[mjm.sensor(f"{prefix}{name}") for name in _CHANNELS] for prefix in batches]
        address = [[np.arange(s.adr[0], s.adr[0] + s.dim[0]) for s in finger] for finger in sensors]
        self._sensed, self._place = sensordata, tensor(np.array([np.concatenate(a) for a in address]))
        self._split = [len(a) for a in address[0]]
        self._kind = tensor(np.repeat(np.arange(len(_CHANNELS)), self._split))
        geometry = load_skin(skin)
        if geometry.design != BIOTAC:
            raise ValueError(f"skin is of a {geometry.design.title}: give a BioTac's or leave it out")
        each = np.eye(len(geometry.electrode_pos))
        self._pos = tensor(geometry.electrode_pos, dtype=torch.float32)
        # the formula is linear in how far counts fall
        self._force = tensor(WeightedElectrodes(geometry).force(-each), dtype=torch.float32)
        self._film = any(isinstance(batch.senses.film, BatchFilm) for batch in batches.values())
        acquired = [batch.senses.acquisition for batch in batches.values()]
        self._seeds = [_as_int64(a.seed) for a in acquired]
        self._drawn = [wp.to_torch(a.drawn) for a in acquired]
        self._noise = [wp.to_torch(a.state)[:, a.place.pdc_noise] for a in acquired]
        self.tare = torch.zeros(self.channels.shape, device=sensordata.device)

    @property
    def channels(self) -> torch.Tensor:
        """(nworld, nfinger, k) counts of electrodes, PDC and PAC."""
        return self._sensed[:, self._place]

    def draw_errors(
        self, shape: tuple[int, ...], deviation: tuple[float, ...], draw: torch.Generator
    ) -> torch.Tensor:
        """Errors (*shape, nfinger, 3 + nelectrode) for `with_errors`, of these deviations: of all electrodes
        of a finger, PDC and PAC, and of each electrode; of three, the first is also the last."""
        own = (*deviation, deviation[0])[3:4]
        each = torch.tensor(deviation[:3] + own * self._split[0], device=draw.device)
        return each * torch.randn(*shape, len(self._seeds), len(each), generator=draw, device=draw.device)

    def with_errors(self, changes: torch.Tensor, errors: torch.Tensor) -> torch.Tensor:
        """Changes of the channels (..., nfinger, k) with errors: of electrodes, PDC and PAC as fractions of
        themselves, of each electrode as a fraction of the RMS of its finger's, since the tier is off by as
        much where electrodes hardly change."""
        n = self._split[0]
        common, own = errors.split([3, n], dim=-1)
        out = changes * (1 + common[..., self._kind])
        out[..., :n] += own * self.rms(changes)[..., :n]
        return out

    def rms(self, changes: torch.Tensor) -> torch.Tensor:
        """RMS (..., nfinger, k) of changes of the channels over those of a finger and of their kind."""
        kinds = changes.split(self._split, dim=-1)
        return torch.cat([c.square().mean(-1, keepdim=True).sqrt().expand_as(c) for c in kinds], dim=-1)

    def without(self, changes: torch.Tensor, count: int, draw: torch.Generator) -> torch.Tensor:
        """Changes of the channels (n, ..., nfinger, k) in which `count` random electrodes of each finger read
        none."""
        shape = len(changes), *[1] * (changes.ndim - 3), changes.shape[-2], self._split[0]
        order = torch.rand(shape, generator=draw, device=changes.device).argsort(-1)
        out = changes.clone()
        out[..., : self._split[0]] *= order >= count
        return out

    def observe(
        self, choice: str, changes: torch.Tensor, worlds: torch.Tensor | slice = slice(None)
    ) -> torch.Tensor:
        """(nworld, h, n) of a choice of OBSERVE, from the `channels` as changes from those at rest, (nworld,
        h, nfinger, k) of h decisions, in these worlds.

        For each finger: "none" nothing; "binary" whether PDC is 50 deviations of its noise above its
        baseline; "force" the force [N] and the mean place of contact [cm] by `WeightedElectrodes`, on the
        core; "electrodes" and "learned" the changes of electrodes and PDC, in hundreds of counts;
        "electrodes+pac" also those of PAC's 22 samples of a frame.

        Raises:
          ValueError: another choice, or "learned" where electrodes are the film's.
        """
        more = "; learned needs make(..., observe='learned'), without signal='physics'" if self._film else ""
        check_choice("observe is", choice, OBSERVE[:-1] if self._film else OBSERVE, more)
        electrodes, pdc, pac = changes.split(self._split, dim=3)
        if choice == "none":
            parts = [pdc[..., :0]]
        elif choice == "binary":
            # noise of the 12-bit converter besides
            noise = torch.stack([n.to(pdc.dtype) for n in self._noise], dim=1).square() + 1 / 12
            noise = noise[worlds]
            parts = [(pdc > _SIGMA * noise.sqrt()[:, None, :, None]).to(pdc.dtype)]
        elif choice == "force":
            fall = (-electrodes).clamp(min=0.0)
            weight = fall.square()
            place = weight @ self._pos / weight.sum(-1, keepdim=True).clamp(min=1.0)
            parts = [fall @ self._force, 100 * place]
        else:
            parts = [electrodes / _COUNTS, pdc / _COUNTS]
            if choice == "electrodes+pac":
                parts.append(pac / _COUNTS)
        return torch.cat(parts, dim=3).flatten(2)

    def alike(self, choice: str) -> np.ndarray:
        """Numbers (n,) of what `observe` gives of a decision, one for all electrodes of a finger and one for
        its samples of PAC."""
        channels = self._split[: 3 if choice == "electrodes+pac" else 2]
        kinds = len(self._seeds) * {"none": [], "binary": [1], "force": 6 * [1]}.get(choice, channels)
        return np.repeat(np.arange(len(kinds)), np.array(kinds, int))

    def reseed(self, worlds: torch.Tensor, seed: torch.Tensor) -> None:
        """Gives worlds (k,) other seeds, of seed (nworld,): of their noise, and of the sensor that the next
        reset draws. States that were kept have one."""
        for seeds, drawn in zip(self._seeds, self._drawn, strict=True):
            seeds[worlds] = (seeds[worlds] >> 32 << 32) + seed[worlds]  # the upper word is of the name
            drawn[worlds] = 1


def _as_int64(array):
    same = wp.array(ptr=array.ptr, dtype=wp.int64, shape=array.shape, device=array.device, copy=False)
    return wp.to_torch(same)
