"""Measured against predicted bodies as a replay, read back."""

import numpy as np
import pytest

from surgisoft.errors import InputError
from surgisoft.replay.comparison import MOST_ROWS, continued, write_comparison
from tests.replay.reading import column


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
    origins = column(replay.path, "/errors/arrows", "Arrows3D:origins")
    vectors = column(replay.path, "/errors/arrows", "Arrows3D:vectors")
    assert 9 not in origins
    assert len(origins) == 49
    assert len(origins[7]) == 3
    stretch = np.array(vectors[3]) / (predicted - measured)[3]
    assert stretch.min() == pytest.approx(stretch.max(), rel=1e-3)
    assert 1.0 <= stretch.mean() <= 50.0
    np.testing.assert_allclose(origins[3], measured[3], atol=1e-4)
    errors = column(replay.path, "/plots/error/k2", "Scalars:scalars")
    truth = np.linalg.norm((predicted - measured)[:, 2], axis=1)
    assert sorted(set(range(50)) - set(errors)) == [7, 9]
    for row, value in errors.items():
        assert value[0] == pytest.approx(truth[row])
    held = column(replay.path, "/plots/pressure/p2", "Scalars:scalars")
    np.testing.assert_allclose(np.ravel([*held.values()]), pressure[:, 1])
    bodies = column(replay.path, "/measured/body", "LineStrips3D:strips")
    assert sorted(set(range(50)) - set(bodies)) == [7, 9]
    np.testing.assert_allclose(np.array(bodies[0][0])[[0, -1]], measured[0][[0, -1]], atol=1e-4)


def test_runs_follow_one_another_in_time():
    times = continued(np.array([0.0, 0.1, 0.2, 0.0, 0.1, 0.3]))
    np.testing.assert_allclose(times, [0.0, 0.1, 0.2, 0.3, 0.4, 0.6])
    np.testing.assert_allclose(continued(np.array([5.0])), [0.0])


def test_long_comparisons_are_thinned_and_one_key_point_will_do(tmp_path):
    rows = MOST_ROWS + 500
    measured = np.random.default_rng(0).normal(size=(rows, 1, 3))
    path = tmp_path / "one.rrd"
    write_comparison(np.arange(rows), measured, 0.0 * measured, "one", path)
    errors = column(path, "/plots/error/k0", "Scalars:scalars", "time")
    assert len(errors) == MOST_ROWS
    assert max(errors) == (rows - 1) * 10**9
    assert path.stat().st_size < 2e6


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
