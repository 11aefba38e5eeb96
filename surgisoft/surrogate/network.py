"""HAW-NN: the Hysteresis-Aware Whole-body Neural Network (Chen et al. 2025, sec. III-A)."""

import itertools

import torch
from torch import Tensor, nn

from surgisoft.errors import InputError
from surgisoft.surrogate.arm import centre_and_half

HIDDEN = (128, 128, 128, 128)
"""Best of the paper's six architectures: 4 hidden layers of 128 neurons."""


def parse_widths(text: str) -> tuple[int, ...]:
    """Widths of hidden layers from text such as `128,128`."""
    try:
        widths = tuple(int(word) for word in text.replace("x", ",").split(","))
    except ValueError:
        widths = ()
    if not widths or min(widths) < 1:
        raise InputError(f"hidden widths '{text}': expected whole numbers such as 128,128,128,128")
    return widths


class HawNN(nn.Module):
    """[p_1..p_m, d_1..d_m] -> n key points; with `directions` false, [p_1..p_m] -> n key points.

    Inputs and outputs are normalised inside: pressures by the arm's range to [-1, 1], key points
    by mean and standard deviation of the data the network was fitted to. The paper does not name
    its activation; SiLU (Elfwing et al. 2018) is smooth, so that Jacobians are too, and fast.
    """

    def __init__(
        self,
        low: Tensor,
        high: Tensor,
        key_points: int,
        hidden: tuple[int, ...] = HIDDEN,
        directions: bool = True,
    ):
        """Pressure range low, high (m,) in the arm's unit; `key_points` is n."""
        super().__init__()
        chambers = len(low)
        self.key_points = key_points
        self.hidden = tuple(hidden)
        self.directions = directions
        centre, half = centre_and_half(low, high)
        self.register_buffer("centre", centre)
        self.register_buffer("half_range", half)
        self.register_buffer("use", torch.ones(chambers))
        self.register_buffer("mean", torch.zeros(3 * key_points))
        self.register_buffer("scale", torch.ones(3 * key_points))
        widths = [chambers * (2 if directions else 1), *hidden]
        layers = []
        for before, after in itertools.pairwise(widths):
            layers += [nn.Linear(before, after), nn.SiLU()]
        layers.append(nn.Linear(widths[-1], 3 * key_points))
        self.layers = nn.Sequential(*layers)

    def forward(self, pressure: Tensor, direction: Tensor) -> Tensor:
        """Key points (..., n, 3) in mm, base frame, from pressure and direction, each (..., m)."""
        x = (pressure - self.centre) / self.half_range
        if self.directions:
            x = torch.cat([x, direction * self.use], dim=-1)
        y = torch.addcmul(self.mean, self.layers(x), self.scale)
        return y.unflatten(-1, (self.key_points, 3))

    @torch.no_grad()
    def with_directions(self, use: Tensor) -> "HawNN":
        """The same function with direction inputs added, whose weights start at zero.

        `use` (m,) is 1 for each chamber whose direction the data supports, 0 elsewhere.
        """
        grown = HawNN(
            self.centre - self.half_range,
            self.centre + self.half_range,
            self.key_points,
            self.hidden,
            directions=True,
        )
        state = self.state_dict()
        first = state["layers.0.weight"]
        state["layers.0.weight"] = torch.cat(
            [first[:, : len(use)], torch.zeros(len(first), len(use))], dim=1
        )
        state["use"] = use.to(first)
        grown.load_state_dict(state)
        return grown


def range_weights(key_points: Tensor) -> Tensor:
    """Weights of the motion-range weighted MSE (Chen et al. 2025, eqs. 4-5).

    w_i = 1 + N dY_i / sum_i dY_i over the N = 3n output coordinates, dY_i their motion range.
    Key points (S, n, 3) in mm, NaN where missing; answer (n, 3), without unit, mean 2.
    """
    low = key_points.nan_to_num(nan=float("inf")).amin(0)
    high = key_points.nan_to_num(nan=float("-inf")).amax(0)
    span = (high - low).clamp(min=0).nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
    return 1 + span.numel() * span / span.sum().clamp(min=1e-12)


def weighted_mse(predicted: Tensor, measured: Tensor, weights: Tensor) -> Tensor:
    """Motion-range weighted MSE in mm^2 (Chen et al. 2025, eq. 6); missing values do not count.

    Shapes: predicted, measured (S, n, 3) in mm, weights (n, 3).
    """
    seen = ~measured.isnan()
    error = (predicted - measured.nan_to_num()) * seen
    return (weights * error.square()).sum() / seen.sum().clamp(min=1)
