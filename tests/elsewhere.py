"""A device that is not there: tensors that say they lie elsewhere, and refuse to meet those of the CPU, as on an accelerator.

They compute on the CPU. What they find is a constant made without `device=`, a mask or an index left behind, numbers taken to
the CPU and back. Single numbers may be read (`.item()`, `bool()`), and CPU tensors of no dimension take part, as they do on
real devices. As on CUDA, a division by a single number is a product with its reciprocal, which is rounded twice.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from torchsfm.linalg.constants import Constant

ELSEWHERE = torch.device("meta")
"""The name of the device; nothing else uses it here."""
INDEXING = (torch.ops.aten.index.Tensor, torch.ops.aten.index_put_.default, torch.ops.aten.index_put.default)
DIVISIONS = (torch.ops.aten.div.Tensor, torch.ops.aten.div_.Tensor, torch.ops.aten.div.Scalar, torch.ops.aten.div_.Scalar)
CONSTANT = 2000
"""Numbers of a table, written in the program, that may be taken along: between brackets, or by `.to(device)`."""


class ElsewhereTensor(Tensor):
    """A tensor of that device; `numbers` is the one that holds the values."""

    numbers: Tensor

    @staticmethod
    def __new__(cls, numbers: Tensor) -> "ElsewhereTensor":
        made: ElsewhereTensor = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls, numbers.shape, strides=numbers.stride(), storage_offset=numbers.storage_offset(),
            dtype=numbers.dtype, device=ELSEWHERE,
        )  # fmt: skip
        made.numbers = numbers
        return made

    def __repr__(self) -> str:  # type: ignore[override]
        return f"elsewhere({self.numbers})"

    def tolist(self) -> Any:
        """For what follows in the program."""
        if self.numel() > CONSTANT:
            raise TransferError(f"{self.numel()} numbers are made a list")
        return self.numbers.tolist()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return compute(func, args, kwargs or {})


class TransferError(RuntimeError):
    """Tensors of two devices in one operation, or a copy from one to the other."""


def compute(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    leaves = list(_leaves((args, list(kwargs.values()))))
    own = [v for v in leaves if isinstance(v, ElsewhereTensor)]
    wanted = kwargs.get("device")
    here = wanted is None and not own
    if here:
        return func(*args, **kwargs)
    if own:
        strangers = [v for v in leaves if isinstance(v, Tensor) and not isinstance(v, ElsewhereTensor) and v.ndim > 0]
        if strangers and not (func in INDEXING and all(v.dtype == torch.long and v.numel() <= CONSTANT for v in strangers)):
            raise TransferError(f"{func}: tensors here of shapes {[tuple(v.shape) for v in strangers]} meet one elsewhere")
        if wanted is not None and torch.device(wanted) != ELSEWHERE:
            raise TransferError(f"{func}: numbers of shape {tuple(own[0].shape)} are taken to {wanted}")
    elif torch.device(wanted) != ELSEWHERE:
        return func(*args, **kwargs)
    elif any(isinstance(v, Tensor) and v.numel() > CONSTANT for v in leaves):
        raise TransferError(f"{func}: a tensor is brought here from the CPU")
    args, kwargs = _changed(_numbers, args), {name: _changed(_numbers, v) for name, v in kwargs.items()}
    if wanted is not None:
        if kwargs.get("generator") is not None:
            raise TransferError(f"{func}: a generator of the CPU draws numbers there")
        kwargs["device"] = torch.device("cpu")
    if func in DIVISIONS and len(own) == 1 and own[0] is leaves[0] and args[0].is_floating_point():
        func = torch.ops.aten.mul_.Tensor if func._schema.is_mutable else torch.ops.aten.mul.Tensor
        args = args[0], 1 / torch.as_tensor(args[1], dtype=args[0].dtype)
    found = func(*args, **kwargs)
    if func is torch.ops.aten._local_scalar_dense.default:
        return found
    known = {id(v.numbers): v for v in own}  # of operations in place

    def brought(v: Any) -> Any:
        if id(v) in known or not isinstance(v, Tensor):
            return known.get(id(v), v)
        # Derivatives that are zero have no memory, which operations below autograd do not expect.
        return ElsewhereTensor(torch.zeros(v.shape, dtype=v.dtype) if v._is_zerotensor() else v)

    return _changed(brought, found)


def _leaves(tree: Any) -> Iterator[Any]:
    """Of lists and tuples, which are all that operations take and give."""
    if isinstance(tree, list | tuple):
        for part in tree:
            yield from _leaves(part)
    else:
        yield tree


def _changed(change: Callable[[Any], Any], tree: Any) -> Any:
    """The tree with every leaf changed."""
    return type(tree)([_changed(change, v) for v in tree]) if isinstance(tree, list | tuple) else change(tree)


def _numbers(v: Any) -> Any:
    return v.numbers if isinstance(v, ElsewhereTensor) else v


class _Factories(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return compute(func, args, kwargs or {})


class _Lists(TorchFunctionMode):
    """PyTorch keeps to itself how it makes tensors of lists, and on this device none of their values would arrive."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func in (torch.tensor, torch.as_tensor) and kwargs.get("device") == ELSEWHERE:
            return ElsewhereTensor(func(*args, **kwargs | {"device": torch.device("cpu")}))
        if func is Tensor.new_tensor and args[0].device == ELSEWHERE:
            return ElsewhereTensor(torch.tensor(*args[1:], **{"dtype": args[0].dtype} | kwargs))
        if func in (Tensor.__getitem__, Tensor.__setitem__) and args[0].device == ELSEWHERE:
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            index = tuple(ElsewhereTensor(torch.tensor(i, dtype=torch.long)) if isinstance(i, list) else i for i in index)
            return func(args[0], index, *args[2:])
        return func(*args, **kwargs)


_on = Constant.on


def _table(constant: Constant, device: torch.device, dtype: torch.dtype | None = None) -> Tensor:
    """Tables of the program come to a device once, however large."""
    return ElsewhereTensor(_on(constant, torch.device("cpu"), dtype)) if device == ELSEWHERE else _on(constant, device, dtype)


@contextmanager
def elsewhere() -> Iterator[None]:
    """Here `device=ELSEWHERE` makes such tensors."""
    with _Factories(), _Lists(), patch.object(Constant, "on", _table):
        yield


def send(tensor: Tensor) -> Tensor:
    """A copy elsewhere, a leaf."""
    return ElsewhereTensor(tensor.detach().clone()).requires_grad_(tensor.requires_grad)


def fetch(tensor: Tensor) -> Tensor:
    """The values, here."""
    return tensor.detach().numbers if isinstance(tensor, ElsewhereTensor) else tensor  # type: ignore[attr-defined]
