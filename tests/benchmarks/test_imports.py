"""The studies import what exists, also inside functions, which may run after hours."""

import ast
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
OWN = ("surgisoft", "benchmarks")
NO_DEPENDENCY = ("mujoco",)
"""Libraries that a study needs and no extra installs."""


def missing_names(source: str) -> list[str]:
    """Names that `from MODULE import NAME` asks this project's modules for in vain."""
    missing = []
    for node in ast.walk(ast.parse(source)):
        if not (isinstance(node, ast.ImportFrom) and node.module) or node.level:
            continue
        if node.module.partition(".")[0] not in OWN:
            continue
        module = import_module(node.module)
        for alias in node.names:
            there = hasattr(module, alias.name)
            if not there and hasattr(module, "__path__"):
                there = find_spec(f"{node.module}.{alias.name}") is not None
            if not there:
                missing.append(f"{node.module}.{alias.name}")
    return missing


def test_a_name_that_is_gone_is_found():
    source = "def f():\n    from surgisoft.errors import InputError, NoSuchName\n"
    assert missing_names(source) == ["surgisoft.errors.NoSuchName"]
    assert missing_names("from surgisoft import errors") == []


@pytest.mark.parametrize(
    "path",
    sorted(BENCHMARKS.rglob("*.py")),
    ids=lambda path: path.relative_to(BENCHMARKS).as_posix(),
)
def test_a_study_imports_what_exists(path):
    try:
        missing = missing_names(path.read_text())
    except ModuleNotFoundError as error:
        if error.name not in NO_DEPENDENCY:
            raise
        pytest.skip(f"{error.name} is not installed")
    assert missing == []
