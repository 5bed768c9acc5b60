"""The pose of a calibrated camera from four or more points, wherever they lie."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_tensors
from torchsfm.geometry import Pose
from torchsfm.linalg import eigh
from torchsfm.optim import wants_derivative
from torchsfm.resection.angles import Rays, attach, cost, determined, gauss_newton, in_pieces, status_of
from torchsfm.resection.other_poses import beside_others, with_poses_of_three
from torchsfm.resection.spread_points import tells_pose

_STARTS = 4
"""Eigenvectors, each with both signs: four points, and points in a plane, leave a null space of four dimensions."""
_SHORT = 5
_LONG = 4
_KEPT = 2


@dataclass(frozen=True)
class PoseEstimate:
    """Poses and how well they fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(3, 20, generator=g), torchsfm.random_poses(3, generator=g)
        >>> X[2] = X[2, :1]  # one point, twenty times
        >>> found = torchsfm.camera_pnp(poses.transform(X), X)
        >>> [torchsfm.Status(k).name for k in found.status.tolist()]
        ['OK', 'OK', 'DEGENERATE']
        >>> bool(found.pose.centre[:2].allclose(poses.centre[:2])), bool((found.error[:2] < 1e-6).all())  # radians
        (True, True)
    """

    model: Float[Tensor, "*batch 3 4"]
    """`cam_from_world` as `[R | t]`, finite always."""
    error: Float[Tensor, "*batch"]
    """Weighted root-mean-square of the sine of the angle between a ray and its point."""
    status: Int8[Tensor, "*batch"]
    """OK; NOT_FINITE: data with weight are not finite, or a ray is zero; TOO_FEW: fewer than four points; DEGENERATE: the pose
    is not determined, or not beyond the noise that the error tells of (points in a line or nearly, rays that coincide, three
    points several times each), or another, well apart, fits as well (some four points, planes far away), or of five points and
    more none fits to 0.2 radians; BEHIND: half of the weight or more is
    behind the camera."""

    @property
    def pose(self) -> Pose:
        """The model as a `Pose`."""
        return Pose.from_matrix(self.model)


def camera_pnp(
    d: Float[Tensor, "*#batch n 3"],
    X: Float[Tensor, "*#batch n 3"],
    *,
    weights: Float[Tensor, "*#batch n"] | None = None,
) -> PoseEstimate:
    """The pose that turns points to their rays with the smallest angles.

    The squared distances of the points from their rays are a quadratic form in the nine entries of R once t is eliminated. Its
    eigenvectors of small eigenvalues, as rotations, are starts for its minimisation over rotations (Terzakis & Lourakis, "A
    consistently fast and globally optimal solution to the perspective-n-point problem", ECCV 2020); the two best minima go on
    to the sum of squared sines of the angles, which is what is minimised in the end: points in a plane, or nearly, are no
    exception, and rays may point anywhere. Computed in float64; the derivative is that of the optimum.

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
        >>> found = torchsfm.camera_pnp(poses.transform(X), X)
        >>> bool(found.model.allclose(poses.matrix())), bool((found.status == torchsfm.Status.OK).all())
        (True, True)
    """
    batch = check_tensors(d=(d, "n 3"), X=(X, "n 3"), weights=(weights, "?n"))
    return least_sines(_starts, d, X, weights, batch, steps=_LONG)


def least_sines(
    starts: Callable[[Rays], tuple[Tensor, Tensor]],
    d: Tensor,
    X: Tensor,
    weights: Tensor | None,
    batch: torch.Size,
    *,
    steps: int,
) -> PoseEstimate:
    """The pose of least squared sines that is reached in some steps from the best start, with its derivative.

    Args:
        starts: Gives several poses of each problem, as R (b, k, 3, 3) and t (b, k, 3).
        d: Rays, as they came.
        X: Points.
        weights: Of both.
        batch: The batch dimensions of all together.
        steps: From the best one.
    """
    with torch.no_grad():
        fixed = (d.detach(), X.detach(), None if weights is None else weights.detach())
        parts = [_solve(data, *starts(data), steps) for data in in_pieces(*fixed, batch)]
        model, error, status = (torch.cat(part) for part in zip(*parts, strict=True))
        model, error, status = model.reshape(*batch, 3, 4), error.reshape(batch), status.reshape(batch)
        # Numbers of the caller's kind may be too small for them.
        held = torch.isfinite(model.to(d.dtype)).flatten(-2).all(-1) & torch.isfinite(error.to(d.dtype))
        model, error = torch.where(held[..., None, None], model, 0), torch.where(held, error, 0)
        status = torch.where(held, status, int(Status.NOT_FINITE)).to(torch.int8)
    if wants_derivative(d, X, *(() if weights is None else (weights,))):
        model = attach(model, status == Status.OK, d, X, weights)
    return PoseEstimate(model.to(d.dtype), error.to(d.dtype), status)


def _solve(data: Rays, R: Tensor, t: Tensor, steps: int) -> tuple[Tensor, Tensor, Tensor]:
    R, t, value, _, _ = gauss_newton(data, *with_poses_of_three(data, R, t), 2)
    best = value.argmin(-1)[:, None]
    near, starts = value, (R, t)
    R, t = R.gather(1, best[..., None, None].expand(-1, 1, 3, 3)), t.gather(1, best[..., None].expand(-1, 1, 3))
    R, t, value, N, _ = gauss_newton(data, R, t, steps)
    R, t, value, N, alone = beside_others(data, R, t, value, N, *starts, near, steps)
    value = value[:, 0]
    told = tells_pose(data, R[:, 0], t[:, 0], value, N[:, 0]) & alone
    status = status_of(data, R, t, determined(data, N)[:, 0] & told, 4)
    total = data.w.sum(-1)
    error = (value / torch.where(total > 0, total, 1.0)).sqrt()
    usable = (status == Status.OK) | (status == Status.BEHIND) | (status == Status.DEGENERATE)
    model = data.world(R, t)[:, 0]
    usable = usable & torch.isfinite(model).all(-1).all(-1)
    nothing = torch.eye(3, 4, dtype=model.dtype, device=model.device)
    return torch.where(usable[:, None, None], model, nothing), torch.where(usable, error, 0.0), status


def _starts(data: Rays) -> tuple[Tensor, Tensor]:
    """The two best minima of the squared distances from the rays, as R (b, 2, 3, 3) and t (b, 2, 3)."""
    quadratic, shift = _forms(data)
    vectors = eigh(quadratic)[1][..., :_STARTS]
    R = _rotations(vectors.mT.reshape(-1, _STARTS, 3, 3).mT)
    value = _value(quadratic, R)
    damping = torch.full_like(value, 1e-3)
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    for _ in range(_SHORT):
        # A turn w from the left moves column j of R by w x r_j.
        J = torch.cat([_cross_matrix(R[..., j]) for j in range(3)], -1)
        A = (J.flatten(1, 2) @ quadratic).view_as(J)
        N, g = A @ J.mT, A @ R.mT.flatten(-2)[..., None]
        trace = N.diagonal(dim1=-2, dim2=-1).sum(-1)
        step = -torch.linalg.solve_ex(N + (damping * trace + 1e-30)[..., None, None] * eye, g)[0][..., 0]
        new = _turned(R, torch.where(torch.isfinite(step), step, 0.0))
        after = _value(quadratic, new)
        better = after <= value
        R, value = torch.where(better[..., None, None], new, R), torch.where(better, after, value)
        damping = torch.where(better, damping * 0.1, (damping * 10).clamp_min(1e-4))
    t = R.mT.flatten(-2) @ shift.mT
    # Of starts that ended in one minimum keep one: what is as good as a better one and no different from it.
    value = cost(data, R, t)
    order = value.argsort(-1)
    R, t = R.gather(1, order[..., None, None].expand_as(R)), t.gather(1, order[..., None].expand_as(t))
    value = value.gather(1, order)
    apart = (R - R[:, :1]).abs().amax((-1, -2)) > 1e-2
    second = torch.where(apart, value, torch.inf).argmin(-1)
    pick = torch.stack((torch.zeros_like(second), second), -1)
    return R.gather(1, pick[..., None, None].expand(-1, _KEPT, 3, 3)), t.gather(1, pick[..., None].expand(-1, _KEPT, 3))


def _forms(data: Rays) -> tuple[Tensor, Tensor]:
    """Omega (b, 9, 9) and T (b, 3, 9): for the columns r of a rotation t = T r is best, r' Omega r its squared distances."""
    b = len(data.u)
    u = data.u
    i, j = torch.triu_indices(3, 3, device=u.device)
    eye = torch.eye(3, dtype=u.dtype, device=u.device)
    # Projectors across the rays, and the points' homogeneous products.
    Q = (eye[i, j][:, None] - u[:, i] * u[:, j]) * data.w[:, None]
    X = torch.cat((torch.ones_like(data.X[:, :1]), data.X), 1)
    k, l = torch.triu_indices(4, 4, device=u.device)  # noqa: E741
    moments = Q @ (X[:, k] * X[:, l]).mT
    full = moments.new_zeros(b, 3, 3, 4, 4)
    for p in range(6):
        for a, c in {(int(i[p]), int(j[p])), (int(j[p]), int(i[p]))}:
            full[:, a, c, k, l] = moments[:, p]
            full[:, a, c, l, k] = moments[:, p]
    A = full[..., 0, 0]
    B = full[..., 0, 1:].permute(0, 1, 3, 2).reshape(b, 3, 9)
    C = full[..., 1:, 1:].permute(0, 3, 1, 4, 2).reshape(b, 9, 9)
    trace = A.diagonal(dim1=-2, dim2=-1).sum(-1)
    T = -torch.linalg.solve_ex(A + (1e-14 * trace + 1e-300)[:, None, None] * eye, B)[0]
    T = torch.where(torch.isfinite(T), T, 0.0)
    omega = C + B.mT @ T
    return 0.5 * (omega + omega.mT), T


def _rotations(M: Tensor) -> Tensor:
    """The rotations nearest to matrices (b, k, 3, 3) and to their negatives, (b, 2 k, 3, 3), by quaternions (Davenport)."""
    m = M
    xx, xy, xz = m[..., 0, 0], m[..., 0, 1], m[..., 0, 2]
    yx, yy, yz = m[..., 1, 0], m[..., 1, 1], m[..., 1, 2]
    zx, zy, zz = m[..., 2, 0], m[..., 2, 1], m[..., 2, 2]
    rows = (
        xx + yy + zz, zy - yz, xz - zx, yx - xy,
        zy - yz, xx - yy - zz, xy + yx, xz + zx,
        xz - zx, xy + yx, yy - xx - zz, yz + zy,
        yx - xy, xz + zx, yz + zy, zz - xx - yy,
    )  # fmt: skip
    vectors = eigh(torch.stack(rows, -1).reshape(*xx.shape, 4, 4))[1]
    w, x, y, z = torch.cat((vectors[..., -1], vectors[..., 0]), -2).unbind(-1)
    entries = (
        w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z,
    )  # fmt: skip
    return torch.stack(entries, -1).reshape(*w.shape, 3, 3)


def _value(quadratic: Tensor, R: Tensor) -> Tensor:
    r = R.mT.flatten(-2)
    return (r * (r @ quadratic)).sum(-1)


def _turned(R: Tensor, w: Tensor) -> Tensor:
    """R turned by w, a quaternion's way: exact rotations from any step."""
    h = 0.5 * w
    square = (h * h).sum(-1)[..., None, None]
    S = _cross_matrix(h)
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    turn = ((1 - square) * eye + 2 * S + 2 * h[..., :, None] * h[..., None, :]) / (1 + square)
    return turn @ R


def _cross_matrix(v: Tensor) -> Tensor:
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).reshape(*v.shape[:-1], 3, 3)
