"""Wall lines: the fibres along an arm's wall, whose material remembers, stiffens or flows.

A line carries a load u of its own, a mixture of the loads x of the chambers: one that bends the arm
shortens the wall on the other side. What a line holds back acts on the chambers by the transpose
(virtual work).
"""

import math

import torch
from torch import Tensor

RINGS = (3, 4)
"""Numbers of chambers that are taken to stand in a ring of their own; of more, nothing is known."""


def wall_lines(others: Tensor, chambers: int, ring: bool = False) -> Tensor:
    """(K, m) matrix A / |A| of the lines' loads u = A x / |A| by the chambers' loads x.

    others: () or (1,) share of a neighbouring chamber's load in the load of the line along a
    chamber, beside 1 of its own. ring: 2 m lines, one along each chamber and one between any two;
    plane sections stay plane, so that the line at the azimuth f carries
    c sum_i x_i + (1 - c) sum_i x_i cos(f - f_i). Else m lines, one along each chamber, all others
    alike. |A| is the largest singular value: all lines together hold back no more than there is.
    """
    m = chambers
    if m == 1:
        return torch.ones(1, 1, dtype=others.dtype, device=others.device)
    if not ring:
        eye = torch.eye(m, dtype=others.dtype, device=others.device)
        most = torch.maximum((1 + (m - 1) * others).abs(), (1 - others).abs())
        return (eye + others * (1 - eye)) / most
    near = math.cos(2 * math.pi / m)
    common = (others - near) / (1 - near)
    step = torch.arange(2 * m, dtype=others.dtype, device=others.device) * (math.pi / m)
    bent = torch.cos(step[:, None] - step[None, ::2])
    most = m * torch.maximum(math.sqrt(2.0) * common.abs(), (1 - common).abs() / math.sqrt(2.0))
    return (common + (1 - common) * bent) / most


def lines_tried(chambers: int, others: float) -> list[tuple[float, bool]]:
    """(share of the others, ring) of the wall lines that a diagnosis tries on an arm.

    Lines along the chambers that carry nothing else, and a ring of lines; where that is not known
    to be one, the given share of the others in its place.
    """
    if chambers == 1:
        return [(0.0, False)]
    return [(0.0, False), (0.0, True) if chambers in RINGS else (others, False)]
