import math

import pytest
import torch
from chance import assert_share
from torch import Tensor

from bench.cases.resection import coplanar_conics
from torchsfm import Ellipse, Status
from torchsfm.geometry import (
    conic_from_ellipse,
    ellipse_from_conic,
    polar_lines,
    rotation_from_rotvec,
    to_homogeneous,
    transform_conic,
)
from torchsfm.images import fit_ellipse
from torchsfm.resection import camera_circle, camera_conics

F64 = torch.float64


def off(model: Tensor, P: Tensor) -> Tensor:
    return (model - P[..., None, :, :]).abs().amax((-2, -1))


def many(family: str, batch: int, m: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """The images of more than two conics, the conics, and the poses."""
    (_, drawn), P = coplanar_conics(family, batch * m, generator, F64)
    drawn, P = drawn[:, 0].reshape(batch, m, 3, 3), P[:batch]
    return transform_conic(P[:, None][..., [0, 1, 3]], drawn), drawn, P


@pytest.mark.parametrize("family", ["random", "circles", "narrow view"])
@pytest.mark.parametrize("m", [2, 4])
def test_exact_conics_have_the_true_pose_among_the_best(family: str, m: int, generator: torch.Generator) -> None:
    C, drawn, P = many(family, 60, m, generator)
    found = camera_conics(C * torch.randn(60, m, 1, 1, generator=generator, dtype=F64), drawn)
    near = torch.where(found.valid, off(found.model, P), torch.inf).amin(-1)
    assert_share((near < 1e-8) & (found.status == Status.OK), 0.998)
    R, t = found.model[..., :3], found.model[..., 3]
    torch.testing.assert_close(R.mT @ R, torch.eye(3, dtype=F64).expand_as(R))
    assert bool((torch.linalg.det(R) > 0).all())
    assert bool((t[..., 2] > 0)[found.valid].all())
    assert float(found.error.max()) < 1e-8
    # One pose, but where the plane may be seen from behind as well.
    assert_share(found.valid.sum(-1) == (2 if family == "circles" and m == 2 else 1), 0.99)


def test_two_circles_stand_where_each_of_them_may(generator: torch.Generator) -> None:
    (C, drawn), _ = coplanar_conics("circles", 50, generator, F64)
    found = camera_conics(C, drawn)
    ellipses, _ = ellipse_from_conic(drawn)
    alone = camera_circle(C, ellipses.semi_axes[..., 0])
    R, t = found.model[..., :3], found.model[..., 3]
    centre = torch.nn.functional.pad(ellipses.centre, (0, 1))
    place = (R[:, :, None] @ centre[:, None, :, :, None])[..., 0] + t[:, :, None]
    # The slots of one circle alone: as `camera_circle` has it, the normal leads away from the camera.
    normal = R[..., 2] * (R[..., 2] * t).sum(-1, keepdim=True).sign()
    gap = (place[:, :, :, None] - alone.model[:, None, :, :, :, 3]).norm(dim=-1)
    gap = gap + (normal[:, :, None, None] - alone.model[:, None, :, :, :, 2]).norm(dim=-1)
    assert_share(found.valid.sum(-1) == 2, 0.99)
    assert float(gap.amin(-1).amax(-1)[found.valid].max()) < 1e-6


def test_coaxial_ellipses_have_four_poses(generator: torch.Generator) -> None:
    axes = torch.tensor([[1.0, 0.5], [0.6, 0.4]], dtype=F64)
    drawn = conic_from_ellipse(Ellipse(torch.zeros(2, 2, dtype=F64), axes, torch.zeros(2, dtype=F64))).expand(40, 2, 3, 3)
    P = coplanar_conics("random", 40, generator, F64)[1]
    found = camera_conics(transform_conic(P[:, None][..., [0, 1, 3]], drawn), drawn)
    assert_share(found.valid.all(-1) & (off(found.model, P).amin(-1) < 1e-8), 0.97)


@pytest.mark.parametrize("family", ["repeated conics", "circles about one centre"])
def test_what_leaves_a_family_of_poses_is_degenerate(family: str, generator: torch.Generator) -> None:
    (C, drawn), _ = coplanar_conics(family, 30, generator, F64)
    found = camera_conics(C, drawn)
    assert not bool(found.valid.any())
    assert bool((found.status == Status.DEGENERATE).all())


def noisy(C: Tensor, noise: float, generator: torch.Generator) -> Tensor:
    ellipse, _ = ellipse_from_conic(C)
    a, b = ellipse.semi_axes.unbind(-1)
    centre = ellipse.centre + noise * torch.randn(ellipse.centre.shape, generator=generator, dtype=F64)
    axes = ellipse.semi_axes + noise * torch.randn(ellipse.centre.shape, generator=generator, dtype=F64)
    turn = noise / (a - b) * torch.randn(a.shape, generator=generator, dtype=F64)
    return conic_from_ellipse(Ellipse(centre, axes, ellipse.angle + turn))


def test_errors_are_as_large_as_the_edge_points_allow(generator: torch.Generator) -> None:
    """Of ellipses fitted to edge points: the squared error in units of the Cramer-Rao bound is chi-squared of six degrees."""
    n, k, sigma = 150, 48, 3e-4
    C, drawn, P = many("random", n, 3, generator)
    exact = ellipse_from_conic(C)[0].points(torch.arange(k, dtype=F64) * (2 * math.pi / k))
    noise = sigma * torch.randn(exact.shape, generator=generator, dtype=F64)
    found = camera_conics(conic_from_ellipse(fit_ellipse(exact + noise).model), drawn)
    assert_share((found.status == Status.OK) & found.valid[:, 0], 0.99)

    def moved(step: Tensor) -> Tensor:
        R = P[..., :3] @ rotation_from_rotvec(step[:3])
        H = torch.cat((R[..., :2], (P[..., 3] + step[3:])[..., None]), -1)
        polar = polar_lines(transform_conic(H[:, None], drawn), exact)
        value = (polar * to_homogeneous(exact)).sum(-1)
        return (value / (2 * polar[..., :2].norm(dim=-1))).flatten(1)

    h = 1e-6
    J = torch.stack([(moved(h * e) - moved(-h * e)) / (2 * h) for e in torch.eye(6, dtype=F64)], -1)
    turn = P[..., :3].mT @ found.model[:, 0, :, :3]
    turn = 0.5 * (turn - turn.mT)[:, [2, 0, 1], [1, 2, 0]]
    delta = torch.cat((turn, found.model[:, 0, :, 3] - P[..., 3]), -1)
    squares = (J @ delta[..., None]).square().sum((-2, -1)) / sigma**2
    # 1.2 is four standard deviations of the mean; a few scenes are near to a symmetry.
    assert abs(float(squares[squares < 30].mean()) - 6) < 1.2


def test_derivatives_are_those_of_the_minima(generator: torch.Generator) -> None:
    C, drawn, _ = many("random", 3, 3, generator)
    C = noisy(C, 1e-4, generator)
    weights = 0.5 + torch.rand(3, 3, generator=generator, dtype=F64)

    def best(C: Tensor, drawn: Tensor, weights: Tensor) -> Tensor:
        return camera_conics(0.5 * (C + C.mT), 0.5 * (drawn + drawn.mT), weights=weights).model[:, 0]

    inputs = [t.requires_grad_() for t in (C, drawn, weights)]
    assert torch.autograd.gradcheck(best, inputs, atol=1e-4, rtol=1e-3, fast_mode=True)


def test_order_and_absent_conics_do_not_matter(generator: torch.Generator) -> None:
    C, drawn, _ = many("random", 20, 4, generator)
    C = noisy(C, 1e-4, generator)
    found = camera_conics(C, drawn)
    order = torch.tensor([2, 0, 3, 1])
    again = camera_conics(C[:, order], drawn[:, order])
    torch.testing.assert_close(again.model[:, 0], found.model[:, 0], rtol=1e-6, atol=1e-6)
    w = torch.tensor([1.0, 1.0, 1.0, 1.0, 0.0], dtype=F64)
    nothing = torch.full((20, 1, 3, 3), torch.nan, dtype=F64)
    again = camera_conics(torch.cat((C, nothing), 1), torch.cat((drawn, nothing), 1), weights=w)
    torch.testing.assert_close(again.model[:, 0], found.model[:, 0], rtol=1e-6, atol=1e-6)


def test_what_is_no_ellipse_has_a_status_and_spoils_none(generator: torch.Generator) -> None:
    (C, drawn), _ = coplanar_conics("random", 6, generator, F64)
    good = camera_conics(C, drawn)
    bad, plane, w = C.clone(), drawn.clone(), torch.ones(6, 2, dtype=F64)
    bad[1, 0], bad[2, 1] = torch.nan, torch.diag(torch.tensor([1.0, -1.0, 1.0]))
    plane[3, 1], w[4, 0] = torch.eye(3), 0
    found = camera_conics(bad, plane, weights=w)
    wanted = [Status.OK, Status.NOT_FINITE, Status.DEGENERATE, Status.DEGENERATE, Status.TOO_FEW, Status.OK]
    assert found.status.tolist() == wanted
    assert found.valid.any(-1).tolist() == [status == Status.OK for status in wanted]
    assert bool(found.model.isfinite().all())
    assert bool(found.error.isfinite().all())
    assert torch.equal(found.model[[0, 5]], good.model[[0, 5]])


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_batch_is_its_elements(shape: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator) -> None:
    (C, drawn), _ = coplanar_conics("random", math.prod(shape), generator, dtype)
    found = camera_conics(C.reshape(*shape, 2, 3, 3), drawn.reshape(*shape, 2, 3, 3))
    assert found.model.shape == (*shape, 4, 3, 4)
    assert found.model.dtype == found.error.dtype == dtype
    assert found.status.shape == shape
    for i in range(len(C)):
        alone = camera_conics(C[i], drawn[i])
        torch.testing.assert_close(alone.model[0], found.model.reshape(-1, 4, 3, 4)[i, 0])
