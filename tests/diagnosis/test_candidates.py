"""Columns against differences of the whole model's predictions."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from surgisoft.diagnosis.candidates import candidates, copied, facts_of, with_effect
from surgisoft.diagnosis.residuals import held_out_rows, problem_of
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import Recording
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.checkpoint import default_arm, load_model, save_model
from surgisoft.surrogate.effects import EFFECTS, make_effect


@pytest.fixture(scope="module")
def recording():
    rig = VirtualRig(0)
    return rig.record(make_protocol("mixed", rig.limits, 1000, seed=1))[0]


@pytest.fixture(scope="module")
def problem(recording):
    return problem_of(default_arm(), [recording], rows=400)


@pytest.fixture(scope="module")
def pressurised(recording):
    """The last run from its highest load on."""
    last = recording.runs[-1]
    top = last.start + int(recording.measured[last.start : last.stop - 100].sum(axis=1).argmax())
    rows = slice(top, last.stop)
    names = ("t_s", "measured", "key_points_mm")
    cut = Recording("cut", **{name: getattr(recording, name)[rows] for name in names})
    return problem_of(default_arm(), [cut], rows=400)


def test_a_room_that_was_warm_all_along_is_the_room_of_the_model():
    """Where the model does not say how warm it was: the mean of what was measured."""
    plain = replace(default_arm().facts, temperature_C=None)
    warm = SimpleNamespace(temperature_C=torch.tensor([[20.0, torch.nan, 25.0]]))
    unknown = SimpleNamespace(temperature_C=None)
    for stated, history, expected in (
        (None, warm, 22.5),
        (30.0, warm, 30.0),
        (None, unknown, None),
    ):
        model = SimpleNamespace(facts=replace(plain, temperature_C=stated))
        found = facts_of(SimpleNamespace(model=model, history=history))
        assert found == replace(plain, temperature_C=expected)


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_a_copied_effect_has_values_of_its_own(name):
    """Amplitudes and nonlinear parameters of the copy change, those of the effect stay."""
    effect = make_effect(name, default_arm().facts)
    kept = {key: value.clone() for key, value in effect.state_dict().items()}
    twin = copied(effect)
    assert type(twin) is type(effect)
    assert [*twin.state_dict()] == [*kept]
    own = {**twin.amplitudes(), **twin.nonlinear_parameters()}
    assert own.keys() == {**effect.amplitudes(), **effect.nonlinear_parameters()}.keys()
    with torch.no_grad():
        for parameter in own.values():
            parameter.add_(1.0)
    assert all(torch.equal(value, kept[key]) for key, value in effect.state_dict().items())
    assert any(not torch.equal(value, kept[key]) for key, value in twin.state_dict().items())


@pytest.mark.parametrize("name", ["creep", "inertia", "rate_dependence", "softening", "payload"])
def test_columns_are_slopes_where_a_run_begins_away_from_rest(pressurised, name):
    model = pressurised.model
    assert not torch.equal(model.first_pressure(pressurised.history), model.rest[None])
    test_columns_are_slopes_of_the_whole_prediction(pressurised, name)


@pytest.mark.parametrize("name", sorted(set(EFFECTS) - {"hysteresis"}))
def test_columns_are_slopes_of_the_whole_prediction(problem, name):
    """Material, body and sensor effects exactly; line effects up to the plays behind them.

    The middle one of the candidates of each stage, and each of its first four amplitudes.
    """
    some = candidates(problem, [name])
    for stage in {each.effect.stage for each in some}:
        own = [each for each in some if each.effect.stage == stage]
        check_columns(problem, name, own[len(own) // 2])


def check_columns(problem, name, candidate):
    """Its sensitivities are differences of the whole model's predictions."""
    count = candidate.sensitivities.shape[3]
    step = 1e-2 / max(float(np.abs(candidate.sensitivities).max()), 1e-9)
    for k in range(min(count, 4)):
        amplitudes = np.zeros(count)
        amplitudes[k] = 20 * step
        effect = candidate.with_amplitudes(amplitudes)
        with torch.no_grad():
            model = with_effect(problem.model, name, effect)
            change = problem.rows(model.predict(problem.history)).numpy() - problem.predicted
        column = candidate.sensitivities[..., k]
        off = np.abs(change / (20 * step) - column)
        tolerance = 0.35 if effect.stage == "line" else 0.06
        scale = np.sqrt(np.square(column).mean())
        assert np.sqrt(np.square(off).mean()) < tolerance * scale


def test_more_of_an_effect_is_its_own_share(problem):
    """A column of more hysteresis: what a tenth more of its push changes, to first order."""
    candidate = candidates(problem, ["hysteresis"])[0]
    assert candidate.more
    model = problem.model
    with torch.no_grad():
        trace = model.trace(problem.history)
        push = trace.behind["material"] - trace.pressure
        more = model.network(trace.pressure + 1.1 * push, trace.direction)
        same = model.network(trace.pressure + push, trace.direction)
        change = problem.rows(more - same).numpy()
    off = change / 0.1 - candidate.sensitivities[..., 0]
    assert np.sqrt(np.square(off).mean()) < 0.05 * np.sqrt(np.square(change / 0.1).mean())


def test_more_of_a_wall_of_the_body_is_what_it_changes(problem):
    """A tenth more of a creep of the body moves the key points by a tenth of the column."""
    creep = make_effect("creep", problem.model.facts, body=True)
    with torch.no_grad():
        for amplitude in creep.amplitudes().values():
            amplitude.fill_(0.2)
    arm = with_effect(problem.model, "creep", creep.requires_grad_(False))
    (candidate,) = [each for each in candidates(problem.with_model(arm), ["creep"]) if each.more]
    with torch.no_grad():
        same = problem.rows(arm.predict(problem.history)).numpy()
        for amplitude in creep.amplitudes().values():
            amplitude.mul_(1.1)
        more = problem.rows(arm.predict(problem.history)).numpy()
    change = more - same
    off = change / 0.1 - candidate.sensitivities[..., 0]
    assert np.sqrt(np.square(change).mean()) > 0.005
    assert np.sqrt(np.square(off).mean()) < 0.05 * np.sqrt(np.square(change / 0.1).mean())


def test_beside_more_of_an_effect_there_are_loops_of_other_widths(problem):
    """Loops add up, so a model with hysteresis may lack a narrow one; of creep there is no more."""
    made = candidates(problem, ["hysteresis"])
    assert [candidate.more for candidate in made] == [True, False, False, False, False]
    assert [candidate.effect.stage for candidate in made] == ["material"] * 4 + ["body"]
    widths = {candidate.effect.others: candidate.effect.radii[0] for candidate in made[1:4]}
    assert len(widths) == 3
    assert max(widths.values()) < 0.02
    creep = make_effect("creep", problem.model.facts)
    with torch.no_grad():
        next(iter(creep.amplitudes().values())).fill_(0.1)
    fresh = with_effect(problem.model, "creep", creep)
    assert [c.more for c in candidates(problem.with_model(fresh), ["creep"])] == [True]


def test_training_and_held_out_parts_share_no_row(recording, problem):
    """The last runs are held out, and both parts together are everything."""
    held_out = held_out_rows([recording])
    last = recording.runs[-1]
    assert held_out[last].all()
    assert not held_out[: last.start].any()
    model = problem.model
    parts = [
        problem_of(model, [recording], rows=10**6, part=part) for part in ("training", "held_out")
    ]
    indices = [set(part.index.tolist()) for part in parts]
    assert not indices[0] & indices[1]
    everything = problem_of(model, [recording], rows=10**6)
    assert indices[0] | indices[1] == set(everything.index.tolist())


def test_blocks_are_contiguous_stretches_of_one_run(problem):
    run = problem.history.run_of_row.numpy()[problem.index.numpy()]
    assert (np.diff(problem.block) >= 0).all()
    for block in np.unique(problem.block):
        assert len(np.unique(run[problem.block == block])) == 1


def test_one_more_of_a_kind_can_be_saved_and_opened(problem, tmp_path):
    """A second creep has a name that a model's folder knows."""
    model = problem.model
    for _ in range(2):
        model = with_effect(model, "creep", make_effect("creep", model.facts))
    save_model(model, tmp_path / "arm")
    assert list(load_model(tmp_path / "arm").effects) == [
        *problem.model.effects,
        "creep",
        "creep#2",
    ]
