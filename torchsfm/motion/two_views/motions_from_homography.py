"""The motion behind a homography between two images of a plane.

With both calibrations known a plane n'X = d gives H ~ R + t n', t in units of the distance d. The singular values of
R + t n' are (s1, 1, s3): the middle one gives the scale. The two circles of vectors whose length H keeps give the two rotations
(Faugeras & Lustman 1988; Ma, Soatto, Kosecka & Sastry 2004, 5.3.3; Malis & Vargas 2007 have the same in closed form).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions, Status, check_tensors
from torchsfm.linalg import cross, determinant_3x3, solve, svd
from torchsfm.motion.two_views.epipolar_fit import matrices
from torchsfm.optim import attach_implicit, for_slots, wants_derivative

_SINGULAR = 1e-10
"""Smallest singular value of a homography, relative to the middle one."""
_TOGETHER = 1e-6
"""Singular values nearer to 1 than this are 1: their square root below is a length of t or the sine of an angle."""


@dataclass(frozen=True)
class PlaneMotion:
    """The pose of a second camera relative to a first, and the plane both look at.

    The plane is `normal' X = 1` in the frame of the first camera, with its distance from that camera as the unit of length;
    |normal| = 1. In that unit X2 = R X1 + t. H ~ R + t normal'.

    Example:
        >>> import torch, torchsfm
        >>> normal, t = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.5, 0.0, 0.0])
        >>> found = torchsfm.motion.motions_from_homography(torch.eye(3) + torch.outer(t, normal))
        >>> motion = found.model
        >>> H = motion.R + motion.t[..., :, None] * motion.normal[..., None, :]  # each of both explains the images
        >>> H.shape, bool((H / H[..., 2:, 2:]).allclose(torch.eye(3) + torch.outer(t, normal), atol=1e-5))
        (torch.Size([2, 3, 3]), True)
    """

    R: Float[Tensor, "*batch 3 3"]
    t: Float[Tensor, "*batch 3"]
    normal: Float[Tensor, "*batch 3"]


@dataclass(frozen=True)
class SelectedMotion:
    """The motion chosen by the points, and what speaks for it.

    `model` is the motion. `in_front` says which points lie on the plane in front of both cameras. `alternative` is the other
    motion, and `alternative_fits` whether it has as many points in front: then the points do not decide. `status` is OK;
    DEGENERATE where the camera only turned (R is right, t = 0, the normal means nothing) or H is singular; TOO_FEW (no finite
    point has weight); BEHIND (half of the weight or less is in front); NOT_FINITE (H).

    Example:
        >>> import torch, torchsfm
        >>> X = torchsfm.random_points(20, kind="plane", generator=torch.Generator().manual_seed(0))
        >>> X[:, 2] += 2
        >>> t = torch.tensor([0.5, 0.0, 0.0], dtype=X.dtype)  # sideways, before a wall two units away
        >>> H = torch.eye(3, dtype=X.dtype) + torch.outer(t, torch.tensor([0.0, 0.0, 0.5], dtype=X.dtype))
        >>> found = torchsfm.motion.motion_from_homography(H, X, X + t)
        >>> found.model.normal.round(decimals=6).abs(), found.alternative_fits  # no other motion explains the points
        (tensor([0., 0., 1.], dtype=torch.float64), tensor(False))
    """

    model: PlaneMotion
    alternative: PlaneMotion
    alternative_fits: Bool[Tensor, "*batch"]
    in_front: Bool[Tensor, "*batch n"]
    status: Int[Tensor, "*batch"]


def equations(y: Float[Tensor, "*#batch 16"], H: Float[Tensor, "*#batch 3 3"]) -> Float[Tensor, "*batch 16"]:
    """The sixteen equations of y = (R, t, n, s): H = s (R + t n'), R'R = I and |n|^2 = 1."""
    R, t, n, s = matrices(y[..., :9], 3), y[..., 9:12], y[..., 12:15], y[..., 15]
    gap = (s[..., None, None] * (R + t[..., :, None] * n[..., None, :]) - H).flatten(-2)
    i, j = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    orthogonal = (R.mT @ R - torch.eye(3, dtype=R.dtype, device=R.device))[..., i, j]
    gauge = (n * n).sum(-1, keepdim=True) - 1
    return torch.cat([p.expand(*gap.shape[:-1], p.shape[-1]) for p in (gap, orthogonal, gauge)], -1)


def motions_from_homography(
    H: Float[Tensor, "*#batch 3 3"],
    K1: Float[Tensor, "*#batch 3 3"] | None = None,
    K2: Float[Tensor, "*#batch 3 3"] | None = None,
) -> Solutions[PlaneMotion]:
    """The two motions of a camera that looks at a plane, from the homography x2 ~ H x1 between its images.

    Taken are the solutions with both cameras on the same side of the plane, and with the plane in front of the first camera on
    its optical axis (normal_z > 0). A plane that the axis meets only behind the camera has -t and -normal instead:
    `motion_from_homography` decides that, and between the two, by points.

    Args:
        H: Homographies of any scale and sign.
        K1: Calibration of the first camera. None: H is between rays.
        K2: Calibration of the second camera.

    Returns:
        Two slots. Where the camera moves along the normal both are the same and one is valid. Where it only turned, one is
        valid, with t = 0 and normal = (0, 0, 1) without meaning. None is valid where H is singular or a number is not finite.
        Computed in float64 whatever the dtype. Differentiable where the two motions differ.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> normal, t = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.5, 0.0, 0.0])
        >>> motions = torchsfm.motion.motions_from_homography(torch.eye(3) + torch.outer(t, normal))
        >>> motions.valid, bool((motions.model.t - t).norm(dim=-1).min() < 1e-3)  # one is the true one
        (tensor([True, True]), True)
    """
    batch = check_tensors(H=(H, "3 3"), K1=(K1, "?3 3"), K2=(K2, "?3 3"))
    G = H.double()
    if K1 is not None:
        G = G @ K1.double()
    if K2 is not None:
        G, _ = solve(K2.double().expand(*batch, 3, 3), G.expand(*batch, 3, 3))
    G = G.expand(*batch, 3, 3)
    finite = torch.isfinite(G).all(-1).all(-1)
    G = torch.where(finite[..., None, None], G, torch.eye(3, dtype=G.dtype, device=G.device))
    largest = G.detach().abs().amax((-2, -1), keepdim=True)
    finite = finite & (largest[..., 0, 0] > 0)
    G = G / torch.where(largest > 0, largest, 1)
    with torch.no_grad():
        y, valid = _solve(G.detach())
        valid = valid & finite[..., None]
    if wants_derivative(G):
        y = attach_implicit(equations, y, for_slots(G, batch), valid=valid)
    # An empty slot holds I, 0, e3.
    eye = torch.eye(3, dtype=y.dtype, device=y.device)
    empty = torch.cat((eye.flatten(), eye.new_zeros(3), eye[2], eye.new_ones(1)))
    y = torch.where(valid[..., None], y, empty).to(H.dtype)
    return Solutions(PlaneMotion(matrices(y[..., :9], 3), y[..., 9:12], y[..., 12:15]), valid)


def _solve(H: Tensor) -> tuple[Tensor, Tensor]:
    """(R, t, n, s) as (*batch, 2, 16) and valid as (*batch, 2)."""
    U, s, Vh, _ = svd(H)
    middle = s[..., 1]
    regular = (s[..., 2] > _SINGULAR * middle) & (middle > _SINGULAR)
    scale = torch.where(determinant_3x3(H) < 0, -middle, middle)
    scale = torch.where(regular, scale, 1)
    H = H / scale[..., None, None]
    first, last = (torch.where(regular, s[..., i] / middle, 1) for i in (0, 2))
    a, b = ((1 - last * last).clamp_min(0)).sqrt(), ((first * first - 1).clamp_min(0)).sqrt()
    length = (a * a + b * b).sqrt()
    turned_only = length < _TOGETHER
    a, b = (torch.where(turned_only, 1, v / torch.where(turned_only, 1, length)) for v in (a, b))
    v1, v2, v3 = Vh.unbind(-2)
    slots = []
    for sign in (1, -1):
        # A vector of the plane n'X = 0 perpendicular to v2, whose length H keeps as it keeps that of v2.
        u = a[..., None] * v1 + sign * b[..., None] * v3
        n = cross(v2, u)
        before = torch.stack((v2, u, n), -1)
        w2, w1 = (H @ v2[..., None])[..., 0], (H @ u[..., None])[..., 0]
        after = torch.stack((w2, w1, cross(w2, w1)), -1)
        R = after @ before.mT
        t = ((H - R) @ n[..., None])[..., 0]
        flip = torch.where(n[..., 2:] < 0, -1.0, 1.0)
        slots.append(torch.cat((R.flatten(-2), flip * t, flip * n, scale[..., None]), -1))
    y = torch.stack(slots, -2)
    rotation = torch.eye(3, dtype=H.dtype, device=H.device)
    pure = torch.cat(((U @ Vh).flatten(-2), torch.zeros_like(v1), rotation[2].expand(v1.shape), scale[..., None]), -1)
    # U V' has the sign of det H.
    pure = torch.cat((pure[..., :9] * torch.sign(scale)[..., None], pure[..., 9:]), -1)
    y = torch.where(turned_only[..., None, None], pure[..., None, :], y)
    two = ~turned_only & (torch.minimum(a, b) > _TOGETHER)
    return y, torch.stack((regular, regular & two), -1) & torch.isfinite(y).all(-1)


def motion_from_homography(
    H: Float[Tensor, "*#batch 3 3"],
    d1: Float[Tensor, "*#batch n 3"],
    d2: Float[Tensor, "*#batch n 3"],
    weights: Float[Tensor, "*#batch n"] | Bool[Tensor, "*#batch n"] | None = None,
) -> SelectedMotion:
    """The one of the motions behind a homography that has the points in front of both cameras.

    Points in part of the image often leave both: `alternative_fits` says so. A third view, or points off the plane, decide.

    Args:
        H: Homographies between rays, d2 ~ H d1, of any scale and sign.
        d1: Rays of the first camera, of any length. Rays that are not finite or zero do not vote.
        d2: The corresponding rays of the second camera.
        weights: Weights >= 0, or a mask; 0 or False means absent. None: all 1.

    Returns:
        The motion, the other one, which points are in front, and the status. Where both fit, the one whose plane faces the
        camera more is chosen. Differentiable in H.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> X = torchsfm.random_points(20, kind="plane", generator=torch.Generator().manual_seed(0))
        >>> X[:, 2] += 2
        >>> t = torch.tensor([0.5, 0.0, 0.0], dtype=X.dtype)  # sideways, before a wall two units away
        >>> H = torch.eye(3, dtype=X.dtype) + torch.outer(t, torch.tensor([0.0, 0.0, 0.5], dtype=X.dtype))
        >>> found = torchsfm.motion.motion_from_homography(H, X, X + t)
        >>> bool(found.status == torchsfm.Status.OK), int(found.in_front.sum())
        (True, 20)
    """
    kind = "?n: bool" if getattr(weights, "dtype", None) == torch.bool else "?n"
    batch = check_tensors(H=(H, "3 3"), d1=(d1, "n 3"), d2=(d2, "n 3"), weights=(weights, kind))
    n = d1.shape[-2]
    w = torch.ones_like(d1[..., 0]) if weights is None else weights.to(d1.dtype)
    present = (w > 0) & torch.isfinite(w)
    rays = []
    for d in (d1.detach(), d2.detach()):
        good = torch.isfinite(d).all(-1) & (d != 0).any(-1)
        present = present & good
        rays.append(torch.where(good[..., None], d, 1))
    present = present.expand(*batch, n)
    w = torch.where(present, w, 0)
    motions = motions_from_homography(H.expand(*batch, 3, 3))
    R, t, normal = (v.detach() for v in (motions.model.R, motions.model.t, motions.model.normal))
    # n'd > 0 is in front of the first camera, and (R + t n') d along d2 in front of the second.
    first = (rays[0][..., None, :, :] * normal[..., None, :]).sum(-1)
    moved = rays[0][..., None, :, :] @ (R + t[..., :, None] * normal[..., None, :]).mT
    ahead = (moved * rays[1][..., None, :, :]).sum(-1) > 0
    turned = (t == 0).all(-1)[..., None]
    front = torch.stack((ahead & ((first > 0) | turned), ahead & (first < 0) & ~turned), -3)
    front = front & present[..., None, None, :]
    votes = (front * w[..., None, None, :]).sum(-1)
    votes = torch.where(motions.valid[..., None, :], votes, -1)
    # Of each motion the better sign of (t, n), then the better motion; face to face wins a tie.
    best, sign = votes.max(-2)
    facing = torch.where(motions.valid, normal[..., 2].abs(), -1)
    winner = (facing[..., 1] > facing[..., 0]).long()
    winner = torch.where(best[..., 0] > best[..., 1], 0, torch.where(best[..., 1] > best[..., 0], 1, winner))
    fits = motions.valid.all(-1) & (best[..., 0] == best[..., 1])
    factor = torch.where(sign == 1, -1.0, 1.0).to(H.dtype)[..., None]
    model = PlaneMotion(motions.model.R, factor * motions.model.t, factor * motions.model.normal)
    chosen, other = _slot(model, winner), _slot(model, 1 - winner)
    in_front = front.movedim(-3, -2).flatten(-3, -2)
    in_front = in_front.gather(
        -2, (2 * winner + sign.gather(-1, winner[..., None])[..., 0])[..., None, None].expand(*batch, 1, n)
    )
    in_front = in_front[..., 0, :]
    status = torch.full(batch, Status.OK, dtype=torch.int8, device=H.device)
    enough = torch.where(in_front, w, 0).sum(-1) > 0.5 * w.sum(-1)
    status = torch.where(enough, status, Status.BEHIND)
    status = torch.where(present.any(-1), status, Status.TOO_FEW)
    flat = ~motions.valid.any(-1) | turned[..., 0, 0]
    status = torch.where(flat, Status.DEGENERATE, status)
    status = torch.where(torch.isfinite(H).all(-1).all(-1), status, Status.NOT_FINITE)
    return SelectedMotion(chosen, other, fits, in_front, status.to(torch.int8))


def _slot(motion: PlaneMotion, index: Tensor) -> PlaneMotion:
    R = motion.R.gather(-3, index[..., None, None, None].expand(*index.shape, 1, 3, 3))[..., 0, :, :]
    t, n = (v.gather(-2, index[..., None, None].expand(*index.shape, 1, 3))[..., 0, :] for v in (motion.t, motion.normal))
    return PlaneMotion(R, t, n)
