"""Pictures of a world from outside: the arms, the bodies, and the reference as a glowing point."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from torch import Tensor

from surgisoft.scene import frames
from surgisoft.scene.camera import Camera
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.mesh import Body, Mesh
from surgisoft.scene.render import Renderer
from surgisoft.tasks.world.arm import radius_mm
from surgisoft.tasks.world.scene import SceneEngine
from surgisoft.tasks.world.world import World, WorldState

PIXELS = 360
"""Width and height of a picture."""
FIELD_RAD = math.radians(40.0)
"""Angle of view of the camera."""
FROM = np.array([0.75, -1.0, 0.45])
"""Direction from the middle of the picture to the camera, world frame."""
FILLED = 0.8
"""Share of the picture that the largest arm's reach fills."""
GLOW_MM = 1.5
"""Radius of the glowing point at the reference, mm."""
FLOOR_MM = 60.0
"""Half edge of the floor below an arm in empty space, mm."""


class WorldPicture:
    """Draws one environment of a world; built once, one picture per call."""

    def __init__(self, world: World, width: int = PIXELS, height: int = PIXELS):
        self._world = world
        scene = world.scene
        bodies = (_floor(),) if scene is None else scene.geometry.bodies
        self._radii = {name: radius_mm(arm.model) for name, arm in world.arms.items()}
        if scene is not None:
            self._radii |= {name: float(r) for name, r in scene.geometry.radii_mm.items()}
        rest = [
            arm.settled(arm.first[None])[0].detach().cpu().double().numpy()
            for arm in world.arms.values()
        ]
        if isinstance(scene, SceneEngine):
            rest.append(scene.centre_mm.cpu().double().numpy()[None])
        corners = np.concatenate(rest)
        middle = 0.5 * (corners.min(0) + corners.max(0))
        reach = max(float(np.linalg.norm(corners - middle, axis=1).max()), FLOOR_MM)
        away = reach / (FILLED * math.tan(0.5 * FIELD_RAD))
        place = middle + away * FROM / np.linalg.norm(FROM)
        self._pose = frames.look_at(place, middle)
        self._scene, self._bodies = scene, bodies
        self._optics = (Camera(FIELD_RAD, (0.0, 2.0 * away)), width, height)
        self._lamp_half_mm = 2.0 * away
        self._renderer = self._renderer_of(bodies)

    def image(self, state: WorldState, reference_mm: Tensor | None = None) -> np.ndarray:
        """(height, width, 3) uint8: the first environment of a state.

        reference_mm: (B, k, 3) mm, world frame; the last point glows.
        """
        arms = {
            name: ArmShape(part.line_mm[0].cpu().double().numpy(), self._radii[name])
            for name, part in state.arms.items()
        }
        glow = None
        if reference_mm is not None:
            point = reference_mm[0, -1].cpu().double().numpy()
            glow = np.stack([point, point + np.array([0.0, 0.0, 0.1])])
        renderer = self._renderer
        if state.scene.breaths is not None and isinstance(self._scene, SceneEngine):
            renderer = self._renderer_of(self._moved(self._scene, state))
        return renderer.image(self._pose, arms, beam_mm=glow, beam_radius_mm=GLOW_MM)

    def _renderer_of(self, bodies: Sequence[Body]) -> Renderer:
        return Renderer(bodies, *self._optics, lamp_half_mm=self._lamp_half_mm, round_view=False)

    def _moved(self, scene: SceneEngine, state: WorldState) -> list[Body]:
        """The bodies where they are in the first environment."""
        placement = scene.placement(state.scene.breaths)
        assert placement is not None, "a scene with breaths has bodies that move"
        now = placement.map[0].cpu().numpy()
        moved = []
        for body in self._bodies:
            mesh = body.world_mesh
            if body.name in placement.at_rest:
                mesh = Mesh(frames.apply(now, mesh.vertices_mm), mesh.faces)
            moved.append(Body(body.name, body.role, mesh))
        return moved


def _floor() -> Body:
    """A square below the base of an arm in empty space."""
    e = FLOOR_MM
    corners = np.array([[-e, -e, 0.0], [e, -e, 0.0], [e, e, 0.0], [-e, e, 0.0]])
    return Body("floor", "support", Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]])), np.eye(4))
