"""The tensors of three and four views from many points and lines."""

from collections.abc import Callable

import pytest
import torch
from chance import assert_share
from multiview_scenes import F64, cameras, images, line_images, points, up_to_scale
from torch import Tensor

from torchsfm._types import Status
from torchsfm.motion import QuadrifocalFit, TrifocalFit, quadrifocal_6pt, trifocal_7pt
from torchsfm.tensors import (
    canonical_cameras,
    quadrifocal_constraints,
    quadrifocal_from_cameras,
    transfer_points_quadrifocal,
    transfer_points_trifocal,
    trifocal_constraints,
    trifocal_from_cameras,
)

EYE = torch.eye(3, dtype=F64)
Fit = TrifocalFit | QuadrifocalFit


def fit(x: Tensor, weights: Tensor | None = None) -> Fit:
    return trifocal_7pt(x, weights=weights) if x.shape[-3] == 3 else quadrifocal_6pt(x, weights=weights)


def tensor(result: Fit) -> Tensor:
    return result.T if isinstance(result, TrifocalFit) else result.Q


def scene(count: int, v: int, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Images, tensors, cameras."""
    P = cameras(count, v=v, generator=generator)
    make: Callable[..., Tensor] = trifocal_from_cameras if v == 3 else quadrifocal_from_cameras
    return images(P, points(count, n=n, generator=generator)), make(*P.unbind(1)), P


@pytest.fixture(params=[3, 4])
def v(request: pytest.FixtureRequest) -> int:
    return int(request.param)


def test_exact_points(v: int, generator: torch.Generator) -> None:
    for n in (10 - v, 12):
        x, T, P = scene(40, v, n, generator)
        found = fit(x)
        assert (found.status == Status.OK).all()
        assert up_to_scale(tensor(found), T, v).max() < 1e-8
        assert (found.P - canonical_cameras(P)).abs().flatten(1).amax(-1).median() < 1e-8
        assert (found.uncertainty < 1e-8).all()
        assert (found.error < 1e-10).all()


def test_lines_and_mixtures(generator: torch.Generator) -> None:
    P = cameras(30, v=3, generator=generator)
    T = trifocal_from_cameras(*P.unbind(1))
    x = images(P, points(30, n=6, generator=generator))
    X, Y = points(30, n=14, generator=generator), points(30, n=14, generator=generator)
    l = line_images(P, X, Y)  # noqa: E741
    scale = torch.tensor([2.0, -0.01, 300.0], dtype=F64)[:, None, None]
    for n, m in ((0, 13), (0, 14), (6, 1), (3, 8), (1, 12)):
        found = trifocal_7pt(x[:, :, :n], l[:, :, :m] * scale)
        assert_share(found.status == Status.OK, 0.95)
        assert up_to_scale(found.T, T, 3).median() < 1e-10
        assert_share(up_to_scale(found.T, T, 3) < 1e-6, 0.95)
    ends = torch.stack((images(P, X)[:, 0], images(P, Y)[:, 0]), -2)
    found = trifocal_7pt(x[:, :, :0], l, ends=ends)
    assert up_to_scale(found.T, T, 3).median() < 1e-10
    # Weight 0 takes lines out, whatever they are.
    l[:, :, 13] = torch.nan
    weights = torch.ones(14, dtype=F64)
    weights[13] = 0
    found = trifocal_7pt(x, l, line_weights=weights)
    assert up_to_scale(found.T, T, 3).max() < 1e-7


def test_ends_of_segments_help(generator: torch.Generator) -> None:
    """Noise at the ends of segments that are far from the middle of the image."""
    P = cameras(40, v=3, generator=generator)
    X = points(40, n=30, generator=generator) * 1.5
    Y = X + 0.3 * torch.randn(X.shape, generator=generator, dtype=F64)
    a, b = images(P, X), images(P, Y)
    a, b = (x + 0.5 * torch.randn(x.shape, generator=generator, dtype=F64) for x in (a, b))
    lines = torch.linalg.cross(*(torch.nn.functional.pad(x, (0, 1), value=1.0) for x in (a, b)), dim=-1)
    ends = torch.stack((a[:, 0], b[:, 0]), -2)
    Z = points(40, n=20, generator=generator)
    x1, x2, x3 = images(P, Z).unbind(1)
    none = a[:, :, :0]
    without, found = trifocal_7pt(none, lines), trifocal_7pt(none, lines, ends=ends)
    errors = [(transfer_points_trifocal(f.T, x1, x2) - x3).norm(dim=-1).median() for f in (without, found)]
    assert errors[1] < 0.5 * errors[0]
    assert errors[1] < 4


def test_noise_and_constraints(v: int, generator: torch.Generator) -> None:
    x, _, P = scene(40, v, 15, generator)
    noisy = x + 0.5 * torch.randn(x.shape, generator=generator, dtype=F64)
    found = fit(noisy)
    assert_share(found.status == Status.OK, 0.9)
    held = images(P, points(40, n=20, generator=generator))
    if v == 3:
        assert trifocal_constraints(tensor(found)).abs().max() < 1e-12
        error = transfer_points_trifocal(tensor(found), held[:, 0], held[:, 1]) - held[:, 2]
    else:
        assert quadrifocal_constraints(tensor(found)).abs().max() < 1e-8
        error = transfer_points_quadrifocal(tensor(found), *held[:, :3].unbind(1)) - held[:, 3]
    assert error.norm(dim=-1).median() < 1.0
    assert 1e-5 < found.error.median() < 1e-2
    assert found.uncertainty.median() < 0.05
    # The tensor is that of the cameras.
    make = trifocal_from_cameras if v == 3 else quadrifocal_from_cameras
    assert up_to_scale(make(*found.P.unbind(1)), tensor(found), v).max() < 1e-9


def test_the_minimum_is_one(generator: torch.Generator) -> None:
    """No tensor of cameras near the solution has a smaller algebraic error, in normalised coordinates."""
    x, _, _ = scene(10, 3, 12, generator)
    x = x - x.mean(-2, keepdim=True)
    x = x / x.square().sum(-1).mean(-1).sqrt()[..., None, None]
    x = x + 2e-3 * torch.randn(x.shape, generator=generator, dtype=F64)
    x = x - x.mean(-2, keepdim=True)
    x = x / x.square().sum(-1).mean(-1).sqrt()[..., None, None]
    found = trifocal_7pt(x)

    def error(P: Tensor) -> Tensor:
        T = trifocal_from_cameras(*P.unbind(1))
        T = T / T.flatten(1).norm(dim=-1)[:, None, None, None]
        h = torch.nn.functional.pad(x, (0, 1), value=1.0)
        M = torch.einsum("bijk,bni->bnjk", T, h[:, 0])
        axes = torch.zeros(10, 3, 12, 2, 3, dtype=F64)
        axes[..., 0, 0] = axes[..., 1, 1] = 1
        axes[..., 2] = -x
        residual = axes[:, 1] @ M @ axes[:, 2].mT
        return residual.square().flatten(1).mean(-1).sqrt()

    best = error(found.P)
    torch.testing.assert_close(best, found.error)
    for _ in range(30):
        moved = found.P + 1e-4 * torch.randn(found.P.shape, generator=generator, dtype=F64)
        assert (error(moved) >= best).all()


def test_weights_count(v: int, generator: torch.Generator) -> None:
    x, T, _ = scene(20, v, 16, generator)
    x[:, :, 12:] = torch.nan
    weights = (torch.arange(16) < 12).double()
    assert up_to_scale(tensor(fit(x, weights)), T, v).max() < 1e-8
    repeated = torch.cat((x[:, :, :12], x[:, :, :12]), 2)
    noisy = x[:, :, :12] + torch.randn(20, v, 12, 2, generator=generator, dtype=F64)
    twice = fit(torch.cat((noisy, noisy), 2))
    doubled = fit(noisy, torch.full((12,), 2.0, dtype=F64))
    assert repeated.shape[2] == 24
    assert up_to_scale(tensor(twice), tensor(doubled), v).max() < 1e-6


def test_statuses_leave_neighbours_alone(v: int, generator: torch.Generator) -> None:
    x, _, P = scene(8, v, 12, generator)
    weights = torch.ones(8, 12, dtype=F64)
    reference = fit(x, weights)
    x[1, 0, 3, 1] = torch.nan
    weights[2, 5:] = 0
    flat = points(8, n=12, generator=generator)
    flat[..., 2] = 0.5 * flat[..., 1]
    x[3] = images(P, flat)[3]
    x[4] = x[4] + 0.3 * torch.randn(x[4].shape, generator=generator, dtype=F64)
    x[5] = images(P, flat)[5] + 0.3 * torch.randn(x[5].shape, generator=generator, dtype=F64)
    x[6] = 5.0
    found = fit(x.requires_grad_(), weights)
    status = found.status.tolist()
    assert status[:5] == [Status.OK, Status.NOT_FINITE, Status.TOO_FEW, Status.DEGENERATE, Status.OK]
    assert status[5] != Status.OK
    assert status[6] == Status.DEGENERATE
    assert found.status.dtype == torch.int8
    for value in (tensor(found), found.P, found.error, found.uncertainty):
        assert torch.isfinite(value).all()
    same = [0, 7]
    torch.testing.assert_close(tensor(found)[same], tensor(reference)[same], rtol=0, atol=0)
    tensor(found).sum().backward()
    assert x.grad is not None
    assert torch.isfinite(x.grad).all()


@pytest.mark.parametrize("shape", [(), (1,), (2, 2), (0,)])
def test_batches_are_loops(v: int, shape: tuple[int, ...], generator: torch.Generator) -> None:
    x, _, _ = scene(4, v, 9, generator)
    x = x + 0.2 * torch.randn(x.shape, generator=generator, dtype=F64)
    count = torch.Size(shape).numel()
    found = fit(x[:count].reshape(*shape, *x.shape[1:]))
    assert tensor(found).shape == (*shape, *(3,) * v)
    assert found.P.shape == (*shape, v, 3, 4)
    for k, one in enumerate(tensor(found).reshape(-1, *(3,) * v)):
        assert up_to_scale(tensor(fit(x[k])), one, v) < 1e-9


def test_single_precision_and_broadcasting(v: int, generator: torch.Generator) -> None:
    x, T, _ = scene(5, v, 12, generator)
    found = fit(x.float())
    assert tensor(found).dtype == found.P.dtype == torch.float32
    assert (found.status == Status.OK).all()
    error = transfer_points_trifocal(tensor(found).double(), x[:, 0], x[:, 1]) - x[:, 2] if v == 3 else torch.zeros(1)
    assert error.norm(dim=-1).median() < 0.1
    weights = torch.ones(3, 1, 12, dtype=F64)
    weights[1, :, 0] = 0
    many = fit(x, weights)
    assert tensor(many).shape == (3, 5, *(3,) * v)
    assert up_to_scale(tensor(many), T.expand(3, *T.shape), v).max() < 1e-8


def test_similarities_of_the_images(v: int, generator: torch.Generator) -> None:
    x, _, P = scene(10, v, 12, generator)
    x = x + 0.3 * torch.randn(x.shape, generator=generator, dtype=F64)
    held = images(P, points(10, n=5, generator=generator))

    def last(result: Fit, y: Tensor) -> Tensor:
        if v == 3:
            return transfer_points_trifocal(tensor(result), y[:, 0], y[:, 1])
        return transfer_points_quadrifocal(tensor(result), *y[:, :3].unbind(1))

    shift = torch.tensor([100.0, -50.0], dtype=F64)
    plain, moved = last(fit(x), held), (last(fit(3 * x + shift), 3 * held + shift) - shift) / 3
    # Minima are flat: where two searches end differs by little of what noise does.
    apart, error = ((a - b).norm(dim=-1).amax(-1) for a, b in ((plain, moved), (plain, held[:, -1])))
    assert (apart < 0.05 * error + 1e-3).all()


def test_derivatives(v: int, generator: torch.Generator) -> None:
    x, _, _ = scene(1, v, 9, generator)
    x = (x - 350) / 500 + 1e-3 * torch.randn(x.shape, generator=generator, dtype=F64)
    weights = (0.5 + torch.rand(1, 9, generator=generator, dtype=F64)).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x, w: tensor(fit(x, w)), (x.requires_grad_(), weights), atol=1e-3, rtol=1e-2, fast_mode=True
    )


def test_wrong_arguments(unchecked: None) -> None:
    with pytest.raises(ValueError, match="4 n"):
        trifocal_7pt(torch.zeros(3, 6, 2))
    with pytest.raises(ValueError, match="4 n"):
        trifocal_7pt(torch.zeros(3, 0, 2), torch.zeros(3, 12, 3))
    with pytest.raises(ValueError, match="l:"):
        trifocal_7pt(torch.zeros(3, 7, 2), line_weights=torch.zeros(3))
    with pytest.raises(ValueError, match="n >= 6"):
        quadrifocal_6pt(torch.zeros(4, 5, 2))
    with pytest.raises(ValueError, match="weights"):
        quadrifocal_6pt(torch.zeros(4, 6, 2), weights=torch.zeros(5))
