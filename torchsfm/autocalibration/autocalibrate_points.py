"""From projective cameras and points to metric ones, with nothing known of the cameras but what is assumed of all cameras."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_options, check_tensors
from torchsfm.autocalibration.intrinsics_model import CONSTANT, VARYING_FOCAL, Assumption
from torchsfm.autocalibration.projective_input import Sightings
from torchsfm.autocalibration.upgrade_cameras import Autocalibration, sizes_of, upgrade_cameras, upgrade_options


def autocalibrate_points(
    P: Float[Tensor, "*#batch v 3 4"],
    X: Float[Tensor, "*#batch n 4"],
    x: Float[Tensor, "*#batch v n 2"] | None = None,
    *,
    image_size: Float[Tensor, "*#batch #v 2"] | tuple[float, float],
    visible: Bool[Tensor, "*#batch v n"] | None = None,
    K: Float[Tensor, "*#batch #v 3 3"] | None = None,
    assume: Assumption | Sequence[Assumption] = (CONSTANT, VARYING_FOCAL),
    noise: float | None = None,
    max_deviation: float = 0.05,
    distortion_sigma: float = 0.05,
) -> Autocalibration:
    """Upgrade projective cameras and points to metric ones.

    A grid of focal lengths, each with the plane at infinity it implies, is the start; then intrinsics and plane are adjusted
    so that all cameras are metric, weighed with the covariance that the observations give the cameras. That is what bundle
    adjustment over metric cameras finds, to first order, at a small part of its cost; metric bundle adjustment is still the
    last step for those who want it. Of several assumptions the likeliest is taken, a later one only where its further unknowns
    explain much more; the deviations tell also what the others would have had, as likely as they are.

    The answer is refused (`status`), not guessed, where the data do not determine the focal length: by their information, and
    by a second look at focal lengths 15 % off, which must fit worse. Critical motions are refused by that, and described in
    `motion`.

    Not differentiable: metric bundle adjustment, which follows, is.

    Args:
        P: Projective cameras in pixels, each of any scale and sign, in any frame, after projective bundle adjustment.
        X: Homogeneous points, of any scale and sign.
        x: Observations in pixels. They serve to estimate the noise; without them it is taken as 1 pixel, or `noise`.
        image_size: Width and height in pixels, of all views or of each.
        visible: Which points each view sees; all by default. A view with fewer than six takes no part.
        K: Where intrinsics are expected: held at these values where they are known, except for the focal length; square pixels
            and the principal point in the middle of the image by default.
        assume: What is assumed of the intrinsics, or several such to be tried in that order.
        noise: Standard deviation of the observations per coordinate, in pixels.
        max_deviation: Largest standard deviation of the logarithm of a focal length that is accepted.
        distortion_sigma: Standard deviation of the radial distortion that the images may have, before any was seen: of k in
            `x_distorted = (1 + k |x|^2) x`, x relative to the middle of the image and over its longer side, the same k in all
            views. It is estimated from the residuals, where x is given, and taken out of the cameras; 0 for images that have
            none.

    Returns:
        Intrinsics, metric cameras and points, with covariance, diagnosis and status.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, or nothing is assumed.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(30, generator=g), torchsfm.random_poses(5, generator=g)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> x = torchsfm.project_points(K @ poses.matrix(), X)
        >>> projective = torchsfm.factorize_points(x)  # in an unknown projective frame
        >>> found = torchsfm.autocalibrate_points(projective.P, projective.X, x, image_size=(1000.0, 750.0))
        >>> bool(found.valid), bool((found.K - K).abs().max() < 0.1)
        (True, True)
    """
    options = upgrade_options(assume, noise, max_deviation, distortion_sigma)
    given = image_size if isinstance(image_size, Tensor) else None
    if given is None:
        check_options(image_size=(image_size, "2 float > 0"))
    batch = check_tensors(
        P=(P, "v>=2 3 4"),
        X=(X, "n>=1 4"),
        x=(x, "?v n 2"),
        image_size=(given, "?w 2"),
        visible=(visible, "?v n : bool"),
        K=(K, "?k 3 3"),
    )
    seen = torch.ones(P.shape[-3], X.shape[-2], dtype=torch.bool, device=P.device) if visible is None else visible
    return upgrade_cameras(P, X, Sightings(x, seen), sizes_of(image_size, K, P), K, options, batch)
