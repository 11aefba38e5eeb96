"""States are trees of tensors: frozen dataclasses, mappings and tuples, with the batch in front."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import TypeVar

from torch import Tensor

Tree = TypeVar("Tree")


def tree_map(function: Callable[..., Tensor], tree: Tree, *others: Tree) -> Tree:
    """The tree with `function` applied to each tensor and its counterparts in `others`.

    What is no tensor (a name, None) is kept as it is in `tree`.
    """
    if isinstance(tree, Tensor):
        return function(tree, *others)
    if isinstance(tree, dict):
        return {
            key: tree_map(function, value, *(other[key] for other in others))
            for key, value in tree.items()
        }
    if isinstance(tree, tuple):
        return tuple(tree_map(function, *values) for values in zip(tree, *others, strict=True))
    if is_dataclass(tree):
        parts = {
            field.name: tree_map(
                function,
                getattr(tree, field.name),
                *(getattr(other, field.name) for other in others),
            )
            for field in fields(tree)
        }
        return replace(tree, **parts)
    return tree


def rows(tree: Tree, index: Tensor) -> Tree:
    """The environments at index (R,) int64."""
    return tree_map(lambda value: value.index_select(0, index), tree)


def with_rows(tree: Tree, index: Tensor, fresh: Tree) -> Tree:
    """The tree with the environments at index (R,) int64 replaced by those of `fresh`.

    Out of place, and nothing is blended: a nan that is replaced is gone.
    """
    return tree_map(lambda old, new: old.index_copy(0, index, new.to(old.dtype)), tree, fresh)
