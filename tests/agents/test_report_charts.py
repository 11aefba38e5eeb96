"""Charts of an experiment: what lies between two values, and where an axis ends."""

import numpy as np
from matplotlib import pyplot as plt

from surgisoft.agents import report_charts
from surgisoft.agents.report_charts import spread_chart, sweep_chart


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


def test_shares_are_drawn_from_0_to_1(monkeypatch):
    groups = [("a", [1.0, 1.0]), ("b", [1.0])]
    share, _ = drawn(monkeypatch, lambda: spread_chart("share cut", groups, "share cut"))
    np.testing.assert_allclose(share.get_xlim(), (-0.02, 1.02))
    length, _ = drawn(monkeypatch, lambda: spread_chart("error", groups, "error [mm]"))
    assert length.get_xlim()[0] > 0.5
