"""Data quality of a recording: channels that froze and jumps in the marker data, found and removed.

A frozen signal repeats one value bit for bit, for longer than it ever does otherwise, while other
signals change. A jump is one step of a key point that neither the rows around it, nor the other
key points, nor the actuation explain. Steady-state samples are independent of each other: each
key point of theirs is compared with a smooth function of the actuation instead of with the row
before.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from surgisoft.measurement.recordings.recording import Recording
from surgisoft.measurement.recordings.valves import valve_words

LEAST_FROZEN_ROWS = 20
"""Shorter repeats are never called frozen."""
FROZEN_RATIO = 5.0
"""How many times longer than its usual longest repeat (99 % quantile) a frozen signal repeats."""
SOME_ZIGZAGS = 0.05
"""Share of two turns on end above which a reading is noisy [-]: 0 of a smooth signal."""
RESTS = 3
"""From so many repeats of LEAST_FROZEN_ROWS on, a channel without a command rests by design, unless
nearly all of its other rows are noise (a count)."""
MOSTLY_NOISE = 1 / 3
"""Share of two turns on end above which nearly all rows are noise [-]: between 1/4 of a random
walk, which is an actuation, and 5/12 of white noise (Bienaymé 1874: runs up and down)."""
JUMP_RATIO = 6.0
"""How many times larger than the usual steps before and after it a jump is."""
JUMP_SHARE = 0.02
"""The least jump, as a share of the arm's largest motion."""
ACTUATION_SHARE = 0.25
"""The least move of the actuation that explains a step, each as a share of its whole motion."""
STEP_WINDOW = 12
"""Number of steps before and after that define the usual size of a step."""
SPIKE_ROWS = 12
"""A key point that comes back within so many rows has made a spike."""
SPIKE_RETURN = 0.5
"""How near a spike ends to where it began, as a share of its size."""
STEADY_RATIO = 15.0
"""Robust standard deviations by which a steady-state key point is off that counts as a jump."""
STEADY_SHARE = 0.1
"""The least deviation of a steady-state key point called a jump, as a share of its motion."""
COPIED_ROWS = 20
"""Shorter stretches that equal earlier rows are never called copies."""
COPIED_CHANGES = 10
"""Least number of these rows that differ from the row before: an arm at rest before coarse sensors
gives the same row again."""
LEAST_PERIODS = 3
"""From so many periods on, a run without noise repeats its motion: these rows are no copies (a
count)."""
MOST_PERIODS = 10
"""Periods that are tried for a stretch, the shortest first (a count)."""
MOST_MOTIONS = 20
"""Periodic motions that are looked for in a run (a count)."""
ALONE_SHARE = 0.1
"""Least motion of a key point, as a share of the arm's length, that constant actuation does not
explain: an arm that creeps or swings out under it moves less [-]."""
MOTION_QUANTILES = (0.01, 0.99)
"""Quantiles of a coordinate between which that motion lies: lost markers jump far [-]."""
MIX = np.uint64(0x9E3779B97F4A7C15)
"""Odd number by which hashes of values are multiplied (2^64 over the golden ratio, Knuth 1973)."""


@dataclass(frozen=True)
class QualityWarning:
    """One finding, in words, and where it starts."""

    sample: int
    """Index of the sample where it starts."""
    text: str
    """What was found, in one line."""


def find_warnings(recording: Recording) -> list[QualityWarning]:
    """The findings, in the order of their samples."""
    jumps = _steady_state_jumps if recording.kind == "settled" else _continuous_jumps
    with np.errstate(over="ignore", invalid="ignore"):  # finite numbers of any size are read
        found = [*_frozen_channels(recording), *_frozen_key_points(recording), *jumps(recording)]
    found += _copied_rows(recording)
    if alone := moves_alone([recording]):
        found.append(QualityWarning(0, alone))
    return sorted(found, key=lambda warning: warning.sample)


def moves_alone(recordings: list[Recording]) -> str:
    """In words, that the body moves while all actuation keeps its value in every row; else empty.

    The motion is compared with the length of the arm (`largest_motion`).
    """
    signal = np.concatenate([recording.measured for recording in recordings])
    if len(signal) < LEAST_FROZEN_ROWS or (signal != signal[0]).any():
        return ""
    if any(ranges.any() for recording in recordings for _, ranges in recording.actuation_ranges):
        return ""
    most, moved_mm, length_mm = max(
        (largest_motion([recording]) for recording in recordings), key=lambda found: found[1]
    )
    if not length_mm or moved_mm < ALONE_SHARE * length_mm:
        return ""
    values = ", ".join(f"{value:.4g}" for value in signal[0])
    return (
        f"no channel of the actuation moves ({values} {recordings[0].unit} in every row), while "
        f"key point k{most} moves by {moved_mm:.3g} mm: check the log, and the columns of "
        "[measured] in the map"
    )


def context_varies(recording: Recording) -> bool:
    """Whether a stated load or temperature varies, which moves an arm at constant pressure."""
    stated = (recording.payload_g, recording.temp_C)
    return any(
        np.ptp(values[known]) > 0.0
        for values in stated
        if values is not None and (known := np.isfinite(values)).any()
    )


def largest_motion(recordings: list[Recording]) -> tuple[int, float, float | None]:
    """The key point that moves most, its motion [mm], and the length of the arm [mm], if known.

    The motion is the diagonal of the box between `MOTION_QUANTILES` of its coordinates. The length
    is the stated one, or the distance between the first and the last key point.
    """
    points = np.concatenate([recording.key_points_mm for recording in recordings])
    known = ~np.isnan(points).any(axis=2)
    moved = [
        float(
            np.linalg.norm(np.ptp(np.quantile(points[seen, j], MOTION_QUANTILES, axis=0), axis=0))
        )
        if seen.any()
        else 0.0
        for j, seen in enumerate(known.T)
    ]
    length = recordings[0].arm.length_mm
    both = known[:, 0] & known[:, -1]
    if length is None and both.any():
        length = float(np.median(np.linalg.norm(points[both, -1] - points[both, 0], axis=1)))
    most = int(np.argmax(moved))
    return most, moved[most], length


# --- copies -------------------------------------------------------------------------------------


def _stretch_hashes(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Hash (S,) uint64 of each stretch of COPIED_ROWS rows, and whether it changes enough to count.

    Of actuation and key points; times, and the numbers of runs, may differ between copies.
    """
    points = recording.key_points_mm.reshape(recording.samples, -1)
    parts = [recording.measured, points]
    parts += [] if recording.commanded is None else [recording.commanded]
    row = np.zeros(recording.samples, np.uint64)
    for column in np.concatenate(parts, axis=1).T:
        value = np.where(np.isnan(column), np.nan, column + 0.0)  # one zero, one NaN
        row = (row ^ value.view(np.uint64)) * MIX
        row ^= row >> np.uint64(29)
    count = max(recording.samples - COPIED_ROWS + 1, 0)
    changed = np.cumsum(np.concatenate([[0], row[1:] != row[:-1]]))
    stretch = np.zeros(count, np.uint64)
    for k in range(COPIED_ROWS):
        stretch = (stretch ^ row[k : k + count]) * MIX
        stretch ^= stretch >> np.uint64(29)
    return stretch, changed[COPIED_ROWS - 1 :] - changed[:count] >= COPIED_CHANGES


def _copied_rows(recording: Recording) -> list[QualityWarning]:
    """Rows that equal earlier ones bit for bit, as where runs were appended twice."""
    stretch, counts = _stretch_hashes(recording)
    _, first, which = np.unique(stretch, return_index=True, return_inverse=True)
    copied = np.flatnonzero(counts & (first[which] < np.arange(len(stretch))))
    run = recording.run
    in_one = copied[run[copied] == run[first[which[copied]]]]
    copied = copied[~np.isin(copied, in_one[_periodic(recording, stretch, in_one)[in_one]])]
    if not len(copied):
        return []
    edges = np.zeros(recording.samples + 1, np.int64)
    np.add.at(edges, copied, 1)
    np.add.at(edges, copied + COPIED_ROWS, -1)
    rows = int((np.cumsum(edges) > 0).sum())
    start = int(copied[0])
    earlier = int(first[which][start])
    text = (
        f"{rows} of {recording.samples} rows equal earlier ones bit for bit, from here on those "
        f"from {recording.t_s[earlier]:.3f} s of run {recording.run[earlier]} on: copies count "
        "twice in a fit, and held-out rows are known to it; remove them"
    )
    return [QualityWarning(start, text)]


def _periodic(recording: Recording, stretch: np.ndarray, copied: np.ndarray) -> np.ndarray:
    """(S,) bool: the stretches of a motion that a run repeats, as simulations without noise do.

    stretch: hashes (S,); copied: the stretches that equal earlier ones of their run.
    """
    found = np.zeros(len(stretch), bool)
    for run in recording.runs:
        last = max(run.stop - COPIED_ROWS + 1, run.start)
        inside, own = stretch[run.start : last], copied[(copied >= run.start) & (copied < last)]
        for _ in range(MOST_MOTIONS):
            own = own[~found[own]]
            if not len(own):
                break
            motion = _motion_around(inside, int(own[len(own) // 2]) - run.start)
            if motion is None:
                break
            found[run.start + motion.start : run.start + motion.stop] = True
    return found


def _motion_around(inside: np.ndarray, place: int) -> slice | None:
    """The stretches of a run, of hashes (K,), that repeat with one period around one of them."""
    earlier = np.flatnonzero(inside[:place] == inside[place])[::-1]
    for period in (place - earlier[:MOST_PERIODS]).tolist():
        differs = np.flatnonzero(inside[period:] != inside[:-period])
        at = int(np.searchsorted(differs, place - period))
        start = int(differs[at - 1]) + 1 if at else 0
        end = int(differs[at]) if at < len(differs) else len(inside) - period
        if end - start > (LEAST_PERIODS - 1) * period - COPIED_ROWS:
            return slice(start, end + period)
    return None


def copies_of_others(recordings: list[Recording]) -> list[str]:
    """A line for each recording that has rows of one before it, bit for bit."""
    found: list[str] = []
    hashes = [_stretch_hashes(recording) for recording in recordings]
    known = [np.unique(stretch[counts]) for stretch, counts in hashes]
    for later in range(1, len(recordings)):
        for earlier in range(later):
            both = np.isin(known[later], known[earlier], assume_unique=True)
            if both.any():
                found.append(
                    f"{recordings[later].label}: {both.mean():.0%} of its motion equals that of "
                    f"{recordings[earlier].label} bit for bit: copies count twice in a fit, and "
                    "held-out rows are known to it; give each row once"
                )
                break
    return found


# --- frozen signals ----------------------------------------------------------------------------


def _changes(signal: np.ndarray, run: np.ndarray) -> np.ndarray:
    """(T,) bool: where a signal (T, d) differs from the row before or a run (T,) starts."""
    with np.errstate(invalid="ignore"):
        differs = run[1:] != run[:-1]
        for column in signal.T:  # a missing value differs from every value
            differs |= column[1:] != column[:-1]
    return np.concatenate([[True], differs])


def _lengths(changed: np.ndarray) -> np.ndarray:
    """Number of rows of each stretch that repeats one value."""
    return np.diff(np.append(np.flatnonzero(changed), len(changed)))


def _long_repeats(changed: np.ndarray) -> list[slice]:
    """The stretches that repeat one value for much longer than the signal usually does."""
    starts, lengths = np.flatnonzero(changed), _lengths(changed)
    others = np.sort(lengths)[:-1]
    usual = np.quantile(others, 0.99, method="lower") if len(others) else 0
    least = max(LEAST_FROZEN_ROWS, FROZEN_RATIO * usual)
    long = np.flatnonzero(lengths >= least)
    return [slice(int(starts[i]), int(starts[i] + lengths[i])) for i in long]


def _lives(changed: np.ndarray, stretch: slice) -> bool:
    """Whether a signal with these changes (T,) changes in at least a tenth of the stretch."""
    inside = changed[stretch][1:]
    return bool(inside.mean() >= 0.1)


def _outside(stretch: slice, rows: int) -> np.ndarray:
    mask = np.ones(rows, bool)
    mask[stretch] = False
    return mask


def _flickers(channel: np.ndarray, changed: np.ndarray, least: float = SOME_ZIGZAGS) -> bool:
    """Whether a reading (T,) zigzags like noise over the rows (T,) where it changes.

    Two turns on end: 5 in 12 of white noise, 1 in 4 of a random walk, none of a smooth signal.
    """
    steps = np.sign(np.diff(channel[changed]))
    zigzags = (steps[1:-1] * steps[:-2] < 0) & (steps[1:-1] * steps[2:] < 0)
    return len(zigzags) > 10 and zigzags.mean() > least


def _channel_froze(
    recording: Recording, i: int, changed: np.ndarray, stretch: slice, rests: int
) -> bool:
    """Whether this repeat of channel i is a fault: its command moves, or it is never at rest.

    rests: number of repeats of the channel that are long enough for a fault.
    """
    outside = _outside(stretch, recording.samples)
    if recording.commanded is None:
        least = SOME_ZIGZAGS if rests < RESTS else MOSTLY_NOISE
        return _flickers(recording.measured[:, i], changed & outside, least)
    command = recording.commanded[:, i]
    rest = ~_changes(command[:, None], recording.run)
    if _flickers(recording.measured[:, i], changed & outside & rest):
        return True
    moves = np.abs(command[stretch] - command[stretch.start]) > 0.01 * np.ptp(command)
    return int(moves.sum()) >= LEAST_FROZEN_ROWS


def frozen_channels(recording: Recording) -> list[tuple[list[int], slice]]:
    """Channels (counted from 0) that froze together, and the samples that repeat one reading."""
    channels = [
        _changes(recording.measured[:, i : i + 1], recording.run) for i in range(recording.chambers)
    ]
    points: list[np.ndarray] = []
    frozen: list[tuple[int, slice]] = []
    for i, changed in enumerate(channels):
        rests = int((_lengths(changed) >= LEAST_FROZEN_ROWS).sum())
        for stretch in _long_repeats(changed):
            points = points or _key_point_changes(recording)
            others = [*channels[:i], *channels[i + 1 :], *points]
            alive = any(_lives(other, stretch) for other in others)
            if alive and _channel_froze(recording, i, changed, stretch, rests):
                frozen.append((i, stretch))
    return _merged(frozen)


def _frozen_channels(recording: Recording) -> list[QualityWarning]:
    return [
        QualityWarning(
            stretch.start,
            f"{', '.join(f'p{i + 1}_{recording.unit}' for i in members)} repeat bit-equal for "
            f"{_duration(recording, stretch)} while other signals move{_more(times)}; frozen?",
        )
        for members, stretch, times in _first(frozen_channels(recording))
    ]


def _merged(frozen: list[tuple[int, slice]]) -> list[tuple[list[int], slice]]:
    """Signals that froze together, as one finding: most of one stretch lies inside the other."""
    groups: list[tuple[list[int], slice]] = []
    for i, stretch in sorted(frozen, key=lambda item: (item[1].start, item[0])):
        for members, first in groups:
            common = min(first.stop, stretch.stop) - max(first.start, stretch.start)
            if i not in members and common > 0.8 * (stretch.stop - stretch.start):
                members.append(i)
                break
        else:
            groups.append(([i], stretch))
    return [(sorted(members), stretch) for members, stretch in groups]


def _first(found: list[tuple[list[int], slice]]) -> list[tuple[list[int], slice, int]]:
    """The first stretch of each set of signals that froze together, and how many it has."""
    stretches: dict[tuple[int, ...], list[slice]] = {}
    for members, stretch in found:
        stretches.setdefault(tuple(members), []).append(stretch)
    return [(list(members), all_[0], len(all_)) for members, all_ in stretches.items()]


def _more(times: int) -> str:
    """The words for further findings of one kind."""
    if times < 2:
        return ""
    return f", and {times - 1} more time{'s' if times > 2 else ''}"


def _duration(recording: Recording, stretch: slice) -> str:
    seconds = recording.t_s[stretch.stop - 1] - recording.t_s[stretch.start]
    return f"{stretch.stop - stretch.start} rows ({seconds:.3g} s)"


def _key_point_changes(recording: Recording) -> list[np.ndarray]:
    return [
        _changes(recording.key_points_mm[:, j], recording.run) for j in range(recording.key_points)
    ]


def _actuation_moves(recording: Recording, rows: slice, share: float) -> bool:
    """Whether any channel moves by this share of its whole range within the rows."""
    for values, ranges in recording.actuation_ranges:
        if len(values[rows]):
            moved = np.ptp(values[rows], axis=0)
            if (moved > share * np.maximum(ranges, 1e-300)).any():
                return True
    return False


def frozen_key_points(recording: Recording) -> list[tuple[list[int], slice]]:
    """Key points (from 0) that froze together, and the samples that repeat one position."""
    changes = _key_point_changes(recording)
    frozen: list[tuple[int, slice]] = []
    for j, changed in enumerate(changes):
        if j == 0 and not changed[_outside_run_starts(recording)].any():
            continue  # the base may be fixed
        for stretch in _long_repeats(changed):
            known = not np.isnan(recording.key_points_mm[stretch.start, j]).any()
            others = any(_lives(c, stretch) for c in (*changes[:j], *changes[j + 1 :]))
            if known and (others or _actuation_moves(recording, stretch, 0.05)):
                frozen.append((j, stretch))
    return _merged(frozen)


def _frozen_key_points(recording: Recording) -> list[QualityWarning]:
    return [
        QualityWarning(
            stretch.start,
            f"key point {', '.join(f'k{j}' for j in members)} repeats bit-equal for "
            f"{_duration(recording, stretch)} while other signals move{_more(times)}; frozen?",
        )
        for members, stretch, times in _first(frozen_key_points(recording))
    ]


def _outside_run_starts(recording: Recording) -> np.ndarray:
    mask = np.ones(recording.samples, bool)
    mask[[run.start for run in recording.runs]] = False
    return mask


# --- jumps of key points -----------------------------------------------------------------------


@dataclass(frozen=True)
class _Track:
    """The fresh positions of one key point in one run: known, and not the stale row before."""

    rows: np.ndarray
    """(F,) sample index of each fresh position."""
    steps_mm: np.ndarray
    """(F - 1,) length of the step to each fresh position from the one before, per row, or per usual
    time between rows where rows are lacking [mm]."""

    def ratios(self, at: np.ndarray) -> np.ndarray:
        """Steps `at` (C,) against the usual steps before and after each, whichever is the larger.

        0 where fewer than three steps stand on a side.
        """
        usual = np.maximum(self._usual(at - STEP_WINDOW), self._usual(at + 1))
        good = (at >= 3) & (at < len(self.steps_mm) - 3)
        return np.where(good, self.steps_mm[at] / np.maximum(usual, 1e-12), 0.0)

    def ratios_of(self, rows: np.ndarray, steps_mm: np.ndarray) -> np.ndarray:
        """(C,) steps of these lengths (C,) to samples (C,) against the usual steps before and after
        each.

        0 where the track has no step.
        """
        if not len(self.steps_mm):
            return np.zeros(len(rows))
        at = np.searchsorted(self.rows[1:-1], rows)
        usual = np.maximum(self._usual(at - STEP_WINDOW), self._usual(at + 1))
        return steps_mm / np.maximum(usual, 1e-12)

    def _usual(self, first: np.ndarray) -> np.ndarray:
        """(C,) median of the steps in the window that begins at each of these, as far as known."""
        padded, usual = self._padded_mm, np.zeros(len(first))
        for start in range(0, len(first), 100_000):
            some = np.arange(start, min(start + 100_000, len(first)))
            windows = np.sort(padded[first[some, None] + STEP_WINDOW + np.arange(STEP_WINDOW)])
            known = STEP_WINDOW - np.isnan(windows).sum(axis=1)  # missing ones are sorted last
            each = np.arange(len(some))
            middle = windows[each, (known - 1) // 2] + windows[each, known // 2]
            usual[some] = np.where(known > 0, 0.5 * middle, 0.0)
        return usual

    @cached_property
    def _padded_mm(self) -> np.ndarray:
        """The steps between two windows of unknown ones."""
        padding = np.full(STEP_WINDOW, np.nan)
        return np.concatenate([padding, self.steps_mm, padding])

    def ratios_near(self, rows: np.ndarray) -> np.ndarray:
        """(C,) the largest ratio of the steps that end within one fresh position of each sample."""
        near = np.searchsorted(self.rows[1:], rows)[:, None] + np.array([-1, 0, 1])
        there = (near >= 0) & (near < len(self.steps_mm))
        ratios = np.zeros(near.shape)
        ratios[there] = self.ratios(near[there])
        return ratios.max(axis=1, initial=0.0)


def _track(points: np.ndarray, t_s: np.ndarray, start: int) -> _Track:
    """The track of positions (R, 3) [mm] at times (R,) [s] of a run that begins at sample `start`.

    A step over frames that a camera dropped takes as long as several, whether the log has rows for
    them or not.
    """
    known = np.flatnonzero(~np.isnan(points[:, 0]))  # missing ones are missing as a whole
    fresh = known[_changes(points[known], np.zeros(len(known)))] if len(known) else known
    moved = np.diff(points[fresh], axis=0)
    steps = np.sqrt(np.einsum("ri,ri->r", moved, moved))
    if len(fresh) < 2:
        return _Track(fresh + start, steps)
    usual_s = max(float(np.median(np.diff(t_s))), 1e-12)
    return _Track(fresh + start, steps / np.maximum(np.diff(fresh), np.diff(t_s[fresh]) / usual_s))


def _motion_mm(points: np.ndarray) -> np.ndarray:
    """(n,) diagonal of the box that holds 98 % of each key point's positions (T, n, 3) [mm]."""
    seen = (~np.isnan(points).all(axis=0)).all(axis=1)
    motion = np.zeros(points.shape[1])
    if seen.any():
        low, high = np.nanquantile(points[:, seen], [0.01, 0.99], axis=0)
        motion[seen] = np.linalg.norm(high - low, axis=1)
    return motion


def key_point_jumps(recording: Recording) -> dict[int, list[tuple[int, float]]]:
    """By key point, the samples that it jumps to and how far [mm]; for continuous recordings."""
    points = recording.key_points_mm
    motions_mm = _motion_mm(points)
    motion_mm = motions_mm.max()
    hits: dict[int, list[tuple[int, float]]] = {}
    for run in recording.runs:
        t_s = recording.t_s[run]
        tracks = [_track(points[run, j], t_s, run.start) for j in range(recording.key_points)]
        for j, track in enumerate(tracks):
            others = [
                (other, motions_mm[i] / max(motions_mm[j], 1e-12))
                for i, other in enumerate(tracks)
                if i != j
            ]
            large = np.flatnonzero(track.steps_mm > JUMP_SHARE * motion_mm)
            at = large[track.ratios(large) > JUMP_RATIO]
            rows, before = track.rows[at + 1], track.rows[at]
            sizes = [float(np.linalg.norm(step)) for step in points[rows, j] - points[before, j]]
            explained = _explained(recording, others, run, rows, np.array(sizes), motion_mm)
            for row, size, known in zip(rows.tolist(), sizes, explained, strict=True):
                if not known:
                    hits.setdefault(j, []).append((row, size))
    return hits


def _continuous_jumps(recording: Recording) -> list[QualityWarning]:
    return [_jump(j, found) for j, found in key_point_jumps(recording).items()]


def spikes(recording: Recording) -> np.ndarray:
    """(T, n) bool: where a key point has jumped away and jumps back within a few samples."""
    away = np.zeros((recording.samples, recording.key_points), bool)
    for j, hits in key_point_jumps(recording).items():
        known = np.flatnonzero(~np.isnan(recording.key_points_mm[:, j, 0]))
        points = recording.key_points_mm[known, j]
        for row, size in hits:
            at = int(np.searchsorted(known, row))
            if not away[row, j] and not away[known[at - 1], j]:
                start, stop = _spike(points, at, size)
                away[known[start:stop], j] = True
    return away


def _spike(points: np.ndarray, at: int, size: float) -> tuple[int, int]:
    """The known positions (K, 3) [mm], from and to, of the spike that the jump to `at` begins, or
    else the one that it ends; empty where there is none."""
    for end in range(at + 1, min(at + 1 + SPIKE_ROWS, len(points))):
        if _comes_back(points[at - 1], points[end - 1], points[end], size):
            return at, end
    for start in range(at - 1, max(at - 1 - SPIKE_ROWS, 0), -1):
        if _comes_back(points[at], points[start], points[start - 1], size):
            return start, at
    return at, at


def _comes_back(true: np.ndarray, away: np.ndarray, next_: np.ndarray, size: float) -> bool:
    """Whether the step from `away` to the next position leads back to the true one."""
    near = np.linalg.norm(next_ - true) < SPIKE_RETURN * size
    return bool(near and np.linalg.norm(next_ - away) > SPIKE_RETURN * size)


def _explained(
    recording: Recording,
    others: list[tuple[_Track, float]],
    run: slice,
    rows: np.ndarray,
    sizes: np.ndarray,
    motion_mm: float,
) -> np.ndarray:
    """(C,) bool: whether a step (C,) [mm] to a sample (C,) comes with a move of the actuation in
    the second before, by a share of its range that the step's share of the motion asks for, and
    with steps of the other key points, as far as these would stand out of the noise.

    others: tracks of the other key points, each with its motion over that of the one that steps.
    """
    witnessed, shared = np.zeros(len(rows), bool), np.zeros(len(rows), bool)
    for other, part in others:
        sees = other.ratios_of(rows, sizes * part) > JUMP_RATIO
        witnessed |= sees
        shared[sees] |= other.ratios_near(rows[sees]) > JUMP_RATIO / 2
    answer = ~witnessed | shared
    for i in np.flatnonzero(answer).tolist():
        row, share = int(rows[i]), float(sizes[i]) / motion_mm
        early = np.searchsorted(recording.t_s[run], recording.t_s[row] - 1.0) + run.start
        stretch = slice(int(max(run.start, min(early, row - 5))), row + 1)
        answer[i] = _actuation_moves(recording, stretch, ACTUATION_SHARE * share)
    return answer


def _jump(j: int, found: list[tuple[int, float]]) -> QualityWarning:
    row, size = found[0]
    return QualityWarning(
        row, f"key point k{j} jumps by {size:.3g} mm{_more(len(found))}; markers swapped or lost?"
    )


def _steady_state_jumps(recording: Recording) -> list[QualityWarning]:
    """Steady-state samples against the quadratic function of the actuation that fits them all."""
    channels = [
        recording.measured[:, i]
        for i in range(recording.chambers)
        if np.ptp(recording.measured[:, i]) > 0
    ]
    scaled = [(c - c.mean()) / np.ptp(c) for c in channels]
    products = [a * b for i, a in enumerate(scaled) for b in scaled[i:]]
    basis = np.column_stack([np.ones(recording.samples), *scaled, *products])
    found = []
    motion = _motion_mm(recording.key_points_mm)
    for j in range(recording.key_points):
        points = recording.key_points_mm[:, j]
        known = np.flatnonzero(~np.isnan(points).any(axis=1))
        if len(known) < 5 * basis.shape[1]:
            continue
        fit = basis[known] @ np.linalg.lstsq(basis[known], points[known], rcond=None)[0]
        off = np.linalg.norm(points[known] - fit, axis=1)
        least = max(STEADY_RATIO * 1.4826 * np.median(off), STEADY_SHARE * motion[j])
        hits = np.flatnonzero(off > least)
        if len(hits):
            found.append(_jump(j, [(int(known[i]), float(off[i])) for i in hits]))
    return found


def summary(recording: Recording) -> list[str]:
    """Lines of text: size, runs, rate, ranges of actuation and motion, missing values, context."""
    unit = recording.unit
    lines = [
        f"{recording.label}: {recording.kind}, {_count(recording.samples, 'row')}, "
        f"{_count(len(recording.runs), 'run')}, {_count(recording.chambers, 'channel')} in {unit}, "
        f"{_count(recording.key_points, 'key point')}",
        _times(recording),
        f"  measured {unit}: {_ranges(recording.measured)}",
    ]
    if recording.commanded is not None:
        lines.append(f"  commanded {unit}: {_ranges(recording.commanded)}")
        if lags := valve_words(recording):
            lines.append(f"  {lags}")
    lines += [_key_point(recording, j) for j in range(recording.key_points)]
    for name in ("temp_C", "payload_g"):
        values = getattr(recording, name)
        if values is not None and not np.isnan(values).all():
            lines.append(f"  {name}: {_ranges(values[:, None])}")
    lines += _about(recording)
    return lines


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + "s" * (number != 1)


def _times(recording: Recording) -> str:
    seconds = sum(recording.t_s[run][-1] - recording.t_s[run][0] for run in recording.runs)
    steps = np.concatenate([np.diff(recording.t_s[run]) for run in recording.runs])
    if not len(steps):
        return f"  time: {seconds:.4g} s"
    return (
        f"  time: {seconds:.4g} s in all, one row each {np.median(steps):.4g} s (median; "
        f"{steps.min():.4g} to {steps.max():.4g} s)"
    )


def _ranges(values: np.ndarray) -> str:
    """Least to largest of each column (T, c)."""
    ends = [(np.nanmin(column), np.nanmax(column)) for column in values.T]
    return ", ".join(f"{a:.4g}" if a == b else f"{a:.4g} to {b:.4g}" for a, b in ends)


def _key_point(recording: Recording, j: int) -> str:
    points = recording.key_points_mm[:, j]
    missing = int(np.isnan(points[:, 0]).sum())  # missing ones are missing as a whole
    if missing == recording.samples:
        return f"  k{j}: missing in every row"
    ends = [(np.nanmin(column), np.nanmax(column)) for column in points.T]
    axes = zip("xyz", ends, strict=True)
    ranges = ", ".join(f"{axis} {a:.1f} to {b:.1f}" for axis, (a, b) in axes)
    lost = f", missing in {missing} rows ({missing / recording.samples:.1%})" if missing else ""
    return f"  k{j} mm: {ranges}{lost}"


def _about(recording: Recording) -> list[str]:
    arm = recording.arm
    stated = {
        "length": f"{arm.length_mm:g} mm" if arm.length_mm else None,
        "diameter": f"{arm.diameter_mm:g} mm" if arm.diameter_mm else None,
        "noise": f"{recording.noise_mm:g} mm" if recording.noise_mm is not None else None,
        "weight along": None
        if recording.gravity is None
        else "(" + ", ".join(f"{v:.3f}" for v in recording.gravity + 0.0) + ")",
        "note": recording.note or None,
    }
    known = [f"{name} {value}" for name, value in stated.items() if value]
    return [f"  {'; '.join(known)}"] if known else []


def without_frozen(recording: Recording) -> tuple[Recording, list[str]]:
    """The recording without the rows that repeat a frozen reading; the first of them stays."""
    keep = np.ones(recording.samples, bool)
    notes = []
    for members, stretch in frozen_channels(recording):
        keep[stretch.start + 1 : stretch.stop] = False
        names = ", ".join(f"p{i + 1}" for i in members)
        notes.append(
            f"{names} frozen at {recording.t_s[stretch.start]:.3f} s of run "
            f"{recording.run[stretch.start]}: {stretch.stop - stretch.start - 1} rows left out"
        )
    by_row = ("t_s", "measured", "key_points_mm", "commanded", "run", "temp_C", "payload_g")
    values = {name: getattr(recording, name) for name in (*by_row, "predicted_mm")}
    return replace(recording, **{k: v[keep] for k, v in values.items() if v is not None}), notes


def without_spikes(recording: Recording) -> tuple[Recording, list[str]]:
    """The recording with a key point missing where it jumps away and back within a few rows."""
    away = spikes(recording)
    if not away.any():
        return recording, []
    points = np.where(away[..., None], np.nan, recording.key_points_mm)
    counts = ", ".join(f"k{j} {n}" for j, n in enumerate(away.sum(axis=0).tolist()) if n)
    notes = [f"spikes of key points count as missing: {counts} of {len(away)} rows"]
    return replace(recording, key_points_mm=points), notes
