import pytest
import torch
from multiview_scenes import F64, cameras, images, line_images, line_through, points, up_to_scale

from torchsfm._types import Status
from torchsfm.tensors import (
    bifocal_tensors,
    cameras_from_quadrifocal,
    canonical_cameras,
    essential_constraints,
    essential_from_pose,
    fundamental_constraint,
    fundamentals_from_quadrifocal,
    quadrifocal_constraints,
    quadrifocal_from_cameras,
    quadrifocal_from_trifocals,
    quadrifocal_lll,
    quadrifocal_llll,
    quadrifocal_plll,
    quadrifocal_ppll,
    quadrifocal_pppl,
    quadrifocal_pppp,
    quadrifocal_tensors,
    transfer_lines_quadrifocal,
    transfer_points_quadrifocal,
    trifocal_from_quadrifocal,
    trifocal_tensors,
)

ALL = torch.combinations(torch.arange(4), 2)
EYE = torch.eye(3, dtype=F64)


def test_determinants_and_lists(generator: torch.Generator) -> None:
    P = torch.randn(2, 5, 3, 4, generator=generator, dtype=F64)
    Q = quadrifocal_tensors(P, torch.tensor([[0, 1, 2, 3], [4, 2, 0, 1]]))
    assert Q.shape == (2, 2, 3, 3, 3, 3)
    for p, q, r, s in ((0, 1, 2, 0), (2, 2, 1, 1)):
        det = torch.linalg.det(torch.stack((P[1, 4, p], P[1, 2, q], P[1, 0, r], P[1, 1, s])))
        torch.testing.assert_close(Q[1, 1, p, q, r, s], det)


def test_incidence_relations(generator: torch.Generator) -> None:
    P = cameras(5, v=4, generator=generator, calibration=EYE)
    X, Y = points(5, n=6, generator=generator), points(5, n=6, generator=generator)
    x1, x2, x3, x4 = images(P, X).unbind(1)
    m1, m2, m3, m4 = (line_through(x, generator) for x in (x1, x2, x3, x4))
    l1, l2, l3, _ = line_images(P, X, Y).unbind(1)
    Q = quadrifocal_from_cameras(*P.unbind(1))
    Q = Q / Q.flatten(1).norm(dim=-1)[:, None, None, None, None]
    relations = {
        "pppp": (quadrifocal_pppp, (x1, x2, x3, x4)),
        "pppl": (quadrifocal_pppl, (x1, x2, x3, m4)),
        "ppll": (quadrifocal_ppll, (x1, x2, m3, m4)),
        "plll": (quadrifocal_plll, (x1, m2, m3, m4)),
        "llll": (quadrifocal_llll, (m1, m2, m3, m4)),
        "lll": (quadrifocal_lll, (l1, l2, l3)),
    }
    for name, (relation, data) in relations.items():
        residual = relation(Q, *data)
        assert residual.shape[:2] == (5, 6), name
        assert residual.abs().max() < 1e-11, name
        wrong = (*data[:-1], data[-1] + 0.1 * torch.randn(data[-1].shape, generator=generator, dtype=F64))
        assert relation(Q, *wrong).flatten(2).abs().amax(-1).median() > 1e-4 if name != "llll" else True


def test_cameras_have_the_tensor_they_come_from(generator: torch.Generator) -> None:
    turned, straight = cameras(60, v=4, generator=generator), cameras(60, v=4, generator=generator, turn=0.0)
    for P in (turned, straight, torch.randn(60, 4, 3, 4, generator=generator, dtype=F64)):
        Q = -1e3 * quadrifocal_from_cameras(*P.unbind(1))
        found = cameras_from_quadrifocal(Q)
        assert (found.status == Status.OK).all()
        assert up_to_scale(quadrifocal_from_cameras(*found.P.unbind(1)), Q, 4).max() < 1e-10
        assert quadrifocal_constraints(Q).abs().max() < 1e-10
    P = cameras(30, v=4, generator=generator, calibration=EYE)
    found = cameras_from_quadrifocal(quadrifocal_from_cameras(*P.unbind(1)))
    assert (found.P - canonical_cameras(P)).abs().max() < 1e-6


def test_a_noisy_tensor_gives_the_cameras_of_the_nearest(generator: torch.Generator) -> None:
    P = cameras(20, v=4, generator=generator, calibration=EYE)
    Q = quadrifocal_from_cameras(*P.unbind(1))
    Q = Q / Q.flatten(1).norm(dim=-1)[:, None, None, None, None]
    noisy = Q + 1e-4 * torch.randn(Q.shape, generator=generator, dtype=F64)

    def distance(P: torch.Tensor) -> torch.Tensor:
        model = quadrifocal_from_cameras(*P.unbind(1)).flatten(1)
        model = model / model.norm(dim=-1, keepdim=True)
        flat = noisy.flatten(1)
        return (flat - (flat * model).sum(-1, keepdim=True) * model).norm(dim=-1)

    found = cameras_from_quadrifocal(noisy).P
    best = distance(found)
    assert (best <= (noisy - Q).flatten(1).norm(dim=-1)).all()
    for _ in range(20):
        assert (distance(found + 1e-5 * torch.randn(found.shape, generator=generator, dtype=F64)) >= best * (1 - 1e-9)).all()
    residual = quadrifocal_constraints(noisy).norm(dim=-1)
    torch.testing.assert_close(residual, best / noisy.flatten(1).norm(dim=-1))


def test_conversions(generator: torch.Generator) -> None:
    P = cameras(25, v=4, generator=generator, calibration=EYE)
    Q = quadrifocal_from_cameras(*P.unbind(1))
    for views in ((0, 1, 2), (3, 1, 0), (2, 0, 3)):
        T = trifocal_tensors(P, torch.tensor([views]))[:, 0]
        assert up_to_scale(trifocal_from_quadrifocal(Q, views), T, 3).max() < 1e-10
    T = trifocal_tensors(P, torch.tensor([[0, 1, 2], [0, 1, 3]]))
    assert up_to_scale(quadrifocal_from_trifocals(3 * T[:, 0], -T[:, 1]), Q, 4).max() < 1e-9
    assert up_to_scale(fundamentals_from_quadrifocal(Q), bifocal_tensors(P, ALL), 2).max() < 1e-8
    with pytest.raises(ValueError, match="views"):
        trifocal_from_quadrifocal(Q, (0, 0, 1))


def test_transfer(generator: torch.Generator) -> None:
    P = cameras(20, v=4, generator=generator)
    X, Y = points(20, n=10, generator=generator), points(20, n=10, generator=generator)
    x1, x2, x3, x4 = images(P, X).unbind(1)
    Q = quadrifocal_from_cameras(*P.unbind(1))
    error = (transfer_points_quadrifocal(Q, x1, x2, x3) - x4).norm(dim=-1)
    assert error.median() < 1e-9
    assert error.max() < 1e-4
    l1, l2, l3, l4 = line_images(P, X, Y).unbind(1)
    for found, line in zip(transfer_lines_quadrifocal(Q, l1, l2), (l3, l4), strict=True):
        gap = torch.minimum((found - line).norm(dim=-1), (found + line).norm(dim=-1))
        assert gap.median() < 1e-8


def test_constraints_of_two_views(generator: torch.Generator) -> None:
    R = torch.linalg.qr(torch.randn(10, 3, 3, generator=generator, dtype=F64)).Q
    t = torch.randn(10, 3, generator=generator, dtype=F64)
    E = 7 * essential_from_pose(R, t)
    assert essential_constraints(E).abs().max() < 1e-14
    F = EYE * torch.tensor([1.0, 2.0, 1.0], dtype=F64) @ E
    assert fundamental_constraint(F).abs().max() < 1e-14
    assert essential_constraints(F).abs().amax(-1).min() > 1e-3
    M = torch.randn(10, 3, 3, generator=generator, dtype=F64)
    torch.testing.assert_close(fundamental_constraint(M), torch.linalg.det(M / M.norm(dim=(-2, -1), keepdim=True)))


def test_degenerate_and_bad_input_leave_neighbours_alone(generator: torch.Generator) -> None:
    P = cameras(6, v=4, generator=generator, calibration=EYE)
    Q = quadrifocal_from_cameras(*P.unbind(1))
    reference = cameras_from_quadrifocal(Q)
    Q[1], Q[2] = torch.inf, 0
    M = torch.randn(3, 3, generator=generator, dtype=F64)
    # Two centres in one place: the first two are not found, the last two are.
    Q[3] = quadrifocal_from_cameras(P[3, 0], M @ P[3, 0], P[3, 2], P[3, 3])
    Q[4] = quadrifocal_from_cameras(P[3, 0], P[3, 1], P[3, 2], M @ P[3, 2])
    Q.requires_grad_()
    found = cameras_from_quadrifocal(Q)
    wanted = [Status.OK, Status.NOT_FINITE, Status.DEGENERATE, Status.DEGENERATE, Status.OK, Status.OK]
    assert found.status.tolist() == wanted
    assert torch.isfinite(found.P).all()
    assert torch.equal(found.P[[0, 5]], reference.P[[0, 5]])
    assert up_to_scale(quadrifocal_from_cameras(*found.P[4]), Q[4], 4) < 1e-9
    found.P.sum().backward()
    assert Q.grad is not None
    assert torch.isfinite(Q.grad).all()


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,)])
@pytest.mark.parametrize("dtype", [F64, torch.float32])
def test_batches(shape: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator) -> None:
    P = cameras(*shape, v=4, generator=generator, calibration=EYE).to(dtype)
    Q = quadrifocal_from_cameras(*P.unbind(-3))
    found = cameras_from_quadrifocal(Q)
    assert found.P.shape == (*shape, 4, 3, 4)
    assert found.P.dtype == dtype
    again = quadrifocal_from_cameras(*found.P.unbind(-3))
    assert (up_to_scale(again, Q, 4) < (1e-10 if dtype == F64 else 1e-4)).all()
    for k in range(torch.Size(shape).numel() if shape else 0):
        one = cameras_from_quadrifocal(Q.reshape(-1, 3, 3, 3, 3)[k])
        torch.testing.assert_close(one.P, found.P.reshape(-1, 4, 3, 4)[k], rtol=0, atol=1e-8 if dtype == F64 else 1e-3)
    assert trifocal_from_quadrifocal(Q).shape == (*shape, 3, 3, 3)


def test_derivatives(generator: torch.Generator) -> None:
    check = torch.autograd.gradcheck
    P = cameras(1, v=4, generator=generator, calibration=EYE)
    Q = quadrifocal_from_cameras(*P.unbind(1))
    Q = (Q / Q.norm()).requires_grad_()
    assert check(lambda Q: cameras_from_quadrifocal(Q).P, Q, atol=1e-3, fast_mode=True)
    assert check(trifocal_from_quadrifocal, Q, atol=1e-4, fast_mode=True)
    T = trifocal_tensors(P, torch.tensor([[0, 1, 2], [0, 1, 3]])).requires_grad_()
    assert check(lambda T: quadrifocal_from_trifocals(*T.unbind(1)), T, atol=1e-4, fast_mode=True)
    x = images(P, points(1, n=2, generator=generator)).requires_grad_()
    assert check(lambda Q, x: transfer_points_quadrifocal(Q, *x[:, :3].unbind(1)), (Q, x), atol=1e-3, fast_mode=True)
    E = torch.randn(2, 3, 3, generator=generator, dtype=F64).requires_grad_()
    assert check(essential_constraints, E)


def test_wrong_arguments(unchecked: None) -> None:
    with pytest.raises(ValueError, match="P4"):
        quadrifocal_from_cameras(*(torch.zeros(3, 4),) * 3, torch.zeros(3, 3))
    with pytest.raises(ValueError, match="Q"):
        cameras_from_quadrifocal(torch.zeros(3, 3, 3))
    with pytest.raises(ValueError, match="dtype"):
        quadrifocal_pppp(torch.zeros(3, 3, 3, 3, dtype=F64), *(torch.zeros(5, 2),) * 4)
