"""Fit of the decision to stored evidence: five logistic models with weights of fixed sign.

Each model is fitted by penalised maximum likelihood (ridge: le Cessie & van Houwelingen 1992;
sign constraints by bounded L-BFGS: Byrd et al. 1995). Every source counts alike, but for one of few
cases; pairs have a stated share of every source (PRIORS). The penalty of each model is chosen by
leaving out one source after another, and one group of robots after another, within the cases that
it is fitted to. Robots left out inside the same cases also give the curves that calibrate the first
effect and the set of two (Platt 1999). So nothing of a source that is judged enters any choice. The
costs of wrong results are stated (`surgisoft.diagnosis.criteria.Worth`).
"""

import datetime
import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from benchmarks.decision.evidence_log import Labelled
from surgisoft.diagnosis.decision import (
    CALIBRATED,
    FEATURES,
    LEAST_CHANCE,
    NAMING,
    SCHEMA,
    Curve,
    Decision,
    DecisionModel,
    Logistic,
    Probabilities,
    content_hash,
    decision_of,
    features_of,
    probabilities,
    shares_of,
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
PRIORS = {"two": 0.3, "known": 0.5}
"""Shares of cases of which a statement is true, in the fit of its model. Stated: how many pairs and
unknown effects were drawn for a source says nothing of real arms. Pairs were a tenth of the cases
in one source and a quarter in another; unknown effects are a fifth, and with half of the weight
they count as much as known ones do. The other models take the sources' shares, and so do the curves
that calibrate names."""
ROBOT_FOLDS = 5
"""Groups of robots that are left out in turn inside the cases of a fit."""
CURVE_PENALTY = 1.0
"""Ridge penalty on constant and log slope of a calibration, in cases: a weak pull to no change."""
TWIN_WEIGHTS = (0.0, 0.1, 0.3, 1.0)
"""Weights that are tried of a case whose truth was no candidate, in units of a real case."""


def sample(
    name: str, cases: Sequence[Labelled], first: Logistic | None = None
) -> list[tuple[np.ndarray, np.ndarray, Labelled]]:
    """(features, right, case) of the cases that a model is fitted to.

    `right` is 0 or 1; for `first` (E,) whether each effect is missing. first: the fitted model of
    that name, whose probabilities are a feature of `two`.
    """
    assert name != "two" or first is not None, "`two` is fitted after `first`"
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
            right = np.array(float(set(pair[0]) == set(case.truth)))
        else:
            names = [one.effect for one in case.evidence.effects]
            right = np.array([float(one in case.truth) for one in names])
            if case.label != "known" or not right.any() or case.size < WEAK:
                continue
        shares = shares_of(case.evidence, first) if name == "two" and first is not None else None
        answer.append((features_of(name, case.evidence, shares), right, case))
    return answer


def case_weights(name: str, some: Sequence, twin: float = 1.0) -> np.ndarray:
    """(N,) weights of a model's sample, of mean 1 over real cases.

    Every source has the same sum, unless it has few cases. Where PRIORS has the model, the
    statement is true for that share of every source; cases of a source that has one kind only have
    the share of that kind. twin: weight of a case whose truth was no candidate, in units of a real
    one. Such cases share the weight of the real ones of their source for which the statement is as
    right, so they do not change how often anything holds.
    """
    prior = PRIORS.get(name)
    kinds = [(case.source, prior is None or bool(right)) for _, right, case in some]
    alike = [(case.source, bool(np.any(right))) for _, right, case in some]
    units = np.array([twin if case.left_out else 1.0 for _, _, case in some])
    real, both = Counter[tuple[str, bool]](), dict.fromkeys(alike, 0.0)
    for group, unit, (_, _, case) in zip(alike, units, some, strict=True):
        real[group] += not case.left_out
        both[group] += unit
    units = units * [real[g] / both[g] if real[g] and both[g] else 1.0 for g in alike]
    number = dict.fromkeys(kinds, 0.0)
    for kind, unit in zip(kinds, units, strict=True):
        number[kind] += unit
    sources = len({source for source, _ in kinds})
    share = {True: 1.0 if prior is None else prior, False: 0.0 if prior is None else 1.0 - prior}
    each = [share[kind[1]] * units.sum() / sources / max(number[kind], 1e-9) for kind in kinds]
    weights = np.minimum(np.array(each, float), MOST_WEIGHT) * units
    return weights * units.sum() / weights.sum()


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


def fit_one(name: str, some: Sequence, penalty: float, twin: float = 1.0) -> Logistic:
    """One logistic model of given penalty and weight of the cases without their truth."""
    features = FEATURES[name]
    signs = np.array([feature.sign for feature in features], float)
    some = [one for one in some if twin > 0.0 or not one[2].left_out]
    if not some:
        return Logistic(tuple(0.0 for _ in features))
    weights = case_weights(name, some, twin)
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


@dataclass(frozen=True)
class Setting:
    """What is chosen for one model inside its cases."""

    penalty: float
    """Ridge penalty."""
    twin: float
    """Weight of a case whose truth was no candidate."""


def setting_of(name: str, some: Sequence) -> Setting:
    """The setting with the least held-out loss, one source or group of robots left out in turn.

    A source is left out too since the decision is asked of robots that are like none of its cases.
    Cases without their truth among the candidates help to fit and do not judge.
    """
    cases = [case for _, _, case in some]
    folds = [*_source_folds(cases), *_robot_folds(cases)]
    if not folds:
        return Setting(PENALTIES[-1], TWIN_WEIGHTS[-1])
    real = np.array([not case.left_out for case in cases])
    weights = np.zeros(len(cases))
    weights[real] = case_weights(name, [one for one in some if not one[2].left_out])
    tried = {}
    for twin in TWIN_WEIGHTS if not real.all() else TWIN_WEIGHTS[-1:]:
        for penalty in PENALTIES:
            total = 0.0
            for fold in folds:
                train = _split(some, fold)[0]
                model = fit_one(name, train, penalty, twin)
                judged = _split(some, ~(fold & real))[0]
                total += float(weights[fold & real] @ log_losses(name, model, judged))
            tried[Setting(penalty, twin)] = total
    return min(tried, key=lambda each: tried[each])


Settings = dict[str, Setting]
"""Setting of each model by its name."""


def _models(cases: Sequence[Labelled], settings: Settings) -> dict[str, Logistic]:
    """The five models of given settings."""
    first = fit_one("first", sample("first", cases), *_values(settings["first"]))
    others = {
        name: fit_one(name, sample(name, cases, first), *_values(each))
        for name, each in settings.items()
        if name != "first"
    }
    return {"first": first, **others}


def _values(setting: Setting) -> tuple[float, float]:
    return setting.penalty, setting.twin


Predicted = list[tuple[Labelled, Probabilities]]


def held_out(
    cases: Sequence[Labelled], settings: Settings, folds: Sequence[np.ndarray]
) -> Predicted:
    """What models that were fitted without the cases of a fold say of them, before calibration.

    folds: (N,) masks of the cases that are left out together. Only real cases are asked.
    """
    answer = []
    for fold in folds:
        train, left = _split(cases, fold)
        model = DecisionModel(_models(train, settings), {})
        real = [case for case in left if not case.left_out]
        answer += [(case, probabilities(case.evidence, model)) for case in real]
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


def names_truth(case: Labelled, found: Decision) -> bool:
    """Whether a result names a missing effect, alone, as one of two, or in a set of two."""
    return found.kind in NAMING and bool(set(found.effects) & set(case.truth))


def names_wrongly(case: Labelled, found: Decision) -> bool:
    """Whether a result names effects none of which is missing, or two of which one is not."""
    if found.kind not in NAMING:
        return False
    hit = [case.label == "known" and name in case.truth for name in found.effects]
    return not (all(hit) if found.kind == "several" else any(hit))


def fit(cases: Sequence[Labelled], command: str = "") -> dict:
    """The asset's values: a decision fitted to cases."""
    samples, settings = {"first": sample("first", cases)}, {}
    settings["first"] = setting_of("first", samples["first"])
    first = fit_one("first", samples["first"], *_values(settings["first"]))
    for name in [each for each in FEATURES if each != "first"]:
        samples[name] = sample(name, cases, first)
        settings[name] = setting_of(name, samples[name])
    models = {}
    for name, model in _models(cases, settings).items():
        models[name] = {
            "constant": round(model.constant, 6),
            "weights": {
                feature.name: round(weight, 6)
                for feature, weight in zip(FEATURES[name], model.weights, strict=True)
            },
            "penalty": settings[name].penalty,
            "twin_weight": settings[name].twin,
            "cases": sum(not case.left_out for _, _, case in samples[name]),
            "without_truth": sum(bool(case.left_out) for _, _, case in samples[name]),
        }
    predicted = held_out(cases, settings, _robot_folds(cases))
    curves = {name: curve_of(count, predicted) for count, name in enumerate(CALIBRATED, 1)}
    values = {
        "schema": SCHEMA,
        "date": datetime.date.today().isoformat(),
        "command": command,
        "sources": {name: about(name, cases) for name in sorted({c.source for c in cases})},
        "models": models,
        "calibration": {
            name: {"constant": round(one.constant, 6), "slope": round(one.slope, 6)}
            for name, one in curves.items()
        },
    }
    return values | {"sha256": content_hash(values)}


def about(source: str, cases: Sequence[Labelled]) -> dict:
    """Number of cases and robots of a source, and the hash of its evidence."""
    own = [case for case in cases if case.source == source]
    digest = hashlib.sha256("\n".join(sorted(case.line for case in own)).encode()).hexdigest()
    return {"cases": len(own), "robots": len({c.robot for c in own}), "evidence_sha256": digest}


def model_of(values: dict) -> DecisionModel:
    """The decision of an asset's values."""
    models = {
        name: Logistic(tuple(one["weights"].values()), one["constant"])
        for name, one in values["models"].items()
    }
    return decision_of(models, values)
