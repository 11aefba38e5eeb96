"""The whole assessment: a model, its comparators and the context in; numbers for a report out."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from surgisoft.credibility.context import Context
from surgisoft.credibility.domain import Applicability, applicability, states_of
from surgisoft.credibility.metrics import Criterion, area_in_space
from surgisoft.credibility.retest import Retest, retest
from surgisoft.credibility.scenario import (
    Agreement,
    Outcome,
    agreement,
    scenario_states,
    stored_episodes,
)
from surgisoft.credibility.software import TESTS, software
from surgisoft.credibility.uncertainty import Budget, budget
from surgisoft.diagnosis.compare import Comparison
from surgisoft.diagnosis.diagnose import Diagnosis, diagnose
from surgisoft.diagnosis.residuals import ResidualTable
from surgisoft.errors import InputError
from surgisoft.files import json_safe, with_former_keys
from surgisoft.measurement.histories import actuation_of, history_of
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.effects import hypothesis_of
from surgisoft.surrogate.model import ArmModel
from surgisoft.workers import torch_threads

STATEMENT = (
    "In a form usable for an assessment of credibility in the terms of ASME V&V 40-2018 and ASME "
    "V&V 20-2009. Whether the credibility is enough for the context of use is a judgement of those "
    "who answer for it."
)
"""What the report is, and what it is not."""
SAME_RANGE = 0.03
"""How far an input of a comparator may lie outside the model's range, as a share of it, and still
count as equivalent: the share up to which `compare` gives no note."""
SAME_ANGLE = 2.0
"""Angle between two directions of weight up to which they count as equal, degrees."""
SAME_PAYLOAD_G = 0.5
"""Load up to which an arm counts as unloaded, g."""
SAME_ROOM_C = 2.0
"""Difference of room temperature up to which it counts as equal, degrees Celsius."""


@dataclass(frozen=True)
class Comparator:
    """One recording that the model is compared with."""

    name: str
    """Name of the recording."""
    sha256: str
    """Hash of its file; of its arrays where it came from none."""
    robot: str
    """Which robot, as stated."""
    date: str
    """When it was measured, as stated."""
    note: str
    """What is known beside."""
    kind: str
    """continuous or settled."""
    rows: int
    """Rows."""
    seconds: float
    """Length, s."""
    range: tuple[tuple[float, float], ...]
    """Lowest and highest actuation of each channel, in its unit."""
    in_fit: float | None
    """Share (0..1) of its rows that the model was fitted to; None where the model does not say."""


@dataclass(frozen=True)
class Input:
    """One input, in the comparators and in the simulation."""

    name: str
    """The input with its unit."""
    measured: str
    """In the comparators."""
    simulated: str
    """In the simulation."""
    equivalent: bool | None
    """Whether both are equivalent; None where one is not known."""


@dataclass(frozen=True)
class PointError:
    """Comparison error of one key point, or of the body."""

    label: str
    """Which: k0 at the base, ..., or `body`."""
    error_mm: float
    """E: RMS distance of predicted from measured, mm."""
    bias_mm: tuple[float, float, float] | None
    """Mean of predicted less measured in x, y and z, base frame, mm; None for the body."""
    uncertainty_mm: float
    """U_val at 95 %, mm."""
    area_mm: float
    """Area metric, mm."""

    @property
    def interval_mm(self) -> tuple[float, float]:
        """E ± U_val, between which the error of the model lies at 95 %, mm."""
        return max(self.error_mm - self.uncertainty_mm, 0.0), self.error_mm + self.uncertainty_mm

    @property
    def resolved(self) -> bool:
        """Whether the error stands out of the validation uncertainty."""
        return self.error_mm > self.uncertainty_mm


@dataclass(frozen=True, eq=False)
class Assessment:
    """Everything that a credibility report says."""

    context: Context
    """What the user states."""
    model: str
    """The model in one line."""
    comparators: tuple[Comparator, ...]
    """The recordings."""
    inputs: tuple[Input, ...]
    """Inputs of comparators and simulation."""
    points: tuple[PointError, ...]
    """Comparison error of every key point, base to tip, then of the body."""
    error_ci95_mm: tuple[float, float]
    """95 % interval of the body's error from a bootstrap of blocks of time, mm."""
    uncertainty: Budget
    """Parts of the validation uncertainty."""
    comparison: Comparison
    """What `compare` says."""
    diagnosis: Diagnosis | None
    """Model form: what is missing; None where the recordings allow no diagnosis."""
    no_diagnosis: str
    """Why there is none."""
    retest: Retest
    """Recordings compared with each other."""
    applicability: Applicability | None
    """The scenario's states beside the validated domain; None where none are given."""
    outcomes: tuple[Outcome, ...]
    """The scenario in simulation and on the rig."""
    agreement: Agreement | None
    """Agreement with the exact collision checker; None without episodes."""
    software: dict[str, str]
    """Versions, and the commit of the source code where it is known."""
    criteria: tuple[Criterion, ...]
    """The user's limits and whether they are met."""
    table: ResidualTable
    """Rows of the comparison, for the drawings."""

    @property
    def rows_of_fit(self) -> str:
        """Which comparators the model was fitted to, so that they are no test; else empty."""
        known = [f"{100 * c.in_fit:.0f} % of {c.name}" for c in self.comparators if c.in_fit]
        return f"the model was fitted to {', '.join(known)}" if known else ""

    @property
    def passed(self) -> bool | None:
        """Whether all criteria are met; None where the user gives none."""
        return all(each.passed for each in self.criteria) if self.criteria else None

    @property
    def sentence(self) -> str:
        """The result in words."""
        body = self.points[-1]
        low, high = body.interval_mm
        text = (
            f"comparison error E {body.error_mm:.3g} mm, validation uncertainty U_val "
            f"{body.uncertainty_mm:.3g} mm (95 %): the model's error lies between {low:.3g} and "
            f"{high:.3g} mm; area metric {body.area_mm:.3g} mm"
        )
        if self.rows_of_fit:
            text = (
                f"no validation: {self.rows_of_fit}; E there {body.error_mm:.3g} mm, U_val "
                f"{body.uncertainty_mm:.3g} mm (95 %), area metric {body.area_mm:.3g} mm"
            )
        elif not body.resolved:
            text += "; E is within U_val, so this comparison cannot resolve the model's error"
        if self.passed is None:
            return f"{text}; no limits are given"
        failed = [each.name for each in self.criteria if not each.passed]
        if not failed:
            return f"{text}; all {len(self.criteria)} criteria are met"
        count = f"{len(failed)} of {len(self.criteria)} criteria {'are' if failed[1:] else 'is'}"
        return f"{text}; {count} not met: {'; '.join(failed)}"

    def to_json(self) -> dict:
        """Plain values, as the JSON file has them."""
        context, found = self.context, self.diagnosis
        values = json_safe(
            {
                "statement": STATEMENT,
                "sentence": self.sentence,
                "passed": self.passed,
                "held_out": None
                if any(each.in_fit is None for each in self.comparators)
                else not self.rows_of_fit,
                "question_of_interest": context.question,
                "context_of_use": context.use,
                "model_risk": asdict(context.risk) | {"level": context.risk.level},
                "model": self.model,
                "comparators": [asdict(each) for each in self.comparators],
                "inputs": [asdict(each) for each in self.inputs],
                "key_points": [
                    asdict(each)
                    | {"interval_mm": list(each.interval_mm), "resolved": each.resolved}
                    for each in self.points
                ],
                "error_ci95_mm": list(self.error_ci95_mm),
                "validation_uncertainty": {
                    "level": 0.95,
                    "parts_mm": asdict(self.uncertainty.body),
                    "per_key_point_mm": [asdict(u) for u in self.uncertainty.per_key_point],
                    "standard_mm": self.uncertainty.body.standard_mm,
                    "expanded_mm": self.uncertainty.body.expanded_mm,
                    "unknown": list(self.uncertainty.body.unknown),
                    "sources": self.uncertainty.sources,
                    "inputs": list(self.uncertainty.inputs),
                },
                "criteria": [each.to_json() for each in self.criteria],
                "comparison": self.comparison.to_json(),
                "model_form": None if found is None else asdict(found.verdict),
                "no_model_form": self.no_diagnosis or None,
                "test_retest": self.retest.to_json(),
                "applicability": self.applicability and self.applicability.to_json(),
                "scenario": [asdict(each) for each in self.outcomes],
                "agreement": self.agreement
                and asdict(self.agreement) | {"sentence": self.agreement.sentence},
                "software": self.software,
                "software_tests": TESTS,
            }
        )
        return with_former_keys(values, {"took_no_part": "held_out"})


@torch_threads(1)
def assess(
    context: Context,
    comparison: Comparison,
    table: ResidualTable,
    recordings: Sequence[Recording],
    outcomes: Sequence[Outcome] = (),
    progress: Callable[[str], None] = lambda text: None,
) -> Assessment:
    """Assess a model for a context of use.

    comparison, table: what `surgisoft.diagnosis.compare.compare` returned for these recordings.
    outcomes: of an experiment (`surgisoft.credibility.scenario.outcomes`).
    """
    model = table.model
    known = {recording.name for recording in recordings}
    for source in context.sources:
        if source.name not in known:
            raise InputError(
                f"sources: '{source.name}' is not a recording of this comparison, expected one of "
                f"{', '.join(sorted(known))}"
            )
    episodes = stored_episodes(context.scenario)
    states = scenario_states(context.scenario, model.spec, episodes)
    progress("validation uncertainty")
    parts = budget(table, recordings, context.uncertainty)
    points = point_errors(table, comparison, parts)
    progress("diagnosing")
    found, why = None, ""
    try:
        found = diagnose(model, list(recordings), refit="never")
    except InputError as error:
        why = str(error)
    again = retest(model, recordings, found, progress)
    inside = None
    if states:
        progress("applicability")
        validated = [states_of(recording, model.spec.actuation) for recording in recordings]
        inside = applicability(validated, states, _length(table))
    comparators = tuple(_comparator(each, context, table) for each in recordings)
    return Assessment(
        context=context,
        model=model.summary(),
        comparators=comparators,
        inputs=inputs_of(model, recordings),
        points=points,
        error_ci95_mm=comparison.rmse_ci95_mm,
        uncertainty=parts,
        comparison=comparison,
        diagnosis=found,
        no_diagnosis=why,
        retest=again,
        applicability=inside,
        outcomes=tuple(outcomes),
        agreement=agreement(episodes.values()),
        software=software(),
        criteria=criteria_of(context, points, inside, any(each.in_fit for each in comparators)),
        table=table,
    )


def point_errors(
    table: ResidualTable, comparison: Comparison, parts: Budget
) -> tuple[PointError, ...]:
    """Comparison error, validation uncertainty and area metric of each key point and the body."""
    found, areas = [], []
    for k, uncertainty in enumerate(parts.per_key_point):
        off = -table.residual_mm[:, k]
        seen = np.isfinite(off).all(1)
        mean = off[seen].mean(0) if seen.any() else np.full(3, np.nan)
        area = area_in_space(table.predicted_mm[:, k], table.measured_mm[:, k])
        areas.append(area)
        found.append(
            PointError(
                f"k{k}",
                comparison.per_key_point_mm[k],
                (float(mean[0]), float(mean[1]), float(mean[2])),
                uncertainty.expanded_mm,
                area,
            )
        )
    whole = float(np.sqrt(np.nanmean(np.square(areas))))
    body = PointError("body", comparison.rmse_mm, None, parts.body.expanded_mm, whole)
    return (*found, body)


def criteria_of(
    context: Context,
    points: Sequence[PointError],
    inside: Applicability | None,
    fitted: bool = False,
) -> tuple[Criterion, ...]:
    """The user's limits, each with the value that it is compared with.

    The comparison error counts with its uncertainty: the upper end of E ± U_val. fitted: whether
    the model was fitted to some of the rows; criteria on the error are then not met, because it is
    known on no unseen data.
    """
    limits, found = context.limits, []
    measured = [each for each in points[:-1] if np.isfinite(each.error_mm)]
    unknown = float("nan")
    why = ", on unseen data" if fitted else ""
    if limits.error_mm is not None:
        worst = max(measured, key=lambda each: each.interval_mm[1])
        name = f"E + U_val of every key point (largest: {worst.label})"
        value = unknown if fitted else worst.interval_mm[1]
        found.append(Criterion(name + why, value, limits.error_mm, "mm"))
    if limits.tip_error_mm is not None:
        tip = points[-2]
        value = unknown if fitted else tip.interval_mm[1]
        found.append(Criterion(f"E + U_val of the tip{why}", value, limits.tip_error_mm, "mm"))
    if limits.area_mm is not None:
        worst = max(measured, key=lambda each: each.area_mm)
        name = f"area metric of every key point (largest: {worst.label})"
        value = unknown if fitted else worst.area_mm
        found.append(Criterion(name + why, value, limits.area_mm, "mm"))
    if limits.applicable is not None:
        share = float("nan") if inside is None else inside.whole
        name = "share of the scenario's states inside the validated domain"
        found.append(Criterion(name, share, limits.applicable, "", least=True))
    return tuple(found)


def inputs_of(model: ArmModel, recordings: Sequence[Recording]) -> tuple[Input, ...]:
    """Each input in the comparators and in the simulation (equivalency of inputs, V&V 40)."""
    spec = model.spec
    signal = np.concatenate([actuation_of(each, spec.actuation) for each in recordings])
    found = []
    for channel in range(spec.chambers):
        low, high = float(signal[:, channel].min()), float(signal[:, channel].max())
        room = SAME_RANGE * spec.span[channel]
        inside = low >= spec.low[channel] - room and high <= spec.high[channel] + room
        found.append(
            Input(
                f"channel {channel + 1} [{spec.unit}]",
                f"{low:.4g} to {high:.4g}",
                f"{spec.low[channel]:.4g} to {spec.high[channel]:.4g}",
                inside,
            )
        )
    return (*found, _weight(spec, recordings), _load(model, recordings), _room(spec, recordings))


def _weight(spec: ArmSpec, recordings: Sequence[Recording]) -> Input:
    known = [each.gravity for each in recordings if each.gravity is not None]
    same = None
    if spec.gravity is not None and len(known) == len(recordings):
        cosines = [float(np.dot(spec.gravity, each)) for each in known]
        same = bool(np.degrees(np.arccos(np.clip(min(cosines), -1.0, 1.0))) <= SAME_ANGLE)
    texts = list(dict.fromkeys(_vector(each) for each in known))
    ours = "not stated" if spec.gravity is None else _vector(np.array(spec.gravity))
    return Input("direction of weight", "; ".join(texts) or "not stated", ours, same)


def _vector(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.3f}" for value in values) + ")"


def _load(model: ArmModel, recordings: Sequence[Recording]) -> Input:
    name = "load at the arm [g]"
    loaded = [of for of, effect in model.effects.items() if hypothesis_of(effect).own_weight]
    ours = f"{' and '.join(loaded)}, as fitted" if loaded else "none"
    loads = [each.payload_g for each in recordings if each.payload_g is not None]
    if len(loads) < len(recordings) or any(np.isnan(each).any() for each in loads):
        return Input(name, "not stated", ours, None)
    whole = np.concatenate(loads)
    same = None if loaded else bool(np.abs(whole).max() <= SAME_PAYLOAD_G)
    return Input(name, f"{whole.min():.4g} to {whole.max():.4g}", ours, same)


def _room(spec: ArmSpec, recordings: Sequence[Recording]) -> Input:
    rooms = [each.temp_C for each in recordings if each.temp_C is not None]
    whole = np.concatenate(rooms) if rooms else np.zeros(0)
    whole = whole[np.isfinite(whole)]
    ours = "not stated" if spec.temperature_C is None else f"{spec.temperature_C:.1f}"
    if not len(whole):
        return Input("room temperature [degrees C]", "not stated", ours, None)
    text = f"{whole.min():.1f} to {whole.max():.1f}"
    same = None
    if spec.temperature_C is not None:
        same = bool(np.abs(whole - spec.temperature_C).max() <= SAME_ROOM_C)
    return Input("room temperature [degrees C]", text, ours, same)


def _comparator(recording: Recording, context: Context, table: ResidualTable) -> Comparator:
    stated = context.source(recording.name)
    notes = [text for text in (recording.note, stated.note if stated else "") if text]
    known = table.model.fitted_rows
    history = history_of([recording], table.spec.actuation)
    signal = actuation_of(recording, table.spec.actuation)
    seconds = sum(
        float(recording.t_s[run.stop - 1] - recording.t_s[run.start]) for run in recording.runs
    )
    return Comparator(
        name=recording.name,
        sha256=fingerprint(recording),
        robot=(stated.robot if stated else "") or "not stated",
        date=(stated.date if stated else "") or "not stated",
        note="; ".join(notes),
        kind=recording.kind,
        rows=recording.samples,
        seconds=seconds,
        range=tuple(zip(signal.min(0).tolist(), signal.max(0).tolist(), strict=True)),
        in_fit=None if known is None else known.certain_part_of(history),
    )


def fingerprint(recording: Recording) -> str:
    """SHA-256 of a recording's file, or of its times, actuation and key points without one."""
    digest = hashlib.sha256()
    source = recording.source
    if source is not None and Path(source).is_file():
        with Path(source).open("rb") as file:
            while chunk := file.read(1 << 20):
                digest.update(chunk)
        return digest.hexdigest()
    for values in (recording.t_s, recording.measured, recording.key_points_mm):
        digest.update(np.ascontiguousarray(values, "<f8").tobytes())
    return digest.hexdigest()


def _length(table: ResidualTable) -> float:
    """Length of the arm, mm: as stated, else from base to tip at rest."""
    if table.spec.length_mm is not None:
        return table.spec.length_mm
    rest = table.rest_mm
    return max(float(np.linalg.norm(np.diff(rest, axis=0), axis=1).sum()), 1.0)
