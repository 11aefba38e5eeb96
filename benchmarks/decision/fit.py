"""Fit of the decision to stored evidence: five logistic models with weights of fixed sign.

Each model is fitted by penalised maximum likelihood (ridge: le Cessie & van Houwelingen 1992;
sign constraints by bounded L-BFGS: Byrd et al. 1995). Every source counts alike, but for one of few
cases; pairs have a stated share of every source (PRIORS). The penalty of each model is chosen by
leaving out one source after another, and one group of robots after another, within the cases that
it is fitted to. Robots left out inside the same cases also give the curves that calibrate the first
effect and the set of two (Platt 1999), and the cost of a wrong "unknown". So nothing of a source
that is judged enters any choice.
"""

import datetime
import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import optimize

from benchmarks.decision.evidence_log import Labelled
from surgisoft.diagnosis.criteria import WORTH
from surgisoft.diagnosis.decision import (
    CALIBRATED,
    FEATURES,
    LEAST_CHANCE,
    SCHEMA,
    Curve,
    DecisionModel,
    Logistic,
    Probabilities,
    calibrated,
    chosen,
    content_hash,
    decision_of,
    features_of,
    probabilities,
)

PENALTIES = (0.3, 1.0, 3.0, 10.0, 30.0)
"""Ridge penalties on the weights that are tried: inverse variances of a normal prior around 0, for
features of order 1."""
CONSTANT_PENALTY = 0.01
"""Ridge penalty on the constant."""
OFF = ("network", "other_robot")
"""Labels of cases whose model is off."""
WEAK = 0.5
"""Change by what is missing, over the validated error, below which "nothing" is right too: such
cases take no part in the fit of `missing`."""
MOST_WEIGHT = 3.0
"""Most weight of one case, in units of the mean: a few cases of a source do not outweigh many."""
PRIORS = {"two": 0.3}
"""Shares of cases of which a statement is true, for which its probability is calibrated. Stated:
how many pairs were drawn for a source says nothing of real arms, and it was a tenth of the cases in
one source and a quarter in another. The other models take the sources' shares."""
ROBOT_FOLDS = 5
"""Groups of robots that are left out in turn inside the cases of a fit."""
CURVE_PENALTY = 1.0
"""Ridge penalty on constant and log slope of a calibration, in cases: a weak pull to no change."""
UNKNOWN_COSTS = (0.25, 0.5, 1.0, 2.0)
"""Costs of a wrong "unknown" that are tried, in units of what a right one is worth."""
MOST_CALLED_UNKNOWN = 0.05
"""Most known effects and unchanged arms, as a share of each source, that may be called unknown."""


def sample(name: str, cases: Sequence[Labelled]) -> list[tuple[np.ndarray, np.ndarray, Labelled]]:
    """(features, right, case) of the cases that a model is fitted to.

    `right` is 0 or 1; for `first` (E,) whether each effect is missing.
    """
    answer = []
    for case in cases:
        if case.label == "setup" or not case.evidence.effects:
            continue
        missing = case.label in ("known", "unknown")
        if name == "missing":
            if (missing and case.size < WEAK) or case.label == "other_robot":
                continue
            right = np.array(float(missing))
        elif name == "known":
            other = case.label == "other_robot"
            if not other and (not missing or case.size < WEAK):
                continue
            right = np.array(float(case.label == "known"))
        elif name == "network":
            if case.label == "known" or case.evidence.paired:
                continue
            right = np.array(float(case.label in OFF))
        elif name == "two":
            pair = [one.effects for one in case.evidence.proposals if len(one.effects) == 2]
            if case.label != "known" or not pair or case.size < WEAK:
                continue
            right = np.array(float(len(case.truth) == 2 and set(pair[0]) == set(case.truth)))
        else:
            names = [one.effect for one in case.evidence.effects]
            right = np.array([float(one in case.truth) for one in names])
            if case.label != "known" or not right.any() or case.size < WEAK:
                continue
        answer.append((features_of(name, case.evidence), right, case))
    return answer


def case_weights(name: str, some: Sequence) -> np.ndarray:
    """(N,) weights of a model's sample, of mean 1.

    Every source has the same sum, unless it has few cases. Where PRIORS has the model, the
    statement is true for that share of every source; cases of a source that has one kind only have
    the share of that kind.
    """
    prior = PRIORS.get(name)
    kinds = [(case.source, prior is None or bool(right)) for _, right, case in some]
    number = {kind: kinds.count(kind) for kind in kinds}
    sources = len({source for source, _ in kinds})
    share = {True: 1.0 if prior is None else prior, False: 0.0 if prior is None else 1.0 - prior}
    weights = [share[kind[1]] * len(kinds) / sources / number[kind] for kind in kinds]
    weights = np.minimum(np.array(weights, float), MOST_WEIGHT)
    return weights / weights.mean()


def log_losses(name: str, model: Logistic, some: Sequence) -> np.ndarray:
    """(N,) negative log likelihood of each case."""
    answer = []
    for features, right, _ in some:
        odds = model.log_odds(features)
        if name == "first":
            odds = odds - odds.max()
            answer.append(np.log(np.exp(odds).sum()) - np.log(np.exp(odds) @ right))
        else:
            answer.append(np.logaddexp(0.0, odds) - right * odds)
    return np.array(answer, float)


def _padded(some: Sequence) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """((N, E, F) features, (N, E) right, (N, E) whether there is such an effect) of E at most."""
    most = max(len(rows) for rows, _, _ in some)
    x = np.zeros((len(some), most, some[0][0].shape[1]))
    y, there = np.zeros((len(some), most)), np.zeros((len(some), most), bool)
    for number, (rows, right, _) in enumerate(some):
        x[number, : len(rows)], y[number, : len(rows)] = rows, right
        there[number, : len(rows)] = True
    return x, y, there


def fit_one(name: str, some: Sequence, penalty: float) -> Logistic:
    """One logistic model of given penalty."""
    features = FEATURES[name]
    signs = np.array([feature.sign for feature in features], float)
    if not some:
        return Logistic(tuple(0.0 for _ in features))
    weights = case_weights(name, some)
    joint = name == "first"
    if joint:
        x, y, there = _padded(some)
    else:
        x, y = np.array([row for row, _, _ in some]), np.array([right for _, right, _ in some])

    def loss(values: np.ndarray) -> tuple[float, np.ndarray]:
        w, constant = values[:-1], values[-1]
        prior = 0.5 * penalty * w @ w + 0.5 * CONSTANT_PENALTY * constant**2
        slope = np.append(penalty * w, CONSTANT_PENALTY * constant)
        total = prior
        if joint:
            odds = np.where(there, x @ w, -np.inf)
            share = np.exp(odds - odds.max(axis=1, keepdims=True))
            share /= share.sum(axis=1, keepdims=True)
            hit = np.maximum((share * y).sum(axis=1), 1e-300)
            total -= weights @ np.log(hit)
            off = weights[:, None] * share * (1.0 - y / hit[:, None])
            slope[:-1] += np.einsum("ne,nef->f", off, x)
            return float(total), slope
        odds = x @ w + constant
        total += float(weights @ (np.logaddexp(0.0, odds) - y * odds))
        off = weights * (1.0 / (1.0 + np.exp(-np.clip(odds, -500, 500))) - y)
        slope[:-1] += off @ x
        slope[-1] += off.sum()
        return float(total), slope

    bounds = [(0.0, None) if sign > 0 else (None, 0.0) for sign in signs]
    bounds.append((0.0, 0.0) if joint else (None, None))
    start = np.append(0.1 * signs, 0.0)
    found = optimize.minimize(
        loss,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"ftol": 1e-13, "gtol": 1e-8, "maxiter": 2000},
    )
    return Logistic(tuple(float(w) for w in found.x[:-1]), float(found.x[-1]))


def _robot_folds(cases: Sequence[Labelled]) -> list[np.ndarray]:
    """(N,) masks of the cases that are left out together: groups of whole robots."""
    names = [f"{case.source}/{case.robot}" for case in cases]
    robots = sorted(set(names))
    fold = np.array([robots.index(name) % ROBOT_FOLDS for name in names])
    return [fold == number for number in np.unique(fold)] if len(robots) > 1 else []


def _source_folds(cases: Sequence[Labelled]) -> list[np.ndarray]:
    """(N,) masks of the cases that are left out together: whole sources."""
    names = np.array([case.source for case in cases])
    sources = sorted(set(names))
    return [names == source for source in sources] if len(sources) > 1 else []


def _split(some: Sequence, left_out: np.ndarray) -> tuple[list, list]:
    """(kept, left out)."""
    both = list(zip(some, left_out, strict=True))
    return [one for one, out in both if not out], [one for one, out in both if out]


def penalty_of(name: str, some: Sequence) -> float:
    """The penalty with the least held-out loss, one source or group of robots left out in turn.

    A source is left out too since the decision is asked of robots that are like none of its cases.
    """
    cases = [case for _, _, case in some]
    folds = [*_source_folds(cases), *_robot_folds(cases)]
    if not folds:
        return PENALTIES[-1]
    weights = case_weights(name, some)
    totals = []
    for penalty in PENALTIES:
        total = 0.0
        for fold in folds:
            train, left = _split(some, fold)
            model = fit_one(name, train, penalty)
            total += float(weights[fold] @ log_losses(name, model, left))
        totals.append(total)
    return PENALTIES[int(np.argmin(totals))]


def _models(cases: Sequence[Labelled], penalties: dict[str, float]) -> dict[str, Logistic]:
    """The five models of given penalties."""
    return {name: fit_one(name, sample(name, cases), penalties[name]) for name in FEATURES}


Predicted = list[tuple[Labelled, Probabilities]]


def held_out(cases: Sequence[Labelled], penalties: dict[str, float]) -> Predicted:
    """What models that were fitted without a robot say of its cases, before calibration."""
    answer = []
    for fold in _robot_folds(cases):
        train, left = _split(cases, fold)
        model = DecisionModel(_models(train, penalties), {})
        answer += [(case, probabilities(case.evidence, model)) for case in left]
    return answer


def curve_of(count: int, predicted: Predicted) -> Curve:
    """The calibration of "one of the `count` most probable effects is missing"."""
    some = [(case, chances) for case, chances in predicted if len(chances.effects) >= count]
    if not some:
        return Curve()
    given, right = [], []
    for case, chances in some:
        names = list(chances.effects)[:count]
        given.append(sum(chances.effects[name] for name in names))
        right.append(case.label == "known" and bool(set(names) & set(case.truth)))
    chance = np.clip(np.array(given), LEAST_CHANCE, 1.0 - LEAST_CHANCE)
    odds, hit = np.log(chance / (1.0 - chance)), np.array(right, float)
    weights = case_weights("", [((), 0.0, case) for case, _ in some])

    def loss(values: np.ndarray) -> float:
        line = values[0] + np.exp(values[1]) * odds
        return float(
            weights @ (np.logaddexp(0.0, line) - hit * line) + 0.5 * CURVE_PENALTY * values @ values
        )

    found = optimize.minimize(loss, np.zeros(2), method="L-BFGS-B")
    return Curve(float(found.x[0]), float(np.exp(found.x[1])))


def wrong_unknown_of(predicted: Predicted, curves: dict[str, Curve]) -> float:
    """The worth of a wrong "unknown": the least cost that calls few known effects or arms so.

    The mean over sources of the share of known effects and unchanged arms that are called unknown
    is at most `MOST_CALLED_UNKNOWN`.
    """
    some = [(c, calibrated(p, curves)) for c, p in predicted if c.label in ("known", "clean")]
    sources = sorted({case.source for case, _ in some})
    for cost in UNKNOWN_COSTS:
        worth = replace(WORTH, wrong_unknown=-cost)
        shares = []
        for source in sources:
            own = [(case.evidence, p) for case, p in some if case.source == source]
            shares.append(np.mean([chosen(e, p, worth).kind == "unknown_effect" for e, p in own]))
        if not shares or np.mean(shares) <= MOST_CALLED_UNKNOWN:
            return -cost
    return -UNKNOWN_COSTS[-1]


def fit(cases: Sequence[Labelled], command: str = "") -> dict:
    """The asset's values: a decision fitted to cases."""
    samples = {name: sample(name, cases) for name in FEATURES}
    penalties = {name: penalty_of(name, some) for name, some in samples.items()}
    models = {}
    for name, model in _models(cases, penalties).items():
        models[name] = {
            "constant": round(model.constant, 6),
            "weights": {
                feature.name: round(weight, 6)
                for feature, weight in zip(FEATURES[name], model.weights, strict=True)
            },
            "penalty": penalties[name],
            "cases": len(samples[name]),
        }
    predicted = held_out(cases, penalties)
    curves = {name: curve_of(count, predicted) for count, name in enumerate(CALIBRATED, 1)}
    values = {
        "schema": SCHEMA,
        "date": datetime.date.today().isoformat(),
        "command": command,
        "sources": {name: _about(name, cases) for name in sorted({c.source for c in cases})},
        "models": models,
        "calibration": {
            name: {"constant": round(one.constant, 6), "slope": round(one.slope, 6)}
            for name, one in curves.items()
        },
        "wrong_unknown": wrong_unknown_of(predicted, curves),
    }
    return values | {"sha256": content_hash(values)}


def _about(source: str, cases: Sequence[Labelled]) -> dict:
    """Number of cases and robots of a source, and the hash of its evidence."""
    own = [case for case in cases if case.source == source]
    lines = sorted(json.dumps(case.to_json(), sort_keys=True) for case in own)
    digest = hashlib.sha256("\n".join(lines).encode()).hexdigest()
    return {"cases": len(own), "robots": len({c.robot for c in own}), "evidence_sha256": digest}


def model_of(values: dict) -> DecisionModel:
    """The decision of an asset's values."""
    models = {
        name: Logistic(tuple(one["weights"].values()), one["constant"])
        for name, one in values["models"].items()
    }
    return decision_of(models, values)
