"""The least-squares problem of reprojection errors over a pose and the inside of a camera."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.geometry import Camera, Distortion, NoDistortion, Pose
from torchsfm.linalg import eigh
from torchsfm.optim import Loss, attach_optimum, loss_slope, wants_derivative

State = tuple[Pose, Tensor]
"""A pose, and the displacements of the free parameters."""
INSIDE = ("focal", "aspect", "principal_point")


def _changed(distortion: Distortion, parameters: dict[str, Tensor]) -> Distortion:
    changed: Distortion = replace(distortion, **parameters)  # type: ignore[type-var]
    return changed


@dataclass(frozen=True)
class Reprojection:
    """The least-squares problem over states (pose, theta), data (x, X, weights, camera)."""

    free: tuple[str, ...]
    loss: Loss | None

    @property
    def size(self) -> int:
        return len(self.free) + ("principal_point" in self.free)

    def residual(self, state: State, x: Tensor, X: Tensor, camera: Camera) -> Tensor:
        pose, theta = state
        return Inside(camera, self.free).moved(theta).project(pose.transform(X)) - x

    def linearize(self, state: State, x: Tensor, X: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
        pose, theta = state
        return linearize(pose.transform(X), x, theta, Inside(camera, self.free))

    def retract(self, state: State, delta: Tensor) -> State:
        pose, theta = state
        return pose.retract(delta[..., :6]), theta + delta[..., 6:]

    def slopes(self, r: Tensor, w: Tensor) -> Tensor:
        """What the loss makes of the weights."""
        return w.double() if self.loss is None else w.double() * loss_slope(self.loss, (r * r).sum(-1).double())

    def normal_matrix(self, J: Tensor, slope: Tensor) -> Tensor:
        """J' diag(slope) J in float64, for J (*batch, n, 2, 6 + size)."""
        J = J.double()
        N: Tensor = (J * slope[..., None, None]).flatten(-3, -2).mT @ J.flatten(-3, -2)
        return N

    def settle(self, state: State, x: Tensor, X: Tensor, w: Tensor, camera: Camera) -> State:
        """A Newton step near the optimum, on steps that may be too small for the cost to see them.

        The stationary point is known much better than the lowest cost. The loss enters with its second derivative (Triggs
        et al. 2000, section 4.3), without which robust losses converge slowly; that of the projection is left out.
        """
        r, J = self.linearize(state, x, X, camera)
        r, J = r.double(), J.double()
        slope = self.slopes(r, w)
        pulled = (J * r[..., None]).sum(-2)
        g = (slope[..., None] * pulled).sum(-2)
        N = self.normal_matrix(J, slope)
        step, sound = _newton_step(N, g)
        if self.loss is not None:
            bent, convex = _newton_step(N + 2 * (pulled * (w.double() * self._bend(r))[..., None]).mT @ pulled, g)
            step = torch.where(convex[..., None], bent, step)
        cost = self.cost(r, w)
        step = torch.where((sound & (-(step * g).sum(-1) <= 1e-2 * cost))[..., None], step, 0.0)
        new = self.retract(state, step.to(x.dtype))
        better = self.cost(self.residual(new, x, X, camera).double(), w) <= cost * (1 + 1e-12) + 1e-300
        pose = Pose(*(torch.where(like(better, a), a, b) for a, b in ((new[0].R, state[0].R), (new[0].t, state[0].t))))
        return pose, torch.where(better[..., None], new[1], state[1])

    def cost(self, r: Tensor, w: Tensor) -> Tensor:
        """Twice the cost of residuals."""
        square = (r * r).sum(-1)
        return (w.double() * (square if self.loss is None else self.loss(square))).sum(-1)

    def _bend(self, r: Tensor) -> Tensor:
        """The second derivative of the loss with respect to the squared residual, by differences of the first."""
        assert self.loss is not None
        square = (r * r).sum(-1).clamp_min(1e-30)
        h = 1e-4
        return (loss_slope(self.loss, square * (1 + h)) - loss_slope(self.loss, square * (1 - h))) / (2 * h * square)

    def attach(self, state: State, data: tuple[Tensor, Tensor, Tensor, Camera], good: Tensor) -> State:
        """The state with the derivative of the optimum with respect to the data."""
        x, X, w, camera = data
        names = camera.distortion.parameter_names
        leaves = (x, X, w, camera.K, *(getattr(camera.distortion, name)[..., None] for name in names))

        def objective(delta: Tensor, x: Tensor, X: Tensor, w: Tensor, K: Tensor, *p: Tensor) -> Tensor:
            inside = Camera(K, _changed(camera.distortion, {name: v[..., 0] for name, v in zip(names, p, strict=True)}))
            square = self.residual(self.retract(state, delta), x, X, inside).square().sum(-1)
            return (w * (square if self.loss is None else self.loss(square))).sum(-1)

        zero = torch.zeros(*good.shape, 6 + self.size, dtype=x.dtype, device=x.device)
        if not wants_derivative(*leaves):
            return state
        moved = self.retract(state, attach_optimum(objective, zero, *leaves, valid=good))
        R, t, theta = (v - v.detach() for v in (moved[0].R, moved[0].t, moved[1]))
        return Pose(state[0].R + R, state[0].t + t), state[1] + theta


@dataclass(frozen=True)
class Inside:
    """A camera and the parameters of it that are free, as displacements theta (*batch, size) from where they are."""

    camera: Camera
    free: tuple[str, ...]

    def moved(self, theta: Tensor) -> Camera:
        """The camera with its free parameters displaced."""
        if not self.free:
            return self.camera
        rows = self.split(theta)
        K = self.camera.K
        fx, fy = K[..., 0, 0], K[..., 1, 1]
        skew, cx, cy = K[..., 0, 1], K[..., 0, 2], K[..., 1, 2]
        if "focal" in rows:
            factor = rows["focal"][0].exp()
            fx, fy, skew = fx * factor, fy * factor, skew * factor
        if "aspect" in rows:
            fy = fy * rows["aspect"][0].exp()
        if "principal_point" in rows:
            cx, cy = cx + rows["principal_point"][0], cy + rows["principal_point"][1]
        zero, one = torch.zeros_like(fx), torch.ones_like(fx)
        matrix = torch.stack((fx, skew, cx, zero, fy, cy, zero, zero, one), -1).reshape(*fx.shape, 3, 3)
        changes = {name: getattr(self.camera.distortion, name) + rows[name][0] for name in self.free if name not in INSIDE}
        return Camera(matrix, _changed(self.camera.distortion, changes))

    def split(self, theta: Tensor) -> dict[str, tuple[Tensor, ...]]:
        """The displacements by name."""
        rows, i = {}, 0
        for name in self.free:
            width = 2 if name == "principal_point" else 1
            rows[name] = tuple(theta[..., i + j] for j in range(width))
            i += width
        return rows


def linearize(Y: Tensor, x: Tensor, theta: Tensor, inside: Inside) -> tuple[Tensor, Tensor]:
    """Residuals (*batch, n, 2) and their derivatives (*batch, n, 2, 6 + size) at points Y in the cameras' frames.

    Every residual depends on its own point and on its camera alone, so that one backward sweep for each of the two
    coordinates gives the derivatives with respect to the points and, with the parameters repeated for every point, to
    the parameters.
    """
    if isinstance(inside.camera.distortion, NoDistortion):
        return _linearize_pinhole(Y, x, theta, inside)
    n = Y.shape[-2]
    with torch.enable_grad():
        points = Y.detach().requires_grad_()
        thetas = theta.detach()[..., None, :].expand(*theta.shape[:-1], n, -1).clone().requires_grad_()
        repeated = tensor_map(lambda v: v.detach(), inside.camera)
        repeated = _repeat(repeated, n)
        u = Inside(repeated, inside.free).moved(thetas).project(points[..., None, :])[..., 0, :]
        sweeps = [
            torch.autograd.grad(u[..., i].sum(), (points, thetas), retain_graph=True, materialize_grads=True, allow_unused=True)
            for i in range(2)
        ]
    D = torch.stack([points_grad for points_grad, _ in sweeps], -2)
    D_theta = torch.stack([theta_grad for _, theta_grad in sweeps], -2)
    # Y moves by w x Y + v, and a row d of D by d' (w x Y) = w' (Y x d).
    turn = torch.linalg.cross(Y.detach()[..., None, :].expand_as(D), D, dim=-1)
    return u.detach() - x, torch.cat((turn, D, D_theta), -1)


def _linearize_pinhole(Y: Tensor, x: Tensor, theta: Tensor, inside: Inside) -> tuple[Tensor, Tensor]:
    """The same without distortion, written out."""
    K = inside.moved(theta).K
    fx, skew, fy = K[..., 0, 0, None], K[..., 0, 1, None], K[..., 1, 1, None]
    y0, y1, y2 = Y.unbind(-1)
    # As `Camera.project` does near the focal plane.
    floor = torch.finfo(Y.dtype).eps * torch.maximum(y0.abs(), y1.abs())
    floor = torch.where(floor > 0, floor, 1.0)
    d = 1 / torch.where(y2.abs() > floor, y2, torch.where(y2 < 0, -floor, floor))
    a, b = y0 * d, y1 * d
    # The two coordinates of a point side by side, rows by parameter: what products of J with itself read fastest.
    J = Y.new_empty(*a.shape[:-1], 6 + theta.shape[-1], a.shape[-1], 2)
    Ju, Jv = J[..., 0], J[..., 1]
    du, dv = fx * a + skew * b, fy * b
    minus_b = -b
    Ju[..., 0, :], Ju[..., 1, :], Ju[..., 2, :] = minus_b * du - skew, a * du + fx, minus_b * fx + skew * a
    Ju[..., 3, :], Ju[..., 4, :], Ju[..., 5, :] = fx * d, skew * d, -du * d
    Jv[..., 0, :], Jv[..., 1, :], Jv[..., 2, :] = minus_b * dv - fy, a * dv, fy * a
    Jv[..., 3, :], Jv[..., 4, :], Jv[..., 5, :] = 0, fy * d, -dv * d
    i = 6
    for name in inside.free:
        if name == "principal_point":
            J[..., i : i + 2, :, :] = torch.eye(2, dtype=J.dtype, device=J.device)[:, None]
            i += 1
        else:
            Ju[..., i, :], Jv[..., i, :] = (du if name == "focal" else 0), dv
        i += 1
    u = torch.stack((du + K[..., 0, 2, None], dv + K[..., 1, 2, None]), -1)
    return u - x, J.movedim(-3, -1)


def _repeat(camera: Camera, n: int) -> Camera:
    """The camera once for each of n points, as a further batch dimension."""
    K = camera.K[..., None, :, :].expand(*camera.K.shape[:-2], n, 3, 3)
    return Camera(K, tensor_map(lambda p: p[..., None].expand(*p.shape, n), camera.distortion))


def _newton_step(N: Tensor, g: Tensor) -> tuple[Tensor, Tensor]:
    """`-N^-1 g` for positive definite N, and where there is one."""
    scale = N.diagonal(dim1=-2, dim2=-1).clamp_min(1e-280).rsqrt()
    eye = torch.eye(N.shape[-1], dtype=N.dtype, device=N.device)
    factor, info = torch.linalg.cholesky_ex(N * scale[..., :, None] * scale[..., None, :])
    sound = (info == 0) & (factor.diagonal(dim1=-2, dim2=-1).amin(-1) > 1e-6)
    factor = torch.where(sound[..., None, None], factor, eye)
    step = -torch.cholesky_solve((g * scale)[..., None], factor)[..., 0] * scale
    sound = sound & torch.isfinite(step).all(-1)
    return torch.where(sound[..., None], step, 0.0), sound


def inverse(N: Tensor) -> tuple[Tensor, Tensor]:
    """The inverse of positive definite matrices, scaled to a unit diagonal before, and where there is one."""
    diagonal = N.diagonal(dim1=-2, dim2=-1)
    positive = (diagonal > 0).all(-1) & torch.isfinite(N).all(-1).all(-1)
    eye = torch.eye(N.shape[-1], dtype=N.dtype, device=N.device)
    root = torch.where(positive[..., None], diagonal, 1.0).rsqrt()
    scaled = torch.where(positive[..., None, None], N * root[..., :, None] * root[..., None, :], eye)
    values, vectors, _ = eigh(scaled)
    determined = positive & (values[..., 0] > 1e-13)
    inverse = (vectors / torch.where(determined[..., None], values, 1.0)[..., None, :]) @ vectors.mT
    return inverse * root[..., :, None] * root[..., None, :], determined


def like(mask: Tensor, value: Tensor) -> Tensor:
    """A mask with the dimensions of a value."""
    return mask.reshape(mask.shape + (1,) * (value.ndim - mask.ndim))
