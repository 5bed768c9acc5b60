"""The words every room shares: solutions, statuses, shape checks, and a map over tensors in a dataclass."""

import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import IntEnum
from functools import cache
from numbers import Integral, Real
from typing import Any, Generic, NamedTuple, TypeVar, cast

import torch
from jaxtyping import Bool
from torch import Tensor

M = TypeVar("M")
T = TypeVar("T")


class Status(IntEnum):
    """What became of one element of a batch; result objects hold it as an int8 tensor over the batch.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(3, generator=g), torchsfm.random_poses(2, generator=g).matrix()
        >>> x = torchsfm.project_points(P, X)
        >>> x[:, 1] = torch.nan  # spoils the second point, and no other
        >>> [torchsfm.Status(status).name for status in torchsfm.triangulate_points(x, P).status.tolist()]
        ['OK', 'NOT_FINITE', 'OK']
    """

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

    Example:
        >>> import torch, torchsfm
        >>> d = torch.rand(8, 5, 3, generator=torch.Generator().manual_seed(0))  # eight problems
        >>> E = torchsfm.motion.essential_5pt(d, d.flip(-1))  # ten slots each
        >>> E.model.shape, E.valid.shape, E.model[E.valid].shape[1:]
        (torch.Size([8, 10, 3, 3]), torch.Size([8, 10]), torch.Size([3, 3]))
    """

    model: M
    valid: Bool[Tensor, "*batch slots"]


def tensor_map(function: Callable[[Tensor], Tensor], tree: T) -> T:
    """Apply `function` to every tensor in nested dataclasses, tuples, lists and dicts; leave everything else as it is."""
    value: Any = tree
    if isinstance(value, Tensor):
        value = function(value)
    elif (names := _parts(value.__class__)) is not None:
        value = value.__class__(**{name: tensor_map(function, getattr(value, name)) for name in names})
    elif isinstance(value, tuple):
        items = [tensor_map(function, item) for item in value]
        value = type(value)(*items) if hasattr(value, "_fields") else tuple(items)
    elif isinstance(value, list):
        value = [tensor_map(function, item) for item in value]
    elif isinstance(value, dict):
        value = {key: tensor_map(function, item) for key, item in value.items()}
    return value  # type: ignore[no-any-return]


@cache
def _parts(kind: type) -> tuple[str, ...] | None:
    """The names of what a dataclass is made of; None for others."""
    return tuple(f.name for f in fields(kind) if f.init) if is_dataclass(kind) else None


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
    number wherever it stands, `name>=k` sets a minimum. A spec may end in `: bool` or `: int`; otherwise the tensor must be of
    single or double precision, and all such tensors must share one dtype: half precision holds neither pixels nor products of
    them. A spec that begins with `?` is that of an option, which may be None.

    Args:
        **arguments: The tensors under the names the caller knows them by.

    Returns:
        The shape to which the leading dimensions of all arguments broadcast.

    Raises:
        ValueError: An argument has the wrong type, number of dimensions, size, dtype or device, or batches do not broadcast.
    """
    batches = _batches(arguments)
    try:
        return broadcast_shapes(*batches.values())
    except ValueError:
        listing = ", ".join(f"{name} {tuple(shape)}" for name, shape in batches.items())
        raise ValueError(f"batch dimensions do not broadcast: {listing}") from None


def check_one_problem(**arguments: tuple[Tensor | None, str]) -> None:
    """Check arguments as `check_tensors` does, which may not have batch dimensions.

    Raises:
        ValueError: An argument has the wrong type, number of dimensions, size, dtype or device.
    """
    for name, shape in _batches(arguments).items():
        if shape:
            wanted = _words(arguments[name][1].removeprefix("?").partition(":")[0]).replace("*batch, ", "")
            raise ValueError(f"{name}: wanted shape {wanted} of one problem, got batch dimensions {tuple(shape)}")


def _batches(arguments: dict[str, tuple[Tensor | None, str]]) -> dict[str, torch.Size]:
    """The batch dimensions of checked arguments."""
    sizes: dict[str, tuple[int, str]] = {}
    batches: dict[str, torch.Size] = {}
    first: tuple[str, Tensor] | None = None
    floating: tuple[str, Tensor] | None = None
    for name, (tensor, words) in arguments.items():
        spec = _spec(words)
        if tensor is None and spec.optional:
            continue
        if not isinstance(tensor, Tensor):
            raise ValueError(f"{name}: wanted a torch.Tensor of shape {_words(spec.shape)}, got {type(tensor).__name__}")
        _check_kind(name, tensor, spec.kind)
        if spec.kind == "":
            if floating is not None and tensor.dtype != floating[1].dtype:
                raise ValueError(f"{name}: wanted dtype {floating[1].dtype} as {floating[0]} has, got {tensor.dtype}")
            floating = floating or (name, tensor)
        if first is not None and tensor.device != first[1].device:
            raise ValueError(f"{name}: wanted device {first[1].device} as {first[0]} has, got {tensor.device}")
        first = first or (name, tensor)
        shape, tokens = tensor.shape, spec.dimensions
        if len(shape) < len(tokens):
            raise ValueError(f"{name}: wanted shape {_words(spec.shape)}, got {tuple(shape)}")
        ahead = len(shape) - len(tokens)
        for (label, least, exact), size in zip(tokens, shape[ahead:], strict=True):
            if exact is not None:
                if size != exact:
                    raise ValueError(f"{name}: wanted shape {_words(spec.shape)}, got {tuple(shape)}")
                continue
            if size < least:
                raise ValueError(f"{name}: wanted {label} >= {least} in {_words(spec.shape)}, got {tuple(shape)}")
            known, owner = sizes.setdefault(label, (size, name))
            if known != size:
                raise ValueError(f"{name}: wanted {label} = {known} as {owner} has, got shape {tuple(shape)}")
        batches[name] = shape[:ahead]
    return batches


class _Spec(NamedTuple):
    """What a tensor may be."""

    optional: bool
    shape: str
    kind: str
    dimensions: tuple[tuple[str, int, int | None], ...]
    """Of each its name, its least number, and the number where that is exact."""


@cache
def _spec(words: str) -> _Spec:
    """What is meant by `?v>=2 n 3 : bool`, say."""
    shape, _, kind = (part.strip() for part in words.removeprefix("?").partition(":"))
    dimensions = []
    for token in shape.split():
        label, _, least = token.partition(">=")
        dimensions.append((label, int(least or 0), int(token) if token.isdigit() else None))
    return _Spec(words.startswith("?"), shape, kind, tuple(dimensions))


def check_index(**indices: tuple[Tensor, int]) -> None:
    """See that index tensors, each given with its limit, point at something.

    Raises:
        ValueError: A number is negative or not below its limit.
    """
    for name, (index, limit) in indices.items():
        if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < limit:
            raise ValueError(f"{name}: wanted numbers from 0 to {limit - 1}, got {int(index.min())} to {int(index.max())}")


def check_options(**arguments: tuple[object, Any]) -> None:
    """Check options, which are no tensors: numbers, choices and objects.

    Each argument comes as `(value, wanted)`: a tuple of the values there are, a type, or the range of a finite number as in
    `int >= 1`, `float > 0`, `0 <= float <= 1`. `2 float > 0` stands for a tuple of two; a range that begins with `?` is that
    of an option which may be None, and one may end with its unit, as in `0 < float < 3.14 radians`.

    Args:
        **arguments: The options under the names the caller knows them by.

    Raises:
        ValueError: An option is not what is wanted.
    """
    for name, (value, wanted) in arguments.items():
        if isinstance(wanted, str):
            good, words = _range(wanted).holds(value), wanted.replace("?", "None or ")
        elif isinstance(wanted, tuple):
            good, words = any(type(value) is type(w) and value == w for w in wanted), f"one of {', '.join(map(repr, wanted))}"
        else:
            good, words = isinstance(value, wanted), getattr(wanted, "__name__", str(wanted))
        if not good:
            raise ValueError(f"{name}: wanted {words}, got {value!r}")


class _Range(NamedTuple):
    """What numbers an option may be."""

    kind: type
    length: int
    optional: bool
    bounds: tuple[tuple[Callable[[Any, float], bool], float], ...]

    def holds(self, value: object) -> bool:
        """Whether a value is one of them, or a tuple of as many as are wanted."""
        if value is None:
            return self.optional
        if not self.length:
            return self._holds(value)
        return isinstance(value, Sequence) and len(value) == self.length and all(self._holds(v) for v in value)

    def _holds(self, value: Any) -> bool:
        if not isinstance(value, self.kind) or isinstance(value, bool) or not math.isfinite(cast(float, value)):
            return False
        return all(compare(value, bound) for compare, bound in self.bounds)


@cache
def _range(words: str) -> _Range:
    """The range of `0 < float <= 1`, say; a `?` in front allows None."""
    tokens = words.removeprefix("?").split()
    if tokens[-1].isalpha() and tokens[-1] not in _NUMBERS:
        tokens.pop()  # the unit, for the reader
    length = int(tokens.pop(0)) if tokens[1:] and tokens[1] in _NUMBERS else 0
    i = next(i for i, token in enumerate(tokens) if token in _NUMBERS)
    below = [(_COMPARE[tokens[k + 1].replace("<", ">")], float(tokens[k])) for k in range(0, i, 2)]
    above = [(_COMPARE[tokens[k]], float(tokens[k + 1])) for k in range(i + 1, len(tokens), 2)]
    return _Range(_NUMBERS[tokens[i]], length, words.startswith("?"), (*below, *above))


_NUMBERS: dict[str, type] = {"int": Integral, "float": Real}
_COMPARE: dict[str, Callable[[Any, Any], bool]] = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge,
}  # fmt: skip


def _words(shape_spec: str) -> str:
    return f"({', '.join(['*batch', *shape_spec.split()])})"


def _check_kind(name: str, tensor: Tensor, kind: str) -> None:
    if kind == "bool":
        good = tensor.dtype == torch.bool
    elif kind == "int":
        good = not (tensor.dtype.is_floating_point or tensor.dtype.is_complex or tensor.dtype == torch.bool)
    else:
        good, kind = tensor.dtype in (torch.float32, torch.float64), "float32 or float64"
    if not good:
        raise ValueError(f"{name}: wanted a {kind} tensor, got {tensor.dtype}")
