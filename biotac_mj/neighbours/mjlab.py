"""A BioTac as a sensor of mjlab's scenes.

    SceneCfg(sensors=(BioTacSensorCfg(name="biotac", body="robot/fingertip"),), ...)

The interface is that of mjlab.sensor's `SensorCfg` and `Sensor`, without import or inheritance: mjlab's scene
calls their methods. The skin has two-way coupling and is part of `mujoco_warp.step`.
"""

import dataclasses
import typing

import mujoco

from .. import batch
from .readings import BioTacData, world_mask

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw

__all__ = ["BioTacSensor", "BioTacSensorCfg"]


@dataclasses.dataclass(kw_only=True)
class BioTacSensorCfg:
    """Configuration of one BioTac in every world.

    Attributes:
      name: key in the scene and, with "_", prefix of all names added to the model.
      body, site: attachment, one of them, by its name in the scene, which begins with "ENTITY/".
      pos, quat: pose [m] of the BioTac frame there. skin, coupling, geoms: as for `batch.add`.
      settings: further arguments of `batch.attach`, such as {"material": "rubber", "seed": 1}.
    """

    name: str
    body: str | None = None
    site: str | None = None
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    skin: typing.Any = "coarse"
    coupling: str = "two-way"
    geoms: list | None = None
    settings: dict = dataclasses.field(default_factory=dict)

    @property
    def prefixed_name(self) -> str:
        """The sensor's name in the model."""
        return self.name

    def build(self) -> "BioTacSensor":
        """The sensor."""
        return BioTacSensor(self)


class BioTacSensor:
    """Made by `BioTacSensorCfg.build`.

    On CUDA mjlab captures its step before sensors are initialised: call `env.sim.create_graph()` once after
    the environment is made, else the captured step has no skin. The objects must be entities of the scene,
    and `SimulationCfg.njmax` must have room for six rows per touching body.
    """

    requires_sensor_context = False

    def __init__(self, cfg: BioTacSensorCfg):
        self.cfg, self.batch = cfg, None
        self._data, self._views = None, {}

    def edit_spec(self, scene_spec: mujoco.MjSpec, entities: dict) -> None:
        """Adds the BioTac to the scene; entities are not used.

        Raises:
          ValueError: see `batch.add`.
        """
        cfg = self.cfg
        batch.add(
            scene_spec,
            site=cfg.site,
            body=cfg.body,
            pos=cfg.pos,
            quat=cfg.quat,
            prefix=f"{cfg.name}_",
            skin=cfg.skin,
            coupling=cfg.coupling,
            geoms=cfg.geoms,
        )

    def initialize(self, mj_model: mujoco.MjModel, model: "mjw.Model", data: "mjw.Data", device: str) -> None:
        """Makes the skins and hooks them into mujoco_warp's Model, which is unwrapped from mjlab's bridge,
        like Data.

        Raises:
          ValueError: see `batch.attach`.
        """
        import mujoco_warp as mjw
        import warp as wp

        cfg, model, data = self.cfg, getattr(model, "struct", model), getattr(data, "struct", data)
        with wp.ScopedDevice(device):
            self.batch = batch.attach(
                mj_model,
                model,
                data,
                prefix=f"{cfg.name}_",
                skin=cfg.skin,
                coupling=cfg.coupling,
                geoms=cfg.geoms,
                **cfg.settings,
            )
            mjw.forward(model, data)  # allocates memory before the step is captured
            self.batch.reset()
        sensed = wp.to_torch(data.sensordata)
        for field in dataclasses.fields(BioTacData):
            sensor = mj_model.sensor(f"{cfg.name}_{field.name}")
            self._views[field.name] = sensed[:, sensor.adr[0] : sensor.adr[0] + sensor.dim[0]]

    @property
    def data(self) -> BioTacData:
        """Result of the last step, copied once per step."""
        if self._data is None:
            self._data = BioTacData(**{name: view.clone() for name, view in self._views.items()})
        return self._data

    def invalidate_cache(self) -> None:
        """Marks `data` for a new copy."""
        self._data = None

    def begin_control_step(self) -> None:
        """Does nothing: there are no sums over policy steps."""

    def update(self, dt: float) -> None:
        """Call after a step of `dt` [s]."""
        self.invalidate_cache()

    def reset(self, env_ids: object = None) -> None:
        """Resets skins and clocks of some worlds.

        Args:
          env_ids: indices, a slice, or None for all.
        """
        self.invalidate_cache()
        if self.batch is not None:
            self.batch.reset(world_mask(env_ids, self.batch.nworld))

    def debug_vis(self, visualizer: object) -> None:
        """Nothing is drawn."""
