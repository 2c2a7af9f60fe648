"""A plugin of pytest that writes what each test costs and what it runs, a line of JSON for each, one file for
each process: `python -m pytest -p tests.costs`, with the folder in the environment's COSTS (out/costs).

    {"test": "tests/test_x.py::test_y", "marks": ["law"], "seconds": 0.21, "compiled": {"module_1a2b": 1.3},
     "runs": ["biotac_mj/press/scene.py:50", "biotac_mj.skin.bodies:move", ...]}

Seconds are of the processor, child processes included, compilation not. `runs` has lines of the package's
functions (of Python 3.12 or later, which can tell them at no cost) and kernels, each variant by the hash of
its module. `scripts/quick_tests.py` chooses the quick tests from it."""

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
_compiled: dict[str, float] = {}
_runs: set[str] = set()


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
            _compiled[pathlib.Path(folder).name] = round(time.thread_time() - began, 3)
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


def pytest_configure():
    _watch_kernels()
    if sys.version_info >= (3, 12):
        _watch_lines()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item):
    _compiled.clear()
    _runs.clear()
    if sys.version_info >= (3, 12):
        sys.monitoring.restart_events()
    began = spent()
    try:
        return (yield)
    finally:
        seconds = round(spent() - began - sum(_compiled.values()), 3)
        marks = sorted({mark.name for mark in item.iter_markers()})
        row = {"test": item.nodeid, "marks": marks, "seconds": seconds, "compiled": _compiled}
        row["runs"] = sorted(_runs)
        _FOLDER.mkdir(parents=True, exist_ok=True)
        with open(_FOLDER / f"{os.getpid()}.jsonl", "a") as file:
            print(json.dumps(row), file=file)
