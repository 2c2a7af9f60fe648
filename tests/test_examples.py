"""The examples run headless and end with the right physics; the README shows the code that runs."""

import importlib.util

import numpy as np
import pytest
from blocks import four_nodes

from biotac_mj.view import find_gl


def load(repo, name):
    spec = importlib.util.spec_from_file_location(name, repo / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow  # the README's lines are these
def test_quickstart_ball_rests_on_the_pad(repo):
    model, data = load(repo, "quickstart").main(seconds=0.4, skin="coarse")
    # a ball at rest: the skin carries its weight, 0.1 kg x 9.81 m/s^2; the pad is -y of the BioTac
    assert np.allclose(data.sensor("biotac_contact_force").data[1], 0.981, rtol=0.01)
    electrodes = data.sensor("biotac_electrodes").data
    assert (
        electrodes.shape == (19,)
        and (electrodes == electrodes.round()).all()
        and (electrodes > 0).all()
        and (electrodes < 4096).all()
    )


def test_the_example_of_a_press_feels_it(repo):
    record = load(repo, "press").main(skin="coarse", depth=0.5e-3)
    # the force opposes the press, which points inwards at 0.3 rad around the finger
    inwards = np.array([0, np.cos(0.3), -np.sin(0.3)])
    assert record.force[-1] @ inwards < -0.05
    # far above the noise of at most 7 counts
    change = np.abs(record.electrode_change[-1])
    assert change.max() > 20


def test_lines_of_the_readme_run_as_they_stand(repo, capsys):
    """A ball of 100 g at rest on the pad, whose weight is read."""
    code = (repo / "README.md").read_text().split("```python\n")[1].split("```")[0]
    attached = 'skin="coarse", tier="condensed")'
    assert code.count(attached) == 1
    code = code.replace(attached, "skin=SKIN)")  # as it stands: test_documents.py
    names = {"SKIN": four_nodes("coarse")}
    exec(code, names)
    force = names["finger"].read(names["data"], "contact_force")[:3]
    assert np.isclose(force[1], 0.1 * 9.81, rtol=0.01)
    assert "force on the BioTac [N]: [" in capsys.readouterr().out


def test_many_at_once_are_what_each_is_alone(repo):
    """rollout and batch agree to the bit; deeper presses change more."""
    example = load(repo, "many_at_once")
    whole, stepwise = example.main(count=3, threads=2)
    assert np.array_equal(whole, stepwise)
    alone, _ = example.main(count=3, threads=1)
    assert np.array_equal(whole, alone)
    change = np.abs(whole[:, -1] - whole[:, 0]).max(axis=1)
    assert change[-1] > 150 and (np.diff(change) > 50).all()


@pytest.mark.slow
def test_a_path_is_shaped(repo):
    """From twice the force and more to the one that is wanted, in every step."""
    pytest.importorskip("torch", reason="needs PyTorch: pip install biotac_mj[learning]")
    example = load(repo, "shape_a_path")
    before, after = example.main()
    assert (before - example.wanted()).abs().max() > 1.0
    assert (after - example.wanted()).abs().max() < 0.01


@pytest.mark.slow
def test_a_sensors_numbers_are_found(repo):
    """Within what the noise leaves of each, and that is little."""
    pytest.importorskip("torch", reason="needs PyTorch: pip install biotac_mj[learning]")
    example = load(repo, "fit_a_sensor")
    found, error = example.main()
    truth, start = (np.array([row[k] for row in example.NUMBERS]) for k in (2, 3))
    assert (np.abs(found - truth) < 3 * error).all()
    assert (error < 0.2 * np.abs(start - truth)).all()


@pytest.mark.slow
def test_pictures_of_tasks_are_drawn_and_scored(repo, tmp_path, capsys):
    pytest.importorskip("dm_control", reason="needs dm_control: pip install biotac_mj[control]")
    asked = ["--tasks", "press", "--seconds", "0.3", "--out", str(tmp_path)]
    written = load(repo, "task_pictures").main(asked)
    assert "finger/press: mean reward 0." in capsys.readouterr().out
    assert find_gl() is None or written["press"].stat().st_size > 10_000
