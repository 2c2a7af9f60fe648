"""`ReadingsOptions`: where the counts of the electrodes come from, in MuJoCo, dm-control, batches and stored
motions."""

import dataclasses

from ...effects.sensors import take_sensor
from ...geometry.skin_geometry import SkinGeometry
from ...sensor.readings import check_settings
from ...sensor.signals import read_signal


@dataclasses.dataclass(frozen=True)
class ReadingsOptions:
    """Settings of a BioTac's readings, from the deformed skin to counts; not a sensor itself.

    For one BioTac these are the arguments of `attach(signal=, sensor=, randomise=, readings={...})`. This is
    for code that gives the same settings to several functions:

        options = ReadingsOptions(signal="learned", noise=False)
        biotac_mj.attach(spec, site="tip", **options.settings())  # so tasks.BioTac
        biotac_mj.batch.attach(mjm, m, d, readings=options.batch())  # `attach` takes this too
        options.readings(geometry)  # for a stored motion, without MuJoCo

    Attributes:
      signal: "physics": conduction in the liquid film; "latent_projection": the networks of Narang et al.
        (ICRA 2021), for every skin of the BioTac; "learned": a network on film and strain over each
        electrode, for the default skin; both trained on synthetic data (docs/lab/learning.md); or a file of
        `biotac learn train`, *.safetensors.
      sensor: which individual it is, see `sensor.presets.read_sensor`; None: the design's own. randomise: see
        `effects.sensors.RANDOM`.
      noise: of the acquisition. weights: of "learned", a file of `biotac learn train`; None takes the
        package's.
      film_every_step: see `sensor.acquisition.Acquisition.needs_impedance`.

    Raises:
      ValueError: unknown signal, weights for the physics, or a value that cannot be.
    """

    signal: str = "physics"
    sensor: str | dict | None = None
    noise: bool = True
    weights: str | None = None
    film_every_step: bool = False
    randomise: list | dict = ()

    def __post_init__(self):
        signal, weights = read_signal(self.signal, self.weights)
        object.__setattr__(self, "signal", signal)
        object.__setattr__(self, "weights", weights)
        given = {name: value for name, value in self.options().items() if name != "weights"}
        take_sensor(check_settings(given, what="ReadingsOptions"))

    def options(self) -> dict:
        """The value of `options["readings"]` of a model, or of `readings` of a batch."""
        out = {"noise": self.noise, "film_every_step": self.film_every_step}
        if self.sensor is not None:  # which leaves it to attach's own argument
            out["sensor"] = self.sensor
        if self.randomise:
            out["randomise"] = self.randomise
        return out if self.weights is None else out | {"weights": str(self.weights)}

    def settings(self, options: dict | None = None) -> dict:
        """Arguments for `biotac_mj.attach` and `tasks.BioTac`: readings and options; `options` are further
        ones to keep."""
        name = "biotac" if self.signal == "physics" else self.signal
        return {"readings": name, "options": {**(options or {}), "readings": self.options()}}

    def batch(self) -> dict:
        """Argument `readings` of `biotac_mj.batch.attach` and `make`."""
        return self.options() | ({} if self.signal == "physics" else {"signal": self.signal})

    def readings(self, geometry: SkinGeometry, seed: int = 0) -> object:
        """`PhysicsReadings`, for stored motions of one skin."""
        from ...sensor.readings import PhysicsReadings

        sensor, options, _ = take_sensor(self.options(), seed, geometry.design)
        film, weights = None, options.pop("weights", None)
        if self.signal != "physics":
            from ...learning.serve import NetworkFilm

            film = NetworkFilm(geometry, weights)
        return PhysicsReadings(geometry, seed=seed, sensor=sensor, film=film, **options)
