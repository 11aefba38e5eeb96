"""Parts that every other one uses: scales, tables of configurations, workers, environments."""

import importlib.util
import os
import sys
import typing
from dataclasses import dataclass, field
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from surgisoft import environments
from surgisoft.config import assignments, to_table
from surgisoft.error_scale import bar_length, body_size, error_scale, quantile
from surgisoft.errors import InputError
from surgisoft.workers import begin_worker, workers

NAN = float("nan")


def test_an_error_scale_is_a_round_number_above_the_errors():
    path = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 60.0], [0.0, 0.0, 130.0]]])
    errors = np.full((1, 3), 0.42)
    scale = error_scale(path, [errors, 0.1 * errors])
    assert scale.large_mm == 0.5
    assert scale.body_mm == pytest.approx(130.0)
    assert scale.bar_mm == bar_length(scale.bar_mm)
    assert error_scale(path, [errors], large_mm=3.0).large_mm == 3.0
    assert error_scale(path, [np.zeros((1, 3))]).large_mm == 1.0
    assert quantile(np.array([NAN, NAN])) == 0.0


def test_the_size_of_a_body_is_that_of_its_line_or_of_its_motion():
    one = np.array([[[0.0, 0.0, 0.0]], [[3.0, 4.0, 0.0]], [[NAN, NAN, NAN]]])
    assert body_size(one) == pytest.approx(5.0)
    assert body_size(np.full((2, 1, 3), NAN)) == 1.0
    assert body_size(np.zeros((2, 2, 3))) == 1e-3


@dataclass
class Loose:
    """Fields of types that say little."""

    anything: typing.Any = None
    table: dict = field(default_factory=dict)
    places: tuple[Path, ...] = ()


def test_a_configuration_is_written_as_plain_values():
    table = {"a": Path("x") / "y", "b": [Path("z")]}
    assert to_table(Loose(3, table, (Path("p"),))) == {
        "anything": 3, "table": {"a": str(Path("x/y")), "b": ["z"]}, "places": ["p"],
    }  # fmt: skip


def test_a_field_has_a_limited_depth():
    with pytest.raises(InputError, match="a field of more than"):
        assignments([".".join("a" * 200) + "=1"])


def test_a_worker_is_a_process_of_its_own():
    with pytest.raises(RuntimeError, match="is for a new process, and this is the first one"):
        begin_worker()


def test_workers_leave_the_environment_as_it_was(monkeypatch):
    monkeypatch.delenv("CLUSTER", raising=False)
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    with pytest.raises(ZeroDivisionError), workers(1):
        1 / 0  # noqa: B018  # what fails beside the workers
    assert "MKL_NUM_THREADS" not in os.environ
    assert os.environ["OMP_NUM_THREADS"] == "3"


def test_environments_are_registered_once_gymnasium_is_imported(monkeypatch):
    environments.register_with_gymnasium()
    assert any(name.startswith("surgisoft/") for name in gymnasium.registry)
    monkeypatch.delitem(sys.modules, "gymnasium")
    monkeypatch.setattr(sys, "meta_path", list(sys.meta_path))
    before = list(sys.meta_path)
    environments.register_with_gymnasium()
    (hook,) = (each for each in sys.meta_path if each not in before)
    assert hook.find_spec("numpy") is None
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert hook.find_spec("gymnasium") is None
    assert hook not in sys.meta_path
