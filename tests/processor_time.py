"""Processor time of the tests: what all of them took, and an error for one that takes too long."""

import resource
import time

import pytest

SLOW = 30  # times as long may one take that is marked slow: five minutes, as `.ci/run` reckons
REFERENCE = 0.17  # of `_slowness` on the processor that the limit is meant for, a new one of 2025 [s]
LONGEST = 10  # tests that the summary names
TIME = "processor time [s]"
BEGIN = pytest.StashKey[float]()


def pytest_addoption(parser):
    parser.addini("most_processor_time", "of a test that is not marked slow [s]", "string", "10")


def _used():
    """Processor time of this process and of those that it has waited for [s]."""
    of = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(used.ru_utime + used.ru_stime for used in of)


def _slowness():
    """How much slower than that this processor is now, where others may work on it too; at least one."""
    begin = time.process_time()
    sum(number * number for number in range(5_000_000))
    return max(1.0, (time.process_time() - begin) / REFERENCE)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item):
    item.stash[BEGIN] = _used()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item):
    result = yield
    taken = _used() - item.stash[BEGIN]
    item.user_properties.append((TIME, taken))
    is_slow = item.get_closest_marker("slow") is not None
    most = float(item.config.getini("most_processor_time")) * (SLOW if is_slow else 1)
    limited = not item.get_closest_marker("users_settings") and not item.config.getoption("jaxtyping_packages", None)
    if limited and taken > most and taken > most * _slowness():
        less = "share a mechanism of tests/mechanisms.py with others, so that less is compiled, or mark it slow"
        remedy = "make tests of its parts" if is_slow else less
        pytest.fail(f"took {taken:.1f} s of processor time, and may take {most:g}: {remedy}", pytrace=False)
    return result


def pytest_terminal_summary(terminalreporter):
    times = {
        report.nodeid: dict(report.user_properties)[TIME]
        for reports in terminalreporter.stats.values()
        for report in reports
        if TIME in dict(getattr(report, "user_properties", ()))
    }
    if not times:
        return
    terminalreporter.section("processor time")
    terminalreporter.line(f"{sum(times.values()):.0f} s in {len(times)} tests; the longest:")
    for nodeid in sorted(times, key=times.get, reverse=True)[:LONGEST]:
        terminalreporter.line(f"{times[nodeid]:6.1f} s {nodeid}")
