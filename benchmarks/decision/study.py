"""Collect the evidence of all sources and fit the decision to it."""

from collections.abc import Sequence
from pathlib import Path

from benchmarks.decision import folders, own_rig
from benchmarks.decision.evidence_log import Labelled, read
from benchmarks.decision.fit import fit
from surgisoft.errors import InputError
from surgisoft.progress import Progress


def run(
    plan: own_rig.Plan,
    count: int,
    seed: int,
    sources: list[str],
    work: Path,
    processes: int,
    report: Progress,
    judged: Sequence[str] = (),
    twins: bool = False,
) -> tuple[list[Labelled], list[Labelled], dict]:
    """(all cases of the fit, those that are judged only, the values of the asset that is fitted).

    sources: `NAME=FOLDER`; the evidence of each is stored in `work/evidence/NAME.jsonl`. judged:
    the same, of cases that take no part in any fit. twins: whether every case of a known effect
    also takes part without its truth among the candidates, as one of an unknown effect.
    """
    logs = work / "evidence"
    command = "surgisoft benchmark decision"
    own = logs / f"{own_rig.SOURCE}.jsonl"
    if count:
        robots, poor = (",".join(map(str, some)) for some in (plan.robots, plan.undertrained))
        command += f" --robots {robots} --undertrained {poor} --count {count} --seed {seed}"
        some = own_rig.run(plan, count, seed, work / "models", own, processes, report, twins)
    else:
        some = [one for one in read(own) if twins or not one.left_out]
    for given in sources:
        name, folder = _source("--cases", given)
        log = logs / f"{name}.jsonl"
        some += folders.run(name, folder, work / "models", log, processes, report, True, twins)
        command += f" --cases {name}={folder.name}"
    if twins:
        command += " --without-truth"
    aside: list[Labelled] = []
    for given in judged:
        name, folder = _source("--judge", given)
        log = logs / f"{name}.jsonl"
        aside += folders.run(name, folder, work / "models", log, processes, report, off=False)
        command += f" --judge {name}={folder.name}"
    if not some:
        raise InputError(f"{logs}: no stored cases; give --count or --cases")
    return some, aside, fit(some, command)


def _source(option: str, given: str) -> tuple[str, Path]:
    """(name, folder) of `NAME=FOLDER`."""
    name, _, folder = given.partition("=")
    if not folder or not Path(folder).is_dir():
        raise InputError(f"{option} {given}: expected NAME=FOLDER with an existing folder")
    return name, Path(folder)
