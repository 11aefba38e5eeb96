"""The actuation's clock: values between rows, logs that are late, readings that were held."""

from dataclasses import dataclass

import numpy as np

SAME_TIME_S = 1e-6
"""Times that differ by no more are the same [s]."""
LARGEST_GAP_S = 1.0
"""A late log is not read inside a longer gap of its own [s]."""


@dataclass(frozen=True, eq=False)
class Between:
    """Where each time (T,) lies between the rows (R,) of a log."""

    before: np.ndarray
    """(T,) index of the row before or at it."""
    after: np.ndarray
    """(T,) index of the row after it."""
    share: np.ndarray
    """(T,) how far between them, 0 to 1; exactly 0 or 1 on a row, up to SAME_TIME_S."""
    gap_s: np.ndarray
    """(T,) time between the two rows [s]; 0 on a row."""
    inside: np.ndarray
    """(T,) bool: not before the first row nor after the last."""

    @classmethod
    def of(cls, own: np.ndarray, t_s: np.ndarray) -> "Between":
        """Times t_s (T,) among a log's own increasing times (R,) [s]."""
        before = np.searchsorted(own, t_s + SAME_TIME_S, side="right") - 1
        before = np.clip(before, 0, max(len(own) - 2, 0))
        after = np.minimum(before + 1, len(own) - 1)
        gap = own[after] - own[before]
        share = np.clip((t_s - own[before]) / np.where(gap > 0, gap, 1.0), 0, 1)
        share[np.abs(t_s - own[before]) <= SAME_TIME_S] = 0
        share[np.abs(t_s - own[after]) <= SAME_TIME_S] = 1
        inside = (t_s >= own[0] - SAME_TIME_S) & (t_s <= own[-1] + SAME_TIME_S)
        return cls(before, after, share, np.where((share == 0) | (share == 1), 0.0, gap), inside)

    def linear(self, values: np.ndarray) -> np.ndarray:
        """(T, c) of the log's values (R, c), on a line between the two rows."""
        first, second = values[self.before], values[self.after]
        share = self.share[:, None]
        line = first + share * (second - first)
        return np.where(share == 0, first, np.where(share == 1, second, line))

    def held(self, values: np.ndarray) -> np.ndarray:
        """(T, c) of the log's values (R, c), each held until the next row."""
        on_next = (self.share == 1)[:, None]
        return np.where(on_next, values[self.after], values[self.before])


def renewed_rows(values: np.ndarray) -> np.ndarray:
    """(F,) rows of values (T, m) that differ from the row before in any column, and the first."""
    return np.flatnonzero(np.r_[True, (values[1:] != values[:-1]).any(axis=1)])


def renewal_s(parts: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """The usual (median) time between two readings [s], of (times (T,), values (T, m)) by run.

    0 where no run has two readings.
    """
    steps = [np.diff(t_s[renewed_rows(values)]) for t_s, values in parts]
    steps = np.concatenate([np.empty(0), *steps])
    return float(np.median(steps)) if len(steps) else 0.0


def without_holds(t_s: np.ndarray, values: np.ndarray, period_s: float) -> np.ndarray:
    """(T, m) readings that were held until the next one, on a line between them instead.

    t_s: (T,) [s]; values: (T, m). A reading that repeats for much longer than the period in which
    the sensor is read was renewed with the same value meanwhile: it stays until one period before
    the next one. The last reading of all stays to the end.
    """
    fresh = renewed_rows(values)
    times, known = [t_s[fresh]], [values[fresh]]
    start, end = fresh[:-1], fresh[1:]
    long = t_s[end] - t_s[start] > 1.5 * period_s
    times.append(t_s[end[long]] - period_s)
    known.append(values[start[long]])
    own, rows = np.concatenate(times), np.concatenate(known)
    order = np.argsort(own, kind="stable")
    return Between.of(own[order], np.minimum(t_s, own.max())).linear(rows[order])
