"""Three views of a plane and two points off it: the other cameras that explain the points of a plane that won.

With cameras [I | 0], [H2 | e2], [H3 | e3] a plane has r = 0 for its points X = (x1, r). Any epipoles agree with it; a point off
the plane puts e2 on the line through x2 and H2 x1, e3 on that through x3 and H3 x1, and its r relates the lengths of the two.
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Solutions
from torchsfm.motion.two_views.epipolar_fit import forms, plane_rows
from torchsfm.motion.two_views.estimate_homography import HomographyEstimator
from torchsfm.motion.two_views.plane_and_parallax import dominant_plane, squared_transfer
from torchsfm.motion.two_views.plane_glance import plane_suspected
from torchsfm.robust import constant_weights
from torchsfm.robust.hypotheses import squared_residual
from torchsfm.robust.sampling import draw_samples
from torchsfm.tensors.canonical import canonical_frame

_PAIRS, _OFF_PLANE, _ALTERNATIVES = 256, 256, 4
"""Pairs of points off the plane, points off it to judge them by, and how many of the best to return."""


def alternatives_of_plane(
    estimator: Any,
    model: Float[Tensor, "p 2 3 4"],
    x: Sequence[Float[Tensor, "p n 2"]],
    inside: Bool[Tensor, "p n"],
    threshold: Float[Tensor, "p"],
    seed: int,
) -> Solutions[Float[Tensor, "p 4 2 3 4"]]:
    """The best cameras of the dominant plane and two points off it, where half of the inliers or more are in one plane.

    Pairs are drawn from all points off the plane, and judged by these: all pairs agree with the points of the plane.

    Args:
        estimator: Measures cameras.
        model: The best cameras so far, the second and the third.
        x: Points in the three images.
        inside: Which points exist.
        threshold: Largest distance of an inlier.
        seed: Seed for the pairs.
    """
    out = model[:, None].expand(-1, _ALTERNATIVES, -1, -1, -1).clone()
    valid = torch.zeros(len(model), _ALTERNATIVES, dtype=torch.bool, device=model.device)
    limit = threshold * threshold
    near = (squared_residual(estimator, model, *x) < limit[:, None]) & inside
    H, on = _planes(model, x, near, limit)
    row = ((2 * on.sum(-1) >= near.sum(-1)) & (on.sum(-1) >= 5)).nonzero()[:, 0]
    if not len(row):
        return Solutions(out, valid)
    x, inside, limit, on = [y[row] for y in x], inside[row], limit[row], on[row]
    H = [h[row] for h in H]
    plane = HomographyEstimator()
    for _ in range(3):
        H = [plane.step(h, x[0], y, weigh=constant_weights(on.to(h.dtype))) for h, y in zip(H, x[1:], strict=True)]
        far = [plane.squared_residual(h, x[0], y) < 4 * limit[:, None] for h, y in zip(H, x[1:], strict=True)]
        on = inside & far[0] & far[1]
    # The points of the plane are in front.
    H = [_facing(h, x[0], on) for h in H]
    aside = inside & ~on
    count = aside.sum(-1)
    # The points off the plane come first, in their order, of which any part is spread over all.
    index = aside.to(torch.int8).argsort(dim=-1, descending=True, stable=True)
    drawn = draw_samples(seed, count.clamp(min=2), torch.zeros_like(count), _PAIRS, 2)
    pair = index.gather(1, drawn.flatten(1).clamp(max=index.shape[-1] - 1))[..., None].expand(-1, -1, 2)
    corners = [y.gather(1, pair).reshape(len(row), 2, _PAIRS, 2).transpose(1, 2) for y in x]
    found = _cameras_of_parallax([h[:, None] for h in H], corners)
    judges = index[:, :_OFF_PLANE, None].expand(-1, -1, 2)
    z = [y.gather(1, judges) for y in x]
    counts = aside.gather(1, judges[..., 0])
    # Problem by problem, or what is being computed leaves the cache.
    loss = []
    for i in range(len(row)):
        squared = squared_residual(estimator, found[i : i + 1], *(y[i : i + 1, None] for y in z))
        ratio = (squared / limit[i]).clamp(max=1).nan_to_num(nan=1.0)
        loss.append((ratio * counts[i]).sum(-1))
    least = torch.cat(loss).topk(_ALTERNATIVES, dim=-1, largest=False)
    out[row] = found.gather(1, least.indices[..., None, None, None].expand(-1, -1, 2, 3, 4))
    valid[row] = (least.values < counts.sum(-1, keepdim=True)) & (count >= 2)[:, None]
    valid &= torch.isfinite(out).flatten(2).all(-1)
    return Solutions(torch.where(valid[..., None, None, None], out, model[:, None]), valid)


def planar_suspected(
    model: Float[Tensor, "p 2 3 4"],
    x: Sequence[Tensor],
    inliers: Bool[Tensor, "p n"],
    limit: Float[Tensor, "p"],
    spare: Float[Tensor, "p"],
) -> Bool[Tensor, "p"]:
    """Whether one plane may hold half of the inliers in both pairs of views, or all but a few (see `plane_suspected`)."""
    first, *others = (torch.nn.functional.pad(y.mT, (0, 0, 0, 1), value=1.0) for y in x)
    pairs = [
        plane_suspected(model[..., k, :, :3], model[..., k, :, 3], first, other, inliers, 4 * limit, spare)
        for k, other in enumerate(others)
    ]
    return pairs[0] & pairs[1]


def planar(
    model: Float[Tensor, "*batch 2 3 4"], x: Sequence[Tensor], inliers: Bool[Tensor, "*batch n"], limit: Float[Tensor, "*batch"]
) -> Bool[Tensor, "*batch n"]:
    """The inliers on the plane that has most of them."""
    return _planes(model, x, inliers, limit)[1]


def _planes(model: Tensor, x: Sequence[Tensor], inliers: Tensor, limit: Tensor) -> tuple[list[Tensor], Tensor]:
    """The homographies of the dominant plane from the first image to the others, and which inliers agree with both.

    The plane is looked for in the view that moves more against the first.
    """
    h = [plane_rows(y) for y in x]
    A, e = [model[..., k, :, :3] for k in range(2)], [model[..., k, :, 3] for k in range(2)]
    best = None
    for k in range(2):
        H, _ = dominant_plane(A[k], e[k], h[0], h[k + 1], inliers, 4 * limit, sphere=False)
        square = (e[k] * e[k]).sum(-1)
        v = (e[k][..., None, :] @ (H - A[k]))[..., 0, :] / torch.where(square > 0, square, 1)[..., None]
        both = [a + c[..., :, None] * v[..., None, :] for a, c in zip(A, e, strict=True)]
        on = inliers
        for b, y in zip(both, h[1:], strict=True):
            on = on & (squared_transfer(b, h[0], y, sphere=False) < 4 * limit[..., None])
        if best is None:
            best = both, on
        else:
            more = on.sum(-1) > best[1].sum(-1)
            kept = [torch.where(more[..., None, None], b, a) for a, b in zip(best[0], both, strict=True)]
            best = kept, torch.where(more[..., None], on, best[1])
    assert best is not None
    return best


def _facing(H: Tensor, x1: Tensor, on: Tensor) -> Tensor:
    """The homography with the sign that gives most points of the plane a positive third coordinate."""
    depth = forms(H[..., 2:, :], plane_rows(x1))[0]
    behind = (on & (depth < 0)).sum(-1) > (on & (depth > 0)).sum(-1)
    return torch.where(behind[..., None, None], -H, H)


def _cameras_of_parallax(H: Sequence[Tensor], x: Sequence[Float[Tensor, "*batch 2 2"]]) -> Tensor:
    """The cameras of the homographies of a plane and two points off it."""
    h = [torch.nn.functional.pad(y, (0, 1), value=1.0) for y in x]
    epipoles, distances = [], []
    for k in range(2):
        y = h[0] @ H[k].mT
        lines = torch.linalg.cross(h[k + 1], y)
        e = torch.linalg.cross(lines[..., 0, :], lines[..., 1, :])
        size = (e * e).sum(-1, keepdim=True)
        e = e * torch.where(size > 0, size, torch.inf).rsqrt()
        across = torch.linalg.cross(h[k + 1], e[..., None, :].expand_as(y))
        square = (across * across).sum(-1)
        distances.append(-(lines * across).sum(-1) / torch.where(square > 0, square, torch.inf))
        epipoles.append(e)
    # r e2 and r s e3: the ratio of the lengths, by least squares over both points.
    r2, r3 = distances
    square = (r2 * r2).sum(-1, keepdim=True)
    s = (r2 * r3).sum(-1, keepdim=True) / torch.where(square > 0, square, torch.inf)
    e = torch.stack((epipoles[0], s * epipoles[1]), -2)
    A = torch.stack([h.expand(*e.shape[:-2], 3, 3) for h in H], -3)
    return canonical_frame(torch.cat((A, e[..., None]), -1), signed=False)[..., 1:, :, :]
