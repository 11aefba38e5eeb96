"""Tasks on the virtual rig: what is seen, what is true, and what feedback is worth."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.agents.on_rig import RigConfig, on_rig
from surgisoft.agents.policies import Random, Scripted
from surgisoft.agents.rollout import rollout
from surgisoft.errors import InputError
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.circle_ablation import CircleAblation
from surgisoft.tasks.path_following import FollowConfig
from surgisoft.tasks.track import TrackConfig, track_circle
from surgisoft.tasks.world.world import WorldConfig

SHORT = TrackConfig(FollowConfig(loop_s=5.0, approach_s=2.0, size_mm=5.0))


@pytest.fixture(scope="module")
def task():
    return track_circle(SHORT)


def test_cameras_hold_the_arm_to_its_path(task):
    """Specimen 1 is not the one that the model was fitted to."""
    errors = {}
    for cameras in (True, False):
        played = rollout(on_rig(task, RigConfig(seed=1, cameras=cameras)), Scripted(), 2, seed=0)
        errors[cameras] = played.mean("error_mm").max().item()
    assert errors[True] < 0.3
    assert errors[False] > 3 * errors[True]


def test_the_models_own_specimen_is_followed_closely(task):
    played = rollout(on_rig(task), Scripted(), 2, seed=0)
    assert played.mean("error_mm").max() < 0.12
    assert played.mean("error_mm").min() > 0.005, "the rig is no copy of the model"


def test_what_is_seen_is_measured_and_what_is_judged_is_not(task):
    moved = on_rig(task, RigConfig(settle_s=0.5))
    play = Episodes(moved)
    state = play.seeded(3, 1)
    (bench,) = moved.world.arms["arm"]._benches.values()
    told, time_s = bench.told_kPa.copy(), bench.rig.time_s
    state, _ = play.step(state, {"arm": torch.tensor([[1.0, -9.0, 0.5]])})
    part, limit = state.world.arms["arm"], task.arm.pneumatics.step_kPa
    assert bench.rig.time_s - time_s == pytest.approx(task.dt_s)
    np.testing.assert_allclose(bench.told_kPa - told, [1.0, -limit, 0.5], atol=1e-5)
    chamber = torch.tensor(bench.rig._state.chamber, dtype=torch.float32)
    assert 0.0 < (part.seen_kPa[0] - chamber).abs().max() < 0.15
    noise = part.seen_mm - part.points_mm
    assert 0.0 < noise.norm(dim=2).mean() < 0.2
    centres = torch.tensor(bench.rig._state.shape.centres, dtype=torch.float32)
    assert (part.points_mm[0] - centres).norm(dim=1).max() < 0.5


def test_without_noise_cameras_see_the_truth(task):
    state = Episodes(on_rig(task, RigConfig(noise=0.0, settle_s=0.5))).seeded(0, 2)
    part = state.world.arms["arm"]
    torch.testing.assert_close(part.seen_mm, part.points_mm)
    # What is foreseen for the present pressure is what is seen: the offset takes the model there.
    foreseen = task.arm.predict(part, part.pressure, 1e-3)
    torch.testing.assert_close(foreseen, part.seen_mm, atol=2e-2, rtol=0.0)


def test_the_same_seed_is_the_same_episode_in_any_batch(task):
    brief = track_circle(replace(SHORT, follow=replace(SHORT.follow, loop_s=1.0, approach_s=0.5)))
    moved = on_rig(brief, RigConfig(settle_s=0.5))
    whole = rollout(moved, Random(), 3, seed=5)
    single = rollout(on_rig(brief, RigConfig(settle_s=0.5)), Random(), 3, seed=5, batch=1)
    torch.testing.assert_close(
        whole.measures["error_mm"],
        single.measures["error_mm"],
        equal_nan=True,
        rtol=1e-4,
        atol=1e-4,
    )
    other = rollout(on_rig(brief, RigConfig(seed=2, settle_s=0.5)), Random(), 3, seed=5)
    assert (other.mean("error_mm") - whole.mean("error_mm")).abs().min() > 0.01


def test_each_arm_of_a_task_has_a_bench_of_its_own():
    task = CircleAblation()
    moved = on_rig(task, RigConfig(settle_s=0.2))
    state = Episodes(moved).seeded(0, 1)
    drawn = Random().act(moved, state, {})
    for _ in range(3):
        state, outcome = Episodes(moved).step(state, drawn)
    benches = [next(iter(arm._benches.values())) for arm in moved.world.arms.values()]
    assert benches[0].rig is not benches[1].rig
    assert not np.allclose(benches[0].told_kPa, benches[1].told_kPa)
    assert outcome.measures["clearance_mm"].isfinite().all()
    laser = state.world.arms["laser"]
    base = task.world.arms["laser"].pose[:3, 3]
    assert (laser.seen_mm[0, 0] - base).norm() < 1.0, "key points are in the world's frame"
    assert task.world.arms["laser"] is not moved.world.arms["laser"]


def test_a_step_that_the_rig_cannot_keep_is_one_line():
    task = track_circle(TrackConfig(world=WorldConfig(dt_s=0.08)))
    with pytest.raises(InputError, match=r"0\.08 s; on the rig expected a multiple of its 0\.05"):
        on_rig(task)
    with pytest.raises(InputError, match="trust is 2"):
        RigConfig(trust=2.0)
