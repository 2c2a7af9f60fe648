"""`Handle`: an attached BioTac, read from mjData; `handles` finds those of any model."""

import dataclasses
import typing
import weakref

import mujoco
import numpy as np

from ..effects.sensors import take_sensor
from ..fields import as_whole, check_choice
from ..geometry.design import BIOTAC, Design
from ..geometry.skins import design_of
from ..geometry.surface import face_areas, node_areas
from ..sensor.presets import Sensor
from ..short_repr import short_repr
from .config import Config
from .setup import Setup
from .structs import ModelView

SENSORS = (*BIOTAC.widths, "contact_force", "status")


def sensor_widths(design: Design = BIOTAC) -> dict[str, int]:
    """{name of SENSORS: numbers of it in mjData.sensordata}."""
    return {**design.widths, "contact_force": 6, "status": 8}


@dataclasses.dataclass(frozen=True)
class Handle:
    """Names and addresses of an attached BioTac in its model.

    Attributes:
      prefix, suffix: of all its names. `MjSpec.attach` of another spec changes them: `handles` has the new
        ones.
      body: name of its body, whose frame is the BioTac frame.
      config: its settings.
    """

    prefix: str
    body: str
    config: Config
    suffix: str = ""

    @property
    def design(self) -> Design:
        """Design of the fingertip: names and numbers of its channels."""
        return design_of(self.config.skin)

    def sensor_name(self, channel: str) -> str:
        """Name of a channel's sensor in the model: of electrodes, pdc, pac, tac, tdc, contact_force or
        status.

        Raises:
          ValueError: no such channel.
        """
        own = [name for name, n in sensor_widths(self.design).items() if n]
        check_choice(f"a {self.design.title} has no channel", channel, own)
        return self.prefix + channel + self.suffix

    @typing.overload
    def read(self, data: mujoco.MjData, channel: str) -> np.ndarray: ...

    @typing.overload
    def read(self, data: mujoco.MjData, channel: None = None) -> dict[str, np.ndarray]: ...

    def read(self, data: mujoco.MjData, channel: str | None = None) -> np.ndarray | dict[str, np.ndarray]:
        """Copy of a channel's present values in mjData, or of all channels: {channel: values}. Counts;
        contact_force is force [N] and torque [N m] on the BioTac in its frame, as they act in the step (with
        RK4, after mj_step, over its four stages), on its skin and on core, nail and clamp; status is
        (converged: 1, 0, or -1 after an error; steps that did not converge; iterations; residual; tier: 0
        full, 1 condensed, -1 where its error has not been measured; rounds through MuJoCo's solver;
        fraction of the bodies' motion for which the skin was solved; fraction of its push on a body that was
        withheld): see docs/lab/coupling.md.

        Raises:
          ValueError: no such channel, or the data are of a model without this BioTac. TypeError: data is no
            MjData.
        """
        if channel is None:
            return {name: self.read(data, name) for name, n in sensor_widths(self.design).items() if n}
        name = self.sensor_name(channel)
        if not hasattr(data, "sensordata"):
            raise TypeError(f"data is {type(data).__name__}: pass the MjData that is stepped")
        try:
            return np.array(data.sensor(name).data)
        except KeyError:
            raise ValueError(
                f"the data's model has no sensor {name!r}: pass the MjData of the model that this BioTac was "
                "attached to; biotac_mj.handles(model) has those that a model holds"
            ) from None

    @property
    def numbers(self) -> Sensor:
        """The sensor's own numbers by its settings: rest counts, noise, levels."""
        settings = self.config.options.get("readings", {})
        return take_sensor(settings, self.config.own_seed(), self.design)[0]

    def draw(self, model: mujoco.MjModel, data: mujoco.MjData, seed: int) -> Sensor | None:
        """Puts another sensor at rest in the place of this one, until the next reset, where the settings
        leave it open (`sensor="random"`, `randomise`, lists of materials or textures); all of it lies in
        mjData.plugin_state. The next mj_forward or mj_step shows it.

        Args:
          seed: which one, 0 .. 2**64 - 1.

        Returns:
          its parameters; None if the readings have no individual sensors.

        Raises:
          ValueError: a seed that cannot be, or model or data without this BioTac. TypeError: no MjModel and
            MjData.
        """
        seed = as_whole("seed", seed, 0, 2**64 - 1)
        setup, (*_, own) = self._parts(model, data)
        if not hasattr(setup.skin.readings, "draw"):
            return None
        with setup.skin.lock:
            return setup.skin.readings.draw(own, seed)

    def _parts(self, model, data):
        """Its setup, and the parts of its state."""
        model, data = _bare(model), _bare(data)
        if not isinstance(model, mujoco.MjModel) or not isinstance(data, mujoco.MjData):
            raise TypeError(
                f"model is {type(model).__name__} and data is {type(data).__name__}: pass the MjModel and "
                "its MjData"
            )
        if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, self.body) < 0:
            raise ValueError(
                f"the model has no body {self.body!r}: pass the one that this BioTac was attached to; "
                "biotac_mj.handles(model) has those that a model holds"
            )
        if len(data.plugin_state) != model.npluginstate:
            raise ValueError("the data are of another model: pass MjModel and MjData that belong together")
        index = int(model.body_plugin[model.body(self.body).id])
        setup, start = _setup(model, index), model.plugin_stateadr[index]
        return setup, setup.parts(data.plugin_state[start : start + setup.nstate])

    def vert_xpos(self, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
        """Nodes of the skin (nvert, 3) [m] in the BioTac frame, as the last step left them."""
        setup, (_, _, state, _) = self._parts(model, data)
        return setup.skin.stepper.vert_xpos(state).copy()

    def linear_model(
        self, model: mujoco.MjModel, data: mujoco.MjData
    ) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """Linear model of the skin's response to motions of the bodies that it may touch, from the last step:
        {number of the body: (wrench, tangent)}. wrench: (6,) on the body, force [N] and torque about the
        BioTac frame's origin [N m], in that frame. tangent: (6, 6) -d wrench / d (translation [m], rotation
        vector about the origin [rad]), its symmetric positive part, as the step's implicit coupling takes it;
        zero where nothing touches. All bodies keep still but one.

        Raises:
          ValueError, TypeError: see `draw`.
        """
        setup, (_, models, *_) = self._parts(model, data)
        bodies = setup.touching.body
        return {
            int(body): tuple(models[bodies == body][name].sum(axis=0) for name in ("wrench0", "tangent0"))
            for body in bodies
        }

    def contact_pressure(
        self, model: mujoco.MjModel, data: mujoco.MjData, of: str = "nodes"
    ) -> np.ndarray | None:
        """Pressure [Pa] with which bodies push on the outer surface, as the last step left it; 0 elsewhere.

        Args:
          of: "nodes": (nvert,), a node stands for a third of the faces around it. "faces": (nface,) of the
            geometry's `outer_face`. A sharp edge or corner pushes on single faces, along their normals:
            pressure times area adds up to its force over the faces, while the mean normals of the nodes
            differ from theirs.

        Returns:
          None of a skin of one's own that does not say (`SkinStepper.contact_force`, `contact_push`).

        Raises:
          ValueError: another `of`.
        """
        if of not in ("nodes", "faces"):
            raise ValueError(f"of is {short_repr(of)}: pass 'nodes' or 'faces'")
        setup, (_, _, state, _) = self._parts(model, data)
        stepper, face = setup.skin.stepper, setup.skin.geometry.outer_face
        push = stepper.contact_force if of == "nodes" else stepper.contact_push
        with setup.skin.lock:
            force = push(state)
        if force is None:
            return None
        across = face_areas(stepper.vert_xpos(state), face)
        if of == "faces":
            return force / np.linalg.norm(across, axis=1)
        area = node_areas(face, across, len(force))
        return -(force * area).sum(1) / np.maximum((area**2).sum(1), np.finfo(float).tiny)


def _bare(one):
    """MuJoCo's own object behind dm_control's wrapper of the same name."""
    return getattr(one, "ptr", one)


_setups = weakref.WeakKeyDictionary()  # of each living model


def _setup(model, index):
    setups = _setups.setdefault(model, {})
    if index not in setups:
        setups[index] = Setup(ModelView(model._address), index)
    return setups[index]


def handles(model: mujoco.MjModel) -> dict[str, Handle]:
    """Handles of all BioTacs of a compiled model, as `attach` would return them now: of a model that was
    loaded from a file, or whose spec went into another one by `MjSpec.attach`, which changes the names.

    Returns:
      {prefix: Handle}, in the order of the model's bodies; where names have a suffix too, {prefix + suffix:
      Handle}.

    Raises:
      TypeError: model is no MjModel. ValueError: a BioTac's settings in the model cannot be.
    """
    model = _bare(model)
    if not isinstance(model, mujoco.MjModel):
        raise TypeError(f"model is {type(model).__name__}: pass the compiled MjModel")
    view, out = ModelView(model._address), {}
    for body in np.flatnonzero(model.body_plugin >= 0):
        index = int(model.body_plugin[body])
        if not view.config(index, "skin"):  # another plugin's
            continue
        name = model.body(body).name
        prefix, _, suffix = name.rpartition("core")
        config = Config.parse(lambda attribute, index=index: view.config(index, attribute))
        out[prefix + suffix] = Handle(prefix, name, config, suffix)
    return out
