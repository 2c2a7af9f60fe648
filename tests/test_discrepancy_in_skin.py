"""Constitutive effects inside the finite elements: what goes into the material, and agreement with the
reduced form where that is exact."""

import dataclasses
import types
from types import SimpleNamespace

import numpy as np
import pytest
from blocks import four_nodes

from biotac_mj import cli
from biotac_mj.discrepancy.trajectories.base.nuisance import Nuisance
from biotac_mj.discrepancy.trajectories.model.in_skin import InSkinSimulator
from biotac_mj.discrepancy.trajectories.model.sensor_file import load_simulator
from biotac_mj.discrepancy.trajectories.model.simulator import Simulator
from biotac_mj.discrepancy.trajectories.trajectory import Trajectory
from biotac_mj.discrepancy.trajectories.workflow import TrajectoryDiagnosis
from biotac_mj.effects.catalogue import by_id
from biotac_mj.effects.in_skin import memory_of
from biotac_mj.geometry.skins import skin_reference
from biotac_mj.skin import Material

SKIN, _ = skin_reference(four_nodes("coarse"))  # its file; a quarter of the work of ten nodes an element


def test_effects_become_what_the_material_remembers():
    effects = [
        (by_id("relax"), {"g": 0.2, "tau": 3.0}),
        (by_id("gain"), {}),
        (by_id("mullins"), {"softening": 0.25, "width": 0.7}),
    ]
    inside = memory_of(effects)
    assert inside.material == {"prony": ((0.2, 3.0),), "mullins": (4.0, 1.0, 0.7)} and [
        e.id for e, _ in inside.rest
    ] == ["gain"]
    assert inside.contact == inside.model == {}
    # a power law of slope -n between the shortest and the longest of its times
    g, tau = np.array(memory_of([(by_id("creep"), {"n": 0.05})]).material["prony"]).T
    t = np.geomspace(0.1, 10, 30)
    slope = np.polyfit(np.log(t), np.log(1 + np.exp(-t[:, None] / tau) @ g), 1)[0]
    assert slope == pytest.approx(-0.05, rel=0.25)
    assert memory_of([(by_id("relax"), {"g": 0.0, "tau": 1.0})]).material == {"prony": ()}


def test_effects_become_what_the_rubber_is():
    """The maps of stiffen and hyster are those measured; what has no size changes nothing; several of a kind
    add up."""
    effects = [(by_id("stiffen"), {"c2": 0.1197}), (by_id("hyster"), {"fraction": 0.1, "width": 0.2e-3})]
    inside = memory_of([*effects, (by_id("inhomog"), {"along": 0.2, "across": -0.1})])
    assert inside.material["stiffening"] == pytest.approx(12) and inside.rest == []
    np.testing.assert_allclose(inside.material["hysteresis"], [(0.495, 0.00319)])
    at = np.random.default_rng(0).uniform(-0.02, 0.02, (50, 3))
    factors = inside.model["modulus"](at)
    run = SimpleNamespace(answers={})
    for place, factor in zip(at, factors):
        run.place, run.scale_load = (
            place,
            lambda reduced, factor=factor: np.testing.assert_allclose(factor, reduced),
        )
        by_id("inhomog").apply(run, {"along": 0.2, "across": -0.1})
    nothing = memory_of(
        [(by_id("stiffen"), {"c2": 0.0}), (by_id("hyster"), {"fraction": 0.0, "width": 0.2e-3})]
    )
    assert Material(**nothing.material) == Material()
    twice = memory_of(
        [
            effects[0],
            effects[0],
            effects[1],
            effects[1],
            *[(by_id("inhomog"), {"along": 0.2, "across": -0.1})] * 2,
        ]
    )
    assert twice.material["stiffening"] == pytest.approx(np.interp(0.2394, [0.1197, 0.2990], [12, 40]))
    assert len(twice.material["hysteresis"]) == 2
    np.testing.assert_allclose(twice.model["modulus"](at), factors**2)


def test_it_is_run_as_any_simulator(monkeypatch):
    """What `Simulator.run` takes by position reaches it, inside the skin and outside."""
    seen = []
    monkeypatch.setattr(Simulator, "run", lambda self, *args, **kw: seen.append((args, kw)) or ["run"])
    gain, relax = (by_id("gain"), {}), (by_id("relax"), {"g": 0.2, "tau": 1.0})
    for effects in ([gain], [relax, gain]):
        assert InSkinSimulator().run(["press"], None, True, effects, 1.1, ["slip"], nuisance="known") == [
            "run"
        ]
    assert seen == [((["press"], None, True, [gain], 1.1, ["slip"]), {"nuisance": "known"})] * 2


def test_what_was_fitted_is_written_with_its_interval(tmp_path):
    effects = [(by_id("relax"), {"g": 0.3, "film": 0.0, "tau": 2.0})]
    fit = SimpleNamespace(
        effects=effects, names=[("relax", "g")], nuisance=Nuisance(), interval=lambda k: (0.2, 0.4)
    )
    report = SimpleNamespace(fit=fit, comparison=SimpleNamespace(sim=Simulator(tier="full")))
    TrajectoryDiagnosis.apply(report, Simulator(tier="full")).save(tmp_path / "amended.yaml")
    again = load_simulator(tmp_path / "amended.yaml")
    assert again.effects == effects and again.intervals["relax"]["g"] == (0.2, 0.4)


def _pressed(depth, dt):
    """A 7 mm sphere to depths [m] on the pad, a row every dt [s]."""
    from biotac_mj.geometry import load_skin

    vert, n = load_skin("coarse").vert, len(depth)
    surface = vert[(abs(vert[:, 0] + 12e-3) < 2e-3) & (abs(vert[:, 2]) < 2e-3), 1].min()
    pos = np.column_stack([np.full(n, -12e-3), surface + depth, np.zeros(n)])
    turn, counts = np.tile(np.eye(3), (n, 1, 1)), np.full((n, 19), 2500.0)
    return Trajectory("a", "sphere_7mm", 0.0, np.arange(n) * dt, pos, turn, counts)


def test_a_file_says_where_constitutive_effects_act(tmp_path):
    InSkinSimulator(effects=[(by_id("relax"), {"g": 0.3, "tau": 2.0})]).save(tmp_path / "s.yaml")
    again = load_simulator(tmp_path / "s.yaml")
    assert type(again) is InSkinSimulator and again.effects[0][1] == {"g": 0.3, "film": 0.0, "tau": 2.0}
    Simulator().save(tmp_path / "r.yaml")
    assert type(load_simulator(tmp_path / "r.yaml")) is Simulator
    (tmp_path / "x.yaml").write_text(
        (tmp_path / "r.yaml").read_text().replace("constitutive: reduced", "constitutive: elsewhere")
    )
    with pytest.raises(ValueError, match="is 'elsewhere': choose one of reduced, in_skin"):
        load_simulator(tmp_path / "x.yaml")


@pytest.mark.parametrize(
    "arguments, text",
    [
        (["--effects", "r.yaml", "--in-skin"], "write `constitutive: in_skin` into it"),
        (["--tier", "condensed", "--device", "cuda:0"], "add --tier full"),
    ],
)
def test_the_command_line_says_what_does_not_go_together(arguments, text, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "biotac_mj.discrepancy.trajectories.trajectory.read_trajectories",
        lambda path: [types.SimpleNamespace(electrodes=None)],
    )
    Simulator().save("r.yaml")
    assert cli.main(["diagnose", "measured.h5", *arguments]) == 2
    assert text in capsys.readouterr().err


def test_the_condensed_tier_is_refused():
    with pytest.raises(ValueError, match="need tier='full'"):
        InSkinSimulator(tier="condensed")


@pytest.mark.slow
def test_stiffening_hysteresis_and_place_match_reduced_forms():
    """Force of a press and a retreat: same sign and about the size of the reduced form, whose misses are in
    docs/lab/memory.md."""
    depth = np.array([-0.1, 0.2, 0.4, 0.55, 0.7, 0.85, 1.0, 0.85, 0.7, 0.55, 0.4]) * 1e-3
    t = np.arange(len(depth)) * 0.5
    from biotac_mj.geometry import load_skin

    vert = load_skin("coarse").vert
    surface = vert[(abs(vert[:, 0] + 14e-3) < 2e-3) & (abs(vert[:, 2]) < 2e-3), 1].min()
    pos = np.column_stack([np.full(len(t), -14e-3), surface + depth, np.zeros(len(t))])
    press = Trajectory(
        "a", "sphere_7mm", 0.0, t, pos, np.tile(np.eye(3), (len(t), 1, 1)), np.full((len(t), 19), 2500.0)
    )
    sim = InSkinSimulator()
    plain = sim.run([press], effects=[])[0].normal_force
    assert plain[-1] > 0.05

    def change(effect, **theta):
        return sim.run([press], effects=[(by_id(effect), theta)])[0].normal_force[2:] / plain[2:] - 1

    stiff = change("stiffen", c2=0.3)
    np.testing.assert_allclose(stiff, 0.3 * (depth[2:] / 1.5e-3) ** 2, rtol=0.35)
    place = change("inhomog", along=0.3, across=0.0)
    np.testing.assert_allclose(place, -0.18, atol=0.05)
    loop = change("hyster", fraction=0.1, width=0.2e-3)
    assert 0.05 < loop[4] < 0.15 and loop[8] < -0.03  # deepest; drawn back
    assert (loop[:4] - loop[:4:-1] > 0.03).all()  # in and out at equal depths


@pytest.mark.slow
def test_held_skin_relaxes_as_reduced_and_keeps_a_dent():
    t = np.concatenate([np.linspace(0, 0.8, 5), np.linspace(1.2, 2.8, 5), [2.9, 3.0, 3.1]])
    depth = np.interp(t, [0, 0.8, 2.8, 3.0], [-0.1e-3, 0.8e-3, 0.8e-3, -0.3e-3])
    from biotac_mj.geometry import load_skin

    vert = load_skin("coarse").vert
    surface = vert[(abs(vert[:, 0] + 12e-3) < 2e-3) & (abs(vert[:, 2]) < 2e-3), 1].min()
    pos = np.column_stack([np.full(len(t), -12e-3), surface + depth, np.zeros(len(t))])
    press = Trajectory(
        "a", "sphere_7mm", 0.0, t, pos, np.tile(np.eye(3), (len(t), 1, 1)), np.full((len(t), 19), 2500.0)
    )
    sim = InSkinSimulator()
    effects = [(by_id("relax"), {"g": 0.4, "tau": 0.8})]
    plain, inside = sim.run([press], effects=[])[0], sim.run([press], effects=effects)[0]
    reduced = dataclasses.replace(plain)
    reduced.force, reduced.pressure = plain.force.copy(), plain.pressure.copy()
    effects[0][0].apply(reduced, effects[0][1])
    held = slice(4, 10)
    np.testing.assert_allclose(inside.normal_force[held], reduced.normal_force[held], rtol=0.02)
    assert inside.normal_force[4] > 1.1 * plain.normal_force[4]
    np.testing.assert_allclose(inside.counts[held], plain.counts[held], atol=2)
    assert (
        plain.normal_force[-2] == 0 and abs(inside.counts[-2] - plain.counts[-2]).max() > 5
    )  # the dent heals after the object has gone
    assert abs(inside.counts[-1] - plain.counts[-1]).max() < abs(inside.counts[-2] - plain.counts[-2]).max()
