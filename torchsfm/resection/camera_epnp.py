"""The pose of a calibrated camera from four or more points by control points: work in proportion to the points.

All points are fixed combinations of four control points, their centre and one along each principal axis; of three where they
lie in a plane. That these combinations, in the camera's frame, lie on the rays is linear: so the control points are a
combination of the eigenvectors of least values, and their distances tell which.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.linalg import eigh, nearest_rotation
from torchsfm.resection.angles import Rays
from torchsfm.resection.camera_pnp import PoseEstimate, least_sines

_FLAT = 1e-3
"""Smallest principal axis, over the largest, of points that count as in a plane."""
_VECTORS = 4
"""Four points leave so many combinations open, five two, more one."""
_STEPS = 6
"""Of the coefficients, to the distances between control points,"""
_SETTLED = 10
"""and of the pose, to the smallest angles."""
_APPROXIMATE = {
    4: (((0, 0), (0, 1), (0, 2), (0, 3)), ((0, 0), (0, 1), (1, 1)), ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2))),
    3: (((0, 0),), ((0, 0), (0, 1)), ((0, 0), (0, 1), (1, 1))),
}
"""By the number of control points, for each start: products of coefficients, in which distances are linear; others are 0."""


def camera_epnp(
    d: Float[Tensor, "*#batch n 3"],
    X: Float[Tensor, "*#batch n 3"],
    *,
    weights: Float[Tensor, "*#batch n"] | None = None,
) -> PoseEstimate:
    """The pose that turns points to their rays, by four control points (EPnP).

    The control points in the camera's frame are combinations of up to four eigenvectors; the products of the coefficients are
    found in three approximations, the coefficients by Gauss-Newton on the distances between control points (Lepetit,
    Moreno-Noguer & Fua, "EPnP: an accurate O(n) solution to the PnP problem", IJCV 2009). The best of the three poses goes on
    to the least sum of squared sines of the angles between rays and points, as those of `camera_pnp` do; of four points also
    the poses of three of them are tried. Computed in float64; the derivative is that of the minimum.

    Args:
        d: Rays in the camera frame, of any length, pointing from the camera towards the points.
        X: The points in the world.
        weights: Factors of the squares, 0 for absent.

    Returns:
        Poses, errors in radians (sines) and a status for each.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(8, 20, generator=g), torchsfm.random_poses(8, generator=g)  # eight cameras
        >>> found = torchsfm.resection.camera_epnp(poses.transform(X), X)
        >>> bool(found.model.allclose(poses.matrix())), bool((found.status == torchsfm.Status.OK).all())
        (True, True)
    """
    batch = check_tensors(d=(d, "n 3"), X=(X, "n 3"), weights=(weights, "?n"))
    return least_sines(_starts, d, X, weights, batch, steps=_SETTLED)


def _starts(data: Rays) -> tuple[Tensor, Tensor]:
    """Three poses of each problem, as R (b, 3, 3, 3) and t (b, 3, 3)."""
    total = data.w.sum(-1)[:, None, None].clamp_min(1e-300)
    values, axes, _ = eigh((data.X * data.w[:, None]) @ data.X.mT / total)
    # The largest axis first.
    size, axes = values.clamp_min(0).sqrt().flip(-1), axes.flip(-1)
    flat = size[:, 2] <= _FLAT * size[:, 0]
    R, t = data.X.new_zeros(len(flat), 3, 3, 3), data.X.new_zeros(len(flat), 3, 3)
    for controls, which in ((4, ~flat), (3, flat)):
        (at,) = which.nonzero(as_tuple=True)
        R[at], t[at] = _of_controls(data.u[at], data.X[at], data.w[at], size[at, : controls - 1], axes[at, :, : controls - 1])
    return R, t


def _of_controls(u: Tensor, X: Tensor, w: Tensor, size: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """The same of problems with as many control points, beside the centre, as there are axes (b, 3, m - 1) of sizes."""
    size = size.clamp_min(1e-12)
    shares = axes.mT @ X / size[..., None]
    shares = torch.cat((1 - shares.sum(1, keepdim=True), shares), 1)
    b, m = shares.shape[:2]
    # Rows of all rays: what the combination is across its ray.
    off = torch.eye(3, dtype=u.dtype, device=u.device)[:, :, None] - u[:, :, None] * u[:, None]
    both = (shares[:, :, None] * shares[:, None]).flatten(1, 2) @ (off * w[:, None, None]).flatten(1, 2).mT
    A = both.view(b, m, m, 3, 3).transpose(2, 3).reshape(b, 3 * m, 3 * m)
    V = eigh(A)[1][..., :_VECTORS].mT.reshape(b, _VECTORS, m, 3)
    i, j = torch.triu_indices(m, m, 1, device=u.device)
    apart = V[:, :, i] - V[:, :, j]
    # Control points stand at the centre, and at a size along each axis.
    square = torch.nn.functional.pad(size.square(), (1, 0))
    distance = square[:, i] + square[:, j]
    coefficients = torch.stack([_approximate(apart, distance, pairs) for pairs in _APPROXIMATE[m]], 1)
    C = (_refined(apart, distance, coefficients) @ V.flatten(2)).view(b, coefficients.shape[1], m, 3)
    Y = C.mT @ shares[:, None]
    # In front of the camera.
    side = torch.where(((Y * u[:, None]).sum(2) * w[:, None]).sum(-1) < 0, -1.0, 1.0).to(Y.dtype)
    Y = Y * side[..., None, None]
    weighted = Y * w[:, None, None]
    R = nearest_rotation(weighted @ X[:, None].mT)
    return R, weighted.sum(-1) / w.sum(-1)[:, None, None].clamp_min(1e-300)


def _approximate(apart: Tensor, distance: Tensor, pairs: tuple[tuple[int, int], ...]) -> Tensor:
    """Coefficients (b, 4) by squared distances (b, p) that are linear in some of their products.

    Args:
        apart: Differences of control points (b, 4, p, 3) in each vector.
        distance: The squared distances.
        pairs: Of the coefficients whose products are unknown.
    """
    rows = torch.stack([(apart[:, i] * apart[:, j]).sum(-1) * (1 if i == j else 2) for i, j in pairs], -1)
    product = _least_squares(rows, distance, 1e-12)
    found = dict(zip(pairs, product.unbind(-1), strict=True))
    zero, first = torch.zeros_like(product[:, 0]), found[0, 0]
    # The first one is positive; what the first square has for a sign the others' products have, too.
    b1 = first.abs().sqrt()
    sign = torch.where(first < 0, -1.0, 1.0).to(b1.dtype)
    others = []
    for k in range(1, _VECTORS):
        value = zero
        if (k, k) in found:
            value = (sign * found[k, k]).clamp_min(0).sqrt() * torch.where(sign * found[0, k] < 0, -1.0, 1.0).to(b1.dtype)
        elif (0, k) in found:
            value = sign * found[0, k] / torch.where(b1 > 0, b1, torch.inf)
        others.append(value)
    return torch.stack((b1, *others), -1)


def _refined(apart: Tensor, distance: Tensor, coefficients: Tensor) -> Tensor:
    """Coefficients (b, k, 4) after Gauss-Newton steps to the squared distances."""
    measure = torch.einsum("bkpx,blpx->bpkl", apart, apart)[:, None]
    for _ in range(_STEPS):
        half = (measure @ coefficients[:, :, None, :, None])[..., 0]
        r = distance[:, None] - (half * coefficients[:, :, None]).sum(-1)
        step = _least_squares((2 * half).flatten(0, 1), r.flatten(0, 1), 1e-9).view_as(coefficients)
        coefficients = coefficients + step
    return coefficients


def _least_squares(A: Tensor, y: Tensor, ridge: float) -> Tensor:
    """The x (b, k) of least |A x - y|, and short where A does not tell; zero where there is none."""
    N = A.mT @ A
    least = ridge * N.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(1e-300)
    N = N + torch.diag_embed(least[:, None].expand(N.shape[:-1]))
    x = torch.linalg.solve_ex(N, A.mT @ y[..., None])[0][..., 0]
    return torch.where(torch.isfinite(x), x, 0.0)
