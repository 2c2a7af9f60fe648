"""Ctrl-C and SIGTERM: a verb stops, says so, and leaves nothing behind."""

import multiprocessing
import os
import signal
import subprocess
import sys
import textwrap
import time

import pytest
import tqdm

from biotac_mj import cli
from biotac_mj.files import replacing
from biotac_mj.shards import end_with_parent

_TAKES_ANYTHING = """
import os, signal, time
try:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.1)
except BaseException:
    pass
"""


@pytest.mark.parametrize("module", ["press.indenter", "data.objects"])
def test_ctrl_c_is_not_lost_while_trimesh_loads(module, tmp_path):
    """trimesh goes on after any exception while it loads; one that sends a SIGINT stands for it."""
    (tmp_path / "trimesh.py").write_text(_TAKES_ANYTHING)
    code = f"""
        import signal
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
        import biotac_mj.{module}
        print("lost")
    """
    path = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert done.returncode == -signal.SIGINT and "lost" not in done.stdout, done.stderr
    assert done.stderr.rstrip().endswith("KeyboardInterrupt")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_verb_that_is_stopped_leaves_no_file(number, tmp_path, monkeypatch, capsys):
    def work(args):
        with replacing(tmp_path / "a.txt"):
            signal.raise_signal(number)
            time.sleep(10)

    verb = cli.parser().parse_args(["data", "samples", str(tmp_path)])
    verb.run = work
    monkeypatch.setattr(cli.parser(), "parse_args", lambda argv: verb)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    kept = signal.getsignal(signal.SIGTERM)
    try:
        assert cli.main([]) == 128 + number
        assert signal.getsignal(signal.SIGTERM) is kept
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err == "biotac: stopped\n"
    assert list(tmp_path.iterdir()) == []


def _work(said):
    end_with_parent()
    said.send(os.getpid())
    time.sleep(30)


def _start(said):
    multiprocessing.get_context("spawn").Process(target=_work, args=(said,)).start()
    time.sleep(30)


def test_workers_end_with_a_process_that_is_killed():
    spawned = multiprocessing.get_context("spawn")
    ours, theirs = spawned.Pipe()
    parent = spawned.Process(target=_start, args=(theirs,))
    parent.start()
    theirs.close()
    assert ours.poll(30)
    worker = ours.recv()
    os.kill(worker, signal.SIGINT)  # from a terminal it comes to all, and the parent ends them
    assert not ours.poll(0.3)
    parent.kill()
    parent.join()
    assert ours.poll(5)  # the worker had the last other end of the pipe
    with pytest.raises(EOFError):
        ours.recv()


@pytest.mark.parametrize("closed", ["stdout", "stderr"])
def test_a_closed_stream_is_no_error(closed, tmp_path, monkeypatch):
    """Python has None for one that is closed (`biotac ... >&-`), as cron and services do."""
    verb = cli.parser().parse_args(["data", "samples", str(tmp_path)])
    verb.run = lambda args: print(*tqdm.tqdm(range(2), disable=None))
    monkeypatch.setattr(cli.parser(), "parse_args", lambda argv: verb)
    monkeypatch.setattr(sys, closed, None)
    assert cli.main([]) == 0
