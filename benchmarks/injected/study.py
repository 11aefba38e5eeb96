"""Diagnoses of case folders: one model for each robot, one answer for each case.

FOLDER/robots/ROBOT/before/*.parquet  recordings of the unchanged robot
FOLDER/robots/ROBOT/model/            the model that was fitted to them; made where it is absent
FOLDER/cases/CASE/after/*.parquet     recordings after the change
FOLDER/cases/CASE/truth.json          what changed, and the name of the robot
"""

import json
from collections.abc import Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from benchmarks.cache import Cache
from benchmarks.injected.laws import UNKNOWN
from benchmarks.real.entries import FitOptions
from benchmarks.real.study import (
    CLAIMED,
    CLAIMING,
    NAMING,
    Answer,
    asked,
    fitted,
    misleads,
    right,
)
from surgisoft.errors import InputError
from surgisoft.files import json_safe
from surgisoft.measurement.recordings import load_recordings
from surgisoft.progress import Progress, silent
from surgisoft.surrogate.checkpoint import load_model
from surgisoft.workers import workers

SURE = 0.95
"""Confidence from which a statement counts as sure (goal: 97 % of these are right)."""


@dataclass(frozen=True)
class CaseFolder:
    """One case on the disk."""

    place: Path
    """Its folder."""
    robot: Path
    """Folder of its robot."""
    truth: tuple[str, ...]
    """Effects that are missing; `unknown`, or none: nothing changed."""
    hidden: tuple[str, ...]
    """Names of the injected effects."""
    size: float
    """RMS change over the validated error that the change was scaled by."""
    left_out: tuple[str, ...] = ()
    """Missing effects that are no candidates: the truth is `unknown` then."""

    @property
    def without_truth(self) -> "CaseFolder | None":
        """The case without its truth among the candidates; None where none is in the list."""
        if not self.truth or UNKNOWN in self.truth:
            return None
        return replace(self, truth=(UNKNOWN,), left_out=self.truth)


@dataclass(frozen=True)
class Judged:
    """One case and the diagnosis of it."""

    case: CaseFolder
    """The case."""
    answer: Answer
    """What the diagnosis said."""


def find_cases(folder: Path) -> list[CaseFolder]:
    """All cases below a folder, in order of their names."""
    found = []
    for file in sorted((folder / "cases").glob("*/truth.json")):
        try:
            about = json.loads(file.read_text())
            truth, name = tuple(about["truth"]), str(about["robot"])
            hidden = tuple(str(each["effect"]) for each in about["hidden"])
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{file}: not the truth of a case ({error!r})") from None
        robot = folder / "robots" / name
        if not (robot / "before").is_dir():
            raise InputError(f"{file}: robot '{name}', expected recordings in {robot / 'before'}")
        size = float(about.get("size", 0.0))
        found.append(CaseFolder(file.parent, robot, truth, hidden, size))
    if not found:
        raise InputError(f"{folder}: no cases/*/truth.json in this folder, expected cases")
    return found


def model_of(robot: Path) -> Path:
    """Folder of the robot's model, which is fitted to the recordings before where it is absent."""
    place = robot / "model"
    if not (place / "config.json").is_file():
        before = load_recordings(robot / "before", lambda text: None)
        cache = Cache(robot / "fits")
        fitted(before, FitOptions(), "measured", cache, silent)
        (made,) = cache.folder.glob("model-*")
        made.rename(place)
    return place


def judge(case: CaseFolder) -> Judged:
    """The diagnosis of one case, with its robot's recordings from before."""
    model = load_model(case.robot / "model")
    before = load_recordings(case.robot / "before", lambda text: None)
    after = load_recordings(case.place / "after", lambda text: None)
    return Judged(case, asked(model, after, before, case.left_out))


def run(cases: Sequence[CaseFolder], processes: int, report: Progress) -> list[Judged]:
    """The diagnoses of all cases, models first, in order."""
    robots = sorted({case.robot for case in cases})
    total, done = len(robots) + len(cases), 0
    judged: dict[CaseFolder, Judged] = {}
    with workers(processes) as pool:
        for future in as_completed([pool.submit(model_of, robot) for robot in robots]):
            future.result()
            done += 1
            report(done, total, "models")
        for future in as_completed([pool.submit(judge, case) for case in cases]):
            one = future.result()
            judged[one.case] = one
            done += 1
            report(done, total, one.case.place.name)
    return [judged[case] for case in cases]


def markdown(judged: Sequence[Judged]) -> str:
    """Tables of all cases, and counts beside the goals."""
    real = [j for j in judged if not j.case.left_out]
    known = [j for j in real if j.case.truth and UNKNOWN not in j.case.truth]
    single = [j for j in known if len(j.case.truth) == 1]
    pairs = [j for j in known if len(j.case.truth) > 1]
    strange = [j for j in real if UNKNOWN in j.case.truth]
    without = [j for j in judged if j.case.left_out]
    clean = [j for j in judged if not j.case.truth]
    sure = [j for j in real if j.answer.kind in NAMING and j.answer.confidence >= SURE]
    first = [j for j in single if j.answer.ranking[:1] == j.case.truth]
    rows = [
        ("right effect first in the ranking", len(first), len(single), ".95"),
        ("named alone or in a set of two", _right(single), len(single), ".90"),
        ("two effects, both named", _right(pairs), len(pairs), ".85"),
        ("unknown called unknown", _right(strange), len(strange), ".80"),
        ("named where nothing changed", _claiming(clean), len(clean), ".02"),
        (f"confidence >= {SURE} and right", _right(sure), len(sure), ".97"),
        (
            f"wrong name with confidence >= {CLAIMED}",
            sum(misleads(j.answer, j.case.truth) for j in real),
            len(real),
            "0",
        ),
    ]
    if without:
        what, count = "a known effect that is no candidate: ", len(without)
        rows.append((f"{what}called unknown", _right(without), count, ""))
        rows.append((f"{what}another one named", _claiming(without), count, ""))
    lines = ["| | found | goal |", "|---|---|---|"]
    lines += [f"| {what} | {count} of {of} | {goal} |" for what, count, of, goal in rows]
    lines += ["", "| robot | case | size | verdict | names | conf. | right |"]
    lines += ["|---|---|---|---|---|---|---|"]
    for j in judged:
        names = ", ".join(j.answer.names) if j.answer.kind in NAMING else ""
        good = "yes" if right(j.answer, j.case.truth) else "no"
        lines.append(
            f"| {j.case.robot.name} | {_name(j.case)} | {j.case.size:g} | {j.answer.kind} "
            f"| {names} | {j.answer.confidence:.2f} | {good} |"
        )
    return "\n".join(lines) + "\n"


def _name(case: CaseFolder) -> str:
    """Name of a case, with the effects that are no candidates."""
    return case.place.name + (f", without {' and '.join(case.left_out)}" if case.left_out else "")


def _right(some: Sequence[Judged]) -> int:
    return sum(right(j.answer, j.case.truth) for j in some)


def _claiming(some: Sequence[Judged]) -> int:
    return sum(j.answer.kind in CLAIMING for j in some)


def to_json(judged: Sequence[Judged]) -> dict:
    """Plain values of all cases."""
    rows = [
        {
            "robot": j.case.robot.name,
            "case": j.case.place.name,
            "truth": list(j.case.truth),
            "hidden": list(j.case.hidden),
            "size": j.case.size,
            "left_out": list(j.case.left_out),
            **asdict(j.answer),
        }
        for j in judged
    ]
    return json_safe({"cases": rows})
