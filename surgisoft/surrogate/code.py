"""Code that models hold and that opening them does not run: effect files and callable models."""

from collections.abc import Iterable
from pathlib import Path

from surgisoft.surrogate.callables.named import name_callables, named_callables
from surgisoft.surrogate.effects import register_effect_files, registered_files


def is_effect_file(text: str | Path) -> bool:
    """Whether a piece of code is a file of an effect; else it is the name of a callable."""
    return Path(text).suffix == ".py"


def name_code(given: Iterable[str | Path]) -> None:
    """Run the code that the user named: effect files, and callables by their names."""
    given = list(given)
    register_effect_files(each for each in given if is_effect_file(each))
    name_callables(str(each) for each in given if not is_effect_file(each))


def named_code() -> list[str]:
    """All code that was named so far: a new process has to name it again."""
    return [*registered_files(), *named_callables()]
