"""`InputError`, the one error type for bad input from outside: files, options, names."""

from collections.abc import Iterable


class InputError(ValueError):
    """Bad input from outside.

    The message is one line: what came, what was expected, what to do. The command line prints it
    as it is and exits with code 2; nothing has been written when it is raised.
    """

    def __init__(self, message: str):
        super().__init__(" ".join(message.split()))


def unknown_name(kind: str, name: str, known: Iterable[str]) -> InputError:
    """InputError for a name that a registry lacks; the message lists the known names."""
    return InputError(f"unknown {kind} '{name}': known are {', '.join(sorted(known))}")
