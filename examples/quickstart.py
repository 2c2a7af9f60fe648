"""A ball of 100 g comes to rest on a BioTac's pad; the electrodes say where. Runs headless: python
examples/quickstart.py"""

import mujoco

import biotac_mj

XML = """<mujoco><option timestep="0.004"/>
  <worldbody>
    <site name="fingertip" quat="1 -1 0 0"/>
    <body name="ball" pos="-0.01 0 0.0135">
      <joint type="slide" axis="0 0 1"/> <geom size="0.005" mass="0.1"/></body>
  </worldbody></mujoco>"""


def main(seconds=1.0, skin="default"):
    spec = mujoco.MjSpec.from_string(XML)  # any model of yours
    biotac_mj.attach(spec, site="fingertip", skin=skin)
    model = spec.compile()
    data = mujoco.MjData(model)
    while data.time < seconds:
        mujoco.mj_step(model, data)
    print("electrodes [counts]:", data.sensor("biotac_electrodes").data.astype(int))
    print("force on the BioTac [N]:", data.sensor("biotac_contact_force").data[:3].round(3))
    return model, data


if __name__ == "__main__":
    main()
