"""From a recording to a finger on a hand that behaves like that sensor: `diagnose` names what the recording
has beyond the model, and `attach` puts a sensor with it on a finger. Runs headless: python
examples/finger_like_a_recording.py [ELECTRODES.txt [FORCE.txt]]

Without a recording a synthetic one is made: a sensor that rests and warms up."""

import pathlib
import sys
import tempfile

import mujoco
import numpy as np

import biotac_mj
from biotac_mj.discrepancy import diagnose_recording, read_recording
from biotac_mj.discrepancy.report.files import write_report
from biotac_mj.discrepancy.report.text import summary
from biotac_mj.sensor.acquisition import Acquisition
from biotac_mj.sensor.presets import read_sensor

HAND = """<mujoco><option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body name="palm"> <geom type="box" size=".04 .02 .05" pos="0 0 -.06"/>
      <body name="finger" pos=".02 0 0"> <joint name="knuckle" axis="0 1 0" damping=".01"/>
        <geom type="capsule" fromto="0 0 0 0 0 .04" size=".008" mass=".03"/>
        <site name="fingertip" pos="0 0 .05" euler="0 90 0"/>
      </body>
    </body>
  </worldbody>
  <actuator> <position joint="knuckle" kp=".5"/> </actuator></mujoco>"""


def synthetic_recording(path: pathlib.Path, seconds: float = 90.0) -> None:
    """Writes counts of a synthetic sensor at 100 Hz that nothing touches."""
    sensor = read_sensor({"like": "phac_f1", "warm_up": 4.0, "warm_time": 40.0, "noise": [3.0] * 19})
    bus = Acquisition(seed=1, sensor=sensor)
    state, rows = np.zeros(bus.nstate), []
    bus.reset(state, sensor.impedance)
    for i in range(round(100 * seconds)):
        bus.advance(state, 0.01 * i, 0.01, sensor.impedance)
        rows.append(bus.readings(state)["electrodes"])
    np.savetxt(path, rows, fmt="%d")


def main(electrodes=None, force=None, seconds=30.0, skin="coarse", tier="condensed"):
    with tempfile.TemporaryDirectory() as folder:
        if electrodes is None:
            electrodes = pathlib.Path(folder) / "synthetic.txt"
            synthetic_recording(electrodes)
        diagnosis = diagnose_recording(read_recording(electrodes, force))
        print(summary(diagnosis))
        _, _, amended, *_ = write_report(diagnosis, folder)  # sensor_amended.yaml, beside report.html
        spec = mujoco.MjSpec.from_string(HAND)
        biotac_mj.attach(spec, site="fingertip", effects=amended, skin=skin, tier=tier)
    model = spec.compile()
    data, rows = mujoco.MjData(model), []
    while data.time < seconds:
        data.ctrl[0] = 0.3 * np.sin(data.time)
        mujoco.mj_step(model, data)
        rows.append(data.sensor("biotac_electrodes").data.copy())
    rows = np.array(rows)
    print("electrodes at first [counts]:", rows[:50].mean(0).round(1))
    print(f"and after {seconds:g} s:", rows[-50:].mean(0).round(1))
    return diagnosis.recording, rows


if __name__ == "__main__":
    main(*sys.argv[1:])
