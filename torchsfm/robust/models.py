"""Stacks of models: selecting and joining what may be one tensor or a dataclass of tensors."""

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import torch
from torch import Tensor

from torchsfm._types import tensor_map

T = TypeVar("T")


def tensors_of(tree: object) -> list[Tensor]:
    """All tensors of a model, in a fixed order."""
    found: list[Tensor] = []

    def note(tensor: Tensor) -> Tensor:
        found.append(tensor)
        return tensor

    tensor_map(note, tree)
    return found


def zip_map(function: Callable[..., Tensor], *trees: T) -> T:
    """Apply a function of several tensors to models of the same structure, tensor by tensor."""
    results: Iterator[Tensor] = iter([function(*group) for group in zip(*map(tensors_of, trees), strict=True)])
    return tensor_map(lambda _: next(results), trees[0])


def take_slots(models: T, index: Tensor) -> T:
    """From models `(g, slots, ...)` those at `index (g, k)`: `(g, k, ...)`."""
    row = torch.arange(len(index), device=index.device)[:, None]
    return tensor_map(lambda t: t[row, index], models)


def take(tree: T, index: Tensor, size: int) -> T:
    """Those at ascending places of a first batch dimension of a size: where these are all, what came."""
    return tree if len(index) == size else tensor_map(lambda t: t[index], tree)


def join(models: Sequence[T], dim: int = 0) -> T:
    """Concatenate models along a batch dimension."""
    return models[0] if len(models) == 1 else zip_map(lambda *parts: torch.cat(parts, dim), *models)


def select(condition: Tensor, models: T, others: T) -> T:
    """The one where the condition holds, else the other; the condition has the batch dimensions of both."""
    return zip_map(
        lambda a, b: torch.where(condition.reshape(condition.shape + (1,) * (a.ndim - condition.ndim)), a, b), models, others
    )


def put(models: T, index: Tensor, others: T) -> T:
    """Models with those at ascending places `(k)` of the first batch dimension replaced by others `(k, ...)`."""
    return zip_map(lambda t, new: new if len(new) == len(t) else t.index_copy(0, index, new), models, others)


def cast(tree: T, dtype: torch.dtype) -> T:
    """Convert the floating-point tensors of a tree."""
    return tensor_map(lambda t: t.to(dtype) if t.dtype.is_floating_point else t, tree)
