"""Processor time of tests by file, child processes' too, for a machine that others use as well: wall time
tells nothing there. A plugin of pytest, of one process: `python -m pytest -p tests.processor_time`."""

import collections
import resource

import pytest

_of_file = collections.Counter()
_slowest = collections.Counter()


def spent() -> float:
    """Processor time [s] of this process and of those that it has waited for."""
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(r.ru_utime + r.ru_stime for r in both)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item):
    began = spent()
    try:
        return (yield)
    finally:
        took = spent() - began
        _of_file[item.nodeid.partition("::")[0]] += took
        _slowest[item.nodeid] += took


def pytest_terminal_summary(terminalreporter):
    say = terminalreporter.write_line
    say(f"processor time {spent():.1f} s, of which in tests {_of_file.total():.1f} s")
    for times, most in ((_of_file, 200), (_slowest, 40)):
        for name, seconds in times.most_common(most):
            say(f"{seconds:8.1f} {name}")
