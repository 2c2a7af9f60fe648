"""Learned film: electrodes from a network for a step of MuJoCo, of dm-control or of a batch."""

import contextlib
import functools
import pathlib

import numpy as np
import torch
import warp as wp

from ..geometry.skin_geometry import SkinGeometry
from ..sensor.presets import read_sensor
from .predictor import ForwardModel
from .weights import check_forward, find_weights, load_forward


class NetworkFilm:
    """Electrodes from a network, in the place of `sensor.film.FilmConduction`.

    Args:
      geometry: the skin.
      weights: file, or a name of `weights.SHIPPED`; None is "forward" (all are trained on synthetic data).

    Attributes:
      geometry: the skin. rest: (n,) impedance at rest [ohm].
    """

    def __init__(self, geometry: SkinGeometry, weights: pathlib.Path | str | None = None):
        self._weights, self.geometry = find_weights(weights), geometry
        check_forward(self._weights, geometry)
        self.rest = read_sensor(None, design=geometry.design).impedance

    @functools.cached_property
    def model(self) -> ForwardModel:
        return load_forward(self._weights, self.geometry)

    def impedance(self, vert_xpos: np.ndarray) -> np.ndarray:
        """(n,) [ohm] for nodes (nvert, 3) [m]."""
        u = torch.as_tensor(1e3 * (vert_xpos - self.geometry.vert), dtype=torch.float32)
        return self.rest * np.exp(self.model.log_change(u[None])[0].double().numpy())


class LearnedBatchFilm:
    """Replacement of `sensor.film.BatchFilm`: impedances of `nworld` skins, on their device.

    Computes all worlds whenever one is due, in single precision. Capturable in a CUDA graph: torch's memory
    comes from a pool of its own, which lives as long as this object.

    Args:
      geometry, weights: as for `NetworkFilm`. nworld: worlds. device: Warp device.

    Attributes:
      impedance: (nworld, n) wp.array float64 [ohm]; valid: (nworld,) wp.array int; rest: (n,); nbytes;
        design.
    """

    def __init__(
        self,
        geometry: SkinGeometry,
        nworld: int,
        device: str = "cpu",
        weights: pathlib.Path | str | None = None,
    ):
        self.device = wp.get_device(device)
        torch_device = wp.device_to_torch(self.device)
        self.model = load_forward(find_weights(weights), geometry).to(torch_device)
        self.design = geometry.design
        self.rest = read_sensor(None, design=self.design).impedance
        with wp.ScopedDevice(self.device):
            self.impedance = wp.array(np.tile(self.rest, (nworld, 1)), dtype=wp.float64)
            self.valid = wp.ones(nworld, dtype=int)
        self._rest = torch.as_tensor(self.rest, device=torch_device)
        self._vert = torch.as_tensor(geometry.vert, device=torch_device)
        self.nbytes = self.impedance.capacity
        self._pool = torch.cuda.MemPool() if self.device.is_cuda else None
        if self.device.is_cuda:  # torch's libraries take their memory before a capture begins
            x = self._vert[:, None].expand(-1, nworld, -1).contiguous()
            with wp.ScopedDevice(self.device):
                self.solve_film(wp.from_torch(x, dtype=wp.vec3d), wp.zeros(nworld, dtype=int))

    @torch.no_grad()
    def solve_film(self, x: wp.array, due: wp.array) -> None:
        """Computes new impedances of the worlds that are due; x (nvert, nworld) wp.array of vec3d [m], due
        (nworld,) wp.array of int. Launches only: may be captured in a CUDA graph."""
        with contextlib.ExitStack() as stack:
            if self.device.is_cuda:  # in order with Warp's launches
                stream = wp.stream_to_torch(wp.get_stream(self.device))
                stack.enter_context(torch.cuda.stream(stream))
                stack.enter_context(torch.cuda.use_mem_pool(self._pool))
            self._solve(
                wp.to_torch(x).view(*x.shape, 3),
                wp.to_torch(due) != 0,
                wp.to_torch(self.impedance),
                wp.to_torch(self.valid),
            )

    def _solve(self, x, wanted, impedance, valid):
        u = (1e3 * (x.transpose(0, 1) - self._vert)).float()
        finite = torch.isfinite(u).all(dim=2).all(dim=1)
        change = self.model.log_change(torch.where(finite[:, None, None], u, 0))
        now = (wanted & finite)[:, None]
        impedance.copy_(torch.where(now, self._rest * change.double().exp(), impedance))
        valid.copy_(torch.where(wanted, finite.int(), valid))
