"""Random effects of simulated arms: each arm has one effect of the library to its own degree."""

import pytest
import torch

from surgisoft.surrogate.checkpoint import default_arm
from surgisoft.tasks.world.arm import Randomisation
from surgisoft.tasks.world.random_effects import KINDS, RandomEffects
from surgisoft.tasks.world.random_streams import streams
from surgisoft.tasks.world.world import WorldConfig, single_arm_world


@pytest.fixture(scope="module")
def drawn():
    return RandomEffects(default_arm())


def motion(steps=12, count=2):
    """(T, B, 3) kPa: a random motion of the chambers."""
    generator = torch.Generator().manual_seed(0)
    return 40.0 * torch.rand(steps, 1, 3, generator=generator).expand(-1, count, -1)


@pytest.mark.parametrize("name", ["creep", "line_lag", "gain_mismatch#2", "payload"])
@torch.no_grad()
def test_a_factor_of_one_is_the_effect_applied_alone(name, drawn):
    """The second arm of the batch has none: it moves as the model without any."""
    plain = default_arm()
    alone = plain.replace(effects={**plain.effects, name: drawn.model.effects[name]})
    factors = torch.zeros(2, drawn.count)
    factors[0, drawn.names.index(name)] = 1.0
    state, first, second = (
        m.initial_state(n) for m, n in ((drawn.model, 2), (alone, 1), (plain, 1))
    )
    apart = 0.0
    for pressure in motion():
        state, points = drawn.step(state, pressure, 0.1, factors)
        first, with_effect = alone.step(first, pressure[:1] - first.pressure, 0.1)
        second, without = plain.step(second, pressure[:1] - second.pressure, 0.1)
        torch.testing.assert_close(points[:1], with_effect, atol=1e-4, rtol=0.0)
        torch.testing.assert_close(points[1:], without, atol=1e-4, rtol=0.0)
        apart = max(apart, float((with_effect - without).abs().max()))
    assert apart > 0.05


def test_an_episode_has_one_kind_of_at_most_the_largest_size(drawn):
    _, factors = drawn.draw(streams(0, 400), 1.5)
    kinds = torch.tensor([number for number, names in enumerate(drawn.kinds) for _ in names])
    had = torch.stack([(factors[:, kinds == k] != 0.0).any(1) for k in range(len(KINDS))], 1)
    assert (had.sum(1) == 1).all()
    assert had.float().mean(0).min() > 0.05
    creeps, gains = (drawn.names.index(name) for name in ("creep", "gain_mismatch"))
    assert factors[:, creeps].min() == 0.0, "a wall does not creep back"
    assert factors[:, gains].min() < 0.0 < factors[:, gains].max()
    size = factors.norm(dim=1)
    assert 0.6 < size.mean() < 0.9
    assert size.max() <= 1.5


def test_random_effects_move_simulated_arms_and_not_the_model_beside(drawn):
    plain = WorldConfig()
    vary = WorldConfig(randomisation=Randomisation(effects_mm=2.0))
    tips = []
    for config in (plain, vary):
        world = single_arm_world(config, start_kPa=(15.0, 15.0, 15.0))
        state = world.start(streams(0, 16))
        for _ in range(10):
            state = world.step(state, {"arm": torch.full((16, 3), 1.0)})
        tips.append(state.arms["arm"].points_mm[:, -1])
    moved = (tips[1] - tips[0]).norm(dim=1)
    assert 0.2 < moved.mean() < 4.0
    assert world.arms["arm"].model.effects.keys() == default_arm().effects.keys()
