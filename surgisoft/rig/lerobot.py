"""A rig as LeRobot's robots are driven: named numbers out, named numbers in; no LeRobot needed.

The plug-in package `lerobot_robot_surgisoft` (folder `plugins` of the repository) wraps `NamedRig`
and `NamedSchedule` in LeRobot's own base classes, so that `lerobot-record
--robot.type=surgisoft_rig --teleop.type=surgisoft_schedule` finds them.
"""

import math
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack

import numpy as np

from surgisoft.errors import InputError
from surgisoft.measurement.protocols.schedule_file import load_schedule
from surgisoft.rig.interface import Rig, vented
from surgisoft.rig.registry import open_rig
from surgisoft.rig.safety import guarded


class NamedRig:
    """A rig by the names that a recording's columns have: p1_kPa, k0_x_mm; c1_kPa.

    A real rig is driven inside its safety limits (`SafeRig`), and vented by `disconnect`.
    """

    def __init__(self, rig: str = "virtual", hold_missing: bool = False):
        """rig: name and options as of every command's `--rig`.

        hold_missing: whether a key point that the cameras lost keeps its last position, which
        policies need that cannot take NaN; a dataset then has values that nobody measured.
        """
        self._text, self.hold_missing = rig, hold_missing
        self._opened: Rig = open_rig(rig)
        self._driven: Rig | None = None
        self._open = ExitStack()
        self._last: dict[str, float] = {}
        self._command = vented(self._opened.limits)

    @property
    def state_names(self) -> list[str]:
        """Names of what `observe` returns."""
        rig = self._opened
        points = [f"k{j}_{axis}_mm" for j in range(rig.key_planes) for axis in "xyz"]
        return [f"p{i + 1}_{rig.unit}" for i in range(rig.chambers)] + points

    @property
    def action_names(self) -> list[str]:
        """Names of the commanded actuation."""
        return [f"c{i + 1}_{self._opened.unit}" for i in range(self._opened.chambers)]

    @property
    def rate_Hz(self) -> float:
        """Samples a second that the rig gives."""
        return 1.0 / self._opened.period_s

    @property
    def is_connected(self) -> bool:
        """Whether the rig is being driven."""
        return self._driven is not None

    def connect(self) -> None:
        """Begin to drive: vent the arm and wait until it is at rest.

        Where that fails the devices are given back, and the rig is not connected.
        """
        if self._driven is not None:
            raise InputError(f"rig '{self._text}': connected already")
        self._driven = self._open.enter_context(guarded(self._opened))
        try:
            self._driven.reset()
        except BaseException:
            self.disconnect()
            raise
        self._command = vented(self._driven.limits)

    def disconnect(self) -> None:
        """Vent the arm and give the devices back."""
        self._driven = None
        self._open.close()

    def observe(self) -> dict[str, float]:
        """One sample: measured actuation [unit] and key points [mm, arm base frame]."""
        sample = self._rig().read()
        values = np.concatenate([sample.measured, sample.key_points_mm.reshape(-1)])
        found = dict(zip(self.state_names, values.tolist(), strict=True))
        if self.hold_missing:
            found = {
                name: self._last.get(name, value) if math.isnan(value) else value
                for name, value in found.items()
            }
        self._last = found
        return found

    def send(self, action: Mapping[str, float]) -> dict[str, float]:
        """Command an actuation [unit]; returns what was sent.

        Values beyond the rig's limits are clipped, and one that is not finite leaves its chamber
        where it was. Raises InputError for missing names.
        """
        rig = self._rig()
        lacking = [name for name in self.action_names if name not in action]
        if lacking:
            raise InputError(
                f"rig '{self._text}': the action lacks {lacking[0]}; expected "
                f"{', '.join(self.action_names)}"
            )
        asked = np.array([float(action[name]) for name in self.action_names])
        asked = np.where(np.isfinite(asked), asked, self._command)
        self._command = np.clip(asked, *np.asarray(rig.limits, np.float64).T)
        rig.command(self._command)
        return dict(zip(self.action_names, self._command.tolist(), strict=True))

    def _rig(self) -> Rig:
        if self._driven is None:
            raise InputError(f"rig '{self._text}': not connected; call connect() first")
        return self._driven


class NamedSchedule:
    """A schedule file (CSV; t_s, c1_kPa ...) as commands by name, in the place of a teleoperator.

    Its clock begins with the first command that is asked for. Between rows the command is linear; a
    schedule that is over begins again, and so does one that nobody asked for longer than GAP_S.
    """

    GAP_S = 1.0
    """Longest time between two commands of one run through the schedule [s]."""

    def __init__(self, path: str, clock: Callable[[], float] = time.monotonic):
        """path: the CSV file; clock: time [s]. Raises InputError for several runs in the file."""
        protocol = load_schedule(path)
        if len(np.unique(protocol.run)) > 1:
            raise InputError(f"{path}: {len(np.unique(protocol.run))} runs; expected one")
        assert protocol.t_s is not None
        self.names = [f"c{i + 1}_{protocol.unit}" for i in range(protocol.commands.shape[1])]
        self._times, self._commands = protocol.t_s - protocol.t_s[0], protocol.commands
        self._clock = clock
        self._begun_s = self._last_s = -math.inf

    def command(self) -> dict[str, float]:
        """The command at this time [unit]."""
        now_s = self._clock()
        if now_s - self._last_s > self.GAP_S:
            self._begun_s = now_s
        self._last_s = now_s
        at_s = (now_s - self._begun_s) % max(self._times[-1], 1e-9)
        values = [float(np.interp(at_s, self._times, column)) for column in self._commands.T]
        return dict(zip(self.names, values, strict=True))
