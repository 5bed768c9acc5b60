"""Five rays in two calibrated cameras: E with d2' E d1 = 0 and 2 E E' E = tr(E E') E (Nister 2004).

The roots of a polynomial of degree ten (`_five_points.py`) are starts, each of which is polished on the manifold of essential
matrices (`_essential_manifold.py`). Where a start turns out to be a poor one the polynomial has lost its digits, to coordinates
that suit those points badly: such problems, few among random ones, are solved again in other coordinates, and solutions from
both are kept. All arithmetic has the batch in the last dimension.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg.portions import portions
from torchsfm.linalg.real_roots import number_among_equals
from torchsfm.linalg.rows import take_columns
from torchsfm.motion.two_views.essential_manifold import combine, from_roots, polish
from torchsfm.motion.two_views.five_points import five_point_roots
from torchsfm.optim import attach_implicit, for_slots, wants_derivative

_CHUNK = 4096
"""Problems at a time: their matrices fit the cache."""
_NEAR = 1e-8
"""Distance from the manifold before a Newton step that ends at a solution."""
_MORE = 6
"""Newton steps for the others, among near-planar points and small baselines, where two solutions are almost one."""
_POOR = 1e-5
"""Distance of a start from the manifold that casts doubt on the polynomial."""
_SAME = 1e-5, 2e-7
"""Distance below which two unit matrices are one solution, from two polynomials and from the same one."""


def equations(
    E: Float[Tensor, "*#batch 3 3"], d1: Float[Tensor, "*#batch 5 3"], d2: Float[Tensor, "*#batch 5 3"]
) -> Float[Tensor, "*batch 15"]:
    """Fifteen equations of rank 9: d2' E d1 = 0 for each ray, 2 E E' E - tr(E E') E = 0, and |E|^2 = 2."""
    epipolar = (d2 * (d1 @ E.mT)).sum(-1)
    S = E @ E.mT
    trace = S.diagonal(dim1=-2, dim2=-1).sum(-1)
    cubic = (2 * S @ E - trace[..., None, None] * E).flatten(-2)
    gauge = trace[..., None] - 2
    shape = epipolar.shape[:-1]
    return torch.cat((epipolar, cubic.expand(*shape, 9), gauge.expand(*shape, 1)), -1)


def essential_5pt(
    d1: Float[Tensor, "*#batch 5 3"], d2: Float[Tensor, "*#batch 5 3"]
) -> Solutions[Float[Tensor, "*batch 10 3 3"]]:
    """The essential matrices with d2' E d1 = 0 for five rays, at most ten, with |E|^2 = 2 (Frobenius).

    Args:
        d1: Five rays of the first camera, of any length but 0.
        d2: The corresponding rays of the second camera.

    Returns:
        Ten slots. None is valid where the linear equations are dependent (coinciding rays) or a ray is zero or not finite.
        Without baseline E is not determined: whatever is valid there has the right epipolar lines and no meaning. Computed in
        float64 whatever the dtype. Differentiable in both arguments.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(5, generator=g), torchsfm.random_poses(generator=g)
        >>> E = torchsfm.motion.essential_5pt(X, pose.transform(X))  # the first camera is the world's origin
        >>> truth = torchsfm.tensors.essential_from_pose(pose.R, pose.t / pose.t.norm())
        >>> fit = (E.model * truth).sum((-2, -1)).abs() / 2  # 1: the same up to sign
        >>> E.model.shape, bool((fit[E.valid] > 1 - 1e-6).any())
        (torch.Size([10, 3, 3]), True)
    """
    batch = check_tensors(d1=(d1, "5 3"), d2=(d2, "5 3"))
    with torch.no_grad():
        # (coordinate, ray, problem)
        rows1, rows2 = (d.detach().double().expand(*batch, 5, 3).reshape(-1, 5, 3).permute(2, 1, 0) for d in (d1, d2))
        E, valid = _solve(rows1, rows2)
        E, valid = E.to(d1.dtype).reshape(*batch, 10, 3, 3), valid.reshape(*batch, 10)
    if wants_derivative(d1, d2):
        E = attach_implicit(equations, E, for_slots(d1, batch), for_slots(d2, batch), dims=2, valid=valid)
    return Solutions(E, valid)


class _Candidates(NamedTuple):
    """Solutions one after the other, in the last dimension."""

    item: Tensor
    E: Tensor
    """(9, candidates), with |E| = 1."""
    error: Tensor
    """Distance from the essential manifold before the last Newton step."""
    rest: Tensor
    """Numbers of those that are not near yet, with what more steps need:"""
    u: Tensor
    basis: Tensor


def _solve(d1: Float[Tensor, "3 5 batch"], d2: Float[Tensor, "3 5 batch"]) -> tuple[Tensor, Tensor]:
    """E as (batch, 10, 9) and valid as (batch, 10)."""
    batch = d1.shape[-1]
    found = _starts(d1, d2)
    doubt = torch.zeros(batch, dtype=torch.bool, device=d1.device)
    doubt[found.item.index_select(0, (found.error >= _POOR).nonzero()[:, 0])] = True
    again = doubt.nonzero()[:, 0]
    if len(again):
        second = _starts(d1.index_select(2, again), d2.index_select(2, again), other_coordinates=True)
        # They stand as problems of their own behind the others.
        found = _joined([found, second._replace(item=second.item + batch)])
    if len(found.rest):
        # The few that are not near yet, all together.
        u, last = found.u, found.error.index_select(0, found.rest)
        for _ in range(_MORE):
            u, last = polish(u, found.basis)
        found.E.index_copy_(1, found.rest, combine(u, found.basis))
        found.error.index_copy_(0, found.rest, last)
    # A unit matrix is finite in all entries or in none.
    keep = ((found.error < _NEAR) & torch.isfinite(found.E[0])).nonzero()[:, 0]
    item, order = found.item.index_select(0, keep).sort(stable=True)
    size = batch + len(again)
    # An empty slot holds diag(1, 1, 0).
    out = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 0], dtype=d1.dtype, device=d1.device).repeat(size * 10, 1)
    valid = torch.zeros(size * 10, dtype=torch.bool, device=d1.device)
    # Never more than the degree.
    place = item * 10 + number_among_equals(item).clamp_max_(9)
    out.index_copy_(0, place, take_columns(found.E, keep.index_select(0, order)).mT * 2**0.5)
    valid.index_fill_(0, place, True)
    out, valid = out.view(size, 10, 9), valid.view(size, 10)
    if len(again):
        both = torch.cat((out[again], out[batch:]), 1), torch.cat((valid[again], valid[batch:]), 1)
        out[again], valid[again] = _once(*both)
    return out[:batch], valid[:batch]


def _once(E: Float[Tensor, "problem 20 9"], real: Bool[Tensor, "problem 20"]) -> tuple[Tensor, Tensor]:
    """The solutions from two polynomials, each once, in ten slots."""
    source = torch.arange(20, device=E.device) // 10
    same = 2**0.5 * torch.where(source[:, None] == source, _SAME[1], _SAME[0])
    a, b = E[:, :, None], E[:, None]
    gap = torch.minimum((a - b).norm(dim=-1), (a + b).norm(dim=-1))
    # What an earlier slot holds already is left out; the rest keeps its order.
    keep = real & ~((gap < same).tril(-1) & real[:, None]).any(-1)
    order = (~keep).to(torch.uint8).argsort(dim=-1, stable=True)[:, :10]
    keep = keep.gather(1, order)
    empty = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 0], dtype=E.dtype, device=E.device)
    return torch.where(keep[..., None], E.gather(1, order[..., None].expand(-1, -1, 9)), empty), keep


def _starts(d1: Tensor, d2: Tensor, other_coordinates: bool = False) -> _Candidates:
    some = portions(max(d1.shape[-1], 1), _CHUNK, d1.device)
    chunks = [_chunk(d1[..., part], d2[..., part], other_coordinates) for part in some]
    return _joined([chunk._replace(item=chunk.item + part.start) for chunk, part in zip(chunks, some, strict=True)])


def _joined(parts: list[_Candidates]) -> _Candidates:
    if len(parts) == 1:
        return parts[0]
    before = 0
    for i, part in enumerate(parts):
        parts[i] = part._replace(rest=part.rest + before)
        before += len(part.item)
    return _Candidates(*(torch.cat(rows, -1) for rows in zip(*parts, strict=True)))


def _chunk(d1: Tensor, d2: Tensor, other_coordinates: bool) -> _Candidates:
    """Every root, after a step."""
    roots = five_point_roots(d1, d2, other_coordinates=other_coordinates)
    basis = take_columns(roots.basis, roots.item)
    u, E, error = from_roots(take_columns(roots.rows, roots.item), roots.s, roots.t, basis)
    rest = (~(error < _NEAR)).nonzero()[:, 0]
    return _Candidates(roots.item, E, error, rest, take_columns(u, rest), take_columns(basis, rest))
