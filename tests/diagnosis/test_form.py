"""Relaxed forms: by the state, and with amplitudes of their own in each part of the time."""

import numpy as np

from surgisoft.diagnosis.candidates import candidates
from surgisoft.diagnosis.residuals import problem_of
from surgisoft.diagnosis.selection import ModelSelection, relaxed_fit
from surgisoft.surrogate.model import Validation
from tests.diagnosis.synthetic import recording, still_model, walk

ROWS = 4000
PRESSURE = walk(ROWS)


def shifted(size_mm: np.ndarray):
    """A selection for an arm whose whole body is measured size_mm (S,) aside."""
    model = still_model()
    model.validation = Validation(0.1, (0.1, 0.1, 0.1), ROWS)
    problem = problem_of(model, [recording(size_mm, PRESSURE)])
    selection = ModelSelection.of(problem, candidates(problem, ["misalignment"]))
    return selection, selection.scores()


def test_what_comes_at_once_is_no_steady_frame():
    """A shift in the second half alone: a steady one leaves most of it, its relaxed form little."""
    late = np.where(np.arange(ROWS) < ROWS // 2, 0.0, 1.0)
    selection, first = shifted(late)
    found = relaxed_fit(selection, first[:1])
    assert 0.5 < found.share <= 1.0
    assert found.p_value < 0.05
    steady, first = shifted(np.ones(ROWS))
    assert relaxed_fit(steady, first[:1]).share < 0.02
