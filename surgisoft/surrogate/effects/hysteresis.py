"""Hysteresis: play operators with memory on mixtures of the chambers (Prandtl-Ishlinskii).

A play operator of radius r follows its input through a gap of width 2r:
y(t) = clamp(y(t-), u(t) - r, u(t) + r) (Krasnosel'skii & Pokrovskii 1989, ch. 1). Many of them
remember every reversal that no larger one has wiped out. In a soft arm friction sits in the wall,
and the strain of a wall line is moved by several chambers at once; as in a vector hysteron model
(Mayergoyz 2003, ch. 3), plays therefore run along several lines l of the actuation space,

    u_l = sum_i a_li x_i + sum_ij b_lij x_i x_j,      x = actuation scaled to [-1, 1],

whose mixture a, b is fitted with the rest. Superposed (Kuhnen 2003, eq. 8) they give

    x_eff = x + sum_l sum_k (w_lk + v_lk (u_l - u_l(rest))) (y_lk - u_l),

where v lets a loop's width depend on where it lies. With w = v = 0 nothing changes.
"""

import torch
from torch import Tensor, nn

from surgisoft.surrogate.arm import centre_and_half
from surgisoft.surrogate.effects.base import Effect, Quantity
from surgisoft.surrogate.scan import play_scan

RADII = (0.02, 0.04, 0.08, 0.14, 0.22, 0.32, 0.44, 0.58, 0.74, 0.90)
"""Radii of the plays, in units of half a line's range: fine for small reversals, and up to nearly
the half range (a larger radius never moves)."""


class Hysteresis(Effect):
    """Rate-independent hysteresis with minor loops."""

    stage = "material"

    def __init__(self, low: Tensor, high: Tensor, rest: Tensor, radii: tuple[float, ...] = RADII):
        """Actuation range low, high and rest (m,) in the arm's unit; radii of the plays."""
        super().__init__()
        chambers = len(low)
        self.radii = tuple(radii)
        centre, half = centre_and_half(low, high)
        self.register_buffer("centre", centre)
        self.register_buffer("half_range", half)
        self.register_buffer("origin", rest)
        self.register_buffer("radius", torch.tensor(self.radii))
        self.register_buffer("use", torch.ones(chambers))
        lines = first_lines(chambers)
        self.linear = nn.Parameter(lines)
        self.bent = nn.Parameter(lines.new_zeros(len(lines), chambers, chambers))
        shape = (chambers, len(lines), len(self.radii))
        self.weight = nn.Parameter(torch.zeros(shape))
        self.slope = nn.Parameter(torch.zeros(shape))

    def lines(self, signal: Tensor) -> Tensor:
        """(..., L) inputs of the lines' plays from the actuation (..., m)."""
        x = (signal - self.centre) / self.half_range * self.use
        products = (x.unsqueeze(-1) * x.unsqueeze(-2)).flatten(-2)
        return x @ self.linear.T + products @ self.bent.flatten(1).T

    def memory_parameters(self) -> list[nn.Parameter]:
        return [self.linear, self.bent]

    def rest(self, signal: Tensor) -> Tensor:
        """(B, L, J) plays centred on the lines at the actuation (B, m): no history."""
        return self.lines(signal)[..., None].expand(*signal.shape[:-1], -1, len(self.radii))

    def advance(self, memory: Tensor, signal: Tensor, dt: Tensor) -> Tensor:
        """(B, L, J) plays after the actuation (B, m); dt does not matter."""
        return self._follow(memory, self.lines(signal))

    def step(self, memory: Tensor, signal: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
        """Plays and effective actuation after the actuation (B, m), its lines computed once."""
        u = self.lines(signal)
        memory = self._follow(memory, u)
        return memory, self._superpose(signal, u, memory)

    def _follow(self, memory: Tensor, u: Tensor) -> Tensor:
        u = u.unsqueeze(-1)
        return torch.clamp(memory, u - self.radius, u + self.radius)

    def scan(self, memory: Tensor, signal: Tensor, dt: Tensor) -> Tensor:
        """(R, T, L, J) plays along the actuation (R, T, m), from plays (R, L, J) before it."""
        u = self.lines(signal).unsqueeze(-1)
        return play_scan(u.expand(*u.shape[:-1], len(self.radii)), self.radius, memory)

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from actuation (..., m) and plays (..., L, J)."""
        return self._superpose(signal, self.lines(signal), memory)

    def _superpose(self, signal: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        lag = memory - u.unsqueeze(-1)
        away = (u - self.lines(self.origin)).unsqueeze(-1)
        shift = lag.flatten(-2) @ self.weight.flatten(1).T
        shift = shift + (lag * away).flatten(-2) @ self.slope.flatten(1).T
        return signal + self.half_range * shift

    def config(self) -> dict:
        return {"radii": list(self.radii)}

    def quantities(self) -> list[Quantity]:
        strength = self.weight.detach().abs().sum(-1) * self.half_range[:, None]
        return [
            Quantity("lines", self.linear.detach().tolist(), ""),
            Quantity("radius", list(self.radii), "half range"),
            Quantity("weight", self.weight.detach().tolist(), ""),
            Quantity("loop", strength.tolist(), "actuation"),
        ]


def first_lines(chambers: int) -> Tensor:
    """(L, m) lines to start from: each chamber, and each with its neighbour; |values| sum to 1."""
    single = torch.eye(chambers)
    if chambers == 1:
        return single
    pairs = (single + single.roll(1, dims=0)) / 2
    return torch.cat([single, pairs[: 1 if chambers == 2 else chambers]])
