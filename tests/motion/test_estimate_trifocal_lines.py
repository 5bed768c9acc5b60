"""Three uncalibrated views of points and lines, of which many are wrong."""

from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from chance import assert_share, seeded
from multiview_scenes import F64, cameras, images, points
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import point_line_distance, project_lines
from torchsfm.motion import PointLineTrifocalEstimator, estimate_trifocal
from torchsfm.motion.three_views.line_reprojection import squared_line_distance
from torchsfm.robust import Degeneracy, RobustResult
from torchsfm.tensors import transfer_points_trifocal, trifocal_from_cameras
from torchsfm.triangulation import triangulate_lines


@dataclass(frozen=True)
class Scene:
    """Points and segments of p problems; each view has a piece of its own of a line."""

    x: Tensor
    l: Tensor  # noqa: E741
    wrong: Tensor
    """Of points, then of lines."""
    P: Tensor

    def estimate(self, threshold: float | None = 3.0, **options: Any) -> RobustResult[Tensor]:
        options = {"generator": seeded(), "max_iterations": 1000} | options
        return estimate_trifocal(self.x, self.l, threshold=threshold, **options)

    def error(self, model: Tensor, generator: torch.Generator) -> Tensor:
        """Median distance of other points, transferred from two views to the third."""
        held = images(self.P, points(len(self.P), n=50, generator=generator))
        T = trifocal_from_cameras(*model.unbind(-3))
        found = transfer_points_trifocal(T, held[:, 0], held[:, 1])
        return (found - held[:, 2]).norm(dim=-1).median(-1).values


def make(
    p: int, n: int, k: int, generator: torch.Generator, share: float = 0.3, noise: float = 0.7, plane: bool = False
) -> Scene:
    """`share` of all is wrong in one of the views."""
    P, X = cameras(p, v=3, generator=generator), points(p, n=n + 2 * k, generator=generator)
    if plane:
        X[..., 2] = 0.4 * X[..., 0]
    x, a, b = images(P, X).split((n, k, k), -2)
    cut = 0.3 * torch.rand(2, p, 3, k, 1, generator=generator, dtype=F64)
    l = torch.stack((a + cut[0] * (b - a), b + cut[1] * (a - b)), -2)  # noqa: E741
    wrong = torch.rand(p, n + k, generator=generator) < share
    hit = wrong[:, None] & (torch.randint(3, (p, 1, n + k), generator=generator) == torch.arange(3)[:, None])
    found = []
    for seen, bad in ((x, hit[..., :n, None]), (l, hit[..., n:, None, None])):
        noisy = seen + noise * torch.randn(seen.shape, generator=generator, dtype=F64)
        found.append(torch.where(bad, 640 * torch.rand(seen.shape, generator=generator, dtype=F64), noisy))
    return Scene(found[0], found[1], wrong, P)


def test_distance_is_that_from_the_images_of_the_best_line(generator: torch.Generator) -> None:
    P = cameras(6, v=3, generator=generator, calibration=torch.eye(3, dtype=F64))
    a, b = (images(P, points(6, n=40, generator=generator)) for _ in range(2))
    l = torch.stack((a, b), -2)  # noqa: E741
    l = l + 1e-3 * torch.randn(l.shape, generator=generator, dtype=F64)  # noqa: E741
    line = triangulate_lines(l, P).model
    seen = project_lines(P[:, :, None], line[:, None, :, None])[..., 0, :]
    optimum = point_line_distance(l, seen[..., None, :]).square().sum((1, 3)).sqrt()
    # The same cameras in the frame of the first.
    H = torch.linalg.inv(torch.cat((P[:, 0], torch.tensor([[[0.0, 0, 0, 1]]], dtype=F64).expand(6, 1, 4)), 1))
    data = (*l.flatten(-2).unbind(1), torch.ones(40, 1, dtype=F64))
    found = PointLineTrifocalEstimator().squared_residual(P[:, 1:] @ H[:, None], *data).sqrt()
    assert_share((found / optimum - 1).abs() < 1e-3, 0.99)


def test_short_segments_of_nothing_are_not_near(generator: torch.Generator) -> None:
    """A step may be longer than the segment: what is then near after a few steps is near after many."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=F64)

    turned = 0.3 * normal(40, 2, 3, 3)
    K = torch.tensor([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]], dtype=F64)
    P = K @ torch.cat((torch.matrix_exp(turned - turned.mT) @ torch.linalg.inv(K), 0.5 * normal(40, 2, 3, 1)), -1)
    ends = []
    for _ in range(3):
        a = torch.rand(40, 500, 2, generator=generator, dtype=F64) * torch.tensor([640.0, 480.0])
        along = normal(40, 500, 2)
        length = 2 + 20 * torch.rand(40, 500, 1, generator=generator, dtype=F64)
        ends.append([*a.unbind(-1), *(a + length * along / along.norm(dim=-1, keepdim=True)).unbind(-1)])
    near = squared_line_distance(P, ends) < 2**2
    wrong = near & ~(squared_line_distance(P, ends, 60) < 3**2)
    # Of 2,400 some twenty; while steps went along segments too, and could shrink them to a point, 3,745 of 6,153.
    assert int(wrong.sum()) < 0.03 * int(near.sum())


def test_distances_are_in_the_unit_of_the_images(generator: torch.Generator) -> None:
    scene = make(6, 0, 60, generator, share=0.0)
    H = torch.linalg.inv(torch.cat((scene.P[:, 0], torch.tensor([[[0.0, 0, 0, 1]]], dtype=F64).expand(6, 1, 4)), 1))
    model, ends, lines = (scene.P @ H[:, None])[:, 1:], scene.l.flatten(-2), torch.ones(60, 1, dtype=F64)
    distance = PointLineTrifocalEstimator().squared_residual(model, *ends.unbind(1), lines).sqrt()
    assert distance.isfinite().all()
    for unit in (1e-3, 640.0):
        T = torch.tensor([unit, unit, 1.0], dtype=F64)
        other = model / T[:, None] * torch.cat((T, torch.ones(1, dtype=F64)))
        found = PointLineTrifocalEstimator().squared_residual(other, *(ends / unit).unbind(1), lines).sqrt()
        torch.testing.assert_close(unit * found, distance, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("n", "k", "share"), [(60, 60, 0.4), (12, 80, 0.3), (80, 12, 0.4), (0, 60, 0.1), (2, 60, 0.1)])
def test_outliers(n: int, k: int, share: float, generator: torch.Generator) -> None:
    scene = make(4, n, k, generator, share)
    copies = scene.x.clone(), scene.l.clone()
    found = scene.estimate(max_iterations=10_000)
    assert torch.equal(scene.x, copies[0])
    assert torch.equal(scene.l, copies[1])
    assert (found.status == Status.OK).all()
    assert_share(found.degeneracy == Degeneracy.NONE, 0.8)
    assert scene.error(found.model, generator).median() < 2.0
    assert found.inliers.shape == scene.wrong.shape
    good = ~scene.wrong
    assert (found.inliers & good).sum() > 0.93 * good.sum()
    assert (found.inliers & scene.wrong).sum() < 0.15 * scene.wrong.sum() + 2


def test_lines_add_to_points(generator: torch.Generator) -> None:
    """Few points leave much to chance that lines determine."""
    scene = make(16, 12, 60, generator, 0.0)
    alone = estimate_trifocal(scene.x, threshold=3.0, generator=seeded())
    both = scene.estimate()
    errors = [scene.error(model, seeded(5)).median() for model in (both.model, alone.model)]
    assert errors[0] < 0.7 * errors[1]


def test_samples_are_mixtures(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seven points, or four points and three lines, by turns, drawn from what there is."""
    seen, minimal = set(), PointLineTrifocalEstimator.minimal

    def recorded(self: PointLineTrifocalEstimator, *sample: Tensor) -> Any:
        seen.update(sample[3].sum((-2, -1)).flatten().tolist())
        return minimal(self, *sample)

    monkeypatch.setattr(PointLineTrifocalEstimator, "minimal", recorded)
    for n, lines in ((20, {0, 3}), (5, {3})):
        seen.clear()
        make(2, n, 30, generator, 0.2).estimate(max_iterations=200)
        assert seen == lines


def test_unit_and_ends_are_free(generator: torch.Generator) -> None:
    scene = make(4, 30, 40, generator)
    plain = scene.estimate()
    swapped = replace(scene, l=scene.l.flip(-2)).estimate()
    torch.testing.assert_close(swapped.model, plain.model, rtol=1e-5, atol=1e-6)
    large = replace(scene, x=1000 * scene.x, l=1000 * scene.l).estimate(3000.0)
    assert torch.equal(large.inliers, plain.inliers)
    weighed = scene.estimate(weights=torch.ones(70, dtype=F64))
    assert (weighed.status == Status.OK).all()
    single = replace(scene, x=scene.x.float(), l=scene.l.float()).estimate()
    assert single.model.dtype == torch.float32
    # Alone as in the batch.
    mask = torch.rand(4, 70, generator=generator) < 0.8
    together = scene.estimate(mask=mask)
    assert not (together.inliers & ~mask).any()
    alone = estimate_trifocal(scene.x[2], scene.l[2], threshold=3.0, mask=mask[2], generator=seeded(), max_iterations=1000)
    assert torch.equal(alone.inliers, together.inliers[2])
    torch.testing.assert_close(alone.model, together.model[2], rtol=1e-6, atol=1e-9)


def test_derivatives_and_covariance(generator: torch.Generator) -> None:
    scene = make(1, 25, 30, generator, 0.1, 0.3)
    x, l = scene.x.requires_grad_(), scene.l.requires_grad_()  # noqa: E741
    found = estimate_trifocal(x, l, threshold=2.0, generator=seeded(1), covariance=True)
    assert found.covariance is not None
    assert found.covariance.shape == (1, 36, 36)
    weight = torch.randn(1, 3, 3, 4, generator=generator, dtype=F64) / found.model.detach().abs().clamp(min=1e-3)
    grads = torch.autograd.grad((found.model * weight).sum(), (x, l))
    steps = [torch.randn(t.shape, generator=generator, dtype=F64) for t in (x, l)]
    steps[0] = steps[0] * found.inliers[:, None, :25, None]
    steps[1] = steps[1] * found.inliers[:, None, 25:, None, None]
    h = 1e-3
    moved = [
        estimate_trifocal(x.detach() + h * s * steps[0], l.detach() + h * s * steps[1], threshold=2.0, generator=seeded(1))
        for s in (1, -1)
    ]
    slope = ((moved[0].model - moved[1].model) * weight).sum() / (2 * h)
    total = sum((g * d).sum() for g, d in zip(grads, steps, strict=True))
    torch.testing.assert_close(total, slope, rtol=0.03, atol=1e-6)


def test_covariance_is_that_of_the_errors(generator: torch.Generator) -> None:
    """On the whole, over problems with noise of their own."""
    scene = make(1, 30, 40, generator, 0.0, 0.0)
    noise = [0.1 * torch.randn(150, *t.shape[1:], generator=generator, dtype=F64) for t in (scene.x, scene.l)]
    found = estimate_trifocal(scene.x + noise[0], scene.l + noise[1], threshold=4.0, generator=seeded(), covariance=True)
    assert (found.status == Status.OK).all()
    assert found.covariance is not None
    exact = estimate_trifocal(scene.x, scene.l, threshold=4.0, generator=seeded()).model
    square, trace = (found.model - exact).square().sum((1, 2, 3)), found.covariance.diagonal(dim1=1, dim2=2).sum(-1)
    # One direction has most of it: chi-square of 150 freedoms.
    assert 0.65 < square.mean() / trace.mean() < 1.5


def test_a_plane_leaves_the_cameras_open(generator: torch.Generator) -> None:
    found = make(4, 40, 40, generator, 0.1, 0.3, plane=True).estimate(2.0, max_iterations=300)
    assert_share(found.degeneracy != Degeneracy.NONE, 0.9)
    assert (found.status == Status.OK).any()


def test_bad_problems(generator: torch.Generator) -> None:
    scene = make(6, 30, 40, generator, 0.2)
    x, l = scene.x.clone(), scene.l.clone()  # noqa: E741
    x[1], l[1] = torch.nan, torch.nan
    x[2], l[2] = x[2, :, :1], l[2, :, :1]
    x[3] = 640 * torch.rand(3, 30, 2, generator=generator, dtype=F64)
    l[3] = 640 * torch.rand(3, 40, 2, 2, generator=generator, dtype=F64)
    l[5, 1, ::2, 1] = l[5, 1, ::2, 0]
    l[5, 2, 1::4] = torch.inf
    mask = torch.ones(6, 70, dtype=torch.bool)
    mask[4, 6:] = False
    bad = replace(scene, x=x, l=l).estimate(mask=mask, max_iterations=500)
    wanted = [Status.OK, Status.NOT_FINITE, Status.DEGENERATE, Status.NO_CONSENSUS, Status.TOO_FEW, Status.OK]
    assert bad.status.tolist() == wanted
    assert torch.isfinite(bad.model).all()
    assert not bad.inliers[5, 30::2].any()
    good = scene.estimate(mask=mask, max_iterations=500)
    assert torch.equal(good.model[0], bad.model[0])


def test_nothing_agrees_on_nothing(generator: torch.Generator) -> None:
    """Cameras that make one plane of all lines are no answer."""
    x = 640 * torch.rand(12, 3, 30, 2, generator=generator, dtype=F64)
    l = 640 * torch.rand(12, 3, 40, 2, 2, generator=generator, dtype=F64)  # noqa: E741
    found = estimate_trifocal(x, l, threshold=3.0, generator=seeded(), max_iterations=300)
    assert (found.status != Status.OK).all()


def test_wrong_arguments(unchecked: None) -> None:
    x, l = torch.zeros(3, 9, 2), torch.zeros(3, 5, 2, 2)  # noqa: E741
    with pytest.raises(ValueError, match="l"):
        estimate_trifocal(x, l[..., 0], threshold=1.0)
    with pytest.raises(ValueError, match="mask"):
        estimate_trifocal(x, l, threshold=1.0, mask=torch.ones(9, dtype=torch.bool))


@pytest.mark.parametrize("layout", ["one point", "one direction", "two directions", "a plane"])
def test_lines_that_leave_the_cameras_open_are_told(layout: str, generator: torch.Generator) -> None:
    p, k = 8, 60
    P, a, b = cameras(p, v=3, generator=generator), *points(p, n=2 * k, generator=generator).split(k, 1)
    if layout == "one point":
        a = a[:, :1].expand_as(b)
    elif layout == "a plane":
        a, b = (torch.cat((X[..., :2], 0.4 * X[..., :1]), -1) for X in (a, b))
    else:
        number = 1 if layout == "one direction" else 2
        along = torch.nn.functional.normalize(torch.randn(p, number, 3, generator=generator, dtype=F64), dim=-1)
        b = a + 0.7 * along.repeat(1, k // number, 1)
    l = torch.stack((images(P, a), images(P, b)), -2)  # noqa: E741
    l = l + 0.7 * torch.randn(l.shape, generator=generator, dtype=F64)  # noqa: E741
    scene = Scene(l[..., :0, 0, :], l, torch.zeros(p, k, dtype=torch.bool), P)
    found = scene.estimate(max_iterations=200)
    assert_share((found.status != Status.OK) | (found.degeneracy == Degeneracy.UNDETERMINED), 0.95)
