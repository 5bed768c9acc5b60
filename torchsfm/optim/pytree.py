"""Batches held in one tensor or in nested dataclasses, tuples and dicts of tensors, with the batch dimensions in front of each.

Some elements of a batch are told by their `places`, an index for each batch dimension. A batch of none has one element, and is
handed through as it is, whatever it is made of.
"""

from typing import Any, TypeVar

import torch
from torch import Tensor

from torchsfm._types import tensor_map

T = TypeVar("T")
Places = tuple[Tensor, ...]


def leaves(tree: Any) -> list[Tensor]:
    """All tensors, in order."""
    found: list[Tensor] = []

    def collect(v: Tensor) -> Tensor:
        found.append(v)
        return v

    tensor_map(collect, tree)
    return found


def places(mask: Tensor) -> Places:
    """Where a mask (*batch) is True."""
    return mask.nonzero(as_tuple=True) if mask.ndim else ()


def pick(at: Places, tree: T) -> T:
    """Some elements, in a batch of one dimension."""
    if not at:
        return tree
    if len(at) == 1:
        return tensor_map(lambda v: v.index_select(0, at[0]), tree)
    return tensor_map(lambda v: v[at], tree)


def put(at: Places, tree: T, values: T) -> T:
    """The tree with some elements replaced by those of a batch of one dimension."""
    if not at:
        return values
    new = iter(leaves(values))
    if len(at) == 1:
        return tensor_map(lambda v: v.index_copy(0, at[0], next(new)), tree)
    return tensor_map(lambda v: v.index_put(at, next(new)), tree)


def choose(mask: Tensor, a: T, b: T) -> T:
    """Elements of `a` where a mask (*batch) is True, of `b` where not."""
    if bool(mask.all()):
        return a
    if not mask.ndim:
        return b
    other = iter(leaves(b))
    return tensor_map(lambda v: torch.where(mask.reshape(mask.shape + (1,) * (v.ndim - mask.ndim)), v, next(other)), a)


def cut(tree: T, start: int, end: int) -> T:
    """The elements from `start` to `end` of the first batch dimension."""
    return tensor_map(lambda v: v[start:end], tree)


def join(trees: list[T]) -> T:
    """Batches one after the other."""
    if len(trees) == 1:
        return trees[0]
    columns = iter(zip(*(leaves(tree) for tree in trees), strict=True))
    return tensor_map(lambda _: torch.cat(next(columns)), trees[0])


def norm(tree: Any) -> Tensor:
    """The length of each element of a batch of one dimension, (batch)."""
    return torch.stack([v.double().flatten(1).square().sum(-1) for v in leaves(tree)]).sum(0).sqrt()


def flatten(tree: Any, batch: torch.Size, name: str = "x0") -> Any:
    """One batch dimension in front of every tensor.

    Raises:
        ValueError: A tensor of what the caller knows by this name has other dimensions in front.
    """

    def one(v: Tensor) -> Tensor:
        rest = v.shape[len(batch) :]
        front = v.shape[: len(batch)]
        if len(front) < len(batch) or any(own not in (1, size) for own, size in zip(front, batch, strict=True)):
            raise ValueError(f"{name}: wanted batch dimensions {tuple(batch)} of the residuals in front, got {tuple(v.shape)}")
        if len(batch) == 1:
            return v.expand(batch + rest)
        return v.expand(batch + rest).reshape(-1, *rest) if batch else v[None]

    return tensor_map(one, tree)
