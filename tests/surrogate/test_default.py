"""The arm that ships, against the virtual rig that it was fitted to."""

import json
from importlib.resources import files

import numpy as np
import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.measurement.histories import history_of
from surgisoft.measurement.protocols import make_protocol
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.checkpoint import default_arm, load_model, load_training_residuals


def test_it_predicts_an_unseen_random_walk_on_the_rig():
    """Root mean square over 80 settled points and all key points; one point moves by 30 mm."""
    rig = VirtualRig(0)
    recording, _ = rig.record(make_protocol("walk", rig.limits, 80, seed=5))
    model = default_arm()
    history = history_of([recording], model.spec.actuation)
    with torch.no_grad():
        predicted = model.predict(history)[history.valid]
    measured = history.key_points[history.valid]
    error = (predicted - measured).square().sum(-1).mean().sqrt().item()
    moved = np.ptp(measured[:, -1].numpy(), axis=0).max()
    assert moved > 10.0
    assert error < 0.4


def test_its_folder_states_its_validation():
    folder = files("surgisoft") / "assets" / "default_arm"
    report = json.loads((folder / "report.json").read_text())
    kept = [stage["valid_rmse_mm"] for stage in report["stages"] if stage["kept"]]
    assert default_arm().validation.rmse_mm == kept[-1] < 0.2
    assert "surgisoft fit" in (folder / "SOURCE.md").read_text()


def test_the_word_default_opens_it(tmp_path, monkeypatch):
    """Unless a folder has that name."""
    monkeypatch.chdir(tmp_path)
    assert load_model("default").summary() == default_arm().summary()
    (tmp_path / "default").mkdir()
    with pytest.raises(InputError, match="no arm model there"):
        load_model("default")


def test_where_its_network_is_off_comes_with_it():
    """The residual on rows of its fit, as large as what it was validated to."""
    known, model = load_training_residuals("default"), default_arm()
    size = known.residual_mm.square().sum(-1).mean().sqrt().item()
    assert 0.03 < size < 1.5 * model.validation.rmse_mm
    assert known.actuation.shape[1] == model.spec.chambers
