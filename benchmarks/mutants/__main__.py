"""`python -m benchmarks.mutants`: run the tests of each mutant, list those that none notices."""

import argparse
import datetime
import json
import re
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from benchmarks.mutants import Mutant, mutants
from benchmarks.mutants.run import failing, key_of, prepare, run

ROOT = Path(__file__).resolve().parents[2]
COPIED = ("benchmarks", "docs", "scenes", "surgisoft", "tests", "pyproject.toml", "setup.py")
COPIED += ("README.md", "CONTRIBUTING.md", "Makefile", "mkdocs.yml", "constraints.txt")
PAGE = ROOT / "docs" / "results" / "mutants.md"
"""The page of results of the last run."""
ROW = re.compile(r"\| (.+?)(?: \(\*\))? \| `[^`]+` \| \w+ \| `(.+)` \|")
"""Its rows: the mutant, and the test that noticed it."""


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
        prepare(tree)
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
    keys = {mutant.name: key_of(mutant) for mutant in some}
    return {row["name"]: row for row in found if keys.get(row["name"]) == row["key"]}


def _copy(tree: Path) -> None:
    tree.mkdir()
    ignored = shutil.ignore_patterns("__pycache__", "*.pyc", "*.nbi", "*.nbc")
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, tree / name, ignore=ignored)
        else:
            shutil.copy2(ROOT / name, tree / name)


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
