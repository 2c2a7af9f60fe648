"""The finite-element skin as the coupling sees it: a function from a state and poses to a new state and
wrenches."""

import copy
import dataclasses
import functools
import math

import numpy as np
import warp as wp

from ...cache import digest
from ...geometry.skin_geometry import SkinGeometry
from ...geometry.solid import close_rim
from ...geometry.surface import pressure_area
from ...skin import GeomSet, SkinData, SkinModel, bake_distance_grid, prepare_step, step
from ...skin.bodies import BodyMotion
from ...skin.contact.clearance import BOUND, EXACT, TOUCH
from ...skin.contact.meshes import DistanceGrid
from ...skin.contact.proximity import ProximityQuery
from ...skin.model import solved_geometry
from ...skin.settings import Settings, read_settings
from ...skin.state import FULL, SavedState, StateLayout, options_of
from ...skin.state_arrays import StateArrays
from ..config import Config
from ..shared import Shared
from ..stepper import Geom, SkinResult, SkinStepper

_WORK = 145  # of all solves of a two-way skin's step, see SkinOptions.max_work
_MORE = 4  # times that at most, for rubber that keeps its volume
_TOLERANCE = 3e-4  # a third of a lone press's: two-way, the error of single steps is heard as chatter
# a skin that nothing touches and that is this near to rest has come to rest [m], [Pa]: far below a solve's
# error
_RESTS = 1e-8, 1.0
_STILL = np.zeros((2, 3)), np.stack([np.eye(3)] * 2)  # a BioTac that does not move


class FemStepper(SkinStepper):
    """Finite elements (`biotac_mj.skin`) for one BioTac; those with the same settings share one model.

    The state holds what `skin.state.VARIABLES` has of the full tier."""

    gives_way = vibrates = True

    def __init__(self, config: Config, geometry: SkinGeometry, geoms: list[Geom]):
        self._config, self._geometry, self._geoms = config, geometry, geoms
        self._settings = _in_time(config, skin_settings(config))
        self._material, self._options, _ = self._settings
        solved, element = solved_geometry(geometry, self._material, self._options)
        self._nodes = solved.vert  # maybe with more nodes behind the geometry's
        self.inertial = self._options.dynamics == "implicit"
        sizes = {
            "vert": len(self._nodes),
            "geom": len(geoms),
            "point": 4 * len(solved.elem) if element == "quadratic" else len(solved.tets),
            "term": len(self._material.prony),
            "branch": len(self._material.hysteresis),
        }
        options = options_of(self._material.extensions, self._options)
        self._layout = StateLayout(FULL, options, sizes)

    @property
    def nstate(self) -> int:
        """Numbers of a state."""
        return self._layout.size

    @functools.cached_property
    def _model(self):
        return shared_model(self._geometry, self._settings, self._config.device)

    @functools.cached_property
    def _data(self):
        data = SkinData(self._model)
        if self._config.coupling == "two-way":
            data.make_bodies_compliant(self._geom_set.ngroup)
        return data

    @functools.cached_property
    def _arrays(self):
        return StateArrays(self._data, self._geom_set, layout=self._layout)

    @functools.cached_property
    def _geom_set(self):
        return geom_set(self._geoms, self._geometry, device=self._config.device)

    def _part(self, state, name):
        return self._layout.part(state, name)

    def reset(self, state: np.ndarray) -> None:
        state[:] = self._rest

    @functools.cached_property
    def _rest(self):
        known = {"x": self._nodes, "resting": not (self.inertial or self._material.remembers)}
        if _filled(self._options):
            known |= {"x": self._model.rest.vert, "last_pressure": self._model.rest.pressure}
            if self._material.remembers:  # no friction in the rubber, nothing to relax: by the shape at rest
                self._data.reset()
                known |= self._arrays.save_of("rubber")
        row = self._layout.rest()
        self._layout.write(SavedState(**known), row)
        return row

    def vert_xpos(self, state: np.ndarray) -> np.ndarray:
        return self._part(state, "x").reshape(-1, 3)[: self._geometry.nvert]

    @property
    def made_of(self) -> tuple[SkinGeometry, Settings, list[Geom]]:
        """Geometry, settings and geoms that it was given."""
        return self._geometry, self._settings, self._geoms

    @property
    def grids(self) -> list[DistanceGrid]:
        """Distance grids of its meshes."""
        return _grids_of(self._geoms)

    def used(self, state: np.ndarray) -> SavedState:
        """Copy of the part of a state that is in use."""
        return copy.deepcopy(self._layout.read(state))

    def begun_at(
        self, state: np.ndarray, geom_pos: np.ndarray, geom_mat: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Poses (ngeom, 3), (ngeom, 3, 3) from which a step that leads to these takes geoms, as its friction
        sees it; None: these themselves."""
        if self.resting(state) and not self._model.device.is_cuda:
            return self._met_at(state, geom_pos, geom_mat)
        return self.came_to(state) if self._part(state, "started")[0] else None

    def put(
        self, state: np.ndarray, placed: np.ndarray, geom_pos: np.ndarray, geom_mat: np.ndarray
    ) -> np.ndarray:
        if self.inertial and not self._part(state, "started")[0]:
            return state  # the skin begins with the core's motion, geoms where they go
        saved, (pos, mat) = self._layout.read(state), (a.copy() for a in self.came_to(state))
        if not self._model.device.is_cuda:
            geom_pos = self._proximity.outside(geom_pos, geom_mat)
        pos[placed], mat[placed] = geom_pos[placed], geom_mat[placed]
        stays = ~placed[saved.contacts[:, 1].astype(int)]
        out = state.copy()
        if not stays.any() and not (self.inertial or self._material.remembers):
            self.reset(out)  # as a skin is that nothing touches any more
            self._place_geoms(out, pos, mat)
            return out
        known = {"geom_pos": pos, "geom_mat": mat, "started": 1.0}
        self._layout.write(saved.replace(contacts=saved.contacts[stays], **known), out)
        return out

    @property
    def model(self) -> SkinModel:
        """The constant SkinModel."""
        return self._model

    def contact_rows(self, state: np.ndarray) -> np.ndarray:
        return self._layout.rows(state, "contacts")

    def came_to(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._part(state, "geom_pos").reshape(-1, 3), self._part(state, "geom_mat").reshape(-1, 3, 3)

    def contact_area(self, result: SkinResult) -> np.ndarray:
        """Of the shape at rest."""
        group = np.array([g.group for g in self._geoms], int)
        sample, geom = self.contact_rows(result.state)[:, :2].T.astype(int)
        force = np.zeros((1 + max(group, default=-1), self._model.nvert))
        if not len(sample):
            return force.sum(1)
        face, part = np.divmod(sample, len(self._model.sample))
        load = self._model.sample.numpy()[part] * result.load[:, None]
        np.add.at(force, (group[geom][:, None], self._model.outer.face_np[face]), load)
        return pressure_area(force[:, self._model.outer.node.numpy()], self._node_areas)

    @functools.cached_property
    def _node_areas(self):
        return self._model.outer.node_areas()

    def contact_force(self, state: np.ndarray) -> np.ndarray:
        self._unpack(state)
        prepare_step(self._model, self._data, self._geom_set).evaluate_forces()
        return self._data.contact_force[0]

    def contact_push(self, state: np.ndarray) -> np.ndarray:
        return self._push(state).reshape(len(self._geometry.outer_face), -1).sum(axis=1)

    def touched_faces(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        push = self.contact_push(state)
        parts = self._model.outer.face.shape[0] // len(push)  # of a face, with more nodes than the geometry's
        face, first = np.unique(self._touched_faces(state) // parts, return_index=True)
        return face, self.contact_rows(state)[first, 1].astype(int), push[face]

    def _push(self, state):
        self._unpack(state)
        step = prepare_step(self._model, self._data, self._geom_set)
        return step.normal_force_of_faces(self._touched_faces(state))

    def _touched_faces(self, state):
        return self.contact_rows(state)[:, 0].astype(int) // len(self._model.sample)

    def solve_skin(
        self,
        state: np.ndarray,
        geom_pos: np.ndarray,
        geom_mat: np.ndarray,
        dt: float,
        core_pos: np.ndarray = _STILL[0],
        core_mat: np.ndarray = _STILL[1],
        near: SkinResult | None = None,
        spent: float = 0.0,
        bodies: BodyMotion | None = None,
    ) -> SkinResult:
        """See `SkinStepper`.

        Raises:
          ValueError: NaN in a pose, or more contact than the state can hold.
        """
        released = geom_pos, geom_mat
        if bodies is not None:  # where the bodies go without the skin
            released = bodies.without(np.array([g.group for g in self._geoms], int), geom_pos, geom_mat)
        if self._untouched(state, *released):
            return self._still(state, *released)
        d, geoms, model = self._data, self._geom_set, self._model
        started, instead = self._part(state, "started")[0], {}
        x = self._part(state, "x").reshape(-1, 3)
        if near is not None:
            instead["increment"] = self._part(near.state, "x").reshape(-1, 3) - x
        if self.inertial:
            instead |= {"frame_pos": core_pos[0], "frame_mat": core_mat[0]}
            if not started:  # it begins at rest on a core that may move
                rigid = x @ (core_mat[1] - core_mat[0]).T + core_pos[1] - core_pos[0]
                instead["velocity"] = rigid / dt
        self._unpack(state, **instead)
        d.worlds.guessed.fill_(int(near is not None))
        before = int(spent * model.options.max_work)
        d.worlds.spent.fill_(before)
        if self.resting(state) and not self._model.device.is_cuda:
            geoms.set_pose(*self._met_at(state, *released))
            geoms.advance()
        if d.bodies is not None:
            self._make_bodies_compliant(bodies)
        geoms.set_pose(geom_pos, geom_mat)
        if not started and not self.resting(state):
            geoms.advance()
        if self.inertial:
            step(model, d, geoms, dt, core_pos[1:], core_mat[1:])
        else:
            step(model, d, geoms, dt)
        new = self._arrays.save_row()
        self._part(new, "started")[:] = 1.0
        if self._came_to_rest(new) if d.converged[0] else self._untouched(state, *released, TOUCH):
            return self._still(state, *released)
        return SkinResult(
            state=new,
            wrench=d.wrench[0],
            tangent=d.tangent(geoms)[0],
            # not the skin's own memory, which another BioTac's solve overwrites
            vert_xpos=self.vert_xpos(new),
            pressure=float(d.pressure[0]),
            converged=bool(d.converged[0]),
            iterations=int(d.iterations[0]),
            residual=float(d.error[0]),
            load_factor=float(d.load_factor[0]),
            measured=bool(d.worlds.tier.numpy()[0] == 0),
            load=np.linalg.norm(
                d.outer.sample_force.numpy()[self.contact_rows(new)[:, 0].astype(int), 0], axis=1
            ),
            cost=(int(d.worlds.work.numpy()[0]) - before) / model.options.max_work,
        )

    def _make_bodies_compliant(self, bodies):
        b = self._data.bodies
        if bodies is None:
            b.compliance.zero_()
            return
        values = {"compliance": bodies.compliance[:, :, None], "predicted": bodies.wrench[:, None]}
        values |= {"origin": bodies.pos[:, None], "arm": bodies.arm[:, None], "spin": bodies.spin[:, None]}
        for name, value in values.items():
            getattr(b, name).assign(np.ascontiguousarray(value))

    # --- a skin at rest  ---

    @functools.cached_property
    def _proximity(self):
        # looked for contact the first time: the step that finds it need not wait for what it takes
        prepare_step(self._model, self._data, self._geom_set)
        return ProximityQuery(self._model, self._geom_set, self._data.laws.struct)

    def resting(self, state: np.ndarray) -> bool:
        return bool(self._part(state, "resting")[0])

    def pressure(self, state: np.ndarray) -> float | None:
        if self.inertial or self._material.remembers:
            return None
        return float(self._part(state, "last_pressure")[0]) - self._model.rest.pressure

    def is_out_of_reach(self, state: np.ndarray, geom_pos: np.ndarray, geom_mat: np.ndarray) -> bool:
        return (
            self.resting(state)
            and not self._model.device.is_cuda
            and self._proximity.clear(geom_pos, geom_mat, BOUND)
        )

    def is_clear(self, geom_pos: np.ndarray, geom_mat: np.ndarray) -> bool | None:
        if self._model.device.is_cuda:
            return None
        return self._proximity.clear(geom_pos, geom_mat)

    @property
    def surface_energy(self) -> float:
        """Adhesion's energy over the whole skin [J]."""
        law, area = self._options.contact_law, self._model.outer.area
        return 0.0 if law is None else law.adhesion * law.adhesion_hysteresis * float(area.numpy().sum())

    def stay_at_rest(self, state: np.ndarray, geom_pos: np.ndarray, geom_mat: np.ndarray) -> None:
        moved = np.ravel(geom_pos) - self._part(state, "geom_pos")
        self._part(state, "motion")[:] = moved if self._part(state, "started")[0] else 0.0
        self._place_geoms(state, geom_pos, geom_mat)

    def _place_geoms(self, state, geom_pos, geom_mat):
        """Writes where geoms are after the step."""
        self._part(state, "geom_pos")[:] = np.ravel(geom_pos)
        self._part(state, "geom_mat")[:] = np.ravel(geom_mat)
        self._part(state, "started")[:] = 1.0

    def _untouched(self, state, geom_pos, geom_mat, wanted=EXACT):
        if self.inertial or self._material.remembers or self._model.device.is_cuda:
            return False
        # one that is deformed and let go comes to rest: nearer than CLEAR it may bulge to the geoms
        return self._proximity.clear(geom_pos, geom_mat, TOUCH if self.resting(state) else wanted)

    def _met_at(self, state, geom_pos, geom_mat):
        """Poses about where geoms on their way to these begin to touch the skin at rest: what they did before
        is none of its friction's."""
        if not self._part(state, "started")[0]:
            return self._proximity.outside(geom_pos, geom_mat), geom_mat
        return self._proximity.met(*self.came_to(state), geom_pos, geom_mat)

    def _came_to_rest(self, state):
        if self.inertial or self._material.remembers or self._part(state, "contacts")[0]:
            return False
        rest, (far, loud) = self._model.rest, _RESTS
        off = np.abs(self._part(state, "x") - rest.vert.ravel()).max()
        return bool(off < far and abs(self._part(state, "last_pressure")[0] - rest.pressure) < loud)

    def _still(self, state, geom_pos, geom_mat):
        """Result of a step from `state` that leaves the skin at rest."""
        new = np.empty_like(state)
        self.reset(new)
        for name in self._layout.of_steps:
            self._part(new, name)[:] = self._part(state, name)
        self.stay_at_rest(new, geom_pos, geom_mat)
        n = 1 + max((g.group for g in self._geoms), default=-1)
        return SkinResult(new, np.zeros((n, 6)), np.zeros((n, 6, 6)), self.vert_xpos(new))

    def key(self, state: np.ndarray) -> bytes:
        return self._layout.key(state)

    # --- the state as numbers  ---

    def _unpack(self, state, **instead):
        """Loads a state; `instead`: values that replace parts of it."""
        if instead:
            state = state.copy()
            self._layout.write(SavedState(**instead), state)
        self._arrays.load_row(state)
        self._geom_set.set_pose(*self.came_to(state))
        self._geom_set.advance()


def rest_geometry(config: Config, geometry: SkinGeometry) -> SkinGeometry:
    """The geometry with the nodes where the skin rests on its filling: what the sensor sees when nothing
    touches."""
    settings = skin_settings(config)
    if not _filled(settings.options):
        return geometry
    rest = shared_model(geometry, settings, config.device).rest
    return dataclasses.replace(geometry, vert=rest.vert[: geometry.nvert])


def skin_settings(config: Config) -> Settings:
    """Material, SkinOptions and modulus of a BioTac.

    Raises:
      ValueError: a value that cannot be. FileNotFoundError: no such material or modulus.
    """
    mine = {name: config.options[name] for name in ("skin", "modulus") if name in config.options}
    return read_settings(config.material, mine, tolerance=_TOLERANCE, liquid=config.liquid)


def _in_time(config, settings):
    """Settings that bound the work of a step under two-way coupling, since the simulation waits for it."""
    rubber, options, modulus = settings
    if config.coupling == "two-way" and "max_work" not in config.options.get("skin", {}):
        options = dataclasses.replace(options, max_work=_allowed(rubber.poissons_ratio, options.tolerance))
    return Settings(rubber, options, modulus)


def _allowed(nu, tolerance):
    """Work of a step. The iterations of conjugate gradients grow as the square root of the ratio of bulk to
    shear stiffness; where skin slips, Newton's method gains digits at a constant rate. A lower bound would
    save nothing: steps would reach it without an equilibrium."""
    stiffer = max(nu, 0.0) / (1 - 2 * nu)
    digits = math.log(tolerance) / math.log(_TOLERANCE)
    return round(_WORK * min(max(stiffer**0.5, 1.0), _MORE) * max(digits, 1.0))


def _filled(options):
    return bool(options.fill_volume or options.rest_pressure)


def geom_set(
    geoms: list[Geom], geometry: SkinGeometry, nworld: int = 1, device: wp.DeviceLike = "cpu"
) -> GeomSet:
    """The geoms that may touch a skin.

    Args:
      geometry: of that skin. nworld: number of worlds. device: Warp device.
    """
    own = ()
    if any(g.type == "skin" for g in geoms):
        node, face = np.unique(close_rim(geometry.outer_face), return_inverse=True)
        own = _grids_of_skin(geometry.vert[node], face.reshape(-1, 3).astype(np.int32), geometry.rigid)
    return GeomSet(
        [g.type for g in geoms],
        [g.size for g in geoms],
        [g.friction for g in geoms],
        [g.group for g in geoms],
        [g.rounding for g in geoms],
        _grids_of(geoms),
        own,
        nworld=nworld,
        device=device,
    )


def grid_of(vert: np.ndarray, face: np.ndarray) -> DistanceGrid:
    """The distance grid of a closed mesh (n, 3) float64 [m], (m, 3) int32; made once."""
    return _grid(vert.tobytes(), face.tobytes())


def _grids_of(geoms):
    """Grids of the meshes and skins."""
    out = []
    for g in geoms:
        if g.type == "mesh":
            out.append(grid_of(g.vert, g.face))
        elif g.type == "skin":
            out += _grids_of_skin(g.vert, g.face, g.rigid)
    return out


def _grids_of_skin(vert, face, rigid):
    """Grids of a skin and of its rigid parts, which reach as far. Both are smooth: between facets of the
    meshes the force would jump."""
    beyond = np.maximum(rigid[0].min(0) - vert.min(0), vert.max(0) - rigid[0].max(0)).max()
    meshes = ((vert, face), 2e-3), (rigid, beyond + 2e-3)
    return [_grid(*(a.tobytes() for a in mesh), True, float(margin)) for mesh, margin in meshes]


@functools.lru_cache(maxsize=16)
def _grid(vert, face, smooth=False, margin=2e-3):
    vert, face = np.frombuffer(vert).reshape(-1, 3), np.frombuffer(face, np.int32).reshape(-1, 3)
    return bake_distance_grid(vert, face, margin=margin, smooth=smooth)


_models = Shared(keep=2)


def shared_model(geometry: SkinGeometry, settings: Settings, device: str) -> SkinModel:
    """One SkinModel per geometry and settings: its factor and compliance are the same for every sensor in the
    process."""
    rubber, options, modulus = settings
    uneven = modulus if modulus is None or callable(modulus) else modulus.tobytes()
    key = (digest(geometry), rubber, options, uneven, device)
    return _models.get(key, lambda: SkinModel(geometry, rubber, options, device, modulus=modulus))
