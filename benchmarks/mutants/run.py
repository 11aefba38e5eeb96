"""Run the tests of mutants, each in a process that is forked from this one.

The libraries are imported once, in this process. The test that noticed a mutant in the last run is
the first to run.
"""

import importlib.util
import os
import signal
import sys
import tempfile
import time
import types
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.mutants import Mutant, mutated

LONGEST_S = 900
"""Time after which the tests of a mutant are ended: a hang is noticed, too, s."""
LIBRARIES = ("numpy", "scipy.optimize", "scipy.stats", "scipy.spatial", "pandas", "pyarrow.parquet")
LIBRARIES += ("numba", "torch", "tensordict", "trimesh", "pytest", "hypothesis", "rerun")
"""What is imported once, before the first process is forked."""
NOT_ENDED = "the tests did not end"
"""What is said in place of a test where the tests took longer than they may."""
OURS = ("benchmarks", "surgisoft", "tests")
"""Packages of the tree, which each process imports from the changed copy."""


def prepare(tree: Path) -> None:
    """Import the libraries, and set what processes that are forked or started later inherit.

    They import the packages of the project from the tree and write no bytecode: a file that is
    changed twice within a second could have that of the change before.
    """
    os.environ |= {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    os.environ |= {"SURGISOFT_SHARED": "/nonexistent", "PYTHONDONTWRITEBYTECODE": "1"}
    sys.dont_write_bytecode = True
    for name in LIBRARIES:
        if importlib.util.find_spec(name.split(".")[0]):
            importlib.import_module(name)


def key_of(mutant: Mutant) -> list[str]:
    """What makes an outcome that of this mutant and of no other."""
    return [mutant.file, mutant.old, mutant.new]


def run(mutant: Mutant, tree: Path, first: str | None) -> dict:
    """Apply a mutant to a tree, run its tests until one fails, and undo it.

    first: the test that is run before the others.
    """
    file, began = tree / mutant.file, time.monotonic()
    text = file.read_text()
    file.write_text(mutated(mutant, text))
    try:
        code, failed = 0, []
        if first is not None:
            code, failed = run_tests(tree, ["-x", first])
        if code != 1:  # it did not notice, or is no more
            code, failed = run_tests(tree, ["-x", *mutant.tests])
    finally:
        file.write_text(text)
    return {
        "name": mutant.name,
        "key": key_of(mutant),
        "outcome": {0: "survived", 1: "caught"}.get(code, "broken"),
        "by": failed[0] if failed else "",
        "seconds": round(time.monotonic() - began, 1),
    }


def failing(outcomes: Iterable[dict], tree: Path) -> set[str]:
    """Those of the tests that noticed a mutant which also fail on the source as it is."""
    tests = sorted({outcome["by"] for outcome in outcomes if "::" in outcome["by"]})
    failed = run_tests(tree, tests, LONGEST_S * 4)[1] if tests else []
    return set(tests if failed == [NOT_ENDED] else failed)


def run_tests(
    tree: Path, arguments: Sequence[str], longest_s: float = LONGEST_S
) -> tuple[int, list[str]]:
    """pytest in a forked process: its exit code, or 1 after that time, and what failed."""
    with tempfile.TemporaryFile() as out:
        pid = os.fork()
        if pid == 0:
            try:
                os.setsid()
                os.dup2(out.fileno(), 1)
                os.dup2(out.fileno(), 2)
                sys.stdout, sys.stderr = (os.fdopen(n, "w", closefd=False) for n in (1, 2))
                _pytest(tree, arguments)
            finally:
                os._exit(70)
        end = time.monotonic() + longest_s
        while not (ended := os.waitpid(pid, os.WNOHANG))[0]:
            if time.monotonic() > end:
                os.killpg(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
                return 1, [NOT_ENDED]
            time.sleep(0.05)
        out.seek(0)
        said = out.read().decode("utf-8", "replace")
    lines = [line.split(" - ")[0].partition(" ") for line in said.splitlines()]
    failed = [rest for word, _, rest in lines if word in ("FAILED", "ERROR")]
    return os.waitstatus_to_exitcode(ended[1]), failed


def _pytest(tree: Path, arguments: Sequence[str]) -> None:
    """Run pytest in this process on the packages of a tree, and end the process."""
    import pytest

    for name in [name for name in sys.modules if name.split(".")[0] in OURS]:
        del sys.modules[name]
    sys.modules["__main__"] = types.ModuleType("__main__")  # processes that tests start import it
    os.chdir(tree)
    sys.path.insert(0, str(tree))
    options = ["-q", "-n", "0", "-p", "no:cacheprovider", "--tb=no"]
    code = pytest.main([*options, *arguments])
    sys.stdout.flush()
    os._exit(int(code))
