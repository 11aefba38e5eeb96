"""One set of promises over every effect and its candidates."""

import copy
import dataclasses

import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.surrogate.effects import STAGES, Context, hypothesis_of, known_effects, make_effect
from tests.surrogate.effects.arms import (
    FACTS,
    REST_MM,
    at,
    context,
    facts,
    on_points,
    signal,
    stir,
    variants,
)

VARIANTS = variants()
EVERY = pytest.mark.parametrize("effect", VARIANTS.values(), ids=VARIANTS)


def candidates(name, arm, points):
    """What identification tries of an effect."""
    return hypothesis_of(known_effects()[name]).candidates(arm, points)


def through(effect, x, seen):
    """The effect's answer along whole runs (R, T, ...)."""
    return effect.apply(x, effect.scan(effect.rest(x[:, 0]), x, seen))


def at_zero(effect):
    """The effect with other shapes, of zero strength."""
    effect = stir(copy.deepcopy(effect))
    with torch.no_grad():
        for strength in effect.amplitudes().values():
            strength.zero_()
    return effect


@EVERY
def test_zero_amplitude_changes_nothing(effect):
    x = signal(effect, 2, 30, 0)
    assert all(not strength.any() for strength in effect.amplitudes().values())
    assert torch.equal(x, through(effect, x, context(2, 30)))
    assert torch.equal(x, through(at_zero(effect), x, context(2, 30)))
    assert not torch.equal(x, through(stir(copy.deepcopy(effect)), x, context(2, 30)))


@EVERY
@pytest.mark.parametrize("elapsed", [True, False])
def test_stepping_is_scanning(effect, elapsed):
    effect, steps = stir(copy.deepcopy(effect)), 60
    x, seen = signal(effect, 3, steps, 1), context(3, steps)
    memory = effect.rest(x[:, 0])
    with torch.no_grad():
        compiled = effect.scan(memory, x, seen)
    scanned = effect.scan(memory, x, seen)
    answers = effect.apply(x, scanned)
    for t in range(steps):
        now = at(seen, t, elapsed)
        stepped, answer = effect.step(memory, x[:, t], now)
        memory = effect.advance(memory, x[:, t], now)
        assert torch.equal(stepped, memory)
        assert torch.equal(answer, effect.apply(x[:, t], memory))
        assert torch.allclose(memory, scanned[:, t], rtol=1e-5, atol=2e-4)
        assert torch.allclose(memory, compiled[:, t], rtol=1e-5, atol=2e-5)
        assert torch.allclose(answer, answers[:, t], rtol=1e-5, atol=2e-4)


@EVERY
def test_sensitivities_are_the_slopes_at_zero_amplitude(effect):
    """Central differences in float64 of every amplitude, one by one."""
    effect = at_zero(effect).double()
    x, seen = signal(effect, 1, 400, 0).double(), context(1, 400)
    memory = effect.scan(effect.rest(x[:, 0]), x, seen)
    columns = effect.sensitivities(x, memory)
    found = []
    with torch.no_grad():
        for strength in effect.amplitudes().values():
            for number in range(strength.numel()):
                sides = []
                for step in (1e-5, -1e-5):
                    strength.view(-1)[number] = step
                    sides.append(effect.apply(x, memory))
                    strength.view(-1)[number] = 0
                found.append((sides[0] - sides[1]) / 2e-5)
    assert columns.shape == (len(found), *x.shape)
    assert torch.allclose(columns, torch.stack(found), rtol=1e-5, atol=1e-5)
    assert all(column.any() for column in columns)


@EVERY
def test_gradients_are_right(effect):
    """By every parameter, through scan and apply, against central differences in float64."""
    effect = stir(copy.deepcopy(effect), size=0.05).double()
    x, seen = signal(effect, 1, 25, 4).double(), context(1, 25)
    weight = torch.randn(x.shape, generator=torch.Generator().manual_seed(5)).double()

    def score():
        return (weight * through(effect, x, seen)).sum()

    parameters = dict(effect.named_parameters())
    slopes = torch.autograd.grad(score(), list(parameters.values()))
    with torch.no_grad():
        for (name, parameter), slope in zip(parameters.items(), slopes, strict=True):
            flat = parameter.view(-1)
            for number in range(0, flat.numel(), max(1, flat.numel() // 3)):
                before, sides = flat[number].item(), []
                for step in (1e-5, -1e-5):
                    flat[number] = before + step
                    sides.append(score())
                flat[number] = before
                measured = float(sides[0] - sides[1]) / 2e-5
                expected = pytest.approx(measured, rel=1e-3, abs=2e-3)
                assert slope.flatten()[number].item() == expected, name


@EVERY
def test_arms_do_not_disturb_each_other(effect):
    effect, seen = stir(copy.deepcopy(effect)), context(3, 40)
    x = signal(effect, 3, 40, 6)
    together = through(effect, x, seen)
    x = x.clone()
    x[1] = torch.nan
    again = through(effect, x, seen)
    assert torch.equal(together[[0, 2]], again[[0, 2]])


@EVERY
def test_memory_starts_as_if_nothing_had_happened(effect):
    """Rest has the batch in front, and zero time at the same signal leaves it as it is."""
    effect = stir(copy.deepcopy(effect))
    x = signal(effect, 4, 1, 7)
    memory = effect.rest(x[:, 0])
    assert memory.shape[0] == 4
    now = Context(torch.zeros(4))
    assert torch.allclose(effect.advance(memory, x[:, 0], now), memory, atol=1e-5)


@EVERY
def test_rebuilt_from_its_config(effect):
    stirred = stir(copy.deepcopy(effect))
    again = type(effect)(FACTS, **effect.config())
    again.load_state_dict(stirred.state_dict())
    x = signal(effect, 2, 20, 1)
    assert torch.equal(through(again, x, context(2, 20)), through(stirred, x, context(2, 20)))


@EVERY
def test_quantities_have_unit_range_and_source(effect):
    quantities = effect.quantities()
    assert len({quantity.name for quantity in quantities}) == len(quantities) > 0
    for quantity in quantities:
        assert quantity.low < quantity.high
        assert quantity.source
        assert not quantity.unit or quantity.name.endswith("_" + quantity.unit.replace("/", "_"))
    assert effect.plausible(), effect.implausible()


@EVERY
def test_amplitudes_and_nonlinear_parameters_are_all_parameters(effect):
    named = dict(effect.named_parameters())
    assert {**effect.amplitudes(), **effect.nonlinear_parameters()}.keys() == named.keys()
    mine = {id(p) for p in named.values()}
    assert all(id(p) in mine for p in effect.memory_parameters())


@pytest.mark.parametrize("name", known_effects())
def test_registered_under_its_file(name):
    effect = make_effect(name, FACTS)
    assert type(effect).__module__.rsplit(".", 1)[1] == name
    assert effect.stage in STAGES
    assert type(effect).__doc__


@pytest.mark.parametrize("name", known_effects())
@pytest.mark.parametrize("chambers", [1, 2, 4])
def test_any_number_of_chambers(name, chambers):
    arm = facts(chambers)
    points = REST_MM + torch.randn(50, 5, 3, generator=torch.Generator().manual_seed(0))
    for effect in [make_effect(name, arm), *candidates(name, arm, points)]:
        x = torch.rand(2, 9, chambers) * 40
        if effect.stage in ("body", "sensor"):
            x = points[:18].view(2, 9, 5, 3)
        seen = context(2, 9, chambers=chambers)
        assert through(effect, x, seen).shape == x.shape
        memory = effect.scan(effect.rest(x[:, 0]), x, seen)
        assert effect.sensitivities(x, memory).isfinite().all()


def test_unknown_effect_names_the_known_ones():
    with pytest.raises(InputError, match=r"known are .*hysteresis"):
        make_effect("gremlins", FACTS)


@pytest.mark.parametrize("name", known_effects())
@pytest.mark.parametrize("count", [1, 2])
def test_few_key_points(name, count):
    """Also an arm with a tip alone, and where the shape at rest is not known yet."""
    for rest_mm in (REST_MM[-count:], torch.zeros(count, 3)):
        arm = dataclasses.replace(FACTS, rest_mm=rest_mm)
        points = REST_MM[-count:] + torch.randn(50, count, 3, generator=torch.manual_seed(0))
        for effect in [make_effect(name, arm), *candidates(name, arm, points)]:
            x = points[:18].view(2, 9, count, 3) if on_points(effect) else torch.rand(2, 9, 3) * 40
            memory = effect.scan(effect.rest(x[:, 0]), x, context(2, 9))
            columns = effect.sensitivities(x, memory)
            assert columns.isfinite().all()
            assert stir(effect).apply(x, memory).shape == columns.shape[1:]
