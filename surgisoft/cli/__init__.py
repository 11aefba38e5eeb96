"""The command line: one thin function a command, one line for a bad input, exit code 2."""

import os
import sys

import click
import typer

from surgisoft.errors import InputError

app = typer.Typer(
    name="surgisoft",
    help="Soft robots in surgical scenes: arm models judged by measurements.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _version(value: bool) -> None:
    if value:
        from surgisoft import __version__

        print(f"surgisoft {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version and leave."
    ),
) -> None:
    pass


def _fail(message: str) -> int:
    print(f"surgisoft: error: {' '.join(message.split())}", file=sys.stderr)
    return 2


def run(arguments: list[str] | None = None) -> int:
    """Run one command; the exit code: 0, 2 for bad input, 130 when interrupted."""
    from surgisoft.cli import commands  # noqa: F401  (registers every command on `app`)

    try:
        code = app(args=arguments, standalone_mode=False)
    except InputError as error:
        return _fail(str(error))
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message())
        return 2
    except click.UsageError as error:
        where = error.ctx.command_path if error.ctx else "surgisoft"
        return _fail(f"{error.format_message().rstrip('.')}; see '{where} --help'")
    except click.ClickException as error:
        return _fail(error.format_message())
    except (KeyboardInterrupt, click.Abort):
        print("surgisoft: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    return code if isinstance(code, int) else 0


def main() -> None:
    """Console script."""
    sys.exit(run())
