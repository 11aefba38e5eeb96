"""A user's Python callable in an exported file: found by its name, called, its answers checked.

`surgisoft export` writes this file's text into the files that call a callable model. It needs
NumPy, and nothing else of surgisoft.
"""

import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np


class Called:
    """One callable model: rows, runs or steps of arrays of float64."""

    def __init__(self, about: Mapping[str, Any], model: Any = None):
        """about: name, sha256, form, chambers and key_points of the callable.

        model: the object; None: it is imported by its name, which runs its code.
        """
        self.about = about
        self.model = found(about["name"], about["sha256"]) if model is None else model
        if isinstance(self.model, type):
            self.model = self.model()

    def points(self, actuation):
        """Key points (S, n, 3) in mm of rows of actuation (S, m), each a run of its own."""
        if self.about["form"] == "static":
            return self.run(np.zeros(len(actuation)), actuation)
        return np.concatenate([self.run(np.zeros(1), row[None]) for row in actuation])

    def run(self, time_s, actuation):
        """Key points (T, n, 3) in mm of a run: times (T,) in s, actuation (T, m)."""
        given = np.array(actuation, np.float64)
        return self._checked(self.model(np.array(time_s, np.float64), given), len(given))

    def initial_state(self, actuation):
        """State (B, k) of arms that were held at actuation (B, m)."""
        return _numbers(self.model.initial_state(np.array(actuation, np.float64)))

    def step(self, state, actuation, dt_s):
        """State (B, k), key points (B, n, 3) in mm after actuation (B, m) was held dt_s (B,)."""
        given = (np.array(each, np.float64) for each in (state, actuation, dt_s))
        fresh, points = self.model.step(*given)
        return _numbers(fresh), self._checked(points, len(actuation))

    def _checked(self, points, rows):
        points = _numbers(points)
        wanted = (rows, self.about["key_points"], 3)
        if points.shape != wanted or not np.isfinite(points).all():
            came = f"shape {points.shape}" if points.shape != wanted else "numbers not finite"
            raise ValueError(f"{self.about['name']}: key points have {came}, expected {wanted}, mm")
        return points


def _numbers(value):
    """An answer as an array of float64 of its own: a callable may use its array again."""
    if hasattr(value, "detach"):  # a tensor of PyTorch
        value = value.detach().cpu().numpy()
    return np.array(value, np.float64)


def found(name, sha256):
    """The object of a name: `package.module:object`, `FILE.py:object`, or an entry point."""
    head, colon, attribute = name.rpartition(":")
    if not colon:
        from importlib.metadata import entry_points

        for entry in entry_points(group="surgisoft.models"):
            if entry.name == name:
                return entry.load()
        raise ValueError(f"{name}: no installed package offers this model; install it")
    if head.endswith(".py"):
        value = _file(head, sha256)
    else:
        if "" not in sys.path and str(Path.cwd()) not in sys.path:
            sys.path.append(str(Path.cwd()))
        value = importlib.import_module(head)
    for part in attribute.split("."):
        value = getattr(value, part)
    return value


def _file(name, sha256):
    """The module of a file, which lies where it lay, in the current folder, or beside this one."""
    places = [Path(name), Path(Path(name).name), Path(__file__).parent / Path(name).name]
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        raise ValueError(f"{name}: no such file; copy it beside {Path(__file__).name}")
    content = path.read_bytes()
    if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
        raise ValueError(f"{path}: is not the file that was exported with; export the model again")
    folder = str(path.resolve().parent)
    if folder not in sys.path:
        sys.path.append(folder)
    spec = importlib.util.spec_from_file_location(f"exported_{path.stem}", path)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    exec(compile(content, str(path), "exec"), module.__dict__)
    return module
