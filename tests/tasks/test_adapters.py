"""PettingZoo's and Gymnasium's own checkers, and what they do not check."""

import copy
import pickle
import warnings
from functools import lru_cache

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test, parallel_seed_test

import surgisoft
from surgisoft.environments import ONE_AGENT
from surgisoft.errors import InputError
from surgisoft.scene.batched import BatchedScene, LoneScene
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import CollisionChecker, ExactScene, LoneExact
from surgisoft.scene.spec import PHANTOM
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.parallel import SurgicalEnv, parallel_env
from surgisoft.tasks.path_following import FollowConfig
from surgisoft.tasks.registry import TASKS, make_task
from surgisoft.tasks.single import BatchedEnv, SingleEnv
from surgisoft.tasks.track import TrackConfig

SHORT = TrackConfig(FollowConfig(loop_s=1.0, approach_s=0.5))
every_task = pytest.mark.parametrize("name", TASKS)
one_arm = pytest.mark.parametrize("name", ONE_AGENT)


@lru_cache
def exact(name, geometry="fcl"):
    """The task that `parallel_env` builds; it holds no state, so that one serves several tests."""
    return parallel_env(name, geometry=geometry).task


@every_task
def test_pettingzoo_api(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(SurgicalEnv(exact(name)), num_cycles=8)


@every_task
def test_pettingzoo_seeds(name):
    parallel_seed_test(lambda: SurgicalEnv(exact(name)), num_cycles=50)


@every_task
def test_pettingzoo_runs_alike_for_many_steps(name):
    """The library's own seed test stops after one step."""

    def run(env):
        rng, heard = np.random.default_rng(0), []
        for seed in (7, None):
            env.reset(seed=seed)
            for _ in range(6):
                shapes = {agent: env.action_space(agent).shape for agent in env.agents}
                actions = {a: rng.uniform(-3, 3, s).astype("f4") for a, s in shapes.items()}
                seen, rewards, *_, infos = env.step(actions)
                heard.append((*seen.values(), *rewards.values(), str(infos)))
            heard.append((env.state(),))
        return heard

    runs = run(surgisoft.parallel_env(name)), run(SurgicalEnv(exact(name)))
    for one, other in zip(*runs, strict=True):
        for a, b in zip(one, other, strict=True):
            assert np.array_equal(a, b)


@pytest.mark.parametrize("geometry", ["fcl", "batched"])
def test_the_geometry_asked_for_decides(geometry, monkeypatch):
    """Every clearance and hit of an episode is an answer of that engine, and of no other."""
    env = surgisoft.parallel_env("circle_ablation", geometry=geometry)
    around, asked = env.task.scene, []
    checker = CollisionChecker(around.geometry.bodies)
    assert isinstance(around.collision, ExactScene if geometry == "fcl" else BatchedScene)
    ask = around.collision.clearance
    monkeypatch.setattr(
        around.collision, "clearance", lambda *a, **k: asked.append("clearance") or ask(*a, **k)
    )
    lone = LoneExact if geometry == "fcl" else LoneScene
    monkeypatch.setattr(
        lone,
        "clearance",
        lambda self, ask=lone.clearance: asked.append("clearance") or ask(self),
    )
    env.reset(seed=3)
    env.step({agent: np.full(3, 2.0, np.float32) for agent in env.agents})
    # The task's reset, what the adapter takes over from it, and the step.
    assert asked.count("clearance") == 3
    arms, scene = env.task_state.world.arms, env.task_state.world.scene
    shapes = {name: ArmShape(part.line_mm[0].numpy(), 7.5) for name, part in arms.items()}
    exact = checker.clearance(shapes).least_mm
    near = {"fcl": 1e-4, "batched": 0.5}[geometry]
    assert scene.clearance.least_mm.item() == pytest.approx(exact, abs=near)


def test_scene_and_arm_are_named_in_one_call(tmp_path):
    with pytest.raises(InputError, match="there is no such scene"):
        surgisoft.parallel_env("circle_ablation", scene=tmp_path / "none")
    with pytest.raises(InputError, match="no arm model there"):
        surgisoft.parallel_env("track_circle", arm=tmp_path / "none")
    with pytest.raises(InputError, match="this task has no scene"):
        surgisoft.parallel_env("track_circle", scene=tmp_path)
    with pytest.raises(InputError, match=r"embree.*batched, fcl"):
        surgisoft.parallel_env("circle_ablation", geometry="embree")
    env = surgisoft.parallel_env("circle_ablation", scene=PHANTOM, arm="default")
    assert env.task.spec.name == "phantom_liver"


def test_agents_leave_when_the_time_is_out():
    env = parallel_env("track_circle", config=SHORT)
    env.reset(seed=0)
    still = {"arm": np.zeros(3, np.float32)}
    for _ in range(14):
        *_, truncated, _ = env.step(still)
        assert truncated == {"arm": False}
        assert env.agents == ["arm"]
    *_, truncated, _ = env.step(still)
    assert truncated == {"arm": True}
    assert env.agents == []
    assert env.step({}) == ({}, {}, {}, {}, {})
    env.reset()
    assert env.agents == ["arm"]


def test_a_reset_without_a_seed_is_another_episode():
    env = parallel_env("track_circle")
    first, _ = env.reset(seed=0)
    second, _ = env.reset()
    again, _ = env.reset(seed=0)
    assert np.array_equal(first["arm"], again["arm"])
    assert not np.array_equal(first["arm"], second["arm"])
    one, _ = parallel_env("track_circle").reset()
    other, _ = parallel_env("track_circle").reset()
    assert not np.array_equal(one["arm"], other["arm"])


def test_the_option_episode_starts_that_episode_of_the_seed():
    """As the streams of a rollout are counted: episode 3 of seed 7, which no other seed has."""
    task = make_task("track_circle")
    episodes = Episodes(task)
    expected = episodes.observe(episodes.seeded(7, 4))["arm"].numpy()
    env, single = SurgicalEnv(task), SingleEnv(task)
    for number in (0, 3):
        seen, _ = env.reset(seed=7, options={"episode": number})
        np.testing.assert_allclose(seen["arm"], expected[number], atol=1e-5)
        seen, _ = single.reset(seed=7, options={"episode": number})
        np.testing.assert_allclose(seen, expected[number], atol=1e-5)
    assert np.abs(env.reset(seed=10)[0]["arm"] - expected[3]).max() > 1e-3
    for one in (env, single):
        with pytest.raises(InputError, match="option 'episode' is -1, expected 0 or more"):
            one.reset(seed=7, options={"episode": -1})
        with pytest.raises(InputError, match="option 'episode' is 2 without a seed; expected both"):
            one.reset(options={"episode": 2})


@one_arm
def test_gymnasium_checker(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # The checker would rather have actions in -1..1; ours are in kPa.
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        check_env(gymnasium.make(f"surgisoft/{name}-v0").unwrapped, skip_render_check=True)


@one_arm
def test_the_batched_environments_are_the_single_ones(name):
    """Environment i of a batch with seed s is the single one with seed s + i."""
    many = gymnasium.make_vec(f"surgisoft/{name}-v0", num_envs=3)
    assert isinstance(many.unwrapped, BatchedEnv)
    singles = [gymnasium.make(f"surgisoft.tasks.single:surgisoft/{name}-v0") for _ in range(3)]
    seen, _ = many.reset(seed=20)
    for i, env in enumerate(singles):
        np.testing.assert_allclose(env.reset(seed=20 + i)[0], seen[i], atol=1e-4)
    rng = np.random.default_rng(1)
    for _ in range(10):
        actions = rng.uniform(-3, 3, (3, 3)).astype(np.float32)
        seen, rewards, *_ = many.step(actions)
        for i, env in enumerate(singles):
            one, reward, *_ = env.step(actions[i])
            np.testing.assert_allclose(one, seen[i], atol=2e-4)
            assert reward == pytest.approx(rewards[i], rel=2e-3, abs=1e-5)


@pytest.mark.parametrize("kind", [list, tuple, np.array])
def test_a_list_of_seeds_has_one_for_each_environment(kind):
    many, single = BatchedEnv("track_circle", 3), SingleEnv("track_circle")
    seen, _ = many.reset(seed=kind([9, 2, 2]))
    for row, seed in zip(seen, (9, 2, 2), strict=True):
        np.testing.assert_allclose(single.reset(seed=seed)[0], row, atol=1e-4)
    assert not np.allclose(seen[0], seen[1])
    fixed, _ = many.reset(seed=[9, None, 2])
    assert np.array_equal(fixed[[0, 2]], seen[[0, 2]])
    assert not np.allclose(fixed[1], seen[1]), "no seed of its own"


@pytest.mark.parametrize(
    ("seed", "told"),
    [
        ("a", "seed is 'a', expected a whole number, 0 or more"),
        (-1, "seed is -1, expected 0 or more"),
        (1.5, "seed is 1.5, expected a whole number"),
        ([1, 2], "seed is a list of 2, expected one for each of 3 environments"),
        ([1, "b", 2], r"seed\[1\] is 'b', expected a whole number"),
        ([1, 2, -3], r"seed\[2\] is -3, expected 0 or more"),
    ],
)
def test_another_seed_is_refused_and_the_episodes_go_on(seed, told):
    many, other = BatchedEnv("track_circle", 3, SHORT), BatchedEnv("track_circle", 3, SHORT)
    for env in (many, other):
        env.reset(seed=4)
    with pytest.raises(InputError, match=told):
        many.reset(seed=seed)
    still = np.zeros((3, 3), np.float32)
    assert np.array_equal(many.step(still)[0], other.step(still)[0])


def test_finished_environments_begin_anew_in_the_same_step():
    many = BatchedEnv("track_circle", 4, SHORT)
    many.reset(seed=0)
    still = np.zeros((4, 3), np.float32)
    for _ in range(14):
        _, _, terminated, truncated, info = many.step(still)
        assert not terminated.any()
        assert not truncated.any()
        assert "final_obs" not in info
    seen, _, terminated, truncated, info = many.step(still)
    assert truncated.all()
    assert not terminated.any()
    assert info["_final_obs"].all()
    assert (info["final_obs"][:, -1] == 1.0).all(), "time observed at the end"
    assert (seen[:, -1] == -1.0).all(), "time observed at the beginning"


def test_a_nan_action_ends_one_environment_only():
    many = BatchedEnv("track_circle", 3)
    many.reset(seed=0)
    actions = np.zeros((3, 3), np.float32)
    actions[1] = np.nan
    seen, rewards, terminated, _, info = many.step(actions)
    assert terminated.tolist() == [False, True, False]
    assert np.isfinite(seen).all()
    assert np.isfinite(rewards).all()
    assert np.isfinite(info["final_obs"]).all()
    assert info["failed"].tolist() == [False, True, False], "the reason"
    assert info["_failed"].all()
    assert not many.step(np.zeros((3, 3), np.float32))[2].any()


@pytest.mark.parametrize("name", ["track_circle", "circle_ablation"])
def test_infos_have_the_measures_that_apply(name):
    """Those that a batch has as numbers: not the error while the reference waits for 0.5 s, nor
    that of a beam that is off."""
    config = SHORT if name == "track_circle" else None
    measure = "error_mm" if name == "track_circle" else "beam_error_mm"
    batch, env = surgisoft.batched_env(name, 1, config=config, seed=4), parallel_env(name, config)
    env.reset(seed=4)
    still = {agent: np.zeros(3, np.float32) for agent in env.possible_agents}
    one, many = [], []
    for _ in range(8):
        *_, infos = env.step(still)
        step = batch.step({agent: value[None] for agent, value in still.items()})
        known = {key for key, value in step.measures.items() if value.isfinite().all()}
        for info in infos.values():
            assert set(step.measures) & set(info) == known
        one.append(infos[env.possible_agents[0]].get(measure))
        many.append(step.measures[measure].item())
    assert [value is None for value in one] == [name != "track_circle" or k < 5 for k in range(8)]
    np.testing.assert_allclose(np.array(one, float), many, rtol=1e-3)
    if name == "track_circle":
        single = SingleEnv(name, config)
        single.reset(seed=4)
        assert measure not in single.step(np.zeros(3, np.float32))[-1]


@pytest.mark.parametrize("geometry", ["fcl", "batched"])
@pytest.mark.parametrize("name", ["track_circle", "circle_ablation"])
def test_infos_say_that_a_nan_action_ended_the_episode(name, geometry):
    env = SurgicalEnv(exact(name, geometry))
    env.reset(seed=0)
    still = {agent: np.zeros(3, np.float32) for agent in env.possible_agents}
    *_, infos = env.step(still)
    assert [infos[agent]["failed"] for agent in still] == [False] * len(still)
    first = env.possible_agents[0]
    *_, ended, _, infos = env.step({**still, first: np.array([np.nan, 0.0, 0.0])})
    assert [ended[agent] for agent in still] == [True] * len(still)
    assert [infos[agent]["failed"] for agent in still] == [True] * len(still)
    if name == "track_circle":
        single = SingleEnv(name)
        single.reset(seed=0)
        assert single.step(np.zeros(3))[4]["failed"] is False
        assert single.step(np.full(3, np.nan))[4]["failed"] is True


@pytest.mark.parametrize("name", ["track_circle", "circle_ablation"])
@pytest.mark.parametrize(
    "action",
    [["1", "2", None], np.array(["1", "2", "3"]), np.array([1j, 0.0, 0.0]), None, [[1.0], [2, 3]]],
    ids=["with None", "digits", "complex", "None", "ragged"],
)
def test_an_action_that_is_no_array_of_real_numbers_is_one_line(name, action):
    env = SurgicalEnv(exact(name))
    env.reset(seed=0)
    with pytest.raises(InputError, match="holds something else than real numbers; expected a ten"):
        env.step(dict.fromkeys(env.possible_agents, action))
    many = surgisoft.batched_env("track_circle", 1)
    with pytest.raises(InputError, match="holds something else than real numbers; expected a ten"):
        many.step({"arm": action})


def test_tensors_with_a_gradient_are_actions():
    env, other = SurgicalEnv(exact("track_circle")), SurgicalEnv(exact("track_circle"))
    env.reset(seed=0)
    other.reset(seed=0)
    seen = env.step({"arm": torch.ones(3, requires_grad=True)})[0]["arm"]
    np.testing.assert_array_equal(seen, other.step({"arm": np.ones(3)})[0]["arm"])


def test_wrong_use_is_one_line():
    env = parallel_env("track_circle")
    with pytest.raises(InputError, match="step before reset"):
        env.step({})
    env.reset()
    with pytest.raises(InputError, match="no action for 'arm'"):
        env.step({"laser": np.zeros(3)})
    with pytest.raises(InputError, match="unknown agent 'laser': known are arm"):
        env.step({"arm": np.zeros(3), "laser": np.zeros(3)})
    with pytest.raises(InputError, match=r"shape \(2,\), expected \(3,\)"):
        env.step({"arm": np.zeros(2)})
    with pytest.raises(InputError, match="actions are of type list, expected a dict of arm"):
        env.step([np.zeros(3)])
    single = SingleEnv("track_circle")
    single.reset(seed=0)
    with pytest.raises(InputError, match=r"shape \(2,\), expected \(3,\)"):
        single.step(np.zeros(2))
    with pytest.raises(InputError, match="step before reset"):
        SingleEnv("track_circle").step(np.zeros(3))


@every_task
@pytest.mark.parametrize("geometry", ["fcl", "batched"])
def test_a_copied_environment_goes_on_as_the_original(name, geometry):
    """In the middle of an episode; SuperSuit and AsyncVectorEnv copy environments."""
    env = SurgicalEnv(exact(name, geometry))
    env.reset(seed=5)
    push = {agent: np.full(3, 1.5, np.float32) for agent in env.agents}
    for _ in range(3):
        env.step(push)
    others = copy.deepcopy(env), pickle.loads(pickle.dumps(env))
    for _ in range(3):
        expected = env.step(push)
        for other in others:
            for one, two in zip(expected, other.step(push), strict=True):
                for agent in push:
                    np.testing.assert_array_equal(one[agent], two[agent])


def test_gymnasium_takes_the_arm_and_refuses_what_it_does_not_know(tmp_path):
    env = gymnasium.make("surgisoft/track_circle-v0", arm="default", geometry="batched")
    plain = gymnasium.make("surgisoft/track_circle-v0")
    np.testing.assert_array_equal(env.reset(seed=4)[0], plain.reset(seed=4)[0])
    many = gymnasium.make_vec("surgisoft/keyhole-v0", num_envs=2, geometry="fcl")
    assert isinstance(many.unwrapped.adapter.task.world.scene.collision, ExactScene)
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(InputError, match="no arm model there"):
            make("surgisoft/track_circle-v0", arm=tmp_path / "none")
        with pytest.raises(InputError, match="this task has no scene"):
            make("surgisoft/track_circle-v0", scene=tmp_path)
        with pytest.raises(TypeError, match="arms"):
            make("surgisoft/track_circle-v0", arms="default")
    with pytest.raises(TypeError, match="num_env"):
        BatchedEnv("track_circle", num_env=3)
    with pytest.raises(InputError, match="num_envs is 0"):
        BatchedEnv("track_circle", 0)
