"""An arm model around a Python callable as a file of NumPy code that calls it.

The callable stays the user's own module. The effects before and behind it are written as NumPy
code, and the file is compared with `ArmModel.predict` before it is kept.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from surgisoft.errors import InputError, raised_by
from surgisoft.numpy_code import HELPERS, Constants, numpy_function
from surgisoft.surrogate.callables import arm_runner, portable
from surgisoft.surrogate.callables.called import CALLED
from surgisoft.surrogate.callables.network import CallableNetwork
from surgisoft.surrogate.callables.operators import as_operators

IMPORTED = "from surgisoft.surrogate.callables.portable import Called\n"
"""Line of the runner that the text of that module replaces."""


def described(network: CallableNetwork) -> dict[str, Any]:
    """What an exported file states of the callable that it calls."""
    return {
        "name": network.name,
        "sha256": network.sha256,
        "form": network.form,
        "chambers": len(network.step_size),
        "key_points": network.key_points,
    }


def functions(
    parts: Mapping[str, tuple[nn.Module, Sequence[Tensor], Sequence[str], bool]],
) -> tuple[str, list[CallableNetwork]]:
    """NumPy source of modules that call callables, and the callables in the order of their calls.

    parts: name of each function -> module, example, names of its inputs, and whether the first
    dimension may vary. The functions' first argument is the list of those callables (`Called`).
    """
    constants = Constants()
    with as_operators() as places:
        texts = [
            numpy_function(module, example, name, inputs, constants, "models", batched)
            for name, (module, example, inputs, batched) in parts.items()
        ]
        called = [CALLED[place] for place in range(len(places))]
    return "\n\n".join([HELPERS, "\n".join(constants.lines), *texts]), called


def library(runner: str) -> str:
    """The text of a runner's module with that of the callables' module in it."""
    own = Path(portable.__file__).read_text(encoding="utf-8")
    body = own[own.index("import hashlib") :]
    head, _, rest = runner.partition(IMPORTED)
    assert rest, "the runner imports the callables' module by that line"
    future = "from __future__ import annotations\n"
    before, _, imports = head.partition(future)
    return f"{before}{future}\nimport base64\n{body}\n{imports.lstrip()}{rest}"


def arm_source(graph: Any, start: nn.Module, about: Mapping[str, Any]) -> str:
    """Text of `arm.py` of an `ArmGraph` around a callable; about: the content of `arm.json`."""
    rest = graph.unpacked(graph.rest_state).pressure.clone()
    code, _ = functions(
        {
            "_start": (start, [rest], ["pressure"], False),
            "_step": (graph, graph.example(), graph.inputs, True),
        }
    )
    return file_text(Path(arm_runner.__file__), code, about, {"start": "_start", "step": "_step"})


def file_text(runner: Path, code: str, about: Mapping[str, Any], named: Mapping[str, str]) -> str:
    """Text of an exported file: a runner, the code of a model, and what the runner has to know.

    named: what the runner calls a function of the code -> its name there.
    """
    steps = ", ".join(f'"{name}": {own}' for name, own in named.items())
    return (
        f"{library(runner.read_text(encoding='utf-8'))}\n\n"
        "# Written by the export: constants and functions of this model.\n\n"
        f"{code}\n\n_described({json.dumps(about)!r})\nSTEPS.update({{{steps}}})\n"
    )


def opened(file: Path) -> dict[str, Any]:
    """The names of a file that was written just now; no callable is imported yet."""
    space: dict[str, Any] = {"__name__": file.stem, "__file__": str(file)}
    exec(compile(file.read_text(encoding="utf-8"), str(file), "exec"), space)
    return space


def played(
    arm: Any,
    name: str,
    first: np.ndarray | None,
    rows: Sequence[np.ndarray],
    began_s: float = 0.0,
) -> np.ndarray:
    """(T, n, 3) mm: one run stepped through the file's functions.

    name: of the callable; first: (m,) actuation at which the run begins, None: at rest; rows:
    actuation (T, m), dt_s (T,), and temperatures (T,); began_s: time since the recording began at
    the first row, s.
    """
    try:
        if first is None:
            state = np.array(arm_rest(arm))[None]
            state[:, arm.elapsed] = began_s
        else:
            state = arm.start(first[None], began_s)
        points = []
        for actuation, dt_s, warm in zip(*rows, strict=True):
            state, found = arm.step(state, actuation[None], dt_s, warm)
            points.append(found[0])
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        raise raised_by(name, error) from error
    return np.stack(points)


def arm_rest(arm: Any) -> list[float]:
    """(S,) the state at rest."""
    return arm.start.__globals__["ABOUT"]["rest"]["state"]


def run_of(history: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Actuation (T, m), dt_s (T,) and temperatures (T,) of a history of one run."""
    actuation = history.pressure[0].double().numpy()
    dt_s = np.diff(history.t_s[0].double().numpy(), prepend=float(history.t_s[0, 0]))
    warm = history.temperature_C
    unknown = torch.full((len(actuation),), torch.nan)
    return actuation, dt_s, (unknown if warm is None else warm[0]).double().numpy()
