"""Arm models for other programs: TorchScript and ONNX with the state as one explicit vector.

A model around a Python callable becomes a file of NumPy code with the same two functions.

    start(pressure) -> state
    step(state, pressure, dt) -> state, key points

in double precision, because a number of 100 mm has steps of 8e-6 mm in single precision. The files
are compared with `ArmModel.predict` over a whole synthetic recording before they are kept, and over
recordings that are given.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from surgisoft.errors import InputError
from surgisoft.files import check_export_folder, new_folder, read_json, write_json
from surgisoft.graphs import (
    Call,
    DoesNotTrace,
    largest_difference,
    write_onnx,
    write_torch_script_of,
)
from surgisoft.surrogate.arm import ArmState
from surgisoft.surrogate.callables.exported import (
    arm_source,
    described,
    opened,
    played,
    run_of,
)
from surgisoft.surrogate.callables.network import CallableNetwork
from surgisoft.surrogate.chain import STOOD_S, Signal, Standing, Stepping
from surgisoft.surrogate.effects import EFFECTS, Context, Effect
from surgisoft.surrogate.effects.user_defined import kind_of
from surgisoft.surrogate.history import History
from surgisoft.surrogate.model import AWAY_SHARE, ArmModel
from surgisoft.units import actuation_word

FORMAT = 1
"""Version of `arm.json`."""
TOLERANCE_MM = 1e-5
"""Largest accepted difference of any coordinate from `ArmModel.predict` over CHECKED rows, mm."""
CHECKED = 100
"""Rows of the synthetic recording on which the files are compared."""
ROOM_C = (15.0, 30.0)
"""Temperatures of the room in that recording, degrees Celsius."""
FILES = ("arm.pt", "arm_start.onnx", "arm_step.onnx", "arm.json")
"""What is written of a model that is a graph."""
CALLABLE_FILES = ("arm.py", "arm.json")
"""What is written of a model around a Python callable."""


@dataclass(frozen=True)
class Part:
    """A tensor of the arm's state and its place in the state vector."""

    name: str
    """`pressure`, `anchor`, `direction`, or `memory.NAME` of an effect or the network."""
    first: int
    """Index of its first number."""
    shape: tuple[int, ...]
    """Shape without the batch."""

    @property
    def last(self) -> int:
        """Index after its last number."""
        return self.first + math.prod(self.shape)


class ArmGraph(nn.Module):
    """An arm model in double precision whose state is one vector.

    `warm` says whether the model depends on the room's temperature, which is then a further input.
    """

    rest_state: Tensor

    def __init__(self, model: ArmModel):
        super().__init__()
        self.model = copy.deepcopy(model).double().eval().requires_grad_(False)
        self.model.freeze()
        with torch.no_grad():
            rest = self.model.initial_state(1)
            self.parts = tuple(_parts(rest))
            self.register_buffer("rest_state", self.packed(rest))
            self.warm = self._depends_on_temperature()

    @property
    def elapsed(self) -> list[int]:
        """Indices of the numbers of the state that are the time since the recording began, s."""
        effects = self.model.effects
        keeps = {f"memory.{name}" for name in effects if effects[name].keeps_time}
        parts = (part for part in self.parts if part.name in keeps)
        return [number for part in parts for number in range(part.first, part.last)]

    @property
    def inputs(self) -> list[str]:
        """Names of the arguments of `step`."""
        return ["state", "pressure", "dt_s", *["temperature_C"] * self.warm]

    def packed(self, state: ArmState) -> Tensor:
        """(B, S): a state as one vector."""
        values = [state.pressure, state.anchor, state.direction, *state.memory.values()]
        return torch.cat([value.flatten(1) for value in values], 1)

    def unpacked(self, state: Tensor) -> ArmState:
        """The state of a vector (B, S)."""
        values = [
            state[:, part.first : part.last].unflatten(1, part.shape)
            if len(part.shape) > 1
            else state[:, part.first : part.last]
            for part in self.parts
        ]
        names = [part.name.removeprefix("memory.") for part in self.parts[3:]]
        pressure, anchor, direction, *memory = values
        return ArmState(pressure, anchor, direction, dict(zip(names, memory, strict=True)))

    def start(self, pressure: Tensor) -> Tensor:
        """(1, S): an arm before its first row at pressure (1, m), see `ArmModel.first_state`."""
        chain, rest = self.model.chain, self.unpacked(self.rest_state)
        mode = Standing(rest)
        signal = chain.walk(Signal(pressure), mode)
        stood = ArmState(pressure, mode.anchor, signal.behind_chambers()[1], mode.memory)
        span = pressure.new_tensor(self.model.spec.span)
        away = ((pressure - rest.pressure).abs() > AWAY_SHARE * span) & ~self.model.still
        away = away.any(-1)
        return self.packed(rest.where(away, stood))

    def step(
        self, state: Tensor, pressure: Tensor, dt_s: Tensor, temperature_C: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """(B, S) state and (B, n, 3) key points in mm after pressure (B, m) was held dt_s (B,)."""
        mode = Stepping(self.unpacked(state), Context(dt_s, None, temperature_C))
        signal = self.model.chain.walk(Signal(pressure), mode)
        after = ArmState(pressure, mode.anchor, signal.behind_chambers()[1], mode.memory)
        return self.packed(after), signal.value

    def forward(
        self, state: Tensor, pressure: Tensor, dt_s: Tensor, temperature_C: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Call `step`, as torch modules do."""
        return self.step(state, pressure, dt_s, temperature_C)

    def example(self, batch: int = 2) -> list[Tensor]:
        """Arguments of `step` for arms at rest."""
        state = self.rest_state.repeat(batch, 1)
        given = [state, self.unpacked(state).pressure.clone(), state.new_full((batch,), 0.05)]
        return [*given, *[state.new_full((batch,), 22.0)] * self.warm]

    def _depends_on_temperature(self) -> bool:
        """Whether key points differ between two temperatures."""
        self.warm = False
        high = torch.tensor(self.model.spec.high, dtype=torch.float64)[None]
        dt_s = high.new_full((1,), 0.5)
        found = [
            self.step(self.rest_state, high, dt_s, high.new_full((1,), at))[1] for at in ROOM_C
        ]
        return not torch.equal(*found)


class _Start(nn.Module):
    """`ArmGraph.start` as a module of its own, for ONNX."""

    def __init__(self, graph: ArmGraph):
        super().__init__()
        self.arm = graph

    def forward(self, pressure: Tensor) -> Tensor:
        """Call `start`."""
        return self.arm.start(pressure)


def export_arm(
    model: ArmModel,
    folder: str | Path,
    recordings: Mapping[str, History] | None = None,
    force: bool = False,
) -> list[Path]:
    """Write an arm model for other programs; returns the files.

    A model around a Python callable becomes NumPy code that calls it (`arm.py`), any other one
    TorchScript and ONNX. recordings: by their names; the files are also compared with the model
    over every row of each, and `arm.json` has the largest difference of a coordinate in mm under
    `recordings`. Raises InputError where the folder is in use, where an effect of the model cannot
    be written, and where a difference is larger than `TOLERANCE_MM`. force: replace an earlier
    export of an arm model.
    """
    folder = Path(folder)
    check_export_folder(folder, "arm.json", force)
    try:
        graph = ArmGraph(model)
        for name, effect in graph.model.effects.items():
            if kind_of(name) not in EFFECTS:
                _check_effect(name, effect, graph)
        called = isinstance(graph.model.network, CallableNetwork)
        write, files = (_write_code, CALLABLE_FILES) if called else (_write, FILES)
        with new_folder(folder, [*FILES, *CALLABLE_FILES]) as fresh:
            worst, over = write(graph, fresh, recordings or {})
            about = describe_arm(graph, worst)
            write_json(fresh / "arm.json", about | ({"recordings": over} if over else {}))
    except DoesNotTrace as error:
        raise InputError(f"{folder}: the arm model cannot be exported: {error}") from error
    return [folder / name for name in files]


def differences(folder: str | Path) -> dict[str, dict[str, float]]:
    """`rows` and `largest_difference_mm` of each recording that an export was compared on."""
    return read_json(Path(folder) / "arm.json").get("recordings", {})


def describe_arm(graph: ArmGraph, worst_mm: float) -> dict[str, Any]:
    """Contents of `arm.json`: names, shapes, units and ranges of all inputs and outputs.

    worst_mm: the largest difference from `ArmModel.predict` that was found, mm.
    """
    spec = graph.model.spec
    size = graph.rest_state.shape[1]
    actuation = {
        "shape": ["B", spec.chambers],
        "unit": spec.unit,
        "low": list(spec.low),
        "high": list(spec.high),
        "meaning": f"{spec.actuation} actuation of each chamber",
    }
    tensors: dict[str, dict[str, Any]] = {
        "state": {"shape": ["B", size], "meaning": "memory of the arm, see `state`"},
        "pressure": actuation,
        "dt_s": {
            "shape": ["B"],
            "unit": "s",
            "meaning": "time since the row before; 0 in the first row of a run",
        },
        "next_state": {"shape": ["B", size], "meaning": "the state for the next row"},
        "key_points_mm": {
            "shape": ["B", spec.key_points, 3],
            "unit": "mm",
            "meaning": "key points from the base to the tip, frame of the arm's base",
        },
    }
    if graph.warm:
        tensors["temperature_C"] = {
            "shape": ["B"],
            "unit": "degrees Celsius",
            "meaning": "temperature of the room; NaN where it is not known",
        }
    parts = [
        {"name": part.name, "first": part.first, "last": part.last, "shape": list(part.shape)}
        for part in graph.parts
    ]
    start: dict[str, Any] = {"inputs": ["pressure"], "outputs": ["state"]}
    step: dict[str, Any] = {"inputs": graph.inputs, "outputs": ["next_state", "key_points_mm"]}
    network = graph.model.network
    if isinstance(network, CallableNetwork):
        files = {"python": "arm.py", "model_code": described(network)}
        if network.runs_only:
            growing = "; behind it the times (s) and the effective actuation of the rows so far"
            tensors["state"]["meaning"] += growing
            tensors["next_state"]["meaning"] += growing
    else:
        files = {"torchscript": "arm.pt"}
        start, step = {"onnx": "arm_start.onnx", **start}, {"onnx": "arm_step.onnx", **step}
    return {
        "format": FORMAT,
        "model": graph.model.summary(),
        "effects": list(graph.model.effects),
        "dtype": "float64",
        **files,
        "start": start,
        "step": step,
        "start_meaning": f"{actuation_word(spec.unit)} (1, m) at which a run begins; an arm that "
        f"begins away from rest by more than {AWAY_SHARE:.0%} of a range is assumed to have been "
        f"held there for {STOOD_S:g} s, any other one to be at rest without a past",
        "recording_columns": [
            f"{'c' if spec.actuation == 'commanded' else 'p'}{number}_{spec.unit}"
            for number in range(1, spec.chambers + 1)
        ],
        "tensors": tensors,
        "rest": {"pressure": list(spec.rest), "state": graph.rest_state[0].tolist()},
        "state": {"size": size, "parts": parts, "elapsed": graph.elapsed},
        "elapsed_meaning": "numbers of the state that are the time since the recording began, s: "
        "set them where a run begins later",
        "largest_difference_mm": worst_mm,
    }


def _write(
    graph: ArmGraph, folder: Path, recordings: Mapping[str, History]
) -> tuple[float, dict[str, dict[str, float]]]:
    """Write the graphs, each compared with the model.

    Returns the largest difference in mm, and that over each recording with its rows.
    """
    rest = graph.unpacked(graph.rest_state).pressure.clone()
    methods = {"start": (rest,), "step": tuple(graph.example())}
    script = write_torch_script_of(graph, methods, folder / "arm.pt")
    stepped = write_onnx(
        graph,
        graph.example(),
        folder / "arm_step.onnx",
        graph.inputs,
        ["next_state", "key_points_mm"],
    )
    started = write_onnx(
        _Start(graph), [rest], folder / "arm_start.onnx", ["pressure"], ["state"], batched=False
    )
    files = (
        (script["start"], script["step"], "arm.pt"),
        (started, stepped, "arm_step.onnx"),
    )

    def gap_of(history: History) -> float:
        worst = 0.0
        for run in _runs(history):
            with torch.no_grad():
                expected = graph.model.predict(run)[0]
            for start, step, name in files:
                gap = float((_played(graph, run, start, step) - expected).abs().max())
                if not gap <= TOLERANCE_MM:
                    raise DoesNotTrace(
                        f"{name} differs by {gap:.2g} mm from the model; an effect or network that "
                        "branches on values cannot be exported"
                    )
                worst = max(worst, gap)
        return worst

    return _over(graph, recordings, gap_of)


def _over(
    graph: ArmGraph, recordings: Mapping[str, History], gap_of: Callable[[History], float]
) -> tuple[float, dict[str, dict[str, float]]]:
    """What `_write` returns, from the largest difference over a history in mm."""
    over = {
        name: {"rows": int(history.valid.sum()), "largest_difference_mm": gap_of(history)}
        for name, history in recordings.items()
    }
    return gap_of(_recording(graph)), over


def _write_code(
    graph: ArmGraph, folder: Path, recordings: Mapping[str, History]
) -> tuple[float, dict[str, dict[str, float]]]:
    """Write `arm.py`, compared with the model; returns what `_write` does."""
    network = cast(CallableNetwork, graph.model.network)
    file = folder / "arm.py"
    about = describe_arm(graph, 0.0)
    del about["largest_difference_mm"]  # `arm.json` has it, after the comparison
    file.write_text(arm_source(graph, _Start(graph), about), encoding="utf-8")
    arm = opened(file)["Arm"](network.named.model)

    def gap_of(history: History) -> float:
        worst = 0.0
        for run in _runs(history):
            with torch.no_grad():
                expected = graph.model.predict(run)[0].numpy()
            stood = run.stood
            first = None if stood is None or bool(stood.isnan().any()) else stood[0].numpy()
            began_s = float(run.t_s[0, 0])
            found = played(arm, network.name, first, run_of(run), began_s)
            gap = float(np.abs(found - expected).max())
            if not gap <= TOLERANCE_MM:
                later = "; key points of a run may not depend on its later rows" * network.runs_only
                raise DoesNotTrace(
                    f"arm.py differs by {gap:.2g} mm from the model; an effect that branches on "
                    f"values cannot be exported{later}"
                )
            worst = max(worst, gap)
        return worst

    return _over(graph, recordings, gap_of)


def _runs(history: History) -> Iterator[History]:
    """Each run by itself without padding, actuation and temperatures in double precision."""
    warm, stood = history.temperature_C, history.stood
    for run, count in enumerate(history.valid.sum(1).tolist()):
        own = (slice(run, run + 1), slice(0, count))
        yield replace(
            history,
            t_s=history.t_s[own],
            pressure=history.pressure[own].double(),
            key_points=history.key_points[own],
            valid=history.valid[own],
            temperature_C=None if warm is None else warm[own].double(),
            stood=None if stood is None else stood[run : run + 1].double(),
            predicted=None,
        )


def _played(graph: ArmGraph, history: History, start: Call, step: Call) -> Tensor:
    """(T, n, 3) mm: a recording of one run stepped through the functions of a file."""
    stood = history.stood
    if stood is None or bool(stood.isnan().any()):
        state = graph.rest_state
    else:
        (state,) = start(stood)
    state = torch.as_tensor(state).clone()
    state[:, graph.elapsed] = history.t_s[:, :1].double()
    dt_s, points = history.dt_s.double(), []
    warm = history.temperature_C
    for row in range(history.pressure.shape[1]):
        now = torch.full((1,), torch.nan).double() if warm is None else warm[:, row]
        warmth = [now] * graph.warm
        state, found = step(state, history.pressure[:, row], dt_s[:, row], *warmth)
        points.append(found[0])
    return torch.stack(points)


def _recording(graph: ArmGraph) -> History:
    """A synthetic recording of one run: ramps, holds and jumps over the range, uneven times.

    It begins away from rest, so that `start` is tried too.
    """
    random, spec = torch.Generator().manual_seed(0), graph.model.spec
    low, high = (torch.tensor(end, dtype=torch.float64) for end in (spec.low, spec.high))
    shares = [torch.rand(spec.chambers, generator=random, dtype=torch.float64)]
    while len(shares) < CHECKED:
        goal = torch.rand(spec.chambers, generator=random, dtype=torch.float64)
        rows = int(torch.randint(1, 25, (), generator=random))
        first = shares[-1]
        shares += [first + (goal - first) * (k + 1) / rows for k in range(rows)]
        shares += [goal] * int(torch.randint(0, 10, (), generator=random))
    pressure = low + (high - low) * torch.stack(shares[:CHECKED])
    # Times of whole 1 / 64 s, exact in single precision, in which `History.dt_s` is.
    steps = torch.randint(1, 9, (CHECKED,), generator=random).double() / 64.0
    steps[0] = 0.0
    warm = ROOM_C[0] + (ROOM_C[1] - ROOM_C[0]) * torch.rand(CHECKED, generator=random)
    return History(
        t_s=steps.cumsum(0)[None],
        pressure=pressure[None],
        key_points=torch.full((1, CHECKED, spec.key_points, 3), torch.nan, dtype=torch.float64),
        valid=torch.ones(1, CHECKED, dtype=torch.bool),
        temperature_C=warm.double()[None],
        stood=pressure[:1],
    )


class _Alone(nn.Module):
    """One step of one effect."""

    def __init__(self, effect: Effect):
        super().__init__()
        self.effect = effect

    def forward(self, memory: Tensor, signal: Tensor, dt_s: Tensor, pressure: Tensor):
        """Memory and signal behind the effect."""
        return self.effect.step(memory, signal, Context(dt_s, None, None, pressure))


def _check_effect(name: str, effect: Effect, graph: ArmGraph) -> None:
    """Raise DoesNotTrace, naming the effect, unless its traced step equals its step."""
    random, spec = torch.Generator().manual_seed(1), graph.model.spec
    low, high = (torch.tensor(end, dtype=torch.float64) for end in (spec.low, spec.high))
    body = effect.stage in ("body", "sensor")

    def signals() -> Iterator[list[Tensor]]:
        memory = None
        for share in torch.rand(60, 1, spec.chambers, generator=random, dtype=torch.float64):
            pressure = low + (high - low) * share
            moved = 5.0 * torch.randn(1, spec.key_points, 3, generator=random).double()
            signal = graph.model.rest_mm + moved if body else pressure
            memory = effect.rest(signal) if memory is None else memory
            yield [memory, signal, signal.new_full((1,), 0.1), pressure]

    reason = (
        f"effect '{name}' does not trace; write its `advance` and `apply` with operations of "
        "PyTorch, torch.where in place of an if on values"
    )
    alone = _Alone(effect)
    try:
        with torch.no_grad():
            traced = torch.jit.trace(alone, tuple(next(signals())), check_trace=False)
            gap = largest_difference(alone, traced, signals(), states=1)
    except Exception as error:
        raise DoesNotTrace(f"{reason} ({type(error).__name__})") from error
    if not gap <= TOLERANCE_MM:
        raise DoesNotTrace(reason)


def _parts(state: ArmState) -> Iterator[Part]:
    """The parts of a state, in the order of the state vector."""
    own = {"pressure": state.pressure, "anchor": state.anchor, "direction": state.direction}
    first = 0
    for name, value in {**own, **{f"memory.{k}": v for k, v in state.memory.items()}}.items():
        part = Part(name, first, tuple(value.shape[1:]))
        yield part
        first = part.last
