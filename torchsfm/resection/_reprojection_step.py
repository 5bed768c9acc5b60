"""Distances of image points to the images of known points, and Gauss-Newton steps on them: all data of many cameras at once.

A camera P sees X at (u, v) = (p, q) / z. With h = (X, 1) / z the derivatives of u and v by the rows of P are (h, 0, -u h) and
(0, h, -v h): the normal equations are moments of the products of (X, 1), which belong to the data, with 1, -u, -v and
u^2 + v^2 over z^2, which belong to the camera. Those of a camera with fewer parameters follow from them.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import broadcast_shapes
from torchsfm.robust import damped_solve
from torchsfm.robust.local_optimisation import Weigh

_PRODUCTS = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2), (0, 3), (1, 3), (2, 3), (3, 3)]
"""Products of the coordinates of (X, 1), as `_monomials` has them; the last four are (X, 1) itself."""
_WIDTH = len(_PRODUCTS)


def _table() -> tuple[Tensor, Tensor]:
    """Where the entries of (A | -g), 12 x 13, are among the 7 x 10 moments, and their signs, 0 for those that are 0.

    The rows of the moments: 1, -u, -v, u^2 + v^2 for A, and three for g.
    """
    where, present = torch.zeros(12, 13, dtype=torch.long), torch.ones(12, 13, dtype=torch.float64)
    factor = {(0, 0): 0, (1, 1): 0, (0, 2): 1, (1, 2): 2, (2, 2): 3}
    for row in range(12):
        for column in range(12):
            blocks, pair = sorted((row // 4, column // 4)), sorted((row % 4, column % 4))
            if blocks == [0, 1]:
                present[row, column] = 0
            else:
                where[row, column] = _WIDTH * factor[blocks[0], blocks[1]] + _PRODUCTS.index((pair[0], pair[1]))
        present[row, 12] = -1
        where[row, 12] = _WIDTH * (4 + row // 4) + _PRODUCTS.index((row % 4, 3))
    return where.flatten(), present


def _generators() -> Tensor:
    """The derivatives of P exp(w, v) by (w, v) at 0, for P exp(w, v) = P [exp(w) | v; 0 1]: linear in P, 12 x (12 6)."""
    linear = torch.zeros(3, 4, 3, 4, 6, dtype=torch.float64)
    for row in range(3):
        for axis in range(3):
            after, last = (axis + 1) % 3, (axis + 2) % 3
            linear[row, last, row, after, axis] = 1
            linear[row, after, row, last, axis] = -1
            linear[row, axis, row, 3, 3 + axis] = 1
    return linear.reshape(12, 72)


_WHERE, _PRESENT = _table()
_GENERATORS = _generators()
_CROSS = torch.zeros(3, 9, dtype=torch.float64)
"""From w to [w]x."""
for _axis in range(3):
    _CROSS[_axis, 3 * ((_axis + 2) % 3) + (_axis + 1) % 3] = 1
    _CROSS[_axis, 3 * ((_axis + 1) % 3) + (_axis + 2) % 3] = -1
_ONE, _MINUS = torch.ones(1, 1, 1, dtype=torch.float64), torch.tensor(-1.0, dtype=torch.float64)


class _Views:
    """Cameras and data in the form (problem, camera, ...): several cameras of the same data share what is of the data."""

    def __init__(self, P: Tensor, x: Tensor, X: Tensor) -> None:
        n = X.shape[-2]
        data = broadcast_shapes(x.shape[:-2], X.shape[:-2])
        self.batch = broadcast_shapes(P.shape[:-2], data)
        shared = bool(self.batch) and (not data or data[-1] == 1)
        lead = self.batch[:-1] if shared else self.batch
        self.cameras = self.batch[-1] if shared else 1
        if shared:
            x, X = (d[..., 0, :, :] if d.ndim > 2 else d for d in (x, X))
        self.x = _flat(x.mT, lead, 2, n)
        self.points = torch.cat((_flat(X.mT, lead, 3, n), self.x.new_ones(1, 1, 1).expand(self.x.shape[0], 1, n)), 1)
        self.P = _flat(P, self.batch, 3, 4).reshape(-1, 3 * self.cameras, 4)

    def project(self) -> Tensor:
        """Homogeneous images (problem, camera, 3, n)."""
        y = torch.bmm(self.P, self.points)
        return y.view(len(y), self.cameras, 3, y.shape[-1])


def _flat(t: Tensor, batch: torch.Size, rows: int, columns: int) -> Tensor:
    """One batch dimension."""
    if t.shape[:-2] != batch:
        t = t.expand(*batch, rows, columns)
    return t if t.ndim == 3 else t.reshape(-1, rows, columns)


def squared_reprojection(
    P: Float[Tensor, "*#batch 3 4"], x: Float[Tensor, "*#batch n 2"], X: Float[Tensor, "*#batch n 3"]
) -> Float[Tensor, "*batch n"]:
    """Squared reprojection error; infinite behind the camera."""
    views = _Views(P, x, X)
    y = views.project()
    z, inverse = _minus_inverse(y[:, :, 2])
    return _squares(torch.addcmul(views.x[:, None], y[:, :, :2], inverse[:, :, None]), y, z).view(*views.batch, x.shape[-2])


def _minus_inverse(depth: Tensor) -> tuple[Tensor, Tensor]:
    """Depths made positive, and -1 over them."""
    z = depth.clamp_min(torch.finfo(depth.dtype).tiny ** 0.4)
    return z, torch.div(_MINUS, z)


def _squares(r: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """The squared lengths of r, infinite where the depth is not the positive one; comparisons and masks would cost more."""
    big = torch.finfo(z.dtype).max
    r0, r1 = r.unbind(2)
    behind = (z.detach() - y[:, :, 2].detach()).mul_(big)
    return torch.addcmul(r0 * r0, r1, r1).add_(behind, alpha=big)


def normal_equations(
    P: Float[Tensor, "*#batch 3 4"], x: Float[Tensor, "*#batch n 2"], X: Float[Tensor, "*#batch n 3"], weigh: Weigh
) -> tuple[Float[Tensor, "b 12 13"], torch.Size]:
    """(J'CJ | -J'Wr) over the entries of P in float64 with the weights W and C of `weigh`, and the batch that b stands for."""
    views = _Views(P, x, X)
    n, points = X.shape[-2], views.points
    y = views.project()
    z, inverse = _minus_inverse(y[:, :, 2])
    m = y[:, :, :2] * inverse[:, :, None]
    r = views.x[:, None] + m
    weights, curvature = weigh(_squares(r, y, z).view(*views.batch, n))
    shape = inverse.shape
    weights, curvature = (w.expand(*views.batch, n).reshape(shape) for w in (weights, curvature))
    c = curvature * (inverse * inverse)
    slope = (weights * inverse)[:, :, None] * r
    first = c[:, :, None] * m
    m0, m1 = m.unbind(2)
    both = torch.addcmul(first[:, :, 0] * m0, first[:, :, 1], m1)
    last = torch.addcmul(slope[:, :, 0] * m0, slope[:, :, 1], m1)
    left = torch.cat((c[:, :, None], first, both[:, :, None], slope, last[:, :, None]), 2)
    a, b, e = points[:, :1], points[:, 1:2], points[:, 2:3]
    right = torch.cat((a * points[:, :3], b * points[:, 1:3], e * e, points), 1)
    moments = torch.bmm(left.view(len(y), -1, n), right.mT).view(-1, 7 * _WIDTH).double()
    device = moments.device
    entries = moments.index_select(1, _WHERE.to(device)).view(-1, 12, 13) * _PRESENT.to(device)
    return entries, views.batch


def pose_step(
    model: Float[Tensor, "*#batch 3 4"],
    K: Float[Tensor, "*#batch 3 3"],
    x: Float[Tensor, "*#batch n 2"],
    X: Float[Tensor, "*#batch n 3"],
    weigh: Weigh,
) -> Float[Tensor, "*batch 3 4"]:
    """The pose [R | t] of cameras K [R | t] after a step.

    The world moves, not the camera: turning about the middle of the points has little in common with shifting them.
    """
    P = K @ model
    S, batch = normal_equations(P, x, X, weigh)
    B = pose_directions(_flat(P.double(), batch, 3, 4))
    half = torch.bmm(B.mT, S)
    step = damped_solve(torch.bmm(half[..., :12], B), half[..., 12:])
    return moved_pose(_flat(model.double(), batch, 3, 4), step).to(x.dtype).view(*batch, 3, 4)


def pose_directions(P: Float[Tensor, "b 3 4"]) -> Float[Tensor, "b 12 6"]:
    """The derivatives of cameras by a step (w, v) of the world."""
    return torch.mm(P.reshape(-1, 12), _GENERATORS.to(P.device)).view(-1, 12, 6)


def moved_pose(pose: Float[Tensor, "b 3 4"], step: Float[Tensor, "b 6 1"]) -> Float[Tensor, "b 3 4"]:
    """[R C(w) | t + R v] with Cayley's C, which is exp to second order, made a rotation to rounding.

    What a start in lower precision lacks to a rotation is mended first.
    """
    R, t = pose[..., :3], pose[..., 3:]
    w, v = step[:, :3], step[:, 3:]
    R = torch.baddbmm(R, R, R.mT @ R, beta=1.5, alpha=-0.5)
    W = torch.mm(w[..., 0], _CROSS.to(pose.device)).view(-1, 3, 3)
    # (1 - W/2)^-1 (1 + W/2)
    turn = torch.baddbmm(W, W, W, alpha=0.5) / torch.baddbmm(_ONE.to(pose.device), w.mT, w, alpha=0.25)
    return torch.cat((torch.baddbmm(R, R, turn), torch.baddbmm(t, R, v)), -1)
