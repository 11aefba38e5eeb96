"""Helpers of the tests of refusals."""

from collections.abc import Callable
from typing import Any

import pytest

from surgisoft.errors import InputError


def refusal(call: Callable[[], Any]) -> str:
    """The one line of the InputError that a call raises."""
    with pytest.raises(InputError) as error:
        call()
    assert "\n" not in str(error.value)
    return str(error.value)
