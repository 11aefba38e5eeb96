"""Memory of the actuation against recursions written out step by step."""

import numpy as np
import pytest
import torch

from surgisoft.diagnosis import history_features
from surgisoft.diagnosis.history_features import RADII, TIMES_S, features, memory_of
from surgisoft.surrogate.history import pack
from tests.diagnosis.synthetic import PERIOD_S, backlash, still_model, walk


@pytest.fixture(scope="module")
def two_runs():
    """Two runs of different length; the memory of the second must not know the first."""
    signal = walk(700)
    return signal, memory_of(_history_of(signal), still_model().spec)


def _history_of(signal):
    """Two runs, of 400 rows and the rest."""
    parts = [signal[:400], signal[400:]]
    times = [PERIOD_S * np.arange(400), 40 + PERIOD_S * np.arange(300)]
    points = [torch.zeros(len(part), 3, 3) for part in parts]
    return pack([torch.tensor(t) for t in times], [torch.tensor(p) for p in parts], points)


def test_plays_and_largest_start_afresh_in_each_run(two_runs):
    signal, memory = two_runs
    for k, radius in enumerate(RADII):
        for begin, end in ((0, 400), (400, 700)):
            expected = backlash(signal[begin:end, 1], 5.0 * radius)
            assert memory.play[begin:end, 1, k] == pytest.approx(expected, abs=1e-5)
    assert memory.largest[:400, 0] == pytest.approx(np.maximum.accumulate(signal[:400, 0]))
    assert memory.largest[400:, 0] == pytest.approx(np.maximum.accumulate(signal[400:, 0]))


def test_low_passes_agree_with_fine_steps(two_runs):
    """The same differential equation in a hundred Euler steps a row."""
    signal, memory = two_runs
    for k in (1, 4):
        y, fine = signal[0, 0], [signal[0, 0]]
        for before, now in zip(signal[:399, 0], signal[1:400, 0], strict=True):
            for part in range(100):
                u = before + (part + 0.5) / 100 * (now - before)
                y += PERIOD_S / 100 / TIMES_S[k] * (u - y)
            fine.append(y)
        assert memory.low_pass[:400, 0, k] == pytest.approx(fine, abs=5e-3)
    assert memory.low_pass[400, :, 0] == pytest.approx(signal[400], abs=1e-5)


def test_a_long_history_is_followed_some_runs_at_a_time(two_runs, monkeypatch):
    """With the same memory, two parts of which are kept in single precision."""
    signal, whole = two_runs
    history = _history_of(signal)
    monkeypatch.setattr(history_features, "BLOCK_ROWS", 400)
    blocks = memory_of(history, still_model().spec)
    for name, values in vars(blocks).items():
        exact = name not in ("low_pass", "play")
        assert values.dtype == (np.float64 if exact else np.float32), name
        assert values == pytest.approx(vars(whole)[name], abs=0.0 if exact else 1e-5), name


def test_way_since_reversal_and_dwell_by_hand():
    up, down = np.linspace(0, 8, 41), np.linspace(8, 3, 26)[1:]
    signal = np.concatenate([up, down, np.full(30, 3.0)])[:, None]
    time = torch.tensor(PERIOD_S * np.arange(len(signal)))
    history = pack([time], [torch.tensor(signal)], [torch.zeros(len(signal), 3, 3)])
    memory = memory_of(history, still_model(1).spec)
    # The dead band of 0.1 is crossed twice at the turn: once to leave, once to follow.
    assert memory.since_reversal[40, 0] == pytest.approx(8.0, abs=0.15)
    assert memory.since_reversal[65, 0] == pytest.approx(5.0, abs=0.25)
    assert memory.direction[65, 0] == -1
    assert memory.dwell_s[-1] == pytest.approx(3.0, abs=0.11)
    assert (memory.dwell_s[1:60] < 0.35).all()
    assert memory.rate[30, 0] == pytest.approx(2.0, rel=0.01)


def test_features_are_finite_and_of_order_one(two_runs):
    _, memory = two_runs
    context = np.full((700, 2), np.nan)
    context[:300, 0] = 1.5
    values = features(memory, still_model().spec, context, timed=True)
    assert np.isfinite(values).all()
    assert np.abs(values).max() < 10
    untimed = features(memory, still_model().spec, None, timed=False)
    assert untimed.shape[1] < values.shape[1]


def test_the_arm_dwells_while_no_chamber_moves():
    """The second chamber rests from the start, the first one from 4 s on: since then it dwells."""
    signal = np.stack([np.minimum(np.arange(100) * 0.2, 8.0), np.full(100, 5.0)], axis=1)
    time = torch.tensor(PERIOD_S * np.arange(100))
    memory = memory_of(
        pack([time], [torch.tensor(signal)], [torch.zeros(100, 3, 3)]), still_model().spec
    )
    assert memory.dwell_s[99] == pytest.approx(9.9 - 4.0, abs=0.11)
    assert memory.dwell_s[39] < 0.11


def test_times_and_context_of_some_rows_are_scaled_by_all(two_runs):
    """Two runs from 0 and 40 s on, the last row at 69.9 s; unknown temperatures are the mean."""
    _, memory = two_runs
    assert memory.in_run_s[[0, 399, 400, 699]] == pytest.approx([0.0, 39.9, 0.0, 29.9])
    assert memory.elapsed_s[[0, 399, 400, 699]] == pytest.approx([0.0, 39.9, 40.0, 69.9])
    context = np.full((700, 1), np.nan)
    context[:300] = np.repeat([1.0, 4.0], [200, 100])[:, None]
    spec, rows = still_model().spec, np.array([0, 250, 399, 400])
    whole = features(memory, spec, context, timed=False)
    some = features(memory, spec, context, timed=False, rows=rows)
    np.testing.assert_array_equal(some, whole[rows])
    assert some[:, -1] == pytest.approx([1.0, 4.0, 2.0, 2.0])
    share = np.array([0.0, 25.0, 39.9, 40.0]) / 69.9
    assert some[:, -5:-3] == pytest.approx(np.stack([share, share**2], axis=1))
    in_run = np.array([0.0, 25.0, 39.9, 0.0]) / 39.9
    assert some[:, -3:-1] == pytest.approx(np.stack([in_run, in_run**2], axis=1))


def test_points_at_rest_have_no_time_constants(two_runs):
    """Low passes of each chamber and the dwell time are for rows that follow each other in time."""
    _, memory = two_runs
    timed, settled = (
        features(memory, still_model().spec, None, timed=timed) for timed in (True, False)
    )
    assert timed.shape[1] - settled.shape[1] == 2 * len(TIMES_S) + 1
    np.testing.assert_array_equal(timed[:, : settled.shape[1]], settled)
