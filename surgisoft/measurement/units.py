"""Units that raw files come in, and conversion between units of one quantity."""

import itertools
import math

from surgisoft.config import Where
from surgisoft.units import DEGREES_PER, KPA_PER, MM_PER

SECONDS_PER = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
"""Seconds in each unit of time."""

_VOLTS_PER = {"V": 1.0, "mV": 1e-3}
_NEWTONS_PER = {"N": 1.0, "mN": 1e-3, "kN": 1e3}
ACTUATION_UNITS = (*KPA_PER, *DEGREES_PER, *_VOLTS_PER, *_NEWTONS_PER)
"""Units of pressures, angles, voltages and forces."""
PLURAL = {"in": "inches"}
"""Units in words, where these differ from their letters."""
_QUANTITIES = (KPA_PER, DEGREES_PER, MM_PER, _VOLTS_PER, _NEWTONS_PER)
_ALL = (*_QUANTITIES, SECONDS_PER)


def factor(unit: str, to: str) -> float | None:
    """How many of `to` one `unit` is; None where they do not measure the same quantity."""
    if unit == to:
        return 1.0
    for quantity in _QUANTITIES:
        if unit in quantity and to in quantity:
            return quantity[unit] / quantity[to]
    return None


def unit_named(text: str) -> str | None:
    """The known unit that a text is; None for another one.

    Upper and lower case count only where they tell two units apart, such as MPa and mPa.
    """
    known = [unit for quantity in _ALL for unit in quantity]
    if text.strip() in known:
        return text.strip()
    like = [unit for unit in known if unit.lower() == text.strip().lower()]
    return like[0] if len(like) == 1 else None


def same_unit(first: str, second: str) -> bool | None:
    """Whether two units are the same; None where they measure different quantities.

    True also where a quantity is not known, because then nothing contradicts.
    """
    if first == second:
        return True
    of = [next((q for q in _ALL if unit in q), None) for unit in (first, second)]
    if of[0] is None or of[1] is None:
        return True
    return False if of[0] is of[1] else None


def check_conversion(unit: str, to: str, where: Where) -> None:
    """Raise where a unit cannot be converted."""
    if factor(unit, to) is None:
        known = next((q for q in _QUANTITIES if unit in q), None)
        expected = (
            f"one of {', '.join(known)}, to convert from '{unit}'"
            if known
            else f"'{unit}' itself, a unit that nothing converts to; use scale and offset"
        )
        raise where.error(f"got '{to}'", expected)


_SELDOM = ("hPa", "atm", "mmHg", "rev")
"""Units that no wrong unit is taken for: another one is as large, or nobody logs in them."""


def other_units(unit: str) -> dict[str, float]:
    """The usual other units of the quantity that a unit measures, and how many of `unit` one is."""
    for quantity in _QUANTITIES:
        if unit in quantity:
            return {
                name: size / quantity[unit]
                for name, size in quantity.items()
                if name != unit and name not in _SELDOM
            }
    return {}


def unit_mistakes(unit: str) -> dict[tuple[str, str], float]:
    """What values that are stated in `unit` have to be multiplied by, for each wrong reading.

    Keys: the true unit of the values, and the unit that they were read as. Where the second is
    `unit`, nothing was converted; elsewhere it was converted to `unit`. A factor that several pairs
    have is listed once: with no conversion if possible, else with values that were right before.
    """
    of_unit = {unit: 1.0} | other_units(unit)
    others = list(of_unit)[1:]
    pairs = [
        *((true, unit) for true in others),
        *((unit, read) for read in others),
        *itertools.permutations(others, 2),
    ]
    found: dict[tuple[str, str], float] = {}
    for true, read in pairs:
        by = of_unit[true] / of_unit[read]
        if not any(math.isclose(by, known, rel_tol=1e-9) for known in (1.0, *found.values())):
            found[true, read] = by
    return found
