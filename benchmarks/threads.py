"""Steps of the world and of PPO on one thread and on several, on the clock.

    python -m benchmarks.threads [--tasks circle_ablation,track_circle] [--envs 1024,4096]
    python -m benchmarks.threads --blocks 128,256,512,1024

Every figure is the best of several rounds, in which one thread and all of them take turns. The
ratio is what further threads are worth; other programs on the machine lower it. With --blocks the
steps of the world for blocks of so many rows, from which `surgisoft.threads.BLOCK` was chosen.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from benchmarks.control.policies import plan_of
from surgisoft import threads
from surgisoft.agents.distributed import Processes
from surgisoft.agents.training import Training
from surgisoft.tasks.batched import BatchedEnv
from surgisoft.tasks.registry import make_task

ROUNDS = 5
"""Turns of each number of threads."""
LEAST_S = 1.0
"""A turn takes at least so long, s."""


def best_rates(work: Callable[[], int], counts: Sequence[int]) -> list[float]:
    """Steps per second of `work`, which returns the steps that it made, by number of threads."""
    best, before = [0.0] * len(counts), torch.get_num_threads()
    try:
        for _ in range(ROUNDS):
            for n, count in enumerate(counts):
                torch.set_num_threads(count)
                work()
                steps, begin = 0, time.perf_counter()
                while (spent := time.perf_counter() - begin) < LEAST_S:
                    steps += work()
                best[n] = max(best[n], steps / spent)
    finally:
        torch.set_num_threads(before)
    return best


def world_work(task: str, envs: int) -> Callable[[], int]:
    """A function that steps all episodes of a batch once, with random actions."""
    env = BatchedEnv(make_task(task), envs, 0, spread=True)
    draw = torch.Generator().manual_seed(0)
    limits = env.action_limits_kPa
    actions = [
        {
            agent: limits[agent] * (2.0 * torch.rand(envs, size, generator=draw) - 1.0)
            for agent, size in env.action_sizes.items()
        }
        for _ in range(8)
    ]
    turn = iter(range(1 << 62))

    def work() -> int:
        env.step(actions[next(turn) % len(actions)])
        return envs

    return work


def training_work(task: str, envs: int) -> Callable[[], int]:
    """A function that makes one iteration of PPO: a rollout and its update."""
    plan = plan_of(task, 1)
    own = plan.preset
    batches = max(1, min(own.batches, envs * own.rollout // 2))
    plan = replace(plan, preset=replace(own, envs=envs, batches=batches))
    training = Training(plan, make_task(task, plan.task_config), Processes())

    def work() -> int:
        training.iterate()
        return envs * own.rollout

    return work


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--tasks", default="track_circle,circle_ablation")
    parser.add_argument("--envs", default="1024,4096,16384")
    parser.add_argument("--blocks", default="")
    chosen = parser.parse_args()
    tasks, sizes = chosen.tasks.split(","), [int(n) for n in chosen.envs.split(",")]
    most = os.cpu_count() or 1
    counts = [1, most]
    if chosen.blocks:
        print(f"world steps/s, {most} threads (of one: ratio)")
        print("| task | envs | " + " | ".join(chosen.blocks.split(",")) + " |")
        print("|---|---|" + "---|" * len(chosen.blocks.split(",")))
        for task in tasks:
            for envs in sizes:
                cells = []
                for block in chosen.blocks.split(","):
                    threads.BLOCK = int(block)
                    one, many = best_rates(world_work(task, envs), counts)
                    cells.append(f"{many:,.0f} ({many / one:.2f})")
                print(f"| {task} | {envs:,} | " + " | ".join(cells) + " |", flush=True)
        return
    print(f"| task | envs | what | 1 thread | {most} threads | ratio |")
    print("|---|---|---|---|---|---|")
    for task in tasks:
        for envs in sizes:
            for name, make in (("world", world_work), ("PPO", training_work)):
                one, many = best_rates(make(task, envs), counts)
                row = f"| {task} | {envs:,} | {name} | {one:,.0f} | {many:,.0f} |"
                print(f"{row} {many / one:.2f} |", flush=True)


if __name__ == "__main__":
    main()
