import os

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):  # before numpy reads them
    os.environ.setdefault(_threads, "1")

# ruff: noqa: E402
import fcntl
import gc
import pathlib
import re
import sys
import time
import types

import numpy as np
import pytest

REPO = pathlib.Path(__file__).resolve().parents[1]
sys.path.append(str(REPO / "scripts"))  # which has no biotac_mj in it
# kernels in which tests spend more time than their compilation takes
_HOT = re.compile(r"biotac_mj\.(data|geometry|launches|sensor|skin)\b")


def pytest_collection():
    """Imports leave no garbage that is worth a collection: 4 s of a process's 14."""
    gc.disable()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Marks the tests of slow.txt, before pytest leaves out what is marked."""
    slow = set((REPO / "tests" / "slow.txt").read_text().splitlines())
    for item in items:
        if not slow.isdisjoint((item.nodeid, item.nodeid.partition("[")[0])):
            item.add_marker("slow")


def pytest_collection_finish():
    """What a process has imported by now stays: without it a collection, of which there are hundreds, takes
    0.6 s. A collection before would take 3 s and find next to nothing."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def default_device():
    """Arrays of the tests are on the CPU, as the package's own are by default, also where CUDA is; tests of
    CUDA name their device."""
    import warp as wp

    wp.set_device("cpu")
    _compile_fast(wp)


def _compile_fast(wp):
    """Halves the time of compilation. Kernels of mujoco_warp and of the tests have the package's flags;
    without CUDA only hot kernels are optimised. A module that another process compiles is waited for."""
    module, ahead = wp._src.context.Module, sys.modules.get("biotac_mj.batch.ahead")
    load, compile_ = module.load, module._compile
    wp.config.cpu_compiler_flags = "-march=native"

    def load_at_level(self, *given, **named):
        if self.options["optimization_level"] is None and not _HOT.match(self.name):
            self.options["optimization_level"] = 0
        return load(self, *given, **named)

    def compile_once(self, *given, **named):
        with open(pathlib.Path(wp.config.kernel_cache_dir) / f"{self.name}.lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            return compile_(self, *given, **named)

    module._compile = compile_once
    if not wp.is_cuda_available():
        module.load = load_at_level
        if ahead:
            ahead._LEVEL = 0


@pytest.fixture(scope="session")
def repo():
    """The root of the repository."""
    return REPO


@pytest.fixture(scope="session")
def shared():
    """../shared, where it is."""
    folder = REPO.parent / "shared"
    if not folder.is_dir():
        pytest.skip("needs ../shared (real meshes, references, measurements), which is not here")
    return folder


@pytest.fixture(scope="session")
def shell():
    """A small closed shell of a finger's size with 19 electrodes along a helix: for what needs a skin's
    topology, not its physics."""
    from blocks import finger

    return finger(3, fixed=3e-3, tip=-16e-3, radius=5e-3)


@pytest.fixture
def serial_port(monkeypatch):
    """A stand-in for pyserial: each read sends a line of 19 counts, the last of which counts the lines."""

    class Port:
        def __init__(self, *given, **named):
            self.sent = 0

        __enter__ = lambda self: self  # noqa: E731
        __exit__ = lambda self, *error: None  # noqa: E731

        def readline(self):
            time.sleep(0.002)
            self.sent += 1
            return b"3000 " * 18 + b"%d\n" % (3000 + self.sent % 900)

    stand_in = types.ModuleType("serial")
    stand_in.Serial, stand_in.SerialException = Port, OSError
    stand_in.__spec__ = types.SimpleNamespace()
    monkeypatch.setitem(sys.modules, "serial", stand_in)


@pytest.fixture(scope="session")
def synthetic_press(shell):
    """A recorded press that nobody simulated: a sphere of 3.5 mm radius leaves its print in the shell,
    Hertz's force, made-up counts."""
    import trimesh

    from biotac_mj.press.record import PressRecord

    n, radius = 12, 3.5e-3
    depth = np.concatenate([[-5e-6], np.linspace(1e-4, 1.5e-3, n - 1)])
    first_touch = np.array([-8e-3, -7e-3, 0])
    xpos = np.repeat(shell.vert[None], n, 0)
    indenter_pos = first_touch + depth[:, None] * [0, 1, 0]
    for step in range(n):
        center = indenter_pos[step] - [0, radius, 0]
        away = xpos[step] - center
        distance = np.linalg.norm(away, axis=1)
        inside = distance < radius
        xpos[step, inside] = center + radius * away[inside] / distance[inside, None]
    force = np.zeros((n, 3))
    force[:, 1] = -4 / 3 * 1.7e6 * np.sqrt(radius) * np.clip(depth, 0, None) ** 1.5
    near = np.exp(-((np.linalg.norm(shell.electrode_pos - first_touch, axis=1) / 4e-3) ** 2))
    counts = np.full((n, 23), 3000.0)
    counts[:, :19] += np.round(np.clip(depth, 0, None)[:, None] / 1.5e-3 * (150 - 900 * near))
    counts[:, 19] += np.round(2e5 * np.clip(depth, 0, None))
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    return PressRecord(
        geometry=shell,
        parameters={"indenter": "synthetic sphere", "depth": 1.5e-3},
        time=4e-3 * np.arange(n),
        depth=depth,
        force=force,
        counts=counts,
        nonconverged=np.repeat([0, 1], n // 2),
        vert_xpos=xpos.astype(np.float32),
        indenter_pos=indenter_pos,
        indenter_quat=np.tile([1.0, 0, 0, 0], (n, 1)),
        indenter_vert=sphere.vertices - [0, radius, 0],
        indenter_face=sphere.faces,
        seconds=0.5,
    )
