"""Key points whose coordinates are in another unit of length than those of the others.

A file whose columns come from two programs may hold one key point in cm beside others in mm. No
frame or scale of the whole body explains it. It is looked for where the frame is right, so that a
key point is the predicted one times a ratio of two units about the origin of the base frame.
"""

import itertools
from dataclasses import dataclass

import numpy as np

from surgisoft.diagnosis.setup.sample import Arrangement, Sample
from surgisoft.diagnosis.setup.words import SetupFault
from surgisoft.units import MM_PER

LEFT = 0.1
"""Most error of a key point that the right unit may leave, as a share of that in the wrong one:
99 % of its square are explained then."""
AWAY = 0.1
"""Least predicted distance of a key point from the origin, as a share of that of the farthest: at
the base, the ratio changes nothing but the noise, and a large one makes up for any shift."""


@dataclass(frozen=True)
class MixedUnits:
    """Key points that are in another unit of length than the others."""

    points: tuple[int, ...]
    """The key points, from 0."""
    ratio: float
    """Their coordinates over what these would be in the unit of the others."""
    before_mm: float
    """RMS error of all key points as recorded, mm."""
    after_mm: float
    """RMS error where they are in the unit of the others, mm."""

    @property
    def fault(self) -> SetupFault:
        """The fault, with the units that are probable."""
        names = " and ".join(f"k{k}" for k in self.points)
        many = len(self.points) > 1
        text = (
            f"the coordinates of key point{'s' * many} {names} are {self.ratio:.4g} times as large "
            f"as those of the other key points say, as {_units(self.ratio)}: in the unit of the "
            f"others the error is {self.after_mm:.3g} mm and not {self.before_mm:.3g} mm"
        )
        numbers: dict[str, float | list] = {
            "key_points": [float(k) for k in self.points],
            "ratio": self.ratio,
        }
        return SetupFault("length_unit", text, numbers)

    @property
    def instructions(self) -> str:
        """What to do about it."""
        names = " and ".join(f"k{k}" for k in self.points)
        return (
            f"multiply the coordinates of {names} by {1.0 / self.ratio:.6g} in the file that was "
            "recorded, and read it again"
        )


def mixed_units(sample: Sample) -> MixedUnits | None:
    """Key points of a sample that are in another unit of length than the others; None where none is
    proved.

    It is where one ratio of units leaves a tenth of the error of some key points (`LEFT`), and all
    others have a tenth of the error that it would give them. Those at the base do not count
    (`AWAY`).
    """
    plain = Arrangement.as_recorded(sample.history.chambers)
    measured, predicted = sample.measured()[0], sample.predicted([plain])[0]
    raw = _rms(measured - predicted)
    distance = _rms(predicted)
    away = distance >= AWAY * distance.max()
    ratios = {a / b for a, b in itertools.permutations(MM_PER.values(), 2)}
    best: MixedUnits | None = None
    for ratio in sorted(ratios):
        scaled = _rms(measured / ratio - predicted)
        there = away & (scaled <= LEFT * raw)
        others = away & ~there & np.isfinite(raw)
        if not there.any() or not others.any() or (raw > LEFT * scaled)[others].any():
            continue
        points = tuple(np.flatnonzero(there).tolist())
        before, after = (
            float(np.sqrt(np.nanmean(np.square(each))))
            for each in (raw, np.where(there, scaled, raw))
        )
        if best is None or after < best.after_mm:
            best = MixedUnits(points, ratio, before, after)
    return best


def _rms(apart_mm: np.ndarray) -> np.ndarray:
    """(n,) RMS length of vectors (S, n, 3); NaN where a key point was never measured."""
    seen = np.isfinite(apart_mm).all(2)
    square = np.where(seen, np.square(np.nan_to_num(apart_mm)).sum(2), 0.0)
    return np.sqrt(square.sum(0) / np.where(seen.any(0), seen.sum(0), np.nan))


def _units(ratio: float) -> str:
    """The units that a ratio is of, such as `cm beside mm`: mm among them where it can be."""
    pairs = [(a, b) for a, b in itertools.permutations(MM_PER, 2) if MM_PER[b] / MM_PER[a] == ratio]
    a, b = min(pairs, key=lambda pair: "mm" not in pair)
    return f"{a} beside {b}"
