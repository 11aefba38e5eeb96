"""Regulators, lines and chambers: flow through a nozzle.

Air of absolute pressure p_1 flows to p_2 as through an isentropic nozzle (Saint-Venant & Wantzel
1839) with the discharge coefficient of sharp edges by Perry (1949),

    d(p V)/dt = C p_1 c(r) psi(r) / psi(r*),   r = max(p_2 / p_1, r*),
    psi(r) = sqrt(r^(2/g) - r^((g+1)/g)),   r* = (2 / (g+1))^(g/(g-1)) = 0.528,   g = 1.4,

choked below r*; c is Perry's polynomial over its value at r*. The regulator is a first-order lag
with a limited rate; its sensor sits in front of the line.
"""

import math
from typing import NamedTuple

import numpy as np

from surgisoft.compiled import compiled

AMBIENT_PA = 101_325.0
"""Standard atmosphere [Pa] (ISO 2533)."""
HEATS = 1.4
"""Ratio of specific heats of air, g [-]."""
CHOKED = (2.0 / (HEATS + 1.0)) ** (HEATS / (HEATS - 1.0))
"""Ratio of pressures below which the flow is choked, r* [-]."""
LAMINAR = 0.995
"""Ratio of pressures beyond which the flow is linear in the difference, as laminar flow is [-]."""
REGULATOR_S = 0.04
"""Time constant of a regulator [s]."""


class Gas(NamedTuple):
    """Parameters of the pneumatics of m chambers."""

    line: np.ndarray
    """(m,) conductance of each line over the volume of its chamber, C / V [1/s]."""
    rate: float
    """Largest rate of a regulator [Pa/s]."""


@compiled
def discharge(ratio: float) -> float:
    """Discharge coefficient of an orifice at a ratio of pressures (Perry 1949) [-]."""
    r = ratio
    return 0.8414 + r * (-0.1002 + r * (0.8415 + r * (-3.9 + r * (4.6001 - r * 1.6827))))


@compiled
def nozzle(ratio: float) -> float:
    """psi(r) of the isentropic flow [-]."""
    return math.sqrt(max(ratio ** (2.0 / HEATS) - ratio ** ((HEATS + 1.0) / HEATS), 0.0))


@compiled
def flow(one: float, two: float) -> float:
    """Flow per conductance from absolute pressure one to two [Pa]; negative: back."""
    high, low = max(one, two), min(one, two)
    ratio = max(low / high, CHOKED)
    share = discharge(min(ratio, LAMINAR)) * nozzle(min(ratio, LAMINAR))
    if ratio > LAMINAR:
        share *= (1.0 - ratio) / (1.0 - LAMINAR)
    moved = high * share / (discharge(CHOKED) * nozzle(CHOKED))
    return moved if one >= two else -moved


@compiled
def fill(gas: Gas, open_: np.ndarray, target: np.ndarray, air: np.ndarray, step: float) -> None:
    """Let air flow for one step [s]; air: (2, m) gauge pressures in lines and chambers [Pa].

    target: (m,) set points [Pa gauge]; open_: (m,) share of each line's section that is open [-].
    """
    for i in range(target.shape[0]):
        wanted = (target[i] - air[0, i]) * -math.expm1(-step / REGULATOR_S)
        most = gas.rate * step
        air[0, i] += min(max(wanted, -most), most)
        # A step must not move more air than makes both pressures equal.
        gap = air[0, i] - air[1, i]
        moved = step * gas.line[i] * open_[i] * flow(air[0, i] + AMBIENT_PA, air[1, i] + AMBIENT_PA)
        air[1, i] += moved if abs(moved) < abs(gap) else gap
