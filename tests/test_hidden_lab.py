"""The laboratory with a hidden sensor: sealed, apart from the engine, carrying out the plan it is given."""

import dataclasses
import pathlib
import warnings

import numpy as np
import pytest
from test_discrepancy_workflow import imports

from biotac_mj.discrepancy.trajectories.contacts import Contact, trajectory_of
from biotac_mj.discrepancy.trajectories.design import Plan, Planned
from biotac_mj.discrepancy.trajectories.plan_files import write_plan

BENCHMARKS = pathlib.Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def lab():
    import sys

    sys.path.insert(0, str(BENCHMARKS))
    try:
        import hidden_lab
    finally:
        sys.path.remove(str(BENCHMARKS))
    return hidden_lab


def plan(depth=0.4e-3):
    contact = Contact("sphere_7mm", -9e-3, 0.0, (0.0, 0.0), depth, 5e-3, 0.5)
    at, mat = np.array([-9e-3, -7.2e-3, 0.0]), np.eye(3)
    ones = [trajectory_of(contact, at, mat, clock, f"contact{k}", 19) for k, clock in enumerate((10.0, 20.0))]
    return Plan([Planned(contact, one, "a test") for one in ones], {}, [])


def test_laboratory_and_engine_share_no_code():
    for name in ("hidden_lab.py", "discrepancy_generator.py"):
        assert not any("discrepancy" in module for module in imports(BENCHMARKS / name) if "." in module)


def test_hidden_sensors_are_drawn_again_by_their_seed_and_sealed(lab):
    first, again, other = lab.draw(30, 3), lab.draw(30, 3), lab.draw(30, 4)
    assert first == again != other
    assert [lab.opened(lab.seal(one))["kind"] for one in first] == [one["kind"] for one in first]
    kinds = [one["kind"] for one in first]
    assert {"single", "pair", "none", "outside"} <= set(kinds)
    assert all(
        len(one["effects"]) == {"none": 0, "wrong-base": 0, "pair": 2}.get(one["kind"], 1) for one in first
    )
    many = [one["kind"] for one in lab.draw(60, 5)]
    assert {k: many.count(k) for k in set(many)} == {
        "single": 30,
        "pair": 10,
        "none": 8,
        "outside": 8,
        "wrong-base": 4,
    }
    for begun in range(5, 60):  # a run may be cut off
        assert all(abs(many[:begun].count(k) - begun * many.count(k) / 60) < 1.1 for k in set(many))
    assert b"latency" not in b"".join(map(lab.seal, first))


def test_a_picture_of_a_plan_has_room_for_long_reasons(tmp_path):
    wanted = plan()
    reason = "it would tell one from the other; " * 20
    one = Plan([dataclasses.replace(wanted.contacts[0], reason=reason)], {}, [])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_plan(one, tmp_path / "plan.csv")


def test_contacts_at_one_place_have_one_label(tmp_path, monkeypatch):
    said, (first, second) = [], plan().contacts
    t = second.trajectory
    second = dataclasses.replace(second, trajectory=dataclasses.replace(t, pos=t.pos + 1e-3))
    monkeypatch.setattr("matplotlib.axes.Axes.annotate", lambda ax, text, at, **_: said.append(text))
    write_plan(Plan([first, second, first], {}, []), tmp_path / "plan.csv")
    assert said == ["1, 3", "2"]


def test_a_laboratory_reads_the_plan_that_was_written(lab, tmp_path):
    wanted = plan()
    write_plan(wanted, tmp_path / "plan.csv")
    contacts = lab.read_plan(tmp_path / "plan.csv")
    assert [c["clock"] for c in contacts] == [10.0, 20.0]
    for c, one in zip(contacts, wanted.contacts):
        np.testing.assert_allclose(c["pos"], one.trajectory.pos, atol=1e-11)
        np.testing.assert_allclose(c["turn"], one.trajectory.mat[0], atol=1e-11)
        np.testing.assert_allclose(c["time"], one.trajectory.time, atol=1e-4)


def test_rounds_are_counted_by_what_was_hidden(lab, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import rounds

    def row(kind, hidden, modulus, named, best, decided=False):
        record = {"named": named, "decided": decided, "verdict": "unknown (x)", "contacts": 9}
        record |= {"explanations": [[best, 1.0]], "confidence": [0.9] * len(named)}
        record |= {"true": 0.9, "unseen": 0.7} if kind == "single" else {"unseen": None}
        truth = {"kind": kind, "effects": [[name, 1.0, 0] for name in hidden], "base": {"modulus": modulus}}
        return [{"truth": truth, "arm": arm, "rounds": [record]} for arm in rounds.ARMS]

    rows = [
        row("single", ["latency"], 1.0, [["latency", "lowpass"]], ["latency"], True),
        row("pair", ["relax", "gain"], 1.0, [["creep"], ["mount"]], ["creep", "mount"], True),
        row("none", [], 1.4, [["modulus"]], []),
        row("none", [], 1.0, [["modulus"]], []),
        row("outside", ["ripple"], 1.0, [], []),
    ]
    c = rounds.counted(sum(rows, []))["designed, round 1"]
    assert (c["right"], c["names"], c["found"], c["singles"], c["both"], c["pairs"]) == (1, 4, 1, 1, 0, 1)
    assert (c["decided"], c["wrongly"], c["false"], c["clean"]) == (1, 1, 1, 2)
    assert (c["unknown"], c["outside"], c["labs"]) == (1, 1, 5)
    assert (c["closed"], c["closed_of"], c["elsewhere"], c["elsewhere_of"]) == (0.9, 1, 0.7, 1)


def test_a_bare_geom_touches_where_an_object_of_its_size_does(lab):
    """The pose of an object is that of its tip, and of a bare geom that of its centre."""
    from discrepancy_generator import _way

    contact = {"heading": np.array([0.0, 1.0, 0.0])}
    tip = np.outer(np.linspace(-1e-3, 1e-3, 4), contact["heading"])
    named = list(_way(contact | {"tool": "sphere_7mm"}, tip, 3.8e-3))
    bare = list(_way(contact | {"tool": "geom:sphere:0.0035"}, tip - 3.5e-3 * contact["heading"], 3.8e-3))
    for (a, there), (b, reached) in zip(named, bare, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)
        assert there == reached


@pytest.mark.slow
def test_a_laboratory_returns_what_its_sensor_reads(lab, tmp_path):
    from biotac_mj.discrepancy import read_trajectories

    sensor = lab.draw(1, 3)[0] | {"effects": [["latency", 0.2, 0]]}
    (tmp_path / "one.sealed").write_bytes(lab.seal(sensor))
    write_plan(plan(), tmp_path / "plan.csv")
    out = tmp_path / "measured.h5"
    lab.main(["--sensor", f"{tmp_path}/one.sealed", "--plan", f"{tmp_path}/plan.csv", "--out", str(out)])
    data = read_trajectories(out)
    assert len(data) == 2 and [t.clock for t in data] == [10.0, 20.0]
    skin, contacts = lab.generator_of(sensor, "coarse", "condensed"), lab.read_plan(tmp_path / "plan.csv")
    late, clean = (lab.clean(skin, sensor, contacts, 0, effects) for effects in (True, False))
    for t, (shown, *_), (counts, _, force) in zip(data, late, clean):
        assert np.abs(t.electrodes - shown).max() < 5 * 3.5  # noise and rounding alone
        assert np.abs(t.electrodes - counts).max() > 10
        assert np.abs(t.force - force).max() < 0.05
