"""Predictions for single rows of a sample, against those of the model for every row."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.diagnosis.setup.sample import Arrangement, sample_of
from surgisoft.measurement.histories import history_of
from surgisoft.surrogate.checkpoint import default_arm
from surgisoft.surrogate.effects import make_effect
from tests.diagnosis.setup.recordings import measured

ROWS = 600


@pytest.mark.parametrize("effect", [None, "payload"])
def test_single_rows_are_those_of_the_whole_prediction(effect):
    """Also behind an effect of the body, whose model is no function of single rows."""
    model, recording = default_arm(), measured(ROWS)
    if effect:
        load = make_effect(effect, model.facts)
        with torch.no_grad():
            for amplitude in load.amplitudes().values():
                amplitude.fill_(0.5)
        model = model.replace(effects={**model.effects, effect: load})
    assert model.row_wise is (effect is None)
    swapped = Arrangement((1, 0, 2), (1.0, 1.0, 1.0))
    driven = history_of([recording])
    driven = type(driven)(**{**vars(driven), "pressure": driven.pressure[..., [1, 0, 2]]})
    with torch.no_grad():
        truth = model.predict(driven)[0].numpy()
    rows = np.array([3, 599, 250, 3])
    found = sample_of(model, [recording], ROWS).along(swapped)
    assert np.abs(found(rows) - truth[rows]).max() < 1e-4
    assert np.abs(found.whole - truth).max() < 1e-4
    assert np.abs(found(rows) - truth[rows]).max() < 1e-4


def test_the_network_computes_each_row_once():
    model, given = default_arm(), []
    found = sample_of(model, [measured(ROWS)], ROWS).along(Arrangement.as_recorded(3))
    hook = model.network.register_forward_pre_hook(lambda _, inputs: given.append(len(inputs[0])))
    first, second = found(np.array([3, 599, 250, 3])), found(np.array([250, 7, 3]))
    found(np.array([7, 599]))
    hook.remove()
    assert given == [3, 1]
    assert np.array_equal(second[[0, 2]], first[[2, 0]])
    assert np.abs(second[1] - found.whole[7]).max() < 1e-4


@pytest.mark.parametrize("first", [0, 1])
def test_cameras_slower_than_the_log_are_seen_by_the_coarse_sample(first):
    """Key points in every second row: of every fourth row none has one, or all have."""
    recording = measured(ROWS)
    points = np.full_like(recording.key_points_mm, np.nan)
    points[first::2] = recording.key_points_mm[first::2]
    found = sample_of(default_arm(), [replace(recording, key_points_mm=points)], ROWS // 4)
    assert (found.block >= 0).mean() > 0.25
