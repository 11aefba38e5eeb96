"""`surgisoft scene new`, `check` and `show`: make, check and view a scene."""

from pathlib import Path
from typing import Annotated

import typer

from surgisoft.cli import app
from surgisoft.cli.files import show_written
from surgisoft.cli.inputs import warn
from surgisoft.cli.options import (
    EffectFiles,
    Force,
    Port,
    SaveReplay,
    Screenshot,
    Web,
    with_effect_files,
)
from surgisoft.cli.progress import progress
from surgisoft.command_line import typed
from surgisoft.errors import InputError

commands = typer.Typer(help="Make, check and view surgical scenes.", no_args_is_help=True)
app.add_typer(commands, name="scene")

Folder = Annotated[
    Path, typer.Argument(metavar="DIR", help="Folder of a scene (or scene.toml), or phantom_liver.")
]
Vector = tuple[float, float, float]


@commands.command("new")
def new(
    meshes: Annotated[
        list[str],
        typer.Argument(
            metavar="MESH",
            help="Mesh files (stl, obj, ply, off, glb, gltf) or a segmented image (nii, nii.gz, "
            "nrrd), the organ first. FILE:keep-out or FILE:support sets a role; the default role "
            "of further files is keep-out.",
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="New scene folder.")
    ],
    unit: Annotated[
        str | None,
        typer.Option(
            metavar="mm|cm|m|inch",
            help="Unit of the mesh files; default: mm (metres for glTF) if that is an organ's "
            "size, else the command asks or stops.",
        ),
    ] = None,
    scale: Annotated[
        float | None,
        typer.Option(metavar="MM", help="Length of one unit of the files, mm, instead of --unit."),
    ] = None,
    up: Annotated[
        str | None,
        typer.Option(
            metavar="AXIS",
            help="Axis of the files that points up: x, y, z, -x, -y or -z. Default: z; y for glTF "
            "and, as the front of a patient in RAS, for segmented images.",
        ),
    ] = None,
    label: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LABEL:ROLE[:NAME]...",
            help="A label of the segmented image, by value or name, and its role: organ, lesion, "
            "keep-out, support. Without it the labels are listed.",
        ),
    ] = None,
    lesion: Annotated[
        Vector | None,
        typer.Option(
            metavar="X Y Z", help="Lesion near this point, in the first file's frame and unit."
        ),
    ] = None,
    lesion_direction: Annotated[
        Vector | None,
        typer.Option(
            metavar="X Y Z", help="Lesion on this side of the organ, in the first file's frame."
        ),
    ] = None,
    diameter: Annotated[
        float | None,
        typer.Option(
            metavar="MM",
            help="Diameter of the ring, mm; default: around a segmented lesion, else 20.",
        ),
    ] = None,
    margin: Annotated[
        float | None,
        typer.Option(
            metavar="MM", help="Distance of the ring from a segmented lesion, mm; default: 5."
        ),
    ] = None,
    clearance: Annotated[
        float,
        typer.Option(metavar="MM", help="Least distance between an arm and anything else, mm."),
    ] = 1.0,
    arms: Annotated[
        str,
        typer.Option(
            metavar="TOOL,...",
            help="Tool of each arm: laser, endoscope, or tip for a plain tip that touches. Arms "
            "with the same tool are numbered: laser_1, laser_2.",
        ),
    ] = "laser,endoscope",
    arm: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL",
            help="Arm model of all mounts ('default' or a fitted model's folder), or of single "
            "ones by arm or tool: laser=MODEL,endoscope=MODEL.",
        ),
    ] = None,
    effect_files: EffectFiles = None,
    force: Force = False,
) -> int:
    """Make a scene: repair the meshes, place the lesion, find mounts for the arms."""
    _check_meshes(meshes)

    from surgisoft.scene.author import NoMounts, check_target, write_scene
    from surgisoft.scene.meshio import UnknownUnit
    from surgisoft.scene.segmentation import parse_label

    request = _request(
        meshes,
        lesion,
        lesion_direction,
        diameter,
        clearance,
        unit=unit,
        scale=scale,
        up=up,
        labels=tuple(parse_label(text) for text in label or ()),
        margin_mm=margin,
    )
    check_target(output, force)

    from surgisoft.tasks.world.authoring import make_scene

    tools = [tool.strip() for tool in arms.split(",")]
    asked = (tools, _models(arm, tools), _name(output))
    try:
        try:
            with progress("scene new") as report:
                made = make_scene(request, *asked, report)
        except UnknownUnit as error:
            request = _ask_unit(request, error)
            with progress("scene new") as report:
                made = make_scene(request, *asked, report)
    except NoMounts as error:
        for note in error.notes:
            print(note)
        print(f"No scene was written: {error}.")
        return 1
    write_scene(made.scene, output, force)
    for note in made.notes:
        print(note)
    _print_check(made.check)
    shown = with_effect_files(f"surgisoft scene show {typed(output)}")
    print(f"wrote {output}: view it with '{shown}'")
    return 0


@commands.command("check")
def check(
    folder: Folder,
    picture: Annotated[
        Path | None,
        typer.Option(
            "--map", metavar="FILE.png", help="Write a picture of the reach to this file."
        ),
    ] = None,
    effect_files: EffectFiles = None,
) -> int:
    """Check a scene with FCL: meshes, lesion, reach of the ring, contacts, view."""
    from surgisoft.scene.check import check_scene, reach_patches
    from surgisoft.scene.folder import open_scene
    from surgisoft.tasks.world.reach import reaches_of, ring_dose_lacking

    scene = open_scene(folder)
    if picture is not None:
        from surgisoft.replay.reach_map import check_map

        check_map(scene, picture)
    reaches = reaches_of(scene)
    with progress("scene check") as report:
        verdict = check_scene(scene, reaches, report)
    _print_check(verdict)
    if verdict.work is not None and (weak := ring_dose_lacking(scene)):
        warn(weak)
    if picture is not None and verdict.work is None:
        print(f"{picture}: not drawn, because the ring does not lie on the organ")
    elif picture is not None:
        from surgisoft.replay.reach_map import draw_reach_map

        draw_reach_map(scene, verdict, reach_patches(scene, reaches), picture)
        print(f"wrote {picture}")
    return 0 if verdict.good else 1


@commands.command("show")
def show(
    folder: Folder,
    web: Web = False,
    port: Port = None,
    screenshot: Screenshot = None,
    save: SaveReplay = None,
    effect_files: EffectFiles = None,
) -> None:
    """View a scene in the Rerun viewer: organs, arms, ring, beam and the camera's cone."""
    from surgisoft.replay.scene_view import save_scene_view
    from surgisoft.replay.viewer import (
        check_picture,
        open_viewer,
        serve_viewer,
        take_screenshot,
        temporary_recording,
    )
    from surgisoft.scene.folder import open_scene
    from surgisoft.tasks.world.reach import reaches_of

    if sum((web, screenshot is not None, save is not None)) > 1:
        raise InputError("expected at most one of --web, --screenshot and --save")
    if port is not None and not web:
        raise InputError("--port applies to a browser only: give --web too")
    if screenshot is not None:
        check_picture(screenshot)
    scene = open_scene(folder)
    reaches = reaches_of(scene)
    if save is not None:
        save_scene_view(scene, reaches, save)
        show_written([save])
        return
    with temporary_recording() as recording:
        save_scene_view(scene, reaches, recording)
        if screenshot is not None:
            take_screenshot(recording, screenshot, "Scene", ("ring_point", 0))
            print(f"wrote {screenshot}")
        elif web:
            serve_viewer(
                recording,
                lambda url: print(f"open {url} (stop with Ctrl-C)", flush=True),
                port,
            )
        else:
            open_viewer(recording)


def _check_meshes(meshes: list[str]) -> None:
    """Raise InputError where a mesh file is missing, with or without a role behind its name."""
    for text in meshes:
        path, _, _ = text.rpartition(":")
        if not Path(text).exists() and not (path and Path(path).exists()):
            raise InputError(f"{path or text}: there is no such file; expected a mesh")


def _models(given: str | None, tools: list[str]) -> dict[str, str]:
    """The arm model of each arm or tool that is given; raises InputError for one given twice."""
    if given is None or "=" not in given:
        return {} if given is None else dict.fromkeys(tools, given)
    models: dict[str, str] = {}
    for text in given.split(","):
        name, _, model = text.partition("=")
        if name in models:
            raise InputError(f"--arm {given}: two arms for the {name}; expected one")
        models[name] = model
    return models


def _ask_unit(request, error):
    """The request with the unit that the user types; the error itself where nobody can be asked."""
    import sys
    from dataclasses import replace

    from surgisoft.scene.meshio import MM_PER_UNIT

    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise error
    print(error)
    unit = typer.prompt(f"Unit of the files ({', '.join(MM_PER_UNIT)})")
    return replace(request, unit=unit.strip())


def _request(meshes, lesion, direction, diameter, clearance, **frame):
    """The request for a new scene, with the role of each file.

    `frame` holds the fields of `Request` that tell how the files are to be read.
    """
    from surgisoft.scene.author import Request, no_lesion_mesh
    from surgisoft.scene.mesh import ROLES
    from surgisoft.scene.segmentation import is_segmentation
    from surgisoft.scene.spec import LimitsSpec

    paths, roles = [], []
    for i, text in enumerate(meshes):
        path, colon, role = text.rpartition(":")
        if not colon or Path(text).exists() or "/" in role:
            path, role = text, "organ" if i == 0 else "keep-out"
        elif role == "lesion" and not is_segmentation(Path(path)):
            raise no_lesion_mesh(Path(path))
        elif role not in ROLES:
            raise InputError(f"{text}: role '{role}'; expected one of {', '.join(ROLES)}")
        paths.append(Path(path))
        roles.append(role)
    return Request(
        tuple(paths),
        tuple(roles),
        lesion=lesion,
        lesion_direction=direction,
        diameter_mm=diameter,
        limits=LimitsSpec(clearance_mm=clearance),
        **frame,
    )


def _name(folder: Path) -> str:
    plain = "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "_" for c in folder.name)
    return plain[:64] or "scene"


def _print_check(verdict) -> None:
    from surgisoft.scene.check import sentence

    print(sentence(verdict))
    wide = max(len(finding.what) for finding in verdict.findings)
    value = max(len(finding.value) for finding in verdict.findings)
    for finding in verdict.findings:
        mark = "ok  " if finding.good else "BAD "
        print(f"  {mark}{finding.what:{wide}}  {finding.value:{value}}  needs {finding.wanted}")
