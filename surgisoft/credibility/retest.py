"""Test-retest: do several recordings of one arm lead to the same diagnosis and parameters?"""

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from surgisoft.credibility.metrics import COVERAGE_FACTOR
from surgisoft.diagnosis.diagnose import Diagnosis, diagnose
from surgisoft.diagnosis.estimation.effects import fit_effects
from surgisoft.diagnosis.inputs import identification_problem
from surgisoft.errors import InputError
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.model import ArmModel

LEVEL = 0.05
"""p-value below which values of several recordings count as different."""
IDENTIFIABLE = 0.5
"""Largest half width of a 95 % interval, as a share of the value, of an identifiable parameter: a
parameter that may be half or half as much again tells hardly more than its sign."""


@dataclass(frozen=True)
class Estimate:
    """One number of an effect from one recording."""

    recording: str
    """Name of the recording."""
    value: float
    """The fitted value."""
    low: float
    """Lower end of its 95 % interval."""
    high: float
    """Upper end of it."""

    @property
    def standard(self) -> float:
        """Standard uncertainty: half the interval over the coverage factor."""
        return (self.high - self.low) / 2.0 / COVERAGE_FACTOR


@dataclass(frozen=True)
class Repeated:
    """One number of an effect over all recordings."""

    effect: str
    """Name of the effect."""
    name: str
    """Name of the number, with its unit as suffix, and its place where there are several."""
    estimates: tuple[Estimate, ...]
    """One for each recording."""

    @property
    def p_value(self) -> float | None:
        """Probability of values so far apart if all were equal (Cochran 1954, Q); None for one."""
        if len(self.estimates) < 2:
            return None
        value = np.array([each.value for each in self.estimates])
        spread = np.array([each.standard for each in self.estimates])
        if not (np.isfinite(spread).all() and (spread > 0).all()):
            return None
        weight = 1.0 / np.square(spread)
        mean = (weight * value).sum() / weight.sum()
        return float(stats.chi2.sf((weight * np.square(value - mean)).sum(), len(value) - 1))

    @property
    def agree(self) -> bool | None:
        """Whether nothing speaks against equal values; None where it cannot be tested."""
        return None if self.p_value is None else self.p_value >= LEVEL

    @property
    def identifiable(self) -> bool:
        """Whether every recording's interval is narrow beside its value."""
        return all(
            (each.high - each.low) / 2.0 <= IDENTIFIABLE * abs(each.value)
            for each in self.estimates
        )

    def to_json(self) -> dict:
        """Plain values."""
        return {
            "effect": self.effect,
            "name": self.name,
            "p_value": self.p_value,
            "agree": self.agree,
            "identifiable": self.identifiable,
            "estimates": {
                each.recording: {"value": each.value, "ci95": [each.low, each.high]}
                for each in self.estimates
            },
        }


@dataclass(frozen=True)
class Told:
    """Diagnosis of one recording alone."""

    recording: str
    """Name of the recording."""
    kind: str
    """Kind of the verdict; `-` where it allows no diagnosis."""
    effects: tuple[str, ...]
    """The named effects."""
    confidence: float
    """Confidence of the statement."""
    sentence: str
    """The verdict, or why there is none, in words."""


@dataclass(frozen=True)
class Retest:
    """Diagnoses and parameters of each recording alone."""

    diagnoses: tuple[Told, ...]
    """One for each recording."""
    parameters: tuple[Repeated, ...]
    """Numbers of the effects that were fitted to each recording."""

    @property
    def diagnoses_agree(self) -> bool | None:
        """Whether all diagnoses are of one kind and name the same; None for fewer than two."""
        known = [each for each in self.diagnoses if each.kind != "-"]
        if len(known) < 2:
            return None
        return len({(each.kind, frozenset(each.effects)) for each in known}) == 1

    @property
    def sentence(self) -> str:
        """The comparison of the recordings in words."""
        if len(self.diagnoses) < 2:
            return "one recording: nothing says how well the measurement repeats"
        said = "fewer than two recordings allow a diagnosis"
        if self.diagnoses_agree is not None:
            said = f"the diagnoses {'agree' if self.diagnoses_agree else 'differ'}"
        tested = [each for each in self.parameters if each.agree is not None]
        if tested:
            same = sum(bool(each.agree) for each in tested)
            said += f"; {same} of {len(tested)} parameters agree within their intervals"
        if self.parameters:
            known = sum(each.identifiable for each in self.parameters)
            said += f"; {known} of {len(self.parameters)} parameters are identifiable"
        return said

    def to_json(self) -> dict:
        """Plain values."""
        return {
            "sentence": self.sentence,
            "diagnoses_agree": self.diagnoses_agree,
            "diagnoses": [vars(each) | {"effects": list(each.effects)} for each in self.diagnoses],
            "parameters": [each.to_json() for each in self.parameters],
        }


def retest(
    model: ArmModel,
    recordings: Sequence[Recording],
    whole: Diagnosis | None,
    progress: Callable[[str], None] = lambda text: None,
) -> Retest:
    """Diagnose each recording alone, and fit the same effects to each.

    whole: diagnosis of all recordings together; the effects that it names, and those that the model
    has, are fitted.
    """
    told = []
    for recording in recordings:
        progress(f"diagnosing {recording.name} alone")
        told.append(_told(model, recording, whole if len(recordings) == 1 else None))
    named = whole.verdict.effects if whole is not None else ()
    if whole is not None and whole.verdict.kind not in ("identified", "several"):
        named = ()
    effects = list(dict.fromkeys([*model.effects, *named])) if model.takes_effects else []
    found: dict[tuple[str, str], list[Estimate]] = {}
    for recording in recordings if effects else ():
        progress(f"fitting {' + '.join(effects)} to {recording.name}")
        try:
            parameters = fit_effects(identification_problem(model, [recording]), effects).parameters
        except InputError:
            continue
        for parameter in parameters:
            for place, value, low, high in numbers(parameter.value, parameter.low, parameter.high):
                key = (parameter.effect, f"{parameter.name}{place}")
                found.setdefault(key, []).append(Estimate(recording.name, value, low, high))
    repeated = (Repeated(*key, tuple(estimates)) for key, estimates in found.items())
    return Retest(tuple(told), tuple(each for each in repeated if _was_fitted(each)))


def _was_fitted(repeated: Repeated) -> bool:
    """Whether a number was fitted at all: one that is given has no interval."""
    return any(each.high > each.low for each in repeated.estimates)


def numbers(value, low, high) -> Iterable[tuple[str, float, float, float]]:
    """(place, value, low, high) of every number of nested lists; the place counts from 1."""
    shape = np.shape(value)
    arrays = [np.asarray(each, float) for each in (value, low, high)]
    for index in itertools.product(*map(range, shape)):
        place = f"[{','.join(str(i + 1) for i in index)}]" if shape else ""
        yield place, float(arrays[0][index]), float(arrays[1][index]), float(arrays[2][index])


def _told(model: ArmModel, recording: Recording, known: Diagnosis | None) -> Told:
    try:
        verdict = (known or diagnose(model, [recording], refit="never")).verdict
    except InputError as error:
        return Told(recording.name, "-", (), 0.0, str(error))
    return Told(recording.name, verdict.kind, verdict.effects, verdict.confidence, verdict.sentence)
