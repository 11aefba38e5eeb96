"""What undecided diagnoses become after the recommended experiment, on folders of cases.

    python -m benchmarks.recommended chain=FOLDER lattice=FOLDER [--models FOLDER] [--log FILE]

Where `surgisoft diagnose MODEL AFTER --before BEFORE` (`--refit never`) ends with the advice to run
`next-experiment`, the steps of a user follow: the recommended schedule (`--as-it-stands`: nothing
on the benches of these robots can be changed) is recorded on the same robot with the same hidden
effects, switched on anew, and `diagnose MODEL AFTER NEW --before BEFORE --paired never` is asked.
For comparison, as many samples of ordinary motion (ramps, holds, reversals, a ladder, wandering)
are recorded in place of the recommended schedule. NAME begins with that of a generator
(`benchmarks.amended_cases.GENERATORS`), whose FOLDER it is; models are those of
`benchmarks.decision.folders`. Cases of two effects are left out. The decision is the one in force,
which may have been fitted to other robots of these simulators.
"""

import argparse
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from benchmarks.amended_cases import GENERATORS
from benchmarks.decision.folders import OTHER, model_folder, robot_folder
from benchmarks.rig_cases import AFTER, Generator, excitation
from benchmarks.without_before import Answer
from surgisoft.diagnosis.decision import NAMING
from surgisoft.diagnosis.design.next_experiment import next_experiment
from surgisoft.diagnosis.design.schedules import AS_IT_STANDS
from surgisoft.diagnosis.diagnose import Verdict, diagnose
from surgisoft.errors import InputError
from surgisoft.measurement.recordings import Recording, load_recordings
from surgisoft.surrogate.checkpoint import load_model

TAKE = 100_000
"""Number of the first trial of the experiments: each has noise of its own."""
PLAN = "surgisoft next-experiment"
"""Beginning of the advice to record an experiment."""
COLUMNS = ("right", "in a set", "wrong", "undecided")
"""What becomes of a case."""


@dataclass(frozen=True)
class Settled:
    """An undecided case, and what it became."""

    source: str
    """Name of the simulator."""
    case: str
    """Name of the case."""
    truth: tuple[str, ...]
    """What has changed: an effect of the list, `unknown`, or nothing."""
    size: float
    """Change of the key points over the validated error of the model, RMS."""
    first: Answer
    """Answer before the experiment."""
    experiment: str
    """Name of the recommended experiment; empty where none was advised."""
    minutes: float
    """Time on the bench, minutes."""
    expected: float
    """Predicted probability of naming the right effect, for the worst pair of effects."""
    recommended: Answer
    """Answer with the recommended experiment."""
    ordinary: Answer
    """Answer with as many samples of ordinary motion."""

    @property
    def line(self) -> str:
        """One line of JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def read(cls, line: str) -> "Settled":
        """The case of a line."""
        values = json.loads(line)
        for name in ("first", "recommended", "ordinary"):
            said = values[name]
            values[name] = Answer(said["kind"], tuple(said["effects"]), said["confidence"])
        return cls(**values | {"truth": tuple(values["truth"])})


def answer_of(verdict: Verdict) -> Answer:
    """What a verdict says."""
    return Answer(verdict.kind, tuple(verdict.effects), verdict.confidence)


def outcome(truth: Sequence[str], said: Answer) -> str:
    """The column of COLUMNS of an answer; truth: at most one name."""
    if said.kind in NAMING:
        if not set(truth) & said.named or said.kind == "several":
            return "wrong"
        return "right" if said.kind == "identified" else "in a set"
    if said.kind == "unknown_effect":
        return "right" if OTHER in truth else "wrong"
    if said.kind == "nothing_missing":
        return "wrong" if truth else "right"
    return "undecided"


def settle(
    source: str, generator: Generator, folder: Path, truth_file: Path, models: Path, number: int
) -> Settled:
    """Ask, record what is recommended and as much of other motion, and ask again.

    number: of the case in its folder, from which the noise of the new recordings is drawn.
    """
    torch.set_num_threads(1)
    truth = json.loads(truth_file.read_text())
    robot, hidden = truth["robot"], [(each["effect"], each["strength"]) for each in truth["hidden"]]
    model = load_model(model_folder(folder, robot, models))
    after = load_recordings(truth_file.parent / "after")
    before = load_recordings(robot_folder(folder, robot) / "before")
    found = diagnose(model, after, before=before, refit="never")
    first = answer_of(found.verdict)
    again, name, minutes, expected = [first, first], "", 0.0, 0.0
    if found.next_command.startswith(PLAN):
        words = found.next_command.split()
        between = words[words.index("--between") + 1 : words.index("-o")]
        advice = next_experiment(model, after, between, settings=(AS_IT_STANDS,), before=before)
        name, minutes = advice.name, advice.minutes
        expected = min(pair.after for pair in advice.pairs)
        rigs = [
            generator.rig(int(robot), take=TAKE + 2 * number + k, hidden=hidden) for k in range(2)
        ]
        new = [rigs[0].record(advice.protocol)[0]]
        seconds = new[0].samples * rigs[1].period_s
        mixed = excitation(rigs[1], "ordinary", AFTER["mixed"], seconds, int(robot))
        new.append(rigs[1].record(mixed)[0])
        again = [_asked_again(model, [*after, each], before) for each in new]
    return Settled(
        source=source,
        case=str(truth_file.parent.relative_to(folder)),
        truth=tuple(truth["truth"]),
        size=truth["change_rms_mm"] / model.validation.rmse_mm,
        first=first,
        experiment=name,
        minutes=minutes,
        expected=expected,
        recommended=again[0],
        ordinary=again[1],
    )


def _asked_again(model, recordings: list[Recording], before: list[Recording]) -> Answer:
    """The answer with further recordings, of which BEFORE has no partner."""
    found = diagnose(model, recordings, before=before, paired="never", refit="never")
    return answer_of(found.verdict)


def kind_of(case: Settled) -> str:
    """The row of a case."""
    if not case.truth:
        return "nothing has changed"
    if OTHER in case.truth:
        return "unknown effect"
    held = case.first.kind == "ambiguous" and set(case.truth) <= case.first.named
    return f"one effect, {'in' if held else 'not in'} the first set"


def markdown(cases: Sequence[Settled]) -> str:
    """The table of what undecided cases became."""
    some = [case for case in cases if case.experiment and (case.size >= 1.0 or not case.truth)]
    lines = [
        "| what has changed | cases | "
        + " | ".join(
            f"{name}{column}"
            for name in ("recommended: ", "ordinary motion: ")
            for column in COLUMNS
        )
        + " | minutes, median |",
        f"|---|{(2 * len(COLUMNS) + 2) * '---|'}",
    ]
    for row in sorted({kind_of(case) for case in some}):
        own = [case for case in some if kind_of(case) == row]
        counts = [
            Counter(outcome(case.truth, said) for case, said in zip(own, answers, strict=True))
            for answers in ([each.recommended for each in own], [each.ordinary for each in own])
        ]
        cells = [str(count[column]) for count in counts for column in COLUMNS]
        minutes = sorted(case.minutes for case in own)[len(own) // 2]
        lines.append(f"| {row} | {len(own)} | {' | '.join(cells)} | {minutes:g} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Settle all cases that the log lacks, and print the table of each source and of all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", nargs="+", help="NAME=FOLDER of cases")
    parser.add_argument("--models", type=Path, default=Path("runs/recommended/models"))
    parser.add_argument("--log", type=Path, default=Path("runs/recommended/settled.jsonl"))
    given = parser.parse_args(arguments)
    lines = given.log.read_text().splitlines() if given.log.exists() else []
    done = {(case.source, case.case): case for case in map(Settled.read, lines)}
    for each in given.folders:
        source, _, place = each.partition("=")
        generator = next((own for name, own in GENERATORS.items() if source.startswith(name)), None)
        files = sorted(Path(place).glob("**/truth.json")) if place else []
        if generator is None or not files:
            known = ", ".join(GENERATORS)
            parser.error(f"'{each}', expected NAME=FOLDER with cases; NAME begins with {known}")
        for number, file in enumerate(files):
            folder = Path(place)
            key = (source, str(file.parent.relative_to(folder)))
            if key not in done and len(json.loads(file.read_text())["truth"]) <= 1:
                try:
                    done[key] = settle(source, generator, folder, file, given.models, number)
                except InputError as error:
                    print(f"{source}: {key[1]} is left out: {error}", flush=True)
                    continue
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
