"""The sidecar NAME.toml of a recording: the arm, gravity and how the recording was made."""

import difflib
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from surgisoft.errors import InputError
from surgisoft.measurement.recordings.recording import (
    KINDS,
    UNIT_TOLERANCE,
    ArmInfo,
    Recording,
    with_unit_length,
)

FIELDS = {
    "arm": ("length_mm", "diameter_mm"),
    "gravity": ("direction",),
    "recording": ("kind", "noise_mm", "note"),
}
"""The sections and fields that a sidecar may have."""


def sidecar_of(path: Path) -> Path:
    """The sidecar that belongs to a table."""
    return path.with_suffix(".toml")


def read_sidecar(path: Path) -> dict[str, Any]:
    """Fields of a Recording that the sidecar sets; none where there is no such file."""
    if not path.exists():
        return {}
    try:
        content = tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML ({error})") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    return parse_sidecar(content, str(path))


def parse_sidecar(content: dict[str, Any], where: str) -> dict[str, Any]:
    """Fields of a Recording out of the sidecar's content; `where` starts every message."""
    _check_names(content, where)
    arm = content.get("arm", {})
    about = content.get("recording", {})
    fields: dict[str, Any] = {
        "arm": ArmInfo(
            length_mm=_number(arm, "length_mm", f"{where}, [arm]", positive=True),
            diameter_mm=_number(arm, "diameter_mm", f"{where}, [arm]", positive=True),
        ),
        "noise_mm": _number(about, "noise_mm", f"{where}, [recording]", positive=False),
    }
    if "kind" in about:
        if about["kind"] not in KINDS:
            raise InputError(
                f"{where}, [recording] kind: got {about['kind']!r}, "
                f"expected one of {', '.join(KINDS)}"
            )
        fields["kind"] = about["kind"]
    if "note" in about:
        if not isinstance(about["note"], str):
            raise InputError(f"{where}, [recording] note: got {about['note']!r}, expected a text")
        fields["note"] = about["note"]
    if "direction" in content.get("gravity", {}):
        fields["gravity"] = unit_vector(
            content["gravity"]["direction"], f"{where}, [gravity] direction"
        )
    return fields


def _check_names(content: dict[str, Any], where: str) -> None:
    for section, fields in content.items():
        if section not in FIELDS:
            raise InputError(f"{where}: {_unknown('section', section, list(FIELDS))}")
        if not isinstance(fields, dict):
            raise InputError(f"{where}: {section} is {fields!r}, expected a section [{section}]")
        for name in fields:
            if name not in FIELDS[section]:
                raise InputError(
                    f"{where}, [{section}]: {_unknown('field', name, list(FIELDS[section]))}"
                )


def _unknown(what: str, name: str, known: list[str]) -> str:
    close = difflib.get_close_matches(name, known, 1)
    meant = f"; did you mean '{close[0]}'?" if close else ""
    return f"unknown {what} '{name}', expected one of {', '.join(known)}{meant}"


def _number(section: dict[str, Any], name: str, where: str, positive: bool) -> float | None:
    if name not in section:
        return None
    value = section[name]
    number = isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value)
    if not number or value < 0 or (positive and value == 0):
        expected = "a positive number" if positive else "a number >= 0"
        raise InputError(f"{where} {name}: got {value!r}, expected {expected}")
    return float(value)


def unit_vector(value: Any, where: str) -> np.ndarray:
    """A direction (3,) of length 1 out of three numbers whose length is 1 within the tolerance."""
    numbers = isinstance(value, list) and all(
        isinstance(v, int | float) and not isinstance(v, bool) and np.isfinite(v) for v in value
    )
    if not numbers or len(value) != 3:
        raise InputError(f"{where}: got {value!r}, expected three numbers")
    vector = np.array(value, np.float64)
    length = float(np.linalg.norm(vector))
    if abs(length - 1) > UNIT_TOLERANCE:
        raise InputError(f"{where}: length {length:.4g}, expected a unit vector (length 1)")
    return with_unit_length(vector)


def sidecar_text(recording: Recording) -> str:
    """The sidecar that says what the recording says."""
    arm = {"length_mm": recording.arm.length_mm, "diameter_mm": recording.arm.diameter_mm}
    about = {"kind": recording.kind, "noise_mm": recording.noise_mm, "note": recording.note}
    content: dict[str, Any] = {"arm": {k: float(v) for k, v in arm.items() if v is not None}}
    if recording.gravity is not None:
        content["gravity"] = {"direction": recording.gravity.tolist()}
    content["recording"] = {k: v for k, v in about.items() if v is not None and v != ""}
    return tomli_w.dumps({section: fields for section, fields in content.items() if fields})
