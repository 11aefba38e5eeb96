"""What no function of the actuation and its past explains: breaks and periodic motion.

Every effect of the list acts through the actuation, its past or the time since the start, and all
the while. Much of what is not in the list does not: a knock or a torn fibre changes the arm at one
moment, a marker slips once, a body that breathes moves the arm whatever the actuation is. Two tests
look for that in what a black box with memory leaves, without asking what it is:

- a *break*: one moment from which on the residual is another function of the actuation, to first
  order. The moment is searched (Andrews 1993, "Tests for parameter instability and structural
  change with unknown change point"; with a known moment: Chow 1960), and held-out blocks judge;
- a *line*: one frequency that holds much of what is left, and neither of the actuation nor of the
  predicted motion (Fisher 1929, "Tests of significance in harmonic analysis").

A third test has a form of its own, because two effects of the list resemble it: a *sudden turn*, a
rigid turn and shift of the whole body that sets in at one moment. A frame that is turned from the
beginning (misalignment) and a holder that yields gradually (drift) imitate it, and a black box that
knows the time learns it. In the terms of fault diagnosis it is an abrupt fault beside an incipient
one (Isermann 2006, "Fault-Diagnosis Systems", sec. 2.2).
"""

from dataclasses import dataclass

import numpy as np

from surgisoft.diagnosis import change_points
from surgisoft.diagnosis.cross_validation import CrossValidation, Split
from surgisoft.diagnosis.residuals import Problem
from surgisoft.diagnosis.statistics import FoldsOfRidge, block_sums

RIDGES = (0.5, 5.0, 50.0)
"""Ridges on the features of the black box that are tried, for features of mean square 1 in all: up
to the weight of as many rows. The best on held-out blocks is taken."""
LEAST_PERIODS = 4.0
"""Fewest periods in a recording: below, a line is not told from a slow drift."""
OVERSAMPLED = 2
"""Points of the spectrum for each of its independent ones: a line between two points would lose
half of its power, and loses a fifth."""
LEAST_ABOVE = 0.25
"""Least share of the squared remainder that counts as above the noise: how large the noise is, is
not known better, and of next to nothing any line is all."""


@dataclass(frozen=True, eq=False)
class BeyondHistory:
    """Error that a black box with memory leaves, and the shares that breaks and lines explain."""

    losses: np.ndarray
    """(B,) held-out sum of squared distances by block of the black box, mm^2."""
    break_losses: np.ndarray
    """(B,) held-out sum of squared distances by block with the best break besides, mm^2."""
    break_at: float
    """Place of that break, as a share of the rows, 0 to 1."""
    line: float
    """Share of the remainder's power above the noise in its strongest line, less the shares that
    actuation and predicted motion have there, 0 to 1."""
    line_hz: float
    """Frequency of that line, Hz; 0 where there is none."""


def beyond_history(problem: Problem, features: np.ndarray) -> BeyondHistory:
    """Look for a break and for a line in what the features (S, F) of a black box leave."""
    seen = np.isfinite(problem.residual).all(2)
    target = np.where(seen[..., None], problem.residual, 0.0).reshape(len(seen), -1)
    ones = np.ones((len(target), 1))
    columns = np.concatenate([ones, features], axis=1).astype(np.float32)
    folds = FoldsOfRidge(columns, target.astype(np.float32), problem.fold[problem.block])
    tried = [folds.remainder(ridge) for ridge in RIDGES]
    best = int(np.argmin([np.square(each, dtype=float).sum() for each in tried]))
    remainder = tried[best]
    state = np.concatenate([ones, problem.pressure], axis=1).astype(np.float32)
    places = change_points.coarse()
    broken = folds.with_breaks(RIDGES[best], state, (places * len(target)).astype(int))
    sums = [np.square(each, dtype=float).sum() for each in broken]
    place = int(np.argmin(sums))

    line, line_hz = strongest_line(problem, remainder)

    def losses(rows: np.ndarray) -> np.ndarray:
        return block_sums(np.square(rows, dtype=float).sum(1), problem.block)

    return BeyondHistory(
        losses=losses(remainder),
        break_losses=losses(broken[place]),
        break_at=float(places[place]),
        line=line,
        line_hz=line_hz,
    )


@dataclass(frozen=True, eq=False)
class SuddenTurn:
    """A rigid turn and shift of the whole body that sets in at one moment."""

    losses: np.ndarray
    """(B,) held-out sum of squared distances by block with the best of the coarse moments, mm^2."""
    at: float
    """Its place, as a share of the rows, 0 to 1, refined between the neighbours of that moment."""


def sudden_turn(split: Split, points: np.ndarray) -> SuddenTurn:
    """The best sudden turn on the rows of a split, the model discrepancy beside it.

    points: (S, n, 3) predicted key points, mm. To first order each point p moves by w x p + d from
    the moment on. Held-out blocks choose the moment.
    """
    axes = np.eye(3)
    turned = np.cross(axes, points[:, :, None, :])  # (S, n, 3 axes, 3)
    rigid = np.concatenate([turned, np.broadcast_to(axes, turned.shape)], axis=2).swapaxes(2, 3)
    place, losses = _best_moment(split, rigid, change_points.coarse())
    place, _ = _best_moment(split, rigid, change_points.finer(place))
    return SuddenTurn(losses, place)


def _best_moment(
    split: Split, sensitivities: np.ndarray, places: np.ndarray
) -> tuple[float, np.ndarray]:
    """The place from which on sensitivities (S, n, 3, k), mm, leave least; what is left (B,), mm^2.

    places: shares of the rows, 0 to 1, that are tried.
    """
    rows, size = len(sensitivities), sensitivities.shape[3]
    behind = [np.arange(rows) >= int(place * rows) for place in places]
    single = sensitivities.astype(np.float32)  # as the cross-validation keeps them
    parts = [single * each[:, None, None, None] for each in behind]
    validation = CrossValidation.on(split, parts)
    losses = [validation.losses(range(n * size, (n + 1) * size)) for n in range(len(places))]
    best = int(np.argmin([each.sum() for each in losses]))
    return float(places[best]), losses[best]


def strongest_line(problem: Problem, remainder: np.ndarray) -> tuple[float, float]:
    """Share of the power above the noise (S, C) in the strongest line that is only there, and its
    frequency in Hz; above half the rate of the problem's rows it is that of its alias."""
    spectrum = _Spectrum.of(problem)
    if spectrum is None:
        return 0.0, 0.0
    power = float(np.square(remainder - remainder.mean(0), dtype=float).sum(1).mean())
    noise = float(np.square(problem.noise_mm).sum())
    above = max(power - noise, LEAST_ABOVE * power, 1e-30)
    own = spectrum.power(remainder) / above
    others = np.zeros_like(own)
    predicted = problem.predicted.reshape(len(remainder), -1)
    for each in (problem.pressure, problem.direction, predicted):
        spread = float(np.square(each - each.mean(0)).sum(1).mean())
        if spread > 0:
            others = np.maximum(others, spectrum.power(each) / spread)
    apart = own - others
    if not apart.size or apart.max() <= 0.0:
        return 0.0, 0.0
    best = int(apart.argmax())
    return float(min(apart[best], 1.0)), spectrum.hertz(best)


@dataclass(frozen=True, eq=False)
class _Spectrum:
    """Power of series on a grid of frequencies, the recordings' phases independent."""

    groups: list[tuple[np.ndarray, np.ndarray]]
    """For each recording its rows, and their places on an even grid of time."""
    points: int
    """Points of the transform."""
    first: int
    """First frequency that counts."""
    step_s: float
    """Time between two points, s."""

    @classmethod
    def of(cls, problem: Problem) -> "_Spectrum | None":
        """The spectrum of a problem's rows; None where they do not follow each other in time."""
        index = problem.index.numpy()
        timed = problem.table.timed[index]
        recording, time = problem.table.recording[index], problem.time_s
        steps = np.diff(time)[(np.diff(recording) == 0) & (np.diff(time) > 0)]
        if not timed.all() or not len(steps):
            return None
        step = float(np.median(steps))
        groups, longest = [], 0
        for number in np.unique(recording):
            rows = np.flatnonzero(recording == number)
            places = np.rint((time[rows] - time[rows[0]]) / step).astype(int)
            groups.append((rows, places))
            longest = max(longest, int(places.max()) + 1)
        points = 1 << int(np.ceil(np.log2(max(OVERSAMPLED * longest, 2))))
        return cls(groups, points, int(np.ceil(LEAST_PERIODS * points / longest)), step)

    def hertz(self, line: int) -> float:
        """Frequency of one of the lines of `power`, Hz."""
        return (self.first + line) / (self.points * self.step_s)

    def power(self, series: np.ndarray) -> np.ndarray:
        """(F,) power of a series (S, C) in each line: its own mean square for a sine."""
        series = series - series.mean(0)
        total = np.zeros(self.points // 2 + 1)
        for rows, places in self.groups:
            even = np.zeros((self.points, series.shape[1]), np.float32)
            even[np.minimum(places, self.points - 1)] = series[rows]
            found = np.abs(np.fft.rfft(even, axis=0)) ** 2
            total += 2.0 * found.sum(1) / len(rows)
        return total[self.first :] / sum(len(rows) for rows, _ in self.groups)
