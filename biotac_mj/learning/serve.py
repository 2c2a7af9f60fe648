"""Learned film: electrodes from a network for a step of MuJoCo, of dm-control or of a batch."""

import functools
import pathlib
import typing

import numpy as np
import torch

from ..sensor.presets import Sensor, read_sensor
from .weights import find_weights, load_forward, window_of

if typing.TYPE_CHECKING:
    import warp as wp

    from ..geometry.skin_geometry import SkinGeometry
    from .predictor import ForwardModel

__all__ = ["LearnedBatchFilm", "NetworkFilm"]


class NetworkFilm:
    """Electrodes from a network, in the place of `sensor.film.FilmConduction`.

    Args:
      geometry: the skin.
      weights: file, or a name of `weights.SHIPPED`; None is "forward" (all are trained on synthetic data).

    Attributes:
      geometry: the skin. rest: (n,) impedance at rest [ohm].
      nstate: length of the state of a network with a window: the time of its last step, and its averages; 0
        without.
    """

    def __init__(self, geometry: "SkinGeometry", weights: pathlib.Path | str | None = None):
        self._weights, self.geometry = find_weights(weights), geometry
        self._memory = window_of(self._weights, geometry)
        size = int(np.prod(self._memory))
        self.nstate = 1 + size if size else 0
        self.rest = read_sensor(None, design=geometry.design).impedance

    @functools.cached_property
    def model(self) -> "ForwardModel":
        return load_forward(self._weights, self.geometry)

    def impedance(self, vert_xpos: np.ndarray) -> np.ndarray:
        """(n,) [ohm] for nodes (nvert, 3) [m]; of a network with a window, of a skin that stays there."""
        return self.rest * np.exp(self.model.log_change(self._change(vert_xpos))[0][0].double().numpy())

    def follow(self, state: np.ndarray, time: float, vert_xpos: np.ndarray) -> np.ndarray:
        """Likewise at `time` [s] of a motion, for a network with a window; updates its state (nstate,), which
        is (time, 0, ...) for a skin that was at rest."""
        before = torch.as_tensor(state[1:].reshape(1, *self._memory), dtype=torch.float32)
        change, after = self.model.log_change(self._change(vert_xpos), before, time - state[0])
        state[0], state[1:] = time, after.numpy().ravel()
        return self.rest * np.exp(change[0].double().numpy())

    def _change(self, vert_xpos):
        vert_xpos = np.asarray(vert_xpos, float)
        if vert_xpos.shape != self.geometry.vert.shape:
            raise ValueError(
                f"vert_xpos has shape {vert_xpos.shape}: this network reads {self.geometry.vert.shape}"
            )
        return torch.as_tensor(1e3 * (vert_xpos - self.geometry.vert), dtype=torch.float32)[None]


class LearnedBatchFilm:
    """Replacement of `sensor.film.BatchFilm`: impedances of `nworld` skins, on their device.

    Computes all worlds whenever one is due, in single precision. Capturable in a CUDA graph: torch's memory
    comes from a pool of its own, which lives as long as this object.

    Args:
      geometry, weights: as for `NetworkFilm`. sensor: whose rest it reads. nworld: worlds. device: Warp
        device. dt: time between two solves, for the window [s].

    Attributes:
      impedance: (nworld, n) wp.array float64 [ohm]; valid: (nworld,) wp.array int; rest: (n,); nbytes;
        design. lasting: the arrays that persist between steps. remembers: whether the network has a window.
    """

    def __init__(
        self,
        geometry: "SkinGeometry",
        nworld: int,
        device: str = "cpu",
        weights: pathlib.Path | str | None = None,
        sensor: str | Sensor | None = None,
        dt: float = 0.01,
    ):
        import warp as wp

        self.device, self._dt = wp.get_device(device), dt
        torch_device = wp.device_to_torch(self.device)
        self.model = load_forward(find_weights(weights), geometry).to(torch_device)
        self.design = geometry.design
        self.rest = read_sensor(sensor, design=self.design).impedance
        with wp.ScopedDevice(self.device):
            self.impedance = wp.array(np.tile(self.rest, (nworld, 1)), dtype=wp.float64)
            self.valid = wp.ones(nworld, dtype=int)
        self._rest = torch.as_tensor(self.rest, device=torch_device)
        self._vert = torch.as_tensor(geometry.vert, device=torch_device)
        self._average = (
            torch.zeros(nworld, *self.model.memory, device=torch_device) if self.model.window else None
        )
        self.remembers = bool(self.model.window)
        self.lasting = [self.impedance, self.valid]
        if self._average is not None:
            self.lasting.append(wp.from_torch(self._average))
        self.nbytes = self.impedance.capacity + (0 if self._average is None else 4 * self._average.numel())
        self._pool = torch.cuda.MemPool() if self.device.is_cuda else None
        if self.device.is_cuda:  # torch's libraries take their memory before a capture begins
            x = self._vert[:, None].expand(-1, nworld, -1).contiguous()
            with wp.ScopedDevice(self.device):
                self.solve_film(wp.from_torch(x, dtype=wp.vec3d), wp.zeros(nworld, dtype=int))

    @torch.no_grad()
    def solve_film(self, x: "wp.array", due: "wp.array") -> None:
        """Computes new impedances of the worlds that are due; x (nvert, nworld) wp.array of vec3d [m], due
        (nworld,) wp.array of int. Launches only: may be captured in a CUDA graph."""
        import contextlib

        import warp as wp

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
        change, average = self.model.log_change(
            torch.where(finite[:, None, None], u, 0), self._average, self._dt
        )
        now = wanted & finite
        if self._average is not None:
            self._average.copy_(torch.where(now[:, None, None, None], average, self._average))
        impedance.copy_(torch.where(now[:, None], self._rest * change.double().exp(), impedance))
        valid.copy_(torch.where(wanted, finite.int(), valid))
