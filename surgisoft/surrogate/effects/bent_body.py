"""Bending and stretch of a body through its key points, from segment to segment.

The nodes of a body are its clamp and its key points; straight lines join them. The bending at a
node is the rotation from the direction of the line below it to that of the line above it; below the
clamp, the direction is that of the first line at rest. The stretch of a line is relative to its
length at rest. Both follow from the key points alone, whatever bends the body, weight included.
"""

import torch
from torch import Tensor, nn

from surgisoft.surrogate.effects.beam import shape_at_rest

SLENDERNESS = 10.0
"""Length over radius of an arm, a round number: a wall that is stretched by 1 / SLENDERNESS is
strained as one that is bent by 1 rad over the length [-]."""
ENERGIES = ("apart", "whole")
"""Energies of a wall: that of bending and that of stretch, or their sum."""
HARD = 0.98
"""Quantile over recordings of the mean energy of the nodes at which a body is much strained."""
LEAST_ENERGY = 1e-3
"""Least ratio of the smaller to the larger of two energies, of bending and of stretch, where they
scale a law: a wall does not stiffen by a strain below a thirtieth of the other one [-]."""
STILL_MM = 1e-3
"""Range of the key points below which a body is at rest, far below the noise of cameras, mm."""
TINY = 1e-6
"""Length below which a line has no direction, mm."""
FOLDED = 0.1
"""Least value of one plus the cosine of the angle between two lines that their bending is divided
by, so that it stays finite where a body is folded back [-]."""


class BentBody(nn.Module):
    """The nodes of an arm and what they bend and stretch."""

    lengths: Tensor
    clamp: Tensor
    rest_bend: Tensor
    rest_stretch: Tensor

    def __init__(self, rest_mm: Tensor):
        """rest_mm: (n, 3) key points at rest, mm, base frame, as `shape_at_rest` takes them."""
        super().__init__()
        shape, self.below = shape_at_rest(rest_mm)
        rest = torch.tensor(shape, dtype=torch.float32)
        lines = self._lines(rest)
        lengths = lines.norm(dim=1)
        self.register_buffer("lengths", lengths, persistent=False)
        self.register_buffer("clamp", lines[0] / lengths[0], persistent=False)
        bend, stretch = self.strains(rest)
        self.register_buffer("rest_bend", bend, persistent=False)
        self.register_buffer("rest_stretch", stretch, persistent=False)

    def _lines(self, points: Tensor) -> Tensor:
        """(..., K, 3) lines between the nodes, mm, of key points (..., n, 3)."""
        lines = points[..., 1:, :] - points[..., :-1, :]
        return torch.cat([points[..., :1, :], lines], dim=-2) if self.below else lines

    def strains(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(bending (..., K, 3), stretch (..., K)) at K nodes of key points (..., n, 3), mm.

        The bending is a vector along the axis of the rotation with twice the tangent of half its
        angle (Rodrigues 1840), which is the angle in rad to third order and needs no arc function;
        the stretch is a change of length over the length.
        """
        lines = self._lines(points)
        lengths = lines.norm(dim=-1)
        along = lines / lengths.clamp(min=TINY).unsqueeze(-1)
        first = self.clamp.expand_as(along[..., :1, :])
        before = torch.cat([first, along[..., :-1, :]], dim=-2)
        cosine = (before * along).sum(-1, keepdim=True)
        turned = torch.linalg.cross(before, along, dim=-1) / (1 + cosine).clamp(min=FOLDED)
        return 2 * turned, lengths / self.lengths - 1.0

    def beyond_rest(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(bending (..., K, 3), stretch (..., K)) less those of the shape at rest."""
        bend, stretch = self.strains(points)
        return bend - self.rest_bend, stretch - self.rest_stretch

    def energies(self, points: Tensor) -> Tensor:
        """(..., K, 2) squares of the bending and of the stretch beyond those at rest, rad^2.

        points: (..., n, 3) key points, mm. A node bends as much as the whole arm would with the
        curvature there; a stretch of 1 / SLENDERNESS counts as a bending of 1 rad.
        """
        bend, stretch = self.beyond_rest(points)
        whole = (self.lengths.sum() / self.lengths).square()
        return torch.stack(
            [bend.square().sum(-1) * whole, (SLENDERNESS * stretch).square()], dim=-1
        )

    def strained(self, points: Tensor, energies: str) -> Tensor:
        """(..., K, 2) energy that bending and stretch depend on, rad^2, one of ENERGIES."""
        found = self.energies(points)
        return found if energies == "apart" else found.sum(-1, keepdim=True).expand_as(found)

    def moved(self, points: Tensor, more: Tensor) -> tuple[Tensor, Tensor]:
        """Displacements (..., n, 3), mm, by more bending and by more stretch, to first order.

        more: (..., K, 2) shares of the bending and of the stretch beyond those at rest that are
        added.
        """
        bend, stretch = self.beyond_rest(points)
        return self.bent_further(points, bend * more[..., :1], stretch * more[..., 1])

    def bent_further(self, points: Tensor, bend: Tensor, stretch: Tensor) -> tuple[Tensor, Tensor]:
        """Displacements (..., n, 3), mm, by bending and by stretch that are added, to first order.

        points: (..., n, 3) key points, mm; bend: (..., K, 3), as that of `strains`; stretch:
        (..., K). What bends at a node turns everything beyond it.
        """
        lines = self._lines(points)
        by_bend = torch.linalg.cross(bend.cumsum(dim=-2), lines, dim=-1).cumsum(dim=-2)
        along = lines / lines.norm(dim=-1, keepdim=True).clamp(min=TINY)
        by_stretch = (along * (self.lengths * stretch).unsqueeze(-1)).cumsum(dim=-2)
        if self.below:
            return by_bend, by_stretch
        still = torch.zeros_like(points[..., :1, :])
        return torch.cat([still, by_bend], dim=-2), torch.cat([still, by_stretch], dim=-2)


def most_strained(rest_mm: Tensor, points: Tensor) -> list[tuple[str, float]]:
    """(one of ENERGIES, its value at HARD in rad^2) of each; none of a body that does not move.

    rest_mm: (n, 3) key points at rest, mm; points: (S, n, 3) those of recordings, mm, NaN where
    missing.
    """
    points = _moving(points)
    if not len(points):
        return []
    body = BentBody(rest_mm)
    mean = {each: body.strained(points, each)[..., 0].mean(-1) for each in ENERGIES}
    hard = {each: float(energy.quantile(HARD)) for each, energy in mean.items()}
    return [(each, energy) for each, energy in hard.items() if energy > 0.0]


def hardest_strained(rest_mm: Tensor, points: Tensor) -> list[tuple[str, tuple[float, float]]]:
    """(one of ENERGIES, its values in rad^2) of the most strained node: of bending, of stretch.

    As `most_strained`. A strain of next to no energy counts as LEAST_ENERGY of the other one.
    """
    points = _moving(points)
    if not len(points):
        return []
    body = BentBody(rest_mm)
    answer = []
    for each in ENERGIES:
        bend, stretch = body.strained(points, each).amax(-2).quantile(HARD, dim=0).tolist()
        least = LEAST_ENERGY * max(bend, stretch)
        if least > 0.0:
            answer.append((each, (max(bend, least), max(stretch, least))))
    return answer


def _moving(points: Tensor) -> Tensor:
    """The rows of key points (S, n, 3), mm, that are whole; none of a body that does not move."""
    points = points[torch.isfinite(points).all(-1).all(-1)]
    if len(points) < 2 or float((points.amax(0) - points.amin(0)).max()) < STILL_MM:
        return points[:0]
    return points
