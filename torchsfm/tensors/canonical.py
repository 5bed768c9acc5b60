"""One projective frame for each set of cameras, so that cameras can be compared and differentiated."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.geometry.cameras import camera_centre
from torchsfm.linalg import solve


def canonical_cameras(P: Float[Tensor, "*batch v 3 4"]) -> Float[Tensor, "*batch v 3 4"]:
    """The cameras in the projective frame in which P1 = [I | 0] and P2 = [A | e] with A'e = 0, |A| = 1 and |e| = 1.

    This leaves no freedom of the frame but signs (HZ 15.1 has the same up to scale): of the fourth coordinate, by which the
    largest entry of e is made positive, and of the cameras, by which that of their left 3x3 part is. Cameras after the second
    are scaled to norm 1. Cameras that differ by a projective map of space become the same.

    Args:
        P: At least two cameras of any scale, the first two with different centres.

    Returns:
        The cameras; finite without meaning where the first two centres coincide, a camera is not of rank 3, or is not finite.
        Differentiable.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> world = torch.eye(4, dtype=P.dtype) + 0.1  # any projective change of space
        >>> canonical = torchsfm.tensors.canonical_cameras
        >>> bool(canonical(P @ world).allclose(canonical(P)))
        True
    """
    check_tensors(P=(P, "v>=2 3 4"))
    safe = torch.where(torch.isfinite(P).flatten(-3).all(-1)[..., None, None, None], P, 0)
    P1 = safe[..., 0, :, :]
    square = torch.cat((P1, camera_centre(P1, homogeneous=True)[..., None, :]), -2)
    H, _ = solve(square, torch.eye(4, dtype=P.dtype, device=P.device))
    return canonical_frame(safe[..., 1:, :, :] @ H[..., None, :, :])


def canonical_frame(P: Float[Tensor, "*batch u 3 4"], signed: bool = True) -> Float[Tensor, "*batch u+1 3 4"]:
    """The same from the cameras after the first, which is [I | 0]; the first is put in front of the result.

    Unless `signed`, all signs stay as they are.
    """
    A, e = P[..., 0, :, :3], P[..., 0, :, 3]
    square = (e * e).sum(-1)
    w = _over(e[..., None, :] @ A, square[..., None, None])[..., None, :, :]
    left, right = P[..., :3] - P[..., 3:] * w, P[..., 3:]
    first = left[..., :1, :, :]
    size = _root((first * first).sum((-2, -1), keepdim=True))
    # The fourth coordinate in units that make |e| = |A|.
    right = _over(right * size, _root(square)[..., None, None, None])
    moved = torch.cat((left, right), -1)
    norm = torch.cat((size, _root((moved[..., 1:, :, :] ** 2).sum((-2, -1), keepdim=True))), -3)
    P1 = torch.eye(3, 4, dtype=P.dtype, device=P.device).expand(*P.shape[:-3], 1, 3, 4)
    moved = _over(moved, norm)
    if not signed:
        return torch.cat((P1, moved), -3)
    # Signs: of each camera, then of the fourth coordinate.
    moved = moved * _sign(moved[..., :3].flatten(-2))[..., None, None]
    side = _sign(moved[..., 0, :, 3])[..., None, None, None]
    moved = torch.cat((moved[..., :3], moved[..., 3:] * side), -1)
    return torch.cat((P1, moved), -3)


def _sign(x: Tensor) -> Tensor:
    """The sign of the largest entry."""
    largest = x.detach().gather(-1, x.detach().abs().argmax(-1, keepdim=True))[..., 0]
    return torch.where(largest < 0, -1.0, 1.0).to(x.dtype)


def _root(square: Tensor) -> Tensor:
    return torch.where(square > 0, torch.where(square > 0, square, 1).sqrt(), 0)


def _over(a: Tensor, b: Tensor) -> Tensor:
    return torch.where(b > 0, a / torch.where(b > 0, b, 1), 0)
