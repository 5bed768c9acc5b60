"""Pose and focal length from three points and the direction of a fourth.

Seven linear equations leave P ~ diag(f, f, 1) [R | t] as a combination of five matrices, of which one is (0; 0; n') with n the
plane of the three points. Its coefficient b enters the third row only: of the four constraints on the rows (r1 r2 = 0,
|r1| = |r2|, r1 r3 = 0, r2 r3 = 0) two are quadrics in the other coefficients, and b drops out of the last two, which leaves a
cubic. The common points of the three are the cameras. The problem is that of Larsson, Kukelova & Zheng, "Making minimal solvers
for absolute pose estimation compact and robust" (ICCV 2017), and Wu, "P3.5P: pose estimation with unknown focal length" (CVPR
2015).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, broadcast_shapes, check_tensors
from torchsfm.linalg.nullspace import nullspace_rows
from torchsfm.linalg.portions import portions
from torchsfm.linalg.quadric_intersection import intersect_quadrics
from torchsfm.linalg.quaternary_forms import cubic_of_forms, product_of_forms
from torchsfm.linalg.rows import combine_rows, take_columns
from torchsfm.optim import attach_implicit, for_slots, wants_derivative
from torchsfm.resection.focal import camera_of, incidence_rows, scaled, world_camera

_CHUNK = 8192
_SLOTS = 10
_INDEPENDENT = 1e-12
_MET = 1e-7
"""Largest error of a solution, in units of the image's radius."""


def equations(
    model: Float[Tensor, "*#batch 3 4"], x: Float[Tensor, "*#batch 4 2"], X: Float[Tensor, "*#batch 4 3"]
) -> Float[Tensor, "*batch 12"]:
    """Twelve equations in the entries of P: seven of the points, four of the rows, and |r3| = 1."""
    Y = X @ model[..., :3].mT + model[..., None, :, 3]
    x, Y = torch.broadcast_tensors(torch.cat((x, x[..., :1]), -1), Y)  # type: ignore[no-untyped-call]
    full = (Y[..., :3, :2] - x[..., :3, :2] * Y[..., :3, 2:]).flatten(-2)
    radial = Y[..., 3, 0] * x[..., 3, 1] - Y[..., 3, 1] * x[..., 3, 0]
    rows = structure(model)
    shape = broadcast_shapes(full.shape[:-1], rows.shape[:-1])
    return torch.cat([e.expand(*shape, e.shape[-1]) for e in (full, radial[..., None], rows)], -1)


def structure(model: Float[Tensor, "*batch 3 4"]) -> Float[Tensor, "*batch 5"]:
    """What says that P = diag(f, f, 1) [R | t]."""
    r1, r2, r3 = model[..., :3].unbind(-2)
    pairs = ((r1, r2), (r1, r3), (r2, r3))
    products = [(a * b).sum(-1) for a, b in pairs]
    return torch.stack((*products, ((r1 - r2) * (r1 + r2)).sum(-1), (r3 * r3).sum(-1) - 1), -1)


def camera_p35pf(x: Float[Tensor, "*#batch 4 2"], X: Float[Tensor, "*#batch 4 3"]) -> Solutions[Float[Tensor, "*batch 10 3 4"]]:
    """The cameras `diag(f, f, 1) [R | t]` that see three points at x and a fourth in its direction from the principal point.

    Computed in float64 whatever comes in. Differentiable in both arguments. No slot is valid where the first three points are
    collinear or two of their images coincide, the fourth lies at the principal point, or anything is not finite. A plane of
    the three points parallel to the image leaves the focal length open.

    Args:
        x: Image points in pixels from the principal point. Of the fourth only `x : y` is used, and its sign.
        X: The points in the world frame.

    Returns:
        Ten slots and which of them are solutions: the points in front of the camera, `|P[2, :3]| = 1`, `f = |P[0, :3]|`.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(4, generator=g), torchsfm.random_poses(generator=g)
        >>> found = torchsfm.resection.camera_p35pf(800 * torchsfm.project_points(pose.matrix(), X), X)
        >>> f = found.model[found.valid][:, 0, :3].norm(dim=-1)
        >>> bool((f - 800).abs().min() < 1e-3)  # the true one is there
        True
    """
    batch = check_tensors(x=(x, "4 2"), X=(X, "4 3"))
    with torch.no_grad():
        image = x.detach().double().expand(*batch, 4, 2).reshape(-1, 4, 2).permute(1, 2, 0)
        world = X.detach().double().expand(*batch, 4, 3).reshape(-1, 4, 3).permute(1, 2, 0)
        parts = [_solve(image[..., some], world[..., some]) for some in portions(max(image.shape[-1], 1), _CHUNK, x.device)]
        model, valid = (torch.cat(part) for part in zip(*parts, strict=True))
        model, valid = model.reshape(*batch, _SLOTS, 3, 4).to(x.dtype), valid.reshape(*batch, _SLOTS)
        # Numbers of this kind may be too small for them.
        held = torch.isfinite(model).flatten(-2).all(-1)
        valid, model = valid & held, torch.where(held[..., None, None], model, 0)
    if wants_derivative(x, X):
        model = attach_implicit(equations, model, for_slots(x, batch), for_slots(X, batch), dims=2, valid=valid)
    return Solutions(model, valid)


def _solve(x: Tensor, X: Tensor) -> tuple[Tensor, Tensor]:
    """P (batch, 10, 12) and validity (batch, 10) of x and X (point, coordinate, batch)."""
    batch = x.shape[-1]
    data = scaled(x, X)
    x, X = data.x, data.X
    rows = incidence_rows(x[:3], X[:3])
    reach = (x[3, 0] * x[3, 0] + x[3, 1] * x[3, 1]).clamp_min(1e-300).rsqrt()
    a, b = x[3] * reach
    zero = torch.zeros_like(X[3])
    radial = torch.cat((b * X[3], -a * X[3], zero))[None]
    # The plane of the three points, as the camera (0; 0; n').
    e, f = X[1, :3] - X[0, :3], X[2, :3] - X[0, :3]
    n = torch.stack((e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0]))
    area = combine_rows(n, n).sqrt()
    n = n / torch.where(area > 0, area, 1.0)
    plane = torch.cat((n, -combine_rows(n, X[0, :3])[None]))
    plane = plane * combine_rows(plane, plane).rsqrt()
    last = torch.cat((zero, zero, plane))[None]
    basis, pivot = nullspace_rows(torch.cat((last, rows, radial)))
    good = data.good & (area > 1e-13) & (pivot > _INDEPENDENT)
    basis = torch.where(good, basis, torch.nan).view(4, 3, 4, batch)
    r1, r2, s = basis[:, 0, :3], basis[:, 1, :3], basis[:, 2, :3]
    n1, n2 = combine_rows(r1.unbind(1), n), combine_rows(r2.unbind(1), n)
    first = sum_of_products(r1, r1) - sum_of_products(r2, r2)
    cubic = cubic_of_forms(sum_of_products(r1, s), n2) - cubic_of_forms(sum_of_products(r2, s), n1)
    item, v = intersect_quadrics(first, sum_of_products(r1, r2), cubic)

    basis, plane, x, X = (take_columns(q, item) for q in (basis, plane, x, X))
    P = combine_rows(basis, v)
    q1, q2 = combine_rows(P[0, :3], plane[:3]), combine_rows(P[1, :3], plane[:3])
    s1, s2 = combine_rows(P[0, :3], P[2, :3]), combine_rows(P[1, :3], P[2, :3])
    P[2] -= (s1 * q1 + s2 * q2) / (q1 * q1 + q2 * q2) * plane
    R, t, f = camera_of(P)
    Y = torch.stack([torch.stack([combine_rows(R[i], X[k, :3]) + t[i] for i in range(3)]) for k in range(4)])
    depth = Y[:, 2]
    error = torch.maximum(
        (f * Y[:3, :2] / depth[:3, None] - x[:3]).abs().amax(0).amax(0),
        (Y[3, 0] * x[3, 1] - Y[3, 1] * x[3, 0]).abs() / (Y[3, 0] * Y[3, 0] + Y[3, 1] * Y[3, 1]).sqrt(),
    )
    ahead = (depth > 0).all(0) & (Y[3, 0] * x[3, 0] + Y[3, 1] * x[3, 1] > 0)
    keep = (ahead & (error < _MET) & torch.isfinite(f)).nonzero()[:, 0]
    found = item[keep]
    slot = torch.arange(len(found), device=found.device) - torch.searchsorted(found, found)
    keep, found, slot = keep[slot < _SLOTS], found[slot < _SLOTS], slot[slot < _SLOTS]
    model = torch.eye(3, 4, dtype=x.dtype, device=x.device).flatten().repeat(batch, _SLOTS, 1)
    valid = torch.zeros(batch, _SLOTS, dtype=torch.bool, device=x.device)
    model[found, slot] = world_camera(R, t, f, data, item)[:, keep].T
    valid[found, slot] = True
    return model, valid


def sum_of_products(a: Float[Tensor, "4 3 batch"], b: Float[Tensor, "4 3 batch"]) -> Float[Tensor, "10 batch"]:
    """The quadric a(v) . b(v) of two vectors of linear forms."""
    return product_of_forms(a[:, 0], b[:, 0]) + product_of_forms(a[:, 1], b[:, 1]) + product_of_forms(a[:, 2], b[:, 2])
