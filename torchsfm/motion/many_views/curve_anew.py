"""Image curves put together anew, by cameras: where guesses of how they run alike were wrong for one of the curves.

An image of a curve that is nearly its own image under an affine map runs one way or the other about as well. Of the cameras
that such a mistake leaves, those by the other curves are right or nearly so; where all curves are in space they tell without
any guess, by epipolar lines and votes, and so how each image runs.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.geometry import Curve
from torchsfm.geometry.curve_places import CurvePlaces, curve_places
from torchsfm.geometry.homogeneous import divide_safely
from torchsfm.linalg import determinant_3x3
from torchsfm.motion.many_views.bilinear_fit import unit_frame
from torchsfm.motion.many_views.curve_fit import Scene
from torchsfm.motion.many_views.curve_refit import finite_frame
from torchsfm.triangulation import triangulate_curves

_UNIT = 100.0
"""Pixels of one unit of image coordinates, about, as triangulation counts them."""
_NEAR, _FAR = 3.0, 12.0
"""Least and largest threshold of triangulation in these pixels,"""
_LOOSE = 3.0
"""and by how many medians of distances it is chosen in between."""
_SHARE = 0.25
"""Of a curve's samples that triangulation must have determined: what is wrong shows later."""
_DENSE = 8
"""Places for each sample among which the nearest is looked for."""


def put_together(
    curves: Curve, there: Bool[Tensor, "1 v c"], right: Float[Tensor, "1 v c m"], x: Scene, misfit: float
) -> tuple[Curve, Scene] | None:
    """All curves by the cameras; None where these are no use.

    Args:
        curves: The image curves, as they have been taken to run so far.
        there: Which images show which curve.
        right: 1 for samples by whose depths cameras are told apart from their mirrors.
        x: Cameras and samples.
        misfit: The median of the samples' distances.
    """
    frame = finite_frame(x, right, cameras=True)
    if frame is None:
        return None
    P, X = frame
    c, m = there.shape[2], right.shape[-1]
    depth = (torch.nn.functional.pad(X, (0, 1), value=1.0) @ P[0].mT)[..., 2]
    side = (depth.sign() * right.flatten(2)[0]).sum(-1).sign() * determinant_3x3(P[0, :, :, :3]).sign()
    # Mirrored where most cameras see all from behind; those that differ from most are beyond the plane at infinity.
    flip = torch.ones(4, dtype=P.dtype, device=P.device)
    flip[0] = torch.where(side.sum() < 0, -1.0, 1.0)
    seen = there[0] & (side * flip[0] > 0)[:, None]
    P = P[0] * flip
    rows = torch.cat((_UNIT * P[:, :2], P[:, 2:]), 1)
    each = Curve(_UNIT * curves.x[0].transpose(0, 1), curves.valid[0].transpose(0, 1), curves.closed[0].transpose(0, 1))
    threshold = min(max(_LOOSE * _UNIT * misfit, _NEAR), _FAR)
    found = triangulate_curves(each, rows, samples=m, threshold=threshold, visible=seen.T)
    good = found.measured.sum(-1) >= _SHARE * m
    around = (curves.closed & there)[0].any(0)
    new = Curve(found.curve.x, found.curve.valid, around).resample(m).x
    X = torch.where(good[:, None, None], new, X[0].view(c, m, 3) * flip[:3])
    X = torch.nn.functional.pad(X, (0, 1), value=1.0)
    y = X @ P[:, None].mT
    place, back = _runs(curve_places(curves), divide_safely(y[..., :2], y[..., 2])[None], there & good)
    place = torch.where(good[:, None], place, x.place)
    other = curves.reversed()
    turned = Curve(torch.where(back[..., None, None], other.x, curves.x), curves.valid, curves.closed)
    cameras, u = unit_frame(P[None], X.flatten(0, 1).mT[None])
    return turned, Scene(cameras, u, place)


def _runs(
    images: CurvePlaces, y: Float[Tensor, "1 v c m 2"], use: Bool[Tensor, "1 v c"]
) -> tuple[Tensor, Bool[Tensor, "1 v c"]]:
    """Places nearest to points, and which images run the other way; places are on those turned round."""
    place = nearest_places(images, y)
    number = images.number[..., None].to(y.dtype)
    ring = images.closed[..., None]
    step = place.diff(dim=-1)
    step = torch.where(ring, step - number * (step / number.clamp(min=1)).round(), step)
    back = use & (step.sign().sum(-1) < 0)
    place = torch.cat((place[..., :1], place[..., :1] + step.cumsum(-1)), -1)
    return torch.where(back[..., None], number - place, place), back


def nearest_places(images: CurvePlaces, y: Float[Tensor, "p v c m 2"]) -> Float[Tensor, "p v c m"]:
    """The places on image curves nearest to points, wherever on a curve they are."""
    dense = images.spread(_DENSE * y.shape[-2])
    gap = torch.cdist(y, images.at(dense)[0])
    return images.nearest(dense.gather(-1, gap.nan_to_num(nan=torch.inf).argmin(-1)), y)
