"""What rays leave open of where cameras are: those that only turned, and parts whose size is free."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.motion.many_views.ray_sums import REACH, Rays
from torchsfm.motion.many_views.triplets import pairs_within
from torchsfm.optim import Block, GemanMcClure, Term, pair_covariance

TOLD = 1e-4
"""That of which deviations are told: eliminating points holds each by about 1e-10 of what its rays say, and were rays more
exact, that would be more than what is expected of a part of free size."""
HELD = 1e3
"""By how much more exactly the extent is held than what the rays leave open, to say how well they determine the rest."""
PARALLAX, NEEDED = 8.0, 3
"""Standard deviations by which so many rays of a camera must differ from where points at infinity would be, and two from where
all points were one."""
CHANCE = 0.2
"""How many more for each wrong ray: those pull points nearer, where right rays still agree."""
FAR = 1e4
"""Points so far away, in extents of the component, or so near, say nothing of centres."""
FREE = 0.5
"""Standard deviation of the size of what a camera sees together with others, over that size, from which on it is free."""
LARGEST = 3000
"""Cameras of the largest component whose deviations are computed, which may take the inverse of a dense matrix."""


def tell(rays: Rays, inliers: Bool[Tensor, "m"], scale: float) -> Bool[Tensor, "v"]:
    """Whether some rays of each camera differ by more than noise from the mean direction of their point, and of the camera.

    Else all points are far, or in one place, of which noise makes several that seem to tell where the camera is.
    """
    known = torch.ones(rays.views, dtype=torch.bool, device=rays.v.device)
    wrong = torch.bincount(rays.view[~inliers], minlength=rays.views)
    for index, number in ((rays.point, rays.points), (rays.view, rays.views)):
        mean = torch.zeros(number, 3, dtype=rays.v.dtype, device=rays.v.device)
        mean = mean.index_add_(0, index[inliers], rays.v[inliers])[index]
        apart = torch.atan2(torch.linalg.cross(rays.v, mean).norm(dim=-1), (rays.v * mean).sum(-1))
        count = torch.bincount(rays.view[inliers & (apart > PARALLAX * scale)], minlength=rays.views)
        known = known & (count >= (NEEDED + CHANCE * wrong if index is rays.point else 2))
    return known


def deviations(rays: Rays, c: Tensor, X: Tensor, component: Tensor, scale: float) -> Float[Tensor, "v"]:
    """Of each centre, with the first camera of its component held, and how far the one farthest away is from it.

    What the rays leave open has the deviation of what is expected without any: 1 where all of a component is open.
    """
    if not len(rays.v) or int(torch.bincount(component).amax()) > LARGEST:
        return c.new_zeros(rays.views)
    scale = max(scale, TOLD)
    own = torch.arange(rays.views, device=c.device)
    far = c.square().sum(-1)
    most = torch.zeros_like(far).scatter_reduce_(0, component, far, "amax")
    last = torch.zeros_like(own).scatter_reduce_(0, component, torch.where(far == most[component], own, 0), "amax")[component]
    first, last = (t[(component == own) & (last != own)] for t in (own, last))
    apart = c[last] - c[first]
    distance = (X[rays.point] - c[rays.view]).norm(dim=-1)
    near = ((distance > 1 / FAR) & (distance < FAR)).nonzero()[:, 0]
    # All of a component may be open together, as the size of a part of it that hangs on one camera: then what is expected
    # of each would add up to something that is known.
    share = torch.bincount(component, minlength=rays.views) + torch.bincount(component[rays.view[near]], minlength=rays.views)
    share = share.to(c.dtype).rsqrt()[component]
    direction = HELD * torch.nn.functional.normalize(apart, dim=-1)
    # A point is as uncertain as it is far away.
    of_points = (rays.point[near],), (X[rays.point[near]], share[rays.view[near]] / distance[near])
    terms = [
        rays.sines(GemanMcClure(REACH), 1 / scale).select(near),
        Term(_apart, ("c",), (own,), (c, share)),
        Term(_apart, ("X",), *of_points),
        Term(_length, ("c", "c"), (first, last), (direction, HELD * apart.norm(dim=-1))),
    ]
    blocks = {"c": Block(c, fixed=component == own), "X": Block(X)}
    pairs, shared = _shared(rays, near)
    spread, between = (t.diagonal(dim1=-2, dim2=-1).sum(-1) for t in pair_covariance(blocks, terms, "c", pairs, eliminate="X"))
    # A part of free size may have come out so small that its deviation is, too, but not beside its own size.
    off, size = torch.zeros_like(spread), torch.zeros_like(spread)
    for i in pairs.unbind(1):
        off.index_add_(0, i, shared * (spread[pairs].sum(1) - 2 * between))
        size.index_add_(0, i, shared * (c[pairs[:, 0]] - c[pairs[:, 1]]).square().sum(-1))
    return torch.where(off > FREE**2 * size, torch.inf, spread.sqrt())


def _shared(rays: Rays, some: Int[Tensor, "k"]) -> tuple[Int[Tensor, "q 2"], Float[Tensor, "q"]]:
    """Pairs of cameras, and how many points they share beyond the first, which leaves open how far apart they are."""
    different = torch.unique(rays.point[some] * rays.views + rays.view[some])
    view, points = different % rays.views, different // rays.views
    found = [torch.unique(view[a] * rays.views + view[b], return_counts=True) for a, b in pairs_within(points)]
    if not found:
        return rays.view.new_zeros((0, 2)), rays.v.new_zeros(0)
    key, place = torch.unique(torch.cat([key for key, _ in found]), return_inverse=True)
    number = torch.zeros_like(key).index_add_(0, place, torch.cat([count for _, count in found])).to(rays.v.dtype)
    return torch.stack((key // rays.views, key % rays.views), 1), number - 1


def _apart(a: Tensor, expected: Tensor, weight: Tensor) -> Tensor:
    return weight[:, None] * (a - expected)


def _length(a: Tensor, b: Tensor, direction: Tensor, length: Tensor) -> Tensor:
    """How much longer a difference is along a direction."""
    return ((b - a) * direction).sum(-1, keepdim=True) - length[:, None]
