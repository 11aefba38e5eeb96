"""Settings that hold for every test: one thread, seeds, slow tests, and where measured data may be.

The tests of a file run in one process, so that its fixtures are made once; files with much work run
first, so that the last ones are short and no process waits for another at the end.

`slow.txt` lists the tests that take at least SLOW_S of processor time; `pytest -m fast` runs the
others. The list is written by

    python -m pytest -n 0 -q --write-slow

which measures each test that it runs, with its fixtures and the processes that it starts. A
fixture that is made once for several tests counts for each of them, as any one may be the only one
that is run. The times of tests that are not run stay as they are, so that a single file can be
measured.
"""

import gc
import os
import sys
from collections import defaultdict
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "surgisoft", deadline=None, max_examples=30, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("surgisoft")

SLOW_S = 0.3
"""Processor time of a test, with its fixtures, from which it is slow, s."""
SLOW = Path(__file__).with_name("slow.txt")
"""The slow tests: `path::function` and the time of the slowest of its cases, s."""

FIRST = ("tests/diagnosis/test_refit.py", "tests/scene/test_author.py")
"""The files that two workers begin with: one compiles the rig, the other one the scenes. Workers
that need the same compiled functions at the same time both compile them, where none are cached."""

_TIMES: dict[str, float] = defaultdict(float)
"""Longest time of each test that has run, s."""
_SHARED: dict[tuple[str, str], float] = {}
"""Time to make each fixture of a class, file, folder or session, s, by its place and name."""


def pytest_addoption(parser):
    parser.addoption(
        "--write-slow", action="store_true", help=f"measure the tests and write them to {SLOW.name}"
    )


def pytest_configure(config):
    """Keep bytecode, whatever the environment says: without it each worker and each process that a
    test starts compiles every module anew, about a minute of processor time in a run of the suite.

    A run that keeps no cache (`-p no:cacheprovider`) keeps none: its source may change within a
    second, as that of mutants does.
    """
    if config.pluginmanager.hasplugin("cacheprovider"):
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        sys.dont_write_bytecode = False


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Import tests and libraries without looking for cycles: what they make stays to the end."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


def pytest_collection_modifyitems(items):
    """Mark each test `slow` or `fast`; put FIRST and the files with the most work first."""
    slow = _slow()
    work: dict[str, float] = defaultdict(float)
    for name, time in slow.items():
        work[name.partition("::")[0]] += time
    for item in items:
        item.add_marker(pytest.mark.slow if _function(item) in slow else pytest.mark.fast)

    def place(item) -> tuple[int, float]:
        file = item.nodeid.partition("::")[0]
        return (FIRST.index(file) if file in FIRST else len(FIRST), -work[file])

    items.sort(key=place)


def pytest_collection_finish():
    """Look for cycles among new objects only: libraries and tests are some million objects that
    stay to the end."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)


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
def pytest_fixture_setup(fixturedef):
    before = _processor_s()
    try:
        return (yield)
    finally:
        if fixturedef.scope != "function":
            _SHARED[fixturedef.baseid, fixturedef.argname] = _processor_s() - before


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    before, known = _processor_s(), dict(_SHARED)
    try:
        return (yield)
    finally:
        spent = _processor_s() - before
        for (place, name), time in _SHARED.items():
            if name in item.fixturenames and item.nodeid.startswith(place):
                spent += time if (place, name) in known else 0.0
        _TIMES[_function(item)] = max(_TIMES[_function(item)], spent)


def pytest_sessionfinish(session):
    if session.config.getoption("--write-slow"):
        times = {**_slow(), **_TIMES}
        lines = (f"{name} {times[name]:.1f}\n" for name in sorted(times) if times[name] >= SLOW_S)
        SLOW.write_text("".join(lines))


def _slow() -> dict[str, float]:
    """The list: processor time by test, s."""
    lines = (line.split() for line in SLOW.read_text().splitlines())
    return {name: float(time) for name, time in lines}


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
