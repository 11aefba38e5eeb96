"""`collect`: record a protocol on a rig that is given by name or as an object."""

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
from surgisoft.rig.registry import open_rig, parse_rig, rig_options
from surgisoft.rig.safety import guarded

TRIAL_STEP = 1_000_003
"""Distance between the schedule seeds of two trials on one robot, larger than any robot seed."""


def rig_of_trial(
    rig: str,
    protocol: str | Path | Protocol,
    seed: int | None = None,
    trial: int = 0,
    hidden: Iterable[str | tuple[str, float]] = (),
    **mount: Any,
) -> Rig:
    """Open the rig of a name with the robot and the noise of one trial; see `collect`."""
    number = zlib.crc32(f"{protocol} {trial}".encode())
    given: dict[str, Any] = dict(mount)
    if tuple(hidden):
        given["hidden"] = tuple(hidden)
    defaults: dict[str, Any] = {"noise_seed": number}
    if seed is not None:
        defaults["seed"] = seed
        known = rig_options(parse_rig(rig).name)
        if "seed" in known:
            given["seed"] = seed
    return open_rig(rig, defaults, **given)


def collect(
    protocol: str | Path | Protocol,
    rig: Rig | str | None = None,
    *,
    seed: int | None = None,
    trial: int = 0,
    points: int | None = None,
    hidden: Iterable[str | tuple[str, float]] = (),
    progress: Progress = silent,
    **mount: Any,
) -> Recording:
    """Record a protocol: its name, a schedule file (.csv), or a `Protocol`.

    rig: the rig to record on: an object (`surgisoft.rig.interface.Rig`), or text
    `NAME[:option=value,...]` (`surgisoft.rig.registry`); default: `virtual`.
    seed: seed of the random schedule and, on a simulated rig, of the robot; default 0, or the
    option `seed` of the rig's text. trial: number of the trial, with other noise and random
    schedule on the same robot. hidden: hidden effects of a simulated rig, by name or (name,
    amplitude). mount: further options of the rig, such as `gravity`, `roll_deg`, `payload_g` and
    `noise` of a simulated one.
    points: number of steady-state points, or of frames; default: by the protocol.
    """
    hidden = tuple(hidden)
    if rig is None or isinstance(rig, str):
        text = rig or "virtual"
        bench = rig_of_trial(text, protocol, seed, trial, hidden, **mount)
        if seed is None:
            seed = getattr(getattr(bench, "config", None), "seed", None)
    elif mount or hidden:
        given = ", ".join([*mount, *(["hidden"] if hidden else [])])
        raise InputError(
            f"{given}: options of the virtual rig and of elastica, but another rig is given"
        )
    else:
        bench = rig
    if not isinstance(protocol, Protocol):
        drawn = (seed or 0) + TRIAL_STEP * trial
        protocol = make_protocol(protocol, bench.limits, points, seed=drawn)
    # A simulated rig records in compiled code; each sample is equal to that of `read`.
    if isinstance(rig, str | None) and hasattr(bench, "record"):
        return bench.record(protocol, progress)[0]
    with guarded(bench) as driven:
        return collect_samples(driven, protocol, progress)
