"""Play operators on the bending and the stretch of a body, segment by segment.

Friction in a wall holds back the strain of each part of a body, whatever moves it. A node of the
body (`bent_body`) bends in all directions, so its bending runs through play operators along several
axes n_a, whose answers are superposed (Mayergoyz 2003, ch. 3): with b the bending, e the stretch
and y[u] the play operator's answer to u,

    lag of b = (3 / A) sum_a n_a (y[n_a . b] - n_a . b),      lag of e = y[e] - e.

The A = 6 axes are those through the vertices of an icosahedron, for which (3 / A) sum_a n_a n_a' is
the unit matrix: while no play operator slips, all directions are alike. Where all of them slip, the
lag along the bending is 1.38 to 1.62 radii.
"""

import math

import torch
from torch import Tensor, nn

from surgisoft.surrogate.effects.bent_body import SLENDERNESS, BentBody

GOLDEN = (1 + math.sqrt(5)) / 2
AXES = torch.nn.functional.normalize(
    torch.tensor(
        [
            [0.0, 1.0, GOLDEN],
            [0.0, 1.0, -GOLDEN],
            [1.0, GOLDEN, 0.0],
            [1.0, -GOLDEN, 0.0],
            [GOLDEN, 0.0, 1.0],
            [-GOLDEN, 0.0, 1.0],
        ],
        dtype=torch.float64,
    )
)
"""(6, 3) unit vectors through the vertices of an icosahedron."""


class BodyPlays(nn.Module):
    """Inputs and answers of the play operators of a body with K nodes."""

    axes: Tensor
    scale: Tensor

    def __init__(self, rest_mm: Tensor, full_rad: float):
        """rest_mm: (n, 3) key points at rest, mm; full_rad: bending over the whole arm that is 1 of
        an input, rad."""
        super().__init__()
        self.bent = BentBody(rest_mm)
        self.register_buffer("axes", AXES.float(), persistent=False)
        whole = self.bent.lengths.sum() / self.bent.lengths
        self.full_rad = float(full_rad)
        self.register_buffer("scale", (whole / self.full_rad).unsqueeze(-1), persistent=False)

    def inputs(self, points: Tensor) -> Tensor:
        """(..., K, 7) bending about the axes and stretch beyond those at rest.

        points: (..., n, 3) key points, mm. A node has 1 where the whole arm would bend by full_rad
        with the curvature there; a stretch of 1 / SLENDERNESS counts as a bending of 1 rad.
        """
        bend, stretch = self.bent.beyond_rest(points)
        stretch = (SLENDERNESS / self.full_rad * stretch).unsqueeze(-1)
        return torch.cat([self.scale * (bend @ self.axes.T), stretch], dim=-1)

    def moved(self, points: Tensor, bend: Tensor, stretch: Tensor) -> tuple[Tensor, Tensor]:
        """Displacements (..., n, 3), mm, by changes of the inputs.

        bend: (..., K, 6) changes of the bending about each axis, stretch: (..., K) of the stretch.
        """
        bend = 3.0 / len(self.axes) * (bend / self.scale) @ self.axes
        return self.bent.bent_further(points, bend, self.full_rad / SLENDERNESS * stretch)

    def loop(self, radius: Tensor) -> Tensor:
        """(J,) width of the loop that a weight of one gives a bending of -1/2 to 1/2 and back.

        radius: (J,) of the play operators. The loop is that in the middle of the range along x, as
        along y or z. On the axis a the range is |n_a . x|; in its middle a play lags by its radius
        if that is below a quarter of it, and not at all beyond half of it.
        """
        seen = self.axes[:, :1].abs()
        lag = torch.minimum(radius, 0.5 * seen - radius).clamp(min=0.0)
        return 6.0 / len(self.axes) * (seen * lag).sum(0)
