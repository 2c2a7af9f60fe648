"""The data sheet's formulas: published pairs, round trips, and noise in the measured bands."""

import numpy as np
import pytest

from biotac_mj.sensor import channels


def test_channels_have_their_names_and_order():
    assert channels.CHANNELS == (*(f"e{i}" for i in range(1, 20)), "pdc", "pac", "tdc", "tac")


def test_counts_of_impedances_are_those_of_the_divider():
    assert channels.counts_from_impedance(10e3) == pytest.approx(2047.5)
    assert channels.impedance_from_counts(3276) == pytest.approx(2500)
    assert channels.impedance_from_counts(0) == np.inf
    z = np.geomspace(100, 1e6, 50)
    np.testing.assert_allclose(
        channels.impedance_from_counts(channels.counts_from_impedance(z)), z, rtol=1e-10
    )


def test_a_count_is_36_5_pa_of_pdc_and_0_37_of_pac():
    assert channels.counts_from_pressure(3650.0) - channels.counts_from_pressure(0.0) == pytest.approx(100)
    assert channels.pressure_from_counts(channels.counts_from_pressure(1234.0)) == pytest.approx(1234.0)
    assert channels.counts_from_pac(37.0) - channels.counts_from_pac(0.0) == pytest.approx(100)
    assert channels.pac_from_counts(channels.counts_from_pac(-12.0)) == pytest.approx(-12.0)


def test_counts_of_temperatures_are_those_by_hand():
    """31 C by hand: exp(4025 / 304.15) = 5.59e5, r = 155183 / 6.055e5 = 0.2563."""
    assert channels.counts_from_temperature(31.0) == pytest.approx(4095 * 0.2563, rel=2e-3)
    celsius = np.linspace(5, 60, 30)
    counts = channels.counts_from_temperature(celsius)
    np.testing.assert_allclose(channels.temperature_from_counts(counts), celsius, atol=1e-9)
    assert np.all(np.diff(counts) > 0)


def test_counts_of_heating_fall_and_come_back():
    def counts_of(rate):
        return channels.thermistor_counts(channels.heating_exponent(rate))

    assert counts_of(0.0) == pytest.approx(4095 / 2)
    rate = np.linspace(-0.2, 0.8, 21)
    counts = counts_of(rate)
    np.testing.assert_allclose(channels.heating_from_counts(counts), rate, atol=1e-9)
    assert np.all(np.diff(counts) < 0)
    assert counts_of(50.0) < 1


def test_noise_lies_in_the_measured_bands():
    assert np.all((channels.electrode_noise([3100, 3300]) > 2) & (channels.electrode_noise([3100, 3300]) < 4))
    assert np.all((channels.electrode_noise([2000, 2200]) > 6) & (channels.electrode_noise([2000, 2200]) < 7))
    assert channels.electrode_noise(5000) == 0
