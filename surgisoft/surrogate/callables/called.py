"""The callables that operators stand for in traced programs."""

from typing import Any
from weakref import WeakValueDictionary

CALLED: WeakValueDictionary[int, Any] = WeakValueDictionary()
"""Networks of callables by the number that stands for each in a traced program."""
