"""Functions of rows, cut into pieces that stay in the cache, and the one switch that compiles them by `torch.compile`.

The formulas are the same in both modes. Dynamo is imported once the switch is on, not before.
"""

from collections.abc import Callable
from functools import update_wrapper
from typing import Any, overload

import torch
from torch import Tensor

Rows = tuple[Tensor, ...]

_on = False


def compile_kernels(on: bool = True) -> None:
    """Compile the arithmetic of the hot minimal solvers by `torch.compile`, from now on and everywhere, or no longer.

    The first call of a solver then takes seconds, up to minutes where PyTorch's disk cache is empty; later ones are faster for
    batches of thousands, and hardly for single problems. Needs a C++ compiler on a CPU. Results may differ from those of eager
    mode by rounding. What PyTorch does not compile it runs as it is.

    Args:
        on: Whether to compile.
    """
    global _on
    _on = on


class Kernel:
    """A function of rows that is cut into pieces, each of which runs as it is, or compiled while the switch is on."""

    def __init__(self, function: Callable[..., Rows], chunk: int) -> None:
        self._function = function
        self._compiled: Callable[..., Rows] | None = None
        self._chunk = chunk
        update_wrapper(self, function)

    def __call__(self, *rows: Tensor, **options: Any) -> Rows:
        """The function's value, the pieces joined along the last dimension; options are constants to the compiler."""
        run, batch, size = self._function, rows[0].shape[-1], self._chunk
        if _on:
            run = self._compiled = self._compiled or torch.compile(self._function, dynamic=True)
        if batch <= size:
            return run(*rows, **options)
        pieces = [run(*(row[..., i : i + size] for row in rows), **options) for i in range(0, batch, size)]
        return tuple(torch.cat(parts, -1) for parts in zip(*pieces, strict=True))


@overload
def kernel(function: Callable[..., Rows]) -> Kernel: ...
@overload
def kernel(*, chunk: int) -> Callable[[Callable[..., Rows]], Kernel]: ...
def kernel(function: Callable[..., Rows] | None = None, *, chunk: int = 4096) -> Any:
    """Make a function of tensors `(..., batch)` to a tuple of tensors `(..., batch)` a kernel.

    Args:
        function: The function, a plain one whose elements of the batch do not depend on each other.
        chunk: How many problems to take at a time.
    """
    return Kernel(function, chunk) if function is not None else lambda f: Kernel(f, chunk)
