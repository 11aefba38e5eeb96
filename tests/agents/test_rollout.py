"""Rollouts: what they keep of an episode is compared with steps taken by hand."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from surgisoft.agents.policies import Random, Scripted
from surgisoft.agents.rollout import rollout
from surgisoft.errors import InputError
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.path_following import FollowConfig
from surgisoft.tasks.registry import make_task
from surgisoft.tasks.track import TrackConfig, track_circle

SHORT = TrackConfig(FollowConfig(loop_s=2.0, approach_s=0.5, size_mm=4.0))


@pytest.fixture(scope="module")
def task():
    return track_circle(SHORT)


def test_the_script_follows_and_chance_does_not():
    task = make_task("track_circle")
    script = rollout(task, Scripted(), 2, seed=0)
    chance = rollout(task, Random(), 16, seed=0)
    assert script.mean("error_mm").max() < 1e-4
    assert chance.mean("error_mm").min() > 5.0
    assert script.steps.tolist() == [task.steps] * 2
    assert not (script.terminated | script.failed).any()


def test_the_size_of_a_batch_changes_nothing(task):
    whole = rollout(task, Random(1), 5, seed=2)
    parts = rollout(task, Random(1), 5, seed=2, batch=2)
    single = rollout(task, Random(1), 5, seed=2, batch=1)
    for other in (parts, single):
        torch.testing.assert_close(
            other.measures["error_mm"],
            whole.measures["error_mm"],
            equal_nan=True,
            rtol=1e-4,
            atol=1e-4,
        )
        torch.testing.assert_close(other.returns["arm"], whole.returns["arm"], rtol=1e-4, atol=1e-4)


def test_statistics_are_those_of_an_episode_played_by_hand(task):
    play, policy = Episodes(task), Random()
    state, errors, total = play.seeded(9, 3), [], 0.0
    for _ in range(task.steps):
        state, outcome = play.step(state, policy.act(task, state, play.observe(state)))
        errors.append(outcome.measures["error_mm"])
        total = total + outcome.rewards["arm"]
    seen = torch.stack(errors, 1).numpy()
    found = rollout(task, policy, 3, seed=9)
    torch.testing.assert_close(found.returns["arm"], total)
    for name, expected in {
        "mean": np.nanmean(seen, 1),
        "rms": np.sqrt(np.nanmean(seen**2, 1)),
        "largest": np.nanmax(seen, 1),
        "smallest": np.nanmin(seen, 1),
        "end": seen[:, -1],
    }.items():
        np.testing.assert_allclose(getattr(found, name)("error_mm"), expected, rtol=1e-5)
    np.testing.assert_allclose(
        found.quantile("error_mm", 0.95), np.nanquantile(seen, 0.95, axis=1), rtol=1e-5
    )


class Ending:
    """A task whose episode i is over after `last[i]` steps; everything else is the task's own."""

    def __init__(self, task, last):
        self._task, self.last = task, last

    def __getattr__(self, name):
        return getattr(self._task, name)

    def ended(self, state):
        keys = Episodes(self._task).seeded(0, len(self.last)).world.stream.key
        which = (state.world.stream.key[:, None] == keys).long().argmax(1)
        return state.world.steps >= torch.tensor(self.last)[which]

    def measures(self, state):
        return {"step": state.world.steps.float()}

    def rewards(self, state):
        return {"arm": {"step": torch.ones(len(state.world.steps))}}


def test_an_episode_that_is_over_counts_no_more(task):
    last = [3, 7, 2, 20, 99]
    seen = []
    found = rollout(
        Ending(task, last), Random(), 5, seed=0, watch=lambda now: seen.append(now.live.sum())
    )
    expected = [min(end, task.steps) for end in last]
    assert found.steps.tolist() == expected
    assert found.terminated.tolist() == [True, True, True, True, False]
    assert found.largest("step").tolist() == expected
    assert found.returns["arm"].tolist() == expected
    assert found.end("step").tolist() == expected
    assert found.measures["step"].isfinite().sum(1).tolist() == expected
    assert found.time_s.tolist() == pytest.approx([0.1 * end for end in expected])
    assert [int(live) for live in seen[:3]] == [5, 5, 5]
    assert int(sum(seen[1:])) == sum(expected)


def test_an_episode_that_never_measures_is_nan(task):
    slow = track_circle(replace(SHORT, follow=replace(SHORT.follow, approach_s=5.0)))
    found = rollout(Ending(slow, [2]), Random(), 1, seed=0)
    found.measures["never"] = found.measures["step"] * math.nan
    for statistic in (found.mean, found.rms, found.largest, found.smallest, found.end):
        assert statistic("never").isnan().all()


def test_progress_ends_at_the_total(task):
    seen = []
    rollout(task, Random(), 3, seed=0, batch=2, progress=lambda *at: seen.append(at))
    assert seen[-1] == (2 * task.steps, 2 * task.steps)
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)


def test_no_episodes_is_one_line(task):
    with pytest.raises(InputError, match="0 episodes"):
        rollout(task, Random(), 0, seed=0)


@pytest.mark.parametrize(
    ("action", "says"),
    [
        ({"arm": torch.zeros(1, 3)}, r"action of 'arm' has shape \(1, 3\), expected \(2, 3\)"),
        ({"arm": torch.zeros(2, 2)}, r"action of 'arm' has shape \(2, 2\), expected \(2, 3\)"),
        ({}, "no action for 'arm'"),
    ],
)
def test_an_action_of_another_shape_is_one_line(task, action, says):
    """A step would read what lies behind the numbers of a smaller one."""
    policy = SimpleNamespace(act=lambda *_: action)
    with pytest.raises(InputError, match=says):
        rollout(task, policy, 2, seed=0)
    play = Episodes(task)
    with pytest.raises(InputError, match=says):
        play.step(play.seeded(0, 2), action)


def test_a_policy_may_give_its_actions_as_arrays(task):
    still = SimpleNamespace(act=lambda *_: {"arm": np.zeros((2, 3))})
    same = SimpleNamespace(act=lambda *_: {"arm": torch.zeros(2, 3)})
    one, other = (rollout(task, policy, 2, seed=0).returns["arm"] for policy in (still, same))
    assert torch.equal(one, other)
