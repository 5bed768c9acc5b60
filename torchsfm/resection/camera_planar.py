"""The two poses from which points of a plane look alike, with their errors."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_tensors
from torchsfm.geometry import Pose
from torchsfm.linalg import eigh
from torchsfm.optim import wants_derivative
from torchsfm.resection.angles import Rays, attach, determined, gauss_newton, in_pieces, status_of
from torchsfm.resection.spread_points import tells_pose

_STEPS = 12
_SAME = 1e-6
_STILL = 1e-10


@dataclass(frozen=True)
class PlanarPoses:
    """Both poses of planar problems, the better one first.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(20, kind="plane", generator=g), torchsfm.random_poses(generator=g)
        >>> d = pose.transform(X)
        >>> found = torchsfm.camera_planar(d / d[:, 2:] + 0.003 * torch.randn(20, 3, generator=g), X)
        >>> found.valid, bool(found.error[0] < found.error[1])  # seen from far, a plane may be turned either way
        (tensor([True, True]), True)
        >>> turned = torchsfm.geometry.rotation_angle(found.pose.R @ pose.R.mT).rad2deg()
        >>> bool(turned[0] < 2), bool(turned[1] > 5)
        (True, True)
    """

    model: Float[Tensor, "*batch 2 3 4"]
    """`cam_from_world` as `[R | t]`, finite always."""
    valid: Bool[Tensor, "*batch 2"]
    """Which slots are minima; the second is not where both starts lead to one (a plane that faces the camera, strong
    perspective)."""
    error: Float[Tensor, "*batch 2"]
    """Weighted root-mean-square of the sine of the angle between a ray and its point. Errors alike mean that the data do not
    tell which of the poses is right."""
    status: Int8[Tensor, "*batch"]
    """OK; NOT_FINITE: data with weight are not finite, or a ray is zero; TOO_FEW: fewer than four points; DEGENERATE: points or
    rays in a line, all of them or all but one, as far as the error lets anybody see; three points several times each; points
    that are in no plane, or that no pose fits to 0.2 radians; BEHIND: half of the weight or more is behind the camera."""

    @property
    def pose(self) -> Pose:
        """The models as poses with a batch dimension of two at the end."""
        return Pose.from_matrix(self.model)


def camera_planar(
    d: Float[Tensor, "*#batch n 3"],
    X: Float[Tensor, "*#batch n 3"],
    *,
    weights: Float[Tensor, "*#batch n"] | None = None,
) -> PlanarPoses:
    """The two local minima of the pose of a camera that sees points of a plane.

    From far away, or with few points, a plane and its mirror image about the line of sight look nearly the same. The homography
    of the plane gives both poses in closed form, from its derivative at the middle of the points (Collins & Bartoli,
    "Infinitesimal plane-based pose estimation", IJCV 2014); each is then refined to the nearest minimum of the sum of squared
    sines of the angles between rays and points. Computed in float64; the derivatives are those of the minima.

    Args:
        d: Rays in the camera frame, of any length, pointing from the camera towards the points.
        X: Points in the world, coplanar to a thousandth of their extent.
        weights: Factors of the squares, 0 for absent.

    Returns:
        Both poses by increasing error, which of them are minima, and a status.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(20, kind="plane", generator=g), torchsfm.random_poses(generator=g)
        >>> found = torchsfm.camera_planar(pose.transform(X), X)
        >>> bool(found.model[0].allclose(pose.matrix())), found.error[0] < 1e-6
        (True, tensor(True))
    """
    batch = check_tensors(d=(d, "n 3"), X=(X, "n 3"), weights=(weights, "?n"))
    with torch.no_grad():
        fixed = (d.detach(), X.detach(), None if weights is None else weights.detach())
        parts = [_solve(data) for data in in_pieces(*fixed, batch)]
        model, valid, error, status = (torch.cat(part) for part in zip(*parts, strict=True))
        model, status = model.reshape(*batch, 2, 3, 4), status.reshape(batch)
        valid, error = valid.reshape(*batch, 2), error.reshape(*batch, 2)
    if wants_derivative(d, X, *(() if weights is None else (weights,))):
        wide = None if weights is None else weights[..., None, :]
        model = attach(model, valid & (status == Status.OK)[..., None], d[..., None, :, :], X[..., None, :, :], wide)
    return PlanarPoses(model.to(d.dtype), valid, error.to(d.dtype), status)


def _solve(data: Rays) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    R, t, flat = _infinitesimal(data)
    R, t, value, N, promise = gauss_newton(data, R, t, _STEPS)
    value, order = value.sort(-1)
    R, N = (a.gather(1, order[..., None, None].expand_as(a)) for a in (R, N))
    t, promise = t.gather(1, order[..., None].expand_as(t)), promise.gather(1, order)
    full = determined(data, N)
    told = tells_pose(data, R[:, 0], t[:, 0], value[:, 0], N[:, 0], plane=True)
    status = status_of(data, R[:, :1], t[:, :1], full[:, 0] & flat & told, 4)
    model = data.world(R, t)
    finite = torch.isfinite(model).all(-1).all(-1)
    fine = (status == Status.OK) | (status == Status.BEHIND)
    valid = finite & fine[:, None] & full
    apart = (R[:, 0] - R[:, 1]).abs().amax((-1, -2)) > _SAME
    # A start that is still on its way has no minimum near.
    valid[:, 1] &= apart & valid[:, 0] & (promise[:, 1] <= _STILL * value[:, 1])
    nothing = torch.eye(3, 4, dtype=model.dtype, device=model.device)
    kept = (finite & (fine | (status == Status.DEGENERATE))[:, None])[..., None, None]
    total = data.w.sum(-1)
    error = (value / torch.where(total > 0, total, 1.0)[:, None]).sqrt()
    return torch.where(kept, model, nothing), valid, torch.where(kept[..., 0, 0], error, 0.0), status


def _infinitesimal(data: Rays) -> tuple[Tensor, Tensor, Tensor]:
    """Both poses R (b, 2, 3, 3), t (b, 2, 3) in closed form, and where the points are in a plane but not in a line."""
    wX = data.X * data.w[:, None]
    spread, axes, _ = eigh(wX @ data.X.mT)
    flat = (spread[:, 0] <= 1e-6 * spread[:, 2]) & (spread[:, 1] > 1e-12 * spread[:, 2])
    # World axes with the plane's normal last, right-handed.
    basis = axes.flip(-1).clone()
    basis[:, :, 2] *= torch.where(torch.linalg.det(basis) < 0, -1.0, 1.0)[:, None]
    plane = basis.mT @ data.X
    h = torch.stack((plane[:, 0], plane[:, 1], torch.ones_like(plane[:, 0])), 1)
    H = _homography(data, h)
    # The frame in which the middle of the points is seen along the third axis.
    middle = H[:, :, 2]
    turn = _turn_to_axis(middle)
    J = turn @ H
    J = J[:, :2, :2] / torch.where(J[:, 2, 2] != 0, J[:, 2, 2], 1.0)[:, None, None]
    # The larger singular value is the inverse of the depth.
    a, b, c, e = J[:, 0, 0], J[:, 0, 1], J[:, 1, 0], J[:, 1, 1]
    s = 0.5 * (torch.hypot(a + e, c - b) + torch.hypot(a - e, b + c))
    J = J / torch.where(s > 0, s, 1.0)[:, None, None]
    rest = torch.eye(2, dtype=J.dtype, device=J.device) - J.mT @ J
    p = rest[:, 0, 0].clamp_min(0).sqrt()
    q = torch.copysign(rest[:, 1, 1].clamp_min(0).sqrt(), rest[:, 0, 1])
    poses = []
    for sign in (1.0, -1.0):
        first = torch.cat((J, sign * torch.stack((p, q), -1)[:, None]), 1)
        x, y = first[:, :, 0], first[:, :, 1]
        x = x / x.norm(dim=-1, keepdim=True).clamp_min(1e-300)
        y = y - (x * y).sum(-1, keepdim=True) * x
        y = y / y.norm(dim=-1, keepdim=True).clamp_min(1e-300)
        poses.append(torch.stack((x, y, torch.linalg.cross(x, y)), -1))
    R = turn.mT[:, None] @ torch.stack(poses, 1) @ basis.mT[:, None]
    R = torch.where(torch.isfinite(R), R, 0.0)
    return R, _translation(data, R), flat


def _translation(data: Rays, R: Tensor) -> Tensor:
    """The best translation for rotations, by distances from the rays."""
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    wu = data.u * data.w[:, None]
    A = data.w.sum(-1)[:, None, None] * eye - wu @ data.u.mT
    RX = R @ data.X[:, None]
    along = (RX * data.u[:, None]).sum(2, keepdim=True)
    right = ((RX - along * data.u[:, None]) * data.w[:, None, None]).sum(-1)
    trace = A.diagonal(dim1=-2, dim2=-1).sum(-1)
    t = -torch.linalg.solve_ex((A + (1e-14 * trace + 1e-300)[:, None, None] * eye)[:, None], right[..., None])[0][..., 0]
    return torch.where(torch.isfinite(t), t, 0.0)


def _homography(data: Rays, h: Tensor) -> Tensor:
    """H (b, 3, 3) with H h along the rays, by least squares in the parts across."""
    i, j = torch.triu_indices(3, 3, device=h.device)
    eye = torch.eye(3, dtype=h.dtype, device=h.device)
    Q = (eye[i, j][:, None] - data.u[:, i] * data.u[:, j]) * data.w[:, None]
    moments = Q @ (h[:, i] * h[:, j]).mT
    full = moments.new_zeros(len(h), 3, 3, 3, 3)
    for p in range(6):
        for a, c in {(int(i[p]), int(j[p])), (int(j[p]), int(i[p]))}:
            full[:, a, c, i, j] = moments[:, p]
            full[:, a, c, j, i] = moments[:, p]
    # Rows are (column of H, row of H).
    quadratic = full.permute(0, 3, 1, 4, 2).reshape(-1, 9, 9)
    H = eigh(quadratic)[1][..., 0].reshape(-1, 3, 3).mT
    votes = ((H @ h) * data.u * data.w[:, None]).sum((1, 2))
    return H * torch.where(votes < 0, -1.0, 1.0)[:, None, None]


def _turn_to_axis(v: Tensor) -> Tensor:
    """The rotation that takes the direction of v (b, 3) to the third axis by the shortest way."""
    n = v / v.norm(dim=-1, keepdim=True).clamp_min(1e-300)
    x, y, z = n.unbind(-1)
    # Half a turn about the first axis before, where the direction is behind.
    front = torch.where(z < 0, -1.0, 1.0)
    y, z = y * front, z * front
    k = 1 / (1 + z)
    rows = (1 - x * x * k, -x * y * k, -x, -x * y * k, 1 - y * y * k, -y, x, y, z)
    turn = torch.stack(rows, -1).reshape(*x.shape, 3, 3)
    return turn * torch.stack((torch.ones_like(front), front, front), -1)[:, None]
