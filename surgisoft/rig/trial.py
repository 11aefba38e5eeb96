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
    if any(len(effect) == 3 for effect in fields.get("hidden", ())):
        raise InputError(
            f"a hidden effect with a time (NAME@SECONDS): the rig '{name}' has all its effects from "
            "the start; use the rig 'virtual'"
        )
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


HiddenEffect = tuple[str, float] | tuple[str, float, float]
"""A hidden effect: name, amplitude and, where it begins later, the time [s] after the first reset."""


def hidden_effects(
    given: Iterable[str | HiddenEffect] | None,
) -> list[HiddenEffect]:
    """Hidden effects from text such as `creep`, `creep:0.5` or `payload:1@360`; amplitude 1.

    `@360` lets the effect begin 360 s after the first reset. Raises InputError for an amplitude or
    a time that is no number.
    """
    found: list[HiddenEffect] = []
    for item in given or ():
        if not isinstance(item, str):
            begins = [float(value) for value in item[1:]]
            found.append((item[0], begins[0]) if len(begins) == 1 else (item[0], *begins[:2]))
            continue
        effect, at, begins_s = item.partition("@")
        name, colon, amplitude = effect.partition(":")
        try:
            size = float(amplitude) if colon else 1.0
            found.append((name, size, float(begins_s)) if at else (name, size))
        except ValueError:
            raise InputError(
                f"--hidden {item}: expected NAME, NAME:STRENGTH or either with @SECONDS"
            ) from None
    return found


def collect(
    protocol: str | Path | Protocol,
    rig: Rig | str | None = None,
    *,
    seed: int = 0,
    trial: int = 0,
    points: int | None = None,
    hidden: Iterable[str | HiddenEffect] = (),
    progress: Progress = silent,
    **mount: Any,
) -> Recording:
    """Record a protocol: its name, a schedule file (.csv), or a `Protocol`.

    rig: the rig to record on: an object (`surgisoft.rig.interface.Rig`), or the name of a simulated
    rig, `virtual` (the default) or `elastica`, which these options describe:
    seed: seed of the robot. trial: number of the trial, with other noise and random schedule on the
    same robot. hidden: hidden effects, by name, (name, amplitude) or text such as `creep:0.5@60`,
    which begins 60 s after the first reset. mount: `gravity`,
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
