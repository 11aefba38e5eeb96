"""Tasks on the virtual rig: measurements, the truth beside them, and what feedback is worth."""

import gc
import re
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.agents.on_rig import RigConfig, at_benches, named_rig, on_rig, real_benches, rigs_in
from surgisoft.agents.policies import Random, Scripted
from surgisoft.agents.rollout import rollout
from surgisoft.agents.session import evaluate
from surgisoft.errors import InputError
from surgisoft.rig import VirtualRig
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.circle_ablation import CircleAblation
from surgisoft.tasks.path_following import FollowConfig
from surgisoft.tasks.track import TrackConfig, track_circle
from surgisoft.tasks.world.pytree import rows
from surgisoft.tasks.world.world import WorldConfig
from tests.rig.own_rig import OwnRig

SHORT = TrackConfig(FollowConfig(loop_s=5.0, approach_s=2.0, size_mm=5.0))


@pytest.fixture(scope="module")
def task():
    return track_circle(SHORT)


def test_cameras_hold_the_arm_to_its_path(task):
    """Robot 1 is not the one that the model was fitted to."""
    errors = {}
    for cameras in (True, False):
        played = rollout(on_rig(task, RigConfig(seed=1, cameras=cameras)), Scripted(), 1, seed=0)
        errors[cameras] = played.mean("error_mm").max().item()
    assert errors[True] < 0.3
    assert errors[False] > 3 * errors[True]


def test_the_robot_that_the_model_was_fitted_to_is_followed_closely(task):
    played = rollout(on_rig(task), Scripted(), 2, seed=0)
    assert played.mean("error_mm").max() < 0.12
    assert played.mean("error_mm").min() > 0.005, "the rig is no copy of the model"


class Watched(VirtualRig):
    """A virtual rig that keeps the last truth that it gave."""

    def read_beside_truth(self):
        sample, self.truth = super().read_beside_truth()
        return sample, self.truth


def watched(config, trial):
    return Watched(config.seed, hidden=config.hidden, noise=config.noise, take=trial)


def test_policies_see_measurements_and_errors_are_those_of_the_true_body(task):
    play = Episodes(on_rig(task, RigConfig(settle_s=0.5), watched))
    state = play.seeded(3, 1)
    plant = state.world.arms["arm"].plant
    (rig,) = plant.rigs.items
    before, time_s = plant.target_kPa, rig.time_s
    state, _ = play.step(state, {"arm": torch.tensor([[1.0, -9.0, 0.5]])})
    part, limit = state.world.arms["arm"], task.arm.pneumatics.step_kPa
    assert part.plant.rigs.items == (rig,)
    assert rig.time_s - time_s == pytest.approx(task.dt_s)
    change = part.plant.target_kPa - before
    torch.testing.assert_close(change, torch.tensor([[1.0, -limit, 0.5]]), atol=1e-5, rtol=0)
    chamber = torch.tensor(rig.truth.pressures_kPa[0], dtype=torch.float32)
    assert 0.0 < (part.seen_kPa[0] - chamber).abs().max() < 0.15
    noise = part.seen_mm - part.points_mm
    assert 0.0 < noise.norm(dim=2).mean() < 0.2
    centres = torch.tensor(rig.truth.centres_mm[0], dtype=torch.float32)
    assert (part.points_mm[0] - centres).norm(dim=1).max() < 0.5


def test_memory_is_constant_over_episodes():
    """50 episodes two by two: no rig of an earlier batch lives on, none of a reset episode."""
    alive, most = weakref.WeakSet(), 0

    def counted(config, trial):
        nonlocal most
        rig = named_rig(config, trial)
        alive.add(rig)
        most = max(most, len(alive))
        return rig

    brief = track_circle(TrackConfig(FollowConfig(loop_s=0.1, approach_s=0.1)))
    moved = on_rig(brief, RigConfig(settle_s=0.05), counted)
    rollout(moved, Random(), 40, seed=0, batch=2)
    play = Episodes(moved)
    state = play.seeded(1, 2)
    for _ in range(10):
        state = play.reset(state, torch.tensor([True, False]))
    kept = state.world.arms["arm"].plant.rigs.items
    gc.collect()
    assert set(alive) == set(kept)
    assert most <= 5


def test_a_reset_and_a_choice_of_rows_keep_each_episodes_rig():
    brief = track_circle(TrackConfig(FollowConfig(loop_s=1.0, approach_s=0.1)))
    play = Episodes(on_rig(brief, RigConfig(settle_s=0.05)))
    state = play.seeded(1, 3)
    first = state.world.arms["arm"].plant.rigs.items
    state = play.reset(state, torch.tensor([False, True, False]))
    second = state.world.arms["arm"].plant.rigs.items
    assert (second[0], second[2]) == (first[0], first[2])
    assert second[1] is not first[1]
    chosen = rows(state, torch.tensor([2, 0])).world.arms["arm"]
    assert chosen.plant.rigs.items == (first[2], first[0])


def test_task_and_world_have_the_same_arm(task):
    moved = on_rig(task, RigConfig(settle_s=0.2))
    assert moved.arm is moved.world.arms["arm"]
    assert task.arm is task.world.arms["arm"] is not moved.arm
    cut = on_rig(CircleAblation(), RigConfig(settle_s=0.2))
    assert {name: each.arm for name, each in cut.pointing.items()} == cut.world.arms


def test_without_noise_cameras_see_the_truth(task):
    raw = RigConfig(noise=0.0, settle_s=0.5, observer_gain=1.0)
    state = Episodes(on_rig(task, raw)).seeded(0, 2)
    part = state.world.arms["arm"]
    torch.testing.assert_close(part.seen_mm, part.points_mm)
    # The prediction for the present pressure is the estimate: the offset takes the model there.
    predicted = task.arm.predict(part, part.pressure, 1e-3)
    torch.testing.assert_close(predicted, part.seen_mm, atol=2e-2, rtol=0.0)


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


def test_each_arm_of_a_task_has_a_separate_rig():
    task = CircleAblation()
    moved = on_rig(task, RigConfig(settle_s=0.2))
    state = Episodes(moved).seeded(0, 1)
    drawn = Random().act(moved, state, {})
    for _ in range(3):
        state, outcome = Episodes(moved).step(state, drawn)
    laser, endoscope = (state.world.arms[name].plant for name in ("laser", "endoscope"))
    assert laser.rigs.items[0] is not endoscope.rigs.items[0]
    assert not torch.allclose(laser.target_kPa, endoscope.target_kPa)
    assert outcome.measures["clearance_mm"].isfinite().all()
    laser = state.world.arms["laser"]
    base = task.world.arms["laser"].pose[:3, 3]
    assert (laser.seen_mm[0, 0] - base).norm() < 1.0, "key points are in the world's frame"
    assert task.world.arms["laser"] is not moved.world.arms["laser"]


def test_a_step_that_the_rig_cannot_keep_is_one_line():
    task = track_circle(TrackConfig(world=WorldConfig(dt_s=0.08)))
    with pytest.raises(InputError, match=r"0\.08 s; on the rig expected a multiple of its 0\.05"):
        on_rig(task)
    with pytest.raises(InputError, match="observer_gain is 2"):
        RigConfig(observer_gain=2.0)


REAL = "tests.rig.own_rig:OwnRig:port=x"


def test_a_real_bench_runs_one_episode_after_the_other_and_is_scored_by_measurements():
    short = TrackConfig(FollowConfig(loop_s=0.4, approach_s=0.1))
    config = RigConfig(rigs=(REAL,), settle_s=0.05)
    moved = on_rig(track_circle(short), config)
    (bench,) = real_benches(moved).values()
    with pytest.raises(InputError, match="2 episodes were to run side by side"):
        rollout(moved, Random(), 2, seed=0)
    with at_benches(moved):
        state = Episodes(moved).seeded(0, 1)
        assert state.world.arms["arm"].plant.rigs.items == (bench,)
        sample = bench.read()
    measured = torch.tensor(sample.key_points_mm, dtype=torch.float32)
    assert (state.world.arms["arm"].points_mm[0] - measured).norm(dim=1).max() < 1.5
    assert (bench.rig.vents, bench.rig.closes) == (1, 1), "left vented and given back"
    found = evaluate("random", "track_circle", episodes=2, rig=config, config=short)
    assert found.measured_arms == ("arm",)
    assert found.to_json()["measured_arms"] == ["arm"]
    assert (
        evaluate(
            "random", "track_circle", episodes=2, rig=RigConfig(settle_s=0.05), config=short
        ).measured_arms
        == ()
    )


class Swapped(OwnRig):
    """The bench with the tubes of chambers 1 and 2 exchanged."""

    def command(self, pressures):
        super().command(np.asarray(pressures)[[1, 0, 2]])


def test_preflight_finds_swapped_tubes_before_the_first_episode():
    short = TrackConfig(FollowConfig(loop_s=0.4, approach_s=0.1))
    request = {"task": "track_circle", "episodes": 1, "config": short}
    for rig, swapped in ((OwnRig, False), (Swapped, True)):
        config = RigConfig(rigs=("bench",), settle_s=0.05, preflight=True)
        moved = on_rig(track_circle(short), config, lambda *_, rig=rig: rig("x"))
        (bench,) = real_benches(moved).values()
        if swapped:
            with pytest.raises(InputError, match="chamber 1 moves the arm as 2"), at_benches(moved):
                pytest.fail("no episode begins")
        else:
            with at_benches(moved):
                assert bench.rig.commands, "each chamber was tried"
        assert (bench.rig.vents > 0, bench.rig.closes) == (True, 1), "left vented and given back"
    with pytest.raises(InputError, match="no arm of track_circle is on one"):
        evaluate("random", rig=RigConfig(preflight=True), **request)


def test_a_lost_key_point_of_a_real_bench_is_estimated():
    class Blind(OwnRig):
        def read(self):
            sample = super().read()
            return replace(sample, key_points_mm=np.full((5, 3), np.nan))

    brief = track_circle(TrackConfig(FollowConfig(loop_s=0.4, approach_s=0.1)))
    moved = on_rig(brief, RigConfig(settle_s=0.05), lambda config, trial: Blind("x"))
    rolled = rollout(moved, Random(), 1, seed=0, batch=1)
    assert not rolled.failed.any()
    assert rolled.measures["error_mm"].isfinite().any()


@pytest.mark.parametrize(
    ("rigs", "message"),
    [
        ((REAL,), "is one bench, and circle_ablation has the arms laser, endoscope"),
        (("virtual", "elastica"), "expected one rig for all arms, or ARM=NAME"),
        (("knife=virtual",), "no arm 'knife', expected one of laser, endoscope"),
        (("laser=virtual", "laser=virtual"), "arm 'laser' has the rig 'virtual' already"),
        (("virtual:seed=1,hidden=x:y",), "hidden effect 'x:y': expected NAME or NAME:AMPLITUDE"),
        ((f"laser={REAL},chambers=2",), "arm 'laser' has 3 chambers .* the rig's has 2 and 5"),
    ],
)
def test_rigs_that_do_not_fit_the_arms_are_one_line(rigs, message):
    with pytest.raises(InputError, match=message):
        on_rig(CircleAblation(), RigConfig(rigs=rigs))


def test_one_arm_is_on_a_real_bench_and_the_other_on_a_virtual_one():
    texts = rigs_in(f"laser={REAL} endoscope=virtual:seed=2")
    moved = on_rig(CircleAblation(), RigConfig(rigs=texts, settle_s=0.05))
    assert list(real_benches(moved)) == ["laser"]
    endoscope = moved.world.arms["endoscope"]
    assert endoscope.config.rigs == ("virtual:seed=2",)
    assert isinstance(endoscope.build(endoscope.config, 0), VirtualRig)
    assert rigs_in("virtual") == ("virtual",)


def test_a_model_of_another_robot_is_warned_of_once():
    brief = track_circle(TrackConfig(FollowConfig(loop_s=0.2, approach_s=0.1)))
    for seed, said in ((0, 0), (1, 1)):
        warned = []
        moved = on_rig(brief, RigConfig(seed=seed, settle_s=1.0), on_warning=warned.append)
        rollout(moved, Random(), 2, seed=0, batch=1)
        assert len(warned) == said
    assert re.match(r"arm 'arm': its model is [12]\.\d mm off the first 4 poses", warned[0])
    assert "validated at 0.1 mm: it is a model of another robot, or the robot has" in warned[0]


def test_evaluate_passes_the_warning_on():
    warned = []
    short = TrackConfig(FollowConfig(loop_s=0.2, approach_s=0.1))
    evaluate(
        "random",
        "track_circle",
        episodes=1,
        rig=RigConfig(seed=3, settle_s=1.0),
        config=short,
        on_warning=warned.append,
    )
    assert len(warned) == 1


def seen_after(task, gain, steps=4):
    """(steps, n, 3) mm: key points as observed, and as they truly are, of one rig."""
    config = RigConfig(settle_s=0.5, observer_gain=gain, drift_gain=0.0)
    play = Episodes(on_rig(task, config))
    state, seen, true = play.seeded(3, 1), [], []
    for _ in range(steps):
        state, _ = play.step(state, {"arm": torch.ones(1, 3)})
        part = state.world.arms["arm"]
        seen.append(part.seen_mm[0])
        true.append(part.points_mm[0])
    return torch.stack(seen), torch.stack(true)


def test_the_observer_gain_decides_how_far_the_cameras_are_followed(task):
    """With gain 1 the estimate is the measurement, whose noise it keeps; with 0 the model's."""
    (raw, true), (held, again), (some, _) = (seen_after(task, gain) for gain in (1.0, 0.0, 0.3))
    assert torch.equal(true, again), "the rig does not depend on the observer"
    noise = (raw - true).norm(dim=2).mean()
    assert 0.01 < noise < 0.3, "policies observe measurements, not the truth"
    assert not torch.allclose(some, raw, atol=1e-4)
    assert not torch.allclose(some, held, atol=1e-4)
    torch.testing.assert_close(some[0], held[0] + 0.3 * (raw[0] - held[0]), atol=1e-4, rtol=0)


def test_the_rig_is_reset_before_an_episode(task):
    class Counted(VirtualRig):
        resets = 0

        def reset(self):
            super().reset()
            self.resets += 1

    play = Episodes(on_rig(task, RigConfig(settle_s=0.5), lambda config, _: Counted(config.seed)))
    (rig,) = play.seeded(3, 1).world.arms["arm"].plant.rigs.items
    assert rig.resets == 1
