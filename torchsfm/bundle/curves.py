"""Curves of space in a bundle: samples of them, which move across, against points of their images, whatever the lens does.

Where along an image curve a sample is seen says nothing: a row is the distance of its image from the circle that touches the
image curve at a point nearby and is as much bent. The foot on the circle needs no search, and moves along as the sample does.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import broadcast_shapes, check_index, check_options, check_tensors
from torchsfm.bundle.structure import Sight
from torchsfm.geometry import Camera, Pose, Similarity
from torchsfm.linalg.vectors import across
from torchsfm.optim import Block, Loss, Term

_TINY = 1e-300


@dataclass(frozen=True)
class BundleCurves:
    """Samples of space curves, and points of the image curves that views show of them.

    A sample is free in two directions, across its curve, so that it takes three views to tell something of the cameras. Samples
    without observations, without a direction, or that are fixed, come back bit for bit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> truth = torchsfm.random_bundle_problem(4, 50, 100, layout="dome", noise=0.0, generator=g).truth
        >>> X, along = truth.X[:20], truth.X[20:40] - truth.X[:20]  # points of curves, and where these go on
        >>> x, ahead = (torchsfm.project_points(truth.poses, p, truth.cameras).flatten(0, 1) for p in (X, X + 1e-4 * along))
        >>> normal = torch.stack((x[:, 1] - ahead[:, 1], ahead[:, 0] - x[:, 0]), -1)
        >>> view, sample = torch.arange(4).repeat_interleave(20), torch.arange(20).repeat(4)
        >>> curves = torchsfm.BundleCurves(X, along, x, normal, view, sample)
        >>> found = torchsfm.bundle_adjust(truth, structure=(curves,), max_iterations=1)
        >>> found.structure[0].X.shape, bool(found.structure_residuals[0].abs().max() < 1e-3)  # pixels
        (torch.Size([20, 3]), True)
    """

    X: Float[Tensor, "n 3"]
    """Samples in the world."""
    tangent: Float[Tensor, "n 3"]
    """Directions of the curves there, of any length."""
    x: Float[Tensor, "k 2"]
    """Points of image curves, pixels, next to where samples are seen."""
    normal: Float[Tensor, "k 2"]
    """Normals of the image curves there, of any length."""
    view: Int[Tensor, "k"]
    """Which view shows each of them."""
    sample: Int[Tensor, "k"]
    """Which sample it shows."""
    curvature: Float[Tensor, "k"] | None = None
    """Of the image curves, 1/pixel, positive where they bend to the normal; straight if not given."""
    fixed: Bool[Tensor, "n"] | None = None
    """Samples that do not move."""
    weights: Float[Tensor, "k"] | None = None
    """Factors of the squared distances: inverse variances, in the unit in which observations of points weigh 1; 0 leaves one
    out."""
    loss: Loss | None = None
    """Robust loss of the squared distance, pixels."""
    block = "curve"
    follows_world = False
    """Samples move across their curves alone."""

    def __post_init__(self) -> None:
        check_tensors(
            X=(self.X, "n 3"), tangent=(self.tangent, "n 3"), x=(self.x, "k 2"), normal=(self.normal, "k 2"),
            view=(self.view, "k: int"), sample=(self.sample, "k: int"), curvature=(self.curvature, "?k"),
            fixed=(self.fixed, "?n: bool"), weights=(self.weights, "?k"),
        )  # fmt: skip
        check_options(loss=(self.loss, Callable | None))
        check_index(sample=(self.sample, len(self.X)))

    def check(self, views: int) -> None:
        """See that the observations fit a bundle of so many views.

        Raises:
            ValueError: A point is in no view.
        """
        check_index(**{"structure.view": (self.view, views)})

    def variables(self, sight: Sight) -> Block:
        """The samples, each with two directions across its curve."""
        tangent = self.tangent.detach().double().mT
        size = torch.linalg.vector_norm(tangent, dim=0)
        # Without a direction there is none across it: such a sample is nowhere, and does not count.
        known = ((size > 0) & size.isfinite())[:, None]
        directions = torch.stack(across(tangent / size)).movedim(-1, 0).flatten(1)
        x = torch.cat((self.X.double(), directions), 1)
        return Block(torch.where(known, x, torch.nan), AcrossCurve(), self.fixed)

    def term(self, sight: Sight, start: Block) -> Term:
        """The signed distances of samples' images from image curves, positive on the side of the normal."""
        x, normal = self.x.double(), self.normal.double()
        size = torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
        normal = torch.where(size > 0, normal, torch.nan) / torch.where(size > 0, size, 1)
        curvature = x.new_zeros(len(x), 1) if self.curvature is None else self.curvature.double()[:, None]

        def residual(*rows: Tensor) -> Tensor:
            *variables, x, normal, curvature = rows
            return circle_distances(sight.residual(*variables, x).mT, normal.mT, curvature.mT)[0][:, None]

        def linearize(*rows: Tensor, out: list[Tensor | None]) -> Tensor:
            *variables, x, normal, curvature = rows
            slopes = [None if o is None else o.new_empty(2, o.shape[2], len(x)).permute(2, 0, 1) for o in out]
            if out[-1] is not None:
                slopes[-1] = x.new_empty(2, 3, len(x)).permute(2, 0, 1)
            away = sight.linearize(*variables, x, out=slopes)
            distance, slope = circle_distances(away.mT, normal.mT, curvature.mT)
            by_each = [None if s is None else (slope[:, None] * s.permute(1, 2, 0)).sum(0) for s in slopes]
            if by_each[-1] is not None:
                directions = variables[-1].mT[3:].reshape(2, 3, -1)
                by_each[-1] = (directions * by_each[-1]).sum(1)
            for o, by in zip(out, by_each, strict=True):
                if o is not None and by is not None:
                    o[:, 0] = by.mT
            return distance[:, None]

        index, data = (*sight.at(self.view), self.sample), (x, normal, curvature)
        return Term(residual, (*sight.blocks, self.block), index, data, self.loss, self.weights, linearize)

    def covariance(self, x: Tensor, C: Tensor) -> Tensor:
        """Covariances (n, 3, 3) of the samples in the world: none along the curves."""
        known = C.diagonal(dim1=-2, dim2=-1).isfinite().all(-1)[:, None, None]
        directions = x[:, 3:].reshape(-1, 2, 3)
        spread = directions.mT @ torch.where(known, C, 0.0) @ directions
        return torch.where(known, spread, torch.diag(C.new_full((3,), torch.inf)))

    def moved(self, start: Tensor, end: Tensor, world: Similarity | None) -> "BundleCurves":
        """The samples after the adjustment."""
        moved = (start != end).any(-1, keepdim=True) & end.isfinite().all(-1, keepdim=True)
        X, tangent = end[:, :3], self.tangent.double()
        if world is not None:
            X, tangent = world.transform(X), tangent @ world.R.to(tangent).mT
        X = torch.where(moved, X.to(self.X.dtype), self.X)
        return replace(self, X=X, tangent=torch.where(moved, tangent.to(self.tangent.dtype), self.tangent))


def edge_distances(poses: Pose, cameras: Camera, curves: BundleCurves) -> Float[Tensor, "k"]:
    """Signed distances of samples' images from image curves, pixels, by the pose and camera of each view."""
    y = cameras[curves.view].project(poses[curves.view].transform(curves.X[curves.sample, None]))[:, 0]
    normal = torch.nn.functional.normalize(curves.normal, dim=-1)
    bent = torch.zeros_like(curves.x[:, 0]) if curves.curvature is None else curves.curvature
    return circle_distances((y - curves.x).mT, normal.mT, bent[None])[0]


@dataclass(frozen=True)
class AcrossCurve:
    """Points with two directions in which they move, `(X, first, second)`."""

    ambient: int = 9
    tangent: int = 2

    def retract(self, x: Float[Tensor, "*#b 9"], delta: Float[Tensor, "*#b 2"]) -> Float[Tensor, "*b 9"]:
        """The points after a step."""
        X = x[..., :3] + delta[..., :1] * x[..., 3:6] + delta[..., 1:] * x[..., 6:]
        return torch.cat((X, x[..., 3:].expand(*broadcast_shapes(X.shape[:-1], x.shape[:-1]), 6)), -1)


def circle_distances(
    away: Float[Tensor, "2 k"], normal: Float[Tensor, "2 k"], curvature: Float[Tensor, "1 k"]
) -> tuple[Float[Tensor, "k"], Float[Tensor, "2 k"]]:
    """Signed distances of points from circles, or straight lines, and the unit vectors in which they grow.

    Args:
        away: The points from a point of the circle.
        normal: Unit normals there.
        curvature: Of the circles, positive where the normal points to the centre.
    """
    bent = curvature[0]
    inner = (normal * away).sum(0)
    # To the centre, over the radius.
    centre = normal - bent * away
    size = centre.square().sum(0).clamp_min(_TINY).sqrt()
    return (2 * inner - bent * away.square().sum(0)) / (1 + size), centre / size
