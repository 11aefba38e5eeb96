"""A rig with a hidden effect, and the recordings made on it, stored in a folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.cache import Cache
from surgisoft.diagnosis.design.schedules import AS_IT_STANDS, SETUPS
from surgisoft.measurement.protocols import Protocol, make_protocol
from surgisoft.measurement.recordings import Recording, load_recording, save_recording
from surgisoft.progress import Progress
from surgisoft.rig import VirtualRig
from surgisoft.rig.virtual import MOUNT


def _silent(done: float, total: float, note: str = "") -> None:
    pass


LOOP_S, RUN_S = 20.0, 120.0
"""Time of one round, as in the tracking tasks, and length of a run, s."""


def circles(samples: int, limits: np.ndarray, seed: int) -> Protocol:
    """Protocol that actuates the chambers in turn, so that the tip goes round in LOOP_S.

    Runs of RUN_S, `samples` at 20 Hz in all; each has its mean, size and sense of rotation.
    limits: (m, 2) [kPa].
    """
    rng = np.random.default_rng([seed, 20])
    t = np.arange(0.0, RUN_S, 0.5)
    phase = 2.0 * np.pi * np.arange(len(limits)) / len(limits)
    runs = []
    for number in range(max(1, round(samples / (20.0 * RUN_S)))):
        mean, size = rng.uniform(16.0, 26.0), rng.uniform(8.0, 16.0)
        turn = (1.0 if number % 2 else -1.0) * 2.0 * np.pi * t / LOOP_S + rng.uniform(0.0, 6.28)
        wave = mean + size * np.sin(turn[:, None] + phase)
        runs.append(np.clip(wave * np.minimum(1.0, t / 5.0)[:, None], *np.asarray(limits).T))
    return Protocol(
        "circles",
        "continuous",
        np.concatenate(runs),
        np.repeat(np.arange(len(runs)), len(t)),
        np.tile(t, len(runs)),
    )


@dataclass(frozen=True)
class Bench:
    """One robot with its hidden effects."""

    kept: Cache
    """Folder of the recordings."""
    robot_seed: int
    """Seed of the robot."""
    hidden: tuple[tuple[str, float], ...]
    """Hidden effects and their amplitudes."""
    samples: int
    """Samples of a `mixed` recording, at 20 Hz."""

    @property
    def about(self) -> dict:
        """Inputs that determine a result on this rig, for the cache."""
        hidden = [list(pair) for pair in self.hidden]
        return {"robot_seed": self.robot_seed, "hidden": hidden, "samples": self.samples}

    def mixed(self, take: int, report: Progress = _silent) -> Recording:
        """A recording of the `mixed` protocol; another trial has another schedule and noise."""
        limits = VirtualRig(self.robot_seed).limits
        protocol = make_protocol("mixed", limits, self.samples, seed=take)
        return self.record(protocol, take, report=report)

    def circles(self, take: int, report: Progress = _silent) -> Recording:
        """A recording of slow circles of the tip, at the pace of the tracking tasks."""
        limits = VirtualRig(self.robot_seed).limits
        return self.record(circles(self.samples, limits, take), take, report=report)

    def record(
        self, protocol: Protocol, take: int, setting: str = AS_IT_STANDS, report: Progress = _silent
    ) -> Recording:
        """A recording of a protocol with the present setup, or after a change of it."""
        about = {**self.about, "take": take, "setting": setting, "protocol": protocol.name}
        about["commands"] = protocol.commands.tolist()
        file = Path(f"{self.kept.place(f'recordings/{protocol.name}', about)}.parquet")
        if not file.is_file():
            change = SETUPS[setting]
            rig = VirtualRig(
                self.robot_seed,
                gravity=tuple(-x for x in MOUNT) if change.flipped else MOUNT,
                roll_deg=change.roll_deg,
                payload_g=change.payload_g,
                take=take,
                hidden=self.hidden,
            )
            recording, _ = rig.record(protocol, lambda done, total: report(done, total, "rig"))
            save_recording(recording, file)
        return load_recording(file)
