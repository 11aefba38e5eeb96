"""How measured actuation follows its command: the first-order lag and dead time of each channel.

    lag dy/dt = gain u(t - dead time) + offset - y,      u holds from its row to the next.

Here u is the command and y the measurement. Gain and offset are those of least squares, lag and
dead time those of a grid that is refined twice.
Readings that a first fit misses by far take no part.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surgisoft.measurement.recordings.recording import Recording

MOST_ROWS = 4000
"""Rows that are looked at: those of the stretch in which the commands move most (a count)."""
LEAST_ROWS = 50
"""Fewest rows of which a lag is told (a count)."""
LONGEST_LAG_S = 10.0
"""Longest lag that is tried [s]."""
LONGEST_DEAD_S = 1.0
"""Longest dead time that is tried [s]."""
LAGS, DEAD_TIMES = 20, 15
"""Lags and dead times of the first grid (counts)."""
REFINED = 7
"""Lags and dead times of a refined grid (a count)."""
MOST_LEFT = 0.02
"""Largest share of a channel's variance that the lag may leave: beyond, it is no such lag [-]."""
LEAST_GAIN = 0.5
"""Least share of what a channel without a lag leaves that the lag explains: below, none shows."""
OUTLIER = 6.0
"""Robust standard deviations beyond which a reading may be an outlier of the sensor, and ..."""
OUTLIER_SHARE = 0.5
"""... standard deviations of the whole channel beyond which it is one: a step that a first-order
lag does not fit exactly is none [-]."""
DEAD_GAIN = 0.1
"""Least share of what a lag alone leaves that a dead time explains: below, none shows [-]."""
LEAST_DEAD = 0.5
"""Shortest dead time that is told, in rows: the rows show none that is shorter [-]."""
LEAST_CHANGE = 0.3
"""Least difference of two delays that is told, as a share of the longer one ..."""
LEAST_CHANGE_S = 0.03
"""... and in seconds."""


@dataclass(frozen=True)
class ValveLag:
    """How one measured channel follows its command."""

    lag_s: float
    """Time constant [s]."""
    dead_s: float
    """Dead time before it; 0 where none shows [s]."""
    left: float
    """Share of the channel's variance that is left [-]."""

    @property
    def delay_s(self) -> float:
        """By how much the measurement follows a ramp of the command late [s]."""
        return self.lag_s + self.dead_s


def valve_lags(recording: Recording) -> list[ValveLag | None]:
    """The lag of each channel; None where the channel rests or has no such lag that shows.

    Empty without a command, and for steady-state samples.
    """
    if recording.commanded is None or recording.kind == "settled":
        return []
    chosen = _moving(recording)
    step = _step_s(recording)
    if chosen is None or step <= 0.0:
        return [None] * recording.chambers
    look = _Look(recording, chosen)
    lags = np.concatenate([[0.0], np.geomspace(step / 4, LONGEST_LAG_S, LAGS)])
    dead = np.linspace(0.0, LONGEST_DEAD_S, DEAD_TIMES)
    every = np.repeat(lags[:, None], recording.chambers, 1)
    look.leave_out(look.least(every, dead[:1]))
    alone = look.least(every, dead[:1])
    none = np.zeros((1, recording.chambers))
    plain = look.left(none, none)[0, 0]
    both = look.least(every, dead)
    return [_told(float(p), a, b, step) for p, a, b in zip(plain, alone, both, strict=True)]


def _told(plain: float, alone: ValveLag, both: ValveLag, step_s: float) -> ValveLag | None:
    """What is told of a channel; plain: share that is left without a lag; alone: no dead time."""
    dead = both.dead_s >= LEAST_DEAD * step_s and both.left <= (1 - DEAD_GAIN) * alone.left
    found = both if dead else alone
    shows = found.left <= min(MOST_LEFT, (1 - LEAST_GAIN) * plain)
    return found if shows and found.delay_s >= step_s else None


class _Look:
    """Rows of a recording, behind lags and dead times of the command."""

    def __init__(self, recording: Recording, rows: slice):
        command = recording.commanded
        assert command is not None, "only recordings with a command have lags"
        self.t_s = recording.t_s[rows]
        self.command, self.measured = command[rows], recording.measured[rows]
        self.kept = np.ones(self.measured.shape)
        self.first = np.concatenate([[True], np.diff(recording.run[rows]) != 0])
        steps = np.where(self.first, 1.0, np.diff(self.t_s, prepend=self.t_s[0]).clip(min=0.0))
        self.clock_s = np.cumsum(steps)
        """(T,) times that increase from run to run [s]."""
        self.begin_s = self.clock_s[self.first][np.cumsum(self.first) - 1]
        """(T,) the time at which each row's run begins [s]."""

    def least(self, lags: np.ndarray, dead: np.ndarray) -> list[ValveLag]:
        """For each channel the best of lags (K, m) and dead times (J,), refined twice [s]."""
        chambers = lags.shape[1]
        every = np.repeat(dead[:, None], chambers, 1)
        for _ in range(3):
            left = self.left(lags, every)
            lowest = left.reshape(-1, chambers).argmin(0)
            places = np.transpose(np.unravel_index(lowest, left.shape[:2]))
            found = [
                ValveLag(float(lags[a, k]), float(every[d, k]), float(left[a, d, k]))
                for k, (a, d) in enumerate(places)
            ]
            lags = _around(lags, [int(a) for a, _ in places])
            every = _around(every, [int(d) for _, d in places])
        return found

    def leave_out(self, found: list[ValveLag]) -> None:
        """Leave out the readings that these lags miss by far."""
        behind = self._lagged(np.array([[each.lag_s for each in found]]))
        for k in range(len(found)):
            x, y = behind[:, 0, k], self.measured[:, k]
            slope = np.cov(x, y)[0, 1] / max(float(x.var(ddof=1)), 1e-300)
            off = y - slope * x
            off = np.abs(off - np.median(off))
            least = max(OUTLIER * 1.4826 * np.median(off), OUTLIER_SHARE * y.std())
            self.kept[:, k] = off <= least

    def left(self, lags: np.ndarray, dead: np.ndarray) -> np.ndarray:
        """(K, J, m) share of each channel's variance that lags (K, m), dead times (J, m) leave."""
        behind = self._lagged(lags)
        own = self.measured - np.average(self.measured, axis=0, weights=self.kept)
        total = (self.kept * np.square(own)).sum(0)
        answer = np.ones((len(lags), *dead.shape))
        for j, late in enumerate(dead):
            for k, seconds in enumerate(late):
                values, kept = self._late(behind[:, :, k], float(seconds)), self.kept[:, k]
                values = values - kept @ values / kept.sum()
                size = kept @ np.square(values)
                both = (kept * own[:, k]) @ values
                explained = both**2 / np.maximum(size * total[k], 1e-300)
                answer[:, j, k] = np.where(both > 0, 1.0 - explained, 1.0)
        return answer

    def _lagged(self, lags: np.ndarray) -> np.ndarray:
        """(T, K, m) command behind first-order lags (K, m), at rest where a run begins."""
        steps = np.diff(self.t_s, prepend=self.t_s[0]).clip(min=0.0)[:, None, None]
        keep = np.exp(-steps / np.maximum(lags, 1e-9))
        answer = np.empty((len(self.t_s), *lags.shape))
        state = np.zeros(lags.shape)
        for row, command in enumerate(self.command):
            if self.first[row]:
                state = np.broadcast_to(command, lags.shape)
            else:
                held = self.command[row - 1]
                state = held + keep[row] * (state - held)
            answer[row] = state
        return answer

    def _late(self, values: np.ndarray, late_s: float) -> np.ndarray:
        """(T, K) of values (T, K), so much later; the first of its run where there is none yet."""
        if late_s == 0.0:
            return values
        wanted = np.maximum(self.clock_s - late_s, self.begin_s)
        place = np.interp(wanted, self.clock_s, np.arange(len(values)))
        low = np.minimum(place.astype(int), max(len(values) - 2, 0))
        part = (place - low)[:, None]
        return values[low] * (1.0 - part) + values[low + 1] * part


def _around(grid: np.ndarray, places: list[int]) -> np.ndarray:
    """(REFINED, m) values around one of a grid (K, m) for each channel; (1, m) of one value."""
    if len(grid) == 1:
        return grid
    low = [grid[max(place - 1, 0), k] for k, place in enumerate(places)]
    high = [grid[min(place + 1, len(grid) - 1), k] for k, place in enumerate(places)]
    return np.linspace(low, high, REFINED)


def _moving(recording: Recording) -> slice | None:
    """The rows in which the commands move most; None for too few rows or no motion."""
    command = recording.commanded
    assert command is not None, "only recordings with a command have lags"
    span = np.ptp(command, axis=0)
    if recording.samples < LEAST_ROWS or not span.any() or not np.isfinite(command).all():
        return None
    if not np.isfinite(recording.measured).all():
        return None
    moved = np.abs(np.diff(command, axis=0, prepend=command[:1]))[:, span > 0] / span[span > 0]
    total = np.concatenate([[0.0], np.cumsum(moved.sum(1))])
    count = min(MOST_ROWS, recording.samples)
    start = int((total[count:] - total[:-count]).argmax())
    return slice(start, start + count)


def _step_s(recording: Recording) -> float:
    """Usual time between rows, s; 0 where there is none."""
    steps = [np.diff(recording.t_s[run]) for run in recording.runs]
    every = np.concatenate(steps)
    return float(np.median(every)) if len(every) else 0.0


def valve_words(recording: Recording) -> str:
    """The lags in one line; empty where none shows."""
    lags = valve_lags(recording)
    if not any(lags):
        return ""
    text = f"lag {_listed([each.lag_s if each else None for each in lags])} s"
    if any(each.dead_s for each in lags if each):
        text += (
            f" behind a dead time of {_listed([each.dead_s if each else None for each in lags])} s"
        )
    unknown = " (- where a channel has no first-order lag that shows)" * (not all(lags))
    return f"measured follows commanded: {text}{unknown}"


def _listed(values: list[float | None]) -> str:
    return ", ".join("-" if value is None else f"{value:.2g}" for value in values)


def changed_valves(after: Sequence[Recording], before: Sequence[Recording]) -> str:
    """What differs between the lags of recordings and of those from before, in words; or empty.

    Channels are compared by the median over the recordings that show their lag.
    """
    then = _medians(before)
    if not any(then):
        return ""
    now, changes = _medians(after), []
    for k, (new, old) in enumerate(zip(now, then, strict=False)):
        if new is None or old is None:
            continue
        apart = abs(new - old)
        if apart >= max(LEAST_CHANGE * max(new, old), LEAST_CHANGE_S):
            changes.append(f"channel {k + 1} by {new:.2g} s, before by {old:.2g} s")
    return f"measured follows commanded with another delay: {'; '.join(changes)}" if changes else ""


def _medians(recordings: Sequence[Recording]) -> list[float | None]:
    """Delay of each channel [s]; None where no recording shows it."""
    rows = [lags for each in recordings if (lags := valve_lags(each))]
    columns = [[each.delay_s for each in column if each] for column in zip(*rows, strict=False)]
    return [float(np.median(column)) if column else None for column in columns]
