"""A model's folder: who may read it, and what comes back from it."""

import errno
import json
import os
import re
import stat
from pathlib import Path

import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.surrogate.checkpoint import (
    OWN_FILES,
    claim_folder,
    default_arm,
    load_model,
    save_model,
)
from surgisoft.surrogate.interval import ErrorInterval
from surgisoft.surrogate.model import Validation

INTERVAL = ErrorInterval(
    (0.5, 0.95), ((0.1, 0.2), (0.3, 0.5)), (2.0, 2.0), 80, 4, "held-out rows", 0.05
)


@pytest.mark.parametrize("mask", [0o022, 0o027, 0o077])
def test_the_umask_decides_who_may_read_a_model(tmp_path, mask):
    before = os.umask(mask)
    try:
        save_model(default_arm(), tmp_path / "arm", {})
    finally:
        os.umask(before)
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "arm").iterdir()}
    assert modes == dict.fromkeys(OWN_FILES, 0o666 & ~mask)
    assert stat.S_IMODE((tmp_path / "arm").stat().st_mode) == 0o777 & ~mask


def test_all_that_a_model_knows_of_its_error_comes_back(tmp_path):
    arm = default_arm()
    arm.validation = Validation(0.4, (0.2, None, 0.3, 0.4, 0.5), 99, 0.02, INTERVAL, 0.7)
    save_model(arm, tmp_path / "arm")
    again = load_model(tmp_path / "arm")
    assert again.validation == arm.validation
    assert again.fitted_rows == arm.fitted_rows
    residuals = [each.training_residuals.residual_mm for each in (again, arm)]
    assert torch.equal(*(torch.as_tensor(each) for each in residuals))
    assert not any(parameter.requires_grad for parameter in again.parameters())
    assert not again.training
    arm.validation = Validation()
    save_model(arm, tmp_path / "new")
    assert load_model(tmp_path / "new").validation == Validation()


def test_a_shape_at_rest_of_other_key_points_is_refused(tmp_path):
    arm = default_arm()
    save_model(arm, tmp_path / "arm")
    file = tmp_path / "arm" / "config.json"
    config = json.loads(file.read_text())
    config["arm"]["key_points"] = 4
    file.write_text(json.dumps(config))
    with pytest.raises(InputError, match=r"4 key points by config.json, 'rest_mm' has shape \[5"):
        load_model(tmp_path / "arm")


def training_run(folder: Path) -> None:
    """A folder as of `surgisoft train`: a configuration, weights and a report of another kind."""
    folder.mkdir()
    (folder / "config.json").write_text('{"task": "reach", "seed": 0}')
    (folder / "weights.safetensors").write_bytes(b"a week of training")
    (folder / "report.json").write_text("{}")


def damaged(folder: Path) -> None:
    folder.mkdir()
    (folder / "config.json").write_text("{")


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (Path.touch, "is a file, expected a folder; choose another name"),
        (Path.mkdir, "holds files that are not a model; choose another name"),
        (training_run, "holds files that are not a model; choose another name"),
        (damaged, "holds files that are not a model; choose another name"),
    ],
)
def test_force_is_recommended_only_where_it_helps(make, message, force, tmp_path):
    make(tmp_path / "a")
    if (tmp_path / "a").is_dir():
        (tmp_path / "a" / "letter.txt").touch()
    before = files(tmp_path)
    with pytest.raises(InputError, match=f"{re.escape(str(tmp_path / 'a'))}: {message}$"):
        save_model(default_arm(), tmp_path / "a", force=force)
    assert files(tmp_path) == before


def test_a_link_into_a_place_that_cannot_be_made_is_told_at_once(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to(tmp_path / "file" / "arm")
    with pytest.raises(InputError, match=r"link: cannot be written, .*file is not a writable"):
        claim_folder(tmp_path / "link")


def test_a_full_disk_names_the_folder_and_keeps_the_old_model(tmp_path, monkeypatch):
    folder = tmp_path / "arm"
    save_model(default_arm(), folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}

    def full(*given, **named):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    said = re.escape(f"{folder}: cannot be written (No space left on device)")
    with pytest.raises(InputError, match=f"^{said}$"):
        save_model(default_arm(), folder, force=True)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["arm"]
