"""The words every room shares: solutions, statuses, shape checks, and a map over tensors in a dataclass."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from enum import IntEnum
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Bool
from torch import Tensor

M = TypeVar("M")
T = TypeVar("T")


class Status(IntEnum):
    """What became of one element of a batch; result objects hold it as an int8 tensor over the batch."""

    OK = 0
    NOT_CONVERGED = 1
    """The iteration limit came first; the value returned is the best seen."""
    TOO_FEW = 2
    """Fewer valid data than the problem needs."""
    DEGENERATE = 3
    """The data do not determine the answer (collinear, coplanar, zero baseline, ...)."""
    NOT_FINITE = 4
    """The data contain NaN or inf where they count."""
    BEHIND = 5
    """The answer lies behind a camera."""
    NO_CONSENSUS = 6
    """No hypothesis was supported by more data than any sample supports."""
    INTERRUPTED = 7
    """Stopped from outside; the value returned is the best seen."""


@dataclass(frozen=True)
class Solutions(Generic[M]):
    """A fixed number of solution slots per problem.

    `model` holds every slot of every problem, slots right after the batch dimensions; empty slots hold finite numbers without
    meaning. `valid` is the only truth about which slots are solutions.
    """

    model: M
    valid: Bool[Tensor, "*batch slots"]


def tensor_map(function: Callable[[Tensor], Tensor], tree: T) -> T:
    """Apply `function` to every tensor in nested dataclasses, tuples, lists and dicts; leave everything else as it is."""
    value: Any = tree
    if isinstance(value, Tensor):
        value = function(value)
    elif is_dataclass(value) and not isinstance(value, type):
        value = replace(value, **{f.name: tensor_map(function, getattr(value, f.name)) for f in fields(value) if f.init})
    elif isinstance(value, tuple):
        items = [tensor_map(function, item) for item in value]
        value = type(value)(*items) if hasattr(value, "_fields") else tuple(items)
    elif isinstance(value, list):
        value = [tensor_map(function, item) for item in value]
    elif isinstance(value, dict):
        value = {key: tensor_map(function, item) for key, item in value.items()}
    return value  # type: ignore[no-any-return]


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """The shape that all shapes broadcast to; as torch's own, whose first call imports for most of a second.

    Raises:
        ValueError: They do not broadcast.
    """
    result: list[int] = []
    for shape in shapes:
        result = [1] * (len(shape) - len(result)) + result
        for i, size in enumerate(reversed(shape), 1):
            if size != 1 and result[-i] not in (1, size):
                raise ValueError(f"shapes do not broadcast: {[tuple(s) for s in shapes]}")
            result[-i] = size if size != 1 else result[-i]
    return torch.Size(result)


def check_tensors(**arguments: tuple[Tensor | None, str]) -> torch.Size:
    """Check shapes, dtypes and devices of named arguments, and return their common batch shape.

    Each argument comes as `(tensor, spec)`. The spec describes the trailing dimensions: a number is exact, a name is the same
    number wherever it stands, `name>=k` sets a minimum. A spec may end in `: bool` or `: int`; otherwise the tensor must be
    floating point, and all floating-point tensors must share one dtype. `None` stands for an option not given.

    Args:
        **arguments: The tensors under the names the caller knows them by.

    Returns:
        The shape to which the leading dimensions of all arguments broadcast.

    Raises:
        ValueError: An argument has the wrong type, number of dimensions, size, dtype or device, or batches do not broadcast.
    """
    sizes: dict[str, tuple[int, str]] = {}
    batches: dict[str, torch.Size] = {}
    first: tuple[str, Tensor] | None = None
    floating: tuple[str, Tensor] | None = None
    for name, (tensor, spec) in arguments.items():
        if tensor is None:
            continue
        shape_spec, _, kind = (part.strip() for part in spec.partition(":"))
        if not isinstance(tensor, Tensor):
            raise ValueError(f"{name}: wanted a torch.Tensor of shape (*batch, {shape_spec}), got {type(tensor).__name__}")
        _check_kind(name, tensor, kind)
        if kind == "":
            if floating is not None and tensor.dtype != floating[1].dtype:
                raise ValueError(f"{name}: wanted dtype {floating[1].dtype} as {floating[0]} has, got {tensor.dtype}")
            floating = floating or (name, tensor)
        if first is not None and tensor.device != first[1].device:
            raise ValueError(f"{name}: wanted device {first[1].device} as {first[0]} has, got {tensor.device}")
        first = first or (name, tensor)
        tokens = shape_spec.split()
        wanted = f"(*batch, {', '.join(tokens)})" if tokens else "(*batch)"
        if tensor.ndim < len(tokens):
            raise ValueError(f"{name}: wanted shape {wanted}, got {tuple(tensor.shape)}")
        trailing = tensor.shape[tensor.ndim - len(tokens) :]
        for token, size in zip(tokens, trailing, strict=True):
            label, _, minimum = token.partition(">=")
            if token.isdigit():
                if size != int(token):
                    raise ValueError(f"{name}: wanted shape {wanted}, got {tuple(tensor.shape)}")
                continue
            if minimum and size < int(minimum):
                raise ValueError(f"{name}: wanted {label} >= {minimum} in shape {wanted}, got {tuple(tensor.shape)}")
            if label in sizes and sizes[label][0] != size:
                known, owner = sizes[label]
                raise ValueError(f"{name}: wanted {label} = {known} as {owner} has, got shape {tuple(tensor.shape)}")
            sizes.setdefault(label, (size, name))
        batches[name] = tensor.shape[: tensor.ndim - len(tokens)]
    try:
        return broadcast_shapes(*batches.values())
    except ValueError:
        listing = ", ".join(f"{name} {tuple(shape)}" for name, shape in batches.items())
        raise ValueError(f"batch dimensions do not broadcast: {listing}") from None


def _check_kind(name: str, tensor: Tensor, kind: str) -> None:
    if kind == "bool":
        good = tensor.dtype == torch.bool
    elif kind == "int":
        good = not (tensor.dtype.is_floating_point or tensor.dtype.is_complex or tensor.dtype == torch.bool)
    else:
        good, kind = tensor.dtype.is_floating_point, "floating point"
    if not good:
        raise ValueError(f"{name}: wanted a {kind} tensor, got {tensor.dtype}")
