"""A skin of independent springs on a flat pad: the coupling's test double, simple enough to know by heart.

Every node of a square grid in the plane y = -8 mm resists the depth d of a geom over it with the force k d
along the geom's normal there, and sliding with a tangential spring (stiffness k / 2) that is anchored in the
geom and yields at mu k d."""

import numpy as np

from biotac_mj.coupling import SkinResult, SkinStepper, register_stepper
from biotac_mj.geometry.skin_geometry import SkinGeometry

HEIGHT = -0.008


def pad_geometry(count=9, spacing=0.001, name="pad of springs"):
    """A `SkinGeometry` whose nodes are a grid of count x count on the pad, around x = -10 mm."""
    line = (np.arange(count) - (count - 1) / 2) * spacing
    x, z = np.meshgrid(line - 0.010, line, indexing="ij")
    vert = np.stack([x.ravel(), np.full(x.size, HEIGHT), z.ravel()], axis=1)
    a = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    outer = np.concatenate(
        [np.stack([a, a + count, a + 1], 1), np.stack([a + 1, a + count, a + count + 1], 1)]
    )
    corner = np.array([[x, y, z] for x in (-0.019, 0.005) for y in (-0.005, 0.003) for z in (-0.005, 0.005)])
    box = np.array(
        [
            [0, 1, 3],
            [0, 3, 2],
            [4, 6, 7],
            [4, 7, 5],
            [0, 4, 5],
            [0, 5, 1],
            [2, 3, 7],
            [2, 7, 6],
            [0, 2, 6],
            [0, 6, 4],
            [1, 5, 7],
            [1, 7, 3],
        ]
    )
    electrode = np.stack([np.linspace(-0.015, 0.0, 19), np.full(19, -0.005), np.zeros(19)], axis=1)
    return SkinGeometry(
        name=name,
        vert=vert,
        elem=np.zeros((0, 4)),
        outer_face=outer,
        inner_face=np.zeros((0, 3)),
        fixed=np.zeros(0),
        core_vert=corner,
        core_face=box,
        nail_vert=np.zeros((0, 3)),
        nail_face=np.zeros((0, 3)),
        clamp_vert=np.zeros((0, 3)),
        clamp_face=np.zeros((0, 3)),
        electrode_pos=electrode,
        electrode_normal=np.tile([0.0, -1.0, 0.0], (19, 1)),
    )


def _depth(geom, point):
    """Depth (n,) of points (n, 3) in the geom's frame and its outward normals (n, 3)."""
    if geom.type == "sphere":
        distance = np.linalg.norm(point, axis=1)
        return geom.size[0] - distance, point / np.maximum(distance, 1e-12)[:, None]
    if geom.type == "plane":
        return -point[:, 2], np.tile([0.0, 0.0, 1.0], (len(point), 1))
    if geom.type == "box":
        gap = np.abs(point) - geom.size
        axis = gap.argmax(axis=1)
        normal = np.zeros_like(point)
        normal[np.arange(len(point)), axis] = np.sign(point[np.arange(len(point)), axis])
        return -gap.max(axis=1), normal
    # the springs do not feel other shapes
    return np.full(len(point), -1.0), np.tile([0.0, 0.0, 1.0], (len(point), 1))


class SpringSkin(SkinStepper):
    """State of a node: geom it touches (0: none, i + 1), then its anchor in that geom's
    frame."""

    def __init__(self, config, geometry, geoms):
        self.vert, self.geoms = geometry.vert, geoms
        self.ngroup = 1 + max((g.group for g in geoms), default=-1)
        self.k = float(config.options.get("stiffness", 1e3))
        self.fail_at = config.options.get("fail_at")
        self.nstate = 4 * len(self.vert) + 3 * len(self.vert)

    def reset(self, state):
        state[: 4 * len(self.vert)] = 0.0
        state[4 * len(self.vert) :] = self.vert.ravel()

    def vert_xpos(self, state):
        return state[4 * len(self.vert) :].reshape(-1, 3)

    def solve_skin(self, state, geom_pos, geom_mat, dt, **more):
        n = len(self.vert)
        new = state.copy()
        memory, moved = new[: 4 * n].reshape(n, 4), self.vert.copy()
        touched = np.full(n, -1)
        wrench, tangent = np.zeros((self.ngroup, 6)), np.zeros((self.ngroup, 6, 6))
        for i, (geom, pos, mat) in enumerate(zip(self.geoms, geom_pos, geom_mat)):
            local = (self.vert - pos) @ mat
            depth, normal = _depth(geom, local)
            node = np.flatnonzero((depth > 0) & (touched < 0))
            if not len(node):
                continue
            fresh = node[memory[node, 0] != i + 1]
            memory[fresh, 0], memory[fresh, 1:] = i + 1, local[fresh]
            touched[node] = i
            x, out, depth = self.vert[node], normal[node] @ mat.T, depth[node]
            slip = pos + memory[node, 1:] @ mat.T - x
            slip -= out * (out * slip).sum(axis=1, keepdims=True)
            trial = 0.5 * self.k * np.linalg.norm(slip, axis=1)
            share = np.minimum(1.0, geom.friction * self.k * depth / np.maximum(trial, 1e-300))
            slip *= share[:, None]
            memory[node, 1:] = np.where(share[:, None] < 1.0, (x + slip - pos) @ mat, memory[node, 1:])
            force = self.k * depth[:, None] * out + 0.5 * self.k * slip  # on the nodes
            wrench[geom.group] -= np.concatenate([force.sum(axis=0), np.cross(x, force).sum(axis=0)])
            project = out[:, :, None] * out[:, None, :]
            across = np.eye(3) - project
            along = slip / np.maximum(np.linalg.norm(slip, axis=1), 1e-300)[:, None]
            # a sliding spring resists across its motion only; how its force follows the normal force is left
            # out (not symmetric)
            across -= np.where(share < 1.0, 1.0, 0.0)[:, None, None] * along[:, :, None] * along[:, None, :]
            stiff = self.k * project + 0.5 * self.k * share[:, None, None] * across
            at = np.zeros((len(node), 3, 6))  # velocity at x of a body that moves by (t, w): t + w x x
            at[:, :, :3] = np.eye(3)
            at[:, 0, 4], at[:, 0, 5], at[:, 1, 5] = x[:, 2], -x[:, 1], x[:, 0]
            at[:, 1, 3], at[:, 2, 3], at[:, 2, 4] = -x[:, 2], x[:, 1], -x[:, 0]
            tangent[geom.group] += np.einsum("nia,nij,njb->ab", at, stiff, at)
            moved[node] = x + out * depth[:, None]
        memory[touched < 0] = 0.0
        new[4 * n :] = moved.ravel()
        return SkinResult(new, wrench, tangent, moved, pressure=1e4 * np.abs(wrench[:, 1]).sum())


class SumReadings:
    """Readings with memory: e1 counts steps, pdc is the pressure, pac a random walk seeded by the
    settings."""

    nstate = 2
    rest = {"electrodes": np.full(19, 3000.0)}

    def __init__(self, config, geometry):
        self.seed = config.seed

    def reset(self, state):
        state[:] = 0.0

    def advance(self, state, time, dt, vert_xpos, pressure):
        state[0] += 1
        state[1] += np.random.default_rng([self.seed, int(state[0])]).normal()
        return {
            "electrodes": 3000.0 + 1e5 * (vert_xpos[:19, 1] - HEIGHT) + (np.arange(19) == 0) * state[0],
            "pdc": pressure,
            "pac": state[1],
        }


register_stepper("springs", SpringSkin)

from biotac_mj.coupling import register_readings  # noqa: E402

register_readings("sum", SumReadings)
