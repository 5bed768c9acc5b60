"""From projective cameras and curves to metric ones: exact data, noise, what curves tell of cameras, critical motions, laws."""

import math
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from chance import assert_unit_variance
from projective_scenes import MOTIONS, SIZE, projective_scene
from torch import Tensor

from torchsfm._types import Status
from torchsfm.autocalibration import Assumption, Autocalibration, autocalibrate_curves
from torchsfm.autocalibration.camera_information import camera_information
from torchsfm.geometry import Curve, curve_from_samples, from_homogeneous, to_homogeneous
from torchsfm.motion import factorize_curves

F64 = torch.float64
FOCAL = Assumption(free=("focal",))


def rings(c: int, n: int, generator: torch.Generator) -> Tensor:
    """Bent rings about the origin, (c, n, 3)."""
    t = torch.arange(n, dtype=F64) * (2 * math.pi / n)
    waves = torch.stack([w for k in (1, 2, 3) for w in ((k * t).cos() / k**2, (k * t).sin() / k**2)], -1)
    bends = torch.randn(c, 6, 3, generator=generator, dtype=F64)
    bends = 0.9 * bends / bends.square().sum((-2, -1), keepdim=True).sqrt()
    return waves @ bends + 0.3 * torch.randn(c, 1, 3, generator=generator, dtype=F64)


@dataclass(frozen=True)
class Scenes:
    """A batch of cameras in pixels, rings and their images; `P` and `X` are the true ones in frames of their own."""

    K: Tensor
    P: Tensor
    X: Tensor
    x: Tensor

    @property
    def curves(self) -> Curve:
        return curve_from_samples(self.x, closed=True)

    def error(self, found: Autocalibration) -> Tensor:
        return (found.K[..., 0, 0] / self.K[..., 0, 0] - 1).abs().amax(-1)


def scenes(generator: torch.Generator, count: int, v: int, c: int = 4, n: int = 400, **options: Any) -> Scenes:
    parts = []
    for _ in range(count):
        true = projective_scene(generator, v, 1, **options)
        P = true.K @ torch.cat((true.R, -true.R @ true.centre[..., None]), -1)
        X = to_homogeneous(rings(c, n, generator))
        x = from_homogeneous(X @ P[:, None].mT)[0]
        frame = torch.eye(4, dtype=F64) + 0.3 * torch.randn(4, 4, generator=generator, dtype=F64)
        sign = torch.randn(v, 1, 1, generator=generator, dtype=F64)
        parts.append((true.K, sign * (P @ frame), torch.linalg.solve(frame, X.mT).mT, x))
    return Scenes(*(torch.stack(part) for part in zip(*parts, strict=True)))


@pytest.mark.parametrize("assume", [FOCAL, Assumption(), Assumption(varying=("focal",))])
def test_exact_curves(assume: Assumption, generator: torch.Generator) -> None:
    scene = scenes(generator, 3, 6, varying=bool(assume.varying), focal=1.2, offset=0.0 if assume == FOCAL else 0.01)
    found = autocalibrate_curves(scene.P, scene.X[..., ::10, :], scene.curves, image_size=SIZE, assume=assume)
    assert (found.status == Status.OK).all()
    assert scene.error(found).max() < 1e-3
    assert found.X.shape == (3, 4, 40, 3)
    seen = from_homogeneous(to_homogeneous(found.X)[:, None] @ found.P[:, :, None].mT)[0]
    assert (seen - scene.x[..., ::10, :]).abs().max() < 1e-3
    assert (found.in_front == 1).all()


def test_from_images_of_curves_alone(generator: torch.Generator) -> None:
    """Noise of half a pixel; what is off has the deviation that was told."""
    scene = scenes(generator, 10, 6, c=3, focal=1.2, offset=0.0)
    noisy = scene.x[..., ::10, :] + 0.5 * torch.randn(10, 6, 3, 40, 2, generator=generator, dtype=F64)
    found = factorize_curves(curve_from_samples(noisy, closed=True), aligned=True, samples=20)
    at = (found.status == Status.OK).nonzero()[:, 0]
    assert len(at) >= 6
    metric = autocalibrate_curves(
        found.P[at], found.X[at], curve_from_samples(noisy[at], closed=True), image_size=SIZE,
        visible=torch.isfinite(found.error[at]), assume=FOCAL, distortion_sigma=0.0,
    )  # fmt: skip
    assert (metric.status == Status.OK).all()
    score = (metric.K[:, 0, 0, 0] / scene.K[at, 0, 0, 0]).log() / metric.deviation[:, 0, 0]
    assert_unit_variance(score)


def test_a_sample_moves_across_its_curve_and_tells_nothing_along_it(generator: torch.Generator) -> None:
    """The information of the cameras is what elimination of two coordinates of each sample leaves of the normal distances."""
    scene = scenes(generator, 1, 5, c=2)
    P, Y, x = scene.P[0], scene.X[0] / scene.X[0, ..., 3:], scene.x[0]
    P = P / P.flatten(1).norm(dim=-1)[:, None, None]
    tangent = torch.nn.functional.normalize(x.roll(-1, 2) - x.roll(1, 2), dim=-1)[:, :, ::20].flatten(1, 2)
    normal = torch.stack((-tangent[..., 1], tangent[..., 0]), -1)
    along = (Y.roll(-1, 1) - Y.roll(1, 1))[:, ::20].flatten(0, 1)
    X = Y[:, ::20].flatten(0, 1)
    across = torch.linalg.svd(along[:, None, :3])[2][:, 1:]
    n = len(X)

    def distances(p: Tensor, move: Tensor) -> Tensor:
        Y = X + torch.nn.functional.pad((move[..., None] * across).sum(1), (0, 1))
        return (from_homogeneous(Y @ p.mT)[0] * normal).sum(-1)

    by_P, by_move = torch.autograd.functional.jacobian(distances, (P, torch.zeros(n, 2, dtype=F64)))
    A, B = by_P.reshape(5 * n, 60), by_move.reshape(5 * n, 2 * n)
    left = A - B @ torch.linalg.lstsq(B, A).solution
    w = torch.ones(1, 5, n, dtype=F64)
    told = camera_information(P[None], X[None], w, torch.zeros(1, 5, n, 2, 1, dtype=F64), normal=normal[None]).matrix[0]
    assert (told - left.mT @ left).abs().max() < 1e-4 * told.abs().max()
    points = camera_information(P[None], X[None], w, torch.zeros(1, 5, n, 2, 1, dtype=F64)).matrix[0]
    assert torch.linalg.eigvalsh(points - told).min() > -1e-3 * told.abs().max()
    assert torch.linalg.matrix_norm(points) > 1.2 * torch.linalg.matrix_norm(told)


@pytest.mark.parametrize("assume", [Assumption(), (Assumption(), Assumption(varying=("focal",)))], ids=["one", "two"])
def test_critical_motions_are_told(assume: Any, generator: torch.Generator) -> None:
    each = [scenes(generator, 2, 8, motion=motion) for motion in MOTIONS]
    P, X, x = (torch.cat([getattr(scene, name) for scene in each]) for name in ("P", "X", "x"))
    found = autocalibrate_curves(
        P, X[..., ::10, :], curve_from_samples(x, closed=True), image_size=SIZE, noise=1.0, assume=assume
    )
    assert ((found.status != Status.OK) | found.motion.critical).all()
    first = MOTIONS.index("translation")
    assert (found.status[2 * first : 2 * first + 2] != Status.OK).all()


def test_bad_data_change_nothing_else(generator: torch.Generator) -> None:
    scene = scenes(generator, 4, 6, focal=1.2)
    P, X, x = scene.P.clone(), scene.X[..., ::10, :].clone(), scene.x.clone()
    good = autocalibrate_curves(P[::3], X[::3], curve_from_samples(x[::3], closed=True), image_size=SIZE)
    visible = torch.ones(4, 6, 4, 40, dtype=torch.bool)
    P[1] = torch.nan
    X[2, 1] = torch.inf
    x[2, 4] = torch.nan
    # Ten samples are one less than a view needs.
    visible[2, 3] = torch.arange(160).reshape(4, 40) < 10
    whole = autocalibrate_curves(P, X, curve_from_samples(x, closed=True), image_size=SIZE, visible=visible)
    assert whole.status[1] == Status.TOO_FEW
    assert whole.status[2] == Status.OK
    rest = torch.tensor([0, 1, 2, 5])
    keep = torch.tensor([0, 2, 3])
    less = autocalibrate_curves(P[2, rest], X[2, keep], curve_from_samples(x[2, rest][:, keep], closed=True), image_size=SIZE)
    torch.testing.assert_close(whole.K[2, rest], less.K, rtol=1e-6, atol=1e-6)
    assert torch.isfinite(whole.K).all()
    assert torch.isfinite(whole.X).all()
    torch.testing.assert_close(whole.K[::3], good.K, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(whole.X[::3], good.X, rtol=1e-9, atol=1e-9)


def test_shapes(generator: torch.Generator) -> None:
    scene = scenes(generator, 1, 4, c=3)
    P, X, curves = scene.P.expand(2, 1, 4, 3, 4), scene.X[..., ::20, :], scene.curves
    found = autocalibrate_curves(P, X, curves, image_size=SIZE)
    assert found.K.shape == (2, 1, 4, 3, 3)
    assert found.X.shape == (2, 1, 3, 20, 3)
    empty = autocalibrate_curves(P[:0], X, curves, image_size=SIZE)
    assert empty.X.shape == (0, 1, 3, 20, 3)
    single = Curve(curves.x.float(), curves.valid, curves.closed)
    assert autocalibrate_curves(P.float(), X.float(), single, image_size=SIZE).K.dtype == torch.float32


def test_wrong_input(generator: torch.Generator, unchecked: None) -> None:
    scene = scenes(generator, 1, 4, c=3)
    with pytest.raises(ValueError, match="X: wanted shape"):
        autocalibrate_curves(scene.P, scene.X[..., :3], scene.curves, image_size=SIZE)
    with pytest.raises(ValueError, match="curves: wanted Curve"):
        autocalibrate_curves(scene.P, scene.X, scene.x, image_size=SIZE)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="image_size"):
        autocalibrate_curves(scene.P, scene.X, scene.curves, image_size=torch.ones(3, 2, dtype=F64))
