"""Parameters held in one tensor or in nested dataclasses of tensors, with a batch dimension in front of each."""

from typing import Any

import torch
from torch import Tensor

from torchsfm._types import tensor_map


def leaves(tree: Any) -> list[Tensor]:
    """All tensors, in order."""
    found: list[Tensor] = []

    def collect(v: Tensor) -> Tensor:
        found.append(v)
        return v

    tensor_map(collect, tree)
    return found


def select(mask: Tensor, a: Any, b: Any) -> Any:
    """Elements of `a` where the mask is True, of `b` where not."""
    other = iter(leaves(b))
    return tensor_map(lambda v: torch.where(mask.reshape(-1, *([1] * (v.ndim - 1))), v, next(other)), a)


def put(tree: Any, index: Tensor, values: Any) -> Any:
    """The tree with the elements at `index` replaced."""
    new = iter(leaves(values))
    return tensor_map(lambda v: v.index_copy(0, index, next(new)), tree)


def cut(tree: Any, start: int, end: int) -> Any:
    """The elements from `start` to `end`."""
    return tensor_map(lambda v: v[start:end], tree)


def join(trees: list[Any]) -> Any:
    """Batches one after the other."""
    if len(trees) == 1:
        return trees[0]
    columns = iter(zip(*(leaves(tree) for tree in trees), strict=True))
    return tensor_map(lambda _: torch.cat(next(columns)), trees[0])


def norm(tree: Any) -> Tensor:
    """The length of each element, (batch)."""
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
