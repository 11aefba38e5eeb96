"""Benchmark `before_after`: what has changed between two recordings of the same actuation.

Virtual robots are recorded with the same protocol before and after an effect is switched on, with
other noise, another start and a delay that is no multiple of a sample. Each change is diagnosed
with a network that was fitted as usual and with one that was deformed on purpose until it is off by
several times what changes; the paired difference (`diagnose --before`) stands beside the residual
of the model (`--paired never`).

    python -m benchmarks.before_after --robots 201 -o docs/results/before_after.md
"""

import argparse
import datetime
import itertools
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.diagnosis.cases import KNOWN, UNKNOWN
from benchmarks.diagnosis.robots import base_model, bent
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.pairs import Paired
from surgisoft.measurement.protocols import Protocol, make_protocol
from surgisoft.measurement.recordings import Recording
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.model import ArmModel

SAMPLES = 3600
"""Samples of a recording: three minutes at 20 Hz."""
POOR_MM = 2.0
"""Validated error to which a network is deformed, mm."""
PROTOCOL = "mixed"
"""Protocol before and after."""
LATE_S = 3.27
"""Time by which the protocol begins later in BEFORE, s: 65.4 samples."""
CUT = 40
"""First samples of AFTER that are missing: its recording began late."""
BEFORE_TAKE, AGAIN_TAKE, AFTER_TAKE = 10, 11, 20
"""Numbers of the trials, which determine the noise."""


@dataclass(frozen=True)
class Change:
    """One change of one robot and how it is diagnosed."""

    robot: int
    """Seed of the robot."""
    hidden: tuple[tuple[str, float], ...]
    """Effects that are switched on, with their amplitudes."""
    poor: bool
    """Whether the network was deformed."""
    repeats: int
    """Recordings of BEFORE: 1, or 2 that show its repeatability."""
    paired: Paired
    """`auto`: paired difference; `never`: residual of the model."""

    @property
    def truth(self) -> tuple[str, ...]:
        """Names that are right; `unknown` for an effect outside the list."""
        return tuple(KNOWN.get(name, "unknown") for name, _ in self.hidden)


@dataclass(frozen=True)
class Outcome:
    """Result of one diagnosis."""

    change: Change
    kind: str
    effects: tuple[str, ...]
    ranking: tuple[str, ...]
    confidence: float
    change_mm: float
    """RMS change that was measured (or residual), mm."""
    validated_mm: float
    """Validated error of the network, mm."""
    paired_share: float
    delay_error_s: float
    """Error of the delay that was found, s."""
    seconds: float
    statistics: dict

    @property
    def first(self) -> bool:
        """Whether a right effect is ranked first."""
        return bool(self.ranking) and self.ranking[0] in self.change.truth

    @property
    def named(self) -> bool:
        """Whether the verdict names a right effect alone or in a set of at most two."""
        return bool(set(self.effects) & set(self.change.truth)) and len(self.effects) <= 2


def late(protocol: Protocol, seconds: float) -> Protocol:
    """The protocol with its first command held for some seconds before it begins."""
    first = np.flatnonzero(np.diff(protocol.run, prepend=protocol.run[0] - 1))
    commands = np.insert(protocol.commands, first, protocol.commands[first], axis=0)
    run = np.insert(protocol.run, first, protocol.run[first])
    later = np.insert(protocol.t_s + seconds, first, 0.0)
    return replace(protocol, commands=commands, run=run, t_s=later)


def cut(recording: Recording, samples: int) -> Recording:
    """The recording without its first samples; its time begins at 0."""

    def rest(values):
        return None if values is None else values[samples:]

    return replace(
        recording,
        t_s=recording.t_s[samples:] - recording.t_s[samples],
        measured=recording.measured[samples:],
        key_points_mm=recording.key_points_mm[samples:],
        commanded=rest(recording.commanded),
        run=rest(recording.run),
        temp_C=rest(recording.temp_C),
        payload_g=rest(recording.payload_g),
    )


def record(robot: int, hidden, take: int, late_s: float = 0.0) -> Recording:
    """A recording of the protocol on a robot with some effects switched on."""
    rig = VirtualRig(robot, take=take, hidden=hidden)
    plan = make_protocol(PROTOCOL, rig.limits, SAMPLES, seed=robot)
    recording, _ = rig.record(late(plan, late_s) if late_s else plan)
    return recording


def changes(robots: Iterable[int], names: Iterable[str]) -> list[Change]:
    """Nothing at all, and each of some effects: those of the list at amplitude 1, others at 2."""
    hidden = [(), *(((name, 1.0 if name in KNOWN else 2.0),) for name in names)]
    answer = []
    for number, (robot, some) in enumerate(itertools.product(robots, hidden)):
        for poor, paired in itertools.product((True, False), ("auto", "never")):
            answer.append(Change(robot, some, poor, 1 + number % 2, paired))
    return answer


def run_change(change: Change, model: ArmModel, before: list[Recording], after: Recording):
    """Diagnose one change."""
    begin = time.process_time()
    some = before[: change.repeats]
    found = diagnose(model, [after], before=some, paired=change.paired, setup_tests=False)
    stretches = [] if found.change is None else found.change.stretches
    first = [each for each in stretches if (each.after_run, each.before_run) == (0, 0)]
    expected = LATE_S + after_start()
    return Outcome(
        change=change,
        kind=found.verdict.kind,
        effects=found.verdict.effects,
        ranking=tuple(row.effect for row in found.ranking),
        confidence=found.ranking[0].confidence if found.ranking else 0.0,
        change_mm=found.error_mm.before,
        validated_mm=model.validation.rmse_mm,
        paired_share=0.0 if found.change is None else found.change.paired_share,
        delay_error_s=first[0].delay_s - expected if first else float("nan"),
        seconds=time.process_time() - begin,
        statistics=found.statistics.to_json(),
    )


def after_start() -> float:
    """Time of AFTER's first row since its protocol began, s."""
    return CUT / 20.0


def run(plan: Iterable[Change], folder: Path, report=print) -> list[Outcome]:
    """Diagnose every change; base models are kept in the folder."""
    outcomes = []
    for robot, some in itertools.groupby(plan, key=lambda change: change.robot):
        fitted = base_model(robot, folder)
        models = {False: fitted, True: bent(fitted, robot, POOR_MM, robot)}
        before = [record(robot, (), take, LATE_S) for take in (BEFORE_TAKE, AGAIN_TAKE)]
        before = [replace(each, name=f"before{i}") for i, each in enumerate(before)]
        for hidden, same in itertools.groupby(some, key=lambda change: change.hidden):
            after = cut(record(robot, hidden, AFTER_TAKE), CUT)
            for change in same:
                done = run_change(change, models[change.poor], before, after)
                outcomes.append(done)
                report(
                    f"{robot} {hidden} {'poor' if change.poor else 'good'} {change.paired} "
                    f"{change.repeats}: {done.kind} {done.effects} {done.ranking[:2]} "
                    f"{done.confidence:.2f} {done.change_mm:.2f} mm, delay off by "
                    f"{1e3 * done.delay_error_s:.1f} ms, {done.seconds:.1f} s"
                )
    return outcomes


def table(outcomes: list[Outcome]) -> str:
    """The results as Markdown."""
    header = (
        "| network | explained | right effect first | named, alone or in a set of two | "
        "confidence >= .8 and wrong | unknown called unknown | nothing changed: named |\n"
        "|---|---|---|---|---|---|---|"
    )
    rows = []
    for poor, paired in itertools.product((False, True), ("auto", "never")):
        own = [o for o in outcomes if (o.change.poor, o.change.paired) == (poor, paired)]
        known = [o for o in own if o.change.hidden and o.change.truth[0] != "unknown"]
        unknown = [o for o in own if o.change.truth[:1] == ("unknown",)]
        clean = [o for o in own if not o.change.hidden]
        wrong = [
            o
            for o in own
            if o.effects and o.confidence >= 0.8 and not set(o.effects[:1]) & set(o.change.truth)
        ]
        validated = np.mean([o.validated_mm for o in own])
        cells = (
            f"{'deformed' if poor else 'fitted'} (error {validated:.2f} mm)",
            "paired difference" if paired == "auto" else "residual of the model",
            share(o.first for o in known),
            share(o.named for o in known),
            f"{len(wrong)} of {sum(bool(o.effects) for o in own)}",
            share(o.kind == "unknown_effect" for o in unknown),
            share(bool(o.effects) for o in clean),
        )
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join([header, *rows])


def cases(outcomes: list[Outcome]) -> str:
    """Every change with its four results, as Markdown."""
    keys = [(True, "auto"), (True, "never"), (False, "auto"), (False, "never")]
    lines = [
        "| robot | changed | change | deformed, paired | deformed, model | fitted, paired | "
        "fitted, model |\n|---|---|---|---|---|---|---|"
    ]
    for (robot, hidden), some in itertools.groupby(
        outcomes, key=lambda o: (o.change.robot, o.change.hidden)
    ):
        found = {(o.change.poor, o.change.paired): o for o in some}
        size = min(o.change_mm for o in found.values())
        names = ", ".join(name for name, _ in hidden) or "nothing"
        cells = [
            f"{found[key].kind}: {', '.join(found[key].effects) or '-'}"
            + (f" ({found[key].confidence:.2f})" if found[key].effects else "")
            for key in keys
        ]
        lines.append(f"| {robot} | {names} | {size:.2f} mm | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def page(outcomes: list[Outcome], arguments: str) -> str:
    """The page of results."""
    pairs = [o for o in outcomes if o.change.paired == "auto"]
    delay = max(abs(o.delay_error_s) for o in pairs)
    rows = min(o.paired_share for o in pairs)
    return (
        "# Before and after\n\n"
        f"Printed by `python -m benchmarks.before_after {arguments}` on "
        f"{datetime.date.today().isoformat()}.\n\n"
        "Virtual robots were recorded with the same protocol (three minutes, `mixed`) before and "
        "after one effect was switched on, with other noise; in BEFORE the protocol began "
        f"{LATE_S} s late, and of AFTER the first {CUT / 20:g} s are missing. The deformed network "
        "is the fitted one with noise on its weights. Paired: `--before BEFORE`; model: the same "
        "with `--paired never`.\n\n"
        f"{table(outcomes)}\n\n"
        f"At least {100 * rows:.0f} % of the rows were paired; delays were off by at most "
        f"{1e3 * delay:.1f} ms, at a sampling time of 50 ms.\n\n"
        f"{cases(outcomes)}\n"
    )


def share(truths: Iterable[bool]) -> str:
    """How many of how many."""
    truths = list(truths)
    return f"{sum(truths)} of {len(truths)}"


def main() -> None:
    """Print the table; write it to a file where one is named."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", default="201", help="seeds of the robots, with commas")
    parser.add_argument(
        "--effects", default=",".join([*KNOWN, *UNKNOWN]), help="hidden effects, with commas"
    )
    parser.add_argument("--work", type=Path, default=Path("runs/benchmark-before-after"))
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    robots = [int(seed) for seed in given.robots.split(",")]
    outcomes = run(changes(robots, given.effects.split(",")), given.work)
    text = page(outcomes, f"--robots {given.robots} --effects {given.effects}")
    print(text)
    if given.output:
        given.output.write_text(text)


if __name__ == "__main__":
    main()
