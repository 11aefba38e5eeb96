"""Recordings as histories: what comes with the actuation."""

from dataclasses import replace

import numpy as np
import torch

from surgisoft.measurement.histories import actuation_noise, history_of
from surgisoft.measurement.recordings import Recording


def recording(name: str, temperature=None) -> Recording:
    """Two runs of three and two rows, the second long after the first."""
    return Recording(
        name,
        np.array([0.0, 1.0, 2.0, 100.0, 101.0]),
        np.arange(5.0)[:, None],
        np.zeros((5, 2, 3)),
        run=np.array([0, 0, 0, 1, 1]),
        temp_C=temperature,
    )


def test_temperature_goes_with_its_rows_and_is_missing_where_it_was():
    warm = recording("warm", np.array([20.0, 21.0, np.nan, 23.0, 24.0]))
    history = history_of([warm, recording("unknown")])
    nan = torch.nan
    expected = [[20.0, 21.0, nan], [23.0, 24.0, 24.0], [nan] * 3, [nan] * 3]
    assert torch.allclose(history.temperature_C, torch.tensor(expected), equal_nan=True)
    second = history.select(torch.tensor([1]))
    assert second.temperature_C.tolist() == [[23.0, 24.0]]
    assert second.t_s.tolist() == [[100.0, 101.0]]


def test_without_any_temperature_there_is_none():
    assert history_of([recording("unknown")]).temperature_C is None
    nowhere = recording("missing", np.full(5, np.nan))
    assert history_of([nowhere]).temperature_C is None


def test_runs_know_where_the_measured_actuation_stood_when_they_began():
    first = recording("first")
    history = history_of([first, replace(first, kind="settled")])
    nan = torch.nan
    expected = torch.tensor([[0.0], [3.0], [nan], [nan]])
    assert torch.allclose(history.stood, expected, equal_nan=True)
    assert history.select(torch.tensor([1])).stood.tolist() == [[3.0]]
    commanded = replace(first, commanded=first.measured + 50)
    assert history_of([commanded], "commanded").stood.tolist() == [[0.0], [3.0]]


def test_a_step_from_run_to_run_is_no_noise():
    """Thirty runs of two rows, each beginning where the last one ended: steps of 0.1, 0.2, 0.3."""
    steps = np.tile([0.1, 0.2, 0.3], 10)
    ends = np.cumsum(steps * np.tile([1, -1], 15))
    measured = np.stack([np.concatenate([[0.0], ends[:-1]]), ends], axis=1).reshape(60, 1)
    measured = np.concatenate([measured, [[50.0], [51.5]]])  # the range, in a run of its own
    run = np.repeat(np.arange(31), 2)
    made = Recording("pairs", np.arange(62.0), measured, np.zeros((62, 1, 3)), run=run)
    expected = 1.4826 * 0.2 / np.sqrt(2)
    np.testing.assert_allclose(actuation_noise(made), [expected], rtol=1e-6)
