"""Distances of image points to the images of known points, and Gauss-Newton steps on them: all data of many cameras at once.

A camera P sees X at (u, v) = (p, q) / z. With h = (X, 1) / z the derivatives of u and v by the rows of P are (h, 0, -u h) and
(0, h, -v h), see `torchsfm.geometry.projection.camera_slopes`. They need not be formed: the normal equations are moments of the
products of (X, 1), which belong to the data, with 1, u, v and u^2 + v^2 over z^2, which belong to the camera. Those of a camera
with fewer parameters follow from them.
"""

from math import prod

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import broadcast_shapes
from torchsfm.geometry.image_distance import positive_depth, squared_in_front
from torchsfm.linalg import damped_solve
from torchsfm.linalg.constants import Constant
from torchsfm.optim import rotation_exponential
from torchsfm.robust import Weigh

_PRODUCTS = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2), (0, 3), (1, 3), (2, 3), (3, 3)]
"""Products of the coordinates of (X, 1); the last four are (X, 1) itself."""


def _table() -> tuple[Tensor, Tensor]:
    """Where the entries of (A | -g), 12 x 13, are among the moments, and their signs, 0 for those that are 0.

    The moments: 1, u, v, u^2 + v^2 by ten products for A, and three by (X, 1) for g.
    """
    where, sign = torch.zeros(12, 13, dtype=torch.long), torch.ones(12, 13, dtype=torch.float64)
    factor = {(0, 0): 0, (1, 1): 0, (0, 2): 1, (1, 2): 2, (2, 2): 3}
    for row in range(12):
        for column in range(12):
            blocks, pair = sorted((row // 4, column // 4)), sorted((row % 4, column % 4))
            if blocks == [0, 1]:
                sign[row, column] = 0
            else:
                sign[row, column] = -1 if blocks in ([0, 2], [1, 2]) else 1
                where[row, column] = 10 * factor[blocks[0], blocks[1]] + _PRODUCTS.index((pair[0], pair[1]))
        where[row, 12], sign[row, 12] = 40 + row, 1 if row < 8 else -1
    return where.flatten(), sign


def _generators() -> Tensor:
    """Derivatives of diag(e^g, e^g, 1) P exp(w, v) by (w, v, g) at 0, linear in P: 12 x (12 7).

    Here P exp(w, v) = P [exp(w) | v; 0 1].
    """
    linear = torch.zeros(3, 4, 3, 4, 7, dtype=torch.float64)
    for row in range(3):
        for axis in range(3):
            after, last = (axis + 1) % 3, (axis + 2) % 3
            linear[row, last, row, after, axis] = 1
            linear[row, after, row, last, axis] = -1
            linear[row, axis, row, 3, 3 + axis] = 1
        for column in range(4 if row < 2 else 0):
            linear[row, column, row, column, 6] = 1
    return linear.reshape(12, 12, 7)


def _cross() -> Tensor:
    """From w to [w]x, 3 x 9."""
    linear = torch.zeros(3, 3, 3, dtype=torch.float64)
    for axis in range(3):
        after, last = (axis + 1) % 3, (axis + 2) % 3
        linear[axis, last, after], linear[axis, after, last] = 1, -1
    return linear.reshape(3, 9)


_WHERE, _SIGN = (Constant(part) for part in _table())
_GENERATORS = {size: Constant(_generators()[..., :size].reshape(12, -1)) for size in (6, 7)}
_CROSS, _ONE = Constant(_cross()), Constant(torch.ones(1, 1, 1, dtype=torch.float64))


class _Views:
    """Cameras and data in the form (problem, camera, ...): several cameras of the same data share what is of the data."""

    def __init__(self, P: Tensor, x: Tensor, X: Tensor) -> None:
        self.n = n = X.shape[-2]
        data = broadcast_shapes(x.shape[:-2], X.shape[:-2])
        self.batch = broadcast_shapes(P.shape[:-2], data)
        shared = bool(self.batch) and (not data or data[-1] == 1)
        lead, self.k = (self.batch[:-1], self.batch[-1]) if shared else (self.batch, 1)
        if shared:
            x, X = (d[..., 0, :, :] if d.ndim > 2 else d for d in (x, X))
        self.x, self.X = _flat(x.mT, lead, 2, n).unsqueeze(1), _flat(X.mT, lead, 3, n)
        self.P = _flat(P, self.batch, 3, 4).reshape(self.X.shape[0], 3 * self.k, 4)

    def one(self) -> Tensor:
        """The fourth coordinate of the points."""
        return torch.ones_like(self.X[:, :1])

    def project(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Homogeneous images (problem, camera, 2 and 1, n), the depths made positive, and 1 over them."""
        y = torch.bmm(self.P, points).view(points.shape[0], self.k, 3, self.n)
        image, depth = y[:, :, :2], y[:, :, 2:]
        return image, depth, *positive_depth(depth)

    def squares(self, r: Tensor, depth: Tensor, z: Tensor) -> Tensor:
        """The squared lengths of r; infinite behind the camera."""
        return squared_in_front(r[:, :, :1], r[:, :, 1:], depth, z).view(*self.batch, self.n)


def _scalar_product(a: Float[Tensor, "b k 2 n"], b: Float[Tensor, "b k 2 n"]) -> Float[Tensor, "b k 1 n"]:
    (a0, a1), (b0, b1) = a.chunk(2, 2), b.chunk(2, 2)
    return torch.addcmul(a0 * b0, a1, b1)


def _flat(t: Tensor, batch: torch.Size, rows: int, columns: int) -> Tensor:
    """One batch dimension."""
    if t.shape[:-2] != batch:
        t = t.expand(*batch, rows, columns)
    return t if t.ndim == 3 else t.reshape(prod(batch), rows, columns)


def squared_reprojection(
    P: Float[Tensor, "*#batch 3 4"], x: Float[Tensor, "*#batch n 2"], X: Float[Tensor, "*#batch n 3"]
) -> Float[Tensor, "*batch n"]:
    """Squared reprojection error; infinite behind the camera."""
    views = _Views(P, x, X)
    image, depth, z, inverse = views.project(torch.cat((views.X, views.one()), 1))
    return views.squares(torch.addcmul(views.x, image, inverse, value=-1), depth, z)


def normal_equations(
    P: Float[Tensor, "*#batch 3 4"], x: Float[Tensor, "*#batch n 2"], X: Float[Tensor, "*#batch n 3"], weigh: Weigh
) -> tuple[Float[Tensor, "b 12 13"], torch.Size]:
    """(J'CJ | -J'Wr) over the entries of P in float64 with the weights W and C of `weigh`, and the batch that b stands for."""
    views = _Views(P, x, X)
    X, n, k = views.X, views.n, views.k
    a, b, c = X.chunk(3, 1)
    products = torch.cat((X * a, X[:, 1:] * b, c * c, X, views.one()), 1)
    points = products[:, 6:]
    image, depth, z, inverse = views.project(points)
    uv = image * inverse
    r = views.x - uv
    slope, curvature = weigh(views.squares(r, depth, z))
    slope, curvature = (w.expand(*views.batch, n).reshape(z.shape) for w in (slope, curvature))
    c, slope = curvature * (inverse * inverse), slope * inverse * r
    first = c * uv
    both, last = _scalar_product(first, uv), _scalar_product(slope, uv)
    matrix = torch.bmm(torch.cat((c, first, both), 2).view(X.shape[0], 4 * k, n), products.mT)
    vector = torch.bmm(torch.cat((slope, last), 2).view(X.shape[0], 3 * k, n), points.mT)
    moments = torch.cat((matrix.view(X.shape[0] * k, 40), vector.view(X.shape[0] * k, 12)), 1).double()
    entries = moments.index_select(1, _WHERE.on(X.device)).view(-1, 12, 13) * _SIGN.on(X.device)
    return entries, views.batch


def camera_step(
    P: Float[Tensor, "*#batch 3 4"], size: int, x: Float[Tensor, "*#batch n 2"], X: Float[Tensor, "*#batch n 3"], weigh: Weigh
) -> tuple[Float[Tensor, "b k 1"], torch.Size]:
    """The step (w, v) or (w, v, g) of cameras diag(e^g, e^g, 1) P exp(w, v), of 6 or 7 parameters, and the batch of b.

    The world moves, not the camera: turning about the middle of the points has little in common with shifting them.
    """
    S, batch = normal_equations(P, x, X, weigh)
    flat = _flat(P.double(), batch, 3, 4).reshape(-1, 12)
    B = torch.mm(flat, _GENERATORS[size].on(P.device)).view(-1, 12, size)
    half = torch.bmm(B.mT, S)
    return damped_solve(torch.bmm(half[..., :12], B), half[..., 12:]), batch


def moved_pose(
    pose: Float[Tensor, "*#batch 3 4"], step: Float[Tensor, "b k 1"], batch: torch.Size
) -> Float[Tensor, "*batch 3 4"]:
    """[R C(w) | t + R v] in float64 with Cayley's C, which is exp to second order.

    What a start in lower precision lacks to a rotation is mended.
    """
    pose, w = _flat(pose.double(), batch, 3, 4), step[:, :3]
    W = torch.mm(w[..., 0], _CROSS.on(w.device)).view(-1, 3, 3)
    # (1 - W/2)^-1 (1 + W/2)
    turn = torch.baddbmm(W, W, W, alpha=0.5) / torch.baddbmm(_ONE.on(w.device), w.mT, w, alpha=0.25)
    moved = torch.baddbmm(pose, pose[..., :3], torch.cat((turn, step[:, 3:6]), -1))
    R = moved[..., :3]
    mended = torch.baddbmm(R, R, torch.bmm(R.mT, R), beta=1.5, alpha=-0.5)
    return torch.cat((mended, moved[..., 3:]), -1).view(*batch, 3, 4)


def retracted_pose(pose: Float[Tensor, "*#batch 3 4"], step: Float[Tensor, "*#batch 6"]) -> Float[Tensor, "*batch 3 4"]:
    """[R | t] <- exp(w) [R | t] + [0 | v], differentiable, as `Pose.retract`."""
    moved = rotation_exponential(step[..., :3]) @ pose
    return torch.cat((moved[..., :3], moved[..., 3:] + step[..., 3:, None]), -1)
