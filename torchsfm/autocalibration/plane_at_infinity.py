"""The plane at infinity from the intrinsics of two views, in closed form, and the homography that makes it infinite."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import broadcast_shapes, check_tensors
from torchsfm.autocalibration.intrinsics_model import inverse_intrinsics
from torchsfm.linalg import cross


def plane_at_infinity_from_intrinsics(
    P: Float[Tensor, "*#batch 3 4"], K1: Float[Tensor, "*#batch 3 3"], K2: Float[Tensor, "*#batch 3 3"]
) -> Float[Tensor, "*batch 3"]:
    """The plane at infinity (p, 1) of two views whose intrinsics are known (Gherardi & Fusiello, ECCV 2010, section 3).

    In axes along and across the second view's epipole, `K2^-1 (A - a p') K1` is a multiple of a rotation whose rows across the
    epipole do not depend on p; the third row is their cross product.

    Args:
        P: The second camera [A | a] where the first is [I | 0], with the sign that puts points before both cameras
            (`orient_projective`); the opposite sign gives the mirrored answer.
        K1: Intrinsics of the first view.
        K2: Intrinsics of the second view.

    Returns:
        p. With intrinsics that are wrong it is the plane for which the two views come nearest in that sense. Finite always;
        without meaning where a is zero (no baseline).

    Example:
        >>> import torch, torchsfm
        >>> K, pose = torch.eye(3).double(), torchsfm.random_poses(generator=torch.Generator().manual_seed(0))
        >>> p = torch.tensor([0.1, 0.2, 0.3]).double()  # the plane at infinity of a projective frame
        >>> P = pose.matrix() @ torch.linalg.inv(torchsfm.autocalibration.metric_upgrade(K, p))
        >>> torchsfm.autocalibration.plane_at_infinity_from_intrinsics(P, K, K)
        tensor([0.1000, 0.2000, 0.3000], dtype=torch.float64)
    """
    check_tensors(P=(P, "3 4"), K1=(K1, "3 3"), K2=(K2, "3 3"))
    inverse = inverse_intrinsics(K2)
    Q = inverse @ P[..., :3] @ K1
    q = (inverse @ P[..., 3:])[..., 0]
    q = q.expand(*broadcast_shapes(q.shape[:-1], Q.shape[:-2]), 3)
    length = q.norm(dim=-1, keepdim=True)
    tiny = torch.finfo(P.dtype).tiny ** 0.5
    u = q / length.clamp_min(tiny)
    axis = torch.nn.functional.one_hot(u.detach().abs().argmin(-1), 3).to(P.dtype)
    m = cross(u, axis)
    m = m / m.norm(dim=-1, keepdim=True).clamp_min(tiny)
    w1, w2, w3 = ((row[..., None, :] @ Q)[..., 0, :] for row in (u, m, cross(u, m)))
    third = cross(w2, w3)
    # The rows across the epipole have one length if the intrinsics are right; their area is its square.
    third = third / third.norm(dim=-1, keepdim=True).clamp_min(tiny).sqrt()
    q_p = (third - w1) / length.clamp_min(tiny)
    p: Tensor = -(inverse_intrinsics(K1).mT @ q_p[..., None])[..., 0]
    return torch.nan_to_num(p, 0.0, 0.0, 0.0)


def metric_upgrade(K: Float[Tensor, "*#batch 3 3"], p: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 4 4"]:
    """The homography H with `P H` metric, for cameras whose first is [I | 0] with intrinsics K.

    Hartley & Zisserman 2004, 19.1: `H = [[K, 0], [-p'K, 1]]`. Points go by its inverse.

    Args:
        K: Intrinsics of the reference camera.
        p: First three coordinates of the plane at infinity.

    Returns:
        H.

    Example:
        >>> import torch, torchsfm
        >>> K, p = torch.diag(torch.tensor([2.0, 2.0, 1.0])), torch.tensor([0.1, 0.2, 0.3])
        >>> H = torchsfm.autocalibration.metric_upgrade(K, p)
        >>> torch.eye(3, 4) @ H  # the first camera: K [I | 0]
        tensor([[2., 0., 0., 0.],
                [0., 2., 0., 0.],
                [0., 0., 1., 0.]])
    """
    batch = check_tensors(K=(K, "3 3"), p=(p, "3"))
    bottom = torch.cat(
        (-p[..., None, :] @ K, torch.ones_like(p[..., :1, None].expand(*broadcast_shapes(p.shape[:-1], K.shape[:-2]), 1, 1))),
        -1,
    )
    top = torch.nn.functional.pad(K, (0, 1)).expand(*batch, 3, 4)
    return torch.cat((top, bottom.expand(*batch, 1, 4)), -2)
