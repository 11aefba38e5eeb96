"""The sidecar NAME.toml of a recording: the arm, gravity and how the recording was made."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tomli_w

from surgisoft.config import Rule, from_table, one_of, read_toml
from surgisoft.measurement.recordings.recording import (
    KINDS,
    NOT_NEGATIVE,
    UNIT_TOLERANCE,
    AlarmInfo,
    ArmInfo,
    Recording,
)

UNIT_VECTOR = Rule(
    "three numbers, a unit vector (length 1)",
    lambda vector: bool(abs(np.linalg.norm(vector) - 1) <= UNIT_TOLERANCE),
)
"""A direction, whose length may be off by what rounding explains."""


@dataclass(frozen=True)
class GravityTable:
    """Table [gravity] of a sidecar: direction of gravity."""

    direction: Annotated[tuple[float, float, float], UNIT_VECTOR] | None = None
    """Unit vector along the weight, arm base frame."""


@dataclass(frozen=True)
class RecordingTable:
    """Table [recording] of a sidecar: how the recording was made."""

    kind: Annotated[str, one_of(KINDS)] | None = None
    """"continuous", or "settled" where each sample is one steady-state average."""
    noise_mm: Annotated[float, NOT_NEGATIVE] | None = None
    """Standard deviation of a key point's coordinate as the lab knows it [mm]."""
    note: str | None = None
    """Free text, for people."""


@dataclass(frozen=True)
class Sidecar:
    """Content of a recording's sidecar file."""

    arm: ArmInfo = field(default_factory=ArmInfo)
    """Table [arm]: name and proportions of the arm."""
    gravity: GravityTable = field(default_factory=GravityTable)
    """Table [gravity]."""
    recording: RecordingTable = field(default_factory=RecordingTable)
    """Table [recording]."""
    alarm: AlarmInfo | None = None
    """Table [alarm], where the recorded run raised one."""

    @property
    def fields(self) -> dict[str, Any]:
        """Fields of a Recording that the sidecar sets."""
        stated = {
            "gravity": None if self.gravity.direction is None else np.array(self.gravity.direction),
            "kind": self.recording.kind,
            "noise_mm": self.recording.noise_mm,
            "note": self.recording.note,
            "alarm": self.alarm,
        }
        return {"arm": self.arm} | {k: v for k, v in stated.items() if v is not None}


def sidecar_of(path: Path) -> Path:
    """The sidecar that belongs to a table."""
    return path.with_suffix(".toml")


def read_sidecar(path: Path) -> dict[str, Any]:
    """Fields of a Recording that the sidecar sets; none where there is no such file."""
    return from_table(Sidecar, *read_toml(path)).fields if path.exists() else {}


def sidecar_text(recording: Recording) -> str:
    """TOML text of a recording's sidecar."""
    arm = {"length_mm": recording.arm.length_mm, "diameter_mm": recording.arm.diameter_mm}
    about = {"kind": recording.kind, "noise_mm": recording.noise_mm, "note": recording.note}
    content: dict[str, Any] = {"arm": {k: float(v) for k, v in arm.items() if v is not None}}
    if recording.gravity is not None:
        content["gravity"] = {"direction": recording.gravity.tolist()}
    content["recording"] = {k: v for k, v in about.items() if v is not None and v != ""}
    if recording.alarm is not None:
        content["alarm"] = {k: float(v) for k, v in asdict(recording.alarm).items()}
    return tomli_w.dumps({section: fields for section, fields in content.items() if fields})
