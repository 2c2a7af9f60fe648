"""Other programs' soft bodies on a skin's linear tetrahedra, pressed by a driven sphere in steps of 2 ms.

- `Flex`: MuJoCo's own deformable. The settings are those with which it comes to quasi-static agreement: the
  "discrete" integrator, the CG solver, contact as stiff as it goes (direct solref, refsafe off). Its
  elasticity is Saint Venant-Kirchhoff's. Each world has a thread.
- `FlexWarp`: the same model in mujoco_warp, in single precision. It is in mm, mN and kPa: mujoco_warp merges
  contacts of a flex with a geom that are nearer than 0.001 units of length, so that in metres a sphere of
  7 mm touches this mesh in one point.
- `NewtonVBD`: Newton's vertex block descent. Its elasticity is stable Neo-Hooke with our Lame constants;
  contact is a penalty at the nodes. Worlds are those of Newton, all at one place: far from the origin single
  precision would be too coarse.

None has liquid or contact with the core. Held nodes are the skin's. Neither mujoco_warp's flex nor Newton is
a requirement of this package: `MISSING` names the scenes that cannot be made here.
"""

import concurrent.futures
import time
from collections.abc import Callable

import mujoco
import numpy as np
import warp as wp

from biotac_mj.geometry import SkinGeometry
from biotac_mj.skin import Material

try:
    import mujoco_warp as mjw
except ImportError:
    mjw = None
try:
    import newton
except ImportError:
    newton = None

__all__ = ["MISSING", "Flex", "FlexWarp", "NewtonVBD"]

TIMESTEP = 2e-3  # [s]
_STIFF = 'solref="1e-4 1" solimp=".9999 .9999 .001" condim="3"'
_MILLI = 1e-3  # of length [m], mujoco_warp's unit here
_CONTACTS, _ROWS = 256, 512  # of a world of mujoco_warp: before contacts are merged, of constraints
_PENALTY = 2e4  # [N/m] of a node of Newton's
_SIZE = 1e-9  # of a node [m]
_GAP = 1e-3  # [m] at which nodes are looked at for contact


@wp.kernel
def _drive_mocap(
    path: wp.array(dtype=wp.vec3), count: wp.array(dtype=int), mocap_pos: wp.array2d(dtype=wp.vec3)
):
    w = wp.tid()
    mocap_pos[w, 0] = path[count[0]]


@wp.kernel
def _drive_body(
    path: wp.array(dtype=wp.vec3), count: wp.array(dtype=int), body_q: wp.array(dtype=wp.transform)
):
    b = wp.tid()
    body_q[b] = wp.transform(path[wp.min(count[0], path.shape[0] - 1)], wp.quat_identity())


@wp.kernel
def _advance(count: wp.array(dtype=int)):
    count[0] = count[0] + 1


class _Scene:
    """A skin with its sphere in each world, for presses of any number of iterations.

    Args:
      geometry, material: the skin. radius: of the sphere [m].
      path: (n + 1, 3) its centres [m], the first at first touch: one step for each that follows.
      direction: (3,) unit direction of the press.
    """

    def __init__(
        self,
        geometry: SkinGeometry,
        material: Material,
        radius: float,
        path: np.ndarray,
        direction: np.ndarray,
        worlds: int = 1,
        device: str = "cpu",
    ):
        self.geometry, self.material, self.radius = geometry, material, radius
        self.path, self.direction, self.worlds, self.device = path, direction, worlds, device
        with wp.ScopedDevice(device):
            self.make()

    def make(self) -> None:
        """The program's model."""
        raise NotImplementedError

    def press(self, iterations: int) -> tuple[np.ndarray, np.ndarray]:
        """The whole path, in each step so many iterations of the solver.

        Returns:
          forces (n, worlds, 3) of the skin on the sphere after each step [N], wall seconds (n,) of the steps
          of all worlds.
        """
        raise NotImplementedError


class Flex(_Scene):
    def make(self):
        self.model = mujoco.MjModel.from_xml_string(_flex_xml(self))

    def press(self, iterations):
        self.model.opt.iterations, self.model.opt.tolerance = iterations, 0.0
        datas = [mujoco.MjData(self.model) for _ in range(self.worlds)]

        def drive(data):
            forces = []
            for center in self.path[1:]:
                data.mocap_pos[0] = center
                mujoco.mj_step(self.model, data)
                forces.append(_force_on_sphere(self.model, data))
            return forces

        with concurrent.futures.ThreadPoolExecutor(self.worlds) as pool:  # mj_step lets the interpreter go
            begin = time.perf_counter()
            forces = list(pool.map(drive, datas)) if self.worlds > 1 else [drive(datas[0])]
            moving = time.perf_counter() - begin
        steps = len(self.path) - 1
        return np.array(forces).swapaxes(0, 1), np.full(steps, moving / steps)


def _flex_xml(scene, unit=1.0):
    """The model as MuJoCo's XML; unit: of length [m], so that 1e-3 is a model in mm, mN and kPa."""

    def text(array):
        return " ".join(f"{v:.9g}" for v in np.ravel(array))

    geometry, material = scene.geometry, scene.material
    start = scene.path[0] - 1e-5 * scene.direction
    mass = (
        material.density
        * np.linalg.det(geometry.vert[geometry.tets[:, 1:]] - geometry.vert[geometry.tets[:, :1]]).sum()
        / 6
    )
    friction = f'friction="{material.friction} 0 0"'
    return f"""
<mujoco>
  <option timestep="{TIMESTEP}" integrator="discrete" solver="CG" gravity="0 0 0">
    <flag refsafe="disable"/>
  </option>
  <size memory="2G"/>
  <worldbody>
    <body mocap="true" pos="{text(start / unit)}">
      <geom type="sphere" size="{scene.radius / unit}" {friction} {_STIFF}/>
    </body>
    <flexcomp name="skin" type="direct" dim="3" radius="{1e-6 / unit}" mass="{mass}"
              point="{text(geometry.vert / unit)}" element="{text(geometry.tets)}">
      <pin id="{text(geometry.fixed)}"/>
      <elasticity young="{material.youngs_modulus * unit}" poisson="{material.poissons_ratio}"/>
      <contact selfcollide="none" {friction} {_STIFF}/>
    </flexcomp>
  </worldbody>
</mujoco>"""


def _force_on_sphere(model, data):
    total, wrench = np.zeros(3), np.zeros(6)
    for i in range(data.ncon):
        contact = data.contact[i]
        mujoco.mj_contactForce(model, data, i, wrench)  # on the second of the two, in the contact's frame
        total += (-1 if contact.geom[0] >= 0 else 1) * (wrench[:3] @ contact.frame.reshape(3, 3))
    return total


def _recorded(once: Callable[[], None]) -> Callable[[], None]:
    """A step that has been made once, which compiles it; on CUDA as one graph."""
    once()
    if not wp.get_device().is_cuda:
        return once
    with wp.ScopedCapture() as capture:
        once()
    return lambda: wp.capture_launch(capture.graph)


def _timed(step, count, force):
    """Forces after each of so many steps, and their wall seconds."""
    wp.synchronize_device()
    forces, seconds = [], []
    for _ in range(count):
        began = time.perf_counter()
        step()
        wp.synchronize_device()
        seconds.append(time.perf_counter() - began)
        forces.append(force())
    return np.array(forces), np.array(seconds)


class FlexWarp(_Scene):
    def make(self):
        self.model = mujoco.MjModel.from_xml_string(_flex_xml(self, _MILLI))
        data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, data)
        room = {"naconmax": _CONTACTS * self.worlds, "njmax": _ROWS}
        self.data = mjw.put_data(self.model, data, nworld=self.worlds, **room)
        start = self.path[:1] - 1e-5 * self.direction
        points = np.concatenate([start, self.path[1:]]) / _MILLI
        self.points = wp.array(points.astype(np.float32), dtype=wp.vec3)

    def press(self, iterations):
        """As `_Scene.press`.

        Raises:
          RuntimeError: there were more contacts or rows than there is room for.
        """
        self.model.opt.iterations, self.model.opt.tolerance = iterations, 0.0
        data = self.data
        with wp.ScopedDevice(self.device):
            model = mjw.put_model(self.model)
            model.opt.warn_overflow &= ~int(mjw.OverflowType.ITERATIONS)  # it is what is asked for
            count = wp.zeros(1, dtype=int)
            mjw.reset_data(model, data)

            def once():
                wp.launch(_drive_mocap, self.worlds, [self.points, count], [data.mocap_pos])
                mjw.step(model, data)
                wp.launch(_advance, 1, [count])

            step = _recorded(once)  # the sphere does not touch yet
            mjw.reset_data(model, data)
            count.fill_(1)
            data.overflow.zero_()
            ids = wp.array(np.arange(data.naconmax), dtype=int)
            each = wp.zeros(data.naconmax, dtype=wp.spatial_vector)

            def force():
                mjw.contact_force(model, data, ids, True, each)
                return self._sum(each.numpy())

            forces, seconds = _timed(step, len(self.path) - 1, force)
            lost = int(np.bitwise_or.reduce(data.overflow.numpy().ravel()))
        lost &= ~int(mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS)
        if lost:
            raise RuntimeError(
                f"mujoco_warp ran out of room: {mjw.OverflowType(lost)!r}; raise _CONTACTS, _ROWS"
            )
        return forces, seconds

    def _sum(self, each):
        """(worlds, 3) of the contacts' forces, each on the second of its two [N]."""
        contact, total = self.data.contact, np.zeros((self.worlds, 3))
        found = int(self.data.nacon.numpy()[0])
        sign = np.where(contact.geom.numpy()[:found, :1] >= 0, -1, 1)
        np.add.at(total, contact.worldid.numpy()[:found], sign * each[:found, :3].astype(float))
        return _MILLI * total  # mN here


class NewtonVBD(_Scene):
    def make(self):
        geometry, material = self.geometry, self.material
        self.outer = np.unique(geometry.outer_face)
        one = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        one.add_soft_mesh(
            pos=wp.vec3(0.0, 0.0, 0.0),
            rot=wp.quat_identity(),
            scale=1.0,
            vel=wp.vec3(0.0, 0.0, 0.0),
            vertices=[wp.vec3(*v) for v in geometry.vert],
            indices=geometry.tets.ravel().tolist(),
            density=material.density,
            k_mu=material.mu,
            k_lambda=material.lame,
            k_damp=0.0,
            add_surface_mesh_edges=False,  # they serve contact of skin with skin
            particle_radius=_SIZE,
        )
        for i in geometry.fixed:
            one.particle_mass[i] = 0.0
        at = wp.transform(wp.vec3(*self.path[0]), wp.quat_identity())
        body = one.add_body(xform=at, is_kinematic=True)
        config = newton.ModelBuilder.ShapeConfig(ke=_PENALTY, kd=0.0, mu=material.friction)
        one.add_shape_sphere(body, radius=self.radius, cfg=config)
        one.color()
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        builder.replicate(one, self.worlds)
        first = one.particle_count * np.arange(self.worlds)[:, None]
        builder.set_coloring([(first + group).ravel() for group in one.particle_color_groups])
        self.model = model = builder.finalize()
        model.soft_contact_ke, model.soft_contact_kd = _PENALTY, 0.0
        model.soft_contact_mu = material.friction
        self.points = wp.array(self.path.astype(np.float32), dtype=wp.vec3)

    def press(self, iterations):
        """As `_Scene.press`; forces are the sum of the penalties, without friction."""
        model, path = self.model, self.path
        with wp.ScopedDevice(self.device):
            solver = newton.solvers.SolverVBD(
                model, iterations=iterations, integrate_with_external_rigid_solver=True
            )
            pipeline = newton.CollisionPipeline(model, soft_contact_gap=_GAP)
            contacts, control = pipeline.contacts(), model.control()
            now, then = model.state(), model.state()
            count = wp.ones(1, dtype=int)

            def once():
                for state in (now, then):
                    wp.launch(_drive_body, self.worlds, [self.points, count], [state.body_q])
                now.clear_forces()
                pipeline.collide(now, contacts)
                solver.step(now, then, control, contacts, TIMESTEP)
                wp.copy(now.particle_q, then.particle_q)
                wp.copy(now.particle_qd, then.particle_qd)
                wp.launch(_advance, 1, [count])

            at_rest = wp.clone(now.particle_q)
            step = _recorded(once)
            wp.copy(now.particle_q, at_rest)
            now.particle_qd.zero_()
            count.fill_(1)

            def force():
                x = now.particle_q.numpy().reshape(self.worlds, -1, 3)[:, self.outer].astype(float)
                away = x - path[int(count.numpy()[0]) - 1]
                distance = np.linalg.norm(away, axis=2)
                depth = np.maximum(self.radius + _SIZE - distance, 0)
                return (-_PENALTY * (depth / distance)[:, :, None] * away).sum(1)

            return _timed(step, len(path) - 1, force)


MISSING = {scene for scene, program in ((FlexWarp, mjw), (NewtonVBD, newton)) if program is None}
