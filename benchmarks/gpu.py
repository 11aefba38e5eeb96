"""An NVIDIA GPU: how far its episodes are from the CPU's, and its steps of the world and of PPO.

    python -m benchmarks.gpu [--tasks track_circle,circle_ablation] [--envs 4096,65536]
    python -m benchmarks.gpu --compile
    python -m benchmarks.gpu --agree all
    python -m benchmarks.gpu --preset robust --arm FOLDER
    python -m benchmarks.gpu --learn 1,2,3 --tasks track_circle --envs 512 --steps 600000

--preset: a preset of `surgisoft train`, with the world that it trains in. --arm: a model for every
arm of a task. With --agree a table of the largest differences between episodes stepped as CUDA
graphs and the same ones on the CPU, with the same random actions and resets: key points and
clearance, mm, the beam's end, mm, how many beams meet another thing, lines of sight that differ,
and dose, as a share of the largest. Otherwise steps per second on the clock, with random actions
and all resets, and of whole iterations of PPO; a step of the world and its parts in milliseconds.
With --learn whole trainings of these seeds, as CUDA graphs and on the CPU: each agent's mean reward
in the last iterations, and the time of one of these.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.control.policies import plan_of
from surgisoft.agents.compiled_update import compile_arms
from surgisoft.agents.distributed import Processes
from surgisoft.agents.presets import PRESETS, Plan, config_for
from surgisoft.agents.training import Training
from surgisoft.tasks.base import Episodes, TaskState
from surgisoft.tasks.batched import BatchedEnv
from surgisoft.tasks.graphed import GraphedEpisodes
from surgisoft.tasks.registry import TASKS, make_task

EPISODES, STEPS = 64, 60
"""Episodes and steps that are compared; one in ten of them begins anew in each step."""
LEAST_S = 1.0
"""What is timed takes at least so long, s."""
ITERATIONS = 5
"""Iterations of PPO that are timed, after the first one, which records the graphs."""


def differences(name: str, device: torch.device, config: Any = None) -> dict[str, float]:
    """Largest differences of a task's episodes on a device from those on the CPU."""
    there, here = make_task(name, config, device), make_task(name, config)
    play, truth = GraphedEpisodes(there, EPISODES), Episodes(here, donate=True)
    draw = torch.Generator().manual_seed(0)
    found: dict[str, float] = {}

    def note(what: str, size: float) -> None:
        found[what] = max(found.get(what, 0.0), size)

    with torch.inference_mode():
        state, expected = play.seeded(1, EPISODES), truth.seeded(1, EPISODES)
        for _ in range(STEPS):
            actions = {
                agent: torch.randn(EPISODES, here.world.arms[agent].chambers, generator=draw)
                for agent in here.agents
            }
            state, _ = play.step(state, {n: a.to(device) for n, a in actions.items()})
            expected, _ = truth.step(expected, actions)
            _note(note, state, expected)
            over = torch.rand(EPISODES, generator=draw) < 0.1
            state, expected = play.reset(state, over.to(device)), truth.reset(expected, over)
    return found


def _note(note: Callable[[str, float], None], state: TaskState, expected: TaskState) -> None:
    def off(one: Tensor, other: Tensor) -> float:
        return (one.cpu() - other).abs().max().item() if other.numel() else 0.0

    one, two = state.world, expected.world
    for name in two.arms:
        note("key points mm", off(one.arms[name].points_mm, two.arms[name].points_mm))
    if two.scene.clearance is not None:
        for each in ("bodies_mm", "arms_mm", "self_mm"):
            of = [getattr(scene.clearance, each) for scene in (one.scene, two.scene)]
            note("clearance mm", off(*of))
    for name, hit in two.scene.hits.items():
        same = one.scene.hits[name].struck.cpu() == hit.struck
        note("other hits", float((~same).sum()))
        place = [h.point_mm.cpu()[same] for h in (one.scene.hits[name], hit)]
        note("beam mm", off(*place))
    for name, view in two.scene.views.items():
        note("other sights", float((one.scene.views[name].visible.cpu() != view.visible).sum()))
    if two.scene.dose is not None:
        dose = two.scene.dose.dose
        note("dose share", off(one.scene.dose.dose, dose) / max(dose.max().item(), 1e-9))


def rate(work: Callable[[], object]) -> float:
    """Calls of `work` per second, on the clock."""
    for _ in range(3):
        work()
    torch.cuda.synchronize()
    calls, begin = 0, time.perf_counter()
    while time.perf_counter() - begin < LEAST_S:
        work()
        calls += 1
    torch.cuda.synchronize()
    return calls / (time.perf_counter() - begin)


def world(plan: Plan, device: torch.device) -> tuple[float, float, float]:
    """Steps of the world per second with resets and observations; ms of a step, of observing."""
    task, envs = make_task(plan.task, plan.task_config, device), plan.preset.envs
    if plan.preset.compile:
        compile_arms(task.world, envs)
    env = BatchedEnv(task, envs, 0, spread=True)
    actions = {
        agent: env.action_limits_kPa[agent] * (2.0 * torch.rand(envs, size, device=device) - 1.0)
        for agent, size in env.action_sizes.items()
    }
    steps = envs * rate(lambda: env.step(actions))
    play, state = GraphedEpisodes(env.task, envs), env.state
    state = play.held(state)
    return (
        steps,
        1e3 / rate(lambda: play.step(state, actions)),
        1e3 / rate(lambda: play.observe(state)),
    )


def ppo(plan: Plan, device: torch.device) -> tuple[float, float]:
    """Steps of training per second, and seconds until the first iteration is done."""
    begin = time.perf_counter()
    training = Training(plan, make_task(plan.task, plan.task_config, device), Processes())
    training.iterate()
    torch.cuda.synchronize()
    first, begin = time.perf_counter() - begin, time.perf_counter()
    for _ in range(ITERATIONS):
        training.iterate()
    torch.cuda.synchronize()
    steps = ITERATIONS * plan.preset.envs * plan.preset.rollout
    return steps / (time.perf_counter() - begin), first


def learned(plan: Plan, device: torch.device) -> tuple[dict[str, float], float]:
    """Mean reward of each agent in the last iterations of a whole training; s of one of them."""
    training = Training(plan, make_task(plan.task, plan.task_config, device), Processes())
    rewards, begin = [], [time.perf_counter()]
    while training.share < 1.0:
        rewards.append(training.iterate().gathered.rewards)
        begin.append(time.perf_counter())
    last = rewards[-ITERATIONS:]
    means = {agent: sum(each[agent] for each in last) / len(last) for agent in training.agents}
    return means, (begin[-1] - begin[-1 - len(last)]) / len(last)


def compare_learning(plans: list[Plan], seeds: list[int], device: torch.device) -> None:
    """Print what whole trainings of these seeds reach on the GPU and on the CPU."""
    print("| task | envs | steps | seed | on | reward of a step at the end | ms an iteration |")
    print("|---|---|---|---|---|---|---|")
    for plan in plans:
        for seed in seeds:
            for place in (device, torch.device("cpu")):
                means, seconds = learned(replace(plan, seed=seed), place)
                told = ", ".join(f"{agent} {value:.4f}" for agent, value in means.items())
                cells = [plan.task, f"{plan.preset.envs:,}", f"{plan.steps:,}", str(seed)]
                cells += [place.type, told, f"{1e3 * seconds:.0f}"]
                print("| " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--tasks", default="track_circle,circle_ablation")
    parser.add_argument("--envs", default="4096,16384,65536")
    parser.add_argument("--agree", default="")
    parser.add_argument("--learn", default="", help="seeds of whole trainings")
    parser.add_argument("--steps", type=int, help="steps of these; default: those of the task")
    parser.add_argument("--preset", default="fast", choices=PRESETS)
    parser.add_argument("--arm", type=Path, help="folder of a model, for every arm")
    parser.add_argument("--compile", action="store_true", help="the arms by torch.compile, too")
    chosen = parser.parse_args()
    if not torch.cuda.is_available():
        parser.error("PyTorch finds no NVIDIA GPU here; run it on a machine that has one")
    device = torch.device("cuda")

    def planned(name: str) -> Plan:
        plan = plan_of(name, 1, arm=chosen.arm, preset=chosen.preset)
        return replace(plan, task_config=config_for(chosen.preset, plan.task_config))

    print(f"{torch.cuda.get_device_name()}, PyTorch {torch.__version__}")
    if chosen.agree:
        names = list(TASKS) if chosen.agree == "all" else chosen.agree.split(",")
        print("| task | largest differences from the CPU |")
        print("|---|---|")
        for name in names:
            found = differences(name, device, planned(name).task_config)
            print(f"| {name} | " + ", ".join(f"{k} {v:.1e}" for k, v in found.items()) + " |")
        return
    counts = [int(count) for count in chosen.envs.split(",")]
    if chosen.learn:
        plans = [
            replace(
                plan,
                preset=replace(plan.preset, envs=envs),
                steps=plan.steps if chosen.steps is None else chosen.steps,
            )
            for plan in map(planned, chosen.tasks.split(","))
            for envs in counts
        ]
        compare_learning(plans, [int(seed) for seed in chosen.learn.split(",")], device)
        return
    print("| task | envs | world, steps/s | step ms | observe ms | PPO, steps/s | first s | GiB |")
    print("|---|---|---|---|---|---|---|---|")
    for name in chosen.tasks.split(","):
        for envs in counts:
            torch.cuda.reset_peak_memory_stats()
            plan = planned(name)
            plan = replace(plan, preset=replace(plan.preset, envs=envs, compile=chosen.compile))
            steps, step, observe = world(plan, device)
            trained, first = ppo(plan, device)
            memory = torch.cuda.max_memory_allocated() / 2**30
            cells = [f"{steps:,.0f}", f"{step:.2f}", f"{observe:.2f}", f"{trained:,.0f}"]
            row = [name, f"{envs:,}", *cells, f"{first:.1f}", f"{memory:.1f}"]
            print("| " + " | ".join(row) + " |", flush=True)
            torch.cuda.empty_cache()


if __name__ == "__main__":
    main()
