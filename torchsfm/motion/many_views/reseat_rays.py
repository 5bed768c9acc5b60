"""Cameras and points put where two of their rays want them, if more of their rays then agree.

A sum in which wrong rays lose their pull has many minima: in some a camera, or a point, is held far away by a few rays that
agree by chance. A ray is a line through its camera and through its point, so both are found alike, where two lines meet.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.motion.many_views.ray_sums import Rays
from torchsfm.optim import Loss

PLACES = 32
"""Pairs of rays that are tried for each: all of eight rays, some of more."""
JUDGES = 64
"""Rays of each by which the best place is chosen; all say whether it is better."""
PARALLEL = 1e-12
"""Squared sine that lines are taken to meet at least by: places of parallel ones are finite, and lose."""
AT_ONCE = 1 << 17
"""Rays times places looked at together: bounds memory, changes nothing."""


def reseat(rays: Rays, x: dict[str, Tensor], loss: Loss, reach: float) -> dict[str, Tensor]:
    """Points, then cameras, where two of their rays put them, if that costs less; those whose rays all agree stay.

    Args:
        rays: All of them.
        x: Centres `c` and points `X`.
        loss: Of the squared sine of a ray.
        reach: Sine within which a ray agrees.
    """
    X = _reseat(x["X"], x["c"][rays.view], rays.point, -rays.v, rays.weights, loss, reach)
    return {"c": _reseat(x["c"], X[rays.point], rays.view, rays.v, rays.weights, loss, reach), "X": X}


def _reseat(
    own: Tensor, ends: Tensor, owner: Tensor, v: Tensor, weights: Tensor | None, loss: Loss, reach: float
) -> Float[Tensor, "n 3"]:
    """Of things with lines in directions v to `ends`."""
    # Coordinates apart: three of them side by side take several times as long.
    far, directions = ends.mT.contiguous(), v.mT.contiguous()

    def cost(place: Tensor, at: Tensor, ray: Tensor) -> Tensor:
        D = far.index_select(1, ray) - place.mT.contiguous().index_select(1, at)
        found = loss(_squared_sine(D, directions.index_select(1, ray)))
        return found if weights is None else weights[ray] * found

    square = _squared_sine(far - own.mT[:, owner], directions)
    doubtful = torch.bincount(owner[square > reach**2], minlength=len(own)) > 0
    order = doubtful[owner].nonzero()[:, 0]
    order = order[torch.argsort(_shuffled(v[order]), stable=True)]
    order = order[torch.argsort(owner[order], stable=True)]
    number = torch.bincount(owner[order], minlength=len(own))
    first = number.cumsum(0) - number
    pairs, judges = (number * (number - 1) // 2).clamp(max=PLACES), number.clamp(max=JUDGES)
    asked = (pairs > 0).nonzero()[:, 0]
    moved = own.clone()
    for some in torch.split(asked, torch.bincount((pairs * judges)[asked].cumsum(0) // AT_ONCE).tolist()):
        thing, count = (t[some] for t in (torch.arange(len(own), device=own.device), number))
        of, k = numbered(pairs[some])
        start, n = first[some][of], count[of]
        a, b = order[start + k % n], order[start + (k + 1 + k // n) % n]
        place = _meeting(ends[a], v[a], ends[b], v[b])
        at, judge = numbered(judges[some][of])
        total = place.new_zeros(len(place)).index_add_(0, at, cost(place, at, order[start[at] + judge]))
        least = total.new_full((len(some),), torch.inf).scatter_reduce_(0, of, total, "amin")
        best = (total == least[of]).nonzero()[:, 0]
        chosen = torch.full_like(some, len(of)).scatter_reduce_(0, of[best], best, "amin")
        at, judge = numbered(count)
        ray = order[first[some][at] + judge]
        gain = cost(own[some], at, ray) - cost(place[chosen], at, ray)
        better = gain.new_zeros(len(some)).index_add_(0, at, gain) > 0
        moved[thing[better]] = place[chosen[better]]
    return moved


def _squared_sine(D: Float[Tensor, "3 m"], v: Float[Tensor, "3 m"]) -> Float[Tensor, "m"]:
    """Of the angles between ways D and unit directions; one where these lead apart, as in `sine`."""
    x, y, z = D
    a, b, c = v
    across = (y * c - z * b).square_().add_((z * a - x * c).square_()).add_((x * b - y * a).square_())
    length = (x * x).addcmul_(y, y).addcmul_(z, z).clamp_(min=torch.finfo(D.dtype).tiny)
    return torch.where(x * a + y * b + z * c > 0, across / length, 1.0)


def numbered(count: Int[Tensor, "n"]) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"]]:
    """Of things that have so many parts each: for all parts, the thing, and the place among its parts."""
    of = torch.arange(len(count), device=count.device).repeat_interleave(count)
    return of, torch.arange(len(of), device=count.device) - (count.cumsum(0) - count)[of]


def _shuffled(v: Float[Tensor, "m 3"]) -> Float[Tensor, "m"]:
    """Numbers in whose order rays are as if drawn at random, in whatever order they are given."""
    return (v @ v.new_tensor([1237.0, 2741.0, 4519.0])).frac()


def _meeting(a: Tensor, u: Tensor, b: Tensor, v: Tensor) -> Float[Tensor, "k 3"]:
    """The point nearest to two lines, through points in unit directions."""
    along = (u * v).sum(-1, keepdim=True)
    apart = b - a
    first, second = (apart * u).sum(-1, keepdim=True), (apart * v).sum(-1, keepdim=True)
    square = (1 - along * along).clamp(min=PARALLEL)
    return (a + b + ((first - along * second) * u + (along * first - second) * v) / square) / 2
