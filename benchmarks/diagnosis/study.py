"""Benchmark `diagnosis`: many virtual robots with known hidden effects.

Most of their hidden effects have other equations than the model's effects; `cases.SAME_LAW` lists
those that do not.
Every case draws the hidden effect (or none, one outside the list, or two), its amplitude, noise,
excitation and the model discrepancy. An ambiguous case continues with the recommended experiment;
in some cases the model is amended by the named effects.
"""

import hashlib
import json
import time
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

import surgisoft
from benchmarks.diagnosis.amend import Amended, amended
from benchmarks.diagnosis.cases import Case
from benchmarks.diagnosis.experiment import Settled, settle_both
from benchmarks.diagnosis.robots import base_model, bent, record, validation_of
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.errors import InputError
from surgisoft.files import json_safe
from surgisoft.progress import Progress
from surgisoft.workers import workers


@dataclass(frozen=True)
class Outcome:
    """Result of the diagnosis of a case."""

    case: Case
    """The case."""
    kind: str
    """Kind of the verdict."""
    effects: tuple[str, ...]
    """Effects that the verdict names."""
    ranking: tuple[str, ...]
    """Effects in the order of their rank."""
    confidence: float
    """Confidence of the verdict."""
    effect_mm: float
    """RMS change of the key points by the hidden effects, mm."""
    discrepancy_mm: float
    """Validated error of the surrogate, mm."""
    seconds: float
    """Processor time of the diagnosis, s."""
    statistics: dict
    """Statistics of the decision, for calibration."""
    settled: Settled | None = None
    """Result of the recommended experiment; None where the case is not ambiguous."""
    settled_untouched: Settled | None = None
    """Result of the experiment that is recommended without a change of the setup."""
    amended: Amended | None = None
    """Result of amending by the named effects; None where it was not requested."""
    case_seconds: float = 0.0
    """Processor time of the whole case, s."""


def to_amend(some: list[Case], number: int) -> set[Case]:
    """The first so many cases with one effect of the list, all effects alternating."""
    return set([case for case in some if case.single][:number])


def run_case(case: Case, folder: Path, amending: bool = False) -> Outcome:
    """Record, deform the surrogate, diagnose; experiment if ambiguous; amend if requested."""
    begin = time.process_time()
    torch.set_num_threads(1)
    model = base_model(case.robot, folder, case.undertrained)
    if case.discrepancy_mm > model.validation.rmse_mm:
        model = bent(model, case.robot, case.discrepancy_mm, case.take)
    known = model.residuals_on([validation_of(case.robot)])
    recorded = record(case)
    ready = time.process_time()
    found = diagnose(model, [recorded.recording], reference=known)
    seconds = time.process_time() - ready
    verdict = found.verdict
    settled = untouched = worth = None
    if verdict.kind == "ambiguous":
        settled, untouched = settle_both(case, model, known, recorded.recording, verdict.effects)
    if amending:
        named = _answer(verdict.kind, verdict.effects, settled)
        worth = amended(model, recorded.recording, recorded.plain, named)
    return Outcome(
        case=case,
        kind=verdict.kind,
        effects=verdict.effects,
        ranking=tuple(row.effect for row in found.ranking),
        confidence=found.ranking[0].confidence if found.ranking else 0.0,
        effect_mm=recorded.effect_mm,
        discrepancy_mm=model.validation.rmse_mm,
        seconds=seconds,
        statistics=json_safe(asdict(found.statistics)),
        settled=settled,
        settled_untouched=untouched,
        amended=worth,
        case_seconds=time.process_time() - begin,
    )


def _answer(kind: str, effects: tuple[str, ...], settled: Settled | None) -> tuple[str, ...]:
    """Effects by which a user would amend, after the recommended experiment."""
    if kind != "ambiguous":
        return effects
    return ((settled and settled.effect) or effects[0],)


def run(
    some: list[Case],
    folder: Path,
    processes: int,
    report: Progress,
    amend: int = 0,
) -> list[Outcome]:
    """Run all cases in parallel, base models first, and return their outcomes.

    amend: number of cases whose model is amended, too. Outcomes are stored in the folder, so that
    an interrupted run continues.
    """
    robots = sorted({(case.robot, case.undertrained) for case in some})
    if not robots:
        raise InputError("no cases: ask for at least one robot")
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / f"outcomes-{fingerprint()}.jsonl"
    wanted = to_amend(some, amend)
    known = {
        case: outcome
        for case, outcome in read_outcomes(log).items()
        if outcome.amended is not None or case not in wanted
    }
    total, done = len(robots) + len(some), 0
    by_case = {case: known[case] for case in some if case in known}
    with workers(processes) as pool:
        for future in as_completed([pool.submit(base_model, r, folder, u) for r, u in robots]):
            future.result()
            done += 1
            report(done, total, "base models")
        done += len(by_case)
        jobs = [
            pool.submit(run_case, case, folder, case in wanted)
            for case in some
            if case not in by_case
        ]
        for future in as_completed(jobs):
            outcome = future.result()
            by_case[outcome.case] = outcome
            done += 1
            report(done, total, f"{len(by_case)} of {len(some)} robots")
            with log.open("a") as file:
                file.write(json.dumps(asdict(outcome)) + "\n")
    return [by_case[case] for case in some]


def fingerprint() -> str:
    """Hash of what the outcomes depend on: the code of the diagnosis, effects, rig and cases."""
    package = Path(surgisoft.__file__).parent
    folders = ("diagnosis", "surrogate", "rig", "measurement/protocols")
    files = [path for folder in folders for path in (package / folder).rglob("*.py")]
    files += [p for p in Path(__file__).parent.glob("*.py") if "table" not in p.name]
    digest = hashlib.sha256()
    for path in sorted(files):
        if "pages" not in path.parts:
            digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def read_outcomes(log: Path) -> dict[Case, Outcome]:
    """Stored outcomes; an incomplete last line is left out."""
    by_case = {}
    for line in log.read_text().splitlines() if log.is_file() else []:
        try:
            values = json.loads(line)
        except json.JSONDecodeError:
            continue
        case = values.pop("case")
        hidden = tuple((name, strength) for name, strength in case.pop("hidden"))
        for name in ("settled", "settled_untouched"):
            values[name] = values[name] and Settled(**values[name])
        worth = values.pop("amended")
        outcome = Outcome(
            case=Case(hidden=hidden, **case),
            effects=tuple(values.pop("effects")),
            ranking=tuple(values.pop("ranking")),
            amended=worth and Amended(**worth | {"effects": tuple(worth["effects"])}),
            **values,
        )
        by_case[outcome.case] = outcome
    return by_case
