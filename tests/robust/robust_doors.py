"""Every door of robust estimation under one handle: scenes in pixels, and a call that takes them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from chance import seeded
from torch import Tensor

from torchsfm.geometry import pluecker_from_points, random_rotation, rotation_from_rotvec, rotvec_from_rotation
from torchsfm.motion import estimate_essential, estimate_fundamental, estimate_homography, estimate_trifocal, estimate_upright
from torchsfm.resection import estimate_camera, estimate_camera_focal, estimate_camera_projective
from torchsfm.robust import RobustResult
from torchsfm.triangulation import triangulate_points_robust

F64 = torch.float64
FOCAL, CENTRE, SIZE = 800.0, 500.0, 1000.0
LARGE = 20_000
K = torch.tensor([[FOCAL, 0, CENTRE], [0, FOCAL, CENTRE], [0, 0, 1]], dtype=F64)


@dataclass(frozen=True)
class Scene:
    """Exact data: `(p, n, d)` each, the images first; and what else the door wants to know, `(p, ...)`."""

    data: tuple[Tensor, ...]
    known: tuple[Tensor, ...] = ()

    def noisy(self, noise: float, wrong: float, images: int, generator: torch.Generator) -> "Scene":
        """With noise in all images, and a share of the points of the last image anywhere in it."""
        data = list(self.data)
        for i in range(images):
            data[i] = data[i] + noise * torch.randn(data[i].shape, generator=generator, dtype=F64)
        bad = torch.rand(data[0].shape[:-1], generator=generator) < wrong
        last = images - 1
        anywhere = torch.rand(data[last].shape, generator=generator, dtype=F64) * SIZE
        data[last] = torch.where(bad[..., None], anywhere, data[last])
        return replace(self, data=tuple(data))

    def at(self, i: Any, n: slice = slice(None)) -> "Scene":
        return Scene(tuple(d[i][..., n, :] for d in self.data), tuple(k[i] for k in self.known))

    def expand(self, p: int) -> "Scene":
        return Scene(*(tuple(t.expand(p, *t.shape[1:]) for t in part) for part in (self.data, self.known)))


@dataclass(frozen=True)
class Door:
    """One door.

    Attributes:
        sample_size: How many data a sample has.
        images: How many of the data are points in images; the others are known exactly.
        scene: Exact scenes of p problems with n data.
        call: The door, for data and known things in the unit of the second argument, a number of pixels.
        rank: The dimension of the model.
        step: Models against others in the terms of the covariance, if that is not of the model's entries.
        dims: How many dimensions a model has.
    """

    sample_size: int
    images: int
    scene: Callable[[int, int, torch.Generator], Scene]
    call: Callable[..., Any]
    rank: int
    step: Callable[[Tensor, Tensor], Tensor] | None = None
    dims: int = 2

    def make(self, p: int, n: int, generator: torch.Generator, noise: float = 0.5, wrong: float = 0.3) -> Scene:
        return self.scene(p, n, generator).noisy(noise, wrong, self.images, generator)

    def __call__(self, scene: Scene, threshold: Any = 2.0, unit: float = 1.0, **options: Any) -> Any:
        options = {"generator": seeded(1), **options}
        return self.call(scene, unit, threshold=threshold, **options)

    def difference(self, models: Tensor, others: Tensor) -> Tensor:
        """In the terms of the covariance."""
        if self.step is not None:
            return self.step(models, others)
        a, b = models.flatten(-self.dims), others.flatten(-self.dims)
        return a * (a * b).sum(-1, keepdim=True).sign() - b


def pixels(X: Tensor) -> Tensor:
    return X[..., :2] / X[..., 2:] * FOCAL + CENTRE


def rays(x: Tensor) -> Tensor:
    return torch.cat(((x - CENTRE) / FOCAL, torch.ones_like(x[..., :1])), -1)


def _points(p: int, n: int, g: torch.Generator) -> Tensor:
    return torch.rand(p, n, 3, generator=g, dtype=F64) * 4 - 2 + torch.tensor([0.0, 0, 6])


def _motion(p: int, g: torch.Generator) -> tuple[Tensor, Tensor]:
    R = rotation_from_rotvec((torch.rand(p, 3, generator=g, dtype=F64) - 0.5) * 0.5)
    return R, torch.nn.functional.normalize(torch.randn(p, 3, generator=g, dtype=F64), dim=-1)


def _two_views(p: int, n: int, g: torch.Generator) -> Scene:
    X, (R, t) = _points(p, n, g), _motion(p, g)
    return Scene((pixels(X), pixels(X @ R.mT + t[:, None])))


def _plane(p: int, n: int, g: torch.Generator) -> Scene:
    X, (R, t) = _points(p, n, g), _motion(p, g)
    X = X / (X @ torch.tensor([0.03, -0.02, 0.17], dtype=F64))[..., None]
    return Scene((pixels(X), pixels(X @ R.mT + t[:, None])))


def _upright(p: int, n: int, g: torch.Generator) -> Scene:
    X, (R, t) = _points(p, n, g), _motion(p, g)
    up = torch.nn.functional.normalize(torch.randn(p, 3, generator=g, dtype=F64), dim=-1)
    return Scene((pixels(X), pixels(X @ R.mT + t[:, None])), (up, (R @ up[..., None])[..., 0]))


def _three_views(p: int, n: int, g: torch.Generator) -> Scene:
    X = _points(p, n, g)
    moved = [X @ R.mT + t[:, None] for R, t in (_motion(p, g), _motion(p, g))]
    return Scene((pixels(X), *(pixels(Y) for Y in moved)))


def _camera(p: int, n: int, g: torch.Generator) -> Scene:
    X = _points(p, n, g)
    return Scene((pixels(X), (X - torch.tensor([0.0, 0, 6])) @ random_rotation(p, generator=g, dtype=F64)))


def _with_intrinsics(p: int, n: int, g: torch.Generator) -> Scene:
    return replace(_camera(p, n, g), known=(K.expand(p, 3, 3),))


def _lines(p: int, n: int, g: torch.Generator) -> Scene:
    """Segments and the lines that they are on."""
    A, B = (_points(p, n, g) for _ in range(2))
    R, middle = random_rotation(p, generator=g, dtype=F64), torch.tensor([0.0, 0, 6], dtype=F64)
    L = pluecker_from_points((A - middle) @ R, (B - middle) @ R)
    return Scene((torch.cat((pixels(A), pixels(B)), -1), L), (K.expand(p, 3, 3),))


def _with_centre(p: int, n: int, g: torch.Generator) -> Scene:
    return replace(_camera(p, n, g), known=(K[:2, 2].expand(p, 2),))


def _views_of_a_point(p: int, n: int, g: torch.Generator) -> Scene:
    """A datum is a view: the image of the point and the camera."""
    X = torch.randn(p, 1, 3, generator=g, dtype=F64) * 0.5
    R = rotation_from_rotvec((torch.rand(p, n, 3, generator=g, dtype=F64) - 0.5) * 1.5)
    t = torch.tensor([0.0, 0, 6]) + 0.5 * torch.randn(p, n, 3, generator=g, dtype=F64)
    Y = (R @ X[..., None])[..., 0] + t
    return Scene((pixels(Y), (K @ torch.cat((R, t[..., None]), -1)).flatten(-2)))


def _triangulate(scene: Scene, unit: float, *, threshold: Any, mask: Tensor | None = None, **options: Any) -> RobustResult[Any]:
    """One point for each problem, its views the data."""
    x, P = scene.data
    S = torch.tensor([unit, unit, 1.0], dtype=x.dtype)[:, None]
    options.pop("covariance", None)
    for name in ("quality", "weights"):
        if options.get(name) is not None:
            options[name] = options[name][..., None]
    limit = threshold[..., None] if isinstance(threshold, Tensor) else threshold
    r = triangulate_points_robust(
        unit * x[..., None, :], S * P.unflatten(-1, (3, 4)), threshold=None if limit is None else limit * unit,
        visible=None if mask is None else mask[..., None], **options,
    )  # fmt: skip
    none = torch.zeros_like(r.status[..., 0])
    return RobustResult(
        r.model[..., 0, :], r.inliers[..., 0], r.support[..., 0], r.threshold[..., 0], r.iterations[..., 0], r.status[..., 0],
        none, r.covariance[..., 0, :, :],
    )  # fmt: skip


def _times(unit: float, threshold: Any) -> Any:
    return None if threshold is None else unit * threshold


def _projective(door: Callable[..., Any]) -> Callable[..., Any]:
    def call(s: Scene, unit: float, *, threshold: Any, **options: Any) -> Any:
        return door(*(unit * d for d in s.data), threshold=_times(unit, threshold), **options)

    return call


def _of_rays(door: Callable[..., Any]) -> Callable[..., Any]:
    def call(s: Scene, unit: float, *, threshold: Any, **options: Any) -> Any:
        return door(*(rays(x) * unit for x in s.data), *s.known, threshold=_times(1 / FOCAL, threshold), **options)

    return call


def _calibrated(s: Scene, unit: float, *, threshold: Any, **options: Any) -> Any:
    S = torch.tensor([unit, unit, 1.0], dtype=s.data[0].dtype)[:, None]
    return estimate_camera(*(unit * d for d in s.data), S * s.known[0], threshold=_times(unit, threshold), **options)


def _of_lines(s: Scene, unit: float, *, threshold: Any, **options: Any) -> Any:
    S = torch.tensor([unit, unit, 1.0], dtype=s.data[0].dtype)[:, None]
    l, L = s.data  # noqa: E741
    none = (l[..., :0, :2], L[..., :0, :3])
    return estimate_camera(
        *none, S * s.known[0], unit * l.unflatten(-1, (2, 2)), L, threshold=_times(unit, threshold), **options
    )  # fmt: skip


def _focal(s: Scene, unit: float, *, threshold: Any, **options: Any) -> Any:
    data = [unit * d for d in (*s.data, *s.known)]
    return estimate_camera_focal(*data, threshold=_times(unit, threshold), **options)


def _trifocal(s: Scene, unit: float, *, threshold: Any, **options: Any) -> Any:
    return estimate_trifocal(unit * torch.stack(s.data, -3), threshold=_times(unit, threshold), **options)


def pose_step(pose: Tensor, truth: Tensor) -> Tensor:
    """(w, v) with [R | t] = exp(w) [R | t] + [0 | v]."""
    turn = pose[..., :3] @ truth[..., :3].mT
    return torch.cat((rotvec_from_rotation(turn), pose[..., 3] - (turn @ truth[..., 3:])[..., 0]), -1)


def focal_step(P: Tensor, truth: Tensor) -> Tensor:
    """The same, and the logarithm of the focal length."""
    poses, logs = [], []
    for camera in (P, truth):
        C = camera[..., :2, :] - K[:2, 2:] * camera[..., 2:, :]
        f = C[..., :3].norm(dim=(-2, -1)) * 0.5**0.5
        poses.append(torch.cat((C / f[..., None, None], camera[..., 2:, :]), -2))
        logs.append(f.log())
    return torch.cat((pose_step(*poses), (logs[0] - logs[1])[..., None]), -1)


DOORS = {
    "fundamental": Door(7, 2, _two_views, _projective(estimate_fundamental), 7),
    "essential": Door(5, 2, _two_views, _of_rays(estimate_essential), 5),
    "homography": Door(4, 2, _plane, _projective(estimate_homography), 8),
    "upright": Door(3, 2, _upright, _of_rays(estimate_upright), 3),
    "trifocal": Door(6, 3, _three_views, _trifocal, 18, dims=3),
    "camera": Door(3, 1, _with_intrinsics, _calibrated, 6, pose_step),
    "lines": Door(3, 1, _lines, _of_lines, 6, pose_step),
    "focal": Door(4, 1, _with_centre, _focal, 7, focal_step),
    "projective": Door(6, 1, _camera, _projective(estimate_camera_projective), 11),
    "point": Door(2, 1, _views_of_a_point, _triangulate, 3, dims=1),
}


def extremes(door: Door, generator: torch.Generator) -> tuple[Scene, Tensor, dict[str, int]]:
    """One batch of all that may happen, which data exist, and the number of data of each."""
    sizes = {"nothing": 0, "one": 1, "too few": door.sample_size - 1, "a sample": door.sample_size, "small": 50, "huge": LARGE}
    sizes |= dict.fromkeys(("wrong", "right", "same", "some NaN", "all NaN", "infinities", "collinear"), 300)
    row = {name: i for i, name in enumerate(sizes)}
    scene = door.scene(len(sizes), LARGE, generator)
    right = scene.noisy(0.5, 0.0, door.images, generator)
    data = list(scene.noisy(0.5, 0.3, door.images, generator).data)
    along = torch.rand(LARGE, 1, generator=generator, dtype=F64)
    for i, d in enumerate(data):
        if i < door.images:
            d[row["wrong"]] = torch.rand(LARGE, d.shape[-1], generator=generator, dtype=F64) * SIZE
        d[row["right"]] = right.data[i][row["right"]]
        d[row["same"]] = d[row["same"], :1].clone()
        d[row["some NaN"], ::3] = torch.nan
        d[row["all NaN"]] = torch.nan
        ends = right.data[i][row["collinear"], :2]
        # Between two lines there are no others: all are the first.
        d[row["collinear"]] = ends[0] + along * (ends[1] - ends[0]) * (d.shape[-1] != 6)
    data[0][row["infinities"], ::4, 0] = torch.inf
    data[-1][row["infinities"], 1::4, -1] = -torch.inf
    mask = torch.arange(LARGE) < torch.tensor(list(sizes.values()))[:, None]
    return Scene(tuple(data), scene.known), mask, sizes
