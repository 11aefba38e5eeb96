"""`InputError`, the one error type for bad input from outside: files, options, names; warnings."""

import difflib
import os
import signal
import traceback
from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from typing import Any

LONGEST = 1000
"""Characters of a message; of a longer one the middle is left out."""
ALIKE = 0.65
"""Least similarity (`difflib`, 0..1) of a known name that a message suggests for an unknown one."""
SHOWN = 160
"""Most characters of a foreign exception's text in a message."""
PACKAGE = Path(__file__).parent
"""Folder of this package."""
STUDIES = PACKAGE.parent / "benchmarks"
"""Folder of the project's own studies, whose exceptions are no user's either."""
STANDARD = Path(os.__file__).parent
"""Folder of Python's standard library."""
INSTALLED = {"site-packages", "dist-packages"}
"""Folders of installed packages."""
LIBRARIES = {"torch", "numpy", "scipy"}
"""Folders of installed packages whose lines are not named as those that raised an exception, where
it went through code that lies elsewhere, such as that of the user's task."""


class InputError(ValueError):
    """Bad input from outside.

    The message is one line: what came, what was expected, what to do. The command line prints it
    as it is and exits with code 2; nothing has been written when it is raised.
    """

    def __init__(self, message: str):
        super().__init__(one_line(message))


class Interrupted(KeyboardInterrupt):
    """Ctrl-C ended work of which a part was finished before.

    `result` is that part, of the kind that the function returns; it says what is missing. Like any
    KeyboardInterrupt it ends a loop over several calls, unless the caller catches it.
    """

    def __init__(self, result: Any):
        super().__init__()
        self.result = result


class Terminated(SystemExit):
    """A signal ended the program; the exit code is 128 and its number, as shells have it."""

    def __init__(self, number: int):
        super().__init__(128 + number)
        self.name = signal.Signals(number).name

    def __str__(self) -> str:
        return f"ended by {self.name}"


class AssumptionWarning(UserWarning):
    """What a result rests on and no data check: one line, which the command line prints."""


def one_line(text: str) -> str:
    """The text as one printable line of at most `LONGEST` characters.

    What a file holds can stand in a message. Control characters, which could steer a terminal, and
    lone surrogates, which cannot be encoded, are written as their escapes.
    """
    line = " ".join(text[: 100 * LONGEST].split())
    if not line.isprintable():
        line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
    if len(line) <= LONGEST:
        return line
    return f"{line[: LONGEST * 7 // 10]} ... {line[len(line) - LONGEST // 5 :]}"


def raised_by(name: str, error: BaseException, thing: str = "model", file: str = "") -> InputError:
    """The InputError for an exception in foreign code, with the line that raised it.

    thing: what the user has to correct; file: as for `raised_at`.
    """
    return InputError(f"{name}: raised {raised_at(error, file)}; correct the {thing}")


def raised_at(error: BaseException, file: str = "") -> str:
    """An exception of foreign code in words: `ValueError in bad.py line 3: mesh is missing`.

    file: the last line in this file is stated, not the last one in a library that it calls; without
    it, the last line outside this project, the standard library and `LIBRARIES`, if there is one.
    """
    if isinstance(error, SyntaxError) and error.filename:
        return (
            f"{type(error).__name__} in {Path(error.filename).name} line {error.lineno}: "
            + (error.msg[:SHOWN])
        )
    frames = list(traceback.extract_tb(error.__traceback__))
    where = [each for each in frames if each.filename == file]
    where = where or [each for each in frames if _is_foreign(each.filename)]
    place = f" in {Path(where[-1].filename).name} line {where[-1].lineno}" if where else ""
    return f"{type(error).__name__}{place}: {str(error)[:SHOWN]}"


def own_file(error: BaseException, offered: Iterable[str] = ()) -> str:
    """The last file of the user's code that an exception went through; empty where there is none.

    offered: installed packages that count as the user's code, by the names they are imported by.
    """
    files = [frame.filename for frame in traceback.extract_tb(error.__traceback__)]
    users = {None, *offered}
    own = [file for file in files if _is_foreign(file) and _installed_package(file) in users]
    return own[-1] if own else ""


def _is_foreign(file: str) -> bool:
    """Whether a file of code lies outside this project, the standard library and `LIBRARIES`."""
    path = Path(file)
    if file.startswith("<") or path.is_relative_to(PACKAGE) or path.is_relative_to(STUDIES):
        return False
    if package := _installed_package(file):
        return package not in LIBRARIES
    return not path.is_relative_to(STANDARD)


def _installed_package(file: str) -> str | None:
    """The name by which the installed package of a file is imported; None for any other file."""
    parts = Path(file).parts
    place = next((i for i, part in enumerate(parts) if part in INSTALLED), None)
    return None if place is None else Path(parts[place + 1]).stem


def wrong_type(role: str, given: object, expected: str) -> InputError:
    """InputError for an argument of another type, as where two arguments are swapped.

    role: what the argument is to the function; expected: its types in words.
    """
    return InputError(
        f"{role} is of type {type(given).__name__}, expected {expected}; check the order of the "
        "arguments"
    )


def path_of(role: str, given: object, expected: str = "a path") -> Path:
    """The path that an argument is; raises InputError for another type (`wrong_type`)."""
    if not isinstance(given, str | PathLike):
        raise wrong_type(role, given, expected)
    return Path(given)


def unknown_name(kind: str, name: str, known: Iterable[str]) -> InputError:
    """InputError for a name that a registry lacks; the message lists the known names.

    Names that hold a comma are listed in quotation marks.
    """
    known = sorted(known)
    if not isinstance(name, str):
        return wrong_type(kind, name, f"the name of one, such as {', '.join(known[:3])}")
    near = [each for each in known if len(name) > 2 and each.startswith(name)]
    near = near or difflib.get_close_matches(name[:100], known, 1, ALIKE)
    hint = f"; did you mean '{near[0]}'?" if len(near) == 1 else ""
    shown = [f"'{each}'" for each in known] if any("," in each for each in known) else known
    return InputError(f"unknown {kind} '{name}': known are {', '.join(shown)}{hint}")


def exists_already(path: object) -> InputError:
    """InputError for an output that is there, for readers at the command line and in Python."""
    return InputError(
        f"{path}: exists already; choose another name or use --force (in Python force=True)"
    )


def counted(number: int, thing: str) -> str:
    """Number and noun of a message: `1 episode`, `2,000 episodes`."""
    return f"{number:,} {thing}" if number == 1 else f"{number:,} {thing}s"
