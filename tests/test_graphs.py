"""Modules that cannot be written as a graph, and what is said of them."""

import pytest
import torch
from torch import nn

from surgisoft.errors import InputError
from surgisoft.graphs import DoesNotTrace, write_onnx, write_torch_script

LONG = "the model is code: " + "expected one that is a graph, " * 8 + "export another one"


class Refuses(nn.Module):
    """A module that raises when it is called."""

    def __init__(self, error, cause=None):
        super().__init__()
        self.error, self.cause = error, cause

    def forward(self, x):
        raise self.error from self.cause


def written(module, folder):
    """The message of each of the two writers."""
    example, found = (torch.zeros(2, 3),), []
    for write in (
        lambda: write_torch_script(module, example, folder / "a.pt"),
        lambda: write_onnx(module, example, folder / "a.onnx", ["x"], ["y"]),
    ):
        with pytest.raises(DoesNotTrace) as told:
            write()
        found.append(str(told.value))
    return found


def test_a_message_for_the_user_is_whole_and_without_its_class(tmp_path):
    """Other errors are those of libraries: their class, and the first 140 letters of a line."""
    assert written(Refuses(InputError(LONG)), tmp_path) == [LONG, LONG]
    assert written(Refuses(RuntimeError("later"), InputError(LONG)), tmp_path) == [LONG, LONG]
    other = f"RuntimeError: {LONG[:140]}"
    assert written(Refuses(RuntimeError(f"\n{LONG}\nmore")), tmp_path)[0] == other
    assert not list(tmp_path.iterdir())
