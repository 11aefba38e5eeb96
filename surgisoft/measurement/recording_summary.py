"""What is in a recording, in a few lines."""

import numpy as np

from surgisoft.measurement.recording import Recording


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
    low, high = np.nanmin(values, axis=0), np.nanmax(values, axis=0)
    return ", ".join(
        f"{a:.4g}" if a == b else f"{a:.4g} to {b:.4g}" for a, b in zip(low, high, strict=True)
    )


def _key_point(recording: Recording, j: int) -> str:
    points = recording.key_points_mm[:, j]
    missing = int(np.isnan(points).any(axis=1).sum())
    if missing == recording.samples:
        return f"  k{j}: missing in every row"
    axes = zip("xyz", np.nanmin(points, axis=0), np.nanmax(points, axis=0), strict=True)
    ranges = ", ".join(f"{axis} {a:.1f} to {b:.1f}" for axis, a, b in axes)
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
