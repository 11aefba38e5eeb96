"""Short names of policies, and policies that are named twice."""

import pytest

from surgisoft.agents.policy_names import short_names, without_repeats


@pytest.mark.parametrize(
    ("names", "short"),
    [
        (["runs/tc1", "scripted"], ["tc1", "scripted"]),
        (["a/run", "b/run"], ["a/run", "b/run"]),
        (["x/a/run", "x/b/run/", "other"], ["a/run", "b/run", "other"]),
        (["run", "a/run"], ["run", "a/run"]),
        (["/a/run", "/b/run"], ["a/run", "b/run"]),
        (["/run", "run"], ["/run", "run"]),
        (["a/x/run", "b/x/run", "y/run"], ["a/x/run", "b/x/run", "y/run"]),
    ],
)
def test_names_are_the_shortest_ends_that_differ(names, short):
    assert [short_names(names)[name] for name in names] == short


def test_this_folder_and_those_above_have_the_names_of_their_folders(tmp_path, monkeypatch):
    (tmp_path / "run" / "inside").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "run" / "inside")
    assert short_names([".", ".."]) == {".": "inside", "..": "run"}


def test_a_folder_that_is_named_twice_is_repeated(tmp_path, monkeypatch):
    (tmp_path / "tc1").mkdir()
    (tmp_path / "link").symlink_to("tc1")
    monkeypatch.chdir(tmp_path)
    given = ["tc1", "scripted", "tc1/", str(tmp_path / "tc1"), "link", "scripted"]
    kept, repeated = without_repeats(given)
    assert kept == ["tc1", "scripted"]
    assert repeated == given[2:]
