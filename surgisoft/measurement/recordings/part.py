"""A part of a recording: the rows between two times."""

from dataclasses import fields, replace
from typing import Any

import numpy as np

from surgisoft.errors import InputError
from surgisoft.measurement.recordings.recording import Recording
from surgisoft.time_axis import continued


def part_of(
    recording: Recording, begin_s: float | None = None, end_s: float | None = None
) -> Recording:
    """The rows from `begin_s` on and before `end_s`; None: from the first row, or up to the last.

    Times are those of charts, checks and diagnoses: s since the first row, and a run whose clock
    starts again continues one step after the run before it (`surgisoft.time_axis.continued`). The
    rows keep their own times and runs. An alarm is kept where its row is.

    Raises InputError where a time is negative or no number, or where no row lies between the two.
    """
    time_s = continued(recording.t_s)
    begin = 0.0 if begin_s is None else begin_s
    end = np.inf if end_s is None else end_s
    for what, value in (("begins at", begin), ("ends at", end)):
        if not value >= 0.0:
            raise InputError(f"the part of {recording.label} {what} {value:g} s, expected >= 0")
    inside = (time_s >= begin) & (time_s < end)
    if not inside.any():
        raise InputError(
            f"{recording.label}: no row from {begin:g} s on and before {end:g} s, expected some of "
            f"the {recording.samples} rows, which last from 0 to {time_s[-1]:.6g} s"
        )
    alarm = recording.alarm
    if alarm is not None:
        kept = recording.t_s[inside]
        alarm = alarm if kept[0] <= alarm.raised_s <= kept[-1] else None
    rows: dict[str, Any] = {
        each.name: value[inside]
        for each in fields(recording)
        if isinstance(value := getattr(recording, each.name), np.ndarray) and each.name != "gravity"
    }
    return replace(recording, **rows, alarm=alarm)
