"""Dead and frozen channels: what a recording holds constant although it must have moved."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from surgisoft.measurement.recordings import Recording
from surgisoft.measurement.recordings.quality import frozen_channels, frozen_key_points
from surgisoft.surrogate.arm import ArmSpec

LEAST_FROZEN = 0.05
"""Least share of the rows in which a channel is frozen that counts as a fault of the set-up; less
is a data-quality warning."""
STILL = 0.003
"""Largest range of a dead channel, as a share of that of the channel that moves most."""


@dataclass(frozen=True)
class Dead:
    """Channels that are constant in one recording, or in several of one set-up."""

    key_points: dict[int, float]
    """Recorded key point, from 0 -> share of the rows in which it is frozen."""
    chambers: tuple[int, ...]
    """Recorded channels, from 0, that never move."""
    frozen: dict[int, float]
    """Recorded channel, from 0 -> share of the rows in which it is frozen, where it moves else."""

    def __bool__(self) -> bool:
        return bool(self.key_points or self.chambers or self.frozen)


def dead_channels(
    spec: ArmSpec, recordings: Sequence[Recording]
) -> tuple[Dead, list[Recording], list[Recording]]:
    """Dead channels, the recordings without frozen stretches, and those with the command instead.

    In the first list frozen key points are missing, and so is every key point of rows in which a
    channel is frozen. In the second one dead and frozen channels have the commanded actuation; it
    is the first one where no recording has a command.
    """
    rows = sum(recording.samples for recording in recordings)
    points: dict[int, int] = {}
    channels: dict[int, int] = {}
    masked = []
    for recording in recordings:
        lost, away = frozen_points(recording), _frozen_rows(recording)
        for k in range(recording.key_points):
            points[k] = points.get(k, 0) + int(lost[:, k].sum())
        for k, stretch in away:
            channels[k] = channels.get(k, 0) + stretch.stop - stretch.start
        if not (away or lost.any()):
            masked.append(recording)
            continue
        positions = np.where(lost[..., None], np.nan, recording.key_points_mm)
        for _, stretch in away:
            positions[stretch] = np.nan
        masked.append(replace(recording, key_points_mm=positions))
    dead = () if spec.actuation == "commanded" else _still_channels(spec, recordings)
    share = {k: count / rows for k, count in points.items() if count >= LEAST_FROZEN * rows}
    frozen = {
        k: count / rows
        for k, count in channels.items()
        if count >= LEAST_FROZEN * rows and k not in dead
    }
    if not (share or dead or frozen):
        return Dead({}, (), {}), list(recordings), list(recordings)
    if all(np.isnan(recording.key_points_mm).all() for recording in masked):
        masked = list(recordings)
    return Dead(share, dead, frozen), masked, _commanded(masked, dead)


def frozen_points(recording: Recording) -> np.ndarray:
    """(T, n) bool: where a key point repeats one value for much longer than it usually does."""
    lost = np.zeros((recording.samples, recording.key_points), bool)
    whole = recording.key_points_mm
    for k in range(recording.key_points):
        seen = np.isfinite(whole[:, k]).all(1)
        if seen.sum() > 1 and (np.ptp(whole[seen, k], axis=0) == 0.0).all():
            lost[seen, k] = True
    for members, stretch in frozen_key_points(recording):
        lost[stretch, members] = True
    return lost


def _frozen_rows(recording: Recording) -> list[tuple[int, slice]]:
    """Channels that move, but are frozen in some rows, and these rows."""
    if recording.kind == "settled":
        return []
    moves = np.ptp(recording.measured, axis=0) > 0
    return [
        (k, stretch) for members, stretch in frozen_channels(recording) for k in members if moves[k]
    ]


def _still_channels(spec: ArmSpec, recordings: Sequence[Recording]) -> tuple[int, ...]:
    """Channels that never move, of an arm all of whose chambers move."""
    measured = np.concatenate([recording.measured for recording in recordings])
    span = np.ptp(measured, axis=0)
    still = np.flatnonzero(span <= STILL * span.max())
    if len(still) == len(span) or any(spec.idle[k] is not None for k in still):
        return ()
    return tuple(int(k) for k in still)


def _commanded(recordings: list[Recording], dead: tuple[int, ...]) -> list[Recording]:
    """The recordings with the command in the place of dead channels, where all have one."""
    if not dead or any(recording.commanded is None for recording in recordings):
        return recordings
    fresh = []
    for recording in recordings:
        measured, commanded = recording.measured.copy(), recording.commanded
        assert commanded is not None
        measured[:, list(dead)] = commanded[:, list(dead)]
        fresh.append(replace(recording, measured=measured))
    return fresh
