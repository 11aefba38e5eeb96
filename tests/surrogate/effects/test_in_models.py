"""Every effect inside a whole arm model, alone and all together."""

import pytest
import torch

from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.checkpoint import load_model, save_model
from surgisoft.surrogate.effects import STAGES, free_name, known_effects, make_effect
from surgisoft.surrogate.history import History
from surgisoft.surrogate.model import ArmModel, Validation, arm_facts
from surgisoft.surrogate.networks import HawNN
from tests.surrogate.effects.arms import REST_MM, stir

SPEC = ArmSpec(3, 5, (-10.0,) * 3, (50.0,) * 3, band=(0.2,) * 3, gravity=(0.6, 0.0, -0.8))
ALL = tuple(known_effects())
SETS = pytest.mark.parametrize("names", [(name,) for name in ALL] + [ALL], ids="+".join)


def model(names) -> ArmModel:
    """An arm with random weights and stirred effects."""
    torch.manual_seed(7)
    network = HawNN(torch.tensor(SPEC.low), torch.tensor(SPEC.high), 5, hidden=(16,))
    network.scale.fill_(8.0)
    network.mean.copy_(REST_MM.flatten())
    facts = arm_facts(SPEC, REST_MM)
    made = {name: stir(make_effect(name, facts), size=0.03) for name in names}
    return ArmModel(SPEC, network, made, REST_MM, Validation(1.0)).eval().requires_grad_(False)


def history(runs: int, steps: int) -> History:
    """Random walks at uneven times, one clock a run from zero."""
    generator = torch.Generator().manual_seed(1)
    x = (20 + 5 * torch.randn(runs, steps, 3, generator=generator).cumsum(1)).clamp(-10, 50)
    t = (0.02 + 0.2 * torch.rand(runs, steps, generator=generator)).cumsum(1).double()
    room = 20 + 5 * torch.rand(runs, steps, generator=generator)
    return History(
        t - t[:, :1], x, torch.zeros(runs, steps, 5, 3), x[..., 0].isfinite(), None, room
    )


@SETS
def test_stepping_is_predicting_and_bit_equal_after_saving(names, tmp_path):
    arm, seen = model(names), history(2, 40)
    save_model(arm, tmp_path / "arm")
    again = load_model(tmp_path / "arm")
    predicted = arm.predict(seen)
    assert torch.equal(predicted, again.predict(seen))
    state, dt = arm.initial_state(2), seen.dt_s
    for t in range(40):
        dp = seen.pressure[:, t] - state.pressure
        state, points = arm.step(state, dp, dt[:, t], seen.temperature_C[:, t])
        assert torch.allclose(points, predicted[:, t], atol=2e-3)


def test_two_effects_of_a_kind_act_in_one_model(tmp_path):
    arm = model(("creep", "payload"))
    facts = arm.facts
    name = free_name("creep", arm.effects)
    assert name == "creep#2"
    assert free_name("creep", ("creep", "creep#2")) == "creep#3"
    more = dict(arm.effects) | {name: stir(make_effect(name, facts), seed=8)}
    twice = ArmModel(SPEC, arm.network, more, REST_MM, Validation(1.0))
    save_model(twice.eval(), tmp_path / "arm")
    again, seen = load_model(tmp_path / "arm"), history(1, 30)
    assert list(again.effects) == ["creep", "creep#2", "payload"]
    with torch.no_grad():
        assert torch.equal(again.predict(seen), twice.predict(seen))
        assert not torch.allclose(again.predict(seen), arm.predict(seen), atol=1e-3)


def test_effects_act_in_the_order_of_the_chain():
    stages = [effect.stage for effect in model(ALL[::-1]).effects.values()]
    assert stages == sorted(stages, key=STAGES.index)


def test_a_masked_reset_forgets_everything_of_those_arms_alone():
    arm = model(ALL)
    fresh = state = arm.initial_state(3)
    for _ in range(5):
        state, _ = arm.step(state, torch.full((3, 3), 4.0), 0.1)
    reset = state.where(torch.tensor([False, True, False]), fresh)
    for name, memory in reset.memory.items():
        assert torch.equal(memory[1], fresh.memory[name][1])
        assert torch.equal(memory[[0, 2]], state.memory[name][[0, 2]])
    _, points = arm.step(reset, torch.full((3, 3), 4.0), 0.1)
    _, first = arm.step(fresh, torch.full((3, 3), 4.0), 0.1)
    assert torch.allclose(points[1], first[1], atol=1e-5)


def test_steps_go_on_under_inference_mode():
    arm = model(ALL)
    with torch.inference_mode():
        state = arm.initial_state(2)
        state, points = arm.step(state, torch.ones(2, 3), 0.05)
    assert points.isfinite().all()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_agrees_with_the_cpu():
    arm, seen = model(ALL), history(2, 200)
    on_device = model(ALL).to("cuda").predict(seen.to("cuda")).cpu()
    assert torch.allclose(on_device, arm.predict(seen), atol=5e-3)
