"""The other geoms of a MuJoCo model on the page in the browser."""

import mujoco
import numpy as np

from .offscreen import SHOWN


class Scene:
    """Adds the visible geoms of `model` to a viser server, except planes and those of `hidden` bodies.

    Args:
      server: ViserServer. model: MjModel. hidden: names of bodies that are drawn otherwise.
    """

    def __init__(self, server: object, model: mujoco.MjModel, hidden: tuple | list = ()):
        hidden = {model.body(name).id for name in hidden}
        self._frames = {}
        for g in range(model.ngeom):
            mesh = geom_mesh(model, g)
            body, color = int(model.geom_bodyid[g]), geom_color(model, g)
            if mesh is None or model.geom_group[g] >= SHOWN or color[3] == 0 or body in hidden:
                continue
            if body not in self._frames:
                self._frames[body] = server.scene.add_frame(f"/model/{body}", show_axes=False)
            server.scene.add_mesh_simple(
                f"/model/{body}/{g}",
                mesh[0].astype(np.float32),
                mesh[1].astype(np.uint32),
                color=tuple(int(255 * c) for c in color[:3]),
                opacity=None if color[3] == 1 else float(color[3]),
                position=model.geom_pos[g],
                wxyz=model.geom_quat[g],
                flat_shading=False,
            )

    def update(self, data: mujoco.MjData) -> None:
        """Moves the bodies to their poses in `data`."""
        for body, frame in self._frames.items():
            frame.position, frame.wxyz = data.xpos[body].copy(), data.xquat[body].copy()


def geom_color(model: mujoco.MjModel, g: int) -> np.ndarray:
    """RGBA (4,) of a geom, from its material if it has one."""
    material = int(model.geom_matid[g])
    return model.mat_rgba[material] if material >= 0 else model.geom_rgba[g]


def geom_mesh(model: mujoco.MjModel, g: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices (n, 3) [m] and triangles (m, 3) of a geom in its frame; None without a finite surface."""
    from ..triangles import trimesh

    kind, size = mujoco.mjtGeom(model.geom_type[g]), model.geom_size[g]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        m = int(model.geom_dataid[g])
        vert, face = slice(model.mesh_vertadr[m], None), slice(model.mesh_faceadr[m], None)
        return model.mesh_vert[vert][: model.mesh_vertnum[m]], model.mesh_face[face][: model.mesh_facenum[m]]
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        made = trimesh.creation.icosphere(subdivisions=3)
        made.apply_scale(size if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID else size[[0, 0, 0]])
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        made = trimesh.creation.box(2 * size)
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        made = trimesh.creation.capsule(height=2 * size[1], radius=size[0])
        made.apply_translation([0, 0, -made.bounds.mean(0)[2]])
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        made = trimesh.creation.cylinder(radius=size[0], height=2 * size[1])
    else:
        return None
    return made.vertices, made.faces
