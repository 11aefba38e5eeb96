"""The state observer of simulated arms: an alpha-beta filter on the nominal model's output."""

import torch

from surgisoft.agents.presets import RANDOMISED_WORLD
from surgisoft.agents.training_request import TrainingRequest
from surgisoft.tasks.track import TrackConfig
from surgisoft.tasks.world.arm import Randomisation
from surgisoft.tasks.world.observer import AlphaBetaFilter
from surgisoft.tasks.world.random_streams import streams
from surgisoft.tasks.world.world import WorldConfig, single_arm_world

NOISE_MM = 0.05


def errors_mm(config: WorldConfig, steps: int = 60, count: int = 64) -> torch.Tensor:
    """(T, B, n, 3) mm: estimate less truth along a motion of all chambers."""
    world = single_arm_world(config, start_kPa=(15.0, 15.0, 15.0))
    state, found = world.start(streams(0, count)), []
    for step in range(steps):
        push = torch.full((count, 3), 0.3) * (1.0 if step % 20 < 10 else -1.0)
        state = world.step(state, {"arm": push})
        part = state.arms["arm"]
        found.append(part.seen_mm - part.points_mm)
    return torch.stack(found)


def test_noise_is_lowered_as_much_as_an_alpha_filter_does():
    """Without drift gain and model error the variance is alpha / (2 - alpha) of the noise's."""
    plain = Randomisation(noise_mm=NOISE_MM)
    raw = errors_mm(WorldConfig(randomisation=plain)).square().mean().sqrt()
    filtered = errors_mm(WorldConfig(randomisation=plain, observer=AlphaBetaFilter(0.3)))[20:]
    torch.testing.assert_close(raw, torch.tensor(NOISE_MM), rtol=0.02, atol=0.0)
    expected = torch.tensor(NOISE_MM * (0.3 / 1.7) ** 0.5)
    torch.testing.assert_close(filtered.square().mean().sqrt(), expected, rtol=0.05, atol=0.0)


def test_the_estimate_follows_mounts_and_gains_that_the_model_does_not_know():
    vary = Randomisation(mount_mm=0.5, gain=0.02)
    off = errors_mm(WorldConfig(randomisation=vary, observer=AlphaBetaFilter(0.3, 0.01)))
    nominal = errors_mm(WorldConfig(randomisation=vary, observer=AlphaBetaFilter(0.0)))
    assert off[20:].square().mean().sqrt() < 0.1
    assert off[20:].square().mean().sqrt() < 0.5 * nominal[20:].square().mean().sqrt()


def test_the_raw_measurement_is_the_default():
    assert (errors_mm(WorldConfig(), steps=3) == 0.0).all()


def test_the_preset_randomised_sets_the_world_that_the_user_left_as_it_was():
    plan = TrainingRequest("track_circle", "randomised").plan()
    assert plan.task_config.world.randomisation == RANDOMISED_WORLD["randomisation"]
    assert plan.task_config.world.observer == AlphaBetaFilter(0.3, 0.01)
    assert plan.preset == TrainingRequest("track_circle").plan().preset
    own = TrackConfig(world=WorldConfig(randomisation=Randomisation(noise_mm=0.2)))
    plan = TrainingRequest("track_circle", "randomised", config=own).plan()
    assert plan.task_config.world.randomisation == Randomisation(noise_mm=0.2)
    assert plan.task_config.world.observer == AlphaBetaFilter(0.3, 0.01)
