"""Cases of the project's own virtual rig for the fit of the decision.

Robots, hidden effects, schedules and noise are those of the benchmark `diagnosis`; robots from
number 200 on, which took no part in anything that was set by hand. Beside its cases there are short
recordings, and models that are asked about another robot than their own.
"""

import time
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.decision.evidence_log import (
    PRIOR,
    Label,
    Labelled,
    Models,
    append,
    is_stored,
    posed_on,
    read,
    with_twins,
    without_truth,
)
from benchmarks.diagnosis.cases import EXCITATIONS, KNOWN, MEMORY, PAIRS, UNKNOWN, Case
from benchmarks.diagnosis.robots import base_model, bent, record, validation_of
from surgisoft.progress import Progress
from surgisoft.workers import workers

SOURCE = "own_rig"
STRENGTHS = (0.6, 1.0, 1.5, 2.0)
"""Amplitudes of hidden effects, relative to those of the rig."""
PAIR_STRENGTHS = (0.9, 1.2, 1.5)
"""Amplitudes of each of two hidden effects."""
EXCITATION_SHARES = {"short": 0.15, "poor": 0.2, "medium": 0.35, "rich": 0.3}
"""How often each schedule is drawn."""
ROUND = (
    *("single",) * 9,
    *("pair",) * 3,
    *("unknown",) * 3,
    *("clean",) * 3,
    "undertrained",
    "other_robot",
)
"""Kinds of case in each round of twenty: any number of rounds has the same shares."""
FIRST_TAKE = 700_000
"""Number of the first trial; those of the benchmark `diagnosis` are below."""


@dataclass(frozen=True)
class Plan:
    """The robots that cases are drawn on."""

    robots: list[int]
    """Seeds of the robots."""
    undertrained: list[int]
    """Seeds of those that also have an undertrained model."""


def draw(plan: Plan, count: int, seed: int) -> list[tuple[Case, int]]:
    """(case, robot whose model is asked) of so many cases."""
    rng = np.random.default_rng([seed, FIRST_TAKE])
    every = {
        "single": [(name,) for name in KNOWN],
        "pair": list(PAIRS),
        "unknown": [(name,) for name in UNKNOWN],
    }
    queues: dict[str, list] = {name: [] for name in every}
    answer = []
    for number in range(count):
        kind = ROUND[(7 * number) % len(ROUND)]
        hidden: tuple = ()
        if kind in every:
            if not queues[kind]:
                queues[kind] = [every[kind][i] for i in rng.permutation(len(every[kind]))]
            strengths = PAIR_STRENGTHS if kind == "pair" else STRENGTHS
            hidden = tuple((name, float(rng.choice(strengths))) for name in queues[kind].pop())
        poor = kind == "undertrained"
        robot = int(rng.choice(plan.undertrained if poor else plan.robots))
        case = Case(
            robot=robot,
            hidden=hidden,
            discrepancy_mm=float(rng.choice([0.0, 0.0, 0.25, 0.4])),
            noise=str(rng.choice(["white", "white", "loud", "correlated"])),
            excitation=str(rng.choice(list(EXCITATION_SHARES), p=list(EXCITATION_SHARES.values()))),
            take=FIRST_TAKE + 10_000 * seed + number,
            undertrained=poor,
        )
        others = [one for one in plan.robots if one != robot]
        asked = int(rng.choice(others)) if kind == "other_robot" else robot
        answer.append((case, asked))
    return answer


def name_of(case: Case, asked: int) -> str:
    """Name of a case: robot, trial and what is hidden."""
    hidden = "+".join(f"{name}*{strength:g}" for name, strength in case.hidden) or "none"
    return f"{case.robot}/{case.take}/{hidden}/{case.excitation}/model-{asked}"


def run_case(
    case: Case, asked: int, folder: Path, twin: bool = False, models: Models = "default"
) -> list[Labelled]:
    """Record, deform the surrogate, and collect the evidence.

    twin: also without the truth among the candidates; models: those that are asked.
    """
    torch.set_num_threads(1)
    recorded = record(case)
    model = base_model(asked, folder, case.undertrained, PRIOR[models])
    if case.discrepancy_mm > model.validation.rmse_mm:
        model = bent(model, asked, case.discrepancy_mm, case.take)
    known = model.residuals_on([validation_of(asked)])
    begin = time.process_time()
    posed = posed_on(model, [recorded.recording], known)
    evidence = posed.evidence()
    seconds = time.process_time() - begin
    label: Label = "network" if case.undertrained else "clean"
    if asked != case.robot:
        label = "other_robot"
    elif case.hidden:
        label = "unknown" if "unknown" in case.truth else "known"
    names = tuple(name for name, _ in case.hidden)
    one = Labelled(
        source=SOURCE,
        robot=str(case.robot),
        case=name_of(case, asked),
        label=label,
        truth=names if label == "unknown" else tuple(KNOWN[name] for name in names),
        memory=bool(names) and all(KNOWN.get(name) in MEMORY for name in names),
        effect_mm=recorded.effect_mm if names else 0.0,
        validated_mm=model.validation.rmse_mm,
        minutes=EXCITATIONS[case.excitation][1] / 1200.0,
        evidence=evidence,
        seconds=seconds,
        models=models,
    )
    left_out = without_truth(one, posed) if twin else None
    return [one] if left_out is None else [one, left_out]


def run(
    plan: Plan,
    count: int,
    seed: int,
    folder: Path,
    log: Path,
    processes: int,
    report: Progress,
    twins: bool = False,
    models: Models = "default",
) -> list[Labelled]:
    """Collect the evidence of so many cases; those that the log has are not repeated.

    twins: whether every case of a known effect gives one more, without its truth among the
    candidates; models: those that are asked.
    """
    done = {one.case: one for one in read(log)}
    drawn = draw(plan, count, seed)
    missing = [pair for pair in drawn if not is_stored(done, name_of(*pair), twins)]
    with workers(processes) as pool:
        jobs = [pool.submit(run_case, *pair, folder, twins, models) for pair in missing]
        for number, job in enumerate(as_completed(jobs)):
            some = job.result()
            append(log, *some)
            done |= {one.case: one for one in some}
            report(number + 1, len(missing), f"{len(done)} cases")
    return with_twins(done, [name_of(*pair) for pair in drawn], twins)
