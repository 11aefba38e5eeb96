"""Networks from actuation to key points: HAW-NN, its ensembles, kernel regression, two baselines.

HAW-NN is the Hysteresis-Aware Whole-body Neural Network of Chen et al. (2025, sec. III-A).
"""

import itertools
import math
from collections.abc import Callable, Sequence
from numbers import Integral
from typing import cast

import torch
from torch import Tensor, nn

from surgisoft.config import value_text
from surgisoft.errors import InputError
from surgisoft.surrogate.arm import centre_and_half
from surgisoft.surrogate.history import History
from surgisoft.surrogate.scan import linear_scan

HIDDEN = (128, 128, 128, 128)
"""Best of the paper's six architectures: 4 hidden layers of 128 neurons."""
MOST_STRETCH = math.log(10.0)
"""Largest logarithm of an arc's length over its length at rest, and of its inverse. No arm gets so
long; actuation in another unit than the model's would make lengths that are not finite."""


MOST_WIDTH, MOST_LAYERS = 4096, 32
"""Largest width of a hidden layer, and most of them: two such layers have 17 million weights, more
than any recording can determine."""


def parse_widths(text: str) -> tuple[int, ...]:
    """Widths of hidden layers from text such as `128,128`."""
    try:
        widths = tuple(int(word) for word in text.replace("x", ",").split(","))
    except ValueError:
        widths = ()
    check_widths(widths, f"'{text}'")
    return widths


def check_widths(widths: object, shown: str | None = None) -> None:
    """Raise InputError unless the widths of hidden layers are whole numbers within the limits."""
    each = list(widths) if isinstance(widths, tuple | list) else []
    if not 1 <= len(each) <= MOST_LAYERS or not all(map(_fits, each)):
        raise InputError(
            f"hidden widths {shown or value_text(widths)}: expected whole numbers such as "
            f"128,128,128,128, 1 to {MOST_LAYERS} of them from 1 to {MOST_WIDTH}"
        )


def _fits(width: object) -> bool:
    """Whether a hidden layer can have this width; a number of NumPy is a whole number, too."""
    whole = isinstance(width, Integral) and not isinstance(width, bool)
    return whole and 1 <= int(cast(int, width)) <= MOST_WIDTH


def stretched(stretch: Tensor) -> Tensor:
    """Length of an arc over its length at rest, from the logarithm of it (...)."""
    return stretch.clamp(-MOST_STRETCH, MOST_STRETCH).exp()


class HawNN(nn.Module):
    """[p_1..p_m, d_1..d_m] -> n key points; with `directions` false, [p_1..p_m] -> n key points.

    Inputs and outputs are normalised inside: pressures by the arm's range to [-1, 1], key points
    by mean and standard deviation of the data the network was fitted to. The paper does not name
    its activation; SiLU (Elfwing et al. 2018) is smooth, so that Jacobians are too, and fast.
    """

    centre: Tensor
    half_range: Tensor
    use: Tensor
    mean: Tensor
    scale: Tensor

    remembers = whole_runs = runs_only = False

    def __init__(
        self,
        low: Tensor,
        high: Tensor,
        key_points: int,
        hidden: tuple[int, ...] = HIDDEN,
        directions: bool = True,
        arcs: int = 0,
    ):
        """Pressure range low, high (m,) in the arm's unit; `key_points` is n.

        arcs: number of arcs of a prior mean (`ArcChain`), to which the layers add what is left; 0:
        none.
        """
        super().__init__()
        chambers = len(low)
        self.arcs = arcs
        self.prior = ArcChain(low, high, key_points, arcs) if arcs else None
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
        y = y.unflatten(-1, (self.key_points, 3))
        return y if self.prior is None else y + self.prior(pressure)

    @torch.no_grad()
    def with_directions(self, use: Tensor) -> "HawNN":
        """This network with added direction inputs whose weights are zero: an equal function.

        use: (m,) 1 for each chamber whose direction the data supports, 0 elsewhere.
        """
        grown = HawNN(
            self.centre - self.half_range,
            self.centre + self.half_range,
            self.key_points,
            self.hidden,
            directions=True,
            arcs=self.arcs,
        )
        state = self.state_dict()
        first = state["layers.0.weight"]
        state["layers.0.weight"] = torch.cat(
            [first[:, : len(use)], torch.zeros(len(first), len(use))], dim=1
        )
        state["use"] = use.to(first)
        grown.load_state_dict(state)
        return grown


class HawEnsemble(nn.Module):
    """K HAW-NN of one layout; the mean of their key points is the prediction.

    Averaging networks that were trained from other weights on other shares of the data lowers the
    part of the error that differs between them (Breiman 1996; Lakshminarayanan et al. 2017). All
    K are evaluated by one batched product a layer.
    """

    remembers = whole_runs = runs_only = False
    centre: Tensor
    half_range: Tensor
    use: Tensor
    mean: Tensor
    scale: Tensor

    def __init__(
        self,
        low: Tensor,
        high: Tensor,
        key_points: int,
        hidden: tuple[int, ...] = HIDDEN,
        directions: bool = True,
        members: int = 5,
        arcs: int = 0,
    ):
        """Pressure range low, high (m,) in the arm's unit; `key_points` is n, `members` K.

        arcs: number of arcs of the prior mean that all members share; 0: none.
        """
        super().__init__()
        self.members, self.arcs = members, arcs
        first = HawNN(low, high, key_points, hidden, directions)
        self.prior = ArcChain(low, high, key_points, arcs) if arcs else None
        self.key_points, self.hidden, self.directions = key_points, first.hidden, directions
        for name, value in first.named_buffers():
            self.register_buffer(name, value)
        linear = [layer for layer in first.layers if isinstance(layer, nn.Linear)]
        self.weights = nn.ParameterList(
            torch.zeros(members, layer.in_features, layer.out_features) for layer in linear
        )
        self.biases = nn.ParameterList(
            torch.zeros(members, 1, layer.out_features) for layer in linear
        )

    @classmethod
    @torch.no_grad()
    def of(cls, networks: list[HawNN]) -> "HawEnsemble":
        """The ensemble of networks of one layout and one normalisation."""
        first = networks[0]
        low, high = first.centre - first.half_range, first.centre + first.half_range
        layout = (first.key_points, first.hidden, first.directions, len(networks), first.arcs)
        made = cls(low, high, *layout)
        shared = {k: v for k, v in first.state_dict().items() if not k.startswith("layers.")}
        made.load_state_dict(shared, strict=False)
        for member, network in enumerate(networks):
            linear = [layer for layer in network.layers if isinstance(layer, nn.Linear)]
            for layer, weight, bias in zip(linear, made.weights, made.biases, strict=True):
                weight[member], bias[member, 0] = layer.weight.T, layer.bias
        return made.to(first.centre.device)

    def each(self, pressure: Tensor, direction: Tensor) -> Tensor:
        """(K, ..., n, 3) key points in mm of every member, base frame."""
        x = self._inputs(pressure, direction)
        leading = x.shape[:-1]
        points = self._through(x.reshape(1, -1, x.shape[-1]).expand(self.members, -1, -1))
        points = points.reshape(self.members, *leading, self.key_points, 3)
        return points if self.prior is None else points + self.prior(pressure)

    def members_at(self, pressure: Tensor, direction: Tensor) -> Tensor:
        """(K, B, n, 3) key points in mm, each member at other rows (K, B, m)."""
        points = self._through(self._inputs(pressure, direction))
        return points if self.prior is None else points + self.prior(pressure)

    def _inputs(self, pressure: Tensor, direction: Tensor) -> Tensor:
        x = (pressure - self.centre) / self.half_range
        return torch.cat([x, direction * self.use], dim=-1) if self.directions else x

    def _through(self, x: Tensor) -> Tensor:
        """(K, B, n, 3) key points in mm from scaled inputs (K, B, m or 2 m)."""
        last = len(self.weights) - 1
        for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = torch.baddbmm(bias, x, weight)
            if number < last:
                x = nn.functional.silu(x)
        return torch.addcmul(self.mean, x, self.scale).unflatten(-1, (self.key_points, 3))

    def forward(self, pressure: Tensor, direction: Tensor) -> Tensor:
        """Key points (..., n, 3) in mm, base frame, from pressure and direction, each (..., m)."""
        return self.each(pressure, direction).mean(0)


def range_weights(key_points: Tensor) -> Tensor:
    """Weights of the motion-range weighted MSE (Chen et al. 2025, eqs. 4-5).

    w_i = 1 + N dY_i / sum_i dY_i over the N = 3n output coordinates, dY_i their motion range.
    Key points (S, n, 3) in mm, NaN where missing; returns (n, 3), without unit, mean 2.
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


def rotation(vector: Tensor) -> Tensor:
    """(..., 3, 3) rotation matrices from rotation vectors (..., 3) in rad (Rodrigues 1840)."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    angle = (vector.square().sum(-1) + 1e-12).sqrt()[..., None, None]
    along = torch.sinc(angle / math.pi)
    across = 0.5 * torch.sinc(angle / (2 * math.pi)).square()
    unturned = torch.eye(3, dtype=cross.dtype, device=cross.device)
    return unturned + along * cross + across * (cross @ cross)


def arc_shape(bend: Tensor) -> tuple[Tensor, Tensor]:
    """(1 - cos a) / a^2 and sin(a) / a, each (...), of arcs of bend (..., 2) in rad, a its norm."""
    angle = (bend.square().sum(-1) + 1e-12).sqrt()
    return 0.5 * torch.sinc(angle / (2 * math.pi)).square(), torch.sinc(angle / math.pi)


def arc_point(bend: Tensor, length: Tensor, shape: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """End of a circular arc that starts at the origin along z (Webster & Jones 2010).

    bend (..., 2) in rad is the arc's angle a times its direction in x and y, length L (...,) in mm,
    shape its `arc_shape`; returns (..., 3) in mm: x, y = L (1 - cos a) / a^2 bend and
    z = L sin(a) / a.
    """
    across, along = arc_shape(bend) if shape is None else shape
    return torch.cat([(length * across)[..., None] * bend, (length * along)[..., None]], -1)


def arc_rotation(bend: Tensor, shape: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """(..., 3, 3) rotation from the start to the end of an arc of bend (..., 2) rad, no twist.

    That of Rodrigues (1840) about the axis (-y, x, 0); shape: the arc's `arc_shape`.
    """
    across, along = arc_shape(bend) if shape is None else shape
    x, y = bend.unbind(-1)
    xx, xy, yy = across * x * x, across * x * y, across * y * y
    right, up = along * x, along * y
    entries = [1 - xx, -xy, right, -xy, 1 - yy, up, -right, -up, 1 - xx - yy]
    return torch.stack(entries, -1).unflatten(-1, (3, 3))


class ConstantCurvature(nn.Module):
    """Key points on constant-curvature arcs; ignores directions (Webster & Jones 2010)."""

    centre: Tensor
    half_range: Tensor
    length: Tensor

    directions = False
    remembers = whole_runs = runs_only = False

    def __init__(self, low: Tensor, high: Tensor, key_points: int, sections: int = 0):
        """Pressure range (m,) in the arm's unit; `sections` 0 means one for every 3 chambers."""
        super().__init__()
        chambers = len(low)
        sections = sections or max(1, math.ceil(chambers / 3))
        if key_points < 2:
            raise InputError("constant curvature needs at least 2 key points; this arm has 1")
        self.key_points, self.sections = key_points, sections
        self._on: list[int] | None = None
        centre, half = centre_and_half(low, high)
        self.register_buffer("centre", centre)
        self.register_buffer("half_range", half)
        self.fraction = nn.Parameter(torch.linspace(0, 1, key_points))
        self.register_buffer("length", torch.ones(()))
        self.table = nn.Parameter(torch.zeros(sections, 3, chambers + 1))
        self.base_turn = nn.Parameter(torch.zeros(3))
        self.base_mm = nn.Parameter(torch.zeros(3))

    def _sections_of_points(self) -> list[int]:
        """The section that each key point is on."""
        place = (self.fraction.detach() * self.sections).floor()
        return place.clamp(0, self.sections - 1).long().tolist()

    def fix_sections(self) -> None:
        """Keep each key point on its section from now on, whatever becomes of the spacing."""
        self._on = self._sections_of_points()

    def set_rest(self, rest: Tensor) -> None:
        """Set base, length and spacing from the key points at rest, (n, 3) in mm, base frame."""
        steps = rest.diff(dim=0).norm(dim=-1)
        if not float(steps.sum()) > 0:
            raise InputError("constant curvature: all key points coincide, expected a chain")
        self.length.copy_(steps.sum())
        self.fraction.data.copy_(torch.cat([steps.new_zeros(1), steps.cumsum(0)]) / steps.sum())
        self.base_mm.data.copy_(rest[0])

    def forward(self, pressure: Tensor, direction: Tensor) -> Tensor:
        """Key points (..., n, 3) in mm, base frame, from pressure (..., m)."""
        x = (pressure - self.centre) / self.half_range
        x = torch.cat([x, torch.ones_like(x[..., :1])], -1)
        values = torch.einsum("scm,...m->...sc", self.table, x)
        turn = rotation(self.base_turn).expand(*x.shape[:-1], 3, 3)
        start = self.base_mm.expand(*x.shape[:-1], 3)
        points = [start] * self.key_points
        on = self._sections_of_points() if self._on is None else self._on
        for section in range(self.sections):
            bend = values[..., section, :2]
            length = self.length / self.sections * stretched(values[..., section, 2])
            for k in range(self.key_points):
                share = self.fraction[k] * self.sections - section
                if on[k] == section:
                    local = arc_point(bend * share, length * share)
                    points[k] = start + (turn @ local[..., None])[..., 0]
            start = start + (turn @ arc_point(bend, length)[..., None])[..., 0]
            turn = turn @ arc_rotation(bend)
        return torch.stack(points, -2)


class ArcChain(nn.Module):
    """Prior mean of an arm: arcs end to end, whose bends and stretches are linear in the actuation.

    One arc ends at each key point (Webster & Jones 2010); where the first key point does not move,
    it is the base, and the arcs begin there. Arcs compose by rotations, so that bends that were
    only recorded one by one already give the shape of all of them together, which a sum of
    displacements does not.
    """

    centre: Tensor
    half_range: Tensor
    length_mm: Tensor
    base_mm: Tensor

    def __init__(self, low: Tensor, high: Tensor, key_points: int, arcs: int):
        """Pressure range low, high (m,) in the arm's unit; arcs: n, or n - 1 from a fixed base."""
        super().__init__()
        if not 1 <= arcs <= key_points or arcs < key_points - 1:
            raise InputError(f"{arcs} arcs for {key_points} key points, expected one for each")
        centre, half = centre_and_half(low, high)
        self.fixed_base = arcs < key_points
        self.register_buffer("centre", centre)
        self.register_buffer("half_range", half)
        self.register_buffer("length_mm", torch.ones(arcs))
        self.register_buffer("base_mm", torch.zeros(3))
        self.table = nn.Parameter(torch.zeros(arcs, 3, len(low) + 1))
        self.base_turn = nn.Parameter(torch.zeros(3))
        self.base_shift = nn.Parameter(torch.zeros(3))
        self.offset = nn.Parameter(torch.zeros(arcs, 3))

    @torch.no_grad()
    def set_rest(self, rest: Tensor) -> None:
        """Set base and lengths from the key points at rest, (n, 3) in mm, base frame.

        A base below the first key point is assumed as far from it as the second one is.
        """
        steps = rest.diff(dim=0)
        if not self.fixed_base:
            first = steps[:1] if len(steps) else rest[:1]
            rest, steps = torch.cat([rest[:1] - first[:1], rest]), torch.cat([first, steps])
        lengths = steps.norm(dim=-1)
        if not bool((lengths > 0).all()):
            raise InputError("prior mean: two key points coincide at rest, expected a chain")
        self.length_mm.copy_(lengths)
        self.base_mm.copy_(rest[0])
        # The rotation that takes z to the first step (Rodrigues 1840).
        along = torch.nn.functional.normalize(steps[0], dim=0)
        axis = torch.stack([-along[1], along[0], torch.zeros(())])
        sine = axis.norm()
        if sine > 1e-6:
            self.base_turn.copy_(axis / sine * torch.atan2(sine, along[2]))

    def forward(self, pressure: Tensor) -> Tensor:
        """Key points (..., n, 3) in mm, base frame, from pressure (..., m)."""
        x = (pressure - self.centre) / self.half_range
        values = torch.einsum("acm,...m->...ac", self.table[..., :-1], x) + self.table[..., -1]
        unit = self.length_mm.mean()
        turn = rotation(self.base_turn).expand(*x.shape[:-1], 3, 3)
        place = (self.base_mm + unit * self.base_shift).expand(*x.shape[:-1], 3)
        points = [place] if self.fixed_base else []
        bend, length = values[..., :2], self.length_mm * stretched(values[..., 2])
        shape = arc_shape(bend)
        steps, turns = arc_point(bend, length, shape)[..., None], arc_rotation(bend, shape)
        for step, bent, offset in zip(
            steps.unbind(-3), turns.unbind(-3), self.offset.unbind(), strict=True
        ):
            place = place + (turn @ step)[..., 0]
            turn = turn @ bent
            points.append(place + unit * (turn @ offset))
        return torch.stack(points, -2)


class KernelArm(nn.Module):
    """Chain of arcs plus kernel regression of what it leaves, on actuation and its fading memory.

    With the scaled actuation p, its low passes q_k of the time constants tau_k, and landmarks x_l,

        key points = arcs(p) + sum_l w_l exp(-|x - x_l|^2 / 2),   x = a [p, b (p - q_1), ...].

    This is the mean of a Gaussian process with the arcs as its prior mean (Rasmussen & Williams
    2006, sec. 2.7), on landmarks (Nyström approximation, Williams & Seeger 2001): far from the data
    it returns to the arcs. A bank of low passes represents a fading memory (Boyd & Chua 1985); in
    steady state all p - q_k are zero.
    """

    centre: Tensor
    half_range: Tensor
    times: Tensor
    input_weight: Tensor
    places: Tensor

    directions = runs_only = False

    def __init__(
        self,
        low: Tensor,
        high: Tensor,
        key_points: int,
        arcs: int,
        landmarks: int,
        times_s: Sequence[float] = (),
    ):
        """Pressure range low, high (m,) in the arm's unit; `key_points` is n.

        arcs: as in `ArcChain`; landmarks: number L of landmarks; times_s: time constants of the K
        low passes of each chamber, s; none: the key points depend on the present actuation alone.
        """
        super().__init__()
        self.key_points, self.arcs, self.landmarks = key_points, arcs, landmarks
        self.times_s = tuple(float(time) for time in times_s)
        self.prior = ArcChain(low, high, key_points, arcs)
        centre, half = centre_and_half(low, high)
        inputs = len(low) * (1 + len(self.times_s))
        self.register_buffer("centre", centre)
        self.register_buffer("half_range", half)
        self.register_buffer("times", torch.tensor(self.times_s), persistent=False)
        self.register_buffer("input_weight", torch.ones(inputs))
        self.register_buffer("places", torch.zeros(landmarks, inputs))
        self.weight = nn.Parameter(torch.zeros(landmarks, 3 * key_points))

    @property
    def remembers(self) -> bool:
        """Whether there are low passes."""
        return bool(self.times_s)

    @property
    def whole_runs(self) -> bool:
        """Whether key points depend on more than the row's own actuation."""
        return self.remembers

    def rest(self, pressure: Tensor) -> Tensor:
        """(B, m, K) low passes of arms that have stood at pressure (B, m)."""
        return pressure.unsqueeze(-1).expand(*pressure.shape, len(self.times_s)).clone()

    def advance(self, memory: Tensor, pressure: Tensor, direction: Tensor, dt_s: Tensor) -> Tensor:
        """(B, m, K) low passes after pressure (B, m) was held for dt_s (B,) seconds."""
        return torch.lerp(pressure.unsqueeze(-1), memory, self._keep(dt_s))

    def _keep(self, dt_s: Tensor) -> Tensor:
        """(..., 1, K) share of a low pass's lag that is left after dt_s (...) seconds."""
        return torch.exp(-dt_s[..., None, None] / self.times)

    def inputs(self, pressure: Tensor, memory: Tensor | None = None) -> Tensor:
        """(..., m (1 + K)) scaled actuation and lags, before weights.

        pressure: (..., m) in the arm's unit; memory: (..., m, K) low passes of it, None in
        steady state.
        """
        x = (pressure - self.centre) / self.half_range
        if not self.remembers:
            return x
        if memory is None:
            memory = pressure.unsqueeze(-1).expand(*pressure.shape, len(self.times_s))
        lag = (pressure.unsqueeze(-1) - memory) / self.half_range.unsqueeze(-1)
        return torch.cat([x, lag.flatten(-2)], -1)

    def forward(self, pressure: Tensor, direction: Tensor, memory: Tensor | None = None) -> Tensor:
        """Key points (..., n, 3) in mm, base frame, from pressure (..., m), low passes (..., m, K).

        memory: None stands for steady state.
        """
        x = self.inputs(pressure, memory) * self.input_weight
        near = gaussian_kernel(x, self.places)
        return self.prior(pressure) + (near @ self.weight).unflatten(-1, (self.key_points, 3))

    def lows(self, actuation: Tensor, history: History, memory: Tensor | None) -> Tensor:
        """(R, T, m, K) low passes along actuation (R, T, m) of a history's runs.

        memory: (R, m, K) before the first row; None: of arms that have stood at the first row's.
        """
        keep = self._keep(history.dt_s.to(actuation))
        start = self.rest(actuation[:, 0]) if memory is None else memory
        start = start.expand(len(actuation), *start.shape[1:])
        return linear_scan(keep, (1 - keep) * actuation.unsqueeze(-1), start)

    def along(self, actuation: Tensor, history: History, memory: Tensor | None) -> Tensor:
        """Key points (R, T, n, 3) in mm along effective actuation (R, T, m) of a history's runs.

        memory: (R, m, K) low passes before the first row.
        """
        low = self.lows(actuation, history, memory)
        parts = zip(
            actuation.flatten(0, 1).split(KERNEL_ROWS),
            low.flatten(0, 1).split(KERNEL_ROWS),
            strict=True,
        )
        points = torch.cat([self(pressure, pressure, low) for pressure, low in parts])
        return points.unflatten(0, actuation.shape[:2])

    def slope_along(
        self,
        actuation: Tensor,
        history: History,
        memory: Tensor | None,
        rows: Callable[[Tensor], Tensor],
    ) -> Tensor:
        """(S, n, 3, m) derivative of key points by a constant offset of each chamber, mm a unit.

        The offset holds for the whole run, so that the low passes have it too. rows: picks the rows
        (S, ...) of a (R, T, ...) tensor.
        """
        pressure, low = rows(actuation), rows(self.lows(actuation, history, memory))
        return rowwise_jacobian(
            lambda at: self(at, at, low + (at - at.detach()).unsqueeze(-1)), pressure
        )


KERNEL_ROWS = 1 << 14
"""Rows whose kernels are held at once; of each there is a number for every landmark."""


def rowwise_jacobian(points_of: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """(S, n, 3, m) derivative at (S, m) of a function whose row s depends on row s of `at` alone.

    points_of: (S, m) to (S, n, 3). By reverse differentiation, one pass for each coordinate: the
    first use of PyTorch's forward mode (`torch.func.jvp`) costs 1.3 s, which is a quarter of a
    diagnosis.
    """
    with torch.enable_grad():
        at = at.detach().clone().requires_grad_(True)
        points = points_of(at)
        coordinates = points.flatten(1).unbind(1)
        slopes = [torch.autograd.grad(c.sum(), at, retain_graph=True)[0] for c in coordinates]
    return torch.stack(slopes, 1).unflatten(1, points.shape[1:])


def gaussian_kernel(x: Tensor, places: Tensor) -> Tensor:
    """(..., L) exp(-|x - place|^2 / 2) of inputs (..., F) and places (L, F)."""
    half = x.square().sum(-1, keepdim=True) + places.square().sum(-1)
    return torch.exp((x @ places.T - half / 2).clamp(max=0))


class RecurrentArm(nn.Module):
    """Gated recurrent unit (Cho et al. 2014) from pressures and directions to key points."""

    centre: Tensor
    half_range: Tensor
    mean: Tensor
    scale: Tensor

    directions = remembers = True
    whole_runs = runs_only = False

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

    def advance(
        self, memory: Tensor, pressure: Tensor, direction: Tensor, dt_s: Tensor | None = None
    ) -> Tensor:
        """(B, width) hidden state after one row of pressure and direction, each (B, m).

        dt_s (B,) does not count: a recurrent unit takes row by row.
        """
        cell = self.cell
        return torch.gru_cell(
            self._inputs(pressure, direction),
            memory,
            cast(Tensor, cell.weight_ih_l0),
            cast(Tensor, cell.weight_hh_l0),
            cast(Tensor, cell.bias_ih_l0),
            cast(Tensor, cell.bias_hh_l0),
        )

    def scan(self, pressure: Tensor, direction: Tensor, memory: Tensor | None = None) -> Tensor:
        """(R, T, width) hidden states along pressure and direction, each (R, T, m)."""
        start = None if memory is None else memory.unsqueeze(0)
        return self.cell(self._inputs(pressure, direction), start)[0]

    def forward(self, pressure: Tensor, direction: Tensor, memory: Tensor) -> Tensor:
        """Key points (..., n, 3) in mm from pressure, direction (..., m), memory (..., width)."""
        y = self.readout(torch.cat([memory, self._inputs(pressure, direction)], dim=-1))
        return torch.addcmul(self.mean, y, self.scale).unflatten(-1, (self.key_points, 3))
