"""PyTorch modules as NumPy source code, for programs without PyTorch.

A module is traced (`make_fx`), what depends on its parameters alone is computed, and every
remaining operation becomes one line of Python. Calls of a user's Python callable stay calls: a
graph (ONNX, TorchScript) cannot have them, and NumPy code can. The code computes with the types of
the tensors, so that it differs from the module by rounding alone.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import operator
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch._subclasses import FakeTensorMode
from torch.fx import GraphModule
from torch.fx.experimental.proxy_tensor import make_fx
from torch.fx.experimental.symbolic_shapes import (
    DimDynamic,
    ShapeEnv,
    StatelessSymbolicContext,
)

from surgisoft.graphs import DoesNotTrace, reason_of, without_stacks

WRITTEN = 24
"""Most numbers of a constant that are written as such; more are written as base64."""
LINE = 88
"""Characters of a line of base64."""
BATCHES = (3, 7, 64, 4096)
"""Numbers of rows for which the conditions of a trace have to hold, which has two rows."""
LAST = 2**62
"""Ends of slices from here on are the end of the dimension."""

HELPERS = '''\
def _array(kind, shape, content):
    """A constant from its numbers, or from base64 of their bytes, little-endian."""
    if isinstance(content, str):
        flat = np.frombuffer(base64.b64decode(content), np.dtype(kind).newbyteorder("<"))
        return flat.astype(kind).reshape(shape)
    return np.array(content, kind).reshape(shape)


def _softmax(x, axis):
    raised = np.exp(x - x.max(axis, keepdims=True))
    return raised / raised.sum(axis, keepdims=True)


def _spread(x, shape):
    lead = len(shape) - x.ndim
    wanted = [x.shape[i - lead] if n == -1 else n for i, n in enumerate(shape)]
    return np.broadcast_to(x, wanted)
'''
"""Functions that the code calls; it needs `import base64` and `import numpy as np`."""

_UNARY = {
    "neg": "-{0}",
    "abs": "np.abs({0})",
    "exp": "np.exp({0})",
    "expm1": "np.expm1({0})",
    "log": "np.log({0})",
    "log1p": "np.log1p({0})",
    "log2": "np.log2({0})",
    "log10": "np.log10({0})",
    "sqrt": "np.sqrt({0})",
    "rsqrt": "1.0 / np.sqrt({0})",
    "reciprocal": "1.0 / {0}",
    "sin": "np.sin({0})",
    "cos": "np.cos({0})",
    "tan": "np.tan({0})",
    "asin": "np.arcsin({0})",
    "acos": "np.arccos({0})",
    "atan": "np.arctan({0})",
    "sinh": "np.sinh({0})",
    "cosh": "np.cosh({0})",
    "tanh": "np.tanh({0})",
    "asinh": "np.arcsinh({0})",
    "acosh": "np.arccosh({0})",
    "atanh": "np.arctanh({0})",
    "sigmoid": "1.0 / (1.0 + np.exp(-{0}))",
    "relu": "np.maximum({0}, 0)",
    "sign": "np.sign({0})",
    "sgn": "np.sign({0})",
    "floor": "np.floor({0})",
    "ceil": "np.ceil({0})",
    "round": "np.round({0})",
    "trunc": "np.trunc({0})",
    "isnan": "np.isnan({0})",
    "isinf": "np.isinf({0})",
    "isfinite": "np.isfinite({0})",
    "logical_not": "np.logical_not({0})",
    "bitwise_not": "~{0}",
    "clone": "{0}",
    "alias": "{0}",
    "detach": "{0}",
    "lift_fresh_copy": "{0}",
    "t": "{0}.T",
}
_BINARY = {
    "mul": "{0} * {1}",
    "div": "{0} / {1}",
    "pow": "{0} ** {1}",
    "remainder": "np.remainder({0}, {1})",
    "fmod": "np.fmod({0}, {1})",
    "maximum": "np.maximum({0}, {1})",
    "minimum": "np.minimum({0}, {1})",
    "fmax": "np.fmax({0}, {1})",
    "fmin": "np.fmin({0}, {1})",
    "atan2": "np.arctan2({0}, {1})",
    "hypot": "np.hypot({0}, {1})",
    "copysign": "np.copysign({0}, {1})",
    "mm": "{0} @ {1}",
    "bmm": "{0} @ {1}",
    "mv": "{0} @ {1}",
    "dot": "{0} @ {1}",
    "bitwise_and": "{0} & {1}",
    "bitwise_or": "{0} | {1}",
    "bitwise_xor": "{0} ^ {1}",
    "logical_and": "np.logical_and({0}, {1})",
    "logical_or": "np.logical_or({0}, {1})",
    "logical_xor": "np.logical_xor({0}, {1})",
}
_COMPARED = {"gt": ">", "ge": ">=", "lt": "<", "le": "<=", "eq": "==", "ne": "!="}
_SYMBOLIC = {
    operator.add: "+",
    operator.sub: "-",
    operator.mul: "*",
    operator.floordiv: "//",
    operator.mod: "%",
}
_KINDS = {
    torch.float32: "float32",
    torch.float64: "float64",
    torch.int64: "int64",
    torch.int32: "int32",
    torch.bool: "bool",
    torch.uint8: "uint8",
}
FOREIGN: dict[Any, str] = {}
"""Operators that call a user's callable: operator -> its call, with {0} ... for its arguments."""


class Constants:
    """Constants of generated code, each once."""

    def __init__(self) -> None:
        self.names: dict[bytes, str] = {}
        self.lines: list[str] = []

    def of(self, value: Tensor) -> str:
        """Name of a constant of the value of a tensor."""
        array = np.ascontiguousarray(value.detach().cpu().resolve_conj().resolve_neg().numpy())
        if array.shape != value.shape:
            array = array.reshape(tuple(value.shape))
        kind = f"{array.dtype}{array.shape}".encode()
        key = hashlib.sha256(kind + array.tobytes()).digest()
        if key not in self.names:
            self.names[key] = name = f"C{len(self.names)}"
            self.lines.append(f"{name} = {_written(array)}")
        return self.names[key]


def _written(array: np.ndarray) -> str:
    """A constant as source code; numbers that are not finite are written as base64."""
    shape, kind = tuple(map(int, array.shape)), str(array.dtype)
    plain = array.size <= WRITTEN and (array.dtype.kind in "biu" or np.isfinite(array).all())
    if plain:
        # Doubles of the numbers: their shortest texts are read as the same numbers.
        return f"_array({kind!r}, {shape}, {array.ravel().tolist()})"
    text = base64.b64encode(array.astype(array.dtype.newbyteorder("<")).tobytes()).decode()
    rows = [text[i : i + LINE] for i in range(0, len(text), LINE)]
    inside = "\n    ".join(repr(row) for row in rows)
    return f"_array({kind!r}, {shape}, (\n    {inside}\n))"


def numpy_function(
    module: nn.Module,
    example: Sequence[Tensor],
    name: str,
    inputs: Sequence[str],
    constants: Constants,
    first: str = "model",
    batched: bool = True,
) -> str:
    """Source code of a function of NumPy arrays that computes what a module does.

    Its arguments are `first`, which the calls of a user's callable are made of, and the inputs, in
    the types of the example. It returns a tuple. batched: whether the first dimension of all
    inputs may vary. Raises DoesNotTrace for a module that cannot be traced, and for an operation
    that is not known here.
    """
    try:
        with warnings.catch_warnings(), without_stacks(), torch.no_grad():
            warnings.simplefilter("ignore")
            traced = _traced(module, example, batched)
    except DoesNotTrace:
        raise
    except Exception as error:
        raise DoesNotTrace(reason_of(error)) from error
    with torch.no_grad():
        return _Writer(traced, constants, inputs).function(name, first)


def _traced(module: nn.Module, example: Sequence[Tensor], batched: bool) -> GraphModule:
    """The core operations that a module calls; arguments as for `numpy_function`.

    `torch.export` gives them after two traces and checks of parameters, in four times the time.
    """
    symbols = ShapeEnv()
    fake = FakeTensorMode(shape_env=symbols, allow_non_fake_inputs=True)

    def symbolic(value: Tensor) -> Tensor:
        sizes = [DimDynamic.STATIC] * value.ndim
        if batched:
            sizes[0] = DimDynamic.DUCK  # first dimensions of one size are one symbol
        context: Any = StatelessSymbolicContext(dynamic_sizes=sizes)
        # Copies: one tensor given twice would become one input.
        return fake.from_tensor(value.clone(), symbolic_context=context)

    def operations(*given: Tensor) -> tuple[Tensor, ...]:
        found = module(*given)
        return tuple(found) if isinstance(found, tuple | list) else (found,)

    given = [symbolic(value) for value in example]
    pure = torch.func.functionalize(operations, remove="mutations")
    core: Any = torch.export.default_decompositions()
    with fake, _compiling():
        traced = make_fx(pure, core)(*given)
    for guard in symbols.guards:
        if not all(_holds(guard.expr, size) for size in BATCHES):
            raise DoesNotTrace(
                f"its program depends on the number of rows ({guard.expr}), expected one program "
                "for any number; leave out the condition"
            )
    return traced


@contextlib.contextmanager
def _compiling() -> Iterator[None]:
    """`torch.compiler.is_compiling()` is true, which modules ask before they leave PyTorch."""
    before = torch.compiler._is_compiling_flag
    torch.compiler._is_compiling_flag = True
    try:
        yield
    finally:
        torch.compiler._is_compiling_flag = before


def _holds(condition: Any, size: int) -> bool:
    """Whether a condition of a trace holds for another number of rows."""
    return bool(condition.subs(dict.fromkeys(condition.free_symbols, size)))


class _Writer:
    """Writes one traced program as a function."""

    def __init__(self, program: GraphModule, constants: Constants, inputs: Sequence[str]):
        self.graph, self.constants = program.graph, constants
        self.known: dict[Any, Any] = {}
        """Values of nodes that no input changes."""
        self.text: dict[Any, str] = {}
        """Names of all other nodes in the code."""
        names = iter(inputs)
        for node in self.graph.nodes:
            if node.op == "placeholder":
                self.text[node] = next(names)
            elif node.op == "get_attr":
                self.known[node] = getattr(program, node.target).detach()
        self.arguments = list(inputs)

    def function(self, name: str, first: str) -> str:
        """Source code of the function."""
        lines: list[tuple[Any, str]] = []
        results: Sequence[Any] = ()
        for node in self.graph.nodes:
            if node.op == "output":
                results = node.args[0]
            elif node.op == "call_function":
                line = self._line(node)
                if line is None:
                    continue
                if line.isidentifier():
                    self.text[node] = line
                else:
                    self.text[node] = f"t{len(lines)}"
                    lines.append((node, line))
        wanted = self._wanted(results)
        body = [f"    {self.text[node]} = {line}" for node, line in lines if node in wanted]
        told = ", ".join(self._value(result) for result in results)
        head = f"def {name}({', '.join([first, *self.arguments])}):"
        return "\n".join([head, *body, f"    return ({told},)"]) + "\n"

    def _wanted(self, results: Sequence[Any]) -> set:
        """Nodes that the results follow from."""
        wanted, left = set(), [node for node in results if node in self.text]
        while left:
            node = left.pop()
            if node not in wanted:
                wanted.add(node)
                left += [each for each in node.all_input_nodes if each in self.text]
        return wanted

    def _line(self, node: Any) -> str | None:
        """The expression of a node; None where its value is known, or is that of another node."""
        if str(node.target).split(".")[1:2] == ["_assert_tensor_metadata"] or "assert" in str(
            node.target
        ):
            return None
        if node.target is operator.getitem:
            place = node.args[0]
            if place in self.known:
                self.known[node] = self.known[place][node.args[1]]
                return None
            return f"{self.text[place]}[{node.args[1]}]"
        if all(each in self.known for each in node.all_input_nodes):
            take = torch.fx.node.map_arg
            given = take(node.args, lambda each: self.known[each])
            named = take(node.kwargs, lambda each: self.known[each])
            self.known[node] = node.target(*given, **named)
            return None
        if node.target in _SYMBOLIC:
            one, other = map(self._value, node.args)
            return f"{one} {_SYMBOLIC[node.target]} {other}"
        overload = getattr(node.target, "overloadpacket", node.target)
        if overload in FOREIGN:
            return FOREIGN[overload].format(*map(self._value, node.args))
        return self._expression(node, str(node.target).split(".")[1])

    def _value(self, given: Any) -> str:
        """An argument as source code."""
        if isinstance(given, torch.fx.Node):
            if given in self.text:
                return self.text[given]
            value = self.known[given]
            return self.constants.of(value) if isinstance(value, Tensor) else repr(value)
        if isinstance(given, list | tuple):
            inside = ", ".join(map(self._value, given))
            return f"({inside},)" if len(given) == 1 else f"({inside})"
        if isinstance(given, float) and not np.isfinite(given):
            return f"float({str(given)!r})"
        if isinstance(given, torch.dtype):
            return f"np.{_kind(given)}"
        return repr(given)

    def _cast(self, given: Any, kind: torch.dtype | None) -> str:
        """An argument in the type of the result, where NumPy's would be another."""
        text = self._value(given)
        own = _type_of(given)
        return text if own is None or own == kind else f"{text}.astype(np.{_kind(kind)})"

    def _expression(self, node: Any, name: str) -> str:
        args, kwargs = node.args, node.kwargs
        kind = _type_of(node)
        if name in _COMPARED:
            return f"{self._value(args[0])} {_COMPARED[name]} {self._value(args[1])}"
        if name in ("add", "sub"):
            one, other = self._cast(args[0], kind), self._cast(args[1], kind)
            if kwargs.get("alpha", 1) != 1:
                other = f"{kwargs['alpha']!r} * {other}"
            return f"{one} {'+' if name == 'add' else '-'} {other}"
        if name == "rsub":
            return f"{self._cast(args[1], kind)} - {self._cast(args[0], kind)}"
        if name in _BINARY and not kwargs:
            return _BINARY[name].format(self._cast(args[0], kind), self._cast(args[1], kind))
        if name in ("isnan", "isinf", "isfinite", "logical_not"):
            return _UNARY[name].format(self._value(args[0]))
        if name in _UNARY:
            return _UNARY[name].format(self._cast(args[0], kind))
        writer = getattr(self, f"_op_{name}", None)
        if writer is None:
            raise DoesNotTrace(
                f"the operation '{name}' cannot be written as NumPy code; write the effect with "
                "sums, products, powers, elementary functions and torch.where"
            )
        return writer(node, kind, *args, **kwargs)

    # Shapes -------------------------------------------------------------------------------

    def _op_view(self, node, kind, x, shape):
        return f"{self._value(x)}.reshape({self._value(shape)})"

    _op_reshape = _op__unsafe_view = _op_view

    def _op_permute(self, node, kind, x, order):
        return f"{self._value(x)}.transpose({self._value(order)})"

    def _op_transpose(self, node, kind, x, one, other):
        return f"{self._value(x)}.swapaxes({one}, {other})"

    def _op_expand(self, node, kind, x, shape, implicit=False):
        return f"_spread({self._value(x)}, {self._value(shape)})"

    def _op_unsqueeze(self, node, kind, x, axis):
        return f"np.expand_dims({self._value(x)}, {axis})"

    def _op_squeeze(self, node, kind, x, axes):
        axes = [axes] if isinstance(axes, int) else axes
        single = tuple(axis for axis in axes if _shape_of(x)[axis] == 1)
        return f"{self._value(x)}.squeeze({single})" if single else self._value(x)

    def _op_slice(self, node, kind, x, axis=0, start=None, end=None, step=1):
        end = None if isinstance(end, int) and end >= LAST else end
        start = None if start == 0 else start
        if start is None and end is None and step == 1:
            return self._value(x)
        marks = ["" if mark is None else self._value(mark) for mark in (start, end)]
        inside = ":".join([*marks, *([] if step == 1 else [str(step)])])
        return f"{self._value(x)}[{_at(axis, node, inside)}]"

    def _op_select(self, node, kind, x, axis, index):
        return f"{self._value(x)}[{_at(axis, x, self._value(index))}]"

    def _op_cat(self, node, kind, parts, axis=0):
        kept = [part for part in parts if _shape_of(part) != (0,)]
        inside = ", ".join(self._cast(part, kind) for part in kept)
        return f"np.concatenate([{inside}], {axis})"

    def _op_stack(self, node, kind, parts, axis=0):
        inside = ", ".join(self._cast(part, kind) for part in parts)
        return f"np.stack([{inside}], {axis})"

    def _op_split_with_sizes(self, node, kind, x, sizes, axis=0):
        ends = np.cumsum(sizes)[:-1].tolist()
        return f"np.split({self._value(x)}, {ends}, {axis})"

    def _op_index(self, node, kind, x, places):
        inside = ", ".join(":" if place is None else self._value(place) for place in places)
        return f"{self._value(x)}[{inside}]"

    def _op_index_select(self, node, kind, x, axis, places):
        return f"np.take({self._value(x)}, {self._value(places)}, {axis})"

    def _op_gather(self, node, kind, x, axis, places, sparse_grad=False):
        return f"np.take_along_axis({self._value(x)}, {self._value(places)}, {axis})"

    def _op_flip(self, node, kind, x, axes):
        return f"np.flip({self._value(x)}, {self._value(axes)})"

    def _op_roll(self, node, kind, x, shifts, axes=()):
        return f"np.roll({self._value(x)}, {self._value(shifts)}, {self._value(axes)})"

    def _op_constant_pad_nd(self, node, kind, x, widths, value=0):
        if any(isinstance(width, int) and width < 0 for width in widths):
            raise DoesNotTrace("a negative padding cannot be written as NumPy code")
        ends = [self._value(width) for width in widths]
        pairs = [f"({a}, {b})" for a, b in zip(ends[::2], ends[1::2], strict=True)]
        before = ["(0, 0)"] * (len(_shape_of(x)) - len(pairs))
        inside = ", ".join([*before, *reversed(pairs)])
        value = self._value(value)
        return f"np.pad({self._value(x)}, [{inside}], constant_values={value})"

    def _op_max(self, node, kind, x, axis=None, keep=False):
        return self._extreme("max", node, x, axis, keep)

    def _op_min(self, node, kind, x, axis=None, keep=False):
        return self._extreme("min", node, x, axis, keep)

    def _extreme(self, how, node, x, axis, keep):
        text = self._value(x)
        if axis is None:
            return f"{text}.{how}()"
        return (
            f"({text}.{how}({axis}, keepdims={keep}), np.arg{how}({text}, {axis}, keepdims={keep}))"
        )

    # Sums ---------------------------------------------------------------------------------

    def _summed(self, how, kind, x, axes, keep):
        axis = "None" if not axes and axes != 0 else self._value(axes)
        return f"{self._cast(x, kind)}.{how}(axis={axis}, keepdims={keep})"

    def _op_sum(self, node, kind, x, axes=None, keep=False, dtype=None):
        return self._summed("sum", kind, x, axes, keep)

    def _op_mean(self, node, kind, x, axes=None, keep=False, dtype=None):
        return self._summed("mean", kind, x, axes, keep)

    def _op_prod(self, node, kind, x, axes=None, keep=False, dtype=None):
        return self._summed("prod", kind, x, axes, keep)

    def _op_amax(self, node, kind, x, axes=(), keep=False):
        return self._summed("max", kind, x, axes, keep)

    def _op_amin(self, node, kind, x, axes=(), keep=False):
        return self._summed("min", kind, x, axes, keep)

    def _op_any(self, node, kind, x, axes=None, keep=False):
        return self._summed("any", _type_of(x), x, axes, keep)

    def _op_all(self, node, kind, x, axes=None, keep=False):
        return self._summed("all", _type_of(x), x, axes, keep)

    def _op_argmax(self, node, kind, x, axis=None, keep=False):
        return f"np.argmax({self._value(x)}, {axis}, keepdims={keep})"

    def _op_argmin(self, node, kind, x, axis=None, keep=False):
        return f"np.argmin({self._value(x)}, {axis}, keepdims={keep})"

    def _op_cumsum(self, node, kind, x, axis, dtype=None):
        return f"np.cumsum({self._cast(x, kind)}, {axis})"

    def _op__softmax(self, node, kind, x, axis, half):
        return f"_softmax({self._value(x)}, {axis})"

    def _op_linalg_vector_norm(self, node, kind, x, order=2, axes=None, keep=False, dtype=None):
        if order != 2:
            raise DoesNotTrace(f"a norm of order {order} cannot be written as NumPy code")
        squared = f"np.square({self._cast(x, kind)})"
        axis = "None" if not axes and axes != 0 else self._value(axes)
        return f"np.sqrt({squared}.sum(axis={axis}, keepdims={keep}))"

    # Values -------------------------------------------------------------------------------

    def _op_addmm(self, node, kind, added, one, other, beta=1, alpha=1):
        if (beta, alpha) != (1, 1):
            raise DoesNotTrace("a scaled sum of matrices cannot be written as NumPy code")
        return f"{self._value(added)} + {self._value(one)} @ {self._value(other)}"

    _op_baddbmm = _op_addmm

    def _op_where(self, node, kind, mask, yes, no):
        return f"np.where({self._value(mask)}, {self._cast(yes, kind)}, {self._cast(no, kind)})"

    def _op_clamp(self, node, kind, x, low=None, high=None):
        ends = [None if end is None else self._cast(end, kind) for end in (low, high)]
        text = self._cast(x, kind)
        text = text if ends[0] is None else f"np.maximum({text}, {ends[0]})"
        return text if ends[1] is None else f"np.minimum({text}, {ends[1]})"

    def _op_clamp_min(self, node, kind, x, low):
        return self._op_clamp(node, kind, x, low)

    def _op_clamp_max(self, node, kind, x, high):
        return self._op_clamp(node, kind, x, None, high)

    def _op__to_copy(self, node, kind, x, **named):
        return f"{self._value(x)}.astype(np.{_kind(kind)})"

    def _op_full(self, node, kind, shape, value, **named):
        return f"np.full({self._value(shape)}, {self._value(value)}, np.{_kind(kind)})"

    def _op_full_like(self, node, kind, x, value, **named):
        return f"np.full_like({self._value(x)}, {self._value(value)}, np.{_kind(kind)})"

    def _op_zeros_like(self, node, kind, x, **named):
        return self._op_full_like(node, kind, x, 0)

    def _op_ones_like(self, node, kind, x, **named):
        return self._op_full_like(node, kind, x, 1)

    def _op_scalar_tensor(self, node, kind, value, **named):
        return f"np.{_kind(kind)}({self._value(value)})"

    def _op_arange(self, node, kind, *ends, **named):
        inside = ", ".join(map(self._value, ends))
        return f"np.arange({inside}, dtype=np.{_kind(kind)})"

    def _op_sym_size(self, node, kind, x, axis):
        return f"{self._value(x)}.shape[{axis}]"


def _at(axis: int, node: Any, inside: str) -> str:
    """An index of one axis of a node's array."""
    rank = len(_shape_of(node))
    axis = axis % max(rank, 1)
    return ", ".join([":"] * axis + [inside])


def _shape_of(node: Any) -> tuple:
    return tuple(node.meta["val"].shape)


def _type_of(given: Any) -> torch.dtype | None:
    """The type of a node that is a tensor."""
    value = given.meta.get("val") if isinstance(given, torch.fx.Node) else None
    return value.dtype if isinstance(value, Tensor) else None


def _kind(dtype: torch.dtype | None) -> str:
    if dtype not in _KINDS:
        raise DoesNotTrace(f"the type {dtype} cannot be written as NumPy code")
    kind = _KINDS[dtype]
    return "bool_" if kind == "bool" else kind
