"""`python -m benchmarks.mutants`: run the tests of each mutant, list those that none notices.

The tests run in processes that are forked from one in which the libraries are imported already. The
test that noticed a mutant in the last run, according to the page of results, runs first. At the end
the tests that noticed something run on the source as it is: a mutant whose test fails there too is
"unknown", because that test shows nothing.
"""

import argparse
import datetime
import importlib.util
import json
import os
import re
import shutil
import signal
import sys
import tempfile
import time
import types
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.mutants import Mutant, mutants, mutated

ROOT = Path(__file__).resolve().parents[2]
COPIED = ("benchmarks", "docs", "scenes", "surgisoft", "tests", "pyproject.toml", "setup.py")
COPIED += ("README.md", "CONTRIBUTING.md", "Makefile", "mkdocs.yml", "constraints.txt")
LONGEST_S = 900
"""Time after which the tests of a mutant are ended: a hang is noticed, too, s."""
PAGE = ROOT / "docs" / "results" / "mutants.md"
"""The page of results of the last run."""
ROW = re.compile(r"\| (.+?)(?: \(\*\))? \| `[^`]+` \| \w+ \| `(.+)` \|")
"""Its rows: the mutant, and the test that noticed it."""
LIBRARIES = ("numpy", "scipy.optimize", "scipy.stats", "scipy.spatial", "pandas", "pyarrow.parquet")
LIBRARIES += ("numba", "torch", "tensordict", "trimesh", "pytest", "hypothesis", "rerun")
"""What is imported once, before the first process is forked."""
OURS = ("benchmarks", "surgisoft", "tests")
"""Packages of the tree, which each process imports from the changed copy."""


def main() -> int:
    """Parse, run, print; exit code 1 where a mutant survives."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mutants", description=__doc__)
    parser.add_argument("--only", nargs="+", help="words: mutants with one in name, area or file")
    parser.add_argument("--issue", action="store_true", help="those of the trial of 2026-11-22")
    parser.add_argument("--log", type=Path, help="append outcomes here; those there are not run")
    parser.add_argument("-o", "--output", type=Path, help="write the page of results here")
    given = parser.parse_args()
    some = [m for m in mutants() if _wanted(m, given.only) and (m.issue or not given.issue)]
    outcomes = _known(given.log, some)
    noticed = dict(ROW.findall(PAGE.read_text())) if PAGE.is_file() else {}
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        _copy(tree)
        os.environ |= {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
        os.environ["SURGISOFT_SHARED"] = "/nonexistent"
        for name in LIBRARIES:
            if importlib.util.find_spec(name.split(".")[0]):
                importlib.import_module(name)
        for mutant in some:
            if mutant.name in outcomes:
                continue
            outcome = run(mutant, tree, noticed.get(mutant.name))
            outcomes[mutant.name] = outcome
            print(f"{outcome['outcome']:9} {outcome['seconds']:5.0f} s  {mutant.name}", flush=True)
            if given.log:
                with given.log.open("a") as file:
                    file.write(json.dumps(outcome) + "\n")
        fail = failing(outcomes.values(), tree)
        for outcome in outcomes.values():
            if outcome["by"] in fail:
                outcome["outcome"] = "unknown"
    page = markdown(some, outcomes)
    print(page)
    if given.output:
        given.output.write_text(page)
    return int(any(outcome["outcome"] != "caught" for outcome in outcomes.values()))


def _wanted(mutant: Mutant, words: list[str] | None) -> bool:
    text = f"{mutant.name} {mutant.area} {mutant.file}"
    return words is None or any(word in text for word in words)


def _known(log: Path | None, some: Iterable[Mutant]) -> dict[str, dict]:
    """Outcomes of the log that are still those of the present list; the last one counts."""
    if log is None or not log.is_file():
        return {}
    found = [json.loads(line) for line in log.read_text().splitlines()]
    keys = {mutant.name: _key(mutant) for mutant in some}
    return {row["name"]: row for row in found if keys.get(row["name"]) == row["key"]}


def _key(mutant: Mutant) -> list[str]:
    return [mutant.file, mutant.old, mutant.new]


def _copy(tree: Path) -> None:
    tree.mkdir()
    ignored = shutil.ignore_patterns("__pycache__", "*.pyc", "*.nbi", "*.nbc")
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, tree / name, ignore=ignored)
        else:
            shutil.copy2(ROOT / name, tree / name)


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
        "key": _key(mutant),
        "outcome": {0: "survived", 1: "caught"}.get(code, "broken"),
        "by": failed[0] if failed else "",
        "seconds": round(time.monotonic() - began, 1),
    }


def failing(outcomes: Iterable[dict], tree: Path) -> set[str]:
    """Those of the tests that noticed a mutant which also fail on the source as it is."""
    tests = sorted({outcome["by"] for outcome in outcomes if "::" in outcome["by"]})
    return set(run_tests(tree, tests, LONGEST_S * 4)[1]) if tests else set()


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
                _pytest(tree, arguments)
            finally:
                os._exit(70)
        end = time.monotonic() + longest_s
        while not (ended := os.waitpid(pid, os.WNOHANG))[0]:
            if time.monotonic() > end:
                os.killpg(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
                return 1, ["the tests did not end"]
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
    sys.path[:] = [str(tree), *(path for path in sys.path if path not in ("", str(ROOT)))]
    options = ["-q", "-n", "0", "-p", "no:cacheprovider", "--tb=no"]
    code = pytest.main([*options, *arguments])
    sys.stdout.flush()
    os._exit(int(code))


def markdown(some: list[Mutant], outcomes: dict[str, dict]) -> str:
    """The page of results."""
    ran = [mutant for mutant in some if mutant.name in outcomes]
    counts = Counter(outcomes[mutant.name]["outcome"] for mutant in ran)
    today = datetime.date.today().isoformat()
    lines = [
        "# Mutants",
        "",
        f"Printed by `python -m benchmarks.mutants` on {today}.",
        "",
        "A mutant is a change of the source that makes the program wrong. Its tests, and only",
        "they, are run with it; it is caught where one of them fails. The list:",
        "`benchmarks/mutants/mutants.toml`.",
        "",
        f"{counts['caught']} of {len(ran)} mutants are caught, {counts['survived']} survive.",
        "",
        "The tests that noticed a mutant were then run on the source as it is: "
        f"{counts['unknown'] or 'none'} failed there, too.",
        "",
        "| area | mutants | caught |",
        "|---|---|---|",
    ]
    for area in dict.fromkeys(mutant.area for mutant in ran):
        here = [mutant for mutant in ran if mutant.area == area]
        caught = sum(outcomes[mutant.name]["outcome"] == "caught" for mutant in here)
        lines.append(f"| {area} | {len(here)} | {caught} |")
    lines += ["", "| mutant | file | outcome | noticed by |", "|---|---|---|---|"]
    for mutant in ran:
        found = outcomes[mutant.name]
        mark = " (*)" if mutant.issue else ""
        by = f"`{found['by']}`" if found["by"] else ""
        lines.append(f"| {mutant.name}{mark} | `{mutant.file}` | {found['outcome']} | {by} |")
    lines += ["", "(*): no test noticed it in the trial of 2026-11-22."]
    left = [mutant.name for mutant in some if mutant.name not in outcomes]
    if left:
        lines += ["", f"Not run: {', '.join(left)}."]
    return "\n".join(lines) + "\n"


sys.exit(main())
