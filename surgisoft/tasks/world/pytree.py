"""Pytree operations on states: frozen dataclasses, dicts and tuples of tensors, batch in front."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import Field, dataclass, fields, is_dataclass
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import torch
from torch import Tensor

Tree = TypeVar("Tree")
Item = TypeVar("Item")


class TensorDataclass(Protocol):
    """A frozen dataclass whose fields are tensors (B, ...) or pytrees of them."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


@dataclass(frozen=True, eq=False)
class ObjectBatch(Generic[Item]):
    """One Python object for each of B environments, as a leaf of a state of tensors.

    `rows` and `with_rows` select and replace objects as they do rows of tensors; `tree_map` leaves
    them alone. An object that changes in a step (a simulated rig) is shared by the old state and
    the new one, so the old state must not be stepped again.
    """

    items: tuple[Item, ...]
    """The B objects, one for each environment."""


def tree_map(function: Callable[..., Tensor], tree: Tree, *others: Tree) -> Tree:
    """Apply `function` to each tensor of a pytree and its counterparts in `others`.

    A leaf that is no tensor (a name, None, an `ObjectBatch`) is kept as it is in `tree`.
    """
    return _mapped(function, lambda objects, *_: objects, tree, *others)


def leaves(tree: Any) -> list[Tensor]:
    """The tensors of a pytree, in order."""
    found: list[Tensor] = []

    def kept(value: Tensor) -> Tensor:
        found.append(value)
        return value

    tree_map(kept, tree)
    return found


def rows(tree: Tree, index: Tensor) -> Tree:
    """The environments at index (R,) int64."""

    def chosen(objects: ObjectBatch) -> ObjectBatch:
        return ObjectBatch(tuple(objects.items[i] for i in index.tolist()))

    return _mapped(lambda value: value.index_select(0, index), chosen, tree)


def with_rows(tree: Tree, index: Tensor, fresh: Tree) -> Tree:
    """The pytree with the environments at index (R,) int64 replaced by those of `fresh`.

    Out of place; values are copied, never blended, so a nan that is replaced leaves no trace.
    """

    def replaced(old: ObjectBatch, new: ObjectBatch) -> ObjectBatch:
        items = list(old.items)
        for place, item in zip(index.tolist(), new.items, strict=True):
            items[place] = item
        return ObjectBatch(tuple(items))

    def copied(old: Tensor, new: Tensor) -> Tensor:
        return old.index_copy(0, index, new.to(old.dtype))

    return _mapped(copied, replaced, tree, fresh)


def overwritable(tensor: Tensor) -> bool:
    """Whether PyTorch allows a write here: a tensor made under inference_mode only inside one."""
    return torch.is_inference_mode_enabled() or not tensor.is_inference()


def _mapped(
    of_tensors: Callable[..., Tensor],
    of_objects: Callable[..., ObjectBatch],
    tree: Any,
    *others: Any,
) -> Any:
    """The pytree with one function applied to its tensors and one to its object batches."""
    if isinstance(tree, Tensor):
        return of_tensors(tree, *others)
    if isinstance(tree, ObjectBatch):
        return of_objects(tree, *others)
    if isinstance(tree, dict):
        return {
            key: _mapped(of_tensors, of_objects, value, *(other[key] for other in others))
            for key, value in tree.items()
        }
    if isinstance(tree, tuple):
        return tuple(
            _mapped(of_tensors, of_objects, *values) for values in zip(tree, *others, strict=True)
        )
    if is_dataclass(tree) and not isinstance(tree, type):
        parts = {
            field.name: _mapped(
                of_tensors,
                of_objects,
                getattr(tree, field.name),
                *(getattr(other, field.name) for other in others),
            )
            for field in fields(tree)
        }
        return type(tree)(**parts)
    return tree
