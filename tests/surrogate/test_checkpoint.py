"""A model's folder: who may read it."""

import os
import stat

import pytest

from surgisoft.surrogate.checkpoint import OWN_FILES, default_arm, save_model


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
