"""The peer: MuJoCo's own deformable, a flex on the same tetrahedra, pressed by a driven sphere in 2 ms steps.

The settings are those with which it comes to quasi-static agreement: the "discrete" integrator, the CG
solver, contact as stiff as it goes (direct solref, refsafe off). Its elasticity is Saint Venant-Kirchhoff's;
it has neither liquid nor core contact here."""

import time

import mujoco
import numpy as np

from biotac_mj.geometry import SkinGeometry

__all__ = ["SETTLE", "VERSION", "force_on_sphere", "model_xml", "press"]

VERSION = mujoco.__version__
TIMESTEP = 2e-3  # [s]
SETTLE = 20  # steps at rest at the end
_CONTACT = 'solref="1e-4 1" solimp=".9999 .9999 .001" condim="3"'


def press(geometry: SkinGeometry, material, radius: float, path: np.ndarray, direction: np.ndarray) -> dict:
    """Drives a sphere along a path, one step of 2 ms for each point, then holds it.

    Args:
      geometry, material: the skin.
      radius: of the sphere [m].
      path: (n + 1, 3) centres [m], the first at first touch.
      direction: (3,) unit direction of the press.

    Returns:
      ms_per_step, cpu_ms_per_step: wall and processor time of a step while the sphere moves; setup_s: of
        compiling the model;
      steps: how many moved;
      force: (3,) of the skin on the sphere at the end [N].
    """
    begin = time.perf_counter()
    model = mujoco.MjModel.from_xml_string(model_xml(geometry, material, radius, path[0] - 1e-5 * direction))
    data = mujoco.MjData(model)
    setup = time.perf_counter() - begin
    begin, cpu = time.perf_counter(), time.process_time()
    for center in path[1:]:
        data.mocap_pos[0] = center
        mujoco.mj_step(model, data)
    moving, cpu = time.perf_counter() - begin, time.process_time() - cpu
    for _ in range(SETTLE):
        mujoco.mj_step(model, data)
    moves = len(path) - 1
    return {
        "ms_per_step": 1e3 * moving / moves,
        "cpu_ms_per_step": 1e3 * cpu / moves,
        "setup_s": setup,
        "steps": moves,
        "force": force_on_sphere(model, data),
    }


def model_xml(geometry, material, radius, center):
    def text(array):
        return " ".join(f"{v:.9g}" for v in np.ravel(array))

    mass = (
        material.density
        * np.linalg.det(geometry.vert[geometry.tets[:, 1:]] - geometry.vert[geometry.tets[:, :1]]).sum()
        / 6
    )
    friction = f'friction="{material.friction} 0 0"'
    return f"""
<mujoco>
  <option timestep="{TIMESTEP}" integrator="discrete" solver="CG" iterations="100" tolerance="1e-8"
          gravity="0 0 0">
    <flag refsafe="disable"/>
  </option>
  <size memory="2G"/>
  <worldbody>
    <body mocap="true" pos="{text(center)}"><geom type="sphere" size="{radius}" {friction} {_CONTACT}/></body>
    <flexcomp name="skin" type="direct" dim="3" radius="1e-6" mass="{mass}"
              point="{text(geometry.vert)}" element="{text(geometry.tets)}">
      <pin id="{text(geometry.fixed)}"/>
      <elasticity young="{material.youngs_modulus}" poisson="{material.poissons_ratio}"/>
      <contact selfcollide="none" {friction} {_CONTACT}/>
    </flexcomp>
  </worldbody>
</mujoco>"""


def force_on_sphere(model, data):
    total, wrench = np.zeros(3), np.zeros(6)
    for i in range(data.ncon):
        contact = data.contact[i]
        mujoco.mj_contactForce(model, data, i, wrench)  # on the second of the two, in the contact's frame
        total += (-1 if contact.geom[0] >= 0 else 1) * (wrench[:3] @ contact.frame.reshape(3, 3))
    return total
