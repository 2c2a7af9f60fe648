"""The peer: MuJoCo's own deformable, a flex on the same tetrahedra, pressed by a driven sphere in 2 ms steps.

The settings are those with which it comes to quasi-static agreement: the "discrete" integrator, the CG
solver of 100 iterations, contact as stiff as it goes (direct solref, refsafe off). Its elasticity is Saint
Venant-Kirchhoff's; it has neither liquid nor core contact here."""

import concurrent.futures
import time

import mujoco
import numpy as np

from biotac_mj.geometry import SkinGeometry

__all__ = ["SETTLE", "VERSION", "force_on_sphere", "model_xml", "press"]

VERSION = mujoco.__version__
TIMESTEP = 2e-3  # [s]
SETTLE = 20  # steps at rest at the end
ITERATIONS, TOLERANCE = 100, 1e-8  # of its solver
_CONTACT = 'solref="1e-4 1" solimp=".9999 .9999 .001" condim="3"'


def press(
    geometry: SkinGeometry,
    material,
    radius: float,
    path: np.ndarray,
    direction: np.ndarray,
    iterations: int = ITERATIONS,
    tolerance: float = TOLERANCE,
    worlds: int = 1,
    settle: int = SETTLE,
) -> dict:
    """Drives a sphere along a path, one step of 2 ms for each point, then holds it.

    Args:
      geometry, material: the skin.
      radius: of the sphere [m].
      path: (n + 1, 3) centres [m], the first at first touch.
      direction: (3,) unit direction of the press.
      iterations, tolerance: where MuJoCo's solver stops; a tolerance of 0 asks for all iterations.
      worlds: presses side by side, each in a thread of its own.
      settle: steps for which the sphere is held at the end.

    Returns:
      ms_per_step, cpu_ms_per_step: wall and processor time of a step of all worlds while the sphere moves;
      setup_s: of compiling the model;
      steps: how many moved;
      forces: (n, worlds, 3) of the skin on the sphere in each step [N];
      force: (3,) that at the end, of the first world [N].
    """
    begin = time.perf_counter()
    model = mujoco.MjModel.from_xml_string(model_xml(geometry, material, radius, path[0] - 1e-5 * direction))
    model.opt.iterations, model.opt.tolerance = iterations, tolerance
    datas = [mujoco.MjData(model) for _ in range(worlds)]
    setup = time.perf_counter() - begin

    def drive(data):
        forces = []
        for center in path[1:]:
            data.mocap_pos[0] = center
            mujoco.mj_step(model, data)
            forces.append(force_on_sphere(model, data))
        return forces

    with concurrent.futures.ThreadPoolExecutor(worlds) as pool:  # mj_step lets the interpreter go
        begin, cpu = time.perf_counter(), time.process_time()
        forces = list(pool.map(drive, datas)) if worlds > 1 else [drive(datas[0])]
        moving, cpu = time.perf_counter() - begin, time.process_time() - cpu
    for _ in range(settle):
        mujoco.mj_step(model, datas[0])
    moves = len(path) - 1
    return {
        "ms_per_step": 1e3 * moving / moves,
        "cpu_ms_per_step": 1e3 * cpu / moves,
        "setup_s": setup,
        "steps": moves,
        "forces": np.array(forces).swapaxes(0, 1),
        "force": force_on_sphere(model, datas[0]),
    }


def model_xml(geometry, material, radius, center, unit=1.0):
    """The model as MuJoCo's XML; unit: of length [m], so that 1e-3 is a model in mm, mN and kPa."""

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
  <option timestep="{TIMESTEP}" integrator="discrete" solver="CG" iterations="{ITERATIONS}"
          tolerance="{TOLERANCE}" gravity="0 0 0">
    <flag refsafe="disable"/>
  </option>
  <size memory="2G"/>
  <worldbody>
    <body mocap="true" pos="{text(center / unit)}">
      <geom type="sphere" size="{radius / unit}" {friction} {_CONTACT}/>
    </body>
    <flexcomp name="skin" type="direct" dim="3" radius="{1e-6 / unit}" mass="{mass}"
              point="{text(geometry.vert / unit)}" element="{text(geometry.tets)}">
      <pin id="{text(geometry.fixed)}"/>
      <elasticity young="{material.youngs_modulus * unit}" poisson="{material.poissons_ratio}"/>
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
