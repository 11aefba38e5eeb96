"""Steps of environments of other projects and of this one, side by side in one run.

    pip install vmas && pip install --no-deps gym-softrobot
    surgisoft benchmark peers

A peer that is not installed is left out. Each side runs in a process of its own on one thread; the
processes take turns, so that other work on the machine slows all of them alike, and the least
processor time of several turns counts. A step is one step of one environment with random actions.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from surgisoft.progress import Progress, silent

ROOT = Path(__file__).resolve().parents[1]

WORKER = """
import json, sys, time, warnings
warnings.filterwarnings("ignore")
import numpy as np
import torch
torch.set_num_threads(1)


def own_batch(name, count):
    from surgisoft.tasks.batched import batched_env
    env = batched_env(name, count)
    acts = {a: 2.0 * torch.rand(count, m) - 1.0 for a, m in env.action_sizes.items()}
    return lambda: env.step(acts)


def own_single(name, geometry):
    from surgisoft.tasks.parallel import parallel_env
    env = parallel_env(name, geometry=geometry)
    env.reset(seed=0)
    acts = {a: np.ones(3, np.float32) for a in env.possible_agents}
    def step():
        if not env.agents:
            env.reset()
        env.step(acts)
    return step


def vmas(scenario, count, **more):
    from vmas import make_env
    env = make_env(scenario=scenario, num_envs=count, device="cpu", continuous_actions=True,
                   seed=0, **more)
    env.reset()
    acts = [2.0 * torch.rand(count, 2) - 1.0 for _ in env.agents]
    return lambda: env.step(acts)


def softrobot(name):
    import gymnasium, gym_softrobot
    env = gymnasium.make(name, disable_env_checker=True)
    env.reset()
    act = env.action_space.sample()
    def step():
        found = env.step(act)
        if found[2] or found[3]:
            env.reset()
    return step


for line in sys.stdin:
    kind, args, more, count, steps = json.loads(line)
    try:
        if "step" not in globals():
            step = globals()[kind](*args, **more)
            step()
        begin = time.process_time()
        for _ in range(steps):
            step()
        print(json.dumps((time.process_time() - begin) / steps / count), flush=True)
    except Exception as error:
        print(json.dumps(f"{type(error).__name__}: {error}"[:120]), flush=True)
"""


@dataclass(frozen=True)
class Side:
    """One environment at one number of copies."""

    name: str
    """Name in the table."""
    envs: int
    """Copies that step together."""
    call: tuple
    """Function of the worker, its arguments and keywords."""
    steps: int
    """Steps of a turn."""
    about: str
    """What a step has in it."""


RING = "two soft arms, contact of whole bodies, beam, dose, view"
LIDAR = {"n_agents": 2, "lidar_range": 0.35, "n_lidar_rays": 12}
SIDES = (
    Side(
        "circle_ablation, batched geometry",
        1,
        ("own_single", ("circle_ablation", "batched"), {}),
        400,
        RING,
    ),
    Side("circle_ablation, FCL", 1, ("own_single", ("circle_ablation", "fcl"), {}), 200, RING),
    Side("circle_ablation", 64, ("own_batch", ("circle_ablation", 64), {}), 30, RING),
    Side("circle_ablation", 1024, ("own_batch", ("circle_ablation", 1024), {}), 6, RING),
    Side(
        "track_circle",
        64,
        ("own_batch", ("track_circle", 64), {}),
        60,
        "one soft arm, learned model",
    ),
    Side(
        "track_circle",
        1024,
        ("own_batch", ("track_circle", 1024), {}),
        20,
        "one soft arm, learned model",
    ),
    *(
        Side(
            "VMAS navigation, lidar",
            n,
            ("vmas", ("navigation", n), LIDAR),
            steps,
            "two discs in the plane, 12 rays each",
        )
        for n, steps in ((1, 100), (64, 60), (1024, 20))
    ),
    *(
        Side(f"gym-softrobot {name}", 1, ("softrobot", (f"{name}-v0",), {}), 2, about)
        for name, about in (
            ("SoftPendulum", "one Cosserat rod by PyElastica, hundreds of small steps inside"),
            ("SoftArmTracking", "one muscular Cosserat rod, as above"),
        )
    ),
)


def run(turns: int = 5, report: Progress = silent) -> list[tuple[Side, float | str]]:
    """Each side with its least processor time of a step of one environment, s, or why it failed."""
    found: list[tuple[Side, float | str]] = [(side, float("inf")) for side in SIDES]
    workers = [_worker() for _ in SIDES]
    try:
        for turn in range(turns):
            report(turn, turns, f"turn {turn + 1}")
            for n, (side, best) in enumerate(found):
                if isinstance(best, str):
                    continue
                kind, args, more = side.call
                pipe = workers[n].stdin
                assert pipe is not None
                pipe.write(json.dumps((kind, args, more, side.envs, side.steps)) + "\n")
                pipe.flush()
                line = workers[n].stdout.readline() if workers[n].stdout else ""
                answer = json.loads(line) if line else "the process ended"
                found[n] = side, answer if isinstance(answer, str) else min(best, answer)
    finally:
        for worker in workers:
            if worker.stdin:
                worker.stdin.close()
            worker.wait()
    return found


def _worker() -> subprocess.Popen:
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    return subprocess.Popen(
        [sys.executable, "-c", WORKER],
        cwd=ROOT,
        env={**os.environ, **threads, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


def markdown(found: list[tuple[Side, float | str]]) -> str:
    """The table: steps a second, and the ratio to `circle_ablation` with as many copies."""
    own = {}
    for side, time in found:
        if side.name in ("circle_ablation", "circle_ablation, batched geometry"):
            own[side.envs] = time
    lines = [
        "| environment | environments | steps/s, one processor | to `circle_ablation` | a step |",
        "|---|---|---|---|---|",
    ]
    for side, time in sorted(found, key=lambda each: each[0].envs):
        base = own.get(side.envs)
        if isinstance(time, str):
            lines.append(f"| {side.name} | {side.envs:,} | not run: {time} | - | {side.about} |")
            continue
        ratio = f"{base / time:.3g}" if isinstance(base, float) else "-"
        lines.append(f"| {side.name} | {side.envs:,} | {1 / time:,.0f} | {ratio} | {side.about} |")
    return "\n".join(lines) + "\n"
