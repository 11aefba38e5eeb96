"""rsl-rl's own runner and ours see the same episodes, stored as they were."""

import copy
import math
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from rsl_rl.runners import OnPolicyRunner

from surgisoft.agents.distributed import Processes
from surgisoft.agents.ppo import algorithm_config, collect_rollout, make_ppo
from surgisoft.agents.presets import Preset
from surgisoft.agents.vec_env import STATE, JointEnv, OneAgentEnv, privileged_state
from surgisoft.errors import InputError
from surgisoft.surrogate.checkpoint import default_arm
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.path_following import FollowConfig
from surgisoft.tasks.registry import make_task
from surgisoft.tasks.track import TrackConfig
from surgisoft.tasks.world.random_streams import streams
from surgisoft.tasks.world.world import Mounted, World

SHORT = TrackConfig(FollowConfig(loop_s=1.0, approach_s=0.5))


@pytest.fixture(scope="module")
def task():
    return make_task("track_circle", SHORT)


def test_the_runner_of_rsl_rl_trains_it(task):
    env = OneAgentEnv(task, 4)
    config = algorithm_config("arm", Preset(envs=4, rollout=8), Processes())
    config = {**copy.deepcopy(config), "save_interval": 100, "run_name": "x"}
    runner = OnPolicyRunner(env, config, log_dir=None, device="cpu")
    before = [value.clone() for value in runner.alg.actor.parameters()]
    runner.learn(2, init_at_random_ep_len=True)
    pairs = zip(before, runner.alg.actor.parameters(), strict=True)
    assert not all(torch.equal(one, other) for one, other in pairs)


def test_the_example_of_the_page_trains(tmp_path, monkeypatch):
    """The block of docs/training.md as it stands: two updates, of 64 episodes and 12 steps each."""
    page = (Path(__file__).parents[2] / "docs" / "training.md").read_text()
    (block,) = re.findall(r"^```python\n(from rsl_rl.*?)^```", page, re.S | re.M)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(block, names)
    env, runner = names["env"], names["runner"]
    groups = {name for group in names["settings"]["obs_groups"].values() for name in group}
    assert groups == set(env.get_observations().keys())
    assert runner.logger.tot_timesteps == 2 * 12 * 64
    assert (tmp_path / "runs" / "rsl" / "model_1.pt").is_file()
    assert names["actions"].shape == (64, 3)
    assert names["actions"].isfinite().all()


def test_actions_are_shares_and_episodes_are_the_tasks_own(task):
    """Against the task stepped by hand, through time-outs and fresh starts."""
    env = JointEnv(task, 3, seed=2, action_kPa=0.5)
    play, state = Episodes(task), env.state
    rng = torch.Generator().manual_seed(0)
    ends = 0
    for _ in range(2 * task.steps):
        action = torch.randn(3, 3, generator=rng)
        seen, rewards, dones, extras = env.step({"arm": action})
        state, outcome = play.step(state, {"arm": 0.5 * action})
        assert torch.equal(rewards["arm"], outcome.rewards["arm"])
        assert torch.equal(dones, outcome.done)
        assert torch.equal(extras["time_outs"], outcome.truncated)
        state = play.reset(state, outcome.done)
        assert torch.equal(seen["arm"], play.observe(state)["arm"])
        assert torch.equal(seen[STATE], seen["arm"])
        ends += int(dones.sum())
    assert ends == 6


def test_first_episodes_do_not_end_together(task):
    steps = JointEnv(task, 8, seed=0, action_kPa=1.0).state.world.steps
    assert len(steps.unique()) == 8
    assert steps.max() < task.steps


def test_the_privileged_state_by_hand():
    """An arm that is driven in degrees, off its nominal base, whose cameras are off, too."""
    model = default_arm()
    model = model.replace(spec=replace(model.spec, unit="deg"))
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([10.0, 20.0, 30.0])
    arm = World({"arm": Mounted(model, pose)}).arms["arm"]
    _, part = arm.start(streams(0, 1))
    assert arm.per_kPa != 1.0
    mount, angle = pose.clone(), 0.01
    mount[:3, 3] += torch.tensor([1.0, 2.0, 3.0])
    mount[:2, :2] = torch.tensor(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    )
    gain = arm.per_kPa * torch.tensor([[1.1, 1.0, 0.8]])
    part = replace(part, seen_mm=part.points_mm - 2.0, gain=gain, mount=mount[None])
    less, sine = 100.0 * (math.cos(angle) - 1.0), 100.0 * math.sin(angle)
    expected = [2.0] * (3 * arm.key_points) + [1.0, 0.0, -2.0] + [1.0, 2.0, 3.0]
    expected += [less, -sine, 0.0, sine, less, 0.0, 0.0, 0.0, 0.0]
    assert privileged_state(arm, part)[0].tolist() == pytest.approx(expected, abs=2e-4)
    found = privileged_state(arm, replace(part, factors=torch.tensor([[5.0, 6.0]])))
    assert found[0, -2:].tolist() == [5.0, 6.0]


def test_stored_observations_are_those_before_the_step(task):
    preset = Preset(envs=4, rollout=6)
    env = JointEnv(task, 4, 0, 1.0)
    agents = make_ppo(env, preset, Processes())
    seen = env.get_observations()
    first = seen["arm"].clone()
    collect_rollout(env, agents, seen, 6)
    stored = agents["arm"].storage
    assert torch.equal(stored.observations["arm"][0], first)
    assert not torch.equal(stored.observations["arm"][1], first)
    # GAE by hand (Schulman et al. 2016, eq. 16), from what is stored.
    last = agents["arm"].critic(env.get_observations()).detach()
    advantage = torch.zeros_like(last)
    for step in reversed(range(6)):
        goes_on = 1.0 - stored.dones[step].float()
        after = last if step == 5 else stored.values[step + 1]
        delta = stored.rewards[step] + preset.gamma * goes_on * after - stored.values[step]
        advantage = delta + preset.gamma * preset.lam * goes_on * advantage
        torch.testing.assert_close(stored.returns[step], advantage + stored.values[step])


def test_two_agents_are_referred_to_the_joint_environment():
    with pytest.raises(InputError, match="use JointEnv"):
        OneAgentEnv(make_task("circle_ablation"), 2)
