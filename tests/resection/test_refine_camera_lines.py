"""Refinement and resection of cameras with lines besides points, or alone: optimum, bounds, lenses, derivatives, bad data."""

import pytest
import torch
from chance import assert_share, seeded
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import (
    Camera,
    Pose,
    Radial,
    line_from_points,
    pluecker_from_points,
    random_rotation,
    rotvec_from_rotation,
)
from torchsfm.optim import Cauchy
from torchsfm.resection import refine_camera, resect_cameras

F64 = torch.float64
K = torch.tensor([[800.0, 0, 500], [0, 820, 400], [0, 0, 1]], dtype=F64)
Scene = tuple[Tensor, Tensor, Tensor, Tensor, Pose]


def lens(camera: Camera, p: int) -> Camera:
    return Camera(camera.K.expand(p, 3, 3), type(camera.distortion)(*(v.expand(p) for v in camera.distortion.parameters())))


def make(p: int, n: int, k: int, generator: torch.Generator, noise: float = 0.5, camera: Camera | None = None) -> Scene:
    """Points and segments, their lines, and poses."""
    kind = {"generator": generator, "dtype": F64}
    camera = camera or Camera(K.expand(p, 3, 3))
    pose = Pose(random_rotation(p, **kind), 0.3 * torch.randn(p, 3, **kind) + torch.tensor([0.0, 0, 6]))
    X, ends = 3 * torch.rand(p, n, 3, **kind) - 1.5, 3 * torch.rand(p, k, 2, 3, **kind) - 1.5
    x = camera.project(pose.transform(X))
    l = camera.project(pose.transform(ends.flatten(1, 2))).reshape(p, k, 2, 2)  # noqa: E741
    x, l = (v + noise * torch.randn(v.shape, **kind) for v in (x, l))  # noqa: E741
    return x, X, l, pluecker_from_points(ends[..., 0, :], ends[..., 1, :]), pose


def near(pose: Pose, generator: torch.Generator, size: float = 0.01) -> Pose:
    return pose.retract(size * torch.randn(*pose.R.shape[:-2], 6, generator=generator, dtype=F64))


def steps(pose: Pose, truth: Pose) -> Tensor:
    """(w, v) from the truth."""
    R = pose.R @ truth.R.mT
    return torch.cat((rotvec_from_rotation(R), pose.t - (R @ truth.t[..., None])[..., 0]), -1)


@pytest.mark.parametrize(("n", "k"), [(0, 20), (10, 10), (20, 2)])
@pytest.mark.parametrize("loss", [None, Cauchy(2.0)])
def test_exact_data_give_the_pose(n: int, k: int, loss: object, generator: torch.Generator) -> None:
    x, X, l, L, pose = make(20, n, k, generator, 0.0)  # noqa: E741
    found = refine_camera(x, X, near(pose, generator), Camera(K), l, L, loss=loss)  # type: ignore[arg-type]
    assert (found.status == Status.OK).all()
    assert (steps(found.pose, pose).abs() < 1e-8).all()
    assert found.in_front.shape == (20, n + k)
    assert found.in_front.all()
    assert (found.error < 1e-6).all()


def test_errors_are_those_the_covariance_says(generator: torch.Generator) -> None:
    """Chi-squared of six: the estimate reaches the bound."""
    x, X, l, L, pose = make(600, 8, 12, generator, 0.5)  # noqa: E741
    found = refine_camera(x, X, pose, Camera(K), l, L, weights=torch.full((20,), 4.0, dtype=F64))
    e = steps(pose, found.pose)
    square = (e * torch.linalg.solve(found.covariance, e[..., None])[..., 0]).sum(-1)
    assert abs(square.mean() - 6) < 5 * (12 / 600) ** 0.5
    # 40 residuals and six unknowns, and two residuals in a row of the error.
    assert abs((found.error.square().mean() * 20 / 34).sqrt() - 0.5) < 0.02


def test_the_inside_is_found_too(generator: torch.Generator) -> None:
    x, X, l, L, pose = make(12, 20, 40, generator, 0.0)  # noqa: E741
    wrong = K.clone()
    wrong[:2, 2] += 5
    wrong[0, 0] *= 1.02
    wrong[1, 1] *= 1.03
    found = refine_camera(x, X, near(pose, generator), Camera(wrong), l, L, free=("focal", "aspect", "principal_point"))
    assert (found.status == Status.OK).all()
    torch.testing.assert_close(found.camera.K, K.expand(12, 3, 3), rtol=1e-7, atol=1e-4)


def test_lines_are_bent_by_lenses(generator: torch.Generator) -> None:
    """Lines alone, whose images are curved, give pose and distortion."""
    camera = lens(Camera(K, Radial(torch.tensor(-0.12).double(), torch.tensor(0.03).double())), 10)
    x, X, l, L, pose = make(10, 0, 60, generator, 0.0, camera)  # noqa: E741
    known = refine_camera(x, X, near(pose, generator), camera, l, L)
    assert (known.status == Status.OK).all()
    assert (steps(known.pose, pose).abs() < 1e-6).all()
    start = Camera(camera.K, Radial(0.8 * camera.distortion.k1, 0 * camera.distortion.k2))
    found = refine_camera(x, X, near(pose, generator, 0.003), start, l, L, free=("k1", "k2"))
    assert (found.status == Status.OK).all()
    assert ((found.camera.distortion.k1 + 0.12).abs() < 1e-4).all()
    assert (steps(found.pose, pose).abs() < 1e-5).all()


def test_weights_and_bad_lines(generator: torch.Generator) -> None:
    x, X, l, L, pose = make(6, 10, 12, generator)  # noqa: E741
    weights = torch.rand(6, 22, generator=generator, dtype=F64) + 0.5
    weights[:, [2, 13, 20]] = 0
    plain = refine_camera(x, X, pose, Camera(K), l, L, weights=weights)
    spoiled, none = l.clone(), L.clone()
    spoiled[:, 3], none[:, 10] = torch.nan, torch.inf
    again = refine_camera(x, X, pose, Camera(K), spoiled, none, weights=weights)
    torch.testing.assert_close(again.model, plain.model, rtol=1e-9, atol=1e-9)
    spoiled[2, 5, 1] = torch.nan
    none[4, 0] = 0
    found = refine_camera(x, X, pose, Camera(K), spoiled, none, weights=weights)
    assert (found.status == torch.tensor([0, 0, Status.NOT_FINITE, 0, Status.NOT_FINITE, 0])).all()
    assert found.model.isfinite().all()
    good = found.status == Status.OK
    assert torch.equal(found.model[good], again.model[good])


def test_no_cameras_are_none(generator: torch.Generator) -> None:
    x, X, l, L, pose = (v[:0] for v in make(2, 5, 6, generator))  # noqa: E741
    found = refine_camera(x, X, pose, Camera(K), l, L, free=("focal",))
    assert found.model.shape == (0, 3, 4)
    assert found.in_front.shape == (0, 11)


def test_a_shift_along_parallel_lines_is_not_determined(generator: torch.Generator) -> None:
    x, X, l, L, pose = make(5, 0, 20, generator, 0.0)  # noqa: E741
    ends = 3 * torch.rand(5, 20, 1, 3, generator=generator, dtype=F64) - 1.5
    ends = torch.cat((ends, ends + torch.tensor([0.3, 1.0, 0.2], dtype=F64)), -2)
    l = Camera(K).project(pose.transform(ends.flatten(1, 2))).reshape(5, 20, 2, 2)  # noqa: E741
    L = pluecker_from_points(ends[..., 0, :], ends[..., 1, :])
    assert (refine_camera(x, X, pose, Camera(K), l, L).status == Status.DEGENERATE).all()
    few = refine_camera(x, X, pose, Camera(K), l[:, :2], L[:, :2])
    assert (few.status == Status.TOO_FEW).all()


def test_derivatives(generator: torch.Generator) -> None:
    x, X, l, L, pose = (v[0] for v in make(1, 5, 6, generator, 0.3))  # noqa: E741
    weights = torch.rand(11, generator=generator, dtype=F64) + 0.5

    def solve(x: Tensor, X: Tensor, l: Tensor, m: Tensor, w: Tensor, k: Tensor) -> Tensor:  # noqa: E741
        # The moment across the direction, of which alone a line is.
        d = L[..., :3] / L[..., :3].norm(dim=-1, keepdim=True)
        m = m - (m * d).sum(-1, keepdim=True) * d
        return refine_camera(x, X, pose, Camera(k), l, torch.cat((L[..., :3], m), -1), weights=w).model

    inputs = [v.clone().requires_grad_() for v in (x, X, l, L[..., 3:], weights)]
    camera = K.clone()
    assert torch.autograd.gradcheck(lambda *v: solve(*v, camera), inputs, eps=1e-6, rtol=1e-3, atol=1e-6, fast_mode=True)


@pytest.mark.parametrize("threshold", [None, 4.0])
def test_cameras_of_a_list(threshold: float | None, generator: torch.Generator) -> None:
    kind = {"generator": generator, "dtype": F64}
    x, X, l, L, _ = make(1, 15, 25, generator)  # noqa: E741
    X, L = X[0], L[0]
    pose = Pose(random_rotation(6, **kind), 0.3 * torch.randn(6, 3, **kind) + torch.tensor([0.0, 0, 6]))
    foot = torch.linalg.cross(L[:, :3], L[:, 3:]) / L[:, :3].square().sum(-1, keepdim=True)
    ends = foot[:, None] + torch.tensor([-0.5, 0.5])[:, None] * L[:, None, :3] / L[:, None, :3].norm(dim=-1, keepdim=True)
    x = Camera(K).project(pose.transform(X)) + 0.5 * torch.randn(6, 15, 2, **kind)
    l = Camera(K).project(pose.transform(ends.flatten(0, 1))).reshape(6, 25, 2, 2)  # noqa: E741
    l = l + 0.5 * torch.randn(6, 25, 2, 2, **kind)  # noqa: E741
    visible = torch.rand(6, 40, generator=generator) < 0.8
    visible[5, 2:] = False
    found = resect_cameras(x, X, K.expand(6, 3, 3), l, L, threshold=threshold, visible=visible, generator=seeded())
    assert found.status.tolist() == [Status.OK] * 5 + [Status.TOO_FEW]
    assert (steps(Pose.from_matrix(found.model[:5]), pose[:5]).abs() < 0.05).all()
    assert not (found.inliers & ~visible).any()
    assert_share((found.inliers == visible)[:5], 0.95)
    assert ((found.error[:5] > 0.4) & (found.error[:5] < 1.1)).all()
    whole = line_from_points(l[..., 0, :], l[..., 1, :])
    lines = resect_cameras(x, X, K.expand(6, 3, 3), whole, L, threshold=40.0, visible=visible, generator=seeded())
    assert (lines.status[:5] == Status.OK).all()
    assert (steps(Pose.from_matrix(lines.model[:5]), pose[:5]).abs() < 0.1).all()


@pytest.mark.usefixtures("unchecked")
def test_wrong_arguments(generator: torch.Generator) -> None:
    x, X, l, L, pose = make(2, 5, 7, generator)  # noqa: E741
    for arguments, options, name in (
        ((l, None), {}, "l, L"), ((l[:, :-1], L), {}, "L: wanted"), ((l, L), {"weights": torch.ones(5).double()}, "weights: w"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=name):
            refine_camera(x, X, pose, Camera(K), *arguments, **options)
    with pytest.raises(ValueError, match="K: wanted"):
        resect_cameras(x, X[0], None, l, L[0])
    with pytest.raises(ValueError, match="visible: wanted 12"):
        resect_cameras(x, X[0], K.expand(2, 3, 3), l, L[0], visible=torch.ones(2, 5, dtype=torch.bool))
