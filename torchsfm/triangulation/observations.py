"""How the solvers of this room see their data: rows over (view, problem, point), in float64, in a well-scaled world.

Points are independent of each other, so the work is done in pieces that fit the cache. Within a piece every number of a
formula is one contiguous tensor (view, problem, point) or (problem, point); cameras are (view, problem, 1) and
broadcast over the points.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.linalg import usable

PIECE = 32768
"""Observations in one piece: some ten temporaries of it fit a second-level cache."""


@dataclass(frozen=True)
class Observations:
    """One piece of a triangulation problem.

    The world is moved and scaled so that the centres of the cameras in use have mean 0 and root-mean-square distance 1:
    the cameras in `P` are those of this world. Absent observations have weight 0 and harmless numbers.
    """

    x: tuple[Tensor, Tensor]
    """Image coordinates, (view, problem, point) each."""
    P: tuple[tuple[Tensor, ...], ...]
    """Camera entries, (view, problem, 1) each, three rows of four."""
    w: Tensor
    """Weights of squared distances, (view, problem, point)."""
    centre: tuple[Tensor, ...]
    """Homogeneous camera centres in the moved world, last entry 1 or 0, (view, problem, 1) each."""
    handed: Tensor
    """Sign of the determinant of each camera's left 3x3 part, 0 where singular, (view, problem, 1)."""
    shift: Tensor
    """Where the origin of the moved world lies, (3, problem, 1)."""
    scale: Tensor
    """The unit of length of the moved world, (problem, 1)."""
    apart: Tensor
    """Whether the cameras in use have more than one centre, (problem, 1)."""
    broken: Tensor
    """Points of which a wanted observation is not finite, (problem, point)."""

    def world(self, X: Tensor) -> Tensor:
        """Homogeneous points (4, problem, point) of the moved world, in the caller's world."""
        return torch.cat((X[:3] * self.scale + self.shift * X[3], X[3:]))

    def depths(self, X: Tensor) -> Tensor:
        """The third homogeneous image coordinate, (view, problem, point)."""
        return row_dot(self.P[2], X)

    def facing(self, X: Tensor) -> Tensor:
        """The sign that puts homogeneous points in front of most of the cameras that see them, (problem, point)."""
        votes = (torch.sign(self.depths(X)) * self.handed * (self.w > 0)).sum(0)
        votes = torch.where(votes == 0, X[3], votes)
        return torch.where(votes < 0, -1.0, 1.0).to(X.dtype)


def row_dot(row: tuple[Tensor, ...], X: Tensor | tuple[Tensor, ...]) -> Tensor:
    """A row of every camera times homogeneous points (4, problem, point)."""
    product = row[0] * X[0]
    for i in range(1, 4):
        product = torch.addcmul(product, row[i], X[i])
    return product


def check(x: Tensor, P: Tensor, visible: Tensor | None, weights: Tensor | None) -> tuple[torch.Size, int]:
    """The batch shape and the number of points."""
    batch = check_tensors(x=(x, "v n 2"), P=(P, "v 3 4"), visible=(visible, "?v n: bool"), weights=(weights, "?v n"))
    return batch, x.shape[-2]


def in_pieces(
    solve: Callable[[Observations], tuple[Tensor, ...]],
    x: Tensor,
    P: Tensor,
    visible: Tensor | None,
    weights: Tensor | None,
) -> tuple[Tensor, ...]:
    """Call `solve` on pieces and join what it returns: tensors (..., problem, point) become (..., *batch, point)."""
    batch, n = check(x, P, visible, weights)
    v, size = x.shape[-3], batch.numel()
    flat_x = x.expand(*batch, v, n, 2).reshape(size, v, n, 2)
    flat_P = P.expand(*batch, v, 3, 4).reshape(size, v, 3, 4)
    flat_w = None if weights is None else weights.expand(*batch, v, n).reshape(size, v, n)
    flat_seen = None if visible is None else visible.expand(*batch, v, n).reshape(size, v, n)
    if v > 2 and size * n > 0 and not (flat_w is None and flat_seen is None):
        joined = _solve_ragged(solve, flat_x, flat_P, flat_seen, flat_w)
    else:
        joined = _solve_dense(solve, flat_x, flat_P, flat_seen, flat_w)
    return tuple(part.reshape(*part.shape[:-2], *batch, n) for part in joined)


def _solve_dense(
    solve: Callable[[Observations], tuple[Tensor, ...]], x: Tensor, P: Tensor, visible: Tensor | None, weights: Tensor | None
) -> list[Tensor]:
    """Results (..., problem, point) for x (problem, view, point, 2), P (problem, view, 3, 4)."""
    size, v, n = x.shape[:3]
    strips = []
    for problems in _ranges(size, max(1, PIECE // max(1, v * n))):
        pieces = []
        for points in _ranges(n, max(1, PIECE // max(1, v))):
            seen = None if visible is None else visible[problems, :, points]
            w = None if weights is None else weights[problems, :, points]
            pieces.append(solve(_observe(x[problems, :, points], P[problems], seen, w)))
        strips.append([torch.cat(parts, -1) if len(parts) > 1 else parts[0] for parts in zip(*pieces, strict=True)])
    return [torch.cat(parts, -2) if len(parts) > 1 else parts[0] for parts in zip(*strips, strict=True)]


def _solve_ragged(
    solve: Callable[[Observations], tuple[Tensor, ...]], x: Tensor, P: Tensor, visible: Tensor | None, weights: Tensor | None
) -> list[Tensor]:
    """The same, for points seen in some of the views only: each becomes a problem of as many views as see it.

    Points are sorted by their number of views, rounded up to a power of two: a point's own number, so that what becomes of it
    does not depend on the others.
    """
    size, v, n = x.shape[:3]
    wanted = torch.ones_like(x[..., 0], dtype=torch.bool) if visible is None else visible
    if weights is not None:
        wanted = wanted & (weights != 0)
    wanted = wanted.permute(0, 2, 1).reshape(size * n, v)
    slot = wanted.cumsum(-1)
    count = slot[:, -1].clamp_min(2)
    # The exponent of the power of two, exactly.
    level = torch.frexp((count - 1).double()).exponent
    results, places = [], []
    for k in range(1, (v - 1).bit_length() + 1):
        place = (level == k).nonzero()[:, 0]
        if len(place) == 0:
            continue
        m = min(2**k, v)
        row, view = wanted[place].nonzero().unbind(-1)
        views = torch.zeros(len(place), m, dtype=torch.long, device=x.device)
        present = torch.zeros(len(place), m, dtype=torch.bool, device=x.device)
        position = slot[place][row, view] - 1
        views[row, position] = view
        present[row, position] = True
        problem, point = (place // n)[:, None], (place % n)[:, None]
        w = None if weights is None else weights[problem, views, point][..., None]
        results.append(_solve_dense(solve, x[problem, views, point][:, :, None], P[problem, views], present[..., None], w))
        places.append(place)
    order = torch.cat(places).argsort()
    joined = (torch.cat(parts, -2) for parts in zip(*results, strict=True))
    return [part.index_select(-2, order).reshape(*part.shape[:-2], size, n) for part in joined]


def _ranges(size: int, step: int) -> Iterator[slice]:
    """Slices that cover `size`; one empty slice where there is nothing, so that shapes come out right."""
    for start in range(0, max(size, 1), step):
        yield slice(start, min(start + step, size))


def _observe(x: Tensor, P: Tensor, visible: Tensor | None, weights: Tensor | None) -> Observations:
    """Lay a piece out: x (problem, view, point, 2), P (problem, view, 3, 4), visible and weights (problem, view, point)."""
    # Coordinates first, points last; cameras (3, 4, view, problem, 1), their arbitrary scale taken out.
    u, v = x.permute(3, 1, 0, 2).double().contiguous().unbind(0)
    entries = P.permute(2, 3, 1, 0).double().contiguous()[..., None]
    size = entries[:, :3].detach().abs().amax((0, 1))
    entries = entries / torch.where((size > 0) & (size < torch.inf), size, 1.0)
    # Squares must be finite too.
    good_P = usable(entries.detach().abs().amax((0, 1)))
    good = usable(u) & usable(v) & good_P
    wanted = torch.ones_like(good) if visible is None else visible.permute(1, 0, 2)
    w = torch.ones_like(u)
    if weights is not None:
        w = weights.permute(1, 0, 2).double()
        wanted = wanted & (w.detach() != 0)
        good = good & (w.detach() >= 0) & usable(w)
    use = wanted & good
    zero = torch.zeros((), dtype=torch.float64, device=x.device)
    w, u, v = torch.where(use, w, zero), torch.where(use, u, zero), torch.where(use, v, zero)
    harmless = torch.eye(3, 4, dtype=torch.float64, device=P.device)[..., None, None, None]
    entries = torch.where(good_P, entries, harmless)
    used = use.any(-1, keepdim=True)
    rows = tuple(row.unbind(0) for row in entries.unbind(0))
    *centre, handed = _centres(rows)
    finite = centre[3].detach() != 0
    counted = used & finite
    number = counted.sum(0).clamp_min(1)
    shift = torch.stack([torch.where(counted, c, 0.0).sum(0) / number for c in centre[:3]])
    offsets = [torch.where(finite, c - s, c) for c, s in zip(centre[:3], shift.unbind(0), strict=True)]
    spread = torch.stack([torch.where(counted, o * o, 0.0).sum(0) for o in offsets]).sum(0) / number
    # One place for all centres: there is no unit but the world's own.
    reach = torch.stack([torch.where(counted, c.detach() * c.detach(), 0.0).sum(0) for c in centre[:3]]).sum(0) / number
    apart = spread.detach() > 1e-22 * reach.clamp_min(1e-200)
    scale = torch.where(apart, spread, 1.0).sqrt()
    apart = apart | (used & ~finite).any(0)
    moved = tuple(
        (r[0] * scale, r[1] * scale, r[2] * scale, r[3] + r[0] * shift[0] + r[1] * shift[1] + r[2] * shift[2]) for r in rows
    )
    scaled = [torch.where(finite, o / scale, o) for o in offsets]
    broken = (wanted & ~good).any(0)
    return Observations((u, v), moved, w, (scaled[0], scaled[1], scaled[2], centre[3]), handed, shift, scale, apart, broken)


def _centres(P: tuple[tuple[Tensor, ...], ...]) -> tuple[Tensor, ...]:
    """Homogeneous camera centres, with last entry 1 or for a camera at infinity a unit direction and 0; and the sign of det."""
    a, b, c = P
    m = {(i, j): torch.addcmul(a[i] * b[j], a[j], b[i], value=-1) for i in range(4) for j in range(i + 1, 4)}

    def minor(i: int, j: int, k: int) -> Tensor:
        return torch.addcmul(torch.addcmul(c[i] * m[j, k], c[j], m[i, k], value=-1), c[k], m[i, j])

    X, Y, Z, W = minor(1, 2, 3), -minor(0, 2, 3), minor(0, 1, 3), -minor(0, 1, 2)
    rows = [(row[0] * row[0] + row[1] * row[1] + row[2] * row[2]).sqrt() for row in P]
    finite = W.detach().abs() > 1e-13 * (rows[0] * rows[1] * rows[2]).detach()
    length = (X * X + Y * Y + Z * Z).sqrt()
    divisor = torch.where(finite, W, torch.where(length.detach() > 0, length, 1.0))
    divisor = torch.where(divisor.detach() == 0, 1.0, divisor)
    handed = torch.where(finite, -torch.sign(W.detach()), 0.0)
    return X / divisor, Y / divisor, Z / divisor, finite.to(W.dtype), handed
