"""Column names of a recording: their meaning, and checks of a header."""

import re
from dataclasses import dataclass

from surgisoft.errors import InputError
from surgisoft.units import MM_PER

_UNIT = r"([A-Za-z%][A-Za-z0-9%]*)"
_ACTUATION = re.compile(rf"([pc])([1-9][0-9]{{0,5}})_{_UNIT}")
_KEY_POINT = re.compile(rf"k(0|[1-9][0-9]{{0,5}})_([xyz])_{_UNIT}")
_CONTEXT = ("t_s", "run", "temp_C", "payload_g")
_LOOKS_KNOWN = re.compile(
    r"\s*([pck][_ ]?[0-9].*|(t|time|temp|temperature|payload)([_ ].*)?|run(s|_id| id)?)\s*",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Layout:
    """Positions, counted from 0, of each quantity's columns in a table."""

    names: tuple[str, ...]
    """All names of the header."""
    time: int
    """Column of the time."""
    measured: tuple[int, ...]
    """Columns of the measured actuation, chamber by chamber."""
    commanded: tuple[int, ...]
    """Columns of the commanded actuation; empty where there is none."""
    key_points: tuple[int, ...]
    """x, y, z of key point 0, then of key point 1, ..."""
    unit: str
    """Unit of the actuation."""
    mm_per_unit: float
    """Millimetres in one unit of the key points' columns."""
    run: int | None
    """Column of the run; None where there is none."""
    temp: int | None
    """Column of the temperature; None where there is none."""
    payload: int | None
    """Column of the payload; None where there is none."""
    ignored: tuple[str, ...]
    """Names that the format does not know and that do not look like one that it knows."""

    @property
    def used(self) -> list[int]:
        """Positions of all columns that are read, ascending."""
        single = [i for i in (self.run, self.temp, self.payload) if i is not None]
        return sorted([self.time, *self.measured, *self.commanded, *self.key_points, *single])


def parse_header(names: list[str], where: str) -> Layout:
    """The layout of a table with these column names; `where` starts every error message."""
    _check_repeated(names, where)
    actuation: dict[str, dict[int, tuple[int, str]]] = {"p": {}, "c": {}}
    points: dict[tuple[int, str], tuple[int, str]] = {}
    context: dict[str, int] = {}
    ignored: list[str] = []
    for position, name in enumerate(names):
        if name in _CONTEXT:
            context[name] = position
        elif match := _ACTUATION.fullmatch(name):
            _check_once(actuation[match[1]], int(match[2]), names, name, where)
            actuation[match[1]][int(match[2])] = (position, match[3])
        elif match := _KEY_POINT.fullmatch(name):
            _check_once(points, (int(match[1]), match[2]), names, name, where)
            points[int(match[1]), match[2]] = (position, match[3])
        elif _LOOKS_KNOWN.fullmatch(name):
            raise InputError(f"{where}, column '{name}': not a column's name; {_hint(name)}")
        else:
            ignored.append(name)
    if "t_s" not in context:
        raise InputError(f"{where}: no column 't_s', expected the time in seconds; {_got(names)}")
    unit = _check_actuation(actuation, names, where)
    scale = _check_key_points(points, names, where)
    return Layout(
        names=tuple(names),
        time=context["t_s"],
        measured=tuple(actuation["p"][i][0] for i in sorted(actuation["p"])),
        commanded=tuple(actuation["c"][i][0] for i in sorted(actuation["c"])),
        key_points=tuple(points[key][0] for key in sorted(points)),
        unit=unit,
        mm_per_unit=scale,
        run=context.get("run"),
        temp=context.get("temp_C"),
        payload=context.get("payload_g"),
        ignored=tuple(ignored),
    )


def _got(names: list[str]) -> str:
    shown = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
    return f"the columns are {shown}"


def _hint(name: str) -> str:
    numbered = re.match(r"\s*([pck])[_ ]?[0-9]", name.lower())
    if numbered and numbered[1] == "k":
        return "expected a key point such as 'k0_x_mm'"
    if numbered:
        return f"expected an actuation with its unit such as '{numbered[1]}1_kPa'"
    known = ", ".join(_CONTEXT)
    return f"expected one of {known}; a lab's own names are converted by 'surgisoft import'"


def _check_repeated(names: list[str], where: str) -> None:
    first: dict[str, int] = {}
    for position, name in enumerate(names):
        if name in first:
            raise InputError(
                f"{where}, column {position + 1}: '{name}' is repeated, "
                f"it is column {first[name] + 1} already; expected each name once"
            )
        first[name] = position


def _check_once(known: dict, key: object, names: list[str], name: str, where: str) -> None:
    if key in known:
        raise InputError(
            f"{where}, column '{name}': repeats '{names[known[key][0]]}' in another unit, "
            "expected each quantity once"
        )


def _check_actuation(
    actuation: dict[str, dict[int, tuple[int, str]]], names: list[str], where: str
) -> str:
    """The common unit of the measured and commanded channels."""
    measured, commanded = actuation["p"], actuation["c"]
    if not measured:
        raise InputError(
            f"{where}: no measured actuation, expected 'p1_kPa' or another unit; {_got(names)}"
        )
    unit_of_first = measured[min(measured)][1]
    for letter, channels in actuation.items():
        _check_numbering(sorted(channels), 1, letter, unit_of_first, where)
        for number in sorted(channels):
            _, unit = channels[number]
            if unit != unit_of_first:
                raise InputError(
                    f"{where}, column '{letter}{number}_{unit}': unit '{unit}', expected "
                    f"'{unit_of_first}' as in 'p1_{unit_of_first}'; use one unit for all channels"
                )
    if commanded and len(commanded) != len(measured):
        raise InputError(
            f"{where}: {len(commanded)} commanded and {len(measured)} measured channels, "
            "expected a command for each channel or for none"
        )
    return unit_of_first


def _check_numbering(numbers: list[int], start: int, letter: str, unit: str, where: str) -> None:
    for expected, number in enumerate(numbers, start):
        if number != expected:
            raise InputError(
                f"{where}: '{letter}{number}_{unit}' without '{letter}{expected}_{unit}', "
                f"expected numbers from {start} without gaps"
            )


def _check_key_points(
    points: dict[tuple[int, str], tuple[int, str]], names: list[str], where: str
) -> float:
    """Millimetres per unit of the key points' columns."""
    if not points:
        raise InputError(f"{where}: no key point, expected 'k0_x_mm'; {_got(names)}")
    unit_of_first = points[min(points)][1]
    if unit_of_first not in MM_PER:
        raise InputError(
            f"{where}, column '{names[points[min(points)][0]]}': unit '{unit_of_first}', "
            f"expected one of {', '.join(MM_PER)}"
        )
    numbers = sorted({number for number, _ in points})
    for expected, number in enumerate(numbers):
        if number != expected:
            raise InputError(
                f"{where}: key point k{number} without k{expected}, "
                "expected numbers from 0 without gaps"
            )
    for number in numbers:
        present = [axis for axis in "xyz" if (number, axis) in points]
        if len(present) < 3:
            lost = [axis for axis in "xyz" if axis not in present]
            raise InputError(
                f"{where}: key point k{number} has only {' and '.join(present)}, "
                f"expected 'k{number}_{lost[0]}_{unit_of_first}' too"
            )
    for (number, axis), (_, unit) in sorted(points.items()):
        if unit != unit_of_first:
            raise InputError(
                f"{where}, column 'k{number}_{axis}_{unit}': unit '{unit}', expected "
                f"'{unit_of_first}' as in the first key point; use one unit for all key points"
            )
    return MM_PER[unit_of_first]
