"""What happened in an episode, read off its log."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from surgisoft.tasks.episode_parts import Event

if TYPE_CHECKING:
    from surgisoft.tasks.episode import EpisodeLog


def find_events(log: EpisodeLog, ending: str = "") -> tuple[Event, ...]:
    """Beam on and off, lesion in and out of sight, too close, contact, cut, and the end.

    `ending` is how the recorder saw it end: `ended` by the task, `time out`, `failed`, or "" where
    it was still running.
    """
    found: list[Event] = []
    found.append(Event(0.0, "info", f"{log.task} by {log.driver} in {log.on}, seed {log.seed}"))
    if log.beam is not None:
        found += _changes(log, log.beam.on, ("info", "beam on"), ("info", "beam off"))
    if log.view_fraction is not None:
        seen = log.view_fraction >= log.limits["view_fraction"]
        found += _changes(log, seen, ("info", "lesion in sight"), ("warning", "lesion lost"))
    if log.clearance_mm is not None:
        if "clearance_mm" in log.limits:
            least = log.limits["clearance_mm"]
            close = ("warning", f"closer than {least:g} mm"), ("info", f"{least:g} mm clear again")
            found += _changes(log, log.clearance_mm < least, *close)
        found += _changes(
            log, log.clearance_mm < 0.0, ("error", "contact"), ("info", "contact ended")
        )
    collided = log.measures.get("collided")
    if collided is not None and log.clearance_mm is not None:
        folded = (collided > 0.0) & ~(log.clearance_mm < 0.0)
        found += _changes(log, folded, ("error", "an arm touches itself"), ("info", "arm unfolded"))
    completion = log.measures.get("completion")
    if completion is not None and len(whole := np.flatnonzero(completion >= 1.0)):
        found.append(Event(float(log.time_s[whole[0]]), "info", "ring cut all around"))
    if ending:
        found.append(Event(float(log.time_s[-1]), *_end(log, ending)))
    return tuple(sorted(found, key=lambda event: event.time_s))


def _changes(
    log: EpisodeLog, holds: np.ndarray, begins: tuple[str, str], ends: tuple[str, str]
) -> list[Event]:
    """An event wherever (T,) bool `holds` changes; not holding at the start is no event."""
    before = np.concatenate(([False], holds[:-1]))
    return [
        Event(float(log.time_s[row]), *(begins if holds[row] else ends))
        for row in np.flatnonzero(holds != before)
    ]


def _end(log: EpisodeLog, ending: str) -> tuple[str, str]:
    """Level and text of the episode's end."""
    if ending == "failed":
        return "error", "an arm is no longer finite"
    success = log.measures.get("success")
    if success is None or success[-1] > 0.0:
        return "info", "done"
    return ("warning", "the time is out") if ending == "time out" else ("error", "ended early")
