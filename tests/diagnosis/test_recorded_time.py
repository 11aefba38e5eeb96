"""Recorded time of a table of residuals."""

from dataclasses import replace

import numpy as np
import pytest

from surgisoft.diagnosis.residuals import residual_table
from tests.diagnosis.synthetic import recording, still_model, walk


def test_pauses_between_runs_are_no_recorded_time():
    """Two runs of 100 samples at 10 Hz, 9.9 s each, with a pause of 30 s between them."""
    made = recording(np.zeros(200), walk(200))
    later = np.arange(200) // 100
    made = replace(made, t_s=0.1 * np.arange(200) + 30.0 * later, run=later)
    table = residual_table(still_model(), [made, made])
    for number in range(2):
        assert table.recorded_s(number) == pytest.approx(19.8)
