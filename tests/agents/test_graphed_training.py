"""Rollouts and updates as CUDA graphs record them, against rsl-rl's own."""

from dataclasses import replace

import pytest
import torch

from surgisoft.agents.distributed import Processes
from surgisoft.agents.graphed_rollout import GraphedRollout, rollouts
from surgisoft.agents.graphed_update import GraphedUpdate
from surgisoft.agents.ppo import collect_rollout, make_ppo
from surgisoft.agents.presets import Preset, preset_for
from surgisoft.agents.vec_env import JointEnv
from surgisoft.tasks.graphed import GraphedEpisodes
from surgisoft.tasks.registry import make_task
from surgisoft.tasks.world.pytree import tree_map
from tests.graph_replays import replays

SMALL = Preset(
    envs=16, rollout=8, epochs=2, batches=2, hidden=(12, 8), clip=0.02, entropy=0.01,
    desired_kl=0.005, last_noise=None, normalise=True,
)  # fmt: skip
"""All that a loss may have: clips that bite, learned noise, entropy, a rate that adapts."""


def trained(preset, recorded, updates=3, reloaded=False, record=replays):
    """Weights, losses and learning rates after a few updates."""
    torch.manual_seed(0)
    env = JointEnv(make_task("track_circle"), preset.envs, 0, preset.action_kPa)
    ((_, ppo),) = agents = make_ppo(env, preset, Processes()).items()
    agents, seen, losses, rates = dict(agents), env.get_observations(), [], []
    update = GraphedUpdate(ppo, record) if recorded else ppo.update
    drawn = ppo.storage.actions.flatten(0, 1)[: preset.envs * preset.rollout // preset.batches]
    for number in range(updates):
        seen, _ = collect_rollout(env, agents, seen, preset.rollout)
        losses.append(update())
        rates.append(ppo.learning_rate)
        if recorded:  # rsl-rl draws actions in every minibatch, and leaves them
            for _ in range(preset.epochs * preset.batches):
                torch.empty_like(drawn).normal_()
        if reloaded and number == 0:
            ppo.load(tree_map(torch.clone, ppo.save()), None, strict=True)
    weights = [w.detach().clone() for w in (*ppo.actor.parameters(), *ppo.critic.parameters())]
    return weights, losses, rates, ppo.optimizer.param_groups


@pytest.mark.parametrize(
    "preset",
    [
        SMALL,
        replace(SMALL, desired_kl=1e-5),  # the rate falls
        replace(SMALL, desired_kl=None, normalise=False, batches=3),
    ],
)
def test_a_recorded_update_learns_what_rsl_rl_does(preset):
    weights, losses, rates, groups = trained(preset, recorded=True)
    expected = trained(preset, recorded=False)
    for one, other in zip(weights, expected[0], strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    for one, other in zip(losses, expected[1], strict=True):
        assert one == pytest.approx(other, rel=1e-3, abs=1e-5)
    assert rates == pytest.approx(expected[2], rel=1e-6)
    assert (rates[-1] == preset.learning_rate) == (preset.desired_kl is None)
    assert [type(group["lr"]) for group in groups] == [float]  # as checkpoints keep it
    assert [group["capturable"] for group in groups] == [False]


def test_an_update_is_recorded_again_where_a_checkpoint_was_loaded():
    made = []

    def noted(work):
        made.append(work)
        return replays(work)

    trained(SMALL, recorded=True, record=noted)
    assert len(made) == 1
    weights, *_ = trained(SMALL, recorded=True, reloaded=True, record=noted)
    assert len(made) == 3
    expected, *_ = trained(SMALL, recorded=False, reloaded=True)
    for one, other in zip(weights, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.filterwarnings("ignore:no CUDA graph could be made of the step of a rollout")
@pytest.mark.parametrize(
    ("name", "refused"),
    [("track_circle", False), ("circle_ablation", False), ("track_circle", True)],
)
def test_a_recorded_rollout_stores_what_a_plain_one_does(name, refused, monkeypatch):
    """refused: a step in which a value is read, of which no graph can be made."""
    preset = replace(preset_for("fast", name), envs=24, rollout=4)

    def record(work):
        """As a graph, its replays read a step where it was when they were recorded."""
        if refused and work == roll.stepped:
            raise RuntimeError("a value was read")
        again, step = replays(work), roll.latest

        def replay():
            if work != roll.stepped:
                roll.latest = step
            return again()

        return replay

    def made(recorded):
        monkeypatch.setattr(
            "surgisoft.agents.vec_env.donated_episodes",
            lambda task, count: GraphedEpisodes(task, count, replays),
        )
        if not recorded:
            monkeypatch.undo()
        torch.manual_seed(3)
        env = JointEnv(make_task(name), preset.envs, 0, preset.action_kPa, privileged=True)
        return env, make_ppo(env, preset, Processes())

    (env, agents), (plain, others) = made(recorded=True), made(recorded=False)
    begin = tree_map(torch.clone, env.state)
    begin.world.steps[:3] = env.task.steps - torch.tensor([2, 5, 9])
    roll = GraphedRollout(env, agents, preset.rollout, record)
    roll(env.get_observations())  # draws while it records
    env.state, plain.state = begin, tree_map(torch.clone, begin)
    seen, expected = env.get_observations(), plain.get_observations()
    ended = 0
    for turn in range(4):
        torch.manual_seed(turn)
        seen, means = roll(seen)
        torch.manual_seed(turn)
        expected, truth = collect_rollout(plain, others, expected, preset.rollout)
        for group in (*others, "state"):
            torch.testing.assert_close(seen[group], expected[group], rtol=1e-4, atol=1e-4)
        for agent, ppo in agents.items():
            fields = ("actions", "rewards", "dones", "values", "actions_log_prob", "advantages")
            for field in (*fields, "returns"):
                one, two = (getattr(p.storage, field) for p in (ppo, others[agent]))
                torch.testing.assert_close(one, two, rtol=1e-3, atol=1e-3)
            for group in (agent, "state"):
                one, two = (p.storage.observations[group] for p in (ppo, others[agent]))
                torch.testing.assert_close(one, two, rtol=1e-4, atol=1e-4)
            ppo.storage.clear()
            others[agent].storage.clear()
        assert means.episodes == truth.episodes
        ended += means.episodes
        for one, two in zip(
            (means.rewards, means.terms, means.measures),
            (truth.rewards, truth.terms, truth.measures),
            strict=True,
        ):
            assert one == pytest.approx(two, rel=1e-3, abs=1e-4, nan_ok=True)
    assert ended > 0


def test_episodes_that_are_not_recorded_are_rolled_out_plainly():
    env = JointEnv(make_task("track_circle"), 4, 0, 1.0)
    agents = make_ppo(env, replace(SMALL, envs=4), Processes())
    assert not isinstance(rollouts(env, agents, 2), GraphedRollout)
