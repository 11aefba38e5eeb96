"""Measured against predicted bodies as a replay, read back."""

import numpy as np
import pytest
import rerun.blueprint as rrb
from rerun.components import AggregationPolicy

from surgisoft.error_scale import bar_length, error_scale
from surgisoft.errors import InputError
from surgisoft.replay.comparison import MOST_ROWS, write_change, write_comparison
from surgisoft.tasks.episodes.parts import Event
from surgisoft.time_axis import continued, pauses, with_gaps
from tests.replay.reading import column, entities


def made_up(rows=50):
    rng = np.random.default_rng(1)
    heights = np.linspace(0.0, 70.0, 4)
    predicted = np.zeros((rows, 4, 3))
    predicted[..., 2] = heights
    predicted[..., 0] = heights / 70.0 * rng.uniform(-5, 5, (rows, 1))
    measured = predicted + rng.normal(0.0, 0.3, predicted.shape)
    measured[7, 2] = np.nan
    measured[9] = np.nan
    return 0.1 * np.arange(rows), measured, predicted


def test_errors_are_arrows_from_measured_to_predicted(tmp_path):
    t_s, measured, predicted = made_up()
    pressure = np.column_stack((t_s, 2.0 * t_s))
    replay = write_comparison(t_s, measured, predicted, "m on r", tmp_path / "c.rrd", pressure)
    origins = column(replay.path, "/model1/errors/arrows", "Arrows3D:origins")
    vectors = column(replay.path, "/model1/errors/arrows", "Arrows3D:vectors")
    assert 9 not in origins
    assert len(origins) == 49
    assert len(origins[7]) == 3
    stretch = np.array(vectors[3]) / (predicted - measured)[3]
    assert stretch.min() == pytest.approx(stretch.max(), rel=1e-3)
    assert 1.0 <= stretch.mean() <= 50.0
    np.testing.assert_allclose(origins[3], measured[3], atol=1e-4)
    errors = column(replay.path, "/plots/error/model1/k2", "Scalars:scalars")
    truth = np.linalg.norm((predicted - measured)[:, 2], axis=1)
    assert sorted(set(range(50)) - set(errors)) == [7, 9]
    for row, value in errors.items():
        assert value[0] == pytest.approx(truth[row])
    held = column(replay.path, "/plots/pressure/p2", "Scalars:scalars")
    np.testing.assert_allclose(np.ravel([*held.values()]), pressure[:, 1])
    bodies = column(replay.path, "/measured/body", "LineStrips3D:strips")
    assert sorted(set(range(50)) - set(bodies)) == [7, 9]
    np.testing.assert_allclose(np.array(bodies[0][0])[[0, -1]], measured[0][[0, -1]], atol=1e-4)


def test_peaks_of_errors_and_changes_stay_in_sight(tmp_path):
    """Where several rows share a column of pixels, the viewer would draw their mean."""
    t_s, measured, predicted = made_up()
    path = tmp_path / "c.rrd"
    write_comparison(t_s, measured, {"a": predicted, "b": measured}, "x", path, np.ones((50, 1)))
    most, mean = [AggregationPolicy.Max.value], [AggregationPolicy.Average.value]
    for entity, kept in (("error/model2/k3", most), ("tip/model1", most), ("pressure/p1", mean)):
        held = column(path, f"/plots/{entity}", "SeriesLines:aggregation_policy")
        assert held == {-1: kept}, entity
    write_change(t_s, measured, predicted, predicted - measured, "x", path)
    for entity, kept in (("size/k2", most), ("change/measured", mean)):
        held = column(path, f"/plots/{entity}", "SeriesLines:aggregation_policy")
        assert held == {-1: kept}, entity


def test_an_explained_change_is_drawn_to_the_scale_of_the_measured_one(tmp_path):
    """Effects that explain two fifths of it: arrows of two fifths, from the same points."""
    t_s, before, _ = made_up()
    change = np.random.default_rng(2).normal(0.0, 0.5, before.shape)
    replay = write_change(t_s, before, before + change, 0.4 * change, "x", tmp_path / "c.rrd")
    arrows = {
        name: column(replay.path, f"/change/{name}", "Arrows3D:vectors")
        for name in ("measured", "explained")
    }
    stretch = np.array(arrows["measured"][3]) / change[3]
    assert stretch.min() == pytest.approx(stretch.max(), rel=1e-3)
    assert stretch.mean() > 1.0
    for row in (3, 7):
        whole, part = (np.array(arrows[name][row]) for name in ("measured", "explained"))
        np.testing.assert_allclose(part, 0.4 * whole, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("apart_mm", [0.0, 0.5])
def test_both_bodies_are_seen_where_they_nearly_coincide(tmp_path, apart_mm):
    """A thicker body around the other leaves parts of it free; both end at base and tip."""
    path = tmp_path / "c.rrd"
    measured = np.zeros((2, 4, 3))
    measured[..., 2] = np.linspace(0.0, 70.0, 4)
    predicted = measured + np.array([apart_mm, 0.0, 0.0])
    write_comparison(np.arange(2.0), measured, predicted, "m on r", path)
    (solid,) = column(path, "/measured/body", "LineStrips3D:strips")[1]
    dashed = np.array(column(path, "/model1/body", "LineStrips3D:strips")[1])
    ends = dashed[:, [0, -1]]
    np.testing.assert_allclose(dashed[..., 0], apart_mm, atol=1e-6)
    assert (ends[0, 0, 2], ends[-1, 1, 2]) == (pytest.approx(0.0), pytest.approx(70.0))
    free = ends[1:, 0, 2] - ends[:-1, 1, 2]
    inner = column(path, "/measured/body", "LineStrips3D:radii")[-1][0]
    outer = column(path, "/model1/body", "LineStrips3D:radii")[-1][0]
    assert 70.0 * 0.3 < free.sum() < 70.0 * 0.6, "of the measured body between the dashes"
    assert outer > inner + 0.2
    assert free.min() > 2 * outer, "wider than the dashes are thick: seen from the side, too"
    np.testing.assert_allclose(np.array(solid)[[0, -1], 2], [0.0, 70.0], atol=1e-5)


def test_several_models_have_one_scale(tmp_path):
    """The model with a tenth of the error is drawn with a tenth of the arrows, and darker."""
    t_s, measured, predicted = made_up()
    better = measured + 0.1 * (predicted - measured)
    models = {"old": predicted, "new": better}
    events = [Event(2.0, "warning", "worst")]
    path = tmp_path / "two.rrd"
    write_comparison(t_s, measured, models, "both", path, seen="words", events=events)
    arrows = [column(path, f"/model{i}/errors/arrows", "Arrows3D:vectors") for i in (1, 2)]
    np.testing.assert_allclose(arrows[1][3], 0.1 * np.array(arrows[0][3]), atol=1e-4)
    shades = [column(path, f"/model{i}/errors/points", "Points3D:colors")[3][-1] for i in (1, 2)]
    red = [shade >> 24 for shade in shades]
    assert red[0] > red[1]
    assert {"/seen", "/legend", "/events", "/bars"} <= entities(path)
    tips = column(path, "/plots/tip/model2", "Scalars:scalars")
    assert tips[3][0] == pytest.approx(np.linalg.norm(better[3, -1] - measured[3, -1]))
    texts = column(path, "/events", "TextLog:text", "time")
    assert list(texts) == [2 * 10**9]
    assert "worst" in texts[2 * 10**9][0]


def test_the_title_of_a_view_states_the_rms_error(tmp_path, monkeypatch):
    """Errors of 1 and 7 mm in equal numbers: 5 mm, and not their mean of 4."""
    titles, space = [], rrb.Spatial3DView

    def noted(**given):
        titles.append(given["name"])
        return space(**given)

    monkeypatch.setattr(rrb, "Spatial3DView", noted)
    measured = np.zeros((20, 2, 3))
    measured[:, 1, 2] = 70.0
    measured[:, 1, 0] = np.linspace(-20.0, 20.0, 20)
    predicted = measured + [[[1.0, 0.0, 0.0]], [[7.0, 0.0, 0.0]]] * 10
    write_comparison(0.1 * np.arange(20), measured, predicted, "x", tmp_path / "c.rrd")
    (title,) = titles
    assert "error 5 mm" in title


@pytest.mark.parametrize("change", [False, True])
@pytest.mark.parametrize(
    ("gravity", "up"),
    [(None, (0, 0, 1)), ((0.0, 0.0, 1.0), (0, 0, -1)), ((2.0, 0.0, 0.0), (-1, 0, 0))],
)
def test_the_weight_is_drawn_downward(change, gravity, up, tmp_path, monkeypatch):
    """So that a hanging arm hangs; the eye is above the middle, and the bars are below the arm."""
    eyes, controls = [], rrb.EyeControls3D

    def noted(**given):
        eyes.append(given)
        return controls(**given)

    monkeypatch.setattr(rrb, "EyeControls3D", noted)
    t_s, measured, predicted = made_up()
    path = tmp_path / "c.rrd"
    if change:
        write_change(t_s, measured, predicted, predicted - measured, "x", path, gravity)
    else:
        write_comparison(t_s, measured, predicted, "x", path, gravity=gravity)
    (eye,) = eyes
    np.testing.assert_allclose(eye["eye_up"], up, atol=1e-12)
    points = measured[np.isfinite(measured).all(-1)]
    assert (eye["position"] - eye["look_target"]) @ up > 0.0
    if not change:
        (bars,) = column(path, "/bars", "LineStrips3D:strips").values()
        heights = np.array(bars).reshape(-1, 3) @ up
        assert heights.max() < (points @ up).min() - 5.0
        assert np.ptp(heights.reshape(2, 2), axis=1) == pytest.approx([0.0, 0.0], abs=1e-4)


def test_the_scale_is_that_of_the_worst_model_in_round_numbers():
    body = np.zeros((40, 2, 3))
    body[:, 1, 2] = 70.0
    body[:, 1, 0] = np.linspace(-60, 60, 40)
    small, large = np.full((40, 2), 0.13), np.full((40, 2), 0.9)
    both = error_scale(body, [small, large])
    assert (both.large_mm, both.stretch) == (1.0, 20.0)
    assert both == error_scale(body, [large])
    assert error_scale(body, [small]).large_mm == 0.2
    assert error_scale(body, [small, large], 3.0).large_mm == 3.0
    assert [bar_length(x) for x in (0.99, 1.0, 4.9, 17.5, 70.0)] == [0.5, 1.0, 2.0, 10.0, 50.0]


def test_no_line_crosses_a_pause():
    time_s = np.array([0.0, 0.1, 0.2, 9.0, 9.1])
    assert pauses(time_s).tolist() == [2]
    times, values = with_gaps(time_s, np.arange(5.0))
    assert times.tolist() == [0.0, 0.1, 0.2, 0.2, 9.0, 9.1]
    np.testing.assert_array_equal(values, [0, 1, 2, np.nan, 3, 4])


def test_runs_follow_one_another_in_time():
    times = continued(np.array([0.0, 0.1, 0.2, 0.0, 0.1, 0.3]))
    np.testing.assert_allclose(times, [0.0, 0.1, 0.2, 0.3, 0.4, 0.6])
    np.testing.assert_allclose(continued(np.array([5.0])), [0.0])


def test_long_comparisons_are_thinned_and_one_key_point_will_do(tmp_path):
    rows = MOST_ROWS + 500
    measured = np.random.default_rng(0).normal(size=(rows, 1, 3))
    path = tmp_path / "one.rrd"
    write_comparison(np.arange(rows), measured, 0.0 * measured, "one", path)
    errors = column(path, "/plots/error/model1/k0", "Scalars:scalars", "time")
    assert len(errors) == MOST_ROWS
    assert max(errors) == (rows - 1) * 10**9
    assert path.stat().st_size < 2e6


@pytest.mark.parametrize("row", [1, 3000, 3001, 2 * MOST_ROWS - 2])
def test_a_peak_of_one_row_is_in_the_replay_of_a_long_comparison(row, tmp_path):
    rows = 2 * MOST_ROWS
    measured = np.zeros((rows, 2, 3))
    predicted = np.full((rows, 2, 3), [0.1, 0.0, 0.0])
    predicted[row, 1] = [0.0, 7.0, 0.0]
    measured[5, 0] = np.nan
    path = tmp_path / "peak.rrd"
    write_comparison(np.arange(rows), measured, predicted, "peak", path)
    errors = column(path, "/plots/error/model1/k1", "Scalars:scalars", "time")
    assert len(errors) == MOST_ROWS
    assert errors[row * 10**9] == pytest.approx([7.0])
    write_change(np.arange(rows), measured, predicted, 0.0 * measured, "peak", path)
    sizes = column(path, "/plots/size/k1", "Scalars:scalars", "time")
    assert sizes[row * 10**9] == pytest.approx([7.0])


def test_what_does_not_fit_is_one_line(tmp_path):
    t_s, measured, predicted = made_up()
    path = tmp_path / "c.rrd"
    with pytest.raises(InputError, match="do not fit"):
        write_comparison(t_s, measured, predicted[:-1], "x", path)
    with pytest.raises(InputError, match=r"expected \(S, n, 3\)"):
        write_comparison(t_s, measured[..., 0], predicted, "x", path)
    with pytest.raises(InputError, match="nothing to draw"):
        write_comparison(t_s, np.nan * measured, predicted, "x", path)
    with pytest.raises(InputError, match=r"expected \.rrd"):
        write_comparison(t_s, measured, predicted, "x", tmp_path / "c.txt")
    assert not list(tmp_path.iterdir())
