"""SuperSuit and TorchRL take the environments as they are; skipped where they are not installed."""

import numpy as np
import pytest
import torch

import surgisoft


def test_supersuit_stacks_and_vectorises_both_arms():
    """Three frames stacked by hand, and two environments side by side with a shared action."""
    supersuit = pytest.importorskip("supersuit", reason="SuperSuit is not installed")
    plain = surgisoft.parallel_env("circle_ablation", geometry="batched")
    wrapped = supersuit.frame_stack_v1(
        surgisoft.parallel_env("circle_ablation", geometry="batched"), 3
    )
    frames, (stacked, _) = [plain.reset(seed=4)[0]], wrapped.reset(seed=4)
    push = {agent: np.full(3, 1.0, np.float32) for agent in plain.possible_agents}
    for _ in range(2):
        frames.append(plain.step(push)[0])
        stacked, *_ = wrapped.step(push)
    for agent in plain.possible_agents:
        by_hand = np.concatenate([frame[agent] for frame in frames])
        np.testing.assert_allclose(stacked[agent], by_hand, atol=1e-5)


def test_supersuit_makes_a_vector_environment_of_one_arm():
    supersuit = pytest.importorskip("supersuit", reason="SuperSuit is not installed")
    many = supersuit.pettingzoo_env_to_vec_env_v1(surgisoft.parallel_env("keyhole"))
    seen, _ = many.reset(seed=1)
    alone, _ = surgisoft.parallel_env("keyhole").reset(seed=1)
    np.testing.assert_allclose(seen[0], alone["arm"], atol=1e-5)
    seen, rewards, terminated, truncated, _ = many.step(np.zeros((1, 3), np.float32))
    assert np.isfinite(seen).all()
    assert rewards[0] > 0.0
    assert not terminated[0]
    assert not truncated[0]


@pytest.mark.parametrize("name", ["circle_ablation", "keyhole"])
def test_supersuit_joins_copies_of_an_environment(name):
    """Two copies in one process; the agents' observations are padded to one length."""
    supersuit = pytest.importorskip("supersuit", reason="SuperSuit is not installed")
    env = supersuit.pad_observations_v0(surgisoft.parallel_env(name))
    env = supersuit.pettingzoo_env_to_vec_env_v1(env)
    many = supersuit.concat_vec_envs_v1(env, 2, num_cpus=0, base_class="gymnasium")
    agents = surgisoft.parallel_env(name).possible_agents
    seen, _ = many.reset(seed=1)
    assert len(seen) == 2 * len(agents)
    seen, rewards, *_ = many.step(np.zeros((len(seen), 3), np.float32))
    assert np.isfinite(seen).all()
    assert np.isfinite(rewards).all()


def test_torchrl_rolls_both_arms_out():
    """Its own spec check, and the same rewards as the environment alone."""
    wrappers = pytest.importorskip("torchrl.envs.libs.pettingzoo", reason="TorchRL not installed")
    utils = pytest.importorskip("torchrl.envs.utils", reason="TorchRL not installed")
    own = surgisoft.parallel_env("circle_ablation", geometry="batched")
    env = wrappers.PettingZooWrapper(
        surgisoft.parallel_env("circle_ablation", geometry="batched"), seed=0
    )
    utils.check_env_specs(env)
    state = env.reset(seed=9)
    own.reset(seed=9)
    for group in env.group_map:
        state[group, "action"] = torch.ones_like(env.full_action_spec[group, "action"].zero())
    after = env.step(state)["next"]
    _, rewards, *_ = own.step({agent: np.ones(3, np.float32) for agent in own.agents})
    for group, agents in env.group_map.items():
        for row, agent in enumerate(agents):
            heard = after[group, "reward"][row].item()
            assert heard == pytest.approx(rewards[agent], rel=1e-3, abs=1e-4)
