"""The rig as a closed loop sees it: every sample is logged, predicted, judged and shown.

What is done with a sample is done after the next command was sent, in the time until the next
sample, so that it does not delay the command.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from surgisoft.live.clock import Clock
from surgisoft.live.log import RunLog
from surgisoft.rig.interface import Rig, Sample, Truth, is_simulated
from surgisoft.surrogate.model import ArmModel


class Finished(Exception):
    """The time of the run is over, or it was asked to stop."""


class Companion:
    """A model beside the rig: it predicts each sample from the actuation so far."""

    def __init__(self, model: ArmModel):
        self.model = model
        self.reset()
        with torch.inference_mode():  # what loads or compiles when first used does so now
            model.step(self._state, torch.zeros_like(self._state.pressure), 0.0, None)

    def reset(self) -> None:
        """The arm was vented and is at rest: the model forgets."""
        self._state = self.model.initial_state(1)
        self._last_s: float | None = None

    def actuation(self, sample: Sample) -> np.ndarray:
        """(m,) the model's input in a sample: measured or commanded actuation [unit]."""
        measured = self.model.spec.actuation == "measured"
        return np.asarray(sample.measured if measured else sample.commanded, np.float64)

    @torch.inference_mode()
    def predict(self, sample: Sample) -> np.ndarray:
        """(n, 3) predicted key points at a sample [mm], arm base frame.

        A chamber whose sensor is silent in the sample keeps its last actuation.
        """
        pressure = torch.tensor(self.actuation(sample), dtype=torch.float32)[None]
        pressure = pressure.where(pressure.isfinite(), self._state.pressure)
        dt_s = 0.0 if self._last_s is None else sample.t_s - self._last_s
        self._last_s = sample.t_s
        room = None if sample.temp_C is None else torch.tensor([sample.temp_C]).float()
        change = pressure - self._state.pressure
        self._state, points = self.model.step(self._state, change, dt_s, room)
        return points[0].double().numpy()


@dataclass(frozen=True, eq=False)
class Instant:
    """One sample of a run and what the model says about it."""

    t_s: float
    """Time since the first sample of the run [s]."""
    sample: Sample
    """What the rig measured."""
    predicted_mm: np.ndarray
    """(n, 3) what the model predicts [mm], arm base frame."""
    run: int
    """Number of the run within the recording: each begins with a reset."""

    @property
    def residual_mm(self) -> np.ndarray:
        """(n, 3) measured less predicted [mm]; NaN where a key point was lost."""
        return self.sample.key_points_mm - self.predicted_mm


class WatchedRig:
    """A rig that keeps a clock, writes a log and reports every sample; satisfies `Rig`."""

    def __init__(
        self,
        rig: Rig,
        companion: Companion,
        clock: Clock,
        log: RunLog,
        seconds: float | None,
        stopped: Callable[[], bool] = lambda: False,
    ):
        """seconds: the run ends that long after its first sample; stopped: whether to end now."""
        self.rig, self.companion, self.clock, self.log = rig, companion, clock, log
        self.seconds, self.stopped = seconds, stopped
        self.chambers, self.key_planes, self.unit = rig.chambers, rig.key_planes, rig.unit
        self.limits, self.period_s, self.arm = rig.limits, rig.period_s, rig.arm
        self.payload_g = rig.payload_g
        for name in ("vent", "close"):  # offered where the rig offers them, see `Rig`
            own = getattr(rig, name, None)
            if callable(own):
                setattr(self, name, own)
        self.watchers: list[Callable[[Instant], None]] = []
        self.on_reset: list[Callable[[], None]] = []
        self.elapsed_s = 0.0
        self._run = -1
        self._pending: Sample | None = None
        self._first_s: float | None = None

    @property
    def gravity(self) -> np.ndarray | None:
        """(3,) unit vector of weight, arm base frame."""
        return self.rig.gravity

    def reset(self) -> None:
        """Vent the arm and let it rest; a new run begins."""
        self.flush()
        self._check()
        self.rig.reset()
        self.companion.reset()
        self.clock.pause()
        for call in self.on_reset:
            call()
        self._run += 1

    def command(self, pressures: np.ndarray) -> None:
        """Set the pressures (m,) [unit] that the controllers reach for from now on."""
        self.rig.command(pressures)

    def wait(self, seconds: float) -> None:
        """Let time [s] pass without a sample."""
        self.rig.wait(seconds)

    def read(self) -> Sample:
        """Wait for one period, then return what sensors and cameras measure."""
        self._before()
        return self._after(self.rig.read())

    def _before(self) -> None:
        self.flush()
        self._check()

    def _after(self, sample: Sample) -> Sample:
        self.clock.tick()
        self._pending = sample
        if self._first_s is None:
            self._first_s = sample.t_s
        self.elapsed_s = sample.t_s - self._first_s
        return sample

    def _check(self) -> None:
        """Raise `Finished` where the run ends before the next sample."""
        over = self.seconds is not None and (
            self.elapsed_s > self.seconds - 1.5 * self.period_s and self._first_s is not None
        )
        if self.stopped() or over:
            raise Finished

    def flush(self) -> None:
        """Log, predict and report the last sample; one that no recording can have is not reported
        (`RunLog.usable`)."""
        sample, self._pending = self._pending, None
        if sample is None:
            return
        usable = self.log.write(sample, self._run)
        now = Instant(self.elapsed_s, sample, self.companion.predict(sample), self._run)
        if not usable:
            return
        for watch in self.watchers:
            watch(now)


class WatchedSimulation(WatchedRig):
    """A simulated rig that is watched; satisfies `SimulatedRig`."""

    def read_beside_truth(self) -> tuple[Sample, Truth]:
        """Do what `read` does, and return the true state of the same instant with it."""
        self._before()
        assert is_simulated(self.rig)
        sample, truth = self.rig.read_beside_truth()
        return self._after(sample), truth
