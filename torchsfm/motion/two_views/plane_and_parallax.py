"""The plane that most points of an epipolar geometry lie in, and the geometry of a plane and two points aside.

With x2 ~ A x1 + (v' x1) e2, the homographies that agree with an epipolar geometry are H = A + e2 v': A is R, e2 is t for a
calibrated pair; A = [e2]x F else (HZ 13.1). A point determines v' x1, three points v. Given H, two points off the plane
determine the epipole: it lies on the lines through x2 and H x1 (Chum, Werner & Matas 2005).
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions
from torchsfm.linalg import damped_solve
from torchsfm.motion.two_views.epipolar_fit import cross_rows, forms, plane_rows
from torchsfm.motion.two_views.plane_glance import best_triple, plane_errors
from torchsfm.robust import constant_weights
from torchsfm.robust.hypotheses import squared_residual
from torchsfm.robust.sampling import draw_samples

_JUDGES = 256
"""How many data to judge planes by before all of them are looked at."""
_PAIRS, _OFF_PLANE, _ALTERNATIVES = 1024, 256, 4
"""Pairs of points off a plane, points off it to judge them by, and how many of the best to return."""


def squared_transfer(
    H: Float[Tensor, "*#batch 3 3"], h1: Sequence[Tensor], h2: Sequence[Tensor], sphere: bool
) -> Float[Tensor, "*batch n"]:
    """The squared distance of the second points from the transferred first ones, on the plane or on the sphere."""
    y0, y1, y2 = forms(H, h1)
    if sphere:
        c0, c1, c2 = _cross((y0, y1, y2), h2)
        squared = (c0 * c0 + c1 * c1 + c2 * c2) / (y0 * y0 + y1 * y1 + y2 * y2).clamp(min=1e-30)
        facing = y0 * h2[0] + y1 * h2[1] + y2 * h2[2] > 0
        return torch.where(facing, squared, torch.inf)
    inverse = 1 / y2
    u, v = y0 * inverse - h2[0], y1 * inverse - h2[1]
    return (u * u + v * v).nan_to_num(nan=torch.inf)


def dominant_plane(
    A: Float[Tensor, "p 3 3"],
    e: Float[Tensor, "p 3"],
    h1: Sequence[Tensor],
    h2: Sequence[Tensor],
    inliers: Bool[Tensor, "p n"],
    limit: Float[Tensor, "p"],
    sphere: bool,
) -> tuple[Float[Tensor, "p 3 3"], Bool[Tensor, "p n"]]:
    """The homography A + e v' that most inliers agree with, and which do.

    Tries planes through triples of inliers: the data come in an order of which any part is spread over all.

    Args:
        A: One homography that agrees with the epipolar geometry.
        e: The epipole in the second image.
        h1: The rows of the first points.
        h2: The rows of the second points.
        inliers: Which points agree with the epipolar geometry.
        limit: Squared largest transfer error.
        sphere: Whether points are unit rays.

    Returns:
        The homography, and the inliers that agree with it; zeros and none where no three inliers determine a plane.
    """
    if inliers.shape[-1] < 3:
        return torch.zeros_like(A), torch.zeros_like(inliers)
    rows = plane_errors(A, e, torch.stack(list(h1), 1), torch.stack(list(h2), 1), limit)
    v, _ = best_triple(rows[..., :_JUDGES], inliers[:, :_JUDGES])
    for _ in range(3):
        error = (v[:, None] @ rows[:, :3])[:, 0] - rows[:, 3]
        on = inliers & (error * error < 1)
        moments = (rows * on[:, None]) @ rows[:, :3].mT
        refined = damped_solve(moments[:, :3], moments[:, 3:].mT)[..., 0]
        v = torch.where((on.sum(-1) >= 3)[:, None], refined, v)
    H = A + e[:, :, None] * v[:, None, :]
    return H, inliers & (squared_transfer(H, h1, h2, sphere) < limit[:, None])


def plane_alternatives(
    estimator: Any,
    plane_estimator: Any,
    model: Float[Tensor, "p 3 4"],
    x1: Float[Tensor, "p n 2"],
    x2: Float[Tensor, "p n 2"],
    *,
    inside: Bool[Tensor, "p n"],
    threshold: Float[Tensor, "p"],
    seed: int,
) -> Solutions[Float[Tensor, "p 4 3 4"]]:
    """The best F of the dominant plane and two points off it, where half of the inliers of F or more are in one plane.

    Pairs are drawn from all points off the plane, and judged by these: all pairs agree with the points of the plane.

    Args:
        estimator: Measures F.
        plane_estimator: Measures and refines homographies.
        model: The best F so far, with its second epipole.
        x1: Points in the first image.
        x2: Points in the second image.
        inside: Which points exist.
        threshold: Largest distance of an inlier.
        seed: Seed for the pairs.
    """
    out = model[:, None].expand(-1, _ALTERNATIVES, -1, -1).clone()
    valid = torch.zeros(len(model), _ALTERNATIVES, dtype=torch.bool, device=model.device)
    limit = threshold * threshold
    # First a look at a part, spread over all.
    some = slice(2 * _OFF_PLANE)
    _, on, near = _on_plane(estimator, model, x1[:, some], x2[:, some], inside[:, some], limit)
    row = ((2 * on.sum(-1) >= near.sum(-1)) & (on.sum(-1) >= 5)).nonzero()[:, 0]
    if not len(row):
        return Solutions(out, valid)
    y1, y2, there, bound = x1[row], x2[row], inside[row], limit[row]
    H, on, _ = _on_plane(estimator, model[row], y1, y2, there, bound)
    for _ in range(3):
        H = plane_estimator.step(H, y1, y2, weigh=constant_weights(on.to(H.dtype)))
        on = there & (plane_estimator.squared_residual(H, y1, y2) < 4 * bound[:, None])
    aside = there & ~on
    count = aside.sum(-1)
    # The points off the plane come first, in their order, of which any part is spread over all.
    index = aside.to(torch.int8).argsort(dim=-1, descending=True, stable=True)
    drawn = draw_samples(seed, count.clamp(min=2), torch.zeros_like(count), _PAIRS, 2)
    pair = index.gather(1, drawn.flatten(1).clamp(max=index.shape[-1] - 1))
    g1, g2 = (torch.cat((y, torch.ones_like(y[..., :1])), -1) for y in (y1, y2))
    corners = [g.gather(1, pair[..., None].expand(-1, -1, 3)).reshape(len(row), 2, _PAIRS, 3).transpose(1, 2) for g in (g1, g2)]
    found, epipole = fundamentals_of_parallax(H[:, None], *corners)
    # Twice, with the epipole on either side: one of them has the points in front.
    both = torch.cat([torch.cat((found, sign * epipole[..., None]), -1) for sign in (1, -1)], 1)
    judges = index[:, :_OFF_PLANE, None].expand(-1, -1, 2)
    z1, z2 = y1.gather(1, judges), y2.gather(1, judges)
    counts = aside.gather(1, judges[..., 0])
    # Problem by problem, or what is being computed leaves the cache.
    loss = []
    for i in range(len(row)):
        squared = squared_residual(estimator, both[i : i + 1], z1[i : i + 1, None], z2[i : i + 1, None])
        ratio = (squared / bound[i]).clamp(max=1).nan_to_num(nan=1.0)
        loss.append((ratio * counts[i]).sum(-1))
    least = torch.cat(loss).topk(_ALTERNATIVES, dim=-1, largest=False)
    out[row] = both.gather(1, least.indices[..., None, None].expand(-1, -1, 3, 4))
    valid[row] = (least.values < counts.sum(-1, keepdim=True)) & (count >= 2)[:, None]
    return Solutions(out, valid)


def _on_plane(
    estimator: Any, model: Tensor, x1: Tensor, x2: Tensor, inside: Tensor, limit: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The homography of the dominant plane, the inliers on it, and all inliers."""
    F, e = model[..., :3], model[..., 3]
    near = (squared_residual(estimator, model, x1, x2) < limit[:, None]) & inside
    H, on = dominant_plane(cross_rows(e, F), e, plane_rows(x1), plane_rows(x2), near, 4 * limit, sphere=False)
    return H, on, near


def fundamentals_of_parallax(
    H: Float[Tensor, "*#batch 3 3"], h1: Float[Tensor, "*#batch 2 3"], h2: Float[Tensor, "*#batch 2 3"]
) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3"]]:
    """F of norm 1 and its second epipole, from the homography of a plane and two points off it; zeros where they are on it."""
    y = h1 @ H.mT
    lines = torch.linalg.cross(h2, y)
    e = torch.linalg.cross(lines[..., 0, :], lines[..., 1, :])
    size = (e * e).sum(-1, keepdim=True)
    e = e * torch.where(size > 1e-30, size, torch.inf).rsqrt()
    F = cross_rows(e, H)
    size = (F * F).sum(-1).sum(-1)[..., None, None]
    return F * torch.where(size > 1e-30, size, torch.inf).rsqrt(), e


def most_by_chance(chance: Float[Tensor, "*batch"], free: int) -> Float[Tensor, "*batch"]:
    """How many points may agree by chance with a model of which the others leave `free` dimensions open."""
    return chance + 3 * chance.sqrt() + (free + 2)


def more_than_chance(number: Int[Tensor, "*#batch"], chance: Float[Tensor, "*#batch"], free: int) -> Bool[Tensor, "*batch"]:
    """Whether so many points agree with such a model, rather than by chance."""
    return number > most_by_chance(chance, free)


def _cross(a: Sequence[Tensor], b: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
