"""One set of promises over every effect, and hysteresis by hand."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.errors import InputError
from surgisoft.surrogate.effects import EFFECTS, STAGES, make_effect

LOW, HIGH = torch.tensor([-10.0, -10.0, -10.0]), torch.tensor([50.0, 50.0, 50.0])
REST = torch.zeros(3)


def signal(effect, runs: int, steps: int, seed: int) -> torch.Tensor:
    """Random walks of what the effect acts on: actuation, or key points."""
    generator = torch.Generator().manual_seed(seed)
    shape = (3,) if effect.stage in ("line", "material") else (4, 3)
    return 20 + 6 * torch.randn(runs, steps, *shape, generator=generator).cumsum(1)


def stirred(name: str):
    """The effect with every parameter moved off its first value."""
    effect = make_effect(name, LOW, HIGH, REST)
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in effect.parameters():
            parameter += 0.05 * torch.randn(parameter.shape, generator=generator)
    return effect


@pytest.mark.parametrize("name", EFFECTS)
def test_no_strength_no_change(name):
    effect = make_effect(name, LOW, HIGH, REST)
    x = signal(effect, 2, 30, 0)
    y = effect.apply(x, effect.scan(effect.rest(x[:, 0]), x, torch.full((2, 30), 0.05)))
    assert torch.equal(x, y)


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("seed", range(3))
def test_stepping_is_scanning(name, seed):
    effect = stirred(name)
    x, dt = signal(effect, 3, 50, seed), torch.rand(3, 50) * 0.2
    dt[:, 0] = 0
    memory = effect.rest(x[:, 0])
    scanned = effect.scan(memory, x, dt)
    for t in range(50):
        stepped, answer = effect.step(memory, x[:, t], dt[:, t])
        memory = effect.advance(memory, x[:, t], dt[:, t])
        assert torch.equal(stepped, memory)
        assert torch.equal(answer, effect.apply(x[:, t], memory))
        assert torch.allclose(memory, scanned[:, t], rtol=1e-5, atol=1e-4)
        assert torch.allclose(answer, effect.apply(x, scanned)[:, t], atol=1e-3)


@pytest.mark.parametrize("name", EFFECTS)
def test_registered_under_its_file_and_rebuilt_from_its_config(name):
    effect = make_effect(name, LOW, HIGH, REST)
    assert type(effect).__module__.rsplit(".", 1)[1] == name
    assert effect.stage in STAGES
    again = make_effect(name, LOW, HIGH, REST, **effect.config())
    again.load_state_dict(stirred(name).state_dict())
    x = signal(effect, 2, 20, 1)
    dt = torch.full((2, 20), 0.1)
    stir = stirred(name)
    one, other = (e.apply(x, e.scan(e.rest(x[:, 0]), x, dt)) for e in (again, stir))
    assert torch.equal(one, other)
    assert all(quantity.name and quantity.value is not None for quantity in effect.quantities())


def test_unknown_effect_names_the_known_ones():
    with pytest.raises(InputError, match=r"known are .*hysteresis"):
        make_effect("gremlins", LOW, HIGH, REST)


def lag(pressures: list[float]) -> torch.Tensor:
    """Play of chamber 1 less its pressure, in kPa: radius 0.2 of the half range 30 is 6 kPa."""
    effect = make_effect("hysteresis", LOW, HIGH, REST, radii=(0.2,))
    x = torch.zeros(1, len(pressures), 3)
    x[0, :, 0] = torch.tensor(pressures)
    plays = effect.scan(effect.rest(x[:, 0]), x, torch.zeros(1, len(pressures)))
    return 30 * (plays[..., 0] - effect.lines(x))[0, :, 0]


def test_play_by_hand():
    expected = [0, -3, -6, -6, -1, 6, 6, 4]
    assert lag([0.0, 3.0, 6.0, 20.0, 15.0, 8.0, 0.0, 2.0]).tolist() == pytest.approx(
        expected, abs=1e-4
    )


def test_strength_acts_as_written():
    """x_eff = x + w (y - u) + v (u - u_rest)(y - u) on one line, by hand."""
    effect = make_effect("hysteresis", LOW, HIGH, REST, radii=(0.2,))
    with torch.no_grad():
        effect.weight[1, 0, 0] = 0.5
        effect.slope[1, 0, 0] = 2.0
    x = torch.tensor([[[0.0, 7.0, 0.0], [20.0, 7.0, 0.0]]])
    plays = effect.scan(effect.rest(x[:, 0]), x, torch.zeros(1, 2))
    # Line 1 is chamber 1: u goes from -2/3 to 0, y follows 0.2 behind; u - u_rest is 2/3.
    moved = 30 * (0.5 + 2.0 * 2 / 3) * -0.2
    expected = torch.tensor([20.0, 7.0 + moved, 0.0])
    assert torch.allclose(effect.apply(x, plays)[0, 1], expected, atol=1e-4)


def plays_after(history: list[float], chamber: int) -> torch.Tensor:
    """(T, L, J) plays while one chamber moves, along lines that rise or fall with it throughout."""
    effect = stirred("hysteresis")
    effect.bent.data.zero_()
    x = torch.zeros(1, len(history), 3)
    x[0, :, chamber] = torch.tensor(history)
    return effect.scan(effect.rest(x[:, 0]), x, torch.zeros(1, len(history)))[0]


@given(st.floats(15, 45), st.floats(-5, 12))
def test_return_point_memory(high, low):
    """A closed inner loop leaves no trace (Mayergoyz 2003: return-point memory)."""
    memory = plays_after([-10.0, high, low, high], 1)
    assert torch.allclose(memory[1], memory[3], atol=1e-5)


@given(st.lists(st.floats(0, 20), min_size=1, max_size=12))
def test_a_larger_sweep_wipes_out_smaller_ones(inner):
    """After a sweep beyond every earlier extremum, what came before is forgotten."""
    tail = [-10.0, 50.0, 30.0]
    one, other = plays_after([10.0, *inner, *tail], 2), plays_after([10.0, *tail], 2)
    assert torch.allclose(one[-1], other[-1], atol=1e-5)
