"""Affine shape, depth space and balanced frames."""

import pytest
import torch
from chance import seeded
from torch import Tensor

from torchsfm.geometry import (
    affine_shape,
    balanced_frame,
    depth_space,
    from_homogeneous,
    normalize_shape,
    principal_angles,
    to_homogeneous,
)


def points(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=seeded(seed), dtype=torch.float64)


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,)])
@pytest.mark.parametrize("d", [2, 3])
def test_shape_and_depth_space_are_orthonormal_complements(batch: tuple[int, ...], d: int) -> None:
    x = points(*batch, 7, d) * 100 + 500
    depths = points(*batch, 7, seed=1).abs() + 0.1
    for lam in (None, depths):
        s, q = affine_shape(x, lam), depth_space(x, lam)
        assert s.shape == (*batch, 7, 6 - d)
        assert q.shape == (*batch, 7, d + 1)
        basis = torch.cat((s, q), -1)
        torch.testing.assert_close(basis.mT @ basis, torch.eye(7, dtype=torch.float64).expand(*batch, 7, 7), rtol=0, atol=1e-12)
        h = to_homogeneous(x) * (1 if lam is None else lam[..., None])
        assert (s.mT @ h).abs().sum() < 1e-7


def test_both_are_blind_to_affine_changes_and_follow_permutations() -> None:
    x, A, b = points(9, 2), points(2, 2, seed=1), points(2, seed=2)
    assert principal_angles(depth_space(x), depth_space(x @ A.mT + b)).max() < 1e-12
    assert principal_angles(affine_shape(x), affine_shape(x @ A.mT + b)).max() < 1e-12
    order = torch.randperm(9, generator=seeded())
    assert principal_angles(depth_space(x)[order], depth_space(x[order])).max() < 1e-12
    assert principal_angles(depth_space(x), depth_space(points(9, 2, seed=5))).max() > 0.1


def test_normalized_shape_has_orthonormal_coordinates_and_says_how() -> None:
    x = points(4, 8, 2) * 300 + 400
    y, T = normalize_shape(x)
    torch.testing.assert_close(y.mT @ y, torch.eye(3, dtype=torch.float64).expand(4, 3, 3), rtol=0, atol=1e-12)
    torch.testing.assert_close(to_homogeneous(x) @ T.mT, y, rtol=0, atol=1e-12)
    depths = points(4, 8, seed=3)
    y, T = normalize_shape(x, depths)
    torch.testing.assert_close(depths[..., None] * to_homogeneous(x) @ T.mT, y, rtol=0, atol=1e-10)


def test_principal_angles_are_accurate_at_both_ends() -> None:
    A = torch.eye(6, dtype=torch.float64)[:, :3]
    wanted = torch.tensor([1.5, 0.3, 1e-10], dtype=torch.float64)
    B = torch.zeros(6, 3, dtype=torch.float64)
    for i, angle in enumerate(wanted):
        B[i, i], B[i + 3, i] = torch.cos(angle), torch.sin(angle)
    mix = points(3, 3, seed=4)
    found = principal_angles(A @ points(3, 3, seed=5), B @ mix)
    torch.testing.assert_close(found, wanted, rtol=1e-6, atol=1e-13)
    torch.testing.assert_close(principal_angles(B, A[:, :1]), principal_angles(A[:, :1], B))
    assert principal_angles(A, torch.eye(6, dtype=torch.float64)[:, :4]).max() == 0


def test_degenerate_points_give_finite_numbers() -> None:
    line = torch.linspace(0, 1, 6, dtype=torch.float64)[:, None] * torch.tensor([2.0, 1.0], dtype=torch.float64)
    same = torch.ones(6, 2, dtype=torch.float64)
    broken = points(6, 2)
    broken[2] = torch.nan
    for x in (line, same, broken):
        for out in (*normalize_shape(x), depth_space(x), affine_shape(x), *balanced_frame(x)):
            assert torch.isfinite(out).all()
    assert not balanced_frame(line)[1]
    assert not balanced_frame(same)[1]
    assert balanced_frame(points(6, 2))[1]


def moments(x: Tensor, T: Tensor, w: Tensor) -> Tensor:
    a = torch.nn.functional.normalize(to_homogeneous(x) @ T.mT, dim=-1)
    return (a * w[..., None]).mT @ a / w.sum(-1)[..., None, None] * T.shape[-1]


def test_balanced_frame_has_equal_moments() -> None:
    x = points(5, 20, 2) * 200 + torch.tensor([700.0, 300.0], dtype=torch.float64)
    w = points(5, 20, seed=1).abs()
    w[:, ::5] = 0
    T, good = balanced_frame(x, w)
    assert good.all()
    torch.testing.assert_close(moments(x, T, w), torch.eye(3, dtype=torch.float64).expand(5, 3, 3), rtol=0, atol=1e-12)


def test_a_homography_turns_the_balanced_frame_and_no_more() -> None:
    x = points(30, 2)
    H = points(3, 3, seed=2) + 4 * torch.eye(3, dtype=torch.float64)
    y = from_homogeneous(to_homogeneous(x) @ H.mT)[0]
    turn = balanced_frame(y)[0] @ H @ torch.linalg.inv(balanced_frame(x)[0])
    torch.testing.assert_close(3 * turn @ turn.mT / (turn * turn).sum(), torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-10)


def test_absent_points_and_neighbours_leave_the_frame_alone() -> None:
    x = points(3, 12, 2)
    w = torch.ones(3, 12, dtype=torch.float64)
    w[1, 8:] = 0
    spoiled = x.clone()
    spoiled[0] = torch.nan
    spoiled[1, 8:] = torch.inf
    T, good = balanced_frame(spoiled, w)
    assert good.tolist() == [False, True, True]
    torch.testing.assert_close(T[1], balanced_frame(x[1, :8])[0])
    assert torch.equal(T[2], balanced_frame(x, w)[0][2])


def test_depth_space_projector_is_differentiable() -> None:
    def projector(x: Tensor) -> Tensor:
        q = depth_space(x)
        return q @ q.mT

    assert torch.autograd.gradcheck(projector, (points(2, 6, 2).requires_grad_(),))


@pytest.mark.usefixtures("unchecked")
def test_wrong_input_is_named() -> None:
    with pytest.raises(ValueError, match="x"):
        affine_shape(points(2, 2))
    with pytest.raises(ValueError, match="depths"):
        depth_space(points(6, 2), points(5))
    with pytest.raises(ValueError, match="B"):
        principal_angles(points(6, 2), points(5, 2))
