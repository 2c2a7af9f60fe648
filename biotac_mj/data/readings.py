"""Impedances and counts of whole interactions, in worker processes: one reading of the film costs a core some
milliseconds."""

import contextlib
import dataclasses
import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor

import numpy as np
from threadpoolctl import threadpool_limits

from ..geometry.skin_geometry import SkinGeometry
from ..sensor.acquisition import Acquisition
from ..sensor.channels import CHANNELS, NELECTRODE
from ..sensor.film import FilmConduction
from .schema import DISPLACEMENT_SCALE

__all__ = ["Readings", "prepare_worker", "read_in_worker", "read_motion", "readings_pool", "sample"]

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclasses.dataclass
class Readings:
    """Of one interaction of n time steps.

    Attributes:
      impedance: (n, 19) [ohm]. counts: (n, 23) in the order of CHANNELS.
      failed: (n,) bool, steps whose film had no solution and kept the last one.
    """

    impedance: np.ndarray
    counts: np.ndarray
    failed: np.ndarray


def sample(
    time: np.ndarray, impedance: np.ndarray, pressure: np.ndarray, seed: int, temperature: float | None = None
) -> np.ndarray:
    """(n, 23) counts in the order of CHANNELS that the multiplexer reports at each time; of PAC's 22 the
    latest.

    Args:
      time: (n,) [s]; impedance: (n, 19) [ohm]; pressure: (n,) above rest [Pa]; linear between samples.
      seed: of the noise.
      temperature: (n,) of the core [C]; None is steady.
    """
    acquisition = Acquisition(seed=seed, film_every_step=True)
    state = np.zeros(acquisition.nstate)
    heat = {} if temperature is None else {"temperature": temperature[0]}
    acquisition.reset(state, impedance[0], pressure[0], time=time[0], **heat)
    frame = 0.011  # [s] one frame ahead of row 0, so that it has noise too
    rows = []
    for i in range(len(time)):
        before, dt = (time[0] - frame, frame) if i == 0 else (time[i - 1], time[i] - time[i - 1])
        heat = None if temperature is None else temperature[i]
        acquisition.advance(state, before, dt, impedance[i], pressure[i], heat)
        out = acquisition.readings(state)
        rows.append([*out["electrodes"], *(np.ravel(out[name])[-1] for name in CHANNELS[NELECTRODE:])])
    return np.array(rows, np.float32)


def read_motion(
    film: FilmConduction, vert_xpos: np.ndarray, time: np.ndarray, pressure: np.ndarray, seed: int
) -> Readings:
    """Film and acquisition along one interaction.

    Args:
      film: of the skin. vert_xpos: (n, nvert, 3) [m]. time: (n,) [s]. pressure: (n,) above rest [Pa]. seed:
        of the noise.
    """
    impedance, failed = np.empty((len(time), NELECTRODE)), np.zeros(len(time), bool)
    last = film.impedance(film.geometry.vert)
    for i, x in enumerate(vert_xpos):
        try:
            last = film.impedance(x)
        except ValueError:  # the skin has left an electrode or is folded
            failed[i] = True
        impedance[i] = last
    return Readings(impedance, sample(time, impedance, pressure, seed), failed)


_here = {}  # what a worker keeps: the film of the set's skin


def prepare_worker(geometry: SkinGeometry, sensor: str, rest_vert: np.ndarray | None = None) -> None:
    """Makes the film of a skin in this process; rest_vert (nvert, 3) [m] is where it rests on its filling."""
    _here["vert"] = geometry.vert
    rest = geometry if rest_vert is None else dataclasses.replace(geometry, vert=rest_vert)
    _here["film"] = FilmConduction(rest, sensor=sensor)


def read_in_worker(displacement: np.ndarray, time: np.ndarray, pressure: np.ndarray, seed: int) -> Readings:
    """`read_motion` with the worker's film; displacement (n, nvert, 3) int16 in units of the store."""
    film = _here["film"]
    return read_motion(film, _here["vert"] + displacement * DISPLACEMENT_SCALE, time, pressure, seed)


class _Now:
    """Runs what is submitted at once, in this process."""

    def submit(self, function, *args):
        future = Future()
        future.set_result(function(*args))
        return future


@contextlib.contextmanager
def readings_pool(
    geometry: SkinGeometry,
    sensor: str | None,
    workers: int,
    start: Callable = prepare_worker,
    start_args: tuple | None = None,
) -> object:
    """Gives an executor whose processes hold the film of a skin (`start(*start_args)` may prepare more); 0
    workers: this process.

    New processes are spawned, since CUDA does not survive a fork.
    """
    args = (geometry, sensor) if start_args is None else start_args
    if not workers:
        start(*args)
        with threadpool_limits(
            1, "blas"
        ):  # as in the workers, so that the numbers are the same to the last bit
            yield _Now()
        return
    kept = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))  # workers inherit them: one core each
    try:
        with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), start, args) as pool:
            yield pool
    finally:
        for name, value in kept.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
