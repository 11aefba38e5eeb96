"""Forward, exchanged, back: on a hand-made table of losses, and on a robot that hides two."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest

from surgisoft.diagnosis import selection
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.residuals import problem_of
from surgisoft.diagnosis.selection import ModelSelection, Option, Score
from surgisoft.diagnosis.statistics import sign_flip_p_values
from surgisoft.measurement.protocols import make_protocol
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.checkpoint import load_model, load_training_residuals

NAMES = ("blend", "left", "right")
LOSS = {"": 100, "0": 40, "1": 55, "2": 50, "01": 20, "02": 18, "12": 2, "012": 2}
"""Loss of every set of effects: the blend is best alone, left and right are the truth."""


@dataclass
class Table:
    """A race whose losses are those of LOSS, spread over blocks."""

    floor = np.full(40, 1.0 / 40)
    whole_size = 3.0

    def losses(self, chosen=()):
        rng = np.random.default_rng(0)
        share = rng.uniform(0.9, 1.1, 40)
        return LOSS["".join(str(p) for p in sorted(set(chosen)))] * share / 40

    def excess(self, losses):
        return float(losses.sum() - 1.0)

    def in_fit(self, effect):
        return False

    def size(self, losses):
        return 3.0

    def scores(self, base=(), without=()):
        answer = []
        for place, name in enumerate(NAMES):
            if name in without:
                continue
            after = self.losses((*base, place))
            gain = np.log((self.losses(base) + 0.01) / (after + 0.01))
            gain = gain + np.random.default_rng(place).normal(0, 1e-3, 40)
            share = (self.losses(base).sum() - after.sum()) / self.excess(self.losses(base))
            chance = float(sign_flip_p_values(gain[None])[0])
            answer.append(Score(name, Option(name, (place,), 0), after, gain, chance, share))
        return sorted(answer, key=lambda s: -s.score)


@pytest.fixture
def table(monkeypatch):
    race = Table()

    def beside(race, named, further):
        base = sum((s.option.chosen for s in named), ())
        return float(race.losses(base).sum()), further

    monkeypatch.setattr(selection, "beside_relaxed", beside)
    return race


def test_the_best_alone_gives_way_to_the_two_that_are_best_together(table):
    first = table.scores()
    assert first[0].effect == "blend"
    named, following = selection.select_effects(table, first)
    assert [s.effect for s in named] == ["right", "left"]
    assert [s.effect for s in following] == ["blend"]


def test_an_effect_of_the_fit_is_not_named_for_what_the_fit_left(table, monkeypatch):
    monkeypatch.setattr(table, "in_fit", lambda effect: effect == "blend", raising=False)
    named, _ = selection.select_effects(table, table.scores())
    assert "blend" not in [s.effect for s in named]
    monkeypatch.setattr(table, "in_fit", lambda effect: True)
    assert selection.select_effects(table, table.scores())[0] == []


def test_an_error_within_the_validated_one_needs_more_to_be_named(table, monkeypatch):
    """Two fifths of the error are enough where it is large, not where the surrogate's is larger."""
    part = replace(table.scores()[0], losses=table.losses() * 0.6 + 0.4 / 40)
    assert selection.passes(table, [part], [], part)
    monkeypatch.setattr(table, "whole_size", 0.7)
    assert not selection.passes(table, [part], [], part)


@pytest.mark.parametrize(("left", "joins"), [(9, True), (12, False)])
def test_a_second_effect_that_does_well_alone_joins_where_no_shadow_does_as_well(
    table, monkeypatch, left, joins
):
    """It leaves 35 of 100 alone, the first 20: a share of 0.66 is more than 0.75 times 0.81."""
    monkeypatch.setitem(globals(), "LOSS", {"": 100, "0": 20, "1": 35, "01": left})
    monkeypatch.setitem(globals(), "NAMES", ("first", "second"))
    first = table.scores()
    second = table.scores((0,), ("first",))[0]
    assert selection.passes(table, first, first[:1], second) == joins


def test_what_a_form_leaves_behind_is_no_further_effect(table, monkeypatch):
    """Where the first effect let loose explains what the second would, one is named."""

    def nothing_left(race, named, further):
        small = race.losses((1, 2))
        gain = np.zeros(40)
        return float(small.sum()), Score(further.effect, further.option, small, gain, 1.0, 0.0)

    monkeypatch.setattr(selection, "beside_relaxed", nothing_left)
    named, _ = selection.select_effects(table, table.scores())
    assert [s.effect for s in named] == ["blend"]


def test_exchanges_that_go_in_a_circle_end_at_the_best(table, monkeypatch):
    """Left gives way to right and right to left, for ever: right leaves less, 50 and not 55."""
    first = {s.effect: s for s in table.scores()}
    turn = itertools.cycle(["left", "right"])
    monkeypatch.setattr(selection, "exchanged", lambda race, named: [first[next(turn)]])
    named, following = selection.select_effects(table, list(first.values()))
    assert [s.effect for s in named] == ["right"]
    assert {s.effect for s in following} == {"blend", "left"}


def test_two_effects_of_a_robot_are_both_named():
    rig = VirtualRig(0, take=3, hidden=(("creep", 1.2), ("payload", 1.2)))
    recording, _ = rig.record(make_protocol("mixed", rig.limits, 6000, seed=3))
    model, known = load_model("default"), load_training_residuals("default")
    found = diagnose(model, [recording], reference=known)
    assert found.verdict.kind == "several"
    assert set(found.verdict.effects) == {"creep", "payload"}


def test_what_the_fit_left_is_the_validated_error_with_the_effect_in_the_model():
    rig = VirtualRig(0, take=5)
    recording, _ = rig.record(make_protocol("ramps", rig.limits, 1200, seed=5))
    problem = problem_of(load_model("default"), [recording], part="training")
    square = np.square(problem.residual).sum(2)
    above = float(np.sqrt(np.nanmean(square) - np.mean(problem.noise_mm**2)))

    def in_fit(effect, factor):
        validated = np.full_like(problem.discrepancy_mm, factor * above)
        return ModelSelection.of(replace(problem, discrepancy_mm=validated), []).in_fit(effect)

    assert in_fit("hysteresis", 1.01)
    assert not in_fit("hysteresis", 0.99)
    assert not in_fit("creep", 2.0)  # the model was fitted without it


@pytest.mark.parametrize("name", ["leak", "breathing", "fibre_break"])
def test_what_is_outside_the_list_is_not_called_by_its_nearest_relative(name):
    """A leak has nearly the form of a gain, a breaking fibre that of a drift; breathing shifts the
    mount only now and then."""
    rig = VirtualRig(0, take=5, hidden=((name, 2.0),))
    recording, _ = rig.record(make_protocol("mixed", rig.limits, 6000, seed=5))
    model, known = load_model("default"), load_training_residuals("default")
    found = diagnose(model, [recording], reference=known)
    assert found.verdict.kind == "unknown_effect"
    assert found.ranking[0].confidence <= 0.25
