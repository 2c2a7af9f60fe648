"""BioTacs in MJX: `put_model`, `make_data` and `step` with the names and data of `mujoco.mjx`, which can be
jitted, scanned and vmapped. A step is one call of `mujoco_warp.step` with the skins (`batch`), through Warp's
interface to JAX's foreign functions, as in the Warp back end of MJX.

The whole state is in `Data`, so that steps are pure functions: equal data gives equal results, to the bit.
JAX traces `step` for one world; `vmap` makes a batch of worlds."""

import dataclasses
import functools
import inspect
import pathlib
import typing

import mujoco
import numpy as np
import warp as wp

from . import batch
from .batch.attach import core_of
from .batch.rows import Rows
from .coupling.handle import SENSORS
from .coupling.settings import SettingKeywords, Settings
from .fields import as_whole

if typing.TYPE_CHECKING:
    import jax

__all__ = ["Data", "Model", "forward", "make_data", "put_model", "readings", "step"]


@dataclasses.dataclass(frozen=True)
class Data:
    """One world, or after `jax.vmap` many of them with one more axis in front: a pytree of JAX's arrays in
    single precision, by the names of `mujoco.mjx.Data`.

    Attributes:
      time: () [s]. qpos (nq,), qvel (nv,), act (na,), history (nhistory,), qacc_warmstart (nv,), ctrl (nu,),
        qfrc_applied (nv,), xfrc_applied (nbody, 6), eq_active (neq,) bool, mocap_pos (nmocap, 3), mocap_quat
        (nmocap, 4), userdata (nuserdata,): the state and what acts on it.
      sensordata: (nsensordata,), with the BioTacs' channels, see `readings`.
      skins: (n,) uint32, all that skins and sensors carry from step to step, as words of 32 bits.
      qacc (nv,), xpos (nbody, 3), xquat (nbody, 4), xmat (nbody, 3, 3), xipos (nbody, 3), ximat
        (nbody, 3, 3), xanchor (njnt, 3), xaxis (njnt, 3), geom_xpos (ngeom, 3), geom_xmat (ngeom, 3, 3),
        site_xpos (nsite, 3), site_xmat (nsite, 3, 3), subtree_com (nbody, 3), cvel (nbody, 6),
        actuator_length (nu,), actuator_velocity (nu,), actuator_force (nu,), qfrc_actuator, qfrc_bias,
        qfrc_passive and qfrc_constraint (nv,): what the last `step` or `forward` found of it; zero before.
      overflow: () int, where contacts or constraints had no room: mujoco_warp's OverflowType.
    """

    time: "jax.Array"
    qpos: "jax.Array"
    qvel: "jax.Array"
    act: "jax.Array"
    history: "jax.Array"
    qacc_warmstart: "jax.Array"
    ctrl: "jax.Array"
    qfrc_applied: "jax.Array"
    xfrc_applied: "jax.Array"
    eq_active: "jax.Array"
    mocap_pos: "jax.Array"
    mocap_quat: "jax.Array"
    userdata: "jax.Array"
    sensordata: "jax.Array"
    skins: "jax.Array"
    qacc: "jax.Array"
    xpos: "jax.Array"
    xquat: "jax.Array"
    xmat: "jax.Array"
    xipos: "jax.Array"
    ximat: "jax.Array"
    xanchor: "jax.Array"
    xaxis: "jax.Array"
    geom_xpos: "jax.Array"
    geom_xmat: "jax.Array"
    site_xpos: "jax.Array"
    site_xmat: "jax.Array"
    subtree_com: "jax.Array"
    cvel: "jax.Array"
    actuator_length: "jax.Array"
    actuator_velocity: "jax.Array"
    actuator_force: "jax.Array"
    qfrc_actuator: "jax.Array"
    qfrc_bias: "jax.Array"
    qfrc_passive: "jax.Array"
    qfrc_constraint: "jax.Array"
    overflow: "jax.Array"

    def replace(self, **changes: typing.Any) -> "Data":
        """A copy with other values of some attributes."""
        return dataclasses.replace(self, **changes)


_FIELDS = tuple(field.name for field in dataclasses.fields(Data))
_SKINS = _FIELDS.index("skins")
_READ = _FIELDS[:_SKINS]  # by a step, of mujoco_warp's Data; the rest it only writes
_WRITTEN = tuple(name for name in _FIELDS if name != "skins")


class Model:
    """A model with BioTacs, for `step`, made by `put_model`. It is a constant for JAX: its numbers are not
    traced, and equal in all worlds.

    Attributes:
      mjm: the MjModel.
      rest: {field of Data: (1, ...)}, the initial state of a world. draws: what seeds draw in words of its
        skins, see `batch.rows.Rows`.
    """

    def __init__(self, mjm: mujoco.MjModel, prefixes: tuple, room: dict, settings: dict, device: str):
        self.mjm, self._prefixes, self._room = mjm, prefixes, room
        self._settings, self._device, self._worlds = settings, device, {}
        self.rest, self.draws = self.worlds(1).rest(), self.worlds(1).rows.draws

    def worlds(self, nworld: int) -> "_Worlds":
        """mujoco_warp's Model and Data of `nworld` worlds with their BioTacs, made at the first call."""
        if nworld not in self._worlds:
            made = self.mjm, nworld, self._prefixes, self._room, self._settings, self._device
            self._worlds[nworld] = _Worlds(*made)
        return self._worlds[nworld]

    @functools.cached_property
    def functions(self) -> dict:
        """JAX functions of the leaves of a Data, by name."""
        return {name: _function(self, name) for name in ("step", "forward")}


def put_model(
    mjm: mujoco.MjModel,
    *,
    prefix: str | tuple[str, ...] = "biotac_",
    nconmax: int | None = None,
    njmax: int | None = None,
    settings: Settings | dict | str | pathlib.Path | None = None,
    **keywords: typing.Unpack[SettingKeywords],
) -> Model:
    """A model for `step`, in place of `mjx.put_model`.

    Args:
      mjm: an MjModel made from a spec that `batch.add` changed.
      prefix: as given to `batch.add`; of several BioTacs one each.
      nconmax, njmax: most contacts and constraint rows of a world; None: mujoco_warp's choice for the model
        in its reference pose.
      settings, keywords: of every BioTac, as for `batch.attach`; equal in all worlds, except for the seed, an
        argument of `make_data`.

    Raises:
      ValueError, TypeError: see `batch.attach`. ModuleNotFoundError: JAX or mujoco_warp is missing.
    """
    try:
        import jax
        import mujoco_warp  # noqa: F401
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{error}: pip install 'biotac-mj[mjx]'", name=error.name) from error
    if "seed" in keywords:
        raise ValueError("seed is of a world here: give it to make_data")
    _register()
    prefixes = (prefix,) if isinstance(prefix, str) else tuple(prefix)
    device = "cuda:0" if jax.default_backend() == "gpu" else "cpu"
    room = {"nconmax": nconmax, "njmax": njmax}
    return Model(mjm, prefixes, room, {"settings": settings, **keywords}, device)


def make_data(model: Model, seed: "jax.typing.ArrayLike" = 0) -> Data:
    """The initial state of a world, in place of `mjx.make_data`: MuJoCo's reference pose, skins and sensors
    without contact. It can be vmapped over seeds.

    Args:
      model: of `put_model`.
      seed: integer from 0 to 2**32 - 1, of the noise of the world's sensors, and of the draws of
        `sensor="random"`, `randomise` and lists of `thermal` and `textures`: those of `batch.attach(seed=)`.

    Raises:
      ValueError: another seed; of a traced one its type alone is known.
    """
    import jax
    import jax.numpy as jnp

    if not isinstance(seed, jax.core.Tracer):
        seed = as_whole("seed", np.asarray(seed).tolist(), 0, 2**32 - 1)
    elif seed.dtype.kind not in "iu":
        raise ValueError(f"seed is of {seed.dtype}: pass integers")
    fields = {name: jnp.asarray(value[0]) for name, value in model.rest.items()}
    row, seed = fields["skins"], jnp.asarray(seed, jnp.uint32)
    for at_seed, places, words in model.draws:
        if len(places):
            like = jax.ShapeDtypeStruct(places.shape, np.uint32)
            row = row.at[places].set(jax.pure_callback(words, like, seed, vmap_method="sequential"))
        row = row.at[at_seed].set(seed)  # the lower word: the upper one is of the BioTac's name
    return Data(**{**fields, "skins": row})


def step(model: Model, data: Data) -> Data:
    """The next state, in place of `mjx.step`: bodies and skins move together, implicitly, as in
    `mujoco_warp.step` with `batch.attach`. It has no gradient: see `differentiable.rollout`.

    Args:
      model: of `put_model`. data: of one world; `jax.vmap(step, (None, 0))` takes a batch.

    Raises:
      ValueError: an array of another shape, or a gradient is wanted.
    """
    return _call(model, "step", data)


def forward(model: Model, data: Data) -> Data:
    """In place of `mjx.forward`: computes quantities that follow from the state without a step, such as
    `xpos`. Skins and sensors are unchanged; arguments and errors as for `step`."""
    return _call(model, "forward", data)


def readings(model: Model, data: Data, prefix: str = "biotac_") -> dict[str, "jax.Array"]:
    """Readings {channel: (..., dim)} of the BioTac with a prefix, from `data.sensordata`: electrodes, pdc,
    pac, tac and tdc [counts], contact_force [N, N m] and status, see `Handle.read`."""
    core_of(model.mjm, prefix)
    found = {}
    for name in SENSORS:
        i = mujoco.mj_name2id(model.mjm, mujoco.mjtObj.mjOBJ_SENSOR, prefix + name)
        if i >= 0:
            begin = model.mjm.sensor_adr[i]
            found[name] = data.sensordata[..., begin : begin + model.mjm.sensor_dim[i]]
    return found


# --- JAX's side ---


@functools.cache
def _register():
    import jax

    jax.tree_util.register_dataclass(Data, list(_FIELDS), [])
    jax.tree_util.register_static(Model)


def _call(model, name, data):
    import jax.numpy as jnp

    leaves = []
    for field in (*_READ, "skins"):
        like, value = model.rest[field], getattr(data, field)
        if np.shape(value) != like.shape[1:]:
            raise ValueError(
                f"{field} has shape {np.shape(value)}, of one world it is {like.shape[1:]}: put {name} of "
                f"many worlds into jax.vmap({name}, (None, 0))"
            )
        leaves.append(jnp.asarray(value, like.dtype))
    return Data(**dict(zip((*_WRITTEN, "skins"), model.functions[name](*leaves), strict=True)))


def _function(model, name):
    """Function of the leaves of one world; vmapped, of many worlds."""
    import jax
    import jax.numpy as jnp

    @jax.custom_batching.custom_vmap
    def of_worlds(*leaves):
        return model.worlds(len(leaves[0])).call(name, leaves)

    @of_worlds.def_vmap
    def _of_more(size, batched, *leaves):
        nworld = next(x.shape[1 if b else 0] for x, b in zip(leaves, batched))
        leaves = [x if b else jnp.broadcast_to(x, (size, *x.shape)) for x, b in zip(leaves, batched)]
        found = of_worlds(*(x.reshape(size * nworld, *x.shape[2:]) for x in leaves))
        return [x.reshape(size, nworld, *x.shape[1:]) for x in found], [True] * len(found)

    @jax.custom_jvp
    def of_world(*leaves):
        return [x[0] for x in of_worlds(*(x[None] for x in leaves))]

    @of_world.defjvp
    def _refuse(_primals, _tangents):
        raise ValueError(
            f"biotac_mj.mjx.{name} has no gradient: put jax.lax.stop_gradient around its data, or take "
            "biotac_mj.differentiable.rollout"
        )

    return of_world


# --- Warp's side ---


class _Worlds:
    """mujoco_warp's Model and Data of `nworld` worlds with BioTacs, used for steps; it has no state between
    steps."""

    def __init__(self, mjm, nworld, prefixes, room, settings, device):
        import mujoco_warp as mjw

        mjd = mujoco.MjData(mjm)
        mujoco.mj_forward(mjm, mjd)
        self.nworld, self._calls = nworld, {}
        with wp.ScopedDevice(device):
            self._m, self._d = mjw.put_model(mjm), mjw.put_data(mjm, mjd, nworld=nworld, **room)
            self._batches = [
                batch.attach(mjm, self._m, self._d, prefix=prefix, **settings) for prefix in prefixes
            ]
            self.rows = Rows(self._batches)

    def rest(self) -> dict[str, np.ndarray]:
        """Initial value (1, ...) of every field of a Data, to be read before the first step."""
        self.rows.write()
        fields = {name: getattr(self._d, name).numpy() for name in _WRITTEN}  # views on the CPU: copied below
        found = {name: value.copy() if name in _READ else 0 * value for name, value in fields.items()}
        return {**found, "skins": self.rows.row.numpy().copy()}

    def call(self, name, leaves):
        """JAX call of "step" or "forward" with arrays (nworld, ...) of `_READ` and the skins; returns those
        of `_WRITTEN` and the skins."""
        if name not in self._calls:
            self._calls[name] = self._callable(name)
        function, dims = self._calls[name]
        return function(*leaves, output_dims=dims)

    def _callable(self, name):
        import mujoco_warp as mjw

        d, rows, read, written = self._d, self.rows, [*_READ, "skins"], [*_WRITTEN, "skins"]
        forward = name == "forward"

        def run(*arrays):
            for field, array in zip(_READ, arrays):
                wp.copy(getattr(d, field), array)
            wp.copy(rows.row, arrays[len(_READ)])
            rows.read()
            for one in self._batches:
                one.active = not forward
            (mjw.forward if forward else mjw.step)(self._m, d)
            for field, array in zip(_WRITTEN, arrays[len(read) :]):
                wp.copy(array, getattr(d, field))
            rows.write()
            wp.copy(arrays[-1], rows.row)

        if d.qpos.device.is_cuda:  # memory for loops is allocated before the step is captured
            with wp.ScopedDevice(d.qpos.device):
                mjw.step(self._m, d)
        kinds = {**{field: getattr(d, field) for field in _WRITTEN}, "skins": rows.row}
        names = [*(f"{field}_in" for field in read), *(f"{field}_out" for field in written)]
        of = [kinds[field] for field in (*read, *written)]
        run.__annotations__ = {
            name: wp.array(dtype=kind.dtype, ndim=kind.ndim) for name, kind in zip(names, of)
        }
        run.__signature__ = inspect.Signature(
            inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=kind)
            for name, kind in run.__annotations__.items()
        )
        # the loops of a step are nodes of a Warp graph, which JAX cannot include in its own
        modes = wp.JaxCallableGraphMode
        mode = modes.WARP if d.qpos.device.is_cuda else modes.NONE
        function = wp.jax_callable(run, num_outputs=len(written), graph_mode=mode, vmap_method=None)
        return function, {f"{field}_out": kinds[field].shape for field in written}
