"""`collect`: record a protocol on a rig that is given by name or as an object."""

import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from surgisoft.errors import InputError, wrong_type
from surgisoft.measurement.protocols import Protocol, load_schedule, make_protocol
from surgisoft.measurement.recordings import Recording
from surgisoft.progress import Progress, silent
from surgisoft.rig.collect import collect as collect_samples
from surgisoft.rig.collect import show_commands
from surgisoft.rig.interface import Rig, is_simulated
from surgisoft.rig.registry import given_options, open_rig, parse_rig, rig_options
from surgisoft.rig.safety import SafeRig, guarded

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
    number = noise_number(protocol, trial)
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


def noise_number(protocol: str | Path | Protocol, trial: int) -> int:
    """Seed of the noise of a trial.

    It follows from the name of a protocol of the catalogue, and from the commands of any other:
    a schedule gives the same recording whatever its file is called and wherever it lies.
    """
    if not isinstance(protocol, Protocol):
        if not str(protocol).endswith(".csv"):
            return zlib.crc32(f"{protocol} {trial}".encode())
        protocol = load_schedule(protocol)
    times = np.zeros(0) if protocol.t_s is None else protocol.t_s
    number = zlib.crc32(str(trial).encode())
    for values in (protocol.commands, protocol.run, times):
        number = zlib.crc32(np.ascontiguousarray(values).tobytes(), number)
    return number


def collect(
    protocol: str | Path | Protocol,
    rig: Rig | str | None = "virtual",
    *,
    seed: int | None = None,
    trial: int = 0,
    points: int | None = None,
    hidden: Iterable[str | tuple[str, float]] = (),
    progress: Progress = silent,
    log: str | Path | None = None,
    force: bool = False,
    before: Callable[[Rig], None] | None = None,
    **mount: Any,
) -> Recording:
    """Record a protocol: its name, a schedule file (.csv), or a `Protocol`.

    Returns the recording: times (T,) s, measured and commanded pressures (T, m) in the rig's unit,
    key points (T, n, 3) mm in the arm base frame. Raises InputError where protocol and rig do not
    fit each other, and where a real rig leaves its limits.

    rig: the rig to record on: an object (`surgisoft.rig.interface.Rig`), or text
    `NAME[:option=value,...]` (`surgisoft.rig.registry`); default: `virtual`. A real rig runs inside
    `SafeRig` and is vented at the end.
    seed: seed of the random schedule and, on a simulated rig, of the robot; default 0, or the
    option `seed` of the rig's text. trial: number of the trial, with other noise and random
    schedule on the same robot. hidden: hidden effects of a simulated rig, by name or (name,
    amplitude). mount: further options of the rig, such as `gravity`, `roll_deg`, `payload_g` and
    `noise` of a simulated one.
    points: number of steady-state points, or of frames; default: by the protocol.
    log: on a real rig, file to which each sample is appended as it is measured; force: replace it.
    before: is called with the rig before the protocol begins, such as a pre-flight check; an
    exception from it ends the run.
    """
    bench, plan = _opened(protocol, rig, seed, trial, points, tuple(hidden), mount)
    # A simulated rig records in compiled code; each sample is equal to that of `read`.
    if isinstance(rig, str | None) and hasattr(bench, "record") and before is None:
        return bench.record(plan, progress)[0]
    with guarded(bench) as driven:
        if before is not None:
            before(driven)
        return collect_samples(driven, plan, progress, None if is_simulated(driven) else log, force)


def dry_run(
    protocol: str | Path | Protocol,
    rig: Rig | str,
    show: Callable[[str], None],
    *,
    seed: int | None = None,
    trial: int = 0,
    points: int | None = None,
    hidden: Iterable[str | tuple[str, float]] = (),
    **mount: Any,
) -> None:
    """Show each command that `collect` would send to a real rig; nothing is sent.

    show: is called with each command in words. Other arguments: as for `collect`; a real rig has no
    hidden effects, and refuses them here, too.
    """
    bench, plan = _opened(protocol, rig, seed, trial, points, tuple(hidden), mount)
    with guarded(bench) as driven:
        if not isinstance(driven, SafeRig):
            raise InputError("a dry run is for real rigs, and this one is simulated")
        driven.show = show
        show_commands(driven, plan)


def _opened(
    protocol: str | Path | Protocol,
    rig: Rig | str | None,
    seed: int | None,
    trial: int,
    points: int | None,
    hidden: tuple[str | tuple[str, float], ...],
    mount: dict[str, Any],
) -> tuple[Rig, Protocol]:
    """The rig and the protocol of the arguments of `collect`."""
    if not isinstance(protocol, str | Path | Protocol):
        raise wrong_type("the protocol", protocol, "its name, a schedule file, or a Protocol")
    if rig is None or isinstance(rig, str):
        bench = rig_of_trial(rig or "virtual", protocol, seed, trial, hidden, **mount)
        if seed is None:
            own = getattr(getattr(bench, "config", None), "seed", None)
            written = given_options(rig or "virtual").get("seed")
            seed = written if isinstance(written, int) else own
    elif mount or hidden:
        given = ", ".join([*mount, *(["hidden"] if hidden else [])])
        raise InputError(
            f"{given}: options of the virtual rig and of elastica, but another rig is given"
        )
    else:
        bench = rig
    if isinstance(protocol, Protocol):
        return bench, protocol
    try:
        drawn = (seed or 0) + TRIAL_STEP * trial
        return bench, make_protocol(protocol, bench.limits, points, seed=drawn)
    except InputError:
        if isinstance(bench, SafeRig):
            bench.close()
        raise
