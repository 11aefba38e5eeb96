"""Collection of recordings: drive any rig, real or virtual, through a protocol."""

from collections.abc import Iterator

import numpy as np

from surgisoft.errors import InputError
from surgisoft.measurement.protocols import Protocol
from surgisoft.measurement.recordings import Recording
from surgisoft.progress import Progress, silent
from surgisoft.rig.interface import Rig, Sample


def collect(rig: Rig, protocol: Protocol, progress: Progress = silent) -> Recording:
    """Record a protocol on any object that satisfies `Rig`, sample after sample.

    progress: called with the number of samples done and to do.
    """
    check_fits(rig, protocol)
    per_run = [commands for _, commands in runs_of(protocol, rig.period_s)]
    total, done = sum(map(len, per_run)), 0
    samples: list[Sample] = []
    start = None
    for commands in per_run:
        rig.reset()
        for row in commands:
            rig.command(row)
            if protocol.kind == "settled":
                rig.wait(protocol.settle_s)
                count = samples_in(protocol.average_s, rig.period_s)
                taken = mean_sample([rig.read() for _ in range(count)])
            else:
                taken = rig.read()
            samples.append(taken)
            done += 1
            progress(done, total)
    start = samples[0].t_s
    temperatures = [s.temp_C for s in samples]
    return describe(
        rig,
        protocol,
        np.array([s.t_s for s in samples]) - start,
        np.array([s.measured for s in samples]),
        np.array([s.key_points_mm for s in samples]),
        np.array([s.commanded for s in samples]),
        temp_C=None if None in temperatures else np.array(temperatures),
    )


def check_fits(rig: Rig, protocol: Protocol) -> None:
    """Raise an InputError unless the rig can run the protocol."""
    if protocol.chambers != rig.chambers:
        raise InputError(
            f"protocol '{protocol.name}' commands {protocol.chambers} chambers, "
            f"the rig has {rig.chambers}"
        )
    if protocol.unit != rig.unit:
        raise InputError(
            f"protocol '{protocol.name}' is in {protocol.unit}, the rig works in {rig.unit}"
        )
    low, high = np.asarray(rig.limits).T
    outside = ((protocol.commands < low - 1e-9) | (protocol.commands > high + 1e-9)).any(axis=1)
    if outside.any():
        row = int(np.flatnonzero(outside)[0])
        raise InputError(
            f"protocol '{protocol.name}': row {row + 1} commands {protocol.commands[row].tolist()} "
            f"{rig.unit}, outside the rig's limits {low.min():g} to {high.max():g} {rig.unit}"
        )


def runs_of(protocol: Protocol, period_s: float) -> Iterator[tuple[int, np.ndarray]]:
    """Each run's id and its commands (F, m), one a sample."""
    for run, rows in protocol.run_rows:
        yield run, protocol.commands_at(rows, period_s)


def samples_in(seconds: float, period_s: float) -> int:
    """Samples in a time [s]; at least one."""
    return max(1, round(seconds / period_s))


def average(frames: np.ndarray) -> np.ndarray:
    """Mean of (P, F, ...) over F, frame by frame; missing values are left out."""
    total = np.zeros_like(frames[:, 0])
    count = np.zeros(total.shape, np.int64)
    for k in range(frames.shape[1]):
        known = np.isfinite(frames[:, k])
        total += np.where(known, frames[:, k], 0.0)
        count += known
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def mean_sample(samples: list[Sample]) -> Sample:
    """Average of the samples of one steady-state point."""

    def mean(values: list) -> np.ndarray:
        return average(np.array(values)[None])[0]

    temperatures = [s.temp_C for s in samples]
    return Sample(
        t_s=float(mean([s.t_s for s in samples])),
        measured=mean([s.measured for s in samples]),
        commanded=samples[-1].commanded,
        key_points_mm=mean([s.key_points_mm for s in samples]),
        temp_C=None if None in temperatures else float(mean(temperatures)),
    )


def describe(
    rig: Rig,
    protocol: Protocol,
    t_s: np.ndarray,
    measured: np.ndarray,
    key_points_mm: np.ndarray,
    commanded: np.ndarray,
    noise_mm: float | None = None,
    temp_C: np.ndarray | None = None,
) -> Recording:
    """The recording of a rig's samples; arguments as in `Recording`."""
    counts = [(run, len(commands)) for run, commands in runs_of(protocol, rig.period_s)]
    payload = rig.payload_g
    return Recording(
        name=protocol.name,
        t_s=t_s,
        measured=measured,
        key_points_mm=key_points_mm,
        commanded=commanded,
        run=np.concatenate([np.full(count, run, np.int64) for run, count in counts]),
        unit=rig.unit,
        temp_C=temp_C,
        payload_g=None if payload is None else np.full(len(t_s), payload),
        arm=rig.arm,
        gravity=rig.gravity,
        kind=protocol.kind,
        noise_mm=noise_mm,
        note=f"protocol {protocol.name}",
    )
