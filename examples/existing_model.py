"""A BioTac on a model of yours in dm_control: python examples/existing_model.py"""

from dm_control import composer, mjcf

from biotac_mj.tasks import TACTILE, BioTac

ROBOT = """<mujoco model="robot"><worldbody>
  <body name="arm" pos="0 0 0.02"><joint name="down" type="slide" axis="0 0 -1" damping="2"/>
    <geom type="box" size=".004 .004 .02" pos=".014 0 .02" mass=".05"/>
    <site name="fingertip" quat="1 1 0 0"/></body>
  <geom name="table" type="box" size=".05 .05 .005" pos="0 0 -.005"/></worldbody></mujoco>"""


def main(seconds=0.4):
    # --- your model, a BioTac at its site "fingertip"
    robot = composer.ModelWrapperEntity(mjcf.from_xml_string(ROBOT))
    finger = BioTac()
    finger.observables.enable(TACTILE)
    robot.attach(finger, robot.mjcf_model.find("site", "fingertip"))
    env = composer.Environment(composer.NullTask(robot), strip_singleton_obs_buffer_dim=True, random_state=0)
    # --- that is all
    step = env.reset()
    while env.physics.data.time < seconds:
        step = env.step([])
    print("electrodes [counts]:", step.observation["biotac/electrodes"].astype(int))
    print("force on the fingertip [N]:", finger.read(env.physics, "contact_force")[:3].round(3))
    return finger.read(env.physics, "contact_force"), step


if __name__ == "__main__":
    main()
