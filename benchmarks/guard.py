"""Speed of the main operations side by side with an earlier commit, in one run.

    surgisoft benchmark guard [COMMIT]

Without COMMIT the last tag is the earlier one; where there is no tag, COMMIT is needed.

Both versions run in processes of their own, which take turns on the same core, because absolute
times on a shared machine say little. Each operation is timed by processor time; the ratio is that
of the two least times. The guard fails where an operation takes more than `LIMIT` times as long.
A version that cannot run an operation is skipped for it.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

from surgisoft.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
LIMIT = 1.15
"""Ratio of times from which an operation counts as slower."""

WORKER = """
import json, sys, time
import torch
torch.set_num_threads(1)
from surgisoft.agents.evaluate import evaluate
from surgisoft.agents.policies import Random
from surgisoft.agents.vec_env import JointEnv
from surgisoft.tasks.parallel import parallel_env
from surgisoft.tasks.registry import make_task


def world(name, count, steps):
    env = JointEnv(make_task(name), count, 0, 1.0)
    acts = {a: 0.3 * torch.randn(count, env.task.world.arms[a].chambers) for a in env.task.agents}
    def work():
        for _ in range(steps):
            env.step(acts)
    return work


def single(name, geometry, steps):
    env = parallel_env(name, geometry=geometry) if geometry else parallel_env(name, geometry=None)
    env.reset(seed=0)
    def work():
        for _ in range(steps):
            if not env.agents:
                env.reset(seed=1)
            env.step({a: 0.0 * env.action_space(a).low for a in env.agents})
    return work


def checked():
    task = make_task("circle_ablation")
    return lambda: evaluate(task, "random", Random(), 2, 0)


def arm():
    from surgisoft.surrogate.checkpoint import default_arm
    model = default_arm()
    state, dp = model.initial_state(4096), torch.zeros(4096, 3)
    def work():
        with torch.inference_mode():
            for _ in range(10):
                model.step(state, dp, 0.05)
    return work


MADE = {
    "track_circle, 1024 episodes": lambda: world("track_circle", 1024, 20),
    "circle_ablation, 1 episode": lambda: world("circle_ablation", 1, 60),
    "circle_ablation, 256 episodes": lambda: world("circle_ablation", 256, 12),
    "circle_ablation, 1024 episodes": lambda: world("circle_ablation", 1024, 6),
    "circle_ablation, 4096 episodes": lambda: world("circle_ablation", 4096, 3),
    "one track_circle": lambda: single("track_circle", None, 100),
    "one circle_ablation, batched geometry": lambda: single("circle_ablation", "batched", 60),
    "one circle_ablation, FCL": lambda: single("circle_ablation", "fcl", 40),
    "evaluation with FCL": checked,
    "arm model, differentiable path": arm,
}
works = {}
for line in sys.stdin:
    name = line.strip()
    try:
        if name not in works:
            works[name] = MADE[name]()
            works[name]()
        begin = time.process_time()
        works[name]()
        print(json.dumps(time.process_time() - begin), flush=True)
    except Exception as error:
        print(json.dumps(str(error)), flush=True)
"""
OPERATIONS = (
    "track_circle, 1024 episodes",
    "circle_ablation, 1 episode",
    "circle_ablation, 256 episodes",
    "circle_ablation, 1024 episodes",
    "circle_ablation, 4096 episodes",
    "one track_circle",
    "one circle_ablation, batched geometry",
    "one circle_ablation, FCL",
    "evaluation with FCL",
    "arm model, differentiable path",
)
"""Names of the operations, as the worker has them."""


def run(against: str = "", repeats: int = 7) -> bool:
    """Print a table of ratios; whether no operation is slower than the limit allows."""
    commit, name = commit_to_compare(against)
    print(f"compared with {commit} ({name}): {_git('log', '-1', '--format=%cs, %s', name)}")
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(
            ["git", "archive", commit], cwd=ROOT, capture_output=True, check=True
        ).stdout
        with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
            tar.extractall(folder, filter="data")
        sides = [_worker(Path(folder)), _worker(ROOT)]
        try:
            table = {one: _times(sides, one, repeats) for one in OPERATIONS}
        finally:
            for side in sides:
                side.stdin.close()
                side.wait()
    return _print(f"{commit} ({name})", table)


def commit_to_compare(against: str = "", root: Path = ROOT) -> tuple[str, str]:
    """The commit as it is named, and its short hash; without a name the last tag.

    Raises InputError where there is no such commit, or no name and no tag: a clean tree would be
    compared with itself.
    """
    commit = against or _git("describe", "--tags", "--abbrev=0", root=root)
    if not commit:
        raise InputError(
            "guard: no tag to compare with, expected a COMMIT, such as 'surgisoft benchmark guard "
            "HEAD~20'"
        )
    name = _git("rev-parse", "--short", "--verify", "--quiet", f"{commit}^{{commit}}", root=root)
    if not name:
        raise InputError(f"guard: '{commit}' is no commit, expected a tag, a branch or a hash")
    return commit, name


def _git(*arguments: str, root: Path = ROOT) -> str:
    """Output of a git command in a repository; nothing where it fails."""
    done = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True)
    return done.stdout.strip() if done.returncode == 0 else ""


def _worker(root: Path) -> subprocess.Popen:
    """A process that runs operations with the package in a folder."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return subprocess.Popen(
        [sys.executable, "-c", WORKER],
        cwd=root,
        env={**os.environ, **threads, "PYTHONPATH": str(root)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def _times(sides: list[subprocess.Popen], operation: str, repeats: int) -> list[float | str]:
    """Least time (s) of each side, or why it has none; the sides take turns."""
    best: list[float | str] = [float("inf"), float("inf")]
    for turn in range(repeats):
        for k in (0, 1) if turn % 2 else (1, 0):
            if isinstance(best[k], str):
                continue
            sides[k].stdin.write(f"{operation}\n")
            sides[k].stdin.flush()
            line = sides[k].stdout.readline()
            answer = json.loads(line) if line else "the process ended"
            best[k] = answer if isinstance(answer, str) else min(best[k], answer)
    return best


def _print(name: str, table: dict[str, list[float | str]]) -> bool:
    """Print the ratios; whether all are within the limit."""
    print(f"{'operation':42s} {name:>22s} {'here':>10s} {'ratio':>7s}")
    fine = True
    for operation, (before, now) in table.items():
        if isinstance(before, str) or isinstance(now, str):
            print(f"{operation:42s} not compared: {before if isinstance(before, str) else now}")
            fine = fine and not isinstance(now, str)
            continue
        slow = now > LIMIT * before
        fine = fine and not slow
        mark = f"  slower than {LIMIT:g}" if slow else ""
        print(f"{operation:42s} {before:20.3f} s {now:8.3f} s {now / before:7.2f}{mark}")
    return fine
