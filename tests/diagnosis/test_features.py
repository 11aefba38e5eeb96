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
