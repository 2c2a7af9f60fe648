"""The finite-element skin as the coupling sees it: a function from a state and poses to a new state and
wrenches."""

import copy
import dataclasses
import functools

import numpy as np
import warp as wp

from ...geometry.skin_geometry import SkinGeometry
from ...skin import GeomSet, SkinData, SkinModel, bake_distance_grid, prepare_step, step
from ...skin.contact.meshes import DistanceGrid
from ...skin.contact.proximity import ProximityQuery
from ...skin.model import solved_geometry
from ...skin.rubber.memory import RubberMemory
from ...skin.settings import Settings, read_settings
from ..config import Config
from ..shared import Shared
from ..stepper import Geom, SkinResult

__all__ = ["CLEAR", "PATIENT", "FemStepper", "geom_set", "rest_geometry", "shared_model", "skin_settings"]

_WORK = 145  # of all solves of a two-way skin's step, see SkinOptions.max_work
_MORE = 4  # times that at most, for rubber that keeps its volume
PATIENT = 4  # times that, of a skin that would else ask the same in vain in every step
_MAX_CONTACTS = 4096
# geoms further than this from the resting skin do not reach it by this step's acceleration: 250 m/s^2 at 2 ms
# [m]
CLEAR = 1e-3
# a skin that nothing touches and that is this near to rest has come to rest [m], [Pa]: far below a solve's
# error
_RESTS = 1e-8, 1.0
_SHORT = 5e-4  # [m] a way to the skin of which friction may know all, as it does in batches
_REACH = 0.02  # [m] from the BioTac's frame to its skin
_STILL = np.zeros((2, 3)), np.stack([np.eye(3)] * 2)  # a BioTac that does not move


class FemStepper:
    """The skin of `biotac_mj.skin` for one BioTac; the model is shared by all with the same settings.

    The state holds: whether a step was made, whether the skin rests, nodal positions, the last increment,
    poses and motion of the geoms in the last step, the sticking contacts (how many, then sample, geom and
    anchor of each), the liquid's pressure and, with implicit dynamics, nodal velocities."""

    begins_near = may_wait = counts_cost = True

    def __init__(self, config: Config, geometry: SkinGeometry, geoms: list[Geom]):
        self._config, self._geometry, self._geoms = config, geometry, geoms
        self._settings = _in_time(config, skin_settings(config))
        self._material, self._options, _ = self._settings
        solved, element = solved_geometry(geometry, self._material, self._options)
        self._nodes = solved.vert  # maybe with more nodes behind the geometry's
        n, g = len(self._nodes), len(geoms)
        sizes = {
            "started": 1,
            "resting": 1,
            "x": 3 * n,
            "increment": 3 * n,
            "geom_pos": 3 * g,
            "geom_mat": 9 * g,
            "motion": 3 * g,
            "contacts": 1 + 5 * _MAX_CONTACTS,
            "pressure": 1,
        }
        self.inertial = self._options.dynamics == "implicit"
        if self.inertial:
            sizes |= {"velocity": 3 * n}
        if self._material.remembers:
            points = 4 * len(solved.elem) if element == "quadratic" else len(solved.tets)
            sizes |= {"memory": RubberMemory.size(self._material, points)}
        ends = np.cumsum(list(sizes.values()))
        self._slices = {
            name: slice(int(end - size), int(end))
            for (name, size), end in zip(sizes.items(), ends, strict=True)
        }
        self.nstate = int(ends[-1])

    @functools.cached_property
    def _model(self):
        return shared_model(self._geometry, self._settings, self._config.device)

    @functools.cached_property
    def _patient(self):
        model = copy.copy(self._model)
        model.options = dataclasses.replace(model.options, max_work=PATIENT * model.options.max_work)
        return model

    @functools.cached_property
    def _data(self):
        return SkinData(self._model)

    @functools.cached_property
    def _geom_set(self):
        return geom_set(self._geoms, self._geometry, device=self._config.device)

    @functools.cached_property
    def _reach(self):
        """Distance at which geoms act on the skin, by adhesion [m]."""
        return 0.0 if self._options.contact_law is None else float(self._data.laws.range.max())

    def _part(self, state, name):
        return state[self._slices[name]]

    def reset(self, state: np.ndarray) -> None:
        state[:] = 0
        vert, pressure = self._nodes, 0.0
        if _filled(self._options):
            vert, pressure = self._model.rest.vert, self._model.rest.pressure
        self._part(state, "x")[:] = vert.ravel()
        self._part(state, "pressure")[:] = pressure
        self._part(state, "resting")[:] = not (self.inertial or self._material.remembers)

    def vert_xpos(self, state: np.ndarray) -> np.ndarray:
        return self._part(state, "x").reshape(-1, 3)[: self._geometry.nvert]

    @property
    def made_of(self) -> tuple[SkinGeometry, Settings, list[Geom]]:
        """Geometry, settings and geoms that it was given."""
        return self._geometry, self._settings, self._geoms

    @property
    def grids(self) -> list[DistanceGrid]:
        """Of its meshes."""
        return [_grid(g.vert.tobytes(), g.face.tobytes()) for g in self._geoms if g.type in ("mesh", "skin")]

    def used(self, state: np.ndarray) -> dict:
        """Copies of what a state holds, without what it has room for, by the names of the class's text."""
        known = {name: self._part(state, name).copy() for name in self._slices if name != "contacts"}
        return known | {"contacts": self.contact_rows(state).copy()}

    def begun_at(
        self, state: np.ndarray, geom_pos: np.ndarray, geom_mat: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Poses (ngeom, 3), (ngeom, 3, 3) from which a step that leads to these takes geoms, as its friction
        sees it; None: these themselves."""
        if self.resting(state) and not self._model.device.is_cuda:
            return self._met_at(state, geom_pos, geom_mat)
        return self.came_to(state) if self._part(state, "started")[0] else None

    @property
    def model(self) -> SkinModel:
        """What of the skin does not change."""
        return self._model

    def contact_rows(self, state: np.ndarray) -> np.ndarray:
        """(k, 5) sample of the outer surface, geom and anchor in its frame [m] of what touches in a state."""
        return _contacts(self._part(state, "contacts"))

    @functools.cached_property
    def sample_area(self) -> tuple[np.ndarray, int]:
        """What a contact sample of each face stands for (nface,) [m^2], and how many a face has."""
        nsample = len(self._model.sample)
        return self._model.outer.area.numpy() / nsample, nsample

    def came_to(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses (ngeom, 3) [m], (ngeom, 3, 3) of the geoms for which a state holds."""
        return self._part(state, "geom_pos").reshape(-1, 3), self._part(state, "geom_mat").reshape(-1, 3, 3)

    def touched_area(self, state: np.ndarray) -> np.ndarray:
        """(ngroup,) area of the skin that each body touches in a state [m^2], of the shape at rest."""
        contacts = self.contact_rows(state)
        share, nsample = self.sample_area
        group = np.array([g.group for g in self._geoms], int)
        face = contacts[:, 0].astype(int) // nsample
        return np.bincount(
            group[contacts[:, 1].astype(int)], share[face], minlength=1 + max(group, default=-1)
        )

    def contact_force(self, state: np.ndarray) -> np.ndarray:
        """(nvert, 3) of what touches on the nodes in a state [N]."""
        self._unpack(state)
        prepare_step(self._model, self._data, self._geom_set).evaluate_forces()
        return self._data.contact_force[0]

    def solve_skin(
        self,
        state: np.ndarray,
        geom_pos: np.ndarray,
        geom_mat: np.ndarray,
        dt: float,
        core_pos: np.ndarray = _STILL[0],
        core_mat: np.ndarray = _STILL[1],
        near: SkinResult | None = None,
        patient: bool = False,
        spent: float = 0.0,
    ) -> SkinResult:
        """See `SkinStepper`. patient: for a step that may be dear.

        Raises:
          ValueError: NaN in a pose, or more contact than the state can hold.
        """
        if self._untouched(state, geom_pos, geom_mat):
            return self._still(state, geom_pos, geom_mat)
        d, geoms, model = self._data, self._geom_set, self._patient if patient else self._model
        self._unpack(state, None if near is None else self._part(near.state, "x"))
        before = int(spent * model.options.max_work)
        d.worlds.spent.fill_(before)
        started = self._part(state, "started")[0]
        if self.resting(state) and not self._model.device.is_cuda:
            geoms.set_pose(*self._met_at(state, geom_pos, geom_mat))
            geoms.advance()
        geoms.set_pose(geom_pos, geom_mat)
        if not started and not self.resting(state):
            geoms.advance()
        if self.inertial:
            x = self._part(state, "x").reshape(-1, 3)
            rigid = (x @ (core_mat[1] - core_mat[0]).T + core_pos[1] - core_pos[0]) / dt
            velocity = (
                self._part(state, "velocity").reshape(-1, 3) if started else rigid
            )  # begins at rest on a core that may move
            d.load_motion(velocity, core_pos[0], core_mat[0])
            step(model, d, geoms, dt, core_pos[1:], core_mat[1:], alone=False)
        else:
            step(model, d, geoms, dt, alone=False)
        new = np.zeros_like(state)
        self._pack(new)
        if self._came_to_rest(new) if d.converged[0] else self._untouched(state, geom_pos, geom_mat, 0.0):
            return self._still(state, geom_pos, geom_mat)
        return SkinResult(
            state=new,
            wrench=d.wrench[0],
            tangent=d.tangent(geoms)[0],
            vert_xpos=self.vert_xpos(
                new
            ),  # not the skin's own memory, which another BioTac's solve overwrites
            pressure=float(d.pressure[0]),
            converged=bool(d.converged[0]),
            iterations=int(d.iterations[0]),
            residual=float(d.error[0]),
            reached=float(d.reached[0]),
            load=d.contact_load(),
            cost=(int(d.worlds.work.numpy()[0]) - before) / model.options.max_work,
        )

    # --- a skin at rest  ---

    @functools.cached_property
    def _proximity(self):
        # looked for contact the first time: the step that finds it need not wait for what it takes
        prepare_step(self._model, self._data, self._geom_set)
        return ProximityQuery(self._model, self._geom_set)

    def resting(self, state: np.ndarray) -> bool:
        """Whether the state is that of the skin at rest, which a step cannot change unless a geom touches."""
        return bool(self._part(state, "resting")[0])

    def is_out_of_reach(self, state: np.ndarray, geom_pos: np.ndarray, geom_mat: np.ndarray) -> bool:
        """Whether the skin rests and the geoms at (ngeom, 3), (ngeom, 3, 3) are further from it than they
        come in a step [BioTac frame]."""
        return (
            self.resting(state)
            and not self._model.device.is_cuda
            and self._proximity.clear(geom_pos, geom_mat, CLEAR)
        )

    def is_clear(self, geom_pos: np.ndarray, geom_mat: np.ndarray) -> bool | None:
        """Whether geoms at (ngeom, 3), (ngeom, 3, 3) [BioTac frame] leave the skin at rest alone; None where
        it is not known."""
        if self._model.device.is_cuda:
            return None
        return self._proximity.clear(geom_pos, geom_mat, self._reach)

    def clearance(self, geom_pos: np.ndarray, geom_mat: np.ndarray) -> np.ndarray | None:
        """(ngeom,) of geoms at (ngeom, 3), (ngeom, 3, 3) from where they are too deep inside the core for any
        skin to fit between [m]; None where it is not known."""
        if self._model.device.is_cuda:
            return None
        clearance = self._proximity.clearance(geom_pos, geom_mat)
        return None if clearance is None else clearance + self._options.max_core_depth

    @property
    def surface_energy(self) -> float:
        """The most [J] that adhesion gives to bodies that come near: its energy over the whole skin."""
        law, area = self._options.contact_law, self._model.outer.area
        return 0.0 if law is None else law.adhesion * law.adhesion_hysteresis * float(area.numpy().sum())

    def stay_at_rest(self, state: np.ndarray, geom_pos: np.ndarray, geom_mat: np.ndarray) -> None:
        """Of a skin at rest that no geom at these poses touches: makes `state` that after the step."""
        last, new = self._part(state, "geom_pos"), np.ravel(geom_pos)
        started = self._part(state, "started")
        self._part(state, "motion")[:] = new - last if started[0] else 0.0
        last[:], self._part(state, "geom_mat")[:], started[:] = new, np.ravel(geom_mat), 1.0

    def _untouched(self, state, geom_pos, geom_mat, margin=CLEAR):
        if (
            self.inertial
            or self._material.remembers
            or self._model.device.is_cuda
            or not (np.isfinite(geom_pos).all() and np.isfinite(geom_mat).all())
        ):
            return False
        # one that is deformed and let go comes to rest: nearer than this it may bulge to the geoms
        margin = 0.0 if self.resting(state) else margin
        return self._proximity.clear(geom_pos, geom_mat, max(margin, self._reach))

    def _met_at(self, state, geom_pos, geom_mat):
        """Poses about where geoms on their way to these begin to touch the skin at rest: what they did before
        is none of its friction's."""
        last = self.came_to(state)
        if self._part(state, "started")[0] and self._proximity.clear(*last, self._reach):
            if _travel(*last, geom_pos, geom_mat) < _SHORT:
                return last
            return self._proximity.last_clear(*last, geom_pos, geom_mat, self._reach)
        return self._proximity.outside(geom_pos, geom_mat, self._reach), geom_mat

    def _came_to_rest(self, state):
        if self.inertial or self._material.remembers or self._part(state, "contacts")[0]:
            return False
        rest, (far, loud) = self._model.rest, _RESTS
        off = np.abs(self._part(state, "x") - rest.vert.ravel()).max()
        return bool(off < far and abs(self._part(state, "pressure")[0] - rest.pressure) < loud)

    def _still(self, state, geom_pos, geom_mat):
        """Result of a step from `state` that leaves the skin at rest."""
        new = np.empty_like(state)
        self.reset(new)
        for name in ("started", "geom_pos", "geom_mat"):
            self._part(new, name)[:] = self._part(state, name)
        self.stay_at_rest(new, geom_pos, geom_mat)
        n = 1 + max((g.group for g in self._geoms), default=-1)
        return SkinResult(new, np.zeros((n, 6)), np.zeros((n, 6, 6)), self.vert_xpos(new))

    def key(self, state: np.ndarray) -> bytes:
        """All that a solve depends on: a state is mostly unused."""
        start, end = self._slices["contacts"].start, self._slices["contacts"].stop
        used = start + 1 + 5 * int(state[start])
        return state[:used].tobytes() + state[end:].tobytes()

    # --- the state as numbers  ---

    def _unpack(self, state, near=None):
        """near: nodes at which a solve begins."""
        d, geoms = self._data, self._geom_set
        x, increment = self._part(state, "x"), self._part(state, "increment")
        d.load(
            x=x.reshape(-1, 3),
            increment=(increment if near is None else near - x).reshape(-1, 3),
            motion=self._part(state, "motion").reshape(-1, 3),
            contacts=_contacts(self._part(state, "contacts")),
            pressure=self._part(state, "pressure")[0],
        )
        d.worlds.guessed.fill_(int(near is not None))
        if self._material.remembers:
            d.memory.load(self._part(state, "memory"), d.x)
        geoms.set_pose(*self.came_to(state))
        geoms.advance()

    def _pack(self, state):
        d, geoms = self._data, self._geom_set.struct
        contacts = d.contacts()
        if len(contacts) > _MAX_CONTACTS:
            raise ValueError(
                f"{len(contacts)} contact samples touch, the state holds {_MAX_CONTACTS}: does a body "
                "swallow the finger (sizes are in metres)? Else take a coarser skin, or fewer samples= in "
                "options['skin']"
            )
        self._part(state, "started")[:] = 1
        self._part(state, "x")[:] = d.vert_xpos[0].ravel()
        self._part(state, "increment")[:] = d.increment.numpy()[:, 0].ravel()
        self._part(state, "geom_pos")[:] = geoms.pos_last.numpy().ravel()  # where they came to
        self._part(state, "geom_mat")[:] = geoms.mat_last.numpy().ravel()
        self._part(state, "motion")[:] = d.motion[0].ravel()
        self._part(state, "pressure")[:] = d.liquid.last_pressure[0] if d.liquid else 0.0
        buffer = self._part(state, "contacts")
        buffer[0] = len(contacts)
        buffer[1 : 1 + contacts.size] = contacts.ravel()
        if self.inertial:
            self._part(state, "velocity")[:] = d.velocity.numpy()[:, 0].ravel()
        if self._material.remembers:
            self._part(state, "memory")[:] = d.memory.state()


def _travel(pos0, mat0, pos, mat):
    """How far geoms carry what of them is at the skin, from poses (n, 3), (n, 3, 3) to others [m]: the frame
    of a large one may lie far away, and moves far where it turns a little."""
    turn = mat @ np.swapaxes(mat0, 1, 2)
    shift = np.linalg.norm(pos - (turn @ pos0[:, :, None])[:, :, 0], axis=1)
    return (shift + _REACH * np.linalg.norm(turn - np.eye(3), axis=(1, 2))).max(initial=0.0)


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
    # a third of a lone press's tolerance: two-way, the error of single steps is heard as chatter
    liquid = {} if config.liquid is None else {"liquid": config.liquid}
    mine = {name: config.options[name] for name in ("skin", "modulus") if name in config.options}
    return read_settings(config.material, mine, tolerance=3e-4, **liquid)


def _in_time(config, settings):
    """Two-way, somebody waits for the step, and a body that nothing holds can be met again in the next."""
    rubber, options, modulus = settings
    if config.coupling == "two-way" and "max_work" not in config.options.get("skin", {}):
        options = dataclasses.replace(options, max_work=_allowed(rubber.poissons_ratio))
    return Settings(rubber, options, modulus)


def _allowed(nu):
    """Work of a step. What conjugate gradients ask for grows as the square root of how much stiffer volume is
    than shape; a bound that steps meet in vain saves nothing, and the skin lets go."""
    stiffer = max(nu, 0.0) / (1 - 2 * nu)
    return round(_WORK * min(max(stiffer**0.5, 1.0), _MORE))


def _filled(options):
    return bool(options.fill_volume or options.rest_pressure)


def _contacts(buffer):
    count = int(buffer[0])
    return buffer[1 : 1 + 5 * count].reshape(count, 5)


def geom_set(
    geoms: list[Geom], geometry: SkinGeometry, nworld: int = 1, device: wp.DeviceLike = "cpu"
) -> GeomSet:
    """The geoms that may touch a skin.

    Args:
      geometry: of that skin. nworld: number of worlds. device: Warp device.
    """
    node, face = np.unique(geometry.outer_face, return_inverse=True)
    own = geometry.vert[node], face.reshape(-1, 3).astype(np.int32)
    return GeomSet(
        [g.type for g in geoms],
        [g.size for g in geoms],
        [g.friction for g in geoms],
        [g.group for g in geoms],
        [g.rounding for g in geoms],
        [_grid(g.vert.tobytes(), g.face.tobytes()) for g in geoms if g.type in ("mesh", "skin")],
        _grid(*(a.tobytes() for a in own)) if any(g.type == "skin" for g in geoms) else None,
        nworld=nworld,
        device=device,
    )


@functools.lru_cache(maxsize=16)
def _grid(vert, face):
    return bake_distance_grid(
        np.frombuffer(vert).reshape(-1, 3), np.frombuffer(face, np.int32).reshape(-1, 3)
    )


_models = Shared(keep=2)


def shared_model(geometry: SkinGeometry, settings: Settings, device: str) -> SkinModel:
    """One SkinModel per geometry and settings: its factor and compliance are the same for every sensor in the
    process."""
    rubber, options, modulus = settings
    mesh = (array.tobytes() for array in (geometry.vert, geometry.elem, geometry.fixed))
    uneven = modulus if modulus is None or callable(modulus) else modulus.tobytes()
    key = (*mesh, rubber, options, uneven, device)
    return _models.get(key, lambda: SkinModel(geometry, rubber, options, device, modulus=modulus))
