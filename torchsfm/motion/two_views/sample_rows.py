"""Samples as rows: every coordinate of every point one tensor over the batch, in float64, as the solvers want them."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.linalg.rows import combine_rows


def rows_of(batch: Sequence[int], *tensors: Tensor) -> list[Tensor]:
    """Tensors (*batch, ...) without derivative as (..., all of the batch)."""
    flat = []
    for t in tensors:
        own = t.shape[t.ndim - 2 :]
        rows = t.detach().double().expand(*batch, *own).reshape(-1, *own)
        flat.append(rows.permute(1, 2, 0))
    return flat


def in_chunks(solve: Callable[..., tuple[Tensor, ...]], size: int, *rows: Tensor) -> list[Tensor]:
    """Call a solver on pieces of the last dimension that fit the cache; results have the batch last too."""
    starts = range(0, max(rows[0].shape[-1], 1), size)
    chunks = [solve(*(r[..., i : i + size] for r in rows)) for i in starts]
    return [torch.cat(parts, -1) for parts in zip(*chunks, strict=True)]


def unit_rays(d: Float[Tensor, "n 3 batch"]) -> tuple[Float[Tensor, "n 3 batch"], Bool[Tensor, " batch"]]:
    """Rays of length 1, and which samples have rays that are finite and not 0; the others get arbitrary finite ones."""
    largest = d.abs().amax(1)
    fine = torch.isfinite(largest) & (largest > 0)
    d = torch.where(fine[:, None], d / torch.where(fine, largest, 1)[:, None], 1)
    return d * combine_rows(d.unbind(1), d.unbind(1)).rsqrt()[:, None], fine.all(0)


def cross_columns(a: Float[Tensor, "*n 3 batch"], b: Float[Tensor, "*n 3 batch"]) -> Float[Tensor, "*n 3 batch"]:
    """The cross product with the batch last."""
    a0, a1, a2 = a.unbind(-2)
    b0, b1, b2 = b.unbind(-2)
    return torch.stack((a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0), -2)


def longest_vector(v: Float[Tensor, "k 3 batch"]) -> tuple[Float[Tensor, "3 batch"], Float[Tensor, " batch"]]:
    """The longest of k vectors, of length 1 (anything finite where all are 0), and its length."""
    square, best = combine_rows(v.unbind(1), v.unbind(1)).max(0)
    longest = v.gather(0, best.expand(1, 3, -1))[0]
    good = square > 1e-280
    return longest * torch.where(good, square, 1).rsqrt(), torch.where(good, square, 0).sqrt()


def towards_the_front(
    t: Float[Tensor, "3 batch"], turned: Float[Tensor, "n 3 batch"], d2: Float[Tensor, "n 3 batch"]
) -> Float[Tensor, "3 batch"]:
    """T or -t, with which more depths along the rays R d1 and d2 are positive."""
    normal = cross_columns(turned, d2)
    votes = torch.zeros_like(t[0])
    for d in (d2, turned):
        depth = -combine_rows(cross_columns(t.expand_as(d), d).unbind(1), normal.unbind(1))
        for row in depth:
            votes = votes + torch.sign(row)
    return torch.where(votes < 0, -t, t)
