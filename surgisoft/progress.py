"""How a function that works for long reports its progress to its caller.

Every such function takes a `Progress`, by default `silent`, and calls it with how much is done, how
much there is to do (any unit), and a note for people. The command line draws it as a bar; the
adapters here make one progress out of several stages, or from a function that reports text only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol


class Progress(Protocol):
    """What a function that works for long calls now and then."""

    def __call__(self, done: float, total: float, note: str = "", /) -> None:
        """done of total, in any unit; note: what is being done."""


def silent(done: float, total: float, note: str = "") -> None:
    """A `Progress` that reports nothing."""


def noted(progress: Progress, note: str) -> Progress:
    """A `Progress` that passes on what it is called with, `note` in place of an empty note."""

    def report(done: float, total: float, more: str = "") -> None:
        progress(done, total, more or note)

    return report


def text_only(progress: Progress) -> Callable[[str], None]:
    """For functions that report text without amounts: each text becomes the note."""

    def report(text: str) -> None:
        progress(0.0, 0.0, text)

    return report


class Stages:
    """One `Progress` over stages of unlike length."""

    def __init__(self, progress: Progress, total: float):
        """total: the sum of the stages' weights."""
        self._progress, self.total, self.done = progress, total, 0.0

    def stage(self, weight: float, note: str) -> Progress:
        """The `Progress` of the next stage, whose share of the whole is weight / total."""
        before, self.done = self.done, self.done + weight
        self._progress(before, self.total, note)

        def report(done: float, total: float, more: str = "") -> None:
            share = done / total if total else 0.0
            text = f"{note}: {more}" if more else note
            self._progress(before + weight * share, self.total, text)

        return report
