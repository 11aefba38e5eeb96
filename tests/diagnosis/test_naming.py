"""Forward, exchanged, back: on a hand-made table of losses, and on a robot that hides two."""

from dataclasses import dataclass

import numpy as np
import pytest

from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.race import naming
from surgisoft.diagnosis.race.gates import family_p_values
from surgisoft.diagnosis.race.ranking import Option, Standing
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.rig import VirtualRig
from surgisoft.surrogate.checkpoint import load_known_error, load_model

NAMES = ("blend", "left", "right")
LOSS = {"": 100, "0": 40, "1": 55, "2": 50, "01": 20, "02": 18, "12": 2, "012": 2}
"""Loss of every set of effects: the blend is best alone, left and right are the truth."""


@dataclass
class Table:
    """A race whose losses are those of LOSS, spread over blocks."""

    floor = np.full(40, 1.0 / 40)

    def losses(self, picked=()):
        rng = np.random.default_rng(0)
        share = rng.uniform(0.9, 1.1, 40)
        return LOSS["".join(str(p) for p in sorted(set(picked)))] * share / 40

    def excess(self, losses):
        return float(losses.sum() - 1.0)

    def standings(self, base=(), without=()):
        answer = []
        for place, name in enumerate(NAMES):
            if name in without:
                continue
            after = self.losses((*base, place))
            gain = np.log((self.losses(base) + 0.01) / (after + 0.01))
            gain = gain + np.random.default_rng(place).normal(0, 1e-3, 40)
            share = (self.losses(base).sum() - after.sum()) / self.excess(self.losses(base))
            chance = float(family_p_values(gain[None])[0])
            answer.append(Standing(name, Option(name, (place,), 0), after, gain, chance, share))
        return sorted(answer, key=lambda s: -s.score)


@pytest.fixture
def table(monkeypatch):
    race = Table()

    def beside(race, named, further):
        base = sum((s.option.picked for s in named), ())
        return float(race.losses(base).sum()), further

    monkeypatch.setattr(naming, "beside_loose", beside)
    return race


def test_the_best_alone_gives_way_to_the_two_that_are_best_together(table):
    first = table.standings()
    assert first[0].effect == "blend"
    named, following = naming.name_effects(table, first)
    assert [s.effect for s in named] == ["right", "left"]
    assert [s.effect for s in following] == ["blend"]


def test_what_a_form_leaves_behind_is_no_further_effect(table, monkeypatch):
    """Where the first effect let loose explains what the second would, one is named."""

    def nothing_left(race, named, further):
        small = race.losses((1, 2))
        gain = np.zeros(40)
        return float(small.sum()), Standing(further.effect, further.option, small, gain, 1.0, 0.0)

    monkeypatch.setattr(naming, "beside_loose", nothing_left)
    named, _ = naming.name_effects(table, table.standings())
    assert [s.effect for s in named] == ["blend"]


def test_two_effects_of_a_robot_are_both_named():
    rig = VirtualRig(0, take=3, hidden=(("creep", 1.2), ("payload", 1.2)))
    recording, _ = rig.record(make_protocol("mixed", rig.limits, 6000, seed=3))
    model, known = load_model("default"), load_known_error("default")
    found = diagnose(model, [recording], reference=known)
    assert found.verdict.kind == "several"
    assert set(found.verdict.effects) == {"creep", "payload"}


@pytest.mark.parametrize("name", ["leak", "breathing"])
def test_what_is_outside_the_list_is_not_called_by_its_nearest_relative(name):
    """A leak has nearly the form of a gain; breathing shifts the mount only now and then."""
    rig = VirtualRig(0, take=5, hidden=((name, 2.0),))
    recording, _ = rig.record(make_protocol("mixed", rig.limits, 6000, seed=5))
    model, known = load_model("default"), load_known_error("default")
    found = diagnose(model, [recording], reference=known)
    assert found.verdict.kind == "unknown_effect"
    assert found.ranking[0].confidence <= 0.25
