"""Functions of rows, cut into pieces that stay in the cache."""

from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from torch import Tensor

Rows = tuple[Tensor, ...]


def kernel(*, chunk: int = 4096) -> Callable[[Callable[..., Rows]], Callable[..., Rows]]:
    """Let a function of tensors `(..., batch)` to a tuple of tensors `(..., batch)` take so many problems at a time.

    The elements of its batch must not depend on each other.

    Args:
        chunk: How many problems.
    """

    def decorate(function: Callable[..., Rows]) -> Callable[..., Rows]:
        @wraps(function)
        def in_pieces(*rows: Tensor, **options: Any) -> Rows:
            batch = rows[0].shape[-1]
            if batch <= chunk:
                return function(*rows, **options)
            pieces = [function(*(row[..., i : i + chunk] for row in rows), **options) for i in range(0, batch, chunk)]
            return tuple(torch.cat(parts, -1) for parts in zip(*pieces, strict=True))

        return in_pieces

    return decorate
