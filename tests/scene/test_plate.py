"""The slotted plate against areas and edges by hand."""

import math

import numpy as np
import pytest

from surgisoft.errors import InputError
from surgisoft.scene.plate import SlottedPlate


def test_the_volume_is_the_plates_less_its_opening():
    """One slot: a straight part of 20 x 30 mm and half a disc of radius 10 mm."""
    plate = SlottedPlate(slots=1, slot_mm=20.0, reach_mm=30.0, radius_mm=60.0, thickness_mm=2.0)
    mesh = plate.mesh()
    assert mesh.is_watertight
    expected = 2.0 * (math.pi * 60.0**2 - (20.0 * 30.0 + 0.5 * math.pi * 10.0**2))
    assert mesh.volume_mm3 == pytest.approx(expected, rel=2e-4)
    np.testing.assert_allclose(mesh.bounds_mm[:, 2], [0.0, 2.0])


def test_the_openings_edge_by_hand():
    """Slots of 23 mm at 0, 120 and 240 degrees: ends, sides, and the corner between two."""
    plate = SlottedPlate()
    along, beside, between = plate.opening_mm(np.radians([120.0, 30.0, 60.0]))
    assert along == pytest.approx(50.0)
    assert beside == pytest.approx(11.5 / math.sin(math.radians(30.0)))
    assert between == pytest.approx(11.5 / math.sin(math.radians(60.0)))
    back = SlottedPlate(slots=1).opening_mm(np.array([math.pi]))
    assert back[0] == pytest.approx(11.5)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"slots": 0}, "slots is 0"),
        ({"reach_mm": 80.0}, "reach_mm 80.0 and radius_mm 70.0 do not rise"),
        ({"thickness_mm": 0.0}, "thickness_mm is 0.0"),
    ],
)
def test_an_impossible_plate_is_one_line(values, says):
    with pytest.raises(InputError, match=says):
        SlottedPlate(**values)
