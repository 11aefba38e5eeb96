"""`run`: a closed loop on a rig, with a model beside it and an alarm when it no longer holds."""

from __future__ import annotations

import gc
import itertools
import math
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch

from surgisoft.agents.on_rig import RigConfig, on_rig
from surgisoft.agents.policies import POLICIES, Policy, check_policy, open_policy
from surgisoft.agents.run_folder import RunFolder, run_path
from surgisoft.agents.session import task_config
from surgisoft.diagnosis.inputs import seen_in_fit
from surgisoft.errors import InputError, Terminated, path_of, unknown_name
from surgisoft.files import json_safe
from surgisoft.live.change import (
    LEAST_BLOCKS,
    LEAST_REPEATED,
    Alarm,
    AlarmDesign,
    Charts,
    Detector,
    Stretch,
    fit_detector,
    repeated_share,
    stretches,
)
from surgisoft.live.clock import Clock, Pace, Timing
from surgisoft.live.log import RunLog
from surgisoft.live.watch import Companion, Finished, Instant, WatchedRig, WatchedSimulation
from surgisoft.measurement.histories import actuation_of, check_fits, history_of
from surgisoft.measurement.protocols import PROTOCOLS, Protocol, make_protocol
from surgisoft.measurement.recordings import (
    AlarmInfo,
    Recording,
    after_alarm,
    load_recordings,
    save_recording,
)
from surgisoft.measurement.recordings.recording import left_out
from surgisoft.progress import Progress, silent
from surgisoft.rig.collect import check_fits as check_protocol
from surgisoft.rig.collect import runs_of
from surgisoft.rig.interface import Rig, close, is_simulated
from surgisoft.rig.registry import open_rig, parse_rig
from surgisoft.rig.safety import SafeRig
from surgisoft.surrogate.checkpoint import load_model
from surgisoft.surrogate.model import ArmModel
from surgisoft.tasks.base import Episodes, Task, TaskState
from surgisoft.tasks.registry import make_task, spec_of, task_names, with_fields

if TYPE_CHECKING:
    from surgisoft.replay.live_view import LiveView

SLOWEST_HZ, FASTEST_HZ = 10.0, 50.0
"""Range of the rate of the loop [Hz]."""
USUAL_HZ = 20.0
"""Rate of the loop without `--rate` where nothing else determines it [Hz]."""
POLICY_S = 600.0
"""Time of a policy's run without `--minutes` [s]."""
REFERENCE_S = 120.0
"""Time at the begin of a run that is the detector's reference where no recording is given [s]."""
CHECKS_S = (10.0, 30.0, 60.0)
"""Times of a run at which the model is checked against the arm [s]."""
ANOTHER_ARM = 10.0
"""Error of the model over its validated error from which on it counts as the model of another arm
[-]. On the virtual rig a hidden effect of strength 1 gives up to 8, the default model on robots 1
to 4 gives 10 to 21."""
ANOTHER_ARM_SHARE = 0.01
"""Least error over the arm's length that counts as that of another arm [-]."""
UNVALIDATED_SHARE = 0.05
"""Least error over the arm's length that counts as that of another arm where the model was never
validated [-]."""
SUSPICIOUS = 2.0
"""Error in the reference over the model's validated error from which on it is warned of."""
LEAD_IN_S = 60.0
"""Time before the change that `*-after` keeps without key points, so that a model's memory is
that of the run [s]."""
SURELY_REPEATED = 0.85
"""Share of a reference, by its schedule, that is enough for `LEAST_REPEATED` as measured: rests
between runs and lags make the measured one smaller [-]."""
LONGER = (1.25, 1.5, 2.0, 3.0, 5.0)
"""Factors on the time of a reference that are tried where it does not repeat its motions [-]."""
REHEARSED = 3
"""Number of steps of a policy in simulation before the run."""
PRIORITY = 20
"""Real-time priority of the loop, of 1 to 99; threads of the kernel have 50."""
OLD_OBJECTS_KEPT = 1_000_000
"""Threshold of the oldest generation of the garbage collector during a run: it is not looked at, as
the samples that a run keeps are in it (after 140 s that took 60 ms, longer than a period)."""
SWITCH_S = 5e-4
"""Longest time for which another thread may hold the interpreter during a run [s]."""

ClockName = Literal["real", "simulated"]


@dataclass(frozen=True)
class RunRequest:
    """Request for a run: what drives the rig, for how long, and what watches it."""

    policy: str
    """`scripted`, `random`, a training run's folder, a schedule file (.csv) or a continuous
    protocol's name."""
    rig: str | Rig = "virtual"
    """Text `NAME[:option=value,...]` (`surgisoft.rig.registry`), or a rig that is open."""
    model: str | Path | ArmModel | None = None
    """Arm model that predicts the samples and that the policy uses: a folder, `default`, or a
    model (with schedules only); None: that of the training run, else `default`."""
    task: str | None = None
    """Name of the task; None: that of the training run."""
    config: Any = None
    """Configuration of the task, or a TOML file with fields of it."""
    minutes: float | None = None
    """Length of the run [min]; None: a schedule once, a policy for ten minutes."""
    rate_hz: float | None = None
    """Rate of the loop [Hz]; None: that of the trained policy, else 20 Hz."""
    clock: ClockName = "real"
    """`simulated`: as fast as possible, for simulated rigs only."""
    before: tuple[str | Path | Recording, ...] = ()
    """Recordings of the unchanged arm, whose residuals are the detector's reference; none: the
    begin of the run."""
    reference_s: float = REFERENCE_S
    """Time at the begin of the run that is the reference without `before` [s]."""
    alarm: AlarmDesign = field(default_factory=AlarmDesign)
    """What the change detector is set for."""
    stop_on_alarm: bool = False
    """Whether the run ends with the first alarm."""
    cameras: bool = True
    """Whether the policy observes measured key points, or those that the model predicts."""
    observer_gain: float | None = None
    """Share of the innovation that the policy's estimate adopts in a step, see `RigConfig`."""
    seed: int = 0
    """Seed of goals and of the schedule's random parts."""
    any_model: bool = False
    """Whether the run goes on with a model whose error is that of another arm's model."""
    output: Path | None = None
    """The recording to write, .parquet or .csv."""
    force: bool = False
    """Whether an older recording is replaced."""

    def __post_init__(self):
        rate = self.rate_hz
        if rate is not None and not SLOWEST_HZ <= rate <= FASTEST_HZ:
            raise InputError(f"rate is {rate:g} Hz, expected {SLOWEST_HZ:g} to {FASTEST_HZ:g} Hz")
        if self.minutes is not None and not (0.0 < self.minutes < math.inf):
            raise InputError(f"minutes is {self.minutes:g}, expected more than 0")
        if self.clock not in ("real", "simulated"):
            raise unknown_name("clock", self.clock, ("real", "simulated"))
        least = LEAST_BLOCKS * self.alarm.block_s + 2.0
        if not least <= self.reference_s < math.inf:
            raise InputError(
                f"--clean {self.reference_s:g}: expected at least {least:g} s at the start of the "
                "run in which the arm is unchanged, or recordings of it by --before"
            )

    @property
    def scheduled(self) -> bool:
        """Whether a schedule drives the rig, and no policy."""
        return self.policy.endswith(".csv") or self.policy in PROTOCOLS


@dataclass(frozen=True, eq=False)
class RunResult:
    """A run that is over."""

    request: RunRequest
    """What was asked for."""
    recording: Recording
    """What the rig measured."""
    predicted_mm: np.ndarray
    """(T, n, 3) what the model predicted [mm], arm base frame."""
    statistic: np.ndarray
    """(T,) largest chart of the detector over its threshold; NaN while there is no reference."""
    detector: Detector | None
    """The detector; None where the run was shorter than its reference."""
    alarms: tuple[Alarm, ...]
    """When the model ceased to be valid."""
    judged: float
    """Share of the run behind the reference whose motion the reference covers; nan without one."""
    timing: Timing
    """How the clock was kept."""
    tracking: np.ndarray
    """(K, 2) time [s] and error of the task [mm] of each of the policy's steps; NaN where the task
    measures none. Empty for schedules."""
    interrupted: bool
    """Whether it was asked to stop before its time was over."""
    ended_by: BaseException | None
    """Ctrl-C or the signal that ended it; a program raises it after it has reported."""
    written: tuple[Path, ...]
    """Files that were written."""

    @property
    def error_mm(self) -> np.ndarray:
        """(T, n) distance between measured and predicted key points [mm]; NaN where missing."""
        residual = self.recording.key_points_mm - self.predicted_mm
        return np.linalg.norm(residual, axis=-1)

    def rms_mm(self, begin_s: float = -math.inf, end_s: float = math.inf) -> float:
        """RMS distance of the key points from the model in a stretch of time [mm]."""
        t_s = self.recording.t_s
        error = self.error_mm[(t_s >= begin_s) & (t_s < end_s)]
        known = error[np.isfinite(error)]
        return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan

    def tracking_mm(self, begin_s: float = -math.inf, end_s: float = math.inf) -> float:
        """Mean error of the task in a stretch of time [mm]; nan where it has none."""
        t_s, error = self.tracking.T if len(self.tracking) else np.zeros((2, 0))
        known = error[(t_s >= begin_s) & (t_s < end_s) & np.isfinite(error)]
        return float(known.mean()) if len(known) else math.nan

    def to_json(self) -> dict:
        """Plain values, as `run --json` writes them."""
        detector = self.detector
        change = self.alarms[0].since_s if self.alarms else math.inf
        return json_safe(
            {
                "policy": self.request.policy,
                "rig": self.request.rig if isinstance(self.request.rig, str) else None,
                "seconds": float(self.recording.t_s[-1]),
                "interrupted": self.interrupted,
                "timing": vars(self.timing),
                "reference_s": None if detector is None else detector.reference_s,
                "reference_mm": None if detector is None else detector.reference_mm,
                "threshold": None if detector is None else detector.threshold,
                "enlargement": None if detector is None else detector.enlargement,
                "repeated": None if detector is None else detector.repeated,
                "alarms": [vars(alarm) for alarm in self.alarms],
                "judged": self.judged,
                "error_mm": {
                    "whole": self.rms_mm(),
                    "before": self.rms_mm(end_s=change),
                    "after": self.rms_mm(begin_s=change),
                },
                "tracking_mm": {
                    "whole": self.tracking_mm(),
                    "before": self.tracking_mm(end_s=change),
                    "after": self.tracking_mm(begin_s=change),
                },
                "written": [str(path) for path in self.written],
            }
        )


def print_nothing(text: str) -> None:
    """Take a line of text and print nothing."""


def run(
    policy: str | Path,
    rig: str | Rig = "virtual",
    model: str | Path | ArmModel | None = None,
    *,
    before: Iterable[str | Path | Recording] | str | Path | Recording = (),
    show: bool = False,
    web: bool = False,
    replay: str | Path | None = None,
    on_address: Callable[[str], None] = print_nothing,
    on_event: Callable[[str], None] = print_nothing,
    on_warning: Callable[[str], None] = warnings.warn,
    progress: Progress = silent,
    stopped: Callable[[], bool] = lambda: False,
    **fields: Any,
) -> RunResult:
    """Drive a rig by a policy or a schedule in a closed loop, with a model beside it.

    Returns the recording, the model's predictions (T, n, 3) mm in the arm base frame, and when and
    since when the model stopped to describe the arm, s. Raises InputError before the rig moves for
    requests that do not fit the rig.

    policy: see `RunRequest.policy`; rig: text as for `--rig`, or an open rig; model: the arm model
    that predicts every sample. before: recordings of the unchanged arm as the detector's reference.
    show, web, replay: show the run while it lasts in the native viewer, serve it to a browser on
    this machine (`on_address` is called with the address), write it to this .rrd file.
    on_event, on_warning: called with one line of text.
    progress: called with seconds done and to do. stopped: asked once a sample whether to end.
    fields: other fields of `RunRequest`, such as `task="track_circle"`, `minutes=10`,
    `clock="simulated"` or `output="run.parquet"`.

    The rig is vented and closed at the end, whatever ends the run, and what was recorded is
    written. Ctrl-C and SIGTERM end it after the present sample.
    """
    if isinstance(before, str | Path | Recording):
        before = (before,)
    if fields.get("output") is not None:
        fields["output"] = Path(fields["output"])
    policy = path_of("the policy", policy, "its name, or a path")
    request = RunRequest(str(policy), rig, model, before=tuple(before), **fields)
    sinks = Sinks(show, web, None if replay is None else Path(replay), on_address)
    return _Session(request, sinks, on_event, on_warning, progress, stopped).run()


@dataclass(frozen=True)
class Sinks:
    """Where a run is shown while it lasts."""

    show: bool
    """In the native viewer."""
    web: bool
    """In a browser."""
    replay: Path | None
    """In an .rrd file."""
    on_address: Callable[[str], None]
    """Called with the address for the browser."""

    @property
    def any(self) -> bool:
        """Whether there is one."""
        return self.show or self.web or self.replay is not None


class _Session:
    """One run: opens what it needs, drives, and finishes."""

    def __init__(
        self,
        request: RunRequest,
        sinks: Sinks,
        on_event: Callable[[str], None],
        on_warning: Callable[[str], None],
        progress: Progress,
        stopped: Callable[[], bool],
    ):
        self.request, self.sinks = request, sinks
        self.view: LiveView | None = None
        self.on_event, self.on_warning, self.progress = on_event, on_warning, progress
        self._asked, self._ended = stopped, threading.Event()
        self.interrupted = False
        self.ended_by: BaseException | None = None
        self.predicted: list[np.ndarray] = []
        self.statistic: list[float] = []
        self.tracking: list[tuple[float, float]] = []
        self.charts: Charts | None = None
        self._early: list[Instant] = []
        self._fit: Future[Detector] | None = None
        self._shown_s = -math.inf
        self._checks = list(CHECKS_S)

    # Setting up --------------------------------------------------------------------------------

    def run(self) -> RunResult:
        """The whole run."""
        request = self.request
        task, config = self._task()
        self.model = self._model(config)
        rate_hz = self._rate(config)
        before = load_recordings(request.before, self.on_warning) if request.before else []
        check_fits(self.model.spec, before)
        rig = self._open_rig(rate_hz)
        with ExitStack() as opened:
            opened.callback(close, rig)
            self._check_rig(rig, rate_hz)
            protocol = self._protocol(rig)
            place = self._place(task, config, rate_hz)
            if before:
                self.charts = Charts(self._detector(before))
            elif protocol is not None:
                self._check_reference(protocol, rig.period_s)
            pace: Pace = "rig"
            if is_simulated(rig):
                pace = "real" if request.clock == "real" else "simulated"
            elif request.clock == "simulated":
                raise InputError(
                    f"--clock simulated: '{request.rig}' is not a simulated rig, which has the "
                    "method 'read_beside_truth' (docs/rigs.md#a-simulation-of-your-own); leave "
                    "--clock out"
                )
            clock = Clock(rig.period_s, pace)
            note = f"run {Path(request.policy).name}"
            log = RunLog(rig, request.output, request.force, note)
            opened.callback(log.close)
            seconds = self._seconds(protocol)
            self.companion = Companion(self.model)
            bench = self._watch(rig, self.companion, clock, log, seconds)
            drive = self._drive(bench, protocol, place)
            self._seconds_to_do = seconds
            opened.pop_all()
            with (
                self._shown(rig),
                _begun(ThreadPoolExecutor(1)) as self._worker,
                self._guarded(bench),
                _undisturbed(),
                nullcontext() if clock.pace == "simulated" else _real_time_priority(),
            ):
                try:
                    try:
                        drive()
                    except Finished:
                        pass
                    except (KeyboardInterrupt, Terminated) as ended:
                        self.interrupted, self.ended_by = True, ended
                    self.watched.flush()
                    self._late_detector(wait=True)
                except InputError:
                    self._keep(log)
                    raise
            return self._result(log, clock)

    def _watch(
        self, rig: Rig, companion: Companion, clock: Clock, log: RunLog, seconds: float | None
    ) -> Rig:
        """The rig that the loop drives: watched, and a real one inside its safety limits."""
        safe = rig if isinstance(rig, SafeRig) else None
        kind = WatchedSimulation if is_simulated(rig) else WatchedRig
        inner = safe.rig if safe else rig
        self.watched = kind(inner, companion, clock, log, seconds, self._stopped)
        self.watched.watchers.append(self._sample)
        self.watched.on_reset.append(self._reset)
        if is_simulated(rig):
            return self.watched
        return SafeRig(self.watched, safe.safety if safe else None, safe.show if safe else None)

    def _keep(self, log: RunLog) -> None:
        """Write what was recorded before an error, where there is something."""
        if len(log.samples) > 1 and log.usable.any():
            self._tell_left_out(log)
            found = log.finish(self._name)
            assert found is not None, "there are samples"
            self.on_warning(f"the {found.samples} samples until then were written: {log.path}")
        else:
            log.discard()

    def _tell_left_out(self, log: RunLog) -> None:
        """Say how many samples the recording cannot have, where there are such."""
        if count := int((~log.usable).sum()):
            self.on_warning(left_out(count))

    @contextmanager
    def _shown(self, rig: Rig) -> Iterator[None]:
        """The view of the run, where one was asked for."""
        if not self.sinks.any:
            yield
            return
        from surgisoft.replay.live_view import LiveBench, live_view

        name = Path(self.request.policy).name
        length = rig.arm.length_mm or self.model.spec.length_mm
        if length is None:
            rest = np.asarray(self.model.rest_mm)
            length = float(np.linalg.norm(rest[-1] - rest[0]))
        title = f"{name} on {self._rig_name}"
        tracks = not self.request.scheduled
        bench = LiveBench(
            rig.chambers,
            rig.key_planes,
            rig.unit,
            length,
            title,
            tracks,
            self.model.validation.rmse_mm,
            None if rig.gravity is None else tuple(np.asarray(rig.gravity, float).tolist()),
        )
        sinks = self.sinks
        with live_view(
            bench,
            window=sinks.show,
            web=sinks.web,
            file=sinks.replay,
            on_address=sinks.on_address,
            stay=lambda: not self.interrupted,
        ) as self.view:
            yield

    def _event(self, t_s: float, text: str, serious: bool = False) -> None:
        """Report what happened at a time [s]."""
        self.on_event(text)
        if self.view is not None:
            self.view.event(t_s, text, serious)

    @property
    def _name(self) -> str:
        return self.request.output.stem if self.request.output else "run"

    @property
    def _rig_name(self) -> str:
        rig = self.request.rig
        return parse_rig(rig).name if isinstance(rig, str) else type(rig).__name__

    def _task(self) -> tuple[str | None, Any]:
        """Name and configuration of the policy's task; None for a schedule."""
        request = self.request
        if request.scheduled:
            if request.task is not None or request.config is not None:
                raise InputError("a schedule has no task: leave --task and --config out")
            if not request.cameras or request.observer_gain is not None:
                raise InputError(
                    "a schedule observes nothing: leave --no-cameras and --observer-gain out"
                )
            return None, None
        if request.policy not in POLICIES and not run_path(request.policy).exists():
            known = [*POLICIES, "the folder of a training run", "SCHEDULE.csv", *PROTOCOLS]
            if Path(request.policy).name == request.policy:
                raise unknown_name("policy", request.policy, known)
        check_policy(request.policy)
        trained = request.policy not in POLICIES
        config = request.config
        task = request.task
        if trained:
            folder = RunFolder(request.policy)
            task = task or folder.config["task"]
            if config is None and task == folder.config["task"]:
                config = folder.plan().task_config
        if task is None:
            raise InputError(f"--task is missing; expected one of {', '.join(task_names())}")
        if len(spec_of(task).agents) != 1:
            raise InputError(
                f"task '{task}' has the arms {', '.join(spec_of(task).agents)}, and a rig has one; "
                "expected a task of one arm"
            )
        arm = request.model
        if isinstance(arm, ArmModel):
            raise InputError(
                "a policy takes its arm model from a folder; save the model with save_model and "
                "give the folder"
            )
        return task, task_config(task, config, arm)

    def _model(self, config: Any) -> ArmModel:
        model = self.request.model
        if isinstance(model, ArmModel):
            return model.eval()
        if model is None:
            model = getattr(getattr(config, "follow", config), "arm", None) or "default"
        return load_model(model).eval()

    def _rate(self, config: Any) -> float:
        """Rate of the loop [Hz]."""
        asked = self.request.rate_hz
        if config is None or self.request.policy in POLICIES:
            return asked or USUAL_HZ
        own = 1.0 / config.world.dt_s
        if asked is not None and abs(asked - own) > 1e-6 * own:
            raise InputError(
                f"--rate {asked:g}: the policy was trained for {own:g} Hz; leave --rate out"
            )
        return own

    def _open_rig(self, rate_hz: float) -> Rig:
        rig = self.request.rig
        if not isinstance(rig, str):
            return rig
        return open_rig(rig, {"rate_Hz": max(rate_hz, USUAL_HZ)})

    def _check_rig(self, rig: Rig, rate_hz: float) -> None:
        """Raise InputError where rig, model and rate do not fit each other."""
        spec = self.model.spec
        for what, came, expected in (
            ("chambers", rig.chambers, spec.chambers),
            ("key points", rig.key_planes, spec.key_points),
            ("actuation unit", rig.unit, spec.unit),
        ):
            if came != expected:
                raise InputError(
                    f"rig '{self._rig_name}': {what}: {came}, but the model has {expected}; "
                    "give the model of the arm on this rig"
                )
        reads = round(1.0 / (rate_hz * rig.period_s))
        if not reads or abs(reads * rig.period_s * rate_hz - 1.0) > 1e-6:
            raise InputError(
                f"rate is {rate_hz:g} Hz, and the rig '{self._rig_name}' gives "
                f"{1.0 / rig.period_s:g} samples per second, expected a whole number of samples in "
                "a period"
            )

    def _protocol(self, rig: Rig) -> Protocol | None:
        request = self.request
        if not request.scheduled:
            return None
        protocol = make_protocol(request.policy, rig.limits, seed=request.seed)
        if protocol.kind != "continuous":
            raise InputError(
                f"protocol '{request.policy}' is one of steady-state points, expected a continuous "
                "one or a schedule file"
            )
        check_protocol(rig, protocol)
        return protocol

    def _place(self, task: str | None, config: Any, rate_hz: float) -> Task | None:
        """The task on its own world; its arm is put on the rig later."""
        if task is None:
            return None
        if self.request.policy in POLICIES:
            config = with_fields(config, dt_s=1.0 / rate_hz)
        vary = config.world.randomisation
        config = with_fields(config, randomisation=replace(vary, history=0, start_kPa=0.0))
        return make_task(task, config)

    def _seconds(self, protocol: Protocol | None) -> float | None:
        """Length of the run [s]; None: until its schedule is over."""
        if self.request.minutes is not None:
            return 60.0 * self.request.minutes
        return None if protocol is not None else POLICY_S

    # The loop ----------------------------------------------------------------------------------

    def _drive(
        self, bench: Rig, protocol: Protocol | None, place: Task | None
    ) -> Callable[[], None]:
        """The loop that drives a watched rig."""
        if protocol is not None:
            return lambda: self._follow_schedule(bench, protocol)
        assert place is not None
        request = self.request
        config = RigConfig(cameras=request.cameras)
        if request.observer_gain is not None:
            config = replace(config, observer_gain=request.observer_gain, adapts=False)
        task = on_rig(place, config, lambda config, trial: bench)
        policy = open_policy(request.policy, place)  # the bench is first moved by the loop
        _rehearse(place, policy)
        return lambda: self._follow_policy(task, policy)

    def _follow_schedule(self, bench: Rig, protocol: Protocol) -> None:
        """The commands of a schedule, again and again where the run is longer."""
        while True:
            for _, commands in runs_of(protocol, bench.period_s):
                bench.reset()
                for row in commands:
                    bench.command(row)
                    bench.read()
            if self.watched.seconds is None:
                return

    @torch.inference_mode()
    def _follow_policy(self, task: Task, policy: Policy) -> None:
        """Episodes of a task one after another; the arm goes on from where it is."""
        episodes = Episodes(task)
        state = episodes.seeded(self.request.seed, 1)
        while True:
            actions = policy.act(task, state, episodes.observe(state))
            state, outcome = episodes.step(state, actions)
            error = _tracking_error(outcome.measures)
            self.tracking.append((self.watched.elapsed_s, error))
            if self.view is not None:
                self.view.tracking(self.watched.elapsed_s, error)
            if bool(outcome.done):
                state = _next_goal(task, state)

    # What is done with a sample ----------------------------------------------------------------

    def _reset(self) -> None:
        if self.charts is not None:
            self.charts.pause()

    def _sample(self, now: Instant) -> None:
        """Keep, judge and show a sample."""
        self.predicted.append(now.predicted_mm)
        self._early.append(now)
        if self._checks and now.t_s >= self._checks[0]:
            self._checks.pop(0)
            self._check_model()
        statistic = math.nan
        if self.charts is not None:
            statistic = self._judge(now)
        elif not self.request.before and now.t_s >= self.request.reference_s:
            self._late_detector(wait=self.watched.clock.pace == "simulated")
        self.statistic.append(statistic)
        if self.view is not None:
            sample = now.sample
            self.view.sample(
                now.t_s,
                sample.key_points_mm,
                now.predicted_mm,
                sample.measured,
                sample.commanded,
                statistic,
            )
        if now.t_s - self._shown_s >= 1.0:
            self._shown_s = now.t_s
            note = "" if math.isnan(statistic) else f"alarm level {statistic:.2f}"
            total = self._seconds_to_do or 0.0
            self.progress(now.t_s, max(total, now.t_s), note)

    def _judge(self, now: Instant) -> float:
        assert self.charts is not None
        actuation = self.companion.actuation(now.sample)
        alarm = self.charts.update(now.t_s, now.residual_mm, actuation)
        if alarm is not None:
            self._event(alarm.at_s, alarm.sentence, serious=True)
            if self.request.stop_on_alarm:
                self._ended.set()
        return self.charts.statistic

    def _check_model(self) -> None:
        """Raise InputError where the model is that of another arm."""
        if self.request.any_model:
            return
        residual = np.array([now.residual_mm for now in self._early])
        rms = float(np.sqrt(np.nanmean((residual**2).sum(-1))))
        length = self.watched.arm.length_mm or self.model.spec.length_mm or 0.0
        validated = self.model.validation.rmse_mm
        limit = UNVALIDATED_SHARE * length
        if validated is not None:
            limit = max(ANOTHER_ARM * validated, ANOTHER_ARM_SHARE * length)
        if rms > limit > 0.0:
            raise InputError(
                f"the model lies {rms:.2f} mm from the measured key points of rig "
                f"'{self._rig_name}' ({self._validated}): it is the model of another arm, or frame "
                "or units differ; give the model of this arm, or --any-model to go on"
            )

    @property
    def _validated(self) -> str:
        rmse = self.model.validation.rmse_mm
        return "it was never validated" if rmse is None else f"validated error {rmse:.3f} mm"

    def _late_detector(self, wait: bool) -> None:
        """Fit the detector to the begin of the run, beside the loop; take it where it is there."""
        if self.charts is not None or not self._early:
            return
        reference_s = self.request.reference_s
        if self._fit is None:
            if self._early[-1].t_s < reference_s:
                return
            rows = [now for now in self._early if now.t_s < reference_s]
            runs = stretches(
                np.array([now.t_s for now in rows]),
                np.array([now.run for now in rows]),
                np.array([now.residual_mm for now in rows]),
                np.array([self.companion.actuation(now.sample) for now in rows]),
            )
            known, span = elsewhere(self.model), np.array(self.model.spec.span)
            self._fit = self._worker.submit(fit_detector, runs, span, self.request.alarm, known)
        if not (wait or self._fit.done()):
            return
        detector = self._fit.result()
        self.charts = Charts(detector)
        self._tell_reference(detector)
        run = None
        for at, now in enumerate(self._early):
            if now.t_s >= reference_s:
                if now.run != run:
                    self.charts.pause()
                run = now.run
                statistic = self._judge(now)
                if at < len(self.statistic):
                    self.statistic[at] = statistic

    def _detector(self, before: list[Recording]) -> Detector:
        """The detector from recordings of the unchanged arm."""
        for recording, seen in zip(before, seen_in_fit(self.model, before), strict=True):
            if seen:
                self.on_warning(
                    f"{recording.name}: {seen.words}, "
                    "and its error is smaller there than in the run: false alarms may come more "
                    "often than stated; give an unseen recording by --before"
                )
        runs = [run for recording in before for run in residual_runs(self.model, recording)]
        span = np.array(self.model.spec.span)
        detector = fit_detector(runs, span, self.request.alarm, elsewhere(self.model))
        self._tell_reference(detector)
        return detector

    def _check_reference(self, protocol: Protocol, period_s: float) -> None:
        """Warn before the run where its schedule will not repeat its motions in the reference."""
        once = [commands for _, commands in runs_of(protocol, period_s)]
        scheduled_s = period_s * sum(map(len, once))
        seconds = 60.0 * self.request.minutes if self.request.minutes else scheduled_s
        reference_s, span = self.request.reference_s, np.array(self.model.spec.span)
        if seconds <= reference_s:
            return

        def repeated(least_s: float) -> float:
            """What is repeated in the first seconds of the run."""
            runs, left = [], round(least_s / period_s)
            for commands in itertools.cycle(once):
                part = commands[:left]
                runs.append((period_s * np.arange(len(part)), np.asarray(part, np.float64)))
                left -= len(part)
                if left <= 0:
                    return repeated_share(runs, span, self.request.alarm)
            return 1.0

        share = repeated(reference_s)
        if share >= LEAST_REPEATED:
            return
        longer = [reference_s * times for times in LONGER if reference_s * times < seconds]
        enough = next((each for each in longer if repeated(each) >= SURELY_REPEATED), None)
        advice = "a recording of the same kind of motion (--before)"
        if enough is not None:
            advice = f"a longer reference (--clean {enough:g}), or {advice}"
        self.on_warning(
            f"the first {reference_s:.0f} s of the schedule, the reference, repeat {share:.0%} of "
            f"their motions, expected at least {LEAST_REPEATED:.0%}: no change can be detected "
            f"with them. Give {advice}"
        )

    def _tell_reference(self, detector: Detector) -> None:
        text = (
            f"reference: {detector.reference_s:.0f} s, error {detector.reference_mm:.3f} mm "
            f"({self._validated}); alarm threshold {detector.threshold:.1f}, scale x "
            f"{detector.enlargement:.2f}, for one false alarm in "
            f"{detector.design.false_alarm_h:g} h"
        )
        self._event(self._early[-1].t_s if self._early else 0.0, text)
        if not detector.judges:
            self.on_warning(
                f"the reference of {detector.reference_s:.0f} s does not repeat its motions: "
                f"{detector.repeated:.0%} of it resembles another part of it, expected at least "
                f"{LEAST_REPEATED:.0%}, so no change can be detected. Give a longer reference "
                "(--clean), or a recording of the same kind of motion (--before)"
            )
        rmse = self.model.validation.rmse_mm
        if rmse is not None and detector.reference_mm > SUSPICIOUS * rmse:
            self.on_warning(
                f"the model's error in the reference is {detector.reference_mm:.3f} mm, its "
                f"validated error {rmse:.3f} mm: the arm had changed already, or the model is that "
                "of another arm; later changes are detected, this one is not"
            )

    # Ending ------------------------------------------------------------------------------------

    def _stopped(self) -> bool:
        if self._asked():
            self.interrupted = True
            return True
        return self._ended.is_set()

    @contextmanager
    def _guarded(self, bench: Rig) -> Iterator[None]:
        """Vent and close the rig at the end, and let Ctrl-C and SIGTERM end the run.

        On a simulated rig the run ends after the present sample, or at once with a second signal;
        a real one is stopped by its safety wrapper.
        """
        if isinstance(bench, SafeRig):
            with bench:
                yield
            return
        with ExitStack() as stack:
            stack.callback(close, bench)
            stack.enter_context(self._signals())
            yield

    @contextmanager
    def _signals(self) -> Iterator[None]:
        """Let a signal end the run after the present sample, a second one at once."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def end(number: int, frame: Any) -> None:
            if self._ended.is_set():
                raise KeyboardInterrupt
            self.interrupted = True
            self.ended_by = KeyboardInterrupt() if number == signal.SIGINT else Terminated(number)
            self._ended.set()

        kept = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in kept.items():
                signal.signal(number, handler)

    def _result(self, log: RunLog, clock: Clock) -> RunResult:
        """Write the recording and what belongs to it."""
        charts = self.charts
        alarms = tuple(charts.alarms) if charts is not None else ()
        first = AlarmInfo(alarms[0].at_s, alarms[0].since_s) if alarms else None
        if log.samples:
            self._tell_left_out(log)
        recording = log.finish(self._name, first) if log.samples else None
        if recording is None:
            log.discard()
            raise InputError("the run ended before its first sample; nothing was recorded")
        written: list[Path] = []
        if log.path is not None:
            written.append(log.path)
            if alarms:
                after = after_alarm(log.path)
                part = since(recording, alarms[0].since_s, after.stem)
                save_recording(part, after, self.request.force)
                written.append(after)
            else:
                log.without_alarm()
        return RunResult(
            self.request,
            recording,
            np.array(self.predicted)[: recording.samples],
            np.array(self.statistic)[: recording.samples],
            None if charts is None else charts.detector,
            alarms,
            _judged(charts),
            clock.timing(),
            np.array(self.tracking).reshape(-1, 2),
            self.interrupted,
            self.ended_by,
            tuple(written),
        )


def since(recording: Recording, begin_s: float, name: str) -> Recording:
    """The part of a recording from a time on [s], for a diagnosis of what changed then.

    Rows up to LEAD_IN_S before are kept without their key points: models follow the actuation
    through them, and nothing is compared there.
    """
    rows = recording.t_s >= begin_s - LEAD_IN_S
    points = np.where((recording.t_s >= begin_s)[:, None, None], recording.key_points_mm, np.nan)

    def of(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else values[rows]

    return replace(
        recording,
        name=name,
        t_s=recording.t_s[rows],
        measured=recording.measured[rows],
        key_points_mm=points[rows],
        commanded=of(recording.commanded),
        run=recording.run[rows],
        temp_C=of(recording.temp_C),
        payload_g=of(recording.payload_g),
        alarm=None,
        note=f"{recording.note}, from {begin_s:.1f} s on",
    )


@torch.inference_mode()
def residual_runs(model: ArmModel, recording: Recording) -> list[Stretch]:
    """The residual of a model on each run of a recording."""
    history = history_of([recording], model.spec.actuation)
    predicted = history.rows(model.predict(history)).double().numpy()
    residual = recording.key_points_mm - predicted
    actuation = actuation_of(recording, model.spec.actuation)
    return [Stretch(recording.t_s[r], residual[r], actuation[r]) for r in recording.runs]


def elsewhere(model: ArmModel) -> np.ndarray | None:
    """(d, d) covariance of a model's known error over its whole range [mm^2]; None: not known."""
    known = model.training_residuals
    if known is None:
        return None
    residual = known.residual_mm.double().numpy().reshape(len(known.residual_mm), -1)
    residual = residual[np.isfinite(residual).all(axis=1)]
    return residual.T @ residual / len(residual) if len(residual) else None


def _judged(charts: Charts | None) -> float:
    """Share of blocks that the charts have taken; nan without any block."""
    count = 0 if charts is None else charts.judged + charts.left_out
    return charts.judged / count if charts is not None and count else math.nan


def _tracking_error(measures: dict[str, torch.Tensor]) -> float:
    """The task's error in a step [mm]; nan where it measures none."""
    names = [name for name in measures if name.endswith("error_mm")]
    return float(measures[names[0]][0]) if names else math.nan


def _next_goal(task: Task, state: TaskState) -> TaskState:
    """A new goal for an arm that goes on from where it is."""
    stream, goal = task.goal(state.world.stream)
    steps = torch.zeros_like(state.world.steps)
    return TaskState(replace(state.world, stream=stream, steps=steps), goal)


def _begun(pool: ThreadPoolExecutor) -> ThreadPoolExecutor:
    """A pool of one thread, which has started."""
    pool.submit(int).result()
    return pool


@torch.inference_mode()
def _rehearse(place: Task, policy: Policy) -> None:
    """A few steps in simulation: what loads or compiles when first used does so before the run."""
    episodes = Episodes(place)
    state = episodes.seeded(0, 1)
    for _ in range(REHEARSED):
        actions = policy.act(place, state, episodes.observe(state))
        state, _ = episodes.step(state, actions)


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Keep the interpreter's garbage collector and other threads from delaying the loop."""
    threads, interval = torch.get_num_threads(), sys.getswitchinterval()
    # A caller that left its own objects alone goes on doing so: unfreezing frees them all.
    frozen = gc.get_freeze_count() > 0
    gc.collect()
    if not frozen:
        gc.freeze()
    thresholds = gc.get_threshold()
    gc.set_threshold(*thresholds[:2], OLD_OBJECTS_KEPT)
    torch.set_num_threads(1)
    sys.setswitchinterval(SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)
        torch.set_num_threads(threads)
        gc.set_threshold(*thresholds)
        if not frozen:
            gc.unfreeze()


@contextmanager
def _real_time_priority() -> Iterator[None]:
    """Real-time priority of this process's threads, where the system has it and permits it.

    All threads that are there get it: one of lower priority that is held up while it has the
    interpreter would hold up the loop. What they start later has none (`SCHED_RESET_ON_FORK`).
    """
    before: dict[int, tuple[int, Any]] = {}
    with suppress(AttributeError, OSError):  # no such call on this system, or not permitted
        policy = os.SCHED_RR | os.SCHED_RESET_ON_FORK
        for name in os.listdir("/proc/self/task"):
            thread = int(name)
            kept = os.sched_getscheduler(thread), os.sched_getparam(thread)
            os.sched_setscheduler(thread, policy, os.sched_param(PRIORITY))
            before[thread] = kept
    try:
        yield
    finally:
        for thread, kept in before.items():
            with suppress(OSError):  # it has ended
                os.sched_setscheduler(thread, *kept)
