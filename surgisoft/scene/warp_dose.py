"""The laser's dose on an accelerator, by a kernel of `warp_kernels`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from surgisoft.scene import warp_kernels as kernels
from surgisoft.scene.dose_patch import RING, DosePatch
from surgisoft.scene.warp_kernels import wp
from surgisoft.scene.warp_queries import held, launch, vectors


class DoseKernel:
    """Deposits sweeps of beams on the samples of rings that share them, on a device."""

    def __init__(
        self,
        patches: Sequence[DosePatch],
        counted: np.ndarray,
        waist_mm: float,
        reach_mm: float,
        steepest: float,
        device: str | torch.device,
    ):
        """counted (3,) J/mm^2: dose from which each zone's area counts; waist_mm: the beam's 1/e^2
        radius; reach_mm: distance from its axis beyond which there is no dose; steepest: cosine of
        the steepest faces that it lights."""

        def there(array, dtype=torch.float64) -> torch.Tensor:
            return torch.tensor(np.ascontiguousarray(array), dtype=dtype, device=device)

        patch, grid = patches[0], patches[0].buckets
        zones, stations = (
            there(np.stack([getattr(one, name) for one in patches]), torch.int32)
            for name in ("zone", "station")
        )
        self._sums: torch.Tensor | None = None
        samples = (there(patch.points_mm), there(patch.normals), there(patch.areas_mm2))
        least, starts = there(counted), there(grid.starts, torch.int64)
        # Warp's arrays do not own their memory.
        self._kept = (*samples, zones, stations, least, starts)
        points, normals, areas = samples
        self._constants = [
            *(float(waist_mm), float(reach_mm), float(steepest)),
            wp.from_torch(least),
            *(vectors(points), vectors(normals), wp.from_torch(areas)),
            *(wp.from_torch(zones), wp.from_torch(stations)),
            wp.vec3d(*map(float, grid.origin_mm)),
            float(grid.cell_mm),
            wp.vec3i(*map(int, grid.shape)),
            wp.from_torch(starts),
        ]

    def __call__(
        self,
        began: torch.Tensor,
        ended: torch.Tensor,
        direction: torch.Tensor,
        energy: torch.Tensor,
        ring: torch.Tensor,
        sums: Sequence[torch.Tensor],
    ) -> None:
        """Add one sweep of each environment to `sums`, which it changes in place.

        began, ended (B, 3) mm, the organ's frame; direction (B, 3) unit vectors; energy (B,) J;
        ring (B,); sums: dose, peak, band, area and energy of an `AblationState`, float32.
        """
        beams, power = [held(t) for t in (began, ended, direction)], energy.float().contiguous()
        rings = ring.contiguous()
        given = [*map(vectors, beams), wp.from_torch(power), wp.from_torch(rings)]
        dose, peak, band, area, joule = (wp.from_torch(one) for one in sums)
        shape = (len(rings), 6 + band.shape[1])
        if self._sums is None or self._sums.shape != shape:
            self._sums = torch.zeros(shape, dtype=torch.int64, device=beams[0].device)
        added = wp.from_torch(self._sums)
        arguments = [*given, *self._constants, dose, peak, added, RING]
        launch(kernels.deposit, (len(rings), kernels.LANES), arguments, beams[0])
        launch(kernels.deposited, shape, [added, joule, area, band], beams[0])


def cut_warp(
    peak: torch.Tensor, band_mm2: torch.Tensor, cut_dose: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """`ablation.cut_torch` as a kernel."""
    peaks, bands = (t.float().contiguous() for t in (peak, band_mm2))
    cut, gap = torch.empty((2, len(peaks)), dtype=torch.int64, device=peak.device).unbind(0)
    burnt = torch.empty_like(peaks[:, 0])
    found = [wp.from_torch(t) for t in (cut, gap, burnt)]
    given = [wp.from_torch(peaks), wp.from_torch(bands), float(cut_dose), *found]
    launch(kernels.ring_cuts, len(peaks), given, peaks)
    return cut, gap, burnt
