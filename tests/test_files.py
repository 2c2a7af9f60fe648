"""Files are written whole or not at all: on a full disk, when the process is killed, when two write."""

import errno
import os
import pathlib
import resource
import signal
import subprocess
import sys

import h5py
import numpy as np
import pytest
from good_input import make_files

from biotac_mj import cli
from biotac_mj.files import check_output, hdf5, remove_leftovers, replacing, write_npz

HOLD = """
import sys, time
from biotac_mj.files import replacing
with replacing(sys.argv[1], folder=len(sys.argv) > 2) as temporary:
    print(temporary, flush=True)
    time.sleep(60)
"""
FULL = """
import resource, sys
import numpy as np
from biotac_mj.files import hdf5
resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, 2**16))
try:
    with hdf5(sys.argv[1]) as file:
        file.create_dataset("x", data=np.random.default_rng(0).random(2**17), chunks=True)
except OSError as error:
    print(error.errno)
"""


def held(path, *folder):
    """A process that is writing, and its temporary."""
    words = [sys.executable, "-c", HOLD, str(path), *folder]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    return process, pathlib.Path(process.stdout.readline().strip())


@pytest.mark.parametrize("folder", [(), ("folder",)])
def test_leftovers_of_the_killed_go_and_those_of_the_living_stay(tmp_path, folder):
    process, temporary = held(tmp_path / "a", *folder)
    try:
        assert temporary.parent == tmp_path and temporary.exists()
        with replacing(tmp_path / "b") as mine:
            mine.write_text("b")
        remove_leftovers(tmp_path)
        assert temporary.exists()
    finally:
        process.kill()
        process.wait()
    assert process.returncode == -signal.SIGKILL and temporary.exists()
    check_output(tmp_path)  # what a next start asks first
    assert [path.name for path in tmp_path.iterdir()] == ["b"]


def test_a_full_disk_ends_no_process_and_keeps_the_old_file(tmp_path):
    path = tmp_path / "a.h5"
    with hdf5(path) as file:
        file["x"] = np.arange(3)
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0 and int(done.stdout) == errno.EFBIG, done.stderr
    with h5py.File(path) as file:
        assert file["x"][:].tolist() == [0, 1, 2]
    assert list(tmp_path.iterdir()) == [path]


def test_nothing_is_left_where_writing_fails(tmp_path):
    with pytest.raises(KeyboardInterrupt), replacing(tmp_path / "a.txt") as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    with pytest.raises(ZeroDivisionError), hdf5(tmp_path / "a.h5") as file:
        file["x"] = 1 / 0
    assert list(tmp_path.iterdir()) == []
    write_npz(tmp_path / "a.npz", x=np.eye(2))
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        assert (file["x"] == np.eye(2)).all()


def test_a_full_disk_is_one_line(tmp_path, synthetic_press, monkeypatch, capsys):
    make_files(tmp_path, synthetic_press)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**14, hard))  # more than the page that is tried before
    try:
        code = cli.main(["data", "import", "nvidia.hdf5", "--out", "out"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    said = capsys.readouterr().err
    assert code == 2 and said.count("\n") == 1 and os.strerror(errno.EFBIG) in said and "--out" in said
    assert list((tmp_path / "out").iterdir()) == []
