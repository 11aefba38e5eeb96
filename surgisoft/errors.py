"""The one error type for what comes from outside: files, options, names."""


class InputError(ValueError):
    """Bad input from outside.

    The message is one line: what came, what was expected, what to do. The command line prints it
    as it is and leaves with exit code 2; nothing has been written when it is raised.
    """

    def __init__(self, message: str):
        super().__init__(" ".join(message.split()))


def unknown_name(kind: str, name: str, known) -> InputError:
    """The answer to a name that no registry knows: the known ones."""
    return InputError(f"unknown {kind} '{name}': known are {', '.join(sorted(known))}")
