"""Tasks with rigs as plants: an arm of the task is a rig, simulated or real.

Commands go to the rig's pumps, pressures and key points come from its sensors and cameras; goals,
scene and scores of the task stay as they are. Policies and the task's controllers see measurements
only.

On a simulated rig every arm of every episode is a separate rig, and the body, the beam and the
errors are the true ones of the plant, without the cameras' noise. A real rig has no truth: the body
is the measured one, errors contain the noise of the cameras, and where a key point is lost the
estimate stands in. There is one bench, so that episodes run one after the other.

An observer (`surgisoft.agents.observer`) makes an estimate of them; with `observer_gain` = 1 the
estimate is the raw measurement.
"""

from __future__ import annotations

import copy
import re
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from surgisoft.agents.observer import Observer, ObserverGains
from surgisoft.errors import InputError
from surgisoft.rig import Rig
from surgisoft.rig.interface import is_simulated
from surgisoft.rig.preflight import preflight
from surgisoft.rig.registry import HiddenEffect, known_size, open_rig, parse_rig
from surgisoft.rig.safety import SafeRig
from surgisoft.scene import frames
from surgisoft.surrogate.reach import steady_key_points
from surgisoft.tasks.base import Task
from surgisoft.tasks.world.adaptation import Adaptation
from surgisoft.tasks.world.arm import ArmPart, ModelArm, require_kPa
from surgisoft.tasks.world.pytree import ObjectBatch
from surgisoft.tasks.world.random_streams import Stream


@dataclass(frozen=True)
class RigConfig:
    """Which rig replaces each arm, and how its measurements are filtered."""

    seed: int = 0
    """Seed of the robot of a simulated rig; the default arm model was fitted to robot 0."""
    hidden: tuple[HiddenEffect, ...] = ()
    """Hidden effects of a simulated rig: (name, amplitude) or (name, amplitude, seconds)."""
    noise: float = 1.0
    """Factor on all sensor and camera noise of a simulated rig."""
    cameras: bool = True
    """Whether cameras measure the key points; else the model alone estimates them."""
    observer_gain: float = ObserverGains.observer_gain
    """The field of `ObserverGains`."""
    drift_gain: float = ObserverGains.drift_gain
    """The field of `ObserverGains`."""
    pump_gain: float = ObserverGains.pump_gain
    """The field of `ObserverGains`."""
    adapts: bool | None = ObserverGains.adapts
    """The field of `ObserverGains`."""
    settle_s: float = 4.0
    """Time at each pressure of the random history before an episode, s."""
    rigs: tuple[str, ...] = ("virtual",)
    """Texts `NAME[:option=value,...]` (`surgisoft.rig.registry`): one for every arm, or
    `ARM=NAME[:...]` for single arms, the others then being virtual."""
    preflight: bool = False
    """Whether each real rig has to move as its arm model predicts before the first episode."""

    def __post_init__(self):
        _ = self.gains  # which checks them
        if not self.settle_s > 0.0:
            raise InputError(f"rig: settle_s is {self.settle_s}, expected more than 0 s")

    @property
    def gains(self) -> ObserverGains:
        """The gains of the observer."""
        gains = self.observer_gain, self.drift_gain, self.pump_gain
        return ObserverGains(self.cameras, *gains, self.adapts)


FOREIGN_RATIO = 5.0
"""Ratio of a model's error on a rig to its validated error from which the model is reported: far
above what noise and the history of the same arm explain."""
FOREIGN_LEAST_mm = 0.5
"""Error below which no model is reported [mm]."""

BuildRig = Callable[[RigConfig, int], Rig]
"""Makes the rig of one arm of one episode from the configuration and the number of its trial.

The configuration has one entry in `rigs`, that of the arm. A real rig is made once."""


def named_rig(config: RigConfig, trial: int = 0) -> Rig:
    """The rig of a configuration; another trial has other noise on the same simulated robot."""
    (text,) = config.rigs
    plain = RigConfig()
    changed = {
        name: getattr(config, name)
        for name in ("hidden", "noise")
        if getattr(config, name) != getattr(plain, name)
    }
    return open_rig(text, {"seed": config.seed, "noise_seed": trial}, **changed)


def rigs_in(text: str) -> tuple[str, ...]:
    """The rigs of one text, as in `RigConfig.rigs`: `NAME[:...]`, or `ARM=NAME[:...] ARM=...`."""
    return tuple(part for part in re.split(r"\s+(?=\w+=)", text.strip()) if part)


def rigs_by_arm(rigs: Sequence[str], arms: Sequence[str]) -> dict[str, str]:
    """Arm -> text of its rig; `rigs` as in `RigConfig`, arms: names of the task's arms."""
    named: dict[str, str] = {}
    plain: list[str] = []
    for text in rigs:
        arm, equals, rest = text.partition("=")
        if not equals or ":" in arm:
            plain.append(text)
        elif arm not in arms:
            raise InputError(f"rig '{text}': no arm '{arm}', expected one of {', '.join(arms)}")
        elif arm in named:
            raise InputError(f"rig '{text}': arm '{arm}' has the rig '{named[arm]}' already")
        else:
            named[arm] = rest
    if len(plain) > 1 or (plain and named):
        raise InputError(
            f"rigs {', '.join(rigs)}: expected one rig for all arms, or ARM=NAME for each of "
            f"{', '.join(arms)}"
        )
    others = plain[0] if plain else "virtual"
    found = {arm: named.get(arm, others) for arm in arms}
    for text in found.values():
        parse_rig(text)
    return found


@dataclass(frozen=True, eq=False)
class RigPlant:
    """State of B rigs as `ArmPart.plant`: the rigs themselves, and the observer's memory of them.

    A rig is stepped in place, as a real one would be: a state is stepped once, and of two states
    that hold the same rig only the later one is true.
    """

    rigs: ObjectBatch[Rig]
    """The B rigs."""
    target_kPa: Tensor
    """(B, m) kPa: pressures that were commanded last."""
    drift_mm: Tensor
    """(B, n, 3) mm, world frame: by how much the output disturbance grows in a step."""
    adaptation: Adaptation | None = None
    """What was learned of the output disturbance; None where it is filtered."""


@dataclass(frozen=True, eq=False)
class Reading:
    """Measurements of B rigs at one instant, float32."""

    pressure: Tensor
    """(B, m) kPa, as measured."""
    points_mm: Tensor
    """(B, n, 3) mm, base frame, as measured; nan where the cameras lost one."""
    true_mm: Tensor
    """(B, n, 3) mm, base frame: what the cameras would measure without noise; on a real rig the
    measurement itself."""


class RigArm:
    """An arm of the world whose plant is a batch of rigs; see the interface `Arm`.

    Predictions (`predict`, `settled`) and the range by which observations are scaled (`low`,
    `high`) are those of the simulated arm, on which policies were trained; commands are also held
    within the rig's limits (`lowest`, `highest`). Holds no state but a real bench (`real`), which
    is there once; simulated rigs are in `ArmPart.plant`.
    """

    def __init__(
        self,
        arm: ModelArm,
        config: RigConfig,
        dt_s: float,
        build: BuildRig = named_rig,
        on_warning: Callable[[str], None] | None = None,
    ):
        """arm: the simulated arm that the rigs replace; dt_s: time of a step of the world, s.

        on_warning: is called once where the arm model does not predict the first measured poses.
        """
        self.config, self.build = config, build
        self.on_warning = on_warning
        rig = build(config, 0)
        self.real: SafeRig | None = None
        if not is_simulated(rig):
            self.real = rig = rig if isinstance(rig, SafeRig) else SafeRig(rig)
        try:
            self._check(rig, arm, dt_s)
        except InputError:
            self.close()
            raise
        self.reads = round(dt_s / rig.period_s)
        self.period_s = rig.period_s
        low, high = (torch.tensor(end).to(arm.low) for end in rig.limits.T)
        self.lowest = torch.maximum(arm.low, low)
        self.highest = torch.minimum(arm.high, high)
        self.observer = Observer(arm, config.gains, dt_s, self.lowest, self.highest)
        self.simulated = arm
        self.name, self.device, self.vary = arm.name, arm.device, arm.vary
        self.chambers, self.key_points = arm.chambers, arm.key_points
        self.model, self.backbone, self.pneumatics = arm.model, arm.backbone, arm.pneumatics
        self.low, self.high, self.first = arm.low, arm.high, arm.first
        self.pose, self.shaft = arm.pose, arm.shaft

    @staticmethod
    def _check(rig: Rig, arm: ModelArm, dt_s: float) -> None:
        """Raise InputError unless the rig fits the simulated arm and the step of the world."""
        _check_size((rig.chambers, rig.key_planes), arm)
        require_kPa(arm, "a rig")
        if rig.unit != "kPa":
            raise InputError(f"arm '{arm.name}' is commanded in kPa, the rig in {rig.unit}")
        reads = round(dt_s / rig.period_s)
        if abs(reads * rig.period_s - dt_s) > 1e-9 or not reads:
            raise InputError(
                f"dt_s is {dt_s} s; on the rig expected a multiple of its {rig.period_s} s"
            )

    def close(self) -> None:
        """Vent the real bench, where there is one, and give its devices back."""
        if self.real is not None:
            self.real.close()

    def start(self, stream: Stream) -> tuple[Stream, ArmPart]:
        """Rigs at rest that then went through random pressures, at the start of an episode."""
        trials = list(zip(stream.key.tolist(), stream.count.tolist(), strict=True))
        if self.real is not None and len(trials) > 1:
            raise InputError(
                f"arm '{self.name}' is one real bench, and {len(trials)} episodes were to run side "
                "by side; expected one after the other (batch=1)"
            )
        rigs = ObjectBatch(tuple(self._fresh(key, count) for key, count in trials))
        salt = zlib.crc32(f"history {self.name}".encode())
        salted = Stream(stream.key ^ salt, torch.zeros_like(stream.count))
        _, share = salted.uniform(0.0, 1.0, self.vary.history, self.chambers)
        stream, part = self.simulated.start(stream)
        first = torch.minimum(torch.maximum(part.pressure, self.lowest), self.highest)
        passed = (self.lowest + (self.highest - self.lowest) * share).unbind(1)
        part = replace(
            part,
            gain=torch.ones_like(part.gain),
            arm=self.model.initial_state(len(rigs.items)),
            belief=None,
            lead_mm=self.observer.no_lead(part.points_mm),
            factors=None,
            plant=RigPlant(
                rigs,
                first,
                torch.zeros_like(part.offset_mm),
                self.observer.memory(len(rigs.items)),
            ),
        )
        off_mm, number = [], 0
        held = max(1, round(self.config.settle_s / self.period_s))
        last = held * (len(passed) + 1)
        for target in (*passed, first):
            for _ in range(held):
                part, reading = self._read(part, target)
                number += 1
                if number % self.reads == 0 and number < last:
                    part = self.observer.learned(part, reading.pressure, reading.points_mm)
            off_mm.append(frames.apply(part.mount, reading.points_mm) - part.points_mm)
        self._compare(torch.stack(off_mm))
        part = self.observer.begun(part, reading.pressure, reading.points_mm)
        return stream, self._true(part, reading)

    def step(
        self, stream: Stream, part: ArmPart, action: Tensor, dt_s: float
    ) -> tuple[Stream, ArmPart]:
        """Advance one step with changes of pressure (B, m), kPa; dt_s is that of the world."""
        order = self.observer.order(part, action)
        for _ in range(self.reads):
            part, reading = self._read(part, order.target_kPa)
        part = self.observer.stepped(part, order, reading.pressure, reading.points_mm)
        return stream, self._true(part, reading)

    def predict(self, part: ArmPart, pressure: Tensor, dt_s: float) -> Tensor:
        """One-step prediction of the key points, see `Arm.predict`, with the estimated offset."""
        return self.simulated.predict(part, pressure, dt_s)

    def posed(self, part: ArmPart, points_mm: Tensor) -> ArmPart:
        """The state with its body moved to key points, see `Arm.posed`."""
        return self.simulated.posed(part, points_mm)

    def settled(self, pressure: Tensor) -> Tensor:
        """Steady-state key points of the arm model, see `Arm.settled`."""
        return self.simulated.settled(pressure)

    def within_reach(self, part: ArmPart, dt_s: float) -> tuple[Tensor, Tensor]:
        """Lowest and highest pressure a step from now, see `Arm.within_reach`."""
        return self.simulated.within_reach(part, dt_s)

    def action_for(self, part: ArmPart, pressure: Tensor, dt_s: float) -> Tensor:
        """The action that leads to a pressure, see `Arm.action_for`."""
        return self.simulated.action_for(part, pressure, dt_s)

    def _fresh(self, key: int, count: int) -> Rig:
        trial = zlib.crc32(f"{self.name} {key} {count}".encode())
        rig = self.real if self.real is not None else self.build(self.config, trial)
        rig.reset()
        return rig

    def _compare(self, off_mm: Tensor) -> None:
        """Report a model that does not predict the first poses: (P, B, n, 3) mm, measured minus it.

        The error is the root mean square of the distance of a key point, as the validated one.
        """
        if self.on_warning is None:
            return
        report, self.on_warning = self.on_warning, None
        error_mm = float(off_mm.norm(dim=-1).square().nanmean().sqrt())
        validated_mm = self.model.validation.rmse_mm
        if validated_mm is None or not validated_mm > 0.0:
            return
        if error_mm > max(FOREIGN_RATIO * validated_mm, FOREIGN_LEAST_mm):
            report(
                f"arm '{self.name}': its model is {error_mm:.1f} mm off the first "
                f"{len(off_mm) * off_mm.shape[1]} poses measured on the rig, and was validated at "
                f"{validated_mm:.2g} mm: it is a model of another robot, or the robot has changed "
                "('surgisoft diagnose' finds out what; --arm names another model)"
            )

    def _read(self, part: ArmPart, target: Tensor) -> tuple[ArmPart, Reading]:
        """One period of the rigs towards pressures (B, m) kPa; the model goes along."""
        rows = []
        for rig, asked in zip(part.plant.rigs.items, target.double().cpu().numpy(), strict=True):
            rig.command(np.clip(asked, *rig.limits.T))
            if is_simulated(rig):
                sample, truth = rig.read_beside_truth()
                body_mm = truth.noise_free_mm[0]
            else:
                sample = rig.read()
                body_mm = sample.key_points_mm
            rows.append((sample.measured, sample.key_points_mm, body_mm))
        columns = (np.stack(column) for column in zip(*rows, strict=True))
        reading = Reading(
            *(torch.tensor(each, dtype=torch.float32, device=self.device) for each in columns)
        )
        # A pressure sensor may be silent for a moment: its chamber keeps the pressure it had.
        heard = reading.pressure.isfinite()
        reading = replace(reading, pressure=reading.pressure.where(heard, part.pressure))
        part = replace(part, plant=replace(part.plant, target_kPa=target))
        return self.observer.followed(part, reading.pressure, self.period_s), reading

    def _true(self, part: ArmPart, reading: Reading) -> ArmPart:
        """The part with the body of the plant in place of the model's."""
        body = frames.apply(part.mount, reading.true_mm)
        if self.real is not None:
            body = body.where(body.isfinite(), part.seen_mm)
        return self.simulated.posed(part, body)


def _check_size(size: tuple[int, int], arm: ModelArm) -> None:
    """Raise InputError unless a rig of so many chambers and key points fits the simulated arm."""
    if size != (arm.chambers, arm.key_points):
        raise InputError(
            f"arm '{arm.name}' has {arm.chambers} chambers and {arm.key_points} key points; "
            f"the rig's has {size[0]} and {size[1]}"
        )


def on_rig(
    task: Task,
    config: RigConfig | None = None,
    build: BuildRig = named_rig,
    on_warning: Callable[[str], None] | None = None,
) -> Task:
    """The task with every arm on a rig; the given task stays as it is.

    Tasks ask their world for its arms, so that this exchanges the world only. Real benches are open
    from here on: run the task inside `at_benches`. on_warning: is called once for each arm whose
    model does not predict the first poses that are measured on its rig.
    """
    config = config or RigConfig()
    world, moved = copy.copy(task.world), copy.copy(task)
    dt_s = world.config.dt_s
    texts = rigs_by_arm(config.rigs, tuple(world.arms))
    for name, arm in world.arms.items():
        size = known_size(texts[name], {"seed": config.seed}) if build is named_rig else None
        if size is not None and isinstance(arm, ModelArm):
            _check_size(size, arm)
    arms: dict[str, RigArm] = {}
    with ExitStack() as opened:
        for name, arm in world.arms.items():
            if not isinstance(arm, ModelArm):
                raise InputError(f"arm '{name}' is on a rig already, expected a simulated arm")
            placed = RigArm(arm, replace(config, rigs=(texts[name],)), dt_s, build, on_warning)
            opened.callback(placed.close)
            arms[name] = placed
            if placed.real is not None and list(texts.values()).count(texts[name]) > 1:
                raise InputError(
                    f"rig '{texts[name]}' is one bench, and {task.name} has the arms "
                    f"{', '.join(texts)}: name the arm that is on it, such as "
                    f"{name}={texts[name]}; the others are virtual"
                )
        if config.preflight and all(arm.real is None for arm in arms.values()):
            raise InputError(
                f"the pre-flight check is for real rigs, and no arm of {task.name} is on one: "
                f"{', '.join(f'{name} on {text}' for name, text in texts.items())}"
            )
        opened.pop_all()
    world.arms = {**arms}
    moved.world = world
    return moved


def real_benches(task: Task) -> dict[str, SafeRig]:
    """Arm -> its real bench, for every arm of a task that is on one."""
    return {
        name: arm.real
        for name, arm in task.world.arms.items()
        if isinstance(arm, RigArm) and arm.real is not None
    }


@contextmanager
def at_benches(task: Task) -> Iterator[None]:
    """Inside it the task's real benches are driven; at its end they are vented and given back.

    Raises InputError where a bench does not pass the pre-flight check that its configuration asks
    for.
    """
    with ExitStack() as opened:
        for arm in task.world.arms.values():
            if isinstance(arm, RigArm) and arm.real is not None:
                opened.enter_context(arm.real)
                if arm.config.preflight:
                    preflight(arm.real, partial(steady_key_points, arm.model)).require()
        yield
