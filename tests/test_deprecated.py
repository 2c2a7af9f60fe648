"""Old spellings still work and say the new one; the functions that put a BioTac somewhere are alike."""

import inspect
import warnings

import mujoco
import numpy as np
import pytest
import spring_skin
import test_hands

import biotac_mj
from biotac_mj import batch, calibration, coupling, discrepancy, recordings
from biotac_mj.deprecated import keywords_after


def with_tip():
    return mujoco.MjSpec.from_string('<mujoco><worldbody><site name="tip"/></worldbody></mujoco>')


def springs():
    return {"skin": spring_skin.pad_geometry(), "stepper": "springs", "readings": "sum"}


def of_attach(*args, **settings):
    spec = with_tip()
    return coupling.attach(spec, *args, **springs() | settings), spec.to_xml()


def of_add(*args, **settings):
    spec = with_tip()
    return batch.add(spec, *args, **settings), spec.to_xml()


def of_hand(*args, **settings):
    spec = test_hands.small_hand()
    return biotac_mj.attach_to_hand(spec, test_hands.mounts(), *args, **springs() | settings), spec.to_xml()


def of_make(*args, **settings):
    """What of its settings a batch of one world tells."""
    spec = with_tip()
    batch.add(spec, site="tip", prefix="a_", skin="coarse", coupling="one-way")
    made = batch.make(spec.compile(), 1, "cpu", *args, **settings)
    return made.skin.geoms.struct.friction.numpy().tolist(), made.senses, len(made.vert_xpos[0])


CALLS = {
    "attach": (of_attach, ("tip", None, (0, 0, 0.1)), dict(site="tip", pos=(0, 0, 0.1)), "site=..., body="),
    "add": (of_add, ("tip", None, (0, 0, 0.1)), dict(site="tip", pos=(0, 0, 0.1)), "site=..., body="),
    "hand": (
        of_hand,
        (("b",), "replace", "x_", True, 9),
        dict(fingers=("b",), prefix="x_", self_touch=True, slots=9),
        "fingers=..., variant=..., prefix=..., self_touch=..., slots=...",
    ),
    # friction and priority came fourth and fifth, and readings before signal
    "make": (
        of_make,
        ("a_", "coarse", "default", False, 0.4, 1, None, None, 5, False),
        dict(prefix="a_", skin="coarse", liquid=False, friction=0.4, priority=1, seed=5, readings=False),
        "prefix=..., skin=..., material=..., liquid=..., friction=..., priority=...",
    ),
}


@pytest.mark.parametrize("name", CALLS)
def test_settings_by_place_are_those_by_name(name):
    call, placed, named, said = CALLS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("error", FutureWarning)
        expected = call(**named)
    with pytest.warns(FutureWarning, match="by name: write " + said.replace(".", r"\.")) as found:
        assert call(*placed) == expected
    assert {one.filename for one in found if one.category is FutureWarning} == {__file__}


def test_settings_that_have_no_place_are_refused_as_python_does():
    with pytest.raises(TypeError, match=r"attach\(\) takes 1 positional argument but 2"):
        of_attach("tip", site="tip")

    @keywords_after("a", "c", "b")
    def both(a, *, b=0, c=0, new=0):
        return a, b, c, new

    with pytest.warns(FutureWarning, match="takes what comes after a by name: write c=..., b=..."):
        assert both(1, 3, 2, new=4) == (1, 2, 3, 4)
    with pytest.raises(TypeError, match="takes 1 positional argument but 4"):
        both(1, 2, 3, 4)
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'a'"):
        both()


SETTINGS = {
    "attach": (coupling.attach, "spec"),
    "add": (batch.add, "spec"),
    "batch.attach": (batch.attach, "mjm m d"),
    "make": (batch.make, "mjm nworld device"),
    "hand": (biotac_mj.attach_to_hand, "spec hand"),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_what_puts_a_biotac_somewhere_has_the_same_settings_in_the_same_order(name):
    """All by name but the first; one name has one default."""
    function, first = SETTINGS[name]
    own, all_of = inspect.signature(function).parameters, inspect.signature(coupling.attach).parameters
    placed = [one.name for one in own.values() if one.kind is one.POSITIONAL_OR_KEYWORD]
    assert placed == first.split()
    shared = [one for one in own if one in all_of and one not in placed]
    assert shared and shared == [one for one in all_of if one in shared]
    assert [one for one in shared if own[one].default != all_of[one].default] == []


@pytest.mark.parametrize(
    "package, old, new",
    [(biotac_mj, "SensorBioTac", "ReadingsOptions"), (discrepancy, "Recording", "PlainRecording")],
)
def test_an_old_name_of_a_package_is_the_new_ones(package, old, new):
    with pytest.warns(FutureWarning, match=f"{package.__name__}.{old} is called {new}") as found:
        assert getattr(package, old) is getattr(package, new)
    assert found[0].filename == __file__
    assert old not in dir(package) and new in dir(package) and old not in package.__all__


def test_an_old_name_is_told_where_it_is_imported(tmp_path):
    """`from package import name` asks from inside importlib."""
    (tmp_path / "theirs.py").write_text("from biotac_mj.discrepancy import Recording\n")
    with pytest.warns(FutureWarning, match="is called PlainRecording") as found:
        exec(compile((tmp_path / "theirs.py").read_text(), "theirs.py", "exec"), {"__name__": "theirs"})
    assert {one.filename for one in found} == {"theirs.py"}


def test_which_recording_of_a_file_was_called_sensor(tmp_path):
    time, path = np.arange(9.0), tmp_path / "two.h5"
    recordings.write(path, [recordings.Recording(time, pdc=time, name=name) for name in "ab"])
    assert recordings.load_one(path, recording="b").recording.name == "b"
    first, notes = recordings.load_one(path)
    assert first.name == "a" and "2 recordings are in" in notes[0]
    with pytest.warns(FutureWarning, match=r"load_one\(sensor=\) is called recording"):
        assert recordings.load_one(path, sensor="b").recording.name == "b"


def test_both_fits_take_the_rest_by_name():
    """They were placed differently: device was the sixth of one, progress of the other."""
    pytest.importorskip("torch")
    from biotac_mj import differentiable

    for fit in (calibration.calibrate, differentiable.calibrate):
        parameters = inspect.signature(fit).parameters.values()
        placed = [one.name for one in parameters if one.kind is one.POSITIONAL_OR_KEYWORD]
        assert placed == ["configuration", "material", "indentation", "parameters"]
    with (
        pytest.warns(FutureWarning, match="by name: write max_iterations=..., device=..."),
        pytest.raises(ValueError, match="name each parameter to fit once"),
    ):
        calibration.calibrate(None, None, None, [], 3, "cpu")  # fails behind the warning
