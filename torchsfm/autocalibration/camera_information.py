"""What the observations say of projective cameras: the information matrix with the points eliminated, and its covariance.

The Gauss-Newton matrix of projective bundle adjustment, points eliminated by the Schur complement. It has a null space, the
scale of every camera and the choice of frame, which is known in closed form. Eliminated with it are fields of displacements of
the image points: the residuals, or what a distortion would do. How far the cameras follow them, and what of them is left, comes
from the same matrix.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry.projection import camera_slopes, point_slopes
from torchsfm.linalg import eigh

_ENTRIES = 2_000_000
"""Entries of the matrix of couplings between cameras and points held at once; bounds memory, changes no result."""


@dataclass(frozen=True)
class CameraInformation:
    """Normal equations of the entries of all cameras, for image noise of standard deviation 1, points eliminated or known."""

    matrix: Float[Tensor, "b r r"] | Float[Tensor, "b v 12 12"]
    right: Float[Tensor, "b r k"]
    """Right-hand sides of k fields of displacements."""
    left_over: Float[Tensor, "b k k"]
    """Products of the fields that the points do not follow."""


def camera_information(
    P: Float[Tensor, "b v 3 4"],
    X: Float[Tensor, "b n 4"],
    weights: Float[Tensor, "b v n"],
    fields: Float[Tensor, "b v n 2 k"],
    *,
    normal: Float[Tensor, "b v n 2"] | None = None,
    coupled: bool = True,
) -> CameraInformation:
    """The normal equations.

    Args:
        P: Cameras.
        X: Homogeneous points.
        weights: Of the observations, 0 where there is none.
        fields: Displacements of the image points.
        normal: Unit vectors, for samples of curves: of these only the distance along the normal of the image curve is
            measured, and they move across the space curve.
        coupled: With the points eliminated; else taken as known, which leaves one block per view.
    """
    b, v, n = weights.shape
    blocks = P.new_zeros(b, v, 12, 12)
    S = P.new_zeros(b, 12 * v, 12 * v) if coupled else blocks
    right = P.new_zeros(b, 12 * v, fields.shape[-1])
    left_over = P.new_zeros(b, fields.shape[-1], fields.shape[-1])
    step = max(1, _ENTRIES // max(1, 48 * b * v)) if n else 1
    for start in range(0, n, step):
        part = slice(start, start + step)
        Y, w = X[:, part], weights[:, :, part]
        # Coordinates first: homogeneous images (3, b, v, n), and points (4, b, 1, n).
        y, point = (P @ Y.mT[:, None]).movedim(2, 0), Y.movedim(-1, 0)[:, :, None]
        z = torch.where((y[2] != 0) & (w > 0), y[2], 1.0)
        uv, inverse = y[:2] / z, w.sqrt() / z
        J = camera_slopes(point, uv, inverse).flatten(1, 2).movedim((0, 1), (-2, -1))
        field = fields[:, :, part] * w.sqrt()[..., None, None]
        if normal is not None:
            across = normal[:, :, part, None]
            J, field = across @ J, across @ field
        blocks += torch.einsum("bvnri,bvnrj->bvij", J, J)
        right += torch.einsum("bvnri,bvnrk->bvik", J, field).flatten(1, 2)
        left_over += torch.einsum("bvnri,bvnrj->bij", field, field)
        if not coupled:
            continue
        DP = point_slopes(P.movedim((2, 3), (0, 1))[..., None], uv, inverse).movedim((0, 1), (-2, -1))
        if normal is not None:
            DP = across @ DP
        V = torch.einsum("bvnri,bvnrj->bnij", DP, DP)
        size = V.diagonal(dim1=-2, dim2=-1).sum(-1)
        size = torch.where(size > 0, size, 1.0)[..., None, None]
        # The point's own scale is determined by nothing, and so is a point seen by one camera along its ray.
        Yn = Y / Y.norm(dim=-1, keepdim=True).clamp_min(1e-300)
        V = V + size * (Yn[..., :, None] * Yn[..., None, :] + 1e-13 * torch.eye(4, dtype=P.dtype, device=P.device))
        if normal is not None:
            # Along its curve a sample is held: that is where the normals together tell least.
            along = eigh(V)[1][..., :1]
            V = V + size * (along @ along.mT)
        L, info = torch.linalg.cholesky_ex(V)
        good = (info == 0)[..., None, None]
        L = torch.where(good, L, torch.eye(4, dtype=P.dtype, device=P.device))
        W = (J.mT @ DP).transpose(1, 2) * good[..., None]
        Z = torch.linalg.solve_triangular(L[:, :, None], W.mT, upper=False)
        Z = Z.permute(0, 2, 4, 1, 3).reshape(b, 12 * v, 4 * Y.shape[1])
        S -= Z @ Z.mT
        followed = torch.einsum("bvnri,bvnrk->bnik", DP, field) * good
        followed = torch.linalg.solve_triangular(L, followed, upper=False).flatten(1, 2)
        right -= Z @ followed
        left_over -= followed.mT @ followed
    if coupled:
        diagonal = S.view(b, v, 12, v, 12).diagonal(dim1=1, dim2=3)
        diagonal += blocks.permute(0, 2, 3, 1)
    return CameraInformation(S, right, left_over)


def covariance_in_frame(
    P: Float[Tensor, "b v 3 4"], S: Float[Tensor, "b r r"], reference: Tensor
) -> Float[Tensor, "b v 12 v 12"]:
    """The covariance of the cameras when the reference camera is held at [I | 0].

    In the directions of the null space it is zero: the scales of cameras and what is left of the frame,
    `[A | a] -> [A + a q' | s a]`.

    Args:
        P: Cameras, the reference one [I | 0].
        S: Their information, as from `camera_information`.
        reference: Index of the reference camera, (b).
    """
    b, v = P.shape[:2]
    S = S.clone().view(b, v, 12, v, 12)
    rows = torch.arange(b, device=P.device)
    S[rows, reference] = 0
    S[rows, :, :, reference] = 0
    absent = S.diagonal(dim1=1, dim2=3).diagonal(dim1=1, dim2=2).sum(-1) <= 0
    N = P.new_zeros(b, v, 12, v + 4)
    views = torch.arange(v, device=P.device)
    N[:, views, :, views] = P.flatten(-2).transpose(0, 1)
    a = P[..., 3]
    for k in range(3):
        N.view(b, v, 3, 4, v + 4)[..., k, v + k] = a
    N.view(b, v, 3, 4, v + 4)[..., 3, v + 3] = a
    N = torch.where(absent[..., None, None], 0.0, N).flatten(1, 2)
    # Absent views leave columns of zeros, which the small diagonal keeps harmless.
    gram = N.mT @ N
    gram = gram + torch.diag_embed(torch.where(gram.diagonal(dim1=-2, dim2=-1) > 0, 0.0, 1.0))
    L, info = torch.linalg.cholesky_ex(gram)
    eye = torch.eye(v + 4, dtype=P.dtype, device=P.device)
    N = torch.linalg.solve_triangular(torch.where((info == 0)[:, None, None], L, eye), N.mT, upper=False).mT
    S = S.reshape(b, 12 * v, 12 * v)
    present = (~absent).sum(-1).clamp_min(1)
    unit = (S.diagonal(dim1=-2, dim2=-1).sum(-1) / (12 * present))[:, None, None].clamp_min(1e-300)
    fill = torch.where(absent, 1.0, 1e-12)[..., None].expand(b, v, 12).flatten(1)
    system = S / unit + N @ N.mT + torch.diag_embed(fill)
    system = torch.where(
        torch.isfinite(system).all(-1).all(-1)[:, None, None], system, torch.eye(12 * v, dtype=P.dtype, device=P.device)
    )
    scale = system.diagonal(dim1=-2, dim2=-1).rsqrt()
    L, info = torch.linalg.cholesky_ex(scale[:, :, None] * system * scale[:, None])
    good = (info == 0)[:, None, None]
    eye = torch.eye(12 * v, dtype=P.dtype, device=P.device)
    inverse = torch.cholesky_inverse(torch.where(good, L, eye)) * scale[:, :, None] * scale[:, None]
    inverse = (inverse - N @ N.mT) / unit
    inverse = inverse.view(b, v, 12, v, 12)
    keep = (~absent).to(P.dtype)
    covariance: Tensor = inverse * keep[:, :, None, None, None] * keep[:, None, None, :, None]
    return covariance
