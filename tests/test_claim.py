"""A mesh VAE of the paper's comparison trains until it is flat, and goes on where it was stopped."""

import pathlib
import sys

import pytest

torch = pytest.importorskip("torch", reason="needs torch: pip install biotac_mj[learning]")


@pytest.fixture
def claim(monkeypatch):
    monkeypatch.syspath_prepend(str(pathlib.Path(__file__).parent.parent / "benchmarks"))
    import claim

    yield claim
    sys.modules.pop("claim", None)


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


def test_it_ends_when_the_error_no_longer_falls(claim, tmp_path, monkeypatch):
    monkeypatch.setattr(claim, "RATES", (1e-2, 3e-3, 1e-3))
    found, _ = _training(claim, tmp_path)
    assert found["converged"] and found["ended"] == ["flat"] * 3
    errors = [error for _, _, error in found["curve"]]
    assert min(errors) == pytest.approx(0.5, abs=5e-3)
    assert found["validation_mm"] == pytest.approx(min(errors), abs=1e-4)
    # no rate ended while the error still fell: over its last checks it did not come below 99 % of what it was
    first = [error for _, rate, error in found["curve"] if rate == 1e-2]
    assert min(first[-claim.PATIENCE :]) >= claim.GAIN * min(first[: -claim.PATIENCE])
    assert first[0] > 1.0
    (tmp_path / "short").mkdir()
    short, _ = _training(claim, tmp_path / "short", seconds=0.0)
    assert short["ended"] == ["time"] * 3 and not short["converged"]


def test_it_goes_on_where_it_was_stopped(claim, tmp_path, monkeypatch):
    monkeypatch.setattr(claim, "RATES", (1e-2, 3e-3, 1e-3))
    (tmp_path / "a").mkdir(), (tmp_path / "b").mkdir()
    whole, weights = _training(claim, tmp_path / "a")
    with pytest.raises(KeyboardInterrupt):
        _training(claim, tmp_path / "b", stop=3)
    again, same = _training(claim, tmp_path / "b")
    assert again["curve"] == whole["curve"]
    for one, other in zip(weights, same, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("splits", [("ring_7mm", "cube_14mm"), ("trajectory",), ("trajectory", "ring_7mm")])
def test_no_row_waits_for_mesh_vaes_that_nobody_asked_for(claim, splits):
    names = list(claim.jobs(splits, claim.CURVE, 1.0))
    assert {n for n in names if n.startswith("mesh_vae")} == {f"mesh_vae {s}" for s in splits}
    of_code = [n for n in names if n.startswith("latent_vae")]
    needed = {s for n in of_code for s in claim._of_row(splits, n)}
    assert needed == set(splits) and all(claim._of_row(splits, n) for n in of_code)
    assert any("labels" in n for n in names) == ("trajectory" in splits)
