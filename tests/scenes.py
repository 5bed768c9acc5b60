"""Random scenes for every estimator: measurements of a known model, in the estimator's own form of data and model."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchsfm.geometry import pluecker_from_points, random_rotation, rotation_angle, rotation_from_rotvec
from torchsfm.motion import TrifocalEstimator
from torchsfm.tensors import trifocal_from_cameras
from torchsfm.tensors.canonical import canonical_frame

FOCAL = 1.5


@dataclass(frozen=True)
class Scene:
    """A batch of problems for one estimator."""

    estimator: Any
    data: tuple[Tensor, ...]
    model: Tensor
    """The model behind the data, `(*batch, ...)`."""
    error: Callable[[Tensor, Tensor], Tensor]
    """Distance between two models, without unit, blind to scale and sign where they mean nothing."""
    spoil: Callable[[tuple[Tensor, ...], Tensor, torch.Generator], tuple[Tensor, ...]]
    """Replace the data where a mask says so by wrong ones."""
    noise: float
    """The noise in the data, a standard deviation per coordinate."""


def make_scene(kind: type, batch: tuple[int, ...], n: int, generator: torch.Generator, noise: float = 0.0) -> Scene:
    """A scene for an estimator class, found by its `model_name`; float64, images about 2 wide."""
    return _SCENES[kind.model_name](kind, batch, n, generator, noise)  # type: ignore[attr-defined]


def _points(batch: tuple[int, ...], n: int, generator: torch.Generator) -> Tensor:
    X = torch.rand(*batch, n, 3, generator=generator, dtype=torch.float64) * 4 - 2
    return X + torch.tensor([0.0, 0.0, 6.0], dtype=torch.float64)


def _motion(batch: tuple[int, ...], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    w = (torch.rand(*batch, 3, generator=generator, dtype=torch.float64) - 0.5) * 0.8
    t = torch.randn(*batch, 3, generator=generator, dtype=torch.float64)
    return rotation_from_rotvec(w), t / t.norm(dim=-1, keepdim=True)


def _image(X: Tensor, noise: float, generator: torch.Generator) -> Tensor:
    x = X[..., :2] / X[..., 2:] * FOCAL
    return x + noise * torch.randn(x.shape, generator=generator, dtype=torch.float64)


def _skew(t: Tensor) -> Tensor:
    zero = torch.zeros_like(t[..., 0])
    x, y, z = t.unbind(-1)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).reshape(*t.shape[:-1], 3, 3)


def _wrong_last(data: tuple[Tensor, ...], wrong: Tensor, generator: torch.Generator) -> tuple[Tensor, ...]:
    """Spread the second points over the image."""
    first, second = data
    anywhere = (torch.rand(second.shape, generator=generator, dtype=second.dtype) - 0.5) * 2
    if second.shape[-1] == 3:
        anywhere[..., 2] = 1
        anywhere[..., :2] *= 0.7
    return first, torch.where(wrong[..., None], anywhere, second)


def _wrong_first(data: tuple[Tensor, ...], wrong: Tensor, generator: torch.Generator) -> tuple[Tensor, ...]:
    """Spread the image points over the image, and leave what they are matched with."""
    second, first = _wrong_last((data[1], data[0]), wrong, generator)
    return first, second


def _up_to_scale(A: Tensor, B: Tensor) -> Tensor:
    A, B = (M[..., :3].flatten(-2) for M in (A, B))
    A, B = (v / v.norm(dim=-1, keepdim=True) for v in (A, B))
    return torch.minimum((A - B).norm(dim=-1), (A + B).norm(dim=-1))


def _pose_error(A: Tensor, B: Tensor) -> Tensor:
    turn = rotation_angle(A[..., :3] @ B[..., :3].mT)
    return torch.maximum(turn, (A[..., 3] - B[..., 3]).norm(dim=-1) / B[..., 3].norm(dim=-1))


def _two_views(kind: type, batch: tuple[int, ...], n: int, generator: torch.Generator, noise: float) -> Scene:
    X = _points(batch, n, generator)
    R, t = _motion(batch, generator)
    x1, x2 = _image(X, noise, generator), _image(X @ R.mT + t[..., None, :], noise, generator)
    if kind.model_name == "relative_pose":  # type: ignore[attr-defined]
        data = tuple(torch.cat((x / FOCAL, torch.ones_like(x[..., :1])), -1) for x in (x1, x2))
        slack = torch.full(batch, 1e-3, dtype=torch.float64)
        return Scene(kind(slack), data, torch.cat((R, t[..., None]), -1), _pose_error, _wrong_last, noise / FOCAL)
    if kind.model_name == "upright_pose":  # type: ignore[attr-defined]
        data = tuple(torch.cat((x / FOCAL, torch.ones_like(x[..., :1])), -1) for x in (x1, x2))
        slack = torch.full(batch, 1e-3, dtype=torch.float64)
        up = torch.nn.functional.normalize(torch.randn(*batch, 3, generator=generator, dtype=torch.float64), dim=-1)
        estimator = kind(up, (R @ up[..., None])[..., 0], slack)
        return Scene(estimator, data, torch.cat((R, t[..., None]), -1), _pose_error, _wrong_last, noise / FOCAL)
    K = torch.diag(torch.tensor([FOCAL, FOCAL, 1.0], dtype=torch.float64))
    F = K.inverse() @ _skew(t) @ R @ K.inverse()
    e = (K @ t[..., None])[..., 0]
    # e2 x h2 ~ F h1 with a positive factor in front of both cameras: K^-T [t]x = [K t]x K up to det K.
    scale = F.flatten(-2).norm(dim=-1)[..., None, None]
    model = torch.cat((F / scale, (e / e.norm(dim=-1, keepdim=True))[..., None]), -1)
    return Scene(kind(), (x1, x2), model, _up_to_scale, _wrong_last, noise)


def _three_views(kind: type, batch: tuple[int, ...], n: int, generator: torch.Generator, noise: float) -> Scene:
    """Uncalibrated, in the frame of the canonical cameras, signed so that the points are in front."""
    X = _points(batch, n, generator)
    K = torch.diag(torch.tensor([FOCAL, FOCAL, 1.0], dtype=torch.float64))
    P, x = [K @ torch.eye(3, 4, dtype=torch.float64).expand(*batch, 3, 4)], [_image(X, noise, generator)]
    for _ in range(2):
        R, t = _motion(batch, generator)
        P.append(K @ torch.cat((R, t[..., None]), -1))
        x.append(_image(X @ R.mT + t[..., None, :], noise, generator))
    # The first camera becomes [I | 0] by a map of space that keeps all points on their side.
    H = torch.eye(4, dtype=torch.float64)
    H[:3, :3] = K.inverse()
    model = canonical_frame((torch.stack(P, -3) @ H)[..., 1:, :, :], signed=False)[..., 1:, :, :]
    return Scene(kind(), tuple(x), model, _tensor_error, _wrong_last_of_three, noise)


def _three_views_with_lines(kind: type, batch: tuple[int, ...], n: int, generator: torch.Generator, noise: float) -> Scene:
    """Of seven data four are points, of more as many as not; every view has a piece of its own of each line."""
    scene = _three_views(TrifocalEstimator, batch, 3 * n, generator, 0.0)
    order = torch.rand(*batch, n, generator=generator, dtype=torch.float64).argsort(-1)[..., None]
    line = order >= 4 if n == 7 else order % 2 == 0
    data = []
    for x in scene.data:
        point, a, b = x.unflatten(-2, (3, n)).unbind(-3)
        cut = 0.3 * torch.rand(2, *batch, n, 1, generator=generator, dtype=torch.float64)
        point = point + noise * torch.randn(point.shape, generator=generator, dtype=torch.float64)
        ends = torch.cat((a + cut[0] * (b - a), b + cut[1] * (a - b)), -1)
        ends = ends + noise * torch.randn(ends.shape, generator=generator, dtype=torch.float64)
        data.append(torch.where(line, ends, torch.cat((point, point), -1)))
    return Scene(kind(), (*data, line.double()), scene.model, _tensor_error, _wrong_pieces, noise)


def _wrong_pieces(data: tuple[Tensor, ...], wrong: Tensor, generator: torch.Generator) -> tuple[Tensor, ...]:
    """Spread points and segments of the second or of the third image over it."""
    *views, kind = data
    half = torch.rand(wrong.shape, generator=generator) < 0.5
    for i, hit in ((1, wrong & half), (2, wrong & ~half)):
        views[i] = _wrong_segments((views[i], views[i], kind), hit, generator)[0]
    return *views, kind


def _tensor_error(A: Tensor, B: Tensor) -> Tensor:
    """Of trifocal tensors, and of the signs of the cameras."""
    eye = torch.eye(3, 4, dtype=A.dtype)
    T, S = (trifocal_from_cameras(eye, M[..., 0, :, :], M[..., 1, :, :]).flatten(-3) for M in (A, B))
    T, S = (v / v.norm(dim=-1, keepdim=True) for v in (T, S))
    # The left parts alone have signs that mean something.
    left, right = (M[..., :3].flatten(-2) for M in (A, B))
    same = ((left * right).sum(-1) > 0).all(-1)
    return torch.minimum((T - S).norm(dim=-1), (T + S).norm(dim=-1)) + 10 * (~same)


def _wrong_last_of_three(data: tuple[Tensor, ...], wrong: Tensor, generator: torch.Generator) -> tuple[Tensor, ...]:
    """Spread the points of the second or of the third image over it."""
    first, second, third = data
    half = torch.rand(wrong.shape, generator=generator) < 0.5
    _, second = _wrong_last((first, second), wrong & half, generator)
    _, third = _wrong_last((first, third), wrong & ~half, generator)
    return first, second, third


def _plane(kind: type, batch: tuple[int, ...], n: int, generator: torch.Generator, noise: float) -> Scene:
    normal = torch.randn(*batch, 3, generator=generator, dtype=torch.float64) * 0.3 + torch.tensor([0.0, 0.0, 1.0])
    normal = normal / normal.norm(dim=-1, keepdim=True)
    X = _points(batch, n, generator)
    X = X * (6 / (X @ normal[..., None]))
    R, t = _motion(batch, generator)
    K = torch.diag(torch.tensor([FOCAL, FOCAL, 1.0], dtype=torch.float64))
    H = K @ (R + t[..., :, None] * normal[..., None, :] / 6) @ K.inverse()
    H = H / H.flatten(-2).norm(dim=-1)[..., None, None]
    x1, x2 = _image(X, noise, generator), _image(X @ R.mT + t[..., None, :], noise, generator)
    return Scene(kind(), (x1, x2), H, _up_to_scale, _wrong_last, noise)


def _camera(kind: type, batch: tuple[int, ...], n: int, generator: torch.Generator, noise: float) -> Scene:
    Y = _points(batch, n, generator)
    R = random_rotation(*batch, generator=generator, dtype=torch.float64)
    t = torch.randn(*batch, 3, generator=generator, dtype=torch.float64) + torch.tensor([0.0, 0.0, 6.0])
    X = (Y - t[..., None, :]) @ R
    K = torch.diag(torch.tensor([FOCAL, FOCAL, 1.0], dtype=torch.float64)).expand(*batch, 3, 3)
    data = (_image(Y, noise, generator), X)
    return Scene(kind(K), data, torch.cat((R, t[..., None]), -1), _pose_error, _wrong_first, noise)


def _point_line_camera(kind: type, batch: tuple[int, ...], n: int, generator: torch.Generator, noise: float) -> Scene:
    """Each datum a point or, as often, a segment."""
    scene = _camera(kind, batch, n, generator, 0.0)
    Y = _points(batch, 2 * n, generator).unflatten(-2, (n, 2))
    R, t = scene.model[..., :3], scene.model[..., 3]
    ends = _image(Y, noise, generator).flatten(-2)
    A, B = ((Y - t[..., None, None, :]) @ R[..., None, :, :]).unbind(-2)
    L = pluecker_from_points(A, B)
    L = L / L[..., :3].norm(dim=-1, keepdim=True)
    line = torch.rand(*batch, n, 1, generator=generator) < 0.5
    x = scene.data[0] + noise * torch.randn(scene.data[0].shape, generator=generator, dtype=torch.float64)
    points = torch.cat((scene.data[1], torch.zeros_like(scene.data[1])), -1)
    data = (torch.where(line, ends, torch.cat((x, x), -1)), torch.where(line, L, points), line.double())
    return Scene(scene.estimator, data, scene.model, _pose_error, _wrong_segments, noise)


def _wrong_segments(data: tuple[Tensor, ...], wrong: Tensor, generator: torch.Generator) -> tuple[Tensor, ...]:
    """Spread points and both ends of segments over the image."""
    x, X, kind = data
    ends = torch.rand(x.shape, generator=generator, dtype=x.dtype) * 2 - 1
    anywhere = torch.where(kind > 0, ends, torch.cat((ends[..., :2], ends[..., :2]), -1))
    return torch.where(wrong[..., None], anywhere, x), X, kind


def _focal_camera(kind: type, batch: tuple[int, ...], n: int, generator: torch.Generator, noise: float) -> Scene:
    Y = _points(batch, n, generator)
    R = random_rotation(*batch, generator=generator, dtype=torch.float64)
    t = torch.randn(*batch, 3, generator=generator, dtype=torch.float64) + torch.tensor([0.0, 0.0, 6.0])
    X = (Y - t[..., None, :]) @ R
    K = torch.diag(torch.tensor([FOCAL, FOCAL, 1.0], dtype=torch.float64))
    relative = lambda A, B: (A - B).norm(dim=(-2, -1)) / B.norm(dim=(-2, -1))  # noqa: E731
    model = K @ torch.cat((R, t[..., None]), -1)
    return Scene(kind(), (_image(Y, noise, generator), X), model, relative, _wrong_first, noise)


def _projective_camera(kind: type, batch: tuple[int, ...], n: int, generator: torch.Generator, noise: float) -> Scene:
    scene = _focal_camera(kind, batch, n, generator, noise)
    return replace(scene, model=scene.model / scene.model.norm(dim=(-2, -1), keepdim=True))


def _point(kind: type, batch: tuple[int, ...], n: int, generator: torch.Generator, noise: float) -> Scene:
    """A point seen by n cameras around it."""
    X = torch.rand(*batch, 3, generator=generator, dtype=torch.float64) * 2 - 1
    R = random_rotation(*batch, n, generator=generator, dtype=torch.float64)
    t = torch.randn(*batch, n, 3, generator=generator, dtype=torch.float64) * 0.3 + torch.tensor([0.0, 0.0, 6.0])
    K = torch.diag(torch.tensor([FOCAL, FOCAL, 1.0], dtype=torch.float64))
    P = K @ torch.cat((R, t[..., None]), -1)
    Y = (R @ X[..., None, :, None])[..., 0] + t
    relative = lambda A, B: (A - B).norm(dim=-1) / 6  # noqa: E731
    return Scene(kind(), (_image(Y, noise, generator), P.flatten(-2)), X, relative, _wrong_first, noise)


def _line(kind: type, batch: tuple[int, ...], n: int, generator: torch.Generator, noise: float) -> Scene:
    """Segments of a line in n cameras around it, each of a piece of its own."""
    scene = _point(kind, batch, n, generator, 0.0)
    P = scene.data[1].unflatten(-1, (3, 4))
    d = torch.nn.functional.normalize(torch.randn(*batch, 3, generator=generator, dtype=torch.float64), dim=-1)
    at = torch.tensor([-1.0, 1.0]) + torch.rand(*batch, n, 2, generator=generator, dtype=torch.float64) - 0.5
    X = scene.model[..., None, None, :] + at[..., None] * d[..., None, None, :]
    Y = X @ P[..., :3].mT + P[..., None, :, 3]
    x = Y[..., :2] / Y[..., 2:] + noise * torch.randn(*batch, n, 2, 2, generator=generator, dtype=torch.float64)
    model = torch.cat((d, torch.linalg.cross(scene.model, d)), -1)
    error = lambda A, B: torch.minimum((A - B).norm(dim=-1), (A + B).norm(dim=-1))  # noqa: E731
    return Scene(kind(), (x.flatten(-2), scene.data[1]), model, error, _wrong_ends, noise)


def _wrong_ends(data: tuple[Tensor, ...], wrong: Tensor, generator: torch.Generator) -> tuple[Tensor, ...]:
    """Spread the ends of segments over the image."""
    anywhere = torch.rand(data[0].shape, generator=generator, dtype=data[0].dtype) * 2 - 1
    return torch.where(wrong[..., None], anywhere, data[0]), data[1]


_SCENES: dict[str, Callable[..., Scene]] = {
    "oriented_fundamental": _two_views,
    "relative_pose": _two_views,
    "upright_pose": _two_views,
    "homography": _plane,
    "point_line_trifocal": _three_views_with_lines,
    "trifocal": _three_views,
    "camera": _camera,
    "point_line_camera": _point_line_camera,
    "focal_camera": _focal_camera,
    "projective_camera": _projective_camera,
    "line": _line,
    "point": _point,
}
