"""The samples of a run, in memory and in a log that grows while the run lasts.

A power cut loses less than the last second (`surgisoft.measurement.recordings.log`); `finish`
replaces the log by the recording in its final form.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import numpy as np

from surgisoft.errors import InputError
from surgisoft.measurement.recordings import (
    AlarmInfo,
    Recording,
    after_alarm,
    check_writable,
    save_recording,
)
from surgisoft.measurement.recordings.log import LogHeader, RecordingLog, recording_log
from surgisoft.measurement.recordings.recording import usable_samples
from surgisoft.measurement.recordings.sidecar import sidecar_of
from surgisoft.rig.interface import Rig, Sample


class RunLog:
    """Samples of a rig, kept in memory and written to `NAME.log.jsonl` as they come."""

    def __init__(self, rig: Rig, path: str | Path | None, force: bool = False, note: str = ""):
        """path: the recording that the log becomes (.parquet or .csv); None: in memory only.

        Raises InputError where the recording, its part after an alarm or the log of an interrupted
        one is there, unless `force` is set.
        """
        self.rig, self.path, self.force, self.note = rig, None, force, note
        self.samples: list[Sample] = []
        self.runs: list[int] = []
        self._kept: tuple[tuple[Sample, int], ...] = ()
        self._writer: RecordingLog | None = None
        self._open = ExitStack()
        if path is None:
            return
        self.path = Path(path)
        check_writable(self.path, force)
        check_writable(after_alarm(self.path), force)
        self.growing = self.path.with_name(f"{self.path.stem}.log.jsonl")
        gravity = None if rig.gravity is None else np.asarray(rig.gravity).tolist()
        header = LogHeader(
            self.path.stem,
            "continuous",
            rig.unit,
            rig.chambers,
            rig.key_planes,
            rig.arm,
            gravity,
            rig.payload_g,
            note,
        )
        self._writer = self._open.enter_context(recording_log(self.growing, header, force))

    def write(self, sample: Sample, run: int) -> bool:
        """Append a sample of a run; whether a recording can have it (`usable`)."""
        self.samples.append(sample)
        self.runs.append(run)
        if self._writer is not None:
            self._writer.sample(
                len(self.samples) - 1,
                run,
                sample.t_s - self.samples[0].t_s,
                sample.measured,
                sample.key_points_mm,
                sample.commanded,
                sample.temp_C,
            )
        usable = bool(_usable([*self._kept, (sample, run)])[-1])
        if usable:
            self._kept = ((sample, run),)
        return usable

    @property
    def usable(self) -> np.ndarray:
        """(T,) bool: the samples so far that a recording can have."""
        return _usable(list(zip(self.samples, self.runs, strict=False)))

    def recording(self, name: str, alarm: AlarmInfo | None = None) -> Recording:
        """The samples so far as a recording; alarm: the first one of the run.

        Samples that it cannot have (`usable_samples`) are left out. Raises InputError where none
        is left.
        """
        rig, usable = self.rig, self.usable
        if not usable.any():
            raise InputError(
                "no sample of the run has every pressure, so there is no recording; are the "
                "sensors connected?"
            )
        samples = [sample for sample, kept in zip(self.samples, usable, strict=False) if kept]
        room = [sample.temp_C for sample in samples]
        payload = rig.payload_g
        return Recording(
            name=name,
            t_s=np.array([sample.t_s for sample in samples]) - samples[0].t_s,
            measured=np.array([sample.measured for sample in samples]),
            key_points_mm=np.array([sample.key_points_mm for sample in samples]),
            commanded=np.array([sample.commanded for sample in samples]),
            run=np.array(self.runs[: len(usable)], np.int64)[usable],
            unit=rig.unit,
            temp_C=None if None in room else np.array(room, np.float64),
            payload_g=None if payload is None else np.full(len(samples), payload),
            arm=rig.arm,
            gravity=rig.gravity,
            kind="continuous",
            note=self.note,
            alarm=alarm,
        )

    def finish(self, name: str, alarm: AlarmInfo | None = None) -> Recording | None:
        """The recording, written in its final form; None without a sample. See `recording`.

        Where it raises InputError the log stays.
        """
        self.close()
        found = self.recording(name, alarm) if self.samples else None
        if found is not None and self.path is not None:
            save_recording(found, self.path, self.force)
        self.discard()
        return found

    def without_alarm(self) -> None:
        """Remove what came after the alarm of an earlier run that this one has replaced."""
        if self.path is not None and self.force:
            after = after_alarm(self.path)
            for place in (after, sidecar_of(after)):
                place.unlink(missing_ok=True)

    def close(self) -> None:
        """Hand all rows to the disk."""
        self._open.close()

    def discard(self) -> None:
        """Remove the growing file."""
        self.close()
        if self.path is not None:
            self.growing.unlink(missing_ok=True)


def _usable(samples: list[tuple[Sample, int]]) -> np.ndarray:
    """(T,) bool: which of these samples with the runs they belong to a recording can have."""
    if not samples:
        return np.zeros(0, bool)
    return usable_samples(
        np.array([sample.t_s for sample, _ in samples]),
        np.array([run for _, run in samples], np.int64),
        np.array([sample.measured for sample, _ in samples]),
        np.array([sample.commanded for sample, _ in samples]),
    )
