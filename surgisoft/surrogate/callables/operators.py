"""Calls of a callable model as operators of PyTorch, so that a traced program keeps them as calls.

A program that is traced has no numbers, which the callable needs; an operator stands for the call.
Graphs (ONNX, TorchScript) cannot have such operators; NumPy code can (`surgisoft.numpy_code`).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from surgisoft.surrogate.callables.called import CALLED

_NUMBERED: ContextVar[dict[int, int] | None] = ContextVar("operators", default=None)


@contextmanager
def as_operators() -> Iterator[dict[int, int]]:
    """While the block is traced, calls of callables are operators.

    Yields the places of the callables in the program's order of first use: id of the network that
    was called -> place.
    """
    # Registering operators takes 0.03 s, and few programs trace anything.
    from surgisoft.surrogate.callables import registered  # noqa: F401

    places: dict[int, int] = {}
    token = _NUMBERED.set(places)
    try:
        yield places
    finally:
        _NUMBERED.reset(token)


def operated() -> bool:
    """Whether calls of callables are operators now."""
    return _NUMBERED.get() is not None


def number_of(network: Any) -> int:
    """The number that stands for a network in the program that is traced: its place."""
    places = _NUMBERED.get()
    assert places is not None
    place = places.setdefault(id(network), len(places))
    CALLED[place] = network
    return place
