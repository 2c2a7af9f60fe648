"""Recordings with hidden effects by a second author, on a synthetic base: independent, seen, reproducible."""

import ast
import dataclasses
import importlib
import pathlib
import sys

import numpy as np
import pytest

BENCHMARKS = pathlib.Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def second():
    sys.path.insert(0, str(BENCHMARKS))
    yield importlib.import_module("authors.second")
    sys.path.remove(str(BENCHMARKS))


@pytest.fixture(scope="module")
def sources(second):
    """Synthetic: three smooth loads, of which each electrode has a share, a slow rise, noise of 3 counts."""

    def base(rng):
        n, rate = 3000, 100.0
        t = np.arange(n) / rate
        loads = np.stack(
            [np.sin(2 * np.pi * f * t + p) ** 2 for f, p in ((0.05, 0), (0.08, 1), (0.12, 2))], 1
        )
        counts = np.linspace(2500, 3300, 19) - loads @ rng.uniform(-150, 350, (3, 19))
        counts += 20 * t[:, None] / t[-1]
        force = loads @ rng.uniform(-2, 2, (3, 3)) + 0.02 * rng.standard_normal((n, 3))
        counts = np.rint(counts + 3 * rng.standard_normal(counts.shape))
        return second.Case("press", counts, rate, force, np.rint(2000 - 40 * t / 30), True)

    return dict.fromkeys(("press", "still"), base)


def _forms(second):
    return [(effect, i) for effect, spec in second.EFFECTS.items() for i in range(len(spec.forms))]


def test_it_imports_nothing_of_what_it_judges_and_no_form_of_the_first():
    path = BENCHMARKS / "authors/second.py"
    assert "biotac_mj" not in path.read_text()
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [(a.name.split(".")[0], "") for a in node.names]
        elif isinstance(node, ast.ImportFrom):
            names += [(node.module.split(".")[0], a.name) for a in node.names]
    outside = {module for module, _ in names} - set(sys.stdlib_module_names)
    assert outside == {"numpy", "scipy", "first"}
    vocabulary = {"ACCEPTED", "NATURAL", "OUTSIDE", "SINGLE", "Case", "Effect", "_counts", "_table", "_z"}
    assert {name for module, name in names if module == "first"} == vocabulary


def test_every_effect_of_the_first_has_three_other_forms(second):
    first = importlib.import_module("authors.first")
    assert set(first.EFFECTS) <= set(second.EFFECTS)
    assert all(len(spec.forms) >= 3 for spec in second.EFFECTS.values())
    assert sum(len(second.EFFECTS[e].forms) for e in second.OUTSIDE) >= 6


@pytest.mark.slow
def test_every_form_changes_its_electrodes_and_does_so_again_from_the_same_seed(second, sources):
    for effect, form in _forms(second):
        case, clean = second.make(sources, "press", (effect,), form)
        again, clean_again = second.make(sources, "press", (effect,), form)
        assert case.truth == [effect] and case.forms == [form] and case.seen[0] >= second.LEAST, effect
        assert np.array_equal(case.counts, again.counts) and np.array_equal(clean, clean_again), effect
        assert np.array_equal(case.force, again.force) and case.channels == again.channels, effect
        assert case.counts.min() >= 0 and case.counts.max() <= 4095 and np.isfinite(case.force).all(), effect
        assert len(case.force) == len(case.counts), effect
        if effect in ("relax", "hyster"):
            assert np.array_equal(case.counts, clean), effect
        elif len(case.counts) == len(clean):
            changed = np.flatnonzero((case.counts != clean).any(0))
            assert len(changed) and set(changed) <= set(case.channels[0]), (effect, form)
        other, _ = second.make(sources, "press", (effect,), form + len(second.EFFECTS[effect].forms))
        assert other.counts.shape != case.counts.shape or not np.array_equal(other.counts, case.counts)


def test_a_change_is_as_visible_as_it_is_large(second, sources):
    before = sources["press"](np.random.default_rng(0)).counts
    assert second.visible(before, before) == 0
    drift = np.zeros_like(before)
    drift[:, 4] = np.linspace(0, 30, len(before))
    seen = [second.visible(before, before + k * drift) for k in (1, 2, 20)]
    assert seen[1] == pytest.approx(2 * seen[0]) and seen[0] > second.LEAST
    # the same slow change of all electrodes is less beside the recording's own
    rise = np.repeat(drift[:, [4]], 19, axis=1)
    assert second.visible(before, before + rise, gradual=True) < second.visible(before, before + rise)


def test_the_plan_is_balanced_and_makes_pairs(second, sources):
    cases = second.plan(9, 5, 20)
    outside = [c for c in cases if set(c[1]) & second.OUTSIDE]
    assert len(set(cases)) == len(cases)
    assert sum(not c[1] for c in cases) >= 40 and sum(len(c[1]) == 2 for c in cases) >= 20
    assert sum(len(c[1]) == 1 for c in cases) - len(outside) >= 96 and len(outside) >= 16
    used = {(c[1][0], c[2] % len(second.EFFECTS[c[1][0]].forms)) for c in cases if len(c[1]) == 1}
    assert used == set(_forms(second))
    for _, pair, seed in [c for c in cases if len(c[1]) == 2][:4]:
        case, _ = second.make(sources, "press", pair, seed)
        assert set(case.truth) == set(pair) and min(case.seen) >= second.LEAST
    null, clean = second.make(sources, "still", (), 0)
    assert np.array_equal(null.counts, clean) and null.truth == []


def test_a_change_that_cannot_be_seen_is_an_error(second, sources, monkeypatch):
    monkeypatch.setitem(second.EFFECTS, "hum", second.Effect((lambda c, rng, size: [],)))
    with pytest.raises(
        ValueError, match=r"no draw of \('hum',\) can be seen on 'press': give it another base"
    ):
        second.make(sources, "press", ("hum",), 0)


def test_the_third_author_shares_a_case_and_nothing_else(second):
    text = (BENCHMARKS / "authors/third.py").read_text()
    assert "biotac_mj" not in text and ".second" not in text
    third = importlib.import_module("authors.third")
    cases = third.plan(2)
    assert len(cases) == len(set(cases)) == 220 and cases[:110] == third.plan()
    assert {e for _, effects, _ in cases for e in effects} == set(third.EFFECTS) <= set(second.ACCEPTED)


def test_the_fourth_author_shares_nothing(second):
    text = (BENCHMARKS / "authors/fourth.py").read_text()
    assert "biotac_mj" not in text and "import recordings" not in text and "from recordings" not in text
    fourth = importlib.import_module("authors.fourth")
    assert len({fourth.name(entry) for entry in fourth.PLAN}) == len(fourth.PLAN) == 141
    used = {pair for _, effects, _ in fourth.PLAN for pair in effects}
    assert used == {(kind, form) for kind, forms in fourth.EFFECTS.items() for form in range(len(forms))}
    assert {kind for kind, _ in used} <= set(second.ACCEPTED)


def test_the_fifth_author_shares_nothing(second):
    text = (BENCHMARKS / "authors/fifth.py").read_text()
    assert "biotac_mj" not in text and "import recordings" not in text and "from recordings" not in text
    fifth = importlib.import_module("authors.fifth")
    plan = fifth.plan()
    assert len({piece["id"] for piece in plan}) == len(plan) == 153
    assert {kind for piece in plan for kind, _ in piece["effects"]} == set(fifth.LAWS) <= set(second.ACCEPTED)


def test_the_seventh_author_shares_nothing(second):
    text = (BENCHMARKS / "authors/seventh.py").read_text()
    assert "biotac_mj" not in text and "import recordings" not in text and "from recordings" not in text
    seventh = importlib.import_module("authors.seventh")
    assert set(seventh.KINDS) == set(seventh.LAWS) and set(seventh.KINDS.values()) <= set(second.ACCEPTED)
    jobs = seventh._jobs()
    assert len(jobs) == 224
    kinds = {kind for group, effects, _ in jobs if group in ("single", "pair") for kind, _ in effects}
    assert kinds == set(seventh.LAWS)
    outside = {effects[0][0].removesuffix("2") for group, effects, _ in jobs if group == "outside"}
    assert outside == {name.removesuffix("2") for name in seventh.OUTSIDE}


def test_the_seventh_authors_effects_change_their_electrodes_alone(second):
    seventh = importlib.import_module("authors.seventh")
    rng = np.random.default_rng(0)
    t = np.arange(3000) / 100
    load = np.sin(2 * np.pi * 0.2 * t) ** 2  # synthetic
    x = np.rint(2500 + np.outer(load, rng.uniform(-400, 800, 19)) + 3 * rng.standard_normal((3000, 19)))
    for kind, forms in seventh._SINGLES.items():
        for form, _ in forms:
            p = seventh._Piece(
                "F1", x.copy(), x.copy(), t, 100.0, np.full(19, 2500.0), np.zeros(3000, bool), None, None, []
            )
            p.force, p.tdc = np.outer(load, [0.1, 0.2, -2.0]), np.linspace(2000, 1960, 3000)
            channels = seventh.LAWS[kind](p, np.random.default_rng(1), form)
            if kind == "lost_samples":
                assert len(p.x) < 3000 and len(p.gaps) and len(p.time) == len(p.x), form
                continue
            changed = set(np.flatnonzero((np.abs(p.x - x) > 1e-9).any(0)))
            assert changed and changed <= {int(k) for k in channels}, (kind, form)


def test_the_eighth_author_shares_nothing(second):
    text = (BENCHMARKS / "authors/eighth.py").read_text()
    assert "biotac_mj" not in text and "import recordings" not in text and "from recordings" not in text
    eighth = importlib.import_module("authors.eighth")
    assert set(eighth.KINDS) == set(eighth.LAWS) and set(eighth.KINDS.values()) <= set(second.ACCEPTED)
    plan = eighth.plan()
    assert len({spec.name for spec in plan}) == len({spec.seed for spec in plan}) == len(plan) == 222
    used = {kind for spec in plan for kind, *_ in spec.effects}
    assert used == set(eighth.LAWS) | set(eighth.OUTSIDE)


def test_the_eighth_authors_effects_change_their_electrodes_alone(second):
    eighth = importlib.import_module("authors.eighth")
    rng = np.random.default_rng(0)
    t = np.arange(3000) / 100
    load = np.sin(2 * np.pi * 0.2 * t) ** 2  # synthetic
    rest = np.linspace(2400.0, 2600.0, 19)
    x = np.rint(rest + np.outer(load, rng.uniform(-400, 800, 19)) + 3 * rng.standard_normal((3000, 19)))
    force, tdc = np.outer(load, [0.1, 0.2, -2.0]), np.linspace(2000, 1960, 3000)
    source = eighth._Source(x, t, 100.0, rest, force, tdc)
    for spec in eighth.plan():
        if spec.outside or len(spec.effects) != 1:
            continue
        ((kind, form, sizes),) = spec.effects
        p = eighth._Piece(source, 0, 3000, True, True, np.random.default_rng(1), None)
        channels = eighth.LAWS[kind](p, form, **sizes)
        if kind == "lost_samples":
            assert len(p.x) < 3000 and len(p.gaps) and len(p.time) == len(p.force) == len(p.x), form
            continue
        if len(p.x) == 3000:
            changed = set(np.flatnonzero((np.abs(p.x - x) > 1e-9).any(0)))
            assert changed and changed <= {int(k) for k in channels}, (kind, form)


def test_the_ninth_author_shares_nothing(second):
    text = (BENCHMARKS / "authors/ninth.py").read_text()
    assert "biotac_mj" not in text and "import recordings" not in text and "from recordings" not in text
    ninth = importlib.import_module("authors.ninth")
    assert set(ninth.KINDS) == set(ninth.LAWS) and set(ninth.KINDS.values()) <= set(second.ACCEPTED)
    plan = ninth.plan()
    assert len({spec.name for spec in plan}) == len({spec.drawn for spec in plan}) == len(plan) == 193
    used = {kind for spec in plan for kind, _ in spec.effects}
    assert used == set(ninth.LAWS) | set(ninth.OUTSIDE)


def test_the_ninth_authors_effects_change_their_electrodes_alone(second):
    ninth = importlib.import_module("authors.ninth")
    rng = np.random.default_rng(0)
    t = np.arange(3000) / 100
    load = np.sin(2 * np.pi * 0.2 * t) ** 2  # synthetic
    x = np.rint(2500 + np.outer(load, rng.uniform(-400, 800, 19)) + 3 * rng.standard_normal((3000, 19)))
    force, tdc = np.outer(load, [0.1, 0.2, -2.0]), np.linspace(2000, 1960, 3000)
    source = ninth._Source(x, t, 100.0, force, tdc)
    for spec in ninth.plan():
        if spec.outside or len(spec.effects) != 1:
            continue
        ((kind, form),) = spec.effects
        p = ninth._Piece(source, 0, 3000, True, spec.stream())
        channels = ninth.LAWS[kind](p, form)
        if kind == "lost_samples":
            assert len(p.x) < 3000 and len(p.gaps) and len(p.time) == len(p.force) == len(p.x), form
            continue
        changed = set(np.flatnonzero((np.abs(p.x - x) > 1e-9).any(0)))
        assert changed and changed <= {int(k) for k in channels}, (kind, form)


def test_a_piece_of_the_ninth_author_begins_where_the_author_was(second):
    """The stream of the whole plan and that of a piece agree, with the half of a number left over."""
    ninth = importlib.import_module("authors.ninth")
    author = np.random.default_rng(ninth._SEED)
    author.random(264)
    author.integers(0, 10)
    spec = dataclasses.replace(ninth.plan()[0], drawn=(265, author.bit_generator.state["uinteger"]))
    assert np.array_equal(author.integers(0, 1000, 5), spec.stream().integers(0, 1000, 5))


def test_the_tenth_author_shares_nothing(second):
    text = (BENCHMARKS / "authors/tenth.py").read_text()
    assert "biotac_mj" not in text and "import recordings" not in text and "from recordings" not in text
    tenth = importlib.import_module("authors.tenth")
    assert set(tenth.KINDS) == set(tenth.LAWS) and set(tenth.KINDS.values()) <= set(second.ACCEPTED)
    plan = tenth.plan()
    assert len({spec.name for spec in plan}) == len({spec.drawn for spec in plan}) == len(plan) == 197
    used = {kind for spec in plan for kind, _ in spec.effects}
    assert used == set(tenth.LAWS) | set(tenth.OUTSIDE)


def test_the_tenth_authors_effects_change_their_electrodes_alone(second):
    tenth = importlib.import_module("authors.tenth")
    rng = np.random.default_rng(0)
    t = np.arange(3000) / 100
    load = np.sin(2 * np.pi * 0.2 * t) ** 2  # synthetic
    x = np.rint(2500 + np.outer(load, rng.uniform(-400, 800, 19)) + 3 * rng.standard_normal((3000, 19)))
    force, tdc = np.outer(load, [0.1, 0.2, -8.0]), np.linspace(2000, 1960, 3000)
    source = tenth._Source(x, t, 100.0, force, tdc, np.full(x.shape, 2500.0))
    for spec in tenth.plan():
        if spec.outside or len(spec.effects) != 1:
            continue
        ((kind, form),) = spec.effects
        p = tenth._Piece(source, spec.base.removesuffix("+f").split("/")[0], 0, 3000, True, spec.stream())
        channels = tenth.LAWS[kind](p, form)
        if kind == "lost_samples":
            assert len(p.x) < 3000 and len(p.gaps) and len(p.time) == len(p.force) == len(p.x), form
            continue
        changed = set(np.flatnonzero((np.abs(p.x - x) > 1e-9).any(0)))
        assert changed and changed <= {int(k) for k in channels}, (kind, form)


def test_the_eleventh_author_shares_nothing(second):
    text = (BENCHMARKS / "authors/eleventh.py").read_text()
    assert "biotac_mj" not in text and "import recordings" not in text and "from recordings" not in text
    eleventh = importlib.import_module("authors.eleventh")
    assert set(eleventh.KINDS) == set(eleventh.LAWS)
    assert set(eleventh.KINDS.values()) <= set(second.ACCEPTED)
    plan = eleventh.plan()
    assert len({spec.name for spec in plan}) == len(plan) == 171
    used = {kind for spec in plan for kind, _ in spec.effects}
    assert used == set(eleventh.LAWS) | set(eleventh.OUTSIDE)


def test_the_eleventh_authors_effects_change_their_electrodes_alone(second):
    eleventh = importlib.import_module("authors.eleventh")
    rng = np.random.default_rng(0)
    t = np.arange(3200) / 100
    load = np.sin(2 * np.pi * 0.2 * t) ** 2  # synthetic
    x = np.rint(2500 + np.outer(load, rng.uniform(-400, 800, 19)) + 3 * rng.standard_normal((3200, 19)))
    force, tdc = np.outer(load, [0.1, 0.2, -8.0]), np.linspace(2000, 1960, 3200)
    source = eleventh._Source(x, t, 100.0, force, tdc, np.full(19, 2500.0))
    for spec in eleventh.plan():
        if spec.outside or len(spec.effects) != 1:
            continue
        ((kind, form),) = spec.effects
        p = eleventh._Piece(source, 200, 3000, True, spec.stream())
        channels = eleventh.LAWS[kind](p, form)
        rows = p.log()
        if kind == "lost_samples":
            assert len(rows) < 3000 and len(p.gaps) and len(p.time) == len(p.force) == len(rows), form
            continue
        changed = set(np.flatnonzero((rows != x[200:]).any(0)))
        assert changed and changed <= set(channels), (kind, form)


def test_the_twelfth_author_shares_nothing(second):
    text = (BENCHMARKS / "authors/twelfth.py").read_text()
    assert "biotac_mj" not in text and "import recordings" not in text and "from recordings" not in text
    twelfth = importlib.import_module("authors.twelfth")
    assert set(twelfth.KINDS) == set(twelfth.LAWS)
    assert set(twelfth.KINDS.values()) <= set(second.ACCEPTED)
    plan = twelfth.plan()
    assert len({spec.name for spec in plan}) == len(plan) == 178
    used = {kind for spec in plan for kind, _ in spec.effects}
    assert used == set(twelfth.LAWS) | set(twelfth.OUTSIDE)


def test_the_twelfth_authors_effects_change_their_electrodes_alone(second):
    twelfth = importlib.import_module("authors.twelfth")
    rng = np.random.default_rng(0)
    t = np.arange(3200) / 100
    load = np.sin(2 * np.pi * 0.2 * t) ** 2  # synthetic
    x = np.rint(2500 + np.outer(load, rng.uniform(-400, 800, 19)) + 3 * rng.standard_normal((3200, 19)))
    force, tdc = np.outer(load, [0.1, 0.2, -8.0]), np.linspace(2000, 1960, 3200)
    source = importlib.import_module("authors.sources").Source(x, t, 100.0, force, tdc, np.full(19, 2500.0))
    for spec in twelfth.plan():
        if spec.outside or len(spec.effects) != 1:
            continue
        ((kind, form),) = spec.effects
        p = twelfth._Piece(source, 200, 3000, True, 2, spec.stream())
        channels = twelfth.LAWS[kind](p, form)
        if kind == "lost_samples":
            assert 2000 < len(p.kept) < 3000, form
            continue
        # an end that all share is said of those that meet it in more than 2 % of the rows
        rows = 0.021 * p.n if kind == "saturation" and form in ("top", "sag") else 0
        changed = set(np.flatnonzero((twelfth.written(p) != x[200:]).sum(0) > rows))
        assert changed and changed <= set(channels), (kind, form)


def test_the_thirteenth_author_shares_nothing(second):
    text = (BENCHMARKS / "authors/thirteenth.py").read_text()
    assert "biotac_mj" not in text and "import recordings" not in text and "from recordings" not in text
    thirteenth = importlib.import_module("authors.thirteenth")
    assert set(thirteenth.KINDS.values()) <= set(second.ACCEPTED)
    plan = thirteenth.plan()
    assert len({spec.name for spec in plan}) == len(plan) == 180
    assert sum(not spec.kinds for spec in plan) == 40
    used = {kind for spec in plan for kind, _ in spec.effects}
    assert used == set(thirteenth.LAWS) | set(thirteenth.OUTSIDE)


def test_the_observer_sees_a_drift_the_better_the_larger_it_is(second):
    observer = importlib.import_module("recordings_observer")
    rng, t = np.random.default_rng(0), np.arange(6000) / 100
    load = np.stack([np.sin(2 * np.pi * f * t + p) for f, p in ((0.21, 0), (0.33, 1), (0.5, 2))], 1)
    x = np.rint(
        2500 + load @ rng.uniform(-300, 300, (3, 19)) + 3 * rng.standard_normal((6000, 19))
    )  # synthetic
    seen = []
    for size in (2, 20):
        drifting = x.copy()
        drifting[:, 4] += size * np.linspace(0, 1, 6000) ** 2
        seen.append(observer.detectable(np.rint(drifting), x, None, 100.0))
    assert seen[1] > 2 * seen[0] > 2 * observer.SEEN
    assert observer.detectable(x, x, None, 100.0) == 0
