import pytest
import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry.rotations import random_rotation, rotation_from_rotvec
from torchsfm.tensors import (
    bifocal_tensors,
    cameras_from_fundamental,
    epipolar_lines,
    epipoles,
    essential_from_fundamental,
    essential_from_pose,
    fundamental_from_cameras,
    fundamental_from_essential,
    fundamental_from_pose,
    pose_from_essential,
    poses_from_essential,
    poses_from_fundamental,
)

F64 = torch.float64
K1 = torch.tensor([[800.0, 1, 320], [0, 820, 240], [0, 0, 1]], dtype=F64)
K2 = torch.tensor([[500.0, 0, 200], [0, 510, 150], [0, 0, 1]], dtype=F64)


def up_to_scale(A: Tensor, B: Tensor) -> Tensor:
    """Distance of the matrices as points of projective space."""
    A, B = A / A.norm(dim=(-2, -1), keepdim=True), B / B.norm(dim=(-2, -1), keepdim=True)
    return torch.minimum((A - B).norm(dim=(-2, -1)), (A + B).norm(dim=(-2, -1)))


def two_views(*shape: int, n: int = 12, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rotations, unit baselines and the same points before both cameras."""
    R = rotation_from_rotvec(0.4 * torch.randn(*shape, 3, dtype=F64, generator=generator))
    t = torch.nn.functional.normalize(torch.randn(*shape, 3, dtype=F64, generator=generator), dim=-1)
    X = 3 * torch.rand(*shape, n, 3, dtype=F64, generator=generator) - 1.5
    X[..., 2] += 6
    return R, t, X, X @ R.mT + t[..., None, :]


def pixels(X: Tensor, K: Tensor) -> Tensor:
    x = X @ K.mT
    return x[..., :2] / x[..., 2:]


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,)])
def test_matrices_satisfy_the_epipolar_constraint(shape: tuple[int, ...], generator: torch.Generator) -> None:
    R, t, d1, d2 = two_views(*shape, generator=generator)
    E = essential_from_pose(R, t)
    assert ((d2 @ E) * d1).sum(-1).abs().sum() < 1e-11
    F = fundamental_from_pose(R, t, K1, K2)
    line = epipolar_lines(F, pixels(d1, K1))
    x2 = torch.nn.functional.pad(pixels(d2, K2), (0, 1), value=1.0)
    assert (line * x2).sum(-1).abs().sum() < 1e-8
    torch.testing.assert_close(line[..., :2].norm(dim=-1), torch.ones_like(line[..., 0]))
    torch.testing.assert_close(essential_from_fundamental(F, K1, K2), E)
    torch.testing.assert_close(fundamental_from_essential(E, K1, K2), F)


def test_fundamental_from_cameras_in_any_coordinates(generator: torch.Generator) -> None:
    R, t, _, _ = two_views(20, generator=generator)
    F = fundamental_from_pose(R, t, K1, K2)
    P1 = K1 @ torch.eye(3, 4, dtype=F64)
    P2 = K2 @ torch.cat((R, t[..., None]), -1)
    F_cameras = fundamental_from_cameras(P1, P2)
    assert up_to_scale(F_cameras, F).max() < 1e-12
    # The sign is that of [t]x R.
    assert ((F_cameras * F).sum((-2, -1)) > 0).all()
    H = torch.randn(20, 4, 4, dtype=F64, generator=generator)
    assert up_to_scale(fundamental_from_cameras(P1 @ H, P2 @ H), F).max() < 1e-9
    # Affine cameras, and the same centre twice.
    affine = torch.randn(2, 5, 3, 4, dtype=F64, generator=generator)
    affine[..., 2, :] = torch.tensor([0.0, 0, 0, 1], dtype=F64)
    F_affine = fundamental_from_cameras(*affine)
    assert F_affine[..., :2, :2].abs().max() < 1e-12
    assert (F_affine.abs().amax((-2, -1)) > 1e-6).all()
    assert (
        fundamental_from_cameras(P2, K1 @ R.mT @ torch.linalg.inv(K2) @ P2).abs().max() < 1e-3 * F_cameras.abs().amin(0).max()
    )


def test_bifocal_tensors_are_pairwise(generator: torch.Generator) -> None:
    P = torch.randn(2, 4, 3, 4, dtype=F64, generator=generator)
    index = torch.tensor([[0, 1], [3, 2], [1, 0]])
    F = bifocal_tensors(P, index)
    for k, (i, j) in enumerate(index.tolist()):
        assert torch.equal(F[:, k], fundamental_from_cameras(P[:, i], P[:, j]))
    torch.testing.assert_close(F[:, 0], F[:, 2].mT)


def test_cameras_and_epipoles_of_a_fundamental_matrix(generator: torch.Generator) -> None:
    P = torch.randn(2, 30, 3, 4, dtype=F64, generator=generator)
    F = fundamental_from_cameras(P[0], P[1]) * 1e7
    assert up_to_scale(fundamental_from_cameras(*cameras_from_fundamental(F)), F).max() < 1e-10
    e1, e2 = epipoles(F)
    size = F.norm(dim=(-2, -1))[:, None]
    assert ((F @ e1[..., None])[..., 0] / size).abs().max() < 1e-12
    assert ((F.mT @ e2[..., None])[..., 0] / size).abs().max() < 1e-12
    centre2 = torch.linalg.svd(P[1]).Vh[..., -1, :]
    expected = torch.nn.functional.normalize((P[0] @ centre2[..., None])[..., 0], dim=-1)
    torch.testing.assert_close((expected * e1).sum(-1).abs(), torch.ones(30, dtype=F64))


def test_four_poses_of_an_essential_matrix(generator: torch.Generator) -> None:
    R = random_rotation(40, generator=generator, dtype=F64)
    t = torch.nn.functional.normalize(torch.randn(40, 3, dtype=F64, generator=generator), dim=-1)
    scale = torch.randn(40, 1, 1, dtype=F64, generator=generator) * 100
    poses = poses_from_essential(essential_from_pose(R, t) * scale)
    assert poses.valid.all()
    Rs, ts = poses.model[..., :3], poses.model[..., 3]
    torch.testing.assert_close(Rs @ Rs.mT, torch.eye(3, dtype=F64).expand_as(Rs))
    torch.testing.assert_close(torch.linalg.det(Rs), torch.ones(40, 4, dtype=F64))
    E = essential_from_pose(Rs, ts)
    assert up_to_scale(E, essential_from_pose(R, t)[:, None]).max() < 1e-12
    distance = (Rs - R[:, None]).norm(dim=(-2, -1)) + (ts - t[:, None]).norm(dim=-1)
    assert distance.amin(-1).max() < 1e-11
    # Four different ones.
    gap = (poses.model[:, :, None] - poses.model[:, None]).norm(dim=(-2, -1)) + 9 * torch.eye(4, dtype=F64)
    assert gap.min() > 1e-3


def test_poses_of_a_matrix_that_is_not_essential_are_those_by_svd(generator: torch.Generator) -> None:
    E = torch.randn(50, 3, 3, dtype=F64, generator=generator)
    model = poses_from_essential(E).model
    U, _, Vh = torch.linalg.svd(E)
    W = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=F64)
    for twist in (W, W.mT):
        R = U @ twist @ Vh
        R = R * torch.linalg.det(R)[:, None, None]
        assert (model[..., :3] - R[:, None]).norm(dim=(-2, -1)).amin(-1).max() < 1e-9
    assert (model[:, 0, :, 3] - U[..., 2]).norm(dim=-1).minimum((model[:, 0, :, 3] + U[..., 2]).norm(dim=-1)).max() < 1e-9


def test_poses_degenerate(generator: torch.Generator) -> None:
    E = essential_from_pose(random_rotation(5, generator=generator, dtype=F64), torch.ones(5, 3, dtype=F64))
    reference = poses_from_essential(E)
    E[1], E[3, 0, 0] = 0, float("nan")
    E[4] = torch.ones(3, 3)
    E.requires_grad_()
    poses = poses_from_essential(E)
    assert poses.valid.tolist() == [[True] * 4, [False] * 4, [True] * 4, [False] * 4, [False] * 4]
    assert torch.isfinite(poses.model).all()
    assert torch.equal(poses.model[[0, 2]], reference.model[[0, 2]])
    poses.model.sum().backward()
    assert E.grad is not None
    assert torch.isfinite(E.grad).all()


@pytest.mark.parametrize("dtype", [F64, torch.float32])
@pytest.mark.parametrize("shape", [(), (1,), (2, 3)])
def test_pose_from_essential_finds_the_pose(shape: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator) -> None:
    R, t, d1, d2 = two_views(*shape, generator=generator)
    d2 = d2 * (0.1 + torch.rand(*shape, 12, 1, dtype=F64, generator=generator))
    pose = pose_from_essential((-7 * essential_from_pose(R, t)).to(dtype), d1.to(dtype), d2.to(dtype))
    tolerance = 1e-10 if dtype == F64 else 1e-4
    assert pose.model.dtype == dtype
    assert pose.pose.matrix().equal(pose.model)
    assert (pose.model - torch.cat((R, t[..., None]), -1)).abs().max() < tolerance
    assert pose.in_front.all()
    assert (pose.status == Status.OK).all()


def test_pose_from_essential_outvotes_outliers_and_heeds_weights(generator: torch.Generator) -> None:
    R, t, d1, d2 = two_views(30, n=20, generator=generator)
    E = essential_from_pose(R, t)
    truth = torch.cat((R, t[..., None]), -1)
    # Twelve points behind both cameras outvote eight, unless weights or a mask take them out.
    d1[:, 8:], d2[:, 8:] = -d1[:, 8:], -d2[:, 8:]
    mask = torch.arange(20) < 8
    for weights in (mask, mask.double() * 0.3):
        pose = pose_from_essential(E, d1, d2, weights)
        assert (pose.model - truth).abs().max() < 1e-10
        assert torch.equal(pose.in_front, mask.expand(30, 20))
    d1[:, 9] = float("nan")
    d2[:, 10] = 0
    assert (pose_from_essential(E, d1, d2, mask).model - truth).abs().max() < 1e-10


def test_points_far_away_count_as_in_front(generator: torch.Generator) -> None:
    R, t, d1, _ = two_views(30, n=40, generator=generator)
    d1 = torch.cat((d1[:, :6], 1e7 * d1[:, 6:]), 1)
    d2 = d1 @ R.mT + t[:, None]
    d1, d2 = (torch.nn.functional.normalize(d, dim=-1) for d in (d1, d2))
    d2 = d2 + 1e-6 * torch.randn(d2.shape, dtype=F64, generator=generator)
    pose = pose_from_essential(essential_from_pose(R, t), d1, d2)
    assert (pose.model - torch.cat((R, t[..., None]), -1)).abs().max() < 1e-10
    assert pose.in_front.all()
    # Points at infinity alone leave the sign of t open, but not the rotation.
    pose = pose_from_essential(essential_from_pose(R, t), d1[:, 6:], (d1 @ R.mT)[:, 6:])
    assert (pose.model[..., :3] - R).abs().max() < 1e-10
    assert pose.in_front.all()


def test_pose_statuses_leave_neighbours_alone(generator: torch.Generator) -> None:
    R, t, d1, d2 = two_views(6, generator=generator)
    E = essential_from_pose(R, t)
    weights = torch.ones(6, 12, dtype=F64)
    reference = pose_from_essential(E, d1, d2, weights)
    E[1, 2, 2] = float("inf")
    E[2] = 0
    weights[3] = 0
    # Looked at through mirrors: every pair of rays diverges.
    d1[4] = d1[4] * torch.tensor([1.0, 1, -1]).where(torch.arange(12)[:, None] % 2 == 0, torch.ones(3))
    pose = pose_from_essential(E, d1, d2, weights)
    wanted = [Status.OK, Status.NOT_FINITE, Status.DEGENERATE, Status.TOO_FEW]
    assert pose.status[:4].tolist() == wanted
    assert pose.status.dtype == torch.int8
    assert torch.isfinite(pose.model).all()
    assert not pose.in_front[1:4].any()
    assert torch.equal(pose.model[[0, 5]], reference.model[[0, 5]])
    behind = pose_from_essential(E[:1], torch.cat((d1[:1], d1[:1]), 1), torch.cat((d2[:1], -d2[:1]), 1))
    assert behind.status.tolist() == [Status.BEHIND]
    assert behind.in_front.sum() == 12


def test_poses_from_fundamental(generator: torch.Generator) -> None:
    R, t, _, _ = two_views(10, generator=generator)
    poses = poses_from_fundamental(fundamental_from_pose(R, t, K1, K2), K1, K2)
    distance = (poses.model - torch.cat((R, t[..., None]), -1)[:, None]).norm(dim=(-2, -1)).amin(-1)
    assert distance.max() < 1e-9


def test_derivatives(generator: torch.Generator) -> None:
    R, t, d1, d2 = two_views(2, generator=generator)
    E = essential_from_pose(R, t).requires_grad_()
    assert torch.autograd.gradcheck(lambda E: poses_from_essential(E).model, E)
    assert torch.autograd.gradcheck(lambda E: pose_from_essential(E, d1, d2).model, E)
    F = torch.randn(2, 3, 3, dtype=F64, generator=generator).requires_grad_()
    assert torch.autograd.gradcheck(epipoles, F)
    assert torch.autograd.gradcheck(cameras_from_fundamental, F)
    P = torch.randn(2, 2, 3, 4, dtype=F64, generator=generator).requires_grad_()
    assert torch.autograd.gradcheck(lambda P: fundamental_from_cameras(P[0], P[1]), P)
    x = torch.randn(2, 4, 2, dtype=F64, generator=generator).requires_grad_()
    assert torch.autograd.gradcheck(epipolar_lines, (F, x))


def test_pose_batch_equals_loop(generator: torch.Generator) -> None:
    R, t, d1, d2 = two_views(2, 3, generator=generator)
    E = essential_from_pose(R, t)
    pose = pose_from_essential(E, d1, d2)
    for i in range(2):
        for j in range(3):
            one = pose_from_essential(E[i, j], d1[i, j], d2[i, j])
            torch.testing.assert_close(one.model, pose.model[i, j], rtol=0, atol=1e-15)
            assert torch.equal(one.in_front, pose.in_front[i, j])


def test_wrong_shapes(unchecked: None) -> None:
    with pytest.raises(ValueError, match="E"):
        poses_from_essential(torch.zeros(3, 4))
    with pytest.raises(ValueError, match="d2"):
        pose_from_essential(torch.eye(3), torch.zeros(5, 3), torch.zeros(4, 3))
    with pytest.raises(ValueError, match="weights"):
        pose_from_essential(torch.eye(3), torch.zeros(5, 3), torch.zeros(5, 3), torch.zeros(5, dtype=torch.long))
