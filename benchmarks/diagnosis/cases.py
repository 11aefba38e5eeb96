"""Cases of the diagnosis benchmark: robot, hidden effects, excitation, noise and surrogate.

Most of the rig's hidden effects have other equations than the model's effects; `SAME_LAW` lists
those whose law the model's effect contains.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from surgisoft.errors import InputError

KNOWN = {
    "hysteresis": "hysteresis",
    "rate_dependence": "rate_dependence",
    "line_lag": "line_lag",
    "creep": "creep",
    "softening": "softening",
    "stiffening": "stiffening",
    "dead_zone": "dead_zone",
    "gain_mismatch": "gain_mismatch",
    "coupling": "coupling",
    "payload": "payload",
    "contact": "contact",
    "misalignment": "misalignment",
    "drift": "drift",
    "thermal_drift": "drift",
    "twist": "twist",
}
"""Hidden effect of the rig -> the corresponding effect of the model's list."""
SAME_LAW = {
    "coupling": "the model's quadratic coupling of pairs contains the rig's exactly",
    "rate_dependence": "the rig's fluid is a limiting case of the model's (f09a868)",
    "line_lag": "both are a turbulent flow with other speeds in filling and in emptying",
    "payload": "both are a weight on an elastic rod; the rig's is off the centre",
    "misalignment": "both are a rigid rotation and shift; the rig's is slightly warped too",
}
"""Hidden effects -> how far the model's effect has the same law: results on them show that the
parameters of a known law are recovered."""
MEMORY = {"hysteresis", "rate_dependence", "line_lag", "creep", "softening", "drift", "inertia"}
"""Effects that a static surrogate cannot imitate."""
UNKNOWN = (
    "stick_slip",
    "leak",
    "marker_slip",
    "breathing",
    "valve_jam",
    "fibre_break",
    "knock",
)
"""Hidden effects that are not in the model's list."""
LATER = ("zero_offset",)
"""Known effects that joined when the cases had been planned: no case has them."""
LEFT_OUT = ("sensor_crosstalk", *LATER)
"""Hidden effects of no case. Crosstalk is neither known nor unknown: a linear map of the pressures
equals coupling with gain mismatch of the list, so no single name is right."""
PAIRS = (
    ("creep", "payload"),
    ("line_lag", "misalignment"),
    ("hysteresis", "creep"),
    ("softening", "gain_mismatch"),
    ("drift", "dead_zone"),
    ("rate_dependence", "payload"),
    ("line_lag", "creep"),
    ("misalignment", "gain_mismatch"),
)
"""Pairs that are hidden at once."""
EXCITATIONS = {
    "short": ("mixed", 1500),
    "poor": ("ramps", 3000),
    "medium": ("mixed", 6000),
    "rich": ("mixed", 12000),
}
"""Name -> protocol and samples at 20 Hz."""
SHARES = {"single": 0.5, "clean": 0.25, "unknown": 0.1, "pair": 0.1, "undertrained": 0.05}
"""Kind of case -> its share of all cases."""


@dataclass(frozen=True)
class Case:
    """One robot with its hidden effects, recording and surrogate."""

    robot: int
    """Seed of the robot."""
    hidden: tuple[tuple[str, float], ...]
    """Hidden effects and their amplitudes."""
    discrepancy_mm: float
    """Validated error to which the surrogate is deformed, mm; 0: as it was fitted."""
    noise: str
    """`white`, `loud` or `correlated`."""
    excitation: str
    """A name of EXCITATIONS."""
    take: int
    """Number of the trial, which determines schedule and noise."""
    undertrained: bool = False
    """Whether the surrogate was fitted for a few epochs only."""

    @property
    def truth(self) -> tuple[str, ...]:
        """The effects that should be named; `unknown` for those outside the list."""
        return tuple(KNOWN.get(name, "unknown") for name, _ in self.hidden)

    @property
    def single(self) -> bool:
        """Whether one effect of the list is hidden, and the surrogate was trained."""
        return len(self.hidden) == 1 and self.truth[0] != "unknown" and not self.undertrained


def cases(
    robots: list[int], count: int, seed: int, kinds: Collection[str] = tuple(SHARES)
) -> list[Case]:
    """About `count` cases: half with one hidden effect, and clean, unknown, two, undertrained.

    kinds: names of `SHARES`; where some are left out, the shares of the others grow in proportion.
    Raises InputError for another name.
    """
    for kind in kinds:
        if kind not in SHARES:
            raise InputError(f"kind of case '{kind}': expected one of {', '.join(SHARES)}")
    whole = sum(SHARES[kind] for kind in SHARES if kind in kinds)

    def number(kind: str) -> int:
        return round(SHARES[kind] / whole * count) if kind in kinds else 0

    rng = np.random.default_rng(seed)
    single = [((name, float(strength)),) for strength in (1.0, 2.0, 0.6) for name in KNOWN]
    plan: list[tuple[tuple, bool]] = []
    for i in range(number("single")):
        plan.append((single[i % len(single)], False))
    plan += [((), False)] * number("clean")
    for i in range(number("unknown")):
        plan.append((((UNKNOWN[i % len(UNKNOWN)], float(rng.choice([1.0, 2.0]))),), False))
    for i in range(number("pair")):
        pair = PAIRS[i % len(PAIRS)]
        plan.append((tuple((name, 1.2) for name in pair), False))
    plan += [((), True)] * number("undertrained")
    drawn = []
    for take, (hidden, undertrained) in enumerate(plan):
        drawn.append(
            Case(
                robot=int(rng.choice(robots)),
                hidden=hidden,
                discrepancy_mm=float(rng.choice([0.0, 0.0, 0.25])),
                noise=str(rng.choice(["white", "white", "loud", "correlated"])),
                excitation=str(rng.choice(["poor", "medium", "rich", "rich"])),
                take=1000 * seed + take,
                undertrained=undertrained,
            )
        )
    return drawn
