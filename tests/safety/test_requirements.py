"""docs/safety.md: every requirement has a number, a hazard, and tests that exist."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "safety.md"
ROW = re.compile(r"^\| (S\d+) \| (.+?) \| (.+?) \| (.+?) \|$", re.MULTILINE)


def requirements(text: str) -> list[tuple[str, str, str, list[str]]]:
    """(number, hazard, requirement, tests) of every row of the table."""
    return [(a, b, c, re.findall(r"`([^`]+::[^`]+)`", d)) for a, b, c, d in ROW.findall(text)]


def missing(tests: list[str]) -> list[str]:
    """Tests that do not exist: `FILE::FUNCTION` in this repository."""
    lost = []
    for test in tests:
        file, _, name = test.partition("::")
        path = ROOT / file
        known = set()
        if path.is_file():
            tree = ast.parse(path.read_text())
            known = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        if name not in known or not name.startswith("test_"):
            lost.append(test)
    return lost


def test_the_requirements_are_numbered_without_a_gap():
    found = [number for number, *_ in requirements(PAGE.read_text())]
    assert len(found) >= 20
    assert found == [f"S{k + 1}" for k in range(len(found))]
    assert len(found) == PAGE.read_text().count("\n| S")


@pytest.mark.parametrize("row", requirements(PAGE.read_text()), ids=lambda row: row[0])
def test_each_requirement_has_tests_that_exist(row):
    number, hazard, requirement, tests = row
    assert hazard.endswith("."), number
    assert requirement.endswith("."), number
    assert tests, f"{number} has no test"
    assert missing(tests) == []


def test_a_test_that_does_not_exist_is_noticed():
    assert missing(["tests/safety/test_requirements.py::test_nothing"])
    assert missing(["tests/safety/test_nowhere.py::test_nothing"])
    assert missing(["tests/safety/test_requirements.py::requirements"])
    row = "| S1 | A hazard. | A requirement. | no test |"
    assert requirements(row) == [("S1", "A hazard.", "A requirement.", [])]
