"""Stored evidence of cases: what the decision is fitted to and judged on.

A case is a model, recordings and what is known to be missing. Its evidence takes seconds of
processor time and is stored as one line of JSON, so that the decision is fitted again without
repeating a diagnosis.
"""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

from surgisoft.diagnosis.candidates import Candidate, candidates
from surgisoft.diagnosis.evidence import VERSION, Evidence, evidence_of
from surgisoft.diagnosis.inputs import open_inputs, with_known_residuals
from surgisoft.diagnosis.pairs import before_and_after
from surgisoft.diagnosis.residuals import Problem, residual_table
from surgisoft.diagnosis.selection import find
from surgisoft.diagnosis.testability import testable
from surgisoft.files import json_safe
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.effects import known_effects
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.training_residuals import TrainingResiduals

Label = Literal["known", "unknown", "clean", "network", "other_robot", "setup"]
"""What is true of a case: effects of the list are missing; one outside the list is; nothing; the
network is undertrained; the model is that of another robot; the set-up is wrong."""


@dataclass(frozen=True)
class Labelled:
    """The evidence of a case, and what is true of it."""

    source: str
    """Where the case comes from, such as `own_rig`; a whole source is left out at a time."""
    robot: str
    """Name of the robot within the source."""
    case: str
    """Name of the case within the source."""
    label: Label
    """What is true."""
    truth: tuple[str, ...]
    """The missing effects of the list; the generator's own name of one outside it."""
    memory: bool
    """Whether the missing effect remembers the actuation's past."""
    effect_mm: float | None
    """RMS change of the key points by what is missing, mm; None where it is not known."""
    validated_mm: float
    """Validated error of the model, mm."""
    minutes: float
    """Duration of the recordings, minutes."""
    evidence: Evidence
    """The evidence of the diagnosis."""
    seconds: float
    """Processor time of the diagnosis, s."""
    complete: bool = True
    """Whether `truth` is all that the model lacks. Not so on a real arm, whose model lacks more
    than what was injected: its residual there is no less without an injection."""
    version: int = VERSION
    """Version of the evidence."""
    left_out: tuple[str, ...] = ()
    """Missing effects that were no candidates (`without_truth`): of such a diagnosis the truth is
    unknown, though it is in the list."""

    @property
    def size(self) -> float:
        """Change by what is missing over the validated error; large where it is not known."""
        return 9.0 if self.effect_mm is None else self.effect_mm / max(self.validated_mm, 1e-9)

    def to_json(self) -> dict:
        """Plain values."""
        return json_safe(asdict(self))


@dataclass(frozen=True, eq=False)
class Posed:
    """The identification problem of a case, and the candidates that its recordings can show."""

    problem: Problem
    """The problem."""
    tried: list[Candidate]
    """The candidates of all effects."""

    def evidence(self, without: Sequence[str] = ()) -> Evidence:
        """The evidence of a diagnosis, as `diagnose` computes it.

        without: effects that are no candidates, as `diagnose --without` takes them.
        """
        tried = [each for each in self.tried if each.name not in without]
        return evidence_of(find(self.problem, tried, lambda text: None))


def posed_on(
    model: ArmModel,
    recordings: list[Recording],
    known: TrainingResiduals | None = None,
    before: list[Recording] | None = None,
) -> Posed:
    """The problem that `diagnose` poses.

    known: residuals of the model from before; before: recordings from before a change.
    """
    model, recordings, _ = open_inputs(model, recordings)
    table = residual_table(model, recordings)
    if before is None:
        problem = with_known_residuals(table.training(), known)
    else:
        problem = before_and_after(table, before).training()
    names = list(known_effects())
    tried, _ = testable(problem, candidates(problem, names), names)
    return Posed(problem, tried)


def twin_name(case: Labelled) -> str:
    """Name of a case without its truth among the candidates."""
    return f"{case.case}/without-{'+'.join(case.truth)}"


def without_truth(case: Labelled, posed: Posed) -> Labelled | None:
    """The same case where its missing effects are no candidates; None where none is in the list.

    What is missing is then unknown to the diagnosis. So every case of a known effect is also one of
    an unknown effect (leave one class out: Scheirer et al. 2013, "Toward open set recognition"): of
    the same arm, noise and size, and from the same generator as the known ones. Of two missing
    effects both are left out.
    """
    if case.label != "known":
        return None
    begin = time.process_time()
    evidence = posed.evidence(case.truth)
    return replace(
        case,
        case=twin_name(case),
        label="unknown",
        left_out=case.truth,
        evidence=evidence,
        seconds=time.process_time() - begin,
    )


def read(path: Path) -> list[Labelled]:
    """The stored cases of a file; an incomplete last line and other versions are left out."""
    answer = {}
    for line in path.read_text().splitlines() if path.is_file() else []:
        try:
            values = json.loads(line)
        except json.JSONDecodeError:
            continue
        if values.get("version") != VERSION:
            continue
        values["truth"] = tuple(values["truth"])
        values["left_out"] = tuple(values.get("left_out", ()))
        values["evidence"] = Evidence.from_json(values["evidence"])
        answer[values["case"]] = Labelled(**values)
    return list(answer.values())


def append(path: Path, *some: Labelled) -> None:
    """Store cases at the end of a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write("".join(json.dumps(one.to_json()) + "\n" for one in some))


def twin_of(done: Mapping[str, Labelled], name: str) -> Labelled | None:
    """The stored case of the same recording without its truth among the candidates."""
    return done.get(twin_name(done[name]))


def is_stored(done: Mapping[str, Labelled], name: str, twins: bool) -> bool:
    """Whether a case is stored, and with `twins` the one without its truth too."""
    known = name in done and done[name].label == "known"
    return name in done and not (twins and known and twin_of(done, name) is None)


def with_twins(done: Mapping[str, Labelled], names: Sequence[str], twins: bool) -> list[Labelled]:
    """The stored cases of these names, each with the one without its truth behind it."""
    answer = []
    for name in names:
        twin = twin_of(done, name) if twins else None
        answer += [done[name]] if twin is None else [done[name], twin]
    return answer
