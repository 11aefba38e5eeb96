"""Numbers inside names and options, of any length and in ASCII digits alone.

`int` refuses texts of more than 4,300 digits, and `str.isdigit` accepts characters such as "²" that
`int` does not.
"""

import re

LONGEST = 18
"""Digits of the longest whole number that `whole_number` accepts: it fits 64 bits."""


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Key that sorts names with numbers by their value: 'Disc2' before 'Disc10'."""
    key = []
    for at, part in enumerate(re.split(r"([0-9]+)", name)):
        number = part.lstrip("0")
        if at % 2:  # more digits without leading zeros: a larger number
            key.append((0, len(number), number))
        elif part:
            key.append((1, 0, part))
    return key


def whole_number(text: str) -> int | None:
    """The number of ASCII digits with one sign at most; None where the text is anything else."""
    return int(text) if re.fullmatch(rf"[+-]?[0-9]{{1,{LONGEST}}}", text) else None
