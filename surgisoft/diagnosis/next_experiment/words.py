"""What the parts of a bench are called, by the unit of the arm's actuation."""

from dataclasses import dataclass

PRESSURES = ("Pa", "hPa", "kPa", "MPa", "mbar", "bar", "psi", "atm", "mmHg", "torr")
"""Units of a pneumatic or hydraulic arm."""
TENDONS = ("deg", "rad", "rev", "mm", "cm", "m", "in", "N", "mN", "kN")
"""Units of an arm that motors pull: angles, lengths and forces."""


@dataclass(frozen=True)
class Words:
    """One bench's own words."""

    channels: str
    """What the actuation goes to."""
    resting: str
    """An arm whose actuation is where it rests."""
    short_line: str
    """What is done to shorten the way from the command to the arm."""


_PNEUMATIC = Words(
    "chambers",
    "vented arm",
    "put the valves at the base of the arm: the shortest and widest tubes that fit",
)
_TENDON = Words(
    "tendons",
    "slack arm",
    "put the motors at the base of the arm: the shortest and straightest tendons that fit, and "
    "the quickest settings of their controllers",
)
_OTHER = Words(
    "channels",
    "relaxed arm",
    "put the drives at the base of the arm: the shortest way from the command to the arm",
)


def words_for(unit: str) -> Words:
    """The words for an arm that is driven in this unit."""
    if unit in PRESSURES:
        return _PNEUMATIC
    return _TENDON if unit in TENDONS else _OTHER
