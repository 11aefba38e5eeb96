"""What is drawn for an arm at the start of an episode, and what its sensors and observer see."""

import math
from dataclasses import replace

import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.surrogate.checkpoint import default_arm
from surgisoft.tasks.world.arm import Pneumatics, Randomisation
from surgisoft.tasks.world.observer import AlphaBetaFilter
from surgisoft.tasks.world.random_streams import streams
from surgisoft.tasks.world.world import Feed, Mounted, World, WorldConfig, single_arm_world


def started(count=2000, start_kPa=None, observer=None, **vary):
    """A world of one arm, and its state at the start of so many episodes."""
    vary = Randomisation(**vary)
    config = WorldConfig(randomisation=vary, observer=observer or AlphaBetaFilter())
    world = single_arm_world(config, start_kPa=start_kPa)
    return world, world.start(streams(3, count))


def test_pressures_before_an_episode_fill_the_range():
    """An arm comes to 0 kPa from below as often as the range lies below 0."""
    world, state = started(history=1)
    arm, part = world.arms["arm"], state.arms["arm"]
    rises = (part.arm.direction > 0.0).float().mean(0)
    share = (arm.first - arm.low) / (arm.high - arm.low)
    assert (share > 0.1).all()
    assert (share < 0.9).all()
    torch.testing.assert_close(rises, share, rtol=0, atol=0.05)


def test_an_episode_starts_within_the_range_of_the_arm():
    high = default_arm().spec.high
    world, state = started(start_kPa=high)
    pressure = state.arms["arm"].pressure
    assert pressure.max() <= world.arms["arm"].high.max()
    assert (pressure == world.arms["arm"].high).float().mean() > 0.4, "the upper half is cut off"


def test_each_chamber_has_a_gain_of_its_own():
    _, state = started(gain=0.1)
    gain = state.arms["arm"].gain
    torch.testing.assert_close(gain.std(0), torch.full((3,), 0.1), rtol=0.1, atol=0)
    assert (torch.corrcoef(gain.T) - torch.eye(3)).abs().max() < 0.1


def test_pressures_have_noise_where_key_points_have_none():
    _, state = started(noise_kPa=0.3)
    part = state.arms["arm"]
    off = part.seen_kPa - part.pressure
    torch.testing.assert_close(off.std(), torch.tensor(0.3), rtol=0.05, atol=0)
    assert torch.equal(part.seen_mm, part.points_mm)


def test_the_model_of_an_observer_is_driven_by_the_measured_pressures():
    world, state = started(4, observer=AlphaBetaFilter(0.5), noise_kPa=0.5)
    state = world.step(state, {"arm": torch.full((4, 3), 2.0)})
    part = state.arms["arm"]
    torch.testing.assert_close(part.belief.arm.pressure, part.seen_kPa)
    assert (part.seen_kPa - part.pressure).abs().max() > 0.1


def test_an_observer_knows_the_nominal_mount_only():
    """An alpha-beta step by hand: the nominal model, and half of what the cameras see besides."""
    world, state = started(3, observer=AlphaBetaFilter(0.5, 0.1), mount_mm=2.0, gain=0.1)
    arm, before = world.arms["arm"], state.arms["arm"].belief
    for value in (1.0, -2.0):
        state = world.step(state, {"arm": torch.full((3, 3), value)})
        part = state.arms["arm"]
        change = part.seen_kPa - before.arm.pressure
        _, nominal = arm.model.step(before.arm, change, world.config.dt_s)
        surprise = part.points_mm - nominal - before.offset_mm
        drift = before.drift_mm + 0.1 * surprise
        now = before.offset_mm + 0.5 * surprise
        torch.testing.assert_close(part.seen_mm, nominal + now, rtol=0, atol=1e-3)
        torch.testing.assert_close(part.belief.offset_mm, now + drift, rtol=0, atol=1e-3)
        before = part.belief
    assert surprise.abs().max() > 1e-3


def test_an_observer_knows_of_the_feed():
    """An arm that is as its model says, without noise: the estimate is the truth throughout."""
    config = WorldConfig(observer=AlphaBetaFilter(0.5))
    feed = Feed(way_mm=20.0, speed_mm_s=10.0, wait_s=0.3)
    world = World({"arm": Mounted(default_arm(), torch.eye(4))}, config, feed=feed)
    state = world.start(streams(1, 2))
    part = state.arms["arm"]
    assert part.points_mm[:, 0, 2].tolist() == pytest.approx([-20.0] * 2, abs=0.5)
    assert torch.equal(part.seen_mm, part.points_mm)
    for _ in range(25):
        state = world.step(state, {"arm": torch.full((2, 3), 0.5)})
        part = state.arms["arm"]
        torch.testing.assert_close(part.seen_mm, part.points_mm, rtol=0, atol=1e-2)
    assert state.out_mm.tolist() == [0.0, 0.0]


def test_a_model_of_commands_has_the_lag_of_the_pumps_already():
    for actuation, lags in (("measured", True), ("commanded", False)):
        model = default_arm()
        model = model.replace(spec=replace(model.spec, actuation=actuation))
        world = World({"arm": Mounted(model, torch.eye(4))})
        state = world.step(world.start(streams(1, 1)), {"arm": torch.full((1, 3), 2.0)})
        part = state.arms["arm"]
        assert torch.allclose(part.pressure, part.command) != lags


def test_the_action_that_brings_a_chamber_to_a_pressure_counts_the_lag():
    pump, dt_s = Pneumatics(tau_s=0.2), 0.1
    command, pressure, wanted = torch.tensor([[5.0]]), torch.tensor([[4.0]]), torch.tensor([[4.6]])
    action = pump.action_for(command, pressure, wanted, dt_s)
    torch.testing.assert_close(pump.follow(pressure, command + action, dt_s), wanted)
    share = 1.0 - math.exp(-0.5)
    assert action.item() == pytest.approx(4.0 + 0.6 / share - 5.0, rel=1e-5)


def test_a_state_of_a_lone_arm_stays_as_it_was():
    world, state = started(1)
    lone = world.arms["arm"].alone(state.arms["arm"], world.config.dt_s)
    kept = lone.part
    names = ("points_mm", "pressure", "command", "line_mm")
    before = {name: getattr(kept, name).clone() for name in names}
    lone.action[:] = 2.0
    lone.step()
    for name, value in before.items():
        assert torch.equal(getattr(kept, name), value), name
        assert not torch.equal(getattr(lone.part, name), value), name


def test_two_arms_of_a_world_draw_numbers_of_their_own():
    vary = Randomisation(gain=0.1, noise_mm=0.2)
    mounted = Mounted(default_arm(), torch.eye(4))
    world = World({"a": mounted, "b": mounted}, WorldConfig(randomisation=vary))
    state = world.start(streams(0, 500))
    gains = torch.stack([part.gain.flatten() for part in state.arms.values()])
    assert torch.corrcoef(gains)[0, 1].abs() < 0.1
    state = world.step(state, {name: torch.zeros(500, 3) for name in "ab"})
    noise = torch.stack([(p.seen_mm - p.points_mm).flatten() for p in state.arms.values()])
    assert torch.corrcoef(noise)[0, 1].abs() < 0.1


def test_an_environment_that_failed_stays_failed():
    world, state = started(2)
    state = replace(state, failed=torch.tensor([True, False]))
    state = world.step(state, {"arm": torch.zeros(2, 3)})
    assert state.failed.tolist() == [True, False]


def test_an_arm_that_an_agent_drives_needs_an_action():
    world, state = started(1)
    with pytest.raises(InputError, match="no action for 'arm'"):
        world.step(state, {})
