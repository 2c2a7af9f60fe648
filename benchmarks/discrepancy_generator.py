"""Measured data with a hidden effect, for the blind benchmark of `biotac_mj.discrepancy` - which nothing here
imports.

The skin and film are the project's, solved on a mesh of the generator's choice with its own way through the
poses; every effect is written anew, in another form than the catalogue's (Euler integration instead of closed
recursions, two time constants where one is fitted, a second-order filter, tanh instead of a bent line, Dahl's
law instead of a play operator). Effects of the set-up and the contact, cross-talk and local stiffness have
three forms each (FORMS), none of them the fitter's."""

import numpy as np
from scipy.spatial.transform import Rotation

__all__ = ["FORMS", "HIDDEN", "OUTSIDE", "Generator", "plan", "slips"]

_E_NEAR = {
    0: (1, 3, 7),
    1: (0, 2, 3, 16),
    2: (1, 4, 16, 17),
    3: (0, 1, 2, 4),
    4: (2, 3, 5, 17),
    5: (3, 4, 18),
    6: (7, 8, 9),
    7: (0, 6, 9),
    8: (6, 9, 10),
    9: (6, 7, 8, 16),
    10: (8, 11, 13),
    11: (10, 12, 13, 16),
    12: (11, 14, 16, 17),
    13: (10, 11, 12, 14),
    14: (12, 13, 15, 17),
    15: (13, 14, 18),
    16: (1, 9, 11, 17),
    17: (4, 14, 16, 18),
    18: (5, 15, 17),
}


def plan(seed, count, skin="coarse"):
    """Trajectories: dicts of tool, clock [s], time (n,), pos (n, 3) [m], quat (4,) w x y z, heading (3,);
    press, hold, sometimes slide, unload."""
    from biotac_mj.geometry import load_skin
    from biotac_mj.press import approach

    geometry, rng, out, clock = load_skin(skin), np.random.default_rng(seed), [], 0.0
    for i in range(count):
        point, normal = approach.surface_point(geometry, rng.uniform(-0.014, -0.004), rng.uniform(-0.5, 0.5))
        heading = -normal
        depth, speed = rng.uniform(0.5e-3, 1.5e-3), np.exp(rng.uniform(np.log(0.5e-3), np.log(20e-3)))
        hold, slide = np.exp(rng.uniform(np.log(0.2), np.log(6))), rng.choice([0.0, 0.8e-3])
        hold = min(
            hold, 60 * depth / speed
        )  # rows of one trajectory lie no further apart than a hundred others
        side = np.cross(heading, [1.0, 0, 0])
        side /= np.linalg.norm(side)
        legs = [(0.2, -0.02e-3, 0, 3), (depth / speed, depth, 0, 6), (hold, depth, 0, 5)]
        legs += [(0.2, depth, slide, 4)] if slide else []
        legs += [(depth / speed, -0.02e-3, slide, 5), (0.1, -0.05e-3, slide, 1)]
        t, d, s = [0.0], [-0.02e-3], [0.0]
        for seconds, to, across, rows in legs:
            t0, d0, s0 = t[-1], d[-1], s[-1]
            for k in range(1, rows + 1):
                (
                    t.append(t0 + seconds * k / rows),
                    d.append(d0 + (to - d0) * k / rows),
                    s.append(s0 + (across - s0) * k / rows),
                )
        turn = Rotation.align_vectors([heading], [[0.0, 1.0, 0.0]])[0]
        out.append(
            {
                "id": f"t{i:02d}",
                "tool": str(rng.choice(["sphere_7mm", "sphere_14mm"])),
                "clock": clock,
                "time": np.array(t),
                "pos": point + np.outer(d, heading) + np.outer(s, side),
                "turn": turn.as_matrix(),
                "quat": np.roll(turn.as_quat(), 1),
                "heading": heading,
                "depth": np.array(d),
            }
        )
        clock += t[-1] + 5
    return out


def slips(count, seed, repeatability):
    """(count, 3) by which the objects of so many trajectories are off [m], in data of this seed."""
    return np.random.default_rng(seed).normal(0, repeatability, (count, 3))


class Generator:
    """The skin of a mesh under plans; `footprint` widens what the electrodes see of a contact (a mildly wrong
    base model)."""

    def __init__(self, skin="coarse", modulus=1.0, footprint=0.0, tier="condensed", device="cpu"):
        from biotac_mj.geometry import load_skin
        from biotac_mj.sensor.film import FilmConduction
        from biotac_mj.skin.model import SkinModel, SkinOptions
        from biotac_mj.skin.rubber.material import material

        self.geometry = load_skin(skin)
        self.film = FilmConduction(self.geometry, sensor="1")
        self.model = SkinModel(
            self.geometry,
            material("default"),
            SkinOptions(liquid=True),
            "cpu" if tier == "condensed" else device,
        )
        self.modulus, self.footprint, self.tier = modulus, footprint, tier
        self._solved = {}  # by the condensed tier

    def skin(self, plans, poses, radii, friction=1.0) -> list:
        """Per plan force (n, 3) [N], pressure (n,) [Pa], impedance (n, 19) [ohm]; poses: lists of (n, 3);
        radii: factors or None; friction: factor on its coefficient."""
        from biotac_mj.data.objects import make_object

        size = [
            float(make_object(one["tool"]).size[0]) * (radius or 1.0) for one, radius in zip(plans, radii)
        ]
        if self.tier == "condensed":
            return [self._condensed(one, pos, r, friction) for one, pos, r in zip(plans, poses, size)]
        return self._full(self.model, plans, poses, size, friction)

    def uneven(self, plans, poses, radii, factor) -> list:
        """Per plan what a modulus that varies adds to force, pressure and the impedances' logarithms; factor:
        of positions (n, 3) [m], on it."""
        from biotac_mj.data.objects import make_object
        from biotac_mj.skin.model import SkinModel

        size = [float(make_object(p["tool"]).size[0]) * (radius or 1.0) for p, radius in zip(plans, radii)]
        at = self.geometry.vert[self.geometry.elem[:, :4]].mean(1)
        plain, stiff = (
            self._full(
                SkinModel(
                    self.geometry, self.model.material, self.model.options, self.model.device, modulus=values
                ),
                plans,
                poses,
                size,
                1.0,
            )
            for values in (np.ones(len(at)), factor(at))
        )
        return [(b[0] - a[0], b[1] - a[1], np.log(b[2] / a[2])) for a, b in zip(plain, stiff)]

    def _condensed(self, one, pos, r, friction):
        """Kept: what effects do after the skin is measured with and without them."""
        key = r, friction, one["tool"], one["heading"].tobytes(), pos.tobytes()
        if key not in self._solved:
            self._solved[key] = self._walked(one, pos, r, friction)
        return tuple(part.copy() for part in self._solved[key])

    def _walked(self, one, pos, r, friction):
        from biotac_mj.skin.condensed import CondensedSkin, Memory
        from biotac_mj.skin.geoms import GeomSet

        skin = self.__dict__.setdefault("_skins", {}).get((r, friction))
        if skin is None:
            mu = friction * self.model.material.friction
            skin = self._skins[r, friction] = CondensedSkin(
                self.model, GeomSet(["sphere"], [(r,)], friction=[mu], device="cpu")
            )
            while len(self._skins) > 4:
                del self._skins[next(iter(self._skins))]
        memory, force, pressure, impedance = Memory.rest(1), [], [], []
        for centre, there in _way(one, pos, r):
            out = skin.solve(memory, centre[None], np.eye(3)[None])
            memory = out.memory
            if there:
                force.append(out.wrench[0, :3]), pressure.append(memory.pressure)
                impedance.append(self.film.impedance(out.vert_xpos[: self.geometry.nvert]))
        return np.array(force), np.array(pressure), np.array(impedance)

    def _full(self, model, plans, poses, size, friction):
        """Full finite elements, every plan a world; spheres of all sizes are in every world, those not used a
        metre away."""
        from biotac_mj.skin import GeomSet, SkinData, step

        kinds = sorted(set(size))
        geoms = GeomSet(
            ["sphere"] * len(kinds),
            [(r,) for r in kinds],
            friction=[friction * model.material.friction] * len(kinds),
            nworld=len(plans),
            device=model.device,
        )
        data = SkinData(model, len(plans))
        ways = [list(_way(one, pos, r)) for one, pos, r in zip(plans, poses, size)]
        out = [([], [], []) for _ in plans]
        for k in range(max(map(len, ways))):
            centre = np.full((len(plans), len(kinds), 3), 1.0)
            for w, way in enumerate(ways):
                centre[w, kinds.index(size[w])] = way[min(k, len(way) - 1)][0]
            geoms.set_pose(centre, np.tile(np.eye(3), (len(plans), len(kinds), 1, 1)))
            step(model, data, geoms)
            if any(k < len(way) and way[k][1] for way in ways):
                x, force, pressure = data.vert_xpos, data.wrench, data.pressure
                for w, way in enumerate(ways):
                    if k < len(way) and way[k][1]:
                        out[w][0].append(force[w, 0, :3].copy()), out[w][1].append(float(pressure[w]))
                        out[w][2].append(self.film.impedance(x[w]))
        return [tuple(np.array(part) for part in one) for one in out]

    def measure(self, plans, effects, seed, repeatability=0.02e-3):
        """Per plan: counts (n, 19), pdc (n,), force (n, 3) with noise and rounding; effects: list of (name,
        size, form)."""
        rng = np.random.default_rng([seed, 1])
        out = []
        for counts, pdc, force in self.clean(plans, effects, seed, repeatability):
            noisy = np.clip(np.rint(counts + 3.5 * rng.standard_normal(counts.shape)), 0, 4095)
            pressed = np.rint(pdc + rng.standard_normal(len(pdc)))
            out.append((noisy, pressed, force + 0.006 * rng.standard_normal(force.shape)))
        return out

    def clean(self, plans, effects, seed, repeatability=0.02e-3):
        """`measure` without noise and rounding; the poses slip as they do there."""
        memory, out = {"end": max(one["clock"] for one in plans)}, []
        off = slips(len(plans), seed, repeatability)
        states = [_State(one, self, slip, memory) for one, slip in zip(plans, off)]
        for s in states:
            for name, size, form in effects:
                if name in _BEFORE:
                    _BEFORE[name](s, size, form)
        poses = [s.one["pos"] + s.offset for s in states]
        for _ in range(4 if states[0].give else 1):
            for s, solved in zip(states, self.skin(plans, poses, [s.radius for s in states])):
                s.force, s.pressure, s.impedance = solved
            if states[0].give:
                wanted = [s.one["pos"] + s.offset + s.give(self.modulus * s.force) for s in states]
                poses = [0.9 * new + 0.1 * old for new, old in zip(wanted, poses)]
        if states[0].slip:
            self._rub(plans, poses, states)
        if states[0].stiff:
            added = self.uneven(plans, poses, [s.radius for s in states], states[0].stiff)
            for s, (force, pressure, log_z) in zip(states, added):
                s.force, s.pressure = s.force + force, s.pressure + pressure
                s.impedance = s.impedance * np.exp(log_z)
        for s in states:
            s.force, s.pressure = self.modulus * s.force, self.modulus * s.pressure
            s.rest = s.impedance[0]
            if self.footprint:
                change = np.log(s.impedance / s.rest)
                smear = np.eye(19) * (1 - self.footprint)
                for k, near in _E_NEAR.items():
                    smear[k, list(near)] = self.footprint / len(near)
                s.impedance = s.rest * np.exp(change @ smear.T)
            for name, size, _ in effects:
                if name in _LOAD:
                    _LOAD[name](s, size)
            s.counts, s.pdc = 4095 / (s.impedance / 1e4 + 1), 2000 + s.pressure / 36.5
            s.zero = 4095 / (s.rest / 1e4 + 1)
            for name, size, form in effects:
                if name == "crosstalk":
                    _crosstalk(s, size, form)
                elif name in _READ:
                    _READ[name](s, size)
            out.append((s.counts, s.pdc, s.force))
        return out

    def _rub(self, plans, poses, states):
        """Friction that changes from row to row: quadratic between solutions at three levels of it."""
        levels = np.log([0.4, 0.8, 1.6])
        radii = [s.radius for s in states]
        solved = [self.skin(plans, poses, radii, float(np.exp(level))) for level in levels]
        for i, s in enumerate(states):
            at = np.clip(np.log(s.slip(s)), levels[0], levels[-1])
            weight = [np.prod([(at - b) / (a - b) for b in levels if b != a], axis=0) for a in levels]
            force, pressure, impedance = zip(*(one[i] for one in solved))
            s.force = sum(w[:, None] * f for w, f in zip(weight, force))
            s.pressure = sum(w * p for w, p in zip(weight, pressure))
            s.impedance = np.exp(sum(w[:, None] * np.log(z) for w, z in zip(weight, impedance)))


def _way(one, pos, r):
    """Centres of the sphere on the way through poses, finer than the fitter's; and whether a pose is
    reached. Poses are those of its tip, of a bare geom those of its centre."""
    from biotac_mj.data.objects import make_object

    back = r - (float(make_object(one["tool"]).size[0]) if one["tool"].startswith("geom:") else 0.0)
    before = pos[0]
    for p in pos:
        parts = max(1, int(np.ceil(np.linalg.norm(p - before) / 0.6e-4)))
        for k in range(1, parts + 1):
            yield before + (p - before) * k / parts - back * one["heading"], k == parts
        before = p


class _State:
    def __init__(self, one, generator, slip, memory):
        self.one, self.generator, self.offset, self.memory = one, generator, slip, memory
        # give(force (n, 3)): how poses yield [m]; slip(state): factor on friction; stiff(positions): on E
        self.radius, self.give, self.slip, self.stiff = None, None, None, None
        self.session = one["clock"] / max(memory["end"], 1.0)  # 0 at its beginning, 1 at its end
        self.t, self.clock, self.depth = one["time"], one["clock"] + one["time"], np.maximum(one["depth"], 0)


def _integrate(t, x, tau):
    """Explicit Euler in small steps: y' = (x - y) / tau."""
    y, out = x[0].copy() if x.ndim > 1 else float(x[0]), [x[0]]
    for i in range(1, len(t)):
        parts = max(1, int(np.ceil(20 * (t[i] - t[i - 1]) / tau)))
        for k in range(parts):
            now = x[i - 1] + (x[i] - x[i - 1]) * (k + 0.5) / parts
            y = y + (t[i] - t[i - 1]) / parts / tau * (now - y)
        out.append(y)
    return np.array(out)


def _relax(s, size):
    for share, tau in ((0.7, 0.3), (0.3, 2.5)):
        s.force = s.force + size * share * (s.force - _integrate(s.t, s.force, tau))
        s.pressure = s.pressure + size * share * (s.pressure - _integrate(s.t, s.pressure, tau))


def _hyster(s, size):
    z = 0.0
    for i in range(1, len(s.t)):
        step = s.depth[i] - s.depth[i - 1]
        for _ in range(10):
            z += step / 10 / 1.5e-4 * (1 - np.sign(step) * z)
        s.force[i] *= 1 + size * z
        s.pressure[i] *= 1 + size * z


def _stiffen(s, size):
    factor = 1 + size * (s.depth / 1.5e-3) ** 1.6
    s.force, s.pressure = s.force * factor[:, None], s.pressure * factor


def _mullins(s, size):
    key = tuple(np.round(s.one["pos"][len(s.t) // 2] / 4e-3).astype(int))
    largest = np.maximum(np.maximum.accumulate(s.depth), s.memory.get(key, 0.0))
    loss = size * np.tanh(3 * np.maximum(largest**2 - s.depth**2, 0) / np.maximum(largest**2, 1e-12))
    s.force, s.pressure = s.force * (1 - loss)[:, None], s.pressure * (1 - loss)
    s.memory[key] = float(largest.max())


def _adhesion(s, size):
    leaving = np.gradient(s.depth) < 0
    s.force = s.force + np.outer(
        size * (0.3 + 0.7 * leaving) * (s.depth > 0) * np.sqrt(s.depth / 1e-3), s.one["heading"]
    )


def _fluidloss(s, size):
    s.impedance = s.impedance * (1 + size * s.clock / 100)[:, None]


def _warmup(s, size):
    s.impedance = (
        s.impedance
        * np.exp(-size * (0.8 * (1 - np.exp(-s.clock / 60)) + 0.2 * (1 - np.exp(-s.clock / 15))))[:, None]
    )


def _asper(s, size):
    s.impedance = s.rest * (s.impedance / s.rest) ** (1 + size)


def _gain(s, size):
    g = s.memory.setdefault("gain", size * np.random.default_rng(int(size * 1e6)).standard_normal(19))
    s.counts = s.zero + (s.counts - s.zero) * (1 + g)


def _crosstalk(s, size, form):
    change = s.counts - s.zero
    if form == 0:  # neighbours alike, however far apart
        m = np.zeros((19, 19))
        for k, near in _E_NEAR.items():
            m[k, list(near)] = size
        added = change @ m.T
    elif form == 1:  # the multiplexer holds what it sampled before, and some of what was before that
        added = size * (1.4 * np.roll(change, 1, axis=1) + 0.6 * np.roll(change, 2, axis=1))
    else:  # the supply gives way
        added = -150 * size * np.tanh(change.mean(1, keepdims=True) / 100)
    s.counts = s.counts + added


def _saturate(s, size):
    s.counts = s.zero + size * np.tanh((s.counts - s.zero) / size)


def _lowpass(s, size):
    s.counts = _integrate(s.t, _integrate(s.t, s.counts, size / 2), size / 2)


def _latency(s, size):
    fine = np.linspace(s.t[0] - 1, s.t[-1], 20000)
    for k in range(19):
        s.counts[:, k] = np.interp(np.interp(s.t - size, fine, fine), s.t, s.counts[:, k])


def _drift(s, size):
    s.counts = s.counts + (size * (s.t - s.t[0]) ** 0.9)[:, None]


def _small(s):
    return s.one["tool"] == "sphere_7mm"


def _radius(s, size, form):
    """One tool; both, unlike; worn over the session."""
    grown = ((size, 0.0)[not _small(s)], (0.6 * size, 1.2 * size)[_small(s)], -size * (0.6 + 0.6 * s.session))
    s.radius = 1 + grown[form]


def _depth0(s, size, form):
    """Along the finger's own axis; creeping over the session; each tool's length."""
    along = (
        np.array([0.0, s.one["heading"][1], 0.0]),
        (0.6 + 0.8 * s.session) * s.one["heading"],
        (1.25, 0.75)[_small(s)] * s.one["heading"],
    )
    s.offset = s.offset + size * along[form]


def _misalign(s, size, form):
    """Turned about the clamp; along the finger and a roll about its axis; each tool beside its axis."""
    place = s.one["pos"][len(s.t) // 2]
    yaw = size / 12e-3 * np.cross([0.3, 1.0, 0.0], place - [6e-3, 0.0, 0.0])
    roll = size * np.array([1.0, 0, 0]) + size / 8e-3 * np.cross([1.0, 0, 0], place)
    s.offset = s.offset + (yaw, roll, size * np.array([0.9, 0, (0.9, 0.4)[_small(s)]]))[form]


def _mount(s, size, form):
    """It stiffens with load; backlash and a spring; a lever that is longer at the tip."""

    def give(force):
        load = np.maximum(-force @ s.one["heading"], 0)
        by = (
            1.5 * size * load / (1 + load / 4),
            0.8 * size * load + 0.3 * size * (1 - np.exp(-load / 0.3)),
            size * load * (1 - (s.one["pos"][0, 0] + 9e-3) / 12e-3),
        )[form]
        return -np.outer(by, s.one["heading"])

    s.give = give


def _rocking(s, size, form):
    """Sideways with load: less and less; with a lever from the clamp; after a little play."""

    def give(force):
        load = np.maximum(-force @ s.one["heading"], 0)
        by = (
            size * load / (1 + load / 6),
            size * load * (6e-3 - s.one["pos"][0, 0]) / 15e-3,
            1.2 * size * np.maximum(load - 0.15, 0),
        )[form]
        return np.outer(by, (0.8, 0.0, 0.6))

    s.give = give


def _friction(s, size, form):
    """One tool more than the other; dust over the session; slower slides rub more."""

    def slip(state):
        speed = np.linalg.norm(np.gradient(s.one["pos"], s.t, axis=0), axis=1)
        by = (
            np.full(len(s.t), (0.75, 1.25)[_small(s)]),
            np.full(len(s.t), 0.7 + 0.6 * s.session),
            1 - 0.12 * np.log(np.maximum(speed, 1e-4) / 2e-3),
        )[form]
        return np.exp(-size * by)

    s.slip = slip


def _fric_load(s, size, form):
    """Shear strength times an area: a power; a plateau; a constant beside a part of the load."""

    def slip(state):
        load = np.maximum(-s.generator.modulus * s.force @ s.one["heading"], 0.05)
        by = (
            1.3 * load ** (-2 * size / 3),
            np.minimum(1.4, 1.4 * (0.6 / load) ** size),
            0.6 + 2 * size / (load + 1),
        )
        return by[form]

    s.slip = slip


def _inhomog(s, size, form):
    """A stiff patch; a step towards the tip; a soft tip that hardens behind it."""

    def stiff(at):
        patch = np.exp(-(((at - [-9e-3, -7e-3, 1e-3]) / 5e-3) ** 2).sum(1))
        by = (1.6 * patch, 1.6 * (at[:, 0] < -9e-3) - 0.3, -1.6 * np.exp((-15e-3 - at[:, 0]) / 5e-3))
        return np.exp(size * by[form])

    s.stiff = stiff


def _ripple(s, size):
    """Outside: a stick-slip ripple of the electrodes in depth."""
    s.counts = s.counts + size * np.sin(2 * np.pi * s.depth / 0.25e-3)[:, None] * np.cos(np.arange(19))


def _leak(s, size):
    """Outside: electrodes read the pressure through a damaged seal, each with its own sign, and keep part of
    it."""
    seen = np.maximum.accumulate(np.maximum(s.pressure, 0)) / 5000
    s.counts = s.counts + size * np.outer(0.5 * s.pressure / 5000 + 0.5 * seen, np.sin(2.1 * np.arange(19)))


def _ring(s, size):
    """Outside: the force sensor's mount rings while it is loaded."""
    s.force = s.force * (1 + size * np.sin(2 * np.pi * 1.7 * s.t + 0.4))[:, None]


def _squeeze(s, size):
    """Outside: the pressure channel answers to speed, through a narrow duct."""
    s.pdc = s.pdc + size * np.tanh(np.gradient(s.depth, s.t) / 2e-3)


_BEFORE = {
    "radius": _radius,
    "mount": _mount,
    "depth0": _depth0,
    "misalign": _misalign,
    "rocking": _rocking,
    "friction": _friction,
    "fric_load": _fric_load,
    "inhomog": _inhomog,
}
FORMS = dict.fromkeys((*_BEFORE, "crosstalk"), 3)  # of all others one
_LOAD = {
    "relax": _relax,
    "hyster": _hyster,
    "stiffen": _stiffen,
    "mullins": _mullins,
    "adhesion": _adhesion,
    "fluidloss": _fluidloss,
    "warmup": _warmup,
    "asper": _asper,
}
_READ = {
    "gain": _gain,
    "saturate": _saturate,
    "lowpass": _lowpass,
    "latency": _latency,
    "drift": _drift,
    "ripple": _ripple,
    "leak": _leak,
    "ring": _ring,
    "squeeze": _squeeze,
}
# Smallest and largest size of each hidden effect.
HIDDEN = {
    "relax": (0.15, 0.4),
    "hyster": (0.08, 0.25),
    "stiffen": (0.2, 0.5),
    "mullins": (0.2, 0.4),
    "adhesion": (0.06, 0.15),
    "fluidloss": (0.03, 0.1),
    "warmup": (0.06, 0.25),
    "asper": (0.15, 0.4),
    "gain": (0.1, 0.25),
    "crosstalk": (0.06, 0.15),
    "saturate": (150, 400),
    "lowpass": (0.04, 0.15),
    "latency": (0.03, 0.1),
    "drift": (4, 15),
    "radius": (0.12, 0.25),
    "mount": (4e-5, 12e-5),
    "depth0": (6e-5, 15e-5),
    "misalign": (1.5e-4, 4e-4),
    "rocking": (1e-4, 3e-4),
    "friction": (0.4, 0.9),
    "fric_load": (0.4, 1.0),
    "inhomog": (0.3, 0.6),
}
OUTSIDE = {"ripple": (20, 60), "leak": (40, 120), "ring": (0.1, 0.3), "squeeze": (10, 40)}
