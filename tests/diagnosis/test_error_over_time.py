"""Pictures: the error over time where motion capture is slower than the log, many chambers, and
charts that fill a page."""

from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest

from surgisoft.diagnosis.diagnose import Diagnosis, ErrorLevels, Verdict
from surgisoft.diagnosis.pages.diagnosis import effects_chart
from surgisoft.diagnosis.pages.pictures import bodies, error_over_time, loops


def test_rows_that_lack_a_key_point_do_not_pull_the_mean_down():
    error = np.tile([0.0, 2.0, 4.0], (40, 1))
    error[1::2, 1:] = np.nan  # only the base is seen in every other row
    table = SimpleNamespace(
        error_mm=error,
        along_s=np.arange(40.0),
        recording=np.zeros(40, int),
        names=("bench",),
        held_out=np.zeros(40, bool),
    )
    figure = error_over_time(table)
    tip, mean = figure.axes[0].lines[:2]
    np.testing.assert_allclose(mean.get_ydata(), 2.0)
    np.testing.assert_allclose(tip.get_ydata(), 4.0)
    np.testing.assert_array_equal(mean.get_xdata(), np.arange(0, 40, 2))
    plt.close(figure)


@pytest.mark.parametrize(
    ("gravity", "up"),
    [
        (None, (0, 0, 1)),
        ((0.0, 0.0, -1.0), (0, 0, 1)),
        ((0.3, 0.0, 0.95), (0, 0, -1)),  # an arm that hangs, a little tilted
        ((0.0, 1.0, 0.1), (0, -1, 0)),
        ((-1.0, 0.0, 0.0), (1, 0, 0)),
    ],
)
def test_postures_are_drawn_with_the_weight_downward(gravity, up):
    """As rows of the projection say: up is up, and the picture is no mirror image."""
    points = np.zeros((20, 2, 3))
    middle = np.array([0.0, 0.0, 35.0])
    points[:, 1] = 2 * middle + np.random.default_rng(0).uniform(-20, 20, (20, 3))
    table = SimpleNamespace(
        measured_mm=points,
        predicted_mm=points + 1.0,
        error_mm=np.full((20, 2), np.sqrt(3.0)),
        spec=SimpleNamespace(key_points=1),
        drawn_gravity=gravity,
    )
    figure = bodies({"predicted": table})
    figure.canvas.draw()
    axis = next(each for each in figure.axes if hasattr(each, "get_proj"))
    projection = axis.get_proj()
    heights = {}
    for name, place in {"low": np.zeros(3), "high": 10.0 * np.array(up)}.items():
        _, y, _, w = projection @ np.append(middle + place, 1.0)
        heights[name] = y / w
    assert heights["high"] > heights["low"]
    axis.view_init(30.0, -60.0, 0.0, vertical_axis="z")
    usual = axis.get_proj()
    assert np.sign(np.linalg.det(projection)) == np.sign(np.linalg.det(usual))
    plt.close(figure)


@pytest.mark.parametrize("chambers", [1, 3, 4, 6, 8])
def test_the_loops_of_many_chambers_keep_their_size(chambers):
    """A page shows a picture at most 11 inches wide at its own size; a wider one is shrunk."""
    rng = np.random.default_rng(1)
    points = np.zeros((200, 2, 3))
    points[:, -1, 0] = np.linspace(0, 30, 200)
    table = SimpleNamespace(
        pressure=rng.uniform(0, 10, (200, chambers)).cumsum(0),
        measured_mm=points,
        predicted_mm=points + 1.0,
        run=np.zeros(200, int),
    )
    figure = loops(table, "ml")
    figure.canvas.draw()
    wide, high = figure.get_size_inches()
    assert wide <= 11.0
    drawn = [axis for axis in figure.axes if axis.lines]
    of = [f"chamber {number} [ml]" for number in range(1, chambers + 1)]
    assert sorted(axis.get_xlabel() for axis in drawn) == sorted(2 * of)
    for axis in drawn:
        box = axis.get_position()
        assert box.width * wide > 1.8
        assert box.height * high > 1.5
    assert all(not axis.axison for axis in figure.axes if not axis.lines)
    plt.close(figure)


def test_a_chart_of_a_chamber_that_never_moves_alone_says_so():
    """Three runs: chamber 1 alone; chamber 2 and half of the range of 3; both. 4 never moves."""
    rise, still = np.linspace(0.0, 1.0, 100), np.zeros(100)
    chambers = ([rise, still, still], [still, rise, rise], [still, 0.5 * rise, rise])
    pressure = np.stack([*map(np.concatenate, chambers), np.full(300, 3.0)], axis=1)
    points = np.zeros((300, 2, 3))
    points[:, -1, 0] = pressure @ [10.0, 5.0, 5.0, 0.0]
    table = SimpleNamespace(
        pressure=pressure,
        measured_mm=points,
        predicted_mm=points,
        run=np.repeat([0, 1, 2], 100),
    )
    figure = loops(table, "kPa")
    titles = {
        axis.get_xlabel(): axis.get_title() for axis in reversed(figure.axes) if axis.get_xlabel()
    }
    plt.close(figure)
    assert titles == {
        "chamber 1 [kPa]": "",
        "chamber 2 [kPa]": "others move too: 50 % of their range",
        "chamber 3 [kPa]": "others move too: 100 % of their range",
        "chamber 4 [kPa]": "does not move",
    }


def test_the_chart_of_effects_fills_the_page():
    """The page is 1072 px wide inside its margins, and an inch is 96 px."""
    found = Diagnosis(Verdict("unknown_effect", (), "unknown"), ErrorLevels(1.0, 0.1, 0.5), ())
    picture = effects_chart(found)
    wide_pt = float(picture.data.split(b'width="', 1)[1].split(b"pt", 1)[0])
    assert 0.9 * 1072 < wide_pt / 72 * 96 <= 1072
    assert picture.least_px >= 600
