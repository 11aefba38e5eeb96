"""Regulators, lines and chambers: slow flow through long capillaries.

A capillary passes air in proportion to the difference of the squares of the absolute pressures at
its ends (the law of Hagen 1839 and Poiseuille 1840 for an ideal gas at constant temperature). A
line is a ladder of capillaries with volumes between them, the last of which is the chamber:

    dP_k/dt = c_k ((P_{k-1}^2 - P_k^2) - (P_k^2 - P_{k+1}^2)) / (2 P_a),

with P_a the ambient pressure; nothing flows beyond the chamber but what leaks to the room. The
regulator is a first-order lag with a limited rate; its sensor sits in front of the line.
"""

import math
from typing import NamedTuple

import numpy as np

from surgisoft.compiled import compiled

AMBIENT_PA = 101_325.0
"""Standard atmosphere [Pa] (ISO 2533)."""
VOLUMES = 3
"""Volumes of a ladder, the chamber included."""
REGULATOR_S = 0.04
"""Time constant of a regulator [s]."""


class Gas(NamedTuple):
    """Parameters of the pneumatics of m chambers."""

    line: np.ndarray
    """(m,) c_k of each line's volumes: inverse of the time in which one fills [1/s]."""
    rate: float
    """Largest rate of a regulator [Pa/s]."""
    leak: np.ndarray
    """(2,) conductance to the room that one chamber gains in a second [1/s^2], and the chamber."""


@compiled
def fill(gas: Gas, target: np.ndarray, air: np.ndarray, time: float, step: float) -> None:
    """Let air flow for one step [s]; time: since the robot was switched on [s].

    target: (m,) set points [Pa gauge]; air: (1 + VOLUMES, m) gauge pressures of the regulators,
    along the lines and in the chambers [Pa]. Each difference of squares is the sum times the
    difference of pressures; the sums are those before the step, the differences those after it.
    """
    diagonal, right, above = np.empty(VOLUMES), np.empty(VOLUMES), np.empty(VOLUMES)
    for i in range(target.shape[0]):
        wanted = (target[i] - air[0, i]) * -math.expm1(-step / REGULATOR_S)
        most = gas.rate * step
        air[0, i] += min(max(wanted, -most), most)
        share = 0.5 * step * gas.line[i] / AMBIENT_PA
        below = share * (air[0, i] + air[1, i] + 2.0 * AMBIENT_PA)
        for k in range(VOLUMES):
            # Gaussian elimination of the tridiagonal system, along the line.
            above[k] = 0.0
            if k < VOLUMES - 1:
                above[k] = share * (air[k + 1, i] + air[k + 2, i] + 2.0 * AMBIENT_PA)
            elif i == int(gas.leak[1]) and time > 0.0:
                open_ = 0.5 * step * gas.leak[0] * time / AMBIENT_PA
                above[k] = open_ * (air[k + 1, i] + 2.0 * AMBIENT_PA)
            diagonal[k] = 1.0 + below + above[k]
            right[k] = air[k + 1, i]
            if k == 0:
                right[k] += below * air[0, i]
            else:
                diagonal[k] -= below * below / diagonal[k - 1]
                right[k] += below * right[k - 1] / diagonal[k - 1]
            below = above[k]
        air[VOLUMES, i] = right[VOLUMES - 1] / diagonal[VOLUMES - 1]
        for k in range(VOLUMES - 2, -1, -1):
            air[k + 1, i] = (right[k] + above[k] * air[k + 2, i]) / diagonal[k]
