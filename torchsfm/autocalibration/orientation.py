"""Signs of projective cameras and points, as cheirality wants them.

A projective reconstruction knows each camera and point up to a factor of either sign. What was seen was in front of its camera:
signs exist for which every visible point has a positive third image coordinate, and they are unique up to one for all where
views are linked by common points (Hartley & Zisserman 2004, 21.1; oriented projective geometry, Laveau & Faugeras 1996). In
such signs a plane at infinity is possible only if all points lie on one side of it and all its cameras `A - a p'` have
positive determinants; no linear programme is needed to test one.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_tensors


@dataclass(frozen=True)
class Orientation:
    """Cameras and points with signs chosen.

    `P` and `X` differ from what was given by signs alone. `consistent` is the share of the observations that are in front of
    their cameras then: 1 for a reconstruction of a real scene; 1 as well where nothing is visible.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(20, generator=g), torchsfm.random_poses(3, generator=g).matrix()
        >>> X = torchsfm.to_homogeneous(X)
        >>> X[5] *= -1  # signs are lost
        >>> P[1] *= -1
        >>> found = torchsfm.autocalibration.orient_projective(P, X)
        >>> float(found.consistent), bool(((found.P @ found.X.mT)[:, 2] > 0).all())  # every point is in front of every camera
        (1.0, True)
    """

    P: Float[Tensor, "*batch v 3 4"]
    X: Float[Tensor, "*batch n 4"]
    consistent: Float[Tensor, "*batch"]


def orient_projective(
    P: Float[Tensor, "*#batch v 3 4"], X: Float[Tensor, "*#batch n 4"], *, visible: Bool[Tensor, "*#batch v n"] | None = None
) -> Orientation:
    """Choose signs of cameras and points so that visible points are in front.

    Cameras and points vote in turns, starting from the first camera that sees anything and spreading along common points;
    a minority of wrong observations is outvoted.

    Args:
        P: Cameras, up to scale and sign.
        X: Homogeneous points, up to scale and sign.
        visible: Which points each view sees; all by default. What stands elsewhere is not looked at.

    Returns:
        The oriented cameras and points. Entries that are not finite keep their sign and do not vote.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(20, generator=g), torchsfm.random_poses(3, generator=g).matrix()
        >>> P[1] *= -1  # a sign is lost
        >>> found = torchsfm.autocalibration.orient_projective(P, torchsfm.geometry.to_homogeneous(X))
        >>> float(found.consistent), bool(((found.P @ found.X.mT)[:, 2] > 0).all())
        (1.0, True)
    """
    batch = check_tensors(P=(P, "v 3 4"), X=(X, "n 4"), visible=(visible, "?v n : bool"))
    v, n = P.shape[-3], X.shape[-2]
    P, X = P.expand(*batch, v, 3, 4), X.expand(*batch, n, 4)
    with torch.no_grad():
        w = P.detach()[..., 2, :] @ X.detach().mT
        vote = torch.where(torch.isfinite(w), w.sign(), 0.0)
        if visible is not None:
            vote = torch.where(visible, vote, 0.0)
        seen = (vote != 0).any(-1)
        first = seen.to(w.dtype).argmax(-1, keepdim=True) if v else seen.long()
        camera = torch.zeros(*batch, v, dtype=w.dtype, device=w.device)
        camera = camera.scatter(-1, first, 1.0) if v else camera
        point = torch.zeros(*batch, n, dtype=w.dtype, device=w.device)
        for round_ in range(2 * v + 4):
            before = camera, point
            point = (camera[..., None, :] @ vote)[..., 0, :].sign()
            camera = (vote @ point[..., None])[..., 0].sign()
            if round_ > 1 and bool((camera == before[0]).all()) and bool((point == before[1]).all()):
                break
        camera, point = torch.where(camera == 0, 1.0, camera), torch.where(point == 0, 1.0, point)
        agreed = ((vote * camera[..., None] * point[..., None, :]) > 0).sum((-2, -1))
        total = (vote != 0).sum((-2, -1))
        consistent = torch.where(total > 0, agreed.to(w.dtype) / total.clamp_min(1), 1.0)
    return Orientation(P * camera[..., None, None], X * point[..., None], consistent)
