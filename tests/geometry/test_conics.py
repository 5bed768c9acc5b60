"""Laws of conics: conversions, duality, polarity, common points, distances; over many random ones of each family."""

import math

import pytest
import torch
from chance import assert_share
from torch import Tensor

from torchsfm.geometry import (
    Ellipse,
    conic_distance,
    conic_from_ellipse,
    dual_conic,
    ellipse_distance,
    ellipse_from_conic,
    intersect_conics,
    intersect_line_conic,
    polar_lines,
    tangent_lines,
    to_homogeneous,
    transform_conic,
    transform_points,
)

F64 = torch.float64


def ellipses(*batch: int, generator: torch.Generator, flat: float = 0.1) -> Ellipse:
    """Ellipses with axes of ratios down to `flat`, up to a few axes away from the origin."""
    size = 0.2 + 2 * torch.rand(batch, generator=generator, dtype=F64)
    ratio = flat + (0.99 - flat) * torch.rand(batch, generator=generator, dtype=F64)
    angle = math.pi * (torch.rand(batch, generator=generator, dtype=F64) - 0.5)
    return Ellipse(torch.randn(*batch, 2, generator=generator, dtype=F64), torch.stack((size, ratio * size), -1), angle)


def unit(v: Tensor) -> Tensor:
    return v / v.norm(dim=-1, keepdim=True)


def near(a: Tensor, b: Tensor) -> Tensor:
    """How far apart homogeneous vectors are, whatever their scales."""
    return torch.linalg.cross(*torch.broadcast_tensors(unit(a), unit(b))).norm(dim=-1)


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,)])
@pytest.mark.parametrize("scale", [1.0, -1e3, 1e-100, 1e50])
def test_ellipses_come_back(batch, scale, generator):
    ellipse = ellipses(*batch, generator=generator)
    found, valid = ellipse_from_conic(scale * conic_from_ellipse(ellipse))
    assert valid.shape == batch
    assert valid.all()
    for a, b in ((found.centre, ellipse.centre), (found.semi_axes, ellipse.semi_axes), (found.angle, ellipse.angle)):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


def test_points_of_an_ellipse_are_on_its_conic(generator):
    ellipse = ellipses(50, generator=generator)
    x = to_homogeneous(ellipse.points(torch.rand(50, 9, generator=generator, dtype=F64) * 7))
    C = conic_from_ellipse(ellipse)
    assert (((x @ C) * x).sum(-1).abs() < 1e-10 * C.abs().amax((-1, -2))[:, None]).all()
    centre = to_homogeneous(ellipse.centre)[:, None]
    torch.testing.assert_close(((centre @ C) * centre).sum(-1), -torch.ones(50, 1, dtype=F64), rtol=1e-9, atol=1e-9)


def test_only_ellipses_are_called_ellipses(generator):
    good = conic_from_ellipse(ellipses(1, generator=generator))[0]
    bad = [
        torch.diag(torch.tensor(d, dtype=F64))
        for d in (
            [1.0, 1, 1],
            [1.0, -1, -1],
            [1.0, -1, 1],
            [1.0, 0, -1],
            [1.0, 1, 0],
            [0.0, 0, 1],
            [0.0, 0, 0],
            [1.0, 1, math.nan],
        )
    ]
    C = torch.stack([good, *bad, torch.full((3, 3), math.inf, dtype=F64)]).requires_grad_()
    found, valid = ellipse_from_conic(C)
    assert valid.tolist() == [True] + [False] * 9
    alone, _ = ellipse_from_conic(good)
    assert torch.equal(found.centre[0], alone.centre)
    assert torch.equal(found.semi_axes[0], alone.semi_axes)
    (found.centre.sum() + found.semi_axes.sum() + found.angle.sum()).backward()
    assert C.grad[:-2].isfinite().all()
    assert (C.grad[1:-2] == 0).all()


def test_circles_have_no_direction_and_no_derivative_of_it():
    circle = Ellipse(torch.tensor([3.0, -1], dtype=F64), torch.tensor([2.0, 2], dtype=F64), torch.tensor(0.7, dtype=F64))
    C = conic_from_ellipse(circle).requires_grad_()
    found, valid = ellipse_from_conic(C)
    assert valid
    assert found.angle == 0
    torch.testing.assert_close(found.semi_axes, circle.semi_axes)
    (found.semi_axes.sum() + found.angle).backward()
    assert C.grad.isfinite().all()


def test_conics_move_with_their_points(generator):
    ellipse = ellipses(40, generator=generator)
    H = torch.eye(3, dtype=F64) + 0.1 * torch.randn(40, 3, 3, generator=generator, dtype=F64)
    C = transform_conic(H, conic_from_ellipse(ellipse))
    x = to_homogeneous(transform_points(H, ellipse.points(torch.linspace(0, 6, 7, dtype=F64))))
    size = C.norm(dim=(-2, -1))[:, None] * x.square().sum(-1)
    assert ((((x @ C) * x).sum(-1).abs()) < 1e-11 * size).all()
    # Tangents go to tangents: the dual moves by H C* H'.
    moved, other = dual_conic(C), H @ dual_conic(conic_from_ellipse(ellipse)) @ H.mT
    assert (near(moved.flatten(-2)[..., :3], other.flatten(-2)[..., :3]) < 1e-9).all()
    torch.testing.assert_close(unit(moved.flatten(-2)).abs(), unit(other.flatten(-2)).abs(), rtol=1e-8, atol=1e-10)


def test_the_dual_of_the_dual_is_the_conic(generator):
    C = conic_from_ellipse(ellipses(30, generator=generator))
    back = dual_conic(dual_conic(C))
    torch.testing.assert_close(unit(back.flatten(-2)).abs(), unit(C.flatten(-2)).abs(), rtol=1e-9, atol=1e-12)


def test_tangents_touch_where_the_polar_meets_the_conic(generator):
    ellipse = ellipses(200, generator=generator)
    C = conic_from_ellipse(ellipse)
    x = ellipse.centre[:, None] + torch.randn(200, 6, 2, generator=generator, dtype=F64) * 2
    outside = ((to_homogeneous(x) @ C) * to_homogeneous(x)).sum(-1) > 0
    lines, real = tangent_lines(C, x)
    points, meets = intersect_line_conic(polar_lines(C, x), C)
    assert torch.equal(real, outside)
    assert torch.equal(meets, outside)
    assert outside.any()
    assert not outside.all()
    lines, points = lines[real], points[real]
    h, A = unit(to_homogeneous(x[real])), C[:, None].expand(-1, 6, -1, -1)[real]
    assert ((lines @ h[..., None]).abs() < 1e-12).all()
    # Each tangent is the polar of a point of contact.
    contact = unit(points @ A)
    apart = torch.stack([near(lines[:, i], contact[:, j]) for i in range(2) for j in range(2)], -1).unflatten(-1, (2, 2))
    assert (apart.amin(-1) < 1e-6).all()


def test_lines_with_special_coefficients_meet_conics():
    C = torch.diag(torch.tensor([1.0, 1, -1], dtype=F64))
    l = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, -1], [0, 0, 0], [1, 0, -2], [math.nan, 0, 1]], dtype=F64)  # noqa: E741
    y, real = intersect_line_conic(l, C)
    assert real.tolist() == [True, True, False, True, False, False, False]
    assert y.isfinite().all()
    assert (((y @ C) * y).sum(-1)[real].abs() < 1e-14).all()
    hyperbola = torch.tensor([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]], dtype=F64)  # xy = 1/2; its axes meet it at infinity, twice
    y, real = intersect_line_conic(l[:3], hyperbola)
    assert real.all()
    assert (near(y[0], torch.tensor([0.0, 1, 0], dtype=F64)) < 1e-14).all()
    assert (near(y[2].sort(dim=-2).values.sum(0, keepdim=True), torch.tensor([1.0, 1, 0], dtype=F64)) < 1e-14).all()


def through_four_points(*batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Two conics and their four common points: members of the pencil of the sides of a quadrangle."""
    h = to_homogeneous(torch.randn(*batch, 4, 2, generator=generator, dtype=F64))
    a, b, c, d = h.unbind(-2)
    cross = torch.linalg.cross

    def pair(p: Tensor, q: Tensor, r: Tensor, s: Tensor) -> Tensor:
        first, second = cross(p, q), cross(r, s)
        M = first[..., :, None] * second[..., None, :]
        return M + M.mT

    A, B = pair(a, b, c, d), pair(a, c, b, d)
    k = torch.randn(4, *batch, 1, 1, generator=generator, dtype=F64)
    return k[0] * A + k[1] * B, k[2] * A + k[3] * B, h


def test_all_four_common_points_are_found(generator):
    C1, C2, h = through_four_points(3000, generator=generator)
    found = intersect_conics(C1, C2)
    miss = near(found.model[:, :, None], h[:, None]).masked_fill(~found.valid[:, :, None], 9).amin(1).amax(-1)
    assert_share(miss < 1e-6, 0.999)
    assert_share(found.valid.all(-1), 0.999)


@pytest.mark.parametrize("count", [0, 2])
def test_fewer_common_points_are_counted(count, generator):
    """Of circles, which have two more at the circular points: two real ones or none."""
    n = 3000
    r = 0.5 + torch.rand(2, n, generator=generator, dtype=F64)
    share = 0.05 + 0.9 * torch.rand(n, generator=generator, dtype=F64)
    low, high = (r[0] - r[1]).abs(), r[0] + r[1]
    gap = low + share * (high - low) if count == 2 else torch.where(share < 0.5, share * low, high * (1 + share))
    turn = 7 * torch.rand(n, generator=generator, dtype=F64)
    c1 = torch.randn(n, 2, generator=generator, dtype=F64)
    c2 = c1 + gap[:, None] * torch.stack((turn.cos(), turn.sin()), -1)
    C = [conic_from_ellipse(Ellipse(c, s[:, None].expand(n, 2), 0 * s)) for c, s in ((c1, r[0]), (c2, r[1]))]
    found = intersect_conics(*C)
    assert_share(found.valid.sum(-1) == count, 0.999)
    for A in C:
        left = ((found.model @ A) * found.model).sum(-1).abs() / A.norm(dim=(-2, -1))[:, None]
        assert (left[found.valid] < 1e-10).all()


def test_common_points_carry_derivatives(generator):
    C1, C2, _ = through_four_points(6, generator=generator)
    valid = intersect_conics(C1, C2).valid

    def points(A: Tensor, B: Tensor) -> Tensor:
        return intersect_conics(0.5 * (A + A.mT), 0.5 * (B + B.mT)).model[valid]

    assert valid.any()
    C1, C2 = (C / C.norm(dim=(-2, -1), keepdim=True) for C in (C1, C2))
    assert torch.autograd.gradcheck(points, (C1.requires_grad_(), C2.requires_grad_()), atol=1e-4, rtol=1e-3)


def test_bad_conics_have_no_common_points(generator):
    C1, C2, _ = through_four_points(5, generator=generator)
    reference = intersect_conics(C1, C2)
    A, B = C1.clone(), C2.clone()
    A[0], B[1], A[2], B[2] = math.nan, 0, A[3], 2 * A[3]
    found = intersect_conics(A, B)
    assert not found.valid[:3].any()
    assert found.model.isfinite().all()
    assert torch.equal(found.model[3:], reference.model[3:])
    assert torch.equal(found.valid[3:], reference.valid[3:])


@pytest.mark.parametrize("where", ["around", "inside", "far", "evolute", "axes"])
def test_distances_are_the_least(where, generator):
    n = 300
    ellipse = ellipses(n, generator=generator, flat=0.02)
    local = torch.randn(n, 1, 2, generator=generator, dtype=F64)
    a, b = ellipse.semi_axes[:, None].unbind(-1)
    if where == "inside":
        share = torch.rand(n, 1, 1, generator=generator, dtype=F64)
        local = unit(local) * torch.stack((a, b), -1) * share
    elif where == "far":
        local = local * 1e3
    elif where == "evolute":
        t = 7 * torch.rand(n, 1, generator=generator, dtype=F64)
        local = torch.stack(((a * a - b * b) / a * t.cos() ** 3, (b * b - a * a) / b * t.sin() ** 3), -1)
    elif where == "axes":
        local = local * torch.eye(2, dtype=F64)[torch.arange(n) % 2][:, None] * (torch.arange(n) % 7 > 0)[:, None, None]
    cos, sin = ellipse.angle.cos()[:, None], ellipse.angle.sin()[:, None]
    turned = torch.stack((cos * local[..., 0] - sin * local[..., 1], sin * local[..., 0] + cos * local[..., 1]), -1)
    x = ellipse.centre[:, None] + turned
    found = ellipse_distance(ellipse, x)[:, 0]
    # By search: on a grid, then on finer ones.
    best, width = torch.zeros(n, 1, dtype=F64), 2 * math.pi
    for _ in range(8):
        t = best + width * torch.linspace(-0.5, 0.5, 201, dtype=F64)
        length = (ellipse.points(t) - x).norm(dim=-1)
        least, index = length.min(-1)
        best, width = t.gather(-1, index[:, None]), width / 20
    torch.testing.assert_close(found.abs(), least, rtol=1e-8, atol=1e-8)
    C = conic_from_ellipse(ellipse)
    inside = ((to_homogeneous(x) @ C) * to_homogeneous(x)).sum(-1)[:, 0] < 0
    assert torch.equal(found < 0, inside) or (found[(found < 0) != inside].abs() < 1e-12).all()


def test_distances_have_first_and_second_derivatives(generator):
    ellipse = ellipses(8, generator=generator)
    x = ellipse.centre[:, None] + torch.randn(8, 3, 2, generator=generator, dtype=F64)
    inputs = tuple(v.requires_grad_() for v in (ellipse.centre, ellipse.semi_axes, ellipse.angle, x))

    def distance(centre: Tensor, axes: Tensor, angle: Tensor, points: Tensor) -> Tensor:
        return ellipse_distance(Ellipse(centre, axes, angle), points)

    assert torch.autograd.gradcheck(distance, inputs)
    # Second ones by differences of the first: the search for the foot hides them from automatic double differences.
    total = distance(*inputs).square().sum()
    slopes = torch.autograd.grad(total, inputs, create_graph=True)
    direction = [torch.randn(v.shape, generator=generator, dtype=F64) for v in inputs]
    along = torch.autograd.grad(sum((s * d).sum() for s, d in zip(slopes, direction, strict=True)), inputs)
    step = 1e-6
    moved = []
    for sign in (1, -1):
        there = tuple((v + sign * step * d).detach().requires_grad_() for v, d in zip(inputs, direction, strict=True))
        moved.append(torch.autograd.grad(distance(*there).square().sum(), there))
    for wanted, plus, minus in zip(along, *moved, strict=True):
        torch.testing.assert_close(wanted, (plus - minus) / (2 * step), rtol=1e-4, atol=1e-5)


def test_first_order_distances_agree_next_to_the_conic(generator):
    ellipse = ellipses(100, generator=generator)
    on = ellipse.points(7 * torch.rand(100, 5, generator=generator, dtype=F64))
    x = on + 1e-5 * torch.randn(100, 5, 2, generator=generator, dtype=F64)
    C = conic_from_ellipse(ellipse)
    torch.testing.assert_close(conic_distance(-3 * C, x), ellipse_distance(ellipse, x).abs(), rtol=1e-3, atol=1e-8)


def test_points_that_are_no_numbers_are_far_and_change_no_others(generator):
    ellipse = ellipses(generator=generator)
    x = torch.randn(4, 2, generator=generator, dtype=F64)
    bad = x.clone()
    bad[1, 0], bad[2] = math.nan, math.inf
    for distance in (lambda p: ellipse_distance(ellipse, p), lambda p: conic_distance(conic_from_ellipse(ellipse), p)):
        p = bad.clone().requires_grad_()
        d = distance(p)
        assert (d[1:3] > 1e100).all()
        assert d.isfinite().all()
        assert torch.equal(d[[0, 3]], distance(x)[[0, 3]])
        d[[0, 3]].sum().backward()
        assert p.grad.isfinite().all()


def test_an_ellipse_that_is_none_is_named(unchecked):
    with pytest.raises(ValueError, match="ellipse"):
        conic_from_ellipse(torch.zeros(5))
    with pytest.raises(ValueError, match="semi_axes"):
        conic_from_ellipse(Ellipse(torch.zeros(2), torch.ones(3), torch.zeros(())))
