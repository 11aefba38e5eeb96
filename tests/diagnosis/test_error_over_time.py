"""The picture of the error over time, where motion capture is slower than the log."""

from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np

from surgisoft.diagnosis.pages.pictures import error_over_time


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
