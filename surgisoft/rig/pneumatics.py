"""Pneumatics: one syringe pump on a lead screw, sensor and PID controller per chamber.

As in Chen et al. (2025, sec. III-B and IV-B): syringe, tube and chamber form a closed air circuit;
the controller's output is the motor's speed; pulling the piston back gives pressures below
ambient. Air is ideal and isothermal (Boyle): (p + p_ambient) V is a constant of the circuit.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from surgisoft.compiled import compiled

AMBIENT_KPA = 101.325
"""Standard atmosphere [kPa] (ISO 2533)."""

X, SPEED, AIR, FAR_AIR, PRESSURE, CHAMBER, INTEGRAL, SLOPE, READING = range(9)
"""Columns of the state: piston position [mm], its speed [mm/s], air in the circuit (behind a
restricting line: on the syringe's side) and in the chamber behind a restricting line [kPa mm^3],
gauge pressure at the sensor and in the chamber [kPa], error integral [kPa s], filtered rate of the
reading [kPa/s], last reading [kPa]."""
COLUMNS = 9


@dataclass(frozen=True)
class PumpDesign:
    """Design of the pumps and their controllers."""

    step_s: float = 0.01
    """Period of the controller [s]."""
    bore_mm: float = 14.5
    """Inner diameter of the 10 ml syringe [mm]."""
    stroke_mm: float = 60.0
    """Travel of the piston [mm]."""
    rest_mm: float = 42.0
    """Free length of the syringe when vented [mm]."""
    tube_mm3: float = 1500.0
    """Volume of tube and fittings [mm^3]: 0.5 m of 2 mm bore."""
    bulge_mm3_kPa: float = 1.5
    """Volume that a chamber gains by its wall's bulging [mm^3/kPa]."""
    top_speed_mm_s: float = 25.0
    """Largest speed of the piston [mm/s]: 6.25 turns/s of a 4 mm lead screw."""
    acceleration_mm_s2: float = 400.0
    """Largest acceleration of the piston [mm/s^2]."""
    kp: float = 2.2
    """Proportional gain [mm/s per kPa]: low."""
    ki: float = 0.02
    """Integral gain [mm/s per kPa s]: low."""
    kd: float = 0.05
    """Derivative gain on the reading [mm/s per kPa/s]: moderate."""
    filter_s: float = 0.05
    """Time constant of the derivative's filter [s]."""
    sensor_noise_kPa: float = 0.02
    """Standard deviation of one reading [kPa]."""
    sensor_step_kPa: float = 0.02
    """Resolution of a reading [kPa]: 14 bits over 300 kPa."""


class Pumps(NamedTuple):
    """The pumps in numbers, for compiled code; units as in PumpDesign."""

    step: float
    """Controller period [s]."""
    bore: float
    """Piston area [mm^2]."""
    stroke: float
    """Travel of the piston [mm]."""
    rest: float
    """Vented free length [mm]."""
    tube: np.ndarray
    """(m,) dead volume [mm^3]."""
    chamber: np.ndarray
    """(m,) chamber volume at rest [mm^3]."""
    bulge: float
    """Compliance of a chamber's wall [mm^3/kPa]."""
    limits: np.ndarray
    """(2,) speed [mm/s] and acceleration [mm/s^2]."""
    gains: np.ndarray
    """(3,) kp, ki, kd."""
    smooth: float
    """Weight of the newest rate in the derivative's filter [-]."""
    noise: float
    """Sensor noise [kPa]."""
    resolution: float
    """Sensor step [kPa]."""


def build_pumps(
    design: PumpDesign, chamber_mm3: np.ndarray, noise_scale: float, seed: int
) -> Pumps:
    """The pumps of one bench; the tubes' lengths differ a little with the seed.

    chamber_mm3: (m,) chamber volumes at rest [mm^3].
    """
    rng = np.random.default_rng([seed, 0xB0])
    return Pumps(
        step=float(design.step_s),
        bore=math.pi / 4 * design.bore_mm**2,
        stroke=float(design.stroke_mm),
        rest=float(design.rest_mm),
        tube=design.tube_mm3 * (1 + rng.normal(0.0, 0.05, len(chamber_mm3))),
        chamber=np.asarray(chamber_mm3, np.float64),
        bulge=float(design.bulge_mm3_kPa),
        limits=np.array([design.top_speed_mm_s, design.acceleration_mm_s2], np.float64),
        gains=np.array([design.kp, design.ki, design.kd], np.float64),
        smooth=design.step_s / (design.filter_s + design.step_s),
        noise=float(noise_scale) * design.sensor_noise_kPa,
        resolution=float(design.sensor_step_kPa) if noise_scale > 0 else 0.0,
    )


def vented(pumps: Pumps) -> np.ndarray:
    """State (m, COLUMNS) of pumps that were opened to the room and closed again."""
    state = np.zeros((len(pumps.chamber), COLUMNS))
    vent(pumps, state)
    return state


def vent(pumps: Pumps, state: np.ndarray) -> None:
    """Open every circuit to the room with the pistons at rest, and close it again."""
    state[:] = 0.0
    for i in range(state.shape[0]):
        state[i, X] = pumps.rest
        state[i, AIR] = AMBIENT_KPA * (pumps.rest * pumps.bore + pumps.tube[i])
        state[i, FAR_AIR] = AMBIENT_KPA * pumps.chamber[i]


@compiled
def read_sensor(pumps: Pumps, pressure: float, normal: float) -> float:
    """One reading [kPa] of a gauge pressure [kPa]; normal: a standard normal number."""
    reading = pressure + pumps.noise * normal
    if pumps.resolution > 0.0:
        reading = pumps.resolution * math.floor(reading / pumps.resolution + 0.5)
    return reading


@compiled
def drive_piston(pumps: Pumps, row: np.ndarray, target: float, reading: float) -> None:
    """PID and motor for one controller period: row (COLUMNS,) of one pump, updated in place.

    target, reading: [kPa]. Positive speed pushes. The integral waits while the speed is limited.
    """
    step = pumps.step
    error = target - reading
    rate = (reading - row[READING]) / step
    row[SLOPE] += pumps.smooth * (rate - row[SLOPE])
    row[READING] = reading
    wanted = pumps.gains[0] * error + pumps.gains[1] * row[INTEGRAL] - pumps.gains[2] * row[SLOPE]
    top = pumps.limits[0]
    speed = min(max(wanted, -top), top)
    if speed == wanted:
        row[INTEGRAL] += error * step
    change = pumps.limits[1] * step
    row[SPEED] += min(max(speed - row[SPEED], -change), change)
    x = row[X] - row[SPEED] * step
    if x < 0.0 or x > pumps.stroke:
        row[SPEED] = 0.0
        x = min(max(x, 0.0), pumps.stroke)
    row[X] = x


@compiled
def pressure_of(air: float, volume: float, bulge: float) -> float:
    """Gauge pressure [kPa] of an amount of air [kPa mm^3] in a space that yields to it.

    Boyle: (p + p_ambient) (volume + bulge p) = air, solved for p. volume: [mm^3]; bulge:
    [mm^3/kPa].
    """
    excess = volume * AMBIENT_KPA - air
    if bulge == 0.0:
        return -excess / volume
    linear = volume + bulge * AMBIENT_KPA
    return -2.0 * excess / (linear + math.sqrt(linear * linear - 4.0 * bulge * excess))


@compiled
def fill(pumps: Pumps, row: np.ndarray, i: int, stretch: float) -> None:
    """Pressures of circuit i after its piston moved; stretch: axial strain of the chamber [-]."""
    volume = row[X] * pumps.bore + pumps.tube[i] + pumps.chamber[i] * (1.0 + stretch)
    row[PRESSURE] = pressure_of(row[AIR] + row[FAR_AIR], volume, pumps.bulge)
    row[CHAMBER] = row[PRESSURE]


@compiled(inner=True)
def fill_through_valve(pumps: Pumps, row: np.ndarray, i: int, stretch: float, shut: bool) -> None:
    """Fill a chamber behind a valve: where it is shut, chamber and pump keep separate air."""
    near = row[X] * pumps.bore + pumps.tube[i]
    if shut:
        row[PRESSURE] = pressure_of(row[AIR], near, 0.0)
        row[CHAMBER] = pressure_of(row[FAR_AIR], pumps.chamber[i] * (1.0 + stretch), pumps.bulge)
        return
    fill(pumps, row, i, stretch)
    air = row[AIR] + row[FAR_AIR]
    row[AIR] = (row[PRESSURE] + AMBIENT_KPA) * near
    row[FAR_AIR] = air - row[AIR]


@compiled
def fill_through_line(
    pumps: Pumps, row: np.ndarray, i: int, stretch: float, filling: float, emptying: float
) -> None:
    """Fill a chamber through a long thin tube behind the sensor, over one period.

    Flow through a rough narrow tube goes with the root of the difference of squared pressures
    (Darcy & Weisbach for a gas: p1^2 - p2^2 ~ q |q|), and a soft tube that is filled is wider than
    one that is emptied. filling, emptying: conductance [mm^3/s]. Ten steps a period.
    """
    near = row[X] * pumps.bore + pumps.tube[i]
    far = pumps.chamber[i] * (1.0 + stretch)
    for _ in range(10):
        p1 = pressure_of(row[AIR], near, 0.0)
        p2 = pressure_of(row[FAR_AIR], far, pumps.bulge)
        drop = (p1 + AMBIENT_KPA) ** 2 - (p2 + AMBIENT_KPA) ** 2
        width = filling if drop > 0.0 else emptying
        moved = 0.1 * pumps.step * width * drop / math.sqrt(abs(drop) + 30.0)
        even = (p1 - p2) * near * far / (near + far)  # would equalise the pressures
        if abs(moved) > 0.5 * abs(even):
            moved = 0.5 * even
        row[AIR] -= moved
        row[FAR_AIR] += moved
    row[PRESSURE] = pressure_of(row[AIR], near, 0.0)
    row[CHAMBER] = pressure_of(row[FAR_AIR], far, pumps.bulge)
