"""`surgisoft rig`: the rigs that commands can drive, their options, and a pre-flight check."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surgisoft.cli import app
from surgisoft.cli.inputs import check_model
from surgisoft.cli.options import EffectFiles

if TYPE_CHECKING:
    from surgisoft.rig.registry import RigOption

commands = typer.Typer(no_args_is_help=True, help="Rigs that commands can drive: list, check.")
app.add_typer(commands, name="rig")


@commands.command("list")
def list_(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME[:option=value,...]",
            help="Show this rig only; also package.module:object or FILE.py:object. Options that "
            "are given are checked, and shown with their values.",
        ),
    ] = None,
) -> None:
    """List the rigs and the options of each: NAME:option=value,..."""
    from surgisoft.rig.registry import (
        check_rig,
        may_be_real,
        parse_rig,
        rig_about,
        rig_names,
        rig_options,
        safety_options,
    )

    given: Mapping[str, str] = {}
    if name:
        check_rig(name)
        given = parse_rig(name).options
    names = [parse_rig(name).name] if name else rig_names()
    for each in names:
        print(f"{each}: {rig_about(each)}")
        _show(rig_options(each).values(), given)
    if any(map(may_be_real, names)):
        print("every rig that is not simulated also has the limits of the safety wrapper:")
        _show(safety_options().values(), given)


def _show(options: Iterable[RigOption], given: Mapping[str, str]) -> None:
    """Print a line for each option; given: values of a rig's text, by the option's name."""
    from surgisoft.rig.registry import REQUIRED, describe_kind

    for option in options:
        default = "required" if option.default is REQUIRED else f"default {option.shown}"
        default += f", given {given[option.name]}" if option.name in given else ""
        about = f"{option.about}; " if option.about else ""
        print(f"  {option.name:14s}{about}{describe_kind(option.kind)}, {default}")


@commands.command("check")
def check(
    name: Annotated[
        str, typer.Argument(metavar="NAME[:option=value,...]", help="The rig, as in --rig.")
    ],
    model: Annotated[
        str, typer.Option("--model", metavar="MODEL", help="Model of the arm that is on the rig.")
    ] = "default",
    effect_files: EffectFiles = None,
) -> None:
    """Compare the motion of each chamber of a rig with a model's prediction.

    Each chamber is pressurised slightly, one at a time. This finds swapped tubes, chambers
    that do not move and a rotated camera frame.
    """
    check_model(Path(model))
    from surgisoft.rig import guarded, open_rig
    from surgisoft.rig.preflight import preflight
    from surgisoft.surrogate.checkpoint import load_model
    from surgisoft.surrogate.reach import steady_key_points

    arm = load_model(model)
    with guarded(open_rig(name)) as rig:
        found = preflight(rig, lambda pressures: steady_key_points(arm, pressures))
    print("chamber   tip moved   predicted   cosine")
    for i, (moved, predicted) in enumerate(zip(found.moved_mm, found.predicted_mm, strict=True)):
        print(f"{i + 1:7d} {moved:8.2f} mm {predicted:8.2f} mm {found.cosines[i, i]:8.2f}")
    found.require()
    print("the arm moves as predicted")
