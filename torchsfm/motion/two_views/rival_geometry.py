"""Is there a second epipolar geometry that the same points agree with, somewhere else altogether?

Points of a ruled quadric through both centres agree with two or three F, and with two E where it is one of a certain kind
(critical surfaces: Krames 1941; HZ 22.1): noise decides which of them fits best. The equations h2' F h1 = 0 of such points have
a pencil of solutions, and the F of rank 2 in it are the rivals.
"""

from collections.abc import Callable
from functools import cache
from operator import itemgetter
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.motion.two_views.epipolar_fit import cofactors
from torchsfm.robust import Degeneracy

_TINY = 1e-30
_PARTS, _ROUNDS, _GLANCE_ROUNDS = 8, 3, 1
"""Into how many parts to part the points, to begin with, and how often to weigh anew what is near to a second solution."""
_STEPS, _SETTLED, _SHORTEST = 40, 0.01, 2.0**12
"""Most steps from a rank-2 member of the pencil to the rival; by what share of the loss one must be better, or be shortened by
how much in vain, to be one of the last."""
_OFF = 0.2
"""What share of the inliers, besides those by chance, may be far from the second solution if a rival is near it: up to 5 % of
them were in scenes on critical surfaces, in others more than this nearly always."""
_DEVIATIONS = 3.0
"""By how many standard deviations of the difference the points must prefer the one to the other."""
_EXACT = 1e-4
"""Distances below this part of the threshold are none."""
_APART = 6.0
"""How many of its own standard deviations the model is from a rival, or this is no other model."""


def _second_solution(
    F: Float[Tensor, "p 3 3"],
    h1: Float[Tensor, "p 3 n"],
    h2: Float[Tensor, "p 3 n"],
    inliers: Bool[Tensor, "p n"],
    limit: Float[Tensor, "p"],
    sphere: bool,
    rounds: int = _ROUNDS,
) -> tuple[Float[Tensor, "p 1 9"], Float[Tensor, "p n"]]:
    """The G across F, of norm 1, with the least h2' G h1, robustly; and the squares of these, 0 for what is no inlier.

    They are measured in the unit of the distances to F, and a few that chance has made inliers of F alone count for little.
    Inverse iteration: it is soon at its end where there is such a G, and else what it has is as far from the points.
    """
    sides = (torch.bmm(F, h1), torch.bmm(F.mT, h2))
    if not sphere:
        sides = (sides[0][:, :2], sides[1][:, :2])
    scale = inliers[:, None] / torch.linalg.vector_norm(torch.cat(sides, 1), dim=1, keepdim=True).clamp(min=_TINY)
    rows = torch.mul(h2[:, :, None], (scale * h1)[:, None]).flatten(1, 2)
    f, bound, damping, start = F.flatten(1)[:, None], limit[:, None, None], *_constants(F.dtype, F.device)
    column = f.mT
    rows = torch.baddbmm(rows, column, torch.bmm(f, rows), alpha=-1)
    # F itself is no second solution; and what nothing speaks against has to be solved for.
    held = torch.addcmul(damping, column, f) * inliers.shape[-1]
    g = _of_parts(rows, held, bound, start)
    other, left = rows.mT, torch.bmm(g, rows)
    for _ in range(rounds):
        weighted = rows / (1 + left * left / bound)
        g = _inverse_iteration(torch.baddbmm(held, weighted, other), g.mT).mT
        left = torch.bmm(g, rows)
    return g, (left * left)[:, 0]


def _of_parts(
    rows: Float[Tensor, "p 9 n"], held: Float[Tensor, "p 9 9"], bound: Float[Tensor, "p 1 1"], start: Float[Tensor, "9 1"]
) -> Float[Tensor, "p 1 9"]:
    """The second solution of all points, or of a part of them if more points are near to that: some parts hold no wrong one."""
    p, _, n = rows.shape
    even = rows if n % _PARTS == 0 else torch.nn.functional.pad(rows, (0, -n % _PARTS))
    part = even.view(p, 9, -1, _PARTS).permute(0, 3, 1, 2)
    moments = part @ part.mT
    moments = torch.cat((moments.sum(1, keepdim=True), moments), 1) + held[:, None]
    g = _inverse_iteration(moments, start)[..., 0]
    left = torch.bmm(g, rows)
    best = (left * left / bound).clamp_(max=1).sum(-1).argmin(-1)
    return g[torch.arange(p, device=g.device), best][:, None]


def _inverse_iteration(A: Float[Tensor, "*batch 9 9"], g: Float[Tensor, "*#batch 9 1"]) -> Float[Tensor, "*batch 9 1"]:
    """One step, which makes A definite but for its rounding, in whatever units points are."""
    A.diagonal(dim1=-2, dim2=-1).mul_(1 + 1e-12)
    g = torch.cholesky_solve(g, torch.linalg.cholesky_ex(A)[0])
    length: Tensor = torch.linalg.vector_norm(g, dim=-2, keepdim=True)
    return g / length


@cache
def _constants(dtype: torch.dtype, device: torch.device) -> tuple[Float[Tensor, "9 9"], Float[Tensor, "9 1"]]:
    """What makes a matrix definite, and a vector to begin with, across no second solution."""
    return 1e-12 * torch.eye(9, dtype=dtype, device=device), torch.linspace(1, 2, 9, dtype=dtype, device=device).cos()[:, None]


def _of_unit_size(
    F: Float[Tensor, "p 3 3"],
    h1: Float[Tensor, "p 3 n"],
    h2: Float[Tensor, "p 3 n"],
    inliers: Bool[Tensor, "p n"],
    limit: Float[Tensor, "p"],
) -> tuple[tuple[Tensor, Tensor, Tensor, Tensor], Float[Tensor, "p 3"]]:
    """The same with inliers about a unit from the origin, F of norm 1 again, and what a homogeneous point was multiplied by.

    What is across F, and how far from it a second solution is, depends on the unit of the points.
    """
    square = (h1[:, :2] * h1[:, :2] + h2[:, :2] * h2[:, :2]).sum(1) * inliers
    unit = (square.sum(-1) / inliers.sum(-1).clamp(min=1) / 4).sqrt().clamp(min=_TINY)
    scale = torch.stack((1 / unit, 1 / unit, torch.ones_like(unit)), -1)
    F = F / scale[:, :, None] / scale[:, None]
    F = F / torch.linalg.matrix_norm(F, keepdim=True).clamp(min=_TINY)
    return (F, scale[:, :, None] * h1, scale[:, :, None] * h2, limit / unit.square()), scale


def rival_suspected(
    F: Float[Tensor, "p 3 3"],
    h1: Float[Tensor, "p 3 n"],
    h2: Float[Tensor, "p 3 n"],
    inliers: Bool[Tensor, "p n"],
    limit: Float[Tensor, "p"],
    spare: Float[Tensor, "p"],
    sphere: bool,
) -> Bool[Tensor, "p"]:
    """Whether there is, to first order and whatever its rank, a second solution on the whole within a limit: a glance.

    Args:
        F: Epipolar geometries, of norm 1.
        h1: The first points, homogeneous, or rays of unit length.
        h2: The second points.
        inliers: Which points agree with them.
        limit: Squared largest distance.
        spare: How many inliers need not agree.
        sphere: Whether points are unit rays.
    """
    if not sphere:
        (F, h1, h2, limit), _ = _of_unit_size(F, h1, h2, inliers, limit)
    _, square = _second_solution(F, h1, h2, inliers, limit, sphere, _GLANCE_ROUNDS)
    far: Tensor = (square > limit[:, None]).sum(-1)
    return far <= spare


def undetermined_where_rivalled(
    code: Int[Tensor, "*batch"], has_rival: Callable[..., Bool[Tensor, "p"]], *known: tuple[Tensor, int]
) -> Int[Tensor, "*batch"]:
    """Degeneracies, as int8, of which NONE becomes UNDETERMINED where another geometry agrees as well.

    Only there is it looked for, which takes as long as a search: of points of a plane, which have rivals as well, it is known.

    Args:
        code: What is known already.
        has_rival: Says so of some problems, given what is known of them.
        *known: Tensors, each with the number of its own dimensions, the last ones.
    """
    row = (code.flatten() == Degeneracy.NONE).nonzero()[:, 0]
    found = code.flatten().to(torch.int8)
    if len(row):
        some = [t.expand(*code.shape, *t.shape[t.ndim - own :]).reshape(-1, *t.shape[t.ndim - own :])[row] for t, own in known]
        found[row[has_rival(*some)]] = int(Degeneracy.UNDETERMINED)
    return found.view(code.shape)


def rank_two_members(
    F: Float[Tensor, "p 3 3"],
    h1: Float[Tensor, "p 3 n"],
    h2: Float[Tensor, "p 3 n"],
    inliers: Bool[Tensor, "p n"],
    limit: Float[Tensor, "p"],
    spare: Float[Tensor, "p"],
    sphere: bool,
) -> tuple[Float[Tensor, "p 2 3 3"], Bool[Tensor, "p"]]:
    """The other two of rank 2 in the pencil of F and the second solution; where these are not real, what is nearest to them.

    And whether so many points are near to the second solution that one of the two may be a rival. See `rival_suspected`.
    """
    scale = torch.ones_like(F[:, 0])
    if not sphere:
        (F, h1, h2, limit), scale = _of_unit_size(F, h1, h2, inliers, limit)
    g, square = _second_solution(F, h1, h2, inliers, limit, sphere)
    near = (square > limit[:, None]).sum(-1) <= torch.add(spare, inliers.sum(-1), alpha=_OFF)
    G = g.reshape(-1, 3, 3)
    # det(a G + b F) = a (a^2 det G + a b cof(G).F + b^2 cof(F).G), as det F = 0.
    C = cofactors(G)
    c0, c1, c2 = (C * G).sum((-2, -1)) / 3, (C * F).sum((-2, -1)), (cofactors(F) * G).sum((-2, -1))
    root = (c1 * c1 - 4 * c0 * c2).clamp(min=0).sqrt()
    q = -0.5 * (c1 + torch.copysign(root, c1))
    # The roots b / a, as pairs: q / c2 and c0 / q.
    a, b = torch.stack((c2, q), -1)[..., None, None], torch.stack((q, c0), -1)[..., None, None]
    both = (a * G[:, None] + b * F[:, None]) * scale[:, None, :, None] * scale[:, None, None]
    size: Tensor = torch.linalg.matrix_norm(both, dim=(-2, -1), keepdim=True)
    return both / size.clamp(min=_TINY), near


def rival_explains(
    estimator: Any,
    model: Float[Tensor, "p 3 4"],
    rivals: Float[Tensor, "p k sides 3 4"],
    near: Bool[Tensor, "p"],
    data: tuple[Tensor, Tensor],
    inliers: Bool[Tensor, "p n"],
    threshold: Float[Tensor, "p"],
    chance: Float[Tensor, "p"],
    rise: Callable[[Tensor, Tensor, Tensor], Tensor],
) -> Bool[Tensor, "p"]:
    """Whether one of the rivals, once refined, agrees with the inliers as well as the model, and is another one.

    As well: all inliers but so few as noise and chance explain are within the threshold, and over these the mean difference
    of the squared distances is not so many times its own deviation (Vuong 1989). Another one: by the quadratic model around the
    optimum the distances of what they share would be larger by far.

    Args:
        estimator: Measures and refines models, its fields one of each problem.
        model: The best model.
        rivals: Where to begin: models that differ by where points are in front alone, of which the best side is meant.
        near: Where there may be a rival: nowhere else it is looked for.
        data: The points.
        inliers: Which of them agree with the model.
        threshold: Largest distance of an inlier.
        chance: How many inliers chance explains.
        rise: By how much the quadratic model of the sum of weighted squares is larger at others: rise(model, others, weights).
    """
    if not bool(near.any()):
        return near
    p, k, sides = rivals.shape[:3]
    x1, x2 = (x[:, None] for x in data)
    wide, limit, inside = tensor_map(lambda t: t[:, None], estimator), (threshold * threshold)[:, None, None], inliers[:, None]
    squared = wide.squared_residual(rivals.flatten(1, 2), x1, x2)
    side = (inside & (squared < limit)).sum(-1).view(p, k, sides).argmax(-1)
    rivals = rivals.flatten(0, 1)[torch.arange(p * k, device=side.device), side.flatten()]
    rivals = _refined(estimator, rivals, data, inliers, limit[:, 0], near).view(p, k, 3, 4)
    own = torch.where(inliers, wide.squared_residual(model[:, None], x1, x2)[:, 0], 0.0)
    squared = wide.squared_residual(rivals, x1, x2)
    agree = inside & (squared < limit)
    spare = (inliers.sum(-1) - estimator.dimension).clamp(min=1)
    # Exact data have no scatter but rounding, which tells nothing.
    variance = torch.maximum(own.sum(-1) / spare, (_EXACT * threshold).square())
    # Chance puts a few within the threshold of the model alone, anywhere else; and noise a few right beyond that of the rival.
    tail = inliers.sum(-1) * torch.special.erfc(threshold / (2 * variance).sqrt())
    enough = _so_few(inside & ~(squared < 4 * limit), chance) & _so_few(inside & ~agree, chance + tail)
    more = torch.where(agree, squared - own[:, None], 0.0)
    rounding = (_EXACT * threshold).square() * inliers.sum(-1)
    as_well = more.sum(-1) < _DEVIATIONS * more.square().sum(-1).sqrt() + rounding[:, None]
    other = rise(model[:, None], rivals, agree.to(squared.dtype)) > _APART**2 * variance[:, None]
    found: Tensor = near & (enough & as_well & other).any(-1)
    return found


def _refined(
    estimator: Any,
    models: Float[Tensor, "r 3 4"],
    data: tuple[Tensor, Tensor],
    inliers: Bool[Tensor, "p n"],
    limit: Float[Tensor, "p 1"],
    near: Bool[Tensor, "p"],
) -> Float[Tensor, "r 3 4"]:
    """Robust Gauss-Newton steps, shorter ones where whole ones lead uphill: rivals that nearly are one are hardly determined.

    Each goes on until it settles, whatever becomes of the others; those of a problem stand together.
    """
    each = len(models) // len(inliers)
    found, row = models.clone(), near.repeat_interleave(each).nonzero()[:, 0]
    some = tensor_map(lambda t: t[row // each], (estimator, *data, inliers, limit))
    models = models[row]
    one = torch.ones_like(models[:, 0, 0])
    state = models, models, one * torch.inf, one, one > 0
    for _ in range(_STEPS):
        (own, x1, x2, inside, bound), (new, best, least, shorter, active) = some, state
        loss = least

        def weigh(squared: Tensor, known: tuple[Tensor, Tensor, Tensor] = (inside, bound, shorter)) -> tuple[Tensor, Tensor]:
            nonlocal loss
            inside, bound, shorter = known
            share = torch.where(inside & (squared < torch.inf), bound / (bound + squared), 0.0).to(squared.dtype)
            loss = torch.where(inside, 1 - share, 0.0).sum(-1)
            return share * share, share * share * shorter[:, None]

        stepped = own.step(new, x1, x2, weigh=weigh)
        worse, better = loss > least, active & (loss < least)
        unsettled = torch.where(worse, shorter < _SHORTEST, (loss < (1 - _SETTLED) * least) | (shorter > 1))
        shorter = torch.where(worse, 8 * shorter, torch.where(better, (shorter / 2).clamp(min=1), shorter))
        best, least = torch.where(better[:, None, None], new, best), torch.where(better, loss, least)
        active = active & unsettled
        state = torch.where(worse[:, None, None], best, stepped), best, least, shorter, active
        going = active.nonzero()[:, 0]
        if 2 * len(going) <= len(row):
            found[row] = best
            row, some, state = tensor_map(itemgetter(going), (row, some, state))
            if not len(going):
                break
    found[row] = state[1]
    return found


def _so_few(off: Bool[Tensor, "p k n"], expected: Float[Tensor, "p"]) -> Bool[Tensor, "p k"]:
    few: Tensor = off.sum(-1) <= (expected + _DEVIATIONS * expected.sqrt())[:, None]
    return few
