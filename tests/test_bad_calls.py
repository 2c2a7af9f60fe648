"""What a person can get wrong in Python: a row is a call and what is said of it, in one line."""

import dataclasses
import functools
import importlib.util
import reprlib

import mujoco
import numpy as np
import pytest
import warp

import biotac_mj
from biotac_mj.tasks.hands import Mount

ARRAY, HUGE = np.zeros(3), 10**400
SCENE = """<mujoco><worldbody><site name="tip"/>
  <body name="b"><freejoint/><geom name="ball" size=".005" mass=".1"/></body></worldbody></mujoco>"""


RECURSIVE = []
RECURSIVE.append(RECURSIVE)


def others():
    """An array that is none of numpy's, and whose type has the name of one of Python's."""
    return warp.zeros(3, device="cpu")


def scene():
    return mujoco.MjSpec.from_string(SCENE)


def attach(**settings):
    place = {} if "body" in settings else {"site": "tip"}
    own = {} if {"sensor", "randomise"} & set(settings) else {"readings": "none"}
    return biotac_mj.attach(scene(), **place | {"skin": "coarse"} | own | settings)


@functools.cache
def attached():
    """(handle, model, data) of a BioTac; nothing is stepped."""
    spec = scene()
    handle = biotac_mj.attach(spec, site="tip", skin="coarse", readings="none")
    model = spec.compile()
    return handle, model, mujoco.MjData(model)


@functools.cache
def elsewhere():
    """(model, data) without a BioTac."""
    model = scene().compile()
    return model, mujoco.MjData(model)


# name of an argument -> values that cannot be, and what is said of them
ATTACH = (
    ("site", ARRAY, "site is array([0., 0., 0.]): give the name of a site"),
    ("body", 5, "body is 5: give the name of a body"),
    ("prefix", "\0", "prefix is '\\x00': give a text"),
    ("prefix", "", "prefix is '': give a text that the BioTac's names begin with"),
    ("slots", 10**9, "slots is 1000000000: give a whole number from 0 to 100000"),
    ("pos", "here", "pos is 'here': give 3 numbers"),
    ("quat", [1, 0, 0, np.nan], "give a finite number"),
    ("skin", 5, "skin is 5: pass one of coarse, default, fine"),
    ("liquid", ARRAY, "liquid is array([0., 0., 0.]): pass true or false"),
    ("liquid", 2, "liquid is 2: pass true or false"),
    ("coupling", ARRAY, "unknown coupling array([0., 0., 0.]): choose one of two-way, one-way"),
    ("tier", ARRAY, "unknown tier array([0., 0., 0.]): choose one of full, condensed"),
    ("on_error", [], "unknown on_error []: choose one of warn, raise"),
    ("geoms", np.array("ball"), "geoms is array('ball', dtype='<U4'): give a list of names"),
    ("sensor", ARRAY, "is array([0., 0., 0.]): pass "),
    ("randomise", ARRAY, "randomise of options['readings'] is array([0., 0., 0.]): pass "),
    ("friction", HUGE, ": give a finite number >= 0"),
    ("stepper", ARRAY, "stepper is array([0., 0., 0.]): pass a text"),
    ("readings", ARRAY, "readings is array([0., 0., 0.]): give True, False, a dict"),
    ("signal", ARRAY, "signal is array([0., 0., 0.]): give one of physics, latent_projection"),
    ("options", 5, "options is 5: give a dict"),
    ("options", "", "options is '': give a dict"),
    ("options", lambda: 1, "options is <function"),
    ("options", {"modulus": HUGE}, "modulus is 1000"),
    ("options", {"skin": {"fill_volume": -1.0}}, "there is, or more: give more than -"),
    (
        "rounding",
        {"ball": 6e-3},
        "rounding of geom 'ball' is 0.006: a fillet's radius lies between 0 and the",
    ),
    ("rounding", {5: 1e-3}, "rounding is {5: 0.001}: give a dict, of geoms' names"),
    ("rounding", {"": 1e-3}, "rounding is {'': 0.001}: give a dict, of geoms' names"),
    ("rounding", {"bal": 1e-3}, "no geom 'bal' to touch: the model has ball"),
    ("thermal", {"": "steel"}, "thermal is {'': 'steel'}: give a dict, of geoms' names"),
    ("geoms", [""], "geoms is ['']: give a list of names"),
    ("thermal", {"ball": {"effusivity": HUGE}}, "holds something that is not a number"),
)


def calls_of_attach():
    array = "array(shape=(3,), dtype=float32)"
    for name in ("readings", "friction", "skin", "geoms", "slots", "body", "prefix", "pos", "rounding"):
        said = f"is {array}: "
        call = lambda name=name: attach(**{name: others()})  # noqa: E731
        yield f"attach {name} of Warp", call, ValueError, said
    for name, wrong in (("pos", RECURSIVE), ("pos", [[1], [1, 2]]), ("rounding", np.zeros((3, 3)))):
        call = lambda name=name, wrong=wrong: attach(**{name: wrong})  # noqa: E731
        yield f"attach {name} {type(wrong)}", call, ValueError, f"{name} is "
    for wrong in ([0] * 4, [np.inf, 0, 0, 0], [10**400, 0, 0, 0]):
        yield "attach quat", lambda wrong=wrong: attach(quat=wrong), ValueError, "quat"
    for name, value, said in ATTACH:
        yield f"attach {name}", lambda name=name, value=value: attach(**{name: value}), ValueError, said
    outside = dict(geoms=[], rounding={"ball": 1e-3})
    said = "rounding is of geom 'ball', which is none of geoms: add it there, or leave it out"
    yield "attach outside", lambda: attach(**outside), ValueError, said


def calls_of_handle():
    def row(label, call, kind, said):
        return f"handle {label}", lambda: call(*attached()), kind, said

    yield row("read", lambda h, m, d: h.read(5), TypeError, "data is int: pass the MjData")
    yield row("read model", lambda h, m, d: h.read(m, "pac"), TypeError, "data is MjModel: pass the MjData")
    yield row("read channel", lambda h, m, d: h.read(d, []), ValueError, "no channel []: choose one of elec")
    yield row(
        "read other", lambda h, m, d: h.read(elsewhere()[1]), ValueError, "the data's model has no sens"
    )
    yield row(
        "sensor_name", lambda h, m, d: h.sensor_name(ARRAY), ValueError, "no channel array([0., 0., 0.])"
    )
    yield row(
        "draw", lambda h, m, d: h.draw(m, d, "a"), ValueError, "seed is 'a': give a whole number from 0"
    )
    yield row("draw", lambda h, m, d: h.draw(m, d, -1), ValueError, "seed is -1: give a whole number from 0")
    yield row("skin", lambda h, m, d: h.vert_xpos(5, d), TypeError, "model is int and data is MjData: pass")
    yield row("skin", lambda h, m, d: h.vert_xpos(*elsewhere()), ValueError, "the model has no body 'biotac_")
    yield row("skin", lambda h, m, d: h.vert_xpos(m, elsewhere()[1]), ValueError, "the data are of another")
    yield row("pressure", lambda h, m, d: h.contact_pressure(m, None), TypeError, "data is NoneType: pass")

    yield row("read Warp", lambda h, m, d: h.read(d, others()), ValueError, "no channel array(shape=(3,)")


def calls_of_hands():
    one = {"f": Mount("b", (0, 0, 0))}

    def row(said, kind=ValueError, spec=True, **settings):
        def call():
            biotac_mj.attach_to_hand(scene() if spec is True else spec, **{"hand": one} | settings)

        return f"hand {said}"[:60], call, kind, said

    yield row("spec is NoneType: pass a mujoco.MjSpec", TypeError, spec=None)
    yield row("prefix is True: pass the text", prefix=True)
    yield row("prefix is array(shape=(3,), dtype=float32): pass the text", prefix=others())
    yield row("fingers is -1: give a list of f", fingers=-1)
    yield row("fingers is array(shape=(3,), dtype=float32): give a list", fingers=others())
    yield row("the hand has no finger ['f']: choose from f", fingers=[["f"]])
    for name in ("batch", "self_touch"):
        yield row(f"{name} is 'no': give True or False", **{name: "no"})
    yield row("hand is {}: choose one of shadow_hand", hand={})
    yield row("hand is array([0., 0., 0.]): choose one of shadow_hand", hand=ARRAY)
    yield row("hand is {1: Mount(", hand={1: one["f"]})
    yield row("path of a file of mounts is array(shape=(3,), dtype=float32): give", mount=others())
    for hand in (one, "shadow_hand"):
        yield row("unknown variant 'autentic': choose one of replace", hand=hand, variant="autentic")
        yield row("unknown variant nan: choose one of replace", hand=hand, variant=np.nan)
        yield row("unknown variant array([0., 0., 0.]): choose one of replace", hand=hand, variant=ARRAY)
    for wrong in (3, "", None):
        said = f"body of a Mount is {wrong!r}: give the name of a link"
        yield f"mount {said}", lambda wrong=wrong: Mount(wrong, (0, 0, 0)), ValueError, said
    yield row("pos is 3: give 3 numbers", hand={"f": Mount("b", 3)})
    yield row("tip of link 'b' is 'up': pass a number", hand={"f": Mount("b", (0, 0, 0), tip="up")})


def calls_of_tasks():
    if importlib.util.find_spec("dm_control") is None:
        return

    def row(said, *arguments, domain="finger", task="press"):
        what = f"load {domain!r} {task!r} {arguments!r}"[:70]
        return what, lambda: biotac_mj.tasks.load(domain, task, *arguments), ValueError, said

    yield row("no domain 5: choose one of finger, gripper", domain=5)
    yield row("has no task []: choose one of press", task=[])
    yield row("task_kwargs is 5: give a dict", 5)
    yield row("task_kwargs is {1: 2}: give a dict", {1: 2})
    yield row("environment_kwargs is 'a': give a dict", None, "a")
    yield row("task_kwargs has environment_kwargs, or task: give them as", {"environment_kwargs": {}})
    for wrong in ("a", -1, 1.5, [1], 2**32):
        yield row(f"random is {wrong!r}: give a whole number from 0 to {2**32 - 1}", {"random": wrong})
    yield row("unknown preset of observe ['electrodes']: choose one of tactile", {"observe": ["electrodes"]})
    yield row("physics_timestep is 0.003: give seconds of which whole", {"physics_timestep": 0.003})
    yield row("physics_timestep is 1.0: give seconds of which whole", {"physics_timestep": 1.0})
    yield row("time_limit is 'a': give a finite number", {"time_limit": "a"})
    for task in ("press", "follow_edge", "explore"):
        yield row("biotac is 5: give a dict", {"biotac": 5}, task=task)
    yield row("the settings of a BioTac has 'tear': did you mean 'tier'?", {"biotac": {"tear": "full"}})
    yield row(
        "the settings of a BioTac has 'glue': choose from design, skin, material", {"biotac": {"glue": 1}}
    )
    yield row("observe array(shape=(3,), dtype=float32): choose", {"observe": others()})
    yield row("biotac has name 'a': leave it out", {"biotac": {"name": "a"}})
    yield row("noise is array([0., 0., 0.]): give True or False", {"biotac": {"noise": ARRAY}})
    yield row("options is array([0., 0., 0.]): give a dict", {"biotac": {"options": ARRAY}})
    yield row("objects is []: give a list of some of", {"objects": []}, task="explore")
    yield row("objects is 'box': give a list of some of", {"objects": "box"}, task="explore")
    yield row("environment_kwargs has 'nope': choose from n_sub_steps", None, {"nope": 1})
    yield row("environment_kwargs has 'time_limit': choose from", None, {"time_limit": 1.0})
    yield row("legacy_step of environment_kwargs is 'x': give True or False", None, {"legacy_step": "x"})
    yield row("max_reset_attempts of environment_kwargs is 0: give a whole", None, {"max_reset_attempts": 0})
    yield row(
        "environment_kwargs is 'x': give one of ObservationPadding",
        None,
        {"delayed_observation_padding": "x"},
    )


def calls_of_batches():
    if importlib.util.find_spec("mujoco_warp") is None:
        return

    @functools.cache
    def batch(nworld=2):
        import mujoco_warp as mjw

        spec = scene()
        biotac_mj.batch.add(spec, site="tip", skin="coarse")
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        return model, mjw.put_model(model), mjw.put_data(model, data, nworld=nworld)

    def call(settings, *change):
        model, m, d = batch()
        m, d = [m, d] if not change else change
        settings = {"skin": "coarse", "readings": False, "mjm": model} | settings
        return biotac_mj.batch.attach(settings.pop("mjm"), m, d, **settings)

    def row(said, kind=ValueError, *change, **settings):
        return f"batch {said}"[:60], lambda: call(settings, *change), kind, said

    yield row("mjm is int: pass the MjModel", TypeError, mjm=5)
    yield row("m is int and d is str: pass mujoco_warp's Model and Data", TypeError, 5, "a")
    yield row("material is 5: pass a name, a dict or a Material", material=5)
    yield row("friction is 1000", friction=HUGE)
    for name in ("rounding", "options", "worlds"):
        for wrong in (5, "a", [1], ARRAY, {1: 2}):
            verb = "pass" if name == "rounding" and not isinstance(wrong, dict) else "give"
            yield row(f"{name} is {wrong!r}: {verb} a dict", **{name: wrong})
    yield row("geom 'bal' of the BioTac's settings matches none", rounding={"bal": 1e-3})
    yield row("rounding of a sphere is 0.006: a fillet's radius", rounding={"ball": 6e-3})
    said = "rounding is of geom 'biotac_core', a part of the BioTac: leave"
    yield row(said, rounding={"biotac_core": 1e-3})
    yield row("rounding is of geom 'ball', which is none of geoms", geoms=[], rounding={"ball": 1e-3})
    yield row("geoms is ['']: give a list of names", geoms=[""])
    yield row("readings is []: pass True, False or a dict", readings=[])
    yield row("readings has 'nose': did you mean 'noise'?", readings={"nose": None})
    yield row("adhesion is 'a': pass a number, or an array", worlds={"adhesion": "a"})
    yield row("adhesion has shape (3,): pass one number or (2,)", worlds={"adhesion": [0, 0, 0]})
    yield row("bulk_modulus has shape (3,): pass one number or (2,)", worlds={"bulk_modulus": [1, 2, 3]})
    yield row("bulk_modulus is -1: pass numbers >= 0", worlds={"bulk_modulus": -1})
    yield row("fill_volume is -1: pass finite numbers [m^3] above minus", worlds={"fill_volume": -1})
    yield row("modulus is {'a': 1}: pass a number, or an array", worlds={"modulus": {"a": 1}})
    yield row("modulus has shape (2, 2): pass factors of shape (2, ", worlds={"modulus": [[1, 2], [3, 4]]})
    yield row("a call of batch.attach has 'device': choose from", TypeError, device="cpu")
    yield row("on_error of settings is 'raise': batch.attach takes none", settings={"on_error": "raise"})
    make = biotac_mj.batch.make
    for wrong in ("a", 0, 1.5, None):
        said = f"nworld is {wrong!r}: give a whole number from 1"
        yield said, lambda wrong=wrong: make(batch()[0], wrong, skin="coarse"), ValueError, said
    for name, wrong, said in (
        ("settings", {"contact": {"coupling": "one-way"}}, "is 'one-way': batch.make takes none"),
        ("prefix", "\udcff", "prefix is '\\udcff': give the text"),
        ("prefix", others(), "prefix is array(shape=(3,), dtype=float32): give the text"),
        ("material", RECURSIVE, "material is list: pass a dict"),
        ("seed", RECURSIVE, "]]: pass whole numbers >= 0"),
        ("friction", np.zeros((2, 2)), "friction is array([[0., 0.], [0., 0.]]) of shape (2, 2): pass"),
    ):
        made = lambda name=name, wrong=wrong: make(batch()[0], 2, "cpu", **{"skin": "coarse", name: wrong})  # noqa: E731
        yield f"make {name} {said}"[:60], made, ValueError, said
    for wrong in ("tpu", [1], 5):
        said = f"device is {wrong!r}: this machine has cpu"
        yield said, lambda wrong=wrong: make(batch()[0], 2, wrong, skin="coarse"), ValueError, said


def calls_of_recordings():
    from biotac_mj.files import replacing
    from biotac_mj.recordings import Recording, draw, findings, load, load_one, read, warnings, write

    def made(**fields):
        return Recording(**{"time": np.arange(9.0), "pdc": np.arange(9.0)} | fields)

    def row(said, call):
        return f"recordings {said}"[:60], call, ValueError, said

    yield row("recording: time is 'noon': pass a number, or an array", lambda: made(time="noon"))
    yield row("recording: pdc is {}: pass a number, or an array", lambda: made(pdc={}))
    yield row("recording: force is 1000", lambda: made(force=HUGE))
    yield row("units are None: a text and a dict", lambda: made(units=None))
    yield row("units of recording has 'pcd': did you mean 'pdc'?", lambda: made(units={"pcd": "counts"}))
    yield row("name is 5 and units are {}: a text and", lambda: made(name=5))
    yield row("paths is 5: give names of files", lambda: load(5))
    yield row("paths is [1]: give names of files", lambda: load_one([1]))
    yield row("force is [5]: give names of files", lambda: load("a", force=5))
    for wrong in (-1, np.nan, "a", [1]):
        yield row(f"rate is {wrong!r}: give a finite number > 0", lambda wrong=wrong: load("a", rate=wrong))
    yield row("the path of a recording is [1]: give a file that", lambda: read([1]))
    yield row("recordings are [5]: give a list of Recordings", lambda: write("a.h5", [5]))
    for wrong in (5, 1.5, "a", None, [1.5], [[1, 2]], [True], {}, slice("a"), ARRAY, [[1], [1, 2]]):
        said = f"rows of recording are {reprlib.repr(wrong)}: give a slice, numbers (k,) of rows, or (9,)"
        yield row(said, lambda wrong=wrong: made().rows(wrong))
    for wrong in ([9], [-10], [2**62], slice(9, 12), np.zeros(9, bool), np.zeros(0, int)):
        yield row(": give at least one of its 9 rows", lambda wrong=wrong: made().rows(wrong))
    for call in (findings, warnings, lambda value: draw(value, "a.png")):
        for wrong in (None, 5, "a", [made()], ARRAY):
            said = f"recording is {type(wrong).__name__}: pass a Recording"
            yield f"of recordings {said}"[:60], lambda c=call, w=wrong: c(w), TypeError, said
    for wrong in (5, None, b"a", [1]):
        said = f"path is {wrong!r}: give the name of a file"
        yield row(said, lambda wrong=wrong: draw(made(), wrong))
        yield row(said, lambda wrong=wrong: replacing(wrong).__enter__())
    yield row("a.jelly is no picture: give a name that ends in", lambda: draw(made(), "a.jelly"))
    for wrong in (".", "/", ""):
        yield row("is a folder: give the name of a file", lambda wrong=wrong: draw(made(), wrong))
        yield row("is a folder: give the name of a file", lambda wrong=wrong: replacing(wrong).__enter__())
    yield row("/ is a folder: give a new name", lambda: replacing("/", folder=True).__enter__())
    yield row("give a name without a zero byte", lambda: replacing("a\0b").__enter__())


def calls_of_sensors():
    from biotac_mj.sensor.readings import PhysicsReadings

    skin = biotac_mj.load_skin("coarse")

    def row(said, call):
        return f"sensors {said}"[:60], call, ValueError, said

    yield row("skin is 5: pass one of coarse, default, fine", lambda: biotac_mj.load_skin(5))
    for name in ("vert", "electrode_pos", "core_face"):
        flat = functools.partial(dataclasses.replace, skin, **{name: [1.0]})
        yield row(f"{name} has shape (1,): pass (n, 3)", flat)
        yield row(
            f"{name} is 'a': pass an array", functools.partial(dataclasses.replace, skin, **{name: "a"})
        )
    yield row("noise of the readings is 5: pass true or false", lambda: PhysicsReadings(skin, noise=5))
    yield row("temperature of the readings is 'a': pass", lambda: PhysicsReadings(skin, temperature="a"))
    yield row("seed is 'a': give a whole number from 0", lambda: PhysicsReadings(skin, seed="a"))
    yield row("geometry is int and film NoneType: pass", lambda: PhysicsReadings(5))


TABLES = (
    calls_of_recordings,
    calls_of_sensors,
    calls_of_attach,
    calls_of_handle,
    calls_of_hands,
    calls_of_tasks,
    calls_of_batches,
)
ROWS = [row for table in TABLES for row in table()]


@pytest.mark.parametrize(("call", "kind", "said"), [row[1:] for row in ROWS], ids=[row[0] for row in ROWS])
def test_a_bad_call_is_an_error_of_one_line(call, kind, said):
    with pytest.raises(kind) as caught:
        call()
    text = str(caught.value)
    assert said in text and "\n" not in text and ": " in text, text


@pytest.mark.parametrize(
    "wrong",
    ["x" * 10_000, np.zeros((99, 99)), {"a" * 9999: [RECURSIVE] * 99}, pytest.param(10**5000, id="number")],
)
def test_a_long_value_is_shown_short(wrong):
    with pytest.raises(ValueError, match="geoms is|no geom") as caught:
        attach(geoms=[wrong] if isinstance(wrong, str) else wrong)
    assert len(str(caught.value)) < 300 and "\n" not in str(caught.value)


@pytest.mark.parametrize("size", [1e200, 1e-20, 1e-200, 1e-320])
def test_a_quaternion_may_have_any_length(size):
    """MuJoCo squares it: beyond 1e154 it was zero, below 1e-15 it stayed as it was."""
    turned = np.array([0.5, 0.5, -0.5, 0.5])
    spec = scene()
    core = biotac_mj.attach(spec, site="tip", skin="coarse", readings="none", quat=size * turned).body
    np.testing.assert_allclose(spec.compile().body(core).quat, turned, atol=1e-3 if size < 1e-310 else 1e-12)
    tip, pad = (0, 0, size), (0, -size, 0)
    np.testing.assert_allclose(Mount("b", (0, 0, 0), tip, pad).quat, Mount("b", (0, 0, 0)).quat, atol=1e-12)


def test_actions_and_seeds_of_gymnasium():
    gymnasium = pytest.importorskip("gymnasium", reason="needs gymnasium (extra gymnasium)")
    pytest.importorskip("dm_control", reason="needs dm_control (extra control)")
    biotac_mj.tasks.register()
    env = gymnasium.make("BioTac/Press-v0").unwrapped
    env.reset(seed=1)
    for action in ("a", 5, np.zeros(2), np.full(3, np.nan), None, [[0, 0, 0]]):
        with pytest.raises(ValueError, match="the action is .*: give 3 finite numbers in "):
            env.step(action)
    env.step([0, 0, 0])
    for seed in ("a", -1, 2**32, 1.5):
        with pytest.raises(ValueError, match="seed is .*: give a whole number from 0 to"):
            env.reset(seed=seed)
    for settings, said in (
        ({"observ": 1}, "task_kwargs of Press has 'observ': did you mean 'observe'?"),
        ({"render_mode": []}, r"unknown render_mode \[\]: choose rgb_array or None"),
        ({"width": "a"}, "width is 'a': give a whole number"),
    ):
        with pytest.raises(ValueError, match=said):
            type(env)("finger", "press", **settings)
