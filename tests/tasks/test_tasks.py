"""Promises that every task keeps, and each task's numbers by hand."""

import copy
import math
import re
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch

from surgisoft.config import to_table
from surgisoft.errors import InputError
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.checkpoint import default_arm, save_model
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import ConstantCurvature
from surgisoft.tasks.base import OBSERVATION_LIMIT, Episodes
from surgisoft.tasks.circle_ablation import CircleAblationConfig
from surgisoft.tasks.inverse_kinematics import least_squares
from surgisoft.tasks.laser_plane import LaserPlaneConfig, laser_plane, on_plane
from surgisoft.tasks.path_following import FollowConfig, FollowWeights
from surgisoft.tasks.registry import (
    TASKS,
    config_from,
    config_of,
    make_task,
    read_config,
    with_fields,
)
from surgisoft.tasks.track import TrackConfig, track_circle
from surgisoft.tasks.track_body import TrackBody, TrackBodyConfig
from surgisoft.tasks.trajectories.closed_path import (
    RingCut,
    Traversal,
    circle,
    draw_cut,
    draw_traversal,
    point_on_closed,
    square,
)
from surgisoft.tasks.world.arm import Randomisation
from surgisoft.tasks.world.pytree import ObjectBatch, rows, tree_map, with_rows
from surgisoft.tasks.world.random_streams import streams
from surgisoft.tasks.world.scene import SceneEngineConfig
from surgisoft.tasks.world.world import WorldConfig


@lru_cache
def task_of(name):
    """Tasks hold no state: one of each serves every test."""
    return make_task(name)


every_task = pytest.mark.parametrize("name", TASKS)


def random_actions(task, count, seed):
    rng = torch.Generator().manual_seed(seed)
    return {
        agent: 3.0 * torch.randn(count, task.world.arms[agent].chambers, generator=rng)
        for agent in task.agents
    }


def played(episodes, count, steps, seed=0):
    """State, rewards and observations after some random steps."""
    state, total, seen = episodes.seeded(seed, count), 0.0, []
    for step in range(steps):
        state, outcome = episodes.step(state, random_actions(episodes.task, count, step))
        total = total + torch.stack([*outcome.rewards.values()])
        seen.append(episodes.observe(state))
    return state, total, seen


@every_task
def test_the_configuration_of_a_task_is_whole(name):
    assert task_of(name).config == config_of(name)


@every_task
def test_a_batch_of_n_is_n_batches_of_one(name):
    """To rounding: matrix products of other sizes add up in another order; a beam has a lever."""
    episodes = Episodes(task_of(name))
    together = episodes.seeded(3, 3)
    alone = [episodes.seeded(3, 1, first=i) for i in range(3)]
    for step in range(5):
        actions = random_actions(episodes.task, 3, step)
        together, outcome = episodes.step(together, actions)
        seen = episodes.observe(together)
        for i in range(3):
            own = {agent: value[i : i + 1] for agent, value in actions.items()}
            alone[i], one = episodes.step(alone[i], own)
            for agent in episodes.task.agents:
                torch.testing.assert_close(
                    one.rewards[agent][0], outcome.rewards[agent][i], rtol=1e-3, atol=1e-5
                )
                torch.testing.assert_close(
                    episodes.observe(alone[i])[agent][0], seen[agent][i], rtol=1e-4, atol=1e-3
                )


@every_task
def test_the_same_seed_gives_the_same_episode_to_the_last_step(name):
    episodes = Episodes(task_of(name))
    steps = 15
    (_, total, seen), (_, again, seen_again) = (played(episodes, 3, steps, seed=8) for _ in "ab")
    assert torch.equal(total, again)
    for one, other in zip(seen, seen_again, strict=True):
        for agent in episodes.task.agents:
            assert torch.equal(one[agent], other[agent])
    assert not torch.equal(played(episodes, 3, 1)[1], played(episodes, 3, 1, seed=9)[1])


@every_task
def test_every_condition_of_a_phase_is_a_decision_for_each_episode(name):
    task = task_of(name)
    state = Episodes(task).seeded(0, 2)
    for condition in TASKS[name].experiment.conditions.values():
        held = condition.holds(task, state, condition.within)
        assert (held.dtype, held.shape) == (torch.bool, (2,))


@every_task
def test_time_is_out_at_the_end_and_not_before(name):
    task = copy.copy(task_of(name))
    if task.world.scene is not None:  # a whole episode takes seconds there
        assert task.steps > 200
        task.steps = 20
    episodes = Episodes(task)
    state = episodes.seeded(0, 2)
    still = {a: torch.zeros(2, episodes.task.world.arms[a].chambers) for a in episodes.task.agents}
    for step in range(1, episodes.task.steps + 1):
        state, outcome = episodes.step(state, still)
        assert not outcome.terminated.any()
        assert outcome.truncated.tolist() == [step == episodes.task.steps] * 2


@every_task
def test_reset_begins_anew_only_where_asked(name):
    episodes = Episodes(task_of(name))
    state, _, _ = played(episodes, 3, 8)
    before = tree_map(torch.clone, state)
    after = episodes.reset(state, torch.tensor([False, True, False]))
    kept = torch.tensor([0, 2])
    for agent, seen in episodes.observe(after).items():
        assert torch.equal(seen[kept], episodes.observe(before)[agent][kept])
    assert after.world.steps.tolist() == [8, 0, 8]
    twice = episodes.reset(after, torch.tensor([False, True, False]))
    assert not torch.equal(
        twice.world.arms[episodes.task.agents[0]].pressure[1],
        after.world.arms[episodes.task.agents[0]].pressure[1],
    ), "a reset that always returns to the same first state"
    assert torch.equal(state.world.steps, before.world.steps)


@every_task
def test_a_diverged_environment_ends_and_poisons_nobody(name):
    episodes = Episodes(task_of(name))
    good = bad = episodes.seeded(1, 3)
    for step in range(6):
        actions = random_actions(episodes.task, 3, step)
        good, fine = episodes.step(good, actions)
        if step == 3:
            actions = {agent: value.index_fill(0, torch.tensor([1]), math.nan)
                       for agent, value in actions.items()}  # fmt: skip
        bad, outcome = episodes.step(bad, actions)
    assert outcome.terminated.tolist() == [False, True, False]
    for agent, reward in outcome.rewards.items():
        assert torch.equal(reward[[0, 2]], fine.rewards[agent][[0, 2]])
        assert reward[1] == 0.0
    for agent, seen in episodes.observe(bad).items():
        assert seen.isfinite().all()
        assert torch.equal(seen[[0, 2]], episodes.observe(good)[agent][[0, 2]])
    healed = episodes.reset(bad, outcome.done)
    _, outcome = episodes.step(healed, random_actions(episodes.task, 3, 99))
    assert not outcome.done.any()
    assert all(reward[1] > 0.0 for reward in outcome.rewards.values())


@every_task
def test_observations_are_of_order_one_and_asking_changes_nothing(name):
    episodes = Episodes(task_of(name))
    state, _, seen = played(episodes, 16, 40)
    for values in seen:
        for value in values.values():
            assert value.dtype == torch.float32
            assert value.abs().max() < OBSERVATION_LIMIT
    for agent, value in episodes.observe(state).items():
        assert torch.equal(value, episodes.observe(state)[agent])
        value.zero_()
        assert episodes.observe(state)[agent].abs().max() > 0.0


@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("track_circle", {"loop_s": 10.0}),
        ("track_square", {}),
        ("laser_plane", {"loop_s": 10.0}),
        ("track_body", {"time_s": 10.0}),
    ],
)
def test_the_script_follows_to_a_hundredth_of_a_millimetre(name, fields):
    """Mean over whole episodes from all sides; largest where a chamber turns its direction.

    Paths without corners at twice their speed, which is harder.
    """
    episodes = Episodes(make_task(name, with_fields(config_of(name), **fields)))
    errors = []
    with torch.inference_mode():
        state = episodes.seeded(0, 4)
        for _ in range(episodes.task.steps):
            action = episodes.task.script(state)
            assert all((value.abs() <= 3.0 + 1e-3).all() for value in action.values())
            state, outcome = episodes.step(state, action)
            errors.append(outcome.measures["error_mm"])
    errors = torch.stack(errors)
    assert errors.isnan().sum(0).tolist() == [episodes.task.approach] * 4
    assert errors.nanmean() < 0.005
    assert errors.nan_to_num().max() < 0.15


def test_reward_by_hand():
    """Error 0.3 mm: exp(-0.3) and exp(-0.3 / 0.1); the paper's reward has the first term only."""
    task = track_circle()
    state = Episodes(task).seeded(0, 1)
    arm = state.world.arms["arm"]
    target = task.target_mm(state)
    points = arm.points_mm.clone()
    points[:, -1] = target + torch.tensor([[0.1, -0.2, 0.2]])
    world = replace(state.world, arms={"arm": replace(arm, points_mm=points)})
    terms = task.rewards(replace(state, world=world))["arm"]
    assert terms["track"].item() == pytest.approx(math.exp(-0.3), rel=1e-4)
    assert terms["fine"].item() == pytest.approx(math.exp(-3.0), rel=1e-3)
    paper = track_circle(TrackConfig(FollowConfig(weights=FollowWeights(fine=0.0))))
    assert set(paper.rewards(Episodes(paper).seeded(0, 1))["arm"]) == {"track"}


def test_the_target_goes_round_once_at_even_speed():
    task = track_circle(TrackConfig(FollowConfig(any_start=False)))
    state = Episodes(task).seeded(0, 1)
    path = []
    for step in range(task.steps + 1):
        now = replace(state, world=replace(state.world, steps=torch.tensor([step])))
        path.append(task.target_mm(now)[0])
    path = torch.stack(path).double()
    assert (path[:31] == path[0]).all(), "waits for 3 s"
    torch.testing.assert_close(path[-1], path[0], rtol=0, atol=1e-4)
    steps = (path[31:] - path[30:-1]).norm(dim=1)
    chord = 20.0 * math.sin(math.pi / 200)
    np.testing.assert_allclose(steps, chord, atol=2e-4)
    np.testing.assert_allclose((path[:, :2] - task.centre[:2]).norm(dim=1), 10.0, atol=1e-4)
    assert (path[:, 2] == path[0, 2]).all()
    assert path[30 + 50, 1] - task.centre[1] == pytest.approx(10.0, abs=1e-4)


@pytest.mark.parametrize("mean_kPa", [20.0, 50.0])
def test_the_bodys_target_is_a_shape_of_the_arm_by_hand(mean_kPa):
    """Two sine waves of 12 s and 7 s, cut off at the range, given to the arm model alone."""
    task, cut = TrackBody(TrackBodyConfig(mean_kPa=mean_kPa)), 0
    state = Episodes(task).seeded(4, 2)
    phase, model = state.goal.phase.double(), default_arm()
    for step, moved_s in ((10, 0.0), (30, 0.0), (91, 6.1)):
        now = replace(state, world=replace(state.world, steps=torch.full((2,), step)))
        wave = [
            15.0 * share * (2.0 * math.pi * (moved_s / period + phase[:, i])).sin()
            for i, (share, period) in enumerate(((0.6, 12.0), (0.4, 7.0)))
        ]
        asked = (mean_kPa + sum(wave)).float()
        pressure = asked.clamp(task.arm.low, task.arm.high)
        cut += int((pressure != asked).sum())
        still = model.initial_state(2, pressure)
        _, points = model.step(still, torch.zeros(2, 3), 0.1)
        torch.testing.assert_close(task.target_mm(now), points, rtol=0, atol=2e-3)
        own = now.world.arms["arm"].points_mm
        gap = (own - points).norm(dim=2)[:, 1:]
        torch.testing.assert_close(task.errors_mm(now), gap, rtol=0, atol=4e-3)
    assert (cut > 0) == (mean_kPa == 50.0)


def test_reward_and_errors_of_a_body_by_hand():
    """Key points that lie 0.1, 0.2, 0.3 ... mm from their targets, the base where it is."""
    task = TrackBody()
    state = Episodes(task).seeded(4, 1)
    steps = torch.tensor([task.approach + 5])
    state = replace(state, world=replace(state.world, steps=steps))
    points = task.target_mm(state)
    count = points.shape[1] - 1
    points[0, 1:, 0] += 0.1 * torch.arange(1.0, count + 1.0)
    part = replace(state.world.arms["arm"], points_mm=points)
    state = replace(state, world=replace(state.world, arms={"arm": part}))
    mean = 0.1 * (count + 1) / 2
    terms, measures = task.rewards(state)["arm"], task.measures(state)
    assert terms["body"].item() == pytest.approx(math.exp(-mean), rel=1e-4)
    assert terms["fine"].item() == pytest.approx(math.exp(-mean / 0.1), rel=1e-3)
    assert measures["error_mm"].item() == pytest.approx(mean, rel=1e-4)
    assert measures["tip_mm"].item() == pytest.approx(0.1 * count, rel=1e-4)


def test_where_a_reference_is_on_its_path_by_hand():
    """It waits for 5 steps and goes round in 20; a cut goes on where the beam was on, in 10."""
    start, direction = torch.tensor([0.25, 0.25]), torch.tensor([1.0, -1.0])
    traversal = Traversal(start, direction)
    for step, moved in ((0, 0.0), (5, 0.0), (6, 0.05), (15, 0.5), (25, 1.0)):
        found = traversal.share(torch.full((2,), step), 5, 20)
        np.testing.assert_allclose(found, [0.25 + moved, 0.25 - moved], atol=1e-6)
    cut = RingCut(start, direction, torch.tensor([3, 3]), torch.zeros(2, dtype=torch.bool))
    np.testing.assert_allclose(cut.share(10), [0.55, -0.05], atol=1e-6)
    np.testing.assert_allclose(cut.share(10, 2), [0.75, -0.25], atol=1e-6)
    on = torch.tensor([True, False])
    after = cut.after(on)
    assert after.done.tolist() == [4, 3]
    assert torch.equal(after.fired, on)
    stream = streams(0, 300)
    _, fixed = draw_traversal(stream, False)
    assert set(fixed.start.tolist()) == {0.0}
    assert set(fixed.direction.tolist()) == {1.0}
    for drawn in (draw_traversal(stream, True)[1], draw_cut(stream)[1]):
        assert 0.4 < drawn.start.mean() < 0.6
        assert 100 < (drawn.direction > 0.0).sum() < 200
        assert set(drawn.direction.tolist()) == {1.0, -1.0}


def test_a_point_on_a_closed_path_by_hand():
    """A square of 4 corners 2 mm apart, and one at 10 mm: halves lie between corners, ends meet."""
    square_mm = torch.tensor([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
    paths = torch.stack((square_mm, square_mm + 10.0))
    which = torch.tensor([0, 0, 0, 1, 0, 0])
    share = torch.tensor([0.0, 0.125, 0.875, 0.25, 1.25, -0.125])
    found = point_on_closed(paths, which, share)
    expected = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [12, 10, 10], [2, 0, 0], [0, 1, 0]]
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_paths_by_hand():
    share = torch.tensor([0.0, 0.125, 0.25, 0.375, 0.5, 0.875, 1.0, -0.125])
    expected = [[0.5, 0], [0.5, 0.5], [0, 0.5], [-0.5, 0.5], [-0.5, 0], [0.5, -0.5], [0.5, 0],
                [0.5, -0.5]]  # fmt: skip
    torch.testing.assert_close(square(share), torch.tensor(expected))
    whole = square(torch.linspace(0, 1, 4001, dtype=torch.float64))
    assert (whole[1:] - whole[:-1]).norm(dim=1).sum().item() == pytest.approx(4.0, rel=1e-9)
    torch.testing.assert_close(
        circle(torch.tensor([0.0, 0.25])), torch.tensor([[0.5, 0.0], [0.0, 0.5]])
    )


def test_the_beam_meets_the_plane_by_hand():
    origin = torch.tensor([[1.0, 2.0, 70.0]] * 3)
    aim = torch.tensor([[0.6, 0.0, 0.8], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    spot = on_plane(origin, aim, 110.0)
    torch.testing.assert_close(spot[0], torch.tensor([31.0, 2.0, 110.0]))
    assert spot.isfinite().all()
    torch.testing.assert_close(spot[1], torch.tensor([1.0, -398.0, 70.0]))


def test_the_plane_is_where_the_config_states():
    near, far = (laser_plane(LaserPlaneConfig(distance_mm=d)) for d in (30.0, 55.0))
    assert (far.centre - near.centre)[2].item() == pytest.approx(25.0, abs=1e-4)


def test_the_predicted_error_is_that_of_a_step_without_action():
    """Simulated: commands held, pumps still catching up, chambers reversing, the target moving."""
    task = track_circle()
    episodes = Episodes(task)
    state, _, _ = played(episodes, 64, task.approach + 10)
    assert (task.target_mm(state, 1) - task.target_mm(state)).norm(dim=1).min() > 0.1
    predicted = episodes.observe(state)["arm"][:, 27:30].sinh() * task.config.follow.fine_mm
    after, _ = episodes.step(state, {"arm": torch.zeros(64, 3)})
    tip = after.world.arms["arm"].points_mm[:, -1]
    torch.testing.assert_close(predicted, task.target_mm(after) - tip, rtol=1e-4, atol=1e-4)


def test_errors_ahead_by_hand():
    """In both scales, of targets that move by more in two steps than in one."""
    task = track_circle()
    episodes = Episodes(task)
    state, _, _ = played(episodes, 4, task.approach + 10)
    (blocks,) = task.blocks(state).values()
    seen = {block.name: value for block, value in blocks.items()}
    tip = state.world.arms["arm"].points_mm[:, -1]
    for ahead, (wide, fine) in enumerate(
        (("error", "fine_error"), ("error_1", "fine_error_1"), ("error_2", None))
    ):
        off = task.target_mm(state, ahead) - tip
        torch.testing.assert_close(seen[wide], off.asinh())
        if fine is not None:
            torch.testing.assert_close(seen[fine], (off / 0.1).asinh(), rtol=1e-4, atol=1e-4)


def test_the_history_holds_the_last_steps_newest_first():
    """Pressures by the pumps' lag, movements from the key points; nothing before the episode."""
    task = track_circle()
    episodes = Episodes(task)
    state, tips, changes = episodes.seeded(2, 5), [], []
    assert not episodes.observe(state)["arm"][:, -13:-1].any()
    share = 1.0 - math.exp(-0.1 / 0.2)
    for step in range(3):
        part, action = state.world.arms["arm"], 0.7 * (-1.0) ** step
        changes.append(share * (part.command + action - part.pressure))
        tips.append(part.points_mm[:, -1])
        state, _ = episodes.step(state, {"arm": torch.full((5, 3), action)})
    tips.append(state.world.arms["arm"].points_mm[:, -1])
    history = episodes.observe(state)["arm"][:, -13:-1]
    by_hand = (changes[2], changes[1], tips[3] - tips[2], tips[2] - tips[1])
    torch.testing.assert_close(history, torch.cat(by_hand, 1), rtol=0, atol=1e-4)
    anew = episodes.reset(state, torch.tensor([True] + 4 * [False]))
    kept = episodes.observe(anew)["arm"][:, -13:-1]
    assert not kept[0].any()
    assert torch.equal(kept[1:], history[1:])
    without = Episodes(
        track_circle(TrackConfig(FollowConfig(history_steps=0, one_step_prediction=False)))
    )
    plain, own = (play.observe(play.seeded(2, 5))["arm"] for play in (without, episodes))
    assert torch.equal(plain, torch.cat((own[:, :27], own[:, 30:-13], own[:, -1:]), 1))


def test_noise_is_seen_but_not_scored():
    vary = Randomisation(noise_mm=0.5, noise_kPa=0.3)
    noisy = Episodes(track_circle(TrackConfig(world=WorldConfig(randomisation=vary))))
    plain = Episodes(track_circle())
    a, b = noisy.seeded(0, 500), plain.seeded(0, 500)
    torch.testing.assert_close(a.world.arms["arm"].points_mm, b.world.arms["arm"].points_mm)
    still = {"arm": torch.zeros(500, 3)}
    (a, one), (b, other) = noisy.step(a, still), plain.step(b, still)
    torch.testing.assert_close(one.rewards["arm"], other.rewards["arm"])
    blocks = [e.task.blocks(s)["arm"] for e, s in ((noisy, a), (plain, b))]
    more = {block.name: value - blocks[1][block] for block, value in blocks[0].items()}
    newest, half = more["pressure_history"][:, :3], 0.5 * (plain.task.arm.high - plain.task.arm.low)
    assert newest.std().item() == pytest.approx(0.3 * 2**0.5, rel=0.1)
    assert (half * more["pressure"]).std().item() == pytest.approx(0.3, rel=0.1)
    part = a.world.arms["arm"]
    assert (part.seen_mm - part.points_mm).std().item() == pytest.approx(0.5, rel=0.05)
    assert (part.seen_kPa - part.pressure).std().item() == pytest.approx(0.3, rel=0.1)
    error = noisy.observe(a)["arm"][:, 12:15].sinh() - plain.observe(b)["arm"][:, 12:15].sinh()
    assert error.std().item() == pytest.approx(0.5, rel=0.05)
    predicted, truly = (e.observe(s)["arm"][:, 27:30].sinh() for e, s in ((noisy, a), (plain, b)))
    assert (0.1 * (predicted - truly)).std().item() == pytest.approx(0.5, rel=0.05)


def test_randomised_mounts_and_gains_have_the_asked_spread():
    vary = Randomisation(mount_mm=2.0, mount_rad=0.05, gain=0.1)
    task = track_circle(TrackConfig(world=WorldConfig(randomisation=vary)))
    part = task.world.start(streams(0, 2000)).arms["arm"]
    assert part.mount[:, :3, 3].std().item() == pytest.approx(2.0, rel=0.05)
    rotation = part.mount[:, :3, :3]
    turn = 0.5 * (rotation - rotation.mT)[:, [2, 0, 1], [1, 2, 0]]
    assert turn.std().item() == pytest.approx(0.05, rel=0.05)
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand(2000, 3, 3))
    assert (part.gain - 1.0).std().item() == pytest.approx(0.1, rel=0.05)


def test_least_squares_finds_the_constrained_minimum():
    """x^2 + y^2 = 25, x = 3 from many places; and one whose optimum lies on the box."""

    def residual(p):
        return torch.stack((p.square().sum(1) - 25.0, 3.0 * (p[:, 0] - 3.0)), 1)

    start = torch.tensor([[1.0, 1.0], [6.0, 2.0], [0.5, 7.0]])
    bound = torch.full_like(start, 10.0)
    found = least_squares(residual, start, -bound, bound, iterations=15)
    torch.testing.assert_close(found, torch.tensor([[3.0, 4.0]] * 3), rtol=1e-4, atol=1e-4)
    # Beside the 16 that remain, single precision does not see an error below 1e-3.
    low, high = torch.zeros(1, 2), torch.ones(1, 2)
    found = least_squares(lambda p: p - torch.tensor([[0.3, 5.0]]), 0.5 * high, low, high)
    torch.testing.assert_close(found, torch.tensor([[0.3, 1.0]]), rtol=0, atol=1e-3)


def test_the_script_is_the_same_for_one_and_for_many():
    episodes = Episodes(track_circle())
    state, _, _ = played(episodes, 5, 10)
    together = episodes.task.script(state)["arm"]
    for i in range(5):
        alone = episodes.task.script(rows(state, torch.tensor([i])))["arm"]
        torch.testing.assert_close(alone[0], together[i], rtol=0, atol=0.02)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: make_task("track_cirle"), "track_cirle.*track_circle"),
        (lambda: FollowConfig(path="star"), "star.*circle.*square"),
        (lambda: FollowConfig(size_mm=-1.0), "size_mm is -1.0"),
        (lambda: FollowConfig(loop_s=math.nan), "loop_s is nan"),
        (lambda: FollowConfig(approach_s=-1.0), "approach_s is -1.0, expected 0 or more"),
        (lambda: TrackBodyConfig(approach_s=math.nan), "approach_s is nan"),
        (lambda: SceneEngineConfig(view_points=0), "view_points is 0, expected above 0"),
        (lambda: SceneEngineConfig(band_mm=-1.0), "band_mm is -1.0, expected above 0"),
        (lambda: FollowConfig(history_steps=-1), "history_steps is -1"),
        (lambda: LaserPlaneConfig(distance_mm=0.0), "distance_mm is 0.0"),
        (lambda: TrackBodyConfig(slow_s=0.0), "slow_s is 0.0"),
    ],
)
def test_bad_input_is_one_line(make, message):
    with pytest.raises(InputError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["track_circle", "laser_plane", "circle_ablation"])
def test_another_arm_model_takes_the_default_ones_place(name, tmp_path):
    """A saved model with six key points in place of five."""
    spec = ArmSpec(3, 6, (0.0,) * 3, (40.0,) * 3, length_mm=70.0)
    low, high = torch.zeros(3), torch.full((3,), 40.0)
    rest = torch.tensor([[0.0, 0.0, 14.0 * k] for k in range(6)])
    model = ArmModel(spec, ConstantCurvature(low, high, key_points=6), rest_mm=rest)
    save_model(model, tmp_path / "arm")
    kind = {"track_circle": TrackConfig, "laser_plane": LaserPlaneConfig}.get(name)
    arm = str(tmp_path / "arm")
    config = kind(FollowConfig(arm=arm)) if kind else CircleAblationConfig(arm=arm)
    task = make_task(name, config)
    for agent in task.agents:
        assert task.world.arms[agent].key_points == 6
    with pytest.raises(InputError, match="no arm model there"):
        make_task(name, kind(FollowConfig(arm="no/arm")) if kind else CircleAblationConfig(arm="x"))


def reward_terms(name, config=None):
    """Weighted terms of one random step, agent -> term -> (B,)."""
    episodes = Episodes(task_of(name) if config is None else make_task(name, config))
    state = episodes.seeded(2, 3)
    _, outcome = episodes.step(state, random_actions(episodes.task, 3, 0))
    return outcome.terms


@every_task
def test_a_weight_scales_its_reward_term_and_no_other(name):
    """The first term of each agent, by factors that differ between agents; 0 leaves it out."""
    usual, own = reward_terms(name), to_table(config_of(name))
    tables = {"follow": own["follow"]} if "follow" in own else {"": own}
    ((part, table),) = tables.items()
    first = {agent: next(iter(terms)) for agent, terms in usual.items()}
    trebled = {agent: 3.0 + number for number, agent in enumerate(usual)}
    absent = {agent: 0.0 if len(terms) > 1 else 2.0 for agent, terms in usual.items()}
    for factors in (trebled, absent) if 0.0 in absent.values() else (trebled,):
        weights = {}
        for agent, term in first.items():
            own_weights = table["weights"].get(agent, table["weights"])
            change = {term: factors[agent] * own_weights[term]}
            weights |= {agent: change} if agent in table["weights"] else change
        change = {"weights": weights}
        config = config_from(name, {part: change} if part else change, Path("x.toml"))
        changed = reward_terms(name, config)
        assert changed.keys() == usual.keys()
        for agent, terms in usual.items():
            left_out = {first[agent]} if factors[agent] == 0.0 else set()
            assert changed[agent].keys() == terms.keys() - left_out
            for other, value in changed[agent].items():
                factor = factors[agent] if other == first[agent] else 1.0
                torch.testing.assert_close(value, terms[other] * factor, rtol=1e-6, atol=1e-6)


def test_rewards_of_the_keyhole_by_hand():
    """3 for each target reached, -1 for contact, as before the weights had names."""
    weights = config_of("keyhole").weights
    assert (weights.way, weights.near, weights.visits, weights.contact) == (1.0, 1.0, 3.0, -1.0)


def test_field_names_of_earlier_versions_are_accepted(tmp_path):
    file = tmp_path / "old.toml"
    file.write_text(
        "[follow]\nrecall = 0\nforesight = false\nfine_weight = 0.25\n"
        "[world.scenery]\ngeometry = 'fcl'\n"
    )
    config = read_config("track_square", file)
    follow = config.follow
    assert (follow.history_steps, follow.one_step_prediction) == (0, False)
    assert follow.weights == FollowWeights(track=1.0, fine=0.25)
    assert config.world.scene_engine.geometry == "fcl"
    assert follow.path == "square", "the task's own default stays"
    file.write_text("[follow]\nrecal = 0\n")
    with pytest.raises(InputError, match=r"old\.toml.*recal"):
        read_config("track_square", file)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[follow.weights]\nfine = nan\n", "finite"),
        ("[follow.weights]\nfine = 0.0\ntrack = 0.0\n", "all reward weights are 0"),
        ("[follow.weights]\nspeed = 1.0\n", "speed"),
    ],
)
def test_wrong_weights_are_one_line(text, says, tmp_path):
    file = tmp_path / "weights.toml"
    file.write_text(text)
    with pytest.raises(InputError, match=says) as caught:
        read_config("track_circle", file)
    assert "\n" not in str(caught.value)
    assert "weights.toml" in str(caught.value)


def test_objects_of_a_state_are_selected_and_replaced_with_its_rows():
    """An arm on a rig keeps a simulated plant for each environment beside its tensors."""
    part = track_circle().world.start(streams(0, 3)).arms["arm"]
    a, b, c, d = (object() for _ in "abcd")
    part = replace(part, plant=ObjectBatch((a, b, c)))
    index = torch.tensor([2, 0])
    assert rows(part, index).plant.items == (c, a)
    fresh = replace(rows(part, torch.tensor([1])), plant=ObjectBatch((d,)))
    changed = with_rows(part, torch.tensor([1]), fresh)
    assert changed.plant.items == (a, d, c)
    assert part.plant.items == (a, b, c)
    assert tree_map(torch.clone, part).plant is part.plant


def test_the_fine_term_has_its_own_scale():
    """exp(-e) and exp(-e / fine_mm) of `FollowWeights`, for e from the state itself."""
    task = make_task("track_circle")
    state = Episodes(task).seeded(0, 4)
    error, reward = task.error_mm(state), task.rewards(state)["arm"]
    near = task.config.follow.fine_mm
    assert near != 1.0
    torch.testing.assert_close(reward["track"], torch.exp(-error))
    torch.testing.assert_close(reward["fine"], torch.exp(-error / near))


def test_a_reference_moves_for_a_step_at_least():
    """The step is 0.1 s. Less than half of one was rounded to none, which left the approach."""
    config = with_fields(config_of("track_body"), time_s=0.04)
    message = "track_body: time_s is 0.04 s, expected at least a step, 0.1 s"
    with pytest.raises(InputError, match=re.escape(message)):
        make_task("track_body", config)
    assert make_task("track_body", with_fields(config, time_s=0.1, approach_s=0.0)).steps == 1


@pytest.mark.parametrize("change", [{"loop_s": 1e308}, {"loops": 2**62}])
def test_an_episode_without_end_is_one_line(change):
    """As a damaged config.json of a training run asks for it."""
    config = with_fields(config_of("track_circle"), **change)
    with pytest.raises(InputError, match="an episode of more than 10,000,000 steps"):
        make_task("track_circle", config)


@pytest.mark.parametrize("name", ["track_circle", "track_square", "laser_plane", "track_body"])
def test_no_reference_begins_before_its_episode(name):
    """The reference waits for a time, or moves at once; steps before the first one do not exist."""
    at_once = make_task(name, with_fields(config_of(name), approach_s=0.0))
    assert make_task(name).steps - at_once.steps == 30
    for wrong in (-1.0, float("nan")):
        with pytest.raises(InputError, match=f"approach_s is {wrong}, expected 0 or more"):
            with_fields(config_of(name), approach_s=wrong)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt_s": 1_000_000.0}, "an episode of no step; expected longer times or a shorter"),
        ({"loop_s": 0.01}, "loop_s is 0.01 s, expected at least a step, 0.1 s"),
        ({"samples": 10**9}, "world.samples is 1000000000, expected at most 1,000"),
        ({"history": 1001}, "world.randomisation.history is 1001"),
        ({"preview": 10**9}, "preview is 1000000000"),
    ],
)
def test_a_configuration_that_claims_too_much_is_one_line(change, message):
    """Found by the fuzzer in damaged config.json of training runs."""
    config = with_fields(config_of("track_circle"), **change)
    with pytest.raises(InputError, match=f"track_circle: .*{re.escape(message)}"):
        make_task("track_circle", config)
