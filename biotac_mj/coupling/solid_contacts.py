"""MuJoCo's contacts of core, nail and clamp with what a skin meets, made those of the shapes that it meets,
and their forces.

A skin meets closed meshes with their hollows, and no geom before it touches. MuJoCo's contacts of the solid
parts are with convex hulls, and begin at a geom's margin: a finger in a cup would be thrown out, and the core
would carry a body through skin that is hardly touched. So each step takes margins away, and replaces contacts
with hulls of meshes that have hollows by those with the meshes themselves.

MuJoCo keeps friction of zero as mjMINMU, and regularises the edges of a pyramid by its square: such a contact
is 1e10 times as hard as its solimp says, and those of a body that is deep in the core contradict each other.
They have one row, as with condim 1."""

import ctypes
import functools
import math

import mujoco
import numpy as np

from ..geometry.rigid import cross, matrix
from ..geometry.solid import fills_hull
from .structs import LIBRARY, DataView, ModelView, c_structs
from .touching import Touching, mesh_of

CONTACT = np.dtype(c_structs("mjContact"))
_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
SOLVED = 1e-3  # of the forces at hand, which MuJoCo's constraint solver may leave open


def contacts_of(data: DataView) -> np.ndarray:
    """MuJoCo's contacts (ncon,), a structured view that writes through."""
    if not data.ncon:
        return np.zeros(0, CONTACT)
    memory = (ctypes.c_char * (data.ncon * CONTACT.itemsize)).from_address(data.struct.contact)
    return np.frombuffer(memory, CONTACT)


class SolidPairs:
    """Solid parts of one BioTac and geoms that its skin meets.

    Attributes:
      part: (k,) ids of the geoms of core, nail and clamp; shape: (s,) of those with hollows among the geoms
        that touch.
      part_of, shape_of: (ngeom,) number of each geom among the parts, and among the shapes, or -1.
      met: (ngeom,) whether the skin meets a geom.
    """

    def __init__(self, model: ModelView, touching: Touching):
        self.model, self.core = model, touching.core
        self.part = np.flatnonzero((model.geom_bodyid == touching.core) & (model.geom_type == _MESH))
        hollow = [g for g, one in zip(touching.geom, touching.geoms) if _is_hollow(model, int(g), one)]
        self.shape = np.array(hollow, dtype=np.int64)
        self.part_of, self.shape_of = np.full((2, model.ngeom), -1)
        self.part_of[self.part] = np.arange(len(self.part))
        self.shape_of[self.shape] = np.arange(len(self.shape))
        self.met = np.zeros(model.ngeom, bool)
        self.met[touching.geom] = True

    def overlaps(self, nworld: int = 1, device: object = "cpu") -> object:
        """The `Overlaps` of these pairs; their grids are made at the call."""
        from ..skin.contact.overlap import Overlaps
        from ..skin.geoms import GeomSet
        from .steppers.fem import grid_of

        parts, shapes = [], []
        for g in self.part:
            vert, face = mesh_of(self.model, int(self.model.geom_dataid[g]))
            vert = vert @ matrix(self.model.geom_quat[g]).T + self.model.geom_pos[g]
            parts.append(grid_of(vert, face))
        for g in self.shape:
            shapes.append(grid_of(*mesh_of(self.model, int(self.model.geom_dataid[g]))))
        count = len(parts) + len(shapes)
        grids = [*parts, *shapes]
        solids = GeomSet(["mesh"] * count, [()] * count, grids=grids, nworld=nworld, device=device)
        return Overlaps(parts, shapes, solids)


def _is_hollow(model, g, described):
    if model.geom_type[g] != _MESH or described.vert is None:
        return False
    vert, face = mesh_of(model, int(model.geom_dataid[g]))
    as_it_is = described.vert.shape == vert.shape and np.array_equal(described.vert, vert)
    return as_it_is and not _fills_hull(vert.tobytes(), face.tobytes())


@functools.lru_cache(maxsize=256)
def _fills_hull(vert, face):
    return fills_hull(np.frombuffer(vert).reshape(-1, 3), np.frombuffer(face, np.int32).reshape(-1, 3))


class SolidContacts(SolidPairs):
    """The same in one mjData. A shape that has moved by less than its distance, as that was last measured, is
    not measured again.

    Attributes:
      met_any: whether MuJoCo had contacts of these pairs when they were last amended.
    """

    met_any = False

    @functools.cached_property
    def _known(self):
        """For each pair the pose of the shape and a lower bound of its distance from the part there [m]; and
        the radius of each shape [m]."""
        shape = len(self.part), len(self.shape)
        vert = (mesh_of(self.model, int(self.model.geom_dataid[g]))[0] for g in self.shape)
        reach = [np.linalg.norm(v, axis=1).max() for v in vert]
        return np.zeros((*shape, 3)), np.zeros((*shape, 3, 3)), np.zeros(shape), np.array(reach)

    @functools.cached_property
    def _overlaps(self):
        return self.overlaps()

    def amend(self, data: DataView) -> bool:
        """Makes the contacts what they should be; whether any was another one, so that constraints have to be
        made again."""
        contacts = contacts_of(data)
        geom = contacts["geom"]
        first = (self.part_of[geom[:, 0]] >= 0) & self.met[geom[:, 1]]
        mine = first | (self.part_of[geom[:, 1]] >= 0) & self.met[geom[:, 0]]
        mine &= (geom >= 0).all(axis=1)  # -1: a flex
        self.met_any = bool(mine.any())
        if not self.met_any:
            return False
        rows, first = mine.nonzero()[0], first[mine]
        part = self.part_of[np.where(first, geom[rows, 0], geom[rows, 1])]
        shape = self.shape_of[np.where(first, geom[rows, 1], geom[rows, 0])]
        wide = rows[contacts["includemargin"][rows] != 0.0]
        contacts["includemargin"][wide] = contacts["exclude"][wide] = 0
        contacts["efc_address"][wide] = -1
        slick = rows[(contacts["friction"][rows, 0] <= mujoco.mjMINMU) & (contacts["dim"][rows] > 1)]
        contacts["dim"][slick] = 1
        gone = (shape >= 0) | (contacts["dist"][rows] >= 0.0)
        if gone.any():
            self._replace(data, contacts, rows[gone], first[gone], part[gone], shape[gone])
        return bool(len(wide) or len(slick) or gone.any())

    def _replace(self, data, contacts, rows, first, part, shape):
        templates = {}
        for row, forward, p, s in zip(rows.tolist(), first.tolist(), part.tolist(), shape.tolist()):
            if s >= 0:
                pair = p * len(self.shape) + s
                templates.setdefault(pair, (contacts[row].copy(), 1.0 if forward else -1.0))
        kept = np.delete(contacts, rows)
        contacts[: len(kept)] = kept
        data.struct.ncon = len(kept)
        if not templates:
            return
        for pair, pos, normal, depth in self._found(data, list(templates)):
            contact, sign = templates[pair]
            frame = contact_frame(sign * normal).ravel()
            contact["dist"], contact["pos"], contact["frame"] = -depth, pos, frame
            contact["includemargin"], contact["exclude"], contact["efc_address"] = 0.0, 0, -1
            made = np.atleast_1d(contact)
            if LIBRARY.mj_addContact(self.model.address, data.address, made.ctypes.data):
                break  # no room, of which MuJoCo warns

    def _found(self, data, pairs):
        """Contacts of these pairs in the world: (pair, pos, normal from part to shape, depth)."""
        found, core = self._overlaps, self.core
        frame, origin = data.xmat[core].reshape(3, 3), data.xpos[core]
        parts = len(self.part)
        pos, mat = found.pos.numpy()[:, 0], found.mat.numpy()[:, 0]
        pos[parts:] = (data.geom_xpos[self.shape] - origin) @ frame
        mat[parts:] = frame.T @ data.geom_xmat[self.shape].reshape(-1, 3, 3)
        at, turned, least, reach = self._known
        travel = np.linalg.norm(pos[parts:] - at, axis=2) + reach * np.linalg.norm(
            mat[parts:] - turned, axis=(2, 3)
        )
        wanted, near = found.wanted.numpy(), np.zeros(least.size, bool)
        near[pairs] = (travel >= least).ravel()[pairs]
        if not near.any():
            return
        wanted[:, 0] = near
        found.find()
        near = near.reshape(least.shape)
        least[near] = found.least.numpy().reshape(least.shape)[near]
        at[near] = np.broadcast_to(pos[parts:], at.shape)[near]
        turned[near] = np.broadcast_to(mat[parts:], turned.shape)[near]
        depth = found.depth.numpy()[:, :, 0]
        at, normal = (a.numpy()[:, :, 0] for a in (found.contact_pos, found.contact_normal))
        for pair, seed in np.argwhere(depth > 0.0):
            where, away = origin + frame @ at[pair, seed], frame @ normal[pair, seed]
            yield int(pair), where, away, float(depth[pair, seed])


def contact_frame(normal: np.ndarray) -> np.ndarray:
    """Axes (3, 3) of a contact, as rows, as MuJoCo makes them of its normal (3,)."""
    frame = np.zeros((3, 3))
    frame[0], frame[1, 1 if abs(normal[1]) < 0.5 else 2] = normal, 1.0
    frame[1] -= (frame[1] @ normal) * normal
    frame[1] /= math.sqrt(frame[1] @ frame[1])
    frame[2] = cross(frame[:1], frame[1:2])[0]
    return frame


def solid_wrench(
    model: ModelView, data: DataView, core: int, dofs: np.ndarray, trees: np.ndarray
) -> tuple[np.ndarray, bool]:
    """(2, 6) forces [N] and torques [N m] of contacts on the geoms of body `core`, about the origin of its
    frame and in that frame: of those that act on none of `trees` (ntree,) and of the others; and whether
    MuJoCo's solver finds them, on these dofs, to `SOLVED`.

    For when all passive forces are known and accelerations are not: where anything touches, MuJoCo's
    constraint solver runs in advance.
    """
    out = np.zeros((2, 6))
    if not data.ncon:
        return out, True
    contacts = contacts_of(data)
    geom = contacts["geom"]
    mine = (geom >= 0) & (model.geom_bodyid[geom] == core)  # -1: a flex, or none
    touching = (mine.any(axis=1) & (contacts["efc_address"] >= 0)).nonzero()[0]
    if not len(touching):
        return out, True
    solved = data.unsolved(data.acceleration(), dofs) < SOLVED
    which = data.trees_of_rows()[contacts["efc_address"][touching]][:, trees].any(axis=1)
    found, frame = np.empty(6), data.xmat[core].reshape(3, 3)
    for i, k in zip(touching, which.astype(int)):
        LIBRARY.mj_contactForce(model.address, data.address, int(i), found.ctypes.data)
        sign = float(mine[i, 1]) - float(mine[i, 0])  # it acts on the second
        force, torque = sign * found.reshape(2, 3) @ contacts["frame"][i].reshape(3, 3)
        torque += cross((contacts["pos"][i] - data.xpos[core])[None], force[None])[0]
        out[k] += np.concatenate([force @ frame, torque @ frame])
    return out, solved
