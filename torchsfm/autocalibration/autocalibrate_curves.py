"""From projective cameras and space curves to metric ones: what curves say of cameras, and what is assumed of all cameras."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_options, check_tensors
from torchsfm.autocalibration.intrinsics_model import CONSTANT, VARYING_FOCAL, Assumption
from torchsfm.autocalibration.projective_input import Sightings
from torchsfm.autocalibration.upgrade_cameras import Autocalibration, sizes_of, upgrade_cameras, upgrade_options
from torchsfm.geometry.curves import Curve
from torchsfm.geometry.foot_points import foot_points
from torchsfm.geometry.homogeneous import divide_safely

_ALONG = 0.7
"""Least cosine of the angle between the samples' way and an image curve where they are on the same stretch of it."""


def autocalibrate_curves(
    P: Float[Tensor, "*#batch v 3 4"],
    X: Float[Tensor, "*#batch c m 4"],
    curves: Curve,
    *,
    image_size: Float[Tensor, "*#batch #v 2"] | tuple[float, float],
    visible: Bool[Tensor, "*#batch v c m"] | None = None,
    K: Float[Tensor, "*#batch #v 3 3"] | None = None,
    assume: Assumption | Sequence[Assumption] = (CONSTANT, VARYING_FOCAL),
    noise: float | None = None,
    max_deviation: float = 0.05,
    distortion_sigma: float = 0.05,
) -> Autocalibration:
    """Upgrade projective cameras and space curves to metric ones.

    As `autocalibrate_points`, but with the weights that curves give the cameras: of a sample only its distance from the image
    curve is measured in each view, and it may move across its space curve. Where along the curve it is tells nothing, however
    well the images of samples seem to correspond.

    Not differentiable.

    Args:
        P: Projective cameras in pixels, each of any scale and sign, in any frame, where the squared distances of samples
            from the image curves are least, as `factorize_curves` leaves them.
        X: Samples of the space curves in order, homogeneous, of any scale and sign. Their distances from the image curves
            count as independent: samples nearer together than the measured points of the image curves make the deviations
            too small.
        curves: The image curves in pixels: fields of shape (*batch, v, c, n, 2), (*batch, v, c, n), (*batch, v, c).
        image_size: Width and height in pixels, of all views or of each.
        visible: Which samples count in which view, as where `error` of `factorize_curves` is finite; all by default. One
            that is seen beyond an open end does not count, and a view where fewer than eleven do takes no part.
        K: Where intrinsics are expected, as for `autocalibrate_points`.
        assume: What is assumed of the intrinsics, or several such to be tried in that order.
        noise: Standard deviation of the image curves across their direction, in pixels; by default it is estimated from the
            distances.
        max_deviation: Largest standard deviation of the logarithm of a focal length that is accepted.
        distortion_sigma: Standard deviation of the radial distortion that the images may have, as for `autocalibrate_points`.

    Returns:
        Intrinsics, metric cameras, and samples of the metric curves (*batch, c, m, 3), with covariance, diagnosis and status.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, or nothing is assumed.

    Example:
        >>> import torch, torchsfm
        >>> t = torch.linspace(0, 6.2, 60).double()
        >>> x, y, z = t.cos(), t.sin(), 0.3 * (2 * t).cos()
        >>> X = torch.stack((torch.stack((x, y, z), -1), torch.stack((z, x, y), -1), torch.stack((y, z, x), -1)))
        >>> K = torchsfm.intrinsics(torch.tensor(800.0), torch.tensor([319.5, 239.5])).double()
        >>> P = K @ torchsfm.random_poses(6, spread=0.5, generator=torch.Generator().manual_seed(0)).matrix()
        >>> curves = torchsfm.geometry.curve_from_samples(torchsfm.project_points(P[:, None], X))
        >>> found = torchsfm.factorize_curves(curves, oriented=True, aligned=True)
        >>> counts = torch.isfinite(found.error)
        >>> metric = torchsfm.autocalibrate_curves(found.P, found.X, curves, image_size=(640.0, 480.0), visible=counts)
        >>> bool(metric.valid), bool((metric.K - K).abs().max() < 1.0), metric.X.shape
        (True, True, torch.Size([3, 40, 3]))
    """
    options = upgrade_options(assume, noise, max_deviation, distortion_sigma)
    check_options(curves=(curves, Curve))
    given = image_size if isinstance(image_size, Tensor) else None
    if given is None:
        check_options(image_size=(image_size, "2 float > 0"))
    batch = check_tensors(
        P=(P, "v>=2 3 4"),
        X=(X, "c>=1 m>=1 4"),
        x=(curves.x, "v c n>=2 2"),
        valid=(curves.valid, "v c n: bool"),
        closed=(curves.closed, "v c: bool"),
        image_size=(given, "?w 2"),
        visible=(visible, "?v c m: bool"),
        K=(K, "?k 3 3"),
    )
    sizes = sizes_of(image_size, K, P)
    with torch.no_grad():
        seen = _sightings(P.detach().double(), X.detach().double(), curves, visible)
    found = upgrade_cameras(P, X.flatten(-3, -2), seen, sizes, K, options, batch)
    return replace(found, X=found.X.reshape(*batch, *X.shape[-3:-1], 3))


def _sightings(P: Tensor, X: Tensor, curves: Curve, visible: Tensor | None) -> Sightings:
    """The points of the image curves nearest to samples, and the normals there."""
    h = X[..., None, :, :, :] @ P[..., None, :, :].mT
    y = divide_safely(h[..., :2], h[..., 2])
    feet = foot_points(replace(curves, x=curves.x.detach().double()), y)
    way = torch.cat((y[..., 1:, :], y[..., -1:, :]), -2) - torch.cat((y[..., :1, :], y[..., :-1, :]), -2)
    straight = torch.nn.functional.normalize(way, dim=-1)
    good = feet.within & ((straight * feet.tangent).sum(-1).abs() > _ALONG)
    if visible is not None:
        good = good & visible
    normal = torch.stack((-feet.tangent[..., 1], feet.tangent[..., 0]), -1)
    return Sightings(feet.x.flatten(-3, -2), good.flatten(-2), normal.flatten(-3, -2))
