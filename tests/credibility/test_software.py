"""The commit that a report states, in checkouts made by hand, and the record of the tests."""

import json
import re
from pathlib import Path

import pytest

from surgisoft.credibility.software import TESTS, commit_of, software

ROOT = Path(__file__).parents[2]
FIRST, SECOND = "0123456789abcdef" * 2 + "01234567", "f" * 40


@pytest.fixture
def package(tmp_path):
    """The folder of a package in a checkout on the branch main, whose commit is FIRST."""
    (tmp_path / "tree/package").mkdir(parents=True)
    heads = tmp_path / "tree/.git/refs/heads"
    heads.mkdir(parents=True)
    (tmp_path / "tree/.git/HEAD").write_text("ref: refs/heads/main\n")
    (heads / "main").write_text(FIRST + "\n")
    return tmp_path / "tree/package"


def test_the_commit_of_a_branch_of_a_packed_one_and_of_none(package):
    git = package.parent / ".git"
    assert commit_of(package) == FIRST
    packed = f"# pack-refs with: peeled\n{FIRST} refs/heads/old\n{SECOND} refs/heads/main\n"
    (git / "packed-refs").write_text(packed)
    assert commit_of(package) == FIRST, "the loose one is newer"
    (git / "refs/heads/main").unlink()
    assert commit_of(package) == SECOND
    (git / "HEAD").write_text(FIRST + "\n")
    assert commit_of(package) == FIRST


def test_the_commit_of_a_linked_working_tree(package, tmp_path):
    """Its `.git` is a file that names a folder of the first tree; branches are in the first one."""
    linked = tmp_path / "tree/.git/worktrees/second"
    linked.mkdir(parents=True)
    (linked / "HEAD").write_text("ref: refs/heads/other\n")
    (linked / "commondir").write_text("../..\n")
    (tmp_path / "tree/.git/refs/heads/other").write_text(SECOND)
    (tmp_path / "second/package").mkdir(parents=True)
    for place in (str(linked), "../tree/.git/worktrees/second"):
        (tmp_path / "second/.git").write_text(f"gitdir: {place}\n")
        assert commit_of(tmp_path / "second/package") == SECOND
    assert commit_of(package) == FIRST


@pytest.mark.parametrize("content", [b"", b"ref: refs/heads/none", b"\xff\xfe", b"0123", b"ref:"])
def test_without_a_commit_there_is_none(package, content):
    (package.parent / ".git/HEAD").write_bytes(content)
    assert commit_of(package) is None
    assert commit_of(package / "deeper") is None, "the checkout has to hold the package itself"


@pytest.mark.parametrize(
    ("origin", "commit"),
    [
        ({"url": "u", "vcs_info": {"vcs": "git", "commit_id": SECOND}}, SECOND),
        ({"url": "u", "dir_info": {"editable": True}}, None),
        ({"url": "u", "vcs_info": {"vcs": "git", "commit_id": "main"}}, None),
        ([], None),
    ],
)
def test_pip_wrote_down_what_it_installed(tmp_path, monkeypatch, origin, commit):
    """PEP 610; the record counts only for the copy that it belongs to."""
    for place in ("site/twin_arms", "other/twin_arms", "site/twin_arms-1.dist-info"):
        (tmp_path / place).mkdir(parents=True)
    record = tmp_path / "site/twin_arms-1.dist-info"
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: twin_arms\nVersion: 1\n")
    (record / "direct_url.json").write_text(json.dumps(origin))
    monkeypatch.syspath_prepend(tmp_path / "site")
    assert commit_of(tmp_path / "site/twin_arms") == commit
    assert commit_of(tmp_path / "other/twin_arms") is None
    (record / "direct_url.json").write_text("{")
    assert commit_of(tmp_path / "site/twin_arms") is None


def test_this_package_states_its_own_commit_where_it_is_a_checkout():
    found = software()
    assert {"surgisoft", "python", "torch", "numpy"} <= set(found)
    if "commit" in found:
        assert re.fullmatch("[0-9a-f]{40}", found["commit"])


def test_the_record_of_the_tests_is_where_it_is_said_to_be():
    goals = re.findall(r"`make (\w+)`", TESTS)
    assert goals == ["test", "coverage", "mutants"]
    makefile = (ROOT / "Makefile").read_text()
    assert all(re.search(rf"^{goal}:", makefile, re.MULTILINE) for goal in goals)
    pages = re.findall(r"docs/\S+?\.md", TESTS)
    assert len(pages) == 2
    assert all((ROOT / page).is_file() for page in pages)
