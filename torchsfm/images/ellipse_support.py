"""Which edge points are on an ellipse, and how much of its outline do they cover?"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import Ellipse
from torchsfm.geometry.conics import shape_of_ellipse
from torchsfm.images.false_alarms import aligned

_BENT = 3
"""How far edges are bent by others that they meet, in pixels."""
_CLEAR = 4.5
"""From how far on edges do not move each other, in widths of their profiles: by 4 e^-10 of these."""
_STEP = 0.5
"""In which other edges are looked for, in pixels, """
_NEAREST = 2.0
"""and from where: edges that are nearer are one."""
_BORDER = 4.0
"""Where there are no edges, in pixels from the border."""


class EdgeMap(NamedTuple):
    """Edge points of images, and which one each pixel has."""

    x: Float[Tensor, "n 2"]
    gradient: Float[Tensor, "n 2"]
    at: Int[Tensor, "images h w"]
    """-1 where there is none."""


class Support(NamedTuple):
    """Edge points near ellipses, one row for each of them and each ellipse, by ellipse."""

    ellipse: Int[Tensor, " rows"]
    edgel: Int[Tensor, " rows"]
    aligned: Bool[Tensor, " rows"]
    """Whether the gradient points along the ellipse's normal, to whichever side."""
    inner: Bool[Tensor, " rows"]
    """Whether it is aligned and not where what is seen of the outline ends: there other edges bend it."""
    outward: Float[Tensor, " rows"]
    """The gradient's part along the outward normal."""
    coverage: Float[Tensor, " ellipses"]
    """The share of the outline, by length, next to aligned edge points."""

    def chosen(self, rows: Bool[Tensor, " rows"]) -> "Support":
        """Of some rows only."""
        return Support(
            self.ellipse[rows], self.edgel[rows], self.aligned[rows], self.inner[rows], self.outward[rows], self.coverage
        )


def edge_map(
    x: Float[Tensor, "n 2"], gradient: Float[Tensor, "n 2"], image: Int[Tensor, " n"], shape: tuple[int, int, int]
) -> EdgeMap:
    """A map of edge points at (images, height, width)."""
    column, row = x.detach().round().long().unbind(-1)
    place = (image * shape[1] + row.clamp(0, shape[1] - 1)) * shape[2] + column.clamp(0, shape[2] - 1)
    at = torch.full((math.prod(shape),), -1, dtype=torch.long, device=x.device)
    own = torch.arange(len(x), device=x.device)
    # Of two at one pixel the later one, on every device.
    at = at.scatter_reduce(0, place, own, "amax")
    return EdgeMap(x, gradient, at.reshape(shape))


def crowded(edges: EdgeMap, image: Int[Tensor, " n"], width: Float[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """Whether there is another edge across so near that smoothing moves both.

    The gradients of two edges add: their tops are moved apart, or towards each other.

    Args:
        edges: The edge points.
        image: Which image each is in.
        width: Of the profile of each.
    """
    h, w = edges.at.shape[1:]
    reach = _CLEAR * width
    normal = torch.nn.functional.normalize(edges.gradient, dim=-1)
    found = torch.zeros_like(image, dtype=torch.bool)
    number = int(float(reach.max() - _NEAREST) / _STEP) + 1 if len(reach) else 0
    for k in range(number):
        away = _NEAREST + _STEP * k
        for side in (-away, away):
            column, row = (edges.x + side * normal).round().long().unbind(-1)
            inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
            place = (image * h + row.clamp(0, h - 1)) * w + column.clamp(0, w - 1)
            found |= inside & (away <= reach) & (edges.at.flatten()[place] >= 0)
    return found


def find_support(ellipses: Ellipse, image: Int[Tensor, " n"], edges: EdgeMap, reach: int) -> Support:
    """Walk along ellipses, a pixel at a time, and take the edge points that are met within so many pixels to both sides."""
    h, w = edges.at.shape[1:]
    axes = ellipses.semi_axes
    steps = (2 * math.pi * axes[:, 0]).ceil().long().clamp_min(16)
    of = torch.repeat_interleave(torch.arange(len(steps), device=steps.device), steps)
    rank = torch.arange(len(of), device=of.device) - (steps.cumsum(0) - steps)[of]
    t = rank * (2 * math.pi / steps[of].to(axes.dtype))
    x = Ellipse(ellipses.centre[of], axes[of], ellipses.angle[of]).points(t[:, None])[:, 0]
    weight = ((axes[of, 0] * t.sin()).square() + (axes[of, 1] * t.cos()).square()).sqrt()
    inside = ((x >= _BORDER) & (x <= x.new_tensor([w, h]) - 1 - _BORDER)).all(-1)
    total = weight.new_zeros(len(steps)).index_add(0, of, weight)
    of, x, weight = of[inside], x[inside], weight[inside]
    inverse = torch.linalg.inv_ex(shape_of_ellipse(ellipses)).inverse
    normal = torch.nn.functional.normalize((inverse[of] @ (x - ellipses.centre[of])[..., None])[..., 0], dim=-1)
    offset = torch.arange(-reach, reach + 1, device=x.device)
    column, row = ((x[:, None, k] + offset * normal[:, None, k]).round().long() for k in (0, 1))
    place = (image[of, None] * h + row.clamp_(0, h - 1)) * w + column.clamp_(0, w - 1)
    edgel = edges.at.flatten()[place]
    step = (edgel >= 0).nonzero()[:, 0]
    edgel = edgel[edgel >= 0]
    met = _dot(edges.x[edgel] - x[step], normal[step]).abs() <= reach
    step, edgel = step[met], edgel[met]
    gradient = edges.gradient[edgel]
    outward = _dot(gradient, normal[step])
    along = aligned(outward.abs(), gradient)
    hit = torch.zeros_like(of, dtype=torch.bool).index_fill(0, step[along], True)
    # Edge points of slanted edges are more than a step apart.
    hit = hit | _next(hit, of, 1) | _next(hit, of, -1)
    ends = ~hit
    for k in range(1, _BENT + 1):
        ends = ends | _next(~hit, of, k) | _next(~hit, of, -k)
    coverage = total.new_zeros(total.shape).index_add(0, of, weight * hit) / total
    number = max(len(edges.x), 1)
    key, back = torch.unique(of[step] * number + edgel, return_inverse=True)

    def total_of(values: Tensor) -> Tensor:
        """Next to each other on the ellipse, several steps meet an edge point."""
        return torch.zeros(len(key), dtype=x.dtype, device=x.device).index_add(0, back, values.to(x.dtype))

    agrees, inner = total_of(along) > 0, total_of(along & ~ends[step]) > 0
    outward = total_of(outward) / total_of(torch.ones_like(along))
    return Support(key // number, key % number, agrees, inner, outward, coverage)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]


def _next(flags: Tensor, of: Tensor, steps: int) -> Tensor:
    """The flag so many steps before on the same ellipse."""
    return flags.roll(steps) & (of.roll(steps) == of)


def keep_the_best(rank: Int[Tensor, " n"], support: Support, edgels: int, most: float) -> Bool[Tensor, " n"]:
    """Going by rank, the ellipses of whose edge points no more than the share `most` is on better ones that stay."""
    n = len(rank)
    size = support.ellipse.bincount(minlength=n)
    undecided = size > 0
    kept = torch.zeros_like(undecided)
    taken = torch.zeros(edgels, dtype=torch.bool, device=rank.device)
    while bool(undecided.any()):
        rows = undecided[support.ellipse] & ~taken[support.edgel]
        ellipse, edgel = support.ellipse[rows], support.edgel[rows]
        first = torch.full((edgels,), n, dtype=torch.long, device=rank.device)
        first = first.scatter_reduce(0, edgel, rank[ellipse], "amin")
        beaten = torch.zeros(n, dtype=torch.long, device=rank.device)
        beaten = beaten.index_add(0, ellipse, (first[edgel] < rank[ellipse]).long())
        best = undecided & (beaten == 0)
        kept |= best
        undecided = undecided & ~best
        taken[support.edgel[best[support.ellipse]]] = True
        lost = torch.zeros(n, dtype=torch.long, device=rank.device).index_add(0, support.ellipse, taken[support.edgel].long())
        undecided &= lost <= most * size.double()
    return kept
