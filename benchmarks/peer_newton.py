"""A peer on the GPU: Newton's VBD soft body (vertex block descent) on the same linear tetrahedra, pressed by
a driven sphere in 2 ms steps.

    python benchmarks/peer_newton.py [--device cuda:0] [--iterations 10,100,1000] [--worlds 1] [--json OUT]

Its elasticity is stable Neo-Hooke with our Lame constants; contact is a penalty at the nodes, of `CONTACT`
N/m each; it has neither liquid nor core contact here. Worlds are those of Newton, all at one place: far from
the origin single precision would be too coarse. The sphere is driven 1 mm, then held until the skin rests.
`force` is the sum of the penalties, without friction. Newton is no requirement of this package: without it
`VERSION` is None."""

import argparse
import pathlib
import sys
import time

sys.path.insert(0, str(pathlib.Path(__file__).parent))

import numpy as np
import warp as wp

try:
    import newton
except ImportError:
    newton = None

__all__ = ["VERSION", "Scene", "press", "time_newton"]

VERSION = newton and getattr(newton, "__version__", "?")
TIMESTEP = 2e-3  # [s]
SETTLE = 20  # steps at rest at the end
CONTACT = 2e4  # [N/m] of a node
SIZE = 1e-9  # of a node [m]
GAP = 1e-3  # [m] at which nodes are looked at for contact


@wp.kernel
def drive(
    path: wp.array(dtype=wp.vec3),
    count: wp.array(dtype=int),
    body_q: wp.array(dtype=wp.transform),
):
    b = wp.tid()
    body_q[b] = wp.transform(path[wp.min(count[0], path.shape[0] - 1)], wp.quat_identity())


@wp.kernel
def advance(count: wp.array(dtype=int)):
    count[0] = count[0] + 1


class Scene:
    """A skin with its sphere in each world, for presses of any number of iterations.

    Args:
      geometry, material: the skin.
      radius: of the sphere [m].
      path: (n + 1, 3) its centres [m], the first at first touch: one step for each that follows.
      worlds: how many.
      device: of Warp.
    """

    def __init__(self, geometry, material, radius: float, path: np.ndarray, worlds=1, device="cuda:0"):
        self.path, self.radius, self.worlds, self.device = path, radius, worlds, device
        self.outer = np.unique(geometry.outer_face)
        with wp.ScopedDevice(device):
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
                particle_radius=SIZE,
            )
            for i in geometry.fixed:
                one.particle_mass[i] = 0.0
            body = one.add_body(xform=wp.transform(wp.vec3(*path[0]), wp.quat_identity()), is_kinematic=True)
            config = newton.ModelBuilder.ShapeConfig(ke=CONTACT, kd=0.0, mu=material.friction)
            one.add_shape_sphere(body, radius=radius, cfg=config)
            one.color()
            builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
            builder.replicate(one, worlds)
            first = one.particle_count * np.arange(worlds)[:, None]
            builder.set_coloring([(first + group).ravel() for group in one.particle_color_groups])
            self.model = model = builder.finalize()
            model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = (
                CONTACT,
                0.0,
                material.friction,
            )
            self.points = wp.array(path.astype(np.float32), dtype=wp.vec3)

    def press(self, iterations: int, settle: int = SETTLE) -> tuple[np.ndarray, np.ndarray]:
        """The whole path, then held for `settle` steps.

        Returns:
          forces (n + settle, worlds, 3) of the skin on the sphere after each step [N];
          wall seconds (n + settle,) of the steps of all worlds."""
        model, path = self.model, self.path
        with wp.ScopedDevice(self.device):
            solver = newton.solvers.SolverVBD(
                model, iterations=iterations, integrate_with_external_rigid_solver=True
            )
            pipeline = newton.CollisionPipeline(model, soft_contact_gap=GAP)
            contacts, control = pipeline.contacts(), model.control()
            now, then = model.state(), model.state()
            count = wp.ones(1, dtype=int)

            def once():
                for state in (now, then):
                    wp.launch(drive, self.worlds, [self.points, count], [state.body_q])
                now.clear_forces()
                pipeline.collide(now, contacts)
                solver.step(now, then, control, contacts, TIMESTEP)
                wp.copy(now.particle_q, then.particle_q)
                wp.copy(now.particle_qd, then.particle_qd)
                wp.launch(advance, 1, [count])

            at_rest = wp.clone(now.particle_q)
            once()  # compiles
            graph = None
            if wp.get_device().is_cuda:
                with wp.ScopedCapture() as capture:
                    once()
                graph = capture.graph
            wp.copy(now.particle_q, at_rest)
            now.particle_qd.zero_()
            count.fill_(1)
            wp.synchronize_device()
            forces, seconds = [], []
            for k in range(len(path) - 1 + settle):
                began = time.perf_counter()
                wp.capture_launch(graph) if graph else once()
                wp.synchronize_device()
                seconds.append(time.perf_counter() - began)
                x = now.particle_q.numpy().reshape(self.worlds, -1, 3)[:, self.outer].astype(float)
                away = x - path[min(k + 1, len(path) - 1)]
                distance = np.linalg.norm(away, axis=2)
                depth = np.maximum(self.radius + SIZE - distance, 0)
                forces.append((-CONTACT * (depth / distance)[:, :, None] * away).sum(1))
        return np.array(forces), np.array(seconds)


def press(geometry, material, radius, path, iterations, worlds=1, device="cuda:0") -> dict:
    """Drives the sphere along path (n + 1, 3) [m], the first at first touch, one step for each point, then
    holds it.

    Returns:
      ms_per_step: wall time of a step while the spheres move, of all worlds; steps: how many moved;
      setup_s: with compilation;
      forces (n, worlds, 3) of the skin on the sphere in each step [N];
      force: (3,) of the first world at the end [N].
    """
    begin = time.perf_counter()
    forces, seconds = Scene(geometry, material, radius, path, worlds, device).press(iterations)
    steps = len(path) - 1
    return {
        "ms_per_step": 1e3 * float(seconds[:steps].mean()),
        "steps": steps,
        "setup_s": time.perf_counter() - begin - float(seconds.sum()),
        "forces": forces[:steps],
        "force": forces[-1, 0],
    }


def time_newton(ours: dict, iterations: int, converged=None) -> dict:
    """Newton's VBD on the mesh and path of one of our rows of linear elements, to where the core would be
    met; its row.

    `force_error_rel` is against our force, to which its law and contact add; `force_error_own` against
    `converged`, its own press of many iterations, (increments, 3) [N]: what stopping early costs, as our
    rows' error is."""
    from speed import INCREMENT, PEER_TRAVEL, RADIUS, standard_path

    from biotac_mj.geometry import load_skin
    from biotac_mj.skin import PRESETS

    increments = min(ours["increments"], round(PEER_TRAVEL / INCREMENT))
    path, _ = standard_path(load_skin(ours["skin"]), increments)
    result = press(
        load_skin(ours["skin"]), PRESETS["paper"], RADIUS, path, iterations, ours["worlds"], ours["device"]
    )
    wanted = np.array(ours["force"][:increments])
    force = result["forces"][:, 0]

    def error(truth):
        return float(np.linalg.norm(force - truth, axis=1).mean() / np.linalg.norm(truth, axis=1).max())

    own = None if converged is None else error(np.asarray(converged))
    return {
        "device": ours["device"],
        "solver": f"newton VBD x{iterations}",
        "skin": ours["skin"],
        "element": "linear",
        "tier": "full",
        "liquid": False,
        "worlds": ours["worlds"],
        "ms_per_press": result["ms_per_step"] * ours["increments"],
        "ms_per_step": result["ms_per_step"],
        "setup_s": result["setup_s"],
        "force_error_rel": error(wanted),
        "force_error_own": own,
        "note": "" if own is None else f"against its own converged press {own:.2%}",
        "increments": ours["increments"],
        "travel_m": increments * INCREMENT,
        "force": force.tolist(),
    }


def main():
    from records import write_json
    from speed import INCREMENT, PEER_TRAVEL, RADIUS, standard_path

    from biotac_mj.geometry import load_skin
    from biotac_mj.skin import PRESETS, GeomSet, SkinData, SkinModel, SkinOptions, step

    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--skin", default="default")
    parser.add_argument("--iterations", default="10,100,1000", help="comma-separated")
    parser.add_argument("--worlds", default="1", help="comma-separated")
    parser.add_argument("--increments", type=int, default=round(PEER_TRAVEL / INCREMENT))
    parser.add_argument("--json", type=pathlib.Path)
    options = parser.parse_args()
    if newton is None:
        print("Newton is not installed: left out")
        return
    wp.config.log_level = wp.LOG_WARNING
    geometry = load_skin(options.skin)
    path, _ = standard_path(geometry, options.increments)
    model = SkinModel(
        geometry, PRESETS["paper"], SkinOptions(element="linear", liquid=False, tolerance=1e-6, max_newton=60)
    )
    data, geoms = SkinData(model), GeomSet(["sphere"], [(RADIUS,)], [model.material.friction])
    geoms.set_pose(path[:1])
    ours = []
    for center in path[1:]:
        geoms.set_pose(center[None])
        step(model, data, geoms)
        ours.append(data.wrench[0, 0, :3].copy())
    ours, rows = np.array(ours), []
    for worlds in map(int, options.worlds.split(",")):
        for iterations in map(int, options.iterations.split(",")):
            result = press(geometry, PRESETS["paper"], RADIUS, path, iterations, worlds, options.device)
            size = np.linalg.norm(ours[-1])
            moving = np.linalg.norm(result["forces"][:, 0] - ours, axis=1).mean() / size
            held = np.linalg.norm(result["force"] - ours[-1]) / size
            rows.append(
                {
                    "device": wp.get_device(options.device).name,
                    "solver": f"newton {VERSION} VBD",
                    "skin": options.skin,
                    "worlds": worlds,
                    "iterations": iterations,
                    "ms_per_step": result["ms_per_step"],
                    "setup_s": result["setup_s"],
                    "steps": result["steps"],
                    "force_error_rel": float(moving),
                    "force_error_held": float(held),
                    "force_N": float(np.linalg.norm(result["force"])),
                    "force_ours_N": float(size),
                }
            )
            print(
                "  ".join(
                    f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in rows[-1].items()
                ),
                flush=True,
            )
    if options.json:
        write_json(options.json, {"rows": rows})


if __name__ == "__main__":
    main()
