"""A task played on the virtual rig: the world goes on, but its arms are on benches.

Each arm of each episode is a `VirtualRig` of its own: commands go to its pumps, pressures and key
points come from its sensors and cameras. The task, its goals and its surroundings stay as they
are. Bodies, beams and errors are judged by where the plant is, without the cameras' noise. What
drivers see is measured: the arm's model runs beside the bench, fed with the measured pressures,
and is held to the cameras and the pumps by a filter each, which takes over a share of every new
difference (an output disturbance, as in offset-free predictive control: Pannocchia & Rawlings
2003). Key points are seen through that filter; with trust = 1 as the cameras give them.
"""

from __future__ import annotations

import copy
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.rig import VirtualRig
from surgisoft.scene import frames
from surgisoft.tasks.base import Task
from surgisoft.tasks.world.arm import ArmPart, ModelArm
from surgisoft.tasks.world.random_streams import Stream


@dataclass(frozen=True)
class RigConfig:
    """Which bench, and how its measurements are used."""

    seed: int = 0
    """Which specimen of the arm was cast; the default arm model was fitted on 0."""
    hidden: tuple[tuple[str, float], ...] = ()
    """Hidden effects by name and strength."""
    noise: float = 1.0
    """Factor on all sensor and camera noise."""
    cameras: bool = True
    """Whether the key points are measured; else drivers get the model's, as it foresees them."""
    trust: float = 0.3
    """Share of a new difference between cameras and model that is taken over in a step, 0..1."""
    drift: float = 0.01
    """Share of it that is taken for a steady drift, added in every later step, 0..1."""
    pump_trust: float = 0.3
    """Share of a new difference between the pumps and the world's that is taken over, 0..1."""
    settle_s: float = 4.0
    """Time at each pressure that an arm goes through before an episode, s."""

    def __post_init__(self):
        for name in ("trust", "drift", "pump_trust"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InputError(f"rig: {name} is {getattr(self, name)}, expected 0 to 1")
        if not self.settle_s > 0.0:
            raise InputError(f"rig: settle_s is {self.settle_s}, expected more than 0 s")


@dataclass(frozen=True, eq=False)
class Reading:
    """What B benches show at one instant, float32."""

    pressure: Tensor
    """(B, m) kPa, as measured."""
    points_mm: Tensor
    """(B, n, 3) mm, base frame, as measured; nan where the cameras lost one."""
    true_mm: Tensor
    """(B, n, 3) mm, base frame: what the cameras would measure without noise."""


@dataclass(eq=False)
class Bench:
    """One arm of one episode; changes with every reading."""

    rig: VirtualRig
    """The arm itself."""
    told_kPa: np.ndarray
    """(m,) what the controllers were told last."""
    drift_mm: Tensor | None = None
    """(n, 3) mm, world frame: by how much the body leaves the model further in a step."""


class RigArm:
    """An `Arm` of the world whose body is on benches; all that is not said here is the arm's.

    The benches are no part of the state: an episode finds its own by its stream's key.
    """

    def __init__(self, arm: ModelArm, config: RigConfig, dt_s: float):
        self.arm, self.config = arm, config
        rig = VirtualRig(config.seed, hidden=config.hidden, noise=config.noise)
        if (rig.chambers, rig.key_planes) != (arm.chambers, arm.key_points):
            raise InputError(
                f"arm '{arm.name}' has {arm.chambers} chambers and {arm.key_points} key points; "
                f"the virtual rig's has {rig.chambers} and {rig.key_planes}"
            )
        self.reads = round(dt_s / rig.period_s)
        if abs(self.reads * rig.period_s - dt_s) > 1e-9 or not self.reads:
            raise InputError(
                f"dt_s is {dt_s} s; on the rig expected a multiple of its {rig.period_s} s"
            )
        self.period_s = rig.period_s
        low, high = (torch.tensor(end, dtype=torch.float32) for end in rig.limits.T)
        self.low, self.high = torch.maximum(arm.low, low), torch.minimum(arm.high, high)
        self._benches: dict[int, Bench] = {}

    def __getattr__(self, name: str):
        return getattr(self.arm, name)

    def start(self, stream: Stream) -> tuple[Stream, ArmPart]:
        """Rested benches that went through random pressures, at the start of an episode."""
        benches = []
        for key, count in zip(stream.key.tolist(), stream.count.tolist(), strict=True):
            self._benches[key] = self._fresh(key, count)
            benches.append(self._benches[key])
        salt = zlib.crc32(f"history {self.name}".encode())
        own = Stream(stream.key ^ salt, torch.zeros_like(stream.count))
        _, share = own.uniform(0.0, 1.0, self.vary.history, self.chambers)
        stream, part = self.arm.start(stream)
        first = torch.minimum(torch.maximum(part.pressure, self.low), self.high)
        passed = (self.low + (self.high - self.low) * share).unbind(1)
        model = self.model.initial_state(len(benches))
        part = replace(part, gain=torch.ones_like(part.gain), arm=model, command=first)
        for target in (*passed, first):
            for _ in range(round(self.config.settle_s / self.period_s)):
                part, reading = self._read(benches, part, target)
        return stream, self._shown(benches, replace(part, command=reading.pressure), reading)

    def step(
        self, stream: Stream, part: ArmPart, action: Tensor, dt_s: float
    ) -> tuple[Stream, ArmPart]:
        """One step with changes of pressure (B, m), kPa, asked for now.

        `part.command` is what a pump of the world would be told to do what the bench's does: the
        two differ by the bench's offset, which is followed here.
        """
        benches = [self._benches[key] for key in stream.key.tolist()]
        target = torch.tensor(np.stack([bench.told_kPa for bench in benches])).to(action)
        shift = part.command - target
        target = self.pneumatics.command(target, action, self.low, self.high)
        expected = self.pneumatics.follow(part.pressure, target + shift, dt_s)
        for _ in range(self.reads):
            part, reading = self._read(benches, part, target)
        surprise = (reading.pressure - expected) / self.pneumatics.share(dt_s)
        shift = shift + self.config.pump_trust * surprise
        part = replace(part, command=target + shift)
        return stream, self._shown(benches, part, reading)

    def _fresh(self, key: int, count: int) -> Bench:
        take = zlib.crc32(f"{self.name} {key} {count}".encode())
        config = self.config
        rig = VirtualRig(config.seed, hidden=config.hidden, noise=config.noise, take=take)
        rig.reset()
        return Bench(rig, np.zeros(rig.chambers))

    def _read(
        self, benches: Sequence[Bench], part: ArmPart, target: Tensor
    ) -> tuple[ArmPart, Reading]:
        """One period of the benches towards pressures (B, m) kPa; the model goes along."""
        rows = []
        for bench, told in zip(benches, target.double().cpu().numpy(), strict=True):
            bench.told_kPa = np.clip(told, *bench.rig.limits.T)
            bench.rig.command(bench.told_kPa)
            sample, truth = bench.rig.read_beside_truth()
            rows.append((sample.measured, sample.key_points_mm, truth.noise_free_mm[0]))
        columns = (np.stack(column) for column in zip(*rows, strict=True))
        row = {"dtype": torch.float32, "device": self.device}
        reading = Reading(*(torch.tensor(column, **row) for column in columns))
        model, points = self.arm.bent(part, reading.pressure, self.period_s)
        return replace(part, arm=model, points_mm=points, pressure=reading.pressure), reading

    def _shown(self, benches: Sequence[Bench], part: ArmPart, reading: Reading) -> ArmPart:
        """The part as measured and as it truly is; its points as yet are the model's."""
        seen, offset = part.points_mm, part.offset_mm
        if self.config.cameras:
            measured = frames.apply(part.mount, reading.points_mm)
            surprise = torch.where(measured.isfinite(), measured - seen - offset, 0.0)
            now, offset = self._offsets(benches, offset, surprise)
            seen = seen + now
        part = self.arm.posed(part, frames.apply(part.mount, reading.true_mm))
        return replace(part, seen_mm=seen, seen_kPa=reading.pressure, offset_mm=offset)

    def _offsets(
        self, benches: Sequence[Bench], offset: Tensor, surprise: Tensor
    ) -> tuple[Tensor, Tensor]:
        """How far the body is off the model now, and in a step from now, (B, n, 3) mm each.

        An alpha-beta filter (Kalata 1984) on the offset that was expected for now and what the
        cameras showed beyond it: it follows a steady drift without lag. The first surprise of an
        episode is taken over whole.
        """
        share, now = self.config.trust, []
        for bench, expected, new in zip(benches, offset, surprise, strict=True):
            first = bench.drift_mm is None
            bench.drift_mm = 0.0 * new if first else bench.drift_mm + self.config.drift * new
            now.append(expected + (new if first else share * new))
        drift = torch.stack([bench.drift_mm for bench in benches])
        return torch.stack(now), torch.stack(now) + drift


def on_rig(task: Task, config: RigConfig | None = None) -> Task:
    """The same task with every arm on the rig; the given task stays as it is."""
    config = config or RigConfig()
    world, moved = copy.copy(task.world), copy.copy(task)
    dt_s = world.config.dt_s
    world.arms = {name: RigArm(arm, config, dt_s) for name, arm in world.arms.items()}
    moved.world = world
    return moved
