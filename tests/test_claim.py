"""The paper's comparison: its mesh VAE trains until it is flat, and a run goes on where it was stopped."""

import pathlib
import sys
import types

import numpy as np
import pytest

from biotac_mj.geometry import load_skin

torch = pytest.importorskip("torch", reason="needs torch: pip install biotac_mj[learning]")

SMALL = dict(mesh_channels=(4,) * 4, mesh_first=4, mesh_last=4, mesh_hidden=8, mesh_latent=8, pod=8)


@pytest.fixture(scope="module")
def claim():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(pathlib.Path(__file__).parent.parent / "benchmarks"))
        import claim

        patch.setattr(claim, "RATES", (1e-2, 3e-3, 1e-3))
        yield claim
    sys.modules.pop("claim", None)


@pytest.fixture(scope="module")
def whole(claim, tmp_path_factory):
    """A training that is not stopped."""
    return _training(claim, tmp_path_factory.mktemp("whole"))


def _training(claim, folder, seconds=600.0, stop=None):
    """A line through a point, whose error falls to nothing it can do about: 0.5."""
    torch.manual_seed(0)
    net = torch.nn.Linear(1, 1)
    x = torch.linspace(-1, 1, 64)[:, None]
    seen = []

    def said(found):
        seen.append(found)
        if stop is not None and len(seen) == stop:
            raise KeyboardInterrupt

    found = claim.converge(
        net,
        lambda r: (net(x[r]) - 3 * x[r]).square().mean(),
        torch.arange(64),
        lambda: 0.5 + (net(x) - 3 * x).abs().mean(),
        16,
        seconds,
        folder / "state.pt",
        said,
        every=200,
    )
    return found, [p.detach().clone() for p in net.parameters()]


def test_it_ends_when_the_error_no_longer_falls(claim, whole, tmp_path):
    found, _ = whole
    assert found["converged"] and found["ended"] == ["flat"] * 3
    errors = [error for _, _, error in found["curve"]]
    assert min(errors) == pytest.approx(0.5, abs=5e-3)
    assert found["validation_mm"] == pytest.approx(min(errors), abs=1e-4)
    # no rate ended while the error still fell: over its last checks it did not come below 99 % of what it was
    first = [error for _, rate, error in found["curve"] if rate == 1e-2]
    assert min(first[-claim.PATIENCE :]) >= claim.GAIN * min(first[: -claim.PATIENCE])
    assert first[0] > 1.0
    short, _ = _training(claim, tmp_path, seconds=0.0)
    assert short["ended"] == ["time"] * 3 and not short["converged"]


def test_it_goes_on_where_it_was_stopped(claim, whole, tmp_path):
    found, weights = whole
    with pytest.raises(KeyboardInterrupt):
        _training(claim, tmp_path, stop=3)
    again, same = _training(claim, tmp_path)
    assert again["curve"] == found["curve"]
    for one, other in zip(weights, same, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("splits", [("ring_7mm", "cube_14mm"), ("trajectory",), ("trajectory", "ring_7mm")])
def test_mesh_vaes_come_first_and_only_those_that_rows_need(claim, splits):
    every = {f"mesh_vae {s}" for s in splits}
    vaes, rows = claim.wanted(splits, None, set(), set())
    assert set(vaes) == every and set(rows) == set(claim.jobs(splits))
    of_code = [n for n in rows if n.startswith("latent_vae")]
    assert {s for n in of_code for s in claim.of_row(splits, n)} == set(splits)
    assert claim.wanted(splits, "pointnet|local", set(), set())[0] == []
    assert claim.wanted(splits, "mesh_vae", set(), set()) == (vaes, [])
    vaes, rows = claim.wanted(splits, "latent_vae", {of_code[0]}, {f"mesh_vae {splits[0]}"})
    assert set(vaes) <= every - {f"mesh_vae {splits[0]}"} and set(rows) == set(of_code[1:])


@pytest.mark.slow  # a script of benchmarks/: quick are its parts
def test_a_run_has_every_row_and_goes_on(claim, tmp_path, monkeypatch):
    """Synthetic: 30 touches that mean nothing, networks of two steps; a row that is there stays."""
    from biotac_mj.learning.training.arrays import Arrays

    rng, n = np.random.default_rng(0), 120
    geometry = load_skin("coarse")
    owner = torch.arange(n) // 4
    first = 4 * owner
    depth = (torch.arange(n) % 4).float()
    field = depth[:, None, None] * torch.tensor(rng.normal(0, 0.01, (n, geometry.nvert, 3))).float()
    counts = 2500 + depth[:, None] * torch.tensor(rng.normal(0, 20, (n, 19))).float()
    arrays = Arrays(
        field, owner, first, depth, np.tile(["ring_7mm", "cube_14mm", "sphere_7mm"], 10), np.ones(30, bool),
        counts, counts[first], counts, torch.zeros(n, 3), np.arange(3), geometry,
    )  # fmt: skip
    here = lambda work, tasks, folder, *_, **__: work((t.value for t in tasks), folder, print)  # noqa: E731
    monkeypatch.setattr(claim, "run_tasks", here)
    monkeypatch.setattr(claim, "SEEDS", (0, 1))
    monkeypatch.setattr(claim, "DROPOUT", (0.1,))
    options = types.SimpleNamespace(
        json=tmp_path / "out.json", device="cpu", devices=None, seconds=600.0, vae_seconds=11.0, steps=2,
        splits=["trajectory", "ring_7mm"], workers=1, keep=tmp_path / "kept", only=None,
    )  # fmt: skip
    config = claim.LearningConfig(**SMALL)
    found = claim.run(arrays, np.zeros(30, int), options, config)
    rows = set(claim.jobs(tuple(options.splits)))
    assert set(found["rows"]) == rows | {"mesh_vae trajectory", "mesh_vae ring_7mm"}
    judged = found["rows"]["latent_vae decoded objects"]["found"][""]["ring_7mm"]
    assert set(judged) == {"0", "1"} and len(judged["0"]) == 10
    text = claim.table(found)
    assert "unseen ring_7mm: 10 interactions" in text and "mesh VAE, trajectory: " in text
    assert " against pointnet dropout " in text
    before = options.json.read_text()
    claim.run(arrays, np.zeros(30, int), options, config)
    assert options.json.read_text() == before
