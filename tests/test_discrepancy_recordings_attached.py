"""What `diagnose` writes can be attached, whatever it found."""

import numpy as np
import pytest

from biotac_mj.discrepancy.recordings.amended import _theta
from biotac_mj.discrepancy.recordings.candidates import Candidate
from biotac_mj.sensor.presets import read_sensor


def latency(delay, channels):
    parameters = {"delay": (delay, delay, delay)}
    return Candidate("latency", channels, 0.0, 1.0, "", parameters, delay=delay)


def test_electrodes_may_drift_against_each_other():
    share = np.linspace(-1, 1, 19)
    sensor = read_sensor({"like": "1", "warm_up": 5.0, "warm_share": share.tolist()})
    np.testing.assert_allclose(sensor.warm_share, share)
    with pytest.raises(ValueError, match="noise of a sensor"):
        read_sensor({"like": "1", "noise": share.tolist()})


def test_a_latency_that_no_sensor_can_run_with_is_left_out():
    assert _theta(latency(0.02, tuple(range(19)))) == {"delay": 0.02}
    assert _theta(latency(0.4, tuple(range(19)))) is None
    assert _theta(latency(0.02, (5,))) is None
