"""Readings: what an effect's parameters mean, in words and in units that a person knows.

Each effect states its own (`Effect.readings`); `in_words` makes one sentence of them, without
those that recordings do not determine.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

MINOR = 0.25
"""Share of the largest reading below which one without an interval is not told: a first estimate
gives every chamber and axis some value."""
KNOWN_MINOR = 0.05
"""The same of readings with intervals, which tell what is there."""
MOST_TOLD = 6
"""Largest number of readings with a size in a sentence: six chambers have 30 couplings."""
WIDEST = 10.0
"""Ratio of the ends of a positive reading's interval from which its value is not known."""
MOST_PERCENT = 110.0
"""Largest share that is told, %: more than all of something is no value of it."""
DIGITS, FIRST_DIGITS = 3, 2
"""Significant digits of a reading with an interval, and of a first estimate."""


@dataclass(frozen=True)
class Reading:
    """One thing that an effect's parameters say about the arm."""

    text: str
    """Words with `{}` in place of the value and its unit; `{+}` writes a plus too."""
    value: float
    """The value."""
    unit: str
    """Unit; empty for a ratio."""
    size: float | None = None
    """How large it is beside the effect's other readings that have a size, in any unit common to
    them: a small one is not told. None: told whatever the others are."""
    signed: bool = False
    """Whether zero means that there is nothing and the value may be negative; else a negative value
    makes no sense and is not told."""
    most: float = math.inf
    """Largest value that makes sense; a larger one is not told."""

    instead: str = ""
    """Words for a negative value, which is then told without its sign; empty: `text`, with it."""

    def known(self, ends: tuple[float, float] | None) -> bool:
        """Whether its 95 % interval determines the value; true where none is at hand."""
        if not self.value <= self.most or (self.value < 0.0 and not self.signed):
            return False
        if ends is None or ends[0] == ends[1]:
            return True
        low, high = ends
        if self.signed:
            return low > 0.0 or high < 0.0
        return low > 0.0 and high <= WIDEST * low

    def said(self, ends: tuple[float, float] | None = None) -> str:
        """The reading in words, with its interval where that is at hand."""
        digits = FIRST_DIGITS if ends is None else DIGITS
        unit, plus = f" {self.unit}" if self.unit else "", "{+}" in self.text
        if self.instead and self.value < 0.0:
            turned = replace(self, text=self.instead, value=-self.value, instead="")
            return turned.said(None if ends is None else (-ends[1], -ends[0]))
        value = f"{_number(self.value, digits, plus)}{unit}"
        if ends is not None and ends[0] != ends[1]:
            low, high = (_number(end, digits, plus) for end in ends)
            value += f" (95 %: {low} to {high})"
        return self.text.replace("{+}" if plus else "{}", value)


def in_words(
    readings: Sequence[Reading], intervals: Sequence[tuple[float, float]] | None = None
) -> str:
    """Readings as one sentence; empty where recordings determine none of them.

    Of more than `MOST_TOLD` readings with a size the largest are told, and how many are not.

    intervals: 95 % interval of each reading; None: the values are first estimates.
    """
    ends = [None] * len(readings) if intervals is None else intervals
    sizes = [abs(each.size) for each in readings if each.size is not None]
    least = MINOR * max(sizes, default=0.0)
    if intervals is not None and any(low != high for low, high in intervals):
        least *= KNOWN_MINOR / MINOR
    known = [
        (each, limits)
        for each, limits in zip(readings, ends, strict=True)
        if each.known(limits) and (each.size is None or abs(each.size) >= least)
    ]
    sized = [each for each in known if each[0].size is not None]
    if len(sized) <= MOST_TOLD:
        return ", ".join(each.said(limits) for each, limits in known)
    sized.sort(key=lambda each: -abs(each[0].size or 0.0))
    told = [each for each in known if each[0].size is None] + sized[:MOST_TOLD]
    text = ", ".join(each.said(limits) for each, limits in told)
    return f"{text}, and {len(sized) - MOST_TOLD} smaller ones"


def each_chamber(
    text: str, values: Sequence[float], unit: str, sizes: Sequence[float], instead: str = ""
) -> list[Reading]:
    """A signed reading of each chamber; text, instead: words with `{chamber}` and `{}`."""
    own = [
        [words.replace("{chamber}", str(number)) for words in (text, instead)]
        for number in range(1, len(values) + 1)
    ]
    return [
        Reading(words, value, unit, size, signed=True, instead=other)
        for (words, other), (value, size) in zip(own, zip(values, sizes, strict=True), strict=True)
    ]


def each_axis(
    text: str, values: Sequence[float], unit: str, sizes: Sequence[float]
) -> list[Reading]:
    """A signed reading of each axis of the base frame; text: words with `{axis}` and `{}`."""
    return [
        Reading(text.replace("{axis}", axis), value, unit, size, signed=True)
        for axis, value, size in zip("xyz", values, sizes, strict=True)
    ]


def duration(seconds: float) -> str:
    """A time in words: seconds up to twenty minutes, then minutes, then hours."""
    if seconds < 1200.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 72000.0 else f"{seconds / 3600:.0f} h"


def _number(value: float, digits: int, plus: bool) -> str:
    """A number with its significant digits and no exponent where it is readable without one."""
    sign = "+" if plus else ""
    text = f"{value:{sign}.{digits}g}"
    return f"{float(text):{sign}.0f}" if "e" in text and 1.0 <= abs(value) < 1e6 else text
