"""An episode in kept arrays against the same episode as a batch of one, over whole episodes."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch

from surgisoft.tasks.base import Episodes, TaskState
from surgisoft.tasks.batched import BatchedEnv
from surgisoft.tasks.circle_ablation import CircleAblation, CircleAblationConfig
from surgisoft.tasks.laser_work import LASER, LaserWeights, LaserWorkWeights
from surgisoft.tasks.lone_ring import LoneRing
from surgisoft.tasks.parallel import SurgicalEnv, parallel_env
from surgisoft.tasks.world.arm import Randomisation
from surgisoft.tasks.world.world import WorldConfig, fed

AGREE_MM = 1e-4
"""Largest difference of a key point, a clearance, the end of the beam (mm), or of an observation: a
few steps of float32 at 100 mm."""
LEVER = 4.0
"""Beam and camera point at 60 to 100 mm from the tip, whose direction is that of some 20 mm of arm,
so that offsets from their axes differ by so many times more than key points."""


def both(geometry, change=None):
    """The environment, and one that advances the task's batch of one."""
    env = parallel_env("circle_ablation", geometry=geometry)
    plain = SurgicalEnv(env.task)
    plain.adapter.alone = lambda state: None
    return env, plain


def differences(env, plain, seed, steps, at_work):
    """Largest difference of each kind over an episode whose first steps an expert chooses."""
    rng, worst, fired = np.random.default_rng(seed), {}, 0
    for one in (env, plain):
        one.reset(seed=seed)
    assert isinstance(env.lone, LoneRing)
    with torch.inference_mode():
        for step in range(steps):
            if at_work(step):
                acts = {a: t.numpy()[0] for a, t in env.task.script(plain.task_state).items()}
            else:
                acts = {a: rng.uniform(-1.0, 1.0, 3).astype("f4") for a in plain.agents}
            found, expected = env.step(acts), plain.step(acts)
            assert found[2:4] == expected[2:4]
            for agent, value in expected[0].items():
                assert found[0][agent].dtype == value.dtype
                assert found[4][agent].keys() == expected[4][agent].keys()
                off = np.abs(found[0][agent] - value)
                worst[agent] = max(worst.get(agent, 0.0), float(off.max()))
                off = abs(found[1][agent] - expected[1][agent])
                worst["reward"] = max(worst.get("reward", 0.0), off)
                for name, number in expected[4][agent].items():
                    off = abs(found[4][agent][name] - number)
                    worst[name] = max(worst.get(name, 0.0), off)
            fired += found[4]["laser"]["cut"]
            if not plain.agents:
                break
        lone, batch = env.task_state, plain.task_state
    for name, part in batch.world.arms.items():
        for what in ("points_mm", "line_mm", "pressure", "command"):
            off = (getattr(lone.world.arms[name], what) - getattr(part, what)).abs().max()
            worst[what] = max(worst.get(what, 0.0), float(off))
    scene, other = lone.world.scene, batch.world.scene
    assert torch.equal(scene.hit.struck, other.hit.struck)
    worst["beam"] = float((scene.hit.point_mm - other.hit.point_mm).abs().max())
    worst["dose"] = float((scene.dose.dose - other.dose.dose).abs().max() / other.dose.dose.max())
    assert torch.equal(lone.goal.done, batch.goal.done)
    assert torch.equal(lone.world.steps, batch.world.steps)
    return worst, fired


def assert_alike(worst):
    levers = ("laser", "endoscope", "beam_error_mm", "pointing_error_mm", "beam")
    for name, off in worst.items():
        # A reward term is exp(-e / 0.1 mm): it changes ten times as much as the error e in mm.
        many = {"reward": 10.0 * LEVER, "fine": 10.0 * LEVER, "dose": 10.0 * LEVER}
        limit = AGREE_MM * many.get(name, LEVER if name in levers else 1.0)
        assert off < limit, name


def test_a_whole_episode_at_work_is_that_of_the_task():
    """The expert cuts for a while, then goes on at random; batched geometry.

    The time is out after 220 steps."""
    env, plain = both("batched")
    env.task.steps = plain.task.steps = 220
    worst, fired = differences(env, plain, 3, env.task.steps, lambda k: k < 70)
    assert fired > 20
    assert worst["completion"] < 1e-6
    assert_alike(worst)


def test_an_episode_with_fcl_is_that_of_the_task():
    env, plain = both("fcl")
    worst, fired = differences(env, plain, 5, 150, lambda k: k < 60)
    assert fired > 10
    assert_alike(worst)


def test_an_episode_ends_and_begins_again_as_the_task_says():
    env, plain = both("batched")
    for one in (env, plain):
        one.task.steps = 5
        one.reset(seed=1)
    still = {agent: np.zeros(3, np.float32) for agent in env.agents}
    for _ in range(5):
        *_, truncated, _ = env.step(still)
        *_, expected, _ = plain.step(still)
        assert truncated == expected
    assert env.agents == []
    again, other = env.reset()[0], plain.reset()[0]
    for agent, seen in other.items():
        np.testing.assert_allclose(again[agent], seen, atol=AGREE_MM)
    assert np.array_equal(env.state()[: len(again["laser"])], again["laser"])


@pytest.mark.parametrize("geometry", ["fcl", "batched"])
def test_a_contact_ends_the_episode(geometry):
    """The laser's base is moved along its axis until the arm is in the organ."""
    task = parallel_env("circle_ablation", geometry=geometry).task
    episodes, ends = Episodes(task), []
    state = episodes.seeded(0, 1)
    still = {agent: np.zeros(3, np.float32) for agent in task.agents}
    for way_mm in (30.0, 52.0, 60.0):
        part = fed(state.world.arms["laser"], torch.tensor([way_mm]))
        part = task.world.arms["laser"].posed(part, part.points_mm)
        world = replace(state.world, arms={**state.world.arms, "laser": part})
        begun = TaskState(world, state.goal)
        lone = LoneRing.of(task, begun)
        lone.step(still)
        with torch.inference_mode():
            acts = {agent: torch.zeros(1, 3) for agent in task.agents}
            _, outcome = episodes.step(begun, acts)
        assert lone.terminated == bool(outcome.terminated)
        assert lone.measures["collided"] == outcome.measures["collided"].item()
        off = abs(lone.measures["clearance_mm"] - outcome.measures["clearance_mm"].item())
        assert off < AGREE_MM
        assert lone.terms["laser"]["contact"] == outcome.terms["laser"]["contact"].item()
        ends.append(lone.terminated)
    assert not ends[0]
    assert ends[2]


@pytest.mark.parametrize("vary", [{"noise_mm": 0.1}, {"noise_kPa": 0.1}])
def test_what_has_noise_is_left_to_the_task(vary):
    config = CircleAblationConfig(world=WorldConfig(randomisation=Randomisation(**vary)))
    env = SurgicalEnv(CircleAblation(config))
    env.reset(seed=0)
    assert env.lone is None


def test_gain_delay_and_lesion_of_the_episode_are_kept():
    vary = Randomisation(gain=0.05, delay=3, mount_mm=1.0, mount_rad=0.01, lesion_mm=3.0, lesions=3)
    task = CircleAblation(CircleAblationConfig(world=WorldConfig(randomisation=vary)))
    env, plain = SurgicalEnv(task), SurgicalEnv(task)
    plain.adapter.alone = lambda state: None
    worst, _ = differences(env, plain, 2, 40, lambda k: k < 20)
    assert_alike(worst)


def test_an_arm_that_is_not_finite_fails_the_environment():
    env, plain = both("batched")
    bad = {agent: np.full(3, np.nan, np.float32) for agent in env.possible_agents}
    for one in (env, plain):
        one.reset(seed=0)
    found, expected = env.step(bad), plain.step(bad)
    assert found[2:4] == expected[2:4]
    assert found[1] == expected[1]
    for agent, seen in expected[0].items():
        assert np.array_equal(found[0][agent], seen)
        assert found[4][agent].keys() == expected[4][agent].keys()


@dataclass(frozen=True)
class GentleWeights(LaserWeights):
    """Weights with a term of the user's own."""

    gentle: float = -0.01
    """Sum of the squared pressures of the laser's arm, kPa^2."""


@dataclass(frozen=True)
class GentleWorkWeights(LaserWorkWeights):
    """Weights of both agents."""

    laser: GentleWeights = field(default_factory=GentleWeights)
    """Weights of the laser's reward terms."""


class GentleAblation(CircleAblation):
    """A reward, an end, an observation and a measure of the user's own."""

    name = "gentle_ablation"

    def own_terms(self, state):
        return {LASER: {"gentle": state.world.arms[LASER].pressure.square().sum(1)}}

    def ended(self, state):
        return state.world.steps >= 3

    def observe(self, state):
        return {agent: 0.5 * seen for agent, seen in super().observe(state).items()}

    def measures(self, state):
        return {**super().measures(state), "steps": state.world.steps.float()}


def test_a_task_that_extends_the_class_keeps_its_own_methods():
    """Terms, ends, observations and measures of the adapter are the class's, as in a batch."""
    config = CircleAblationConfig(weights=GentleWorkWeights())
    env, batch = SurgicalEnv(GentleAblation(config)), BatchedEnv(GentleAblation(config), 1, seed=4)
    env.reset(seed=4)
    push = {agent: np.full(3, 2.0, np.float32) for agent in env.agents}
    for step in (1, 2, 3):
        seen, rewards, ends, _, infos = env.step(push)
        expected = batch.step({agent: kPa[None] for agent, kPa in push.items()})
        pressure = env.task_state.world.arms[LASER].pressure.double()
        by_hand = -0.01 * float(pressure.square().sum())
        assert infos[LASER]["gentle"] == pytest.approx(by_hand, rel=1e-5)
        assert infos[LASER]["steps"] == step
        assert ends == dict.fromkeys(push, step == 3)
        for agent, terms in expected.terms.items():
            found = {name: infos[agent][name] for name in terms}
            assert found == pytest.approx({name: float(v) for name, v in terms.items()}, rel=1e-4)
            assert rewards[agent] == pytest.approx(float(expected.rewards[agent]), rel=1e-4)
            wanted = expected.final_observations[agent][0].numpy()
            np.testing.assert_allclose(seen[agent], wanted, atol=AGREE_MM)


def test_a_class_that_changes_nothing_but_its_reward_is_advanced_by_the_task():
    """The documented way: `rewards` overridden, weights as they are."""

    class Mine(CircleAblation):
        name = "mine"

        def rewards(self, state):
            mine = torch.full((len(state.world.steps),), 100.0)
            return {a: {**terms, "mine": mine} for a, terms in super().rewards(state).items()}

    env = SurgicalEnv(Mine())
    env.reset(seed=0)
    _, rewards, _, _, infos = env.step({agent: np.zeros(3, np.float32) for agent in env.agents})
    for agent in (LASER, "endoscope"):
        assert infos[agent]["mine"] == 100.0
        assert 100.0 < rewards[agent] < 106.0
