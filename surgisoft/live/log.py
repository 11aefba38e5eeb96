"""The log of a run: a recording in CSV that grows while the run lasts.

A power cut loses at most the last second, and what is there is a recording that every command
reads. `finish` replaces it by the whole recording in its final form.
"""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path
from typing import TextIO

import numpy as np

from surgisoft.errors import InputError
from surgisoft.measurement.recordings import Recording, check_writable, save_recording
from surgisoft.rig.interface import Rig, Sample

FLUSH_S = 1.0
"""Time within which rows are on the disk [s]."""


class RunLog:
    """Samples of a rig, kept in memory and written to `NAME.log.csv` as they come."""

    def __init__(self, rig: Rig, path: str | Path | None, force: bool = False, note: str = ""):
        """path: the recording that the log becomes (.parquet or .csv); None: in memory only."""
        self.rig, self.path, self.force, self.note = rig, None, force, note
        self.samples: list[Sample] = []
        self.runs: list[int] = []
        self._file: TextIO | None = None
        self._flushed = 0.0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._sync, daemon=True)
        if path is None:
            return
        self.path = Path(path)
        check_writable(self.path, force)
        self.growing = self.path.with_name(f"{self.path.stem}.log.csv")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self.growing.open("w", encoding="utf-8")
        except OSError as error:
            raise InputError(f"{self.growing}: cannot be written ({error.strerror})") from error
        m, n, unit = rig.chambers, rig.key_planes, rig.unit
        names = ["t_s", *(f"{letter}{i + 1}_{unit}" for letter in "pc" for i in range(m))]
        names += [f"k{j}_{axis}_mm" for j in range(n) for axis in "xyz"]
        self._file.write(",".join([*names, "run", "temp_C"]) + "\n")
        self._thread.start()

    def write(self, sample: Sample, run: int) -> None:
        """Append a sample of a run."""
        self.samples.append(sample)
        self.runs.append(run)
        if self._file is None:
            return
        values = [sample.t_s - self.samples[0].t_s, *sample.measured, *sample.commanded]
        values += [*sample.key_points_mm.reshape(-1)]
        cells = ["" if np.isnan(v) else repr(float(v)) for v in values]
        temperature = "" if sample.temp_C is None else repr(float(sample.temp_C))
        self._file.write(",".join([*cells, str(run), temperature]) + "\n")
        now = time.monotonic()
        if now - self._flushed > FLUSH_S / 2:
            self._flushed = now
            self._file.flush()

    def _sync(self) -> None:
        """Write what was flushed to the disk, beside the loop, which must not wait for it."""
        while self._file is not None and not self._over.wait(FLUSH_S / 2):
            os.fsync(self._file.fileno())

    def recording(self, name: str) -> Recording:
        """The samples so far as a recording."""
        rig, count = self.rig, min(len(self.samples), len(self.runs))
        samples = self.samples[:count]
        room = [sample.temp_C for sample in samples]
        payload = rig.payload_g
        return Recording(
            name=name,
            t_s=np.array([sample.t_s for sample in samples]) - samples[0].t_s,
            measured=np.array([sample.measured for sample in samples]),
            key_points_mm=np.array([sample.key_points_mm for sample in samples]),
            commanded=np.array([sample.commanded for sample in samples]),
            run=np.array(self.runs[:count], np.int64),
            unit=rig.unit,
            temp_C=None if None in room else np.array(room, np.float64),
            payload_g=None if payload is None else np.full(len(samples), payload),
            arm=rig.arm,
            gravity=rig.gravity,
            kind="continuous",
            note=self.note,
        )

    def finish(self, name: str) -> Recording | None:
        """The recording, written in its final form; None without a sample."""
        self.close()
        found = self.recording(name) if self.samples else None
        if found is not None and self.path is not None:
            save_recording(found, self.path, self.force)
        self.discard()
        return found

    def close(self) -> None:
        """Hand all rows to the disk."""
        if self._file is not None and not self._file.closed:
            self._over.set()
            self._thread.join()
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()

    def discard(self) -> None:
        """Remove the growing file."""
        self.close()
        if self.path is not None:
            self.growing.unlink(missing_ok=True)
