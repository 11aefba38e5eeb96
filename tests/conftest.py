"""Settings that hold for every test: one thread, seeds, slow tests, and where measured data may be.

The tests of a file run in one process, so that its fixtures are made once; files with much work run
first, so that the last ones are short and no process waits for another at the end.

`slow.txt` lists the tests that take at least SLOW_S of processor time; `pytest -m fast` runs the
others. The list is written by

    OMP_NUM_THREADS=1 python -m pytest -n 0 -q --write-slow

which measures every test, with its fixtures and the processes that it starts.
"""

import os
from collections import defaultdict
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "surgisoft", deadline=None, max_examples=30, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("surgisoft")

SLOW_S = 0.5
"""Processor time of a test, with its fixtures, from which it is slow, s."""
SLOW = Path(__file__).with_name("slow.txt")
"""The slow tests: `path::function` and the time of the slowest of its cases, s."""

_TIMES: dict[str, float] = defaultdict(float)


def pytest_addoption(parser):
    parser.addoption(
        "--write-slow", action="store_true", help=f"measure all tests and write {SLOW.name} anew"
    )


def pytest_collection_modifyitems(items):
    """Mark each test `slow` or `fast`; put the files with the most processor time first."""
    slow = dict(line.split() for line in SLOW.read_text().splitlines())
    work: dict[str, float] = defaultdict(float)
    for name, time in slow.items():
        work[name.partition("::")[0]] += float(time)
    for item in items:
        item.add_marker(pytest.mark.slow if _function(item) in slow else pytest.mark.fast)
    items.sort(key=lambda item: -work[item.nodeid.partition("::")[0]])


@pytest.fixture(scope="module", autouse=True)
def code_of_a_file():
    """Models and effects that the tests of a file name are forgotten after it: hints at the next
    command name the code that a process was given."""
    from surgisoft.surrogate.callables import named
    from surgisoft.surrogate.effects import user_defined

    known = [(each, dict(each)) for each in (named.NAMED, user_defined.FILES)]
    yield
    for each, before in known:
        each.clear()
        each.update(before)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    before = _processor_s()
    try:
        return (yield)
    finally:
        name = _function(item)
        _TIMES[name] = max(_TIMES[name], _processor_s() - before)


def pytest_sessionfinish(session):
    if session.config.getoption("--write-slow"):
        slow = {name: time for name, time in _TIMES.items() if time >= SLOW_S}
        SLOW.write_text("".join(f"{name} {slow[name]:.1f}\n" for name in sorted(slow)))


def _function(item) -> str:
    """The test's file and name, without its parameters."""
    return item.nodeid.partition("[")[0]


def _processor_s() -> float:
    """Processor time of this process and of those that it has waited for, s."""
    return sum(os.times()[:4])


@pytest.fixture(scope="session", autouse=True)
def _one_thread():
    import torch

    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of public recordings and meshes that are no part of the project."""
    beside = Path(__file__).resolve().parents[2] / "shared"
    folder = Path(os.environ.get("SURGISOFT_SHARED", beside))
    if not folder.is_dir():
        pytest.skip("public recordings and meshes are not here (set SURGISOFT_SHARED)")
    return folder
