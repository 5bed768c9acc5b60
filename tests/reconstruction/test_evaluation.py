"""Errors of a reconstruction against the truth: what they are zero for, what they measure, and what infinite means."""

import math

import numpy as np
import pytest
import torch
from chance import numpy_seeded
from torch import Tensor

from torchsfm.geometry import Camera, Pose, Similarity, random_rotation, rotation_from_rotvec
from torchsfm.reconstruction.model.evaluation import align_poses, align_reconstruction, pose_auc, pose_errors, position_rmse
from torchsfm.reconstruction.model.reconstruction import Reconstruction

F64 = torch.float64


def random_poses(*shape: int, generator: torch.Generator) -> Pose:
    return Pose(random_rotation(*shape, generator=generator, dtype=F64), torch.randn(*shape, 3, generator=generator, dtype=F64))


def random_similarity(*shape: int, generator: torch.Generator) -> Similarity:
    R = random_rotation(*shape, generator=generator, dtype=F64)
    return Similarity(torch.full(shape, 3.7, dtype=F64), R, torch.randn(*shape, 3, generator=generator, dtype=F64))


def superglue_auc(errors: np.ndarray, thresholds: list[float]) -> list[float]:
    """The definition as the SuperGlue evaluation writes it, in a loop."""
    errors = np.sort(errors)
    recall = (np.arange(len(errors)) + 1) / len(errors)
    errors, recall = np.r_[0.0, errors], np.r_[0.0, recall]
    areas = []
    for threshold in thresholds:
        last = np.searchsorted(errors, threshold)
        r = np.r_[recall[:last], recall[last - 1]]
        e = np.r_[errors[:last], threshold]
        areas.append(np.trapezoid(r, x=e) / threshold)
    return areas


@pytest.mark.parametrize("views", [3, 12])
def test_frame_and_scale_do_not_count(views: int, generator: torch.Generator) -> None:
    truth = random_poses(views, generator=generator)
    estimate = random_similarity(generator=generator).transform_pose(truth)
    errors = pose_errors(estimate, truth)
    assert errors.pose.shape == (views * (views - 1) // 2,)
    for error in (errors.rotation, errors.direction, errors.image_rotation, errors.image_position):
        assert float(error.max()) < 1e-10
    assert float(position_rmse(estimate, truth)) < 1e-12
    assert pose_auc(errors.pose).min() > 1 - 1e-10


def test_a_turned_camera_is_wrong_by_its_angle_in_its_own_pairs(generator: torch.Generator) -> None:
    truth = random_poses(6, generator=generator)
    turn = rotation_from_rotvec(torch.tensor([0.0, math.radians(3), 0.0], dtype=F64))
    R, t = truth.R.clone(), truth.t.clone()
    R[2], t[2] = turn @ truth.R[2], turn @ truth.t[2]
    errors = pose_errors(Pose(R, t), truth)
    touched = (errors.pair == 2).any(-1)
    torch.testing.assert_close(errors.rotation, 3.0 * touched.to(F64), atol=1e-9, rtol=0)
    # The direction is seen from the second image of a pair: only there does the turn move it.
    second = errors.pair[:, 1] == 2
    assert (errors.direction[~second] < 1e-9).all()
    assert ((errors.direction[second] > 0) & (errors.direction[second] <= 3 + 1e-9)).all()
    assert float(position_rmse(Pose(R, t), truth)) < 1e-12


def test_a_direction_error_is_the_angle_between_baselines() -> None:
    eye = torch.eye(3, dtype=F64).expand(2, 3, 3)
    truth = Pose(eye, torch.tensor([[0.0, 0, 0], [1, 0, 0]], dtype=F64))
    angle = math.radians(20)
    estimate = Pose(eye, torch.tensor([[0.0, 0, 0], [5 * math.cos(angle), 5 * math.sin(angle), 0]], dtype=F64))
    assert float(pose_errors(estimate, truth).direction) == pytest.approx(20)
    assert float(pose_errors(Pose(eye, -truth.t), truth).direction) == pytest.approx(180)
    # No true baseline: there is no direction to find. No estimated one: as far as a direction can be from knowing nothing.
    still = Pose(eye, torch.zeros(2, 3, dtype=F64))
    assert float(pose_errors(estimate, still).direction) == 0
    assert float(pose_errors(still, truth).direction) == 90


def test_images_without_a_pose_are_infinitely_wrong(generator: torch.Generator) -> None:
    truth = random_poses(5, generator=generator)
    registered = torch.tensor([True, True, False, True, True])
    estimate = random_similarity(generator=generator).transform_pose(truth)
    estimate = Pose(estimate.R.clone(), estimate.t.clone())
    estimate.R[2], estimate.t[2] = torch.eye(3, dtype=F64), 100.0
    errors = pose_errors(estimate, truth, registered)
    touched = (errors.pair == 2).any(-1)
    assert torch.equal(torch.isinf(errors.pose), touched)
    assert torch.equal(torch.isinf(errors.image_position), ~registered)
    assert torch.equal(torch.isinf(errors.image_rotation), ~registered)
    assert float(position_rmse(estimate, truth, registered)) < 1e-12
    assert float(pose_auc(errors.pose)[0]) == pytest.approx(0.6, abs=1e-9)
    nothing = torch.zeros(5, dtype=torch.bool)
    assert math.isinf(float(position_rmse(estimate, truth, nothing)))
    assert torch.isinf(pose_errors(estimate, truth, nothing).pose).all()


@pytest.mark.parametrize("views", [1, 2, 6])
def test_centres_on_a_line_are_aligned_by_orientations(views: int, generator: torch.Generator) -> None:
    R = random_rotation(views, generator=generator, dtype=F64)
    centre = torch.linspace(0, 1, views, dtype=F64)[:, None] * torch.tensor([1.0, 2, 3], dtype=F64)
    truth = Pose(R, -(R @ centre[..., None])[..., 0])
    similarity = random_similarity(generator=generator)
    back = align_poses(similarity.transform_pose(truth), truth)
    torch.testing.assert_close(back.R, similarity.R.mT)
    X = torch.randn(4, 3, generator=generator, dtype=F64)
    if views > 1:
        torch.testing.assert_close(back.transform(similarity.transform(X)), X)


def test_rmse_is_in_the_unit_of_the_truth(generator: torch.Generator) -> None:
    corners = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=F64)
    eye = torch.eye(3, dtype=F64).expand(8, 3, 3)
    truth = Pose(eye, torch.cat([corners, -corners]))
    # Pushes along z that no similarity can explain: every corner up or down by 0.01, odd along each of the cube's axes.
    push = 0.01 * torch.tensor([1.0, 1, 1, 1, -1, -1, -1, -1], dtype=F64)[:, None] * torch.tensor([0, 0, 1.0], dtype=F64)
    estimate = random_similarity(generator=generator).transform_pose(Pose(eye, truth.t + push))
    assert float(position_rmse(estimate, truth)) == pytest.approx(0.01, rel=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_auc_is_that_of_superglue(seed: int) -> None:
    generator = numpy_seeded(seed)
    errors = generator.exponential(2.0, 40)
    errors[generator.random(40) < 0.2] = np.inf
    thresholds = [0.5, 1.0, 2.0, 5.0, 10.0]
    ours = pose_auc(torch.from_numpy(errors), thresholds)
    np.testing.assert_allclose(ours.numpy(), superglue_auc(errors, thresholds), atol=1e-12)


def test_auc_by_hand() -> None:
    def auc(*errors: float) -> float:
        return float(pose_auc(torch.tensor(errors, dtype=F64), (1.0,)))

    assert auc(0, 0, 0) == 1
    assert auc(math.inf, math.inf) == 0
    assert auc(1.0) == 0
    assert auc(0.5) == pytest.approx(0.75)
    assert auc(0.5, math.inf) == pytest.approx(0.375)
    assert torch.equal(pose_auc(torch.zeros(3, 0)), torch.zeros(3, 3))


def test_a_batch_is_its_elements(generator: torch.Generator) -> None:
    truth, estimate = (random_poses(2, 3, 5, generator=generator) for _ in range(2))
    registered = torch.rand(2, 3, 5, generator=generator) < 0.8
    together = pose_errors(estimate, truth, registered)
    areas, rmse = pose_auc(together.pose, (90.0, 180.0)), position_rmse(estimate, truth, registered)
    for i, j in np.ndindex(2, 3):
        alone = pose_errors(estimate[i, j], truth[i, j], registered[i, j])
        torch.testing.assert_close(together.pose[i, j], alone.pose)
        torch.testing.assert_close(together.image_position[i, j], alone.image_position)
        torch.testing.assert_close(areas[i, j], pose_auc(alone.pose, (90.0, 180.0)))
        torch.testing.assert_close(rmse[i, j], position_rmse(estimate[i, j], truth[i, j], registered[i, j]))


def small_reconstruction(poses: Pose, X: Tensor) -> Reconstruction:
    views, points = poses.t.shape[0], X.shape[0]
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=F64)
    return Reconstruction(
        names=tuple(f"{i}.png" for i in range(views)),
        image_size=torch.tensor([[640, 480]]).expand(views, 2),
        cameras=Camera(K[None]),
        camera_index=torch.zeros(views, dtype=torch.long),
        poses=poses,
        registered=torch.ones(views, dtype=torch.bool),
        X=X,
        color=torch.zeros_like(X),
        x=torch.zeros(views * points, 2, dtype=F64),
        view=torch.arange(views).repeat(points),
        point=torch.arange(points).repeat_interleave(views),
    )


def test_a_reconstruction_is_carried_onto_the_truth(generator: torch.Generator) -> None:
    truth = random_poses(5, generator=generator)
    truth = Pose(truth.R, truth.t + torch.tensor([0, 0, 20.0], dtype=F64))
    X = torch.randn(7, 3, generator=generator, dtype=F64)
    similarity = random_similarity(generator=generator)
    model = small_reconstruction(similarity.transform_pose(truth), similarity.transform(X))
    aligned = align_reconstruction(model, truth)
    torch.testing.assert_close(aligned.X, X)
    torch.testing.assert_close(aligned.poses.t, truth.t)
    torch.testing.assert_close(aligned.projections(), model.projections())
