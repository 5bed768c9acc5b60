"""Curves in space of a model: samples in order, and the edge points of images that show them."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_index, check_options, check_tensors, tensor_map
from torchsfm.bundle import BundleCurves
from torchsfm.geometry import Curve, Similarity, Spline, fit_spline
from torchsfm.optim import Loss


@dataclass(frozen=True)
class Curves:
    """Curves in space, sample by sample, and their tracks: the edge points of images next to which samples are seen.

    Example:
        >>> import torch, torchsfm
        >>> angle = torch.arange(100).double() * (torch.pi / 50)
        >>> circle = torch.stack((angle.cos(), angle.sin(), 0 * angle), -1)
        >>> X = torch.cat((circle, circle[:51] + 3))  # a circle, and half of one beside it
        >>> curve = (torch.arange(151) >= 100).long()
        >>> none, empty = torch.zeros(0, dtype=torch.int64), torch.zeros(0).double()  # measured nowhere
        >>> ones, seen = torch.ones(151, 3).double(), (empty.reshape(0, 2), empty.reshape(0, 2), empty, empty, none, none)
        >>> curves = torchsfm.reconstruction.Curves(X, curve, torch.tensor([True, False]), ones, ones[:, 0], *seen)
        >>> curves.number, curves.length()  # around the circle, from end to end of the other
        (tensor([100,  51]), tensor([6.2822, 3.1411], dtype=torch.float64))
        >>> spline = curves.select(torch.tensor([False, True])).splines(tolerance=1e-3)[0]
        >>> spline.control.shape  # instead of 51 samples
        torch.Size([8, 3])
    """

    X: Float[Tensor, "n 3"]
    """Samples in the world: those of a curve in order, after those of the curve before."""
    curve: Int[Tensor, "n"]
    """Curve of each sample, ascending."""
    closed: Bool[Tensor, "c"]
    """Whether the last sample of a curve is next to the first."""
    color: Float[Tensor, "n 3"]
    """Red, green, blue in [0, 1] of each sample."""
    sigma: Float[Tensor, "n"]
    """Standard deviation of each sample across the curve for noise of one pixel in the images that see it from one image's
    edge; those of several images were averaged."""
    x: Float[Tensor, "k 2"]
    """Edge points, pixels."""
    normal: Float[Tensor, "k 2"]
    """Unit normals of the edges there."""
    curvature: Float[Tensor, "k"]
    """Of the edges, 1/pixel, positive where they bend to the normal."""
    weight: Float[Tensor, "k"]
    """Inverse variance across the edge of what each edge point says of the curve that none beside it says."""
    view: Int[Tensor, "k"]
    """Image of each edge point."""
    sample: Int[Tensor, "k"]
    """Sample of each edge point."""

    def __post_init__(self) -> None:
        check_tensors(
            X=(self.X, "n 3"), curve=(self.curve, "n: int"), closed=(self.closed, "c: bool"), color=(self.color, "n 3"),
            sigma=(self.sigma, "n"), x=(self.x, "k 2"), normal=(self.normal, "k 2"), curvature=(self.curvature, "k"),
            weight=(self.weight, "k"), view=(self.view, "k: int"), sample=(self.sample, "k: int"),
        )  # fmt: skip
        check_index(curve=(self.curve, len(self.closed)), sample=(self.sample, len(self.X)))
        if not bool((self.curve.diff() >= 0).all()):
            raise ValueError("curve: wanted ascending numbers, got others")

    def __len__(self) -> int:
        """Number of curves."""
        return len(self.closed)

    @property
    def number(self) -> Int[Tensor, "c"]:
        """How many samples each curve has."""
        return torch.bincount(self.curve, minlength=len(self))

    def rows(self) -> Curve:
        """The curves with their samples in slots, a row each."""
        number = self.number
        slot = torch.arange(len(self.X), device=self.X.device) - (number.cumsum(0) - number)[self.curve]
        most = max(2, int(number.amax())) if len(self) else 2
        x, valid = self.X.new_zeros(len(self), most, 3), torch.zeros(len(self), most, dtype=torch.bool, device=self.X.device)
        x[self.curve, slot], valid[self.curve, slot] = self.X, True
        return Curve(x, valid, self.closed)

    def tangents(self) -> Float[Tensor, "n 3"]:
        """Unit tangents at the samples, forwards."""
        rows = self.rows()
        return rows.tangents()[rows.valid]

    def links(self) -> Int[Tensor, "s 2"]:
        """Each sample and the next one of its curve."""
        number = self.number
        first = number.cumsum(0) - number
        own = torch.arange(len(self.X), device=self.X.device)
        last = own + 1 == (first + number)[self.curve]
        there = ~last | (self.closed & (number > 2))[self.curve]
        return torch.stack((own, torch.where(last, first[self.curve], own + 1)), -1)[there]

    def length(self) -> Float[Tensor, "c"]:
        """The length of the polygon through the samples of each curve."""
        a, b = self.links().unbind(-1)
        apart = torch.linalg.vector_norm(self.X[b] - self.X[a], dim=-1)
        return self.X.new_zeros(len(self)).index_add(0, self.curve[a], apart)

    def support(self) -> Int[Tensor, "n"]:
        """Number of images that show each sample."""
        pairs = torch.unique(torch.stack((self.sample, self.view)), dim=1)
        return torch.bincount(pairs[0], minlength=len(self.X))

    def splines(self, tolerance: float) -> list[Spline]:
        """A cubic B-spline for each curve, of as few control points, by doubling, as leave no sample farther away than this."""
        check_options(tolerance=(tolerance, "float > 0"))
        parts = torch.split(self.X, self.number.tolist())
        return [_spline(x, closed, tolerance) for x, closed in zip(parts, self.closed.tolist(), strict=True)]

    def select(self, keep: Bool[Tensor, "c"]) -> "Curves":
        """Some of the curves, with what images show of them."""
        own = keep[self.curve]
        seen = self.seen_where(own[self.sample])
        return replace(
            seen, X=self.X[own], curve=(keep.cumsum(0) - 1)[self.curve[own]], closed=self.closed[keep],
            color=self.color[own], sigma=self.sigma[own], sample=(own.cumsum(0) - 1)[seen.sample],
        )  # fmt: skip

    def runs_where(self, keep: Bool[Tensor, "n"]) -> "Curves":
        """Some of the samples: each run of neighbours is a curve, which closes only where a closed curve is there whole."""
        number = self.number
        first = number.cumsum(0) - number
        own = torch.arange(len(self.X), device=self.X.device)
        whole = torch.ones_like(self.closed).index_fill(0, self.curve[~keep], value=False)
        # A closed curve is cut where it lacks a sample, so that no run goes on around its end.
        cut = (first + number).scatter_reduce(0, self.curve[~keep], own[~keep], "amin")
        cut = torch.where(self.closed & ~whole, cut, first)
        order = torch.argsort(first[self.curve] + (own - cut[self.curve]) % number[self.curve])
        order = order[keep[order]]
        linked = torch.zeros_like(order, dtype=torch.bool)
        if len(order) > 1:
            before, after, of = order[:-1], order[1:], self.curve[order]
            last = (first + number - 1)[of[:-1]]
            linked[1:] = (of[1:] == of[:-1]) & (torch.where(before == last, first[of[:-1]], before + 1) == after)
        run = (~linked).cumsum(0) - 1
        place = torch.empty_like(own).index_copy(0, order, torch.arange(len(order), device=own.device))
        seen = self.seen_where(keep[self.sample])
        return replace(
            seen, X=self.X[order], curve=run, closed=(self.closed & whole)[self.curve[order[~linked]]],
            color=self.color[order], sigma=self.sigma[order], sample=place[seen.sample],
        )  # fmt: skip

    def seen_where(self, keep: Bool[Tensor, "k"]) -> "Curves":
        """All curves, with some of the edge points."""
        return replace(self, **{name: getattr(self, name)[keep] for name in TRACKS})

    def arcs(self) -> Float[Tensor, "k 3 2"]:
        """Three points of each edge, a pixel apart, of which the second is the edge point."""
        ahead = torch.stack((self.normal[:, 1], -self.normal[:, 0]), -1)
        on = torch.tensor([-1.0, 0.0, 1.0], dtype=self.x.dtype, device=self.x.device)[:, None]
        return (
            self.x[:, None] + on * ahead[:, None] + (0.5 * on.square() * self.curvature[:, None, None]) * self.normal[:, None]
        )

    def shown_as(self, arcs: Float[Tensor, "k 3 2"]) -> "Curves":
        """The same where other images show the `arcs` elsewhere; of variances it is the change of size that counts."""
        before, x, after = arcs.unbind(1)
        first, second = (after - before) / 2, after - 2 * x + before
        size = torch.linalg.vector_norm(first, dim=-1, keepdim=True).clamp_min(1e-300)
        normal = torch.stack((-first[:, 1], first[:, 0]), -1) / size
        curvature = (normal * second).sum(-1) / size[:, 0].square()
        return replace(self, x=x, normal=normal, curvature=curvature, weight=self.weight / size[:, 0].square())

    def in_images(self, view: Int[Tensor, "v"], zoom: Float[Tensor, "v 2"]) -> "Curves":
        """The same where each image has another number, and so many times the pixels along x and y."""
        arcs = (self.arcs().double() + 0.5) * zoom.double()[self.view, None] - 0.5
        return replace(self.shown_as(arcs.to(self.x)), view=view[self.view])

    def detached(self) -> "Curves":
        """The same as plain numbers on the CPU."""
        return tensor_map(lambda t: t.detach().cpu(), self)

    def transform(self, similarity: Similarity) -> "Curves":
        """The same curves in another world frame."""
        return replace(self, X=similarity.transform(self.X), sigma=self.sigma * similarity.scale)

    def bundle(self, *, unit: float = 1.0, loss: Loss | None = None) -> BundleCurves:
        """As a part of a bundle in which an observation of a point has the standard deviation `unit`, pixels."""
        return BundleCurves(
            self.X, self.tangents(), self.x, self.normal, self.view, self.sample, self.curvature,
            weights=self.weight * unit**2, loss=loss,
        )  # fmt: skip

    def adjusted(self, structure: BundleCurves) -> "Curves":
        """The same where that part of a bundle was moved to."""
        return replace(self, X=structure.X)


TRACKS = ("x", "normal", "curvature", "weight", "view", "sample")
"""The members of which each edge point has one."""


def _spline(x: Float[Tensor, "n 3"], closed: bool, tolerance: float) -> Spline:
    curve = Curve(x, torch.ones(len(x), dtype=torch.bool, device=x.device), torch.tensor(closed, device=x.device))
    controls = 4
    while True:
        spline, gap = fit_spline(curve, controls, closed=closed)
        if float(gap.amax()) <= tolerance or 2 * controls > len(x):
            return spline
        controls *= 2
