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
    from surgisoft.rig.registry import REQUIRED, describe_kind, rig_about, rig_names, rig_options

    for each in [name] if name else rig_names():
        print(f"{each}: {rig_about(each)}")
        for option in rig_options(each).values():
            default = "required" if option.default is REQUIRED else f"default {option.shown}"
            about = f"{option.about}; " if option.about else ""
            print(f"  {option.name:14s}{about}{describe_kind(option.kind)}, {default}")
