"""A recurrent baseline: gated recurrent units (Cho et al. 2014) over pressures and directions.

The paper names recurrent networks as future work. The hidden state is the arm's memory; time
steps are the rows of a recording, however far apart.
"""

import torch
from torch import Tensor, nn

from surgisoft.surrogate.arm import centre_and_half


class RecurrentArm(nn.Module):
    """[p, d] at each row -> hidden state -> key points."""

    directions = True

    def __init__(self, low: Tensor, high: Tensor, key_points: int, width: int = 64):
        """Pressure range low, high (m,) in the arm's unit; `width` of the hidden state."""
        super().__init__()
        chambers = len(low)
        self.key_points, self.width = key_points, width
        centre, half = centre_and_half(low, high)
        self.register_buffer("centre", centre)
        self.register_buffer("half_range", half)
        self.register_buffer("mean", torch.zeros(3 * key_points))
        self.register_buffer("scale", torch.ones(3 * key_points))
        self.cell = nn.GRU(2 * chambers, width, batch_first=True)
        self.readout = nn.Sequential(
            nn.Linear(width + 2 * chambers, 128), nn.SiLU(), nn.Linear(128, 3 * key_points)
        )

    def _inputs(self, pressure: Tensor, direction: Tensor) -> Tensor:
        return torch.cat([(pressure - self.centre) / self.half_range, direction], dim=-1)

    def rest(self, pressure: Tensor) -> Tensor:
        """(B, width) hidden state of an arm without history, for pressure (B, m)."""
        return pressure.new_zeros(len(pressure), self.width)

    def advance(self, memory: Tensor, pressure: Tensor, direction: Tensor) -> Tensor:
        """(B, width) hidden state after one row of pressure and direction, each (B, m)."""
        x = self._inputs(pressure, direction).unsqueeze(1)
        return self.cell(x, memory.unsqueeze(0))[1].squeeze(0)

    def scan(self, pressure: Tensor, direction: Tensor, memory: Tensor | None = None) -> Tensor:
        """(R, T, width) hidden states along pressure and direction, each (R, T, m)."""
        start = None if memory is None else memory.unsqueeze(0)
        return self.cell(self._inputs(pressure, direction), start)[0]

    def forward(self, pressure: Tensor, direction: Tensor, memory: Tensor) -> Tensor:
        """Key points (..., n, 3) in mm from pressure, direction (..., m), memory (..., width)."""
        y = self.readout(torch.cat([memory, self._inputs(pressure, direction)], dim=-1))
        return torch.addcmul(self.mean, y, self.scale).unflatten(-1, (self.key_points, 3))
