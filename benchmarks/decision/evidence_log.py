"""Stored evidence of cases: what the decision is fitted to and judged on.

A case is a model, recordings and what is known to be missing. Its evidence takes seconds of
processor time and is stored as one line of JSON, so that the decision is fitted again without
repeating a diagnosis.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from surgisoft.diagnosis.candidates import candidates
from surgisoft.diagnosis.evidence import VERSION, Evidence, evidence_of
from surgisoft.diagnosis.inputs import open_inputs, with_known_residuals
from surgisoft.diagnosis.pairs import before_and_after
from surgisoft.diagnosis.residuals import residual_table
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

    @property
    def size(self) -> float:
        """Change by what is missing over the validated error; large where it is not known."""
        return 9.0 if self.effect_mm is None else self.effect_mm / max(self.validated_mm, 1e-9)

    def to_json(self) -> dict:
        """Plain values."""
        return json_safe(asdict(self))


def evidence_on(
    model: ArmModel,
    recordings: list[Recording],
    known: TrainingResiduals | None = None,
    before: list[Recording] | None = None,
) -> Evidence:
    """The evidence of a diagnosis, as `diagnose` computes it.

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
    return evidence_of(find(problem, tried, lambda text: None))


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
        values["evidence"] = Evidence.from_json(values["evidence"])
        answer[values["case"]] = Labelled(**values)
    return list(answer.values())


def append(path: Path, one: Labelled) -> None:
    """Store a case at the end of a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write(json.dumps(one.to_json()) + "\n")
