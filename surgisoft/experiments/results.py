"""Results of an experiment: tables of episodes and settings, logs of the first and the worst."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from surgisoft.agents.evaluate import Summary, summary
from surgisoft.experiments.run import Failure, failures, log_file
from surgisoft.experiments.spec import Experiment
from surgisoft.files import write_atomically, write_json
from surgisoft.tasks.episodes.file import load_episode
from surgisoft.tasks.episodes.log import EpisodeLog
from surgisoft.tasks.supervision import Row

TEXTS = ("setting", "case", "lesion", "outcome")
"""Columns of a row that hold text."""


@dataclass(frozen=True, eq=False)
class SettingResult:
    """Results of one setting: its episodes and their summary."""

    label: str
    """The setting's label, see `Setting.label`."""
    case: str
    """Name of the case."""
    values: dict[str, float | int | str | None]
    """Varied fields and their values, the lesion among them; None for what varies on a rig only."""
    rows: list[Row]
    """Results of the episodes, in order."""
    overall: dict[str, Summary]
    """Name of a number of the episodes -> its summary over all of them."""
    outcomes: dict[str, int]
    """How episodes ended -> number of episodes, the most frequent first."""
    worst: int
    """Number of the worst episode."""


@dataclass(frozen=True, eq=False)
class Results:
    """All results of an experiment."""

    experiment: Experiment
    """The experiment as its file describes it."""
    folder: Path
    """Folder of the results."""
    settings: list[SettingResult]
    """Results of every setting, in order, without those with a failure."""
    failed: list[Failure] = field(default_factory=list)
    """Blocks that an exception ended."""

    @property
    def rows(self) -> list[Row]:
        """Results of every episode of every setting."""
        return [row for setting in self.settings for row in setting.rows]

    @property
    def worst(self) -> tuple[str, int]:
        """Label and number of the worst episode of all."""
        row = max(self.rows, key=self.experiment.of.experiment.badness)
        return row["setting"], row["episode"]

    def log(self, label: str, episode: int) -> EpisodeLog:
        """Log of a stored episode: the first and the worst of each setting."""
        return load_episode(log_file(self.folder, label, episode))


def sum_up(spec: Experiment, folder: Path, rows: list[Row]) -> Results:
    """Summarise the rows of all episodes."""
    varied = ["lesion", *(vary.field for vary in spec.vary)]
    found = []
    for label in dict.fromkeys(row["setting"] for row in rows):
        episodes = [row for row in rows if row["setting"] == label]
        numbers = [n for n in episodes[0] if n not in (*TEXTS, *varied, "episode")]
        overall = {
            name: summary(name, _numbers([row[name] for row in episodes])) for name in numbers
        }
        values = {name: episodes[0][name] for name in varied if name in episodes[0]}
        outcomes = dict(Counter(row["outcome"] for row in episodes).most_common())
        worst = max(episodes, key=spec.of.experiment.badness)["episode"]
        found.append(
            SettingResult(label, episodes[0]["case"], values, episodes, overall, outcomes, worst)
        )
    return Results(spec, folder, found, failures(spec, folder))


def write_tables(results: Results) -> list[Path]:
    """`episodes.csv`, `episodes.parquet` and `summary.json`, each whole or not at all."""
    import pyarrow as pa
    from pyarrow import csv, parquet

    rows, folder = results.rows, results.folder
    names = list(dict.fromkeys(name for row in rows for name in row))
    table = pa.table({name: [row.get(name) for row in rows] for name in names})
    files = []
    for name, write in (("episodes.csv", csv.write_csv), ("episodes.parquet", parquet.write_table)):
        buffer = pa.BufferOutputStream()
        write(table, buffer)
        write_atomically(folder / name, buffer.getvalue().to_pybytes())
        files.append(folder / name)
    about = {
        "experiment": results.experiment.name,
        "confidence": 0.95,
        "worst": dict(zip(("setting", "episode"), results.worst, strict=True)),
        "settings": {
            setting.label: {
                "case": setting.case,
                "values": setting.values,
                "episodes": len(setting.rows),
                "outcomes": setting.outcomes,
                "overall": {name: asdict(v) for name, v in setting.overall.items()},
            }
            for setting in results.settings
        },
    }
    path = folder / "summary.json"
    write_json(path, about)
    return [*files, path]


def drop_logs(results: Results) -> None:
    """Remove the logs of blocks' worst episodes that are not their setting's.

    A setting with a failure keeps its logs for the run that continues it.
    """
    for setting in results.settings:
        for row in setting.rows:
            if row["episode"] not in (0, setting.worst):
                log_file(results.folder, setting.label, row["episode"]).unlink(missing_ok=True)


def _numbers(values: list) -> np.ndarray:
    return np.array([math.nan if value is None else value for value in values], dtype=float)
