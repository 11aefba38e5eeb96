"""Reporting of progress from long-running functions to their callers.

Every such function has a parameter `Progress`, by default `silent`, and calls it with the amount
done, the total amount (any unit) and a note for people. The command line draws it as a bar; the
adapters here make one progress out of several stages, or from a function that reports text only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol


class Progress(Protocol):
    """Callback of a long-running function."""

    def __call__(self, done: float, total: float, note: str = "", /) -> None:
        """Report `done` of `total`, in any unit; note: the present activity."""


def silent(done: float, total: float, note: str = "") -> None:
    """A `Progress` that reports nothing."""


def noted(progress: Progress, note: str) -> Progress:
    """A `Progress` that passes on what it is called with, `note` in place of an empty note."""

    def report(done: float, total: float, more: str = "") -> None:
        progress(done, total, more or note)

    return report


def text_only(progress: Progress) -> Callable[[str], None]:
    """Function that passes text on as the note of a `Progress`, without amounts."""

    def report(text: str) -> None:
        progress(0.0, 0.0, text)

    return report


class Stages:
    """One `Progress` over several stages of different length."""

    def __init__(self, progress: Progress, total: float):
        """total: sum of the weights of all stages."""
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
