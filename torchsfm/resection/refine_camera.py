"""The pose, and on request the inside, of cameras whose reprojection error is smallest."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, check_tensors, tensor_map
from torchsfm.geometry import Camera, Distortion, Pose
from torchsfm.optim import Loss, attach_optimum, levenberg_marquardt, loss_slope, wants_derivative

State = tuple[Pose, Tensor]
"""A pose, and the displacements of the free parameters."""
INSIDE = ("focal", "aspect", "principal_point")


@dataclass(frozen=True)
class CameraRefinement:
    """Refined cameras and how well they are determined."""

    pose: Pose
    """`cam_from_world`."""
    camera: Camera
    """With the free parameters changed."""
    covariance: Float[Tensor, "*batch p p"]
    """Of the pose, as a perturbation (w, v) on the left in the camera's frame (`Pose.retract`), followed by the free
    parameters in the order given: logarithms of focal length and aspect, principal point in pixels, distortion. For
    independent noise of variance 1 / weight in every image coordinate; zero where not determined."""
    in_front: Bool[Tensor, "*batch n"]
    """Which points have positive depth."""
    error: Float[Tensor, "*batch"]
    """Weighted root-mean-square reprojection error in pixels, whatever the loss."""
    cost: Float[Tensor, "*batch"]
    """Half the weighted sum of losses, which is what was minimised."""
    iterations: Int[Tensor, "*batch"]
    status: Int[Tensor, "*batch"]
    """OK, NOT_CONVERGED, TOO_FEW, NOT_FINITE; DEGENERATE: the parameters are not determined (points in a line, all far away,
    ...); BEHIND: half of the weight or more is behind the camera."""

    @property
    def model(self) -> Float[Tensor, "*batch 3 4"]:
        """The pose as a matrix `[R | t]`."""
        return self.pose.matrix()


def refine_camera(
    x: Float[Tensor, "*#batch n 2"],
    X: Float[Tensor, "*#batch n 3"],
    pose: Pose,
    camera: Camera,
    *,
    free: Sequence[str] = (),
    weights: Float[Tensor, "*#batch n"] | Bool[Tensor, "*#batch n"] | None = None,
    loss: Loss | None = None,
    max_iterations: int = 50,
) -> CameraRefinement:
    """Minimise reprojection errors over the pose of every camera of a batch, and over chosen parameters of its inside.

    Batched Levenberg-Marquardt, each camera with its own damping and its own stop. `pose` is the start, and so is
    `camera` for the parameters that are free. The pose carries the derivative of the optimum with respect to x, X,
    weights and what of the camera is held fixed. Points whose image or position is not finite make their camera
    NOT_FINITE unless their weight is 0.

    Args:
        x: Image points in pixels, distorted as the camera distorts.
        X: The points in the world.
        pose: Starting poses.
        camera: The cameras.
        free: Any of "focal" (one factor for both focal lengths), "aspect" (their ratio), "principal_point" and the
            names of the distortion's parameters ("k1", ...).
        weights: Factors of the points' losses, 0 or False for absent.
        loss: A robust loss of squared distances in pixels (see `torchsfm.optim.loss`); squared error by default.
        max_iterations: Most steps for each camera.

    Returns:
        Poses, cameras, covariances, errors and a status per camera.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, or `free` names what the camera does not have.
    """
    names = (*INSIDE, *camera.distortion.parameter_names)
    unknown = [name for name in free if name not in names]
    if unknown or len(set(free)) != len(free):
        raise ValueError(f"free: wanted distinct names out of {names}, got {tuple(free)}")
    floating = weights if weights is None or weights.dtype != torch.bool else weights.to(x.dtype)
    batch = check_tensors(x=(x, "n 2"), X=(X, "n 3"), R=(pose.R, "3 3"), K=(camera.K, "3 3"), weights=(floating, "n"))
    x, X = x.expand(*batch, *x.shape[-2:]), X.expand(*batch, *X.shape[-2:])
    pose = Pose(pose.R.expand(*batch, 3, 3), pose.t.expand(*batch, 3))
    camera = _expand(camera, batch)
    w = torch.ones(x.shape[:-1], dtype=x.dtype, device=x.device) if floating is None else floating.expand(x.shape[:-1])
    wanted = ~(w <= 0)
    finite = torch.isfinite(x).all(-1) & torch.isfinite(X).all(-1) & torch.isfinite(w)
    bad = (wanted & ~finite).any(-1) | ~(torch.isfinite(pose.R).all(-1).all(-1) & torch.isfinite(pose.t).all(-1))
    bad = bad | ~torch.isfinite(camera.K).all(-1).all(-1)
    use = wanted & finite & ~bad[..., None]
    w = torch.where(use, w, 0.0)
    x, X = torch.where(use[..., None], x, 0.0), torch.where(use[..., None], X, 0.0)

    # The origin of the world goes to the points: far coordinates must not cost digits.
    total = w.detach().sum(-1, keepdim=True)
    middle = (w.detach()[..., None] * X.detach()).sum(-2) / torch.where(total > 0, total, 1.0)
    local = X - middle[..., None, :]
    t = (pose.R @ middle[..., None])[..., 0] + pose.t
    start = Pose(torch.where(bad[..., None, None], torch.eye(3, dtype=x.dtype, device=x.device), pose.R), t)
    problem = _Problem(tuple(free), loss)
    theta = torch.zeros(*batch, problem.size, dtype=x.dtype, device=x.device)
    data = (x, local, w, camera)
    with torch.no_grad():
        fixed = tensor_map(torch.Tensor.detach, data)
        state = tensor_map(torch.Tensor.detach, (start, theta))
        result = levenberg_marquardt(
            problem.residual, state, fixed[0], fixed[1], fixed[3], retract=problem.retract, size=6 + problem.size,
            weights=fixed[2], loss=loss, linearize=problem.linearize, max_iterations=max_iterations,
            function_tolerance=1e-9 if loss is None else 1e-6, step_tolerance=1e-12,
        )  # fmt: skip
        state = result.x
        for _ in range(2 if loss is None else 5):
            state = problem.settle(state, *fixed)
    refined, theta = problem.attach(state, data, (result.status == Status.OK) & ~bad)
    inside = _Inside(camera, problem.free)
    with torch.no_grad():
        r, J = _linearize(refined.transform(local), x, theta, inside)
        square = (r * r).sum(-1).double()
        J = J.double()
        N = (J * problem.slopes(r, w)[..., None, None]).flatten(-3, -2).mT @ J.flatten(-3, -2)
        covariance, determined = _inverse(N)
        depth = refined.transform(local)[..., 2]
        in_front = depth > 0
        ahead = torch.where(in_front, w, 0.0).sum(-1)
        error = ((w.double() * square).sum(-1) / torch.where(total[..., 0] > 0, total[..., 0], 1.0).double()).sqrt()
    status = result.status
    for condition, code in (
        ((status == Status.OK) & (2 * ahead <= total[..., 0]), Status.BEHIND),
        ((status != Status.TOO_FEW) & ~determined, Status.DEGENERATE),
        (bad, Status.NOT_FINITE),
    ):
        status = torch.where(condition, int(code), status)
    known = determined & ~bad
    R = refined.R
    world = Pose(R, refined.t - (R @ middle[..., None])[..., 0])
    world = Pose(torch.where(bad[..., None, None], torch.eye(3, dtype=R.dtype, device=R.device), R), _or_zero(world.t, ~bad))
    return CameraRefinement(
        world,
        inside.moved(theta),
        torch.where(known[..., None, None], covariance, 0.0).to(x.dtype),
        in_front & ~bad[..., None],
        _or_zero(error, ~bad).to(x.dtype),
        _or_zero(result.cost, ~bad).to(x.dtype),
        result.iterations,
        status,
    )


def _or_zero(value: Tensor, good: Tensor) -> Tensor:
    return torch.where(_like(good, value), value, 0.0)


def _expand(camera: Camera, batch: torch.Size) -> Camera:
    """The camera with the full batch shape."""
    distortion = tensor_map(lambda p: p.expand(batch), camera.distortion)
    return Camera(camera.K.expand(*batch, 3, 3), distortion)


def _changed(distortion: Distortion, parameters: dict[str, Tensor]) -> Distortion:
    changed: Distortion = replace(distortion, **parameters)  # type: ignore[arg-type]
    return changed


@dataclass(frozen=True)
class _Problem:
    """The least-squares problem over states (pose, theta), data (x, X, weights, camera)."""

    free: tuple[str, ...]
    loss: Loss | None

    @property
    def size(self) -> int:
        return len(self.free) + ("principal_point" in self.free)

    def residual(self, state: State, x: Tensor, X: Tensor, camera: Camera) -> Tensor:
        pose, theta = state
        return _Inside(camera, self.free).moved(theta).project(pose.transform(X)) - x

    def linearize(self, state: State, x: Tensor, X: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
        pose, theta = state
        return _linearize(pose.transform(X), x, theta, _Inside(camera, self.free))

    def retract(self, state: State, delta: Tensor) -> State:
        pose, theta = state
        return pose.retract(delta[..., :6]), theta + delta[..., 6:]

    def slopes(self, r: Tensor, w: Tensor) -> Tensor:
        """What the loss makes of the weights."""
        return w.double() if self.loss is None else w.double() * loss_slope(self.loss, (r * r).sum(-1).double())

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
        N = (J * slope[..., None, None]).flatten(-3, -2).mT @ J.flatten(-3, -2)
        inverse, sound = _inverse(N)
        if self.loss is not None:
            bent, convex = _inverse(N + 2 * (pulled * (w.double() * self._bend(r))[..., None]).mT @ pulled)
            inverse = torch.where(convex[..., None, None], bent, inverse)
        step = -(inverse @ g[..., None])[..., 0]
        cost = self.cost(r, w)
        step = torch.where((sound & (-(step * g).sum(-1) <= 1e-2 * cost))[..., None], step, 0.0)
        new = self.retract(state, step.to(x.dtype))
        better = self.cost(self.residual(new, x, X, camera).double(), w) <= cost * (1 + 1e-12) + 1e-300
        pose = Pose(*(torch.where(_like(better, a), a, b) for a, b in ((new[0].R, state[0].R), (new[0].t, state[0].t))))
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
class _Inside:
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


def _linearize(Y: Tensor, x: Tensor, theta: Tensor, inside: _Inside) -> tuple[Tensor, Tensor]:
    """Residuals (*batch, n, 2) and their derivatives (*batch, n, 2, 6 + size) at points Y in the cameras' frames.

    Every residual depends on its own point and on its camera alone, so that one backward sweep for each of the two
    coordinates gives the derivatives with respect to the points and, with the parameters repeated for every point, to
    the parameters.
    """
    n = Y.shape[-2]
    with torch.enable_grad():
        points = Y.detach().requires_grad_()
        thetas = theta.detach()[..., None, :].expand(*theta.shape[:-1], n, -1).clone().requires_grad_()
        repeated = tensor_map(lambda v: v.detach(), inside.camera)
        repeated = _repeat(repeated, n)
        u = _Inside(repeated, inside.free).moved(thetas).project(points[..., None, :])[..., 0, :]
        sweeps = [
            torch.autograd.grad(u[..., i].sum(), (points, thetas), retain_graph=True, materialize_grads=True, allow_unused=True)
            for i in range(2)
        ]
    D = torch.stack([points_grad for points_grad, _ in sweeps], -2)
    D_theta = torch.stack([theta_grad for _, theta_grad in sweeps], -2)
    # Y moves by w x Y + v, and a row d of D by d' (w x Y) = w' (Y x d).
    turn = torch.linalg.cross(Y.detach()[..., None, :].expand_as(D), D, dim=-1)
    return u.detach() - x, torch.cat((turn, D, D_theta), -1)


def _repeat(camera: Camera, n: int) -> Camera:
    """The camera once for each of n points, as a further batch dimension."""
    K = camera.K[..., None, :, :].expand(*camera.K.shape[:-2], n, 3, 3)
    return Camera(K, tensor_map(lambda p: p[..., None].expand(*p.shape, n), camera.distortion))


def _inverse(N: Tensor) -> tuple[Tensor, Tensor]:
    """The inverse of positive definite matrices, scaled to a unit diagonal before, and where there is one."""
    diagonal = N.diagonal(dim1=-2, dim2=-1)
    positive = (diagonal > 0).all(-1) & torch.isfinite(N).all(-1).all(-1)
    eye = torch.eye(N.shape[-1], dtype=N.dtype, device=N.device)
    root = torch.where(positive[..., None], diagonal, 1.0).rsqrt()
    scaled = torch.where(positive[..., None, None], N * root[..., :, None] * root[..., None, :], eye)
    values, vectors = torch.linalg.eigh(scaled)
    determined = positive & (values[..., 0] > 1e-13)
    inverse = (vectors / torch.where(determined[..., None], values, 1.0)[..., None, :]) @ vectors.mT
    return inverse * root[..., :, None] * root[..., None, :], determined


def _like(mask: Tensor, value: Tensor) -> Tensor:
    """A mask with the dimensions of a value."""
    return mask.reshape(mask.shape + (1,) * (value.ndim - mask.ndim))
