"""Recordings of an arm that moves as a model predicts, and faults put into them."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from surgisoft.measurement.histories import history_of
from surgisoft.measurement.recordings import ArmInfo, Recording
from surgisoft.surrogate.checkpoint import default_arm
from surgisoft.surrogate.model import ArmModel
from tests.diagnosis.synthetic import walk

NOISE_MM = 0.05
STEP_S = 0.1


@lru_cache(maxsize=4)
def predicted(
    rows: int = 2400, seed: int = 0, rests: int = 0, arm: Callable[[], ArmModel] = default_arm
) -> Recording:
    """What a model predicts for ramps and rests of all chambers, without noise.

    rests: number of last rows in which the first chamber rests at no pressure; arm: makes the
    model.
    """

    def resting(actuation):
        actuation[rows - rests :, 0] = 0.0
        return actuation

    return predicted_along(resting, rows, seed, arm)


def predicted_along(
    change, rows: int = 2400, seed: int = 0, arm: Callable[[], ArmModel] = default_arm
) -> Recording:
    """The same along another actuation (rows, 3), which `change` makes of the ramps and rests."""
    model = arm()
    low, high = np.array(model.spec.low), np.array(model.spec.high)
    actuation = change(low + walk(rows, 3, seed) / 10.0 * (high - low))
    empty = Recording(
        name="bench",
        t_s=STEP_S * np.arange(rows),
        measured=actuation,
        commanded=actuation.copy(),
        key_points_mm=np.zeros((rows, 5, 3)),
        gravity=model.spec.gravity,
        arm=ArmInfo(70.0, 15.0),
    )
    with torch.no_grad():
        points = model.predict(history_of([empty]))[0].double().numpy()
    return replace(empty, key_points_mm=points)


def measured(
    rows: int = 2400,
    seed: int = 0,
    noise_mm: float = NOISE_MM,
    arm: Callable[[], ArmModel] = default_arm,
) -> Recording:
    """The same motion, as cameras with white noise see it."""
    true = predicted(rows, seed, arm=arm)
    noise = np.random.default_rng(seed + 1).normal(0, noise_mm, true.key_points_mm.shape)
    return replace(true, key_points_mm=true.key_points_mm + noise, noise_mm=noise_mm)


def turned(recording: Recording, vector_rad, shift_mm=(0.0, 0.0, 0.0)) -> Recording:
    """Key points turned by a rotation vector and shifted."""
    rotation = Rotation.from_rotvec(vector_rad).as_matrix()
    return with_points(recording, recording.key_points_mm @ rotation.T + np.array(shift_mm))


def with_points(recording: Recording, points: np.ndarray) -> Recording:
    """The recording with other key points."""
    return replace(recording, key_points_mm=points)


def driven(recording: Recording, change) -> Recording:
    """The recording with changed actuation, measured and commanded."""
    return replace(
        recording, measured=change(recording.measured), commanded=change(recording.commanded)
    )


def late(recording: Recording, rows: int) -> Recording:
    """Key points recorded so many rows late; negative: early."""
    count = recording.samples - abs(rows)
    body, rest = (
        (slice(0, count), slice(rows, None)) if rows > 0 else (slice(-rows, None), slice(count))
    )
    return replace(
        recording,
        t_s=recording.t_s[rest],
        run=recording.run[rest],
        measured=recording.measured[rest],
        commanded=recording.commanded[rest],
        key_points_mm=recording.key_points_mm[body],
        temp_C=None,
    )


def in_time(recording: Recording, factor: float) -> Recording:
    """The recording with times so many times as long."""
    return replace(recording, t_s=recording.t_s * factor)
