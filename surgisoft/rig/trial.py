"""`collect`: record a protocol on a rig, by default on the virtual one."""

import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from surgisoft.errors import InputError
from surgisoft.measurement.protocols import Protocol, make_protocol
from surgisoft.measurement.recordings import Recording
from surgisoft.progress import Progress, silent
from surgisoft.rig.collect import collect as collect_samples
from surgisoft.rig.interface import Rig
from surgisoft.rig.virtual import VirtualRig

TRIAL_STEP = 1_000_003
"""Distance between the schedule seeds of two trials on one robot, larger than any robot seed."""


def hidden_effects(
    given: Iterable[str | tuple[str, float]] | None,
) -> list[tuple[str, float]]:
    """Hidden effects as (name, amplitude), from text such as `creep:0.5`; default amplitude 1.

    Raises InputError for an amplitude that is no number.
    """
    found = []
    for item in given or ():
        if not isinstance(item, str):
            found.append((item[0], float(item[1])))
            continue
        name, colon, strength = item.partition(":")
        try:
            found.append((name, float(strength) if colon else 1.0))
        except ValueError:
            raise InputError(f"--hidden {item}: expected NAME or NAME:STRENGTH") from None
    return found


def collect(
    protocol: str | Path | Protocol,
    rig: Rig | None = None,
    *,
    seed: int = 0,
    trial: int = 0,
    points: int | None = None,
    hidden: Iterable[str | tuple[str, float]] = (),
    progress: Progress = silent,
    **mount: Any,
) -> Recording:
    """Record a protocol: its name, a schedule file (.csv), or a `Protocol`.

    rig: the rig to record on (`surgisoft.rig.interface.Rig`). Without it the virtual rig, which
    these options describe:
    seed: seed of the robot. trial: number of the trial, with other noise and random schedule on the
    same robot. hidden: hidden effects, by name or (name, amplitude). mount: `gravity`,
    `roll_deg`, `payload_g` and `noise` of `VirtualRig`.
    points: number of steady-state points, or of frames; default: by the protocol.
    """
    virtual = None
    if rig is None:
        number = zlib.crc32(f"{protocol} {trial}".encode())
        rig = virtual = VirtualRig(seed, take=number, hidden=hidden_effects(hidden), **mount)
    elif mount or hidden:
        given = ", ".join([*mount, *(["hidden"] if hidden else [])])
        raise InputError(f"{given}: options of the virtual rig, but another rig is given")
    if not isinstance(protocol, Protocol):
        drawn = seed + TRIAL_STEP * trial
        protocol = make_protocol(protocol, rig.limits, points, seed=drawn)
    if virtual is not None:
        return virtual.record(protocol, progress)[0]
    return collect_samples(rig, protocol, progress)
