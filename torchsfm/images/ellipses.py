"""Ellipses of images: bent arcs of edges that belong together, with what their edge points say of their place."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, check_options
from torchsfm.geometry import Ellipse, ellipse_distance
from torchsfm.geometry.conics import ellipse_of_shape
from torchsfm.images.arc_ends import arc_ends
from torchsfm.images.edge_chains import chains_of
from torchsfm.images.edges import detect_edges
from torchsfm.images.ellipse_moments import conic_moments, ellipse_of_moments, residual
from torchsfm.images.ellipse_support import Support, crowded, edge_map, find_support, keep_the_best
from torchsfm.images.elliptic_arcs import Arcs, compatible_pairs, find_arcs
from torchsfm.images.false_alarms import CHANCE, log_tail
from torchsfm.images.fit_ellipse import fit_ellipse
from torchsfm.images.slots import lay_in_slots

_LEAST_TURN = 0.3
"""Of an arc that anything is made of, in radians."""
_ENOUGH = 0.8
"""Turn from which an arc, or a pair of them, tells an ellipse."""
_MOST_ARCS = 300
"""Arcs of an image, the longest ones, of which pairs are tried."""
_OFF = 1.0
"""Root-mean-square distance from which arcs are not of one ellipse, in pixels."""
_REACHES = (2, 1, 1)
"""How far from a first, a second and a third ellipse edge points are looked for, in pixels."""
_UNSURE = 0.05
"""Largest standard deviation of a semi-axis, relative to it."""
_EXACT = 0.02
"""Errors of edge points without noise, in pixels."""
_BENT = 4.5
"""Distances that edge points do not have by chance, in units of their median: three standard deviations."""
_CROWDED = 0.75
"""Share of edge points next to other edges up to which they are left out."""
_ROUNDS = 2
"""Fits that are made to leave out edge points, """
_FEW = 3
"""each with so many steps."""
_FIRST = 0.5
"""The part of the coverage wanted in the end that arcs, and first ellipses, must have."""
_END = 8
"""Decimal digits of false alarms that each end of an arc costs, times the share of the outline that is not seen,"""
_SMOOTH_END = 20
"""and each more where the edge goes smoothly on."""
_SHARED = 0.5
"""The share of an ellipse's edge points from which on it is another one, seen again."""


@dataclass(frozen=True)
class Ellipses:
    """Ellipses of images, in slots of which the first ones are `valid`, the most edge points first; zero in empty slots.

    Example:
        >>> import torch, torchsfm
        >>> disc = torchsfm.Ellipse(torch.tensor([60.0, 45.0]), torch.tensor([30.0, 20.0]), torch.tensor(0.3))
        >>> image = torchsfm.simulation.paint_shapes([disc], torch.tensor([0.2, 0.9]), width=120, height=90)
        >>> found = torchsfm.detect_ellipses(image)
        >>> best = found.ellipse.centre[found.valid][0]
        >>> bool((best - disc.centre).norm() < 0.1), bool(found.coverage[0] > 0.9)  # nearly all of the outline was seen
        (True, True)
        >>> found.covariance.shape[-2:], bool(found.scatter[0] < 0.1)  # pixels
        (torch.Size([5, 5]), True)
    """

    ellipse: Ellipse
    """In pixels, batch (*batch, n)."""
    covariance: Float[Tensor, "*batch n 5 5"]
    """Of centre, semi-axes and angle, in this order, by the image's noise or by the scatter of the edge points if that is
    larger; that neighbouring edge points are tied together by smoothing is counted in."""
    count: Int[Tensor, "*batch n"]
    """Number of edge points."""
    coverage: Float[Tensor, "*batch n"]
    """The share of the outline that edge points cover."""
    scatter: Float[Tensor, "*batch n"]
    """Root-mean-square distance of the edge points from the ellipse, in pixels."""
    contrast: Float[Tensor, "*batch n"]
    """Mean gradient along the outward normal, in image values per pixel: negative where the inside is brighter."""
    log_nfa: Float[Tensor, "*batch n"]
    """Decimal logarithm of the number of as good ellipses to be expected in noise (Desolneux, Moisan and Morel 2000)."""
    valid: Bool[Tensor, "*batch n"]


def detect_ellipses(
    image: Float[Tensor, "*#batch c h w"],
    max_ellipses: int = 200,
    *,
    min_coverage: float = 0.25,
    min_radius: float = 2.0,
    max_scatter: float = 0.15,
    tolerance: float = 0.15,
    blur: float = 1.0,
    low: float = 0.004,
    high: float = 0.01,
    noise: float | None = None,
    mask: Bool[Tensor, "*#batch h w"] | None = None,
) -> Ellipses:
    """Ellipses of each image, whole or in part, from linked edges (`detect_edges`).

    Chains are cut into arcs that bend to one side. Arcs, and pairs of arcs that may be of one convex curve, give ellipses, all
    in one batch; each takes up the edge points next to it, is fitted again, and is kept where that many gradients along its
    normals are not to be expected in noise and where the edge points are not those of a better one. Where an ellipse is seen in
    part, ends of its arcs count against it, and more so those where the edge goes on without a corner, as a smooth curve does
    that an ellipse only touches. What is left is fitted by orthogonal distances.

    Args:
        image: Grey (c = 1) or red, green, blue images.
        max_ellipses: The number of slots for each image, for those with the most edge points.
        min_coverage: Smallest share of the outline that edge points cover. Folds of cloth and other smooth curves look like
            parts of ellipses, and some still are taken for them: where whole ones are wanted, ask for 0.9.
        min_radius: Smallest semi-axis, in pixels.
        max_scatter: Root-mean-square distance of the edge points from the ellipse, in pixels, that is not noise but does no
            harm either; as much less as less of the outline is seen.
        tolerance: Root-mean-square deviation from straightness of the straight runs that arcs are made of, in pixels.
        blur: As in `detect_edges`.
        low: As in `detect_edges`.
        high: As in `detect_edges`.
        noise: As in `detect_edges`.
        mask: Where edges may be.

    Returns:
        The ellipses. An image without any has none valid.

    Raises:
        ValueError: A shape or an option is wrong.

    Example:
        >>> import torch, torchsfm
        >>> disc = torchsfm.Ellipse(torch.tensor([60.0, 45.0]), torch.tensor([30.0, 20.0]), torch.tensor(0.3))
        >>> image = torchsfm.simulation.paint_shapes([disc], torch.tensor([0.2, 0.9]), width=120, height=90)
        >>> found = torchsfm.detect_ellipses(image)
        >>> found.valid.sum(), found.ellipse.semi_axes[0].round()
        (tensor(1), tensor([30., 20.]))
    """
    check_options(
        max_ellipses=(max_ellipses, "int >= 1"), min_coverage=(min_coverage, "0 <= float <= 1"),
        min_radius=(min_radius, "float > 0"), max_scatter=(max_scatter, "float > 0"), tolerance=(tolerance, "float > 0"),
    )  # fmt: skip
    edges = detect_edges(image, blur=blur, low=low, high=high, noise=noise, mask=mask)
    batch, slots = edges.valid.shape[:-1], edges.valid.shape[-1]
    size = (batch.numel(), *image.shape[-2:])
    place = edges.valid.flatten().nonzero()[:, 0]
    of_image = place // slots
    x, gradient = (v.reshape(-1, 2)[place].double() for v in (edges.x, edges.gradient))
    variance, closed = edges.sigma.flatten()[place].double().square(), edges.closed.flatten()[place]
    chain = edges.chain.flatten()[place] + of_image * (slots + 1)
    arcs = find_arcs(x, variance, chain, closed, of_image, tolerance)
    frame = _Frame(x.new_tensor([size[2] - 1, size[1] - 1]) / 2, math.hypot(*size[1:]) / 2)
    ellipse, of = _from_arcs(x, arcs, frame, min_radius, _FIRST * min_coverage)
    edgels = edge_map(x, gradient, of_image, size)
    for reach in _REACHES[:-1]:
        support = find_support(ellipse, of, edgels, reach)
        ellipse, good = _again(x, support, len(of), frame, min_radius)
        good &= support.coverage >= _FIRST * min_coverage
        ellipse, of = _chosen(ellipse, good), of[good]
    support = find_support(ellipse, of, edgels, _REACHES[-1])
    found = _judge(support, len(of), math.log10(size[1] * size[2]))
    good = (found["coverage"] >= min_coverage) & (found["log_nfa"] <= 0) & (found["count"] > 5)
    ends = arc_ends(support.chosen(good[support.ellipse]), edgels, chains_of(chain, closed))
    good &= found["log_nfa"] + (1 - found["coverage"]) * (_END * ends.all + _SMOOTH_END * ends.smooth) <= 0
    rank = torch.argsort(torch.where(good, -found["coverage"] * found["count"], 1.0), stable=True).argsort()
    support = support.chosen(good[support.ellipse] & support.aligned)
    kept = keep_the_best(rank, support, len(x), _SHARED)
    found = {name: values[kept] for name, values in found.items()}
    moved = crowded(edgels, of_image, edges.width.flatten()[place].double())
    # The shorter an arc is, the better an ellipse fits it whatever it is of.
    most = max_scatter * found["coverage"]
    more, good = _refined(x, variance, support, moved, kept, 2 * math.sqrt(math.pi) * blur, most)
    good &= more["semi_axes"][:, 1] >= min_radius
    found |= more
    laid = lay_in_slots(found, good, found["count"].double(), of[kept], batch, max_ellipses, image.dtype)
    return Ellipses(Ellipse(*(laid.pop(name) for name in ("centre", "semi_axes", "angle"))), **laid)


@dataclass(frozen=True)
class _Frame:
    """Coordinates of size 1, in which sums of fourth powers keep their digits."""

    middle: Tensor
    scale: float

    def moments(self, x: Tensor, number: Tensor, sets: int) -> Tensor:
        return conic_moments((x - self.middle) / self.scale, number, sets)

    def ellipses(self, M: Tensor, min_radius: float) -> tuple[Ellipse, Tensor, Tensor]:
        """In pixels, which are neither too small nor larger than the image, and their conics in this frame."""
        centre, D, good, v = ellipse_of_moments(M)
        shape = ellipse_of_shape(centre, D)
        axes = self.scale * shape.semi_axes
        good = good & (axes[:, 1] >= 0.7 * min_radius) & (axes[:, 0] <= 2 * self.scale) & (centre.abs() <= 3).all(-1)
        return Ellipse(self.middle + self.scale * centre, axes, shape.angle), good, v


def _from_arcs(x: Tensor, arcs: Arcs, frame: _Frame, min_radius: float, least: float) -> tuple[Ellipse, Tensor]:
    """Ellipses of arcs and pairs of arcs, and their images."""
    bent = arcs.turn.abs() >= _LEAST_TURN
    new = bent.long().cumsum(0) - 1
    chosen = bent[arcs.number]
    M = frame.moments(x[chosen], new[arcs.number[chosen]], int(bent.sum()))
    arcs = Arcs(new[arcs.number], *(v[bent] for v in arcs[1:]))
    single = (arcs.turn.abs() >= _ENOUGH).nonzero()
    pairs = torch.cat((single.expand(-1, 2), compatible_pairs(arcs, _ENOUGH, _MOST_ARCS)))
    alone = pairs[:, 0] == pairs[:, 1]
    ellipse, good, v = frame.ellipses(M[pairs[:, 0]] + torch.where(alone[:, None, None], 0.0, M[pairs[:, 1]]), min_radius)
    off = torch.stack([residual(M[pairs[:, k]], v) for k in (0, 1)]).amax(0) * frame.scale
    good &= off <= _OFF
    # Edge points are a pixel apart or a little more.
    around = 2 * math.pi * ellipse.semi_axes.square().mean(-1).sqrt()
    edgels = arcs.edgels[pairs[:, 0]] + torch.where(alone, 0, arcs.edgels[pairs[:, 1]])
    good &= edgels >= least * around
    return _chosen(ellipse, good), arcs.image[pairs[good, 0]]


def _again(x: Tensor, support: Support, n: int, frame: _Frame, min_radius: float) -> tuple[Ellipse, Tensor]:
    """Ellipses of the aligned edge points."""
    rows = support.aligned
    ellipse, good, _ = frame.ellipses(frame.moments(x[support.edgel[rows]], support.ellipse[rows], n), min_radius)
    return ellipse, good & (support.ellipse[rows].bincount(minlength=n) > 5)


def _judge(support: Support, n: int, log_pixels: float) -> dict[str, Tensor]:
    near, k = (rows.bincount(minlength=n) for rows in (support.ellipse, support.ellipse[support.aligned]))
    out = support.ellipse[support.aligned & (support.outward > 0)].bincount(minlength=n)
    one = torch.maximum(out, k - out)
    # Five numbers of an ellipse, to a pixel each: 2.5 powers of the number of pixels. Inside or outside is the bright side, or
    # either in turn.
    tail = [log_tail(hits.double(), near.double(), chance) for hits, chance in ((one, CHANCE), (k, 2 * CHANCE))]
    log_nfa = 2.5 * log_pixels + math.log10(3) + torch.minimum(*tail)
    across = torch.where(support.aligned, support.outward, 0.0)
    contrast = across.new_zeros(n).index_add(0, support.ellipse, across) / k.clamp_min(1)
    return {"count": k, "coverage": support.coverage, "contrast": contrast, "log_nfa": log_nfa}


def _refined(
    x: Tensor, variance: Tensor, support: Support, moved: Tensor, kept: Tensor, tied: float, scatter: Tensor
) -> tuple[dict[str, Tensor], Tensor]:
    """Ellipses of least orthogonal distances to edge points that other edges have not `moved`, and which are determined."""
    rows = kept[support.ellipse]
    new = kept.long().cumsum(0) - 1
    of, edgel = new[support.ellipse[rows]], support.edgel[rows]
    n = int(kept.sum())
    count = of.bincount(minlength=n)
    width = max(int(count.max()) if n else 0, 5)
    slot = torch.arange(len(of), device=of.device) - (count.cumsum(0) - count)[of]
    points, weights = x.new_zeros(n, width, 2), x.new_zeros(n, width)
    points[of, slot] = x[edgel]
    weights[of, slot] = 1 / (variance[edgel] + _EXACT**2)
    for wrong, most in ((~support.inner[rows], 0.5), (moved[edgel], _CROWDED)):
        bent = torch.zeros_like(weights, dtype=torch.bool)
        bent[of, slot] = wrong
        some = (bent & (weights > 0)).sum(-1, keepdim=True) < most * (weights > 0).sum(-1, keepdim=True, dtype=weights.dtype)
        weights = torch.where(bent & some, 0.0, weights)
    near = weights
    for _ in range(_ROUNDS):
        first = fit_ellipse(points, weights=weights, max_iterations=_FEW)
        # Where another edge meets it, it is bent.
        away = ellipse_distance(first.model, points).abs()
        typical = torch.where(weights > 0, away, torch.nan).nanmedian(-1).values.nan_to_num()
        weights = torch.where(away <= (_BENT * typical).clamp_min(_EXACT)[:, None], near, 0.0)
    count = (weights > 0).sum(-1)
    fit = fit_ellipse(points, weights=weights)
    # What the edge points scatter more than by noise is as noise.
    excess = fit.error.square() * weights.sum(-1) / (count - 5).clamp_min(1)
    covariance = fit.covariance * (tied * excess.clamp_min(1.0))[:, None, None]
    model = fit.model
    sure = (covariance.diagonal(dim1=-2, dim2=-1)[:, 2:4].sqrt() <= _UNSURE * model.semi_axes).all(-1)
    noise = count / weights.sum(-1)
    sure &= fit.error.square() <= scatter.square() + 4 * noise
    return {
        "centre": model.centre, "semi_axes": model.semi_axes, "angle": model.angle, "covariance": covariance,
        "scatter": fit.error,
    }, (fit.status == Status.OK) & sure  # fmt: skip


def _chosen(ellipse: Ellipse, rows: Tensor) -> Ellipse:
    return Ellipse(ellipse.centre[rows], ellipse.semi_axes[rows], ellipse.angle[rows])
