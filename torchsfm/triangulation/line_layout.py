"""Data of lines in views as they come, laid out with the lines last."""

import torch
from torch import Tensor

Laid = tuple[Tensor, Tensor, Tensor | None, Tensor | None]


def lay_out(
    batch: torch.Size,
    l: Tensor,  # noqa: E741
    last: int,
    P: Tensor,
    visible: Tensor | None,
    weights: Tensor | None,
) -> Laid:
    """What `observe` takes, of two views at least: where there are fewer, others that see nothing are added.

    Args:
        batch: The batch dimensions of all together; the lines are theirs times n.
        l: Segments or image lines (*#batch, v, n, ...).
        last: The number of dimensions after n.
        P: Cameras (*#batch, v, 3, 4).
        visible: (*#batch, v, n)
        weights: (*#batch, v, n)
    """
    v, n = l.shape[-last - 2 : -last]
    rows, cameras = lines_last(l, batch, last), _cameras_last(P, batch, n)
    seen, w = (None if t is None else lines_last(t, batch) for t in (visible, weights))
    if v >= 2:
        return rows, cameras, seen, w
    if seen is None:
        seen = torch.ones(rows.shape[-2:], dtype=torch.bool, device=rows.device)
    return _padded(rows), _padded(cameras), _padded(seen), None if w is None else _padded(w)


def lines_last(t: Tensor, batch: torch.Size, rest: int = 0) -> Tensor:
    """(..., v, lines), of (*#batch, v, n, ...) with so many dimensions at the end, which come the last one first."""
    t = t.expand(*batch, *t.shape[t.ndim - 2 - rest :])
    front = len(batch)
    t = t.permute(*range(t.ndim - 1, front + 1, -1), front, *range(front), front + 1)
    return t.flatten(rest + 1)


def _cameras_last(P: Tensor, batch: torch.Size, n: int) -> Tensor:
    """(3, 4, v, lines), or (3, 4, v, 1) where all lines have the same cameras."""
    v = P.shape[-3]
    if P.shape[:-3].numel() == 1:
        return P.reshape(v, 3, 4).permute(1, 2, 0)[..., None]
    P = P.expand(*batch, v, 3, 4)[..., None].expand(*batch, v, 3, 4, n)
    return P.permute(-3, -2, -4, *range(len(batch)), -1).flatten(3)


def _padded(t: Tensor) -> Tensor:
    """Rows (..., v, lines) with zeros up to two views."""
    return torch.cat((t, t.new_zeros(*t.shape[:-2], 2 - t.shape[-2], t.shape[-1])), -2)
