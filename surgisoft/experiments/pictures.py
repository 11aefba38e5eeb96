"""Picture files of an experiment: charts of episodes, and film strips of the endoscope."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from surgisoft.errors import InputError
from surgisoft.files import write_atomically
from surgisoft.report import Picture
from surgisoft.tasks.episodes.log import EpisodeLog

PICTURES = 5
"""Pictures in a strip."""
GAP_PX = 6


def film(log: EpisodeLog, count: int = PICTURES) -> Picture:
    """Film strip of the endoscope's pictures at `count` moments from the first beam to the end.

    The end is the last moment at which all arms are finite, which they are not where they failed.
    """
    from PIL import Image

    from surgisoft.replay.endoscope import jpegs

    if log.camera is None:
        raise InputError("the episode has no endoscope, so it has no pictures")
    on = np.array([], int) if log.burning is None else np.flatnonzero(log.burning)
    finite = np.all([np.isfinite(arm.line_mm).all((1, 2)) for arm in log.arms.values()], axis=0)
    last = int(np.flatnonzero(finite).max(initial=0))
    ends = (int(on[0]), int(on[-1])) if len(on) > 1 else (0, last)
    rows = np.unique(np.append(np.linspace(*ends, count - 1).astype(int), last).clip(max=last))
    frames = [Image.open(io.BytesIO(data)) for data in jpegs(log, next(iter(log.cameras)), rows)]
    side = frames[0].width
    strip = Image.new("RGB", (len(frames) * (side + GAP_PX) - GAP_PX, side), "white")
    for place, frame in enumerate(frames):
        strip.paste(frame, (place * (side + GAP_PX), 0))
    buffer = io.BytesIO()
    strip.save(buffer, "PNG", optimize=True)
    times = ", ".join(f"{log.time_s[row]:.1f}" for row in rows)
    caption = f"What the endoscope saw at {times} s"
    return Picture(buffer.getvalue(), caption, caption, "image/png", 620)


def write_pictures(
    folder: Path,
    charts: Mapping[tuple[str, int], Sequence[Picture]],
    films: dict[tuple[str, int], Picture],
) -> list[Path]:
    """`pictures/SETTING-EPISODE-WHAT.svg` (charts) and `.png` (endoscope) of episodes shown.

    folder: that of the results; charts, films: those of (setting's label, episode).
    """
    place, files = folder / "pictures", []
    place.mkdir(exist_ok=True)
    for (label, episode), drawn in charts.items():
        strip = films.get((label, episode))
        named = [] if strip is None else [("endoscope.png", strip)]
        for picture in drawn:
            named.append((f"{picture.alt.replace(' ', '-')}.svg", picture))
        for name, picture in named:
            path = place / f"{label}-{episode:04d}-{name}"
            write_atomically(path, picture.data)
            files.append(path)
    return files
