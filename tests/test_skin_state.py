"""The declaration of a skin's state against what skins do: a skin with every option that remembers, and one
of the condensed tier."""

import functools

import numpy as np
import pytest
import trimesh
import warp as wp
from blocks import shell, skin

from biotac_mj.coupling.config import Config
from biotac_mj.coupling.stepper import Geom
from biotac_mj.coupling.steppers.condensed import CondensedStepper
from biotac_mj.coupling.steppers.fem import FemStepper
from biotac_mj.geometry import load_skin
from biotac_mj.skin import ContactLaw, GeomSet, Material, SkinData, SkinModel, SkinOptions, state, step
from biotac_mj.skin.condensed import CondensedStep, LinearSkin
from biotac_mj.skin.state import (
    CONDENSED,
    FULL,
    GUESS,
    MEMORY,
    VARIABLES,
    WORK,
    SavedState,
    StateLayout,
    Variable,
    options_of,
)
from biotac_mj.skin.state_arrays import StateArrays
from biotac_mj.skin.transfer import Transfer
from biotac_mj.skin.types import vec3

RUBBER = Material(
    "neo_hookean",
    1e6,
    0.4,
    prony=((0.3, 0.05), (0.1, 0.3)),
    mullins=(2.0, 300.0, 0.2),
    hysteresis=((0.3, 0.005),),
    stiffening=1.0,
)
OPTIONS = SkinOptions(
    dynamics="implicit",
    mass_damping=20.0,
    stiffness_damping=1e-4,
    liquid=True,
    fill_volume=1e-8,
    contact_law=ContactLaw(friction_exponent=0.2, adhesion=0.02),
    max_newton=100,
)
# share of the depth, of the way aside, and angle [rad]; the frame is back where it was at the end
WAY = ((0.0, 0.0, 0.0), (0.3, 0.1, 0.02), (0.6, 0.4, 0.05), (0.8, 0.7, 0.1), (0.9, 0.0, 0.2))


@functools.cache
def ball():
    """A filled ball of rubber round a rigid core, held on one side."""
    vert, elem, inner = shell(10e-3, 8e-3, 1, 1)
    core = trimesh.creation.icosphere(subdivisions=1)
    held = np.flatnonzero(vert[:, 2] < -6e-3)
    core = 7e-3 * core.vertices, core.faces.astype(np.int32)
    return SkinModel(skin(vert, elem, held, inner_face=inner, core=core), RUBBER, OPTIONS)


@functools.cache
def coarse():
    return SkinModel(load_skin("coarse"), options=SkinOptions(liquid=True))


def turned(angle):
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


class Full:
    """Worlds of the ball that a sphere presses, drags and turns on, while the frame is shaken."""

    tier, sizes = FULL, {"term": 2, "branch": 1, "geom": 1}

    def __init__(self, nworld=1):
        self.model, self.nworld = ball(), nworld
        self.data = SkinData(self.model, nworld)
        self.geoms = GeomSet(["sphere"], [(4e-3,)], [0.6], nworld=nworld)
        self.geoms.struct.pos_last.fill_(np.nan)
        self.arrays = StateArrays(self.data, self.geoms)

    def step(self, k):
        depth, aside, angle = WAY[k]
        center = [[4e-4 * aside, 1e-4 * w, 14e-3 - 1e-3 * depth] for w in range(self.nworld)]
        self.geoms.set_pose(np.array(center)[:, None], np.tile(turned(angle), (self.nworld, 1, 1, 1)))
        frame = [2e-4 * aside, 0, 0], turned(0.02 * aside)
        frame = [np.tile(a, (self.nworld, *[1] * np.ndim(a))) for a in frame]
        step(self.model, self.data, self.geoms, 5e-3, *frame)
        assert self.data.converged.all()


class Condensed:
    """Worlds of the coarse skin in the condensed tier, that a sphere presses, drags and turns on."""

    tier, sizes = CONDENSED, {"geom": 1}

    def __init__(self, nworld=1):
        self.model, self.nworld = coarse(), nworld
        self.data = SkinData(self.model, nworld)
        self.geoms = GeomSet(["sphere"], [(3.5e-3,)], [0.8], nworld=nworld)
        self.geoms.struct.pos_last.fill_(np.nan)
        self._step = CondensedStep(self.model, LinearSkin.of(self.model), self.data, self.geoms)
        self.arrays = StateArrays(self.data, self.geoms, CONDENSED, **self._step.holders)
        self._tangent = wp.zeros((1, nworld), dtype=wp.spatial_matrixd)

    def step(self, k):
        depth, aside, angle = WAY[k]
        y = self.model.rest.vert[:, 1].min() - 3.55e-3 + 2.4e-3 * depth
        center = [[-12e-3 + 3e-4 * aside, y, 1e-4 * w] for w in range(self.nworld)]
        self.geoms.set_pose(np.array(center)[:, None], np.tile(turned(angle), (self.nworld, 1, 1, 1)))
        self._step.launch(self._tangent)
        assert self.data.converged.all()


def copies(skin):
    return {name: array.numpy().copy() for name, array in skin.arrays.arrays.items()}


def worlds_of(array, variable):
    return np.moveaxis(array, len(variable.axes), 0)


def steps(skin, start=0, stop=None):
    for k in range(start, stop or len(WAY)):
        skin.step(k)
    return skin


def same(one, other):
    for name, array in copies(one).items():
        if next(v for v in VARIABLES if v.name == name).role == WORK:  # how far off faces are by which step
            continue
        np.testing.assert_array_equal(array, other.arrays.arrays[name].numpy(), err_msg=name)
    wrenches = [s.data.geom_memory(1, 1)[2].numpy() for s in (one, other)]
    np.testing.assert_array_equal(*wrenches)
    assert wrenches[0].any()


@pytest.mark.parametrize("kind", [Full, Condensed])
def test_reset_restores_declared_values_in_masked_worlds(kind):
    skin, virgin = steps(kind(3)), copies(kind(1))
    skin.arrays.prepare()
    before = copies(skin)
    skin.arrays.reset(wp.array([True, False, True], dtype=bool))
    sources = {"rest_vert": skin.model.rest.vert, "rest_pressure": skin.model.rest.pressure}
    moved = set()
    for v in VARIABLES:
        if v.name not in before:
            continue
        was, now = (worlds_of(a, v) for a in (before[v.name], skin.arrays.arrays[v.name].numpy()))
        np.testing.assert_array_equal(now[1], was[1], err_msg=v.name)
        wanted = v.reset
        if wanted == "virgin":
            wanted = worlds_of(virgin[v.name], v)[0]
        elif isinstance(wanted, str):
            wanted = sources[wanted]
        for w in (0, 2):
            np.testing.assert_array_equal(now[w], was[w] if wanted is None else np.full_like(now[w], wanted))
        if not np.array_equal(now[0], was[0]):
            moved.add(v.name)
    pressed = {v.name for v in VARIABLES if v.role in (MEMORY, GUESS) and v.name in before}
    # frame and turn are inputs; nothing is lost
    assert pressed - moved == {"frame_pos", "frame_mat", "geom_mat", "anchor", "nonconverged"} & set(before)


@pytest.mark.parametrize("kind", [Full, Condensed])
def test_a_skin_that_was_reset_steps_as_a_new_one(kind):
    skin = steps(kind(2))
    skin.arrays.prepare()
    skin.arrays.reset(wp.ones(2, dtype=bool))
    same(steps(skin), steps(kind(2)))
    skin.data.reset()  # with all its worlds
    if kind is Full:
        skin.geoms.struct.pos_last.fill_(np.nan)
        same(steps(skin), steps(kind(2)))


@pytest.mark.parametrize("kind", [Full, Condensed])
def test_what_is_put_back_steps_again_to_the_same_bits(kind):
    skin = steps(kind(2), 0, 3)
    declared = skin.arrays.of_role(MEMORY, GUESS)
    kept = [(wp.clone(array), array) for array in declared]
    steps(skin, 3)
    once = steps(kind(2))
    same(skin, once)
    Transfer(kept, 2, "cpu").launch_where(wp.ones(2, dtype=bool))
    same(steps(skin, 3), once)


def layout_of(skin):
    elements, options = skin.model.elements, options_of(skin.model.material.extensions, skin.model.options)
    sizes = skin.sizes | {"vert": skin.model.nvert, "point": elements.npoint * elements.nelem}
    return StateLayout(skin.tier, options, sizes)


def test_a_saved_state_goes_on_in_a_new_skin_to_the_same_bits():
    """As a row of numbers; and not without any part of it."""
    skin = steps(Full(), 0, 3)
    layout, saved = layout_of(skin), skin.arrays.save()
    numbers = np.zeros(layout.size)
    layout.write(saved, numbers)
    assert layout.write(layout.read(numbers), again := np.zeros(layout.size)) is None
    np.testing.assert_array_equal(numbers, again)
    steps(skin, 3)

    def go_on(saved):
        other = Full()
        other.data.worlds.nonconverged.fill_(0)
        other.arrays.load(saved)
        return steps(other, 3)

    same(skin, go_on(layout.read(numbers)))
    parts = dict(vars(saved))
    assert {"overstress", "worst", "slip", "velocity", "contacts", "last_pressure"} <= set(parts)
    missed = set()
    for name in parts:
        other = go_on(SavedState(**{k: v for k, v in parts.items() if k != name}))
        try:
            same(skin, other)
        except AssertionError:
            missed.add(name)
    assert missed == set(parts)


@pytest.mark.parametrize("kind, tier", [(FemStepper, FULL), (CondensedStepper, CONDENSED)])
def test_the_plugin_keeps_what_is_saved(kind, tier):
    """As many numbers as the declaration says, which are those that the skin's arrays hold."""
    radius, geometry = 3.5e-3, load_skin("coarse")
    stepper = kind(Config(skin="coarse", tier=tier), geometry, [Geom("b", "sphere", [radius, 0, 0], 0.5, 0)])
    numbers = np.empty(stepper.nstate)
    stepper.reset(numbers)
    y = stepper.vert_xpos(numbers)[:, 1].min() - radius
    for depth in (-1e-4, 3e-4, 8e-4):
        pose = np.array([[-6.2e-3, y + depth, 0]]), np.eye(3)[None]
        numbers = stepper.solve_skin(numbers, *pose, 2e-3).state
    sizes = {"vert": geometry.nvert, "geom": 1}
    of_item = {
        v.name: int(np.prod([sizes[a] for a in v.axes])) * int(np.prod(v.item))
        for v in VARIABLES
        if v.is_saved(tier) and tier in v.tiers and not v.needs and not v.rows
    }
    room = {"contacts": 1 + 5 * state.ROOM["contacts"][tier]}
    if tier == CONDENSED:
        room["forces"] = 1 + 2 * state.ROOM["forces"][tier]
    assert stepper.nstate == sum(of_item.values()) + sum(room.values())
    held, arrays = stepper.used(numbers), stepper._arrays if tier == FULL else stepper._skin._state
    assert set(vars(held)) == set(of_item) | set(room)
    for name, value in vars(arrays.save()).items():
        np.testing.assert_array_equal(getattr(held, name), value, err_msg=name)
    assert len(held.contacts) > 2


def test_the_plugin_rests_as_skin_data_does():
    """A filled skin of rubber that remembers: without stress of friction, and with what it bears borne."""
    config = Config(
        skin="coarse",
        material=Material(prony=((0.2, 0.05),), mullins=(2.0, 1e3, 0.1), hysteresis=((0.3, 0.01),)),
        options={"skin": {"fill_volume": 2e-8}},
    )
    stepper = FemStepper(config, load_skin("coarse"), [])
    numbers = np.empty(stepper.nstate)
    stepper.reset(numbers)
    held, data = stepper.used(numbers), SkinData(stepper.model)
    for name, value in StateArrays(data, GeomSet([], [])).save_of("rubber").items():
        np.testing.assert_array_equal(getattr(held, name), value)
    assert abs(held.slip).max() > 1e-4 and held.worst.max() > 1.0


def test_an_array_more_is_a_line_more(monkeypatch):
    """It is made, reset, saved, set again, put back and given room in the plugin's state."""
    before = FemStepper(Config(skin="coarse"), load_skin("coarse"), []).nstate
    worn = Variable("worn", "data.worn", ("vert",), vec3, 2.0, MEMORY)
    monkeypatch.setattr(state, "VARIABLES", (*VARIABLES, worn))
    stepper = FemStepper(Config(skin="coarse"), load_skin("coarse"), [])
    assert stepper.nstate == before + 3 * load_skin("coarse").nvert
    skin = Full(2)
    array = skin.data.worn
    assert (array.numpy() == 2.0).all() and array in skin.arrays.of_role(MEMORY)
    array.fill_(5.0)
    skin.arrays.prepare()
    skin.arrays.reset(wp.array([True, False], dtype=bool))
    assert (array.numpy()[:, 0] == 2.0).all() and (array.numpy()[:, 1] == 5.0).all()
    skin.data.reset()
    assert (array.numpy() == 2.0).all()
    one, other = Full(), Full()
    one.data.worn.assign(np.random.default_rng(0).normal(size=one.data.worn.numpy().shape))
    layout = layout_of(one)
    numbers = np.zeros(layout.size)
    layout.write(one.arrays.save(), numbers)
    other.arrays.load(layout.read(numbers))
    np.testing.assert_array_equal(other.data.worn.numpy(), one.data.worn.numpy())
