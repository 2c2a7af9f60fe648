"""Fields of the skin in trajectories, and their derivatives by the quantities that effects change: solved
once, these make every effect cheap."""

import dataclasses

import numpy as np
from scipy.interpolate import PchipInterpolator

from ....effects.catalogue import CATALOGUE
from ....effects.contact import TACKY
from ....effects.effect import Run
from ....effects.rubber import SPOT
from ....sensor.channels import temperature_from_counts

_SEVERAL = SPOT, TACKY  # the same, of which there are several, by what follows in their names

MAPS = "along", "across"  # of a modulus that varies with place
_ANSWERS = {name for effect in CATALOGUE for name in effect.answers}  # that effects after the skin use


@dataclasses.dataclass
class Fields:
    """base: per trajectory force, pressure, log_z; slopes: name -> per trajectory all of these
    (n, nelectrode + 4), force and pressure per unit of the modulus: per metre (x, y, z), per log
    (radius, friction; friction2 per its square), per m3 (bubble), per 1/cm (along, across), per metre that
    the skin has sunk (sink); "tacky_" and a work of joining: by all of it; about rest "mesh": of another
    mesh, "tier": of the condensed tier, "modulus": per log of the modulus, beyond a factor on force and
    pressure (where the liquid stands under pressure at rest).

    deeper: changes by displacements along the heading [m], None where x, y and z contain them. film: changes
    by the logarithm of the film's least thickness, about rest.
    quick: base of the condensed tier. curves: ids of effects -> [(their parameters in units of their scales,
    {trajectory: error of the slopes there with all of them}, {parameter: derivative of that error})], see
    `Simulator.bend`: at a fraction s of these parameters the error is s^2 of it, its derivative s. All
    solutions are kept, since several fits use theirs."""

    base: list
    slopes: dict
    trajectories: list
    quick: list | None = None
    curves: dict[frozenset, list] = dataclasses.field(default_factory=dict)
    deeper: "Curve | None" = None
    film: "Curve | None" = None

    def __post_init__(self):
        self.quick = self.base if self.quick is None else self.quick
        first = self.trajectories[0].tdc
        self.begun = [_begin(i, t, self.base[i], self.slopes, first) for i, t in enumerate(self.trajectories)]

    def add(self, name: str, slope: list) -> None:
        """Keeps a further difference [(n, nelectrode + 4) per trajectory] among those that effects after the
        skin use."""
        self.slopes[name] = slope
        for run, one in zip(self.begun, slope):
            run.answers[name] = one

    def part(self, which: np.ndarray) -> "Fields":
        """Fields of some trajectories (indices), as the condensed tier solves them, without what was solved
        with effects."""
        slopes = {k: [v[i] for i in which] for k, v in self.slopes.items()}
        deeper, film = (None if one is None else one.part(which) for one in (self.deeper, self.film))
        some = [self.trajectories[i] for i in which]
        return Fields([self.quick[i] for i in which], slopes, some, deeper=deeper, film=film)

    def shifted(self, i: int, offset: np.ndarray) -> np.ndarray:
        """Changes (n, nelectrode + 4) of trajectory i by an offset (n, 3) of its poses [m]."""
        heading, change = self.trajectories[i].heading, 0.0
        if self.deeper is not None:
            along = offset @ heading
            change, offset = self.deeper.at(i, along), offset - np.outer(along, heading)
        for name, by in zip("xyz", offset.T):
            if name in self.slopes and by.any():
                change = change + self.slopes[name][i] * by[:, None]
        return change

    def shifting(self, i: int, offset: np.ndarray) -> list[np.ndarray]:
        """(n, nelectrode + 4) per metre along x, y and z, about an offset (3,) of trajectory i [m]."""
        slopes = [self.slopes[name][i] for name in "xyz"]
        if self.deeper is None:
            return slopes
        heading = self.trajectories[i].heading
        straight = sum(h * slope for h, slope in zip(heading, slopes))
        press = self.deeper.slope(i, offset @ heading) - straight
        return [slope + h * press for h, slope in zip(heading, slopes)]

    def bent(self, moving: list) -> list:
        """Curves of effects [(Effect, theta)], as (solved change, its amount): the largest set of effects
        that was solved together comes first, and each effect occurs once."""
        left, now, out = {e.id for e, _ in moving}, sizes(moving), []
        for ids in sorted(self.curves, key=len, reverse=True):
            if ids <= left:
                there, curve, tangents = nearest(self.curves[ids], now)
                along = sum(now[k] * v for k, v in there.items() if k in now and len(k) == 2)
                fraction = max(along / max(square(there), 1e-12), 0.0)
                out.append((curve, fraction**2))
                for k, tangent in tangents.items():
                    out.append((tangent, min(fraction, 1.0) * (now.get(k, 0.0) - fraction * there[k])))
                left -= ids
        return out


class Curve:
    """Change by one number of the base: a cubic between the values that were solved, straight beyond them. It
    has no more turns than they have: an object that does not touch yet changes nothing, and a film matters
    only where the skin lies on the core."""

    def __init__(self, at: np.ndarray, changes: list[np.ndarray]):
        """at: (m,) that were solved, rising, one of them 0. changes: per trajectory
        (m, n, nelectrode + 4)."""
        self.solved, self.changes = at, changes
        self._cubics = [PchipInterpolator(at, one) for one in changes]
        self._last = {}  # trajectory -> the values that were asked for last, and the change

    def part(self, which: np.ndarray) -> "Curve":
        return Curve(self.solved, [self.changes[i] for i in which])

    def at(self, i: int, value: np.ndarray | float) -> np.ndarray:
        """(n, nelectrode + 4) change of trajectory i by values (n,), or one of all rows."""
        before, known = self._last.get(i, (np.nan, None))
        if np.array_equal(before, value):
            return known
        inside = np.clip(value, self.solved[0], self.solved[-1])
        (a, b, c, d), x = self._cubic(i, inside)
        change, beyond = ((a * x + b) * x + c) * x + d, np.subtract(value, inside)[..., None]
        if beyond.any():
            change = change + beyond * self.slope(i, inside)
        self._last[i] = np.copy(value), change
        return change

    def slope(self, i: int, value: np.ndarray | float) -> np.ndarray:
        """(n, nelectrode + 4) of the change at values (n,), or one of all rows."""
        (a, b, c, _), x = self._cubic(i, np.clip(value, self.solved[0], self.solved[-1]))
        return (3 * a * x + 2 * b) * x + c

    def _cubic(self, i, value):
        """Coefficients (4, n, nelectrode + 4) of each row's cubic at its own value, and how far that is from
        where the cubic begins (n, 1)."""
        cubics = self._cubics[i]
        row = np.arange(cubics.c.shape[2])
        value = np.broadcast_to(value, row.shape)
        k = np.clip(np.searchsorted(cubics.x, value, "right") - 1, 0, len(cubics.x) - 2)
        return cubics.c[:, k, row], (value - cubics.x[k])[:, None]


def sizes(effects: list) -> dict:
    """(id, name) -> value in units of its scale, of effects [(Effect, theta)]; (id, name, "shape") -> log
    of one that does nothing by itself."""
    out = {}
    for e, th in effects:
        for n, p in e.params.items():
            out |= {(e.id, n, "shape"): float(np.log(th[n]))} if p.shape else {(e.id, n): th[n] / p.scale}
    return out


def square(there: dict) -> float:
    """Squared size of parameters, in the units of `sizes`, without shapes."""
    return sum(v**2 for k, v in there.items() if len(k) == 2)


def squared_distance(now: dict, there: dict) -> float:
    """Square of the distance between parameters as of `sizes`; a shape that one of them has alone is far."""
    return sum((now[k] - v) ** 2 if k in now else 1.0 for k, v in there.items()) + len(now.keys() - there)


def nearest(solved: list, now: dict) -> tuple:
    """The one of [(parameters, curve, tangents)] with the nearest parameters."""
    return min(solved, key=lambda one: squared_distance(now, one[0]))


def stack(one: dict) -> np.ndarray:
    """(n, nelectrode + 4) force, pressure and ln Z of a solution."""
    return np.column_stack([one["force"], one["pressure"], one["log_z"]])


def _begin(order, t, base, slopes, first_tdc):
    warm = None
    if t.tdc is not None and first_tdc is not None:
        warm = temperature_from_counts(t.tdc) - temperature_from_counts(first_tdc[0])
    return Run(
        time=t.time,
        clock=t.clock + t.time,
        tool=t.tool,
        heading=t.heading,
        depth=t.depth,
        place=t.pos[int(np.argmax(t.depth))],
        order=order,
        offset=np.zeros((len(t.time), 3)),
        force=base["force"],
        pressure=base["pressure"],
        log_z=base["log_z"],
        temperature=warm,
        session={},
        rest_log_z=base["log_z"][0],
        stiffness=_stiffness(base, slopes, t, order),
        answers={one: slopes[one][order] for one in slopes if one in _ANSWERS or one.startswith(_SEVERAL)},
        pos=t.pos,
    )


def _stiffness(base, slopes, t, order):
    """(n,) d normal force / d depth [N/m]; without differences that of a Hertzian contact."""
    if "x" not in slopes:
        return 1.5 * np.maximum(-base["force"] @ t.heading, 0) / np.maximum(t.depth, 1e-4)
    along = sum(h * slopes[x][order][:, :3] for h, x in zip(t.heading, "xyz"))
    return np.maximum(-along @ t.heading, 0)
