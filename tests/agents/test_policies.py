"""Drivers by name, and what they promise."""

import pytest
import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch.distributions import Normal, kl_divergence

from surgisoft.agents.actor import Actor, ScaledActor
from surgisoft.agents.compiled_network import LEAST_ROWS, CompiledNetwork
from surgisoft.agents.policies import Random, open_policy
from surgisoft.agents.policy_network import (
    ActionNoise,
    acting,
    compile_network,
    network_config,
    noise_config,
)
from surgisoft.agents.presets import ACTIVATIONS, Preset
from surgisoft.errors import InputError
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.registry import make_task
from surgisoft.tasks.world.pytree import rows


@pytest.fixture(scope="module")
def task():
    return make_task("track_circle")


def trained_by_rsl_rl(width, chambers, preset):
    """An actor of rsl-rl as a training makes it: what checkpoints hold the weights of."""
    seen = TensorDict({"arm": torch.zeros(1, width)}, batch_size=[1])
    config = {**network_config(preset), "distribution_cfg": noise_config(preset)}
    return MLPModel(seen, {"actor": ["arm"]}, "actor", chambers, **config)


def test_random_actions_do_not_depend_on_the_rest_of_the_batch(task):
    policy, state = open_policy("random", task), Episodes(task).seeded(5, 4)
    together = policy.act(task, state, {})["arm"]
    for i in range(4):
        one = rows(state, torch.tensor([i]))
        assert torch.equal(policy.act(task, one, {})["arm"][0], together[i])


def test_scripted_is_the_expert_of_the_task(task):
    play = Episodes(task)
    state = play.seeded(5, 4)
    action = open_policy("scripted", task).act(task, state, play.observe(state))
    assert torch.equal(action["arm"], task.script(state)["arm"])


def test_random_fills_the_pumps_range_evenly_and_anew_each_step(task):
    play, policy = Episodes(task), Random(3)
    state = play.seeded(0, 2000)
    first = policy.act(task, state, {})["arm"]
    state, _ = play.step(state, {"arm": first})
    second = policy.act(task, state, {})["arm"]
    limit = task.world.arms["arm"].pneumatics.step_kPa
    for draw in (first, second):
        assert draw.abs().max() <= limit
        assert draw.mean().abs() < 0.1 * limit
        assert draw.std() == pytest.approx(limit / 3**0.5, rel=0.05)
    each = torch.cat((first, second), 1)
    assert (torch.corrcoef(each.T) - torch.eye(each.shape[1])).abs().max() < 0.1
    assert not torch.equal(first, Random(4).act(task, play.seeded(0, 2000), {})["arm"])


@pytest.mark.parametrize("name", ["skripted", "runs/nowhere"])
def test_what_drives_nothing_is_one_line(name, task):
    with pytest.raises(InputError, match="scripted") as error:
        open_policy(name, task)
    assert name in str(error.value)


def test_outputs_are_scaled_and_clipped_to_the_pumps_step():
    torch.manual_seed(0)
    preset = Preset(hidden=(5,), action_kPa=2.5)
    actor, seen = Actor(7, 3, preset), 20.0 * torch.randn(50, 7)
    plain = actor(seen)
    found = ScaledActor(actor, preset.action_kPa, 0.4)(seen)
    torch.testing.assert_close(found, (2.5 * plain).clamp(-0.4, 0.4))
    assert (2.5 * plain).abs().min() < 0.4 < plain.abs().max()


@pytest.mark.parametrize("activation", sorted(set(ACTIVATIONS)))
@pytest.mark.parametrize("normalise", [False, True])
@pytest.mark.parametrize("last_noise", [None, 0.05])
def test_a_saved_policy_acts_as_rsl_rl_says_to_the_last_bit(activation, normalise, last_noise):
    torch.manual_seed(0)
    preset = Preset(
        hidden=(9, 6), activation=activation, normalise=normalise, last_noise=last_noise
    )
    trained, seen = trained_by_rsl_rl(7, 3, preset), 2.0 * torch.randn(50, 7)
    trained.train().update_normalization(TensorDict({"arm": 3.0 * seen + 1.0}, batch_size=[50]))
    saved, actor = trained.state_dict(), Actor(7, 3, preset)
    assert list(actor.state_dict()) == list(saved)
    actor.load_state_dict(saved)
    expected = trained.eval()(TensorDict({"arm": seen}, batch_size=[50]))
    assert torch.equal(actor.eval()(seen), expected)
    assert torch.equal(acting(trained)(seen), expected)
    assert expected.std() > 1e-3


def test_a_training_computes_by_compiled_networks_and_its_policies_act_as_saved_ones():
    actor = trained_by_rsl_rl(5, 3, Preset(hidden=(8, 8)))
    seen = torch.randn(LEAST_ROWS, 5, generator=torch.Generator().manual_seed(0))
    before, names = actor.mlp(seen), list(actor.state_dict())
    compile_network(actor)
    assert isinstance(actor.mlp, CompiledNetwork)
    assert list(actor.state_dict()) == names
    assert torch.allclose(actor.mlp(seen), before, atol=1e-5)
    assert torch.equal(acting(actor)(seen), before)


@pytest.mark.parametrize("last_noise", [None, 0.05])
def test_the_noise_of_actions_is_that_of_independent_normal_distributions(last_noise):
    noise = trained_by_rsl_rl(5, 3, Preset(last_noise=last_noise)).distribution
    assert isinstance(noise, ActionNoise)
    with torch.no_grad():
        noise.log_std_param.copy_(torch.tensor([-1.5, 0.2, -0.1]))
    mean, outputs, old_mean = torch.randn(3, 50, 3)
    old = torch.tensor([0.4, 0.9, 1.3]).expand(50, 3)
    noise.update(mean)
    deviation = noise.log_std_param.exp()
    truth = Normal(mean, deviation.expand(50, 3))
    found = noise.log_prob(outputs), noise.entropy
    true = truth.log_prob(outputs).sum(1), truth.entropy().sum(1)
    for one, other in zip(found, true, strict=True):
        assert torch.allclose(one, other, atol=1e-5)
    apart = noise.kl_divergence((old_mean, old), noise.params)
    assert torch.allclose(apart, kl_divergence(Normal(old_mean, old), truth).sum(1), atol=1e-5)
    assert noise.log_std_param.requires_grad is (last_noise is None)
    if last_noise is None:
        sums = [one.sum() + other.sum() for one, other in (found, true)]
        slopes = [torch.autograd.grad(each, noise.log_std_param)[0] for each in sums]
        assert torch.allclose(*slopes, rtol=1e-4)
