"""Cost of a training step by rollout and update, compared with the peak of matrix products.

    python -m benchmarks.training [TASK]

Processor time of one thread. The limit by operations counts the matrix products alone: the arm's
network once a step; actor and critic once in the rollout, and in each epoch forward and backward
(three times the forward products, less the first layer's gradient by its input).
"""

import os
import sys
import time
from dataclasses import replace

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
from torch import nn

from benchmarks.control.policies import plan_of
from surgisoft.agents.distributed import Processes
from surgisoft.agents.ppo import collect_rollout
from surgisoft.agents.training import Training
from surgisoft.tasks.registry import make_task

ROWS = ((256, 8, 4), (256, 5, 4), (1024, 8, 4), (1024, 5, 4), (1024, 5, 16), (4096, 5, 4))
"""Parallel episodes, epochs and minibatches of an update; those of the preset are marked."""
SAMPLES = 60_000
"""Least number of steps over which each row is measured."""


def peak() -> float:
    """Operations per second of processor time of a 2048 x 2048 x 2048 float32 product."""
    a = torch.randn(2048, 2048)
    a @ a
    begin = time.process_time()
    for _ in range(4):
        a @ a
    return 4 * 2 * 2048**3 / (time.process_time() - begin)


def products(network: nn.Module) -> list[int]:
    """Operations of each linear layer's product for one sample."""
    return [2 * part.weight.numel() for part in network.modules() if isinstance(part, nn.Linear)]


def operations(training: Training) -> float:
    """Operations of the matrix products of one step, its share of the update included."""
    epochs, total = training.plan.preset.epochs, 0.0
    for agent, ppo in training.agents.items():
        total += sum(products(training.task.world.arms[agent].model.network))
        for network in (ppo.actor, ppo.critic):
            layers = products(network)
            total += (1 + 3 * epochs) * sum(layers) - epochs * layers[0]
    return total


def measured(training: Training) -> tuple[float, float]:
    """Seconds of processor time of a step's rollout and of its share of the update."""
    preset = training.plan.preset
    size = preset.envs * preset.rollout
    turns = -(-SAMPLES // size)
    rollout = update = 0.0
    training.iterate()
    for _ in range(turns):
        begin = time.process_time()
        training.seen, _ = collect_rollout(
            training.env, training.agents, training.seen, preset.rollout
        )
        middle = time.process_time()
        for ppo in training.agents.values():
            ppo.update()
        rollout += middle - begin
        update += time.process_time() - middle
    return rollout / (turns * size), update / (turns * size)


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    name = sys.argv[1] if len(sys.argv) > 1 else "track_circle"
    plan = plan_of(name, 1)
    task = make_task(name, plan.task_config)
    print(f"{name}: microseconds of one processor for a step; limit by matrix products")
    print("  envs epochs batches  rollout  update   steps/s  of limit  20 M steps, min")
    own = (plan.preset.envs, plan.preset.epochs, plan.preset.batches)
    for row in ROWS:
        envs, epochs, batches = row
        preset = replace(plan.preset, envs=envs, epochs=epochs, batches=batches)
        training = Training(replace(plan, preset=preset), task, Processes())
        most = peak()
        rollout, update = measured(training)
        rate = 1.0 / (rollout + update)
        share = rate * operations(training) / most
        print(
            f"{'*' if row == own else ' '}{envs:5d} {epochs:6d} {batches:7d} {1e6 * rollout:8.1f} "
            f"{1e6 * update:7.1f} {rate:9,.0f} {share:9.0%} {20e6 / rate / 60:16.1f}"
        )


if __name__ == "__main__":
    main()
