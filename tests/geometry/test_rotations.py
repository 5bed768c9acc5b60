import math

import pytest
import torch
from chance import seeded
from hypothesis import given, settings
from hypothesis import strategies as st

from torchsfm.geometry import (
    cross_matrix,
    quaternion_wxyz_from_rotation,
    random_rotation,
    rotation_angle,
    rotation_from_euler,
    rotation_from_quaternion_wxyz,
    rotation_from_rotvec,
    rotvec_from_rotation,
)

ANGLES = [
    0.0,
    1e-300,
    1e-12,
    1e-8,
    1e-4,
    0.02,
    0.0316,
    0.0317,
    0.1,
    1.0,
    2.0,
    3.0,
    math.pi - 1e-4,
    math.pi - 1e-7,
    math.pi - 1e-11,
]


def axes(count, generator):
    v = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    v[:3] = torch.eye(3, dtype=torch.float64)
    v[3:6] = -torch.eye(3, dtype=torch.float64)
    return v / v.norm(dim=-1, keepdim=True)


@settings(deadline=None, max_examples=100)
@given(st.floats(0, math.pi), st.integers(0, 2**31))
def test_matrix_exponential_and_round_trip(angle, seed):
    w = axes(8, seeded(seed)) * angle
    R = rotation_from_rotvec(w)
    torch.testing.assert_close(R, torch.linalg.matrix_exp(cross_matrix(w)), atol=1e-14, rtol=0)
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand(8, 3, 3), atol=4e-15, rtol=0)
    torch.testing.assert_close(rotation_from_rotvec(rotvec_from_rotation(R)), R, atol=4e-15, rtol=0)
    torch.testing.assert_close(rotation_angle(R), torch.full((8,), angle, dtype=torch.float64), atol=4e-15, rtol=0)
    q = quaternion_wxyz_from_rotation(R)
    assert (q[:, 0] >= 0).all()
    torch.testing.assert_close(rotation_from_quaternion_wxyz(q * 3), R, atol=4e-15, rtol=0)


@pytest.mark.parametrize("angle", ANGLES)
def test_the_logarithm_keeps_relative_accuracy(angle, generator):
    """Relative to the angle: the matrix knows the smaller coordinates no better."""
    w = axes(200, generator) * angle
    error = (rotvec_from_rotation(rotation_from_rotvec(w)) - w) / max(angle, 1e-300)
    assert error.norm(dim=-1).max() < 1e-15


def test_the_logarithm_of_half_turns(generator):
    v = axes(200, generator)
    R = 2 * v[:, :, None] * v[:, None, :] - torch.eye(3, dtype=torch.float64)
    w = rotvec_from_rotation(R)
    torch.testing.assert_close(w.norm(dim=-1), torch.full((200,), math.pi, dtype=torch.float64))
    torch.testing.assert_close((w * v).sum(-1).abs(), torch.full((200,), math.pi, dtype=torch.float64))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.0316, 0.0317, 0.5, 2.0, 3.0, math.pi - 1e-3])
def test_gradients(angle, generator):
    w = (axes(12, generator) * angle).requires_grad_()
    assert torch.autograd.gradcheck(rotation_from_rotvec, w)
    assert torch.autograd.gradcheck(lambda w: rotvec_from_rotation(rotation_from_rotvec(w)), w, eps=1e-7, atol=1e-5)
    assert torch.autograd.gradcheck(lambda w: quaternion_wxyz_from_rotation(rotation_from_rotvec(w)), w)
    if angle > 0.01:
        assert torch.autograd.gradcheck(lambda w: rotation_angle(rotation_from_rotvec(w)), w, eps=1e-7, atol=1e-5)


def test_the_logarithm_undoes_the_exponential_in_derivatives_too(generator):
    """The chain of both Jacobians is the identity to full accuracy, which finite differences near pi cannot see."""
    for angle in ANGLES:
        w = axes(6, generator) * angle
        J = torch.func.vmap(torch.func.jacrev(lambda w: rotvec_from_rotation(rotation_from_rotvec(w))))(w)
        distance = max(math.pi - angle, 1e-12)
        torch.testing.assert_close(J, torch.eye(3, dtype=torch.float64).expand(6, 3, 3), atol=1e-13 / min(1, distance), rtol=0)


def test_second_derivatives_at_zero():
    w = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradgradcheck(rotation_from_rotvec, w)
    assert torch.autograd.gradgradcheck(lambda w: rotvec_from_rotation(rotation_from_rotvec(w)), w)


def test_angle_has_zero_gradient_where_it_has_none():
    R = torch.eye(3, dtype=torch.float64).requires_grad_()
    rotation_angle(R).backward()
    assert R.grad.isfinite().all()


def test_cross_matrix(generator):
    a, b = torch.randn(2, 4, 5, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close((cross_matrix(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b))
    assert (cross_matrix(a) == -cross_matrix(a).mT).all()


@pytest.mark.parametrize("order", ["x", "zx", "xyz", "zyx", "zxz", "XYZ", "ZYX", "YXY", "Z"])
def test_euler_angles_follow_scipy(order, generator):
    scipy_rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    angles = torch.randn(2, 7, len(order), generator=generator, dtype=torch.float64)
    expected = scipy_rotation.from_euler(order, angles.reshape(-1, len(order)).numpy()).as_matrix()
    torch.testing.assert_close(rotation_from_euler(angles, order).reshape(-1, 3, 3), torch.from_numpy(expected))


@pytest.mark.parametrize("order", ["", "xYz", "abc", "xy"])
def test_euler_angles_refuse_other_orders(order):
    with pytest.raises(ValueError, match=r"axes|angles"):
        rotation_from_euler(torch.zeros(3), order)


def test_random_rotations_are_uniform_and_repeatable():
    R = random_rotation(40000, generator=seeded(1), dtype=torch.float64)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(40000, dtype=torch.float64))
    assert (random_rotation(40000, generator=seeded(1), dtype=torch.float64) == R).all()
    assert R.mean(0).abs().max() < 0.012
    # Under the Haar measure the angle has density (1 - cos a) / pi: its mean is pi / 2 + 2 / pi.
    assert abs(rotation_angle(R).mean().item() - (math.pi / 2 + 2 / math.pi)) < 0.02
    assert random_rotation().shape == (3, 3)
    assert random_rotation(2, 0).shape == (2, 0, 3, 3)


def test_zero_quaternion_is_the_identity():
    q = torch.zeros(4, requires_grad=True)
    R = rotation_from_quaternion_wxyz(q)
    assert (torch.eye(3) == R).all()
    R.sum().backward()
    assert q.grad.isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_is_kept(dtype, generator):
    R = random_rotation(3, generator=generator, dtype=dtype)
    for result in (rotvec_from_rotation(R), quaternion_wxyz_from_rotation(R), rotation_angle(R)):
        assert result.dtype == dtype
    assert rotation_from_rotvec(torch.zeros(2, 3, dtype=dtype)).dtype == dtype
