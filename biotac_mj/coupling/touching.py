"""Geoms of a model that can touch a BioTac, and their poses at the end of the step."""

import functools
import math
import warnings
from collections.abc import Iterable

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from ..geometry.rigid import matrix
from ..geometry.solid import bounds_solid, close_rim, convex_hull, face_outwards, ground, joined
from .config import OWN, Config
from .stepper import Geom
from .structs import ModelView

_SHAPES = "plane sphere capsule ellipsoid cylinder box mesh".split()
_TYPES = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{shape.upper()}")): shape for shape in _SHAPES}
_HFIELD = int(mujoco.mjtGeom.mjGEOM_HFIELD)
_TYPES[_HFIELD] = "mesh"  # the ground under it
_TYPES[int(mujoco.mjtGeom.mjGEOM_SDF)] = "mesh"  # that MuJoCo has made of it
_HUGE = mujoco.mjMAXVAL  # [m] what MuJoCo takes in no qpos
_APART = 1e3  # [m] where geoms touch no skin
_noted = {}  # address of a model -> what was said of it


class Touching:
    """The geoms that can touch the BioTac fixed to body `core`, grouped by body.

    Attributes:
      core: id of the BioTac's body.
      geom: (ngeom,) ids of the geoms; geoms: their `Geom` descriptions.
      body: (ngroup,) ids of the touching bodies, a BioTac's twice: as its skin, and as nail and clamp. group:
        (ngeom,) which of them each geom is on.
      fraction: (ngroup,) of what the skin is pushed by each with that this BioTac answers for: half of it
        where another one's skin is pushed as well and answers for the other half.
      path: (ngroup,) of a body's way that what the skin meets goes along: half, where that is another skin.
      skins: numbers of the touching bodies that are BioTacs with a skin.
      by_mocap: (ngroup,) bool, whether a mocap body moves it or the BioTac: its motion is known from its
        poses alone, since a mocap body has no velocity.
      parted: whether nothing touches, wherever bodies are: the skin sees its geoms far away.
      notes: for the user: meshes that are met as their convex hulls, geoms that cannot touch.

    Raises:
      ValueError: a named geom is missing or ambiguous, or lies on the BioTac's own link; a rounding of one
        that is not named; a flex that collides with the BioTac.
    """

    def __init__(self, model: ModelView, core: int, config: Config, compiling: bool = False):
        self.core, self.parted = core, False
        _refuse_flexes(model, core)
        find_geoms(model, {**(config.thermal or {}), **(config.textures or {})})
        named = ids = _select(model, core, config.geoms)
        # contact exclusions are not yet in the model while it is compiled
        if config.geoms is None and not compiling:
            ids = _not_excluded(model, core, ids)
        meshes, self.notes = {}, []
        if not compiling:  # nor are meshes
            meshes, self.notes = _meshes(model, core, ids)
            ids = np.array([i for i in ids if meshes.get(int(i), True) is not None], dtype=np.int64)
        # a body's skin and its rigid parts are groups of their own
        is_rigid = np.array([not _has_skin(model, core, g) for g in ids], dtype=np.int64)
        parts = 2 * model.geom_bodyid[ids] + is_rigid
        self.geom = ids
        parts, self._first, group = np.unique(parts, return_index=True, return_inverse=True)
        self.body = parts // 2
        rounding = {_resolve(model, name): radius for name, radius in config.rounding.items()}
        for i in rounding:
            if model.geom_bodyid[i] == core:
                raise ValueError(
                    f"rounding is of geom {model.name('geom', i)!r}, a part of the BioTac: leave it out"
                )
            if config.geoms is not None and i not in named:
                raise ValueError(outside_geoms(model.name("geom", i)))
        self.geoms = [
            _describe(model, core, g, int(k), float(rounding.get(int(g), 0.0)), config, meshes.get(int(g)))
            for g, k in zip(ids, group)
        ]
        self.group = group
        self.fraction, self.path = np.ones((2, len(self.body)))
        self.skins = [g.group for g in self.geoms if g.type == "skin"]
        self.path[self.skins] = 0.5
        # one that is only read answers for nothing, and where others do not meet this one it answers for all
        if self.skins and not compiling and config.coupling == "two-way" and _is_met(model, core):
            self.fraction[[k for k in self.skins if _pushes(model, self.body[k])]] = 0.5
        moved = model.body_mocapid[model.body_rootid] >= 0
        self.by_mocap = moved[self.body] | moved[core]
        self._geom_pos, self._geom_mat = model.geom_pos[ids][:, :, None], matrix(model.geom_quat[ids])

    def warn(self, model: ModelView | None = None) -> None:
        """Warns of the notes, each once a model where MuJoCo tells when one is made (`forget_notes`)."""
        said = set() if model is None else _noted.setdefault(model.address, set())
        for note in self.notes:
            if note not in said:
                said.add(note)
                warnings.warn(note, stacklevel=2)

    def key(self) -> bytes:
        """Bytes that differ whenever the skin would see other geoms."""
        parts = []
        for g in self.geoms:
            parts.append(repr((g.type, g.size.tolist(), g.friction, g.group, g.rounding)).encode())
            meshes = ((g.vert, g.face), g.rigid)
            parts += [a.tobytes() for mesh in meshes for a in mesh or () if a is not None]
        return b"|".join(parts)

    def geom_pose(self, pos: np.ndarray, mat: np.ndarray) -> tuple:
        """Poses (ngeom, 3), (ngeom, 3, 3) of the geoms on bodies at (ngroup, 3), (ngroup, 3, 3).

        Raises:
          ValueError: a pose is not finite, or huge.
        """
        self.check(pos, mat)
        owner = mat[self.group]
        geom_pos, geom_mat = pos[self.group] + (owner @ self._geom_pos)[:, :, 0], owner @ self._geom_mat
        if self.parted:
            geom_pos -= self._separation(geom_mat)
        return geom_pos, geom_mat

    def _separation(self, geom_mat):
        """Displacement that removes geoms from the pad, planes against their normals. MuJoCo's compiler, too,
        makes its one step without contact."""
        plane = np.array([[g.type == "plane"] for g in self.geoms], bool).reshape(-1, 1)
        return _APART * np.where(plane, geom_mat[:, :, 2], (0.0, 1.0, 0.0))

    def body_pose(self, geom_pos: np.ndarray, geom_mat: np.ndarray) -> tuple:
        """Poses (ngroup, 3), (ngroup, 3, 3) of the bodies whose geoms are at (ngeom, 3), (ngeom, 3, 3)."""
        if self.parted:
            geom_pos = geom_pos + self._separation(geom_mat)
        pos, turned = self._first_geom
        mat = geom_mat[self._first] @ turned
        return geom_pos[self._first] - (mat @ pos)[:, :, 0], mat

    @functools.cached_property
    def _first_geom(self):
        """Position of the first geom of each body, and the rotation from it to the body."""
        return self._geom_pos[self._first], self._geom_mat[self._first].transpose(0, 2, 1)

    def check(self, pos: np.ndarray, mat: np.ndarray) -> None:
        """Raises ValueError for poses (ngroup, 3), (ngroup, 3, 3) that are not finite, or huge."""
        if np.abs(pos).max(initial=0.0) < _HUGE and math.isfinite(mat.sum()):
            return
        bad = ~((np.abs(pos) < _HUGE).all(axis=1) & np.isfinite(mat.sum(axis=(1, 2))))
        names = [g.name or f"#{i}" for g, i in zip(self.geoms, self.geom) if bad[g.group]]
        raise ValueError(
            f"NaN or a huge number in the pose of the BioTac or of geom {', '.join(names)}: "
            "check mocap_pos, mocap_quat, qpos and qvel"
        )


def _select(model, core, names):
    weld = model.body_weldid
    own = weld[core]
    if names is not None:
        ids = [_resolve(model, name) for name in names]
        for i in ids:
            if weld[model.geom_bodyid[i]] == own and own:
                raise ValueError(
                    f"geom {model.name('geom', i)!r} is fixed to the BioTac and cannot touch it: "
                    "leave it out of geoms"
                )
        return np.array(sorted(ids), dtype=np.int64)
    # as in MuJoCo's filter: links joined by one joint do not collide
    parent = model.body_weldid[model.body_parentid]
    contype, conaffinity = _masks(model, core)
    meets = (model.geom_contype & conaffinity | contype & model.geom_conaffinity) != 0
    pairs = np.stack([model.pair_geom1, model.pair_geom2])  # that MuJoCo collides whatever the masks are
    of_core = model.geom_bodyid[pairs] == core
    meets[pairs[of_core[::-1]]] = True
    out = []
    for i in np.flatnonzero(meets):
        body = model.geom_bodyid[i]
        if weld[body] == own:
            continue
        if (weld[body] and weld[body] == parent[own]) or (own and parent[weld[body]] == own):
            continue
        out.append(i)
    return np.array(out, dtype=np.int64)


def _masks(model, core):
    """contype and conaffinity of a BioTac's solid parts."""
    mine = model.geom_bodyid == core
    return [np.bitwise_or.reduce(m[mine], initial=0) for m in (model.geom_contype, model.geom_conaffinity)]


def _refuse_flexes(model, core):
    """Raises ValueError for flexes that collide with a BioTac: they would pass through its skin."""
    if not model.nflex:
        return
    contype, conaffinity = _masks(model, core)
    meets = (model.flex_contype & conaffinity | contype & model.flex_conaffinity) != 0
    if meets.any():
        names = (model.name("flex", i) or f"#{i}" for i in np.flatnonzero(meets).tolist())
        raise ValueError(deformable(map(repr, names)))


def deformable(names: Iterable[str]) -> str:
    """Error text for flexes that collide with a BioTac."""
    return (
        f"flex {', '.join(names)} collides with the BioTac, whose skin meets rigid geoms alone: set its "
        "contype and conaffinity to 0, or name the geoms that may touch with geoms=[...]"
    )


def _has_skin(model, core, geom):
    """Whether a geom is the core of another BioTac that meets the skin of BioTac `core`, as both meet all
    that collides."""
    own = model.geom_contype[model.geom_bodyid == core]
    return _is_core(model, geom) and bool((own & OWN).any())


def _is_core(model, geom):
    """Whether a geom is the core of a BioTac that meets others; bodies of a user may have its mask."""
    name, body = model.name("geom", geom), model.geom_bodyid[geom]
    return (
        bool(model.geom_contype[geom] & OWN)
        and model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
        and name == model.name("body", body)
    )


def _is_met(model, core):
    """Whether other BioTacs meet the skin of BioTac `core`: they find it by the geoms of its core."""
    return any(
        _has_skin(model, core, g) and _skin_of(model, g) for g in np.flatnonzero(model.geom_bodyid == core)
    )


def _pushes(model, body):
    """Whether the BioTac of a body is coupled two-way, as all in a batch without plugins may be."""
    index = int(model.body_plugin[body])
    return index < 0 or Config.parse(lambda name: model.config(index, name)).coupling == "two-way"


def outside_geoms(name: str) -> str:
    """Error text for the rounding of a geom that is not among the touching ones."""
    return f"rounding is of geom {name!r}, which is none of geoms: add it there, or leave it out"


def _not_excluded(model, core, ids):
    pairs = {tuple(sorted((core, int(model.geom_bodyid[i])))) for i in ids}
    excluded = {
        pair
        for pair in pairs
        if model.nexclude and np.any(model.exclude_signature == (pair[0] << 16) + pair[1])
    }
    return np.array(
        [i for i in ids if tuple(sorted((core, int(model.geom_bodyid[i])))) not in excluded], dtype=np.int64
    )


def geom_type(kind: int) -> str:
    """Type of the shape that a skin meets where MuJoCo has a geom of type `kind`; "" where it meets none."""
    return _TYPES.get(int(kind), "")


def find_geoms(model: ModelView, wanted: Iterable[str]) -> None:
    """Raises ValueError for the name of a geom that the model has not."""
    for name in wanted:
        names, matches = _matches(model, name)
        if not matches:
            found = ", ".join(n for n in names if n) or "no named geom"
            raise ValueError(f"no geom {name!r} to touch: the model has {found}")


def _matches(model, name):
    """Names of all geoms, and the numbers of those that a name of the settings means."""
    names = [model.name("geom", i) for i in range(model.ngeom)]
    exact = [i for i, n in enumerate(names) if n == name]
    return names, exact or [i for i, n in enumerate(names) if n.endswith(name)]  # after a further attach


def _resolve(model, name):
    names, matches = _matches(model, name)
    if len(matches) != 1:
        found = "none" if not matches else ", ".join(names[i] for i in matches)
        raise ValueError(
            f"geom {name!r} of the BioTac's settings matches {found}: the model has "
            f"{', '.join(n for n in names if n) or 'no named geom'}"
        )
    return matches[0]


def forget_notes(model: ModelView) -> None:
    """Forgets the warnings of an earlier model at the address of one that is being made."""
    _noted.pop(model.address, None)


def _skin_of(model, geom):
    """Mesh (n, 3) [m], (m, 3) of the skin at rest around a BioTac's core, in the frame of that geom; None
    where the model shows none."""
    body = model.geom_bodyid[geom]
    shown = np.flatnonzero(model.skin_bonebodyid[model.skin_boneadr] == body) if model.nskin else ()
    if not len(shown):
        return None
    vert, face = (_part(model, shown[0], part, "skin") for part in ("vert", "face"))
    vert = (vert - model.geom_pos[geom]) @ matrix(model.geom_quat[geom])
    face = close_rim(face)  # a dome's is on its backing
    return (vert, face) if bounds_solid(vert, face) else None


def _rigid_of(model, geom):
    """Mesh (n, 3) [m], (m, 3) of all rigid parts of a BioTac, in the frame of its core's geom."""
    parts, frame = [], matrix(model.geom_quat[geom])
    for g in np.flatnonzero((model.geom_bodyid == model.geom_bodyid[geom]) & (model.geom_dataid >= 0)):
        vert, face = mesh_of(model, int(model.geom_dataid[g]))
        vert = vert @ matrix(model.geom_quat[g]).T + model.geom_pos[g]
        parts.append(((vert - model.geom_pos[geom]) @ frame, face))
    return joined(parts)


def _meshes(model, core, ids):
    """{geom: (vert, face), or None where it is no solid} of the meshes and skins among the geoms, and
    notes."""
    out, hulls, left, unseen = {}, {}, [], []
    for g in ids.tolist():
        if _has_skin(model, core, g):
            out[g] = _skin_of(model, g)
            if out[g] is None:
                unseen.append(repr(model.name("geom", g)))
            continue
        if _TYPES[int(model.geom_type[g])] != "mesh":
            continue
        data, name = int(model.geom_dataid[g]), model.name("geom", g)
        if model.geom_type[g] == _HFIELD:
            start, shape = model.hfield_adr[data], (model.hfield_nrow[data], model.hfield_ncol[data])
            height = model.hfield_data[start : start + shape[0] * shape[1]].reshape(shape)
            out[g] = ground(height.astype(float), model.hfield_size[data])
            continue
        mesh = model.name("mesh", data) if data >= 0 else ""
        vert, face = _part(model, data, "vert"), _part(model, data, "face")
        out[g], as_it_is = _solid(vert.tobytes(), face.tobytes(), _hull_points(model, data))
        if out[g] is None:
            left.append(f"geom {name or g!r} (mesh {mesh!r})")
        elif not as_it_is:
            hulls[mesh] = None
    notes = []
    if hulls:
        names = ", ".join(map(repr, hulls))
        notes.append(
            f"collision mesh {names} is open or does not bound a solid: the BioTac's skin meets the convex "
            "hull, as MuJoCo's own contacts do; close the mesh if its hollows matter"
        )
    if unseen:
        notes.append(
            f"the model shows no closed skin around {', '.join(unseen)}: another BioTac's goes through it; "
            "leave the skin in the MjSpec, or exclude the two bodies"
        )
    if left:
        notes.append(f"{', '.join(left)} is flat or has no mesh and cannot touch the BioTac's skin: left out")
    return out, notes


def mesh_of(model: ModelView, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) [m] and faces (m, 3) of one of the model's meshes."""
    vert, face = _part(model, mesh, "vert"), _part(model, mesh, "face")
    return vert.astype(float), np.ascontiguousarray(face, np.int32)


def _part(model, number, part, kind="mesh"):
    if number < 0:  # an SDF without a mesh
        return np.zeros((0, 3))
    start, count = getattr(model, f"{kind}_{part}adr")[number], getattr(model, f"{kind}_{part}num")[number]
    return getattr(model, f"{kind}_{part}")[start : start + count]


def _hull_points(model, mesh):
    """Bytes of the numbers (int32) of the vertices on the hull that MuJoCo collides; maybe none."""
    start = model.mesh_graphadr[mesh] if mesh >= 0 else -1
    if start < 0:
        return b""
    count = model.mesh_graph[start]
    return model.mesh_graph[start + 2 + count : start + 2 + 2 * count].tobytes()


@functools.lru_cache(maxsize=256)
def _solid(vert, face, hull):
    """Mesh ((n, 3), (m, 3)) that stands for one given as bytes, or None, and whether it is that one."""
    vert = np.frombuffer(vert, np.float32).reshape(-1, 3).astype(np.float64)
    face = face_outwards(vert, np.frombuffer(face, np.int32).reshape(-1, 3))
    if bounds_solid(vert, face):
        return (vert, face), True
    number = np.frombuffer(hull, np.int32)
    return convex_hull(vert[number] if len(number) else vert), False


def friction_of(
    model: ModelView | mujoco.MjModel, geom: ArrayLike, friction: ArrayLike, priority: int
) -> np.ndarray:
    """Friction between geoms and skins of a friction and a priority, by MuJoCo's rule: the larger one, or
    that of the higher priority."""
    other, rank = model.geom_friction[geom, 0], model.geom_priority[geom]
    alone = np.where(rank > priority, other, friction)
    return np.where(rank == priority, np.maximum(other, friction), alone)


def _describe(model, core, index, group, rounding, config, mesh):
    name, kind = model.name("geom", index), int(model.geom_type[index])
    friction = float(friction_of(model, index, config.friction, config.priority))
    vert, face = mesh or (None, None)
    shape, rigid = _TYPES[kind], None
    if _has_skin(model, core, index):
        shape, rigid = "skin", mesh and _rigid_of(model, index)
    size = np.array(model.geom_size[index])
    return Geom(name, shape, size, friction, group, rounding, vert, face, rigid)
