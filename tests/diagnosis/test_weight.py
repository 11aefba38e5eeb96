"""Recordings on a turned bench: the arm's own weight is not taken for a wrong effect."""

from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest
import torch

from surgisoft.cli import run
from surgisoft.diagnosis.amend import amend
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.weight import under_weight
from surgisoft.measurement.histories import history_of
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import save_recording
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.checkpoint import default_arm, load_model, save_model


@pytest.fixture(scope="module")
def arm():
    return default_arm()


@pytest.fixture(scope="module")
def turned(arm):
    """A minute and a half of the model's own robot, bare, with its base rolled by 90 degrees."""
    rig = VirtualRig(0, take=7, roll_deg=90.0)
    return rig.record(make_protocol("mixed", rig.limits, 900, seed=2))[0]


def test_the_same_direction_changes_nothing(arm, turned):
    tilt = np.radians(3.0)
    near = np.array(arm.spec.gravity) * np.cos(tilt) + np.array([0, 1.0, 0]) * np.sin(tilt)
    for direction in (np.array(arm.spec.gravity), near / np.linalg.norm(near), None):
        model, notes = under_weight(arm, [replace(turned, gravity=direction)])
        assert model is arm
        assert notes == []


def test_another_direction_is_told_and_frees_the_load(arm, turned):
    model, notes = under_weight(arm, [turned])
    assert model.spec.gravity is None
    assert model.spec == replace(arm.spec, gravity=None)
    # (x, y, z) rolled by 90 degrees is (y, -x, z): the cosine between them is z^2.
    assert f"{np.degrees(np.arccos(arm.spec.gravity[2] ** 2)):.0f} degrees" in notes[0]
    history = history_of([turned])
    with torch.no_grad():
        assert torch.equal(model.predict(history), arm.predict(history))


def test_several_directions_are_told_and_no_load_is_freed(arm, turned):
    model, notes = under_weight(arm, [turned, replace(turned, gravity=np.array(arm.spec.gravity))])
    assert model is arm
    assert "one direction at a time" in notes[-1]


def test_beside_an_unknown_direction_no_load_is_freed(arm, turned):
    """The bench of the second recording may stand as where the model was fitted."""
    model, notes = under_weight(arm, [turned, replace(turned, gravity=None)])
    assert model is arm
    assert "several or unknown directions of weight" in notes[-1]


def test_own_weight_of_a_rolled_arm_is_called_a_load(arm, turned, tmp_path):
    """Truth: nothing but gravity's direction differs from where the model was fitted."""
    model, _ = under_weight(arm, [turned])
    found = diagnose(model, [turned], setup_tests=False)
    # Of all effects the load leaves least. At most one other is named that these recordings do not
    # tell from it: a load that changes little with the posture does what shifted zeros do.
    load = next(row for row in found.ranking if row.effect == "payload")
    assert load.heldout_rmse_mm == min(row.heldout_rmse_mm for row in found.ranking)
    assert found.verdict.kind in ("identified", "ambiguous")
    assert "payload" in found.verdict.effects
    if found.verdict.kind == "ambiguous":
        assert f"payload {load.heldout_rmse_mm:.3g} mm" in found.verdict.sentence
    result = amend(model, [turned], ["payload"], refit="never")
    assert result.held_out.after < 0.25 * result.held_out.before
    save_model(result.model, tmp_path / "turned", {})
    history = history_of([turned])
    with torch.no_grad():
        again = load_model(tmp_path / "turned").predict(history)
        torch.testing.assert_close(again, result.model.predict(history))


def test_commands_tell_of_the_direction(turned, tmp_path, capsys):
    path = tmp_path / "turned.parquet"
    save_recording(turned, path)
    model = str(files("surgisoft") / "assets" / "default_arm")
    assert run(["compare", model, str(path)]) == 0
    said = capsys.readouterr().err
    assert "turned.parquet: the weight pulls along" in said
    assert "35 degrees" in said
