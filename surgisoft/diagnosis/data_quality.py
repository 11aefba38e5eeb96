"""Data-quality warnings of a diagnosis: what the recordings cannot support."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from surgisoft.diagnosis.residuals import Problem, ResidualTable
from surgisoft.measurement.histories import moved_together
from surgisoft.measurement.recordings import AlarmInfo, Recording, after_alarm
from surgisoft.measurement.recordings.clock import gaps_in_words
from surgisoft.measurement.recordings.valves import changed_valves

FAR_FROM_FIT = 2.0
"""An actuation is far from the fit where its distance from the nearest actuation of the fit exceeds
this multiple of `NEIGHBOURS`."""
NEIGHBOURS = 0.97
"""Quantile of the distances between each actuation of the fit and its nearest neighbour there."""
LEAST_FAR = 0.2
"""Distance below which no actuation is far from the fit, in half ranges of a chamber."""
FAR_ROWS = 0.1
"""Share of rows at far actuations above which a warning is given."""
LONG_ROWS = 100_000
"""Number of training rows from which a diagnosis states how they are thinned."""
SOURCE_OF_SMOOTH = "second differences"
"""Source of a noise floor that is neither stated nor shown by holds."""
MOST_MISSING = 0.2
"""Share of missing key points above which a warning is given."""


def _far_from_fit(problem: Problem) -> float:
    """Share of the rows whose actuation is far from all that the model was fitted on: the rows that
    it keeps of its fit, or where it keeps none those of the reference."""
    fit = problem.model.training_residuals
    known = problem.reference if fit is None else problem.with_reference(fit).reference
    if known is None or len(known.pressure) < 2:
        return 0.0
    return far_share(known.pressure, problem.pressure)


def far_share(known: np.ndarray, asked: np.ndarray) -> float:
    """Share of actuations `asked` (S, m) that are far from all `known` (K, m), in half ranges."""
    tree = cKDTree(known)
    own = tree.query(known, k=2, p=np.inf)[0][:, 1]
    apart = tree.query(asked, p=np.inf)[0]
    return float(np.mean(apart > max(FAR_FROM_FIT * np.quantile(own, NEIGHBOURS), LEAST_FAR)))


def thinning_notes(problem: Problem) -> tuple[str, ...]:
    """A note on the rows of long recordings that effects are fitted to."""
    rows = int((problem.block_of_row >= 0).sum())
    if rows < LONG_ROWS:
        return ()
    return (
        f"{rows:,} rows are thinned: effects are fitted to {len(problem.index):,} of them, evenly "
        "spaced; the model and the memories of effects follow every row",
    )


def alarm_hints(recordings: Sequence[Recording], training: Sequence[Recording]) -> tuple[str, ...]:
    """A sentence for each recording of a run in which an alarm was raised (`surgisoft run`).

    It names the moment and the recording that begins there, and says where the diagnosis looked at
    no sample after it. recordings: as they were given; training: those with the key points of
    held-out rows missing (`Sealed`), in the same order.
    """
    return tuple(
        _alarm_hint(recording, recording.alarm, bool(_seen_since(part, recording.alarm.since_s)))
        for recording, part in zip(recordings, training, strict=True)
        if recording.alarm is not None
    )


def _seen_since(recording: Recording, since_s: float) -> int:
    """Number of samples with key points from a time on [s]."""
    seen = np.isfinite(recording.key_points_mm).any(axis=(1, 2))
    return int((seen & (recording.t_s >= since_s)).sum())


def _alarm_hint(recording: Recording, alarm: AlarmInfo, seen: bool) -> str:
    looked = "this diagnosis looked at samples of before and after it together"
    if not seen:
        looked = "this diagnosis looked at no sample after it, because the last quarter is held out"
    after = after_alarm(recording.source) if recording.source is not None else None
    advice = f"diagnose the samples from {alarm.since_s:.1f} s on alone"
    if after is not None and after.is_file():
        advice = f"diagnose {after}, which begins there"
    return (
        f"{recording.name}: an alarm was raised at {alarm.raised_s:.1f} s of the run: the model "
        f"has not been valid since {alarm.since_s:.1f} s; {looked}; {advice}"
    )


def gap_hints(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """A sentence for each recording with gaps inside runs, and what to do about them."""
    return tuple(
        f"{recording.name}: {found}"
        for recording in recordings
        if (found := gaps_in_words(recording))
    )


def collinear_hints(table: ResidualTable) -> tuple[str, ...]:
    """A sentence where channels hardly move apart from each other, or none: an effect of one of
    them can then stand in for that of another."""
    like = moved_together(table.pressure)
    return (f"{like}: what is said of one may be of the other",) if like else ()


def valve_hints(
    recordings: Sequence[Recording], before: Sequence[Recording], actuation: str
) -> tuple[str, ...]:
    """A sentence where valves follow their commands faster or slower than before, or none.

    actuation: what drives the model, `measured` or `commanded`.
    """
    found = changed_valves(recordings, before)
    if not found:
        return ()
    means = "the model is driven by measured actuation, which contains the delay"
    if actuation == "commanded":
        means = "the model is driven by commands, so the change is one of line_lag"
    return (f"{found}: {means}",)


def data_quality_warnings(problem: Problem) -> list[str]:
    """Warnings about the recordings of an identification problem, one sentence each."""
    warnings, source = [], problem.table.floor.source
    if source == SOURCE_OF_SMOOTH:
        warnings.append(
            "the measurement noise is not stated and no holds show it: it was estimated from "
            "second differences in time; state noise_mm in the sidecar for a better noise floor"
        )
    elif source == "unknown":
        warnings.append(
            "the measurement noise is not stated and nothing in the recordings shows it: the noise "
            "floor is not known; state noise_mm in the sidecar"
        )
    blocks, motions = len(problem.motion), int(problem.motion.max()) + 1
    if 2 * motions <= blocks:
        warnings.append(
            f"the recordings repeat themselves: their {blocks} blocks of time show {motions} "
            "different motions, and each counts once; record other paths and speeds"
        )
    far = _far_from_fit(problem)
    if far > FAR_ROWS:
        where = "those that the model was fitted on, where its own error is larger"
        if problem.model.training_residuals is None:
            where = "those of the recordings from before, where the model's own error is not known"
        warnings.append(
            f"{100 * far:.0f} % of the rows are at actuations far from {where}: an effect that "
            "shows there alone may be an error of the model"
        )
    validated = problem.model.validation.rmse_mm
    noise = problem.floor_mm
    if validated and source == "holds" and noise > validated:
        warnings.append(
            f"while the arm is held the key points scatter by {noise:.3g} mm, more than "
            f"the model's whole validated error ({validated:.3g} mm): worse cameras, or something "
            "shakes the arm; smaller effects cannot be seen"
        )
    table = problem.table
    if problem.model.spec.actuation == "measured" and np.array_equal(
        table.pressure, table.commanded
    ):
        warnings.append(
            "measured and commanded actuation are equal in every row: a log without sensors, or a "
            "simulation? What the line delays then looks like a lag of the arm; if there are no "
            "sensors, use a model of the commands (fit --actuation commanded)"
        )
    absent = np.isnan(problem.measured)
    for point in np.flatnonzero(absent.any(2).all(0)):
        warnings.append(
            f"key point k{point} is missing in every row: an effect that moves it alone cannot be "
            "seen"
        )
    missing = float(absent.mean())
    if missing > MOST_MISSING:
        warnings.append(f"{100 * missing:.0f} % of the key points are missing")
    return warnings
