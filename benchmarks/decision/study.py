"""The evidence of all sources, collected or stored, and the decision that is fitted to it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.decision import folders, own_rig
from benchmarks.decision.evidence_log import (
    EVIDENCE,
    JUDGED,
    Labelled,
    Models,
    file_of,
    files_of,
    in_order,
    keep,
    read,
    stored,
)
from benchmarks.decision.fit import fit
from surgisoft.errors import InputError
from surgisoft.progress import Progress


@dataclass(frozen=True)
class Collected:
    """What is collected anew; all other sources are those that are stored."""

    own: own_rig.Plan
    """Robots of the own rig."""
    count: int = 0
    """Cases of the own rig; 0: none is collected."""
    seed: int = 1
    """Seed of these cases."""
    sources: Sequence[str] = ()
    """`NAME=FOLDER` of the other sources."""
    judged: Sequence[str] = ()
    """The same, of cases that take no part in any fit."""
    included: Sequence[str] = ()
    """Names of stored sources that otherwise take no part, and are fitted to here."""
    models: Models = "default"
    """Models that are asked."""

    @property
    def command(self) -> str:
        """The command that collects them."""
        words = ["surgisoft benchmark decision"]
        if self.count:
            robots, poor = (
                ",".join(map(str, some)) for some in (self.own.robots, self.own.undertrained)
            )
            words.append(f"--robots {robots} --undertrained {poor}")
            words.append(f"--count {self.count} --seed {self.seed}")
        for option, given in (("--cases", self.sources), ("--judge", self.judged)):
            words += [f"{option} {name}={folder.name}" for name, folder in map(_source, given)]
        words += ["--models alone"] * (self.models == "alone")
        words += [f"--include {name}" for name in self.included]
        return " ".join(words)


def run(
    new: Collected,
    work: Path,
    processes: int,
    report: Progress,
    evidence: Path = EVIDENCE,
    keeps: bool = False,
) -> tuple[list[Labelled], list[Labelled], dict]:
    """(all cases of the fit, those that are judged only, the values of the asset that is fitted).

    work: the evidence of a source that is collected is stored in `work/evidence/FILE.jsonl`
    (`evidence_log.file_of`), that of the own rig with what was there before. evidence: folder of
    the stored evidence. keeps: whether what was collected is stored there, too, in its place.
    """
    logs = work / "evidence"
    every, aside = stored(evidence), stored(evidence / JUDGED)
    if new.count:
        file = file_of(own_rig.SOURCE, new.models)
        log, asked = logs / f"{file}.jsonl", (processes, report, True, new.models)
        own_rig.run(new.own, new.count, new.seed, work / "models", log, *asked)
        every[file] = read(log)  # with those of other seeds
    for target, given, fitted in ((every, new.sources, True), (aside, new.judged, False)):
        for name, folder in map(_source, given):
            file = file_of(name, new.models)
            log, asked = logs / f"{file}.jsonl", (processes, report, fitted, fitted, new.models)
            target[file] = folders.run(name, folder, work / "models", log, *asked)
    for name in new.included:
        files = files_of(name, aside)
        if not files:
            known = ", ".join(sorted({file.partition(".")[0] for file in aside})) or "none"
            raise InputError(f"--include {name}: expected a source that is only judged: {known}")
        every |= {file: aside.pop(file) for file in files}
    if not every:
        raise InputError(f"{evidence}: no stored evidence; give --count or --cases")
    if keeps:
        for target, folder in ((every, evidence), (aside, evidence / JUDGED)):
            for name, some in target.items():
                keep(folder, name, some)
    fitted_to, judged = (_ordered(some) for some in (every, aside))
    return fitted_to, judged, fit(fitted_to, new.command)


def _ordered(sources: dict[str, list[Labelled]]) -> list[Labelled]:
    """All cases as they are stored, in an order that does not depend on how they were collected."""
    return in_order([Labelled.from_json(o.to_json()) for own in sources.values() for o in own])


def _source(given: str) -> tuple[str, Path]:
    """(name, folder) of `NAME=FOLDER`."""
    name, _, folder = given.partition("=")
    if not folder or not Path(folder).is_dir():
        raise InputError(f"{given}: expected NAME=FOLDER with an existing folder")
    return name, Path(folder)
