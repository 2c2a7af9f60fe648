"""The skin along trajectories, solved once and once more for each small change: these differences make every
effect cheap to fit (`Fields`). The settings of a `Simulator` decide what is solved."""

import contextlib
import dataclasses
import pathlib
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import tqdm

from ....effects.contact import TACKY, Adhesion
from ....effects.in_skin import memory_of, moduli
from ....effects.rubber import SPOT, Stiffening, modulus_of
from ....geometry.rigid import across
from ....geometry.skins import load_skin
from ....skin.contact.law import GridTooCoarse
from ....skin.settings import plain, read_dict, read_material, read_settings
from ..base.nuisance import BETWEEN, OTHER_MESH
from ..trajectory import Trajectory
from .fields import MAPS, Curve, Fields, stack
from .solver import Solver

_SHIFT = 40e-6  # [m] of the poses for differences
# [m] along the press: densest where errors of poses lie, since rows before the touch begin to touch there
_DEEPER = 20e-6 * np.array([-6, -4, -2, -1, 0, 1, 2, 4, 6])
_FRICTION = -0.7, 0.4  # of its logarithm: what sticks and what slides changes
_RADIUS, _BUBBLE = 0.15, 8e-9
_FILM = np.linspace(-0.8, 0.8, 17)  # logarithms of its least thickness
_SOFTER = -0.25  # of the logarithm of the modulus
_UNEVEN = 0.2  # [1/cm] of the modulus
_SPOT, _SPOTS, _NEAR_SPOT = 0.5, 3, 4e-3  # of its logarithm in a spot; at most; [m] of those touched there
_SUNK = 60e-6  # [m] of the skin towards the core
_FILL = 0.02  # of the liquid; the condensed tier takes no less than there is
_TACKY = 1.0, 4.0  # [J/m2] of joining, see `stick`
_STIFFER = 0.3  # c2 of `effects.rubber.Stiffening`


@dataclasses.dataclass(frozen=True)
class Change:
    """A small change of what is solved.

    Attributes:
      name: of the difference by it. by: its amount. sim: with the change. how: further arguments of `solve`.
      load: factor on force and pressure, per unit of which `Simulator.run` adds differences.
    """

    name: str
    by: float
    sim: Solver
    how: dict = dataclasses.field(default_factory=dict)
    load: float = 1.0


def differences(
    changes: Iterable[Change],
    trajectories: list[Trajectory],
    base: list,
    tick: Callable[[], object] | None = None,
) -> dict:
    """name of each change -> per trajectory the difference by one of it; base: what is solved without."""
    out = {}
    for change in changes:
        solved = change.sim.solve(trajectories, progress=tick, **change.how)
        borne = [{k: v if k == "log_z" else v / change.load for k, v in one.items()} for one in solved]
        out[change.name] = _difference(borne, base, change.by)
    return out


def solved_fields(
    sim: Solver,
    trajectories: list[Trajectory],
    progress: bool = True,
    places: Sequence[str] | None = None,
) -> Fields:
    """The skin along the trajectories and its differences: 20 solutions of the data set by the condensed
    tier, beside one of the simulator's own; kept in `cache`.

    Args:
      places: at which the rubber may be another (see `spots`), of contacts that are not made yet: nothing is
        fitted to these, so curves are straight lines about their middle. None finds them in the data. Those
        of the simulator's own effects are always among them."""
    fitted = places is None
    own = [name for _, theta in sim.effects for name in theta if name.startswith(SPOT)]
    places = dict.fromkeys([*own, *(spots(trajectories) if fitted else places)])
    deeper, thick = (_DEEPER, _FILM) if fitted else (_DEEPER[2:7:2], _FILM[4:13:4])
    # Differences are the condensed tier's, whose price is seconds; what it misses itself is one of them.
    quick = sim if sim.tier == "condensed" else sim.but(tier="condensed")
    lacking = []
    if quick is not sim:
        inside = memory_of([(Stiffening(), {"c2": _STIFFER})])
        rubber = plain(inside.rubber(read_material(sim.material)))
        lacking = [Change("stiffen", _STIFFER, sim.but(material=rubber)), *(tacky(sim, by) for by in _TACKY)]
    small = [*sunk(quick), *_uneven(quick, places), *filled(quick), *softer(quick)]
    if sim.skin in OTHER_MESH:
        small.append(Change("mesh", 1.0, quick.but(skin=OTHER_MESH[sim.skin])))
    if any("sphere" in t.tool for t in trajectories):
        small.append(Change("radius", _RADIUS, quick, {"log_radius": [_RADIUS] * len(trajectories)}))
    small.append(Change("bubble", _BUBBLE, quick, {"bubble": _BUBBLE}))
    # beside these the base by each tier, films, two shifts, two frictions, displacements
    count = 6 + bool(lacking) + len(lacking) + len(small) + len(deeper) - 1
    with tqdm.tqdm(
        total=count * len(trajectories), desc="skin", disable=not progress or None, leave=False
    ) as bar:
        tick, slopes = bar.update, {}
        here = base = sim.solve(trajectories, progress=tick)
        if quick is not sim:
            here = quick.solve(trajectories, progress=tick)
            slopes["tier"] = _difference(here, base)
            # a tool of fine meshes is exact only so far: then as much adhesion as there can be
            with contextlib.suppress(GridTooCoarse):
                for change in lacking:
                    slopes |= differences([change], trajectories, base, tick)
        # films first, while what the skin does is known
        film = _films(quick, trajectories, here, thick, tick)
        slopes |= differences(small, trajectories, here, tick)
        for name in slopes.keys() & set(BETWEEN):
            slopes[name] = [one - one[0] for one in slopes[name]]
        deeper = _deeper(quick, trajectories, here, deeper, tick)
        slopes |= _shifts(quick, trajectories, here, deeper, tick)
        less, more = (quick.solve(trajectories, log_friction=by, progress=tick) for by in _FRICTION)
        slopes["friction"], slopes["friction2"] = _parabola(less, here, more, *_FRICTION)
    return Fields(base, slopes, trajectories, here, deeper=deeper, film=film)


def _deeper(sim, trajectories, base, displacements, tick):
    """Changes by displacements along the press: load rises faster than depth, and starts at first contact."""
    changes = []
    for by in displacements:
        offset = [np.tile(by * t.heading, (len(t.time), 1)) for t in trajectories]
        solved = sim.solve(trajectories, offset=offset, progress=tick) if by else base
        changes.append(_difference(solved, base))
    return Curve(displacements, [np.array(of) for of in zip(*changes)])


def _shifts(sim, trajectories, base, deeper, tick):
    """Differences by shifts along the sensor's axes. Across the press they are solved; a shift with a part
    along it would touch earlier or later, of which the curve knows."""
    sides = [across(t.heading[None]) for t in trajectories]
    solved = []
    for k in range(2):
        offset = [np.tile(_SHIFT * side[k], (len(t.time), 1)) for t, side in zip(trajectories, sides)]
        solved.append(_difference(sim.solve(trajectories, offset=offset, progress=tick), base, _SHIFT))
    out = {axis: [] for axis in "xyz"}
    for i, (t, side) in enumerate(zip(trajectories, sides)):
        straight = [deeper.slope(i, 0.0), *(one[i] for one in solved)]
        for k, axis in enumerate("xyz"):
            weights = t.heading[k], side[0][0, k], side[1][0, k]
            out[axis].append(sum(by * slope for by, slope in zip(weights, straight)))
    return out


def _films(sim, trajectories, base, logs, tick):
    """Changes of the readings from the baseline for other minimum thicknesses of the film, which differ by
    the factors exp(logs). The skin does not depend on the thickness, so it is solved once."""
    from ....effects.in_film import SeveralFilms

    model, own = sim.skin_and_film(0.0, 0.0)
    given = read_dict(sim.options, "options").get("film") or {}
    thick = [float(by * own.residual_film) for by in np.exp(logs)]
    films = SeveralFilms([own.with_residual_film(one) for one in thick])
    options = sim.options | {"film": {**given, "residual_film": thick}}
    several = sim.but({0.0: model, "film": films}, options=options)
    changes = []
    for solved, here in zip(several.solve(trajectories, progress=tick), base):
        n, electrodes = here["log_z"].shape
        log_z = solved["log_z"].reshape(n, -1, electrodes) - here["log_z"][:, None]
        log_z = np.broadcast_to(log_z - log_z[0], (n, len(logs), electrodes))  # alike where there is no film
        changes.append(np.pad(np.swapaxes(log_z, 0, 1), ((0, 0), (0, 0), (4, 0))))
    return Curve(logs, changes)


def _uneven(sim, places):
    """A modulus that varies along and across the finger, or in spots."""
    given, geometry = read_settings(sim.material, sim.options).modulus, load_skin(sim.skin)
    for name in (*MAPS, *places):
        by = _UNEVEN if name in MAPS else _SPOT
        modulus = moduli(given, modulus_of({name: by}), geometry)
        yield Change(name, by, sim.but(options=sim.options | {"modulus": modulus}))


def tacky(sim: Solver, work: float) -> Change:
    """A contact that sticks, of so much work of joining [J/m2], all of it together."""
    inside = memory_of([(Adhesion().given(["joining"]), {"joining": work})])
    skin = plain(inside.options(read_settings(sim.material, sim.options)[1]))
    return Change(f"{TACKY}{work:.9g}", 1.0, sim.but(options=sim.options | {"skin": skin}))


def filled(sim: Solver) -> list[Change]:
    """The fraction of its liquid that the fingertip has lost or won, the film as it was."""
    model, film = sim.skin_and_film(0.0, 0.0)
    settings = read_settings(sim.material, sim.options)[1]
    if not model.has_liquid or settings.rest_pressure:
        return []
    volume = settings.fill_volume + _FILL * model.liquid_volume
    options = sim.options | {"skin": {**plain(settings), "fill_volume": volume}}
    return [Change("fill", _FILL, sim.but({"film": film}, options=options, cache=_subfolder(sim, "filled")))]


def sunk(sim: Solver) -> list[Change]:
    """The depth [m] to which the skin has sunk towards the core, all else as it was."""
    from ....effects.in_film import SunkFilm

    model, film = sim.skin_and_film(0.0, 0.0)
    if not model.has_liquid:
        return []
    models = {0.0: model, "film": SunkFilm(film, _SUNK)}
    return [Change("sink", _SUNK, sim.but(models, cache=_subfolder(sim, "sunk")))]


def _subfolder(sim, name):
    """Folder of solutions that settings do not distinguish from the simulator's own."""
    return None if sim.cache is None else str(pathlib.Path(sim.cache) / name)


def softer(sim: Solver) -> list[Change]:
    """The logarithm of the modulus, beyond a factor on force and pressure: there is nothing but where the
    liquid stands under pressure at rest, which another modulus leaves as it is."""
    if not read_settings(sim.material, sim.options)[1].rest_pressure:
        return []
    rubber, factor = read_material(sim.material), float(np.exp(_SOFTER))
    material = plain(dataclasses.replace(rubber, youngs_modulus=factor * rubber.youngs_modulus))
    return [Change("modulus", _SOFTER, sim.but(material=material), load=factor)]


def spots(trajectories: list[Trajectory]) -> list[str]:
    """Places at which the rubber may be another, as parameters of `Spots`: where most trajectories
    touch, the others of each left out, at least two each."""
    place = np.array([t.pos[np.argmax(t.depth)] for t in trajectories])
    near = np.linalg.norm(place[:, None] - place, axis=2) < _NEAR_SPOT
    out, left = [], np.ones(len(place), bool)
    while len(out) < _SPOTS and (near & left).sum(1).max() > 1:
        at = int(np.argmax((near & left).sum(1)))
        out.append(SPOT + "_".join(f"{1e3 * v:.1f}" for v in place[near[at] & left].mean(0)))
        left &= ~near[at]
    return out


def _difference(moved, base, by=1.0):
    return [(stack(a) - stack(b)) / by for a, b in zip(moved, base)]


def _parabola(before, base, after, low, high):
    """Slopes and curvatures of solutions at low, 0 and high."""
    first, second = _difference(before, base, low), _difference(after, base, high)
    bend = [(b - a) / (high - low) for a, b in zip(first, second)]
    return [a - low * c for a, c in zip(first, bend)], bend
