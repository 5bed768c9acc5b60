"""The least-squares problem of distances in the image over a pose and the inside of a camera."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm.geometry import Camera, Pose
from torchsfm.geometry.intrinsic_parameters import intrinsic_columns, move_camera, row_from_camera
from torchsfm.geometry.projection import PixelProjection, turn_slopes
from torchsfm.linalg import eigh
from torchsfm.optim import Loss, attach_optimum, loss_slope, wants_derivative
from torchsfm.resection.line_chords import chord_distances

State = tuple[Pose, Tensor]
"""A pose, and the displacements of the free parameters."""


@dataclass(frozen=True)
class Reprojection:
    """The least-squares problem over states (pose, theta), data (x, X, weights, camera), all float64."""

    free: tuple[str, ...]
    loss: Loss | None
    size: int
    """Numbers that are free."""
    skew: bool
    """Whether any camera has skew; False saves time."""
    points: int | None = None
    """How many points there are before the lines, each of which is two image points and four of the world (`line_chords`); all
    if not given."""

    def inside(self, camera: Camera) -> "Inside":
        """The free parameters of the inside of this camera."""
        return Inside(camera, self.free, self.skew)

    def residual(self, state: State, x: Tensor, X: Tensor, camera: Camera) -> Tensor:
        """What is seen of points and lines, less what was measured, in pixels."""
        pose, theta = state
        inside = self.inside(camera)
        pixels = inside.projection.pixels(camera_frame(pose, X.mT), inside.row(theta)).movedim(0, -1)
        if self.points is None:
            return pixels - x
        n = self.points
        away, _ = chord_distances(pixels[..., n:, :], x[..., n:, :])
        return torch.cat((pixels[..., :n, :] - x[..., :n, :], away), -2)

    def linearize(self, state: State, x: Tensor, X: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
        """The residual and its derivative by pose and free parameters."""
        pose, theta = state
        if self.points is None:
            return linearize(pose, x, X, theta, self.inside(camera))
        n = self.points
        pixels, J = linearize(pose, torch.zeros_like(X[..., :2]), X, theta, self.inside(camera))
        away, slopes = chord_distances(pixels[..., n:, :], x[..., n:, :])
        lines = (slopes[..., None] * J[..., n:, :, :].reshape(*slopes.shape, J.shape[-1])).sum((-3, -2))
        return torch.cat((pixels[..., :n, :] - x[..., :n, :], away), -2), torch.cat((J[..., :n, :, :], lines), -3)

    def in_front(self, pose: Pose, X: Tensor) -> Tensor:
        """Whether points, and all of what is seen of lines, have positive depths."""
        ahead = pose.transform(X)[..., 2] > 0
        if self.points is None:
            return ahead
        lines = ahead[..., self.points :]
        return torch.cat((ahead[..., : self.points], lines.reshape(*lines.shape[:-1], lines.shape[-1] // 4, 4).all(-1)), -1)

    def retract(self, state: State, delta: Tensor) -> State:
        """Move the pose along its tangent, the parameters by addition."""
        pose, theta = state
        return pose.retract(delta[..., :6]), theta + delta[..., 6:]

    def slopes(self, r: Tensor, w: Tensor) -> Tensor:
        """What the loss makes of the weights."""
        return w if self.loss is None else w * loss_slope(self.loss, (r * r).sum(-1))

    def normal_matrix(self, J: Tensor, slope: Tensor) -> Tensor:
        """J' diag(slope) J, for J (*batch, n, 2, 6 + size)."""
        N: Tensor = (J * slope[..., None, None]).flatten(-3, -2).mT @ J.flatten(-3, -2)
        return N

    def settle(self, state: State, x: Tensor, X: Tensor, w: Tensor, camera: Camera) -> State:
        """A Newton step near the optimum, on steps that may be too small for the cost to see them.

        The stationary point is known much better than the lowest cost. The loss enters with its second derivative (Triggs
        et al. 2000, section 4.3), without which robust losses converge slowly; that of the projection is left out.
        """
        r, J = self.linearize(state, x, X, camera)
        slope = self.slopes(r, w)
        pulled = (J * r[..., None]).sum(-2)
        g = (slope[..., None] * pulled).sum(-2)
        N = self.normal_matrix(J, slope)
        step, sound = _newton_step(N, g)
        if self.loss is not None:
            bent, convex = _newton_step(N + 2 * (pulled * (w * self._bend(r))[..., None]).mT @ pulled, g)
            step = torch.where(convex[..., None], bent, step)
        cost = self.cost(r, w)
        step = torch.where((sound & (-(step * g).sum(-1) <= 1e-2 * cost))[..., None], step, 0.0)
        new = self.retract(state, step)
        better = self.cost(self.residual(new, x, X, camera), w) <= cost * (1 + 1e-12) + 1e-300
        pose = Pose(*(torch.where(like(better, a), a, b) for a, b in ((new[0].R, state[0].R), (new[0].t, state[0].t))))
        return pose, torch.where(better[..., None], new[1], state[1])

    def cost(self, r: Tensor, w: Tensor) -> Tensor:
        """Twice the cost of residuals."""
        square = (r * r).sum(-1)
        return (w * (square if self.loss is None else self.loss(square))).sum(-1)

    def _bend(self, r: Tensor) -> Tensor:
        """The second derivative of the loss with respect to the squared residual, by differences of the first."""
        assert self.loss is not None
        square = (r * r).sum(-1).clamp_min(1e-30)
        h = 1e-4
        return (loss_slope(self.loss, square * (1 + h)) - loss_slope(self.loss, square * (1 - h))) / (2 * h * square)

    def attach(self, state: State, data: tuple[Tensor, Tensor, Tensor, Camera], good: Tensor) -> State:
        """The state with the derivative of the optimum with respect to the data."""
        x, X, w, camera = data
        model = type(camera.distortion)
        leaves = (x, X, w, camera.K, *(getattr(camera.distortion, name)[..., None] for name in model.parameter_names))

        def objective(delta: Tensor, x: Tensor, X: Tensor, w: Tensor, K: Tensor, *p: Tensor) -> Tensor:
            inside = Camera(K, model(*(v[..., 0] for v in p)))
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
    """A camera and which of its numbers are free, as relative displacements theta (*batch, size) from where they are."""

    camera: Camera
    free: tuple[str, ...]
    skew: bool

    @property
    def columns(self) -> tuple[int, ...]:
        """Free numbers in the row of a camera."""
        return intrinsic_columns(self.free, type(self.camera.distortion))

    @property
    def projection(self) -> PixelProjection:
        """From the camera's frame to pixels."""
        return PixelProjection(type(self.camera.distortion), self.columns, self.skew, relative=True)

    def moved(self, theta: Tensor) -> Camera:
        """The camera with its free parameters displaced."""
        return move_camera(self.camera, self.columns, theta)

    def row(self, theta: Tensor) -> Tensor:
        """Its numbers (k, *batch, 1), for `projection`."""
        return row_from_camera(self.moved(theta)).movedim(-1, 0)[..., None]


def linearize(pose: Pose, x: Tensor, X: Tensor, theta: Tensor, inside: Inside) -> tuple[Tensor, Tensor]:
    """Residuals (*batch, n, 2) and their derivatives (*batch, n, 2, 6 + size) by pose and theta."""
    ray = camera_frame(pose, X.mT)
    # The two coordinates of a point side by side, rows by parameter: what products of J with itself read fastest.
    J = X.new_empty(*ray.shape[1:-1], 6 + theta.shape[-1], ray.shape[-1], 2)
    out = J.movedim((-1, -3), (0, 1))
    pixels = inside.projection.linearize(ray, inside.row(theta), out[:, 3:6], out[:, 6:])
    turn_slopes(ray, out[:, 3:6], out)
    return pixels.movedim(0, -1) - x, J.movedim(-3, -1)


def camera_frame(pose: Pose, X: Tensor) -> Tensor:
    """Points (*batch, 3, n) in the cameras' frames, coordinates first (3, *batch, n)."""
    return (pose.R @ X + pose.t[..., None]).movedim(-2, 0)


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
