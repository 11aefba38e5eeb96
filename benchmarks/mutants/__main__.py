"""`python -m benchmarks.mutants`: run the tests of each mutant, list those that none notices."""

import argparse
import datetime
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from benchmarks.mutants import Mutant, mutants, mutated

ROOT = Path(__file__).resolve().parents[2]
COPIED = ("benchmarks", "docs", "scenes", "surgisoft", "tests", "pyproject.toml", "setup.py")
COPIED += ("README.md", "CONTRIBUTING.md", "Makefile", "mkdocs.yml", "constraints.txt")
LONGEST_S = 900
"""Time after which the tests of a mutant are ended: a hang is noticed, too, s."""


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
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        _copy(tree)
        for mutant in some:
            if mutant.name in outcomes:
                continue
            outcome = run(mutant, tree)
            outcomes[mutant.name] = outcome
            print(f"{outcome['outcome']:9} {outcome['seconds']:5.0f} s  {mutant.name}", flush=True)
            if given.log:
                with given.log.open("a") as file:
                    file.write(json.dumps(outcome) + "\n")
    page = markdown(some, outcomes)
    print(page)
    if given.output:
        given.output.write_text(page)
    return int(any(outcome["outcome"] == "survived" for outcome in outcomes.values()))


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


def run(mutant: Mutant, tree: Path) -> dict:
    """Apply a mutant to a tree, run its tests with `-x`, and undo it."""
    file, began = tree / mutant.file, time.monotonic()
    text = file.read_text()
    file.write_text(mutated(mutant, text))
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    environment["SURGISOFT_SHARED"] = "/nonexistent"
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider"]
    command += ["--tb=no", *mutant.tests]
    try:
        done = subprocess.run(
            command, cwd=tree, env=environment, capture_output=True, text=True, timeout=LONGEST_S
        )
        code, said = done.returncode, done.stdout
    except subprocess.TimeoutExpired:
        code, said = 1, "FAILED (the tests did not end)"
    finally:
        file.write_text(text)
    failed = [
        line.split(" - ")[0] for line in said.splitlines() if line.startswith(("FAILED", "ERROR"))
    ]
    outcome = {0: "survived", 1: "caught"}.get(code, "broken")
    return {
        "name": mutant.name,
        "key": _key(mutant),
        "outcome": outcome,
        "by": (failed or [""])[0].removeprefix("FAILED ").removeprefix("ERROR "),
        "seconds": round(time.monotonic() - began, 1),
    }


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
