"""The sensor of `biotac_mj.sensor` as the coupling's `Readings`."""

import functools

import numpy as np

__all__ = ["SensorReadings"]


class SensorReadings:
    """Counts of a real sensor's channels from the film's conduction and the liquid's pressure.

    `config.options["sensor"]` holds further arguments of `PhysicsReadings`, for example {"noise": False}.
    """

    def __init__(self, config, geometry):
        self._arguments = dict(config.options.get("sensor", {}))
        self._seed, self._geometry = config.seed, geometry

    @functools.cached_property
    def _sensor(self):
        from ..sensor import PhysicsReadings

        try:
            return PhysicsReadings(self._geometry, seed=self._seed, **self._arguments)
        except TypeError as error:
            raise ValueError(f"options['sensor'] of the BioTac: {error}; see biotac_mj.sensor.PhysicsReadings") from error

    @property
    def nstate(self):
        return self._sensor.nstate

    @functools.cached_property
    def rest(self):
        """Counts at rest."""
        state = np.zeros(self.nstate)
        self._sensor.reset(state)
        return self._sensor.readings(state)

    def reset(self, state):
        self._sensor.reset(state)

    def advance(self, state, time, dt, vert_xpos, pressure):
        self._sensor.advance(state, time, dt, vert_xpos, pressure)
        return self._sensor.readings(state)
