"""Learned film: electrodes from a network for a step of MuJoCo, of dm-control or of a batch."""

import functools
import pathlib
import typing

import numpy as np
import torch

from ..effects.sensors import take_sensor
from ..sensor.acquisition import Acquisition
from ..sensor.presets import Sensor, read_sensor
from ..sensor.readings import check_settings
from .weights import find_weights, load_forward, window_of

if typing.TYPE_CHECKING:
    import warp as wp

    from ..geometry.skin_geometry import SkinGeometry
    from .predictor import ForwardModel

__all__ = ["LearnedBatchFilm", "LearnedReadings", "NetworkFilm", "NetworkReadings"]


class NetworkFilm:
    """Replacement of `sensor.film.FilmConduction` for stored motions: a network without memory.

    Args:
      geometry, weights: as for `NetworkReadings`.

    Attributes:
      geometry: the skin. rest: (n,) impedance at rest [ohm].

    Raises:
      ValueError: a network with a window.
    """

    def __init__(self, geometry: "SkinGeometry", weights: pathlib.Path | str | None = None):
        path = find_weights(weights)
        self.geometry, self._model = geometry, load_forward(path, geometry)
        if self._model.window:
            raise ValueError(f"{path} has a window, which remembers: stored motions need a network without")
        self.rest = read_sensor(None, design=geometry.design).impedance

    def impedance(self, vert_xpos: np.ndarray) -> np.ndarray:
        """(n,) [ohm] for nodes (nvert, 3) [m]."""
        u = torch.as_tensor(1e3 * (vert_xpos - self.geometry.vert), dtype=torch.float32)
        return self.rest * np.exp(self._model.log_change(u[None])[0][0].double().numpy())


class NetworkReadings:
    """Counts of all channels: electrodes from a network, the others like `sensor.readings.PhysicsReadings`.
    The caller owns the state.

    Args:
      geometry: the skin.
      weights: file, or a name of `weights.SHIPPED`; None is "forward" (all are trained on synthetic data).
      seed, noise, sensor, film_every_step, temperature: as for `PhysicsReadings`; d ln Z is added to the
        baseline of `sensor`.

    Attributes:
      nstate: length of the state: the acquisition's, the time of the last film, and the network's window.
    """

    def __init__(
        self,
        geometry: "SkinGeometry",
        weights: pathlib.Path | str | None = None,
        seed: int = 0,
        noise: bool = True,
        sensor: str | dict | Sensor | None = None,
        film_every_step: bool = False,
        temperature: float | None = None,
    ):
        design = geometry.design
        sensor = read_sensor(sensor, seed, design)
        self.acquisition = Acquisition(seed, noise, film_every_step, sensor, sensor.impedance, design=design)
        self.temperature = temperature
        self._weights, self._geometry = find_weights(weights), geometry
        self._rest = sensor.impedance
        self._memory = window_of(self._weights, geometry)
        self.nstate = self.acquisition.nstate + 1 + int(np.prod(self._memory))

    @functools.cached_property
    def model(self) -> "ForwardModel":
        return load_forward(self._weights, self._geometry)

    def _parts(self, state):
        n = self.acquisition.nstate
        return state[:n], state[n : n + 1], state[n + 1 :]

    def reset(
        self, state: np.ndarray, pressure: float = 0.0, time: float = 0.0, sensor: Sensor | None = None
    ) -> None:
        """Writes the skin at rest into state (nstate,); from now on the sensor is `sensor`."""
        counts, last, memory = self._parts(state)
        acquisition = self.acquisition if sensor is None else self.acquisition.of(sensor)
        acquisition.reset(counts, self._rest, pressure, self.temperature, time)
        last[:], memory[:] = time, 0

    def advance(
        self, state: np.ndarray, time: float, dt: float, vert_xpos: np.ndarray, pressure: float
    ) -> None:
        """Samples (time, time + dt]; arguments and errors as `PhysicsReadings.advance`."""
        acquisition, last, memory = self._parts(state)
        impedance = None
        if self.acquisition.needs_impedance(acquisition, time, dt):
            vert_xpos = np.asarray(vert_xpos, float)
            if vert_xpos.shape != self._geometry.vert.shape:
                raise ValueError(
                    f"vert_xpos has shape {vert_xpos.shape}: this network reads {self._geometry.vert.shape}"
                )
            u = torch.as_tensor(1e3 * (vert_xpos - self._geometry.vert), dtype=torch.float32)[None]
            before = (
                torch.as_tensor(memory.reshape(1, *self._memory), dtype=torch.float32)
                if memory.size
                else None
            )
            change, after = self.model.log_change(u, before, time + dt - last[0])
            impedance = self._rest * np.exp(change[0].double().numpy())
        self.acquisition.advance(acquisition, time, dt, impedance, pressure, self.temperature)
        if impedance is not None:
            last[0] = time + dt
            if memory.size:
                memory[:] = after.numpy().ravel()

    def readings(self, state: np.ndarray) -> dict:
        """dict of counts, as `PhysicsReadings.readings`."""
        return self.acquisition.readings(self._parts(state)[0])


class LearnedReadings:
    """`NetworkReadings` with the coupling's `Readings` protocol; `config.options["readings"]` are its
    settings."""

    def __init__(self, config: typing.Any, geometry: "SkinGeometry"):
        if "film" in config.options:
            raise ValueError("a network replaces the film: leave options['film'] out")
        settings = check_settings(
            config.options.get("readings", {}), more={"weights": str | None}, design=geometry.design
        )
        self._settings, self._config, self._design = settings, config, geometry.design
        sensor, settings, _ = take_sensor(settings, config.own_seed(), geometry.design)
        self._network = NetworkReadings(geometry, seed=config.seed, sensor=sensor, **settings)
        self.nstate = self._network.nstate

    @functools.cached_property
    def rest(self) -> dict:
        state = np.zeros(self.nstate)
        self._network.reset(state)
        return self._network.readings(state)

    def reset(self, state: np.ndarray) -> None:
        self._network.reset(state)

    def draw(self, state: np.ndarray, seed: int) -> Sensor:
        """Resets to a randomly drawn sensor, if the settings are random."""
        sensor = take_sensor(self._settings, self._config.own_seed(seed), self._design)[0]
        self._network.reset(state, sensor=sensor)
        return sensor

    def advance(
        self, state: np.ndarray, time: float, dt: float, vert_xpos: np.ndarray, pressure: float
    ) -> dict:
        self._network.advance(state, time, dt, vert_xpos, pressure)
        return self._network.readings(state)


class LearnedBatchFilm:
    """Replacement of `sensor.film.BatchFilm`: impedances of `nworld` skins, on their device.

    Computes all worlds whenever one may be due, in single precision. Not capturable in a CUDA graph: torch
    launches are not Warp's.

    Args:
      geometry, weights, sensor: as for `NetworkReadings`. nworld: worlds. device: Warp device. dt: time
        between two solves, for the window [s].

    Attributes:
      impedance: (nworld, n) wp.array float64 [ohm]; valid: (nworld,) wp.array int; rest: (n,); nbytes;
        design. lasting: the arrays that persist between steps.
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
        self.lasting = [self.impedance, self.valid]
        if self._average is not None:
            self.lasting.append(wp.from_torch(self._average))
        self.nbytes = self.impedance.capacity + (0 if self._average is None else 4 * self._average.numel())

    @torch.no_grad()
    def solve_film(self, x: "wp.array", due: "wp.array") -> None:
        """Computes new impedances of the worlds that are due; x (nvert, nworld) wp.array of vec3d [m], due
        (nworld,) wp.array of int."""
        import contextlib

        import warp as wp

        cuda = self.device.is_cuda
        # synchronise with Warp's stream before and after
        with (
            torch.cuda.stream(wp.stream_to_torch(wp.get_stream(self.device)))
            if cuda
            else contextlib.nullcontext()
        ):
            wanted = wp.to_torch(due) != 0
            if bool(wanted.any()):
                self._solve(
                    wp.to_torch(x).view(*x.shape, 3),
                    wanted,
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
