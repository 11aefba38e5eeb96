"""Benchmark `real`: a model fitted before a change, asked about the recordings after it."""

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from benchmarks.cache import Cache
from benchmarks.real.entries import SETUP, UNKNOWN, Entry, FitOptions, recordings_of
from surgisoft.diagnosis.amend import amend
from surgisoft.diagnosis.diagnose import Diagnosis, diagnose
from surgisoft.errors import InputError
from surgisoft.files import json_safe
from surgisoft.measurement.fitting import fit
from surgisoft.measurement.recordings import Recording
from surgisoft.progress import Progress, Stages
from surgisoft.surrogate.checkpoint import load_model, save_model
from surgisoft.surrogate.model import ArmModel

NAMING = ("identified", "several", "ambiguous")
"""Kinds of verdicts that name effects."""
CLAIMING = (*NAMING, SETUP)
"""Kinds of verdicts that claim to know what changed."""
REFUSED = "refused"
"""Kind of an answer where `diagnose` ended with an error; its line is the sentence."""
CLAIMED = 0.8
"""Confidence from which a wrong name misleads (goal of the benchmark)."""
MOST_NAMES = 2
"""Most names of a verdict that counts as naming the truth (goal of the benchmark)."""


@dataclass(frozen=True)
class Answer:
    """What `diagnose` answered about one change."""

    kind: str
    """Kind of the verdict."""
    names: tuple[str, ...]
    """Effects that the verdict names; `setup` and `unknown` for verdicts of these kinds."""
    confidence: float
    """Calibrated probability that the statement is right; 0 for a fault of the set-up."""
    ranking: tuple[str, ...]
    """All effects, the most likely first."""
    sentence: str
    """The verdict in words."""
    before_mm: float
    """Error of the model on the recordings after the change, mm."""
    floor_mm: float
    """Noise floor, mm."""
    best_mm: float
    """Best achievable error on held-out blocks, a black box included, mm."""
    validated_mm: float
    """Validated error of the model, mm."""
    seconds: float
    """Duration of the diagnosis, s."""
    faults: tuple[str, ...] = ()
    """Kinds of the faults of the set-up that were found."""


@dataclass(frozen=True)
class Outcome:
    """One entry and what came of it."""

    entry: Entry
    """The entry."""
    skipped: str = ""
    """Why it was not run; empty: it was."""
    answer: Answer | None = None
    """The diagnosis; None where it was skipped."""
    amended_mm: float | None = None
    """Error on the held-out quarter after amending by what was named, mm; None: nothing named."""
    oracle_mm: float | None = None
    """Error on the held-out quarter after amending by the truth, mm; None: no effect is true."""
    held_out_mm: float | None = None
    """Error on the held-out quarter without the effects (`_amended`), mm."""

    @property
    def named(self) -> bool:
        """Whether the diagnosis is right (`right`)."""
        return self.answer is not None and right(self.answer, self.entry.truth, self.entry.faults)

    @property
    def misled(self) -> bool:
        """Whether the diagnosis claims a wrong name (`misleads`)."""
        return self.answer is not None and misleads(
            self.answer, self.entry.truth, self.entry.faults
        )


def right(answer: Answer, truth: Sequence[str], faults: Sequence[str] = ()) -> bool:
    """Whether the truth is named, alone or in a set of at most two (or as many as there are).

    Where nothing changed: whether nothing was named. A verdict of several effects claims that all
    of them are missing, so each of them has to be true. faults: those of the set-up, which have to
    be found exactly where the truth is `setup`.
    """
    if not truth:
        return not answer.names
    if not set(truth) <= set(answer.names) or len(answer.names) > max(MOST_NAMES, len(truth)):
        return False
    if answer.kind == "several" and not set(answer.names) <= set(truth):
        return False
    return not faults or set(answer.faults) == set(faults)


def misleads(answer: Answer, truth: Sequence[str], faults: Sequence[str] = ()) -> bool:
    """Whether a wrong name is claimed with a confidence that promises to be right.

    A set of competing effects claims that one of its names is true, any other verdict that all of
    them are; a fault of the set-up is claimed as proven, without a confidence.
    """
    if answer.kind not in CLAIMING:
        return False
    if answer.kind == SETUP:
        return SETUP not in truth or (bool(faults) and not set(answer.faults) <= set(faults))
    names = set(answer.names)
    wrong = names.isdisjoint(truth) if answer.kind == "ambiguous" else not names <= set(truth)
    return wrong and answer.confidence >= CLAIMED


def digest_of(recordings: Sequence[Recording], options: FitOptions, actuation: str) -> str:
    """Twelve letters that differ where recordings or options of a fit do."""
    found = hashlib.sha256()
    for recording in recordings:
        for array in (recording.t_s, recording.measured, recording.commanded, recording.run):
            if array is not None:
                found.update(np.ascontiguousarray(array).tobytes())
        found.update(np.ascontiguousarray(recording.key_points_mm).tobytes())
        found.update(repr((recording.unit, recording.kind, recording.noise_mm)).encode())
    found.update(repr((options, actuation)).encode())
    return found.hexdigest()[:12]


def fitted(
    recordings: Sequence[Recording],
    options: FitOptions,
    actuation: str,
    cache: Cache,
    tell: Progress,
) -> ArmModel:
    """The model of the recordings: from the cache where the same fit was made before."""
    digest = digest_of(recordings, options, actuation)
    place = cache.folder / f"model-{digest}"
    if (place / "config.json").is_file():
        return load_model(place)
    named = {field.name: getattr(options, field.name) for field in fields(options)}
    widths = named.pop("widths")
    result = fit(
        list(recordings),
        actuation=actuation,
        hidden=widths,
        progress=lambda stage, epoch, of, loss: tell(epoch, of, stage),
        **named,
    )
    cache.folder.mkdir(parents=True, exist_ok=True)
    save_model(result.model, place, result.report(), force=True)
    return load_model(place)


Ask = Callable[[ArmModel, Sequence[Recording], Sequence[Recording] | None], Diagnosis]
"""A diagnosis of a model by recordings, with those from before a change where there are any."""


def ask(
    model: ArmModel,
    after: Sequence[Recording],
    before: Sequence[Recording] | None,
    without: Sequence[str] = (),
) -> Diagnosis:
    """The diagnosis of `surgisoft diagnose MODEL AFTER --before BEFORE --without EFFECT`."""
    return diagnose(model, after, before=before, without=without)


def answer_of(model: ArmModel, found: Diagnosis, seconds: float) -> Answer:
    """What a diagnosis said, in short."""
    verdict = found.verdict
    stand_ins = {"unknown_effect": (UNKNOWN,), "setup": (SETUP,)}
    names = verdict.effects if verdict.kind in NAMING else stand_ins.get(verdict.kind, ())
    return Answer(
        kind=verdict.kind,
        names=tuple(names),
        confidence=verdict.confidence,
        ranking=tuple(row.effect for row in found.ranking),
        sentence=verdict.sentence,
        before_mm=found.error_mm.before,
        floor_mm=found.error_mm.floor,
        best_mm=found.error_mm.best_achievable,
        validated_mm=model.validation.rmse_mm,
        seconds=seconds,
        faults=found.setup.kinds if found.setup else (),
    )


def asked(
    model: ArmModel,
    after: Sequence[Recording],
    before: Sequence[Recording] | None,
    without: Sequence[str] = (),
) -> Answer:
    """The answer of a diagnosis, or why it was refused.

    without: effects that are no candidates.
    """
    begin = time.process_time()
    try:
        found = ask(model, after, before, without)
    except InputError as error:
        nan, seconds = float("nan"), time.process_time() - begin
        known = model.validation.rmse_mm
        return Answer(REFUSED, (), 0.0, (), str(error), nan, nan, nan, known, seconds)
    return answer_of(model, found, time.process_time() - begin)


def run_entry(entry: Entry, data: Path, cache: Cache, tell: Progress) -> Outcome:
    """Import, fit, diagnose and amend for one entry; skipped where its files are absent."""
    try:
        before = recordings_of(entry.before, data, "before")
        after = recordings_of(entry.after, data, "after") if entry.after else before
    except InputError as error:
        return Outcome(entry, skipped=str(error))
    model = fitted(before, entry.fit, entry.actuation, cache, tell)
    tell(1, 1, "diagnose")
    answer = asked(model, after, before if entry.after else None)
    if answer.kind == REFUSED:
        return Outcome(entry, answer=answer)
    tell(1, 1, "amend")
    catalogue = [name for name in entry.truth if name not in (UNKNOWN, SETUP)]
    named = answer.names if answer.kind in NAMING else ()
    by_named = _amended(model, after, named[:1] if answer.kind == "ambiguous" else named)
    by_truth = by_named if set(named) == set(catalogue) else _amended(model, after, catalogue)
    held = by_named or by_truth
    return Outcome(
        entry,
        answer=answer,
        amended_mm=by_named and by_named[1],
        oracle_mm=by_truth and by_truth[1],
        held_out_mm=held and held[0],
    )


def _amended(
    model: ArmModel, after: Sequence[Recording], effects: Sequence[str]
) -> tuple[float, float] | None:
    """Error without and with effects on the held-out quarter, mm; None without effects.

    Where they were fitted together with the network: without them that of the network that was
    trained for as many epochs. The given model may have been fitted to the held-out rows, the
    trained ones have not.
    """
    if not effects:
        return None
    found = amend(model, list(after), list(effects))
    fall = found.held_out if found.refit is None else found.alone
    return fall.before, fall.after


def run(entries: Sequence[Entry], data: Path, work: Path, report: Progress) -> list[Outcome]:
    """The outcomes of all entries, in order; the folder `work` keeps the fitted models.

    Raises InputError where no entry can be run.
    """
    cache, stages, outcomes = Cache(work), Stages(report, len(entries)), []
    for entry in entries:
        outcomes.append(run_entry(entry, data, cache, stages.stage(1.0, entry.name)))
    if outcomes and all(outcome.skipped for outcome in outcomes):
        raise InputError(f"{outcomes[0].entry.name}: {outcomes[0].skipped}")
    return outcomes


def to_json(outcomes: Sequence[Outcome]) -> dict:
    """Plain values of all outcomes."""
    rows = []
    for outcome in outcomes:
        entry, answer = outcome.entry, outcome.answer
        row: dict = {
            "entry": entry.name,
            "robot": entry.robot,
            "change": entry.change,
            "truth": list(entry.truth),
            "actuation": entry.actuation,
            "source": entry.source,
            "licence": entry.licence,
        }
        if answer is None:
            rows.append(row | {"skipped": outcome.skipped})
            continue
        row["verdict"] = {
            "kind": answer.kind,
            "names": list(answer.names),
            "faults": list(answer.faults),
            "confidence": answer.confidence,
            "sentence": answer.sentence,
        }
        row["ranking"] = list(answer.ranking)
        row["named"] = outcome.named
        row["misled"] = outcome.misled
        row["error_mm"] = {
            "before": answer.before_mm,
            "floor": answer.floor_mm,
            "best_achievable": answer.best_mm,
            "validated": answer.validated_mm,
            "held_out": outcome.held_out_mm,
            "amended": outcome.amended_mm,
            "oracle": outcome.oracle_mm,
        }
        rows.append(row | {"seconds": answer.seconds})
    return json_safe({"entries": rows})
