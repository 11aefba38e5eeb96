"""A scene as a Rerun recording: bodies, all arms at work, ring, beams and the cameras' cones."""

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from surgisoft.error_scale import bar_length
from surgisoft.replay.arms import BORE_MM
from surgisoft.replay.colours import (
    ARM_COLOURS,
    BACKGROUND,
    BEAM_COLOUR,
    CONE_COLOUR,
    LESION_COLOUR,
    MEASURED_COLOUR,
    PLAN_COLOUR,
    ROLE_COLOURS,
    ROLE_NAMES,
    SHAFT_COLOUR,
)
from surgisoft.replay.recording import LEGEND, new_recording
from surgisoft.replay.shapes import creased, finer, polar_patch, tube, view_cone, widest_apart
from surgisoft.scene import frames
from surgisoft.scene.check import mounted_arms
from surgisoft.scene.folder import Scene
from surgisoft.scene.lesion import circle_on, nearest_on_surface
from surgisoft.scene.mounted_arm import (
    EndoscopePose,
    MountedArm,
    RingSolution,
    look_at_lesion,
    ring_moments,
    solve_ring,
    touch_lesion,
)
from surgisoft.scene.reach import ArmReach

LIFT_MM = 0.5
"""Height of drawings above the surface they lie on, so that it does not hide them (mm)."""
BAR_SHARE = 0.3
"""Length of the scale bar over the organ's size, before it is rounded."""
NAME_BEHIND = 3.0
"""Distance of an arm's name behind its base over the arm's radius, where there is a shaft."""
FRAMES = 72
"""Number of frames, during which the laser goes once around the ring."""


def save_scene_view(scene: Scene, reaches: dict[str, ArmReach], path: Path) -> None:
    """Write the scene as an .rrd file that includes its layout."""
    arms, ring, spec = mounted_arms(scene, reaches), scene.ring, scene.spec
    lasers = spec.arms_with("laser")
    cuts = {name: solve_ring(arms[name], ring, spec.laser) for name in lasers}
    identity = scene.content_hash[:16]
    with new_recording(path, "surgisoft_scene", identity, blueprint(scene, arms)) as recording:
        _log_bodies(recording, scene)
        _log_lesion(recording, scene)
        _log_bar(recording, scene, _side_of_arms(scene, arms))
        text = rr.TextDocument(scene_legend(scene), media_type="text/markdown")
        recording.log(LEGEND, text, static=True)
        for name in spec.arms_with("endoscope"):
            look = look_at_lesion(arms[name], ring, spec.camera)
            _log_endoscope(recording, scene, name, arms[name], look)
        for name in spec.arms_with("tip"):
            touch = touch_lesion(arms[name], ring, spec.limits.clearance_mm)
            _log_shaft(recording, name, arms[name])
            _log_arm(recording, name, "tip", arms[name], touch.way_mm[0], static=True)
        _log_lasers(recording, arms, cuts)
        for name, arm in arms.items():
            _log_name(recording, name, arm)


def blueprint(scene: Scene, arms: dict[str, MountedArm]) -> rrb.Blueprint:
    """A layout with one 3D view from the lesion's side that contains lesion and all bases."""
    organ = scene.organ.world_mesh.bounds_mm
    points = np.array([*organ, *(arm.pose[:3, 3] for arm in arms.values())])
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    towards = _side_of_arms(scene, arms)
    eye = middle + 1.05 * size * frames.normalise(towards + np.array([0.0, 0.0, 0.45]))
    view = rrb.Spatial3DView(
        origin="/",
        contents=["+ /**", f"- {LEGEND}"],
        name="Scene",
        background=rrb.Background(BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(position=eye, look_target=middle, eye_up=(0.0, 0.0, 1.0)),
    )
    legend = rrb.TextDocumentView(origin=LEGEND, name="What is seen")
    return rrb.Blueprint(
        rrb.Horizontal(view, legend, column_shares=[4, 1]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed"),
    )


def scene_legend(scene: Scene) -> str:
    """Markdown: what the scene has, and the colours of the 3D view."""
    spec = scene.spec
    names = {role: [b.name for b in scene.bodies if b.role == role] for role in ROLE_NAMES}
    rows = [
        (ROLE_NAMES["organ"], f"organ: {', '.join(names['organ'])}"),
        (ROLE_NAMES["keep-out"], f"must not be touched: {', '.join(names['keep-out'])}"),
        (ROLE_NAMES["support"], f"support: {', '.join(names['support'])}"),
    ]
    rows = [row for row, role in zip(rows, ROLE_NAMES, strict=True) if names[role]]
    ring = f"ring of {scene.spec.lesion.diameter_mm:g} mm" if not spec.lesion.path_mm else "path"
    rows.append(("yellow", f"the {ring} around the lesion"))
    for tool, colour, sees in (
        ("laser", "ivory", ", green: its beam"),
        ("endoscope", "blue", ", lines: its field of view"),
        ("tip", "pale green", ""),
    ):
        if arms := spec.arms_with(tool):
            rows.append((colour, f"{', '.join(arms)}{sees}"))
    rows.append(("dark grey", "rigid shafts"))
    lines = "\n".join(f"- **{colour}**: {meaning}" for colour, meaning in rows)
    note = ""
    if spec.arms_with("laser"):
        note = "\n\nThe timeline `ring_point` leads the beam once around the ring."
    return f"**{spec.name}**\n\n{lines}{note}\n"


def _log_bar(recording, scene: Scene, towards: np.ndarray) -> None:
    """Log a bar of a round length right of the organ; towards: (3,) direction to the eye."""
    mesh = scene.organ.world_mesh
    low, high = mesh.bounds_mm
    size, middle = float(np.linalg.norm(high - low)), 0.5 * (low + high)
    length = bar_length(BAR_SHARE * size)
    right = np.cross([0.0, 0.0, 1.0], towards)
    beyond = float(((mesh.vertices_mm - middle) @ right).max()) + 0.08 * size
    ends = middle + (beyond + np.array([[0.0], [length]])) * right
    bar = rr.LineStrips3D(
        [ends], colors=[MEASURED_COLOUR], radii=[0.004 * size], labels=[f"{length:g} mm"]
    )
    recording.log("/scale_bar", bar, static=True)


def _side_of_arms(scene: Scene, arms: dict[str, MountedArm]) -> np.ndarray:
    """(3,) horizontal unit vector towards an eye that sees the arms side by side."""
    apart = widest_apart(np.array([arm.pose[:3, 3] for arm in arms.values()])) * [1.0, 1.0, 0.0]
    facing = scene.ring.normal * [1.0, 1.0, 0.0]
    if np.linalg.norm(facing) < 0.1:
        facing = np.array([0.0, -1.0, 0.0])
    facing = frames.normalise(facing)
    if np.linalg.norm(apart) < 1e-6:
        return facing
    across = frames.normalise(np.cross([0.0, 0.0, 1.0], apart))
    across = across if across @ facing >= 0.0 else -across
    return frames.normalise(across + 0.5 * facing)


def _log_bodies(recording, scene: Scene) -> None:
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for body in scene.bodies:
        mesh = body.world_mesh
        vertices, faces, normals = creased(mesh)
        recording.log(
            f"/bodies/{body.name}",
            rr.Mesh3D(
                vertex_positions=vertices,
                triangle_indices=faces,
                vertex_normals=normals,
                albedo_factor=ROLE_COLOURS[body.role],
            ),
            static=True,
        )


def _log_lesion(recording, scene: Scene) -> None:
    ring, lesion, mesh = scene.ring, scene.spec.lesion, scene.organ.world_mesh
    recording.log(
        "/lesion/ring",
        rr.LineStrips3D(
            [np.vstack((ring.points_mm, ring.points_mm[:1])) + LIFT_MM * ring.normal],
            colors=[PLAN_COLOUR],
            radii=[0.45],
        ),
        static=True,
    )
    if lesion.path_mm:
        return
    _, face = nearest_on_surface(mesh, ring.centre_mm[None])
    circles = [
        circle_on(mesh, ring.centre_mm, int(face[0]), share * lesion.diameter_mm)
        for share in np.linspace(0.15, 0.85, 6)
    ]
    whole = [circle for circle in circles if circle is not None]
    if len(whole) < len(circles):
        return
    lifted = [circle.points_mm + LIFT_MM * circle.normals for circle in whole]
    vertices, faces = polar_patch(lifted, ring.centre_mm + LIFT_MM * ring.normal)
    normals = np.vstack((ring.normal[None], *(circle.normals for circle in whole)))
    recording.log(
        "/lesion/tissue",
        rr.Mesh3D(
            vertex_positions=vertices,
            triangle_indices=faces,
            vertex_normals=normals,
            albedo_factor=LESION_COLOUR,
        ),
        static=True,
    )


def _log_arm(
    recording, name: str, tool: str, arm: MountedArm, line_mm: np.ndarray, static: bool
) -> None:
    """Log the soft body as a tube."""
    body = line_mm[1:] if arm.shaft_mm > 0.0 else line_mm
    vertices, faces, normals = tube(finer(body, 2.0), arm.reach.radius_mm, BORE_MM)
    recording.log(
        f"/arms/{name}/body",
        rr.Mesh3D(
            vertex_positions=vertices,
            triangle_indices=faces,
            vertex_normals=normals,
            albedo_factor=ARM_COLOURS[tool],
        ),
        static=static,
    )


def _log_shaft(recording, name: str, arm: MountedArm) -> None:
    if arm.shaft_mm <= 0.0:
        return
    ends = arm.pose[:3, 3] - np.array([arm.shaft_mm, 0.0])[:, None] * arm.pose[:3, 2]
    vertices, faces, normals = tube(finer(ends, 10.0), 1.02 * arm.reach.radius_mm)
    recording.log(
        f"/arms/{name}/shaft",
        rr.Mesh3D(
            vertex_positions=vertices,
            triangle_indices=faces,
            vertex_normals=normals,
            albedo_factor=SHAFT_COLOUR,
        ),
        static=True,
    )


def _log_name(recording, name: str, arm: MountedArm) -> None:
    """Log the arm's name on its shaft near the base, at a point inside the arm.

    On the dark shaft the name is easier to read than on the bright soft body.
    """
    behind = min(arm.shaft_mm, NAME_BEHIND * arm.reach.radius_mm)
    place = arm.pose[:3, 3] - behind * arm.pose[:3, 2]
    label = rr.Points3D(
        [place], radii=[0.1], colors=[MEASURED_COLOUR], labels=[name], show_labels=True
    )
    recording.log(f"/arms/{name}/name", label, static=True)


def _log_endoscope(
    recording, scene: Scene, name: str, arm: MountedArm, look: EndoscopePose
) -> None:
    _log_shaft(recording, name, arm)
    _log_arm(recording, name, "endoscope", arm, look.line_mm, static=True)
    half = np.radians(scene.spec.camera.fov_deg / 2)
    lines = view_cone(look.line_mm[-1], look.direction, half, 0.8 * look.distance_mm)
    recording.log(
        f"/arms/{name}/view",
        rr.LineStrips3D(lines, colors=[CONE_COLOUR] * len(lines), radii=[0.2] * len(lines)),
        static=True,
    )


def _log_lasers(recording, arms: dict[str, MountedArm], cuts: dict[str, RingSolution]) -> None:
    """Log the lasers going round the ring at once, evenly spread, one frame for each point."""
    count = max((len(cut.commands) for cut in cuts.values()), default=0)
    for name in cuts:
        _log_shaft(recording, name, arms[name])
    for moment in range(0, count, max(1, count // FRAMES)):
        recording.set_time("ring_point", sequence=moment)
        points = ring_moments(count, len(cuts))[moment]
        for (name, cut), i in zip(cuts.items(), points, strict=True):
            _log_arm(recording, name, "laser", arms[name], cut.lines_mm[i], static=False)
            tip = cut.lines_mm[i, -1]
            end = tip + cut.directions[i] * max(float(cut.standoff_mm[i]), 1.0)
            entity = "/beam" if len(cuts) == 1 else f"/beams/{name}"
            beam = rr.LineStrips3D([np.stack((tip, end))], colors=[BEAM_COLOUR], radii=[0.35])
            recording.log(entity, beam)
            recording.log(f"{entity}/hit", rr.Points3D([end], colors=[BEAM_COLOUR], radii=[0.9]))
    recording.reset_time()
