"""The list of mutants applies to the source as it is, and a survivor is told from a caught one."""

from pathlib import Path

import pytest

from benchmarks.mutants import Mutant, mutants, mutated

ROOT = Path(__file__).resolve().parents[2]
ALL = mutants()


@pytest.mark.parametrize("mutant", ALL, ids=lambda mutant: mutant.name)
def test_every_mutant_applies_and_is_still_python(mutant):
    """A changed line of the source needs its mutant changed in benchmarks/mutants/mutants.toml."""
    text = (ROOT / mutant.file).read_text()
    changed = mutated(mutant, text)
    assert changed != text
    compile(changed, mutant.file, "exec")
    assert mutant.tests
    assert all((ROOT / test.split("::")[0]).is_file() for test in mutant.tests)


def test_names_differ_and_those_of_the_trial_are_there():
    assert len({mutant.name for mutant in ALL}) == len(ALL)
    assert sum(mutant.issue for mutant in ALL) >= 23


def test_a_text_that_is_not_there_once_does_not_apply():
    mutant = Mutant("x", "y", "z.py", "a", "b", ("t",))
    assert mutated(mutant, "cad") == "cbd"
    for text in ("b", "aa"):
        with pytest.raises(ValueError, match="expected once"):
            mutated(mutant, text)
