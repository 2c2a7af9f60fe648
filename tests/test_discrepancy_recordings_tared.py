"""Logs from which the rest was subtracted, with and without their sign: what they can tell is told, what they
cannot is left out by name."""

import json

import numpy as np
import pytest
import yaml
from logs import RATE, noisy, pressed

from biotac_mj.discrepancy import diagnose_recording, read_recording
from biotac_mj.discrepancy.report.files import write_report
from biotac_mj.discrepancy.report.text import summary
from biotac_mj.recordings.recording import with_baseline


def log(tmp_path, values):
    path = tmp_path / "e.txt"
    np.savetxt(path, values, "%.6g")
    return read_recording(path, rate=RATE)


@pytest.mark.parametrize(
    ("rest", "unit"),
    [
        pytest.param(lambda x: x[0], "tared counts", marks=pytest.mark.slow),
        (lambda x: x[:100].mean(0), "tared counts"),
        pytest.param(lambda x: x[0], "tared counts without sign", marks=pytest.mark.slow),
    ],
)
def test_a_jump_is_told_whatever_was_subtracted(tmp_path, rest, unit):
    """120 counts of e4 from 20 s on, under a load; nothing without it."""
    e, _, _ = pressed(8, 40)
    found = []
    for jump in (0, 120):
        x = e.copy()
        x[2000:, 3] += jump
        x = noisy(x, np.random.default_rng(1))
        x = x - rest(x)
        r = log(tmp_path, np.abs(x) if unit.endswith("sign") else x)
        assert r.unit == unit and not r.absolute and r.signed != unit.endswith("sign")
        assert (r.electrodes == np.rint(r.electrodes)).all() and np.ptp(r.electrodes) < 4095
        found.append(diagnose_recording(r))
    assert not found[0].findings, found[0].verdict
    (named,) = found[1].findings
    assert (named.id, named.channels) == ("drift", (3,)) and abs(named.start - 20) < 0.5


@pytest.mark.slow  # quick: a jump is told whatever was subtracted
def test_what_a_tared_log_cannot_tell_is_said(tmp_path):
    """The report names it, the amended sensor has no rest that nobody measured."""
    e, _, rng = pressed(8, 40)
    x = noisy(e, rng)
    d = diagnose_recording(log(tmp_path, x - x[0]))
    write_report(d, tmp_path)
    verdict = json.loads((tmp_path / "verdict.json").read_text())
    (line,) = (line for line in verdict["cannot_be_known"] if "rest is assumed" in line)
    assert "common gain in counts" in line and line in summary(d)
    assert "rest" not in yaml.safe_load((tmp_path / "sensor_amended.yaml").read_text())["sensor"]
    unsigned, raw = (diagnose_recording(log(tmp_path, y)).notes for y in (np.abs(x - x[0]), x))
    assert any("no sign: liquid lost" in line for line in unsigned)
    assert not any("no sign" in line or "rest is assumed" in line for line in raw)


def test_values_are_put_where_all_of_them_fit():
    """Changes stay what they were, to the count where a mean of whole counts was subtracted."""
    rng = np.random.default_rng(0)
    counts = rng.integers(100, 4000, (500, 19)).astype(float)
    tared = counts - rng.uniform(1000, 3000, 19)
    put = with_baseline(tared)
    np.testing.assert_array_equal(np.diff(put, axis=0), np.diff(counts, axis=0))
    assert put.min() >= 1 and put.max() <= 4094 and (put == np.rint(put)).all()
    smooth = np.cumsum(rng.standard_normal((500, 19)), axis=0)
    np.testing.assert_allclose(np.diff(with_baseline(smooth), axis=0), np.diff(smooth, axis=0), atol=1e-9)


@pytest.mark.slow
def test_states_are_not_fitted_to_a_rest_that_is_assumed(tmp_path):
    e, _, rng = pressed(8, 40)
    x = noisy(e, rng)
    np.savetxt(tmp_path / "e.txt", x - x[0], "%d")
    np.savetxt(tmp_path / "f.txt", np.ones((len(x), 3)), "%d")
    with pytest.raises(ValueError, match="--simulate needs raw counts"):
        _verb(tmp_path)


def _verb(folder):
    import argparse

    from biotac_mj.discrepancy.verbs import diagnose_verb

    names = "data force tdc rate object skin material options effects repeatability in_skin locked".split()
    names.append("earlier")
    names += ["protocol", "which"]
    args = argparse.Namespace(**dict.fromkeys(names), also=None, simulate=True, quiet=True, out=str(folder))
    args.electrodes, args.force = str(folder / "e.txt"), str(folder / "f.txt")
    diagnose_verb(args)
