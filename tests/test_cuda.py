"""What needs an NVIDIA GPU: episodes and training there, against the CPU."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from benchmarks.gpu import differences
from surgisoft.agents.distributed import Processes
from surgisoft.agents.presets import ROBUST, Plan, config_for, preset_for
from surgisoft.agents.training import Training
from surgisoft.cuda_graph import cuda_graph, recorded
from surgisoft.errors import AssumptionWarning
from surgisoft.surrogate.checkpoint import default_arm, save_model
from surgisoft.surrogate.networks import ArcChain
from surgisoft.tasks.registry import TASKS, config_of, make_task, with_fields

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch finds no NVIDIA GPU")
MOST = {
    "key points mm": 1e-4,
    "clearance mm": 1e-3,
    "beam mm": 0.05,
    "other hits": 0.0,
    "other sights": 0.0,
    "dose share": 1e-3,
}
"""Largest differences from the CPU. The end of a beam that grazes a surface differs by hundreds of
times what its arm does."""


@pytest.mark.filterwarnings("error::surgisoft.errors.AssumptionWarning")
@pytest.mark.parametrize(
    ("name", "preset"),
    [*((name, "fast") for name in TASKS), ("track_circle", ROBUST), ("circle_ablation", ROBUST)],
)
def test_episodes_on_a_gpu_are_those_of_the_cpu(name, preset):
    agree(name, config_for(preset, config_of(name)))


@pytest.mark.filterwarnings("error::surgisoft.errors.AssumptionWarning")
def test_an_arm_with_a_prior_mean_steps_in_a_graph(tmp_path):
    model = default_arm()
    prior = ArcChain(
        torch.tensor(model.spec.low), torch.tensor(model.spec.high), model.spec.key_points, 4
    )
    prior.set_rest(model.rest_mm)
    nn.init.normal_(prior.table, std=0.1)
    model.network.prior, model.network.arcs = prior, 4
    save_model(model, tmp_path / "arm")
    agree("track_circle", with_fields(config_of("track_circle"), arm=str(tmp_path / "arm")))


def agree(name, config):
    """Episodes on a GPU are those of the CPU but for rounding."""
    found = differences(name, torch.device("cuda"), config)
    assert found["key points mm"] > 0.0  # another processor rounds in another way
    for what, size in found.items():
        assert size <= MOST[what], what


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

    with pytest.warns(AssumptionWarning, match="no CUDA graph could be made of a sum"):
        work = recorded(reads, lambda: None, device, cuda_graph, "a sum")
    assert work() != work()
    draw = recorded(
        lambda: torch.randn(3, device=device), lambda: None, device, cuda_graph, "a draw"
    )
    first = draw().clone()
    assert not torch.equal(first, draw())
