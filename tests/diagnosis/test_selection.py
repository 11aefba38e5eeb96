"""Proposals from a hand-made table of losses, and from a robot that hides two effects."""

from dataclasses import dataclass, replace
from itertools import combinations
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from surgisoft.diagnosis import selection
from surgisoft.diagnosis.candidates import candidates
from surgisoft.diagnosis.criteria import SEARCH
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.residuals import problem_of
from surgisoft.diagnosis.selection import ModelSelection, Option, RelaxedFit, Score, propose
from surgisoft.diagnosis.statistics import sign_flip_p_values
from surgisoft.measurement.protocols import make_protocol
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.checkpoint import load_model, load_training_residuals

NAMES = ("blend", "left", "right")
LOSS = {"": 100, "0": 40, "1": 55, "2": 50, "01": 20, "02": 18, "12": 2, "012": 2}
"""Loss of every set of effects: the blend is best alone, left and right are the truth."""


def forms_of(names, count):
    """So many forms of every effect, numbered through."""
    return {
        name: [Option(name, (count * i + k,), count * i + k, 1) for k in range(count)]
        for i, name in enumerate(names)
    }


@dataclass
class Table:
    """A model selection whose losses are those of LOSS, spread over blocks."""

    floor = np.full(40, 1.0 / 40)
    whole_size = 3.0
    options: ClassVar = forms_of(NAMES, 1)
    loss: ClassVar = LOSS

    def losses(self, chosen=(), common=()):
        rng = np.random.default_rng(0)
        share = rng.uniform(0.9, 1.1, 40)
        return self.loss["".join(str(p) for p in sorted(set(chosen)))] * share / 40

    def losses_of(self, sets, common=None):
        return np.array([self.losses(each) for each in sets]).reshape(len(sets), 40)

    def excess(self, losses):
        return float(losses.sum() - 1.0)

    def in_fit(self, effect):
        return False

    def size(self, losses):
        return 3.0

    def log_ratio(self, before, after):
        return np.log((before + self.floor) / (after + self.floor))

    def plausible(self, option, base=()):
        return True

    def every_score(self, base=(), without=()):
        answer = []
        for name, options in self.options.items():
            for option in options if name not in without else []:
                after = self.losses((*base, *option.chosen))
                gain = np.log((self.losses(base) + 0.01) / (after + 0.01))
                gain = gain + np.random.default_rng(option.chosen[0]).normal(0, 1e-3, 40)
                share = (self.losses(base).sum() - after.sum()) / self.excess(self.losses(base))
                chance = float(sign_flip_p_values(gain[None])[0])
                answer.append(Score(name, option, after, gain, chance, share))
        return answer

    def scores(self, base=(), without=()):
        return sorted(self.every_score(base, without), key=lambda s: -s.score)


@pytest.fixture
def table(monkeypatch):
    table = Table()
    nothing = RelaxedFit(table.losses(), 0.0, 0.0, 1.0)
    monkeypatch.setattr(selection, "beside_relaxed", lambda table, named, further: further)
    monkeypatch.setattr(selection, "relaxed_fit", lambda table, named: nothing)
    return table


def test_the_best_alone_gives_way_to_the_two_that_are_best_together(table):
    first = table.scores()
    assert first[0].effect == "blend"
    one, two = selection.propose(table, first)
    assert one.effects == ("blend",)
    assert two.effects == ("right", "left")
    assert [score.effect for score in two.instead] == ["blend", "blend"]


def test_two_that_are_not_plausible_beside_each_other_are_not_proposed(table, monkeypatch):
    """Left and right explain most, but right would have an impossible parameter beside left."""
    monkeypatch.setattr(
        table,
        "plausible",
        lambda option, base=(): not (option.effect == "right" and base == (1,)),
        raising=False,
    )
    assert selection.propose(table, table.scores())[1].effects == ("blend", "right")
    monkeypatch.setattr(table, "plausible", lambda option, base=(): not base)
    assert [p.effects for p in selection.propose(table, table.scores())] == [("blend",)]


def test_one_of_two_need_not_be_plausible_alone(table):
    """Beside a drift a weight alone would be negative: it is no candidate alone, but one of two."""
    alone = [score for score in table.scores() if score.effect != "right"]
    assert selection.propose(table, alone)[1].effects == ("right", "left")


def test_nothing_is_proposed_only_where_every_effect_alone_is_within_chance(table):
    """The effect that explains most may be within chance where a smaller one is not."""
    first = [replace(score, p_value=0.5, gain=0.4) for score in table.scores()]
    assert selection.propose(table, first) == ()
    first[-1] = replace(first[-1], p_value=0.1)
    one, two = selection.propose(table, first)
    assert one.scores == (first[0],)
    assert two.effects == ("right", "left")
    assert selection.close_to_best(first, 0.9)[0] is first[0]


def test_the_best_two_of_all_pairs_are_proposed_in_their_best_forms(table, monkeypatch):
    """Random losses of three effects with three forms each that two divide as products: the
    proposal leaves the least of all 27 pairs of forms, and the effect missed most comes first."""
    monkeypatch.setattr(Table, "options", forms_of(NAMES, 3))
    pairs = list(combinations(range(9), 2))
    for seed in range(20):
        alone = np.random.default_rng(seed).uniform(0.2, 0.9, 9)
        loss = {"": 100.0} | {str(i): 100.0 * alone[i] for i in range(9)}
        loss |= {f"{i}{j}": 100.0 * alone[i] * alone[j] for i, j in pairs}
        monkeypatch.setattr(Table, "loss", loss)
        apart = [(i, j) for i, j in pairs if i // 3 != j // 3]
        least = min(apart, key=lambda pair: loss[f"{pair[0]}{pair[1]}"])
        found = selection.best_pair(table, NAMES)
        assert {score.option.candidate for score in found} == set(least)
        assert alone[found[0].option.alone] <= alone[found[1].option.alone]


def test_forms_are_exchanged_until_no_other_form_is_better(table, monkeypatch):
    """The best pair of forms is four exchanges away from the two that are best alone."""
    monkeypatch.setattr(Table, "options", forms_of(NAMES[:2], 3))
    loss = {"": 100} | {str(i): 90 for i in range(6)} | {"0": 80, "3": 80}
    loss |= {f"{i}{j}": 70 for i in range(3) for j in range(3, 6)}
    loss |= {"03": 60, "04": 50, "14": 40, "15": 30, "25": 10}
    monkeypatch.setattr(Table, "loss", loss)
    found = selection.best_pair(table, NAMES[:2])
    assert {score.option.candidate for score in found} == {2, 5}


def test_a_proposal_is_tested_when_its_tests_are_read(table, monkeypatch):
    """`compare` asks what the effects leave, and nothing else."""
    asked = []
    monkeypatch.setattr(selection, "relaxed_fit", lambda _, named: asked.append(len(named)))
    one, two = selection.propose(table, table.scores())
    assert (one.chosen, two.chosen, asked) == ((0,), (2, 1), [])
    assert two.relaxed is two.relaxed
    assert asked == [2]


def test_an_effect_of_the_fit_is_not_proposed_for_what_the_fit_left(table, monkeypatch):
    monkeypatch.setattr(table, "in_fit", lambda effect: effect == "blend", raising=False)
    one, two = selection.propose(table, table.scores())
    assert (one.effects, two.effects) == (("right",), ("right", "left"))
    monkeypatch.setattr(table, "in_fit", lambda effect: True)
    assert selection.propose(table, table.scores()) == ()


def test_what_is_within_chance_and_small_is_not_proposed(table):
    best = table.scores()[0]
    assert selection.propose(table, [replace(best, p_value=0.3, gain=0.2)]) == ()
    assert selection.propose(table, [replace(best, p_value=0.1, gain=0.2)]) != ()
    assert selection.propose(table, [replace(best, p_value=0.3, gain=0.6)]) != ()


def test_no_share_of_what_can_be_explained_is_above_one():
    """Creep explains nearly all, and the sidecar states a noise that is larger than the error."""
    rig = VirtualRig(0, take=5, hidden=(("creep", 1.0),))
    recording, _ = rig.record(make_protocol("mixed", rig.limits, 1200, seed=5))
    loud = replace(recording, noise_mm=2.0)
    problem = problem_of(load_model("default"), [loud], part="training")
    assert problem.rmse_mm < problem.floor_mm
    found = ModelSelection.of(problem, candidates(problem, ["creep", "payload", "line_lag"]))
    for score in found.scores():
        assert score.gain <= 1.0
    assert max(found.unique_gains(found.scores()).values()) <= 1.0


def test_products_are_those_of_the_measured_numbers():
    """Of sensitivities of two candidates out of order, against sums over one column after another;
    more rows than are multiplied at once, and key points are missing."""
    rng = np.random.default_rng(0)
    residual = rng.normal(size=(selection.AT_ONCE + 30, 2, 3))
    residual[3, 1] = residual[-4:, 0] = np.nan
    field = rng.normal(size=residual.shape)
    both = [rng.normal(size=(*residual.shape, count)) for count in (2, 3)]
    given = [SimpleNamespace(sensitivities=each) for each in both]
    problem = SimpleNamespace(residual=residual)
    found = ModelSelection(problem, given, None, {}, np.ones(1))
    columns = [both[1][..., 2], both[0][..., 0], both[0][..., 1]]
    seen = ~np.isnan(residual)
    gram, moment = found.products((4, 0, 1), field)
    expected = [[(one * other)[seen].sum() for other in columns] for one in columns]
    np.testing.assert_allclose(gram, expected, rtol=1e-12, atol=1e-10)
    expected = [(one * field)[seen].sum() for one in columns]
    np.testing.assert_allclose(moment, expected, rtol=1e-12, atol=1e-10)


def test_two_effects_of_a_robot_are_proposed_together():
    rig = VirtualRig(0, take=3, hidden=(("creep", 1.2), ("payload", 1.2)))
    recording, _ = rig.record(make_protocol("mixed", rig.limits, 3000, seed=3))
    model, known = load_model("default"), load_training_residuals("default")
    found = diagnose(model, [recording], reference=known, setup_tests=False)
    assert found.ranking[0].effect in ("creep", "payload")
    assert found.probabilities is not None
    assert set(found.probabilities.two) == {"creep", "payload"}
    assert found.probabilities.pair > 0.3


def test_what_the_fit_left_is_the_validated_error_with_the_effect_in_the_model():
    rig = VirtualRig(0, take=5)
    recording, _ = rig.record(make_protocol("ramps", rig.limits, 1200, seed=5))
    problem = problem_of(load_model("default"), [recording], part="training")
    square = np.square(problem.residual).sum(2)
    above = float(np.sqrt(np.nanmean(square) - np.mean(problem.noise_mm**2)))

    def in_fit(effect, factor):
        validated = np.full_like(problem.discrepancy_mm, factor * above)
        known = replace(problem, discrepancy_mm=validated, tolerance_mm=validated)
        return ModelSelection.of(known, []).in_fit(effect)

    assert in_fit("hysteresis", 1.01)
    assert not in_fit("hysteresis", 0.99)
    assert not in_fit("creep", 2.0)  # the model was fitted without it


@pytest.mark.parametrize("name", ["leak", "breathing", "fibre_break"])
def test_what_is_outside_the_list_is_not_called_by_its_nearest_relative(name):
    """A leak has nearly the form of a gain, a breaking fibre that of a drift; breathing shifts the
    mount only now and then."""
    rig = VirtualRig(0, take=5, hidden=((name, 2.0),))
    recording, _ = rig.record(make_protocol("mixed", rig.limits, 2000, seed=5))
    model, known = load_model("default"), load_training_residuals("default")
    found = diagnose(model, [recording], reference=known, setup_tests=False)
    assert found.verdict.kind not in ("nothing_missing", "surrogate_undertrained")
    assert max(row.confidence for row in found.ranking) < 0.8
    if name == "breathing":
        assert found.verdict.kind == "unknown_effect"


def test_an_effect_within_chance_is_not_proposed():
    """Selection that would go on with it fails here: nothing of it is there."""
    score = Score("creep", None, np.zeros(3), np.zeros(3), p_value=0.9, gain=0.1)
    nothing = SimpleNamespace(in_fit=lambda effect: False)
    assert propose(nothing, [score]) == ()
    for better in (replace(score, p_value=0.01), replace(score, gain=0.9)):
        with pytest.raises(AttributeError):
            propose(nothing, [better])


def test_what_is_reached_can_be_explained():
    """A floor that is stated too large leaves an excess of 4 of 10; a candidate explains 9."""
    before, after = np.array([6.0, 4.0]), np.array([0.5, 0.5])
    known = SimpleNamespace(excess=lambda losses: losses.sum() - 6.0)
    whole = ModelSelection.explainable(known, before, [after])
    assert whole == pytest.approx(9.0)
    assert (before.sum() - after.sum()) / whole <= 1.0
    assert ModelSelection.explainable(known, before, []) == pytest.approx(4.0)


def test_more_amplitudes_never_rank_higher():
    """Also of log gains below zero, where an effect makes the error larger."""
    for gain in (-1.0, -0.01, 0.0, 0.5):
        prices = [SEARCH.priced(gain, count) for count in (1, 4, 12, 40)]
        assert prices == sorted(prices, reverse=True)
    assert SEARCH.priced(-1.0, 12) == pytest.approx(-1.036)


def test_each_of_the_first_twelve_amplitudes_costs_three_thousandths():
    assert SEARCH.priced(2.0, 0) == 2.0
    assert SEARCH.priced(2.0, 4) == pytest.approx(2.0 * (1.0 - 0.012))
    assert SEARCH.priced(2.0, 12) == SEARCH.priced(2.0, 360) == pytest.approx(2.0 * (1.0 - 0.036))
