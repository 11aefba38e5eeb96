"""Commands in messages, as they are typed in a shell."""

import shlex


def typed(*parts: object) -> str:
    """Texts and paths as words of a command line: what a shell would take apart is quoted.

    Every command that is printed takes the paths and options of the user from here, so that it
    can be copied where a path holds spaces.
    """
    return shlex.join(map(str, parts))
