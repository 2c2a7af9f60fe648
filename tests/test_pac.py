"""PAC through `mj_step` with implicit dynamics: tapping, rubbing over ridges, and what steps do to a
vibration."""

import mujoco
import numpy as np
import pytest
from blocks import four_nodes
from grids import first

import biotac_mj
from biotac_mj.press import approach
from biotac_mj.sensor import channels
from biotac_mj.sensor.acquisition import Acquisition
from biotac_mj.sensor.acquisition_kernels import SLOT_RATE, SLOTS_PER_FRAME

RATE = SLOT_RATE / 2  # [Hz] of PAC
REST = channels.impedance_from_counts(np.full(19, 3000.0))
SKIN = four_nodes("coarse")  # of ten nodes an element takes twice the time, and PAC is no finer
PITCH, RIDGE = 1e-3, 0.3e-3  # [m] of the texture, and its capsules' radius


@pytest.fixture(autouse=True)
def no_errors():
    yield
    biotac_mj.plugin.check()


@pytest.fixture(scope="module")
def pad():
    """Point on the pad, outward normal and the direction along the finger."""
    point, normal = approach.surface_point(SKIN, -12e-3, 0.0)
    along = np.cross(normal, [0, 0, 1.0])
    return point, normal, along / np.linalg.norm(along)


def scene(geoms, timestep, start, noise=True):
    """A BioTac and a body that is moved from `start`, with geoms (type, size, pos)."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = timestep, np.zeros(3)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_body(name="finger")
    tool = spec.worldbody.add_body(name="tool", pos=start, mocap=True)
    for kind, size, pos in geoms:
        tool.add_geom(type=kind, size=size, pos=pos, contype=0, conaffinity=0, friction=[0.2, 0, 0])
    for i, geom in enumerate(tool.geoms):
        geom.name = f"g{i}"
    handle = biotac_mj.attach(
        spec,
        body="finger",
        skin=SKIN,
        coupling="one-way",
        geoms=[g.name for g in tool.geoms],
        friction=0.2,
        options={"skin": {"dynamics": "implicit"}, "readings": {"noise": noise}},
    )
    model = spec.compile()
    return model, mujoco.MjData(model), handle


def record(model, data, handle, path):
    """PAC counts, every one of 2.2 kHz, while the tool goes along `path` (nstep, 3)."""
    pac, last = [], 0
    for i, position in enumerate(path):
        data.mocap_pos[0] = position
        mujoco.mj_step(model, data)
        assert handle.read(data, "status")[0] == 1
        slot = int(np.floor((i + 1) * model.opt.timestep * SLOT_RATE + 1e-6))
        frame = handle.read(data, "pac")
        pac += [frame[k % SLOTS_PER_FRAME // 2] for k in range(last, slot) if k % 2 == 0]
        last = slot
    return np.array(pac)


def test_tapping_is_felt_as_often_as_it_happens(pad):
    """A ball meets the pad at 13 mm/s, goes 0.1 mm deep and leaves, at 20 Hz."""
    point, normal, _ = pad
    dt, frequency = 5e-4, 20.0
    time = dt * np.arange(1, 201)
    depth = -1e-4 + 2e-4 * np.sin(2 * np.pi * frequency * (time - 0.02)) * (time > 0.02)
    path = point + (3.5e-3 - depth)[:, None] * normal
    pac = record(*scene([(mujoco.mjtGeom.mjGEOM_SPHERE, [3.5e-3, 0, 0], [0, 0, 0])], dt, path[0]), path)
    pressure = channels.pac_from_counts(pac)
    quiet = pressure[: int(0.022 * RATE)]
    assert 0.8 < quiet.std() < 2.2  # before first touch only the noise: 1.45 Pa
    instant = np.arange(1, len(pac) + 1) / RATE
    touch = 0.02 + 1 / 12 / frequency
    rising = (instant > touch) & (instant < touch + 1 / 3 / frequency)
    assert pressure[rising].max() > 50 * quiet.std()
    falling = (instant > touch + 1 / 3 / frequency) & (instant < touch + 1 / frequency)
    assert (
        pressure[falling].min() < -20 * quiet.std()
    )  # below rest while the ball leaves: no steady part passes


def rub(pad, speed, periods, rate):
    """Amplitudes [counts] of PAC at multiples 1 / periods, 2 / periods... of speed / pitch, once the rubbing
    is steady."""
    point, normal, along = pad
    count, dt = 25, PITCH / speed / rate
    ridges = [
        (mujoco.mjtGeom.mjGEOM_CAPSULE, [RIDGE, 5e-3, 0], (i - count // 2) * PITCH * along)
        for i in range(count)
    ]
    press, lead = 20, 3 * rate  # steps
    n = np.arange(1, press + lead + rate * periods + 1)
    depth = 0.4e-3 * np.minimum(n / press, 1)
    slid = speed * dt * np.clip(n - press, 0, None)
    slid -= slid[-1] / 2
    path = point + (RIDGE - depth)[:, None] * normal + slid[:, None] * along
    pac = record(*scene(ridges, dt, path[0], noise=False), path)
    pac = pac[-int(round(periods * PITCH / speed * RATE)) :].astype(float)
    index = np.arange(len(pac))
    pac -= np.polyval(np.polyfit(index, pac, 1), index)
    return np.abs(np.fft.rfft(pac)) * 2 / len(pac)


# 200 Hz at 0.42 ms, 100 Hz at 0.5 ms
@pytest.mark.slow  # quick: tapping
@pytest.mark.parametrize("speed, rate", [(0.2, 12), pytest.param(0.1, 20, marks=pytest.mark.slow)])
def test_rubbing_over_ridges_shows_lines_at_speed_by_pitch(pad, speed, rate):
    """PAC without its noise shows the lines speed / pitch and its multiples, and next to nothing between
    them."""
    periods = 4
    lines = rub(pad, speed, periods, rate)
    top = min(4 * periods, int(periods * PITCH / speed * 1000))
    number = np.arange(1, top + 1)
    on = number % periods == 0
    between = ~on & (number > periods)  # below lies what is left of the way in
    amplitude = lines[1 : top + 1]
    assert amplitude[periods - 1] > 5
    assert amplitude[on].max() > 18
    assert np.median(amplitude[on]) > 5 * np.median(amplitude[between])
    assert (amplitude[on] ** 2).sum() > 30 * (amplitude[between] ** 2).sum()


@pytest.mark.parametrize("dt", [2e-4, 5e-4])
@pytest.mark.parametrize("frequency", [50.0, 200.0, 400.0])
def test_vibration_passes_as_linear_pressure_between_steps(frequency, dt):
    """Pressure known at step ends, linear between: a tone passes as sinc^2(f dt) of what the continuous
    band-pass lets through."""
    acquisition = Acquisition(noise=False)
    state = np.zeros(acquisition.nstate)
    acquisition.reset(state, REST)
    amplitude, count = 400.0, int(round(0.2 / dt))
    pac, last = [], 0
    for i in range(count):
        acquisition.advance(state, i * dt, dt, None, amplitude * np.sin(2 * np.pi * frequency * (i + 1) * dt))
        slot = int(np.floor((i + 1) * dt * SLOT_RATE + 1e-6))
        frame = acquisition.readings(state)["pac"]
        pac += [frame[k % SLOTS_PER_FRAME // 2] for k in range(last, slot) if k % 2 == 0]
        last = slot
    pac = np.array(pac)[-int(0.1 * RATE) :] - channels.counts_from_pac(0.0)
    phase = np.exp(-2j * np.pi * frequency * np.arange(len(pac)) / RATE)
    measured = 2 * abs((pac * phase).mean()) * 0.37
    s, low, high = 2j * np.pi * frequency, 2 * np.pi * 1040, 2 * np.pi * 10
    band = abs(s * low / ((s + low) * (s + high)))
    assert measured == pytest.approx(amplitude * band * np.sinc(frequency * dt) ** 2, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("tier", first(["condensed", "full"]))
def test_a_smooth_plate_that_slides_is_not_heard(tier):
    """Single samples begin and cease to touch at the rim; the shorter the step, the louder that would be."""
    dt = 1e-3
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = dt, np.zeros(3)
    plate = spec.worldbody.add_body(name="plate", mocap=True, pos=[-9e-3, -13.3e-3, 0])
    plate.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.06, 0.005, 0.03], friction=[0.3, 0, 0])
    handle = biotac_mj.attach(
        spec, body="world", skin="coarse", tier=tier, coupling="one-way", friction=0.3, textures={},
        sensor={"pac_noise": 0},
    )  # fmt: skip
    model = spec.compile()
    data, heard = mujoco.MjData(model), []
    for k in range(200):
        data.mocap_pos[0] = [-9e-3 + 5e-5 * max(0, k - 60), -13.3e-3 + 1.2e-3 * min(1, (k + 1) / 50), 0]
        mujoco.mj_step(model, data)
        if k > 150 and k % 10 == 9:
            heard.append(handle.read(data, "pac"))
    assert np.diff(np.ravel(heard)).std() < 3  # what is left of the way in is slow
