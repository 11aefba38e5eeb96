"""Model folders whose files are damaged: one line, no memory for false sizes, no NaN weights."""

import json
import shutil

import pytest
import torch
from safetensors.torch import load_file, save_file

from surgisoft.errors import InputError
from surgisoft.surrogate.checkpoint import DEFAULT_FOLDER, load_model, save_model


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
        (("format",), "\x1b[2J", r"model format '\\x1b"),
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


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("past_row", lambda row: row + 1, "not among those of the actuation over time"),
        ("past_row", lambda row: row[1:], "does not have the shapes of its rows"),
        ("past_actuation", lambda values: values[:, 1:], "does not have the shapes of its rows"),
        ("past_actuation", lambda values: values / 0, "actuation over time is NaN or infinite"),
        ("past_t_s", lambda t_s: -t_s, "not in order"),
        ("past_run", lambda run: run.flip(0), "not in order"),
        ("past_t_s", None, "missing 1 required"),
        ("past_stood", lambda stood: stood[:-1], "not say of each run where it begins"),
    ],
)
def test_the_actuation_before_the_residuals_fits_them_or_is_refused(folder, name, change, words):
    rows, chambers = load_model("default").training_residuals.actuation.shape
    known = load_file(folder / "known_error.safetensors")
    count = torch.arange(rows, dtype=torch.int32)
    past = {"t_s": count * 0.05, "actuation": torch.ones(rows, chambers), "run": count // 700}
    past |= {"row": count, "stood": torch.full((int(count[-1]) // 700 + 1, chambers), 3.0)}
    past = {f"past_{each}": value for each, value in past.items()}
    former = {each: value for each, value in past.items() if each != "past_stood"}
    save_file(known | former, folder / "known_error.safetensors")
    assert load_model(folder).training_residuals.past.stood is None
    save_model(load_model(folder), folder.parent / "former")
    assert load_model(folder.parent / "former").training_residuals.past.stood is None
    save_file(known | past, folder / "known_error.safetensors")
    kept = load_model(folder).training_residuals.past
    assert torch.equal(kept.row, count)
    assert torch.equal(kept.stood, past["past_stood"])
    save_model(load_model(folder), folder.parent / "again")
    again = load_model(folder.parent / "again").training_residuals.past
    assert all(torch.equal(value, getattr(kept, each)) for each, value in vars(again).items())
    changed = {} if change is None else {name: change(past.pop(name)).contiguous()}
    past.pop(name, None)
    save_file(known | past | changed, folder / "known_error.safetensors")
    with pytest.raises(InputError, match=words):
        load_model(folder)


def test_key_points_that_the_weights_do_not_have_take_no_memory(folder):
    """A billion of them would be 12 GB for the arm at rest alone."""
    config = json.loads((folder / "config.json").read_text())
    config["arm"]["key_points"] = 10**9
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(InputError, match=r"1000000000 key points by config\.json") as caught:
        load_model(folder)
    assert caught.value.__cause__ is None
