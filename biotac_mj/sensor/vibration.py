"""Vibration of a BioTac: PAC between the steps of the skin, many sensors at once.

    slip, texture -> height -> force \\
                                       -> modes of the skin -> pressure -> 10 to 1040 Hz -> PAC
    taps, stick-slip: force -----------/

Everything is linear: a force on the skin drives its modes (`skin.modes`), each an oscillator of unit static
gain, discretised as a second-order section by the bilinear rule with its frequency kept. The FEM skin
supplies the steady pressure of the contact force; here only the modes' deviation from it counts. The pressure
of the texture has no other source, so it counts whole: modes, and the static contribution of the truncated
ones.

A texture is a height under the contact that passes at the sliding speed: regular ridges, and roughness as the
sum of waves (a second-order process over the distance slid) and grain (a first-order one). The two halves of
a ridge's pitch cancel, so the mean over the touched area counts.

Slots are those of `acquisition`, 4.4 kHz. The state is short and noise a function of seed and slot, so frames
join and a replay is bit-equal."""

import dataclasses
import math
from collections.abc import Mapping

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from biotac_mj.sensor.acquisition_kernels import SLOT_RATE, draw_normal, slots_until
from biotac_mj.sensor.materials import material_of

from ..kernels import kernel_module
from ..short_repr import short_repr

kernel_module(__name__)

real = wp.float64

# Loss factor of the rubber: silicones have about 0.1 to 0.3 between 10 Hz and 3 kHz (typical, not fitted).
LOSS_FACTOR = 0.2
# Roughness: length of the waves, of the grain [m], and the grain's fraction of the mean square. FITTED, like
# ROUGHNESS: RMS [m] under a BioTac at 20 mm/s, one slide of each material, in three bands
# (`benchmarks/vibration.py`). Effective values: the contact's averaging is not separated.
_WAVE, _GRAIN = 4.15e-4, 2.0e-6
_GRAIN_FRACTION = 1.13e-3
ROUGHNESS = {"carpet": 0.69e-6, "cork": 0.83e-6, "fiberboard": 0.70e-6, "sponge": 0.61e-6, "steel": 0.55e-6}
_LOW, _HIGH = (math.tan(math.pi * hertz / SLOT_RATE) for hertz in (1040.0, 10.0))  # of the band-pass
_FILTER = 4  # numbers of the band-pass, after the modes in the state
# per body: phase; input of the waves, waves and grain, over their RMS; speed; its texture: pitch, height,
# roughness [m], so that a reset may change it; then the gains
_BODY, _SPEED, _TEXTURE = 8, 4, 5
# [m] limits of the linearised contact: larger or longer features are shape, shorter pitches average out
_RANGE = {"pitch": (1e-6, 0.1), "height": (0.0, 1e-3), "roughness": (0.0, 1e-3)}
_KEY = 0x1E3779B97F4A7C15  # separates the seeds of the roughness from the noise's


@dataclasses.dataclass(frozen=True)
class Texture:
    """Texture of a surface.

    Attributes:
      pitch: of ridges across the sliding direction [m]; height: of ridges, from bottom to top [m].
      roughness: RMS [m].
    """

    pitch: float = 1e-3
    height: float = 0.0
    roughness: float = 0.0


def read_texture(value: str | Texture | Mapping) -> Texture:
    """A texture from a user's description of a geom.

    Args:
      value: a material's name of `ROUGHNESS`, "smooth", or a dict with any of material, pitch, height,
        roughness [m].

    Raises:
      ValueError: an unknown name or key, or an invalid number.
    """
    if isinstance(value, Texture):
        return value
    value = {"material": value} if isinstance(value, str) else value
    if not isinstance(value, Mapping) or not isinstance(value.get("material", ""), str):
        raise ValueError(f"texture is {short_repr(value)}: give a material's name, or a dict of numbers")
    value = dict(value)
    names = [f.name for f in dataclasses.fields(Texture)]
    unknown = set(value) - {"material", *names}
    if unknown or not value or ("height" in value) != ("pitch" in value):
        raise ValueError(f"texture {value!r}: give a material, pitch and height, or roughness")
    out = {}
    name = value.pop("material", "smooth")
    if name != "smooth":
        numbers = "dict(pitch=, height=) of ridges, or dict(roughness=), in metres"
        found = material_of(name, ("smooth", *ROUGHNESS), numbers).name
        if found not in ROUGHNESS:
            raise ValueError(
                f"no roughness is known of {name!r}: choose smooth, {', '.join(ROUGHNESS)}, or give {numbers}"
            )
        out["roughness"] = ROUGHNESS[found]
    for key, number in value.items():
        least, most = _RANGE[key]
        good = isinstance(number, (int, float)) and not isinstance(number, bool)
        if not (good and least <= number <= most):
            raise ValueError(
                f"{key} of a texture is {number!r}: give a positive number of metres, {least:g} to {most:g}; "
                "what is larger is shape, of the geom"
            )
        out[key] = float(number)
    return Texture(**out)


@dataclasses.dataclass(frozen=True)
class Modes:
    """Modes of the skin for the sensor (from `skin.modes.SkinModes`): angular frequencies (nmode,) [rad/s]
    and static pressures of unit modal forces (nmode,) [Pa / (N kg^-1/2)]."""

    rate: np.ndarray
    static_pressure: np.ndarray


def sections(rate: ArrayLike, loss: float = LOSS_FACTOR) -> np.ndarray:
    """Second-order sections of w^2 / (s^2 + loss w s + w^2) at `SLOT_RATE`.

    Args:
      rate: (nmode,) w [rad/s], below pi times the rate. loss: factor of the rubber, twice the damping ratio.

    Returns:
      (nmode, 3): b0 = b1 / 2 = b2, a1 and a2; the poles lie inside the unit circle.

    Raises:
      ValueError: a mode above the Nyquist frequency.
    """
    rate = np.asarray(rate, float)
    if not (rate < np.pi * SLOT_RATE).all():
        raise ValueError(f"modes up to {rate.max() / 2 / np.pi:.0f} Hz: leave those above 2200 Hz out")
    t = np.tan(rate / (2 * SLOT_RATE))
    total = 1 + loss * t + t * t
    return np.stack([t * t / total, 2 * (t * t - 1) / total, (1 - loss * t + t * t) / total], axis=-1)


def state_size(nmode: int, nbody: int) -> int:
    """Length of the state of a sensor with so many modes that up to `nbody` bodies touch."""
    return 3 * nmode + _FILTER + nbody * (_BODY + nmode + 1)


@wp.func
def _average(ka: real):
    """Average of a wave over a disc of radius a: a bound of 2 J1(ka) / ka without zeros, as contacts have no
    sharp edge."""
    return real(1.0) / wp.sqrt(real(1.0) + real(math.pi) / real(8.0) * ka * ka * ka)


@wp.kernel
def shake(
    # In:
    dt: real,
    section: wp.array(dtype=wp.vec3d),
    static_pressure: wp.array(dtype=real),
    seed: wp.array(dtype=wp.uint64),
    time: wp.array(dtype=real),
    drive: wp.array2d(dtype=real),
    gain: wp.array3d(dtype=real),
    slip: wp.array2d(dtype=real),
    area: wp.array2d(dtype=real),
    # Out:
    state: wp.array2d(dtype=real),
    height: wp.array2d(dtype=real),
    pressure_out: wp.array2d(dtype=real),
):
    """`Vibration.advance` of each world over (time, time + dt]: heights of the slot under each body, then the
    modes, then the band-pass."""
    w = wp.tid()
    one = real(1.0)
    turn = real(2.0) * real(math.pi)  # a product outside would be in single precision
    period = one / real(SLOT_RATE)
    nmode = static_pressure.shape[0]
    nbody = slip.shape[1]
    band = 3 * nmode
    bodies = band + _FILTER
    size = _BODY + nmode + 1
    now = time[w]
    before = slots_until(now)
    for k in range(1, wp.int32(slots_until(now + dt) - before) + 1):
        slot = before + wp.int64(k)
        s = (real(slot) / real(SLOT_RATE) - now) / dt
        sound = real(0.0)
        for g in range(nbody):
            b = bodies + size * g
            speed = state[w, b + _SPEED] + s * (slip[w, g] - state[w, b + _SPEED])
            t = wp.vec3d(state[w, b + _TEXTURE], state[w, b + _TEXTURE + 1], state[w, b + _TEXTURE + 2])
            wave = turn / t[0]
            phase = state[w, b] + wave * speed * period
            state[w, b] = phase - turn * wp.floor(phase / turn)
            h = real(0.5) * t[1] * wp.sin(phase) * _average(wave * wp.sqrt(area[w, g] / real(math.pi)))
            if t[2] > real(0.0) and speed > real(0.0):
                keep = wp.exp(-speed * period / real(_WAVE))
                fresh = wp.sqrt(one - keep * keep) * draw_normal(
                    slot, seed[w] + wp.uint64(_KEY) * wp.uint64(2 * g + 1)
                )
                state[w, b + 1] = keep * state[w, b + 1] + fresh
                state[w, b + 2] = keep * state[w, b + 2] + (one - keep) * wp.sqrt(real(2.0)) * state[w, b + 1]
                keep = wp.exp(-speed * period / real(_GRAIN))
                fresh = wp.sqrt(one - keep * keep) * draw_normal(
                    slot, seed[w] + wp.uint64(_KEY) * wp.uint64(2 * g + 2)
                )
                state[w, b + 3] = keep * state[w, b + 3] + fresh
            h += t[2] * (
                wp.sqrt(one - real(_GRAIN_FRACTION)) * state[w, b + 2]
                + wp.sqrt(real(_GRAIN_FRACTION)) * state[w, b + 3]
            )
            height[w, g] = h
            last = state[w, b + _BODY + nmode]
            sound += (last + s * (gain[w, g, nmode] - last)) * h
        for m in range(nmode):
            force = state[w, 2 * nmode + m] + s * (drive[w, m] - state[w, 2 * nmode + m])
            for g in range(nbody):
                last = state[w, bodies + size * g + _BODY + m]
                force += (last + s * (gain[w, g, m] - last)) * height[w, g]
            c = section[m]
            moved = c[0] * force + state[w, 2 * m]
            state[w, 2 * m] = real(2.0) * c[0] * force - c[1] * moved + state[w, 2 * m + 1]
            state[w, 2 * m + 1] = c[0] * force - c[2] * moved
            sound += static_pressure[m] * (moved - force)
        low = (real(_LOW) * (sound + state[w, band]) + (one - real(_LOW)) * state[w, band + 1]) / (
            one + real(_LOW)
        )
        high = (low - state[w, band + 2] + (one - real(_HIGH)) * state[w, band + 3]) / (one + real(_HIGH))
        state[w, band] = sound
        state[w, band + 1] = low
        state[w, band + 2] = low
        state[w, band + 3] = high
        pressure_out[w, k - 1] = high
    for m in range(nmode):
        state[w, 2 * nmode + m] = drive[w, m]
    for g in range(nbody):
        b = bodies + size * g
        state[w, b + _SPEED] = slip[w, g]
        for m in range(nmode + 1):
            state[w, b + _BODY + m] = gain[w, g, m]


class Vibration:
    """Vibrations of `nworld` sensors on one device, each touched by up to `nbody` bodies.

    Args:
      modes: of the skin.
      textures: of the touching bodies, the same in every world.
      nworld: number of sensors.
      seed: of the roughness, 0 .. 2**64 - 1; world w has seed + w. Or (nworld,) of them.
      device: Warp device.

    Attributes:
      state: (nworld, nstate) wp.array float64; `rest` gives the initial one.
      time: (nworld,) wp.array float64, at the start of the next step [s]; the caller's.
      drive: (nworld, nmode) wp.array float64, modal force of all contacts at the end of the step
        [N kg^-1/2]. gain: (nworld, nbody, nmode + 1), modal forces per height under each body [N kg^-1/2 /
        m], and last its steady pressure [Pa/m]. slip: (nworld, nbody) speed [m/s]. area: touched (nworld,
        nbody) [m^2]. Write them before `advance`.
      pressure: (nworld, nslot) wp.array float64, pressure on PAC at the step's slots [Pa], see `acquisition`.
      nstate: length of a sensor's state.
    """

    def __init__(
        self, modes: Modes, textures: list[Texture], nworld: int = 1, seed: ArrayLike = 0, device: str = "cpu"
    ):
        self.nmode, self.nbody, self.nworld = len(modes.rate), len(textures), nworld
        self.device, self.nstate = wp.get_device(device), state_size(self.nmode, self.nbody)
        seeds = np.asarray(seed, np.uint64)
        if not seeds.ndim:
            seeds = seeds + np.arange(nworld, dtype=np.uint64)
        with wp.ScopedDevice(self.device):
            self._section = wp.array(sections(modes.rate), dtype=wp.vec3d)
            self._static_pressure = wp.array(modes.static_pressure, dtype=real)
            self._seed = wp.array(seeds, dtype=wp.uint64)
            self.time = wp.zeros(nworld, dtype=real)
            self.state = wp.array(np.tile(self.rest(textures), (nworld, 1)), dtype=real)
            self.drive = wp.zeros((nworld, self.nmode), dtype=real)
            self.gain = wp.zeros((nworld, self.nbody, self.nmode + 1), dtype=real)
            self.slip, self.area, self._height = (
                wp.zeros((nworld, self.nbody), dtype=real) for _ in range(3)
            )
        self._dt, self.pressure = None, None

    def rest(self, textures: list[Texture]) -> np.ndarray:
        """The state (nstate,) of a sensor at rest, with textures of the bodies."""
        state = np.zeros(self.nstate)
        bodies = state[3 * self.nmode + _FILTER :].reshape(self.nbody, _BODY + self.nmode + 1)
        made = [dataclasses.astuple(t) for t in textures]
        bodies[:, _TEXTURE : _TEXTURE + 3] = np.array(made, float).reshape(-1, 3)
        return state

    def read_from(
        self, seed: wp.array, time: wp.array, drive: wp.array, gain: wp.array, slip: wp.array, area: wp.array
    ) -> None:
        """Makes these device arrays the source of the seeds, `time`, `drive`, `gain`, `slip` and `area`."""
        self._seed, self.time = seed, time
        self.drive, self.gain, self.slip, self.area = drive, gain, slip, area
        self._dt = None

    def prepare(self, dt: float) -> None:
        """Allocates for steps of dt [s]."""
        if dt != self._dt:
            self._dt = dt
            nslot = math.ceil(dt * SLOT_RATE) + 1
            self.pressure = wp.zeros((self.nworld, nslot), dtype=real, device=self.device)
            inputs = [self._section, self._static_pressure, self._seed, self.time, self.drive]
            inputs += [self.gain, self.slip, self.area]
            outputs = [self.state, self._height, self.pressure]
            # packing the arguments takes longer than the step of one sensor
            self._step = wp.launch(
                shake, self.nworld, [dt, *inputs], outputs, device=self.device, record_cmd=True
            )

    def advance(self, dt: float) -> None:
        """Computes the slots of a step of dt [s]. A launch only, once prepared: may be captured in a CUDA
        graph."""
        self.prepare(dt)
        self._step.launch()
