"""Contacts that an experiment may consist of, within bounds: presses, holds, slides, repeats, at several
speeds, tilts, places and with several tools."""

import dataclasses
import typing

import numpy as np
from scipy.stats import qmc

from ...data.generation.clearance import Placed, first_touch, surface_samples
from ...geometry.rigid import across, matrix, quaternion_from_y
from ...geometry.skins import load_skin
from ...press.approach import surface_point
from .trajectory import Trajectory

if typing.TYPE_CHECKING:
    from .model.simulator import Simulator

_BACK, _LEAD = 50e-3, 20e-6  # [m] from which an object comes; before first touch, where row 0 is
_SPEEDS, _HOLDS = (0.5e-3, 20e-3), (0.2, 10.0)  # [m/s], [s], both uniform in their logarithm
_LONGEST = 60.0  # hold, in times that a press takes
_SLIDE, _SHALLOW = 2e-3, 1e-4  # [m]: at most, of half of the contacts; less deep than any contact
_LEAST = 0.15  # of the depth that the bounds allow
_ROWS = {"press": 6, "hold": 5, "slide": 5, "release": 5}
_SAFE = 0.9  # of the largest force: effects may add to the base model's


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Limits of a contact.

    Attributes:
      force: largest [N]. depth: largest [m]. reach: from and to along the finger, tip at -x, of
        the whole path [m]. around: the
        largest angle around the finger, either way, 0 on the pad's midline; tilt: the largest angle between
        press and the skin's inward normal [rad]. tools: names, as for `biotac press`.
    """

    force: float = 3.0
    depth: float = 1.5e-3
    reach: tuple[float, float] = (-14e-3, -4e-3)
    around: float = np.radians(30.0)
    tilt: float = np.radians(20.0)
    tools: tuple[str, ...] = ("sphere_7mm",)

    def __post_init__(self):
        if not (self.force > 0 and 1e-4 <= self.depth <= 2.5e-3 and self.reach[0] < self.reach[1]):
            raise ValueError(
                f"the bounds are {self.force:g} N, {1e3 * self.depth:g} mm and x from "
                f"{1e3 * self.reach[0]:g} to {1e3 * self.reach[1]:g} mm: give a positive force, a depth from "
                "0.1 to 2.5 mm and a reach that rises"
            )
        if not self.tools:
            raise ValueError("no tool is there to touch with: give at least one name")


@dataclasses.dataclass(frozen=True)
class Contact:
    """A touch: x along the finger [m], angle around it [rad], tilt (2,) of the press from the skin's inward
    normal, along and around [rad]; depth [m], speed [m/s], hold [s], slide along the finger [m], presses."""

    tool: str
    x: float
    angle: float
    tilt: tuple[float, float]
    depth: float
    speed: float
    hold: float
    slide: float = 0.0
    presses: int = 1

    @property
    def text(self) -> str:
        """As a person would carry it out."""
        tilt = np.degrees(np.hypot(*self.tilt))
        times = "" if self.presses == 1 else f", {self.presses} times"
        slide = f", slide {1e3 * self.slide:+.1f} mm" if self.slide else ""
        return (
            f"{self.tool} at x {1e3 * self.x:.1f} mm, {np.degrees(self.angle):+.0f} degrees, tilted by "
            f"{tilt:.0f}: {1e3 * self.depth:.2f} mm deep at {1e3 * self.speed:.1f} mm/s, hold "
            f"{self.hold:.1f} s{slide}{times}"
        )


def drawn(
    sim: "Simulator", bounds: Bounds, count: int, seed: int = 0
) -> list[tuple[Contact, np.ndarray, np.ndarray]]:
    """Contacts that spread over all that the bounds allow, each with the place (3,) of its first touch [m]
    and its attitude (3, 3), whose +y axis is the heading. A depth is reduced until the base model's force is
    within its bound.

    Raises:
      ValueError: no contact is possible within the bounds.
    """
    geometry = load_skin(sim.skin)
    points = surface_samples(geometry.vert, geometry.outer_face, "cpu")
    found = []
    for u in qmc.Halton(10, rng=np.random.default_rng(seed)).random(count):
        tool = bounds.tools[int(u[0] * len(bounds.tools))]
        x = bounds.reach[0] + u[1] * (bounds.reach[1] - bounds.reach[0])
        angle, tilt, turn = bounds.around * (2 * u[2] - 1), bounds.tilt * np.sqrt(u[3]), 2 * np.pi * u[4]
        tilt = float(tilt * np.cos(turn)), float(tilt * np.sin(turn))
        point, normal = surface_point(geometry, x, angle)
        first, second = (side[0] for side in across(normal[None]))
        heading = -normal + np.tan(tilt[0]) * first + np.tan(tilt[1]) * second
        heading /= np.linalg.norm(heading)
        mat = matrix(quaternion_from_y(heading))
        begin = point - _BACK * heading
        travel = first_touch(Placed(tool, 1), points, begin[None], mat[None], heading[None])[0]
        if not np.isfinite(travel):
            continue
        # the whole path is within reach: so deep, and from there so far aside
        at, steep = begin + travel * heading, heading[0]
        room = np.array(bounds.reach) - at[0]
        depth = min(bounds.depth, room[int(steep > 0)] / steep if steep else np.inf)
        ways = (room - np.sort([-_LEAD * steep, depth * steep])) / np.sqrt(1 - steep**2)
        if depth < _SHALLOW or ways[0] > 0 or ways[1] < 0:
            continue
        contact = Contact(
            tool,
            float(x),
            float(angle),
            tilt,
            float(depth),
            _between(_SPEEDS, u[5]),
            _between(_HOLDS, u[6]),
            float(np.fix(1e5 * np.clip(_SLIDE * (4 * u[7] - 3), *ways)) / 1e5) if u[7] > 0.5 else 0.0,
            2 if u[8] > 0.75 else 1,
        )
        found.append((contact, at, mat, _LEAST + (1 - _LEAST) * u[9]))
    if not found:
        raise ValueError("no tool meets the skin within these bounds: give another --reach, or a larger one")
    # straight presses to the bound give force over depth
    n = sim.design.nelectrode
    probes = [
        trajectory_of(dataclasses.replace(c, slide=0.0, presses=1), at, mat, 0.0, f"probe{k}", n)
        for k, (c, at, mat, _) in enumerate(found)
    ]
    solved = sim.but(tier="condensed").solve(probes)
    out = []
    for (contact, at, mat, fraction), probe, one in zip(found, probes, solved):
        load = sim.modulus * np.linalg.norm(one["force"], axis=1)
        deepest = int(np.argmax(probe.depth)) + 1
        far = np.interp(_SAFE * bounds.force, np.maximum.accumulate(load[:deepest]), probe.depth[:deepest])
        if far > _SHALLOW:
            deep = float(fraction * far)
            # rows of one trajectory lie no further apart than a hundred others
            hold = min(contact.hold, _LONGEST * deep / contact.speed)
            out.append((dataclasses.replace(contact, depth=deep, hold=hold), at, mat))
    return out


def _between(limits, fraction):
    """A number between two, uniform in its logarithm."""
    return float(np.exp(np.log(limits[0]) + fraction * np.log(limits[1] / limits[0])))


def trajectory_of(
    contact: Contact, at: np.ndarray, mat: np.ndarray, clock: float, name: str, nelectrode: int
) -> Trajectory:
    """Poses of a contact over time from just before first touch; its counts are placeholders.

    Args:
      at: (3,) of the object's frame at first touch [m]. mat: (3, 3) its attitude. clock: of the session [s].
      nelectrode: of the sensor.
    """
    heading, side = mat[:, 1], np.array([1.0, 0.0, 0.0])
    side = side - (side @ heading) * heading
    side /= np.linalg.norm(side)
    deep, wait = contact.depth, contact.depth / contact.speed
    hold = min(contact.hold, _LONGEST * wait)
    legs = [(0.2, -_LEAD, 0.0, 2)]
    for last in range(contact.presses, 0, -1):
        legs += [(wait, deep, 0.0, _ROWS["press"]), (hold, deep, 0.0, _ROWS["hold"])]
        if contact.slide and last == 1:
            legs.append((abs(contact.slide) / 5e-3, deep, contact.slide, _ROWS["slide"]))
        legs.append((wait, -_LEAD, contact.slide if last == 1 else 0.0, _ROWS["release"]))
    time, down, along = [0.0], [-_LEAD], [0.0]
    for seconds, to, sideways, rows in legs:
        step = np.arange(1, rows + 1) / rows
        time += (time[-1] + seconds * step).tolist()
        down += (down[-1] + (to - down[-1]) * step).tolist()
        along += (along[-1] + (sideways - along[-1]) * step).tolist()
    n = len(time)
    return Trajectory(
        name,
        contact.tool,
        clock,
        np.array(time),
        at + np.outer(down, heading) + np.outer(along, side),
        np.tile(mat, (n, 1, 1)),
        np.full((n, nelectrode), 2500.0),
        np.full(n, 2000.0),
        None,
        np.zeros((n, 3)),
    )
