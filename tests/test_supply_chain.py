"""Licences of dependencies are compatible with MIT; every package but torch has its hash."""

import re
import shutil
import subprocess
from email.message import Message
from pathlib import Path

import pytest

from benchmarks.supply_chain import (
    UNHASHED,
    Package,
    installed,
    licence_of,
    packages,
    project_requirements,
)

ROOT = Path(__file__).resolve().parents[1]
INSTALLED = packages()


@pytest.mark.parametrize("package", INSTALLED, ids=lambda package: package.name)
def test_a_dependency_is_compatible_with_mit(package):
    assert package.compatible, f"{package.name} {package.version}: {package.licence}"
    listed = f"| {package.name} |" in (ROOT / "docs" / "licences.md").read_text()
    assert listed, "python -m benchmarks.supply_chain licences > docs/licences.md"


def test_the_list_of_licences_is_one_table_in_the_order_of_names():
    head, row, table = (ROOT / "docs" / "licences.md").read_text().partition("\n|---|---|---|\n")
    assert row
    assert head.count("|") == 4, "only the names of the columns"
    names = re.findall(r"^\| (\S+) \|", table, re.M)
    assert len(names) >= len(INSTALLED)
    assert names == sorted(names)


def test_dependencies_of_dependencies_are_among_them():
    names = {package.name for package in INSTALLED}
    assert {"torch", "numpy", "llvmlite", "mpmath", "markdown-it-py"} <= names
    assert {one.name for one in project_requirements()} >= {"numpy", "trimesh", "pytest", "mkdocs"}
    assert "surgisoft" not in installed()


@pytest.mark.parametrize(
    ("fields", "licence", "compatible"),
    [
        ({"License-Expression": "MIT OR GPL-3.0-only"}, "MIT OR GPL-3.0-only", True),
        ({"License-Expression": "MIT AND GPL-3.0-only"}, "MIT AND GPL-3.0-only", False),
        ({"License-Expression": "GPL-2.0-or-later"}, "GPL-2.0-or-later", False),
        (
            {"Classifier": "License :: OSI Approved :: GNU Affero General Public License v3"},
            "unknown: GNU Affero General Public License v3",
            False,
        ),
        ({"Classifier": "License :: OSI Approved :: MIT License"}, "MIT", True),
        ({"License": "Proprietary"}, "unknown: Proprietary", False),
        ({"License": "BSD"}, "BSD-3-Clause", True),
        ({}, "unknown: none stated", False),
    ],
)
def test_what_is_stated_is_read(fields, licence, compatible):
    metadata = Message()
    for name, value in fields.items():
        metadata[name] = value
    assert licence_of(metadata) == licence
    assert Package("a", "1", licence).compatible is compatible


def test_every_locked_package_has_a_hash_and_the_version_of_the_constraints():
    pinned = dict(
        line.split("==") for line in (ROOT / "constraints.txt").read_text().split() if "==" in line
    )
    pinned = {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in pinned.items()}
    text = (ROOT / "requirements.lock").read_text()
    rows = re.findall(r"^([\w.-]+)==(\S+) --hash=sha256:[0-9a-f]{64}$", text, re.M)
    assert len(rows) == sum(not line.startswith("#") for line in text.splitlines())
    locked = dict(rows)
    assert UNHASHED not in locked
    assert {name: version for name, version in pinned.items() if name != UNHASHED} == locked
    assert UNHASHED in pinned
    missing = {re.sub(r"[-_.]+", "-", one.name).lower() for one in project_requirements()}
    how = "python -m benchmarks.supply_chain lock > requirements.lock"
    assert missing - set(locked) == {UNHASHED}, how


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
@pytest.mark.parametrize("target", ["test", "docs"])
def test_a_locked_installation_takes_nothing_without_its_hash(target):
    """What `make` would run: nothing from an index without a hash but the build of torch."""
    command = ["make", "-n", "LOCKED=1", "VENV=nowhere", "TORCH=torch==2.13.0+cpu", target]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    installs = re.findall(r"pip install (?:--quiet )?(.*)", said)
    assert installs == [
        '--no-deps "torch==2.13.0+cpu"',
        "--require-hashes --no-deps -r requirements.lock",
        "--no-deps --no-build-isolation -e .",
    ]


def test_the_workflow_installs_by_hash_where_the_lock_holds():
    """Every job that installs with `make`, which takes Linux and Python 3.11."""
    text = (ROOT / ".github" / "workflows" / "test.yml").read_text()
    made = re.findall(r"make .*", re.sub(r"#.*", "", text))
    assert len(made) == 3
    assert all(line.startswith("make LOCKED=1 ") for line in made)


def test_actions_of_the_workflow_are_pinned_to_commits():
    """A tag can be moved to other code; the comment names the release of the commit."""
    for workflow in (ROOT / ".github" / "workflows").glob("*.yml"):
        used = re.findall(r"uses: (.*)", workflow.read_text())
        assert used
        assert all(re.fullmatch(r"[\w/-]+@[0-9a-f]{40}  # v\d+(\.\d+)*", one) for one in used), used
