"""`python -m benchmarks.coverage_table`: branch coverage by part, from the data of `make coverage`.

Prints docs/results/coverage.md. A branch is a jump from one line to another that a condition, a
loop or a `with` can take. What draws is counted apart: its tests look at the page or the recording
that comes out, and the goal of COVERED is for what computes and decides.
"""

import argparse
import datetime
import json
import subprocess
import sys
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

COVERED = 0.95
"""Goal for branches of what does not draw."""
MOST = 15
"""Files that are listed with branches that no test takes."""
DRAWING = {
    "surgisoft/replay/": "Rerun recordings, the viewer's process, screenshots",
    "surgisoft/report/": "parts, style and charts of the reports",
    "surgisoft/diagnosis/pages/": "the reports of diagnose, compare and amend",
    "surgisoft/agents/report.py": "the report of evaluate",
    "surgisoft/agents/report_charts.py": "charts of that report",
    "surgisoft/credibility/page.py": "the credibility report as HTML",
    "surgisoft/experiments/page.py": "the report of an experiment",
    "surgisoft/experiments/pictures.py": "pictures of that report",
    "surgisoft/demonstration/": "the page and the text of the demonstration",
    "surgisoft/palette.py": "colours",
    "surgisoft/progress.py": "progress bars",
}
"""What draws: modules (or folders) whose output is looked at, with what they draw."""


@dataclass
class Count:
    """Statements and branches, all and reached."""

    statements: int = 0
    reached: int = 0
    branches: int = 0
    taken: int = 0
    excluded: int = 0
    """Lines that are not measured: bodies of compiled functions, and declarations of types."""

    def add(self, summary: dict) -> None:
        """Add the summary of a file as `coverage json` has it."""
        self.statements += summary["num_statements"]
        self.reached += summary["covered_lines"]
        self.branches += summary["num_branches"]
        self.taken += summary["covered_branches"]
        self.excluded += summary["excluded_lines"]

    def row(self, name: str) -> str:
        """Line of the table."""
        lines = f"{_share(self.reached, self.statements)} of {self.statements:,}"
        branches = f"{_share(self.taken, self.branches)} of {self.branches:,}"
        return f"| {name} | {lines} | {branches} | {self.excluded or ''} |"


def _share(some: int, of: int) -> str:
    return f"{100 * some / of:.1f} %" if of else "-"


def draws(file: str) -> bool:
    """Whether a file is one of those that draw."""
    return any(file == one or (one[-1] == "/" and file.startswith(one)) for one in DRAWING)


def part_of(file: str) -> str:
    """The part of the package that a file belongs to: its folder below `surgisoft`."""
    folders = Path(file).parts[1:-1]
    return folders[0] if folders else "(files of the package)"


NOT_MEASURED = """\
**Not measured:** the bodies of functions under `@compiled`, which numba turns into machine code,
and those of Warp's kernels:
the interpreter, which counts branches, never runs them. Their tests compare them with other
calculations: distances, rays and contacts with trimesh and FCL, plants with formulas and
PyElastica, compiled steps of a model with the same step in torch. What torch exports (TorchScript,
ONNX) is traced from Python that is measured, and compared with it."""


def page(files: dict[str, dict], about_run: str) -> str:
    """The page of the table, from the files of `coverage json`."""
    parts: dict[str, Count] = defaultdict(Count)
    computing, drawing = Count(), Count()
    missed = []
    for file, found in sorted(files.items()):
        summary = found["summary"]
        (drawing if draws(file) else computing).add(summary)
        if not draws(file):
            parts[part_of(file)].add(summary)
            untaken = summary["num_branches"] - summary["covered_branches"]
            missed.append((untaken, file, summary))
    most = sorted(missed, key=lambda row: row[:2], reverse=True)[:MOST]
    branches = _share(computing.taken, computing.branches)
    lines = _share(computing.reached, computing.statements)
    goal = "reached" if computing.taken >= COVERED * computing.branches else "not reached"
    return "\n".join(
        [
            "# Branch coverage",
            "",
            "Printed by `python -m benchmarks.coverage_table` from the data of `make coverage`.",
            about_run,
            "",
            f"**{branches} of the branches of what does not draw are taken** by the tests (goal",
            f"{100 * COVERED:.0f} %: {goal}); {lines} of its lines are run. A branch is a jump",
            "that a condition or a loop can take. Processes that tests and commands start are",
            "measured too; those that a test kills are not.",
            "",
            "| part | lines run | branches taken | lines not measured |",
            "|---|---|---|---|",
            *(count.row(name) for name, count in sorted(parts.items())),
            computing.row("**what does not draw**"),
            drawing.row("what draws"),
            "",
            NOT_MEASURED,
            "",
            "Branches that no test takes, most first:",
            "",
            "| file | branches not taken |",
            "|---|---|",
            *(f"| `{file}` | {n} of {about['num_branches']} |" for n, file, about in most),
            "",
            "What draws, and is counted apart:",
            "",
            *(f"- `{name}`: {what}" for name, what in DRAWING.items()),
            "",
        ]
    )


def main() -> int:
    """Parse, read the data, print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coverage_table")
    parser.add_argument("--json", type=Path, help="what `coverage json` wrote (made here)")
    parser.add_argument("--about", default="", help="sentences on the run, behind its date")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        file = given.json or Path(folder) / "coverage.json"
        if given.json is None:
            command = [sys.executable, "-m", "coverage", "json", "--quiet", "-o", str(file)]
            subprocess.run(command, check=True)
        found = json.loads(file.read_text())
    day = datetime.datetime.fromisoformat(found["meta"]["timestamp"]).date()
    about = f"Measured on {day} with coverage.py {found['meta']['version']}. {given.about}".strip()
    sys.stdout.write(page(found["files"], about))
    return 0


if __name__ == "__main__":
    sys.exit(main())
