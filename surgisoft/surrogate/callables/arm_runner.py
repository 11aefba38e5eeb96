"""An arm model around a user's Python callable: actuation in, key points out, with NumPy alone.

`surgisoft export MODEL -o DIR` writes this file as DIR/arm.py. It needs NumPy and the callable's
own module, and nothing else of surgisoft; the effects before and behind the callable are in it.

    from arm import Arm                                # the file in the exported folder

    arm = Arm()                                        # imports the callable, which runs its code
    state = arm.start(pressure)                        # (B, m) -> (B, S)
    state, points = arm.step(state, pressure, dt_s)    # -> (B, S), (B, n, 3) mm

`pressure` is the actuation, of whatever kind: `arm.json` states units, ranges and the parts of the
state. The first row of a run has dt_s = 0. A drift with the elapsed time counts from the start of
the run, or goes on from `elapsed_s`:

    state = arm.start(pressure, elapsed_s=600.0)       # the recording began ten minutes before
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from surgisoft.surrogate.callables.portable import Called

ABOUT: dict[str, Any] = {}
"""What `arm.json` states; filled in below where the file was exported."""
STEPS: dict[str, Any] = {}
"""The functions `start` and `step`; filled in below where the file was exported."""


class Arm:
    """Arms whose state is an array: step(state, pressure, dt_s) -> state, key points."""

    def __init__(self, model: Any = None, keep_rows: int | None = None):
        """model: the callable itself; None: it is imported by its name.

        keep_rows: for a callable of whole runs, which is given the whole run in every step, how
        many rows of it are kept at most; None: all, so that state and time of a step grow with
        the run. A callable that is stepped, or static, needs no rows.
        """
        if keep_rows is not None and keep_rows < 1:
            raise ValueError(f"keep_rows is {keep_rows}, expected 1 or more")
        self.called = Called(ABOUT["model_code"], model)
        self.chambers, self.keep_rows = ABOUT["model_code"]["chambers"], keep_rows
        self.size, self.warm = ABOUT["state"]["size"], "temperature_C" in ABOUT["tensors"]
        self.elapsed = ABOUT["state"].get("elapsed", [])

    def start(self, pressure, elapsed_s=0.0):
        """State (B, S) of arms before a run that begins at actuation (B, m).

        elapsed_s: time since the recording began, s, which a drift follows; one number, or (B,).
        """
        pressure = self._rows(pressure, "pressure")
        since = self._each(elapsed_s, "elapsed_s", len(pressure))
        if not np.isfinite(since).all():
            raise ValueError(f"elapsed_s is {elapsed_s}, expected finite numbers")
        with np.errstate(all="ignore"):
            each = [STEPS["start"]([self.called], row[None])[0] for row in pressure]
        state = np.concatenate(each)
        state[:, self.elapsed] = since[:, None]
        return state

    def step(self, state, pressure, dt_s, temperature_C=np.nan):
        """State (B, S) and key points (B, n, 3) mm after actuation (B, m) was held for dt_s.

        dt_s, temperature_C: one number, or (B,); s, and degrees Celsius, NaN where not known. For
        a callable of whole runs the state grows by 1 + m numbers in a step, up to `keep_rows`.
        """
        pressure, state = self._rows(pressure, "pressure"), np.asarray(state, np.float64)
        batch = len(pressure)
        if state.ndim != 2 or len(state) != batch or state.shape[1] < self.size:
            raise ValueError(f"state has shape {state.shape}, expected ({batch}, {self.size})")
        given = [self._each(dt_s, "dt_s", batch)]
        if not (np.isfinite(given[0]) & (given[0] >= 0.0)).all():
            raise ValueError(f"dt_s is {dt_s}, expected 0 s or more")
        if self.warm:
            given.append(self._each(temperature_C, "temperature_C", batch))
        model: Any = self.called
        if self.called.about["form"] == "runs":
            model = _Run(self.called, state[:, self.size :], given[0], self.keep_rows)
        with np.errstate(all="ignore"):
            fresh, points = STEPS["step"]([model], state[:, : self.size], pressure, *given)
        if isinstance(model, _Run):
            fresh = np.concatenate([fresh, model.past.reshape(batch, -1)], 1)
        return fresh, points

    def _rows(self, given, name):
        given = np.asarray(given, np.float64)
        if given.ndim != 2 or given.shape[1] != self.chambers:
            raise ValueError(f"{name} has shape {given.shape}, expected (B, {self.chambers})")
        if not np.isfinite(given).all():
            raise ValueError(f"{name} is {given.tolist()}, expected finite numbers")
        return given

    def _each(self, given, name, batch):
        given = np.asarray(given, np.float64)
        if given.shape not in ((), (1,), (batch,)):
            raise ValueError(f"{name} has shape {given.shape}, expected one number or ({batch},)")
        return np.broadcast_to(given, (batch,))


class _Run:
    """A callable of whole runs in one step: it is given the rows so far and the row of now."""

    def __init__(self, called: Called, past, dt_s, keep_rows: int | None):
        """past: (B, T (1 + m)) times and actuation of the rows before; dt_s: (B,)."""
        self.called, self.dt_s, self.keep_rows = called, dt_s, keep_rows
        self.past = past.reshape(len(past), -1, 1 + called.about["chambers"])

    def points(self, actuation):
        """Key points (B, n, 3) in mm at the effective actuation (B, m) of this row."""
        before = self.past[:, -1, 0] if self.past.shape[1] else np.zeros(len(actuation))
        row = np.concatenate([(before + self.dt_s)[:, None], actuation], 1)
        self.past = np.concatenate([self.past, row[:, None]], 1)
        if self.keep_rows is not None:
            self.past = self.past[:, -self.keep_rows :]
        return np.stack([self.called.run(run[:, 0], run[:, 1:])[-1] for run in self.past])


def _described(text: str) -> None:
    ABOUT.update(json.loads(text))
