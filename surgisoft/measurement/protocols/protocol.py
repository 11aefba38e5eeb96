"""The data class of a protocol: its commands over time. Users can write their own."""

import itertools
from dataclasses import dataclass

import numpy as np

from surgisoft.errors import InputError
from surgisoft.measurement.recordings.recording import KINDS


@dataclass(frozen=True, eq=False)
class Protocol:
    """Commands for a rig; each run begins with a vented arm at rest."""

    name: str
    """Name of the recordings made with it."""
    kind: str
    """"settled": one averaged steady-state sample a row; "continuous": samples at the rig's
    rate, the command linear between rows."""
    commands: np.ndarray
    """(T, m) float64, commanded actuation [unit]."""
    run: np.ndarray
    """(T,) int64 id of each row's run, in blocks."""
    t_s: np.ndarray | None = None
    """(T,) float64, time of each row from the start of its run [s]; continuous protocols only."""
    settle_s: float = 3.0
    """Time between a command and its sample [s]; steady-state only (Chen et al. 2025, III-B)."""
    average_s: float = 1.0
    """Time over which samples are averaged to one [s]; steady-state only (same source)."""
    unit: str = "kPa"
    """Unit of the commands."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "commands", np.asarray(self.commands, np.float64))
        object.__setattr__(self, "run", np.asarray(self.run, np.int64))
        if self.kind not in KINDS:
            self._fail(f"kind is '{self.kind}', expected one of {', '.join(KINDS)}")
        shape = self.commands.shape
        if len(shape) != 2 or shape[0] < 1 or shape[1] < 1 or self.run.shape != shape[:1]:
            self._fail(f"commands {shape} and runs {self.run.shape}, expected (T, m) and (T,)")
        if not np.isfinite(self.commands).all():
            row = int(np.flatnonzero(~np.isfinite(self.commands).all(axis=1))[0])
            self._fail(f"the command of row {row + 1} is not finite")
        starts = self.run[np.flatnonzero(np.diff(self.run, prepend=self.run[0] - 1))]
        if len(set(starts.tolist())) != len(starts):
            self._fail("a run appears again after another run; keep its rows together")
        if self.kind == "continuous":
            self._check_times()
        elif not (self.settle_s >= 0 and self.average_s > 0):
            self._fail(
                f"settle_s {self.settle_s} and average_s {self.average_s}, expected >= 0 and > 0"
            )

    def _check_times(self) -> None:
        if self.t_s is None or np.shape(self.t_s) != self.run.shape:
            self._fail("a continuous protocol needs a time for every row")
        object.__setattr__(self, "t_s", np.asarray(self.t_s, np.float64))
        bad = (np.diff(self._times_s) <= 0) & (np.diff(self.run) == 0)
        if bad.any() or not np.isfinite(self._times_s).all():
            row = int(np.flatnonzero(bad)[0]) + 2 if bad.any() else 1
            self._fail(f"time does not increase at row {row}; each run needs rising times")
        if min(np.count_nonzero(self.run == run) for run in set(self.run.tolist())) < 2:
            self._fail("a run has one row; a continuous run needs at least two")

    @property
    def _times_s(self) -> np.ndarray:
        """(T,) s, times of a continuous protocol, which always has them."""
        assert self.t_s is not None
        return self.t_s

    def _fail(self, message: str) -> None:
        raise InputError(f"protocol '{self.name}': {message}")

    @property
    def chambers(self) -> int:
        """Number m of chambers."""
        return self.commands.shape[1]

    @property
    def run_rows(self) -> list[tuple[int, slice]]:
        """Each run's id and rows, in order."""
        edges = [0, *(np.flatnonzero(np.diff(self.run)) + 1).tolist(), len(self.run)]
        return [(int(self.run[a]), slice(a, b)) for a, b in itertools.pairwise(edges)]

    def commands_at(self, rows: slice, period_s: float) -> np.ndarray:
        """(F, m) commands of one run for samples every `period_s` [s]; for steady-state
        points, its rows."""
        if self.kind == "settled":
            return self.commands[rows]
        knots = self._times_s[rows] - self._times_s[rows.start]
        times = period_s * np.arange(round(knots[-1] / period_s))
        columns = self.commands[rows].T
        return np.stack([np.interp(times, knots, column) for column in columns], axis=1)
