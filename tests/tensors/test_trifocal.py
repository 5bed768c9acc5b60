import pytest
import torch
from multiview_scenes import F64, cameras, images, line_images, line_through, points, up_to_scale

from torchsfm._types import Status
from torchsfm.tensors import (
    bifocal_tensors,
    cameras_from_fundamentals,
    cameras_from_trifocal,
    canonical_cameras,
    fundamentals_from_trifocal,
    homographies_from_trifocal,
    reordered_trifocal,
    transfer_lines_trifocal,
    transfer_points_trifocal,
    trifocal_constraints,
    trifocal_epipoles,
    trifocal_from_cameras,
    trifocal_from_fundamentals,
    trifocal_lll,
    trifocal_pll,
    trifocal_plp,
    trifocal_ppl,
    trifocal_ppp,
    trifocal_tensors,
)

PAIRS = torch.tensor([[0, 1], [0, 2], [1, 2]])


def test_layout_is_that_of_hartley_and_zisserman(generator: torch.Generator) -> None:
    B, C = torch.randn(2, 3, 4, generator=generator, dtype=F64)
    T = trifocal_from_cameras(torch.eye(3, 4, dtype=F64), B, C)
    for i in range(3):
        torch.testing.assert_close(T[i], torch.outer(B[:, i], C[:, 3]) - torch.outer(B[:, 3], C[:, i]))


def test_determinants_and_lists(generator: torch.Generator) -> None:
    P = torch.randn(2, 5, 3, 4, generator=generator, dtype=F64)
    index = torch.tensor([[0, 1, 2], [4, 2, 0]])
    T = trifocal_tensors(P, index)
    assert T.shape == (2, 2, 3, 3, 3)
    a, b, c = (P[1, k] for k in index[1].tolist())
    for i, j, k in ((0, 1, 2), (1, 0, 0), (2, 2, 1)):
        det = torch.linalg.det(torch.stack((a[(i + 1) % 3], a[(i + 2) % 3], b[j], c[k])))
        torch.testing.assert_close(T[1, 1, i, j, k], det)


def test_incidence_relations(generator: torch.Generator) -> None:
    P = cameras(7, v=3, generator=generator)
    X, Y = points(7, n=9, generator=generator), points(7, n=9, generator=generator)
    x1, x2, x3 = images(P, X).unbind(1)
    l1, l2, l3 = line_images(P, X, Y).unbind(1)
    m2, m3 = line_through(x2, generator), line_through(x3, generator)
    T = trifocal_from_cameras(*P.unbind(1))
    size = T.flatten(1).abs().amax(-1)[:, None]

    def largest(residual: torch.Tensor) -> float:
        return float((residual.flatten(2).abs().amax(-1) / size).max())

    exact = 1e-5  # pixels multiply up to 1e3 in each factor
    assert largest(trifocal_ppp(T, x1, x2, x3)) < exact
    assert largest(trifocal_ppl(T, x1, x2, m3)) < exact
    assert largest(trifocal_plp(T, x1, m2, x3)) < exact
    assert largest(trifocal_pll(T, x1, m2, m3)[..., None]) < exact
    assert largest(trifocal_pll(T, x1, l2, l3)[..., None]) < exact
    assert largest(trifocal_lll(T, l1, l2, l3)) < exact
    # A point a pixel off is seen.
    assert trifocal_ppp(T, x1, x2, x3 + 1).flatten(2).abs().amax(-1).min() > 1e3 * exact * size.min()
    assert trifocal_lll(T, l1.roll(1, -2), l2, l3).flatten(2).abs().amax(-1).median() > 1e3 * exact * size.min()
    # Each relation is the one before contracted with a line through the point.
    ppl = trifocal_ppl(T, x1, x2, m3)
    torch.testing.assert_close(trifocal_pll(T, x1, m2 + m3, m3), trifocal_pll(T, x1, m2, m3) + trifocal_pll(T, x1, m3, m3))
    assert ppl.shape == (7, 9, 3)


def test_cameras_have_the_tensor_they_come_from(generator: torch.Generator) -> None:
    for P in (cameras(300, v=3, generator=generator), torch.randn(300, 3, 3, 4, generator=generator, dtype=F64)):
        T = -1e5 * trifocal_from_cameras(*P.unbind(1))
        found = cameras_from_trifocal(T)
        assert (found.status == Status.OK).all()
        assert torch.equal(found.P[:, 0], torch.eye(3, 4, dtype=F64).expand(300, 3, 4))
        assert up_to_scale(trifocal_from_cameras(*found.P.unbind(1)), T, 3).max() < 1e-10


def test_cameras_that_do_not_turn_have_slices_of_rank_one(generator: torch.Generator) -> None:
    P = cameras(50, v=3, generator=generator, turn=0.0)
    P[..., 1:, 3] = P[:, :1, 1:, 3]
    T = trifocal_from_cameras(*P.unbind(1))
    found = cameras_from_trifocal(T)
    assert (found.status == Status.OK).all()
    assert up_to_scale(trifocal_from_cameras(*found.P.unbind(1)), T, 3).max() < 1e-10
    assert trifocal_constraints(T).abs().max() < 1e-12


def test_a_noisy_tensor_gives_the_cameras_of_the_nearest(generator: torch.Generator) -> None:
    P = torch.randn(40, 3, 3, 4, generator=generator, dtype=F64)
    T = trifocal_from_cameras(*P.unbind(1))
    T = T / T.flatten(1).norm(dim=-1)[:, None, None, None]
    noisy = T + 3e-3 * torch.randn(T.shape, generator=generator, dtype=F64)
    noisy = noisy / noisy.flatten(1).norm(dim=-1)[:, None, None, None]
    found = cameras_from_trifocal(noisy).P
    distance = lambda P: (trifocal_from_cameras(*P.unbind(1)) - noisy).flatten(1).norm(dim=-1)  # noqa: E731
    best = distance(found)
    assert (best < (T - noisy).flatten(1).norm(dim=-1)).all()
    for _ in range(20):
        moved = found + 1e-4 * torch.randn(found.shape, generator=generator, dtype=F64)
        moved[:, 0] = found[:, 0]
        assert (distance(moved) >= best).all()


def test_no_trifocal_tensor_is_nearer(generator: torch.Generator) -> None:
    n, starts = 500, 16
    noise = 10 ** (torch.rand(n, 1, 1, 1, generator=generator, dtype=F64) - 1.7)
    P = torch.randn(n, 3, 3, 4, generator=generator, dtype=F64)
    unit = lambda T: T / T.flatten(1).norm(dim=-1)[:, None, None, None]  # noqa: E731
    T = unit(trifocal_from_cameras(*P.unbind(1)))
    T = unit(T + noise * torch.randn(T.shape, generator=generator, dtype=F64) / 27**0.5)
    # |T|^2 less its part across both epipoles, from many epipoles by alternation.
    e2 = torch.nn.functional.normalize(torch.randn(n, starts, 3, generator=generator, dtype=F64), dim=-1)
    for _ in range(20):
        A = T[:, None] - e2[..., None, :, None] * (e2[..., None, None, :] @ T[:, None])
        e3 = torch.linalg.eigh((A.mT @ A).sum(-3))[1][..., -1]
        B = T[:, None] - (T[:, None] @ e3[..., None, :, None]) * e3[..., None, None, :]
        values, vectors = torch.linalg.eigh((B @ B.mT).sum(-3))
        e2 = vectors[..., -1]
    nearest = values[..., :2].sum(-1).amin(-1).clamp_min(0).sqrt()
    found = trifocal_from_cameras(*cameras_from_trifocal(T).P.unbind(1))
    distance = (found - T).flatten(1).norm(dim=-1)
    # Seven in ten thousand are not the nearest.
    assert (distance > nearest + 1e-6).sum() <= 3


def test_epipoles_and_fundamental_matrices(generator: torch.Generator) -> None:
    P = cameras(60, v=3, generator=generator, calibration=torch.eye(3, dtype=F64))
    T = trifocal_from_cameras(*P.unbind(1))
    e2, e3 = trifocal_epipoles(T)
    centre = torch.linalg.svd(P[:, 0]).Vh[:, -1, :, None]
    for e, view in ((e2, 1), (e3, 2)):
        expected = torch.nn.functional.normalize((P[:, view] @ centre)[..., 0], dim=-1)
        assert ((expected * e).sum(-1).abs() - 1).abs().max() < 1e-12
    F = fundamentals_from_trifocal(T)
    assert up_to_scale(F, bifocal_tensors(P, PAIRS), 2).max() < 1e-9


def test_tensor_from_fundamental_matrices(generator: torch.Generator) -> None:
    P = cameras(600, v=3, generator=generator)
    scale = torch.tensor([3.0, -1e4, 1e-3], dtype=F64)[:, None, None]
    F = bifocal_tensors(P, PAIRS) * scale
    T = trifocal_from_cameras(*P.unbind(1))
    assert up_to_scale(trifocal_from_fundamentals(*F.unbind(1)), T, 3).max() < 1e-6
    assert up_to_scale(trifocal_from_fundamentals(*F.unbind(1)), T, 3).median() < 1e-9
    found = cameras_from_fundamentals(*F.unbind(1))
    assert (found.status == Status.OK).all()
    # Centres on a line are not determined; nor is anything by a matrix of rank 1 or NaN.
    C = torch.randn(3, 1, generator=generator, dtype=F64)
    P = torch.randn(3, 3, 3, generator=generator, dtype=F64)
    P = torch.stack([torch.cat((M, -M @ (k * C)), -1) for k, M in zip((0.0, 1.0, 2.5), P, strict=True)])
    F = bifocal_tensors(P, PAIRS)
    assert cameras_from_fundamentals(*F.unbind(0)).status == Status.DEGENERATE
    assert cameras_from_fundamentals(F[0], F[1], torch.ones(3, 3, dtype=F64)).status == Status.DEGENERATE
    bad = cameras_from_fundamentals(F[0] * torch.nan, F[1], F[2])
    assert bad.status == Status.NOT_FINITE
    assert torch.isfinite(bad.P).all()


def test_order_of_the_views(generator: torch.Generator) -> None:
    P = cameras(20, v=3, generator=generator, calibration=torch.eye(3, dtype=F64))
    T = trifocal_from_cameras(*P.unbind(1))
    for order in ((1, 0, 2), (2, 0, 1), (0, 2, 1)):
        expected = trifocal_from_cameras(*(P[:, k] for k in order))
        assert up_to_scale(reordered_trifocal(T, order), expected, 3).max() < 1e-9
    with pytest.raises(ValueError, match="permutation"):
        reordered_trifocal(T, (0, 1, 1))


def test_transfer_of_points_and_lines(generator: torch.Generator) -> None:
    P = cameras(30, v=3, generator=generator)
    X, Y = points(30, n=12, generator=generator), points(30, n=12, generator=generator)
    x1, x2, x3 = images(P, X).unbind(1)
    T = trifocal_from_cameras(*P.unbind(1))
    assert (transfer_points_trifocal(T, x1, x2) - x3).norm(dim=-1).median() < 1e-9
    assert (transfer_points_trifocal(T, x1, x2) - x3).norm(dim=-1).quantile(0.99) < 1e-5
    l1, l2, l3 = line_images(P, X, Y).unbind(1)
    found = transfer_lines_trifocal(T, l2, l3)
    assert torch.minimum((found - l1).norm(dim=-1), (found + l1).norm(dim=-1)).quantile(0.98) < 1e-5
    # The plane of a line in the second view carries its points from the first to the third.
    H = homographies_from_trifocal(T, line_through(x2, generator))
    y = (H @ torch.nn.functional.pad(x1, (0, 1), value=1.0)[..., None])[..., 0]
    assert (y[..., :2] / y[..., 2:] - x3).norm(dim=-1).median() < 1e-8
    # On the plane of the three centres, where epipolar lines coincide.
    centres = torch.linalg.svd(P).Vh[..., -1, :]
    weights = torch.rand(30, 4, 3, generator=generator, dtype=F64)
    Z = weights @ (centres[..., :3] / centres[..., 3:])
    y1, y2, y3 = images(P, Z + 0.0).unbind(1)
    assert (transfer_points_trifocal(T, y1, y2) - y3).norm(dim=-1).median() < 1e-6


def test_constraints_are_met_by_tensors_alone(generator: torch.Generator) -> None:
    P = torch.randn(100, 3, 3, 4, generator=generator, dtype=F64)
    T = trifocal_from_cameras(*P.unbind(1))
    assert trifocal_constraints(T).shape == (100, 64)
    assert trifocal_constraints(T).abs().max() < 1e-14
    noisy = T / T.flatten(1).norm(dim=-1)[:, None, None, None] + 1e-2 * torch.randn(T.shape, generator=generator, dtype=F64)
    rank, left, right = trifocal_constraints(noisy).split((10, 27, 27), -1)
    for part in (rank, left, right):
        assert (part.abs().amax(-1) > 1e-10).all()
    # Singular slices do not make a trifocal tensor: pencil of rank 2 with left null vectors in general position.
    U, s, Vh = torch.linalg.svd(noisy)
    s[..., 2] = 0
    single = (U * s[..., None, :]) @ Vh
    rank, left, _ = trifocal_constraints(single).split((10, 27, 27), -1)
    assert rank[:, :3].abs().max() < 1e-15
    assert (rank[:, 3:].abs().amax(-1) > 1e-8).all()
    assert (left.abs().amax(-1) > 1e-12).all()


def test_canonical_cameras(generator: torch.Generator) -> None:
    P = torch.randn(30, 4, 3, 4, generator=generator, dtype=F64)
    C = canonical_cameras(P)
    assert torch.equal(C[:, 0], torch.eye(3, 4, dtype=F64).expand(30, 3, 4))
    A, e = C[:, 1, :, :3], C[:, 1, :, 3]
    torch.testing.assert_close(e.norm(dim=-1), torch.ones(30, dtype=F64))
    torch.testing.assert_close(A.flatten(1).norm(dim=-1), torch.ones(30, dtype=F64))
    assert (e[:, None] @ A).abs().max() < 1e-10
    index = torch.tensor([[0, 1, 2], [3, 1, 0]])
    assert up_to_scale(trifocal_tensors(C, index), trifocal_tensors(P, index), 3).max() < 1e-9
    H = torch.randn(30, 1, 4, 4, generator=generator, dtype=F64)
    assert up_to_scale(canonical_cameras(P @ H), C, 2).max() < 1e-7
    assert (canonical_cameras(-P @ H) - C).abs().max() < 1e-7
    same = canonical_cameras(P[:, [0, 0, 1]])
    assert torch.isfinite(same).all()


def test_degenerate_and_bad_input_leave_neighbours_alone(generator: torch.Generator) -> None:
    P = cameras(6, v=3, generator=generator, calibration=torch.eye(3, dtype=F64))
    T = trifocal_from_cameras(*P.unbind(1))
    reference = cameras_from_trifocal(T)
    T[1] = torch.nan
    T[2] = 0
    # The first centre in the place of the second, of the third.
    M = torch.randn(3, 3, generator=generator, dtype=F64)
    T[3] = trifocal_from_cameras(P[3, 0], M @ P[3, 0], P[3, 2])
    T[4] = trifocal_from_cameras(P[3, 0], P[3, 1], M @ P[3, 0])
    T.requires_grad_()
    found = cameras_from_trifocal(T)
    wanted = [Status.OK, Status.NOT_FINITE, Status.DEGENERATE, Status.DEGENERATE, Status.DEGENERATE, Status.OK]
    assert found.status.tolist() == wanted
    assert found.status.dtype == torch.int8
    assert torch.isfinite(found.P).all()
    assert torch.equal(found.P[[0, 5]], reference.P[[0, 5]])
    found.P.sum().backward()
    assert T.grad is not None
    assert torch.isfinite(T.grad).all()
    for function in (trifocal_constraints, fundamentals_from_trifocal, lambda T: torch.cat(trifocal_epipoles(T))):
        assert torch.isfinite(function(T)).all()


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,)])
@pytest.mark.parametrize("dtype", [F64, torch.float32])
def test_batches(shape: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator) -> None:
    P = cameras(*shape, v=3, generator=generator, calibration=torch.eye(3, dtype=F64)).to(dtype)
    T = trifocal_from_cameras(*P.unbind(-3))
    found = cameras_from_trifocal(T)
    assert T.shape == (*shape, 3, 3, 3)
    assert found.P.shape == (*shape, 3, 3, 4)
    assert found.P.dtype == dtype
    assert found.status.shape == shape
    again = trifocal_from_cameras(*found.P.unbind(-3))
    assert (up_to_scale(again, T, 3) < (1e-10 if dtype == F64 else 1e-4)).all()
    for k in range(torch.Size(shape).numel() if shape else 0):
        one = cameras_from_trifocal(T.reshape(-1, 3, 3, 3)[k])
        torch.testing.assert_close(one.P, found.P.reshape(-1, 3, 3, 4)[k], rtol=0, atol=1e-12 if dtype == F64 else 1e-6)
    x = images(P.double(), points(*shape, n=4, generator=generator)).to(dtype)
    assert trifocal_ppp(T, *x.unbind(-3)).shape == (*shape, 4, 3, 3)
    assert trifocal_constraints(T).shape == (*shape, 64)


def test_derivatives(generator: torch.Generator) -> None:
    check = torch.autograd.gradcheck
    P = cameras(1, v=3, generator=generator, calibration=torch.eye(3, dtype=F64)).requires_grad_()
    T = trifocal_from_cameras(*P.detach().unbind(1))
    noisy = T / T.norm() + 1e-3 * torch.randn(T.shape, generator=generator, dtype=F64)
    for tensor in (T, noisy):
        assert check(lambda T: cameras_from_trifocal(T).P, tensor.clone().requires_grad_(), atol=1e-4)
    noisy.requires_grad_()
    for function in (fundamentals_from_trifocal, trifocal_constraints):
        assert check(function, noisy, atol=1e-4, fast_mode=True)
    x = images(P.detach(), points(1, n=3, generator=generator)).requires_grad_()
    assert check(lambda P, x: trifocal_ppp(trifocal_from_cameras(*P.unbind(1)), *x.unbind(1)), (P, x), fast_mode=True)
    assert check(lambda T, x: transfer_points_trifocal(T, x[:, 0], x[:, 1]), (noisy, x), atol=1e-3, fast_mode=True)
    F = bifocal_tensors(P.detach(), PAIRS).requires_grad_()
    assert check(lambda F: trifocal_from_fundamentals(*F.unbind(1)), F, atol=1e-4, fast_mode=True)
    assert check(canonical_cameras, P, atol=1e-4, fast_mode=True)


def test_wrong_arguments(unchecked: None) -> None:
    with pytest.raises(ValueError, match="P2"):
        trifocal_from_cameras(torch.zeros(3, 4), torch.zeros(4, 3), torch.zeros(3, 4))
    with pytest.raises(ValueError, match="T"):
        cameras_from_trifocal(torch.zeros(3, 3))
    with pytest.raises(ValueError, match="x3"):
        trifocal_ppp(torch.zeros(3, 3, 3), torch.zeros(5, 2), torch.zeros(5, 2), torch.zeros(4, 2))
    with pytest.raises(ValueError, match="index"):
        trifocal_tensors(torch.zeros(4, 3, 4), torch.zeros(2, 2, dtype=torch.long))
