"""The batched environment for other trainers, and pictures of environments."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.wrappers import RenderCollection

import surgisoft
from surgisoft.errors import InputError
from surgisoft.tasks.circle_ablation import CircleAblation
from surgisoft.tasks.path_following import FollowConfig
from surgisoft.tasks.registry import config_of, make_task, with_fields
from surgisoft.tasks.single import BatchedEnv


def drawn(env, generator):
    """Random actions, agent -> (B, m) kPa."""
    return {
        agent: env.action_limits_kPa[agent]
        * (2.0 * torch.rand(env.num_envs, size, generator=generator) - 1.0)
        for agent, size in env.action_sizes.items()
    }


def test_an_environment_of_the_batch_is_that_of_pettingzoo_with_its_seed():
    """Two arms: observations, rewards and ends of every agent."""
    task, generator = CircleAblation(), torch.Generator().manual_seed(0)
    env = surgisoft.batched_env(task, 3, seed=11)
    single = surgisoft.parallel_env("circle_ablation", geometry="batched")
    alone, _ = single.reset(seed=13)
    together = env.reset(seed=11)
    assert env.agents == ("laser", "endoscope")
    for _ in range(4):
        for agent in env.agents:
            np.testing.assert_allclose(together[agent][2], alone[agent], atol=1e-4)
            assert env.observation_sizes[agent] == len(alone[agent])
        actions = drawn(env, generator)
        step = env.step(actions)
        one = {agent: value[2].numpy() for agent, value in actions.items()}
        alone, rewards, *_ = single.step(one)
        together = step.observations
        for agent in env.agents:
            assert step.rewards[agent][2].item() == pytest.approx(rewards[agent], abs=1e-4)
            total = torch.stack([*step.terms[agent].values()]).sum(0)
            torch.testing.assert_close(total, step.rewards[agent])


def test_a_thousand_episodes_end_and_begin_anew():
    config = with_fields(config_of("track_circle"), loop_s=0.4, approach_s=0.2)
    env = surgisoft.batched_env("track_circle", 1000, config=config)
    generator = torch.Generator().manual_seed(1)
    for number in range(1, env.max_episode_steps + 1):
        step = env.step(drawn(env, generator))
        assert bool(step.truncated.all()) == (number == env.max_episode_steps)
    assert (env.episode_steps == 0).all()
    time = {
        name: value["arm"][:, -1]
        for name, value in (("new", step.observations), ("old", step.final_observations))
    }
    assert (time["new"] == -1.0).all()
    assert (time["old"] == 1.0).all()
    assert step.measures["error_mm"].shape == (1000,)


def test_spread_episodes_do_not_all_end_at_once():
    env = surgisoft.batched_env("track_body", 16, spread=True)
    assert len(set(env.episode_steps.tolist())) == 16


def test_wrong_actions_are_one_line():
    env = surgisoft.batched_env("track_body", 2)
    with pytest.raises(InputError, match=r"shape \(1, 3\), expected \(2, 3\)"):
        env.step({"arm": torch.zeros(1, 3)})
    with pytest.raises(InputError, match="no action for 'arm'"):
        env.step({})
    step = env.step({"arm": torch.tensor([[0.0, 0.0, 0.0], [torch.nan, 0.0, 0.0]])})
    assert step.failed.tolist() == step.terminated.tolist() == [False, True]
    assert not env.step({"arm": torch.zeros(2, 3)}).failed.any(), "it has begun anew"
    with pytest.raises(InputError, match="num_envs is 0"):
        surgisoft.batched_env("track_body", 0)


def test_a_config_may_be_a_file_and_any_other_one_is_refused(tmp_path):
    (tmp_path / "c.toml").write_text("time_s = 1.5\napproach_s = 0.5\n")
    assert (
        surgisoft.batched_env("track_body", 1, config=tmp_path / "c.toml").max_episode_steps == 20
    )
    for make in (
        lambda config: surgisoft.batched_env("track_body", 1, config=config),
        lambda config: gymnasium.make("surgisoft/track_body-v0", config=config),
        lambda config: gymnasium.make_vec("surgisoft/track_body-v0", num_envs=2, config=config),
    ):
        with pytest.raises(InputError, match="is of type dict, expected TrackBodyConfig"):
            make({"time_s": 1.5})


@pytest.mark.parametrize("name", ["track_circle", "track_square", "laser_plane"])
def test_the_configuration_of_a_task_builds_it_again(name):
    """Also the parts of the world and of the path, here with a start that is not at rest."""
    given = with_fields(config_of(name), size_mm=9.0, gain=0.1, mean_kPa=15.0)
    task = make_task(name, given)
    assert task.config == given
    envs = [
        surgisoft.batched_env(task, 3, seed=2),
        surgisoft.batched_env(name, 3, seed=2, config=task.config),
        surgisoft.batched_env(name, 3, seed=2),
    ]
    one, again, usual = (env.step({"arm": torch.ones(3, 3)}).observations["arm"] for env in envs)
    assert torch.equal(one, again)
    assert not torch.allclose(one, usual)


def test_a_part_of_a_configuration_is_told_as_one():
    told = r"FollowConfig, expected TrackConfig \(with it as the field 'follow'\) or the path of"
    with pytest.raises(InputError, match=told):
        surgisoft.batched_env("track_circle", 1, config=FollowConfig())


def test_pictures_show_the_arm_where_it_is():
    """The bright pixels of the arm move to the side to which it bends."""
    env = RenderCollection(gymnasium.make("surgisoft/track_body-v0", render_mode="rgb_array"))
    env.reset(seed=0)
    for _ in range(8):
        env.step(np.array([3.0, -3.0, -3.0], np.float32))
    pictures = env.render()
    assert len(pictures) == 9
    assert all(p.shape == (360, 360, 3) and p.dtype == np.uint8 for p in pictures)
    assert env.metadata["render_fps"] == 10
    arms = [np.argwhere(picture.min(2) > 150) for picture in (pictures[0], pictures[-1])]
    assert all(500 < len(arm) < 20_000 for arm in arms)
    tops = [arm[arm[:, 0] < arm[:, 0].min() + 15].mean(0) for arm in arms]
    assert np.abs(tops[1] - tops[0]).max() > 10


def test_a_vector_environment_has_a_picture_of_each_of_its_environments():
    """Those of single environments of the same seeds and actions."""
    many = gymnasium.make_vec("surgisoft/track_body-v0", num_envs=2, render_mode="rgb_array")
    with pytest.raises(InputError, match="render before reset"):
        many.render()
    many.reset(seed=3)
    actions = np.array([[3.0, -3.0, -3.0], [-3.0, 3.0, 0.0]], np.float32)
    many.step(actions)
    pictures = many.render()
    assert len(pictures) == 2
    assert not np.array_equal(*pictures)
    for i, picture in enumerate(pictures):
        env = gymnasium.make("surgisoft/track_body-v0", render_mode="rgb_array")
        env.reset(seed=3 + i)
        env.step(actions[i])
        different = np.abs(env.render().astype(int) - picture).max(2) > 8
        assert different.mean() < 1e-3
    plain = gymnasium.make_vec("surgisoft/track_body-v0", num_envs=2)
    plain.reset(seed=0)
    assert plain.render() is None
    with pytest.raises(InputError, match="unknown render_mode 'human'"):
        BatchedEnv("track_body", 2, render_mode="human")


def test_two_arms_have_pictures_too_and_others_have_none():
    env = surgisoft.make("circle_ablation", geometry="batched", render_mode="rgb_array")
    with pytest.raises(InputError, match="render before reset"):
        env.render()
    env.reset(seed=0)
    picture = env.render().astype(int)
    red = (picture[..., 0] > picture[..., 1] + 40).mean()
    assert red > 0.02, "the organ"
    assert (picture.min(2) > 150).mean() > 0.02, "the arms"
    plain = gymnasium.make("surgisoft/track_body-v0").unwrapped
    plain.reset(seed=0)
    assert plain.render() is None
    with pytest.raises(InputError, match="unknown render_mode 'human'"):
        surgisoft.parallel_env("track_body", render_mode="human")
