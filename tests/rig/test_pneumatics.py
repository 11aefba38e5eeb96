"""Pumps: Boyle's law, the controller's steps, the line's asymmetry."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.rig import pneumatics as p

AMBIENT = 101.325


@pytest.fixture
def pumps():
    return p.build_pumps(p.PumpDesign(), np.full(3, 1500.0), noise_scale=0.0, seed=1)


def run(pumps, target, seconds, line=None, state=None, noise=None):
    """Pressures (T, m) at the sensor and in the chambers for constant targets (m,)."""
    state = p.vented(pumps) if state is None else state
    rows = []
    for t in range(round(seconds / pumps.step)):
        for i, row in enumerate(state):
            z = 0.0 if noise is None else noise[t, i]
            p.drive_piston(pumps, row, target[i], p.read_sensor(pumps, row[p.PRESSURE], z))
            if line is None:
                p.fill(pumps, row, i, 0.0)
            else:
                p.fill_through_line(pumps, row, i, 0.0, *line)
        rows.append(state[:, [p.PRESSURE, p.CHAMBER]].copy())
    rows = np.array(rows)
    return rows[..., 0], rows[..., 1]


@given(
    share=st.floats(0.3, 3.0),
    volume=st.floats(1e3, 2e4),
    bulge=st.one_of(st.just(0.0), st.floats(0.1, 20)),
)
def test_pressure_obeys_boyle(share, volume, bulge):
    """(p + ambient) (V + bulge p) is the amount of air that went in."""
    air = share * AMBIENT * volume
    pressure = p.pressure_of(air, volume, bulge)
    assert (pressure + AMBIENT) * (volume + bulge * pressure) == pytest.approx(air, rel=1e-12)
    assert pressure > -AMBIENT


def test_air_is_conserved_over_a_wild_ride(pumps):
    """Pressure times volume of every closed circuit, summed anew, never changes."""
    state = p.vented(pumps)
    rng = np.random.default_rng(0)
    for line in (None, (2000.0, 800.0)):
        for _ in range(20):
            run(pumps, rng.uniform(-15, 54, 3), 0.7, line, state)
            for i, row in enumerate(state):
                near = row[p.X] * pumps.bore + pumps.tube[i]
                far = pumps.chamber[i] + pumps.bulge * row[p.CHAMBER]
                air = (row[p.PRESSURE] + AMBIENT) * near + (row[p.CHAMBER] + AMBIENT) * far
                vented = AMBIENT * (pumps.rest * pumps.bore + pumps.tube[i] + pumps.chamber[i])
                assert air == pytest.approx(vented, rel=1e-9)


@pytest.mark.parametrize("start", [-15.0, -3.0, 0.0, 24.0, 51.0])
def test_a_step_of_3_kPa_settles_in_a_second_and_a_half_without_overshoot(pumps, start):
    state = p.vented(pumps)
    run(pumps, np.full(3, start), 20.0, state=state)
    sensor, _ = run(pumps, np.full(3, start + 3.0), 3.0, state=state)
    done = (sensor - start) / 3.0
    assert (np.abs(done[150:] - 1.0) < 0.05).all()
    assert done.max() < 1.02
    assert 0.2 < (done[:, 0] < 0.9).sum() * pumps.step < 1.2


def test_whole_range_is_within_reach(pumps):
    """Both limits, in time for the 3 s of settling, and the piston keeps off its stops."""
    state = p.vented(pumps)
    for target in (54.0, -15.0, 54.0):
        sensor, _ = run(pumps, np.full(3, target), 3.0, state=state)
        assert np.abs(sensor[-1] - target).max() < 0.5
        assert (state[:, p.X] > 1.0).all()
        assert (state[:, p.X] < pumps.stroke - 1.0).all()


def test_motor_keeps_its_limits(pumps):
    state = p.vented(pumps)
    speeds = []
    for target in (54.0, -15.0):
        for _ in range(150):
            run(pumps, np.full(3, target), pumps.step, state=state)
            speeds.append(state[:, p.SPEED].copy())
    speeds = np.array(speeds)
    assert np.abs(speeds).max() == pytest.approx(25.0)
    assert np.abs(np.diff(speeds, axis=0)).max() <= 400.0 * pumps.step + 1e-9


def test_long_line_lags_and_empties_slower(pumps):
    """Time to 90 % of a step of 20 kPa in the chamber, up and down, against the sensor."""
    times = {}
    for line in (None, (1500.0, 600.0)):
        state = p.vented(pumps)
        run(pumps, np.full(3, 10.0), 20.0, line, state)
        for name, start, target in (("up", 10.0, 30.0), ("down", 30.0, 10.0)):
            _, chamber = run(pumps, np.full(3, target), 20.0, line, state)
            done = (chamber[:, 0] - start) / (target - start)
            times[name, line] = np.argmax(done > 0.9) * pumps.step
            assert done[-1] == pytest.approx(1.0, abs=0.02)
    slow = (1500.0, 600.0)
    assert times["up", slow] > times["up", None]
    assert times["down", slow] - times["down", None] > 1.5 * (times["up", slow] - times["up", None])


def test_readings_are_noisy_and_in_steps():
    pumps = p.build_pumps(p.PumpDesign(), np.full(3, 1500.0), noise_scale=1.0, seed=1)
    normals = np.random.default_rng(0).standard_normal(20000)
    readings = np.array([p.read_sensor(pumps, 12.345, z) for z in normals])
    np.testing.assert_allclose(readings / 0.02, np.round(readings / 0.02), atol=1e-6)
    assert readings.mean() == pytest.approx(12.345, abs=1e-3)
    # Variance of noise plus that of rounding, step^2 / 12 (Sheppard's correction).
    assert readings.std() == pytest.approx(np.sqrt(0.02**2 + 0.02**2 / 12), rel=0.03)
