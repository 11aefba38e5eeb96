"""Stored evidence of cases: what the decision is fitted to and judged on.

A case is a model, recordings and what is known to be missing. Its evidence takes seconds of
processor time and is stored as one line of JSON, so that the decision is fitted again without
repeating a diagnosis. The folder `evidence` beside this module holds, in one file for each source,
the cases that the decision in force was fitted to, and in `evidence/judged` those that it is judged
on and was never fitted to.
"""

import gzip
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from surgisoft.diagnosis.candidates import Candidate, candidates
from surgisoft.diagnosis.evidence import VERSION, Evidence, evidence_of
from surgisoft.diagnosis.inputs import open_inputs, with_known_residuals
from surgisoft.diagnosis.pairs import before_and_after
from surgisoft.diagnosis.residuals import Problem, residual_table
from surgisoft.diagnosis.selection import find
from surgisoft.diagnosis.testability import testable
from surgisoft.files import json_safe, write_atomically
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.effects import known_effects
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.training_residuals import TrainingResiduals
from surgisoft.workers import torch_threads

EVIDENCE = Path(__file__).parent / "evidence"
"""Folder of the stored evidence of the decision in force."""
JUDGED = "judged"
"""Folder therein of cases that take no part in any fit."""
ENDING = ".jsonl.gz"
"""End of the name of a file of stored evidence."""
DIGITS = 5
"""Significant digits of a stored number. On 691 cases no probability of the decision in force
changed by more than 0.00005 with five digits, 0.0006 with four and 0.004 with three."""

Label = Literal["known", "unknown", "clean", "network", "other_robot", "setup"]
"""What is true of a case: effects of the list are missing; one outside the list is; nothing; the
network is undertrained; the model is that of another robot; the set-up is wrong."""


Models = Literal["default", "alone"]
"""Models that a case is asked of: those of `fit` by default, with a prior mean where it does no
harm; or networks alone (`--prior none`)."""
PRIOR: dict[Models, str | None] = {"default": None, "alone": "none"}
"""Prior mean of these models, as `FitConfig` takes it."""


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
    models: Models = "alone"
    """The model that was asked; that of stored evidence that does not say so is a network alone."""

    @property
    def size(self) -> float:
        """Change by what is missing over the validated error; large where it is not known."""
        return 9.0 if self.effect_mm is None else self.effect_mm / max(self.validated_mm, 1e-9)

    def to_json(self) -> dict:
        """Plain values, numbers with DIGITS significant digits; no `models` where it is alone."""
        plain = asdict(self) | {"evidence": self.evidence.to_json()}
        if self.models == "alone":
            del plain["models"]
        return _rounded(json_safe(plain))

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "Labelled":
        """The case that `to_json` wrote."""
        plain = dict(values)
        plain["truth"] = tuple(plain["truth"])
        plain["left_out"] = tuple(plain.get("left_out", ()))
        plain["evidence"] = Evidence.from_json(plain["evidence"])
        return cls(**plain)

    @property
    def line(self) -> str:
        """The case as a line of JSON, equal for equal cases."""
        return json.dumps(self.to_json(), sort_keys=True)


def _rounded(values: Any) -> Any:
    """Plain values with numbers rounded to DIGITS significant digits."""
    if isinstance(values, dict):
        return {key: _rounded(value) for key, value in values.items()}
    if isinstance(values, list):
        return [_rounded(value) for value in values]
    return float(f"{values:.{DIGITS}g}") if isinstance(values, float) else values


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


@torch_threads(1)
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


@torch_threads(1)
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
    if not path.is_file():
        return []
    packed = path.name.endswith(".gz")
    text = gzip.decompress(path.read_bytes()).decode() if packed else path.read_text()
    answer = {}
    for line in text.splitlines():
        try:
            values = json.loads(line)
        except json.JSONDecodeError:
            continue
        if values.get("version") != VERSION:
            continue
        answer[values["case"]] = Labelled.from_json(values)
    return list(answer.values())


def file_of(source: str, models: Models) -> str:
    """Name of the file of a source's evidence, without its end."""
    return source if models == "alone" else f"{source}.{models}"


def files_of(source: str, files: Iterable[str]) -> list[str]:
    """The names among them of files of a source's evidence, of any models."""
    return [file for file in files if file.partition(".")[0] == source]


def in_order(some: Sequence[Labelled]) -> list[Labelled]:
    """Cases in an order that does not depend on how they were collected or stored."""
    return sorted(some, key=lambda one: (one.source, one.case, one.models))


def stored(folder: Path = EVIDENCE) -> dict[str, list[Labelled]]:
    """The cases of each file of a folder of stored evidence, by its name (`file_of`)."""
    files = sorted(folder.glob(f"*{ENDING}"))
    return {file.name.removesuffix(ENDING): read(file) for file in files}


def keep(folder: Path, source: str, some: Sequence[Labelled]) -> None:
    """Store all cases of a source in a folder; equal cases give equal bytes, in any order."""
    folder.mkdir(parents=True, exist_ok=True)
    text = "".join(f"{line}\n" for line in sorted(one.line for one in some))
    write_atomically(folder / f"{source}{ENDING}", gzip.compress(text.encode(), 9, mtime=0))


def append(path: Path, *some: Labelled) -> None:
    """Store cases at the end of a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write("".join(f"{one.line}\n" for one in some))


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
