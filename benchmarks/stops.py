"""Count the modules that a pressure, a recording and an effect pass through when commands run.

    python benchmarks/stops.py [ROOT]

ROOT is the root of a checkout, this one by default; its commands are run and their calls recorded
(sys.setprofile), from a step of `circle_ablation`, from `diagnose` and from `amend --effect creep`.
Imports are no part of a walk, nor are the modules of the ground (`surgisoft/*.py`: errors, files,
progress).

    stops     modules in which a function ran
    folders   folders of these modules
    hops      pairs of modules of which one calls the other
    returns   those hops that lead back to a module which is still waiting for the answer: the walk
              comes back to where it was before it is done there
"""

import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType

PACKAGE = "surgisoft"
WALKS = {
    "pressure to dose": "a step of circle_ablation",
    "recording to verdict": "diagnose default creep.parquet",
    "effect to saved model": "amend default --effect creep --data creep.parquet -o amended",
}
"""Name of each walk -> the command of surgisoft, or the step of a task."""
COLLECT = "collect mixed --points 900 --seed 0 --hidden creep -o creep.parquet"
"""The recording of the last two walks."""


class Walk:
    """The calls between modules of the package while a function runs."""

    def __init__(self, root: Path):
        self.folder = f"{root / PACKAGE}{os.sep}"
        self.names: dict[str, str | None] = {}
        self.stack: list[str] = []
        self.stops: list[str] = []
        self.hops: set[tuple[str, str]] = set()
        self.returns: set[tuple[str, str]] = set()

    def of(self, code) -> str | None:
        """The module of a function, None for one outside of the package's parts."""
        file = code.co_filename
        if file not in self.names:
            inside = file.startswith(self.folder) and os.sep in file[len(self.folder) :]
            self.names[file] = file[len(self.folder) :] if inside else None
        return None if code.co_name == "<module>" else self.names[file]

    def event(self, frame: FrameType, event: str, _: object) -> None:
        """What sys.setprofile calls for every function that begins and ends."""
        module = self.of(frame.f_code)
        if module is None:
            return
        if event == "call":
            if module not in self.stops:
                self.stops.append(module)
            if self.stack and self.stack[-1] != module:
                hop = (self.stack[-1], module)
                self.hops.add(hop)
                if module in self.stack:
                    self.returns.add(hop)
            self.stack.append(module)
        elif event == "return" and self.stack:
            self.stack.pop()

    def record(self, function: Callable[[], object]) -> None:
        """Run the function and record its calls."""
        threading.setprofile(self.event)
        sys.setprofile(self.event)
        try:
            function()
        finally:
            sys.setprofile(None)
            threading.setprofile(None)


def run(line: str) -> None:
    """A command of the package, in this process."""
    from surgisoft.cli import run as command

    if code := command(line.split()):
        raise SystemExit(code)


def step_of_a_task() -> Callable[[], object]:
    """A step of a ready environment."""
    import surgisoft

    env = surgisoft.parallel_env("circle_ablation")
    env.reset(seed=0)
    actions = {agent: env.action_space(agent).sample() for agent in env.agents}
    env.step(actions)
    return lambda: env.step(actions)


def walk(name: str, root: Path) -> None:
    """Record one walk and print its row."""
    found = Walk(root)
    if name == "pressure to dose":
        function = step_of_a_task()
    else:
        run(COLLECT)
        function = lambda: run(WALKS[name])  # noqa: E731
    with open(os.devnull, "w") as nowhere:
        out, sys.stdout = sys.stdout, nowhere
        found.record(function)
        sys.stdout = out
    folders = {str(Path(stop).parent) for stop in found.stops}
    numbers = (len(found.stops), len(folders), len(found.hops), len(found.returns))
    print(f"| {name} | `{WALKS[name]}` | " + " | ".join(map(str, numbers)) + " |")


def main(root: Path) -> None:
    """Print a row for each walk, each in a process and an empty folder of its own."""
    print("| walk | command | stops | folders | hops | returns |\n|---|---|---|---|---|---|")
    for name in WALKS:
        with tempfile.TemporaryDirectory() as folder:
            done = subprocess.run(
                [sys.executable, __file__, "--walk", name, str(root)],
                cwd=folder,
                env={**os.environ, "PYTHONPATH": str(root)},
                capture_output=True,
                text=True,
                check=False,
            )
        if done.returncode:
            sys.exit(done.stderr)
        print(done.stdout.splitlines()[-1], flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--walk"]:
        walk(sys.argv[2], Path(sys.argv[3]))
    else:
        given = sys.argv[1:2]
        main(Path(given[0]).resolve() if given else Path(__file__).resolve().parents[1])
