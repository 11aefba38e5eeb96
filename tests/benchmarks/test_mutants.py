"""The list of mutants applies to the source as it is, and a survivor is told from a caught one."""

import ast
import itertools
from pathlib import Path

import pytest

from benchmarks.mutants import Mutant, mutants, mutated
from benchmarks.mutants.run import failing, run

ROOT = Path(__file__).resolve().parents[2]
ALL = mutants()


@pytest.mark.parametrize("file", sorted({mutant.file for mutant in ALL}))
def test_every_mutant_applies_and_is_still_python(file):
    """A changed line of the source needs its mutant changed in benchmarks/mutants/mutants.toml.

    The statements of the file that a mutant touches are compiled; the others stay as they are.
    """
    text = (ROOT / file).read_text()
    begins = statements(text)
    for mutant in (each for each in ALL if each.file == file):
        changed = mutated(mutant, text)
        assert changed != text, mutant.name
        at = text.index(mutant.old)
        behind = [begin for begin in begins if begin >= at + len(mutant.old)]
        begin = max((begin for begin in begins if begin <= at), default=0)
        end = len(changed) - (len(text) - min(behind, default=len(text)))
        compile(changed[begin:end], mutant.name, "exec")
        assert mutant.tests, mutant.name
        assert all((ROOT / test.split("::")[0]).is_file() for test in mutant.tests), mutant.name


def statements(text: str) -> list[int]:
    """Places in a module's text where the lines of its statements begin, with their decorators."""
    lines = [0, *itertools.accumulate(len(line) for line in text.splitlines(keepends=True))]
    return [
        lines[min(part.lineno for part in (each, *getattr(each, "decorator_list", ()))) - 1]
        for each in ast.parse(text).body
    ]


def test_names_differ_and_those_of_the_trial_are_there():
    assert len({mutant.name for mutant in ALL}) == len(ALL)
    assert sum(mutant.issue for mutant in ALL) >= 23


def test_a_text_that_is_not_there_once_does_not_apply():
    mutant = Mutant("x", "y", "z.py", "a", "b", ("t",))
    assert mutated(mutant, "cad") == "cbd"
    for text in ("b", "aa"):
        with pytest.raises(ValueError, match="expected once"):
            mutated(mutant, text)


@pytest.fixture
def tree(tmp_path):
    """A project with two values and two tests, of which one looks at a value."""
    (tmp_path / "surgisoft").mkdir()
    (tmp_path / "surgisoft" / "__init__.py").write_text("A = 1\nB = 2\n")
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_values.py").write_text(
        "import surgisoft\n\ndef test_a():\n    assert surgisoft.A == 1\n\n"
        "def test_b():\n    assert surgisoft.B\n"
    )
    return tmp_path


@pytest.mark.parametrize("first", [None, "tests/test_values.py::test_a", "tests/gone.py::test_c"])
def test_a_survivor_is_told_from_a_caught_one(tree, first):
    """The changed copy is imported, not the package that this process has imported."""
    file, tests = "surgisoft/__init__.py", ("tests/test_values.py",)
    caught = run(Mutant("x", "y", file, "A = 1", "A = 3", tests), tree, first)
    assert (caught["outcome"], caught["by"]) == ("caught", "tests/test_values.py::test_a")
    survived = run(Mutant("x", "y", file, "B = 2", "B = 3", tests), tree, first)
    assert (survived["outcome"], survived["by"]) == ("survived", "")
    assert (tree / file).read_text() == "A = 1\nB = 2\n"


def test_a_test_that_fails_without_a_mutant_is_found(tree):
    (tree / "tests" / "test_broken.py").write_text("def test_c():\n    assert False\n")
    noticed = ("tests/test_values.py::test_a", "tests/test_broken.py::test_c", "")
    outcomes = [{"by": test} for test in noticed]
    assert failing(outcomes, tree) == {"tests/test_broken.py::test_c"}
