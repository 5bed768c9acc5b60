"""Laws of quadrics and of conics in space: conversions, duality, projection."""

import math

import pytest
import torch
from torch import Tensor

from torchsfm.geometry import (
    Ellipsoid,
    camera_from_krt,
    dual_conic,
    dual_quadric,
    dual_quadric_from_ellipsoid,
    ellipse_distance,
    ellipse_from_conic,
    ellipsoid_from_dual_quadric,
    plane_conic_from_dual_quadric,
    project_points,
    project_quadric,
    random_rotation,
    to_homogeneous,
    transform_quadric,
    viewing_cone,
)

F64 = torch.float64


def ellipsoids(*batch: int, flat: bool, generator: torch.Generator) -> Ellipsoid:
    """With clearly different axes, a few of them away from the origin."""
    lengths = torch.rand(*batch, 3, generator=generator, dtype=F64) * 0.3 + torch.tensor([1.2, 0.8, 0.3], dtype=F64)
    if flat:
        lengths[..., 2] = 0
    R = random_rotation(*batch, generator=generator, dtype=F64)
    return Ellipsoid(torch.randn(*batch, 3, generator=generator, dtype=F64), lengths[..., None] * R)


def camera(generator: torch.Generator) -> Tensor:
    """Far enough away to see everything."""
    K = torch.tensor([[800.0, 0, 320], [0, 810, 240], [0, 0, 1]], dtype=F64)
    R = random_rotation(generator=generator, dtype=F64)
    return camera_from_krt(K, R, torch.tensor([0.0, 0, 20], dtype=F64))


def unit(A: Tensor) -> Tensor:
    flat = A.flatten(-2)
    largest = flat.gather(-1, flat.abs().argmax(-1, keepdim=True))
    return A / largest[..., None]


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,)])
@pytest.mark.parametrize("scale", [1.0, -1e3, 1e-50])
def test_ellipsoids_come_back(batch, flat, scale, generator):
    e = ellipsoids(*batch, flat=flat, generator=generator)
    found, valid = ellipsoid_from_dual_quadric(scale * dual_quadric_from_ellipsoid(e))
    assert valid.shape == batch
    assert valid.all()
    torch.testing.assert_close(found.centre, e.centre, rtol=1e-12, atol=1e-12)
    # The signs of axes are free.
    agree = (found.axes * e.axes).sum(-1, keepdim=True).sign()
    torch.testing.assert_close(found.axes * agree, e.axes * agree.square(), rtol=1e-9, atol=1e-9)
    if flat:
        assert (found.axes[..., 2, :] == 0).all()


def test_only_ellipsoids_are_called_ellipsoids(generator):
    good = dual_quadric_from_ellipsoid(ellipsoids(flat=True, generator=generator))
    entries = [1.0, 1, -1, -1], [1.0, 0, 0, -1], [1.0, 1, 1, 0], [1.0, 1, 1, 1], [0.0, 0, 0, 0]
    bad = [torch.diag(torch.tensor(d, dtype=F64)) for d in entries]
    Q = torch.stack([good, *bad, torch.full((4, 4), math.nan, dtype=F64)]).requires_grad_()
    found, valid = ellipsoid_from_dual_quadric(Q)
    assert valid.tolist() == [True] + [False] * 6
    assert torch.equal(found.axes[0], ellipsoid_from_dual_quadric(good)[0].axes)
    (found.centre.sum() + found.axes.sum()).backward()
    assert Q.grad[:-1].isfinite().all()


def test_axes_have_derivatives(generator):
    e = ellipsoids(5, flat=False, generator=generator)
    Q = dual_quadric_from_ellipsoid(e).requires_grad_()

    def axes(q: Tensor) -> Tensor:
        found, _ = ellipsoid_from_dual_quadric(0.5 * (q + q.mT))
        return torch.cat((found.centre[:, None], found.axes), -2)

    assert torch.autograd.gradcheck(lambda q: axes(q) * axes(Q).detach().sign() * axes(q).detach().sign(), (Q,))


@pytest.mark.parametrize("flat", [False, True])
def test_quadrics_move_with_their_points_and_planes(flat, generator):
    e = ellipsoids(20, flat=flat, generator=generator)
    H = torch.eye(4, dtype=F64) + 0.1 * torch.randn(20, 4, 4, generator=generator, dtype=F64)
    dual = H @ dual_quadric_from_ellipsoid(e) @ H.mT
    if not flat:
        Q = transform_quadric(H, dual_quadric(dual_quadric_from_ellipsoid(e)))
        torch.testing.assert_close(unit(dual_quadric(Q)), unit(dual), rtol=1e-8, atol=1e-9)
        w = torch.randn(20, 6, 3, generator=generator, dtype=F64)
        X = e.centre[:, None] + w / w.norm(dim=-1, keepdim=True) @ e.axes
        Y = to_homogeneous(X) @ H.mT
        size = Q.norm(dim=(-2, -1))[:, None] * Y.square().sum(-1)
        assert (((Y @ Q) * Y).sum(-1).abs() < 1e-10 * size).all()
    else:
        # The dual's null vector is the plane, and its adjugate the plane twice.
        plane = (torch.linalg.inv(H).mT @ e.plane[..., None])[..., 0]
        assert ((dual @ plane[..., None]).norm(dim=(-2, -1)) < 1e-10 * dual.norm(dim=(-2, -1)) * plane.norm(dim=-1)).all()
        torch.testing.assert_close(unit(dual_quadric(dual)), unit(plane[:, :, None] * plane[:, None]), rtol=1e-8, atol=1e-9)


def test_a_conic_in_space_projects_to_the_image_of_its_points(generator):
    e, P = ellipsoids(30, flat=True, generator=generator), camera(generator)
    image, valid = ellipse_from_conic(dual_conic(project_quadric(P, dual_quadric_from_ellipsoid(e))))
    assert valid.all()
    t = torch.linspace(0, 6, 9, dtype=F64)
    X = e.centre[:, None] + torch.stack((t.cos(), t.sin(), 0 * t), -1) @ e.axes
    # An ellipse seen from the side has few digits left across.
    ratio = image.semi_axes[:, :1] / image.semi_axes[:, 1:]
    assert (ellipse_distance(image, project_points(P, X)).abs() < 1e-9 * ratio**2).all()
    # Each of these points is on the viewing cone of the image.
    cone = viewing_cone(P, dual_conic(project_quadric(P, dual_quadric_from_ellipsoid(e))))
    h = to_homogeneous(X)
    assert (((h @ cone) * h).sum(-1).abs() < 1e-9 * cone.norm(dim=(-2, -1))[:, None] * h.square().sum(-1)).all()


def test_the_outline_of_an_ellipsoid_holds_all_its_points(generator):
    e, P = ellipsoids(30, flat=False, generator=generator), camera(generator)
    image, valid = ellipse_from_conic(dual_conic(project_quadric(P, dual_quadric_from_ellipsoid(e))))
    assert valid.all()
    w = torch.randn(30, 4000, 3, generator=generator, dtype=F64)
    X = e.centre[:, None] + w / w.norm(dim=-1, keepdim=True) @ e.axes
    d = ellipse_distance(image, project_points(P, X))
    assert (d < 1e-8).all()
    assert (d.amax(-1) > -0.5).all()


@pytest.mark.parametrize("kind", ["ellipse", "hyperbola"])
def test_plane_and_conic_make_the_dual_quadric(kind, generator):
    Q = dual_quadric_from_ellipsoid(ellipsoids(20, flat=True, generator=generator))
    if kind == "hyperbola":
        e = ellipsoids(20, flat=True, generator=generator)
        sign = torch.tensor([1.0, -1.0, 0.0], dtype=F64)[:, None]
        c = to_homogeneous(e.centre)
        Q = torch.nn.functional.pad(e.axes.mT @ (sign * e.axes), (0, 1, 0, 1)) + c[:, :, None] * c[:, None]
    found, valid = plane_conic_from_dual_quadric(-2 * Q)
    assert valid.all()
    assert ((Q @ found.plane[..., None]).norm(dim=(-2, -1)) < 1e-10 * Q.norm(dim=(-2, -1))).all()
    torch.testing.assert_close(unit(found.frame @ dual_conic(found.C) @ found.frame.mT), unit(Q), rtol=1e-8, atol=1e-9)
    assert ((found.plane[:, None] @ found.frame).abs() < 1e-12).all()


def test_planes_that_are_none_are_told(generator):
    good = dual_quadric_from_ellipsoid(ellipsoids(flat=True, generator=generator))
    bad = [torch.diag(torch.tensor(d, dtype=F64)) for d in ([1.0, 1, -1, 0], [1.0, 0, 0, -1], [0.0, 0, 0, 0])]
    Q = torch.stack([good, *bad, torch.full((4, 4), math.inf, dtype=F64)])
    found, valid = plane_conic_from_dual_quadric(Q)
    assert valid.tolist() == [True, False, False, False, False]
    assert all(v.isfinite().all() for v in (found.plane, found.frame, found.C))
