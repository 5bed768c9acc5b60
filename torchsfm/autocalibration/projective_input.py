"""A projective reconstruction made ready for autocalibration: scaled images, signs, one frame, and weights."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.autocalibration.camera_information import CameraInformation, camera_information, covariance_in_frame
from torchsfm.autocalibration.orientation import orient_projective
from torchsfm.geometry import camera_centre
from torchsfm.linalg import svdvals

MAX_COUPLED = 120
"""Beyond this many views the covariance between different cameras is left out: it grows with the square of their number."""
NOISE_FLOOR = 0.01
"""Image noise in pixels that is assumed at least: better measurements do not exist, and exact ones need a scale."""


class Sightings(NamedTuple):
    """What was seen of the structure."""

    x: Float[Tensor, "*#batch v n 2"] | None
    """Where, in pixels; None where nothing but the cameras tells."""
    visible: Bool[Tensor, "*#batch v n"]
    normal: Float[Tensor, "*#batch v n 2"] | None = None
    """Unit vectors, where only the distance along them was measured: across a curve."""


@dataclass(frozen=True)
class PreparedCameras:
    """Cameras and points of one flat batch in the frame where the first view is [I | 0].

    The first view is the one with most points; `order` says which of the views given stands at each place. Image coordinates
    are relative to the middle of the image, in units of its longer side.
    """

    P: Float[Tensor, "b v 3 4"]
    X: Float[Tensor, "b n 4"]
    frame: Float[Tensor, "b 4 4"]
    """H with `T P H ~ P` of this class, where T scales the image."""
    image: Float[Tensor, "b v 3 3"]
    """T of every view."""
    order: Int[Tensor, "b v"]
    visible: Bool[Tensor, "b v n"]
    present: Bool[Tensor, "b v"]
    straight: Float[Tensor, "b v 3 4"]
    """P as it would be without the distortion."""
    covariance: Tensor
    """Of `straight`, of all views together or of each by itself."""
    distortion: Float[Tensor, "b"]
    """k of `x_distorted = (1 + k |x|^2) x`, the same for all views, in the image coordinates above."""
    distortion_deviation: Float[Tensor, "b"]
    noise: Float[Tensor, "b"]
    """Standard deviation per image coordinate, pixels."""
    consistent: Float[Tensor, "b"]
    finite: Bool[Tensor, "b"]


def image_scaling(image_size: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3 3"]:
    """The similarity T that moves the middle of the image to the origin and makes its longer side 1."""
    scale = 1 / image_size.amax(-1)
    c = (image_size - 1) / 2
    zero = torch.zeros_like(scale)
    rows = (scale, zero, -scale * c[..., 0], zero, scale, -scale * c[..., 1], zero, zero, zero + 1)
    return torch.stack(rows, -1).reshape(*scale.shape, 3, 3)


@dataclass(frozen=True)
class CanonicalCameras:
    """As `PreparedCameras`, without weights."""

    P: Float[Tensor, "b v 3 4"]
    X: Float[Tensor, "b n 4"]
    frame: Float[Tensor, "b 4 4"]
    image: Float[Tensor, "b v 3 3"]
    order: Int[Tensor, "b v"]
    visible: Bool[Tensor, "b v n"]
    present: Bool[Tensor, "b v"]
    consistent: Float[Tensor, "b"]
    finite: Bool[Tensor, "b"]


def canonical_cameras(
    P: Float[Tensor, "b v 3 4"],
    X: Float[Tensor, "b n 4"],
    visible: Bool[Tensor, "b v n"],
    image_size: Float[Tensor, "b v 2"],
    numbers: int = 2,
) -> CanonicalCameras:
    """Scale, orient and move cameras and points to the frame of the view with most points, whatever the order of the views.

    Args:
        P: Cameras in pixels.
        X: Homogeneous points.
        visible: Which points each view sees.
        image_size: Width and height.
        numbers: How many are measured of each point in a view.
    """
    b, v = visible.shape[:2]
    point_good = torch.isfinite(X).all(-1) & (X != 0).any(-1)
    view_good = torch.isfinite(P).flatten(-2).all(-1) & (P != 0).flatten(-2).any(-1)
    visible = visible & point_good[:, None] & view_good[..., None]
    # A view needs as many numbers as a camera has unknowns.
    present = numbers * visible.sum(-1) >= 11
    visible = visible & present[..., None]
    finite = present.any(-1)
    X = torch.where(point_good[..., None], X, torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=X.dtype, device=X.device))
    P = torch.where(view_good[..., None, None], P, torch.eye(3, 4, dtype=P.dtype, device=P.device))
    usable_size = torch.isfinite(image_size).all(-1) & (image_size > 0).all(-1)
    image_size = torch.where(usable_size[..., None], image_size, 1.0)
    finite = finite & (usable_size | ~present).all(-1)
    T = image_scaling(image_size)
    first = _widest(T @ P, X, visible)
    order = torch.arange(v, device=P.device).expand(b, v).clone()
    order.scatter_(1, first[:, None], 0)
    order[:, 0] = first
    rows = torch.arange(b, device=P.device)[:, None]
    P, T, visible, present = P[rows, order], T[rows, order], visible[rows, order], present[rows, order]
    Q = T @ P
    Q = Q / Q.flatten(-2).norm(dim=-1)[..., None, None]
    Y = X / X.norm(dim=-1, keepdim=True)
    oriented = orient_projective(Q, Y, visible=visible)
    Q, Y = oriented.P, oriented.X
    frame, regular = _frame(Q, present)
    Q = Q @ frame[:, None]
    Q = Q * (3**0.5 / Q.flatten(-2).norm(dim=-1).clamp_min(1e-300))[..., None, None]
    Q[:, 0] = torch.eye(3, 4, dtype=P.dtype, device=P.device)
    Y = torch.linalg.solve_ex(frame, Y.mT).result.mT
    Y = Y / Y.norm(dim=-1, keepdim=True).clamp_min(1e-300)
    finite = finite & regular & torch.isfinite(Q).flatten(1).all(-1) & torch.isfinite(Y).flatten(1).all(-1)
    eye = torch.eye(3, 4, dtype=P.dtype, device=P.device)
    # Problems that cannot be solved go through the motions with harmless numbers.
    Q = torch.where((finite[:, None] & present)[..., None, None], Q, eye)
    Y = torch.where(finite[:, None, None], Y, torch.tensor([0.0, 0.0, 1.0, 1.0], dtype=X.dtype, device=X.device))
    return CanonicalCameras(Q, Y, frame, T, order, visible, present, oriented.consistent, finite)


def _widest(P: Float[Tensor, "b v 3 4"], X: Float[Tensor, "b n 4"], visible: Bool[Tensor, "b v n"]) -> Int[Tensor, "b"]:
    """The view with most points, and of several the one over whose image they are spread most."""
    h = X[:, None] @ P.mT
    square = (h[..., :2] / h[..., 2:]).square().sum(-1)
    spread = torch.where(visible & torch.isfinite(square), square, 0.0).sum(-1)
    return (visible.sum(-1) + spread / (1 + spread)).argmax(-1)


def prepare_cameras(
    P: Float[Tensor, "b v 3 4"],
    X: Float[Tensor, "b n 4"],
    seen: Sightings,
    image_size: Float[Tensor, "b v 2"],
    noise: Float[Tensor, "b"] | None,
    distortion_sigma: float,
) -> PreparedCameras:
    """Bring cameras and points to the canonical frame, and weigh them by their covariance.

    A little radial distortion bends projective cameras by more than their noise, mostly without trace in their own residuals,
    and a focal length with them. It is one more unknown here, linearised: the residuals tell it, the cameras are freed of it,
    and what stays unknown of it is in their covariance.

    Args:
        P: Cameras in pixels.
        X: Homogeneous points.
        seen: The observations; where they are tells noise and distortion.
        image_size: Width and height.
        noise: Standard deviation of the observations per coordinate, in pixels; from x if None, else 1.
        distortion_sigma: Standard deviation of the distortion before any image was seen; 0 for none.
    """
    x, visible, normal = seen
    if x is not None:
        visible = visible & torch.isfinite(x).all(-1)
    c = canonical_cameras(P, X, visible, image_size, 2 if normal is None else 1)
    b, v = visible.shape[:2]
    row = torch.arange(b, device=P.device)[:, None]
    kept = torch.zeros_like(c.visible)
    kept[row, c.order] = c.visible
    sigma = _noise(torch.nan_to_num(P), torch.nan_to_num(X), Sightings(x, kept, normal)) if noise is None else noise
    sigma = torch.where(torch.isfinite(sigma), sigma, 1.0).clamp_min(NOISE_FLOOR)
    precision = (1 / (sigma[:, None] * c.image[..., 0, 0])).square()
    weights = c.visible.to(P.dtype) * torch.where(c.present, precision, 0.0)[..., None]
    fields = _fields(c, x)
    coupled = v <= MAX_COUPLED
    across = None if normal is None else normal[row, c.order]
    information = camera_information(c.P, c.X, weights, fields, normal=across, coupled=coupled)
    if coupled:
        covariance: Tensor = covariance_in_frame(c.P, information.matrix, torch.zeros(b, dtype=torch.long, device=P.device))
    else:
        covariance = _separate(c.P, information.matrix)
    covariance = torch.where(torch.isfinite(covariance), covariance, 0.0)
    # Noise that is given, or already the least, does not shrink when distortion takes its part of the residuals.
    least = (NOISE_FLOOR / sigma).square() if x is not None and noise is None else torch.ones_like(sigma)
    bend, k, deviation, share = _distortion(information, covariance, distortion_sigma, least, x is not None)
    sigma = sigma * share.sqrt()
    covariance = covariance * share.reshape(-1, *[1] * (covariance.ndim - 1))
    spread = bend * deviation[:, None, None]
    if coupled:
        covariance = covariance + spread[..., None, None] * spread[:, None, None]
    else:
        covariance = covariance + spread[..., None] * spread[..., None, :]
    straight = c.P - (k[:, None, None] * bend).reshape(c.P.shape)
    return PreparedCameras(
        c.P, c.X, c.frame, c.image, c.order, c.visible, c.present, straight, covariance, k, deviation, sigma, c.consistent,
        c.finite,
    )  # fmt: skip


def _fields(c: CanonicalCameras, x: Tensor | None) -> Tensor:
    """Where unit distortion would move the image points, and their residuals (b, v, n, 2, 2), zero where nothing is seen."""
    h = torch.einsum("bvij,bnj->bvni", c.P, c.X)
    seen = c.visible & (h[..., 2] != 0)
    y = h[..., :2] / torch.where(seen, h[..., 2], 1.0)[..., None]
    bent = y * y.square().sum(-1, keepdim=True)
    residual = torch.zeros_like(y)
    if x is not None:
        rows = torch.arange(len(x), device=x.device)[:, None]
        T = c.image
        residual = torch.nan_to_num(x[rows, c.order]) * T[:, :, None, [0, 1], [0, 1]] + T[:, :, None, :2, 2] - y
    fields = torch.stack((bent, residual), -1)
    return torch.where(seen[..., None, None] & torch.isfinite(fields), fields, 0.0)


def _distortion(
    information: CameraInformation, covariance: Tensor, prior: float, least_share: Tensor, told: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """How unit distortion bends the cameras (b, v, 12), the distortion, its deviation, and what share of the variance stays."""
    b, v = covariance.shape[:2]
    right = information.right
    if covariance.ndim == 5:
        follow = covariance.reshape(b, 12 * v, 12 * v) @ right
    else:
        follow = (covariance @ right.reshape(b, v, 12, -1)).flatten(1, 2)
    bend = follow[..., 0].reshape(b, v, 12)
    share = torch.ones_like(least_share)
    if prior == 0 or not told:
        return bend, 0 * share, prior * share, share
    left_over = information.left_over - right.mT @ follow
    own, common = left_over[:, 0, 0].clamp_min(0), left_over[:, 0, 1]
    explained = common.square() / (own * information.left_over[:, 1, 1]).clamp_min(1e-300)
    share = torch.maximum(1 - explained, least_share)
    precision = own / share + prior**-2
    k = common / share / precision
    # What the linear term leaves is of the size of its square.
    return bend, k, (1 / precision + k**4).sqrt(), share


def _frame(P: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """H with `P_0 H = [I | 0]`, the rest of it chosen so that it does not matter which frame P came in.

    With every other camera `[A | a]` scaled to |a| = 1, adding multiples of a to the columns of A makes A as short as it can
    be; then the last column gets about the length of the others.
    """
    first = P[:, 0]
    gram = first @ first.mT
    left, info = torch.linalg.inv_ex(gram)
    regular = (info == 0) & torch.isfinite(left).flatten(1).all(-1)
    left = torch.where(regular[:, None, None], left, torch.eye(3, dtype=P.dtype, device=P.device))
    values, _ = svdvals(gram)
    regular = regular & (values[:, 0] < 1e20 * values[:, -1])
    pseudo = first.mT @ left
    c = camera_centre(first, homogeneous=True)
    A, a = P @ pseudo[:, None], (P @ c[:, None, :, None])[..., 0]
    w = present.to(P.dtype)
    w[:, 0] = 0
    length = a.norm(dim=-1)
    # A camera at the first one's place has no baseline to scale by.
    apart = length > 1e-12 * A.flatten(-2).norm(dim=-1)
    w = torch.where(apart, w, 0.0) / torch.where(apart, length, 1.0)
    A, a = A * w[..., None, None], a * w[..., None]
    number = a.square().sum((-2, -1))
    some = number > 0
    q = -torch.einsum("bvi,bvij->bj", a, A) / torch.where(some, number, 1.0)[:, None]
    A = A + a[..., None] * q[:, None, None]
    ratio = A.square().sum((-3, -2, -1)) / (3 * torch.where(some, number, 1.0))
    ratio = torch.where(some & (ratio > 0) & torch.isfinite(ratio), ratio, 1.0).sqrt()
    frame = torch.cat((pseudo + c[..., None] * q[:, None], (c * ratio[:, None])[..., None]), -1)
    eye = torch.eye(4, dtype=P.dtype, device=P.device)
    return torch.where(regular[:, None, None], frame, eye), regular


def _noise(P: Tensor, X: Tensor, seen: Sightings) -> Tensor:
    x, visible, normal = seen
    if x is None:
        return torch.ones(len(P), dtype=P.dtype, device=P.device)
    h = torch.einsum("bvij,bnj->bvni", P, X)
    z = torch.where(h[..., 2] != 0, h[..., 2], 1.0)
    residual = torch.where(visible[..., None], x, 0.0) - h[..., :2] / z[..., None]
    square = (residual if normal is None else (residual * normal).sum(-1, keepdim=True)).square().sum(-1)
    total = torch.where(visible, square, 0.0).sum((-2, -1))
    views = (visible.sum(-1) > 0).sum(-1)
    # A point may move in space, a sample across its curve, and none tells more than is measured of it.
    rows, free = (2, 3) if normal is None else (1, 2)
    measured = rows * visible.sum(-2)
    redundancy = (measured - measured.clamp(max=free)).sum(-1) - 11 * views + 15
    return (total / redundancy.clamp_min(1)).sqrt()


def _separate(P: Tensor, information: Tensor) -> Tensor:
    """Covariance of each camera by itself, its scale held."""
    unit = information.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].clamp_min(1e-300)
    p = P.flatten(-2)
    p = p / p.norm(dim=-1, keepdim=True)
    eye = torch.eye(12, dtype=P.dtype, device=P.device)
    inverse, info = torch.linalg.inv_ex(information / unit + p[..., :, None] * p[..., None, :] + 1e-13 * eye)
    good = (info == 0)[..., None, None]
    covariance = torch.where(good, (inverse - p[..., :, None] * p[..., None, :]) / unit, 0.0)
    covariance[:, 0] = 0
    return covariance
