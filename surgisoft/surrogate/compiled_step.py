"""A time step of a HAW-NN, with or without hysteresis and arcs, in compiled parts and its products.

`Chain.step` is the reference: it takes every effect and network, and is differentiable. Here the
memories and directions of all arms are one compiled loop in front of the network's matrix products,
and the chain of arcs of its prior mean is one behind them. Both agree to rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from surgisoft.compiled import compiled
from surgisoft.surrogate.arm import ArmState
from surgisoft.surrogate.effects.hysteresis import Hysteresis
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import MOST_STRETCH, ArcChain, HawNN, rotation
from surgisoft.threads import over_rows

LANES = 16
"""Numbers of float32 in the widest vectors of x86-64 (AVX-512)."""


_MOST_STRETCH = np.float32(MOST_STRETCH)
"""The bound of `networks.stretched` in single precision, as a compiled loop takes it."""


class CompiledStep:
    """Steps of one arm model on the CPU, without gradients.

    Constants are taken from the model again whenever its parameters or buffers have changed.
    """

    def __init__(
        self, model: ArmModel, network: HawNN, name: str | None, hysteresis: Hysteresis | None
    ):
        """Parts of the model: network, and name and effect of its hysteresis, None without."""
        self.model, self.name, self._network, self._hysteresis = model, name, network, hysteresis
        *self._hidden, self._out = network.layers
        self._tensors = [*model.parameters(), *model.buffers()]
        self._seen: list[tuple[int, int]] = []
        self._constants: list[np.ndarray] = []
        self._arcs: list[np.ndarray] = []
        self._last: tuple[Tensor, Tensor] | None = None

    @classmethod
    def of(cls, model: ArmModel) -> CompiledStep | None:
        """The compiled step of a model; None where only the reference can step it."""
        network, effects = model.network, dict(model.effects)
        name, effect = next(iter(effects.items()), (None, None))
        if type(network) is not HawNN or len(effects) > 1:
            return None
        if not (effect is None or (type(effect) is Hysteresis and effect.body_rad is None)):
            return None
        tensors = [*model.parameters(), *model.buffers()]
        if any(t.device.type != "cpu" for t in tensors):
            return None
        if any(t.is_floating_point() and t.dtype != torch.float32 for t in tensors):
            return None
        return cls(model, network, name, effect)

    @property
    def learns(self) -> bool:
        """Whether a gradient by the model's parameters is asked for."""
        return any(tensor.requires_grad for tensor in self._tensors)

    @torch.no_grad()
    def __call__(self, state: ArmState, pressure: Tensor) -> tuple[ArmState, Tensor]:
        """State and key points (B, n, 3) mm, base frame, after a step at `pressure` (B, m)."""
        points = pressure.new_empty(len(pressure), self._network.key_points, 3)
        state, work = self.prepared(state, pressure, points)
        over_rows(len(pressure), work)
        return state, points

    @torch.no_grad()
    def follow(self, state: ArmState, pressure: Tensor) -> ArmState:
        """State after a step at `pressure` (B, m), where nobody asks for its key points."""
        state, work = self.prepared(state, pressure)
        over_rows(len(pressure), work)
        return state

    def prepared(
        self, state: ArmState, pressure: Tensor, points_mm: Tensor | None = None
    ) -> tuple[ArmState, Callable[[slice], None]]:
        """The state after a step, and the work that fills the rows (a slice) of its tensors.

        pressure: (B, m), contiguous; what stands in the rows is read when they are worked on.
        points_mm: (B, n, 3), contiguous, which is filled with key points in the base frame. The
        work is done without gradients.
        """
        count, chambers = pressure.shape
        network = self._network
        memory = pressure.new_empty(count, 0) if self.name is None else state.memory[self.name]
        after = memory.new_empty(memory.shape)
        anchor, direction = (pressure.new_empty(count, chambers) for _ in range(2))
        x = pressure.new_empty(count, chambers * (2 if network.directions else 1))
        arrays = [
            _array(t) for t in (pressure, state.anchor, state.direction, anchor, direction, x)
        ]
        seen = [(t.data_ptr(), 0 if t.is_inference() else t._version) for t in self._tensors]
        if seen != self._seen:
            self._seen, self._constants, self._last = seen, self._read(), self._wide_last_layer()
            self._arcs = self._read_arcs()
        constants, last, arcs = self._constants, self._last, self._arcs
        memories = [] if self.name is None else [_array(memory), _array(after)]
        loop = _advance if self.name is None else _advance_with_plays
        flat = None if points_mm is None else points_mm.view(count, -1)
        filled = None if points_mm is None else _array(points_mm)
        assert last is not None

        def work(rows: slice) -> None:
            loop(*(a[rows] for a in arrays), *constants, *(a[rows] for a in memories))
            if flat is None:
                return
            y = x[rows]
            for layer in self._hidden:
                if isinstance(layer, nn.Linear):
                    y = torch.addmm(layer.bias, y, layer.weight.t())
                else:
                    y = nn.functional.silu(y, inplace=True)
            y = torch.addmm(last[1], y, last[0])[:, : len(network.mean)]
            torch.addcmul(network.mean, y, network.scale, out=flat[rows])
            if arcs and filled is not None:
                _add_arcs(arrays[-1][rows], *arcs, filled[rows])

        held = {} if self.name is None else {self.name: after}
        return ArmState(pressure, anchor, direction, held), work

    def alone(self, state: ArmState, pressure: np.ndarray) -> LoneArmModel:
        """Steps of the one arm (B = 1) of a state; see `LoneArmModel`."""
        return LoneArmModel(self, state, pressure)

    def _wide_last_layer(self) -> tuple[Tensor, Tensor]:
        """Weights (i, o) and bias (o,) of the last layer, with zeros up to whole vectors.

        A product with 15 outputs takes three times as long as one with 16.
        """
        layer = self._out
        assert isinstance(layer, nn.Linear)
        more = -layer.out_features % LANES
        weight, bias = layer.weight.detach().t(), layer.bias.detach()
        return nn.functional.pad(weight, (0, more)), nn.functional.pad(bias, (0, more))

    def _read(self) -> list[np.ndarray]:
        """Constants of the compiled loops."""
        model, network = self.model, self._network
        chain = (model.still, model.idle, model.band)
        constants = [_array(t) for t in (*chain, network.centre, network.half_range, network.use)]
        return constants + ([] if self._hysteresis is None else _plays(self._hysteresis))

    def _read_arcs(self) -> list[np.ndarray]:
        """Constants of the prior mean's loop; none without a prior mean."""
        return [] if self._network.prior is None else _chain_of(self._network.prior)


class LoneArmModel:
    """Steps of one arm in arrays that are allocated once; the model may not change meanwhile.

    A step overwrites the state before the last one. `state` copies the present one.
    """

    def __init__(self, compiled_step: CompiledStep, state: ArmState, pressure: np.ndarray):
        """pressure (1, m) kPa: where the caller puts the model's actuation before each step."""
        network, name = compiled_step._network, compiled_step.name
        self._name, self._pressure = name, pressure
        pressure[:] = _array(state.pressure)
        memory = state.memory[name] if name is not None else state.pressure.new_empty(1, 0)
        now = [_array(t).copy() for t in (state.anchor, state.direction, memory)]
        self._states = now, [np.empty_like(array) for array in now]
        linear = [layer for layer in network.layers if isinstance(layer, nn.Linear)]
        widths = [linear[0].in_features, *(layer.out_features for layer in linear)]
        x = np.empty((1, widths[0]), np.float32)
        self.points_mm = np.empty((1, network.key_points, 3), np.float32)
        """(1, n, 3) mm, base frame: key points after the last step."""
        constants = compiled_step._read()
        self._advance = _advance if name is None else _advance_with_plays
        self._calls = []
        for before, after in (self._states, self._states[::-1]):
            given = (pressure, *before[:2], *after[:2], x, *constants)
            self._calls.append(given if name is None else (*given, before[2], after[2]))
        self._network = (
            x,
            np.array(widths),
            np.concatenate([_array(layer.weight.t()).ravel() for layer in linear]),
            np.concatenate([_array(layer.bias) for layer in linear]),
            _array(network.mean),
            _array(network.scale),
            np.empty((2, max(widths)), np.float32),
            self.points_mm.reshape(-1),
        )
        arcs = compiled_step._read_arcs()
        self._arcs = (x, *arcs, self.points_mm) if arcs else None
        self._turn = 0

    @property
    def anchor(self) -> np.ndarray:
        """(1, m) kPa: see `ArmState`; overwritten by the step after the next."""
        return self._states[self._turn][0]

    @property
    def direction(self) -> np.ndarray:
        """(1, m): see `ArmState`; overwritten by the step after the next."""
        return self._states[self._turn][1]

    @property
    def state(self) -> ArmState:
        """A copy of the present state."""
        pressure, anchor, direction, memory = (
            torch.from_numpy(array.copy()) for array in (self._pressure, *self._states[self._turn])
        )
        return ArmState(
            pressure, anchor, direction, {} if self._name is None else {self._name: memory}
        )

    def step(self) -> None:
        """Advance to the actuation that stands in `pressure`, and compute the key points."""
        self._advance(*self._calls[self._turn])
        self._turn = 1 - self._turn
        _layers(*self._network)
        if self._arcs is not None:
            _add_arcs(*self._arcs)


@compiled
def _layers(x, widths, weights, biases, mean, scale, work, out):
    """Outputs (o,) of a network of linear layers with SiLU in between, for inputs x (1, i).

    weights: each layer's (inputs, outputs) one after the other, biases likewise. An inner loop
    over the outputs needs no other order of its sums to be vectorised.
    """
    last, w, b = len(widths) - 2, 0, 0
    for i in range(widths[0]):
        work[0, i] = x[0, i]
    for layer in range(last + 1):
        rows, columns = widths[layer], widths[layer + 1]
        here, there = work[layer % 2], work[1 - layer % 2]
        for j in range(columns):
            there[j] = biases[b + j]
        for i in range(rows):
            value = here[i]
            line = weights[w + i * columns : w + (i + 1) * columns]
            for j in range(columns):
                there[j] += value * line[j]
        w += rows * columns
        b += columns
        if layer < last:
            for j in range(columns):
                there[j] = there[j] / (np.float32(1.0) + math.exp(-there[j]))
        else:
            for j in range(columns):
                out[j] = mean[j] + there[j] * scale[j]


def _array(tensor: Tensor) -> np.ndarray:
    """A tensor as an array that shares its memory."""
    return tensor.detach().contiguous().numpy()


def _plays(effect: Hysteresis) -> list[np.ndarray]:
    """Constants of an effect's play operators: lines (m, L) and (m, m, L), and one after another
    with zeros up to whole vectors (P,) the radii, (m, P) the weights and the slopes."""
    weight, slope = effect.weights, effect.slopes
    slope = torch.zeros_like(weight) if slope is None else slope
    origin, more = effect.lines(effect.origin), (0, -weight[0].numel() % LANES)
    radius = nn.functional.pad(effect.radius.repeat(len(origin)), more)
    wide = [nn.functional.pad(t.flatten(1), more) for t in (weight, slope)]
    lines = effect.linear.movedim(0, -1), effect.bent.movedim(0, -1)
    parts = (effect.centre, effect.half_range, effect.use, *lines, origin)
    return [_array(t) for t in (*parts, radius, *wide)]


def _chain_of(prior: ArcChain) -> list[np.ndarray]:
    """Constants of a chain of A arcs: table (A, 3, m + 1), lengths (A,) and offsets (A, 3) in mm,
    and place (3,) in mm and turn (3, 3) of its base, all in the base frame."""
    unit = prior.length_mm.mean()
    parts = (
        prior.table,
        prior.length_mm,
        unit * prior.offset,
        prior.base_mm + unit * prior.base_shift,
        rotation(prior.base_turn),
    )
    return [_array(t) for t in parts]


@compiled
def _add_arcs(x, table, length_mm, offset_mm, base_mm, base_turn, points_mm):
    """Add a chain of arcs to key points (B, n, 3) in mm; see `ArcChain.forward`.

    x: (B, m or more) scaled actuation, in the first m columns; the others are those of `_chain_of`.
    """
    one, half = np.float32(1.0), np.float32(0.5)
    arcs, chambers = table.shape[0], table.shape[2] - 1
    behind = points_mm.shape[1] - arcs
    place, turn, next_turn = np.empty_like(base_mm), np.empty_like(base_turn), base_turn.copy()
    for b in range(len(x)):
        for i in range(3):
            place[i] = base_mm[i]
            if behind:
                points_mm[b, 0, i] += place[i]
            for j in range(3):
                turn[i, j] = base_turn[i, j]
        for a in range(arcs):
            bend_x, bend_y = table[a, 0, chambers], table[a, 1, chambers]
            stretch = table[a, 2, chambers]
            for m in range(chambers):
                bend_x += table[a, 0, m] * x[b, m]
                bend_y += table[a, 1, m] * x[b, m]
                stretch += table[a, 2, m] * x[b, m]
            angle = math.sqrt(bend_x * bend_x + bend_y * bend_y + np.float32(1e-12))
            along = math.sin(angle) / angle
            across = math.sin(half * angle) / (half * angle)
            across *= half * across
            stretch = min(max(stretch, -_MOST_STRETCH), _MOST_STRETCH)
            length = length_mm[a] * math.exp(stretch)
            ahead_x, ahead_y, ahead_z = across * bend_x, across * bend_y, along
            # The rotation about (-y, x, 0), column by column.
            xx, xy = across * bend_x * bend_x, across * bend_x * bend_y
            yy = across * bend_y * bend_y
            for i in range(3):
                u, v, w = turn[i, 0], turn[i, 1], turn[i, 2]
                place[i] += length * (u * ahead_x + v * ahead_y + w * ahead_z)
                next_turn[i, 0] = u * (one - xx) - v * xy - w * along * bend_x
                next_turn[i, 1] = v * (one - yy) - u * xy - w * along * bend_y
                next_turn[i, 2] = along * (u * bend_x + v * bend_y) + w * (one - xx - yy)
            for i in range(3):
                point = place[i]
                for j in range(3):
                    turn[i, j] = next_turn[i, j]
                    point += next_turn[i, j] * offset_mm[a, j]
                points_mm[b, behind + a, i] += point


@compiled
def _direct(pressure, anchor, direction, still, idle, band):
    """Chamber pressure, confirmed pressure and direction of one chamber after a step; see
    `scan.direction_step`.

    Numbers in, numbers out: a compiled call with arrays costs 80 ns, by the counts of references.
    """
    chamber = idle if still else pressure
    moved = min(max(anchor, chamber - band), chamber + band)
    if moved > anchor:
        direction = np.float32(1.0)
    elif moved < anchor:
        direction = np.float32(-1.0)
    return chamber, moved, direction


@compiled
def _advance(
    pressure,
    anchor,
    direction,
    new_anchor,
    new_direction,
    x,
    still,
    idle,
    band,
    centre,
    half_range,
    use,
):
    """Fill directions (B, m) and the network's inputs (B, m or 2 m) for arms without memory."""
    count, chambers = pressure.shape
    for b in range(count):
        for m in range(chambers):
            chamber, new_anchor[b, m], new_direction[b, m] = _direct(
                pressure[b, m], anchor[b, m], direction[b, m], still[m], idle[m], band[m]
            )
            x[b, m] = (chamber - centre[m]) / half_range[m]
            if x.shape[1] > chambers:
                x[b, chambers + m] = new_direction[b, m] * use[m]


@compiled(reorder=True)
def _advance_with_plays(
    pressure,
    anchor,
    direction,
    new_anchor,
    new_direction,
    x,
    still,
    idle,
    band,
    centre,
    half_range,
    use,
    play_centre,
    play_half,
    play_use,
    linear,
    bent,
    origin,
    radius,
    weight,
    slope,
    memory,
    after,
):
    """As `_advance` for arms with hysteresis: memory (B, L, J) to after; see `Hysteresis`.

    The constants are those of `_plays`; all play operators of an arm are one loop.
    """
    count, chambers = pressure.shape
    lines, radii, plays = memory.shape[1], memory.shape[2], memory.shape[1] * memory.shape[2]
    held, moved = memory.reshape(count, plays), after.reshape(count, plays)
    chamber, scaled = np.empty(chambers, np.float32), np.empty(chambers, np.float32)
    load, mixed = np.empty(lines, np.float32), np.empty(lines, np.float32)
    wide, away = np.empty(plays, np.float32), np.empty(plays, np.float32)
    lag, sloped = np.zeros(len(radius), np.float32), np.zeros(len(radius), np.float32)
    for b in range(count):
        for m in range(chambers):
            chamber[m], new_anchor[b, m], new_direction[b, m] = _direct(
                pressure[b, m], anchor[b, m], direction[b, m], still[m], idle[m], band[m]
            )
            scaled[m] = (chamber[m] - play_centre[m]) / play_half[m] * play_use[m]
        load[:] = np.float32(0.0)
        for m in range(chambers):
            for line in range(lines):
                mixed[line] = linear[m, line]
            for other in range(chambers):
                for line in range(lines):
                    mixed[line] += bent[m, other, line] * scaled[other]
            for line in range(lines):
                load[line] += mixed[line] * scaled[m]
        for line in range(lines):
            for j in range(radii):
                wide[line * radii + j] = load[line]
                away[line * radii + j] = load[line] - origin[line]
        for i in range(plays):
            u = wide[i]
            value = min(max(held[b, i], u - radius[i]), u + radius[i])
            moved[b, i] = value
            lag[i] = value - u
            sloped[i] = away[i] * (value - u)
        for m in range(chambers):
            shift = np.float32(0.0)
            for i in range(len(lag)):
                shift += weight[m, i] * lag[i] + slope[m, i] * sloped[i]
            effective = chamber[m] + play_half[m] * shift
            x[b, m] = (effective - centre[m]) / half_range[m]
            if x.shape[1] > chambers:
                x[b, chambers + m] = new_direction[b, m] * use[m]
