"""The live view of a run, as a file."""

import numpy as np
import pytest
from rerun.components import AggregationPolicy

from surgisoft.replay.live_view import LiveBench, live_blueprint, live_view
from surgisoft.viewpoint import upright
from tests.replay.reading import column, values_of


def test_lines_end_where_the_arm_rests_between_two_runs(tmp_path):
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 60.0]])
    with live_view(LiveBench(3, 2, "kPa", 70.0, "a bench", False), file=tmp_path / "a.rrd") as view:
        for t_s in (0.0, 0.5, 1.0, 30.0, 30.5):
            view.sample(t_s, points, points + 0.1, np.ones(3), np.ones(3), 0.2)
    for entity, count in (("pressure/measured", 3), ("residual/key_points", 2), ("alarm/level", 1)):
        held = column(tmp_path / "a.rrd", f"/plots/{entity}", "Scalars:scalars", "time")
        broken = {round(t * 1e-9, 6): len(v) for t, v in held.items() if np.isnan(v).all()}
        assert broken == {1.001: count}, entity
        assert len([t for t in held if t >= 0]) == 5 + 1, "and every sample"


def test_peaks_of_errors_and_of_the_alarm_level_stay_in_sight(tmp_path):
    """Where several samples share a column of pixels, the viewer would draw their mean."""
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 60.0]])
    with live_view(LiveBench(3, 2, "kPa", 70.0, "a bench", True), file=tmp_path / "a.rrd") as view:
        view.sample(0.0, points, points + 0.1, np.ones(3), np.ones(3), 0.2)
    kept = {
        place: column(tmp_path / "a.rrd", f"/plots/{place}", "SeriesLines:aggregation_policy")[-1]
        for place in ("residual/key_points", "alarm/level", "tracking/error", "pressure/measured")
    }
    most, mean = AggregationPolicy.Max.value, AggregationPolicy.Average.value
    assert list(kept.values()) == [[most], [most], [most], [mean]]


@pytest.mark.parametrize(
    ("error_mm", "length_mm", "large_mm", "stretch"),
    [(None, 70.0, 1.0, 10.0), (0.1, 70.0, 1.0, 10.0), (1.1, 260.0, 5.0, 5.0)],
)
def test_the_scale_of_residuals_follows_the_error_of_the_model(
    error_mm, length_mm, large_mm, stretch
):
    """Three validated errors of 1.1 mm are 3.3 mm, 5 mm rounded up; such an arrow is drawn at most
    0.15 of 260 mm = 39 mm long, which 5 times as long is and 10 times as long is not."""
    bench = LiveBench(6, 6, "ml", length_mm, "a bench", False, error_mm)
    assert (bench.large_mm, bench.stretch) == (large_mm, stretch)
    assert f"from 0 to {large_mm:g} mm" in bench.legend
    assert f"{stretch:g} times as long" in bench.legend


@pytest.mark.parametrize(
    ("gravity", "tip"),
    [
        (None, (0, 1)),  # upright
        ((0.0, 0.0, -9.81), (0, 1)),
        ((0.0, 0.0, 1.0), (0, -1)),  # hanging
        ((1.0, 0.0, 0.0), (1, 0)),  # lying to the right
        ((0.0, -1.0, 0.0), (1, 0)),
    ],
)
def test_an_arm_is_drawn_as_its_weight_pulls(gravity, tip):
    side, into, up = upright(gravity)
    axes = np.stack([side, into, up])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0), "no mirror image"
    along = np.array([0.0, 0.0, 1.0])
    assert (side @ along, up @ along) == pytest.approx(tip)
    bench = LiveBench(3, 2, "kPa", 70.0, "a bench", False, None, gravity)
    assert live_blueprint(bench) is not None


def test_a_long_event_is_shown_in_lines(tmp_path):
    """The viewer shows one line of a text, and cuts it at the edge of its table."""
    text = "the model has not been valid since 117.4 s; this was detected at 125.3 s (7.9 s later)"
    with live_view(LiveBench(3, 2, "kPa", 70.0, "a bench", False), file=tmp_path / "a.rrd") as view:
        view.event(125.3, text, serious=True)
    rows = values_of(tmp_path / "a.rrd", "/events")
    lines = [row[0] for row in rows["TextLog:text"]]
    assert rows["TextLog:level"] == [["ERROR"]] * len(lines)
    assert len(lines) > 1
    assert max(map(len, lines)) <= 64
    assert " ".join(" ".join(lines).split()) == f"125.3 s {text}"
