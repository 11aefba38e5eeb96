"""The decision of a diagnosis: evidence in, calibrated probabilities and a result out.

Five logistic models, fitted together on cases of several sources (`benchmarks/decision`), give the
probabilities:

- `missing`: something is missing that acts on the arm, in the list of effects or not;
- `known`: what is missing is in the list, given that something is;
- `first`: which effect of the list it is, given that it is in the list: a conditional logit over
  all effects (McFadden 1974), P(e | list) proportional to exp(w . x_e);
- `two`: the two proposed effects are both missing, given that some effect of the list is;
- `network`: the model is off, undertrained or that of another arm, given that no effect of the list
  is missing; not asked of a paired difference, which has no error of a model in it.

So two effects e and f are both missing with the probability P(missing) P(known) P(two). What
`first` says holds where only one is: P(e) is a mixture of P(e | list) and, where both are, of P(e |
list) over the two alone (McLachlan & Peel 2000), since a third effect may explain more alone than
either of two that explain everything together. Every weight has a fixed sign: more evidence for a
statement never makes it less probable. The probabilities of the most probable effect and of the two
most probable ones are products of several fits; two curves calibrate them (Platt 1999), and what
remains to 1 is shared by the others as before. Each statement that could be made has one
probability (`Statement`), and the result is the one whose worth to its reader, weighed with it, is
largest (`criteria.Worth`; Savage 1954). "Cannot tell" is worth 0 (Chow 1970: a statement that is
not made), so it is the result only where no statement is probable enough. Weights, curves, sources
and hashes stand in `assets/decision/decision.json`.
"""

import hashlib
import json
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from surgisoft.diagnosis.criteria import CLAIM, SEARCH, WORTH, Claim, Worth
from surgisoft.diagnosis.evidence import (
    EffectEvidence,
    Evidence,
    ProposalEvidence,
    normal_quantile,
)
from surgisoft.errors import InputError
from surgisoft.files import read_json

Kind = Literal[
    "identified",
    "several",
    "ambiguous",
    "nothing_missing",
    "unknown_effect",
    "surrogate_undertrained",
    "cannot_tell",
    "setup",
]
NAMING: tuple[Kind, ...] = ("identified", "several", "ambiguous")
"""Kinds of result that name effects."""
Reason = Literal["network", "learned", "repeatability", "few_data", "schedule", "before", "arm"]
"""Why a diagnosis cannot tell: the model is not that of this arm; the model has learned part of
what is missing; how well recordings of an unchanged arm agree is not known well enough; there are
too few motions; the schedule does not tell effects apart; the model does not describe the
recordings from before a change; even with the most probable effect it leaves most of the motion."""

SCHEMA = 8
"""Version of the asset's format and of the features: weights belong to the features that they were
fitted with, so an asset of another version is fitted again."""
ASSET = Path(__file__).parents[1] / "assets" / "decision" / "decision.json"
"""The fitted decision that is in force."""
FEW_MOTIONS = 24
"""Fewer different motions than this, two minutes of five seconds each, are few data."""
FEW_PAIRED_MOTIONS = 12
"""Fewer than this, one minute, are few where a paired difference is explained: it has no error of a
network that an effect has to be told apart from."""
LEARNED = 0.1
"""Share of what can be explained that memory must explain beyond any static function before the
model is said to have learned part of what is missing."""
LEAST_LEFT = 0.02
"""Share of what can be explained that no proposal is taken to fall below: a fiftieth is within what
the noise floor is known."""
LEAST_UNIQUE = 0.02
"""Sum of unique shares below which their parts say little: no more than `LEAST_LEFT` returns."""
LEAST_EXPLAINED = 0.05
"""Share of what can be explained below which a black box is taken to explain nothing."""
FORM_SHARE = 0.02
"""Share of what an effect explains that its formula gets wrong on a real arm: two effects whose
changes differ by less are not told apart by how sure the blocks are, and a second one that explains
less besides is not told from the first one's form."""
CLEAR_JUMPS = 0.2
"""Level of new jumps over the error (`Evidence.jumps`) that counts in full, and from which on they
are mentioned. The inner loss of the fits is flat about it (docs/results/decision.md)."""
CLEAR_SHIFT = 0.1
"""Shift of a key point (`Evidence.shift`) that counts in full and is mentioned from there on."""
MOSTLY_STATIC = 0.8
"""Share of what a black box with memory explains that a static function must explain before an
error that is too large for "nothing is missing" is put down to the model where no effect is
probable."""


# Features -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Feature:
    """One input of a fitted model: a number of order 1 with the sign of its weight."""

    name: str
    """Its name in the asset."""
    sign: int
    """+1: more of it makes the statement more probable; -1: less probable."""
    of: Callable[..., float]
    """Computes it from the evidence; for `first` from an effect's evidence and all of it; for `two`
    from the evidence and what `first` says (`shares_of`)."""
    meaning: str
    """What it is."""


def _between(value: float, low: float, high: float) -> float:
    return float(min(max(value, low), high))


def _log(value: float, low: float, high: float) -> float:
    return _between(math.log(max(value, 1e-9)), low, high)


def _z(value: float) -> float:
    return _between(value, 0.0, 3.0) / 3.0


def _best(evidence: Evidence) -> EffectEvidence | None:
    return evidence.effects[0] if evidence.effects else None


def _beyond_chance(evidence: Evidence) -> list[ProposalEvidence]:
    """The proposals but for two effects of which the second is within chance.

    Two effects are always proposed where one is, and explain a little more than one, whatever is
    missing.
    """
    least = normal_quantile(SEARCH.p_value)
    return [each for each in evidence.proposals if len(each.effects) == 1 or each.last_z >= least]


def _most(evidence: Evidence, name: str, start: float) -> float:
    """Largest value of a number of the proposals that are beyond chance."""
    return max([start, *(float(getattr(each, name)) for each in _beyond_chance(evidence))])


def _explained(evidence: Evidence) -> float:
    """Share of what can be explained that the best proposal explains."""
    return _between(_most(evidence, "gain", 0.0), 0.0, 1.0)


def _unexplained(evidence: Evidence) -> float:
    """-log of the share of what can be explained that the best proposal leaves, over 2."""
    return -0.5 * math.log(1.0 - _explained(evidence) + LEAST_LEFT)


def _left_size(evidence: Evidence) -> float:
    """Error above the floor that the best proposal leaves, in units of the discrepancy."""
    some = [each.left_size for each in _beyond_chance(evidence)]
    return min([evidence.size_beside_discrepancy, *some])


def _free_better(evidence: Evidence) -> float:
    """Log gain of the free black box over the best proposal."""
    return min([evidence.free_log_gain, *(each.left_log_free for each in _beyond_chance(evidence))])


def _break(evidence: Evidence) -> float:
    """Log gain of one break over the black box, or over the best proposal where that is better.

    An effect that sets in fast and fades is no function that the black box knows: where the effect
    itself explains it, there is no break.
    """
    return _between(evidence.break_log_gain + min(_free_better(evidence), 0.0), 0.0, 1.0)


def _line(evidence: Evidence) -> float:
    """Share in one line, by as much as the best proposal leaves no less than the black box does.

    A line that an effect of the list explains, such as a user-defined one, is none.
    """
    return _between(evidence.line * math.exp(min(_free_better(evidence), 0.0)), 0.0, 1.0)


def _jumps(evidence: Evidence) -> float:
    """Level of the jumps that are new, over the error."""
    return _between(evidence.jumps / CLEAR_JUMPS, 0.0, 1.0)


def _shift(evidence: Evidence) -> float:
    """How clearly one key point shifts against the others."""
    return _between(evidence.shift / CLEAR_SHIFT, 0.0, 1.0)


def _distinct(evidence: Evidence) -> float:
    """Log of what the third best effect leaves over what the best one leaves; 0 without one.

    An effect that is missing stands out, with a relative of it perhaps. Of noise all explain alike.
    """
    return _between(evidence.effects[2].left, -0.5, 1.0) if len(evidence.effects) > 2 else 0.0


def _uneven(evidence: Evidence) -> float:
    """Share that the best effect leaves in a block (geometric mean) less the share that it leaves
    of the whole squared error.

    A missing effect reduces the error of most blocks alike. One that only imitates the cause
    reduces that of a few blocks with large errors. 0 where it reduces the others more.
    """
    best = _best(evidence)
    if best is None:
        return 0.0
    return _between(math.exp(-best.log_gain) - (1.0 - min(best.gain, 1.0)), 0.0, 1.0)


def _of_box(evidence: Evidence) -> float:
    """What the best proposal explains over what a black box with memory explains, at most 1."""
    explained = _explained(evidence)
    return explained / max(evidence.free_box, explained, LEAST_EXPLAINED)


def _stays(evidence: Evidence) -> float:
    """Log of the error above the floor that the best proposal leaves over the whole of it."""
    return _log(_left_size(evidence) / max(evidence.size, 1e-3), -3.0, 0.0)


def _definition_z(evidence: Evidence) -> float:
    """Quantile of the relaxed form of the best single proposal that is its formula by definition.

    0 for others.
    """
    if not evidence.proposals:
        return 0.0
    one = evidence.proposals[0]
    defined = {each.effect for each in evidence.effects if each.by_definition}
    return _z(one.form_z) if one.effects[0] in defined else 0.0


def _exact_left(evidence: Evidence) -> float:
    """Log size of what an effect of exact form leaves where it explains best; 0 for others."""
    best = _best(evidence)
    if best is None or not best.exact_form or not evidence.proposals:
        return 0.0
    return _log(_left_size(evidence), 0.0, 2.0)


def _pair(evidence: Evidence) -> ProposalEvidence | None:
    """The proposal of two effects, if there is one."""
    return next((each for each in evidence.proposals if len(each.effects) == 2), None)


def _last(evidence: Evidence, name: str) -> float:
    """A number of the proposal of two effects; 0 where there is none."""
    pair = _pair(evidence)
    return float(getattr(pair, name)) if pair else 0.0


def _instead_margin(evidence: Evidence) -> float:
    """The least margin of the two over what would stand in the place of one of them."""
    pair = _pair(evidence)
    return min(pair.instead_margin, default=3.0) if pair else 0.0


def _left_by(proposal: ProposalEvidence) -> float:
    """Share of what can be explained that a proposal leaves."""
    return 1.0 - _between(proposal.gain, 0.0, 1.0)


def _beyond_form(evidence: Evidence) -> float:
    """Share of what the best single effect leaves that is not what its form gets wrong.

    The second of two effects explains a share of what the first one leaves. Where that is as little
    as the first one's form may be wrong by, the second mends the form and says nothing else.
    """
    left = _left_by(evidence.proposals[0]) if evidence.proposals else 1.0
    return left / (left + FORM_SHARE)


def _pair_better(evidence: Evidence) -> float:
    """Log of what the best single effect leaves over what the two leave, their form in both."""
    pair = _pair(evidence)
    if pair is None:
        return 0.0
    one, two = (_left_by(each) + FORM_SHARE for each in (evidence.proposals[0], pair))
    return _between(math.log(one / two), 0.0, 2.0)


def _instead_left(evidence: Evidence) -> float:
    """Log of what is left with another effect in the place of one of two, over what they leave.

    The least of both places; what the form of the right effects gets wrong is added to both.
    """
    pair = _pair(evidence)
    if pair is None:
        return 0.0
    left = _left_by(pair)
    some = [
        (left * math.exp(more) + FORM_SHARE) / (left + FORM_SHARE) for more in pair.instead_left
    ]
    return _between(math.log(min(some)), 0.0, 1.0) if some else 1.0


def _unique_share(effect: EffectEvidence, evidence: Evidence) -> float:
    """Gain that returns when an effect is left out of all effects together, over the sum of these.

    Effects that do nearly the same return little each, however large the error; what one of them
    returns over all others says whether the data need it.
    """
    each = [_between(one.unique, 0.0, 1.0) for one in evidence.effects]
    return _between(effect.unique, 0.0, 1.0) / (sum(each) + LEAST_UNIQUE)


def _least_unique(evidence: Evidence) -> float:
    """The lesser unique share of two proposed effects; 0 where there are none."""
    pair = _pair(evidence)
    own = [each for each in evidence.effects if pair and each.effect in pair.effects]
    return min((_unique_share(each, evidence) for each in own), default=0.0)


def _one_of_them(evidence: Evidence, shares: Mapping[str, float]) -> float:
    """Log of the probability that one of the two proposed effects is missing, at least -4."""
    pair = _pair(evidence)
    return _log(sum(shares.get(name, 0.0) for name in pair.effects), -4.0, 0.0) if pair else -4.0


def _leaves_more(effect: EffectEvidence, evidence: Evidence) -> float:
    """Log of what an effect leaves over what the best one leaves, over 2, as shares.

    What the form of the right effect gets wrong is added to both.
    """
    own, best = (1.0 - min(one.gain, 1.0) + FORM_SHARE for one in (effect, evidence.effects[0]))
    return _between(0.5 * math.log(own / best), -0.5, 2.0)


def _margin(effect: EffectEvidence, evidence: Evidence) -> float:
    """Margin of the best effect, in units of 3 standard errors.

    No real effect has exactly the form of its model, so of two that do nearly the same the data
    prefer one for what its form gets wrong, however sure the blocks are: the margin counts up to
    the ratio of what the other effect cannot imitate to what the form gets wrong.
    """
    apart = math.sqrt(_between(1.0 - effect.collinear, 0.0, 1.0) / FORM_SHARE)
    return _between(min(effect.margin, apart), -3.0, 6.0) / 3.0


def _proposed(effect: EffectEvidence, evidence: Evidence) -> float:
    """What the second of two effects explains as far as it is beyond chance, for either of them.

    0 for others. Where few motions show the two, the second is found by chance, and the two would
    stand above the effects that do as well in the place of one of them.
    """
    own = any(effect.effect in each.effects for each in evidence.proposals[1:])
    gain = _between(_last(evidence, "own_gain"), 0.0, 1.0) * _z(_last(evidence, "own_z"))
    return own * gain * _beyond_form(evidence)


JUMPS_MEANS = "level of the body's new jumps that the actuation does not have, over the error"
SHIFT_MEANS = "root of the share of the error that one shifted key point makes, times its log gain"
"""Meanings of two features that three models have."""
MISSING = (
    Feature(
        "above_floor",
        +1,
        lambda e: _log(e.error_over_floor, 0.0, 2.0),
        "log of the error over the noise floor",
    ),
    Feature(
        "beside_discrepancy",
        +1,
        lambda e: _log(e.size_beside_discrepancy, -1.0, 2.0),
        "log of the error that the model discrepancy leaves, over the validated error",
    ),
    Feature(
        "effect_z",
        +1,
        lambda e: _z(e.effects[0].z) if e.effects else 0.0,
        "normal quantile of the best effect's family-wise p-value",
    ),
    Feature(
        "effect_log_gain",
        +1,
        lambda e: _between(e.effects[0].log_gain, 0.0, 1.0) if e.effects else 0.0,
        "log gain of the best effect",
    ),
    Feature("explained", +1, _explained, "share of what can be explained by the best proposal"),
    Feature(
        "box_log_gain",
        +1,
        lambda e: _between(e.box_log_gain, 0.0, 1.0),
        "log gain of the black box with memory over the model discrepancy",
    ),
    Feature("box_z", +1, lambda e: _z(e.box_z), "normal quantile of the black box's p-value"),
    Feature(
        "memory",
        +1,
        lambda e: _between(e.free_box - e.free_static, 0.0, 1.0),
        "share that a black box with memory explains beyond any static function",
    ),
    Feature(
        "size",
        +1,
        lambda e: _log(e.size, -1.0, 2.0),
        "log of the error above the floor over the validated one",
    ),
    Feature(
        "of_box",
        +1,
        _of_box,
        "what the best proposal explains, as a share of what a black box with memory explains",
    ),
    Feature(
        "stays",
        -1,
        _stays,
        "log of the share of the error above the floor that the best proposal leaves",
    ),
    Feature(
        "distinct",
        +1,
        _distinct,
        "log of what the third best effect leaves over what the best one leaves",
    ),
    Feature(
        "break",
        +1,
        _break,
        "log gain of one break in time over a black box with memory, or over the best proposal",
    ),
    Feature(
        "line",
        +1,
        _line,
        "share of what a black box with memory leaves in one line of its spectrum",
    ),
    Feature("jumps", +1, _jumps, JUMPS_MEANS),
    Feature("shift", +1, _shift, SHIFT_MEANS),
)
BEYOND_HISTORY = (
    Feature(
        "break",
        -1,
        _break,
        "log gain of one break in time over a black box with memory, or over the best proposal",
    ),
    Feature(
        "line",
        -1,
        _line,
        "share of what a black box with memory leaves in one line of its spectrum",
    ),
    Feature("jumps", -1, _jumps, JUMPS_MEANS),
    Feature("shift", -1, _shift, SHIFT_MEANS),
)
"""Features of two models: signs of what no function of the actuation and its past explains."""
KNOWN = (
    Feature(
        "explained",
        +1,
        _unexplained,
        "-log of the share of what can be explained that the best proposal leaves",
    ),
    Feature(
        "left_size",
        -1,
        lambda e: _log(_left_size(e), -1.0, 2.0),
        "log of the error that the best proposal leaves, over the validated error",
    ),
    Feature(
        "form_z",
        -1,
        lambda e: _z(_most(e, "form_z", 0.0)),
        "normal quantile of the p-value of a proposal's relaxed form",
    ),
    Feature(
        "definition_z",
        -1,
        _definition_z,
        "p-value (normal quantile) of the best single proposal's relaxed form, if that makes it "
        "another effect by definition (gain, frame)",
    ),
    Feature(
        "exact_left",
        -1,
        _exact_left,
        "log size of what is left by an effect whose form is exact (frame)",
    ),
    Feature(
        "effect_z",
        +1,
        lambda e: _z(e.effects[0].z) if e.effects else 0.0,
        "normal quantile of the best effect's family-wise p-value",
    ),
    Feature(
        "uneven",
        -1,
        _uneven,
        "share that the best effect leaves in a block (geometric mean) less the share that it "
        "leaves of the whole squared error, at least 0",
    ),
    *BEYOND_HISTORY,
    Feature(
        "sudden",
        -1,
        lambda e: _z(e.sudden_margin),
        "studentised log gain of a sudden turn over the best proposal, where that moves the base",
    ),
)
FIRST = (
    Feature(
        "left",
        -1,
        _leaves_more,
        "log of the share that the effect leaves over the share that the best one leaves",
    ),
    Feature(
        "margin",
        -1,
        _margin,
        "studentised difference of the log gains of the best effect and this one, at most what the "
        "angle between their changes allows",
    ),
    Feature(
        "gain", +1, lambda x, e: _between(x.gain, 0.0, 1.0), "share that the effect alone explains"
    ),
    Feature("z", +1, lambda x, e: _z(x.z), "normal quantile of its family-wise p-value"),
    Feature(
        "unique",
        +1,
        _unique_share,
        "share that returns when it is left out of all effects together, over the sum of them",
    ),
    Feature(
        "proposed",
        +1,
        _proposed,
        "for one of the two proposed effects what the second explains beside the relaxed first",
    ),
    Feature(
        "amplitudes",
        -1,
        lambda x, e: _log(x.size + 1, 0.0, 4.0),
        "log(1 + its number of amplitudes)",
    ),
    Feature(
        "exact_left",
        -1,
        lambda x, e: (
            _log(e.size_beside_discrepancy * math.exp(0.5 * x.left), 0.0, 2.0)
            * _between(1.0 - x.gain, 0.0, 1.0)
            * x.exact_form
        ),
        "size of what an effect of exact form leaves",
    ),
)
TWO = (
    Feature(
        "one_of_them",
        +1,
        _one_of_them,
        "log of the probability by `first` that one of the two is missing",
    ),
    Feature(
        "better",
        +1,
        lambda e, shares: _pair_better(e),
        "log of what the best single effect leaves over what the two leave",
    ),
    Feature(
        "last_z",
        +1,
        lambda e, shares: _z(_last(e, "last_z")),
        "normal quantile of the second's p-value",
    ),
    Feature(
        "last_log_gain",
        +1,
        lambda e, shares: _between(_last(e, "last_log_gain"), 0.0, 1.0) * _beyond_form(e),
        "log gain of the second on top of the first, beyond what the form of the first gets wrong",
    ),
    Feature(
        "own_gain",
        +1,
        lambda e, shares: _between(_last(e, "own_gain"), 0.0, 1.0) * _beyond_form(e),
        "share that the second explains beside the relaxed form of the first, beyond its form",
    ),
    Feature(
        "own_log_gain",
        +1,
        lambda e, shares: _between(_last(e, "own_log_gain"), 0.0, 1.0) * _beyond_form(e),
        "log gain of the second there, beyond the form of the first",
    ),
    Feature(
        "instead_left",
        +1,
        lambda e, shares: _instead_left(e),
        "log of what is left with the best other effect in the place of one of the two",
    ),
    Feature(
        "instead_margin",
        +1,
        lambda e, shares: _between(_instead_margin(e), 0.0, 6.0) / 3.0,
        "studentised log gain of the two over it",
    ),
    Feature(
        "unique",
        +1,
        lambda e, shares: _least_unique(e),
        "the lesser of the two effects' unique shares",
    ),
    Feature(
        "log_gain",
        -1,
        lambda e, shares: _between(e.effects[0].log_gain, 0.0, 2.0) if e.effects else 0.0,
        "log gain of the best effect: the more there is to mend of its formula, the less a second "
        "one says",
    ),
)
NETWORK = (
    Feature(
        "over_box",
        +1,
        lambda e: _log(e.error_over_box, 0.0, 3.0),
        "log of the error over what a black box with memory reaches",
    ),
    *BEYOND_HISTORY,
)
FEATURES = {"missing": MISSING, "known": KNOWN, "first": FIRST, "two": TWO, "network": NETWORK}
"""The features of each fitted model."""


# Fitted models ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Logistic:
    """A fitted logistic model, or conditional logit."""

    weights: tuple[float, ...]
    """One for each feature."""
    constant: float = 0.0
    """Log odds where all features are 0."""

    def log_odds(self, features: np.ndarray) -> np.ndarray:
        """(...) log odds of features (..., F)."""
        return self.constant + np.asarray(features, float) @ np.asarray(self.weights)


@dataclass(frozen=True)
class Curve:
    """A calibration of probabilities (Platt 1999): log odds' = constant + slope x log odds."""

    constant: float = 0.0
    """Log odds where the probability was 0.5."""
    slope: float = 1.0
    """Above 1 where probabilities were too near to 0.5."""

    def __call__(self, chance: float) -> float:
        """The calibrated probability."""
        chance = _between(chance, LEAST_CHANCE, 1.0 - LEAST_CHANCE)
        return _sigmoid(self.constant + self.slope * math.log(chance / (1.0 - chance)))


CALIBRATED = ("name", "set")
"""Probabilities that have a curve: that of the most probable effect, of the two most probable."""
LEAST_CHANCE = 1e-6
"""Least probability whose log odds are taken."""


@dataclass(frozen=True)
class DecisionModel:
    """The fitted decision: a logistic model for each of `FEATURES`, and curves of `CALIBRATED`."""

    models: dict[str, Logistic]
    """The fitted models by name."""
    about: dict[str, Any]
    """Sources, hashes, command and date of the fit."""
    curves: dict[str, Curve] = field(default_factory=dict)
    """The calibrations by name; one that is not there changes nothing."""


def content_hash(values: dict[str, Any]) -> str:
    """SHA-256 of an asset's content but for its own hash."""
    plain = {name: value for name, value in values.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def _table(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def load_decision(path: Path = ASSET) -> DecisionModel:
    """The fitted decision of a file; raises InputError for one that is damaged or of another
    version."""
    try:
        values = read_json(path)
    except (OSError, InputError) as reason:
        raise InputError(f"{path.name}: no fitted decision ({reason}); install again") from None
    found = values.get("schema") if isinstance(values, dict) else None
    if type(found) is not int or found != SCHEMA:
        raise InputError(
            f"{path.name}: a fitted decision of schema {found}, expected {SCHEMA}; fit it again"
        )
    if values.get("sha256") != content_hash(values):
        raise InputError(f"{path.name}: the fitted decision does not match its hash; install again")
    models = {}
    for name, features in FEATURES.items():
        one = _table(_table(values.get("models")).get(name))
        weights = _table(one.get("weights"))
        expected = [feature.name for feature in features]
        if list(weights) != expected:
            raise InputError(
                f"{path.name}: model '{name}' has the features {', '.join(weights)},"
                f" expected {', '.join(expected)}; fit it again"
            )
        numbers = (*weights.values(), one.get("constant"))
        if not all(_finite(v) for v in numbers):
            raise InputError(
                f"{path.name}: model '{name}' has a weight that is not a finite number; fit it "
                "again"
            )
        models[name] = Logistic(tuple(map(float, weights.values())), numbers[-1])
    curves = values.get("calibration", {})
    if not isinstance(curves, dict):
        raise InputError(f"{path.name}: calibration is not a table; fit it again")
    for name, one in curves.items():
        given = _table(one)
        if name not in CALIBRATED or not all(_finite(given.get(k)) for k in ("constant", "slope")):
            raise InputError(f"{path.name}: calibration '{name}' is not readable; fit it again")
    return decision_of(models, values)


def _finite(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) <= sys.float_info.max


def decision_of(models: dict[str, Logistic], values: dict[str, Any]) -> DecisionModel:
    """The fitted decision of its models and the other values of an asset."""
    fitted = ("models", "calibration")
    curves = {
        name: Curve(one["constant"], one["slope"])
        for name, one in values.get("calibration", {}).items()
    }
    about = {key: value for key, value in values.items() if key not in fitted}
    return DecisionModel(models, about, curves)


@lru_cache(maxsize=1)
def fitted_decision() -> DecisionModel:
    """The decision in force, read once."""
    return load_decision()


def features_of(
    name: str, evidence: Evidence, shares: Mapping[str, float] | None = None
) -> np.ndarray:
    """(F,) features of a model; (E, F) for `first`, one row for each effect.

    shares: what `first` says of the effects (`shares_of`), for `two`.
    """
    some = FEATURES[name]
    if name == "two":
        return np.array([feature.of(evidence, shares or {}) for feature in some], float)
    if name == "first":
        rows = [[feature.of(each, evidence) for feature in some] for each in evidence.effects]
        return np.array(rows, float).reshape(len(rows), len(some))
    return np.array([feature.of(evidence) for feature in some], float)


# Probabilities and decision -----------------------------------------------------------------


@dataclass(frozen=True)
class Probabilities:
    """Calibrated probabilities of what is true."""

    nothing: float
    """Nothing is missing."""
    network: float
    """The model is off, undertrained or of another arm, and no effect of the list is missing."""
    unknown: float
    """Something outside the list is missing."""
    effects: dict[str, float]
    """Each effect is missing, alone or as one of two, the most probable first."""
    pair: float
    """The two proposed effects are both missing."""
    two: tuple[str, ...]
    """The two proposed effects; empty where there are none."""

    @property
    def known(self) -> float:
        """Some effect of the list is missing."""
        return sum(self.effects.values())


def shares_of(evidence: Evidence, first: Logistic) -> dict[str, float]:
    """Effect -> probability that it is missing, given that one effect of the list is; sums to 1."""
    if not evidence.effects:
        return {}
    odds = first.log_odds(features_of("first", evidence))
    share = np.exp(odds - odds.max())
    share /= share.sum()
    return {one.effect: float(p) for one, p in zip(evidence.effects, share, strict=True)}


def _sigmoid(odds: float) -> float:
    return 1.0 / (1.0 + math.exp(-_between(odds, -500.0, 500.0)))


def probabilities(evidence: Evidence, model: DecisionModel | None = None) -> Probabilities:
    """The probabilities of what is true, from the evidence."""
    model = model or fitted_decision()

    each = shares_of(evidence, model.models["first"])

    def chance(name: str) -> float:
        return _sigmoid(float(model.models[name].log_odds(features_of(name, evidence, each))))

    missing = chance("missing")
    known = chance("known") if evidence.effects else 0.0
    network = 0.0 if evidence.paired else chance("network")
    pair = next((one.effects for one in evidence.proposals if len(one.effects) == 2), ())
    both = chance("two") if pair else 0.0
    one = max(sum(each.get(name, 0.0) for name in pair), LEAST_CHANCE)
    each = {name: p * (1.0 - both + both * (name in pair) / one) for name, p in each.items()}
    ordered = sorted(each.items(), key=lambda item: -item[1])
    found = Probabilities(
        nothing=(1.0 - missing) * (1.0 - network),
        network=(1.0 - missing * known) * network,
        unknown=missing * (1.0 - known) * (1.0 - network),
        effects={name: missing * known * p for name, p in ordered},
        pair=missing * known * both,
        two=pair,
    )
    return calibrated(found, model.curves)


def calibrated(raw: Probabilities, curves: dict[str, Curve]) -> Probabilities:
    """The probabilities with those of the most probable effect and of the first two calibrated.

    What remains to 1 is shared by all others as before. Where the curves make the second of two
    effects more probable than the first, both have half of the set.
    """
    names = list(raw.effects)
    if not names or not curves:
        return raw
    given = [raw.effects[name] for name in names[:2]]
    name, both = (curves.get(each, Curve()) for each in CALIBRATED)
    first, whole = name(given[0]), both(sum(given)) if len(given) > 1 else name(given[0])
    whole = max(whole, first)
    first = max(first, 0.5 * whole) if len(given) > 1 else first
    others = (1.0 - whole) / max(1.0 - sum(given), LEAST_CHANCE)
    effects = {name: chance * others for name, chance in raw.effects.items()}
    effects |= dict(zip(names, (first, whole - first), strict=False))
    known = sum(effects.values())
    return replace(
        raw,
        nothing=raw.nothing * others,
        network=raw.network * others,
        unknown=raw.unknown * others,
        effects=dict(sorted(effects.items(), key=lambda item: -item[1])),
        pair=min(raw.pair * known / max(raw.known, LEAST_CHANCE), known),
    )


@dataclass(frozen=True)
class Statement:
    """A statement that the diagnosis could make."""

    kind: Kind
    """Kind of the result."""
    effects: tuple[str, ...]
    """The effects that it names."""
    probability: float
    """Calibrated probability that it is right."""
    worth: float
    """What it is worth to its reader, weighed with the probabilities; "cannot tell" is worth 0."""


@dataclass(frozen=True)
class Decision:
    """Result that follows from the evidence."""

    kind: Kind
    """Kind of the result."""
    effects: tuple[str, ...]
    """The effects that are named; the competing ones where they cannot be told apart."""
    confidence: float
    """Calibrated probability that the statement is right, 0 to 1; where it cannot be told that of
    the most probable statement."""
    probabilities: Probabilities
    """All probabilities."""
    reason: Reason | None = None
    """Why it cannot be told, or why the model is called off where its validated error does not say
    so; None for another kind."""
    statements: tuple[Statement, ...] = ()
    """All statements that could be made, worth most first."""


def claimable(evidence: Evidence, claim: Claim = CLAIM) -> bool:
    """Whether "nothing is missing" may be claimed at all.

    The error must be near the noise floor or near what a black box with memory reaches, and must
    not exceed the validated error by much. A paired difference must not exceed by much what the
    recordings from before do not repeat.
    """
    announced = evidence.error_over_validated <= claim.most_over_validated
    near = (
        evidence.error_over_floor <= claim.near_floor or evidence.error_over_box <= claim.near_box
    )
    return announced and (near or evidence.paired)


def statements(
    evidence: Evidence, chances: Probabilities, worth: Worth = WORTH, claim: Claim = CLAIM
) -> tuple[Statement, ...]:
    """All statements that could be made, each with its probability, worth most first."""
    found: list[Statement] = []

    def add(kind: Kind, effects: tuple[str, ...], chance: float, value: float) -> None:
        found.append(Statement(kind, effects, chance, value))

    names, known, pair = list(chances.effects), chances.known, chances.pair
    both = pair / known if known and names[0] in chances.two else 0.0
    whole = 1.0 - both * (1.0 - worth.first_of_pair)

    def named(chance: float, right: float, wrong: float) -> float:
        """Worth of a name or set: another effect, or none of the list, may be what is missing."""
        none = min(1.0 - known, 1.0 - chance)
        other = 1.0 - chance - none
        return right * chance * whole + wrong * (
            other * worth.wrong_name + none * worth.needless_name
        )

    if names:
        chance = chances.effects[names[0]]
        add("identified", (names[0],), chance, named(chance, 1.0, 1.0))
    if len(names) > 1:
        chance += chances.effects[names[1]]
        value = named(chance, worth.right_set, worth.right_set)
        add("ambiguous", (names[0], names[1]), chance, value)
    if chances.two:
        some = max(sum(chances.effects.get(name, 0.0) for name in chances.two), pair)
        half, none = some - pair, max(known - some, 0.0)
        value = pair + half * worth.half_pair + none * worth.wrong_name
        add("several", chances.two, pair, value + (1.0 - known) * worth.needless_name)
    quiet, unknown = chances.nothing + chances.network, chances.unknown
    if claimable(evidence, claim):
        add("nothing_missing", (), quiet, worth_of_nothing(quiet, worth))
    if unknown >= quiet:
        # Not where "nothing" is more probable and only not to be claimed.
        add("unknown_effect", (), unknown, unknown + (1.0 - unknown) * worth.wrong_unknown)
    if not evidence.paired:
        # An error too large for "nothing" that is static is the model's, and no effect's.
        static = _mostly_static(evidence) and not claimable(evidence, claim)
        off = quiet if static else chances.network
        add("surrogate_undertrained", (), off, off + (1.0 - off) * worth.wrong_network)
    return tuple(sorted(found, key=lambda each: -each.worth))


def worth_of_nothing(quiet: float, worth: Worth = WORTH) -> float:
    """Worth of the statement that nothing is missing; quiet: its probability."""
    return quiet + (1.0 - quiet) * worth.wrong_nothing


def decide(
    evidence: Evidence,
    model: DecisionModel | None = None,
    worth: Worth = WORTH,
    claim: Claim = CLAIM,
) -> Decision:
    """The statement that is worth most to its reader, weighed with the fitted probabilities."""
    return chosen(evidence, probabilities(evidence, model or fitted_decision()), worth, claim)


def chosen(
    evidence: Evidence, chances: Probabilities, worth: Worth = WORTH, claim: Claim = CLAIM
) -> Decision:
    """The statement that is worth most with given probabilities; none where none is worth it."""
    tried = statements(evidence, chances, worth, claim)
    best = next((one for one in tried if one.probability >= worth.least_probability), None)
    if best is None or best.worth <= 0.0:
        silent = max(chances.nothing, chances.network, chances.unknown)
        most = max((one.probability for one in tried), default=silent)
        return Decision("cannot_tell", (), most, chances, reason_of(evidence, chances), tried)
    reason = _why_off(evidence, claim) if best.kind == "surrogate_undertrained" else None
    return Decision(best.kind, best.effects, best.probability, chances, reason, tried)


def _why_off(evidence: Evidence, claim: Claim) -> Reason | None:
    """Why the model is called off; None where its validated error announced it."""
    if evidence.error_over_validated > claim.most_over_validated:
        return "network"
    memory = evidence.free_box - evidence.free_static
    return "learned" if memory >= LEARNED and not _mostly_static(evidence) else None


def _mostly_static(evidence: Evidence) -> bool:
    """Whether what can be explained is a static function for the most part."""
    return evidence.free_static >= MOSTLY_STATIC * evidence.free_box


def reason_of(evidence: Evidence, chances: Probabilities) -> Reason:
    """Why a diagnosis cannot tell.

    A paired difference contains no error of the model, so no reason of the model applies to it.
    """
    memory = evidence.free_box - evidence.free_static
    if evidence.paired:
        if chances.nothing >= chances.known + chances.unknown:
            return "repeatability"
    elif _mostly_static(evidence) and chances.network + chances.nothing >= chances.known:
        return "network"
    elif evidence.error_over_validated <= CLAIM.most_over_validated and memory >= LEARNED:
        return "learned"
    return few_or_schedule(evidence)


def few_or_schedule(evidence: Evidence) -> Reason:
    """The reason that lies in the recordings."""
    few = FEW_PAIRED_MOTIONS if evidence.paired else FEW_MOTIONS
    return "few_data" if evidence.motions < few else "schedule"


def of_change(decision: Decision, evidence: Evidence) -> Decision:
    """The same about what has changed since recordings that the model describes.

    The model is older than the change and has learned nothing of it.
    """
    if decision.reason != "learned":
        return decision
    off = decision.kind == "surrogate_undertrained"
    return replace(decision, reason=None if off else few_or_schedule(evidence))
