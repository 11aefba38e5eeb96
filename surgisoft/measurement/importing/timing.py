"""Moves of the body regressed on moves of the actuation, at shifts in time between the two."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from surgisoft.measurement.importing.align import renewal_s, renewed_rows, without_holds
from surgisoft.measurement.recordings import Recording

BACK_S = 0.5
"""Largest shift at which the body moves first [s]."""
FURTHER_BACK_S = 3.0
"""... where the best shift is as far back as that one [s]."""
AHEAD_S = 3.0
"""Largest shift at which the actuation moves first [s]."""
LEAST_STEP_S = 0.005
"""Shortest time between samples [s]."""
ROWS = 4000
"""Largest number of moves for an estimate, evenly over the recording."""
LEAST_ROWS = 200
"""Least number of moves for an estimate."""
STEPS = 25
"""Shifts on each side of zero, before those around the best one."""
BLOCKS = 30
"""Blocks of time over which the errors are summed separately."""
FOLDS = 5
"""Folds of the cross-validation."""
MOVE_SHARE = 0.25
"""The longest moves last until their mean square is this share of twice the body's variance."""
LONGEST_S = 5.0
"""No move lasts longer [s]."""
LIVE_SHARE = 0.02
"""A channel is looked at that moves by more than this share of the widest range."""
BODY_SHARE = 0.05
"""A coordinate is looked at that moves by more than this share of the one that moves most."""
GAP_S = 0.2
"""Key points are on a line over gaps up to this, or up to five samples [s]."""
RIDGE = 1e-4
"""Ridge of the regression, as a share of the features' mean square."""
MOST_SAMPLES = 300_000
"""Samples of the even clock, those of the first runs, among which a lead of the body is looked for;
the cost grows with them (a count)."""
MOST_GAPS = 100
"""Times that a run may last longer than its samples at the usual step: beyond it the run is mostly
gaps, and an even clock would have as many samples as its longest time claims."""


@dataclass(frozen=True, eq=False)
class Moves:
    """A recording's runs on an even clock."""

    step_s: float
    """Time between samples [s]."""
    actuation: list[np.ndarray]
    """Each run's actuation (G, m), scaled to [-1, 1]."""
    body: list[np.ndarray]
    """Each run's coordinates (G, d) [mm], NaN where missing."""
    longest: int
    """Length of the longest moves, in samples."""
    back_s: float = BACK_S
    """Largest shift of a search at which the body moves first [s]."""

    @classmethod
    def of(cls, recording: Recording) -> "Moves | None":
        """The runs that are long enough; None where too little moves."""
        low, high = recording.measured.min(axis=0), recording.measured.max(axis=0)
        live = high - low > LIVE_SHARE * (high - low).max()
        steps = [np.diff(recording.t_s[run]) for run in recording.runs]
        if not live.any() or not len(np.concatenate(steps)):
            return None
        step = max(float(np.median(np.concatenate(steps))), LEAST_STEP_S)
        scaled = (2 * (recording.measured - low) / np.where(live, high - low, 1.0) - 1)[:, live]
        actuation: list[np.ndarray] = []
        body: list[np.ndarray] = []
        for run in recording.runs:
            t_s = recording.t_s[run]
            if t_s[-1] - t_s[0] > MOST_GAPS * len(t_s) * step:
                continue
            left = MOST_SAMPLES - sum(len(part) for part in body)
            grid = np.arange(t_s[0], t_s[-1] + 1e-9, step)[:left]
            if len(grid) > 4 * BACK_S / step:
                actuation.append(_on(grid, t_s, scaled[run]))
                points = recording.key_points_mm[run]
                body.append(
                    np.concatenate(
                        [_seen_on(grid, t_s, points[:, j], step) for j in range(points.shape[1])],
                        axis=1,
                    )
                )
        if not body:
            return None
        spread = np.array([_spread(column) for column in np.concatenate(body).T])
        moving = spread > BODY_SHARE * spread.max()
        if not moving.any():
            return None
        body = [part[:, moving] for part in body]
        moves = cls(step, actuation, body, _longest(body, spread[moving], step))
        return moves if len(moves._rows(moves.longest)[1]) >= LEAST_ROWS else None

    def power(self, length: int) -> float:
        """Sum of squares of the moves of this length, mm^2."""
        return float(np.square(self._rows(length)[1]).sum())

    def mean_square(self, length: int, part: int | None = None) -> float:
        """Mean square of the moves of this length that are compared [mm^2], or of only the last
        `part` samples of each; 0 without any."""
        rows, moved = self._rows(length)
        if part is not None:
            pairs = zip(self.body, rows, strict=True)
            moved = np.concatenate([body[at] - body[at - part] for body, at in pairs])
        known = moved[~np.isnan(moved).any(axis=1)]
        return float(np.square(known).sum(axis=1).mean()) if len(known) else 0.0

    def search(self, length: int) -> tuple[np.ndarray, int, np.ndarray]:
        """Shifts (K,) in samples, the place of the best one, and squared errors (K, BLOCKS) mm^2.

        A positive shift: the body follows its actuation.
        """
        rows, moved = self._rows(length)
        back, ahead = round(self.back_s / self.step_s), self._ahead(length)
        coarse = max(1, -(-back // STEPS))
        near = np.arange(-back, min(back, ahead) + 1, coarse)
        far = (
            np.geomspace(max(back, 1), ahead, 12).round().astype(int) if ahead > back else near[:0]
        )
        shifts = np.union1d(np.union1d(near, far), [0]).astype(int)
        errors = {s: self._errors(rows, moved, length, s) for s in shifts.tolist()}
        best = min(errors, key=lambda s: errors[s].sum())
        below = max((s for s in errors if s < best), default=best)
        above = min((s for s in errors if s > best), default=best)
        every = max(1, (above - below) // STEPS)
        around = {*range(best - coarse, best + coarse + 1), *range(below, above, every)}
        for s in sorted(around):
            if -back <= s <= ahead and s not in errors:
                errors[s] = self._errors(rows, moved, length, s)
        shifts = np.array(sorted(errors))
        table = np.stack([errors[s] for s in shifts.tolist()])
        return shifts, int(table.sum(axis=1).argmin()), table

    def explained_at(self, shift: int, length: int, most_rows: int) -> float:
        """Share of the moves of this length that the actuation, shifted by any number of samples,
        explains: cross-validated, of at most about `most_rows` moves; 0 for too few."""
        rows, body = self._rows_at(shift, length, most_rows)
        if len(body) < LEAST_ROWS:
            return 0.0
        errors = self._errors(rows, body, length, shift)
        return 1 - float(errors.sum() / max(np.square(body).sum(), 1e-300))

    def errors_at(self, shift: int, most: int, length: int) -> np.ndarray:
        """(BLOCKS,) squared error at a shift [mm^2], in the rows that the largest shift leaves."""
        rows, body = self._rows_at(most, length, ROWS)
        return self._errors(rows, body, length, shift)

    def behind(self, samples: float, lags: int) -> "Moves":
        """The moves with the actuation behind equal first-order lags of so many samples each."""
        parts = self.actuation
        for _ in range(lags):
            parts = [lagged(part, samples) for part in parts]
        return replace(self, actuation=parts)

    def _rows_at(self, shift: int, length: int, most_rows: int) -> tuple[list, np.ndarray]:
        """Where moves end in each run, and the known ones (S, d) [mm], that a shift leaves."""
        rows, moved = [], []
        every = max(1, sum(len(part) for part in self.body) // most_rows)
        for part in self.body:
            at = np.arange(max(shift, 0) + length, len(part) + min(shift, 0), every)
            move = part[at] - part[at - length]
            known = ~np.isnan(move).any(axis=1)
            rows.append(at[known])
            moved.append(move[known])
        return rows, np.concatenate(moved)

    def further_back(self) -> "Moves":
        """The same moves, searched further back, as far as a third of a usual run allows."""
        third = np.median([len(part) for part in self.body]) / 3 * self.step_s
        return replace(self, back_s=max(self.back_s, min(FURTHER_BACK_S, float(third))))

    def _ahead(self, length: int) -> int:
        """Largest shift, in samples, that leaves two thirds of a usual run to look at."""
        usual = int(np.median([len(part) for part in self.body]))
        return max(1, min(round(AHEAD_S / self.step_s), usual // 3 - length))

    def _rows(self, length: int) -> tuple[list[np.ndarray], np.ndarray]:
        """Where moves end in each run, and the moves of the body (S, d) [mm] that are known."""
        back, ahead = round(self.back_s / self.step_s), self._ahead(length)
        every = max(1, sum(len(part) for part in self.body) // ROWS)
        rows, moved = [], []
        for part in self.body:
            at = np.arange(ahead + length, len(part) - back, every)
            move = part[at] - part[at - length]
            known = ~np.isnan(move).any(axis=1)
            rows.append(at[known])
            moved.append(move[known])
        return rows, np.concatenate(moved)

    def _errors(self, rows, moved: np.ndarray, length: int, shift: int) -> np.ndarray:
        """(BLOCKS,) cross-validated squared error of moves (S, d), block by block [mm^2]."""
        order, folds, block = _folds(len(moved))
        every, begins = self._joined
        parts = zip(rows, begins, strict=True)
        at = np.concatenate([at + begin for at, begin in parts])[order] - shift
        features = _features(every.take(at, axis=1))
        features -= _features(every.take(at - length, axis=1))
        moved = moved[order]
        grams = np.stack([features[:, fold] @ features[:, fold].T for fold in folds])
        pulls = np.stack([features[:, fold] @ moved[fold] for fold in folds])
        others, pulled = grams.sum(axis=0) - grams, pulls.sum(axis=0) - pulls
        count = len(features)
        ridge = np.maximum(RIDGE * np.trace(others, axis1=1, axis2=2) / count, 1e-12)
        weights = np.linalg.solve(others + ridge[:, None, None] * np.eye(count), pulled)
        left = [
            moved[fold] - features[:, fold].T @ own
            for fold, own in zip(folds, weights, strict=True)
        ]
        return np.bincount(block, _squares(np.concatenate(left)), BLOCKS)

    @cached_property
    def _joined(self) -> tuple[np.ndarray, list[int]]:
        """The actuation (m, S) run after run, and where each run begins."""
        begins = np.cumsum([0, *(len(part) for part in self.actuation[:-1])]).tolist()
        return np.ascontiguousarray(np.concatenate(self.actuation).T), begins


@lru_cache(maxsize=64)
def _folds(count: int) -> tuple[np.ndarray, tuple[slice, ...], np.ndarray]:
    """Moves (count,) in order of their folds, where each fold is in it, and each one's block."""
    block = np.arange(count) * BLOCKS // count
    fold = block % FOLDS
    order = np.argsort(fold, kind="stable")
    ends = np.cumsum(np.bincount(fold, minlength=FOLDS)).tolist()
    return order, tuple(map(slice, [0, *ends[:-1]], ends)), block[order]


def _features(actuation: np.ndarray) -> np.ndarray:
    """(k, S) of actuation (m, S): itself and all products of two."""
    count = len(actuation)
    made = np.empty((count + count * (count + 1) // 2, actuation.shape[1]))
    made[:count] = actuation
    first = count
    for k in range(count):
        np.multiply(actuation[k], actuation[k:], out=made[first : first + count - k])
        first += count - k
    return made


def _squares(vectors: np.ndarray) -> np.ndarray:
    """(S,) squared lengths of vectors (S, d)."""
    return np.einsum("sd,sd->s", vectors, vectors)


def _on(grid: np.ndarray, t_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(G, c) of values (T, c) at times t_s (T,), on a line between them."""
    return np.stack([np.interp(grid, t_s, column) for column in values.T], axis=1)


def _seen_on(grid: np.ndarray, t_s: np.ndarray, point: np.ndarray, step: float) -> np.ndarray:
    """(G, 3) of a key point (T, 3), missing before, after and in long gaps of what is known."""
    known = ~np.isnan(point[:, 0])  # missing ones are missing as a whole
    if known.sum() < 2:
        return np.full((len(grid), 3), np.nan)
    known_s = t_s[known]
    after = np.clip(np.searchsorted(known_s, grid), 1, len(known_s) - 1)
    lost = known_s[after] - known_s[after - 1] > max(GAP_S, 5 * step)
    lost |= (grid < known_s[0]) | (grid > known_s[-1])
    return np.where(lost[:, None], np.nan, _on(grid, known_s, point[known]))


def lagged(values: np.ndarray, samples: float) -> np.ndarray:
    """(G, m) of values (G, m) behind a first-order lag of so many samples, at rest at the begin."""
    if samples <= 0.0:
        return values
    from scipy.signal import lfilter  # a tenth of a second, which few imports need

    keep = float(np.exp(-1.0 / samples))
    return lfilter([1.0 - keep], [1.0, -keep], values, axis=0, zi=keep * values[:1])[0]


def _spread(column: np.ndarray) -> float:
    """Standard deviation of what is known."""
    known = column[~np.isnan(column)]
    return float(known.std()) if len(known) else 0.0


def _longest(body: list[np.ndarray], spread: np.ndarray, step: float) -> int:
    """The length, in samples, from which on moves have their share of the body's variance."""
    wanted = MOVE_SHARE * 2 * np.square(spread).sum()
    length = 1
    while True:
        moved = [part[length:] - part[:-length] for part in body if len(part) > length]
        longer = max(length + 1, round(1.3 * length))
        if not moved or longer * step > LONGEST_S:
            return length
        every = np.square(np.concatenate(moved))
        if np.nanmean(every, axis=0).sum() >= wanted:
            return length
        length = longer


LEAST_SHARE = 0.05
"""Least share of the squared error that a lead must remove beyond every lag."""
LEAST_T = 4.0
"""Least mean over standard error, over blocks, of what a lead removes."""
LEAST_SPEED_R2 = 0.3
"""A length of move counts where its actuation explains at least this share of it."""
SAME_LEAD = 0.6
"""Least lead of shorter moves, as a share of that of the longest ones."""

HELD_RANGE = (0.5, 1.6)
"""A held reading lasts so many times the usual period."""
HELD_REGULAR = 0.8
"""Least share of readings that last so long, for the sensor to be called slow."""


@dataclass(frozen=True)
class Lead:
    """By how much time the body leads its measured actuation."""

    seconds: float
    """Best estimate, which includes the lag of the arm [s]."""
    ci95_s: tuple[float, float]
    """95 % interval, by a jackknife over blocks of time [s]."""
    at_least: bool = False
    """Whether the lead is the largest one that was tried."""


def held_period_s(recording: Recording) -> float | None:
    """The period of a sensor that is slower than the log while the body moves on [s]; else None.

    Not where readings come irregularly, as quantised or resting ones do, nor where the command
    changes in the very same rows: then the actuation may be a staircase indeed.
    """
    if recording.kind == "settled":
        return None
    renewed = [renewed_rows(recording.measured[run]) for run in recording.runs]
    steps = np.concatenate([np.diff(fresh) for fresh in renewed])
    usual = np.median(steps) if len(steps) >= LEAST_ROWS else 1.0
    if usual < 2:
        return None
    alive, same = [], []
    for run, fresh in zip(recording.runs, renewed, strict=True):
        points = recording.key_points_mm[run].reshape(run.stop - run.start, -1)
        moved = (np.diff(points, axis=0) != 0) & ~np.isnan(np.diff(points, axis=0))
        held = np.ones(len(points), bool)
        held[0] = held[fresh] = False
        alive.append(moved[held[1:]].any(axis=1))
        if recording.commanded is not None:
            same.append(np.isin(fresh[1:], renewed_rows(recording.commanded[run])[1:]))
    if np.concatenate(alive).mean() < 0.5:
        return None
    low, high = (factor * usual for factor in HELD_RANGE)
    if ((steps >= low) & (steps <= high)).mean() < HELD_REGULAR:
        return None
    if same and np.concatenate(same).mean() > 0.9 and _staircase(recording, usual):
        return None
    return renewal_s([(recording.t_s[run], recording.measured[run]) for run in recording.runs])


def _staircase(recording: Recording, usual: float) -> bool:
    """Whether the command is renewed as seldom as the measurement."""
    command = recording.commanded
    if command is None:
        return False
    steps = [np.diff(renewed_rows(command[run])) for run in recording.runs]
    return bool(np.median(np.concatenate(steps)) >= 0.8 * usual)


def released(recording: Recording, period_s: float) -> Recording:
    """The recording with readings on a line between those of a slow sensor."""
    measured = recording.measured.copy()
    for run in recording.runs:
        measured[run] = without_holds(recording.t_s[run], measured[run], period_s)
    return replace(recording, measured=measured)


def body_lead(recording: Recording) -> Lead | None:
    """The body's lead before its measured actuation, where the recording shows one significantly.

    Moves of the body x(t) - x(t - w) are regressed on those of a quadratic function of the
    actuation, shifted in time, and cross-validated. A lead is reported where it leaves a smaller
    error than every lag (so that a periodic motion, whose lead is as good as a lag, shows
    none), and where shorter moves show it too: a late log shifts every speed of motion alike,
    whereas an arm's relaxation, or a readings' hold, shifts some of them only.
    """
    if recording.kind == "settled":
        return None
    moves = Moves.of(recording)
    if moves is None or moves.power(moves.longest) == 0.0:
        return None
    first, best, error = moves.search(moves.longest)
    if best in (0, len(first) - 1):
        further = moves.further_back()
        if len(further._rows(moves.longest)[1]) >= LEAST_ROWS:
            moves = further
            first, best, error = moves.search(moves.longest)
    causal = error[first >= 0].sum(axis=1)
    won = error[first >= 0][causal.argmin()] - error[best]
    if first[best] >= 0 or won.sum() < LEAST_SHARE * causal.min():
        return None
    if won.mean() < LEAST_T * won.std(ddof=1) / np.sqrt(len(won)):
        return None
    length = moves.longest
    while length > 1:
        length = length // 2
        shifts, at, losses = moves.search(length)
        explained = 1 - losses[at].sum() / max(moves.power(length), 1e-300)
        if explained >= LEAST_SPEED_R2 and shifts[at] > SAME_LEAD * first[best]:
            return None
    seconds, spread = _jackknife(first, error)
    if seconds + 2 * spread >= 0:
        return None
    step = moves.step_s
    low, high = -(seconds + 2 * spread) * step, -(seconds - 2 * spread) * step
    return Lead(-seconds * step, (low, high), at_least=best == 0)


def set_delay(delays_s: Mapping[str, float], more_s: float, digits: str = ".3f") -> str:
    """What to put into a map where logs of actuation are later than it says, by `more_s` [s].

    delays_s: delay that the map already corrects, by its tables that are of the same clock [s].
    """
    by_value: dict[str, list[str]] = {}
    for table, delay_s in delays_s.items():
        by_value.setdefault(format(delay_s + more_s, digits), []).append(f"[{table}]")
    parts = [f"delay_s = {value} in {' and '.join(names)}" for value, names in by_value.items()]
    return f"set {' and '.join(parts)} of the map"


def timing_notes(
    recording: Recording, delays_s: Mapping[str, float], lead: bool = True
) -> list[str]:
    """Notes about a delay of the actuation's clock, with what to put into the import's map.

    delays_s: as for `set_delay`; lead: whether a lead of the body is told.
    """
    notes = []
    period = held_period_s(recording)
    if period is not None:
        recording = released(recording, period)
        notes.append(
            f"measured actuation is renewed every {period:.4g} s only and held in between, while "
            'the body moves on: if its sensor is slower than the log, set repeated = "interpolate" '
            "in [measured] of the map"
        )
    found = body_lead(recording) if lead else None
    if found is not None:
        low, high = found.ci95_s
        within = f"{found.seconds:.3f} s ({low:.3f} to {high:.3f})"
        again = ""
        if found.at_least:
            within = f"at least {found.seconds:.3f} s, the largest lead that is tried,"
            again = ", and import again to see what is left"
        notes.append(
            f"the body moves {within} before its measured actuation, which no arm that follows it "
            f"can: if the actuation was logged late, {set_delay(delays_s, found.seconds)}{again}"
        )
    return notes


def _jackknife(shifts: np.ndarray, error: np.ndarray) -> tuple[float, float]:
    """The best of shifts (K,), in samples, by errors (K, blocks), and its standard error."""
    total = error.sum(axis=1)
    blocks = error.shape[1]
    without = [_lowest(shifts, total - error[:, k]) for k in range(blocks)]
    spread = np.sqrt((blocks - 1) / blocks * np.square(np.array(without) - np.mean(without)).sum())
    return _lowest(shifts, total), float(spread)


def _lowest(shifts: np.ndarray, total: np.ndarray) -> float:
    """Where the parabola through the lowest of totals (K,) and its two neighbours is lowest."""
    at = int(total.argmin())
    if at in (0, len(total) - 1):
        return float(shifts[at])
    a, b, _ = np.polyfit(shifts[at - 1 : at + 2] - shifts[at], total[at - 1 : at + 2], 2)
    return float(shifts[at] - b / (2 * a)) if a > 0 else float(shifts[at])
