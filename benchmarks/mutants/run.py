"""Run the tests of mutants, each in a process that is forked from this one.

The libraries are imported once, in this process. The test that noticed a mutant in the last run is
the first to run.
"""

import gc
import importlib.util
import os
import resource
import signal
import sys
import tempfile
import time
import types
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.mutants import Mutant, mutated

LONGEST_S = 600
"""Processor time of a process after which the tests of a mutant are ended: a hang is noticed, too,
s."""
MOST_WAITED_S = 7200
"""Wall time after which they are ended, s. It shows nothing: the machine may be busy."""
LIBRARIES = ("numpy", "scipy.optimize", "scipy.stats", "scipy.spatial", "pandas", "pyarrow.parquet")
LIBRARIES += ("numba", "torch", "tensordict", "trimesh", "pytest", "hypothesis", "rerun")
"""What is imported once, before the first process is forked."""
NOT_ENDED = "the tests did not end"
"""What is said in place of a test where the tests took longer than they may."""
OURS = ("benchmarks", "surgisoft", "tests")
"""Packages of the tree, which each process imports from the changed copy."""


def prepare(tree: Path) -> None:
    """Import the libraries, and set what processes that are forked or started later inherit.

    They import the packages of the project from the tree.
    """
    os.environ |= {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    os.environ["SURGISOFT_SHARED"] = "/nonexistent"
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
    outcome, failed = "survived", []
    try:
        for test in (first, *mutant.tests):  # one by one: pytest would run a file in its own order
            if test is None:
                continue
            code, failed = run_tests(tree, ["-x", test])
            if code == 1:
                outcome = "caught"
                break
            if code != 0 and test in mutant.tests:  # another `first` may be no more
                outcome = "broken"
    finally:
        file.write_text(text)
    return {
        "name": mutant.name,
        "key": key_of(mutant),
        "outcome": outcome,
        "by": failed[0] if outcome == "caught" and failed else "",
        "seconds": round(time.monotonic() - began, 1),
    }


def failing(outcomes: Iterable[dict], tree: Path) -> set[str]:
    """Those of the tests that noticed a mutant which also fail on the source as it is."""
    tests = sorted({outcome["by"] for outcome in outcomes if "::" in outcome["by"]})
    code, failed = run_tests(tree, tests) if tests else (0, [])
    return set(tests if code not in (0, 1) else failed)


def run_tests(tree: Path, arguments: Sequence[str]) -> tuple[int, list[str]]:
    """pytest in a forked process: its exit code and what failed.

    The code is 1 after `LONGEST_S` of processor time, -9 after `MOST_WAITED_S`.
    """
    with tempfile.TemporaryFile() as out:
        pid = os.fork()
        if pid == 0:
            try:
                os.setsid()
                os.dup2(out.fileno(), 1)
                os.dup2(out.fileno(), 2)
                sys.stdout, sys.stderr = (os.fdopen(n, "w", closefd=False) for n in (1, 2))
                resource.setrlimit(resource.RLIMIT_CPU, (LONGEST_S, LONGEST_S))
                _pytest(tree, arguments)
            finally:
                os._exit(70)
        end = time.monotonic() + MOST_WAITED_S
        while not (ended := os.waitpid(pid, os.WNOHANG))[0]:
            if time.monotonic() > end:
                os.killpg(pid, signal.SIGKILL)
                ended = os.waitpid(pid, 0)
                break
            time.sleep(0.05)
        out.seek(0)
        said = out.read().decode("utf-8", "replace")
    code = os.waitstatus_to_exitcode(ended[1])
    if -code in (signal.SIGXCPU, signal.SIGKILL) and time.monotonic() < end:
        return 1, [NOT_ENDED]
    lines = [line.split(" - ")[0].partition(" ") for line in said.splitlines()]
    return code, [rest for word, _, rest in lines if word in ("FAILED", "ERROR")]


def _pytest(tree: Path, arguments: Sequence[str]) -> None:
    """Run pytest in this process on the packages of a tree, and end the process.

    Neither it nor a process that it starts writes bytecode: a file that is changed twice within a
    second could have that of the change before.
    """
    import pytest

    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    sys.dont_write_bytecode = True
    gc.freeze()  # else each collection goes through, and copies, all that the first process holds
    for name in [name for name in sys.modules if name.split(".")[0] in OURS]:
        del sys.modules[name]
    sys.modules["__main__"] = types.ModuleType("__main__")  # processes that tests start import it
    os.chdir(tree)
    sys.path.insert(0, str(tree))
    options = ["-q", "-n", "0", "-p", "no:cacheprovider", "--tb=no"]
    code = pytest.main([*options, *arguments])
    sys.stdout.flush()
    os._exit(int(code))
