"""Charts of an experiment: what lies between two values, and where an axis ends."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib import pyplot as plt

from surgisoft.agents import report_charts
from surgisoft.agents.report_charts import (
    clearance_chart,
    error_chart,
    path_chart,
    spread_chart,
    sweep_chart,
)


def drawn(monkeypatch, call):
    """The axes that a chart function draws."""
    figures = []

    def keep(figure, alt, caption=""):
        figures.append((figure, caption))

    monkeypatch.setattr(report_charts, "chart", keep)
    call()
    ((figure, caption),) = figures
    plt.close(figure)
    return figure.axes[0], caption


def test_numbers_that_are_names_have_no_line_between_them(monkeypatch):
    lines = {"expert": [(1, 0.9, 0.8, 1.0), (3, 0.7, 0.5, 0.9)], "own": [(1, 0.2, 0.1, 0.3)]}
    axis, caption = drawn(monkeypatch, lambda: sweep_chart("fault.chamber", "success", lines))
    assert axis.get_xticks().tolist() == [1.0, 3.0]
    assert {line.get_linestyle() for line in axis.lines} == {"None"}
    ends = sorted(
        {round(v, 3) for c in axis.collections for s in c.get_segments() for v in s[:, 1]}
    )
    assert ends == [0.1, 0.3, 0.5, 0.8, 0.9, 1.0], "the intervals"
    assert caption.startswith("Lines")


def test_amounts_are_joined_and_the_highest_line_is_inside_the_frame(monkeypatch):
    lines = {"expert": [(0.5, 0.97, 0.96, 0.98), (2.0, 0.96, 0.95, 0.97)]}
    axis, caption = drawn(monkeypatch, lambda: sweep_chart("fault.at_s", "time in sight", lines))
    assert axis.lines[0].get_linestyle() == "-"
    low, high = axis.get_ylim()
    assert low == 0.0
    assert high > 1.03 * 0.98
    assert caption.startswith("Shaded")


def test_an_error_without_bound_leaves_a_gap(monkeypatch):
    """Of a file whose numbers are damaged."""
    log = SimpleNamespace(
        measures={"beam_error_mm": np.array([0.5, np.inf, np.nan, 1e300, 0.25])},
        time_s=np.arange(5.0), beams={"laser": None},
    )  # fmt: skip
    axis, caption = drawn(monkeypatch, lambda: error_chart(log))
    np.testing.assert_array_equal(axis.lines[0].get_ydata(), [0.5, np.nan, np.nan, np.nan, 0.25])
    assert axis.get_ylim() == (0.0, 1.08 * 0.5)
    assert caption == "Largest 0.5 mm"
    log.measures["beam_error_mm"][:] = np.inf
    assert error_chart(log) is None
    log.clearance_mm, log.limits = np.array([-np.inf, 3.0, -2.0, np.nan, np.inf]), {}
    axis, _ = drawn(monkeypatch, lambda: clearance_chart(log))
    assert axis.get_ylim()[0] == pytest.approx(-2.2)


def test_on_an_organ_that_moves_the_error_is_that_on_the_tissue(monkeypatch):
    measures = {"beam_error_mm": np.array([0.1, 0.1]), "tissue_error_mm": np.array([0.4, 0.75])}
    log = SimpleNamespace(measures=measures, time_s=np.arange(2.0), beams={"laser": None})
    axis, caption = drawn(monkeypatch, lambda: error_chart(log))
    np.testing.assert_array_equal(axis.lines[0].get_ydata(), [0.4, 0.75])
    assert axis.get_title() == "error on the tissue while the beam is on"
    assert caption == "Largest 0.75 mm"


def test_steps_at_which_no_error_is_measured_are_grey_and_not_the_largest(monkeypatch):
    """The reference waits for two rows while the arm comes from 11.9 mm away."""
    apart = np.array([11.9, 4.0, 0.05, 0.12, 0.1])
    measured = np.where(np.arange(5) < 2, np.nan, apart)
    log = SimpleNamespace(
        measures={"error_mm": measured}, error_mm=apart, time_s=np.arange(5.0), beams={}
    )
    axis, caption = drawn(monkeypatch, lambda: error_chart(log))
    counted, left_out = (line.get_ydata() for line in axis.lines)
    np.testing.assert_array_equal(counted, measured)
    np.testing.assert_array_equal(left_out, [11.9, 4.0, 0.05, np.nan, np.nan])
    assert axis.get_ylim()[1] == pytest.approx(1.08 * 11.9)
    assert caption == "Largest 0.12 mm; grey: the numbers do not count these steps"
    log.measures["error_mm"] = apart
    axis, caption = drawn(monkeypatch, lambda: error_chart(log))
    assert len(axis.lines) == 1
    assert caption == "Largest 11.9 mm"


def test_targets_in_turn_are_points_and_the_way_between_them_has_no_gap(monkeypatch):
    """Three targets 12 to 14 mm apart, and an arm that passes between two of them in a step."""
    places = np.array([[8.0, 0.0, 0.0], [-4.0, 7.0, 0.0], [-4.0, -7.0, 0.0]])
    log = SimpleNamespace(
        path_mm=np.zeros((0, 3)), paths_mm=[], target_mm=np.repeat(places, 5, axis=0),
        actual_mm=np.repeat(places, 5, axis=0) + 0.1, rows=15, beams={}, one_ring=False,
    )  # fmt: skip
    axis, _ = drawn(monkeypatch, lambda: path_chart(log))
    reference, points, done = (np.stack(line.get_data(), axis=1) for line in axis.lines)
    assert np.isnan(reference).any(), "no line where the target jumps"
    apart = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
    np.testing.assert_allclose(sorted(apart), [193.0**0.5, 193.0**0.5, 14.0], rtol=1e-6)
    assert np.isfinite(done).all()
    moving = np.arange(15.0)
    log.target_mm = np.stack((moving, moving**2 / 99.0, 0.0 * moving), axis=1)
    axis, _ = drawn(monkeypatch, lambda: path_chart(log))
    assert len(axis.lines) == 2, "one that moves has no such points"


def test_lengths_over_several_decades_have_a_logarithmic_axis(monkeypatch):
    """A learned policy beside the expert: their errors would lie on one spot at 0."""
    groups = [("tc1", [5.0, 7.5]), ("scripted", [3.6e-6, 4.0e-6])]
    axis, _ = drawn(monkeypatch, lambda: spread_chart("error", groups, "error mean [mm]"))
    assert axis.get_xscale() == "log"
    for label, values in (("error mean [mm]", [0.2, 5.0]), ("reward", [1e-6, 5.0])):
        axis, _ = drawn(monkeypatch, lambda v=values, x=label: spread_chart(x, [("a", v)], x))
        assert axis.get_xscale() == "linear"


def test_shares_are_drawn_from_0_to_1(monkeypatch):
    groups = [("a", [1.0, 1.0]), ("b", [1.0])]
    share, _ = drawn(monkeypatch, lambda: spread_chart("share cut", groups, "share cut"))
    np.testing.assert_allclose(share.get_xlim(), (-0.02, 1.02))
    length, _ = drawn(monkeypatch, lambda: spread_chart("error", groups, "error [mm]"))
    assert length.get_xlim()[0] > 0.5


def test_labels_of_small_numbers_stand_side_by_side(monkeypatch):
    groups = [("sim", [1e-5, 1.7e-3]), ("rig", [3.5e-4])]
    axis, _ = drawn(monkeypatch, lambda: spread_chart("error", groups, "beam error, mean [mm]"))
    axis.figure.draw_without_rendering()
    boxes = [label.get_window_extent() for label in axis.get_xticklabels() if label.get_text()]
    assert len(boxes) >= 3
    assert all(one.x1 < other.x0 for one, other in pairwise(boxes))


def test_a_sweep_without_any_value_is_an_empty_chart(monkeypatch):
    """As of the beam's error where the beam was never on; a warning fails the test."""
    lines = {"sim": [(30.0, np.nan, np.nan, np.nan), (40.0, np.nan, np.nan, np.nan)]}
    axis, _ = drawn(monkeypatch, lambda: sweep_chart("task.cut_s", "beam error", lines))
    assert axis.get_ylim() == (0.0, 1.0)
    lines["sim"][1] = (40.0, 2.0, 1.0, 3.0)
    axis, _ = drawn(monkeypatch, lambda: sweep_chart("task.cut_s", "beam error", lines))
    assert axis.get_ylim() == (0.0, pytest.approx(1.06 * 3.0))
