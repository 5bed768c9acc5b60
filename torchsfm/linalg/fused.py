"""Functions of several batch dimensions that become one compiled loop: what is computed for every datum and summed over them.

A kernel (`compilation.kernel`) treats every element of one batch dimension on its own. A fused function has several dimensions
of varying size: problems, models, data. It is traced with symbolic sizes and compiled once for each structure of its arguments;
any size from 1 on then runs through the same code, without guards and without compiling anew.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import lru_cache, update_wrapper
from typing import Any, Generic, NamedTuple, ParamSpec, TypeVar

import torch
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.linalg import compilation

P = ParamSpec("P")
R = TypeVar("R")

_LOCK = threading.Lock()
_EXAMPLES = (6, 40, 272, 13, 23, 31, 47)
"""Sizes to trace with: distinct, so that only dimensions of the same name are taken to have the same size."""
_VARIANTS = 8
"""How often a function may be compiled for the same form of arguments because it, or the compiler, treats sizes differently."""


class Variant(NamedTuple):
    """What one function was compiled to."""

    run: Callable[[list[Tensor]], Any]
    holds: Callable[..., bool]
    """Whether it is right for some sizes, given in the order of `names`."""
    names: list[str]
    """The dimensions that this depends on: none if the function treats all sizes alike."""
    reason: str


class Fused(Generic[P, R]):
    """A function of trees of tensors that is compiled while `compile_kernels` is on."""

    def __init__(self, function: Callable[P, R], dims: tuple[str, ...]) -> None:
        self.function = function
        self._dims = tuple(tuple(names.split()) for names in dims)
        self._variants: dict[Any, list[Variant]] = {}
        update_wrapper(self, function)

    def compiles(self, first: Any) -> bool:
        """Whether it is compiled when called with this first argument, now."""
        return compilation.wanted() and getattr(first, "traceable", True)

    def __call__(self, *arguments: P.args, **none: P.kwargs) -> R:
        """The function's value; arguments go by position."""
        if none or not self.compiles(arguments[0]):
            return self.function(*arguments, **none)
        tensors: list[Tensor] = []
        sizes: dict[str, int] = {}
        form: list[Any] = [torch.get_num_threads()]
        for argument, names in _named(arguments, self._dims):
            _flatten(argument, names, tensors, sizes, form)
        if 0 in sizes.values() or (torch.is_grad_enabled() and any(t.requires_grad for t in tensors)):
            return self.function(*arguments, **none)
        value: R = self._variant(tuple(form), sizes, arguments)(tensors)
        return value

    def _variant(self, key: Any, sizes: dict[str, int], arguments: tuple[Any, ...]) -> Callable[[list[Tensor]], Any]:
        """What to run for arguments of this form and these sizes."""
        variants = self._variants.get(key, ())
        for variant in variants:
            if not variant.names or variant.holds(*(sizes[name] for name in variant.names)):
                return variant.run
        with _LOCK:
            found = self._variants.setdefault(key, [])
            if len(found) >= _VARIANTS:
                reasons = "; ".join(variant.reason for variant in found)
                raise RuntimeError(f"{self.function.__qualname__} would be compiled for every size: {reasons}")
            typical = dict(zip((name for name in sizes if name != "1"), _EXAMPLES, strict=False))
            variant = _compile(self.function, self._dims, arguments, typical)
            if not variant.holds(*(sizes[name] for name in variant.names)):
                # A size of 1 is what it is; others are all different: what happens to be equal would be taken to be so always.
                own = {name: 1 if sizes[name] == 1 else sizes[name] + i for i, name in enumerate(typical)}
                while len(set(own.values()) - {1}) < sum(size != 1 for size in own.values()):
                    own = {name: size if size == 1 else size + i for i, (name, size) in enumerate(own.items())}
                variant = _compile(self.function, self._dims, arguments, own)
                if not variant.holds(*(sizes[name] for name in variant.names)):
                    raise RuntimeError(f"{self.function.__qualname__} would be compiled for every size: {variant.reason}")
            found.append(variant)
        return variant.run


def fused(*dims: str) -> Callable[[Callable[P, R]], Fused[P, R]]:
    """Make a function of trees of tensors (tensors, dataclasses, tuples, lists) one that `compile_kernels` compiles as a whole.

    What is not a tensor is a constant to the compiler and must be hashable. Nothing may depend on the values of tensors or on
    the size of a dimension that has a name, nor change its arguments. It runs as it is where derivatives are wanted, where a
    dimension is empty, and if the first argument says of itself that it is not `traceable`.

    Args:
        *dims: For each argument the names of the leading dimensions of all its tensors, as "problem 1 datum"; 1 stands for
            itself. Dimensions without a name have a fixed size.
    """
    return lambda function: Fused(function, dims)


def _flatten(value: Any, names: tuple[str, ...], tensors: list[Tensor], sizes: dict[str, int], form: list[Any]) -> None:
    """Append the tensors of a tree, contiguous or with the last two dimensions exchanged, and what tells it from others."""
    if isinstance(value, Tensor):
        shape = value.shape
        for name, size in zip(names, shape, strict=False):
            if sizes.setdefault(name, size) != size if name != "1" else size != 1:
                raise ValueError(f"wanted tensors of the dimensions {' '.join(names)} with {sizes}, got {tuple(shape)}")
        swapped = _is_swapped(value)
        tensors.append((value.mT if swapped else value).contiguous())
        form.extend((value.dtype, value.device, swapped, shape[len(names) :], value.ndim))
    elif is_dataclass(value) and not isinstance(value, type):
        form.append(type(value))
        for f in fields(value):
            if f.init:
                _flatten(getattr(value, f.name), names, tensors, sizes, form)
    elif isinstance(value, (tuple, list)):
        form.extend((type(value), len(value)))
        for item in value:
            _flatten(item, names, tensors, sizes, form)
    else:
        form.append(value)


def _named(arguments: tuple[Any, ...], dims: tuple[tuple[str, ...], ...]) -> Iterator[tuple[Any, tuple[str, ...]]]:
    """Each argument with the names of its dimensions: none for those after the last that has some."""
    return zip(arguments, dims + ((),) * (len(arguments) - len(dims)), strict=True)


def _is_swapped(value: Tensor) -> bool:
    """Whether the last two dimensions lie in memory the other way round; masks are laid out anew, which is cheap.

    The compiler misreads boolean tensors that do (PyTorch 2.13).
    """
    return value.dtype.is_floating_point and value.ndim > 1 and value.stride(-1) > value.stride(-2) and value.shape[-1] > 1


def _compile(
    function: Callable[..., Any], dims: tuple[tuple[str, ...], ...], arguments: tuple[Any, ...], example: dict[str, int]
) -> Variant:
    """Trace with symbols for the sizes, which have the values of the example, and compile."""
    from torch._guards import TracingContext, tracing
    from torch._inductor.compile_fx import compile_fx
    from torch._subclasses.fake_tensor import FakeTensorMode
    from torch.fx import GraphModule
    from torch.fx.experimental.proxy_tensor import make_fx
    from torch.fx.experimental.symbolic_shapes import DimDynamic, ShapeEnv, StatelessSymbolicContext

    # Dimensions whose examples have the same size share one symbol.
    env = ShapeEnv(duck_shape=True)
    mode = FakeTensorMode(shape_env=env, allow_non_fake_inputs=True)
    inputs: list[Tensor] = []
    swapped: list[bool] = []
    symbols: dict[str, Any] = {}

    def fake(value: Tensor, names: tuple[str, ...]) -> Tensor:
        own = [*names, *value.shape[len(names) :]][: value.ndim]
        swapped.append(_is_swapped(value))
        if swapped[-1]:
            own[-1], own[-2] = own[-2], own[-1]
        kinds = [DimDynamic.DUCK if example.get(name, 1) > 1 else DimDynamic.STATIC for name in own]
        context: Any = StatelessSymbolicContext(dynamic_sizes=kinds)
        shape = [example.get(name, 1) if isinstance(name, str) else name for name in own]
        empty = torch.empty(shape, dtype=value.dtype, device=value.device)
        inputs.append(mode.from_tensor(empty, static_shapes=False, symbolic_context=context))
        sized: Any = zip(own, inputs[-1].shape, strict=True)
        symbols.update((size.node.expr, name) for name, size in sized if example.get(name, 1) > 1)
        return inputs[-1]

    for argument, names in _named(arguments, dims):
        tensor_map(lambda t: fake(t, names), argument)  # noqa: B023
    structure: Any = None  # of the value

    def flat(*rows: Tensor) -> list[Tensor]:
        nonlocal structure
        left = iter([row.mT if swap else row for row, swap in zip(rows, swapped, strict=True)])
        own: tuple[Any, ...] = tensor_map(lambda _: next(left), arguments)
        structure = function(*own)
        found: list[Tensor] = []

        def note(tensor: Tensor) -> Tensor:
            found.append(tensor)
            return tensor

        tensor_map(note, structure)
        return found

    try:
        with torch.no_grad(), _compiling():
            # Constants that the function keeps must be real: it makes them here, before it is traced.
            function(*arguments)
            traced = make_fx(flat, tracing_mode="symbolic", _allow_non_fake_inputs=True)(*inputs)
            traced.graph.eliminate_dead_code()
            # Without what else the tracer notes in the module, which would keep it out of the disk cache.
            graph = GraphModule(traced, traced.graph)
        with torch.no_grad(), tracing(TracingContext(mode)):
            # One loop over the data: the default limit cuts long formulas into many, with intermediate values in memory.
            compiled: Any = compile_fx(graph, inputs, config_patches={"max_fusion_size": 100_000})
    except Exception as error:
        # What the error is about is in its cause: the types of PyTorch's own errors change.
        raise RuntimeError(f"{function.__qualname__} cannot be compiled for {arguments[0]!r}: {error}") from error

    def run(tensors: list[Tensor]) -> Any:
        with torch.no_grad():
            values = iter(compiled(*tensors))
        return tensor_map(lambda _: next(values), structure)

    conditions = [guard.expr for guard in env.guards]
    involved = sorted(set().union(*(c.free_symbols for c in conditions)), key=str)
    ones = [name for name, size in example.items() if size == 1]

    @lru_cache(4096)
    def holds(*sizes: int) -> bool:
        values = dict(zip(involved, sizes, strict=False))
        return set(sizes[len(involved) :]) <= {1} and all(bool(condition.xreplace(values)) for condition in conditions)

    reason = ", ".join([*map(str, conditions), *(f"{name} = 1" for name in ones)])
    return Variant(run, holds, [symbols[symbol] for symbol in involved] + ones, reason)


@contextmanager
def _compiling() -> Iterator[None]:
    """Let `torch.compiler.is_compiling` say so."""
    before = torch.compiler._is_compiling_flag
    torch.compiler._is_compiling_flag = True
    try:
        yield
    finally:
        torch.compiler._is_compiling_flag = before
