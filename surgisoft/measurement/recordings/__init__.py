"""Recordings of one arm's measurements: in memory, on disk, and checks of data quality.

The file format is described in docs/recordings.md.
"""

from surgisoft.measurement.recordings.file import (
    after_alarm,
    check_names_differ,
    check_writable,
    given_recordings,
    load_recording,
    load_recordings,
    save_recording,
    save_recordings,
)
from surgisoft.measurement.recordings.part import part_of
from surgisoft.measurement.recordings.predictions import with_predictions
from surgisoft.measurement.recordings.quality import QualityWarning, find_warnings, summary
from surgisoft.measurement.recordings.recording import (
    KINDS,
    AlarmInfo,
    ArmInfo,
    Recording,
    check_rows,
    check_same_arm,
)

__all__ = [
    "KINDS",
    "AlarmInfo",
    "ArmInfo",
    "QualityWarning",
    "Recording",
    "after_alarm",
    "check_names_differ",
    "check_rows",
    "check_same_arm",
    "check_writable",
    "find_warnings",
    "given_recordings",
    "load_recording",
    "load_recordings",
    "part_of",
    "save_recording",
    "save_recordings",
    "summary",
    "with_predictions",
]
