"""Pressure regulators, tubes and chambers: compressible flow through orifices.

Every flow follows ISO 6358-1 (2013), the ellipse of Sanville (1971): air of absolute pressure p_1
flows through an opening of conductance C [m^3/s] to p_2 at

    d(p V)/dt = C p_1 phi(p_2 / p_1),   phi(r) = 1 for r <= b, sqrt(1 - ((r - b) / (1 - b))^2) else,

choked below the critical ratio b = 0.3 and laminar close to r = 1, where phi is linear (same
standard, annex). A proportional valve connects the tube to a supply or to a vacuum and opens in
proportion to the error of the tube's pressure; the tube ends in the chamber. Air is isothermal, and
a chamber's volume follows the strain of the arm. The pressure sensor sits on the tube, so what a
long thin tube delays is not measured.
"""

import math
from typing import NamedTuple

import numpy as np

from surgisoft.compiled import compiled

AMBIENT_PA = 101_325.0
"""Standard atmosphere [Pa] (ISO 2533)."""
CRITICAL = 0.3
"""Critical ratio of pressures b [-]: fittings and short tubes (ISO 6358-1, annex)."""
LAMINAR = 0.99
"""Ratio of pressures beyond which flow is laminar [-] (0.999 in the standard; less is smoother)."""


class Gas(NamedTuple):
    """Parameters of the pneumatics of m chambers; constant."""

    supply: float
    """Absolute pressure of the supply [Pa]."""
    vacuum: float
    """Absolute pressure of the vacuum line [Pa]."""
    valve: float
    """Conductance of the fully open valve [m^3/s]."""
    band: float
    """Error of pressure at which the valve is fully open [Pa]."""
    tube: np.ndarray
    """(m,) volume of each tube [m^3]."""
    line: np.ndarray
    """(m,) conductance of each tube [m^3/s]."""
    leak: np.ndarray
    """(m,) conductance of a crack in each chamber to the room, at twice `opens` [m^3/s]."""
    opens: float
    """Pressure above which a crack opens, the wider the higher the pressure [Pa gauge]."""
    bulge: float
    """Volume that a chamber gains with pressure, per its volume [1/Pa]."""


class Air(NamedTuple):
    """State of the pneumatics; updated in place."""

    target: np.ndarray
    """(m,) set points [Pa gauge]."""
    line: np.ndarray
    """(m,) pressures in the tubes [Pa gauge]."""
    chamber: np.ndarray
    """(m,) pressures in the chambers [Pa gauge]."""
    volume: np.ndarray
    """(m,) volumes of the chambers at the last step [m^3]."""


def vented(volumes: np.ndarray) -> Air:
    """State of chambers of volumes (m,) [m^3] that are open to the room."""
    m = len(volumes)
    return Air(np.zeros(m), np.zeros(m), np.zeros(m), np.array(volumes, np.float64))


@compiled
def flow(conductance: float, one: float, two: float) -> float:
    """Flow d(p V)/dt [Pa m^3/s] from absolute pressure one to two [Pa]; negative: back."""
    high, low = max(one, two), min(one, two)
    ratio = low / high
    if ratio <= CRITICAL:
        share = 1.0
    else:
        share = math.sqrt(1.0 - ((min(ratio, LAMINAR) - CRITICAL) / (1.0 - CRITICAL)) ** 2)
        if ratio > LAMINAR:
            share *= (1.0 - ratio) / (1.0 - LAMINAR)
    moved = conductance * high * share
    return moved if one >= two else -moved


@compiled
def fill_chambers(gas: Gas, air: Air, step: float, volumes: np.ndarray) -> None:
    """Let air flow for one step [s]; volumes: (m,) of the unpressurised chambers now [m^3]."""
    for i in range(volumes.shape[0]):
        line = air.line[i] + AMBIENT_PA
        chamber = air.chamber[i] + AMBIENT_PA
        opening = min(max((air.target[i] - air.line[i]) / gas.band, -1.0), 1.0)
        source = gas.supply if opening > 0.0 else gas.vacuum
        room = volumes[i] * (1.0 + gas.bulge * air.chamber[i])
        fed = step * flow(gas.valve * abs(opening), source, line)
        passed = step * flow(gas.line[i], line, chamber)
        # A step must not move more air than makes both pressures equal.
        even = (line - chamber) * gas.tube[i] * room / (gas.tube[i] + room)
        if abs(passed) > abs(even):
            passed = even
        lost = 0.0
        if gas.leak[i] > 0.0 and air.chamber[i] > gas.opens:
            wide = gas.leak[i] * (air.chamber[i] / gas.opens - 1.0)
            lost = step * flow(wide, chamber, AMBIENT_PA)
        held = chamber * air.volume[i] + passed - lost
        air.line[i] = line + (fed - passed) / gas.tube[i] - AMBIENT_PA
        air.chamber[i] = held / room - AMBIENT_PA
        air.volume[i] = room
