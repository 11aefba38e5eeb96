"""Collection of recordings: drive any rig, real or virtual, through a protocol."""

import warnings
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from surgisoft.errors import AssumptionWarning, InputError
from surgisoft.measurement.protocols import Protocol
from surgisoft.measurement.recordings import Recording
from surgisoft.measurement.recordings.log import (
    LogHeader,
    RecordingLog,
    average,
    recording_log,
)
from surgisoft.measurement.recordings.recording import left_out, usable_samples
from surgisoft.progress import Progress, silent
from surgisoft.rig.interface import Rig, Sample
from surgisoft.rig.safety import SafeRig
from surgisoft.units import actuation_word


def collect(
    rig: Rig,
    protocol: Protocol,
    progress: Progress = silent,
    log: str | Path | None = None,
    force: bool = False,
) -> Recording:
    """Record a protocol on any object that satisfies `Rig`, sample after sample.

    progress: called with the number of samples done and to do. log: file to which each sample is
    appended as it is measured (`surgisoft.measurement.recordings.log`); it stays there. force:
    replace a log that is there.
    """
    check_fits(rig, protocol)
    per_run = list(runs_of(protocol, rig.period_s))
    total = sum(len(commands) for _, commands in per_run)
    header = LogHeader(
        name=protocol.name,
        kind=protocol.kind,
        unit=rig.unit,
        chambers=rig.chambers,
        key_points=rig.key_planes,
        arm=rig.arm,
        gravity=None if rig.gravity is None else np.asarray(rig.gravity).tolist(),
        payload_g=rig.payload_g,
        note=f"protocol {protocol.name}",
        rows=total,
    )
    with recording_log(log, header, force) if log else nullcontext() as writer:
        samples = _samples(rig, protocol, per_run, total, progress, writer)
    start = samples[0].t_s
    points = np.array([s.key_points_mm for s in samples])
    temperatures = [s.temp_C for s in samples]
    return describe(
        rig,
        protocol,
        np.array([s.t_s for s in samples]) - start,
        np.array([s.measured for s in samples]),
        np.where(np.isinf(points), np.nan, points),
        np.array([s.commanded for s in samples]),
        temp_C=None if None in temperatures else np.array(temperatures),
    )


def _samples(
    rig: Rig,
    protocol: Protocol,
    per_run: list[tuple[int, np.ndarray]],
    total: int,
    progress: Progress,
    log: RecordingLog | None,
) -> list[Sample]:
    """One sample for each command of each run; each that the rig gives is logged at once."""
    samples: list[Sample] = []
    settled = protocol.kind == "settled"
    count = samples_in(protocol.average_s, rig.period_s) if settled else 1
    for run, commands in per_run:
        rig.reset()
        for row in commands:
            rig.command(row)
            if settled:
                rig.wait(protocol.settle_s)
            taken = []
            for _ in range(count):
                one = rig.read()
                taken.append(one)
                if log:
                    log.sample(
                        len(samples),
                        run,
                        one.t_s,
                        one.measured,
                        one.key_points_mm,
                        one.commanded,
                        one.temp_C,
                    )
            samples.append(mean_sample(taken) if settled else taken[0])
            progress(len(samples), total)
    return samples


def show_commands(rig: SafeRig, protocol: Protocol) -> None:
    """Show every command of a protocol as it would be sent; nothing is sent, nothing is waited for.

    rig: a rig whose `show` is set.
    """
    check_fits(rig, protocol)
    for _, commands in runs_of(protocol, rig.period_s):
        rig.reset()
        for row in commands:
            rig.command(row)
            rig.wait(protocol.settle_s if protocol.kind == "settled" else rig.period_s)


def check_fits(rig: Rig, protocol: Protocol) -> None:
    """Raise an InputError unless the rig can run the protocol, with a sample in every run."""
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
    for run, commands in runs_of(protocol, rig.period_s):
        if not len(commands):
            raise InputError(
                f"protocol '{protocol.name}': run {run} is too short for a sample of the rig, "
                f"which measures every {rig.period_s:g} s; make it longer or leave it out"
            )


def runs_of(protocol: Protocol, period_s: float) -> Iterator[tuple[int, np.ndarray]]:
    """Each run's id and its commands (F, m), one a sample."""
    for run, rows in protocol.run_rows:
        yield run, protocol.commands_at(rows, period_s)


def samples_in(seconds: float, period_s: float) -> int:
    """Samples in a time [s]; at least one."""
    return max(1, round(seconds / period_s))


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
    """The recording of a rig's samples; arguments as in `Recording`.

    Samples that it cannot have (`usable_samples`) are left out, with an `AssumptionWarning`. Raises
    InputError where none is left.
    """
    counts = [(run, len(commands)) for run, commands in runs_of(protocol, rig.period_s)]
    run_ids = np.concatenate([np.full(count, run, np.int64) for run, count in counts])
    usable = usable_samples(t_s, run_ids, measured, commanded)
    if not usable.any():
        raise InputError(
            f"protocol '{protocol.name}': no sample has every {actuation_word(rig.unit)}; are the "
            "sensors connected?"
        )
    if not usable.all():
        warnings.warn(left_out(int((~usable).sum())), AssumptionWarning, stacklevel=2)
        t_s, measured, key_points_mm = t_s[usable], measured[usable], key_points_mm[usable]
        commanded, run_ids = commanded[usable], run_ids[usable]
        temp_C = None if temp_C is None else temp_C[usable]
    payload = rig.payload_g
    return Recording(
        name=protocol.name,
        t_s=t_s,
        measured=measured,
        key_points_mm=key_points_mm,
        commanded=commanded,
        run=run_ids,
        unit=rig.unit,
        temp_C=temp_C,
        payload_g=None if payload is None else np.full(len(t_s), payload),
        arm=rig.arm,
        gravity=rig.gravity,
        kind=protocol.kind,
        noise_mm=noise_mm,
        note=f"protocol {protocol.name}",
    )
