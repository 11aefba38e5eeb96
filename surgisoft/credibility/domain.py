"""Applicability: which states of a scenario lie inside the domain that recordings have validated.

A state has pressures, their rates, a pose (the key points) and a load. It is inside where some
measured row has about the same pressures, some measured row about the same pose, and rates and load
lie within what was measured. Distances, not a convex hull: a hull would fill gaps in which nothing
was ever measured.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from surgisoft.measurement.histories import actuation_of
from surgisoft.measurement.recordings import Recording

NEAR = 0.1
"""Largest difference of a pressure from a measured row, as a share of the channel's range: the one
up to which two rows count as the same motion in an identification."""
NEAR_POSE = 0.05
"""Largest distance of a key point from where it was in a measured row, as a share of the arm's
length."""
RATE_ROOM = 0.05
"""How far a rate may exceed the fastest measured one, as a share of it."""
LOAD_ROOM_G = 0.5
"""How far a load may lie outside the measured ones, g: what a balance of a bench resolves."""
MOST_ROWS = 20_000
"""Most rows that are compared; more are thinned evenly."""
RATE_S = 0.5
"""Time over which a rate is taken, s: shorter differences are noise of the sensors."""


@dataclass(frozen=True, eq=False)
class States:
    """States of one arm, S rows."""

    label: str
    """Where they come from."""
    pressure: np.ndarray
    """(S, m) actuation, in the arm's unit."""
    rate: np.ndarray
    """(S, m) change of the actuation over RATE_S, per second; NaN where it is not known."""
    points_mm: np.ndarray | None
    """(S, n, 3) key points, base frame, mm; NaN where missing, None where not known."""
    load_g: np.ndarray | None
    """(S,) mass attached, g; NaN or None where not known."""


@dataclass(frozen=True, eq=False)
class Applicability:
    """Shares (0..1) of a scenario's states inside the validated domain."""

    labels: tuple[str, ...]
    """Where the states come from."""
    count: int
    """Number of states that were compared."""
    pressures: float
    """Share with validated pressures."""
    rates: float | None
    """Share with validated rates; None where they are not known."""
    poses: float | None
    """Share with a validated pose; None where it is not known."""
    loads: float | None
    """Share with a validated load; None where it is not known."""
    whole: float
    """Share inside in all that is known."""
    validated: States
    """States of the recordings, for the drawing."""
    states: States
    """States of the scenario, for the drawing."""
    inside: np.ndarray
    """(S,) bool: inside in all that is known."""

    @property
    def sentence(self) -> str:
        """The shares in words."""
        parts = {
            "pressures": self.pressures,
            "rates": self.rates,
            "poses": self.poses,
            "loads": self.loads,
        }
        known = [f"{name} {percent(value)}" for name, value in parts.items() if value is not None]
        unknown = [name for name, value in parts.items() if value is None]
        text = (
            f"{percent(self.whole)} of {self.count} states lie inside the validated domain "
            f"({', '.join(known)})"
        )
        return f"{text}; {' and '.join(unknown)} of the scenario are not known" if unknown else text

    def to_json(self) -> dict:
        """Plain values."""
        return {
            "sentence": self.sentence,
            "states": list(self.labels),
            "count": self.count,
            "share": self.whole,
            "pressures": self.pressures,
            "rates": self.rates,
            "poses": self.poses,
            "loads": self.loads,
            "near_pressure": NEAR,
            "near_pose": NEAR_POSE,
        }


def percent(share: float) -> str:
    """A share as text, such as `99.3 %`; only what is whole is written as 100 %."""
    if 0.0 < share < 1.0:
        share = min(max(share, 0.001), 0.999)
    return f"{100.0 * share:.3g} %"


def states_of(recording: Recording, actuation: str = "measured") -> States:
    """The states of a recording."""
    pressure = actuation_of(recording, actuation)
    rate = np.full_like(pressure, np.nan)
    if recording.kind == "continuous":
        for run in recording.runs:
            rate[run] = rates(recording.t_s[run], pressure[run])
    label = recording.name
    return States(label, pressure, rate, recording.key_points_mm, recording.payload_g)


def rates(t_s: np.ndarray, pressure: np.ndarray) -> np.ndarray:
    """(S, m) change over RATE_S before each row, per second; over less at the begin of the run."""
    if len(t_s) < 2:
        return np.zeros_like(pressure)
    before = np.searchsorted(t_s, t_s - RATE_S - 1e-6, side="left")  # but for rounding
    before = np.minimum(before, np.maximum(np.arange(len(t_s)) - 1, 0))
    before[0], now = 0, np.arange(len(t_s))
    now[0] = 1
    return (pressure[now] - pressure[before]) / (t_s[now] - t_s[before])[:, None]


def joined(label: str, parts: Sequence[States]) -> States:
    """Several sets of states as one; what one of them does not know is NaN."""

    def every(pick, width: tuple[int, ...]) -> np.ndarray | None:
        values = [pick(part) for part in parts]
        if all(value is None for value in values):
            return None
        return np.concatenate(
            [
                np.full((len(part.pressure), *width), np.nan) if value is None else value
                for part, value in zip(parts, values, strict=True)
            ]
        )

    shapes = {part.points_mm.shape[1:] for part in parts if part.points_mm is not None}
    points = every(lambda p: p.points_mm, next(iter(shapes))) if len(shapes) == 1 else None
    return States(
        label,
        np.concatenate([part.pressure for part in parts]),
        np.concatenate([part.rate for part in parts]),
        points,
        every(lambda p: p.load_g, ()),
    )


def applicability(
    validated: Sequence[States], scenario: Sequence[States], length_mm: float
) -> Applicability:
    """Shares of a scenario's states that recordings have validated; length_mm: of the arm."""
    known = joined("validated", list(validated))
    asked = _thinned(joined("scenario", list(scenario)))
    span = np.ptp(known.pressure, axis=0)
    span = np.where(span > 0, span, 1.0)
    tree = cKDTree(_few(known.pressure / span))
    near, _ = tree.query(asked.pressure / span, p=np.inf)
    pressures = near <= NEAR
    inside, rate, pose, load = pressures.copy(), None, None, None
    moving = np.isfinite(asked.rate).all(1)
    measured = np.isfinite(known.rate).all(1)
    if moving.any() and measured.any():
        fastest = (1.0 + RATE_ROOM) * np.abs(known.rate[measured]).max(0)
        slow = (np.abs(np.nan_to_num(asked.rate)) <= fastest).all(1)
        rate, inside = float(slow[moving].mean()), inside & (slow | ~moving)
    same = (
        known.points_mm is not None
        and asked.points_mm is not None
        and known.points_mm.shape[1] == asked.points_mm.shape[1]
    )
    if same:
        there, here = known.points_mm, asked.points_mm
        assert there is not None
        assert here is not None
        seen, whole = (np.isfinite(each).all((1, 2)) for each in (there, here))
        if seen.any() and whole.any():
            close = np.full(len(here), False)
            close[whole] = _posed(_few(there[seen]), here[whole], length_mm)
            pose, inside = float(close[whole].mean()), inside & (close | ~whole)
    if known.load_g is not None and asked.load_g is not None:
        loads, wanted = known.load_g[np.isfinite(known.load_g)], asked.load_g
        stated = np.isfinite(wanted)
        if len(loads) and stated.any():
            room = (loads.min() - LOAD_ROOM_G, loads.max() + LOAD_ROOM_G)
            within = (wanted >= room[0]) & (wanted <= room[1])
            load, inside = float(within[stated].mean()), inside & (within | ~stated)
    return Applicability(
        labels=tuple(part.label for part in scenario),
        count=len(asked.pressure),
        pressures=float(pressures.mean()),
        rates=rate,
        poses=pose,
        loads=load,
        whole=float(inside.mean()),
        validated=_thinned(known),
        states=asked,
        inside=inside,
    )


def _posed(there: np.ndarray, here: np.ndarray, length_mm: float) -> np.ndarray:
    """(S,) bool: in one measured row all key points were where they are here, nearly.

    The largest distance of any key point counts; the least of it over the measured rows is found
    among the rows that are nearest in all coordinates together.
    """
    tree = cKDTree(there.reshape(len(there), -1))
    _, nearest = tree.query(here.reshape(len(here), -1), k=min(8, len(there)))
    nearest = nearest.reshape(len(here), -1)
    apart = np.linalg.norm(there[nearest] - here[:, None], axis=-1).max(-1).min(1)
    return apart <= NEAR_POSE * length_mm


def _few(values: np.ndarray) -> np.ndarray:
    return values[:: max(1, -(-len(values) // MOST_ROWS))]


def _thinned(states: States) -> States:
    step = max(1, -(-len(states.pressure) // MOST_ROWS))
    return States(
        states.label,
        states.pressure[::step],
        states.rate[::step],
        None if states.points_mm is None else states.points_mm[::step],
        None if states.load_g is None else states.load_g[::step],
    )
