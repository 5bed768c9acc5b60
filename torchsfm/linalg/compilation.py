"""The one switch for `torch.compile`, and the decorator of what it compiles.

A kernel is a function of tensors with the batch in the last dimension, without data-dependent shapes, called where nothing is
differentiated. Batches are cut into pieces that stay in the cache: small ones for eager mode, larger ones when compiled. There
is one compiled object for each dtype, device and shape of a problem; the batch is dynamic. Dynamo is imported once the switch
is on, not before.
"""

from collections.abc import Callable
from functools import update_wrapper
from types import FunctionType
from typing import Any, overload

import torch
from torch import Tensor

Rows = tuple[Tensor, ...]

COMPILED_CHUNK = 8192
_WIDTH = 16
_on = False


def compile_kernels(on: bool = True) -> None:
    """Compile the hot kernels of solvers and of robust estimation, from now on and everywhere, or no longer.

    The first call of a solver then takes seconds, up to minutes where PyTorch's disk cache is empty, for each dtype; later ones
    are several times faster for batches of thousands, and slower for single problems. Robust estimation compiles the distances
    of data to models and the steps of refinement, about ten loops for each kind of model, in a minute or more, and is faster
    for single problems too. Needs a C++ compiler. Results may differ
    from those of eager mode by rounding. Whatever keeps a kernel from being compiled whole and once is an error, not a fall
    back to eager mode. No effect on what runs inside a function that is itself being compiled.

    Args:
        on: Whether to compile.
    """
    global _on
    _on = on


def wanted() -> bool:
    """Whether to run what is compiled: the switch is on, and nothing around is being compiled."""
    return _on and not torch.compiler.is_compiling()


class Kernel:
    """A function of rows that is cut into pieces and compiled on demand."""

    def __init__(self, function: Callable[..., Rows], chunk: int) -> None:
        self.function = function
        self.chunk = chunk
        self._compiled: dict[Any, Callable[..., Rows]] = {}
        update_wrapper(self, function)

    def __call__(self, *rows: Tensor, **options: Any) -> Rows:
        """The function's value, the pieces joined along the last dimension; options are constants to the compiler."""
        run, size, batch = self.function, self.chunk, rows[0].shape[-1]
        if batch > 0 and wanted():
            run, size = self._run_compiled, COMPILED_CHUNK
        if batch <= size:
            return run(*rows, **options)
        pieces = [run(*(row[..., i : i + size] for row in rows), **options) for i in range(0, batch, size)]
        return tuple(torch.cat(parts, -1) for parts in zip(*pieces, strict=True))

    def _run_compiled(self, *rows: Tensor, **options: Any) -> Rows:
        first = rows[0]
        # What dynamo would compile anew for.
        state = (torch.get_num_threads(), torch.is_inference_mode_enabled())
        key = (first.dtype, first.device, *state, *options.items(), *(row.shape[:-1] for row in rows))
        compiled = self._compiled.get(key)
        # A multiple of the width of a vector needs no loop for the rest, which would be as much code again.
        batch = first.shape[-1]
        lines = max(2, -(-batch // _WIDTH))
        rows = tuple(_padded(row, lines * _WIDTH).view(*row.shape[:-1], lines, _WIDTH) for row in rows)
        if compiled is None:
            compiled = self._compiled[key] = _compile(self.function, options)
            for row in rows:
                torch._dynamo.mark_dynamic(row, row.ndim - 2, min=2, max=COMPILED_CHUNK // _WIDTH)
        with torch.no_grad():
            outputs = compiled(*rows)
        return tuple(row[..., :batch] for row in outputs)


def _padded(row: Tensor, size: int) -> Tensor:
    """Contiguous, and of this many columns: the last stands in the place of those that are missing."""
    missing = size - row.shape[-1]
    return torch.cat((row, row[..., -1:].expand(*row.shape[:-1], missing)), -1) if missing else row.contiguous()


@overload
def kernel(function: Callable[..., Rows]) -> Kernel: ...
@overload
def kernel(*, chunk: int) -> Callable[[Callable[..., Rows]], Kernel]: ...
def kernel(function: Callable[..., Rows] | None = None, *, chunk: int = 4096) -> Any:
    """Make a function of tensors `(..., batch)` to a tuple of tensors `(..., batch)` a kernel.

    Args:
        function: The function, a plain one whose elements of the batch do not depend on each other.
        chunk: How many problems to take at a time in eager mode.
    """
    return Kernel(function, chunk) if function is not None else lambda f: Kernel(f, chunk)


def _compile(function: Callable[..., Rows], options: dict[str, Any]) -> Callable[..., Rows]:
    import torch._dynamo
    from torch._inductor.compile_fx import compile_fx

    assert isinstance(function, FunctionType)
    # Dynamo keeps what it compiles with the code object: each compiled object gets its own.
    code, names = function.__code__.replace(), function.__globals__
    copy = FunctionType(code, names, function.__name__, function.__defaults__, function.__closure__)
    copy.__kwdefaults__ = (function.__kwdefaults__ or {}) | options
    times = 0

    def once(graph: Any, inputs: list[Any]) -> Any:
        nonlocal times
        times += 1
        if times > 1:
            raise RuntimeError(f"{function.__qualname__} would be compiled more than once")
        # One loop over the batch: the default limit cuts long formulas into many, with their intermediate values in memory.
        return compile_fx(graph, inputs, config_patches={"max_fusion_size": 100_000})

    def whole(*lines: Tensor) -> Rows:
        outputs: Rows = copy(*(line.flatten(-2) for line in lines))
        return outputs

    return torch.compile(whole, fullgraph=True, backend=once)
