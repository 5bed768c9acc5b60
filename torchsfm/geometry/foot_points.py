"""The points of curves nearest to given points."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import broadcast_shapes, check_tensors
from torchsfm.geometry.curves import Curve, Segments, segments_of

_NUMBERS = 1 << 22
"""Distances of points from segments that are computed at a time."""
_NEWTON = 4
"""Steps from the nearest point of the chord to that of the cubic."""


class FootPoints(NamedTuple):
    """The points of curves nearest to given points.

    Example:
        >>> import torch, torchsfm
        >>> line = torchsfm.geometry.curve_from_samples(torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]))
        >>> x = torch.tensor([[0.5, 3.0], [-1.0, 0.0]])
        >>> foot = torchsfm.geometry.foot_points(line, x)
        >>> normal = torch.stack((-foot.tangent[:, 1], foot.tangent[:, 0]), -1)
        >>> ((x - foot.x) * normal).sum(-1).abs(), foot.within  # distances across; the second point is beyond the end
        (tensor([3., 0.]), tensor([ True, False]))
    """

    x: Float[Tensor, "*batch m d"]
    """The nearest points, on the smooth curves; zero where a curve has fewer than two samples."""
    tangent: Float[Tensor, "*batch m d"]
    """Unit tangents there, forwards."""
    within: Bool[Tensor, "*batch m"]
    """False where the nearest point is an open end that the given point lies beyond, or there is no curve."""


def foot_points(curve: Curve, y: Float[Tensor, "*#batch m d"]) -> FootPoints:
    """The points of curves nearest to given points: on the nearest chord, then by Newton's method on its cubic.

    Args:
        curve: The curves.
        y: Points.

    Returns:
        Nearest points, tangents and whether they are within the curve. `x` has the derivatives by the curve's samples of the
        point at the same share of its segment: exact across the curve, which is all that distances feel; none by `y`, and
        `tangent` has none.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> line = torchsfm.geometry.curve_from_samples(torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]))
        >>> foot = torchsfm.geometry.foot_points(line, torch.tensor([[0.5, 3.0], [-1.0, 0.0]]))
        >>> foot.x[0], foot.within
        (tensor([0.5000, 0.0000]), tensor([ True, False]))
    """
    d = curve.x.shape[-1]
    check_tensors(y=(y, f"m {d}"), curve=(curve.x, f"n {d}"))
    batch = broadcast_shapes(curve.x.shape[:-2], y.shape[:-2])
    n, m = curve.x.shape[-2], y.shape[-2]
    s = segments_of(
        Curve(
            curve.x.expand(*batch, n, d).reshape(-1, n, d),
            curve.valid.expand(*batch, n).reshape(-1, n),
            curve.closed.expand(batch).reshape(-1),
        )
    )
    with torch.no_grad():
        held = Segments(*(t.detach() for t in s))
        points = y.detach().expand(*batch, m, d).reshape(-1, m, d)
        rows = max(1, _NUMBERS // max(n * d * len(points), 1))
        parts = [_feet(held, points[:, i : i + rows]) for i in range(0, max(m, 1), rows)]
        index, share, tangent, good, beyond = (torch.cat(part, 1) for part in zip(*parts, strict=True))
    x = torch.where(good[..., None], s.cubics().take(index).at(share)[0], 0)
    return FootPoints(*(part.reshape(*batch, m, *part.shape[2:]) for part in (x, tangent, good & ~beyond)))


def _feet(s: Segments, y: Float[Tensor, "b m d"]) -> tuple[Tensor, ...]:
    """Segment and share of the nearest points, unit tangents, whether there is any, and whether y is beyond an open end."""
    away = y[:, :, None] - s.start[:, None]
    square = s.length.square()[:, None]
    t = ((away * s.chord[:, None]).sum(-1) / torch.where(square > 0, square, 1)).clamp(0, 1)
    gap = (away - t[..., None] * s.chord[:, None]).square().sum(-1)
    index = torch.where(s.there[:, None], gap, torch.inf).nan_to_num(nan=torch.inf).argmin(-1)
    t = t.gather(-1, index[..., None])[..., 0]
    number, around = s.there.sum(-1, keepdim=True), ~s.open[:, None]
    cubics = s.cubics()
    for again in (True, False):
        own = cubics.take(index)
        for _ in range(_NEWTON):
            p, first, second = own.at(t)
            speed = first.square().sum(-1)
            bent = speed + ((p - y) * second).sum(-1)
            step = ((p - y) * first).sum(-1) / torch.maximum(bent, 0.3 * speed).clamp(min=1e-300)
            t = (t - step).clamp(0, 1)
        p, first, _ = own.at(t)
        slope = ((p - y) * first).sum(-1)
        before, after = (t <= 0) & (slope > 0), (t >= 1) & (slope < 0)
        if again:
            # Near a sample the nearest chord may be the one beside the nearest cubic.
            before, after = before & (around | (index > 0)), after & (around | (index < number - 1))
            moved = (index + after.long() - before.long()) % number.clamp(min=1)
            index, t = moved, torch.where(before, 1.0, torch.where(after, 0.0, t))
    beyond = (before & ~around & (index == 0)) | (after & ~around & (index == number - 1))
    tangent = torch.nn.functional.normalize(first, dim=-1)
    good = (number > 0) & torch.isfinite(y).all(-1) & torch.isfinite(p + tangent).all(-1)
    return index, t, torch.where(good[..., None], tangent, 0), good, beyond
