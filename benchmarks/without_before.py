"""Diagnosis with and without the recordings from before a change, on folders of cases.

    python -m benchmarks.without_before chain=FOLDER lattice=FOLDER [--models FOLDER] [--log FILE]

A model may lack more than what has changed: what its network cannot do, and effects of speed where
the arm never moved fast when it was recorded for the fit. `diagnose MODEL AFTER` asks what the
model lacks, `diagnose MODEL AFTER --before BEFORE` what has changed. Where the motion is faster
than that of the fit (`surgisoft.measurement.histories.faster_than_fit`), the first also tells what
has changed since the fit. The cases state what has changed. Each is asked both ways (`--refit
never`), with the robot's model (`benchmarks.decision.folders`), and the table tells faster motion
from other motion. The decision is the one in force, which may have been fitted to other robots of
these simulators.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from benchmarks.decision.folders import OTHER, model_folder, robot_folder
from surgisoft.diagnosis.decision import NAMING
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.measurement.histories import faster_than_fit
from surgisoft.measurement.recordings import load_recordings
from surgisoft.surrogate.checkpoint import load_model

SURE = 0.8
"""Confidence from which a wrong name is counted."""
SLOW = ("without", "given")
"""Fields of the answers of a case whose motion is that of the fit."""
FAST = ("without", "since_fit", "given")
"""Fields of the answers of a case whose motion is faster."""


@dataclass(frozen=True)
class Answer:
    """What a diagnosis says of a case."""

    kind: str
    """Kind of the verdict."""
    effects: tuple[str, ...]
    """What it names."""
    confidence: float
    """Its confidence."""

    @property
    def named(self) -> frozenset[str]:
        """The effects that it names."""
        return frozenset(self.effects if self.kind in NAMING else ())


NOT_TOLD = Answer("not_told", (), 0.0)
"""Where a diagnosis does not tell what has changed since the fit."""


@dataclass(frozen=True)
class Asked:
    """A case, and both answers."""

    source: str
    """Name of the simulator."""
    case: str
    """Name of the case."""
    truth: tuple[str, ...]
    """What has changed: effects of the list, or `unknown`."""
    size: float
    """Change of the key points over the validated error of the model, RMS."""
    faster: bool
    """Whether the arm moves faster than in the recordings of the fit."""
    without: Answer
    """Answer from the recordings after the change alone."""
    given: Answer
    """Answer with those from before."""
    since_fit: Answer = NOT_TOLD
    """What has changed since the fit, from the recordings after the change and the model."""

    @property
    def line(self) -> str:
        """One line of JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def read(cls, line: str) -> "Asked":
        """The case of a line."""
        values = json.loads(line)
        for key in FAST:
            said = values[key]
            values[key] = Answer(said["kind"], tuple(said["effects"]), said["confidence"])
        return cls(**values | {"truth": tuple(values["truth"])})


def asked(source: str, folder: Path, truth_file: Path, models: Path) -> Asked:
    """Both answers to a case of a folder."""
    torch.set_num_threads(1)
    truth = json.loads(truth_file.read_text())
    model = load_model(model_folder(folder, truth["robot"], models))
    after = load_recordings(truth_file.parent / "after")
    before = load_recordings(robot_folder(folder, truth["robot"]) / "before")
    alone, given = (diagnose(model, after, before=each, refit="never") for each in (None, before))
    answers = [
        Answer(said.kind, tuple(said.effects), said.confidence) if said else NOT_TOLD
        for said in (alone.verdict, given.verdict, alone.since_fit)
    ]
    return Asked(
        source=source,
        case=str(truth_file.parent.relative_to(folder)),
        truth=tuple(truth["truth"]),
        size=truth["change_rms_mm"] / model.validation.rmse_mm,
        faster=bool(faster_than_fit(model.spec, after)),
        without=answers[0],
        given=answers[1],
        since_fit=answers[2],
    )


def rows(cases: Sequence[Asked], names: Sequence[str] = SLOW) -> list[tuple[str, ...]]:
    """(question, count of each of the named answers) of some cases."""

    def counted(
        question: str, some: Sequence[Asked], hit: Callable[[Asked, Answer], bool]
    ) -> tuple[str, ...]:
        count = [sum(hit(case, getattr(case, name)) for case in some) for name in names]
        return (question, *(f"{number} of {len(some)}" for number in count))

    large = [case for case in cases if OTHER not in case.truth and case.size >= 1.0]
    one = [case for case in large if len(case.truth) == 1]
    return [
        counted(
            "one effect: named, alone or in a set of two",
            one,
            lambda case, said: said.kind != "several" and set(case.truth) <= said.named,
        ),
        counted(
            "one effect: named, and a second one that has not changed",
            one,
            lambda case, said: said.kind == "several" and set(case.truth) <= said.named,
        ),
        counted(
            "one effect: only others named",
            one,
            lambda case, said: bool(said.named) and not set(case.truth) <= said.named,
        ),
        counted(
            "two effects: both named as two",
            [case for case in large if len(case.truth) == 2],
            lambda case, said: said.kind == "several" and set(case.truth) == said.named,
        ),
        counted(
            "unknown effect called unknown",
            [case for case in cases if OTHER in case.truth],
            lambda case, said: said.kind == "unknown_effect",
        ),
        counted(
            "nothing has changed: something named",
            [case for case in cases if not case.truth],
            lambda case, said: bool(said.named),
        ),
        counted(
            f"only wrong names, confidence >= {SURE:g}",
            cases,
            lambda case, said: (
                bool(said.named) and said.confidence >= SURE and not said.named & set(case.truth)
            ),
        ),
    ]


def markdown(cases: Sequence[Asked]) -> str:
    """The table: motion as in the fit, and faster motion."""
    slow = rows([case for case in cases if not case.faster])
    fast = rows([case for case in cases if case.faster], FAST)
    lines = [
        "| what is asked | AFTER alone | with `--before` | faster than in the fit: AFTER alone "
        "| since the fit | with `--before` |",
        "|---|---|---|---|---|---|",
    ]
    for (question, *first), (_, *second) in zip(slow, fast, strict=True):
        lines.append(f"| {' | '.join([question, *first, *second])} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Ask all cases that the log lacks, and print the table of each source and of all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", nargs="+", help="NAME=FOLDER of cases")
    parser.add_argument("--models", type=Path, default=Path("runs/without_before/models"))
    parser.add_argument("--log", type=Path, default=Path("runs/without_before/answers.jsonl"))
    given = parser.parse_args(arguments)
    lines = given.log.read_text().splitlines() if given.log.exists() else []
    done = {(case.source, case.case): case for case in map(Asked.read, lines)}
    for each in given.folders:
        source, _, name = each.partition("=")
        folder = Path(name)
        files = sorted(folder.glob("**/truth.json")) if name else []
        if not files:
            parser.error(f"'{each}' has no cases (truth.json), expected NAME=FOLDER of cases")
        for number, file in enumerate(files):
            key = (source, str(file.parent.relative_to(folder)))
            if key not in done:
                done[key] = asked(source, folder, file, given.models)
                given.log.parent.mkdir(parents=True, exist_ok=True)
                with given.log.open("a") as log:
                    print(done[key].line, file=log)
            print(f"{source}: {number + 1} of {len(files)}", flush=True)
    every = list(done.values())
    for source in sorted({case.source for case in every}):
        print(f"\n{source}\n\n{markdown([c for c in every if c.source == source])}")
    print(f"\nall {len(every)} cases\n\n{markdown(every)}")


if __name__ == "__main__":
    main()
