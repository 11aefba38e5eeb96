"""What needs an NVIDIA GPU: episodes and training there, against the CPU."""

from dataclasses import replace

import pytest
import torch

from surgisoft.agents.distributed import Processes
from surgisoft.agents.presets import Plan, preset_for
from surgisoft.agents.training import Training
from surgisoft.cuda_graph import cuda_graph, recorded
from surgisoft.errors import AssumptionWarning
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.graphed import GraphedEpisodes
from surgisoft.tasks.registry import TASKS, config_of, make_task

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch finds no NVIDIA GPU")
COUNT, STEPS = 32, 20


@pytest.mark.filterwarnings("error::surgisoft.errors.AssumptionWarning")
@pytest.mark.parametrize("name", TASKS)
def test_episodes_on_a_gpu_are_those_of_the_cpu(name):
    device, random = torch.device("cuda"), torch.Generator().manual_seed(0)
    there, here = make_task(name, device=device), make_task(name)
    play, truth = GraphedEpisodes(there, COUNT), Episodes(here, donate=True)
    with torch.inference_mode():
        state, expected = play.seeded(1, COUNT), truth.seeded(1, COUNT)
        for _ in range(STEPS):
            actions = {
                agent: torch.randn(COUNT, here.world.arms[agent].chambers, generator=random)
                for agent in here.agents
            }
            state, outcome = play.step(state, {n: a.to(device) for n, a in actions.items()})
            expected, known = truth.step(expected, actions)
            for agent, reward in known.rewards.items():
                torch.testing.assert_close(
                    outcome.rewards[agent].cpu(), reward, rtol=1e-3, atol=1e-3
                )
            for arm, part in expected.world.arms.items():
                off = state.world.arms[arm].points_mm.cpu() - part.points_mm
                assert off.abs().max() < 1e-4, arm
            over = torch.rand(COUNT, generator=random) < 0.1
            state, expected = play.reset(state, over.to(device)), truth.reset(expected, over)
            for agent, seen in truth.observe(expected).items():
                found = play.observe(state)[agent].cpu()
                torch.testing.assert_close(found, seen, rtol=1e-3, atol=1e-3)


@pytest.mark.filterwarnings("error::surgisoft.errors.AssumptionWarning")
def test_training_on_a_gpu_learns():
    preset = replace(preset_for("fast", "track_circle"), envs=512)
    plan = Plan("track_circle", config_of("track_circle"), "fast", preset, 600_000, seed=1)
    training = Training(plan, make_task("track_circle", device="cuda"), Processes())
    rewards = []
    while training.share < 1.0:
        rewards.append(training.iterate().gathered.rewards["arm"])
    assert sum(rewards[-5:]) > sum(rewards[:5]) + 1.0


def test_what_reads_a_value_is_no_graph_and_random_numbers_go_on():
    device, place = torch.device("cuda"), torch.zeros(3, device="cuda")

    def reads():
        return place.copy_(torch.randn(3, device=device)).sum().item()

    with pytest.warns(AssumptionWarning, match="no CUDA graph of a sum"):
        work = recorded(reads, lambda: None, device, cuda_graph, "a sum")
    assert work() != work()
    draw = recorded(
        lambda: torch.randn(3, device=device), lambda: None, device, cuda_graph, "a draw"
    )
    first = draw().clone()
    assert not torch.equal(first, draw())
