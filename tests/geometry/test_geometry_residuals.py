import math

import pytest
import torch

from torchsfm.geometry import (
    camera_from_krt,
    cross_matrix,
    epipolar_distance,
    intrinsics,
    project_points,
    random_rotation,
    reprojection_distance,
    sampson_distance,
    to_homogeneous,
    transfer_distance,
    transform_points,
)

F64 = torch.float64


def scene(generator, count=40):
    """Two cameras, their F by definition, exact point pairs in front."""
    K = intrinsics(torch.tensor(800.0, dtype=F64), torch.tensor([320.0, 240.0], dtype=F64))
    R = random_rotation(generator=generator, dtype=F64)
    R = torch.linalg.matrix_exp(0.1 * (R - R.T))
    t = torch.tensor([1.0, 0.2, 0.1], dtype=F64)
    F = torch.linalg.inv(K).T @ cross_matrix(t) @ R @ torch.linalg.inv(K)
    X = torch.randn(count, 3, generator=generator, dtype=F64) + torch.tensor([0.0, 0.0, 6.0], dtype=F64)
    P1 = camera_from_krt(K, torch.eye(3, dtype=F64), torch.zeros(3, dtype=F64))
    P2 = camera_from_krt(K, R, t)
    return F, P1, P2, X, project_points(P1, X), project_points(P2, X)


def nearest_pair(F, x1, x2):
    """Distance in 4-space to the nearest pair with x2' F x1 = 0, by Newton on the Lagrange conditions."""
    start = torch.cat([x1, x2])

    def constraint(z):
        return to_homogeneous(z[2:]) @ F @ to_homogeneous(z[:2])

    z = start.clone()
    for _ in range(20):
        gradient = torch.func.grad(constraint)(z)
        z = start - gradient * (constraint(z) + gradient @ (start - z)) / (gradient @ gradient)
    return (z - start).norm()


def test_exact_pairs_have_distance_zero(generator):
    F, _, P2, X, x1, x2 = scene(generator)
    assert sampson_distance(F, x1, x2).max() < 1e-10
    assert epipolar_distance(-3 * F, x1, x2).max() < 1e-10
    assert reprojection_distance(-2 * P2, X, x2).max() < 1e-10


def test_sampson_is_the_distance_to_the_nearest_pair_to_first_order(generator):
    F, _, _, _, x1, x2 = scene(generator, 10)
    noise = torch.randn(2, 10, 2, generator=generator, dtype=F64)
    for size, error in ((1.0, 1e-2), (1e-2, 1e-4)):
        a, b = x1 + size * noise[0], x2 + size * noise[1]
        exact = torch.stack([nearest_pair(F, p, q) for p, q in zip(a, b, strict=True)])
        torch.testing.assert_close(sampson_distance(1e5 * F, a, b), exact, rtol=error, atol=0)


def test_epipolar_distance_by_lines(generator):
    F, _, _, _, x1, x2 = scene(generator)
    a, b = x1 + torch.randn(40, 2, generator=generator, dtype=F64), x2 + torch.randn(40, 2, generator=generator, dtype=F64)
    squares = 0.0
    for M, p, q in ((F, a, b), (F.T, b, a)):
        line = to_homogeneous(p) @ M.T
        squares = squares + ((line * to_homogeneous(q)).sum(-1) / line[:, :2].norm(dim=-1)).square()
    torch.testing.assert_close(epipolar_distance(F, a, b), (squares / 2).sqrt())
    torch.testing.assert_close(epipolar_distance(F, a, b), epipolar_distance(F.T, b, a))
    torch.testing.assert_close(sampson_distance(F, a, b), sampson_distance(F.T, b, a))


def test_transfer_distance_by_hand_and_by_inverse(generator):
    shift = torch.tensor([[1.0, 0, 3], [0, 1, 4], [0, 0, 1]], dtype=F64)
    x = torch.randn(6, 2, generator=generator, dtype=F64)
    torch.testing.assert_close(transfer_distance(shift, x, x), torch.full((6,), 5.0, dtype=F64))
    H = torch.randn(3, 3, generator=generator, dtype=F64) + 3 * torch.eye(3, dtype=F64)
    y = transform_points(H, x)
    assert transfer_distance(-2 * H, x, y).max() < 1e-12
    z = y + torch.randn(6, 2, generator=generator, dtype=F64)
    forward = (transform_points(H, x) - z).square().sum(-1)
    backward = (transform_points(torch.linalg.inv(H), z) - x).square().sum(-1)
    torch.testing.assert_close(transfer_distance(H, x, z), ((forward + backward) / 2).sqrt())


def test_reprojection_distance_by_hand():
    P = torch.eye(3, 4, dtype=F64)
    X = torch.tensor([[0.0, 0, 1], [2, 2, 2], [2, 2, -2]], dtype=F64)
    x = torch.tensor([[3.0, 4], [1, 1], [-1, -1]], dtype=F64)
    assert reprojection_distance(P, X, x).tolist() == [5, 0, 0]


@pytest.mark.parametrize("name", ["sampson", "epipolar", "transfer"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_meaningless_pairs_are_huge_finite_and_alone(name, dtype, generator):
    distance = {"sampson": sampson_distance, "epipolar": epipolar_distance, "transfer": transfer_distance}[name]
    M = torch.randn(2, 3, 3, generator=generator, dtype=dtype)
    M[1] = 0
    x1, x2 = torch.randn(2, 6, 2, generator=generator, dtype=dtype)
    bad1, bad2 = x1.clone(), x2.clone()
    bad1[1, 0] = math.nan
    bad2[2, 1] = -math.inf
    M.requires_grad_()
    bad1.requires_grad_()
    bad2.requires_grad_()
    result = distance(M, bad1, bad2)
    assert result.isfinite().all()
    assert result.square().isfinite().all()
    huge = 0.1 * math.sqrt(torch.finfo(dtype).max)
    assert (result[1] > huge).all()
    assert (result[0, 1:3] > huge).all()
    keep = torch.tensor([0, 3, 4, 5])
    assert result[0, keep].equal(distance(M, x1, x2)[0, keep])
    result[0, keep].sum().backward()
    assert M.grad.isfinite().all()
    assert bad1.grad.isfinite().all()
    assert bad2.grad.isfinite().all()
    assert (M.grad[0] != 0).any()


def test_epipoles_have_no_epipolar_line():
    F = cross_matrix(torch.tensor([0.0, 0.0, 1.0], dtype=F64))
    origin, other = torch.zeros(1, 2, dtype=F64), torch.ones(1, 2, dtype=F64)
    assert sampson_distance(F, origin, origin) > 1e100
    assert epipolar_distance(F, origin, other) > 1e100
    assert sampson_distance(F, other, 2 * other) == 0


@pytest.mark.parametrize("shapes", [((), ()), ((3,), ()), ((), (2,)), ((2, 1), (4,)), ((0,), ())])
def test_batches_broadcast_like_loops(shapes, generator):
    M = torch.randn(*shapes[0], 3, 4, generator=generator, dtype=F64)
    X = torch.randn(*shapes[1], 5, 3, generator=generator, dtype=F64)
    x1, x2 = X[..., :2], X[..., 1:]
    batch = torch.broadcast_shapes(*shapes)
    calls = [
        (sampson_distance, (M[..., :3], x1, x2)),
        (epipolar_distance, (M[..., :3], x1, x2)),
        (transfer_distance, (M[..., :3], x1, x2)),
        (reprojection_distance, (M, X, x1)),
    ]
    for function, arguments in calls:
        result = function(*arguments)
        assert result.shape == (*batch, 5)
        flat = [a.expand(*batch, *a.shape[-2:]).reshape(-1, *a.shape[-2:]) for a in arguments]
        for row, *one in zip(result.reshape(-1, 5), *flat, strict=True):
            torch.testing.assert_close(row, function(*one), rtol=1e-12, atol=1e-12)


def test_gradients(generator):
    _, _, P2, X, _, _ = scene(generator, 5)
    M = torch.randn(3, 3, generator=generator, dtype=F64).requires_grad_()
    a, b = torch.randn(2, 5, 2, generator=generator, dtype=F64)
    a.requires_grad_()
    b.requires_grad_()
    for function in (sampson_distance, epipolar_distance, transfer_distance):
        assert torch.autograd.gradcheck(function, (M, a, b))
    assert torch.autograd.gradcheck(reprojection_distance, ((P2 / 800).requires_grad_(), X.requires_grad_(), b))
    exact = reprojection_distance(P2, X, project_points(P2, X).detach())
    exact.sum().backward()
    assert X.grad.isfinite().all()


@pytest.mark.reference
def test_opencv_sampson_agrees(generator):
    cv2 = pytest.importorskip("cv2")
    F, _, _, _, x1, x2 = scene(generator, 10)
    a, b = x1 + 1, x2 - 1
    expected = [
        cv2.sampsonDistance(p.numpy(), q.numpy(), F.numpy()) for p, q in zip(to_homogeneous(a), to_homogeneous(b), strict=True)
    ]
    torch.testing.assert_close(sampson_distance(F, a, b).square(), torch.tensor(expected, dtype=F64))
