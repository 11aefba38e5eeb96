"""Updates through torch.compile: the weights of rsl-rl's, and one line where nothing compiles."""

import functools
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
import torch._inductor.config as inductor

from surgisoft.agents import compiled_update
from surgisoft.agents.compiled_update import CompileFailed, check_compiler, compile_arms
from surgisoft.agents.distributed import Processes
from surgisoft.agents.ppo import collect_rollout, make_ppo, update
from surgisoft.agents.ppo_loss import PPOLoss
from surgisoft.agents.presets import Plan, Preset
from surgisoft.agents.shared_ppo import adapt_rate
from surgisoft.agents.training import train_new
from surgisoft.agents.vec_env import JointEnv
from surgisoft.cli import run as surgisoft
from surgisoft.errors import InputError
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.registry import config_of, make_task

SMALL = Preset(
    envs=16, rollout=8, epochs=2, batches=2, hidden=(12,), clip=0.02, entropy=0.01,
    desired_kl=0.005, last_noise=None, normalise=True,
)  # fmt: skip
"""All that a loss may have: clips that bite, learned noise, entropy, a rate that adapts."""


def learned(preset, processes, updates=3):
    """Weights, losses and learning rates after a few updates."""
    torch.manual_seed(0)
    env = JointEnv(make_task("track_circle"), preset.envs, 0, preset.action_kPa)
    agents = make_ppo(env, preset, processes)
    (ppo,) = agents.values()
    seen, losses, rates = env.get_observations(), [], []
    for _ in range(updates):
        seen, _ = collect_rollout(env, agents, seen, preset.rollout)
        losses.append(update(ppo))
        rates.append(ppo.learning_rate)
    weights = [
        each.detach().clone() for each in (*ppo.actor.parameters(), *ppo.critic.parameters())
    ]
    return weights, losses, rates, torch.rand(1)


@pytest.mark.parametrize("processes", [Processes(), Processes(1, 2)])
def test_a_compiled_update_learns_what_a_plain_one_does(processes, monkeypatch):
    monkeypatch.setattr(torch.distributed, "all_reduce", lambda tensor, op: tensor.mul_(2.0))
    plain = learned(SMALL, processes)
    # Without a trial of each instruction set of this processor, which takes longer than the rest.
    with inductor.patch({"cpp.vec_isa_ok": True}):
        weights, losses, rates, drawn = learned(replace(SMALL, compile=True), processes)
    for one, other in zip(weights, plain[0], strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    for one, other in zip(losses, plain[1], strict=True):
        assert one == pytest.approx(other, rel=1e-3, abs=1e-5)
    assert rates == plain[2]
    assert len(set(rates)) > 1
    assert torch.equal(drawn, plain[3])  # as many random numbers as rsl-rl draws


def test_the_losses_of_a_minibatch_by_hand():
    """Schulman et al. (2017, eq. 7 and 9) row by row, with torch's Gaussians; every clip bites."""
    preset = replace(SMALL, envs=4, clip=0.1, entropy=0.03)
    torch.manual_seed(0)
    (ppo,) = make_ppo(JointEnv(make_task("track_circle"), 4, 0, 1.0), preset, Processes()).values()
    ppo.value_loss_coef = 0.7
    wide, rows = ppo.actor.obs_normalizer.mean.shape[-1], 64
    seen, own = 3.0 * torch.randn(rows, wide), torch.rand(rows, wide)
    ppo.actor.obs_normalizer.update(2.0 * torch.randn(200, wide) + 1.0)
    ppo.critic.obs_normalizer.update(3.0 * torch.randn(200, wide) - 1.0)
    with torch.no_grad():
        mean, deviation = ppo.actor.mlp(ppo.actor.obs_normalizer(seen)), 0.5
        values = ppo.critic.mlp(ppo.critic.obs_normalizer(own))
    actions, advantages = mean + deviation * torch.randn(rows, 3), torch.randn(rows, 1)
    old_mean, old_deviation = mean + 0.1 * torch.randn(rows, 3), torch.full((rows, 3), 0.4)
    old = torch.distributions.Normal(old_mean, old_deviation)
    now = torch.distributions.Normal(mean, deviation)
    old_values, returns = values + torch.randn(rows, 1), values + torch.randn(rows, 1)
    old_likelihood = old.log_prob(actions).sum(1)
    found = PPOLoss(ppo)(
        seen, own, actions, old_values, advantages, returns, old_likelihood[:, None], old_mean,
        old_deviation,
    )  # fmt: skip
    surrogate = value = 0.0
    ratios = (now.log_prob(actions).sum(1) - old_likelihood).exp()
    for n, ratio in enumerate(ratios.tolist()):
        gain = advantages[n].item()
        surrogate -= min(gain * ratio, gain * min(max(ratio, 0.9), 1.1)) / rows
        v, before, target = values[n].item(), old_values[n].item(), returns[n].item()
        near = before + min(max(v - before, -0.1), 0.1)
        value += max((v - target) ** 2, (near - target) ** 2) / rows
    chaos = now.entropy()[0].sum().item()
    apart = torch.distributions.kl_divergence(old, now).sum(1).mean().item()
    expected = [surrogate + 0.7 * value - 0.03 * chaos, value, surrogate, chaos, apart]
    assert [each.item() for each in found] == pytest.approx(expected, rel=1e-4)
    assert ((ratios < 0.9) | (ratios > 1.1)).sum() > 10


def test_an_update_clips_gradients_and_learns_to_normalise(monkeypatch):
    """As rsl-rl's does, where the clip is far below every gradient; nothing is compiled here."""
    monkeypatch.setattr(torch, "compile", lambda function, **options: function)
    found = []
    for compiled in (False, True):
        torch.manual_seed(0)
        preset = replace(SMALL, compile=compiled, desired_kl=None)
        env = JointEnv(make_task("track_circle"), preset.envs, 0, preset.action_kPa)
        agents = make_ppo(env, preset, Processes())
        (ppo,) = agents.values()
        ppo.max_grad_norm = 1e-9  # Adam adds 1e-8 to a root mean square
        collect_rollout(env, agents, env.get_observations(), preset.rollout)
        before = [each.detach().clone() for each in ppo.actor.parameters()]
        losses = update(ppo)
        steps = [
            each.detach() - old for each, old in zip(ppo.actor.parameters(), before, strict=True)
        ]
        found.append((steps, losses, ppo.actor.obs_normalizer.mean.clone()))
    (plain, losses, mean), (steps, others, normalised) = found
    size = torch.cat([step.flatten() for step in plain]).norm()
    assert 0.0 < size < 1e-3
    for one, other in zip(plain, steps, strict=True):
        torch.testing.assert_close(one, other, rtol=0.02, atol=1e-3 * size.item())
    assert others == pytest.approx(losses, rel=1e-3, abs=1e-5)
    torch.testing.assert_close(normalised, mean)
    assert mean.abs().max() > 0.0


@pytest.mark.parametrize(
    ("divergence", "before", "after"),
    [
        (0.021, 3e-3, 2e-3),
        (0.019, 3e-3, 3e-3),
        (0.006, 3e-3, 3e-3),
        (0.004, 3e-3, 4.5e-3),
        (0.0, 3e-3, 3e-3),
        (0.021, 1.2e-5, 1e-5),
        (0.004, 9e-3, 1e-2),
    ],
)
def test_the_learning_rate_follows_the_divergence_within_bounds(divergence, before, after):
    """A divergence of 0.01 is desired; twice and half of it leave the rate as it is."""
    groups = [{"lr": before}, {"lr": before}]
    optimizer = SimpleNamespace(param_groups=groups)
    ppo = SimpleNamespace(desired_kl=0.01, learning_rate=before, optimizer=optimizer)
    adapt_rate(ppo, divergence)
    assert ppo.learning_rate == pytest.approx(after)
    assert [group["lr"] for group in groups] == [ppo.learning_rate] * 2


def test_compiled_arms_step_as_plain_ones_and_only_batches_of_their_size(monkeypatch):
    sizes = []

    def look(graph, given):
        return lambda *tensors: (sizes.append(1), graph(*tensors))[1]

    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend=look))
    task = make_task("track_circle")
    task.world.arms = {name: arm.reference() for name, arm in task.world.arms.items()}
    episodes, truth = Episodes(task), []
    for compiled in (False, True):
        if compiled:
            compile_arms(task.world, 6)
        with torch.inference_mode():
            for count in (5, 6):
                state = episodes.seeded(0, count)
                for kPa in (0.3, -0.2):
                    state, _ = episodes.step(state, {"arm": torch.full((count, 3), kPa)})
                truth.append(state.world.arms["arm"].points_mm)
    torch.testing.assert_close(truth[2], truth[0], rtol=0.0, atol=0.0)
    torch.testing.assert_close(truth[3], truth[1], rtol=0.0, atol=1e-4)
    assert len(sizes) == 2


def test_without_a_compiler_it_is_refused_before_anything_is_written(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    folder = tmp_path / "run"
    arguments = ["train", "--task", "track_circle", "--steps", "400", "--compile"]
    assert surgisoft([*arguments, "-o", str(folder)]) == 2
    error = capsys.readouterr().err.strip()
    assert "no-such-compiler" in error
    assert len(error.splitlines()) == 1
    assert not folder.exists()
    monkeypatch.setattr(compiled_update, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="Triton"):
        check_compiler(torch.device("cuda"))


def test_a_compilation_that_fails_is_one_line_and_leaves_no_run(tmp_path, monkeypatch):
    def fails(graph, given):
        raise RuntimeError("the compiler crashed")

    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend=fails))
    plan = Plan("track_circle", config_of("track_circle"), "fast", replace(SMALL, compile=True), 99)
    with pytest.raises(CompileFailed, match="the compiler crashed") as error:
        train_new(tmp_path / "run", plan, Processes(), torch.device("cpu"))
    assert len(str(error.value).splitlines()) == 1
    assert not (tmp_path / "run").exists()


def test_arms_that_cannot_be_compiled_are_told_at_their_first_step(monkeypatch):
    """As on a GPU without a C compiler, which Triton needs; other batches are stepped as before."""

    def fails(graph, given):
        raise RuntimeError("Failed to find C compiler.\nPlease specify via CC")

    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend=fails))
    task = make_task("track_circle")
    task.world.arms = {name: arm.reference() for name, arm in task.world.arms.items()}
    compile_arms(task.world, 6)
    episodes = Episodes(task)
    with torch.inference_mode():
        few, many = (episodes.seeded(0, count) for count in (5, 6))
        assert not episodes.step(few, {"arm": torch.zeros(5, 3)})[1].done.any()
        with pytest.raises(CompileFailed, match="Failed to find C compiler") as error:
            episodes.step(many, {"arm": torch.zeros(6, 3)})
    assert len(str(error.value).splitlines()) == 1
