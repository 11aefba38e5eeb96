"""The guard compares with the commit that is named, else the last tag, and never with nothing."""

import subprocess

import pytest

from benchmarks.guard import commit_to_compare
from surgisoft.errors import InputError


def git(folder, *arguments):
    identity = ("-c", "user.name=a", "-c", "user.email=a@b")
    done = subprocess.run(
        ["git", *identity, *arguments], cwd=folder, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def test_the_last_tag_is_compared_and_without_one_a_commit_is_needed(tmp_path):
    git(tmp_path, "init", "-q")
    git(tmp_path, "commit", "-q", "--allow-empty", "-m", "first")
    first = git(tmp_path, "rev-parse", "--short", "HEAD")
    with pytest.raises(InputError, match="guard: no tag to compare with, expected a COMMIT"):
        commit_to_compare(root=tmp_path)
    assert commit_to_compare("HEAD", tmp_path) == ("HEAD", first)
    git(tmp_path, "tag", "v1")
    git(tmp_path, "commit", "-q", "--allow-empty", "-m", "second")
    assert commit_to_compare(root=tmp_path) == ("v1", first)
    second = git(tmp_path, "rev-parse", "--short", "HEAD")
    assert commit_to_compare("HEAD", tmp_path) == ("HEAD", second)
    with pytest.raises(InputError, match="'nowhere' is no commit, expected a tag"):
        commit_to_compare("nowhere", tmp_path)
