"""Adhesion and load-dependent friction of the catalogue inside the contact: what the skin becomes, and what
comes out."""

import dataclasses
import types

import numpy as np
import pytest
from blocks import four_nodes

from biotac_mj.discrepancy.trajectories.model import simulator
from biotac_mj.discrepancy.trajectories.model.fields import Fields
from biotac_mj.discrepancy.trajectories.model.in_skin import InSkinSimulator
from biotac_mj.discrepancy.trajectories.model.sensor_file import load_simulator
from biotac_mj.discrepancy.trajectories.model.simulator import Simulator
from biotac_mj.discrepancy.trajectories.trajectory import Trajectory
from biotac_mj.effects.catalogue import by_id
from biotac_mj.effects.contact import TACKY
from biotac_mj.effects.in_skin import memory_of
from biotac_mj.geometry import load_skin
from biotac_mj.geometry.skins import skin_reference
from biotac_mj.skin import ContactLaw, SkinOptions
from biotac_mj.skin.contact.law import GridTooCoarse

SKIN, _ = skin_reference(four_nodes("coarse"))  # its file; a quarter of the work of ten nodes an element


def walk(depth, along=None, rows=8):
    """A Trajectory of the 7 mm sphere over the pad through depths and places along x [m], `rows` rows between
    each two."""
    vert = load_skin("coarse").vert
    surface = vert[(abs(vert[:, 0] + 12e-3) < 2e-3) & (abs(vert[:, 2]) < 2e-3), 1].min()
    knots = np.arange(len(depth))
    t = np.linspace(0, knots[-1], rows * knots[-1] + 1)
    x = np.interp(t, knots, along) if along is not None else 0 * t
    pos = np.column_stack([-11e-3 + x, surface + np.interp(t, knots, depth), 0 * t])
    return Trajectory(
        "a", "sphere_7mm", 0.0, t, pos, np.tile(np.eye(3), (len(t), 1, 1)), np.full((len(t), 19), 2500.0)
    )


def test_effects_become_the_contact_s_law():
    effects = [
        (by_id("adhesion"), {"W": 0.05}),
        (by_id("friction"), {"log_mu": 0.1}),
        (by_id("fric_load"), {"exponent": 0.14}),
    ]
    inside = memory_of(effects)
    assert [e.id for e, _ in inside.rest] == ["friction"]
    law = SkinOptions(**inside.contact).contact_law
    assert law == ContactLaw(
        friction_exponent=0.14 / 0.7, friction_pressure=1.65e5, adhesion=0.05, adhesion_hysteresis=3.0
    )
    none = memory_of([(by_id("adhesion"), {"W": 0.0}), (by_id("fric_load"), {"exponent": 0.0})])
    assert none.contact == {} and not none.rest


def test_it_sticks_to_what_is_drawn_off(tmp_path):
    """The skin follows the object, by millinewtons (JKR: 1.5 pi W R = 2.5 mN for the work of parting);
    without adhesion it does not."""
    press = walk([-0.1e-3, 0.1e-3, -0.1e-3], rows=16)
    sim = InSkinSimulator(effects=[(by_id("adhesion"), {"W": 0.05})])
    sim.save(tmp_path / "s.yaml")
    sim = load_simulator(tmp_path / "s.yaml")
    assert type(sim) is InSkinSimulator
    sticking, plain = sim.run([press])[0], sim.run([press], effects=[])[0]
    pull = -(-sticking.force @ press.heading)
    assert 1e-3 < pull.max() < 3.5e-3 and np.argmax(pull) > 16  # on the way out
    assert (-plain.force @ press.heading).min() > -1e-9
    assert abs(sticking.counts - plain.counts).max() < 3


def test_adhesion_by_its_work_is_what_the_skin_answered():
    """Straight lines between the works that it was solved for, from none on; beyond them in proportion."""
    press = walk([-0.1e-3, 0.1e-3, -0.1e-3])
    n = len(press.time)
    slope = np.column_stack([np.ones((n, 4)), np.full((n, 19), 0.01)])
    answers = {f"{TACKY}{w:g}": f * slope for w, f in ((4.0, 3.0), (1.0, 1.0))}
    stuck = by_id("adhesion").given(list(answers))
    assert list(stuck.params) == ["joining"] and list(by_id("adhesion").given(["x"]).params) == ["W"]
    base = {"force": np.zeros((n, 3)), "pressure": np.zeros(n), "log_z": np.full((n, 19), 10.0)}
    fields = Fields([base], {k: [v] for k, v in answers.items()}, [press])
    for work, by in ((0.0, 0.0), (0.5, 0.5), (1.0, 1.0), (2.5, 2.0), (4.0, 3.0), (8.0, 6.0)):
        run = dataclasses.replace(fields.begun[0])
        stuck.apply(run, {"joining": work})
        np.testing.assert_allclose(
            [run.force[3, 0], run.pressure[3], run.log_z[3, 0] - 10], [by, by, by / 100]
        )
    fields.add(f"{TACKY}2", [5.0 * slope])
    run = dataclasses.replace(fields.begun[0])
    stuck.apply(run, {"joining": 2.0})
    assert run.force[3, 0] == 5.0
    law = memory_of([(stuck, {"joining": 2.0})]).contact["contact_law"]
    assert law == {"adhesion": 2.0, "adhesion_hysteresis": 3.0}
    with pytest.raises(ValueError, match="take tier='full', or leave it out"):
        Simulator(effects=[(stuck, {"joining": 2.0})]).run([press])


def test_the_skin_itself_is_asked_where_it_sticks():
    """As inside the contact (`InSkinSimulator`), of which the reduced law is no part: a tail of pull when the
    object leaves; solved once for a work."""
    press = walk([-0.1e-3, 0.1e-3, -0.1e-3], rows=16)
    effects = [(by_id("adhesion").given(["joining"]), {"joining": 0.5})]
    sim = Simulator(SKIN, tier="full")
    fields = Fields(sim.solve([press]), {}, [press])
    one, same = (
        sim.run([press], fields, True, effects)[0],
        InSkinSimulator(SKIN, effects=effects).run([press])[0],
    )
    np.testing.assert_allclose(one.force, same.force, atol=1e-4)
    assert (one.force @ press.heading).max() > 5e-3
    assert not sim.stick(fields, 0.55) and not sim.stick(fields, 0.0) and len(fields.slopes) == 1


@pytest.mark.slow
@pytest.mark.parametrize("exponent", [0.2, -0.1])
def test_a_slide_s_ratio_follows_the_load(exponent):
    """Three loads: T / N over Coulomb's goes as N^-exponent, within what the mesh scatters."""
    depth = np.array([-0.1, 0.4, 0.4, 0.8, 0.8, 1.2, 1.2, -0.1]) * 1e-3
    slide = walk(depth, np.array([-1, -1, 1, 1, -1, -1, 1, 1]) * 1.5e-3)
    sim, rows = InSkinSimulator(), np.r_[11:17, 27:33, 43:49]
    ratio, load = [], None
    for n in (0.0, exponent):
        run = sim.run([slide], effects=[(by_id("fric_load"), {"exponent": n})])[0]
        load = run.normal_force[rows]
        ratio.append(run.force[rows, 0] / load)
    slope, level = np.polyfit(np.log(load), np.log(ratio[1] / ratio[0]), 1)
    assert slope == pytest.approx(-exponent, abs=0.04) and np.exp(level) == pytest.approx(1, abs=0.04)


def test_a_mesh_too_fine_for_adhesion_ends_no_diagnosis(monkeypatch):
    """A fit that asks for more work than the distance to a mesh is exact for stopped with an error. Other
    errors still do."""
    sim, asked = Simulator(skin="coarse", tier="full"), []
    fields = types.SimpleNamespace(slopes={f"{TACKY}1": {}}, base=[], trajectories=[])

    def refuses(sim, work):
        asked.append(work)
        raise GridTooCoarse("adhesion reaches 92 um") if work < 25 else ValueError("another")

    monkeypatch.setattr(simulator, "tacky", refuses)
    assert not sim.stick(fields, 20.0) and asked == [20.0] and list(fields.slopes) == [f"{TACKY}1"]
    with pytest.raises(ValueError, match="another"):
        sim.stick(fields, 30.0)
