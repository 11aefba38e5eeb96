"""Regulators, hoses and chambers: turbulent flow in smooth hoses.

Air of absolute pressure P_1 flows to P_2 through a smooth hose against a friction that goes with
the power -1/4 of Reynolds' number (Blasius 1913), so that the flow is

    q = c d (d^2 / d_0^2 + e^2)^(-3/14),   d = (P_1^2 - P_2^2) / (2 P_a),

a power 4/7 of the difference of the squares, and linear (laminar) close to zero. A hose is two
such halves with a volume between them. A chamber's volume V(p) grows in proportion to its pressure,
and its air is isothermal: d(P V)/dt = q. Both pressures follow by an implicit step with the
conductances of the step before. A regulator is a linear system of second order; its sensor is in
front of the hose.
"""

import numpy as np

from benchmarks.strain_rod.robot import Gas
from surgisoft.compiled import compiled

AMBIENT_PA = 101_325.0
"""Standard atmosphere, P_a [Pa] (ISO 2533)."""
BLASIUS = 3.0 / 14.0
"""Half of what the power 4/7 of the flow lacks to 1 [-]."""
LAMINAR = 0.05
"""Difference below which the flow is laminar, as a share e of d_0 [-]."""
SCALE = 0.1
"""Difference d_0 at which the rate of `Gas.line` holds, as a share of the limit [-]."""
MIDDLE = 0.2
"""Volume in the middle of a hose, as a share of that of its chamber [-]."""


@compiled
def conductance(one: float, two: float, scale: float) -> float:
    """Flow over the difference of two gauge pressures [Pa], per rate c [-]."""
    mean = 1.0 + 0.5 * (one + two) / AMBIENT_PA
    share = (one - two) * mean / scale
    return mean * (share * share + LAMINAR**2) ** -BLASIUS


@compiled
def fill(
    gas: Gas,
    target: np.ndarray,
    air: np.ndarray,
    flags: np.ndarray,
    time: float,
    high: float,
    step: float,
) -> None:
    """Let air flow for one step [s]; air: (4, m) see `State`; high: upper limit of pressure [Pa].

    target: (m,) set points [Pa]; flags: (1,) 1 while the relief valve is open; time: [s].
    """
    frequency, damping = gas.regulator[0], gas.regulator[1]
    for i in range(target.shape[0]):
        force = frequency**2 * (target[i] - air[0, i])
        stiff = 1.0 + 2.0 * damping * frequency * step + (frequency * step) ** 2
        air[1, i] = (air[1, i] + step * force) / stiff
        air[0, i] += step * air[1, i]
        front, middle, chamber = air[0, i], air[2, i], air[3, i]
        vents = 0.0
        if gas.relief[3] > 0.0 and i == int(gas.relief[0]):
            if chamber > gas.relief[1]:
                flags[0] = 1.0
            elif chamber < gas.relief[2]:
                flags[0] = 0.0
            vents = flags[0] * gas.relief[3] * step
        rate = gas.line[i] * step
        one = rate * conductance(front, middle, SCALE * high)
        two = rate * conductance(middle, chamber, SCALE * high)
        volume = 1.0 + gas.swell * (2.0 * chamber + AMBIENT_PA) / high
        # MIDDLE (m - middle) = one (front - m) - two (m - c), volume (c - chamber) = two (m - c)
        # - vents c
        first, last = MIDDLE + one + two, volume + two + vents
        right, left = MIDDLE * middle + one * front, volume * chamber
        below = first * last - two * two
        air[2, i] = (right * last + two * left) / below
        air[3, i] = (first * left + two * right) / below
    if gas.crossed[2] > 0.0:
        for spell in range(gas.crossing.shape[0]):
            if gas.crossing[spell, 0] <= time < gas.crossing[spell, 1]:
                i, j = int(gas.crossed[0]), int(gas.crossed[1])
                rate = gas.crossed[2] * step
                moved = rate / (1.0 + 2.0 * rate) * (air[3, i] - air[3, j])
                air[3, i] -= moved
                air[3, j] += moved
