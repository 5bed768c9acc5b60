"""A conic in space from two views, in closed form: the two planes it may lie in.

With the camera centres as the first two unit vectors of space, the first image fixes all of the dual quadric but its first row,
the second all but its second row: each up to scale, and the scales agree where both see the same epipolar tangents. One entry
is left, and that the rank is three makes a quadratic of it (Quan 1996, by other means).
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.geometry.conics import shape_of_dual_conic
from torchsfm.linalg import adjugate_3x3, null_vector, qr, unit_scale, usable

_ROUNDING = 1e-13
"""What is left of a number of unit size that is zero."""


def conics_2view(
    C1: Float[Tensor, "*#batch 3 3"],
    C2: Float[Tensor, "*#batch 3 3"],
    P1: Float[Tensor, "*#batch 3 4"],
    P2: Float[Tensor, "*#batch 3 4"],
) -> Solutions[Float[Tensor, "*batch 2 4 4"]]:
    """The dual quadrics, of rank three, of conics in space from their images in two views.

    Args:
        C1: Conics in the first image.
        C2: The same conics in the second.
        P1: First cameras.
        P2: Second cameras.

    Returns:
        Both candidates, of unit size; valid where the centres differ, no plane passes through one, the conic does not touch the
        baseline, and the images can belong together. Of one candidate the plane often has the centres on different sides:
        cameras that see the same face have the other. Computed in float64; differentiable.

    Example:
        >>> import torch, torchsfm
        >>> scene = torchsfm.simulation.simulate_conics((), views=2, generator=torch.Generator().manual_seed(0))
        >>> found = torchsfm.triangulation.conics_2view(scene.C[0, 0], scene.C[1, 0], *scene.P)
        >>> truth = torchsfm.geometry.dual_quadric_from_ellipsoid(scene.model)[0]
        >>> fit = (found.model * truth).sum((-2, -1)).abs() / truth.norm()  # 1: the same up to scale
        >>> found.valid, bool((fit[found.valid] > 1 - 1e-6).any())
        (tensor([True, True]), True)
    """
    batch = check_tensors(C1=(C1, "3 3"), C2=(C2, "3 3"), P1=(P1, "3 4"), P2=(P2, "3 4"))
    dtype = C1.dtype
    C1, C2, P1, P2 = (t.double() for t in (C1, C2, P1, P2))
    C1, C2, P1, P2 = (t.expand(*batch, *t.shape[-2:]) for t in (C1, C2, P1, P2))
    good = torch.stack([usable(t).all(-1).all(-1) for t in (C1, C2, P1, P2)]).all(0)
    eye = torch.eye(3, 4, dtype=C1.dtype, device=C1.device)
    C1, C2 = (torch.where(good[..., None, None], C, eye[:, :3]) for C in (C1, C2))
    P1, P2 = (torch.where(good[..., None, None], P, eye) for P in (P1, P2))
    P1, C1 = _normalised(P1, C1)
    P2, C2 = _normalised(P2, C2)
    (c1, fine1), (c2, fine2) = null_vector(P1), null_vector(P2)
    basis, R, _ = qr(torch.stack((c1, c2), -1).detach(), complete=True)
    good = good & fine1 & fine2 & (R[..., 1, 1].abs() > 1e-9)
    e3, e4 = basis[..., 2], basis[..., 3]
    W = torch.stack((c1, c2, e3, e4), -1)
    first = _pulled(P1 @ torch.stack((c2, e3, e4), -1), C1)
    second = _pulled(P2 @ torch.stack((c1, e3, e4), -1), C2)
    # The 2x2 block of what both see; then everything in its scale.
    B1, B2 = first[..., 1:, 1:], second[..., 1:, 1:]
    size1, size2 = (B.detach().square().sum((-2, -1)).sqrt() for B in (B1, B2))
    good = good & (size1 > _ROUNDING) & (size2 > _ROUNDING)
    scale1, scale2 = ((B.square().sum((-2, -1)) + (~good).to(B.dtype)).sqrt()[..., None, None] for B in (B1, B2))
    sign = torch.where((B1 * B2).detach().sum((-2, -1)) < 0, -1.0, 1.0)[..., None, None]
    first, second = first / scale1, sign * second / scale2
    B = 0.5 * (first[..., 1:, 1:] + second[..., 1:, 1:])
    det = B[..., 0, 0] * B[..., 1, 1] - B[..., 0, 1] * B[..., 1, 0]
    good = good & (det.detach().abs() > _ROUNDING)
    det = torch.where(good, det, 1.0)[..., None, None]
    adjugate = torch.stack((B[..., 1, 1], -B[..., 0, 1], -B[..., 1, 0], B[..., 0, 0]), -1).reshape(*B.shape)
    F = torch.stack((second[..., 0, 1:], first[..., 0, 1:]), -2)
    K = F @ adjugate @ F.mT / det
    # The Schur complement of the block, [[a - k11, b - k12], [b - k12, d - k22]], is singular.
    square = (second[..., 0, 0] - K[..., 0, 0]) * (first[..., 0, 0] - K[..., 1, 1])
    good = good & (square.detach() > 0)
    root = torch.where(good, square, 1.0).sqrt()
    candidates = []
    for b in (K[..., 0, 1] + root, K[..., 0, 1] - root):
        A = torch.stack((second[..., 0, 0], b, b, first[..., 0, 0]), -1).reshape(*B.shape)
        Q = torch.cat((torch.cat((A, F), -1), torch.cat((F.mT, B), -1)), -2)
        candidates.append(W @ Q @ W.mT)
    Q = torch.stack(candidates, -3)
    Q = Q * unit_scale(Q)
    valid = good[..., None] & torch.isfinite(Q).all(-1).all(-1) & (Q.detach().abs().amax((-2, -1)) > 0)
    Q = torch.where(valid[..., None, None], Q, torch.eye(4, dtype=Q.dtype, device=Q.device)).to(dtype)
    return Solutions(Q, valid)


def _normalised(P: Tensor, C: Tensor) -> tuple[Tensor, Tensor]:
    """Camera and dual conic in an image in which the conic, if it is an ellipse, lies about the origin and has unit size."""
    dual = adjugate_3x3(C * unit_scale(C))
    N = image_normalisation(dual)
    P, dual = N @ P, N @ dual @ N.mT
    return P * unit_scale(P), dual * unit_scale(dual)


def image_normalisation(C_dual: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The similarity that brings ellipses about the origin and to unit size; the identity for other conics. No derivatives."""
    centre, D, good = shape_of_dual_conic(C_dual.detach())
    scale = torch.where(good, (0.5 * D.diagonal(dim1=-2, dim2=-1).sum(-1)).rsqrt(), 1.0)
    one, zero = torch.ones_like(scale), torch.zeros_like(scale)
    rows = (scale, zero, -scale * centre[..., 0]), (zero, scale, -scale * centre[..., 1]), (zero, zero, one)
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _pulled(H: Tensor, C_dual: Tensor) -> Tensor:
    """`H^-1 C* H^-T` up to scale."""
    inverse = adjugate_3x3(H)
    G = inverse @ C_dual @ inverse.mT
    return G * unit_scale(G)


def in_front(P: Float[Tensor, "*#batch 3 4"], Q_dual: Float[Tensor, "*#batch 4 4"]) -> Bool[Tensor, "*batch"]:
    """Whether ellipses in space, or ellipsoids, are wholly in front of cameras."""
    # The depths of points are those of the centre, give or take the support of the third row.
    sign = torch.where(torch.linalg.det(P[..., :3]) < 0, -1.0, 1.0)
    row = P[..., 2, :]
    depth = (row * Q_dual[..., :, 3]).sum(-1) / Q_dual[..., 3, 3]
    return (sign * depth > 0) & ((row[..., None, :] @ Q_dual @ row[..., None])[..., 0, 0] / Q_dual[..., 3, 3] > 0)
