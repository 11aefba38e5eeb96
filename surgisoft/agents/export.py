"""Policies for other programs: networks and whole controllers as ONNX and TorchScript.

`AGENT.onnx` and `AGENT.pt` are an agent's network alone: `observation` (B, D) float32 as the task
gives it in, `action` (B, m) float32 out, change of pressure in kPa within the pumps' largest step.

`controller.onnx` and `controller.pt` are all of it, from measurements to commands, for one robot:
see `ControllerGraph`. `controller.py` runs either without this package, and `policy.json` states
every name, order, unit, scale and range. Where an arm model calls Python code of the user, which no
graph can have, `controller_code.py` is in their place: NumPy code that calls it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from surgisoft.agents import controller_code, controller_runner
from surgisoft.agents.actor import ScaledActor
from surgisoft.agents.controller import ControllerGraph, goal_docs
from surgisoft.agents.controller_runner import Controller
from surgisoft.agents.learned import LearnedPolicy
from surgisoft.agents.observer import ObserverGains
from surgisoft.errors import InputError
from surgisoft.files import check_export_folder, json_safe, new_folder, read_json, write_json
from surgisoft.graphs import (
    Call,
    DoesNotTrace,
    largest_difference,
    write_onnx,
    write_torch_script,
)
from surgisoft.surrogate.callables.exported import described, file_text, functions, opened
from surgisoft.tasks.base import DocumentedTask, Task
from surgisoft.tasks.describe import describe_agents

ABOUT = "policy.json"
"""File that says what an exported policy takes and gives."""
CODE = "controller_code.py"
"""File of a controller whose arm model calls Python code."""
FORMAT = 2
"""Version of `policy.json`; version 1 had the networks alone."""
TOLERANCE = 1e-5
"""Largest accepted difference between actions of exported and original policy, kPa."""
CONTROLLER_TOLERANCE = 1e-4
"""Largest accepted difference of any command (kPa), estimate (mm) or observation of an exported
controller over CHECKED samples; of an observation also what rounding alone makes of it."""
ROUNDING = 6e-8
"""Relative size of the rounding of a number in single precision."""
DRAWS = 8
"""Roundings of the state that are tried where an observation differs by more: one may come out
smaller than the rounding inside a file."""
CHECKED = 40
"""Samples of a random sequence on which an exported controller is compared."""
SETTABLE = {
    "mount": "pose of the arm's base in the task's frame, 4 x 4, mm",
    "plant.lowest_kPa": "lowest pressure that is commanded, kPa",
    "plant.highest_kPa": "highest pressure that is commanded, kPa",
}
"""Parts of an arm's state that a user may set before an episode, with their meaning."""
NOTE = (
    "A block's value is `scale` of the quantity x in `unit`. Values are clipped to -20..20; noise "
    "may carry measured ones past low and high."
)


def export(
    policy: LearnedPolicy,
    folder: Path,
    task: Task | None = None,
    gains: ObserverGains | None = None,
    force: bool = False,
    check: Callable[[Controller], None] | None = None,
) -> list[Path]:
    """Write a policy for other programs, each file checked against the policy; returns the files.

    task: where the policy acts, None: the task of its run. gains: of the observer. force: replace
    an earlier export of a policy. check: is called with the exported controller, where there is
    one, before the files are in their place: what it raises leaves the folder as it was. Raises
    InputError where the folder is in use.
    """
    check_export_folder(folder, ABOUT, force)
    task = task or policy.run.task()
    with new_folder(folder, _files_of(folder)) as fresh:
        written = []
        for agent, actor in policy.actors.items():
            width = policy.run.agents[agent]["observation"]
            written += _network(actor.to("cpu"), width, fresh / agent)
        content = {
            "format": FORMAT,
            "task": policy.run.config["task"],
            "checkpoint": policy.which,
            "iteration": policy.iteration,
            "input": "observation (B, D) float32",
            "output": "action (B, m) float32, change of pressure, kPa",
            "agents": policy.run.agents,
            "trained_with": policy.run.config["versions"],
        }
        try:
            graph = ControllerGraph(task, policy.actors, gains).eval().requires_grad_(False)
            written += (_controller_code if graph.callables else _controller)(graph, fresh)
            content |= describe_controller(graph)
            runner = Path(controller_runner.__file__).read_text(encoding="utf-8")
            (fresh / "controller.py").write_text(runner, encoding="utf-8")
            written.append(fresh / "controller.py")
        except (DoesNotTrace, InputError) as error:
            content |= {"controller": None, "note": str(error)}
            for file in [*fresh.glob("controller.*"), fresh / CODE]:  # what was written of it
                file.unlink(missing_ok=True)
        write_json(fresh / ABOUT, content)
        if check is not None and content["controller"] is not None:
            check(Controller(fresh))
        names = [*(file.name for file in written), ABOUT]
    return [folder / name for name in names]


def _files_of(folder: Path) -> list[str]:
    """Names of the files of an earlier export of a policy; empty without one."""
    if not (folder / ABOUT).is_file():
        return []
    agents = read_json(folder / ABOUT).get("agents") or {}
    stems = [*agents, "controller"]
    names = [ABOUT, CODE, "controller.py"]
    return names + [f"{stem}{suffix}" for stem in stems for suffix in (".pt", ".onnx")]


def controller_of(
    policy: LearnedPolicy, task: Task | None = None, gains: ObserverGains | None = None
) -> Controller:
    """The controller of a policy in this process, without any file; arguments as for `export`."""
    graph = ControllerGraph(task or policy.run.task(), policy.actors, gains)
    return running(graph.eval().requires_grad_(False))


def running(graph: ControllerGraph) -> Controller:
    """A controller that computes with a graph of this process."""
    names = graph.inputs

    def function(given: Mapping[str, Any]) -> list:
        with torch.no_grad():
            found = graph(*(torch.from_numpy(given[name]) for name in names))
        return [value.numpy() for value in found]

    return Controller.of(json_safe(describe_controller(graph)), function)


def describe_controller(graph: ControllerGraph) -> dict[str, Any]:
    """Contents of `policy.json`: names, order, units, scales and ranges of a controller."""
    task, meanings = graph.task, goal_docs(graph.start.goal)
    leaves: list[dict[str, Any]] = [
        {"name": leaf.name, "first": leaf.first, "last": leaf.last, "shape": list(leaf.shape)}
        for leaf in graph.leaves
    ]
    initial = graph.initial[0].tolist()
    arms = [
        {
            "name": name,
            "chambers": arm.chambers,
            "key_points": arm.key_points,
            "lowest_kPa": arm.low.tolist(),
            "highest_kPa": arm.high.tolist(),
            "start_kPa": arm.first.tolist(),
            "largest_change_kPa": arm.pneumatics.step_kPa,
            "model": arm.model.summary(),
        }
        for name, arm in graph.arms.items()
    ]
    goals = [
        {**leaf, "meaning": meanings[leaf["name"]], "default": _shaped(initial, leaf)}
        for leaf in leaves
        if leaf["name"] in meanings
    ]
    if graph.signals:
        lesion = next(leaf for leaf in leaves if leaf["name"] == "lesion")
        goals.append({**lesion, "meaning": "number of the lesion", "default": 0})
    settable = [
        {**leaf, "meaning": meaning, "default": _shaped(initial, leaf)}
        for leaf in leaves
        for suffix, meaning in SETTABLE.items()
        if leaf["name"].startswith("arms.") and leaf["name"].split(".", 2)[2] == suffix
    ]
    agents = describe_agents(cast(DocumentedTask, graph.simulated))
    files: dict[str, Any] = {"onnx": "controller.onnx", "torchscript": "controller.pt"}
    if graph.callables:
        files = {"python": CODE, "model_code": [described(each) for each in graph.callables]}
    signals = [
        {
            "name": signal.name,
            "meaning": signal.meaning,
            "unit": signal.unit,
            "low": signal.low,
            "high": signal.high,
            "default": signal.default,
            "optional": signal.default is not None,
        }
        for signal in graph.signals
    ]
    return {
        "episode_steps": task.steps,
        "episode_s": task.steps * graph.control_s,
        "observations": {
            agent: [
                {
                    "name": block.name,
                    "first": block.first,
                    "last": block.last,
                    "unit": block.unit,
                    "scale": block.scale,
                    "low": block.low,
                    "high": block.high,
                    "meaning": block.meaning,
                }
                for block in facts.observation
            ]
            for agent, facts in agents.items()
        },
        "observations_note": NOTE,
        "controller": {
            **files,
            "runner": "controller.py",
            "control_period_s": graph.control_s,
            "arms": arms,
            "signals": signals,
            "inputs": graph.inputs,
            "outputs": graph.outputs,
            "tensors": _tensors(graph),
            "goal": goals,
            "settable": settable,
            "state": {"size": len(initial), "leaves": leaves, "initial": initial},
        },
    }


def _tensors(graph: ControllerGraph) -> dict[str, dict]:
    """Input or output -> its shape, unit, range and meaning."""
    size = graph.initial.shape[1]
    found: dict[str, dict] = {
        "state": {"shape": [1, size], "meaning": "all memories, see `state`"},
        "begin": {"shape": [1], "meaning": "1 if the episode begins with this sample, else 0"},
        "dt_s": {"shape": [1], "unit": "s", "meaning": "time since the sample before"},
        "next_state": {"shape": [1, size], "meaning": "the state for the next sample"},
    }
    for name, arm in graph.arms.items():
        row, points = [1, arm.chambers], [1, arm.key_points, 3]
        low, high = float(arm.low.min()), float(arm.high.max())
        kPa = {"shape": row, "unit": "kPa", "low": low, "high": high}
        mm = {"shape": points, "unit": "mm"}
        base = "frame of the arm's base, from the base to the tip"
        found |= {
            f"{name}_pressure_kPa": {**kPa, "meaning": "measured pressures"},
            f"{name}_key_points_mm": {
                **mm,
                "meaning": f"measured key points, {base}; NaN where one is lost",
            },
            f"{name}_commanded_kPa": {**kPa, "meaning": "set points that are in force"},
            f"{name}_command_kPa": {**kPa, "meaning": "set points to command now"},
            f"{name}_estimate_mm": {**mm, "meaning": "estimated key points, task's frame"},
            f"{name}_model_mm": {**mm, "meaning": "the arm model's key points, task's frame"},
            f"{name}_observation": {
                "shape": [1, graph.widths[name]],
                "meaning": "observation of the last decision, see `observations`",
            },
        }
    for signal in graph.signals:
        about = {"unit": signal.unit, "low": signal.low, "high": signal.high}
        found[signal.name] = {"shape": [1], **about, "meaning": signal.meaning}
    return {name: {"dtype": "float32", **about} for name, about in found.items()}


def _shaped(values: list[float], leaf: dict) -> Any:
    """A part of a state vector as nested lists."""
    flat = torch.tensor(values[leaf["first"] : leaf["last"]])
    return flat.reshape(leaf["shape"]).tolist()


def _controller_code(graph: ControllerGraph, folder: Path) -> list[Path]:
    """Write `controller_code.py`, checked on a sequence of samples; returns the files."""
    parts = {"_controller": (graph, graph.example(), graph.inputs, False)}
    code, called = functions(parts)
    about = {"inputs": graph.inputs, "model_code": [described(each) for each in called]}
    file = folder / CODE
    runner = Path(controller_code.__file__)
    text = file_text(runner, code, about, {"controller": "_controller"})
    file.write_text(text, encoding="utf-8")
    function = opened(file)["opened"]([each.named.model for each in called])

    def other(*given: Tensor) -> tuple[Tensor, ...]:
        values = {name: value.numpy() for name, value in zip(graph.inputs, given, strict=True)}
        return tuple(torch.from_numpy(np.array(value)) for value in function(values))

    _compared(graph, other, CODE)
    return [file]


def _compared(graph: ControllerGraph, other: Call, name: str) -> None:
    """Raise DoesNotTrace unless a file's function agrees with the graph over samples.

    An observation may be ill-conditioned, such as the direction of an error that is nearly none:
    it may differ by as much as it does from itself where the state is moved by its rounding.
    """
    worst = _largest(graph, graph, other)
    if worst <= CONTROLLER_TOLERANCE:
        return
    noise = torch.Generator().manual_seed(1)

    def moved(state: Tensor, *given: Tensor) -> tuple[Tensor, ...]:
        rounding = 1.0 + ROUNDING * torch.randn(state.shape, generator=noise)
        return graph(state * rounding, *given)

    acted, seen = (_some(graph, graph, observations) for observations in (False, True))
    same = _largest(graph, acted, _some(graph, other, False)) <= CONTROLLER_TOLERANCE
    rounded = _some(graph, moved, True)
    if not (same and any(worst <= _largest(graph, seen, rounded) for _ in range(DRAWS))):
        raise DoesNotTrace(
            f"controller: {name} differs by {worst:.2g} from the policy; an effect or a task "
            "that branches on values cannot be exported"
        )


def _largest(graph: ControllerGraph, one: Call, other: Call) -> float:
    """Largest difference of two functions of a graph's inputs over samples."""
    # The state has coefficients in units of their prior deviations, which noise alone decides
    # where the motion shows little of them; what they do is in the estimates.
    return largest_difference(one, other, _samples(graph), states=1, compared_states=False)


def _some(graph: ControllerGraph, function: Call, observations: bool) -> Call:
    """A function of a graph's inputs that returns the state, and the observations or the rest."""
    names = graph.outputs
    kept = [name.endswith("_observation") == observations for name in names[1:]]

    def call(*given: Tensor) -> tuple[Tensor, ...]:
        state, *found = function(*given)
        return state, *(value for value, keep in zip(found, kept, strict=True) if keep)

    return call


def _controller(graph: ControllerGraph, folder: Path) -> list[Path]:
    """Write `controller.pt` and `controller.onnx`, each checked on a sequence of samples."""
    example = graph.example()
    files = {
        "controller.pt": lambda file: write_torch_script(graph, example, file),
        "controller.onnx": lambda file: write_onnx(
            graph, example, file, graph.inputs, graph.outputs, batched=False
        ),
    }
    for name, write in files.items():
        _compared(graph, write(folder / name), name)
    return [folder / name for name in files]


def _samples(graph: ControllerGraph) -> Iterator[list[Tensor]]:
    """A random sequence of measurements, in which the episode begins after a few samples."""
    random = torch.Generator().manual_seed(0)
    pressure = {name: arm.first.clone() for name, arm in graph.arms.items()}
    for sample in range(CHECKED):
        given = [graph.initial, torch.tensor([float(sample == 5)]), torch.tensor([0.05])]
        for name, arm in graph.arms.items():
            step = arm.pneumatics.step_kPa * torch.randn(arm.chambers, generator=random)
            pressure[name] = (pressure[name] + step).clamp(arm.low, arm.high)
            noise = torch.randn(1, arm.key_points, 3, generator=random)
            points = arm.model.rest_mm + noise
            commanded = pressure[name] + 0.1 * torch.rand(arm.chambers, generator=random)
            given += [pressure[name][None].clone(), points, commanded[None]]
        for signal in graph.signals:
            share = torch.rand(1, generator=random)
            value = signal.low + (signal.high - signal.low) * share
            optional = signal.default is not None and math.isnan(signal.default)
            given.append(torch.full((1,), torch.nan) if optional and sample % 2 else value)
        yield given


def _network(actor: ScaledActor, width: int, stem: Path) -> list[Path]:
    """Write an actor as `STEM.pt` and `STEM.onnx`, checked far beyond what tasks give."""
    example = [torch.zeros(2, width)]
    seen = 3.0 * torch.randn(64, width, generator=torch.Generator().manual_seed(0))
    written = []
    for suffix in (".pt", ".onnx"):
        file = stem.with_name(stem.name + suffix)
        if suffix == ".pt":
            other = write_torch_script(actor, example, file)
        else:
            other = write_onnx(actor, example, file, ["observation"], ["action"])
        worst = largest_difference(actor, other, [[seen]])
        if not worst <= TOLERANCE:
            raise RuntimeError(f"{file}: actions differ by {worst:.2g} kPa from the policy's")
        written.append(file)
    return written
