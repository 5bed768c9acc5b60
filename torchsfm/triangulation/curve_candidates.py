"""At which depths may the samples of one image's curve be? Where their epipolar lines cross the curves of other images."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import Curve, curve_crossings
from torchsfm.linalg import inverse
from torchsfm.triangulation.curve_views import CurveViews, biweight, viewing_rays

_CROSSINGS = 6
"""Most crossings of an epipolar line with a curve that become candidates."""
_PROBES = 24
"""Samples by which the view is chosen whose samples are followed."""
_STEEP = 0.1
"""Sine of the angle between curve and epipolar line below which a crossing says nothing of the depth."""
_LATTICE = 128
"""Samples of the image curves among which votes are counted."""
_ROUNDING = 1e-10
"""Of an epipole, relative to what it is a sum of: less is no baseline."""


class Samples(NamedTuple):
    """Samples of the curves of one view, and their rays."""

    view: Int[Tensor, "p"]
    x: Float[Tensor, "p m 2"]
    tangent: Float[Tensor, "p m 2"]
    centre: Float[Tensor, "p 3"]
    direction: Float[Tensor, "p m 3"]
    """Unit directions."""

    def at(self, depth: Float[Tensor, "p m *c"]) -> Float[Tensor, "p m *c 3"]:
        """The points of the rays so far from the centre."""
        more = (1,) * (depth.ndim - 2)
        p, m = depth.shape[:2]
        return self.centre.view(p, 1, *more, 3) + depth[..., None] * self.direction.view(p, m, *more, 3)


def samples_of(views: CurveViews, view: Int[Tensor, "p"], number: int) -> Samples:
    """So many samples of each problem's curve in a view."""
    row = torch.arange(len(view), device=view.device)
    curve, P = views.curve, views.P[row, view]
    samples = Curve(curve.x[row, view], curve.valid[row, view], curve.closed[row, view]).resample(number)
    return Samples(view, samples.x, samples.tangents(), *viewing_rays(P, samples.x))


def depth_candidates(views: CurveViews, samples: Samples) -> Float[Tensor, "p v m k"]:
    """Depths at which rays of the reference view meet the viewing cones of the other curves; 0 where they do not.

    Where the curve runs along the epipolar lines there are none: it does so in both images, and what such a line crosses
    elsewhere is another part of it.
    """
    M = views.P[..., :3]
    a, baseline = _image_of(views.P, samples.centre[:, None])
    vanishing = samples.direction[:, None] @ M.mT
    a, b = a[:, :, None].expand_as(vanishing), vanishing
    met = curve_crossings(views.curve, torch.linalg.cross(a, b), _CROSSINGS)
    y = torch.cat((met.x, torch.ones_like(met.x[..., :1])), -1)
    a, b = a[..., None, :].expand_as(y), b[..., None, :].expand_as(y)
    across, far = torch.linalg.cross(y, b), torch.linalg.cross(y, a)
    square = across.square().sum(-1)
    depth = -(far * across).sum(-1) / torch.where(square > 0, square, 1)
    in_front = b[..., 2] * depth + a[..., 2] > 0
    row = torch.arange(len(M), device=M.device)
    centre = -(inverse(M)[0] @ views.P[..., 3:])[..., 0]
    epipole, _ = _image_of(views.P[row, samples.view][:, None], centre)
    along = epipole[:, :, None, :2] - samples.x[:, None] * epipole[:, :, None, 2:]
    width = along[..., 0] * samples.tangent[:, None, :, 1] - along[..., 1] * samples.tangent[:, None, :, 0]
    crossed = baseline[..., None] & (width.abs() > _STEEP * torch.linalg.vector_norm(along, dim=-1))
    good = met.valid & (square > 0) & (depth > 0) & in_front & (met.sine > _STEEP)
    return torch.where(good & (crossed & views.others(samples.view)[..., None])[..., None], depth, 0)


def _image_of(P: Float[Tensor, "p #v 3 4"], X: Float[Tensor, "p #v 3"]) -> tuple[Float[Tensor, "p v 3"], Bool[Tensor, "p v"]]:
    """Homogeneous images of points, and whether they are more than rounding."""
    image = (P[..., :3] @ X[..., None])[..., 0] + P[..., 3]
    size = torch.linalg.matrix_norm(P[..., :3]) * torch.linalg.vector_norm(X, dim=-1)
    size = size + torch.linalg.vector_norm(P[..., 3], dim=-1)
    return image, torch.linalg.vector_norm(image, dim=-1) > _ROUNDING * size


def reference_view(views: CurveViews) -> tuple[Int[Tensor, "p"], Bool[Tensor, "p"]]:
    """The view whose samples meet most of the other curves, and whether half of its samples meet any."""
    met = []
    for i in range(views.used.shape[-1]):
        view = torch.full((len(views.P),), i, device=views.P.device)
        depth = depth_candidates(views, samples_of(views, view, _PROBES))
        met.append((depth > 0).any(-1).sum(1))
    number = torch.stack(met, 1)
    length = torch.where(views.used, views.curve.length, 0)
    # Of views that do as well, the one that sees most.
    score = number.clamp(max=4).sum(-1) + 0.5 * length / length.amax(-1, keepdim=True).clamp_min(1e-300)
    best = torch.where(views.used, score, -1).argmax(-1)
    steep = (number.gather(1, best[:, None, None].expand(-1, 1, _PROBES))[:, 0] > 0).sum(-1)
    return best, 2 * steep >= _PROBES


def depth_votes(views: CurveViews, X: Float[Tensor, "p q 3"], threshold: float) -> Float[Tensor, "p v q"]:
    """By how much the views agree with points: the biweight of their distance from the curves' tangents nearby."""
    lattice = views.curve.resample(min(_LATTICE, views.curve.x.shape[-2]))
    y, depth = views.project(X)
    gap = torch.cdist(y, lattice.x, compute_mode="donot_use_mm_for_euclid_dist")
    nearest = gap.masked_fill(~lattice.valid[:, :, None], torch.inf).argmin(-1)[..., None].expand(y.shape)
    away, tangent = y - lattice.x.gather(-2, nearest), lattice.tangents().gather(-2, nearest)
    along = (away * tangent).sum(-1).abs()
    r = away[..., 0] * tangent[..., 1] - away[..., 1] * tangent[..., 0]
    spacing = views.curve.length / lattice.number.clamp(min=1)
    counted = (along <= spacing[..., None]) & (depth > 0) & views.used[..., None]
    return torch.where(counted, biweight(r, threshold), 0)


def depth_resolution(
    views: CurveViews, X: Float[Tensor, "p m c 3"], direction: Float[Tensor, "p m 3"]
) -> Float[Tensor, "p m c"]:
    """The step along the rays that moves an image by a pixel, in the view where it is shortest."""
    y, depth = views.project(X.flatten(1, 2))
    toward = (direction[:, None] @ views.P[..., :3].mT).repeat_interleave(X.shape[2], dim=2)
    motion = torch.linalg.vector_norm(toward[..., :2] - y * toward[..., 2:], dim=-1)
    speed = torch.where(views.used[..., None] & (depth > 0), motion / depth.clamp_min(1e-300), 0).amax(1)
    return speed.clamp_min(1e-300).reciprocal().view(X.shape[:-1])
