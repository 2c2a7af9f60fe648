"""Impedances and counts of whole interactions, in worker processes: one evaluation of the film takes some
milliseconds on a core."""

import contextlib
import dataclasses
import multiprocessing
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor

import numpy as np
from threadpoolctl import threadpool_limits

from ...geometry.design import BIOTAC, SINGLES, Design
from ...geometry.skin_geometry import SkinGeometry
from ...sensor.acquisition import Acquisition
from ...sensor.acquisition_kernels import SLOT_RATE
from ...sensor.film import FilmConduction
from ...sensor.materials import Material
from ...sensor.presets import SENSORS, Sensor, read_sensor
from ...sensor.readings import PhysicsReadings
from ...sensor.signals import read_signal
from ...sensor.vibration import Modes, Texture, Vibration
from ...shards import added_to_environment, end_with_parent
from ..schema import DISPLACEMENT_SCALE

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclasses.dataclass
class Readings:
    """Readings of one interaction of n time steps.

    Attributes:
      impedance: (n, nelectrode) [ohm]. counts: (n, nchannel) in the order of the design's channels. pac:
        (n, npac) counts of the last frame in the order of time.
      failed: (n,) bool, steps without a solution of the film, which keep the last one.
    """

    impedance: np.ndarray
    counts: np.ndarray
    pac: np.ndarray
    failed: np.ndarray


@dataclasses.dataclass(frozen=True)
class Sense:
    """Sensor and touched object of one interaction.

    Attributes:
      sensor: its constants; None: the design's own.
      body: material of the object, for heat; texture: of its surface, for vibration; None: no heat, no
        vibration.
      modes: of the skin, for vibration.
    """

    sensor: Sensor | None = None
    body: Material | None = None
    texture: Texture | None = None
    modes: Modes | None = None


@dataclasses.dataclass(frozen=True)
class Touch:
    """Contact of the object with the skin in n time steps, see `skin.touched.Touched`.

    Attributes:
      area: (n,) [m^2]; force: (n,) [N]; slip: (n,) [m/s]; drive: (n, nmode); gain: (n, nmode + 1).
    """

    area: np.ndarray
    force: np.ndarray
    slip: np.ndarray
    drive: np.ndarray
    gain: np.ndarray


def in_order(pac: np.ndarray, time: float) -> np.ndarray:
    """(npac,) samples of the frame's slots in order of time, the last one at or before time [s]."""
    slot = (int(np.floor(time * SLOT_RATE + 1e-6)) - 1) % (2 * len(pac))
    return np.roll(pac, -1 - slot // 2)


def _row(readings, time):
    """(nchannel,) counts in the order of the channels, the latest of PAC, and PAC of a frame (npac,)."""
    pac = in_order(readings["pac"], time)
    singles = [pac[-1] if name == "pac" else readings[name] for name in SINGLES]
    return [*readings["electrodes"], *singles], pac


def sample(
    time: np.ndarray,
    impedance: np.ndarray,
    pressure: np.ndarray,
    seed: int,
    temperature: float | None = None,
    sensor: Sensor = SENSORS["1"],
    design: Design = BIOTAC,
) -> tuple[np.ndarray, np.ndarray]:
    """(n, nchannel) counts of the multiplexer at each time, in the order of the design's channels, with the
    latest of PAC, and (n, npac) all PAC samples of the last frame in order of time.

    Args:
      time: (n,) [s]; impedance: (n, nelectrode) [ohm]; pressure: (n,) above rest [Pa]; linear between
        samples.
      seed: of the noise.
      temperature: (n,) of the core [C]; None is constant. sensor: of noise and levels.
    """
    acquisition = Acquisition(seed=seed, film_every_step=True, sensor=sensor, design=design)
    state = np.zeros(acquisition.nstate)
    heat = {} if temperature is None else {"temperature": temperature[0]}
    acquisition.reset(state, impedance[0], pressure[0], time=time[0], **heat)

    def advance(i, before, dt):
        heat = None if temperature is None else temperature[i]
        acquisition.advance(state, before, dt, impedance[i], pressure[i], heat)
        return acquisition.readings(state)

    return _rows(time, design, advance)


def _rows(time, design, advance):
    """Counts (n, nchannel) and PAC (n, npac) at times (n,), from the readings after `advance(row, start,
    length)` of each step; one frame before row 0 gives it noise."""
    frame = round(design.slots / SLOT_RATE + 1e-3, 6)  # [s], plus one sample
    steps = [(time[0] - frame, frame), *zip(time[:-1], np.diff(time))]
    rows = [_row(advance(i, *one), time[i]) for i, one in enumerate(steps)]
    return tuple(np.array(part, np.float32) for part in zip(*rows))


def read_motion(
    film: FilmConduction,
    vert_xpos: np.ndarray,
    time: np.ndarray,
    pressure: np.ndarray,
    seed: int,
    sense: Sense = Sense(),
    touch: Touch | None = None,
    rest: np.ndarray | None = None,
) -> Readings:
    """Film, heat, vibration and acquisition along one interaction.

    Args:
      film: of the skin. vert_xpos: (n, nvert, 3) [m]. time: (n,) [s]. pressure: (n,) above rest [Pa].
      seed: of the noise. sense: sensor and object. touch: contact, for heat and vibration.
      rest: (nvert, 3) rest positions of the skin if not the film's [m]: there the readings are the film's at
        rest.
    """
    scale = 1.0 if rest is None else film.rest / film.impedance(rest)
    design = film.geometry.design
    impedance, failed = np.empty((len(time), design.nelectrode)), np.zeros(len(time), bool)
    last = film.rest
    for i, x in enumerate(vert_xpos):
        try:
            last = scale * film.impedance(x)
        except ValueError:  # an electrode without film, or a folded skin
            failed[i] = True
        impedance[i] = last
    bodies = None if sense.body is None else [sense.body]
    textures = None if sense.texture is None else [sense.texture]
    sound = None if textures is None else Vibration(sense.modes, textures, seed=seed)
    more = {"film": film, "film_every_step": True, "vibration": sound, "textures": textures}
    sensor = read_sensor(sense.sensor, design=design)
    physics = PhysicsReadings(film.geometry, seed, sensor=sensor, bodies=bodies, **more)
    state = np.zeros(physics.nstate)
    physics.reset(state, pressure=pressure[0], time=time[0], impedance=impedance[0])

    def advance(i, before, dt):
        felt = {}
        if bodies is not None:
            felt = {"area": touch.area[i : i + 1], "force": touch.force[i : i + 1]}
        if textures is not None:
            one = slice(i, i + 1)
            felt["shaking"] = touch.drive[i], touch.gain[one], touch.slip[one], touch.area[one]
        physics.advance(state, before, dt, None, pressure[i], impedance=impedance[i], **felt)
        return physics.readings(state)

    return Readings(impedance, *_rows(time, design, advance), failed)


_here = {}  # a worker's state: the film of the set's skin


def prepare_worker(
    geometry: SkinGeometry,
    rest_vert: np.ndarray | None = None,
    film: dict | None = None,
    signal: str = "physics",
) -> None:
    """Makes the film of a skin, or the network in its place, in this process.

    Args:
      rest_vert: (nvert, 3) rest positions of the filled skin [m]. film: settings of FilmConduction.
      signal: see `sensor.signals.read_signal`.
    """
    _here["vert"] = geometry.vert
    rest = geometry if rest_vert is None else dataclasses.replace(geometry, vert=rest_vert)
    kind, weights = read_signal(signal)
    if kind == "physics":
        _here["film"] = FilmConduction(rest, **(film or {}))
    else:
        from ...learning.serve import NetworkFilm

        _here["film"] = NetworkFilm(rest, weights)


def read_in_worker(
    displacement: np.ndarray,
    time: np.ndarray,
    pressure: np.ndarray,
    seed: int,
    sense: Sense = Sense(),
    touch: Touch | None = None,
    rest: np.ndarray | None = None,
) -> Readings:
    """`read_motion` with the worker's film; displacement (n, nvert, 3) int16 in units of the store, rest
    (nvert, 3) that of the skin at rest [m]."""
    vert = _here["vert"]
    at_rest = None if rest is None else vert + rest
    moved = vert + displacement * DISPLACEMENT_SCALE
    return read_motion(_here["film"], moved, time, pressure, seed, sense, touch, at_rest)


def _start_worker(start, args):
    end_with_parent()
    start(*args)


class _Now:
    """Executor that runs submitted work at once, in this process."""

    def submit(self, function, *args):
        future = Future()
        future.set_result(function(*args))
        return future


@contextlib.contextmanager
def readings_pool(
    geometry: SkinGeometry, workers: int, start: Callable = prepare_worker, start_args: tuple | None = None
) -> object:
    """An executor whose processes hold the film of a skin (`start(*start_args)` may prepare more); 0 workers:
    this process.

    New processes are spawned, since CUDA does not survive a fork.
    """
    args = (geometry,) if start_args is None else start_args
    if not workers:
        start(*args)
        with threadpool_limits(1, "blas"):  # one thread as in the workers, so that the results are bit-equal
            yield _Now()
        return
    spawned = multiprocessing.get_context("spawn")
    with (
        added_to_environment(dict.fromkeys(THREADS, "1")),  # workers inherit it: one core each
        ProcessPoolExecutor(workers, spawned, _start_worker, (start, args)) as pool,
    ):
        try:
            yield pool
        except BaseException:  # pending readings are not needed
            pool.shutdown(wait=False, cancel_futures=True)
            raise
