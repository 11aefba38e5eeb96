"""The command line: one thin function per command, one line for a bad input, exit code 2."""

import atexit
import functools
import gc
import os
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from contextvars import ContextVar
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

import typer
from typer.exceptions import TyperException
from typer.main import get_command

from surgisoft.errors import AssumptionWarning, InputError, one_line, own_file, raised_by
from surgisoft.extras import missing_library, offering_packages
from surgisoft.files import noted_writes

app = typer.Typer(
    name="surgisoft",
    help="Soft robot arms in surgical scenes: system identification, diagnosis, control.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

COMMANDS = (
    "demo",
    "collect",
    "import_",
    "fit",
    "compare",
    "diagnose",
    "next_experiment",
    "amend",
    "improve",
    "train",
    "export",
    "evaluate",
    "run_",
    "scene",
    "experiment",
    "rig",
    "replay",
    "benchmark",
)
"""Modules of commands, in the order of the help."""

MANY = {
    *(
        "--before",
        "--between",
        "--data",
        "--effect",
        "--effect-file",
        "--effects",
        "--hidden",
        "--label",
        "--model-code",
    ),
    *("--policy", "--predictions", "--strength", "--valid", "--without"),
}
"""Options with one or more values: `--valid A B` reads as `--valid A --valid B`."""


OLD_NAMES = {
    "--no-referee": "--no-exact-checks",
    "--referee": "--exact-checks",
    "--reference": "--before",
    "--specimen": "--robot-seed",
    "--take": "--trial",
    "--trust": "--observer-gain",
}
"""Present names of renamed options; an old name still works and is not shown in the help."""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""
NAMED_FILES = 8
"""Most files that the message after Ctrl-C names (a count)."""
IMPORTED_OBJECTS = 600_000
"""New containers after which Python looks for cycles among them for the first time (a count), if no
work has begun by then. The imports make 400,000 that all stay: looking through them once or twice
takes 0.1 s, and as often as Python does by default 0.4 s."""
LARGEST_WRITTEN = 1e12
"""Whole numbers below this are written out where a message corrects one such as 1e5."""
NEW_OBJECTS = 10_000
"""The same while a command works (Python's default is 700)."""
NEW_GENERATIONS = 50
"""Looks at new containers between two looks at those that stayed once (a count; Python's default is
10): 0.004 in place of 0.11 s of a comparison of 12,000 rows."""


def _version(value: bool) -> None:
    if value:
        from surgisoft import __version__

        print(f"surgisoft {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version and exit."
    ),
) -> None:
    pass


def _with_arm(arguments: list[str]) -> list[str]:
    """`collect --preflight MODEL`, as it was once written, as `--preflight --arm MODEL`."""
    if arguments[:1] != ["collect"]:
        return arguments
    found: list[str] = []
    for given in arguments:
        name, _, model = given.partition("=")
        if name == "--preflight" and model:
            found += ["--preflight", "--arm", model]
        elif found[-1:] == ["--preflight"] and (given == "default" or Path(given).is_dir()):
            found += ["--arm", given]
        else:
            found.append(given)
    return found


def spread(arguments: list[str]) -> list[str]:
    """Repeat each option of `MANY` before every value that follows it; accept old spellings."""
    arguments = _with_arm(arguments)
    repeated, option = [], None
    old = {} if arguments[:1] == ["benchmark"] else OLD_NAMES
    for given in arguments:
        name, equals, value = given.partition("=")
        argument = old.get(name, name) + equals + value
        if argument.startswith("-") and not argument.lstrip("-").replace(".", "").isdigit():
            option = argument if argument in MANY else None
            first = option is not None
            repeated.append(argument)
            continue
        if option is not None and not first:
            repeated.append(option)
        first = False
        repeated.append(argument)
    return repeated


def _fail(message: str) -> int:
    print(f"surgisoft: error: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _of_own_code(error: Exception) -> str | None:
    """One line about an exception in the user's own code, such as a task; None for any other."""
    file = own_file(error, offering_packages())
    return str(raised_by(file, error, "code or what it is given")) if file else None


def _of_value(error: TyperException) -> str:
    """What came for an option and what was expected, from Pydantic's error, which typer names
    without the value; empty for any other error."""
    found: list[dict[str, Any]] = getattr(error.__cause__, "errors", list)()
    if not found:
        return ""
    given, limits = str(found[0]["input"]), found[0].get("ctx", {})
    expected = {
        "int_parsing": "a whole number",
        "int_from_float": "a whole number",
        "float_parsing": "a number",
        "greater_than_equal": f"{limits.get('ge')} or more",
        "greater_than": f"more than {limits.get('gt')}",
        "less_than_equal": f"{limits.get('le')} or less",
        "less_than": f"less than {limits.get('lt')}",
    }.get(found[0]["type"])
    if expected is None:
        return ""
    if expected == "a whole number":
        with suppress(ValueError):
            if (number := float(given)).is_integer() and abs(number) < LARGEST_WRITTEN:
                expected += f", such as {int(number)}"
    quoted = error.format_message().removeprefix("Invalid value for ").partition(": ")[0]
    option = quoted.replace("'", "")
    return one_line(f"{option} is {given[:60]!r}, expected {expected}")


def _usage(error: TyperException, many: list[str]) -> int:
    if type(error).__name__ == "NoArgsIsHelpError":
        print(error.format_message())
        return 2
    context = getattr(error, "ctx", None)
    where = context.command_path if context else "surgisoft"
    message = _of_value(error) or error.format_message().rstrip(".")
    if message.startswith("Missing argument") and many:
        message += (
            f" (values after {', '.join(many)} belong to that option: put arguments before options)"
        )
    return _fail(f"{message}; see '{where} --help'")


def with_commands() -> typer.Typer:
    """The app with every command; a module of commands registers them when it is imported."""
    for name in COMMANDS:
        import_module(f"surgisoft.cli.{name}")
    return app


@functools.cache
def command_line() -> Callable[..., Any]:
    """All commands as one object that parses and runs, made once: making it takes 20 ms."""
    return get_command(with_commands())


_told: ContextVar[bool] = ContextVar("how an interrupted command was left is told", default=False)


def stopped(text: str) -> NoReturn:
    """End an interrupted command that can be continued: print how it was left, and how to go on.

    Its folder is not named as complete then, see `left_behind`.
    """
    print(text)
    _told.set(True)
    raise typer.Exit(INTERRUPTED) from None


def left_behind(written: Sequence[Path]) -> str:
    """Outputs that an interrupted command leaves, in words: each file is complete or absent."""
    there = [path for path in dict.fromkeys(written) if path.exists()]
    outer = [path for path in there if not any(other in path.parents for other in there)]
    if not outer:
        return "no output was written"
    names = ", ".join(map(str, outer[:NAMED_FILES]))
    more = f" and {len(outer) - NAMED_FILES} more" if len(outer) > NAMED_FILES else ""
    return f"written before and complete: {names}{more}; nothing else"


def run(arguments: list[str] | None = None) -> int:
    """Run one command and return the exit code: 0, 2 for bad input, 130 after Ctrl-C."""
    _told.set(False)
    with noted_writes() as written, warnings.catch_warnings():
        warnings.showwarning = functools.partial(_show, warnings.showwarning, set())
        return _run(arguments, written)


def _show(
    otherwise: Callable[..., None],
    printed: set[str],
    message: Warning | str,
    category: type,
    *place,
) -> None:
    """Print an `AssumptionWarning` once, as a line of warning; any other warning goes on."""
    if not issubclass(category, AssumptionWarning):
        otherwise(message, category, *place)
    elif str(message) not in printed:
        printed.add(str(message))
        print(f"surgisoft: warning: {message}", file=sys.stderr)


def _run(arguments: list[str] | None, written: list[Path]) -> int:
    arguments = spread(sys.argv[1:] if arguments is None else arguments)
    try:
        code = command_line()(args=arguments, standalone_mode=False, prog_name="surgisoft")
    except InputError as error:
        return _fail(str(error))
    except TyperException as error:
        return _usage(error, sorted(MANY.intersection(arguments)))
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except ModuleNotFoundError as error:
        advice = missing_library(error, arguments[0] if arguments else "")
        advice = advice or _of_own_code(error)
        if advice is None:
            raise
        return _fail(advice)
    except SystemExit as ended:
        if isinstance(ended.code, int) and ended.code > 128:  # `surgisoft.errors.Terminated`
            print(f"surgisoft: {ended}", file=sys.stderr)
            return ended.code
        raise
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        own = None if error.filename else _of_own_code(error)
        return _fail(own or f"{error.filename or 'file system'}: {error.strerror or error}")
    except Exception as error:
        own = _of_own_code(error)
        if own is None:
            raise
        return _fail(own)
    if code == INTERRUPTED and not _told.get():  # typer turns a KeyboardInterrupt into this code
        print(f"surgisoft: interrupted; {left_behind(written)}", file=sys.stderr)
    return code if isinstance(code, int) else 0


def end_process(code: int) -> NoReturn:
    """End the process with an exit code, without freeing its objects one by one.

    Freeing what PyTorch's import makes takes half a second. All that is registered with `atexit`
    runs and output is flushed, as in Python's own way to end. That way is taken where another
    thread has to be waited for or output cannot be written. (mypy ends likewise, with `hard_exit`.)
    """
    others = (thread for thread in threading.enumerate() if not thread.daemon)
    if any(thread is not threading.main_thread() for thread in others):
        sys.exit(code)
    atexit._run_exitfuncs()
    try:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
    except (OSError, ValueError):
        sys.exit(code)
    os._exit(code)


def main() -> None:
    """Entry point of the console script `surgisoft`: ends the process. `run` returns instead."""
    gc.callbacks.append(_first_look)
    gc.set_threshold(IMPORTED_OBJECTS, NEW_GENERATIONS)
    end_process(run())


def _first_look(phase: str, info: dict[str, int]) -> None:
    """Called by Python before it looks for cycles: from now on it does so as usual."""
    work_begins()


def work_begins() -> None:
    """Let Python look for cycles of objects as usual; those of the imports are left alone.

    Without effect from the second call on, and where `main` did not start the process.
    """
    if _first_look in gc.callbacks:
        gc.callbacks.remove(_first_look)
        gc.set_threshold(NEW_OBJECTS, NEW_GENERATIONS)
        gc.freeze()
