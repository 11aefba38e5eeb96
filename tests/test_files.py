"""Files appear whole or not at all, with the permissions that the umask gives."""

import errno
import json
import math
import os
import re
import stat

import numpy as np
import pytest

from surgisoft.errors import InputError
from surgisoft.files import (
    json_safe,
    new_file,
    new_folder,
    read_json,
    write_atomically,
    write_json,
)


@pytest.fixture(params=[0o022, 0o077, 0o002])
def umask(request):
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_permissions_are_those_of_the_umask(tmp_path, umask):
    write_atomically(tmp_path / "a.bin", b"\0\1")
    with new_folder(tmp_path / "folder") as fresh:
        (fresh / "b.txt").write_text("b")
    assert mode(tmp_path / "a.bin") == 0o666 & ~umask
    assert mode(tmp_path / "folder") == 0o777 & ~umask
    assert (tmp_path / "a.bin").read_bytes() == b"\0\1"


def test_a_failed_write_leaves_the_old_file_alone(tmp_path):
    path = tmp_path / "deep" / "a.txt"
    write_atomically(path, "old é")

    def interrupted():
        with new_file(path) as fresh:
            fresh.write_text("half of the n")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text(encoding="utf-8") == "old é"
    assert [item.name for item in path.parent.iterdir()] == ["a.txt"]


def test_a_failed_folder_leaves_the_old_one_alone(tmp_path):
    folder = tmp_path / "model"
    with new_folder(folder) as fresh:
        (fresh / "weights").write_text("1")

    def failing():
        with new_folder(folder) as fresh:
            (fresh / "weights").write_text("2")
            raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        failing()
    assert (folder / "weights").read_text() == "1"
    assert [item.name for item in tmp_path.iterdir()] == ["model"]


def test_a_replaced_folder_keeps_foreign_files(tmp_path):
    folder = tmp_path / "model"
    (folder / "notes").mkdir(parents=True)
    (folder / "notes" / "mine.txt").write_text("mine")
    for name in ("weights", "report"):
        (folder / name).write_text("old")
    with new_folder(folder, own=("weights", "report")) as fresh:
        (fresh / "weights").write_text("new")
    assert sorted(item.name for item in folder.iterdir()) == ["notes", "weights"]
    assert (folder / "weights").read_text() == "new"
    assert (folder / "notes" / "mine.txt").read_text() == "mine"
    assert [item.name for item in tmp_path.iterdir()] == ["model"]


def test_a_link_to_a_folder_stays_a_link(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "there")
    with new_folder(tmp_path / "link") as fresh:
        (fresh / "a").write_text("a")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "there" / "a").read_text() == "a"


def test_a_link_to_a_file_stays_a_link(tmp_path):
    """The temporary file has the suffix of the link: writers choose their format by it."""
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "7f3a").write_text("old")
    for name, stored in (("a.csv", "7f3a"), ("new.csv", "not/there/yet")):
        link = tmp_path / name
        link.symlink_to(tmp_path / "store" / stored)
        with new_file(link) as fresh:
            assert fresh.suffix == ".csv"
            fresh.write_text("new")
        assert link.is_symlink()
        assert (tmp_path / "store" / stored).read_text() == "new"
    assert sorted(item.name for item in tmp_path.iterdir()) == ["a.csv", "new.csv", "store"]
    (tmp_path / "round").symlink_to(tmp_path / "round")
    with pytest.raises(OSError, match="symbolic links"):
        write_atomically(tmp_path / "round", "x")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in folders here")
def test_a_pipe_is_not_replaced_by_a_file(tmp_path):
    os.mkfifo(tmp_path / "a.json")
    with pytest.raises(InputError, match=r"a\.json: is a device or a pipe, expected a file"):
        write_json(tmp_path / "a.json", {})
    assert stat.S_ISFIFO((tmp_path / "a.json").stat().st_mode)
    assert [item.name for item in tmp_path.iterdir()] == ["a.json"]


def test_a_failed_write_names_what_the_user_named(tmp_path):
    """A full disk names no file, and a folder that is being filled has a temporary name."""

    def full(where, inside):
        with where as fresh:
            (fresh / inside).write_text("") if inside else None
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    for where, inside, named in (
        (new_file(tmp_path / "a.txt"), "", "a.txt"),
        (new_folder(tmp_path / "b"), "weights", "b"),
        (new_folder(tmp_path / "b"), "missing/weights", "b/missing/weights"),
    ):
        with pytest.raises(OSError, match=re.escape(f"'{tmp_path / named}'")) as caught:
            full(where, inside)
        assert caught.value.filename == str(tmp_path / named)
    assert not list(tmp_path.iterdir())
    with pytest.raises(OSError, match="words alone"), new_file(tmp_path / "a.txt"):
        raise OSError("words alone")


def test_a_folder_that_cannot_be_made_is_named_as_given(tmp_path, monkeypatch):
    """Its temporary name is not: a file system such as /proc makes no folders."""

    def none_made(place, *given):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(place))

    monkeypatch.setattr(os, "mkdir", lambda place, *given: os.path.isdir(place) or none_made(place))
    with pytest.raises(OSError, match="Read-only") as caught, new_folder(tmp_path / "b"):
        pass
    assert caught.value.filename == str(tmp_path / "b")


def test_json_has_null_for_numbers_that_are_not_finite(tmp_path):
    value = {"a": [1.5, math.nan], "b": (math.inf, "x"), "c": np.array([1.0, -np.inf])}
    write_json(tmp_path / "a.json", value | {"d": np.float64("nan"), "e": np.int64(3), "f": None})
    text = (tmp_path / "a.json").read_text()
    assert json.loads(text, parse_constant=pytest.fail) == {
        "a": [1.5, None],
        "b": [None, "x"],
        "c": [1.0, None],
        "d": None,
        "e": 3,
        "f": None,
    }
    assert json_safe(True) is True


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"[" * 100_000, "nested too deeply"),
        (b'{"a": ' + b"9" * 5000 + b"}", "not valid JSON"),
        (b"\xff\xfe{}", "not valid JSON"),
        (b"{", "not valid JSON"),
        (b" " * 2000, "larger than 1000 bytes"),
    ],
)
def test_json_of_any_content_is_a_value_or_one_line(tmp_path, content, said):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(InputError, match=said):
        read_json(tmp_path / "a.json", 1000 if "larger" in said else 10**6)
    write_json(tmp_path / "b.json", {"a": [1, None]})
    assert read_json(tmp_path / "b.json") == {"a": [1, None]}
