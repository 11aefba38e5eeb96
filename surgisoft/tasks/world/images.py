"""The endoscope's image as an observation: what its camera shows of a world, batched."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import InputError, unknown_name
from surgisoft.scene import frames
from surgisoft.scene.dose_patch import LESION
from surgisoft.scene.images import KINDS, BatchedRenderer, Label, TissueMarks
from surgisoft.tasks.world.pytree import rows
from surgisoft.tasks.world.scene import SceneEngine, SceneState

VECTOR = "vector"
"""Key of the observation's vector beside the images."""
FEWEST_PIXELS, MOST_PIXELS = 64, 256
"""Smallest and largest width and height of an image."""


@dataclass(frozen=True)
class ImageConfig:
    """The endoscope's image as a part of the observations."""

    images: str = ""
    """Kinds of image, with commas in between: `rgb`, `depth`, `segmentation`; empty: none."""
    image_pixels: int = 64
    """Width and height of an image, 64 to 256 pixels."""

    def __post_init__(self):
        for kind in self.kinds:
            if kind not in KINDS:
                raise unknown_name("images", kind, KINDS)
        if not FEWEST_PIXELS <= self.image_pixels <= MOST_PIXELS:
            raise InputError(
                f"image_pixels is {self.image_pixels}, expected {FEWEST_PIXELS} to {MOST_PIXELS}"
            )

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of image in the order of `scene.images.KINDS`; an unknown one comes last."""
        named = {kind.strip() for kind in self.images.split(",")} - {""}
        return (*(kind for kind in KINDS if kind in named), *sorted(named - {*KINDS}))


@dataclass(frozen=True)
class ImageSpace:
    """Values and shape of one image."""

    shape: tuple[int, int, int]
    """Height, width, channels."""
    low: float
    """Lowest value."""
    high: float
    """Highest value."""
    dtype: type
    """NumPy's type of a value."""


class EndoscopeImages:
    """Draws the images of a world's endoscopes; built once, holds no state."""

    def __init__(self, engine: SceneEngine, config: ImageConfig):
        self._engine, self._kinds, pixels = engine, config.kinds, config.image_pixels
        geometry, ablation = engine.geometry, engine.ablation
        marks = None
        if engine.lasers:
            patch = ablation.patch
            grid = patch.buckets
            marks = TissueMarks(
                body=geometry.bodies[engine.organ].name,
                points_mm=patch.points_mm,
                origin_mm=grid.origin_mm,
                cell_mm=grid.cell_mm,
                shape=grid.shape,
                starts=grid.starts,
                lesion=np.stack([one.zone == LESION for one in ablation.patches]),
                threshold=ablation.threshold,
            )
        radii = {name: float(radius) for name, radius in geometry.radii_mm.items()}
        self._renderer = BatchedRenderer(
            geometry.bodies, radii, engine.camera, pixels, pixels, marks
        )
        far = 4.0 * engine.camera.range_mm[1]
        each = {
            "rgb": ImageSpace((pixels, pixels, 3), 0, 255, np.uint8),
            "depth": ImageSpace((pixels, pixels, 1), 0.0, far, np.float32),
            "segmentation": ImageSpace((pixels, pixels, 1), 0, max(Label), np.uint8),
        }
        self.spaces: dict[str, ImageSpace] = {
            self._key(name, kind): each[kind] for name in engine.endoscopes for kind in self._kinds
        }

    def of(self, arms: Mapping, scene: SceneState) -> dict[str, Tensor]:
        """Images (B, H, W, C) by kind; with several endoscopes by `NAME_kind`.

        arms: the world's arms, name -> `ArmPart`; scene: its scene.
        """
        lines = {name: part.line_mm.cpu() for name, part in arms.items()}
        beams, lit = self._beams(arms, scene)
        dose = None if scene.dose is None else scene.dose.dose.cpu()
        lesion = None if scene.lesion is None else scene.lesion.cpu()
        places = self._engine.placement(scene.breaths)
        found = {}
        for name in self._engine.endoscopes:
            eye = arms[name]
            pose = frames.pose_from_z(eye.tip_mm.cpu().double(), eye.tip_direction.cpu().double())
            images = self._renderer.draw(
                pose,
                lines,
                name,
                beams,
                lit,
                places,
                dose=dose,
                lesion=lesion,
                kinds=self._kinds,
            )
            for kind in self._kinds:
                found[self._key(name, kind)] = images.of(kind).to(eye.tip_mm.device)
        return found

    def renewed(
        self, images: Mapping[str, Tensor], arms: Mapping, scene: SceneState, index: Tensor
    ) -> dict[str, Tensor]:
        """The images with those of the environments at index (R,) int64 drawn anew."""
        fresh = self.of(rows(dict(arms), index), rows(scene, index))
        return {name: held.index_copy(0, index, fresh[name]) for name, held in images.items()}

    def _key(self, endoscope: str, kind: str) -> str:
        return kind if len(self._engine.endoscopes) == 1 else f"{endoscope}_{kind}"

    def _beams(self, arms: Mapping, scene: SceneState) -> tuple[Tensor | None, Tensor | None]:
        """Ends (B, L, 2, 3) mm and whether they burn (B, L), of the L lasers' beams."""
        if not scene.lit:
            return None, None
        ends = [
            torch.stack((arms[name].tip_mm, scene.hits[name].point_mm), 1).cpu()
            for name in scene.lit
        ]
        return torch.stack(ends, 1), torch.stack([*scene.lit.values()], 1).cpu()


def images_of(engine: object, config: ImageConfig, task: str) -> EndoscopeImages | None:
    """The images of a task's scene; None where its configuration asks for none.

    Raises an InputError where images are asked for and no arm carries an endoscope.
    """
    if not config.kinds:
        return None
    if not isinstance(engine, SceneEngine) or not engine.endoscopes:
        raise InputError(
            f"images is '{config.images}', but task '{task}' has no endoscope: leave it empty"
        )
    return EndoscopeImages(engine, config)
