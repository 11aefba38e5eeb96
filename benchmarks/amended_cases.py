"""Fall of the error by `amend` on generators of robots that took no part in the decision's fit.

    python -m benchmarks.amended_cases chain=FOLDER elastica=FOLDER [--models FOLDER]
        [--pairs] [--improve [--before]] [--log FILE]

FOLDER holds the cases of the generator that the name begins with (`GENERATORS`). The decision in
force judges the stored evidence of each case (`benchmarks/decision/evidence/judged`); a source that
the decision was fitted to is judged by a fit without it. Where one effect is missing that changes
the key points by at least the model's validated error, and the decision names something, the
robot's model is amended as by `surgisoft amend MODEL --effect NAME --data AFTER --before BEFORE`:
by the effect that is named alone, by both of two, by the more probable one of a set.

The oracle is the error of the same model on the same robot, schedule and noise with nothing hidden
(`benchmarks.diagnosis.amend`). Its share compares two falls of the error on the held-out quarter:
that by `amend`, 0 where it claims none, and that by taking the effect out of the robot.

With `--improve` nothing has to be named: every such case goes through
`surgisoft improve MODEL AFTER --refit never`, which repeats diagnosis and amendment; with
`--before` through `surgisoft improve MODEL AFTER --before BEFORE`.
"""

import argparse
import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks import chain_cases, elastica_cases, lattice_cases, strain_rod_cases
from benchmarks.decision.evidence_log import (
    EVIDENCE,
    JUDGED,
    Labelled,
    files_of,
    in_order,
    stored,
)
from benchmarks.decision.fit import fit, model_of
from benchmarks.decision.folders import model_folder, robot_folder
from benchmarks.decision.table import Judged, default_models, judged
from benchmarks.diagnosis.after_table import SHOWS
from benchmarks.diagnosis.amend import Amended, amended
from benchmarks.rig_cases import TAKES, Generator, after_protocol
from surgisoft.diagnosis.decision import NAMING, fitted_decision
from surgisoft.diagnosis.improve import NETWORK, improve
from surgisoft.errors import InputError
from surgisoft.measurement.recordings import Recording, load_recordings
from surgisoft.surrogate.checkpoint import load_model
from surgisoft.surrogate.model import ArmModel

GENERATORS = {
    "chain": chain_cases.GENERATOR,
    "elastica": elastica_cases.GENERATOR,
    "lattice": lattice_cases.GENERATOR,
    "strain_rod": strain_rod_cases.GENERATOR,
}
"""Generators by the beginning of the name of their evidence."""


@dataclass(frozen=True)
class AmendedCase:
    """What an amendment by the named effects was worth."""

    case: str
    """Name of the case."""
    truth: tuple[str, ...]
    """The missing effects."""
    kind: str
    """Kind of the result."""
    amended: Amended
    """The errors, mm."""

    @property
    def right(self) -> bool:
        """Whether the model was amended by what is missing and by nothing else."""
        return set(self.amended.effects) == set(self.truth)


def statements(source: str) -> list[Judged]:
    """What the decision says of the stored cases of a source that took no part in its fit."""
    aside = stored(EVIDENCE / JUDGED)
    unseen = [case for file in files_of(source, aside) for case in aside[file]]
    if unseen:
        return judged(default_models(unseen), fitted_decision())
    every = in_order([case for some in stored().values() for case in some])
    names = sorted({case.source for case in every})
    if source not in names:
        known = ", ".join((*sorted({file.partition(".")[0] for file in aside}), *names))
        raise InputError(f"{source}: no stored evidence of that name; there is {known}")
    own = default_models([case for case in every if case.source == source])
    return judged(own, model_of(fit([case for case in every if case.source != source])))


def to_amend(some: Sequence[Judged], effects: int) -> list[tuple[Labelled, str, tuple[str, ...]]]:
    """(case, kind, effects to amend by) of the cases that are judged.

    effects: number of effects that are missing.
    """
    answer = []
    for one in some:
        case, found = one.case, one.decision
        if case.label != "known" or case.left_out or len(case.truth) != effects:
            continue
        if case.size < 1.0 or found.kind not in NAMING:
            continue
        chance = found.probabilities.effects
        named = tuple(sorted(found.effects, key=lambda name: -chance.get(name, 0.0)))
        answer.append((case, found.kind, named[:1] if found.kind == "ambiguous" else named))
    return answer


def to_improve(some: Sequence[Judged], effects: int) -> list[tuple[Labelled, str, tuple[str, ...]]]:
    """The same of all cases with so many missing effects, for `improve`: none is named."""
    cases = [one.case for one in some]
    known = [c for c in cases if c.label == "known" and not c.left_out and c.size >= 1.0]
    return [(case, "improve", ()) for case in known if len(case.truth) == effects]


def unchanged(generator: Generator, case: Labelled, after: str) -> Recording:
    """The recording of a case with nothing hidden: the same robot, schedule and noise."""
    plan, _, number = Path(case.case).name.rpartition("-")
    take = TAKES[plan or "round"] + int(number)
    rig = generator.rig(int(case.robot), take=take)
    return rig.record(after_protocol(generator, rig, int(case.robot), after))[0]


def worth_of(
    generator: Generator, folder: Path, models: Path, case: Labelled, named: tuple[str, ...]
) -> Amended:
    """Amend the model of a case's robot by the named effects, and compare with the oracle."""
    model, recording, plain = _opened(generator, folder, models, case)
    before = load_recordings(robot_folder(folder, case.robot) / "before")
    return amended(model, recording, plain, named, before)


def worth_of_improve(
    generator: Generator, folder: Path, models: Path, case: Labelled, before: bool = False
) -> Amended:
    """Improve the model of a case's robot, and compare with the oracle.

    before: whether `improve` is given the recordings from before the change.
    """
    model, recording, plain = _opened(generator, folder, models, case)
    earlier = load_recordings(robot_folder(folder, case.robot) / "before") if before else None
    found = improve(model, [recording], refit="never", before=earlier)
    fall = found.model_error or found.held_out
    added = tuple(name for name in dict(found.steps) if name != NETWORK)
    after = fall.after if found.claimed else fall.before
    return Amended(added, fall.before, after, amended(model, recording, plain, ()).oracle)


def _opened(
    generator: Generator, folder: Path, models: Path, case: Labelled
) -> tuple[ArmModel, Recording, Recording]:
    """The model of a case's robot, its recording, and the same with nothing hidden."""
    place = folder / case.case
    after = json.loads((place / "truth.json").read_text())["after"]
    model = load_model(model_folder(folder, case.robot, models, models=case.models))
    recording = load_recordings(place / "after")[0]
    about = json.loads((robot_folder(folder, case.robot) / "robot.json").read_text())
    as_long = dataclasses.replace(generator, longer=about.get("longer", 1.0))
    return model, recording, unchanged(as_long, case, after)


def markdown(some: dict[str, list[AmendedCase]]) -> str:
    """The tables: shares of each source, and each case."""
    lines = [
        "| source | cases | all that is missing added | and nothing else | nothing added | of them "
        "shown in the held-out rows | share of the oracle's fall, median | pooled | amended by "
        "what is missing alone | their median | pooled |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    together = [worth for worths in some.values() for worth in worths]
    for source, worths in (some | {"together": together} if len(some) > 1 else some).items():
        shown = [w for w in worths if w.amended.before >= SHOWS * w.amended.oracle]
        right = [w for w in shown if w.right]
        whole = sum(set(w.truth) <= set(w.amended.effects) for w in worths)
        none = sum(not w.amended.effects for w in worths)
        lines.append(
            f"| {source} | {len(worths)} | {whole} | {sum(w.right for w in worths)} | {none} | "
            f"{len(shown)} | {_shares(shown)} | {len(right)} | {_shares(right)} |"
        )
    lines += [
        "",
        "| source | case | missing | said | amended by | before | after | oracle | share |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for source, worths in some.items():
        for w in sorted(worths, key=lambda w: w.amended.share):
            a = w.amended
            share = f"{100 * a.share:.0f} %" if a.before >= SHOWS * a.oracle else "-"
            lines.append(
                f"| {source} | {w.case} | {' + '.join(w.truth)} | {w.kind} | "
                f"{' + '.join(a.effects)} | {a.before:.3f} | {a.after:.3f} | {a.oracle:.3f} | "
                f"{share} |"
            )
    return "\n".join(lines)


def _shares(some: Sequence[AmendedCase]) -> str:
    if not some:
        return "- | -"
    falls = np.array([[w.amended.before - w.amended.after for w in some], _best(some)])
    middle = np.median([w.amended.share for w in some])
    return f"{100 * middle:.0f} % | {100 * falls[0].sum() / falls[1].sum():.0f} %"


def _best(some: Sequence[AmendedCase]) -> list[float]:
    return [w.amended.before - w.amended.oracle for w in some]


def read_log(log: Path) -> dict[tuple[str, str], AmendedCase]:
    """Stored results by source and case."""
    found = {}
    for line in log.read_text().splitlines() if log.is_file() else []:
        values = json.loads(line)
        about = values["amended"]
        a = Amended(**about | {"effects": tuple(about["effects"])})
        one = AmendedCase(values["case"], tuple(values["truth"]), values["kind"], a)
        found[values["source"], one.case] = one
    return found


def main() -> None:
    """Parse the command line, amend, and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("cases", nargs="+", help="NAME=FOLDER, NAME as of the stored evidence")
    parser.add_argument("--models", type=Path, default=Path("runs/benchmark-decision/models"))
    parser.add_argument("--log", type=Path, default=Path("runs/amended-cases.jsonl"))
    parser.add_argument("--pairs", action="store_true", help="cases of two effects")
    parser.add_argument("--improve", action="store_true", help="`improve` in place of `amend`")
    parser.add_argument("--before", action="store_true", help="`improve` with --before")
    given = parser.parse_args()
    torch.set_num_threads(1)
    done, answer = read_log(given.log), dict[str, list[AmendedCase]]()
    given.log.parent.mkdir(parents=True, exist_ok=True)
    for name, _, folder in (each.partition("=") for each in given.cases):
        generator = next(own for kind, own in GENERATORS.items() if name.startswith(kind))
        answer[name] = []
        pick = to_improve if given.improve else to_amend
        wanted = pick(statements(name), 2 if given.pairs else 1)
        for number, (case, kind, named) in enumerate(wanted):
            one = done.get((name, case.case))
            if one is None or one.kind != kind or (named and one.amended.effects != named):
                place = generator, Path(folder), given.models, case
                if given.improve:
                    result = worth_of_improve(*place, given.before)
                else:
                    result = worth_of(*place, named)
                one = AmendedCase(case.case, case.truth, kind, result)
                with given.log.open("a") as file:
                    file.write(json.dumps({"source": name} | dataclasses.asdict(one)) + "\n")
            answer[name].append(one)
            print(f"{name}: {number + 1} of {len(wanted)}", flush=True)
    print(markdown(answer))


if __name__ == "__main__":
    main()
