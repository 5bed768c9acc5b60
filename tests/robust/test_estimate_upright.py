"""The door for cameras that know the vertical; the laws of its estimator are in the contract."""

import pytest
import torch
from chance import assert_share
from scenes import make_scene

from torchsfm._types import Status
from torchsfm.geometry import rotation_from_rotvec
from torchsfm.motion import RelativePoseEstimator, UprightPoseEstimator, estimate_essential, estimate_upright
from torchsfm.robust import Degeneracy, constant_weights
from torchsfm.tensors import essential_from_pose


def test_poses_are_found_with_few_samples(generator: torch.Generator) -> None:
    scene = make_scene(UprightPoseEstimator, (12,), 200, generator, 1e-3)
    wrong = torch.rand(12, 200, generator=generator) < 0.5
    d1, d2 = scene.spoil(scene.data, wrong, generator)
    up1, up2 = scene.estimator.gravity1, scene.estimator.gravity2
    found = estimate_upright(5 * d1, d2, 3 * up1, 0.1 * up2, threshold=2e-3, generator=generator)
    assert (found.status == Status.OK).all()
    assert scene.error(found.model, scene.model).median() < 0.01
    assert ((found.model[..., :3] @ up1[..., None])[..., 0] - up2).abs().max() < 1e-9
    free = estimate_essential(d1, d2, threshold=2e-3, generator=generator)
    assert found.iterations.double().mean() < free.iterations.double().mean()
    # Knowing more is better.
    E = essential_from_pose(scene.model[..., :3], scene.model[..., 3])
    far = torch.minimum((free.model - E).norm(dim=(-2, -1)), (free.model + E).norm(dim=(-2, -1)))
    own = essential_from_pose(found.model[..., :3], found.model[..., 3])
    near = torch.minimum((own - E).norm(dim=(-2, -1)), (own + E).norm(dim=(-2, -1)))
    assert near.median() < far.median()


def test_a_wrong_vertical_is_corrected_by_refinement(generator: torch.Generator) -> None:
    scene = make_scene(UprightPoseEstimator, (8,), 150, generator, 3e-4)
    up1, up2 = scene.estimator.gravity1, scene.estimator.gravity2
    tilted = up2 + 3e-3 * torch.randn(up2.shape, generator=generator, dtype=up2.dtype)
    found = estimate_upright(*scene.data, up1, tilted, threshold=5e-3, generator=generator)
    model = found.model
    free = RelativePoseEstimator(torch.full((8,), 5e-3, dtype=torch.float64))
    for _ in range(5):
        model = free.step(model, *scene.data, weigh=constant_weights(found.inliers.double()))
    assert scene.error(model, scene.model).median() < 0.5 * scene.error(found.model, scene.model).median()


def test_dtype_bad_input_and_arguments(generator: torch.Generator, unchecked: None) -> None:
    scene = make_scene(UprightPoseEstimator, (3,), 60, generator, 1e-3)
    d1, d2 = (d.float() for d in scene.data)
    up1, up2 = scene.estimator.gravity1.float(), scene.estimator.gravity2.float()
    d1[1, ::2], up1[2] = torch.nan, 0
    found = estimate_upright(d1, d2, up1, up2, threshold=3e-3, generator=generator)
    assert found.model.dtype == torch.float32
    assert found.status.tolist()[:2] == [Status.OK, Status.OK]
    assert found.status[2] != Status.OK
    assert torch.isfinite(found.model).all()
    with pytest.raises(ValueError, match="gravity2"):
        estimate_upright(d1, d2, up1, up2[..., :2], threshold=3e-3)


def test_cameras_that_only_turned_are_told(generator: torch.Generator) -> None:
    """Every translation fits them; those that moved are not among them."""
    down = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    R = rotation_from_rotvec(0.3 * down)
    X = torch.randn(20, 60, 3, generator=generator, dtype=torch.float64) + torch.tensor([0.0, 0.0, 6.0])
    centre = torch.nn.functional.normalize(torch.randn(20, 1, 3, generator=generator, dtype=torch.float64), dim=-1)

    def found(centre: torch.Tensor) -> torch.Tensor:
        rays = [torch.nn.functional.normalize(d, dim=-1) for d in (X, (X - centre) @ R.mT)]
        noisy = [d + 1e-3 * torch.randn(d.shape, generator=generator, dtype=torch.float64) for d in rays]
        result = estimate_upright(*noisy, down, down, threshold=3e-3, generator=generator)
        assert (result.status == Status.OK).all()
        return result.degeneracy

    assert (found(0 * centre) == Degeneracy.ROTATION).all()
    assert (found(centre) == Degeneracy.NONE).all()


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_points_of_a_line_are_told(noise: float, generator: torch.Generator) -> None:
    """Several upright poses fit them."""
    draw = {"generator": generator, "dtype": torch.float64}
    down = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    R = rotation_from_rotvec(0.3 * down)
    along = torch.linspace(-1, 1, 60, dtype=torch.float64)[:, None]
    X = along * 0.6 * torch.randn(20, 1, 3, **draw) + 0.3 * torch.randn(20, 1, 3, **draw) + torch.tensor([0.0, 0.0, 5.0])
    X[:10, :1] += 0.5 * torch.randn(10, 1, 3, **draw)  # one point off it changes nothing
    t = torch.nn.functional.normalize(torch.randn(20, 1, 3, **draw), dim=-1)
    rays = [torch.nn.functional.normalize(d, dim=-1) + noise * torch.randn(X.shape, **draw) for d in (X, X @ R.mT + t)]
    found = estimate_upright(*rays, down, down, threshold=5e-3, generator=generator)
    assert not ((found.status == Status.OK) & (found.degeneracy == Degeneracy.NONE)).any()


@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_rays_that_contradict_the_verticals_are_told(wrong: float, generator: torch.Generator) -> None:
    scene = make_scene(UprightPoseEstimator, (40,), 100, generator, 1e-3)
    bad = torch.rand(40, 100, generator=generator) < wrong
    d1, d2 = scene.spoil(scene.data, bad, generator) if wrong else scene.data
    up1, up2 = scene.estimator.gravity1, scene.estimator.gravity2
    off = torch.linalg.cross(up2, torch.randn(up2.shape, generator=generator, dtype=up2.dtype))
    off = torch.nn.functional.normalize(off, dim=-1)
    for angle, right in ((0.005, 1.0), (0.15, 0.0)):
        tilted = torch.nn.functional.normalize(up2 + angle * off, dim=-1)
        found = estimate_upright(d1, d2, up1, tilted, threshold=5e-3, generator=generator)
        good = (found.status == Status.OK) == bool(right)
        assert_share(good, 0.8)
