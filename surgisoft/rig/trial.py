"""`collect`: record a protocol on a rig: the virtual one, the PyElastica rig, or a given object."""

import importlib
import importlib.util
import zlib
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

from surgisoft.errors import InputError, unknown_name
from surgisoft.measurement.protocols import Protocol, make_protocol
from surgisoft.measurement.recordings import Recording
from surgisoft.progress import Progress, silent
from surgisoft.rig.collect import collect as collect_samples
from surgisoft.rig.hidden import HIDDEN
from surgisoft.rig.interface import Rig
from surgisoft.rig.virtual import VirtualRig

TRIAL_STEP = 1_000_003
"""Distance between the schedule seeds of two trials on one robot, larger than any robot seed."""


RIGS = ("virtual", "elastica")
"""Names of the simulated rigs."""


def simulated_rig(name: str, seed: int, **fields: Any) -> Any:
    """The simulated rig of a name with the robot of a seed; fields: of its configuration."""
    if name == "virtual":
        return VirtualRig(seed, **fields)
    return _elastica(name).ElasticaRig(seed, **fields)


def hidden_of(name: str) -> dict[str, Any]:
    """The hidden effects of the simulated rig of a name; each has a `place` and `about`."""
    return HIDDEN if name == "virtual" else _elastica(name).HIDDEN


def _elastica(name: str) -> ModuleType:
    """The package of the PyElastica rig; raises InputError where PyElastica is not installed."""
    if name != "elastica":
        raise unknown_name("rig", name, RIGS)
    if importlib.util.find_spec("elastica") is None:
        raise InputError(
            "the rig 'elastica' needs PyElastica, which is not installed: "
            "pip install 'surgisoft[elastica]'"
        )
    return importlib.import_module("surgisoft.rig.elastica")


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
    rig: Rig | str | None = None,
    *,
    seed: int = 0,
    trial: int = 0,
    points: int | None = None,
    hidden: Iterable[str | tuple[str, float]] = (),
    progress: Progress = silent,
    **mount: Any,
) -> Recording:
    """Record a protocol: its name, a schedule file (.csv), or a `Protocol`.

    rig: the rig to record on: an object (`surgisoft.rig.interface.Rig`), or the name of a simulated
    rig, `virtual` (the default) or `elastica`, which these options describe:
    seed: seed of the robot. trial: number of the trial, with other noise and random schedule on the
    same robot. hidden: hidden effects, by name or (name, amplitude). mount: `gravity`,
    `roll_deg`, `payload_g` and `noise` of the simulated rig.
    points: number of steady-state points, or of frames; default: by the protocol.
    """
    if rig is None or isinstance(rig, str):
        number = zlib.crc32(f"{protocol} {trial}".encode())
        effects = hidden_effects(hidden)
        simulated = simulated_rig(rig or "virtual", seed, take=number, hidden=effects, **mount)
        bench: Rig = simulated
    elif mount or hidden:
        given = ", ".join([*mount, *(["hidden"] if hidden else [])])
        raise InputError(
            f"{given}: options of the virtual rig and of elastica, but another rig is given"
        )
    else:
        bench, simulated = rig, None
    if not isinstance(protocol, Protocol):
        drawn = seed + TRIAL_STEP * trial
        protocol = make_protocol(protocol, bench.limits, points, seed=drawn)
    if simulated is not None:
        return simulated.record(protocol, progress)[0]
    return collect_samples(bench, protocol, progress)
