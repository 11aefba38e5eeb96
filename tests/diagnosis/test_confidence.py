"""Confidence follows the evidence: an effect's name changes nothing, its unique gain does."""

from dataclasses import replace

import pytest

from surgisoft.diagnosis.decision import decide, load_decision
from surgisoft.diagnosis.evidence import Evidence
from tests.diagnosis.test_decision import CREEP, GOOD, LAG, PAIR

SURE = 0.8
"""Confidence from which a name counts as confident."""
NAMES = [
    {"creep": "payload", "line_lag": "contact", "payload": "misalignment"},
    {"creep": "gain_mismatch", "line_lag": "creep", "payload": "hysteresis"},
    {"creep": "an_effect_of_a_user", "line_lag": "another", "payload": "a_third"},
]
PAYLOAD = replace(LAG, effect="payload", left=0.9, margin=3.0)
CASES = {
    "one effect": GOOD,
    "two effects": replace(GOOD, effects=(CREEP, PAYLOAD, LAG), proposals=(*GOOD.proposals, PAIR)),
    "two that do alike": replace(GOOD, effects=(CREEP, replace(LAG, left=0.05, margin=0.3))),
}


def renamed(evidence: Evidence, names: dict[str, str]) -> Evidence:
    effects = tuple(replace(each, effect=names[each.effect]) for each in evidence.effects)
    proposals = tuple(
        replace(
            each,
            effects=tuple(names[name] for name in each.effects),
            instead=tuple(names.get(name, name) for name in each.instead),
        )
        for each in evidence.proposals
    )
    return replace(evidence, effects=effects, proposals=proposals)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("names", NAMES, ids=lambda names: names["creep"])
def test_other_names_change_nothing(case, names):
    model, evidence = load_decision(), CASES[case]
    plain, other = decide(evidence, model), decide(renamed(evidence, names), model)
    assert other.kind == plain.kind
    assert other.confidence == plain.confidence
    assert other.effects == tuple(names[name] for name in plain.effects)
    assert other.probabilities.effects == {
        names[name]: chance for name, chance in plain.probabilities.effects.items()
    }


def test_an_effect_without_a_gain_of_its_own_is_not_named_with_confidence():
    """0.1 % unique gain: another effect explains as much, whatever the first one's name."""
    model = load_decision()
    rival = replace(LAG, gain=0.94, log_gain=1.15, left=0.05, margin=0.3, unique=0.3)
    chances = []
    for unique in (0.001, 0.1, 0.4):
        first = replace(CREEP, unique=unique)
        said = decide(replace(GOOD, effects=(first, rival)), model)
        chances.append(said.probabilities.effects["creep"])
        if unique == 0.001:
            assert said.probabilities.effects["creep"] < SURE
            assert said.effects != ("creep",) or said.confidence < SURE
    assert chances[0] < chances[1] < chances[2]
