"""A plugin of pytest that writes what each test costs and what it runs, a line of JSON for each, one file for
each process: `python -m pytest -p tests.costs`, with the folder in the environment's COSTS (out/costs).

    {"test": "tests/test_x.py::test_y", "marks": ["law"], "seconds": 0.21,
     "shared": {"biotac_mj.skin.bodies 1a2b": 1.3, "tests/test_x.py::pressed[0]": 2.1},
     "runs": ["biotac_mj/press/scene.py:50", "biotac_mj.skin.bodies:move", "biotac_mj.skin.bodies 1a2b", ...]}

Seconds are of the processor, child processes included. What other tests use too is in `shared` of the first
of them: the compilation of modules, and fixtures of modules and sessions. `runs` has lines of the package's
functions (of Python 3.12 or later, which can tell them at no cost), kernels, each variant by the hash of its
module, and all shared things that the test uses, with what these run. `scripts/quick_tests.py` chooses the
quick tests from it."""

import json
import os
import pathlib
import resource
import sys
import time

import pytest
import warp as wp

_TOOL = 4  # of sys.monitoring's six
_FOLDER = pathlib.Path(os.environ.get("COSTS", "out/costs"))
_shared: dict[str, float] = {}  # set up or compiled since the test began [s]
_runs: set[str] = set()
_runs_of: dict[str, set[str]] = {}  # fixtures


def spent() -> float:
    """Processor time [s] of this process and of those that it has waited for."""
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(r.ru_utime + r.ru_stime for r in both)


def _watch_kernels():
    module = wp._src.context.Module
    compile_, load, launch = module._compile, module.load, wp.launch

    def timed_compile(self, device, folder, *given, **named):
        began = time.thread_time()
        done = compile_(self, device, folder, *given, **named)
        if done:
            name, _, variant = pathlib.Path(folder).name.removeprefix("wp_").rpartition("_")
            _shared[f"{name} {variant}"] = round(time.thread_time() - began, 3)
        return done

    def noted_load(self, *given, **named):
        loaded = load(self, *given, **named)
        if loaded is not None:
            _runs.add(f"{self.name} {loaded.module_hash.hex()[:7]}")
        return loaded

    def noted_launch(kernel, *given, **named):
        _runs.add(f"{kernel.module.name}:{kernel.key}")
        return launch(kernel, *given, **named)

    module._compile, module.load, wp.launch = timed_compile, noted_load, noted_launch


def _watch_lines():
    """Starts to note lines of the package, each once until `restart_events`."""
    tools, kept = sys.monitoring, {}  # of codes, whose comparison is by value and slow
    part = f"{os.sep}biotac_mj{os.sep}"

    def start(code, _):
        if part in code.co_filename and id(code) not in kept:
            kept[id(code)] = code
            tools.set_local_events(_TOOL, code, tools.events.LINE)
        return tools.DISABLE

    def line(code, number):
        _runs.add(f"biotac_mj/{code.co_filename.rpartition(part)[2]}:{number}")
        return tools.DISABLE

    tools.use_tool_id(_TOOL, "costs")
    tools.register_callback(_TOOL, tools.events.PY_START, start)
    tools.register_callback(_TOOL, tools.events.LINE, line)
    tools.set_events(_TOOL, tools.events.PY_START)


def _restart_lines():
    if sys.version_info >= (3, 12):
        sys.monitoring.restart_events()


def _name(fixture, index):
    return f"{fixture.baseid}::{fixture.argname}[{index}]"


def _fixtures(item):
    """Names of the fixtures that a test shares with others."""
    indices = getattr(getattr(item, "callspec", None), "indices", {})
    fixtures = (item._fixtureinfo.name2fixturedefs.get(name, [None])[-1] for name in item.fixturenames)
    return {_name(f, indices.get(f.argname, 0)) for f in fixtures if f and f.scope != "function"}


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef, request):
    if fixturedef.scope == "function":
        return (yield)
    before = _runs.copy()
    _runs.clear()
    _restart_lines()
    began = spent() - sum(_shared.values())
    try:
        return (yield)
    finally:
        name = _name(fixturedef, request.param_index)
        _shared[name] = round(spent() - sum(_shared.values()) - began, 3)
        _runs_of[name] = _runs | {name}
        _runs.update(before)


def pytest_configure():
    _watch_kernels()
    if sys.version_info >= (3, 12):
        _watch_lines()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item):
    _shared.clear()
    _runs.clear()
    _restart_lines()
    began = spent()
    try:
        return (yield)
    finally:
        seconds = round(spent() - began - sum(_shared.values()), 3)
        marks = sorted({mark.name for mark in item.iter_markers()})
        row = {"test": item.nodeid, "marks": marks, "seconds": seconds, "shared": _shared}
        row["runs"] = sorted(_runs.union(*(_runs_of.get(name, ()) for name in _fixtures(item))))
        _FOLDER.mkdir(parents=True, exist_ok=True)
        with open(_FOLDER / f"{os.getpid()}.jsonl", "a") as file:
            print(json.dumps(row), file=file)
