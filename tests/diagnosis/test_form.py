"""Forms let loose: by the state, and with a strength of their own in each part of the time."""

import numpy as np
import pytest

from surgisoft.diagnosis.candidates import candidates
from surgisoft.diagnosis.residuals import problem_of
from surgisoft.diagnosis.selection import ModelSelection, RelaxedFit, relaxed_fit
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
    """A shift in the second half alone: a steady one leaves most of it, one let loose little."""
    late = np.where(np.arange(ROWS) < ROWS // 2, 0.0, 1.0)
    selection, first = shifted(late)
    found = relaxed_fit(selection, [first[:1]])
    assert found.wrong
    assert found.share > 0.5
    steady, first = shifted(np.ones(ROWS))
    assert not relaxed_fit(steady, [first[:1]]).wrong


@pytest.mark.parametrize(
    ("share", "log_gain", "chance", "wrong"),
    [
        (0.05, 0.4, 0.001, True),  # a twentieth that shows in every block
        (0.12, 0.05, 0.001, True),  # an eighth, in noise
        (0.05, 0.1, 0.001, False),
        (0.05, 0.4, 0.2, False),  # chance
        (-0.2, -0.3, 0.001, False),  # two losses are no gain
    ],
)
def test_when_a_form_is_wrong(share, log_gain, chance, wrong):
    assert RelaxedFit(np.zeros(1), share, log_gain, chance).wrong is wrong
