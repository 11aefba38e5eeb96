"""A callable model in the place of the network of an arm model.

The callable is plain NumPy and is never changed. Its derivatives are central differences of its own
input, of `DIFFERENCE` of each chamber's range. In PyTorch's graph the key points are linear in the
actuation around its value, so that first derivatives pass, in reverse and batched.
"""

import hashlib
import time
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from surgisoft.errors import AssumptionWarning, InputError, raised_by
from surgisoft.surrogate.callables import operators
from surgisoft.surrogate.callables.named import (
    Named,
    as_numbers,
    checked_points,
    no_graph,
    read_attribute,
    stored_callable,
)
from surgisoft.surrogate.history import History

DIFFERENCE = 5e-3
"""Half width of a central difference, as a share of a chamber's range: the error of a smooth
model's slope is of the order of its square, and a solver that is right to 1e-3 mm is off by 0.1 mm
in the motion over the whole range."""
CACHED = 64
"""Runs whose key points are cached, for callables of whole runs (a count)."""
SLOW_S = 2.0
"""Duration of one evaluation, s, from which a diagnosis takes minutes."""
EVALUATIONS = 140
"""Evaluations of a callable in a diagnosis or a comparison, of all rows or of some of them: counted
for static callables and those of whole runs, with six chambers."""

Form = Literal["static", "steps", "runs"]
"""Kinds of callables: a function of the row's actuation alone; one that can be stepped; one of
whole runs."""


def form_of(named: Named) -> Form:
    """The kind of a callable model, by its attributes: the methods of steps come first."""
    given = (named.name, named.model)
    if all(callable(read_attribute(*given, part)) for part in ("initial_state", "step")):
        return "steps"
    return "static" if bool(read_attribute(*given, "static")) else "runs"


class CallableNetwork(nn.Module):
    """Key points from a named callable model; see docs/your_model.md for what it has to offer."""

    directions = False

    def __init__(
        self,
        low: Tensor,
        high: Tensor,
        key_points: int,
        name: str,
        sha256: str | None = None,
        named: Named | None = None,
    ):
        """Range of the actuation low, high (m,) in the arm's unit; `key_points` is n.

        named: the callable; None: the one that the user has named before, or that an installed
        package offers. sha256: hash of its file.
        """
        super().__init__()
        self.named = named or stored_callable(name, sha256, name)
        self.key_points, self.name, self.sha256 = key_points, self.named.name, self.named.sha256
        self.form: Form = form_of(self.named)
        self.step_size = DIFFERENCE * (high - low).where(high > low, torch.ones_like(low))
        self.cached: OrderedDict[bytes, np.ndarray] = OrderedDict()
        self._states: int | None = None
        self.warns_if_slow = False
        self._slow: list[float] = []

    def __deepcopy__(self, memo: dict) -> "CallableNetwork":
        """A network of its own with the same callable, which is never changed."""
        fresh = type(self).__new__(type(self))
        nn.Module.__init__(fresh)
        shared = ("named", "cached", "_slow")
        for key, value in vars(self).items():
            if key not in vars(fresh) or key == "training":
                fresh.__dict__[key] = value if key in shared else deepcopy(value, memo)
        return fresh

    @property
    def remembers(self) -> bool:
        """Whether the network has a state that is stepped."""
        return self.form == "steps"

    @property
    def whole_runs(self) -> bool:
        """Whether key points depend on more than the row's own actuation."""
        return self.form != "static"

    @property
    def runs_only(self) -> bool:
        """Whether the callable cannot be stepped."""
        return self.form == "runs"

    # One row ------------------------------------------------------------------------------

    def forward(self, pressure: Tensor, direction: Tensor, memory: Tensor | None = None) -> Tensor:
        """Key points (..., n, 3) in mm, base frame, from pressure (..., m).

        memory: (..., k + 3 n) of a callable that is stepped; None: held at the pressure for a long
        time. One of whole runs takes each row as a run of its own, of one row.
        """
        if self.form != "static" and memory is not None:
            points = memory[..., memory.shape[-1] - 3 * self.key_points :]
            return points.unflatten(-1, (self.key_points, 3)).to(pressure.dtype)
        if operators.operated():
            place = operators.number_of(self)
            rows = pressure.double().reshape(-1, pressure.shape[-1])
            points = torch.ops.surgisoft.callable_points(rows, place, self.key_points)
            return points.reshape(*pressure.shape[:-1], self.key_points, 3).to(pressure.dtype)
        return self._differentiable(self.points_of_rows, pressure)

    def points_of_rows(self, actuation: np.ndarray) -> np.ndarray:
        """(S, n, 3) key points in mm of rows (S, m), each held for a long time or a run of its own.

        A callable that is stepped is never called itself: it need not be callable.
        """
        with self._evaluation(len(actuation)):
            if self.form == "steps":
                state, still = self.state_of(actuation), np.zeros(len(actuation))
                return self.step_of(state, actuation, still)[1]
            return self._static(actuation) if self.form == "static" else self._alone(actuation)

    def rest(self, pressure: Tensor) -> Tensor:
        """(B, k + 3 n) memory of arms that begin at pressure (B, m): state, then key points."""
        if operators.operated():
            place, size = operators.number_of(self), self.states
            state = torch.ops.surgisoft.callable_state(pressure.double(), place, size)
            return self._operated(state, pressure, pressure.new_zeros(len(pressure)))
        actuation = _numbers(pressure)
        return self._stepped(self.state_of(actuation), pressure, np.zeros(len(actuation)))

    @property
    def states(self) -> int:
        """k, how many numbers the state of a callable has that is stepped."""
        if self._states is None:
            self.state_of(np.zeros((1, len(self.step_size))))
        assert self._states is not None
        return self._states

    def state_of(self, actuation: np.ndarray) -> np.ndarray:
        """(B, k) state of a callable that was held at actuation (B, m)."""
        state = self._state(self._call("initial_state", actuation), len(actuation), None)
        self._states = state.shape[1]
        return state

    def advance(self, memory: Tensor, pressure: Tensor, direction: Tensor, dt_s: Tensor) -> Tensor:
        """(B, k + 3 n) memory after pressure (B, m) was held for dt_s (B,) seconds."""
        states = memory.shape[1] - 3 * self.key_points
        if operators.operated():
            return self._operated(memory[:, :states], pressure, dt_s)
        return self._stepped(_numbers(memory[:, :states]), pressure, _numbers(dt_s))

    def _operated(self, state: Tensor, pressure: Tensor, dt_s: Tensor) -> Tensor:
        """(B, k + 3 n) state and key points after a step that stays a call in a traced program."""
        place = operators.number_of(self)
        given = (state.double(), pressure.double(), dt_s.double())
        fresh, points = torch.ops.surgisoft.callable_step(*given, place, self.key_points)
        return torch.cat([fresh, points.flatten(1)], 1)

    def _stepped(self, before: np.ndarray, pressure: Tensor, dt_s: np.ndarray) -> Tensor:
        """(B, k + 3 n) state and key points after a step from states (B, k)."""

        def evaluate(actuation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            copies = len(actuation) // len(before)
            return self.step_of(np.tile(before, (copies, 1)), actuation, np.tile(dt_s, copies))

        state, known = evaluate(_numbers(pressure))
        points = self._differentiable(lambda moved: evaluate(moved)[1], pressure, known)
        fresh = torch.from_numpy(state).to(pressure.device)
        return torch.cat([fresh, points.flatten(1).to(fresh.dtype)], 1)

    # Whole runs ---------------------------------------------------------------------------

    def along(self, actuation: Tensor, history: History, memory: Tensor | None) -> Tensor:
        """Key points (R, T, n, 3) in mm along effective actuation (R, T, m) of a history's runs.

        memory: (R, k + 3 n) before the first row, of a callable that is stepped.
        """
        with self._evaluation(int(history.valid.sum())):
            if self.form == "runs":
                points = self._runs(_numbers(actuation), history)
                return torch.from_numpy(points).to(actuation)
            if memory is None:
                memory = self.rest(actuation[:, 0])
            state = _numbers(memory[:, : memory.shape[1] - 3 * self.key_points])
            moved, dt_s = _numbers(actuation), _numbers(history.dt_s)
            points = np.empty((*moved.shape[:2], self.key_points, 3))
            for row in range(moved.shape[1]):
                state, points[:, row] = self.step_of(state, moved[:, row], dt_s[:, row])
            return torch.from_numpy(points).to(actuation)

    def slope_along(
        self, actuation: Tensor, history: History, memory: Tensor | None, rows: Callable
    ) -> Tensor:
        """(S, n, 3, m) derivative of key points by a constant offset of each chamber, mm a unit.

        The offset holds for the whole run, so the callable's own memory follows it. rows: picks the
        rows (S, ...) of a (R, T, ...) tensor.
        """
        slopes = []
        for chamber, size in enumerate(self.step_size.tolist()):
            ends = []
            for sign in (1.0, -1.0):
                moved = actuation.double().clone()
                moved[..., chamber] += sign * size
                ends.append(rows(self.along(moved, history, memory)))
            slopes.append((ends[0] - ends[1]) / (2.0 * size))
        return torch.stack(slopes, -1).to(actuation.dtype)

    def no_graph(self) -> InputError:
        """The InputError for an export: what the callable computes is not in PyTorch's graph."""
        return no_graph(self.name)

    # The callable -------------------------------------------------------------------------

    @contextmanager
    def _evaluation(self, rows: int) -> Iterator[None]:
        """Warn once, with an `AssumptionWarning`, where an evaluation of `rows` rows is slow.

        A diagnosis of a slow callable goes on for minutes or hours, and looks as if it hung. Only
        where `warns_if_slow`: environments evaluate a callable for as long as the user trains.
        """
        begin = time.perf_counter()
        yield
        seconds = time.perf_counter() - begin
        if not self.warns_if_slow or self._slow or seconds < SLOW_S:
            return
        self._slow.append(seconds)
        warnings.warn(
            f"{self.name} took {seconds:.1f} s for {rows} rows, and a diagnosis or a comparison "
            f"evaluates it about {EVALUATIONS} times, which may take "
            f"{seconds * EVALUATIONS / 60:.0f} min; if that is too long, give its predictions as a "
            "file (docs/your_model.md), or a part of the recording ('surgisoft recording REC "
            "--from S --until S -o PART')",
            AssumptionWarning,
            stacklevel=2,
        )

    def _differentiable(
        self,
        evaluate: Callable[[np.ndarray], np.ndarray],
        actuation: Tensor,
        known: np.ndarray | None = None,
    ) -> Tensor:
        """Key points (..., n, 3) of evaluate: (S, m) -> (S, n, 3), with first derivatives."""
        flat = _numbers(actuation).reshape(-1, actuation.shape[-1])
        points = evaluate(flat) if known is None else known
        shape = (*actuation.shape[:-1], self.key_points, 3)
        value = torch.from_numpy(points).to(actuation).view(shape)
        if not (torch.is_grad_enabled() and actuation.requires_grad):
            return value
        step = self.step_size.double().numpy()
        shifts = np.concatenate([np.diag(step), -np.diag(step)])
        ends = evaluate((flat + shifts[:, None]).reshape(-1, flat.shape[1]))
        up, down = ends.reshape(2, len(step), *points.shape)
        slope = torch.from_numpy(np.moveaxis(up - down, 0, -1) / (2.0 * step)).to(actuation)
        away = actuation - actuation.detach()
        return value + torch.einsum("...njm,...m->...nj", slope.view(*shape, len(step)), away)

    def step_of(
        self, state: np.ndarray, actuation: np.ndarray, dt_s: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """State (B, k) and key points (B, n, 3) after actuation (B, m) was held for dt_s (B,)."""
        result = self._call("step", state, actuation, dt_s)
        if not (isinstance(result, tuple | list) and len(result) == 2):
            came = type(result).__name__
            raise InputError(f"{self.name}: step returned {came}, expected (state, key points)")
        fresh = self._state(result[0], len(actuation), state.shape[1])
        shape = ((len(actuation),), actuation.shape[1], self.key_points)
        return fresh, checked_points(self.name, result[1], *shape)

    def _static(self, actuation: np.ndarray) -> np.ndarray:
        """(S, n, 3) key points of rows (S, m) of a static callable."""
        return self._points(np.zeros(len(actuation)), actuation)

    def _alone(self, actuation: np.ndarray) -> np.ndarray:
        """(S, n, 3) key points of rows (S, m), each a run of its own."""
        return np.concatenate([self._points(np.zeros(1), row[None]) for row in actuation])

    def _runs(self, actuation: np.ndarray, history: History) -> np.ndarray:
        """(R, T, n, 3) key points of a callable of whole runs; 0 in the padding."""
        answer = np.zeros((*actuation.shape[:2], self.key_points, 3))
        for run, length in enumerate(history.valid.sum(1).tolist()):
            time = history.t_s[run, :length].cpu().numpy()
            key = _digest(time, actuation[run, :length])
            if key not in self.cached:
                self.cached[key] = self._points(time, actuation[run, :length])
                if len(self.cached) > CACHED:
                    self.cached.popitem(last=False)
            self.cached.move_to_end(key)
            answer[run, :length] = self.cached[key]
        return answer

    def _points(self, time_s: np.ndarray, actuation: np.ndarray) -> np.ndarray:
        points = self._call("__call__", time_s, actuation)
        rows = (len(actuation),)
        return checked_points(self.name, points, rows, actuation.shape[1], self.key_points)

    def _call(self, part: str, *arguments: np.ndarray) -> Any:
        """Call a method of the callable; whatever it raises becomes an InputError.

        It gets copies, which it may change.
        """
        if torch.jit.is_tracing() or torch.compiler.is_compiling():
            raise self.no_graph()
        model = self.named.model
        method = model if part == "__call__" else getattr(model, part)
        try:
            return method(*(each.copy() for each in arguments))
        except InputError:
            raise
        except (Exception, SystemExit) as error:
            raise raised_by(self.name, error) from error

    def _state(self, state: Any, batch: int, width: int | None) -> np.ndarray:
        """A state (B, k) that the callable returned, or InputError."""
        try:
            values = as_numbers(state)
        except (TypeError, ValueError, RuntimeError):
            raise InputError(
                f"{self.name}: its state is a {type(state).__name__}, expected an array (B, k)"
            ) from None
        fits = values.ndim == 2 and len(values) == batch and width in (None, values.shape[1])
        if not fits or not np.isfinite(values).all():
            came = f"shape {values.shape}" if not fits else "values that are not finite"
            expected = f"({batch}, {'k' if width is None else width})"
            raise InputError(f"{self.name}: its state has {came}, expected finite {expected}")
        return values


def _numbers(tensor: Tensor) -> np.ndarray:
    """A tensor as float64 numbers."""
    return tensor.detach().cpu().double().numpy()


def _digest(*arrays: np.ndarray) -> bytes:
    digest = hashlib.sha1(usedforsecurity=False)
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.digest()
