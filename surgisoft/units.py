"""Units of actuation: pressures, and the displacements of tendons and motors."""

KPA_PER = {
    "Pa": 1e-3,
    "hPa": 0.1,
    "kPa": 1.0,
    "MPa": 1e3,
    "mbar": 0.1,
    "bar": 100.0,
    "psi": 6.894757293168361,  # 0.45359237 kg * 9.80665 m/s2 / (0.0254 m)^2, NIST SP 811 (2008) B.8
    "atm": 101.325,  # NIST SP 811 (2008) B.8
    "mmHg": 0.133322387415,  # 13595.1 kg/m3 * 9.80665 m/s2 * 1 mm, NIST SP 811 (2008) B.8
}
"""kPa in each unit of pressure."""
MM_PER = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}
"""mm in each unit of length."""
DEGREES_PER = {"deg": 1.0, "rad": 57.29577951308232, "rev": 360.0}
"""Degrees in each unit of angle."""


def actuation_word(unit: str) -> str:
    """What an actuation in a unit is called: `pressure`, or `actuation` where it is none, such as
    the volume of a syringe in ml."""
    return "pressure" if unit in KPA_PER else "actuation"


def is_displacement(unit: str) -> bool:
    """Whether an actuation is how far something moves: tendons in mm, motors in degrees."""
    return unit in MM_PER or unit in DEGREES_PER
