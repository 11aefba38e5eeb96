"""One chamber and one key point, on an arc: a part of it, magnified, nearly has its shape.

A tenth of the pressure and a tenth of each position leave a tenth of any error of a model. The arm
is a circular arc of constant length whose angle grows with the pressure, in closed form.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from surgisoft.diagnosis.other_models import callable_arm
from surgisoft.diagnosis.setup import find_setup_faults
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.callables.named import given_callable
from tests.diagnosis.synthetic import walk

STEP_S, LENGTH_MM, HIGHEST_KPA, LARGEST_RAD = 0.1, 100.0, 150.0, 1.2
VALIDATED_MM = 1.2


def tip(time_s, actuation):
    """Key point (T, 1, 3) [mm] at the end of the arc for a pressure (T, 1) [kPa]."""
    angle = np.maximum(LARGEST_RAD * actuation[:, 0] / HIGHEST_KPA, 1e-9)
    x, z = LENGTH_MM * (1 - np.cos(angle)) / angle, LENGTH_MM * np.sin(angle) / angle
    return np.stack([x, np.zeros_like(x), z], axis=1)[:, None]


def arc(time_s, actuation):
    return tip(time_s, actuation)


arc.static = True


def bench(change=lambda p: p):
    """A recording of 4 min of the arm whose true pressure is a function of the measured one."""
    pressure = HIGHEST_KPA / 10 * walk(2400, 1, seed=5)
    time_s = STEP_S * np.arange(len(pressure))
    points = tip(time_s, change(pressure))
    points += np.random.default_rng(1).normal(0, 0.04, points.shape)
    return Recording("bench", time_s, pressure, points, noise_mm=0.04)


def lagged(pressure):
    keep = np.exp(-STEP_S / 0.5)
    return lfilter([1 - keep], [1, -keep], pressure, axis=0, zi=keep * pressure[:1])[0]


def found(recording):
    model = callable_arm(given_callable(arc), [bench()], error_mm=VALIDATED_MM)
    return find_setup_faults(model, [recording])


PHYSICS = {
    "a gain of 12 %": lambda p: 1.12 * p,
    "a lag of 0.5 s": lagged,
    "pressure lost below 15 kPa": lambda p: np.maximum(p - 15.0, 0.0),
    "stiffening": lambda p: p * (1.1 - 0.2 * p / HIGHEST_KPA),
}


@pytest.mark.parametrize("name", PHYSICS)
def test_no_error_falls_because_positions_are_divided(name):
    assert found(bench(PHYSICS[name])) is None


FAULTS = {
    "cm": (lambda r: replace(r, key_points_mm=r.key_points_mm / 10), {"length_unit"}),
    "inches read as mm": (
        lambda r: replace(r, key_points_mm=r.key_points_mm * 25.4),
        {"length_unit"},
    ),
    "turned": (lambda r: replace(r, key_points_mm=r.key_points_mm[..., [1, 2, 0]]), {"frame"}),
    "psi": (lambda r: replace(r, measured=r.measured / 6.894757), {"actuation_unit"}),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_of_such_an_arm_is_found(name):
    change, kinds = FAULTS[name]
    assert set(found(change(bench())).kinds) == kinds


def test_a_wrong_unit_of_one_key_point_may_be_that_of_the_model():
    """Neither is compared with a length: the tip's distance from the base is not recorded."""

    def in_metres(time_s, actuation):
        return tip(time_s, actuation) / 1000

    in_metres.static = True
    model = callable_arm(given_callable(in_metres), [bench()], error_mm=VALIDATED_MM)
    result = find_setup_faults(model, [bench()])
    assert "mm were read as m; or the model returns m where mm are expected" in result.sentence
    assert result.of_model == "the model returns m where mm are expected"
    assert result.to_json()["of_model"] == result.of_model
    assert found(FAULTS["turned"][0](bench())).of_model == ""
    assert result.how_to_tell == "to distinguish them: compare a distance with a ruler"


def test_the_floor_of_a_wrong_unit_is_in_the_unit_of_the_corrected_error():
    right = bench()
    in_cm = replace(right, key_points_mm=right.key_points_mm / 10, noise_mm=None)
    result = found(in_cm)
    assert result.kinds == ("length_unit",)
    assert result.floor_mm == pytest.approx(0.04 * 3**0.5, rel=0.2)
