"""Functions of rows, cut into pieces that stay in the cache."""

from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from torch import Tensor

from torchsfm.linalg.portions import portions

Rows = tuple[Tensor, ...]


def kernel(*, chunk: int = 4096) -> Callable[[Callable[..., Rows]], Callable[..., Rows]]:
    """Let a function of tensors `(..., batch)` to a tuple of tensors `(..., batch)` take so many problems at a time.

    The elements of its batch must not depend on each other.

    Args:
        chunk: How many problems, on a CPU.
    """

    def decorate(function: Callable[..., Rows]) -> Callable[..., Rows]:
        @wraps(function)
        def in_pieces(*rows: Tensor, **options: Any) -> Rows:
            some = portions(rows[0].shape[-1], chunk, rows[0].device)
            if len(some) <= 1:
                return function(*rows, **options)
            pieces = [function(*(row[..., part] for row in rows), **options) for part in some]
            return tuple(torch.cat(parts, -1) for parts in zip(*pieces, strict=True))

        return in_pieces

    return decorate
