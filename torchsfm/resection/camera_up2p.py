"""Pose of a calibrated camera that knows which way is down, from two rays to two known points.

With gravity turned to the third axis on both sides, R is a turn by an angle about it. Both points and the centre lie in the
plane of the two rays, so that the normal `d_1 x d_2` is orthogonal to `R (X_1 - X_2)`: a cos + b sin + k = 0 (Kukelova,
Bujnak & Pajdla, "Closed-form solutions to minimal absolute pose problems with known vertical direction", ACCV 2010).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, broadcast_shapes, check_tensors
from torchsfm.geometry.homogeneous import moderate_directions
from torchsfm.optim import attach_implicit, for_slots, wants_derivative
from torchsfm.resection.triangle import NEAREST


def equations(
    model: Float[Tensor, "*#batch 3 4"],
    d: Float[Tensor, "*#batch 2 3"],
    X: Float[Tensor, "*#batch 2 3"],
    g: Float[Tensor, "*#batch 3"],
    G: Float[Tensor, "*#batch 3"],
) -> Float[Tensor, "*batch 15"]:
    """Fifteen equations of rank 12 in `[R | t]`: R'R = I, `d x (R X + t) = 0` for each point, and R G = g for unit vectors."""
    R, t = model[..., :3], model[..., 3]
    gram = R.mT @ R - torch.eye(3, dtype=R.dtype, device=R.device)
    i, j = torch.triu_indices(3, 3, device=R.device)
    Y = X @ R.mT + t[..., None, :]
    u = d / torch.linalg.vector_norm(d, dim=-1, keepdim=True)
    u, Y = torch.broadcast_tensors(u, Y)  # type: ignore[no-untyped-call]
    sideways = torch.linalg.cross(u, Y, dim=-1).flatten(-2)
    g, G = (v / torch.linalg.vector_norm(v, dim=-1, keepdim=True) for v in (g, G))
    upright = (R @ G[..., None])[..., 0] - g
    shape = broadcast_shapes(gram.shape[:-2], sideways.shape[:-1], upright.shape[:-1])
    return torch.cat([e.expand(*shape, e.shape[-1]) for e in (gram[..., i, j], sideways, upright)], -1)


def camera_up2p(
    d: Float[Tensor, "*#batch 2 3"],
    X: Float[Tensor, "*#batch 2 3"],
    g: Float[Tensor, "*#batch 3"],
    G: Float[Tensor, "*#batch 3"],
) -> Solutions[Float[Tensor, "*batch 2 3 4"]]:
    """The up to two poses `[R | t]` that turn G to g and see two points along two rays, `d_i ~ R X_i + t` with positive depths.

    Computed in float64 whatever comes in. Differentiable in all arguments; where both solutions merge there is no derivative.
    No slot is valid where the points or the rays coincide, the points lie on a vertical line (any turn would do), or
    anything is not finite.

    Args:
        d: Rays in the camera frame, one per row, of any length, pointing from the camera towards the points.
        X: The points in the world frame.
        g: The direction of gravity (or any other) in the camera frame, of any length.
        G: The same direction in the world frame.

    Returns:
        Two slots of `cam_from_world` and which of them are solutions.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(2, generator=g), torchsfm.random_poses(generator=g)
        >>> G = torch.tensor([0.0, 0.0, -1.0], dtype=X.dtype)  # down
        >>> poses = torchsfm.resection.camera_up2p(pose.transform(X), X, pose.R @ G, G)
        >>> bool((poses.model[poses.valid] - pose.matrix()).abs().amax((-2, -1)).min() < 1e-6)  # the true one is there
        True
    """
    batch = check_tensors(d=(d, "2 3"), X=(X, "2 3"), g=(g, "3"), G=(G, "3"))
    with torch.no_grad():
        eps = torch.finfo(d.dtype).eps
        rays, points = (a.detach().double().expand(*batch, 2, 3).reshape(-1, 2, 3).permute(1, 2, 0) for a in (d, X))
        down, world = (a.detach().double().expand(*batch, 3).reshape(-1, 3).T for a in (g, G))
        model, valid = _solve(rays, points, down, world, eps)
        model, valid = model.permute(3, 0, 1, 2).reshape(*batch, 2, 3, 4).to(d.dtype), valid.T.reshape(*batch, 2)
        # Numbers of this kind may be too small for them.
        held = torch.isfinite(model).flatten(-2).all(-1)
        valid, model = valid & held, torch.where(held[..., None, None], model, 0)
    if wants_derivative(d, X, g, G):
        d, g, G = (moderate_directions(v) for v in (d, g, G))
        inputs = (for_slots(d, batch), for_slots(X, batch), for_slots(g, batch, 1), for_slots(G, batch, 1))
        model = attach_implicit(equations, model, *inputs, dims=2, valid=valid)
    return Solutions(model, valid)


def _solve(d: Tensor, X: Tensor, g: Tensor, G: Tensor, eps: float) -> tuple[Tensor, Tensor]:
    """Poses (2, 3, 4, batch) and validity (2, batch) of d and X (2, 3, batch), g and G (3, batch)."""
    finite = torch.isfinite(d).all(0).all(0) & torch.isfinite(X).all(0).all(0) & torch.isfinite(g + G).all(0)
    d, g, G = _unit(d, 1), _unit(g, 0), _unit(G, 0)
    # The shorter way around: frames with gravity as third axis.
    a, b = _frame(g), _frame(G)
    u, v = (torch.stack([_dot(axis, ray) for axis in a]) for ray in d.unbind(0))
    edge = X[0] - X[1]
    e = torch.stack([_dot(axis, edge) for axis in b])
    n = _cross(u, v)
    p, q, k = n[0] * e[0] + n[1] * e[1], n[1] * e[0] - n[0] * e[1], n[2] * e[2]
    square = p * p + q * q
    discriminant = square - k * k
    # A ray or an edge that is vertical leaves the angle open.
    flat, wide = e[0] * e[0] + e[1] * e[1], (n * n).sum(0)
    length = (edge * edge).sum(0)
    size = torch.maximum(X[0].abs().amax(0), X[1].abs().amax(0))
    good = finite & (flat > (64 * eps * size) ** 2) & (flat > 16 * eps * eps * length) & (wide > 1e-28)
    good = good & (square > 1e-28 * flat * wide) & (discriminant >= -1e-12 * square)
    root, inverse = discriminant.clamp_min(0).sqrt(), 1 / torch.where(good, square, 1.0)
    # The normal's part across gravity rotates; both signs of the root.
    poses: list[Tensor] = []
    valid: list[Tensor] = []
    for sign in (1.0, -1.0):
        c, s = (-k * p - sign * root * q) * inverse, (-k * q + sign * root * p) * inverse
        norm = (c * c + s * s).rsqrt()
        c, s = c * norm, s * norm
        r = torch.stack((c * e[0] - s * e[1], s * e[0] + c * e[1], e[2]))
        # l u - m v = r in the plane of u and v.
        cos, across = _dot(u, v), 1 / torch.where(good, wide, 1.0)
        ru, rv = _dot(r, u), _dot(r, v)
        l, m = (ru - cos * rv) * across, (cos * ru - rv) * across  # noqa: E741
        # R = a' turn b with the frames as rows.
        rows = [c * b[0] - s * b[1], s * b[0] + c * b[1], b[2]]
        R = torch.stack([a[0][i] * rows[0] + a[1][i] * rows[1] + a[2][i] * rows[2] for i in range(3)])
        first, second = d[0] * l, d[1] * m
        t = 0.5 * torch.stack([first[i] + second[i] - _dot(R[i], X[0] + X[1]) for i in range(3)])
        pose = torch.cat((R, t[:, None]), 1)
        right = good & (torch.minimum(l, m) > NEAREST * torch.maximum(l, m)) & torch.isfinite(pose).all(0).all(0)
        if sign < 0:
            right = right & ((root > 0) | ~valid[0])
        poses.append(torch.where(right, pose, torch.eye(3, 4, dtype=d.dtype, device=d.device)[..., None]))
        valid.append(right)
    return torch.stack(poses), torch.stack(valid)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return torch.addcmul(torch.addcmul(a[0] * b[0], a[1], b[1]), a[2], b[2])


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.stack((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


def _unit(v: Tensor, dim: int) -> Tensor:
    largest = v.abs().amax(dim, keepdim=True)
    v = v / torch.where(largest > 0, largest, 1.0)
    return v * _dot(*(2 * (v.movedim(dim, 0),))).clamp_min(1e-300).rsqrt().unsqueeze(dim)


def _frame(g: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """An orthonormal right-handed frame with third axis g (Duff et al. 2017)."""
    x, y, z = g
    s = torch.copysign(torch.ones_like(z), z)
    a = -1 / (s + z)
    b = x * y * a
    return torch.stack((1 + s * x * x * a, s * b, -s * x)), torch.stack((b, s + y * y * a, -y)), g
