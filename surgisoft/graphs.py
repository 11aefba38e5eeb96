"""PyTorch modules as files for other programs: TorchScript and ONNX, checked against the module.

A traced graph holds what one call computed: Python branches on values are frozen. So every file is
compared with its module on inputs that were not traced, and is removed where the two differ.
"""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from surgisoft.errors import InputError

OPSET = 20
"""ONNX operator set of the files: onnxruntime 1.17 (2024) and later read it."""

Call = Callable[..., tuple[Tensor, ...]]
"""Tensors in, tensors out."""


class DoesNotTrace(Exception):
    """A module cannot be written as a graph; the message names the reason in one line."""


def write_torch_script(module: nn.Module, example: Sequence[Tensor], file: Path) -> Call:
    """Write a module as TorchScript; returns the file's function."""
    return write_torch_script_of(module, {"forward": tuple(example)}, file)["forward"]


def write_torch_script_of(
    module: nn.Module, methods: Mapping[str, Sequence[Tensor]], file: Path
) -> dict[str, Call]:
    """Write several methods of a module as one TorchScript file; returns the file's functions.

    methods: name of each method -> its example arguments.
    """
    with _quiet():
        try:
            given = {name: tuple(value) for name, value in methods.items()}
            traced = torch.jit.trace_module(module, given, check_trace=False)
        except Exception as error:
            raise DoesNotTrace(reason_of(error)) from error
        # Written by Python: the library's own writer ends the process where the disk is full.
        content = io.BytesIO()
        torch.jit.save(traced, content)
        file.write_bytes(content.getvalue())
        again = torch.jit.load(str(file))

    def function(name: str) -> Call:
        return lambda *given: _tuple(getattr(again, name)(*given))

    return {name: function(name) for name in methods}


def write_onnx(
    module: nn.Module,
    example: Sequence[Tensor],
    file: Path,
    inputs: Sequence[str],
    outputs: Sequence[str],
    batched: bool = True,
) -> Call:
    """Write a module as ONNX; returns the file's function by ONNX's reference evaluator.

    inputs, outputs: names; batched: whether the first dimension of all inputs may vary.
    """
    shapes = tuple({0: torch.export.Dim("batch")} for _ in example) if batched else None
    with _quiet():
        try:
            made = torch.onnx.export(
                module,
                # Copies: one tensor given twice would become one input.
                tuple(value.clone() for value in example),
                input_names=list(inputs),
                output_names=list(outputs),
                dynamic_shapes=shapes,
                opset_version=OPSET,
                dynamo=True,
                verbose=False,
                # The rewriter takes minutes for an observer's 10,000 nodes; runtimes optimise
                # a graph when they load it.
                optimize=False,
            )
            assert made is not None  # the exporter of torch 2.5 and before gives nothing back
            content = _bare(made.model_proto).SerializeToString()
        except ImportError:
            raise
        except Exception as error:
            raise DoesNotTrace(reason_of(error)) from error
    _check_runtime(content)
    file.write_bytes(content)
    from onnx.reference import ReferenceEvaluator

    session = ReferenceEvaluator(str(file))

    def call(*given: Tensor) -> tuple[Tensor, ...]:
        named = {name: value.detach().numpy() for name, value in zip(inputs, given, strict=True)}
        with np.errstate(all="ignore"):
            found = session.run(None, named)
        return tuple(torch.from_numpy(np.asarray(out)) for out in found)

    return call


def _bare(model):
    """An onnx.ModelProto without what the exporter notes of its nodes: paths and lines of code."""
    for node in [*model.graph.node, *(node for each in model.functions for node in each.node)]:
        del node.metadata_props[:]
    return model


def largest_difference(
    module: Call,
    other: Call,
    cases: Iterable[Sequence[Tensor]],
    states: int = 0,
    compared_states: bool = True,
) -> float:
    """Largest difference of any output over cases; infinite where one is not a number.

    states: so many of the first outputs are the first inputs of the next case, in either function,
    so that errors may add up over a sequence of cases. compared_states: whether they count
    themselves, too, and not only by what follows from them.
    """
    worst, mine, theirs = 0.0, None, None
    with torch.no_grad():
        for case in cases:
            ours = case if mine is None else (*mine[:states], *case[states:])
            others = case if theirs is None else (*theirs[:states], *case[states:])
            mine, theirs = _tuple(module(*ours)), _tuple(other(*others))
            first = 0 if compared_states else states
            for a, b in zip(mine[first:], theirs[first:], strict=True):
                gap = (a - b).abs()
                gap = torch.where(a.isnan() & b.isnan(), 0.0, gap)
                largest = float(gap.max()) if gap.numel() else 0.0
                worst = max(worst, largest if np.isfinite(largest) else np.inf)
    return worst


def _tuple(value) -> tuple[Tensor, ...]:
    return tuple(value) if isinstance(value, tuple | list) else (value,)


def reason_of(error: Exception) -> str:
    """The first line of a message that says something, shortened.

    The message of an InputError, which tells what to do, is whole and without its class.
    """
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, InputError):
            return str(cause)
        cause = cause.__cause__ or cause.__context__
    cause = error.__cause__ or error
    lines = [line.strip() for line in str(cause).splitlines() if line.strip()]
    return f"{type(cause).__name__}: {lines[0][:140]}" if lines else type(cause).__name__


def _check_runtime(content: bytes) -> None:
    """Raise DoesNotTrace where onnxruntime is installed and cannot open a file.

    The reference evaluator knows every operator for every type, onnxruntime does not.
    """
    try:
        import onnxruntime
    except ImportError:
        return
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.log_severity_level = 4
    try:
        onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise DoesNotTrace(f"onnxruntime cannot open it: {reason_of(error)}") from error


@contextlib.contextmanager
def _quiet():
    """Without the exporter's chatter, which takes most of its time where logs are kept.

    Its errors are raised.
    """
    before = logging.root.manager.disable
    logging.disable(logging.ERROR)
    try:
        with (
            warnings.catch_warnings(),
            contextlib.redirect_stdout(io.StringIO()),
            without_stacks(),
        ):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


@contextlib.contextmanager
def without_stacks():
    """Traces of modules do not keep the call stack of each operation, which nobody reads."""
    name = "do_not_emit_stack_traces"
    if not hasattr(torch.fx.config, name):  # torch 2.10 and before
        yield
        return
    before = getattr(torch.fx.config, name)
    setattr(torch.fx.config, name, True)
    try:
        yield
    finally:
        setattr(torch.fx.config, name, before)
