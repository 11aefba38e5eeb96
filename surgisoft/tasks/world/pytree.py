"""States are pytrees: frozen dataclasses, mappings and tuples of tensors, the batch in front."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import Field, fields, is_dataclass, replace
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import torch
from torch import Tensor

Tree = TypeVar("Tree")
Thing = TypeVar("Thing")


class TensorDataclass(Protocol):
    """A frozen dataclass whose fields are tensors (B, ...) or pytrees of them."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


class Objects(Generic[Thing]):
    """A batch of B things that are no tensors, one for each environment, such as simulated plants.

    `rows` and `with_rows` choose among the things as they choose among the rows of tensors. The
    things themselves are never copied: two states may hold the same one, and where a step changes
    it, only the new state may be stepped again.
    """

    def __init__(self, things: Iterable[Thing]):
        self.things: tuple[Thing, ...] = tuple(things)

    def __len__(self) -> int:
        return len(self.things)


def tree_map(
    function: Callable[..., Tensor],
    tree: Tree,
    *others: Tree,
    objects: Callable[..., Objects] | None = None,
) -> Tree:
    """The pytree with `function` applied to each tensor and its counterparts in `others`.

    `objects` does the same to each batch of `Objects`; without it they are kept as they are in
    `tree`, as is everything else that is no tensor (a name, None).
    """

    def down(value, *values):
        return tree_map(function, value, *values, objects=objects)

    if isinstance(tree, Tensor):
        return function(tree, *others)
    if isinstance(tree, Objects):
        return tree if objects is None else objects(tree, *others)
    if isinstance(tree, dict):
        return {key: down(value, *(o[key] for o in others)) for key, value in tree.items()}
    if isinstance(tree, tuple):
        return tuple(down(*values) for values in zip(tree, *others, strict=True))
    if is_dataclass(tree):
        parts = {
            field.name: down(*(getattr(each, field.name) for each in (tree, *others)))
            for field in fields(tree)
        }
        return replace(tree, **parts)
    return tree


def rows(tree: Tree, index: Tensor) -> Tree:
    """The environments at index (R,) int64."""
    return tree_map(
        lambda value: value.index_select(0, index),
        tree,
        objects=lambda batch: Objects(batch.things[row] for row in index.tolist()),
    )


def with_rows(tree: Tree, index: Tensor, fresh: Tree) -> Tree:
    """The pytree with the environments at index (R,) int64 replaced by those of `fresh`.

    Out of place; values are copied, never blended, so a nan that is replaced leaves no trace.
    """

    def replaced(old: Objects, new: Objects) -> Objects:
        things = list(old.things)
        for row, thing in zip(index.tolist(), new.things, strict=True):
            things[row] = thing
        return Objects(things)

    return tree_map(
        lambda old, new: old.index_copy(0, index, new.to(old.dtype)), tree, fresh, objects=replaced
    )


def overwritable(tensor: Tensor) -> bool:
    """Whether PyTorch allows a write here: a tensor made under inference_mode only inside one."""
    return torch.is_inference_mode_enabled() or not tensor.is_inference()
