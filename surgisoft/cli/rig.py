"""`surgisoft rig`: the rigs that commands can drive, and their options."""

from typing import Annotated

import typer

from surgisoft.cli import app

commands = typer.Typer(no_args_is_help=True, help="Rigs that commands can drive: list.")
app.add_typer(commands, name="rig")


@commands.command("list")
def list_(
    name: Annotated[
        str | None,
        typer.Argument(metavar="NAME", help="Show this rig only, or package.module:object."),
    ] = None,
) -> None:
    """List the rigs and the options of each: NAME:option=value,..."""
    from surgisoft.rig.registry import (
        SIMULATED,
        rig_about,
        rig_names,
        rig_options,
        safety_options,
    )

    names = [name] if name else rig_names()
    for each in names:
        print(f"{each}: {rig_about(each)}")
        _show(rig_options(each).values())
    if set(names) - set(SIMULATED):
        print("every rig that is not simulated also has the limits of the safety wrapper:")
        _show(safety_options().values())


def _show(options) -> None:
    from surgisoft.rig.registry import REQUIRED, describe_kind

    for option in options:
        default = "required" if option.default is REQUIRED else f"default {option.shown}"
        about = f"{option.about}; " if option.about else ""
        print(f"  {option.name:14s}{about}{describe_kind(option.kind)}, {default}")
