"""Model folders whose files are damaged: one line, no memory for false sizes, no NaN weights."""

import json
import shutil

import pytest
import torch
from safetensors.torch import load_file, save_file

from surgisoft.errors import InputError
from surgisoft.surrogate.checkpoint import DEFAULT_FOLDER, load_model


@pytest.fixture
def folder(tmp_path):
    shutil.copytree(DEFAULT_FOLDER, tmp_path / "arm")
    return tmp_path / "arm"


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("last", [True, False])
def test_weights_that_are_not_finite_are_refused(folder, value, last):
    weights = load_file(folder / "weights.safetensors")
    name = (max if last else min)(name for name in weights if name.startswith("network.layers"))
    weights[name].view(-1)[-1] = value
    save_file(weights, folder / "weights.safetensors")
    with pytest.raises(InputError, match=f"1 of {weights[name].numel()} numbers of '{name}'"):
        load_model(folder)


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        (("network", "hidden"), [50_000, 50_000], "by config.json"),
        (("network", "hidden"), [1] * 3000, "not that of the weights"),
        (("network", "key_points"), 10**9, "not that of the weights"),
        (("arm", "low"), [0.0, 0.0, float("nan")], r"arm.low\[2\]: got nan"),
        (("arm", "chambers"), "3", "arm.chambers: got text '3'; expected an integer"),
        (("validation", "rmse_mm"), "small", "rmse_mm: got text 'small'"),
        (("format",), "\x1b[2J", r"model format text '\\x1b"),
    ],
)
def test_a_config_that_does_not_fit_is_one_line(folder, path, value, said):
    config = json.loads((folder / "config.json").read_text())
    node = config
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = value
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(InputError, match=said):
        load_model(folder)


def test_training_residuals_of_other_rows_are_refused(folder):
    known = load_file(folder / "known_error.safetensors")
    known["direction"] = known["direction"][:-1].clone()
    save_file(known, folder / "known_error.safetensors")
    with pytest.raises(InputError, match="do not have the same rows"):
        load_model(folder)
    assert torch.equal(known["actuation"], load_model("default").training_residuals.actuation)


def test_key_points_that_the_weights_do_not_have_take_no_memory(folder):
    """A billion of them would be 12 GB for the arm at rest alone."""
    config = json.loads((folder / "config.json").read_text())
    config["arm"]["key_points"] = 10**9
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(InputError, match=r"1000000000 key points by config\.json") as caught:
        load_model(folder)
    assert caught.value.__cause__ is None
