"""A peer on the GPU: MuJoCo's flex in mujoco_warp, the model of `peer_flex.py` in a batch of worlds.

The model is in mm, mN and kPa: mujoco_warp merges contacts of a flex with a geom that are nearer than 0.001
units of length, so that in metres a sphere of 7 mm touches this mesh in one point. Forces are in N here all
the same. mujoco_warp computes in single precision."""

import time

import mujoco
import numpy as np
import warp as wp
from peer_flex import model_xml

try:
    import mujoco_warp as mjw
except ImportError:
    mjw = None

__all__ = ["VERSION", "Scene"]

VERSION = mjw and getattr(mjw, "__version__", mujoco.__version__)
UNIT = 1e-3  # of length [m]
CONTACTS = 256  # a world, before they are merged
ROWS = 512  # of constraints a world


@wp.kernel
def drive(path: wp.array(dtype=wp.vec3), count: wp.array(dtype=int), mocap_pos: wp.array2d(dtype=wp.vec3)):
    w = wp.tid()
    mocap_pos[w, 0] = path[count[0]]


@wp.kernel
def advance(count: wp.array(dtype=int)):
    count[0] = count[0] + 1


class Scene:
    """A skin with its sphere in each world, for presses of any number of iterations; arguments as those of
    `peer_newton.Scene`, and direction (3,), the unit direction of the press."""

    def __init__(self, geometry, material, radius, path, direction, worlds=1, device="cuda:0"):
        start = path[0] - 1e-5 * direction
        self.model = mujoco.MjModel.from_xml_string(model_xml(geometry, material, radius, start, UNIT))
        self.steps, self.worlds, self.device = len(path) - 1, worlds, device
        data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, data)
        with wp.ScopedDevice(device):
            self.data = mjw.put_data(self.model, data, nworld=worlds, naconmax=CONTACTS * worlds, njmax=ROWS)
            points = np.concatenate([start[None], path[1:]]) / UNIT
            self.points = wp.array(points.astype(np.float32), dtype=wp.vec3)

    def press(self, iterations: int, tolerance: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """The whole path, one step of 2 ms for each point.

        Returns:
          forces (n, worlds, 3) of the skin on the sphere after each step [N], wall seconds (n,) of the steps
          of all worlds.

        Raises:
          RuntimeError: there were more contacts or rows than there is room for."""
        self.model.opt.iterations, self.model.opt.tolerance = iterations, tolerance
        data = self.data
        with wp.ScopedDevice(self.device):
            model = mjw.put_model(self.model)
            model.opt.warn_overflow &= ~int(mjw.OverflowType.ITERATIONS)  # it is what is asked for
            count = wp.zeros(1, dtype=int)
            mjw.reset_data(model, data)

            def once():
                wp.launch(drive, self.worlds, [self.points, count], [data.mocap_pos])
                mjw.step(model, data)
                wp.launch(advance, 1, [count])

            once()  # compiles; the sphere does not touch yet
            graph = None
            if wp.get_device().is_cuda:
                with wp.ScopedCapture() as capture:
                    once()
                graph = capture.graph
            mjw.reset_data(model, data)
            count.fill_(1)
            data.overflow.zero_()
            ids = wp.array(np.arange(data.naconmax), dtype=int)
            each = wp.zeros(data.naconmax, dtype=wp.spatial_vector)
            wp.synchronize_device()
            forces, seconds = [], []
            for _ in range(self.steps):
                began = time.perf_counter()
                wp.capture_launch(graph) if graph else once()
                wp.synchronize_device()
                seconds.append(time.perf_counter() - began)
                mjw.contact_force(model, data, ids, True, each)
                forces.append(self._sum(each.numpy()))
            lost = int(np.bitwise_or.reduce(data.overflow.numpy().ravel()))
        lost &= ~int(mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS)
        if lost:
            raise RuntimeError(
                f"mujoco_warp ran out of room: {mjw.OverflowType(lost)!r}; raise CONTACTS, ROWS"
            )
        return np.array(forces), np.array(seconds)

    def _sum(self, each):
        """(worlds, 3) of the contacts' forces, each on the second of its two [N]."""
        contact, total = self.data.contact, np.zeros((self.worlds, 3))
        found = int(self.data.nacon.numpy()[0])
        sign = np.where(contact.geom.numpy()[:found, :1] >= 0, -1, 1)
        np.add.at(total, contact.worldid.numpy()[:found], sign * each[:found, :3].astype(float))
        return UNIT * total  # mN here
