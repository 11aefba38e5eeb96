"""Run an exported controller: measurements in, commands out. This file needs no other package.

`surgisoft export RUN -o DIR` writes this file as `controller.py` beside `controller.onnx`,
`controller.pt` and `policy.json`. It needs NumPy, and onnxruntime, or torch, or onnx. Where an arm
model calls Python code of yours, `controller_code.py` lies there in place of the graphs; it needs
NumPy and that code alone, and is imported.

    from controller import Controller

    controller = Controller("DIR")
    controller.reset()                                     # the arm is vented and at rest
    # every sample, while you move the arm
    controller.observe(p, points, commanded, dt, **signals)
    # the episode begins with this sample
    command = controller.begin(p, points, commanded, dt, **signals)
    while not controller.done:
        ...                                                # set `command`, wait for a sample
        command = controller.step(p, points, dt, **signals)  # every sample

p: measured pressures (m,) kPa; points: measured key points (n, 3) mm in the frame of the arm's
base, from the base to the tip, NaN where one is lost; commanded: set points (m,) kPa that are in
force; dt: time since the sample before, s. With several arms each of them is a dict from the arm's
name to its array, and so is the command. signals: measurements of the scene by their names, such
as view_fraction=0.9, beam_on=1.0; none for a task without a scene. `policy.json` states every name,
order, unit and range.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np

Arrays = dict[str, np.ndarray]
Function = Callable[[Arrays], list]
"""Input arrays by name in, output arrays in the order of `policy.json` out."""


MOST_PERIODS = 20.0
"""Longest time between two samples of an episode, in control periods. After a longer one the arm
has moved on without decisions, and the policy would go on as if it had not."""
BEYOND = 1e-3
"""By how much a share or a flag may be outside of its range, by rounding."""
SHARE = "-"
"""Unit of shares and flags, whose ranges are hard; distances may be beyond theirs."""


class Controller:
    """One robot's controller: keeps the state between samples and checks what comes in."""

    def __init__(self, folder: str | Path, engine: str | None = None):
        """Open an exported policy.

        engine: `onnxruntime`, `torch` or `onnx`; None: the first that is installed. A policy whose
        arm model calls Python code has none of these, and imports that code.
        """
        folder = Path(folder)
        about = json.loads((folder / "policy.json").read_text(encoding="utf-8"))
        if about.get("controller") is None:
            raise ValueError(f"{folder / 'policy.json'}: has no controller, {about.get('note')}")
        self._set(about, _function(folder, about["controller"], engine))

    @classmethod
    def of(cls, about: Mapping[str, Any], function: Function) -> Controller:
        """A controller from the content of `policy.json` and a function in place of the files."""
        made = cls.__new__(cls)
        made._set(about, function)
        return made

    def _set(self, about: Mapping[str, Any], function: Function) -> None:
        self.about, self._function = about, function
        self.arms = {arm["name"]: arm for arm in about["controller"]["arms"]}
        self._leaves = {leaf["name"]: leaf for leaf in about["controller"]["state"]["leaves"]}
        self._signals = {s["name"]: s for s in about["controller"]["signals"]}
        self._goal = about["controller"]["goal"]
        self._names = about["controller"]["outputs"]
        self.reset()

    def reset(self) -> None:
        """Start from an arm at rest: vented, without memory of earlier pressures."""
        self._state = np.array(self.about["controller"]["state"]["initial"], np.float32)[None]
        self._last: dict[str, np.ndarray] = {}
        self._begun = False
        self.outputs: Arrays = {}

    def set(self, **values: Any) -> None:
        """Change parts of the state by the names in `policy.json` (`settable`).

        Dots are written as two underscores: `set(arms__arm__mount=np.eye(4))`.
        """
        for name, value in values.items():
            self._put(name.replace("__", "."), value)

    def limit(self, lowest_kPa, highest_kPa) -> None:
        """Hold commands within other limits, (m,) kPa or a dict by arm, inside those trained with.

        Stays until `reset`.
        """
        for end, given, stricter in (
            ("lowest", lowest_kPa, np.maximum),
            ("highest", highest_kPa, np.minimum),
        ):
            for name, arm in self.arms.items():
                value = self._array(given, name, f"{end}_kPa", (arm["chambers"],))[0]
                self._put(f"arms.{name}.plant.{end}_kPa", stricter(value, arm[f"{end}_kPa"]))

    @property
    def steps(self) -> int:
        """Decisions since the episode began, without the first."""
        return round(float(self.state("steps")))

    @property
    def done(self) -> bool:
        """Whether the episode has begun and its time is out."""
        return self._begun and self.steps >= self.about["episode_steps"]

    def state(self, name: str) -> np.ndarray:
        """A part of the state by its name in `policy.json`."""
        leaf = self._leaf(name)
        return self._state[0, leaf["first"] : leaf["last"]].reshape(leaf["shape"]).copy()

    def observe(self, pressure_kPa, key_points_mm, commanded_kPa, dt_s, **signals: float) -> None:
        """Follow a sample before the episode begins: the models remember what the arm did."""
        self._run(pressure_kPa, key_points_mm, commanded_kPa, dt_s, 0.0, signals)

    def begin(self, pressure_kPa, key_points_mm, commanded_kPa, dt_s, goal=None, **signals: float):
        """Begin an episode with this sample; returns the pressures to command, kPa.

        goal: values by the names in `policy.json`, such as {"traversal.start": 0.25}; what is not
        named has its default.
        """
        for leaf in self._goal:
            self._put(leaf["name"], leaf["default"])
        known = {leaf["name"].removeprefix("goal."): leaf["name"] for leaf in self._goal}
        for name, value in (goal or {}).items():
            if name not in known:
                raise ValueError(f"goal '{name}' is not known, expected {', '.join(known)}")
            self._put(known[name], value)
        self._run(pressure_kPa, key_points_mm, commanded_kPa, dt_s, 1.0, signals)
        self._begun = True
        return self._commands()

    def step(self, pressure_kPa, key_points_mm, dt_s, commanded_kPa=None, **signals: float):
        """Follow a sample; returns the pressures to command, kPa.

        A new decision is made once in a control period; in between the last one is returned.
        commanded_kPa: the set points in force where they are not those that were returned last,
        for example because a safety layer held them back. Raises ValueError after more than
        `MOST_PERIODS` control periods without a sample.
        """
        if not self._begun:
            raise ValueError("step before begin: call begin(...) with the first sample")
        longest_s = MOST_PERIODS * self.about["controller"]["control_period_s"]
        if float(dt_s) > longest_s:
            raise ValueError(
                f"dt_s is {float(dt_s):g} s, expected at most {longest_s:g} s within an episode; "
                "after a longer break bring the arm to its start and call begin(...) again"
            )
        self._run(pressure_kPa, key_points_mm, commanded_kPa, dt_s, 0.0, signals)
        return self._commands()

    def _run(self, pressure, points, commanded, dt_s, begin, signals) -> None:
        dt_s = float(dt_s)
        if not 0.0 <= dt_s < np.inf:
            raise ValueError(f"dt_s is {dt_s}, expected 0 s or more")
        given = {
            "state": self._state,
            "begin": np.array([begin], np.float32),
            "dt_s": np.array([dt_s], np.float32),
        }
        several = [("pressure_kPa", pressure), ("key_points_mm", points)]
        for name, arm in self.arms.items():
            shapes = {"pressure_kPa": (arm["chambers"],), "key_points_mm": (arm["key_points"], 3)}
            for kind, value in several:
                given[f"{name}_{kind}"] = self._array(value, name, kind, shapes[kind])
            if commanded is None:
                value = self._last[name]
            else:
                value = self._array(commanded, name, "commanded_kPa", shapes["pressure_kPa"])
            given[f"{name}_commanded_kPa"] = value
        unknown = sorted(set(signals) - set(self._signals))
        if unknown:
            known = ", ".join(self._signals) or "no signal"
            raise ValueError(f"signal '{unknown[0]}' is not known, expected {known}")
        for name, signal in self._signals.items():
            value = signals.get(name, signal["default"])
            value = np.nan if value is None else float(value)
            if not np.isfinite(value) and not signal["optional"]:
                raise ValueError(f"signal '{name}' is missing: {signal['meaning']}")
            low, high = signal["low"], signal["high"]
            outside = value < low - BEYOND or value > high + BEYOND
            if outside and signal["unit"] == SHARE:
                raise ValueError(
                    f"signal '{name}' is {value:g}, expected {low:g} to {high:g}: "
                    f"{signal['meaning']}"
                )
            given[name] = np.array([value], np.float32)
        found = dict(zip(self._names, self._function(given), strict=True))
        self._state = np.asarray(found.pop("next_state"), np.float32)
        self.outputs = {name: np.asarray(value)[0] for name, value in found.items()}
        for name in self.arms:
            self._last[name] = self.outputs[f"{name}_command_kPa"][None].astype(np.float32)

    def _array(self, value, name: str, kind: str, shape: tuple) -> np.ndarray:
        """(1, ...) one arm's part of a measurement, checked."""
        if isinstance(value, Mapping):
            if name not in value:
                raise ValueError(f"{kind}: arm '{name}' is missing, got {', '.join(value)}")
            value = value[name]
        elif len(self.arms) > 1:
            raise ValueError(f"{kind}: expected a dict with the arms {', '.join(self.arms)}")
        array = np.asarray(value, np.float32)
        if array.shape != shape:
            raise ValueError(f"{kind} of arm '{name}': shape {array.shape}, expected {shape}")
        if kind != "key_points_mm" and not np.isfinite(array).all():
            raise ValueError(f"{kind} of arm '{name}': {array.tolist()}, expected finite numbers")
        return array[None]

    def _commands(self):
        """(m,) kPa of the only arm, or a dict of them by arm."""
        each = {name: value[0].astype(np.float64) for name, value in self._last.items()}
        return each if len(each) > 1 else next(iter(each.values()))

    def _leaf(self, name: str) -> dict:
        if name not in self._leaves:
            raise ValueError(f"'{name}' is not in the state, expected {', '.join(self._leaves)}")
        return self._leaves[name]

    def _put(self, name: str, value) -> None:
        leaf = self._leaf(name)
        array = np.asarray(value, np.float32)
        if array.shape != tuple(leaf["shape"]):
            raise ValueError(f"'{name}' has shape {array.shape}, expected {tuple(leaf['shape'])}")
        self._state[0, leaf["first"] : leaf["last"]] = array.ravel()


def _function(folder: Path, about: dict, engine: str | None) -> Function:
    """The controller's function by the first engine that is installed."""
    engines = {"onnxruntime": _onnxruntime, "torch": _torch, "onnx": _onnx}
    if "python" in about:
        engines = {"numpy": _numpy}
    if engine is not None and engine not in engines:
        raise ValueError(f"engine '{engine}' is not known, expected {', '.join(engines)}")
    for name in [engine] if engine else engines:
        try:
            return engines[name](folder, about)
        except ImportError:
            continue
    raise ImportError(f"install one of {', '.join(engines)} (asked for: {engine or 'any'})")


def _numpy(folder: Path, about: dict) -> Function:
    spec = spec_from_file_location("controller_code", folder / "controller_code.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.opened()


def _onnxruntime(folder: Path, about: dict) -> Function:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # errors: it warns of what it cannot simplify
    session = onnxruntime.InferenceSession(
        str(folder / about["onnx"]), options, providers=["CPUExecutionProvider"]
    )
    return lambda given: list(session.run(about["outputs"], given))


def _torch(folder: Path, about: dict) -> Function:
    import torch

    script = torch.jit.load(str(folder / about["torchscript"]))

    def call(given: Arrays) -> list:
        with torch.no_grad():
            found = script(*(torch.from_numpy(given[name]) for name in about["inputs"]))
        return [value.numpy() for value in found]

    return call


def _onnx(folder: Path, about: dict) -> Function:
    from onnx.reference import ReferenceEvaluator

    session = ReferenceEvaluator(str(folder / about["onnx"]))
    return lambda given: list(session.run(about["outputs"], given))
