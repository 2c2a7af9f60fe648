"""Tasks give the same files wherever they are done, and a cluster may lose a machine meanwhile."""

import dataclasses
import sys
import threading
import time

import pytest
from writing import Write

from biotac_mj.data.generation.generate import GenerateOptions, batches, generate
from biotac_mj.data.generation.making import MakeShards
from biotac_mj.shards import Task, run_tasks

TWO = {"one": {}, "two": {"MARK": "x"}}
PLACES = [{}, {"processes": TWO}]


@pytest.mark.parametrize(
    "place",
    [pytest.param({}, id="here"), pytest.param({"processes": TWO}, id="processes", marks=pytest.mark.slow)],
)
def test_all_tasks_are_done_once(place, tmp_path):
    tasks = [Task(k, 2, f"{k}.txt") for k in range(5)]
    found = sorted(run_tasks(Write(), tasks, tmp_path, progress=False, **place))
    assert found == [0, 1, 4, 9, 16] and len(list(tmp_path.iterdir())) == 5
    assert (tmp_path / "3.txt").read_text() == "3 in a folder of its own"


@pytest.mark.parametrize("place", PLACES, ids=["here", "processes"])
def test_what_is_refused_is_said_in_one_line(place, tmp_path):
    with pytest.raises(ValueError, match="13 is refused: take 12"):
        list(run_tasks(Write(), map(Task, (1, 13)), tmp_path, progress=False, **place))


def test_a_process_that_ends_is_an_error(tmp_path):
    with pytest.raises(
        RuntimeError, match=r"the process of one \(exit code 9\) ended: run the command again"
    ):
        list(run_tasks(Write(), [Task(99)], tmp_path, processes={"one": {}}, progress=False))


@pytest.mark.parametrize("terminal", [True, False])
def test_the_bar_moves_by_the_size_of_tasks(tmp_path, capsys, monkeypatch, terminal):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    list(run_tasks(Write(), [Task(k, 2) for k in range(4)], tmp_path, "numbers", "file"))
    said, bar = capsys.readouterr()
    assert "2 is there\n" in said
    if terminal:
        assert all(f"{k}/8" in bar for k in (0, 2, 4, 6))  # each line draws it
    else:
        assert not bar  # in a pipe or a file it would be noise


SMALL = GenerateOptions(
    count=8,
    labelled=1,
    steps=8,
    seed=5,
    objects=("sphere_7mm",),
    kinds=("press",),
    skin="coarse",
    measured_skin="coarse",
    batch=1,
)


@pytest.fixture
def cluster():
    """Three nodes of one core on this machine, the driver's first."""
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    nodes = [made.add_node(num_cpus=1) for _ in range(2)]
    made.wait_for_nodes()
    ray.init(made.address, log_to_driver=False)
    yield made, nodes
    ray.shutdown()
    made.shutdown()


@pytest.mark.slow
def test_a_cluster_that_loses_a_node_makes_the_same_set(cluster, tmp_path):
    import ray

    made, nodes = cluster
    left = []

    def kill():
        while not (first := list((tmp_path / "ray").glob("shard-*.h5"))):
            time.sleep(0.05)
        left.append(SMALL.count - len(first))
        made.remove_node(nodes[1], allow_graceful=False)

    killer = threading.Thread(target=kill)
    killer.start()
    report = generate(tmp_path / "ray", SMALL, progress=False, ray=made.address)
    killer.join()
    assert left[0] >= 3  # every node still had a task
    end = time.monotonic() + 60  # the head hears of it later
    while sum(node["Alive"] for node in ray.nodes()) > 2 and time.monotonic() < end:
        time.sleep(0.1)
    assert sum(node["Alive"] for node in ray.nodes()) == 2
    assert report.interactions == report.made == 8
    generate(tmp_path / "here", SMALL, workers=0, progress=False)
    names = sorted(path.name for path in (tmp_path / "here").glob("shard-*.h5"))
    assert len(names) == 8
    for name in names:
        assert (tmp_path / "ray" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()


@pytest.mark.slow
def test_what_a_cluster_refuses_is_said_in_one_line(cluster, tmp_path):
    made, _ = cluster
    with pytest.raises(ValueError, match="unknown material 'jelly'"):
        bad = dataclasses.replace(SMALL, material="jelly")
        work = MakeShards(bad, {}, "cpu", 0)
        list(run_tasks(work, map(Task, batches(bad)), tmp_path, ray=made.address, progress=False))


def test_without_a_cluster_the_remedy_is_said(tmp_path):
    try:
        import ray  # noqa: F401
    except ImportError:
        text = r"--ray needs Ray: pip install 'biotac-mj\[ray\]'"
    else:
        text = "no Ray cluster at 127.0.0.1:1 .*: start one with `ray start --head`"
    with pytest.raises(ValueError, match=text):
        list(run_tasks(Write(), [Task(1)], tmp_path, ray="127.0.0.1:1", progress=False))
