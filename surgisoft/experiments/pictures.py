"""The report's pictures as files of their own."""

from __future__ import annotations

from pathlib import Path

from surgisoft.agents.report_charts import episode_charts
from surgisoft.experiments.results import Results
from surgisoft.report import Picture
from surgisoft.toml_config import write_atomically


def write_pictures(results: Results, films: dict[tuple[str, int], Picture]) -> list[Path]:
    """`pictures/SETTING-EPISODE-WHAT.svg` (charts) and `.png` (endoscope) of episodes shown."""
    folder, files = results.folder / "pictures", []
    folder.mkdir(exist_ok=True)
    for (label, episode), film in films.items():
        named = [("endoscope.png", film)]
        for picture in episode_charts(results.log(label, episode)):
            named.append((f"{picture.alt.replace(' ', '-')}.svg", picture))
        for name, picture in named:
            path = folder / f"{label}-{episode:04d}-{name}"
            write_atomically(path, picture.data)
            files.append(path)
    return files
