"""What every result promises, whatever was asked for."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import torch
from torch import Tensor

from torchsfm import Solutions, Status

MAY_BE_INFINITE = {
    "deviation", "data_deviation", "intrinsics_deviation", "residuals", "error", "covariance", "cost", "initial_cost",
    "threshold", "proximity",
}  # fmt: skip
"""Fields in which infinity means: not determined, not used, not found."""


def tensors(value: Any, name: str = "") -> Iterator[tuple[str, Tensor]]:
    """Every tensor in nested dataclasses, tuples, lists and dicts, with its place."""
    if isinstance(value, Tensor):
        yield name, value
    elif is_dataclass(value) and not isinstance(value, type):
        for f in fields(value):
            yield from tensors(getattr(value, f.name), f"{name}.{f.name}")
    elif isinstance(value, tuple | list):
        names = getattr(value, "_fields", range(len(value)))
        for part, item in zip(names, value, strict=True):
            yield from tensors(item, f"{name}.{part}")
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from tensors(item, f"{name}.{key}")


def verdict(result: Any) -> Tensor | None:
    """Which elements the result calls good: by `status`, by `valid`, or by a mask after one value; None if it does not say."""
    status, valid = getattr(result, "status", None), getattr(result, "valid", None)
    if isinstance(status, Tensor):
        return status == int(Status.OK)
    if isinstance(valid, Tensor):
        return valid
    if isinstance(result, tuple) and not hasattr(result, "_fields") and len(result) >= 2:
        last = result[-1]
        if isinstance(last, Tensor) and last.dtype == torch.bool:
            return last
    return None


def not_finite(result: Any) -> Iterator[str]:
    """Numbers that are none where the result calls itself good; in `Solutions` anywhere."""
    good = verdict(result)
    if good is None:
        return
    for name, value in tensors(result):
        if not (value.is_floating_point() or value.is_complex()) or value.shape[: good.ndim] != good.shape:
            continue
        kept = value if isinstance(result, Solutions) else value[good]
        infinite = name.rpartition(".")[2] in MAY_BE_INFINITE
        if bool((kept.isnan() if infinite else ~kept.isfinite()).any()):
            yield f"not finite: {name} of {type(result).__name__} where it is called good"


def zero_models(result: Any) -> Iterator[str]:
    """Models of zeros alone that are called good."""
    good = verdict(result)
    model = None if good is None else getattr(result, "model", None)
    if good is None or not isinstance(model, Tensor) or model.ndim <= good.ndim or model.shape[: good.ndim] != good.shape:
        return
    if bool((model[good].flatten(1) == 0).all(-1).any()):
        yield f"zero model: of {type(result).__name__} is called good"


def changed(result: Any, reference: Any, kept: Tensor, *, homogeneous: bool = False) -> Iterator[str]:
    """Elements of the batch, those of a mask, that are not what they are in a reference.

    `Solutions` are to be the same bit for bit, other results to rounding, which iterations stretch to their tolerance. Of what
    a result does not call good only the status, and whether numbers are finite, is promised: rounding moves an estimate freely
    along what its data leave open. The sign of a `homogeneous` model, too, is its own to choose.
    """
    good = None if isinstance(result, Solutions) else verdict(reference)
    for (name, value), (_, wanted) in zip(tensors(result), tensors(reference), strict=True):
        if value.shape != wanted.shape:
            yield f"neighbour changed: shape of {name or 'the value'}"
        elif value.shape[: kept.ndim] == kept.shape:
            a, b = value[kept], wanted[kept]
            if homogeneous and name == ".model":
                a = torch.where((a * b).flatten(1).sum(-1).reshape(-1, *[1] * (a.ndim - 1)) < 0, -a, a)
            same = (a == b) | ((a != a) & (b != b))
            if value.is_floating_point() and not isinstance(result, Solutions):
                size = b.abs().nan_to_num(0, 0, 0).amax() if b.numel() else 0
                eps = torch.finfo(a.dtype).eps
                # What rounding leaves of zero has no digits in common.
                same |= (a - b).abs() <= 64 * eps**0.5 * size + eps**1.5
                if good is not None and good.shape == kept.shape:
                    open_ = ~good[kept].reshape(-1, *[1] * (a.ndim - 1))
                    same |= open_ & (a.isfinite() == b.isfinite())
            if not bool(same.all()):
                most = (a.double() - b.double()).abs().nan_to_num(torch.inf).max() if value.is_floating_point() else torch.inf
                yield f"neighbour changed: {name or 'the value'} by {float(most):.1e}"
