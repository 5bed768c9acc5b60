"""Pose of a calibrated camera from three rays to three known points.

The depths along the unit rays satisfy three quadrics, `|l_i u_i - l_j u_j|^2 = |X_i - X_j|^2`, which `_triangle.py` solves; the
pose takes one triangle to the other.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, broadcast_shapes, check_tensors
from torchsfm.linalg.kernel import kernel
from torchsfm.linalg.vectors import across, cross, dot, fma
from torchsfm.optim import wants_derivative
from torchsfm.resection.triangle import Triangle


def camera_p3p(d: Float[Tensor, "*#batch 3 3"], X: Float[Tensor, "*#batch 3 3"]) -> Solutions[Float[Tensor, "*batch 4 3 4"]]:
    """The up to four poses `[R | t]` that see three points along three rays, `d_i ~ R X_i + t` with positive depths.

    Computed in float64 whatever comes in. Derivatives are those of the solutions (implicit function theorem on the
    depths), to second order; empty slots have none.

    No slot is valid where the points are collinear or coincide, or where anything is not finite. Where two solutions
    merge (the centre on the danger cylinder through the points) both slots stay valid, and are as inaccurate as a
    double root is.

    Args:
        d: Rays in the camera frame, one per row, of any length, pointing from the camera towards the points.
        X: The points in the world frame, one per row.

    Returns:
        Four slots of `cam_from_world`, rotations orthonormal to rounding, and which of them are solutions.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(3, generator=g), torchsfm.random_poses(generator=g)
        >>> poses = torchsfm.resection.camera_p3p(pose.transform(X), X)
        >>> bool((poses.model[poses.valid] - pose.matrix()).abs().amax((-2, -1)).min() < 1e-6)  # the true one is there
        True
    """
    batch = check_tensors(d=(d, "3 3"), X=(X, "3 3"))
    rays, points = (a.double().expand(*batch, 3, 3).reshape(batch.numel(), 9) for a in (d, X))
    # Structure of arrays: (point and coordinate, problem).
    rays, points = rays.t(), points.t()
    eps = torch.finfo(d.dtype).eps
    if wants_derivative(d, X):
        model, valid = _solve(rays, points, eps, differentiable=True)
    else:
        model, valid = _poses(rays, points, eps=eps)
    return Solutions(model.permute(3, 2, 0, 1).to(d.dtype).reshape(*batch, 4, 3, 4), valid.t().reshape(*batch, 4))


@kernel(chunk=8192)
def _poses(rays: Tensor, points: Tensor, *, eps: float) -> tuple[Tensor, Tensor]:
    return _solve(rays, points, eps, differentiable=False)


def _solve(rays: Tensor, points: Tensor, eps: float, differentiable: bool) -> tuple[Tensor, Tensor]:
    """Poses (row, column, slot, problem) and validity (slot, problem) of rays and points (9, problem) of precision eps."""
    rays, points = rays.contiguous(), points.contiguous()
    sound = _sound(rays.detach(), points.detach(), eps)
    safe = torch.tensor(_SAFE, dtype=rays.dtype, device=rays.device)[:, None]
    rays, points = torch.where(sound, rays, safe), torch.where(sound, points, safe)
    rays, X = rays.view(3, 3, -1), points.view(3, 3, -1)
    u = rays * (rays * rays).sum(1, keepdim=True).rsqrt()
    with torch.no_grad():
        triangle = Triangle(u.detach(), X.detach())
        depths, valid = triangle.candidates()
        depths, valid = triangle.polish(depths, valid & sound)
    if differentiable:
        depths = Triangle(u, X).follow(depths, valid)
    Y = u.unsqueeze(2) * depths.unsqueeze(1)
    if not differentiable:
        return _pose(X, Y), valid
    # Empty slots have no derivative, neither by their points nor by their depths, which need not be finite.
    pose = _pose(X, torch.where(valid, Y, Y.detach()))
    return torch.where(valid, pose, pose.detach()), valid


def equations(
    model: Float[Tensor, "*#batch 3 4"], d: Float[Tensor, "*#batch 3 3"], X: Float[Tensor, "*#batch 3 3"]
) -> Float[Tensor, "*batch 12"]:
    """What a pose from three rays satisfies: twelve equations in the twelve entries of `[R | t]`, zero at a solution.

    Six say `R'R = I`; two for each point say that `R X + t` has no component across its ray, relative to the point's
    size there.
    """
    R, t = model[..., :3], model[..., 3]
    gram = R.mT @ R - torch.eye(3, dtype=R.dtype, device=R.device)
    rows, columns = torch.triu_indices(3, 3, device=R.device)
    Y = X @ R.mT + t[..., None, :]
    u = d / torch.linalg.vector_norm(d, dim=-1, keepdim=True)
    sideways = [dot(Y.movedim(-1, 0), e) / torch.linalg.vector_norm(Y.detach(), dim=-1) for e in across(u.movedim(-1, 0))]
    shape = broadcast_shapes(gram.shape[:-2], sideways[0].shape[:-1])
    return torch.cat([g.expand(*shape, -1) for g in (gram[..., rows, columns], *sideways)], -1)


_SAFE = (1.0, 0.0, 1.0, 0.0, 1.0, 1.0, -1.0, 0.0, 1.0)
"""A harmless triangle, put where the data are not usable."""


def _sound(rays: Tensor, points: Tensor, eps: float) -> Tensor:
    """Finite data, rays with a direction, points not in a line; (problem)."""
    # What is not finite is not 0 when subtracted from itself.
    zero = torch.cat((rays, points))
    zero = (zero - zero).sum(0)
    X = points.view(3, 3, -1)
    e1, e2 = X[1] - X[0], X[2] - X[0]
    e3, normal = e2 - e1, cross(e1, e2)
    longest = torch.maximum(torch.maximum(dot(e1, e1), dot(e2, e2)), dot(e3, e3))
    # Twice the area against the longest side squared; rounding of far coordinates also counts.
    reach = (points * points).sum(0)
    area = dot(normal, normal)
    bound = torch.maximum((256 * eps * eps) * longest, (16 * eps * eps) * reach) * longest
    shortest, longest_ray = (rays * rays).view(3, 3, -1).sum(1).aminmax(dim=0)
    # Frames of triangles are made of products of four lengths, which must not vanish.
    bound = bound.clamp(min=1e-280)
    return (zero == 0) & (area > bound) & (shortest > 1e-200) & (longest_ray < torch.inf)


def _pose(X: Tensor, Y: Tensor) -> Tensor:
    """`[R | t]` (3, 4, slot, problem) that takes the triangle X (point, coordinate, problem) to those of the slots."""
    # The triangle in the world as one more slot.
    points = torch.cat((X.unsqueeze(2), Y), 2)
    sides = points[1:] - points[:1]
    middle = points.sum(0) * (1 / 3)
    side = sides[0]
    axes = torch.stack((side, cross(side, sides[1])))
    axes = axes * (axes * axes).sum(1, keepdim=True).clamp_min(1e-300).rsqrt()
    # Along the side, normal to the triangle, and across.
    frame = [axes[0], axes[1], cross(axes[1], axes[0])]
    world, (x, y, z) = [v[:, :1] for v in frame], [v[:, None, 1:] for v in frame]
    R = fma(x, world[0], fma(y, world[1], z * world[2]))
    return torch.cat((R, (middle[:, 1:] - (R * middle[:, :1]).sum(1)).unsqueeze(1)), 1)
