"""Slot times, filters, converter and noise against closed forms, for time steps that do not divide the
frame."""

import numpy as np
import pytest

from biotac_mj.sensor import channels
from biotac_mj.sensor.acquisition import Acquisition
from biotac_mj.sensor.acquisition_kernels import SLOT_RATE, SLOTS_PER_FRAME
from biotac_mj.sensor.presets import Sensor

REST = channels.impedance_from_counts(channels.REST_COUNTS["1"])


def started(**options):
    acquisition = Acquisition(**options)
    state = np.zeros(acquisition.nstate)
    acquisition.reset(state, REST)
    return acquisition, state


def run(acquisition, state, dt, duration, signal):
    """Steps of dt [s]; signal(t) -> impedance (19,), pressure [Pa], temperature [C]."""
    n = round(duration / dt)
    for i in range(n):
        impedance, pressure, temperature = signal((i + 1) * dt)
        acquisition.advance(state, i * dt, dt, impedance, pressure, temperature)


def flat(readings):
    return np.concatenate(
        [readings["electrodes"], readings["pac"], [readings["pdc"], readings["tac"], readings["tdc"]]]
    )


def test_at_rest_the_counts_are_the_rest_counts():
    acquisition, state = started(noise=False)
    run(acquisition, state, 1e-3, 0.05, lambda t: (REST, 0.0, channels.REST_TEMPERATURE))
    readings = acquisition.readings(state)
    assert np.array_equal(readings["electrodes"], channels.REST_COUNTS["1"])
    assert readings["pdc"] == 2000 and readings["tac"] in (2047, 2048)
    assert np.all((readings["pac"] >= 2047) & (readings["pac"] <= 2048))
    assert channels.temperature_from_counts(readings["tdc"]) == pytest.approx(
        channels.REST_TEMPERATURE, abs=0.05
    )


@pytest.mark.parametrize("dt", [1e-4, 7e-4, 2e-3, 2e-2])
def test_every_electrode_is_sampled_at_its_slot(dt):
    """A ramp in Z: the held count is the ramp at the last slot of that electrode, whatever the step."""
    acquisition, state = started(noise=False)
    rate = np.linspace(1e4, 4e4, 19)
    run(acquisition, state, dt, 0.14, lambda t: (REST + rate * t, 0.0, channels.REST_TEMPERATURE))
    slot = 2 * np.arange(19) + 2
    last = slot + SLOTS_PER_FRAME * np.floor(
        (round(0.14 / dt) * dt * SLOT_RATE + 1e-6 - slot) / SLOTS_PER_FRAME
    )
    expected = np.round(channels.counts_from_impedance(REST + rate * last / SLOT_RATE))
    assert np.array_equal(acquisition.readings(state)["electrodes"], expected)


def test_pdc_answers_a_step_as_its_low_pass_does():
    """A ramp of 1 ns, then level: a step; PDC's slot sees 1 - exp(-2 pi 1040 t)."""
    acquisition, state = started(noise=False)
    slot_time = 40 / SLOT_RATE
    for delay in (1e-4, 2e-4, 4e-4):
        acquisition.reset(state, REST)
        start = slot_time - delay
        acquisition.advance(state, 0.0, start, REST, 0.0)
        acquisition.advance(state, start, 1e-9, REST, 50e3)
        acquisition.advance(state, start + 1e-9, 5e-4, REST, 50e3)
        expected = 50e3 * (1 - np.exp(-2 * np.pi * 1040 * delay))
        assert channels.pressure_from_counts(acquisition.readings(state)["pdc"]) == pytest.approx(
            expected, abs=30
        )


@pytest.mark.parametrize("hertz", [2.0, 100.0, 800.0])
def test_the_gain_of_pac_is_that_of_the_band_pass(hertz):
    """Amplitude of a sine against |H| of the analogue band-pass."""
    acquisition, state = started(noise=False)
    amplitude, dt, values = 300.0, 1e-4, []
    for i in range(10000):
        acquisition.advance(state, i * dt, dt, None, amplitude * np.sin(2 * np.pi * hertz * (i + 1) * dt))
        if i >= 5000 and (i + 1) % 100 == 0:
            values.append(channels.pac_from_counts(acquisition.readings(state)["pac"]))
    values = np.concatenate(values)  # (22 * 50,) at 2.2 kHz, whole periods
    s = 2j * np.pi * hertz
    low, high = 2 * np.pi * 10, 2 * np.pi * 1040
    gain = abs(s / (s + low) * high / (s + high))
    assert np.sqrt(2) * values.std() == pytest.approx(amplitude * gain, rel=0.03)


def test_tac_follows_heating():
    """TDC at once, TAC behind 0.25 Hz."""
    acquisition, state = started(noise=False)
    run(acquisition, state, 2e-3, 0.5, lambda t: (REST, 0.0, channels.REST_TEMPERATURE + 0.4 * t))
    readings = acquisition.readings(state)
    followed = 0.4 * (1 - np.exp(-2 * np.pi * 0.25 * 0.5))
    assert channels.heating_from_counts(readings["tac"]) == pytest.approx(followed, abs=2e-3)
    warm = channels.REST_TEMPERATURE + 0.2
    assert channels.temperature_from_counts(readings["tdc"]) == pytest.approx(warm, abs=0.05)


def test_the_step_does_not_change_what_is_sampled():
    """Signals linear in time are the same for every step: counts with noise are equal to the bit."""
    results = []
    for dt in (1e-4, 7e-4, 2e-3, 2e-2):
        acquisition, state = started(seed=5)
        run(
            acquisition,
            state,
            dt,
            0.14,
            lambda t: (REST + 2e3 * t, 5e3 * t, channels.REST_TEMPERATURE + 0.1 * t),
        )
        results.append(flat(acquisition.readings(state)))
    assert all(np.array_equal(results[0], other) for other in results[1:])


def test_replay_from_a_saved_state_is_bit_equal():
    acquisition, state = started(seed=1)
    run(acquisition, state, 2e-3, 0.1, lambda t: (REST * (1 + t), 1e3 * t, channels.REST_TEMPERATURE))
    saved, copies = state.copy(), []
    for _ in range(2):
        state[:] = saved
        for i in range(50, 90):
            acquisition.advance(state, i * 2e-3, 2e-3, REST * (1 + 0.01 * i), 10.0 * i)
        copies.append(state.copy())
    assert np.array_equal(copies[0], copies[1])
    assert not np.array_equal(copies[0], saved)


def test_noise_has_the_measured_size_and_depends_on_the_seed():
    rows = {}
    for seed in (1, 2):
        acquisition, state = started(seed=seed)
        rows[seed] = []
        for i in range(1000):
            acquisition.advance(state, i * 0.01, 0.01, REST)
            rows[seed].append(acquisition.readings(state)["electrodes"])
    first, second = np.array(rows[1]), np.array(rows[2])
    expected = np.sqrt(channels.electrode_noise(channels.REST_COUNTS["1"]) ** 2 + 1 / 12)
    np.testing.assert_allclose(first.std(0), expected, rtol=0.1)
    correlation = np.corrcoef(np.concatenate([first, second], axis=1).T) - np.eye(38)
    assert np.abs(correlation).max() < 0.15
    assert np.abs([np.corrcoef(first[1:, k], first[:-1, k])[0, 1] for k in range(19)]).max() < 0.15


@pytest.mark.parametrize("seed", [0, 5, 2**63 + 1])
def test_noise_is_that_of_numpys_philox(seed):
    """One counter for each slot of 4.4 kHz, two of its four words through Box and Muller's formula."""
    acquisition, state = started(seed=seed)
    electrode = channels.counts_from_impedance(REST)
    hiss = 0.0
    for frame in range(-3, 40):
        acquisition.advance(state, frame * 0.01, 0.01, REST)
        raw = np.random.Philox(key=seed, counter=(frame * SLOTS_PER_FRAME + 1) % 2**64).random_raw(4 * 44)
        u, v = ((raw.reshape(-1, 4)[:, :2] >> np.uint64(11)) + 0.5).T * 2.0**-53
        normal = np.sqrt(-2 * np.log(u)) * np.cos(2 * np.pi * v)
        expected = np.rint(electrode + channels.electrode_noise(electrode) * normal[1:38:2])
        readings = acquisition.readings(state)
        assert np.array_equal(readings["electrodes"], expected)
        assert readings["pdc"] == np.rint(2000 + Sensor().pdc_noise * normal[39])
        coloured = []
        for white in channels.PAC_NOISE * normal[::2]:
            hiss = channels.PAC_COLOUR * hiss + white
            coloured.append(hiss)
        assert np.array_equal(readings["pac"], np.rint(4095 / 2 + np.array(coloured)))


def test_pac_at_rest_has_the_measured_spectrum():
    """First-order noise: 3.92 counts RMS, and 4.2 dB less per hertz near 1 kHz than near 25 Hz."""
    acquisition, state = started(seed=3)
    pac = []
    for frame in range(3000):
        acquisition.advance(state, frame * 0.01, 0.01, REST)
        pac.append(acquisition.readings(state)["pac"])
    pac = np.ravel(pac) - 4095 / 2
    a = channels.PAC_COLOUR
    assert pac.std() == pytest.approx(np.sqrt(channels.PAC_NOISE**2 / (1 - a * a) + 1 / 12), rel=0.02)
    power = (np.abs(np.fft.rfft(pac.reshape(-1, 220))) ** 2).mean(0)
    hertz = np.fft.rfftfreq(220, 1 / 2200.0)
    near = [power[(hertz > low) & (hertz < high)].mean() for low, high in ((20, 70), (950, 1050))]
    expected = [1 / (1 + a * a - 2 * a * np.cos(2 * np.pi * f / 2200)) for f in (45, 1000)]
    assert near[0] / near[1] == pytest.approx(expected[0] / expected[1], rel=0.1)


def test_clipping_to_twelve_bits():
    acquisition, state = started()
    run(acquisition, state, 5e-3, 0.03, lambda t: (np.full(19, 1e12), 1e9, channels.REST_TEMPERATURE))
    readings = acquisition.readings(state)
    assert (
        np.all(readings["electrodes"] <= 25)
        and np.all(readings["electrodes"] >= 0)
        and readings["pdc"] == 4095
    )


def test_one_film_solution_per_frame():
    for dt in (1e-4, 7e-4, 2e-3):
        acquisition, state = started()
        asked = [acquisition.needs_impedance(state, i * dt, dt) for i in range(round(0.14 / dt))]
        assert sum(asked) == 14
    acquisition, state = started(film_every_step=True)
    assert all(acquisition.needs_impedance(state, i * 2e-3, 2e-3) for i in range(4))
    assert not acquisition.needs_impedance(state, 40 / SLOT_RATE, 1e-3)  # pdc, tac, tdc and pac only
    assert sum(acquisition.needs_impedance(state, i * 1e-4, 1e-4) for i in range(100)) == 19


def test_impedance_is_held_between_solutions():
    acquisition, state = started(noise=False)
    for i in range(100):
        impedance = REST * (1 + i * 1e-3)
        time = i * 1e-3
        acquisition.advance(
            state, time, 1e-3, impedance if acquisition.needs_impedance(state, time, 1e-3) else None
        )
    expected = channels.counts_from_impedance(REST[18] * (1 + 90e-3))  # solved in the step from 90 to 91 ms
    assert acquisition.readings(state)["electrodes"][18] == np.round(expected)


def test_bad_input_is_named_and_changes_no_state():
    acquisition, state = started()
    before = state.copy()
    broken = REST.copy()
    broken[4] = np.nan
    for arguments, text in (
        (dict(impedance=broken), "impedance of e5 is not a positive finite number"),
        (dict(impedance=REST[:18]), r"impedance has shape \(18,\): pass \(19,\)"),
        (dict(impedance=REST, pressure=np.nan), "pressure is nan Pa"),
    ):
        with pytest.raises(ValueError, match=text):
            acquisition.advance(state, 0.0, 1e-3, **arguments)
    with pytest.raises(ValueError, match="dt positive"):
        acquisition.advance(state, 0.0, 0.0, REST)
    with pytest.raises(ValueError, match="state is float64 of shape"):
        acquisition.reset(np.zeros(3), REST)
    with pytest.raises(ValueError, match="seed is -1"):
        Acquisition(seed=-1)
    assert np.array_equal(before, state)
