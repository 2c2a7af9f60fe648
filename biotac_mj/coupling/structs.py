"""mjModel and mjData seen from an engine plugin: numpy views on MuJoCo's own memory, laid out by
`mujoco.introspect`.

A plugin's callbacks get bare addresses. The field layouts of the installed MuJoCo come from its own
introspection tables, so that a new release that adds fields needs no change here."""

import contextlib
import ctypes
import functools
import math
import pathlib
import types
from collections.abc import Iterator

import mujoco
import numpy as np
from mujoco.introspect import ast_nodes, enums, structs

# already loaded: this only finds it
LIBRARY = ctypes.CDLL(str(next(pathlib.Path(mujoco.__file__).parent.glob("libmujoco.*"))))
LIBRARY.mj_getPluginConfig.restype = ctypes.c_char_p
LIBRARY.mj_getPluginConfig.argtypes = (ctypes.c_void_p, ctypes.c_int, ctypes.c_char_p)
LIBRARY.mj_rne.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p)
LIBRARY.mj_solveM.argtypes = (*(ctypes.c_void_p,) * 4, ctypes.c_int)
LIBRARY.mj_integratePos.argtypes = (*(ctypes.c_void_p,) * 3, ctypes.c_double)
LIBRARY.mj_contactForce.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p)
LIBRARY.mjd_smooth_vel.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int)
_POINTERS = {
    1: "mj_isSparse",
    2: "mj_kinematics mj_comPos mj_comVel mj_makeConstraint mj_island mj_projectConstraint mj_fwdConstraint "
    "mj_referenceConstraint mj_fwdActuation mj_fwdAcceleration mj_rnePostConstraint mj_sensorAcc",
    3: "mj_addContact",
    4: "mj_mulM mj_mulJacTVec mj_mulJacVec",
}
for _count, _names in _POINTERS.items():
    for _name in _names.split():
        getattr(LIBRARY, _name).argtypes = (ctypes.c_void_p,) * _count

_SCALARS = {
    "mjtNum": ctypes.c_double,
    "double": ctypes.c_double,
    "float": ctypes.c_float,
    "int": ctypes.c_int,
    "int32_t": ctypes.c_int32,
    "int64_t": ctypes.c_int64,
    "uint64_t": ctypes.c_uint64,
    "unsigned int": ctypes.c_uint,
    "unsigned char": ctypes.c_ubyte,
    "char": ctypes.c_char,
    "mjtByte": ctypes.c_ubyte,
    "mjtBool": ctypes.c_bool,
    "mjtSize": ctypes.c_int64,
    "size_t": ctypes.c_size_t,
    "uintptr_t": ctypes.c_size_t,
}
_ROWS = (
    *("efc_type", "efc_id", "efc_J", "efc_J_rownnz", "efc_J_rowadr", "efc_J_colind", "efc_pos", "efc_margin"),
    *("efc_KBIP", "efc_D", "efc_R", "efc_aref", "efc_state", "efc_force"),
    *("iefc_D", "iefc_R", "iefc_state", "map_efc2iefc"),
)
_built = {}
_TINY = np.finfo(float).tiny
MINVAL = 1e-15  # mjMINVAL
_PGS, _NEWTON = int(mujoco.mjtSolver.mjSOL_PGS), int(mujoco.mjtSolver.mjSOL_NEWTON)
_NO_WARMSTART = int(mujoco.mjtDisableBit.mjDSBL_WARMSTART)
# iterations of MuJoCo's constraint solver for one answer; as many as its default has are a model's own choice
_ENOUGH = 99
_SEARCHES = 50  # of a line at most, MuJoCo's default


def _c_type(node):
    if isinstance(node, ast_nodes.PointerType):
        return ctypes.c_void_p
    if isinstance(node, ast_nodes.ArrayType):
        kind = _c_type(node.inner_type)
        for extent in reversed(node.extents):
            kind = kind * extent
        return kind
    if isinstance(node, ast_nodes.AnonymousStructDecl):
        base = ctypes.Union if isinstance(node, ast_nodes.AnonymousUnionDecl) else ctypes.Structure
        return type("anonymous", (base,), {"_fields_": [(f.name, _c_type(f.type)) for f in node.fields]})
    name = node.name.removeprefix("struct ").rstrip("_")
    if name in _SCALARS:
        return _SCALARS[name]
    if name in structs.STRUCTS:
        return c_structs(name)
    if name in enums.ENUMS:
        return ctypes.c_int
    raise ValueError(
        f"biotac_mj does not know MuJoCo's type {node.name!r}: "
        "this MuJoCo is newer than the plugin; install mujoco>=3.17,<5"
    )


def c_structs(name: str) -> type:
    """The ctypes.Structure of one of MuJoCo's public structs, for example "mjData"."""
    if name not in _built:
        fields = []
        for i, field in enumerate(structs.STRUCTS[name].fields):
            kind = field if isinstance(field, ast_nodes.AnonymousStructDecl) else field.type
            fields.append((getattr(field, "name", f"anonymous{i}"), _c_type(kind)))
        _built[name] = type(name, (ctypes.Structure,), {"_fields_": fields})
    return _built[name]


class _View:
    """Fields of one struct by name: scalars as Python numbers, arrays as numpy views that write through."""

    def __init__(self, kind, address):
        self.struct = c_structs(kind).from_address(address)
        self.address = address
        self._field = _pointer_fields(kind)
        self._own, self._other = {name for name, *_ in self.struct._fields_}, None  # who has a size
        self._seen = {}

    def pointer(self, name, shape):
        """(shape) view of the memory that pointer `name` points to now, without looking up its size."""
        address = getattr(self.struct, name)
        last = self._seen.get(name)
        # the same memory, whatever it holds now
        if last is not None and last[0] == address and last[1] == shape:
            return last[2]
        dtype = self._field[name][0]
        if not address:
            return np.zeros(shape, dtype)
        count = 1
        for n in shape:
            count *= n
        buffer = (ctypes.c_char * (count * np.dtype(dtype).itemsize)).from_address(address)
        view = np.frombuffer(buffer, dtype).reshape(shape)
        self._seen[name] = address, shape, view
        return view

    def array(self, name):
        """View of array `name` with the shape that MuJoCo documents."""
        extents, own = self._field[name][1], self._own
        sizes = [
            e if e.__class__ is int else getattr(self.struct if e in own else self._other, e) for e in extents
        ]
        return self.pointer(name, tuple(sizes))


def _dtype(kind):
    return np.uint8 if kind in ("char", "mjtBool") else _SCALARS.get(kind)


def _extent(extent):
    if isinstance(extent, int) or extent.isdigit():
        return int(extent)
    constants = {
        name: value for enum in enums.ENUMS.values() for name, value in enum.values.items() if name == extent
    }
    # a constant such as mjNREF, or the name of a size
    return constants.get(extent, getattr(mujoco, extent, extent))


def _pointer_fields(kind):
    key = kind + "*"
    if key not in _built:
        _built[key] = {
            f.name: (_dtype(f.type.inner_type.name), tuple(_extent(e) for e in f.array_extent or ()))
            for f in structs.STRUCTS[kind].fields
            if isinstance(getattr(f, "type", None), ast_nodes.PointerType)
            and isinstance(f.type.inner_type, ast_nodes.ValueType)
        }
    return _built[key]


class ModelView(_View):
    """mjModel at an address. Arrays are found once and kept: a model's arrays never move."""

    def __init__(self, address: int):
        super().__init__("mjModel", address)

    def __getattr__(self, name):
        value = self.array(name) if name in self._field else getattr(self.struct, name)
        self.__dict__[name] = value
        return value

    def name(self, kind: str, index: int) -> str:
        """Name of an object, for example name("body", 3)."""
        start = getattr(self, f"name_{kind}adr")[index]
        names = self.names
        return names[start : start + int(np.argmax(names[start:] == 0))].tobytes().decode()

    def config(self, instance: int, attribute: str) -> str:
        """Configuration string of a plugin instance, "" where the model gives none."""
        value = LIBRARY.mj_getPluginConfig(self.address, instance, attribute.encode())
        return value.decode() if value else ""

    @property
    def is_sparse(self) -> bool:
        return bool(LIBRARY.mj_isSparse(self.address))


class DataView(_View):
    """mjData at an address. Arrays of fixed size are kept; those that live on the arena (efc_*, contacts) are
    looked up at each use."""

    def __init__(self, address: int, model: ModelView):
        super().__init__("mjData", address)
        self.model, self._other = model, model.struct
        self._where = self._rows = None
        self._solver = self.model.struct  # whose options the last `acceleration` had

    def __getattr__(self, name):
        if name not in self._field:
            return getattr(self.struct, name)
        value = self.array(name)
        if not name.startswith(
            ("efc_", "iefc_", "map_", "contact", "island_", "dof_island", "tree_island", "tendon_efcadr")
        ):
            self.__dict__[name] = value
        return value

    def rows(self) -> types.SimpleNamespace:
        """Arrays of the constraint rows by name. They lie in the arena, and are others once MuJoCo has made
        constraints again."""
        counts, pointers = self._arena
        where = counts.raw, pointers.raw
        if where != self._where:
            self._where, self._rows = where, types.SimpleNamespace(**{n: self.array(n) for n in _ROWS})
        return self._rows

    @functools.cached_property
    def _arena(self):
        """Bytes of mjData that say where the rows are: their numbers, and pointers into the arena."""
        spans, kind = (("ncon", "nisland"), ("contact", "efc_force")), type(self.struct)
        fields = ([getattr(kind, name) for name in span] for span in spans)
        sizes = [(a.offset, b.offset + b.size - a.offset) for a, b in fields]
        return [(ctypes.c_char * size).from_address(self.address + offset) for offset, size in sizes]

    def row_states(self) -> np.ndarray:
        """(nefc,) states of the rows, mjtConstraintState, where MuJoCo's constraint solver left them. Where
        it solves island by island it leaves `efc_state` as the warm start was, and writes `iefc_state`."""
        rows = self.rows()
        if not self.struct.nisland or _is_dual(self._solver.opt):
            return rows.efc_state
        return rows.iefc_state[rows.map_efc2iefc]

    @property
    def is_dual(self) -> bool:
        """Whether the model's solver, PGS or with noslip, works on the forces of rows: in its iterations it
        does not find those of stiff ones."""
        return _is_dual(self.model.opt)

    @functools.cached_property
    def _primal(self):
        return c_structs("mjModel").from_buffer_copy(self.model.struct)

    def _take_primal(self):
        """The model with Newton's method for its solver."""
        self._primal.opt, option = self.model.struct.opt, self._primal.opt
        option.solver, option.noslip_iterations = _NEWTON, 0
        option.iterations = max(option.iterations, _ENOUGH + 1)
        option.ls_iterations = max(option.ls_iterations, _SEARCHES)
        return self._primal

    def make_constraints(self) -> None:
        """Makes all constraint rows again, as mj_fwdPosition does: equalities were switched since."""
        for stage in (LIBRARY.mj_makeConstraint, LIBRARY.mj_island, LIBRARY.mj_projectConstraint):
            stage(self.model.address, self.address)

    def project_constraints(self) -> None:
        """Rebuilds what the dual solvers (PGS, noslip) derive from the constraints' Jacobian and
        regularisation."""
        LIBRARY.mj_projectConstraint(self.model.address, self.address)

    def weigh_constraints(self, weight: np.ndarray | float) -> None:
        """Gives the rows weights (nefc,), one over their regularisation, or all the same."""
        rows = self.rows()
        rows.efc_D[:] = weight
        rows.efc_R[:] = 1.0 / rows.efc_D
        if self.struct.nisland:
            rows.iefc_D[rows.map_efc2iefc], rows.iefc_R[rows.map_efc2iefc] = rows.efc_D, rows.efc_R
        if self.is_dual:
            self.project_constraints()

    def trees_of_rows(self) -> np.ndarray:
        """(nefc, ntree) whether a constraint row acts on a kinematic tree."""
        rows = self.rows()
        if self.model.is_sparse:
            number, column = np.repeat(np.arange(len(rows.efc_D)), rows.efc_J_rownnz), rows.efc_J_colind
        else:
            number, column = rows.efc_J.reshape(-1, self.model.nv).nonzero()
        out = np.zeros((len(rows.efc_D), self.model.ntree), bool)
        out[number, self.model.dof_treeid[column]] = True
        return out

    def linked_trees(self, trees: np.ndarray) -> np.ndarray:
        """(ntree,) `trees` (ntree,) and the kinematic trees that rows with a weight link to them."""
        links = self.trees_of_rows()[self.rows().efc_D > 2.0 * MINVAL]
        while True:
            more = trees | links[links[:, trees].any(axis=1)].any(axis=0)
            if (more == trees).all():
                return trees
            trees = more

    def reference_constraints(self) -> None:
        """Computes the rows' reference accelerations from their present values."""
        LIBRARY.mj_referenceConstraint(self.model.address, self.address)

    def moved_by(self, force: np.ndarray) -> np.ndarray:
        """(k, nv) accelerations by generalised forces (k, nv), without any constraint."""
        out, force = np.empty(force.shape), np.ascontiguousarray(force)
        LIBRARY.mj_solveM(self.model.address, self.address, out.ctypes.data, force.ctypes.data, len(force))
        return out

    def rows_moved_by(self, motion: np.ndarray) -> np.ndarray:
        """(nefc,) motions of the constraint rows by those of the degrees of freedom (nv,)."""
        out, motion = np.empty(len(self.rows().efc_type)), np.ascontiguousarray(motion)
        LIBRARY.mj_mulJacVec(self.model.address, self.address, out.ctypes.data, motion.ctypes.data)
        return out

    def pushed_by(self, force: np.ndarray) -> np.ndarray:
        """(nv,) generalised forces of forces (nefc,) of the constraint rows."""
        out, force = np.empty(self.model.nv), np.ascontiguousarray(force)
        LIBRARY.mj_mulJacTVec(self.model.address, self.address, out.ctypes.data, force.ctypes.data)
        return out

    def find_poses(self) -> None:
        """Makes the poses of bodies, geoms and sites those of the positions of now."""
        LIBRARY.mj_kinematics(self.model.address, self.address)

    def integrate_positions(self, seconds: float) -> None:
        """Moves the positions on at the present velocity, for `seconds`."""
        where = self.qpos.ctypes.data, self.qvel.ctypes.data
        if seconds:
            LIBRARY.mj_integratePos(self.model.address, *where, seconds)

    @contextlib.contextmanager
    def ahead(self, seconds: float) -> Iterator[None]:
        """Within this, bodies are where they go in `seconds` at the present velocity."""
        if not seconds:
            yield
            return
        before = self.qpos.copy()
        self.integrate_positions(seconds)
        self._find_motion()
        try:
            yield
        finally:
            self.qpos[:] = before
            self._find_motion()

    def set_velocity(self, velocity: np.ndarray) -> None:
        """Makes the velocities of the degrees of freedom (nv,), and those of the bodies with them."""
        self.qvel[:] = velocity
        LIBRARY.mj_comVel(self.model.address, self.address)

    def _find_motion(self):
        for stage in (LIBRARY.mj_kinematics, LIBRARY.mj_comPos, LIBRARY.mj_comVel):
            stage(self.model.address, self.address)

    def acceleration(self, again: bool = False, primal: bool = False) -> np.ndarray:
        """(nv,) accelerations that the rest of mj_forward would find with the passive forces and constraint
        rows as they are now.

        Runs MuJoCo's own later stages, which mj_forward runs again; what that would not overwrite (input of
        mj_inverse, warm start) is put back. Where the solver stops at its last iteration it goes on from
        there, and so will MuJoCo's own run: Euler moves bodies by accelerations of CG and Newton, which no
        force explains before they have finished, and what PGS leaves unsolved may throw a light body off.

        Args:
          again: whether nothing but passive forces, Jacobians and regularisation of rows has changed since it
            was last called.
          primal: whether Newton's method takes the place of a dual solver.
        """
        model, data = self.model.address, self.address
        qacc, warmstart = self.qacc, self.qacc_warmstart
        kept = qacc.copy(), warmstart.copy()
        if not again:
            LIBRARY.mj_rne(model, data, 0, self.qfrc_bias.ctypes.data)
            LIBRARY.mj_referenceConstraint(model, data)
            LIBRARY.mj_fwdActuation(model, data)
        LIBRARY.mj_fwdAcceleration(model, data)
        self._solver = self._take_primal() if primal and self.is_dual else self.model.struct
        solver = ctypes.addressof(self._solver)
        LIBRARY.mj_fwdConstraint(solver, data)
        for _ in range(self._rounds_left()):
            if not self._stopped():
                break
            warmstart[:] = kept[1][:] = qacc
            LIBRARY.mj_fwdConstraint(solver, data)
        out = qacc.copy()
        qacc[:], warmstart[:] = kept
        return out

    def _rounds_left(self):
        """Number of further rounds; none if each run starts anew."""
        option = self._solver.opt
        if option.disableflags & _NO_WARMSTART:
            return 0
        return _ENOUGH // max(option.iterations, 1)

    def _stopped(self):
        """Whether MuJoCo's constraint solver ended at its last iteration, not as near as it should."""
        return max(self.struct.solver_niter) >= self._solver.opt.iterations

    def unsolved(self, acceleration: np.ndarray, dofs: np.ndarray) -> float:
        """Residual of `acceleration`: forces that would balance its (nv,) on some dofs and that no constraint
        gives, as a fraction of the constraint and passive forces there; 0 if MuJoCo's solver ended before its
        last iteration, within the model's `tolerance`."""
        if not self._stopped():
            return 0.0
        balance = np.empty(self.model.nv)
        LIBRARY.mj_mulM(self.model.address, self.address, balance.ctypes.data, acceleration.ctypes.data)
        held, passive = self.qfrc_constraint[dofs], self.qfrc_passive[dofs]
        left = balance[dofs] - self.qfrc_smooth[dofs] - held
        inertia = np.maximum(self.model.dof_M0[dofs], _TINY)
        size, *others = (math.sqrt(float(f @ (f / inertia))) for f in (left, held, passive))
        return size / max(others) if any(others) else 0.0


def _is_dual(option):
    return option.solver == _PGS or bool(option.noslip_iterations)
