"""What is odd but usable in a recording: channels that froze and jumps in the marker data."""

from dataclasses import dataclass

from surgisoft.measurement.recording import Recording


@dataclass(frozen=True)
class Oddity:
    """One finding, in words, and where it starts."""

    sample: int
    """Index of the sample where it starts."""
    text: str
    """What is odd, in one line."""


def find_oddities(recording: Recording) -> list[Oddity]:
    """The findings, in the order of their samples."""
    return []
