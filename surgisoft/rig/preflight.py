"""Pre-flight check of a real rig: each chamber alone, a little; does the arm move as predicted?

It finds tubes that are swapped, chambers that do not move, and a frame of the cameras that is
turned, before anything moves fast. The displacement of all key points by one chamber is compared
with the prediction of an arm model for every chamber: the cosine of the angle between the two, as
vectors of all coordinates, is 1 where the arm moves exactly as predicted.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from surgisoft.errors import InputError
from surgisoft.measurement.protocols.continuous import farthest_from_rest
from surgisoft.rig.collect import mean_sample, samples_in
from surgisoft.rig.interface import Rig, Sample, vent, vented

Predict = Callable[[np.ndarray], np.ndarray]
"""Steady-state prediction of an arm model: pressures (K, m) -> key points (K, n, 3) [mm]."""


@dataclass(frozen=True)
class PreflightPlan:
    """How the check moves the arm, and what counts as right."""

    share: float = 0.1
    """Pressure of the chamber that is tried, as a share of the way from rest to the end of its
    range that is farthest from rest."""
    settle_s: float = 1.5
    """Time at a pressure before samples are taken [s]."""
    average_s: float = 0.5
    """Time over which samples are averaged [s]."""
    least_share: float = 0.25
    """Smallest displacement of the tip that counts as motion, as a share of the predicted one."""
    noise_factor: float = 5.0
    """Smallest displacement that counts as motion, in standard errors of the measured rest."""
    aligned: float = 0.85
    """Cosine from which a displacement has the predicted direction (about 32 degrees)."""
    turned_deg: float = 15.0
    """Smallest turn of the frame that is reported [deg]."""


@dataclass(frozen=True, eq=False)
class Preflight:
    """Result of a pre-flight check of m chambers."""

    faults: tuple[str, ...]
    """What is wrong, in words; empty: the arm moves as predicted."""
    moved_mm: np.ndarray
    """(m,) measured displacement of the tip by each chamber alone [mm]."""
    predicted_mm: np.ndarray
    """(m,) predicted one [mm]."""
    cosines: np.ndarray
    """(m, m) cosine between the measured displacement by chamber i and that predicted for j."""

    def require(self) -> None:
        """Raise an InputError where something is wrong."""
        if self.faults:
            raise InputError(f"pre-flight check: {'; '.join(self.faults)}")


def preflight(rig: Rig, predict: Predict, plan: PreflightPlan | None = None) -> Preflight:
    """Try each chamber of a rig alone and compare the arm's motion with a model's prediction.

    The rig begins and ends vented. Raises InputError where the model has another number of chambers
    or key points than the rig.
    """
    plan = plan or PreflightPlan()
    rest, far = vented(rig.limits), farthest_from_rest(rig.limits)
    commands = np.tile(rest, (rig.chambers + 1, 1))
    for i in range(rig.chambers):
        commands[i + 1, i] += plan.share * (far[i] - rest[i])
    predicted = _predicted(rig, predict, commands)
    samples = []
    noise_mm = 0.0
    rig.reset()
    for row in commands:
        rig.command(rest)
        rig.wait(plan.settle_s)
        rig.command(row)
        rig.wait(plan.settle_s)
        taken = [rig.read() for _ in range(max(2, samples_in(plan.average_s, rig.period_s)))]
        samples.append(mean_sample(taken))
        noise_mm = max(noise_mm, _standard_error(taken))
    vent(rig)
    measured = np.array([sample.key_points_mm for sample in samples])
    return judge(measured, predicted, noise_mm, plan)


def judge(
    at: np.ndarray, expected: np.ndarray, noise_mm: float, plan: PreflightPlan | None = None
) -> Preflight:
    """Judge key points (1 + m, n, 3) [mm]: at rest, then with each chamber alone.

    at: as measured; expected: as predicted; noise_mm: standard error of a coordinate.
    """
    plan = plan or PreflightPlan()
    measured, predicted = at[1:] - at[0], expected[1:] - expected[0]
    seen = np.isfinite(measured).all(axis=(0, 2))
    moved = np.linalg.norm(measured[:, -1], axis=1)
    asked = np.linalg.norm(predicted[:, -1], axis=1)
    flat, plain = (x[:, seen].reshape(len(x), -1) for x in (measured, predicted))
    cosines = _cosines(flat, plain)
    if not seen[-1]:
        return Preflight(("the key point of the tip is not seen",), moved, asked, cosines)
    still = moved < np.maximum(plan.least_share * asked, plan.noise_factor * noise_mm)
    faults = [
        f"chamber {i + 1} moves the tip by {moved[i]:.2f} mm, expected {asked[i]:.2f} mm: is its "
        "tube off, its valve shut, or its sensor on another chamber?"
        for i in np.flatnonzero(still)
    ]
    if not still.any():
        axes = tuple(x[0, seen][-1] - x[0, seen][0] for x in (at, expected))
        faults += _directions(measured[:, seen], predicted[:, seen], axes, cosines, plan)
    return Preflight(tuple(faults), moved, asked, cosines)


def _directions(
    measured: np.ndarray,
    predicted: np.ndarray,
    axes: tuple[np.ndarray, ...],
    cosines: np.ndarray,
    plan: PreflightPlan,
) -> list[str]:
    """What is wrong with the directions of displacements (m, n, 3); empty: nothing.

    axes: (3,) from base to tip at rest, as measured and as predicted. It tells a frame that is
    mirrored from one that is turned, which displacements across the arm alone cannot.
    """
    count = len(measured)
    aligned = np.diag(cosines)
    if (aligned >= plan.aligned).all():
        return []
    faults = []
    chambers, as_chamber = linear_sum_assignment(-cosines)
    best = cosines[chambers, as_chamber]
    if (as_chamber != chambers).any() and (best >= plan.aligned).all():
        pairs = ", ".join(
            f"{i + 1} moves the arm as {j + 1} is predicted to"
            for i, j in zip(chambers, as_chamber, strict=True)
            if i != j
        )
        faults.append(f"tubes are swapped (chamber {pairs})")
    along = np.linalg.norm(predicted) / np.maximum([np.linalg.norm(axis) for axis in axes], 1e-9)
    turn, angle_deg = _rotation(
        *(
            np.vstack([moved.reshape(-1, 3), scale * axis])
            for moved, axis, scale in zip((measured, predicted), axes, along, strict=True)
        )
    )
    straight = np.einsum("ab,knb->kna", turn, predicted)
    fits = np.diag(_cosines(measured.reshape(count, -1), straight.reshape(count, -1)))
    if angle_deg >= plan.turned_deg and (fits >= plan.aligned).all():
        faults.append(
            f"{'or ' if faults else ''}the cameras' frame is turned by {angle_deg:.0f} degrees "
            "against the arm's base frame"
        )
    if not faults:
        worst = int(aligned.argmin())
        off = np.degrees(np.arccos(np.clip(aligned[worst], -1.0, 1.0)))
        faults.append(
            f"chamber {worst + 1} moves the arm {off:.0f} degrees off the predicted direction: "
            "check tubes, the order of the key points and the frame of the cameras"
        )
    return faults


def _predicted(rig: Rig, predict: Predict, commands: np.ndarray) -> np.ndarray:
    points = np.asarray(predict(commands), np.float64)
    if points.shape != (len(commands), rig.key_planes, 3):
        raise InputError(
            f"pre-flight check: the model gives key points of shape {points.shape}, expected "
            f"{(len(commands), rig.key_planes, 3)} for the rig's {rig.key_planes} key planes"
        )
    return points


def _standard_error(samples: list[Sample]) -> float:
    """Standard error of the mean of the tip's position, its largest coordinate [mm]."""
    tips = np.array([sample.key_points_mm[-1] for sample in samples])
    tips = tips[np.isfinite(tips).all(axis=1)]
    if len(tips) < 2:
        return 0.0
    return float(tips.std(axis=0, ddof=1).max() / np.sqrt(len(tips)))


def _cosines(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(p, q) cosines between the rows of a (p, d) and of b (q, d)."""
    sizes = np.linalg.norm(a, axis=1)[:, None] * np.linalg.norm(b, axis=1)
    return a @ b.T / np.maximum(sizes, 1e-12)


def _rotation(measured: np.ndarray, predicted: np.ndarray) -> tuple[np.ndarray, float]:
    """The rotation (3, 3) that brings predicted (k, 3) nearest to measured, and its angle [deg].

    Kabsch (1976).
    """
    u, _, vt = np.linalg.svd(measured.T @ predicted)
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return turn, float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0))))
