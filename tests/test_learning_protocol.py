"""The measures that models are judged by, against closed forms and simulation."""

import numpy as np
import pytest

from biotac_mj.learning.protocol import conformal_width, interaction_errors, paired_test, quartiles


def test_errors_are_averaged_within_an_interaction_first():
    truth = np.zeros((5, 19))
    predicted = np.array([1.0, 3, 2, 2, 2])[:, None] * np.ones(19)
    which, error = interaction_errors(predicted, truth, [7, 7, 9, 9, 9])
    np.testing.assert_array_equal(which, [7, 9])
    np.testing.assert_allclose(error, [2, 2])
    predicted[2, 0] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        interaction_errors(predicted, truth, [7, 7, 9, 9, 9])
    with pytest.raises(ValueError, match="test part of the split is empty"):
        interaction_errors(truth[:0], truth[:0], [])
    with pytest.raises(ValueError, match=r"\(n, nelectrode\)"):
        interaction_errors(truth[:, :18], truth, np.zeros(5))


def test_quartiles_are_those_of_the_values():
    assert quartiles([1, 2, 3, 4, 5]) == (3, 2, 4)


def test_intervals_cover_new_interactions_whose_rows_are_alike():
    rng = np.random.default_rng(0)

    def draw(
        count,
    ):  # rows of one interaction share most of their error, so counting rows as independent would be too bold
        size = rng.gamma(2.0, 1.0, count)
        return np.repeat(size, 8)[:, None] * (1 + 0.1 * rng.normal(size=(8 * count, 19))), np.repeat(
            np.arange(count), 8
        )

    covered = []
    for _ in range(40):
        width = conformal_width(*draw(60))
        error, _ = draw(200)
        covered.append((np.abs(error) <= width).mean())
    assert 0.89 < np.mean(covered) < 0.95
    assert np.isinf(conformal_width(*draw(5))).all()  # five interactions cannot promise 90 %


def test_paired_test_sees_what_medians_hide():
    rng = np.random.default_rng(0)
    hard = rng.gamma(2, 10, 40)
    test = paired_test(hard, hard + rng.uniform(0.1, 1.0, 40))
    assert test["better"] == 1 and test["p"] < 1e-6 and test["n"] == 40 and -1 < test["median_difference"] < 0
    assert paired_test(hard, hard)["p"] == 1
    swapped = rng.permutation(40) < 20
    assert paired_test(hard, hard + np.where(swapped, 1, -1) * rng.uniform(0.5, 1, 40))["p"] > 0.05
    with pytest.raises(ValueError, match="at least five"):
        paired_test([1, 2], [1, 2])


@pytest.fixture
def claim(repo, monkeypatch):
    pytest.importorskip("torch")
    monkeypatch.syspath_prepend(str(repo / "benchmarks"))
    import claim

    return claim


def test_nobody_sees_what_judges_the_claim(claim):
    objects = np.tile(["ring_7mm", "cube_14mm", "sphere_7mm"], 400)
    sensor = (np.arange(1200) >= 1100).astype(int)
    found = claim.members(objects, sensor, ["trajectory", "ring_7mm"])
    assert len(found) == 10 and set(found[0].judge) == {"trajectory", "sensor"}
    for one in found:
        parts = [one.train, one.choose, one.unpaired, *one.judge.values()]
        every = np.concatenate(parts)
        assert len(np.unique(every)) == len(every) and len(one.train) == 258 and len(one.choose) == 65
        assert (sensor[np.concatenate(parts[:3])] == 0).all()
        if one.split != "trajectory":
            assert (objects[one.judge[one.split]] == one.split).all()
            assert one.split not in objects[np.concatenate(parts[:3])]


def test_only_what_was_measured_has_labels_in_the_claim(claim):
    objects, sensor = np.tile(["ring_7mm", "cube_14mm", "sphere_7mm"], 400), np.zeros(1200, int)
    measured = np.arange(1200) % 2 == 0
    for one in claim.members(objects, sensor, ["trajectory"], measured):
        assert len(one.train) == 258 and measured[one.train].all() and measured[one.choose].all()
        assert not measured[one.unpaired].all()
