"""Histories: actuation and key points over time, as tensors to fit and validate models."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from surgisoft.errors import InputError

ALIKE = 0.5
"""Least length of a run, as a share of the longest one of its group."""


@dataclass(frozen=True)
class History:
    """Measured runs of equal (padded) length. Rows with `valid` false are padding."""

    t_s: Tensor
    """(R, T) float64, seconds since the start of each run's recording."""
    pressure: Tensor
    """(R, T, m) float32, actuation in the arm's unit; padding repeats the last row."""
    key_points: Tensor
    """(R, T, n, 3) float32, mm, base frame; NaN where missing and in the padding."""
    valid: Tensor
    """(R, T) bool: the row was measured, and is no padding."""
    noise: tuple[float, ...] | None = None
    """Standard deviation of the measured actuation at rest, one a chamber, if known."""
    temperature_C: Tensor | None = None
    """(R, T) float32 temperature of the room, degrees Celsius; NaN where missing."""
    stood: Tensor | None = None
    """(R, m) float32 measured actuation at the begin of each run's recording, in the arm's unit;
    NaN, or None for all, where runs begin at rest."""
    noise_mm: float | None = None
    """Standard deviation of one coordinate of the key points, mm, where it is known."""
    predicted: Tensor | None = None
    """(R, T, n, 3) float32 key points that the model in question predicts, mm, base frame, where
    they come from a file; None where the model itself computes them."""

    @property
    def runs(self) -> int:
        """Number of runs."""
        return self.pressure.shape[0]

    @property
    def chambers(self) -> int:
        """Number m of chambers."""
        return self.pressure.shape[2]

    @property
    def dt_s(self) -> Tensor:
        """(R, T) float32, time since the row before, s; 0 in the first row and in the padding."""
        dt = torch.zeros_like(self.t_s)
        dt[:, 1:] = self.t_s[:, 1:] - self.t_s[:, :-1]
        return torch.where(self.valid, dt, torch.zeros_like(dt)).float()

    @cached_property
    def seen(self) -> Tensor:
        """(R, T) bool: at least one key point was measured in the row, padding included."""
        return (~self.key_points.isnan()).all(-1).any(-1)

    @cached_property
    def groups(self) -> list[tuple[Tensor, int]]:
        """Indices (k,) of runs of similar length, and the number of rows of the longest of them.

        All runs, longest first. Without the padding behind the longest run of its group, a history
        has at most 1 / ALIKE times as many rows as were measured.
        """
        count = self.valid.shape[1]
        ends = (self.valid * torch.arange(1, count + 1, device=self.valid.device)).amax(1)
        order = ends.argsort(descending=True, stable=True)
        found: list[tuple[Tensor, int]] = []
        lengths, first = ends[order].tolist(), 0
        while first < len(lengths):
            longest = max(lengths[first], 1)
            last = first + sum(1 for length in lengths[first:] if length >= ALIKE * longest)
            last = max(last, first + 1)
            found.append((order[first:last], longest))
            first = last
        return found

    def rows(self, tensor: Tensor) -> Tensor:
        """The rows of a (R, T, ...) tensor that are no padding, (S, ...), run by run."""
        return tensor[self.valid]

    @property
    def run_of_row(self) -> Tensor:
        """(S,) index of the run of each row that is no padding."""
        index = torch.arange(self.runs, device=self.valid.device)[:, None].expand_as(self.valid)
        return index[self.valid]

    def select(self, runs: Tensor) -> "History":
        """A history of the given runs, (k,) indices."""
        length = int(self.valid[runs].sum(1).max())
        return History(
            self.t_s[runs, :length],
            self.pressure[runs, :length],
            self.key_points[runs, :length],
            self.valid[runs, :length],
            self.noise,
            None if self.temperature_C is None else self.temperature_C[runs, :length],
            None if self.stood is None else self.stood[runs],
            self.noise_mm,
            None if self.predicted is None else self.predicted[runs, :length],
        )

    def to(self, device: str | torch.device) -> "History":
        """Copy of the history on another device."""
        return History(
            self.t_s.to(device),
            self.pressure.to(device),
            self.key_points.to(device),
            self.valid.to(device),
            self.noise,
            None if self.temperature_C is None else self.temperature_C.to(device),
            None if self.stood is None else self.stood.to(device),
            self.noise_mm,
            None if self.predicted is None else self.predicted.to(device),
        )


def pack(
    t_s: list[Tensor],
    pressure: list[Tensor],
    key_points: list[Tensor],
    noise: tuple[float, ...] | None = None,
    temperature_C: list[Tensor] | None = None,
    stood: list[Tensor] | None = None,
    predicted: list[Tensor] | None = None,
) -> History:
    """Runs of any lengths as one padded history.

    Shapes a run: t_s (T,), pressure (T, m), key_points and predicted (T, n, 3) in mm,
    temperature_C (T,), stood (m,).
    """
    if not pressure:
        raise InputError("no run: expected at least one with one row; check the recordings")
    length = max(len(run) for run in pressure)

    def stack(runs: list[Tensor], dtype, fill: float | None) -> Tensor:
        out = []
        for run in runs:
            run = run.to(dtype)
            rest = length - len(run)
            tail = run[-1:].expand(rest, *run.shape[1:])
            if fill is not None:
                tail = torch.full_like(tail, fill)
            out.append(torch.cat([run, tail]))
        return torch.stack(out)

    return History(
        t_s=stack(t_s, torch.float64, None),
        pressure=stack(pressure, torch.float32, None),
        key_points=stack(key_points, torch.float32, float("nan")),
        valid=stack([torch.ones(len(run), dtype=torch.bool) for run in pressure], torch.bool, 0),
        noise=noise,
        temperature_C=None if temperature_C is None else stack(temperature_C, torch.float32, None),
        stood=None if stood is None else torch.stack(stood).float(),
        predicted=None if predicted is None else stack(predicted, torch.float32, None),
    )
