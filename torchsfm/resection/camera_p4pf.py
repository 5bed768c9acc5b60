"""Pose and focal length from four points, one equation more than needed.

Eight linear equations leave P ~ diag(f, f, 1) [R | t] as a combination of four matrices, also where the points lie in a plane.
Of the four quadrics r1 r2 = 0, |r1| = |r2|, r1 r3 = 0, r2 r3 = 0 the first three have up to eight common points. The one that
sees the four points best is refined to the least sum of squared reprojection errors (seven unknowns, eight residuals). The
problem is that of Bujnak, Kukelova & Pajdla, "A general solution to the P4P problem for camera with unknown focal length" (CVPR
2008).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, broadcast_shapes, check_tensors
from torchsfm.geometry import rotation_from_rotvec
from torchsfm.linalg.elimination import least_squares_rows
from torchsfm.linalg.nullspace import nullspace_rows
from torchsfm.linalg.portions import portions
from torchsfm.linalg.quadric_intersection import intersect_quadrics
from torchsfm.linalg.rows import combine_rows, take_columns
from torchsfm.optim import attach_optimum, wants_derivative
from torchsfm.resection.camera_p35pf import structure, sum_of_products
from torchsfm.resection.focal import camera_of, incidence_rows, scaled, world_camera

_CHUNK = 8192
_INDEPENDENT = 1e-12
_STEPS = 8
_EXACT = 1e-22
"""Squared error of exact data, in units of the image's radius."""
_FAR = 0.3
"""Largest error of what is taken for a camera, in units of the image's radius."""


def equations(
    model: Float[Tensor, "*#batch 3 4"], x: Float[Tensor, "*#batch 4 2"], X: Float[Tensor, "*#batch 4 3"]
) -> Float[Tensor, "*batch 13"]:
    """Thirteen equations in the entries of P: eight of the points, four of the rows, and |r3| = 1; met by exact data."""
    Y = X @ model[..., :3].mT + model[..., None, :, 3]
    points = (Y[..., :2] - x * Y[..., 2:]).flatten(-2)
    rows = structure(model)
    shape = broadcast_shapes(points.shape[:-1], rows.shape[:-1])
    return torch.cat([e.expand(*shape, e.shape[-1]) for e in (points, rows)], -1)


def camera_p4pf(x: Float[Tensor, "*#batch 4 2"], X: Float[Tensor, "*#batch 4 3"]) -> Solutions[Float[Tensor, "*batch 1 3 4"]]:
    """The camera `diag(f, f, 1) [R | t]` that sees four points at x, in the sense of least squares.

    Computed in float64 whatever comes in. Differentiable in both arguments, as the optimum is. Not valid where no camera sees
    the points near their images and in front of it, where three points are collinear, or anything is not finite. Points in a
    plane parallel to the image leave the focal length open.

    Args:
        x: Image points in pixels from the principal point.
        X: The points in the world frame, also coplanar ones.

    Returns:
        One slot: `|P[2, :3]| = 1`, `f = |P[0, :3]|`.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(4, generator=g), torchsfm.random_poses(generator=g)
        >>> camera = torchsfm.resection.camera_p4pf(800 * torchsfm.project_points(pose.matrix(), X), X)
        >>> bool(camera.valid), camera.model[0, 0, :3].norm()  # the focal length
        (True, tensor(800.0000, dtype=torch.float64))
    """
    batch = check_tensors(x=(x, "4 2"), X=(X, "4 3"))
    with torch.no_grad():
        image = x.detach().double().expand(*batch, 4, 2).reshape(-1, 4, 2).permute(1, 2, 0)
        world = X.detach().double().expand(*batch, 4, 3).reshape(-1, 4, 3).permute(1, 2, 0)
        parts = [_solve(image[..., some], world[..., some]) for some in portions(max(image.shape[-1], 1), _CHUNK, x.device)]
        P, valid = (torch.cat(part) for part in zip(*parts, strict=True))
        P, valid = P.reshape(*batch, 1, 3, 4), valid.reshape(*batch, 1)
        # Numbers of the caller's kind may be too small for them.
        held = torch.isfinite(P.to(x.dtype)).flatten(-2).all(-1)
        valid, P = valid & held, torch.where(held[..., None, None], P, 0)
    model = P.to(x.dtype)
    if wants_derivative(x, X):
        zero = torch.zeros(*batch, 1, 7, dtype=torch.float64, device=x.device)
        objective = lambda delta, x, X: _squared_error(_moved(P, delta), x, X)  # noqa: E731
        delta = attach_optimum(objective, zero, x.double()[..., None, :, :], X.double()[..., None, :, :], valid=valid)
        moved = _moved(P, delta)
        model = model + (moved - moved.detach()).to(x.dtype)
    return Solutions(model, valid)


def _moved(P: Tensor, delta: Tensor) -> Tensor:
    """The camera with its pose and the logarithm of its focal length displaced by (w, v, g)."""
    f = torch.linalg.vector_norm(P[..., 0, :3], dim=-1)
    K = torch.stack((f, f, torch.ones_like(f)), -1)[..., None]
    pose = rotation_from_rotvec(delta[..., :3]) @ (P / K)
    pose = torch.cat((pose[..., :3], pose[..., 3:] + delta[..., 3:6, None]), -1)
    zoom = delta[..., 6, None].exp().expand(*delta.shape[:-1], 2)
    return torch.cat((zoom, torch.ones_like(zoom[..., :1])), -1)[..., None] * K * pose


def _squared_error(P: Tensor, x: Tensor, X: Tensor) -> Tensor:
    Y = X @ P[..., :3].mT + P[..., None, :, 3]
    return (Y[..., :2] / Y[..., 2:] - x).square().sum((-2, -1))


def _solve(x: Tensor, X: Tensor) -> tuple[Tensor, Tensor]:
    """P (batch, 12) and validity (batch) of x and X (point, coordinate, batch)."""
    batch = x.shape[-1]
    data = scaled(x, X)
    basis, pivot = nullspace_rows(incidence_rows(data.x, data.X))
    basis = torch.where(data.good & (pivot > _INDEPENDENT), basis, torch.nan).view(4, 3, 4, batch)
    r1, r2, r3 = (basis[:, i, :3] for i in range(3))
    first = sum_of_products(r1, r1) - sum_of_products(r2, r2)
    item, v = intersect_quadrics(first, sum_of_products(r1, r2), sum_of_products(r1, r3))
    R, t, f = camera_of(combine_rows(take_columns(basis, item), v))
    error = _residuals(R, t, f, *(take_columns(q, item) for q in (data.x, data.X)))
    error = torch.where(torch.isfinite(error), error, torch.inf)
    # The best one of each problem.
    least = torch.full((batch,), torch.inf, dtype=x.dtype, device=x.device).scatter_reduce(0, item, error, "amin")
    best = ((error == least[item]) & (error < _FAR * _FAR)).nonzero()[:, 0]
    # Equal errors: the first.
    found = item[best]
    once = torch.ones_like(found, dtype=torch.bool)
    once[1:] = found[1:] != found[:-1]
    best, found = best[once], found[once]
    R, t, f = _refine(R[..., best], t[:, best], f[best], take_columns(data.x, found), take_columns(data.X, found))
    error = _residuals(R, t, f, take_columns(data.x, found), take_columns(data.X, found))
    P = world_camera(R, t, f, data, found)
    right = (error < _FAR * _FAR) & torch.isfinite(P).all(0)
    model = torch.eye(3, 4, dtype=x.dtype, device=x.device).flatten().repeat(batch, 1)
    valid = torch.zeros(batch, dtype=torch.bool, device=x.device)
    model[found[right]] = P[:, right].T
    valid[found[right]] = True
    return model, valid


def _residuals(R: Tensor, t: Tensor, f: Tensor, x: Tensor, X: Tensor) -> Tensor:
    """The sum of squared reprojection errors, infinite behind the camera."""
    y, depth, _ = _images(R, t, f, X)
    error = ((y - x) ** 2).sum(1)
    total = error[0] + error[1] + error[2] + error[3]
    return torch.where((depth > 0).all(0), total, torch.inf)


def _images(R: Tensor, t: Tensor, f: Tensor, X: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    Y = torch.stack([combine_rows(R[i], X[:, :3].transpose(0, 1)) for i in range(3)], 1) + t
    return f * Y[:, :2] / Y[:, 2:], Y[:, 2], Y


def _refine(R: Tensor, t: Tensor, f: Tensor, x: Tensor, X: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Gauss-Newton steps kept where they do not increase the error; more than one only for those that are not exact."""
    R, t, f, error, _ = _step(R, t, f, x, X, _residuals(R, t, f, x, X))
    rest = (error > _EXACT).nonzero()[:, 0]
    for _ in range(_STEPS - 1):
        if len(rest) == 0:
            break
        y, Y = take_columns(x, rest), take_columns(X, rest)
        r, u, g, e, gain = _step(R[..., rest], t[:, rest], f[rest], y, Y, error[rest])
        R, t, f = R.index_copy(2, rest, r), t.index_copy(1, rest, u), f.index_copy(0, rest, g)
        error = error.index_copy(0, rest, e)
        rest = rest[gain > 1e-14 * e]
    return R, t, f


def _step(
    R: Tensor, t: Tensor, f: Tensor, x: Tensor, X: Tensor, before: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """One step on (w, v, log f), the pose moving from the left; the camera, its error and how much was gained."""
    y, depth, Y = _images(R, t, f, X)
    inverse = 1 / depth
    a, b = Y[:, 0] * inverse, Y[:, 1] * inverse
    zero = torch.zeros_like(a)
    ju = torch.stack((-a * b, 1 + a * a, -b, inverse, zero, -a * inverse, a), 1)
    jv = torch.stack((-1 - b * b, a * b, a, zero, inverse, -b * inverse, b), 1)
    step = -least_squares_rows(torch.cat((ju, jv)) * f, torch.cat((y[:, 0] - x[:, 0], y[:, 1] - x[:, 1])))
    turn = rotation_from_rotvec(step[:3].T).permute(1, 2, 0)
    new_R = torch.stack([combine_rows(R, turn[i][:, None]) for i in range(3)])
    new_t = torch.stack([combine_rows(t, turn[i]) for i in range(3)]) + step[3:6]
    new_f = f * step[6].clamp(-1, 1).exp()
    after = _residuals(new_R, new_t, new_f, x, X)
    better = after <= before * (1 + 1e-12) + 1e-28
    R, t, f = torch.where(better, new_R, R), torch.where(better, new_t, t), torch.where(better, new_f, f)
    after = torch.where(better, after, before)
    return R, t, f, after, before - after
