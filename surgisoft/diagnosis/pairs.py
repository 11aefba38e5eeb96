"""Before and after: rows of two sets of recordings that were made with the same actuation.

A model's residual holds what the model cannot describe. Where the same actuation was recorded
before and after a change, that part is the same in both and cancels in the *paired difference*

    d(t) = [y_after(t) - f(u_after)(t)] - [y_before(t') - f(u_before)(t')],    t' = t + delay,

with y the measured key points and f the model's prediction, memory included. With equal actuation
the two predictions are equal and d is measured minus measured; where the actuation differs a
little, f(u_after) - f(u_before) is the first-order (and higher) correction for it. So the residual
does not depend on how good the model is; only the sensitivities of the candidate effects do.

An effect that acts before and after alike cancels as far as it is additive: what hysteresis or
creep does to the *change* (a load moves the arm along another loop) is of second order and stays.

Partners are found in three steps: windows of AFTER are searched in BEFORE by the mean squared
difference of the actuation over all delays (computed by FFT); each delay that explains windows is
refined to a fraction of a sample; a row is paired where the actuation agreed over the seconds
before it. Delay estimation by matching: Knapp & Carter 1976, here with a squared difference in
place of a correlation, because the level of an actuation counts.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.fft import irfft, next_fast_len, rfft

from surgisoft.diagnosis.abrupt import body_jumps, own_jumps_mm
from surgisoft.diagnosis.discrepancy import LENGTHS
from surgisoft.diagnosis.known_error import known_error, rows_before
from surgisoft.diagnosis.residuals import (
    BLOCK_ROWS,
    LEAST_BLOCKS,
    LEAST_DISCREPANCY,
    MOTION_ALIKE,
    ROWS,
    STILL,
    Floor,
    ModelFit,
    Problem,
    ResidualTable,
    model_discrepancy,
    model_fit,
    residual_table,
)
from surgisoft.errors import InputError, unknown_name
from surgisoft.measurement.histories import faster_in_words, speed_of_runs
from surgisoft.measurement.recordings import Recording

WINDOW_S = 20.0
"""Length of the windows of AFTER that are searched in BEFORE, s: several blocks of time."""
WINDOW_SHARE = 0.5
"""Longest window as a share of the shorter of two runs, so that delays of up to the other half are
found."""
STRIDE_SHARE = 0.5
"""Distance of two windows as a share of their length."""
GRID_ROWS = 20_000
"""Most samples of a run in the search; longer runs are searched on a coarser grid."""
ALIKE = MOTION_ALIKE / 2
"""Largest difference of the actuation, as a share of its range, at which two rows count as the same
(root mean square over the past, any chamber): the one up to which two blocks show the same motion.
The difference that remains is corrected by the model."""
EXACT = ALIKE / 10
"""Largest difference of the actuation, as a share of its range, in exact repeats, as of one
protocol by its commands: the model's correction is then too small for its error to matter."""
ALIKE_NOISES = 4.0
"""Or: so many standard deviations of the actuation's noise in both recordings."""
ALIKE_NOW = 2.0
"""Largest difference at the row itself, in multiples of the one over the past."""
NOISE_SHARE = 0.5
"""Least repeatability, as a share of the noise floor, which may be stated too large."""
MORE_ROWS = 1.1
"""Rows that the measured actuation must pair, as a multiple of those of the commands, to be taken
in their place: its noise makes pairs less exact."""
PAST_S = 2.0
"""Time before a row over which the actuation must agree, s: the longest of the memories by which
motions are told apart (`residuals.MOTION_TIMES_S`)."""
MOVES = STILL / 2
"""A window counts where a chamber moves, RMS, by this share of its range: at rest every delay
fits."""
NEAR = 2.0
"""Largest difference that counts for the refinement of a delay, in multiples of what counts as the
same."""
REFINEMENTS = 8
"""Most Newton steps of a delay."""
APART_S = 10.0
"""Least delay at which a run repeats itself, s; a smaller one is the run itself."""
IDLE = 0.1
"""Motion of a chamber, as a share of that of the one that moves most, below which it is nearly
idle: as much as two motions may differ (`residuals.MOTION_ALIKE`)."""
LEAST_SHARE = 0.5
"""Share of the training rows of AFTER that must have a partner for the paired difference to be
used: it says nothing of the other rows. Two schedules of ten minutes that were drawn by chance have
minutes of rest and of equal ramps in common, which need not show what changed."""
NOISIER = 1.5
"""Noise of AFTER, as a multiple of that of BEFORE, from which on it is told where it counts."""
LEAST_ROWS = 2 * LEAST_BLOCKS * BLOCK_ROWS
"""Fewest rows with a partner, in any case."""
LEAST_S = 60.0
"""Time with a partner that suffices although fewer rows have one, where pairs are asked for
(`--paired always`), s."""
SPECTRUM_S = 20.0
"""Longest stretch of a power spectrum, s: four blocks of time."""
FREE_POWER = 4.0
"""Power of the measured motion over that of the predicted one from which motion is free."""
COHERENCE_S = 5.0
"""Longest stretch of a spectrum from which coherence is estimated, s: one block of time, which
resolves the resonance of a damped arm and leaves many stretches to average."""
LEAST_STRETCHES = 4
"""Fewest stretches of such spectra; of fewer, fast motion does not count as repeated."""
LEAST_BINS = 8
"""Lowest frequency at which motion can be free, in steps of the spectrum: below it the few bins say
little, and creep and drift act there."""


@dataclass(frozen=True)
class Stretch:
    """Rows of one run of AFTER that have their partners in one run of BEFORE at one delay."""

    after: str
    """Recording of AFTER."""
    after_run: int
    """Run, counted over all recordings of AFTER."""
    before: str
    """Recording of BEFORE."""
    before_run: int
    """Run, counted over all recordings of BEFORE."""
    delay_s: float
    """Time in BEFORE less time in AFTER, s; rows in place of s for steady-state samples."""
    rows: int
    """Rows of AFTER that are paired so."""
    mismatch: float
    """RMS difference of the actuation over these rows, as a share of its range."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """The partners of the N rows of AFTER in BEFORE, and how well BEFORE repeats itself.

    What is made of the partners is computed when it is read. What pairs say about errors is of
    training rows.
    """

    after: ResidualTable
    """Residuals of the model on AFTER."""
    earlier: ResidualTable
    """Residuals of the model on BEFORE."""
    found: "_Found"
    """The partners."""

    @property
    def before(self) -> tuple[str, ...]:
        """Names of the recordings of BEFORE."""
        return self.earlier.names

    @property
    def stretches(self) -> tuple[Stretch, ...]:
        """What was paired with what, the longest first."""
        return self.found.stretches

    @property
    def partners(self) -> np.ndarray:
        """(N,) runs of BEFORE that a row has a partner in; partners are averaged."""
        return self.found.partners

    @property
    def partner_t_s(self) -> np.ndarray:
        """(N,) time of the first partner in its recording, s; NaN where there is none."""
        return self.found.partner_t_s

    @property
    def paired(self) -> np.ndarray:
        """(N,) bool: rows with a partner."""
        return self.partners > 0

    @property
    def after_mm(self) -> np.ndarray:
        """(N, n, 3) measured key points of AFTER, base frame, mm; NaN where missing."""
        return self.after.measured_mm

    @property
    def before_mm(self) -> np.ndarray:
        """(N, n, 3) measured key points of the partner, corrected for the difference of the
        actuation, base frame, mm; NaN where there is none."""
        return self._measured_before_mm + self.correction_mm

    @cached_property
    def change_mm(self) -> np.ndarray:
        """(N, n, 3) paired difference: AFTER less BEFORE, mm; NaN where a row has no partner."""
        return self.after_mm - self.before_mm

    @cached_property
    def correction_mm(self) -> np.ndarray:
        """(N, n, 3) what the model says the difference of the actuation does, mm."""
        correction = self.after.predicted_mm - self.found.predicted_mm
        return without_noise(self.after, self.after_mm - self._measured_before_mm, correction)

    @cached_property
    def body_mm(self) -> np.ndarray:
        """(N, n, 3) motion of BEFORE in every row of AFTER, as far as it comes again, mm, see
        `body_before`."""
        return body_before(self.after, self.before_mm, self._repeated)

    @cached_property
    def free_mm(self) -> np.ndarray:
        """(n,) RMS of the change at the frequencies of free motion, mm, see `free_motion`."""
        measured, predicted = self._measured_before_mm, self.found.predicted_mm
        return free_motion(self.after, measured, predicted, self.change_mm, self._repeated)

    @property
    def repeatability_mm(self) -> np.ndarray:
        """(n,) RMS distance by which two recordings of the same motion differ at each key point
        where nothing has changed, for one recording (their difference over root two), mm."""
        return self._repeatability[0]

    @property
    def source(self) -> str:
        """Where the repeatability is from: `repeats` of BEFORE, or `noise` where it has none."""
        return self._repeatability[1]

    @property
    def noise_mm(self) -> np.ndarray:
        """(n,) RMS noise of the paired difference of each key point, free motion included, mm."""
        return np.maximum(self._fast_noise_mm, self.free_mm)

    @cached_property
    def discrepancy_mm(self) -> np.ndarray:
        """(n,) what takes the place of the model discrepancy, mm, see `paired_discrepancy`."""
        correction = self.correction_mm[~self.after.held_out]
        noise, slope = self._fast_noise_mm, slope_error(self.after)
        return paired_discrepancy(self._slow_mm, correction, noise, slope)

    @cached_property
    def tolerance_mm(self) -> np.ndarray:
        """(n,) what the right effect may leave, mm: the discrepancy, the share of the change that
        the sensitivities of the effects are off by (`slope_error`), and where BEFORE has no repeats
        slow noise, which may be as large as fast noise."""
        slow = self._fast_noise_mm if self.source == "noise" else 0.0
        change = rms_by_point(self.change_mm[~self.after.held_out])
        slope = slope_error(self.after)
        return np.sqrt(self.discrepancy_mm**2 + slow**2 + (slope * change) ** 2)

    def unchanged_mm(self, rows: np.ndarray) -> np.ndarray:
        """(n,) RMS paired difference of a key point, mm, over rows (N,) bool, if nothing changed.

        The noise of the pair, and the variance of what one recording and a mean over k partners
        have beside it: slow^2 (1 + 1/k).
        """
        partners = self.partners[rows & self.paired]
        share = np.minimum(self.repeatability_mm / self.earlier.noise_mm, 1.0)
        slow = np.square(self._slow_mm) * (1.0 + np.mean(1.0 / partners))
        return np.sqrt(np.square(share * self._fast_noise_mm) + slow)

    @property
    def _measured_before_mm(self) -> np.ndarray:
        """(N, n, 3) measured key points of the partner, mm; NaN where there is none."""
        return self.found.residual_mm + self.found.predicted_mm

    @cached_property
    def _repeated(self) -> "RepeatedShare":
        """How much of each frequency AFTER repeats."""
        return repeated_share(self.after, self._measured_before_mm)

    @cached_property
    def _repeatability(self) -> tuple[np.ndarray, str]:
        return _repeatability(self.earlier)

    @property
    def _slow_mm(self) -> np.ndarray:
        """(n,) what repeats of BEFORE differ by beyond their noise, RMS of one recording, mm."""
        square = np.square(self.repeatability_mm) - np.square(self.earlier.noise_mm)
        return np.sqrt(np.maximum(square, 0.0))

    @cached_property
    def _fast_noise_mm(self) -> np.ndarray:
        """(n,) RMS noise of the paired difference of each key point, mm."""
        averaging = np.nanmean(self.found.averaging) if self.paired.any() else 1.0
        return np.sqrt(
            np.square(self.after.noise_mm) + np.square(self.earlier.noise_mm) * averaging
        )


@dataclass(frozen=True)
class Change:
    """How far AFTER differs from BEFORE."""

    before: tuple[str, ...]
    """Names of the recordings of BEFORE."""
    paired_share: float
    """Share of the rows of AFTER with a partner in BEFORE, 0 to 1."""
    change_mm: float | None
    """RMS paired difference over all key points and training rows, mm; None without pairs."""
    per_key_point_mm: tuple[float, ...]
    """RMS paired difference of each key point, mm."""
    repeatability_mm: float | None
    """RMS distance by which a recording of the same motion differs where nothing changed, mm."""
    repeatability_source: str
    """`repeats`, `noise`, or `none` without pairs."""
    free_mm: float
    """RMS of the change at frequencies at which the arm moves freely (swings, vibration,
    noise), mm; no effect explains it."""
    mismatch: float
    """RMS difference of the actuation between partners, as a share of its range."""
    stretches: tuple[Stretch, ...]
    """What was paired with what."""
    unchanged_mm: float | None = None
    """RMS paired difference that an arm shows where nothing has changed, mm: a difference of two
    recordings, to be compared with `change_mm`; None without pairs."""
    noise_mm: tuple[float, float] | None = None
    """RMS noise of BEFORE and of AFTER, which is a part of `unchanged_mm`, mm; None without
    pairs."""

    @property
    def _source(self) -> str:
        """What `unchanged_mm` is computed from, in words."""
        source = self.repeatability_source
        if self.noise_mm is None or self.noise_mm[1] < NOISIER * self.noise_mm[0]:
            return source
        before, after = self.noise_mm
        more = "" if source == "noise" else " and noise"
        return (
            f"{source}{more}, which is {after:.3g} mm in these recordings and {before:.3g} mm in "
            "those before"
        )

    @property
    def sentence(self) -> str:
        """The change in words."""
        names = " + ".join(self.before)
        if self.change_mm is None:
            few = f"{100 * self.paired_share:.0f} %"
            paired = f"no rows are paired with {names}"
            if few != "0 %":
                paired = f"only {few} of the rows have the same actuation as {names}"
            if self.paired_share >= LEAST_SHARE:  # not asked for, or too few for a check
                paired = f"rows are not paired with {names}, though {few} have the same actuation"
            return f"{paired}: the model's residuals are compared with its residuals there"
        delays = sorted({f"{each.delay_s:z.2f} s" for each in self.stretches[:DELAYS_SHOWN]})
        return (
            f"{100 * self.paired_share:.0f} % of the rows are paired with {names} (delay "
            f"{', '.join(delays)}); change {self.change_mm:.3g} mm, expected of an unchanged arm "
            f"{self.unchanged_mm:.3g} mm (from {self._source})"
        )

    def to_json(self) -> dict:
        """Plain values."""
        return asdict(self) | {"sentence": self.sentence}


@dataclass(frozen=True, eq=False)
class ChangeTrack:
    """Key points before and after, and what effects explain of the change, on S rows."""

    t_s: np.ndarray
    """(S,) time in the recording of AFTER, s."""
    run: np.ndarray
    """(S,) run of each row."""
    before_mm: np.ndarray
    """(S, n, 3) key points of BEFORE at the matching instant, base frame, mm; NaN where missing."""
    after_mm: np.ndarray
    """(S, n, 3) key points of AFTER, base frame, mm; NaN where missing."""
    explained_mm: np.ndarray
    """(S, n, 3) change that the named effects explain, of alternatives the first alone, mm; 0 where
    none is named."""

    @property
    def change_mm(self) -> np.ndarray:
        """(S, n, 3) change that was measured, mm."""
        return self.after_mm - self.before_mm


DELAYS_SHOWN = 3
"""Delays that a sentence lists."""


# Runs as signals -----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class RunSignal:
    """The actuation of one run."""

    number: int
    """Number of the run in its table."""
    recording: str
    """Name of its recording."""
    rows: np.ndarray
    """(T,) rows of the table."""
    t_s: np.ndarray
    """(T,) time, s; the number of the row for steady-state samples."""
    values: np.ndarray
    """(T, m) actuation as a share of its range."""
    timed: bool = True
    """Whether it is a continuous run, not one of steady-state samples."""

    @property
    def step_s(self) -> float:
        """Usual distance of two samples, s."""
        return float(np.median(np.diff(self.t_s))) if len(self.t_s) > 1 else 1.0

    def at(self, t_s: np.ndarray) -> np.ndarray:
        """(S, m) actuation at times (S,), between the samples linear; NaN outside."""
        columns = [
            np.interp(t_s, self.t_s, column, left=np.nan, right=np.nan) for column in self.values.T
        ]
        return np.stack(columns, axis=1)


def run_signals(table: ResidualTable, commanded: bool) -> list[RunSignal]:
    """The actuation of every run of a table, as commanded or as the model takes it."""
    span, answer = np.array(table.spec.span), []
    actuation = table.commanded if commanded else table.pressure
    for number in np.unique(table.run):
        rows = np.flatnonzero(table.run == number)
        timed = bool(table.timed[rows[0]])
        time = table.t_s[rows] if timed else np.arange(len(rows), dtype=float)
        name = table.names[table.recording[rows[0]]]
        answer.append(RunSignal(int(number), name, rows, time, actuation[rows] / span, timed))
    return answer


# Delays --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Match:
    """Rows of a run of AFTER that agree with a run of BEFORE at one delay."""

    after: RunSignal
    before: RunSignal
    delay_s: float
    """Time in BEFORE less time in AFTER, s."""
    inside: np.ndarray
    """(T,) bool: rows of the run of AFTER that are paired."""
    mismatch: float
    """RMS difference of the actuation over them, as a share of its range."""


def matches(
    after: RunSignal,
    before: RunSignal,
    alike: np.ndarray,
    apart_s: float = 0.0,
    least: np.ndarray | None = None,
) -> list[Match]:
    """Delays at which a run of AFTER repeats a run of BEFORE, the one with most rows first.

    alike: (m,) difference of each chamber, as a share of its range, that counts as the same;
    apart_s: least size of a delay, s; least: (m,) motion, RMS as a share of the range, of windows
    that count. A row belongs to one match only.
    """
    step = max(after.step_s, before.step_s, _length(after) / GRID_ROWS, _length(before) / GRID_ROWS)
    a, b = _on_grid(after, step), _on_grid(before, step)
    longest = WINDOW_S / step if after.timed else BLOCK_ROWS * LEAST_BLOCKS
    width = int(min(longest, WINDOW_SHARE * min(len(a), len(b))))
    if width < BLOCK_ROWS:
        return []
    begins = np.arange(0, len(a) - width + 1, max(1, int(STRIDE_SHARE * width)))
    least = np.maximum(MOVES, alike - ALIKE) if least is None else least
    about = (a - a.mean(0)).T
    spread = _moving_sum(np.square(about), width) - np.square(_moving_sum(about, width)) / width
    moving = spread[:, begins] >= width * np.square(least).reshape(-1, 1)
    begins = begins[moving.any(axis=0)]
    lags = np.arange(-len(a) + 1, len(b))
    fits = np.zeros((len(begins), len(lags)), bool)
    apart = np.zeros((len(begins), len(lags)))
    places = _Places(b, width, alike)
    for number, begin in enumerate(begins):
        found = places.misfit(a[begin : begin + width])
        first = len(a) - 1 - begin
        fits[number, first : first + len(found)] = found <= 1.0
        apart[number, first : first + len(found)] = found
    offset = before.t_s[0] - after.t_s[0]
    if apart_s:
        fits[:, np.abs(lags * step + offset) < apart_s] = False
    free, answer = np.full(len(after.rows), True), []
    while fits.any():
        count = fits.sum(0)
        tied = np.flatnonzero(count == count.max())
        best = tied[np.argmin((apart * fits)[:, tied].sum(0))]
        delay = _refined(after, before, float(lags[best] * step + offset), alike, 2 * step)
        inside, mismatch = _agree(after, before, delay, alike)
        inside &= free
        # Delays within a window's own uncertainty of this one are this one.
        done = fits[:, best].copy()
        fits[done] = False
        if inside.sum() >= BLOCK_ROWS:
            free &= ~inside
            level = float(np.sqrt(np.mean(np.square(mismatch[inside]))))
            answer.append(Match(after, before, delay, inside, level))
    return sorted(answer, key=lambda match: -int(match.inside.sum()))


def all_matches(
    after: list[RunSignal], before: list[RunSignal], alike: np.ndarray, itself: bool = False
) -> list[Match]:
    """Windows of the runs of AFTER that repeat motion of the runs of BEFORE.

    A run at rest fits at every delay: it is paired at the delays at which other runs of the same
    two recordings repeat each other. itself: both are the same runs, which are not their own
    partners.
    """
    found: list[Match] = []
    both = [(one, other) for one in after for other in before if one.timed == other.timed]
    if itself:
        both = [(one, other) for one, other in both if one.number <= other.number]
    for one, other in both:
        apart = APART_S if itself and one.number == other.number else 0.0
        found += matches(one, other, alike, apart, NEAR * alike if itself else None)
    delays: dict[tuple[str, str], list[float]] = {}
    for match in sorted(found, key=lambda match: -int(match.inside.sum())):
        delays.setdefault((match.after.recording, match.before.recording), []).append(match.delay_s)
    moved = {(match.after.number, match.before.recording) for match in found}
    for one, other in both:
        if not one.timed or (one.number, other.recording) in moved or itself:
            continue
        tried = []
        for delay in delays.get((one.recording, other.recording), []):
            inside, mismatch = _agree(one, other, delay, alike)
            if inside.sum() >= BLOCK_ROWS:
                level = float(np.sqrt(np.mean(np.square(mismatch[inside]))))
                tried.append(Match(one, other, delay, inside, level))
        if tried:
            found.append(min(tried, key=lambda match: match.mismatch))
            moved.add((one.number, other.recording))
    return found


def _length(signal: RunSignal) -> float:
    return float(np.ptp(signal.t_s))


def _on_grid(signal: RunSignal, step: float) -> np.ndarray:
    """(G, m) the actuation at even times from the run's first on."""
    count = int(_length(signal) / step + 1e-6) + 1
    return signal.at(np.minimum(signal.t_s[0] + step * np.arange(count), signal.t_s[-1]))


class _Places:
    """A run b (G, m) at all of whose places windows of W rows are laid, of one width."""

    def __init__(self, b: np.ndarray, width: int, alike: np.ndarray):
        self.width, self.alike = width, alike
        scaled = (b / alike).T
        self.middle = scaled.mean(1, keepdims=True)
        y = scaled - self.middle
        self.count = len(b) - width + 1
        self.length = next_fast_len(len(b) + width - 1, real=True)
        self.spectrum = rfft(y, self.length)
        self.sum, self.square = (_moving_sum(each, width) for each in (y, np.square(y)))

    def misfit(self, window: np.ndarray) -> np.ndarray:
        """(G - W + 1,) mean squared difference of a window (W, m) from b at each place.

        In units of what counts as the same, of the chamber that differs most.
        """
        scaled = (window / self.alike).T
        mean = scaled.mean(1, keepdims=True)
        x, shift = scaled - mean, mean - self.middle
        cross = irfft(np.conj(rfft(x, self.length)) * self.spectrum, self.length)[:, : self.count]
        square = self.square - 2 * shift * self.sum + self.width * np.square(shift)
        square += np.square(x).sum(1, keepdims=True) - 2 * cross
        return np.maximum(square.max(0), 0.0) / self.width


def _moving_sum(x: np.ndarray, width: int) -> np.ndarray:
    """(m, G - W + 1) sums of W successive values of x (m, G)."""
    sums = np.cumsum(np.hstack([np.zeros((len(x), 1)), x]), axis=1)
    return sums[:, width:] - sums[:, : sums.shape[1] - width]


def _refined(
    after: RunSignal, before: RunSignal, delay: float, alike: np.ndarray, reach: float
) -> float:
    """The delay at which the slope of the misfit is zero, from one that is right to a sample.

    Newton steps on sum a'(t) (b(t + delay) - a(t)) = 0 with the central difference a' of AFTER: its
    noise is independent of that of a(t) and of b, so the noise of the actuation causes no bias (the
    least squared difference itself prefers delays between samples, where interpolation averages
    noise). reach: farthest that it may go, s.
    """
    if not after.timed or len(after.t_s) < 3:
        return float(round(delay))
    slope = np.zeros_like(after.values)
    dt = after.t_s[2:] - after.t_s[:-2]
    slope[1:-1] = (after.values[2:] - after.values[:-2]) / dt[:, None]
    start = delay
    for _ in range(REFINEMENTS):
        difference = before.at(after.t_s + delay) - after.values
        whole = np.isfinite(difference).all(1) & (np.abs(difference) <= NEAR * alike).all(1)
        power = np.square(slope[whole] / alike).sum()
        if power <= 0:
            return start
        change = -float((slope[whole] * difference[whole] / np.square(alike)).sum() / power)
        delay = float(np.clip(delay + change, start - reach, start + reach))
        if abs(change) < 1e-6:
            break
    return delay


def _agree(
    after: RunSignal, before: RunSignal, delay: float, alike: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """((T,) bool, (T,) share): rows that agree with BEFORE at a delay, and their RMS difference."""
    difference = before.at(after.t_s + delay) - after.values
    inside = np.isfinite(difference).all(1)
    scaled = np.where(inside[:, None], np.square(difference / alike), 0.0)
    past = PAST_S if after.timed else 1.0
    sums = np.cumsum(np.vstack([np.zeros(scaled.shape[1]), scaled]), axis=0)
    # Rows from the begin of the common stretch on, at most so far back.
    begin = np.flatnonzero(inside)[0] if inside.any() else 0
    first = np.maximum(np.searchsorted(after.t_s, after.t_s - past - 1e-9), begin)
    rows = np.arange(len(after.t_s))
    count = np.maximum(rows + 1 - first, 1)
    mean = (sums[rows + 1] - sums[np.minimum(first, rows)]) / count[:, None]
    alike_past = (mean <= 1.0).all(1)
    alike_now = (scaled <= ALIKE_NOW**2).all(1)
    # Memories of the two runs agree from their first rows on, or after some time.
    both_begin = abs(after.t_s[0] + delay - before.t_s[0]) <= 1.5 * after.step_s
    known = both_begin | (after.t_s - after.t_s[begin] >= past)
    ok = inside & alike_past & alike_now & known
    return ok, np.sqrt(np.nan_to_num(np.square(difference).mean(1)))


# Tables --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Found:
    """What BEFORE says about the rows of AFTER."""

    residual_mm: np.ndarray
    """(N, n, 3) mean residual of the partners, mm; NaN where there is none."""
    predicted_mm: np.ndarray
    """(N, n, 3) mean prediction of the partners, mm."""
    partners: np.ndarray
    """(N,) number of them."""
    partner_t_s: np.ndarray
    """(N,) time of the first one, s."""
    averaging: np.ndarray
    """(N,) factor on the variance of BEFORE's noise, by interpolation and by averaging."""
    stretches: tuple[Stretch, ...]

    @classmethod
    def none(cls, after: ResidualTable) -> "_Found":
        """No partner for any row."""
        nothing = np.full(after.measured_mm.shape, np.nan)
        never = np.full(len(nothing), np.nan)
        return cls(nothing, nothing, np.zeros(len(nothing), int), never, never, ())


def _alike(
    after: ResidualTable, before: ResidualTable, commanded: bool, share: float = ALIKE
) -> np.ndarray:
    """(m,) difference of each chamber, as a share of its range, that counts as the same."""
    span = np.array(after.spec.span)
    noise = [
        np.zeros(len(span)) if table.history.noise is None else np.array(table.history.noise)
        for table in (after, before)
    ]
    noise_share = 0.0 if commanded else ALIKE_NOISES * np.hypot(*noise) / span
    return np.maximum(share, noise_share)


def _best_matches(
    after: ResidualTable, before: ResidualTable, itself: bool, share: float
) -> list[Match]:
    """What AFTER repeats of BEFORE by the commands, or by the actuation that the model takes.

    A command has no noise, and a change of the arm does not change it. But where commands are steps
    whose instants jitter from run to run, the measured actuation agrees better: it is taken where
    it pairs clearly more rows.
    """
    known = all(np.isfinite(table.commanded).all() for table in (after, before))
    best: list[Match] = []
    most = 0.0
    for commanded in (True, False) if known else (False,):
        one, other = (run_signals(table, commanded) for table in (after, before))
        found = all_matches(one, other, _alike(after, before, commanded, share), itself)
        rows = sum(int(match.inside.sum()) for match in found)
        if rows > most:
            best, most = found, MORE_ROWS * rows
    return best


def _partners(
    after: ResidualTable, before: ResidualTable, itself: bool = False, share: float = ALIKE
) -> _Found:
    """The partners of every row of AFTER; itself: BEFORE is the same table, rows are not their own
    partners; share: difference of the actuation, as a share of its range, that counts as the same.
    """
    shape = after.measured_mm.shape
    sums, predicted = np.zeros(shape), np.zeros(shape)
    seen, averaging = np.zeros(shape[:2]), np.zeros(shape[0])
    partners, time = np.zeros(shape[0], int), np.full(shape[0], np.nan)
    stretches: list[Stretch] = []
    for match in _best_matches(after, before, itself, share):
        one, other = match.after, match.before
        at = one.t_s[match.inside] + match.delay_s
        rows = one.rows[match.inside]
        lower = np.clip(np.searchsorted(other.t_s, at, "right") - 1, 0, len(other.t_s) - 2)
        between = (at - other.t_s[lower]) / (other.t_s[lower + 1] - other.t_s[lower])
        between = np.clip(between, 0.0, 1.0)
        lower = other.rows[lower]
        residual = _between(before.residual_mm, lower, between)
        ok = np.isfinite(residual).all(2)
        sums[rows] += np.where(ok[..., None], residual, 0.0)
        predicted[rows] += _between(before.predicted_mm, lower, between)
        seen[rows] += ok
        partners[rows] += 1
        averaging[rows] += between**2 + (1 - between) ** 2
        time[rows] = np.where(np.isnan(time[rows]), at, time[rows])
        stretches.append(
            Stretch(
                after=one.recording,
                after_run=one.number,
                before=other.recording,
                before_run=other.number,
                delay_s=match.delay_s,
                rows=len(rows),
                mismatch=match.mismatch,
            )
        )
    with np.errstate(invalid="ignore", divide="ignore"):
        residual = sums / np.where(seen, seen, np.nan)[..., None]
        predicted = predicted / np.where(partners, partners, np.nan)[:, None, None]
        averaging = averaging / np.where(partners, partners, np.nan) ** 2
    stretches.sort(key=lambda stretch: -stretch.rows)
    return _Found(residual, predicted, partners, time, averaging, tuple(stretches))


def _between(values: np.ndarray, lower: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(S, n, 3) values between the rows `lower` and those behind them; exact at share 0 or 1."""
    upper = np.minimum(lower + 1, len(values) - 1)
    w = share[:, None, None]
    first = np.where(w < 1, values[lower], 0.0) * (1 - w)
    return first + np.where(w > 0, values[upper], 0.0) * w


def paired_table(
    after: ResidualTable, before: ResidualTable, asked: bool = False
) -> tuple[ResidualTable | None, Pairs]:
    """AFTER's table with the paired difference in place of the residual, and the pairs.

    The measured key points become those that would have been measured if the model made no other
    errors after than before: measured less the partner's residual. Rows without a partner are NaN.
    None where too few rows have one; asked: whether a minute of them is enough.
    """
    pairs = Pairs(after, before, _partners(after, before))
    if not _enough(after, pairs, asked):
        return None, pairs
    change, noise = pairs.change_mm, pairs.noise_mm
    measured = after.predicted_mm + change
    points = after.history.key_points.clone()
    points[after.history.valid] = torch.from_numpy(measured).to(points.dtype)
    paired = replace(
        after,
        measured_mm=measured,
        history=replace(after.history, key_points=points),
        noise_mm=noise,
        floor=Floor(float(np.sqrt(np.mean(noise**2))), "pairs"),
        paired_discrepancy_mm=pairs.discrepancy_mm,
        paired_tolerance_mm=pairs.tolerance_mm,
        body_before_mm=pairs.body_mm,
    )
    return paired, pairs


def body_before(
    after: ResidualTable, before_mm: np.ndarray, repeated: "RepeatedShare"
) -> np.ndarray:
    """(N, n, 3) key points of BEFORE along every row of AFTER, as far as they come again, mm.

    before_mm: (N, n, 3) key points of the partners, mm, NaN where there is none. In gaps the model
    stands in, with what it got wrong at their ends. Of fast motion the share is taken that AFTER
    repeats: a vibration that is another one in each recording says nothing of a load, but half of
    the difference of two of them is one of them with the other sign (regression to the mean).
    """
    wrong = before_mm - after.predicted_mm
    answer = after.predicted_mm.copy()
    for signal in run_signals(after, False):
        rows = signal.rows
        for point in range(wrong.shape[1]):
            seen = rows[np.isfinite(wrong[rows, point]).all(1)]
            if len(seen):
                answer[rows, point] += np.stack(
                    [np.interp(rows, seen, axis[seen]) for axis in wrong[:, point].T], axis=1
                )
        if signal.timed:
            answer[rows] = repeated.of(answer[rows], signal.step_s)
    return answer


@dataclass(frozen=True, eq=False)
class RepeatedShare:
    """How much of the motion of BEFORE comes again in AFTER, by frequency."""

    frequency_Hz: np.ndarray
    """(F,) frequencies, Hz."""
    share: np.ndarray
    """(F, n) share of the power of each key point's motion that both recordings have in common, 0
    to 1: the root of their squared coherence, which is the product of both shares."""

    def at(self, frequency_Hz: np.ndarray) -> np.ndarray:
        """(G, n) the share at other frequencies (G,)."""
        return np.stack(
            [np.interp(frequency_Hz, self.frequency_Hz, column) for column in self.share.T], axis=1
        )

    def of(self, motion_mm: np.ndarray, step_s: float) -> np.ndarray:
        """(T, n, 3) motion of one run (T, n, 3) with each frequency as far as it is repeated, mm.

        The run is continued by its mirror image, so that it ends where it begins.
        """
        both = np.concatenate([motion_mm, motion_mm[::-1]])
        weights = self.at(np.fft.rfftfreq(len(both), step_s))
        spectrum = np.fft.rfft(both, axis=0) * weights[..., None]
        return np.fft.irfft(spectrum, len(both), axis=0)[: len(motion_mm)]


def repeated_share(after: ResidualTable, before_mm: np.ndarray) -> RepeatedShare:
    """The share of the motion that BEFORE and AFTER have in common, from the training rows.

    A load, gain or lag filters a motion linearly, which leaves the coherence at 1 (Bendat & Piersol
    2010, ch. 6). The estimate of the squared coherence from K stretches is 1 / K too large where
    there is none, which is taken off. Slower than LEAST_BINS / SPECTRUM_S, and where there
    are too few stretches at hand for an estimate, all slow and no fast motion counts as repeated.
    """
    points = before_mm.shape[1]
    slow = LEAST_BINS / SPECTRUM_S
    fields = np.concatenate([before_mm, after.measured_mm], axis=1)
    count, cross, power = 0, None, None
    step, length = _stretch(after, COHERENCE_S)
    for values in _stretches(after, fields, step, length):
        spectrum = _spectrum(values).reshape(-1, 2, points, 3)
        both = np.conj(spectrum[:, 0]) * spectrum[:, 1]
        own = np.square(np.abs(spectrum))
        cross, power = (both, own) if cross is None else (cross + both, power + own)
        count += 1
    if cross is None or power is None or count < LEAST_STRETCHES:
        edges = np.array([0.0, slow, np.nextafter(slow, np.inf)])
        return RepeatedShare(edges, np.repeat([[1.0], [1.0], [0.0]], points, axis=1))
    found = np.square(np.abs(cross)) / np.maximum(power[:, 0], 1e-30)
    share = found.sum(2) / np.maximum(power[:, 1].sum(2), 1e-30)
    share = np.clip((share - 1.0 / count) / (1.0 - 1.0 / count), 0.0, 1.0)
    frequency = np.fft.rfftfreq(length, step)
    share[frequency <= slow] = 1.0
    return RepeatedShare(frequency, np.sqrt(share))


def without_noise(
    after: ResidualTable, difference_mm: np.ndarray, correction_mm: np.ndarray
) -> np.ndarray:
    """(N, n, 3) the correction for the actuation, its fast part only as far as the arm followed it.

    Differences of a measured actuation are real, or noise of its sensors, which moves no arm. What
    is slower than PAST_S is taken for real. Of the rest a share is, found by regression of the
    steps of the measured difference on those of the correction (training rows, one number).
    """
    if not after.timed.any():
        return correction_mm
    slow = np.full_like(correction_mm, np.nan)
    for signal in run_signals(after, False):
        width = max(1, round(PAST_S / signal.step_s))
        slow[signal.rows] = _moving_mean(correction_mm[signal.rows], width)
    fast = correction_mm - slow
    same = (after.run[1:] == after.run[:-1]) & ~after.held_out[1:] & ~after.held_out[:-1]
    left, right = np.diff(difference_mm, axis=0)[same], np.diff(fast, axis=0)[same]
    seen = np.isfinite(left) & np.isfinite(right)
    power = float(np.square(right[seen]).sum())
    share = float((left[seen] * right[seen]).sum()) / power if power > 0 else 0.0
    return slow + float(np.clip(share, 0.0, 1.0)) * fast


def _moving_mean(field: np.ndarray, width: int) -> np.ndarray:
    """(T, ...) mean over `width` rows around each row, of what is not NaN; NaN where nothing is."""
    seen = np.isfinite(field)
    empty = np.zeros((1, *field.shape[1:]))
    sums = np.concatenate([empty, np.cumsum(np.where(seen, field, 0.0), axis=0)])
    counts = np.concatenate([empty, np.cumsum(seen, axis=0)])
    rows = np.arange(len(field))
    low, high = np.maximum(rows - width // 2, 0), np.minimum(rows + width // 2 + 1, len(field))
    with np.errstate(invalid="ignore", divide="ignore"):
        return (sums[high] - sums[low]) / (counts[high] - counts[low])


def free_motion(
    after: ResidualTable,
    measured_before_mm: np.ndarray,
    predicted_before_mm: np.ndarray,
    change_mm: np.ndarray,
    repeated: RepeatedShare,
) -> np.ndarray:
    """(n,) RMS of the change of each key point that free motion makes, mm.

    An arm that swings, vibrates or is measured with noise moves at frequencies that the actuation
    hardly contains: there BEFORE or AFTER shows FREE_POWER times the power that the model predicts,
    or more. No change of gain below 1 and no delay of a predicted motion has so much
    (|1 - exp(i phi)|^2 is at most 4). What BEFORE and AFTER do not have in common there counts as
    noise of the pair: swings that every recording has otherwise. Power by the method of Welch
    (1967), in bands of a third of an octave.
    """
    points = change_mm.shape[1]
    fields = np.concatenate(
        [measured_before_mm, after.measured_mm, predicted_before_mm, after.predicted_mm, change_mm],
        axis=1,
    )
    count, power = 0, None
    step, length = _stretch(after, SPECTRUM_S)
    for values in _stretches(after, fields, step, length):
        found = np.square(np.abs(_spectrum(values))).reshape(-1, 5, points, 3).sum(3)
        power, count = found if power is None else power + found, count + 1
    if power is None or length < 2 * LEAST_BINS:
        return np.zeros(points)
    total = power / count
    frequency = np.fft.rfftfreq(length, step)
    band = np.floor(3.0 * np.log2(np.maximum(frequency, frequency[1]) / frequency[1])).astype(int)
    apart = (1.0 - repeated.at(frequency)) * total[:, :2].sum(1)
    free = np.zeros(points)
    for number in range(band[LEAST_BINS] + 1, band.max() + 1):
        before, later, predicted_before, predicted_later = total[band == number, :4].sum((0, 2))
        if before >= FREE_POWER * predicted_before or later >= FREE_POWER * predicted_later:
            free += np.minimum(apart, total[:, 4])[band == number].sum(0)
    return np.sqrt(free)


def _stretch(table: ResidualTable, longest_s: float) -> tuple[float, int]:
    """(time between two samples, s; samples of a stretch, a power of two)."""
    steps = [np.diff(signal.t_s) for signal in run_signals(table, False) if signal.timed]
    step = float(np.median(np.concatenate(steps))) if steps else 1.0
    return step, int(2 ** np.floor(np.log2(max(4.0, longest_s / step))))


def _stretches(
    table: ResidualTable, fields: np.ndarray, step: float, length: int
) -> Iterator[np.ndarray]:
    """(length, C) stretches of the training rows of fields (N, ...), evenly sampled, half over."""
    for signal in run_signals(table, False):
        rows = signal.rows[~table.held_out[signal.rows]]
        seen = np.isfinite(fields[rows]).all((1, 2))
        if not signal.timed or seen.sum() < length:
            continue
        time = table.t_s[rows][seen]
        even = np.arange(time[0], time[-1], step)
        flat = fields[rows][seen].reshape(seen.sum(), -1)
        values = np.stack([np.interp(even, time, column) for column in flat.T], axis=1)
        for begin in range(0, len(even) - length + 1, length // 2):
            yield values[begin : begin + length]


def _spectrum(values: np.ndarray) -> np.ndarray:
    """(F, C) amplitudes of signals (T, C) at each frequency; their squares sum to the variance."""
    window = np.hanning(len(values))
    spectrum = np.fft.rfft((values - values.mean(0)) * window[:, None], axis=0)
    spectrum /= np.sqrt(np.square(window).sum() * len(values))
    spectrum[1:-1] *= np.sqrt(2.0)
    return spectrum


def _enough(after: ResidualTable, pairs: Pairs, asked: bool) -> bool:
    """Whether enough of the training rows have a partner to diagnose the paired difference.

    asked: whether fewer than LEAST_SHARE are enough if they last for LEAST_S.
    """
    shown = np.isfinite(after.measured_mm).all(2).any(1) & ~after.held_out
    both = shown & np.isfinite(pairs.change_mm).all(2).any(1)
    if both.sum() < LEAST_ROWS:
        return False
    if both.sum() >= LEAST_SHARE * shown.sum():
        return True
    if not asked or not after.timed.any():
        return False
    step = np.median(np.concatenate([np.diff(s.t_s) for s in run_signals(after, False)]))
    return bool(both.sum() * step >= LEAST_S)


def _repeatability(before: ResidualTable) -> tuple[np.ndarray, str]:
    """(n,) RMS distance by which a recording of the same motion differs, mm, and its source.

    Exact repeats of a motion in BEFORE count; where there are too few, rows that are alike, with
    the model's correction. Where BEFORE repeats nothing, the noise floor is what is known. A row
    and the mean of its k partners differ by the variance

        noise^2 (1 + averaging) + slow^2 (1 + 1/k),

    with white noise, which the interpolation of partners lowers (`_Found.averaging`), and what is
    slower than two samples, which it does not. The repeatability is the root of noise^2 + slow^2.
    """
    noise = np.square(before.noise_mm)
    for share in (EXACT, ALIKE):
        found = _partners(before, before, True, share)
        difference = before.measured_mm - found.residual_mm - found.predicted_mm
        correction = before.predicted_mm - found.predicted_mm
        correction = without_noise(before, difference, correction)
        square = np.square(difference - correction).sum(2)
        # Less what an error of the model's slope does to the correction.
        square -= np.square(slope_error(before)) * np.square(correction).sum(2)
        seen = np.isfinite(square)
        if (seen.sum(0) >= LEAST_ROWS).all():
            some = seen.any(1)
            white = 1.0 + float(np.mean(found.averaging[some]))
            whole = 1.0 + float(np.mean(1.0 / found.partners[some]))
            mean = np.nanmean(square, axis=0)
            slow = (mean - white * noise) / whole
            # The noise floor may be stated too large.
            variance = np.where(slow >= 0.0, noise + slow, np.maximum(mean, 0.0) / white)
            return np.maximum(np.sqrt(variance), NOISE_SHARE * before.noise_mm), "repeats"
    return before.noise_mm, "noise"


def paired_discrepancy(
    slow_mm: np.ndarray, correction_mm: np.ndarray, noise_mm: np.ndarray, slope: float
) -> np.ndarray:
    """(n,) RMS systematic error of the paired difference of each key point, mm, without noise.

    What two recordings differ by beyond the noise, the square of which is twice that of one
    (`slow_mm`), and the error of the correction for the actuation, of which the model's slope is
    off by a share (`slope`):

        discrepancy^2 = max(2 slow^2, (least noise)^2) + (slope correction)^2.

    It takes the place of the model discrepancy, in its size and its form: a smooth function of the
    actuation that is the same in every repeat.
    """
    slow = np.maximum(2 * slow_mm**2, (LEAST_DISCREPANCY * noise_mm) ** 2)
    return np.sqrt(slow + (slope * rms_by_point(correction_mm)) ** 2)


def rms_by_point(field_mm: np.ndarray) -> np.ndarray:
    """(n,) RMS distance of a field (N, n, 3), mm; NaN counts as missing, nothing at all as 0."""
    square = np.square(field_mm).sum(2)
    count = np.isfinite(square).sum(0)
    return np.sqrt(np.nansum(square, axis=0) / np.maximum(count, 1))


def _rms(per_key_point_mm: np.ndarray) -> float:
    """RMS over key points (n,), mm."""
    return float(np.sqrt(np.mean(np.square(per_key_point_mm))))


def slope_error(table: ResidualTable) -> float:
    """Error of a model's slopes as a share of them, at most 1.

    Values off by e (validated error over the RMS motion that the model predicts) have slopes that
    are off by more, the shorter the scales of the error are: a Matern-5/2 function of unit variance
    and length l has slopes of variance 5 / (3 l^2) (Rasmussen & Williams 2006, sec. 4.2), here the
    mixture of lengths of the model discrepancy. A motion of m chambers, each spread evenly over its
    range of -1 to 1 with a slope s, is m s^2 / 3 in the mean square.
    """
    motion = table.predicted_mm - table.predicted_mm.mean(0)
    moved = float(np.sqrt(np.mean(np.square(motion).sum(2))))
    error = float(np.sqrt(np.mean(model_discrepancy(table.model, table.noise_mm) ** 2)))
    steepness = sum(share * 5.0 / (3.0 * length**2) for length, share in LENGTHS)
    return min(1.0, np.sqrt(steepness * table.spec.chambers / 3.0) * error / max(moved, 1e-9))


# Before and after ----------------------------------------------------------------------------

Paired = str
"""Whether rows are paired: `auto` where at least half of them have a partner, `always` also where
fewer have one, for a minute in all, and with an error otherwise, `never` not at all."""
PAIRED: tuple[Paired, ...] = ("auto", "always", "never")


@dataclass(frozen=True, eq=False)
class BeforeAfter:
    """Recordings of an arm before and after a change, under one model."""

    table: ResidualTable
    """Residuals of AFTER: paired differences where `used`, else those of the model."""
    plain: ResidualTable
    """Residuals of the model on AFTER."""
    earlier: ResidualTable
    """Residuals of the model on BEFORE."""
    pairs: Pairs
    """The partners of the rows of AFTER."""
    used: bool
    """Whether the paired difference is what is explained."""
    asked: Paired = "auto"
    """What was asked for."""
    unchecked: bool = False
    """Whether the paired difference is left aside because a final check could not see it: too few
    of the held-out rows have a partner."""

    @property
    def names(self) -> str:
        """The recordings of BEFORE, for a sentence."""
        return " + ".join(self.pairs.before)

    def training(self, rows: int = ROWS) -> Problem:
        """The training rows of AFTER; without pairs less what the model got wrong on BEFORE."""
        if self.used:
            return self.table.training(rows)
        return known_error(self.plain, rows_before(self.earlier)).problem_of(self.plain, rows)

    def track(self, problem: Problem, explained_mm: np.ndarray) -> ChangeTrack:
        """The change along the rows of a problem, of which effects explain (S, n, 3) mm."""
        rows = problem.index.numpy()
        return ChangeTrack(
            t_s=problem.time_s,
            run=self.plain.run[rows],
            before_mm=self.pairs.before_mm[rows],
            after_mm=self.pairs.after_mm[rows],
            explained_mm=explained_mm,
        )

    @property
    def change(self) -> Change:
        """How far AFTER differs from BEFORE."""
        pairs, training = self.pairs, ~self.table.held_out
        share = float(pairs.paired[training].mean())
        if not self.used:
            return Change(pairs.before, share, None, (), None, "none", 0.0, 0.0, pairs.stretches)
        square = np.square(pairs.change_mm[training]).sum(2)
        counts = np.array([each.rows for each in pairs.stretches])
        mismatch = np.array([each.mismatch for each in pairs.stretches])
        return Change(
            before=pairs.before,
            paired_share=share,
            change_mm=float(np.sqrt(np.nanmean(square))),
            per_key_point_mm=tuple(rms_by_point(pairs.change_mm[training]).tolist()),
            repeatability_mm=float(np.sqrt(np.mean(pairs.repeatability_mm**2))),
            repeatability_source=pairs.source,
            free_mm=float(np.sqrt(np.mean(pairs.free_mm**2))),
            mismatch=float(np.sqrt(np.average(mismatch**2, weights=counts))),
            stretches=pairs.stretches,
            unchanged_mm=float(np.sqrt(np.mean(np.square(pairs.unchanged_mm(training))))),
            noise_mm=(_rms(pairs.earlier.noise_mm), _rms(pairs.after.noise_mm)),
        )

    def with_final_check(self) -> "BeforeAfter":
        """The same, unpaired where too few held-out rows have a partner for a final check: fewer
        than half, or where pairs are asked for (`--paired always`) fewer than a fit takes."""
        there = self.pairs.paired[self.plain.held_out]
        least = LEAST_ROWS if self.asked == "always" else LEAST_SHARE * len(there)
        if self.used and there.sum() < least:
            return replace(self, table=self.plain, used=False, unchecked=True)
        return self

    @cached_property
    def strange(self) -> ModelFit | None:
        """The model's fit to BEFORE where it does not describe it, though it describes AFTER."""
        before, after = model_fit(self.earlier), model_fit(self.plain)
        if before is None or after is None or before.fits or not after.fits:
            return None
        return before

    @property
    def strange_in_words(self) -> str:
        """That the model does not describe BEFORE, and what to do; empty where that is not so."""
        if self.strange is None:
            return ""
        after = model_fit(self.plain)
        return (
            f"the model does not describe {self.names} (error {self.strange.rmse_mm:.3g} mm, "
            f"motion {self.strange.motion_mm:.3g} mm), though it describes the recordings after "
            f"the change (error {after.rmse_mm if after else 0.0:.3g} mm): give recordings of this "
            "arm from before the change, or leave out --before; a diagnosis of "
            f"{self.names} alone tests the set-up"
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """Limits of a diagnosis or a comparison, in words."""
        return self._limits("the model's residuals before and after are compared instead")

    @property
    def notes_of_fit(self) -> tuple[str, ...]:
        """Limits of effects that were fitted: without pairs to the residuals of AFTER."""
        return self._limits(
            "effects are fitted to the model's residuals there and not to the change since then, "
            "as they would be without --before"
        )

    def _limits(self, instead: str) -> tuple[str, ...]:
        """Why rows are not paired, and what is done instead, or that most of them are not looked
        at; empty where they are paired."""
        if self.strange is not None:
            return (self.strange_in_words,)
        if self.used:
            left_out = 1.0 - float(self.pairs.paired[~self.table.held_out].mean())
            if self.asked != "always" or left_out <= 1.0 - LEAST_SHARE:
                return ()
            return (
                f"{100 * left_out:.0f} % of the rows have no partner in {self.names}, and what "
                "changed there is not explained; --paired auto explains the model's residuals on "
                "all rows",
            )
        return (self._why_unpaired(instead), *self._faster)

    @property
    def _faster(self) -> tuple[str, ...]:
        """That AFTER moves faster than BEFORE, from which the model's error is learned; empty where
        most rows repeat motion of BEFORE."""
        if self.pairs.paired[~self.table.held_out].mean() >= LEAST_SHARE:
            return ()
        faster = faster_in_words(_speed(self.plain), _speed(self.earlier), self.names)
        if not faster:
            return ()
        return (
            f"{faster}: what the model lacks at this speed was not seen there and counts as a "
            "change; record motion as fast as this before the change, too",
        )

    def _why_unpaired(self, instead: str) -> str:
        """Why rows are not paired, and what is done instead."""
        if self.asked == "never":
            return f"rows are not paired, because --paired never was given: {instead}"
        same = f"were recorded with the same actuation as {self.names}"
        again = "record the same protocol before and after"
        if self.unchecked:
            share = float(self.pairs.paired[self.plain.held_out].mean())
            return (
                f"{100 * share:.0f} % of the held-out rows {same}, too few to check an amendment "
                f"of the change on them: {instead}; {again}"
            )
        share = float(self.pairs.paired[~self.table.held_out].mean())
        if share >= LEAST_SHARE:
            return (
                f"{100 * share:.0f} % of the rows {same}, but these are fewer than the "
                f"{LEAST_ROWS} that a paired difference needs: {instead}; record for longer"
            )
        few = _enough(self.plain, self.pairs, asked=True)
        alone = ", or explain the change in these rows alone by --paired always" if few else ""
        return f"{100 * share:.0f} % of the rows {same}: {instead}; {again}{alone}"


def _speed(table: ResidualTable) -> float:
    """Speed of the actuation of a table (`speed_of_runs`), 1/s."""
    timed = np.flatnonzero(table.timed)
    runs = np.split(timed, np.flatnonzero(np.diff(table.run[timed])) + 1)
    span = np.asarray(table.spec.span)
    return speed_of_runs((table.t_s[rows], table.pressure[rows] / span) for rows in runs)


def before_and_after(
    table: ResidualTable, before: Sequence[Recording], paired: Paired = "auto"
) -> BeforeAfter:
    """Pair AFTER's residual table with recordings from before a change."""
    if paired not in PAIRED:
        raise unknown_name("choice of pairing", paired, PAIRED)
    before = tuple(before)
    if not before:
        raise InputError("no recording from before the change; expected at least one")
    other = residual_table(table.model, list(before))
    _check_common_range(table, other)
    table = replace(table, jumps=body_jumps(table, own_jumps_mm(other)))
    if paired == "never":
        none = Pairs(table, other, _Found.none(table))
        return BeforeAfter(table, table, other, none, False, paired)
    found, pairs = paired_table(table, other, asked=paired == "always")
    if found is None and paired == "always":
        share = pairs.paired[~table.held_out].mean()
        raise InputError(
            f"{' + '.join(table.names)}: only {100 * share:.0f} % of the rows were recorded with "
            f"the same actuation as {' + '.join(pairs.before)}, expected half of them, or "
            f"{LEAST_S:g} s; record the same protocol before and after, or leave out "
            "--paired always"
        )
    return BeforeAfter(found or table, table, other, pairs, found is not None, paired)


def _check_common_range(after: ResidualTable, before: ResidualTable) -> None:
    """Raise where the actuation of BEFORE and AFTER has no range in common.

    A chamber that is nearly idle in both has none to compare: a regulator holds it at about 0.
    """
    ranges = [(table.pressure.min(axis=0), table.pressure.max(axis=0)) for table in (after, before)]
    moved = np.max([high - low for low, high in ranges], axis=0)
    for chamber in np.flatnonzero(moved >= IDLE * moved.max()):
        (a, b), (c, d) = ((low[chamber], high[chamber]) for low, high in ranges)
        if min(b, d) < max(a, c):
            raise InputError(
                f"{' + '.join(before.names)}: chamber {chamber + 1} goes from {c:.4g} to {d:.4g} "
                f"{after.spec.unit}, and after the change from {a:.4g} to {b:.4g}: no common "
                "actuation; use a recording from before the change that moves over the same range"
            )
