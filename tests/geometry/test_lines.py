import pytest
import torch
from torch import Tensor

from torchsfm.geometry import (
    camera_from_krt,
    intersect_line_plane,
    line_from_points,
    line_to_line_distance,
    nearest_on_line,
    nearest_pluecker,
    pluecker_from_planes,
    pluecker_from_points,
    point_line_distance,
    point_to_line_distance,
    project_lines,
    project_points,
    random_rotation,
    to_homogeneous,
    transform_lines,
    unproject_onto_lines,
    viewing_planes,
)

F64 = torch.float64
SHAPES = [(), (1,), (2, 3), (0,)]


def randn(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(shape, generator=generator, dtype=F64)


def parallel(a: Tensor, b: Tensor) -> Tensor:
    """How far two vectors are from being the same up to scale and sign."""
    a, b = (torch.nn.functional.normalize(v, dim=-1) for v in (a, b))
    return torch.minimum((a - b).norm(dim=-1), (a + b).norm(dim=-1))


def cameras(generator: torch.Generator, *shape: int) -> Tensor:
    K = torch.tensor([[800.0, 3, 500], [0, 790, 380], [0, 0, 1]], dtype=F64)
    R = random_rotation(*shape, generator=generator, dtype=F64)
    return camera_from_krt(K, R, randn(generator, *shape, 3) + torch.tensor([0.0, 0, 6], dtype=F64))


@pytest.mark.parametrize("shape", SHAPES)
def test_lines_of_the_plane(shape: tuple[int, ...], generator: torch.Generator) -> None:
    x1, x2, x = (100 * randn(generator, *shape, 2) for _ in range(3))
    line = line_from_points(x1, x2)
    assert line.shape == (*shape, 3)
    torch.testing.assert_close(line[..., :2].norm(dim=-1), torch.ones(shape, dtype=F64))
    for end in (x1, x2):
        torch.testing.assert_close(point_line_distance(end, line), torch.zeros(shape, dtype=F64), rtol=0, atol=1e-11)
    d = x2 - x1
    area = d[..., 0] * (x - x1)[..., 1] - d[..., 1] * (x - x1)[..., 0]
    torch.testing.assert_close(point_line_distance(x, line), -area / d.norm(dim=-1))
    torch.testing.assert_close(point_line_distance(x, 3 * line), point_line_distance(x, line))
    assert bool((line_from_points(x1, x1) == 0).all())
    assert bool((point_line_distance(x, torch.tensor([0.0, 0, 1], dtype=F64)) == 0).all())


@pytest.mark.parametrize("shape", SHAPES)
def test_lines_of_space_through_points_and_planes(shape: tuple[int, ...], generator: torch.Generator) -> None:
    X1, X2, X3, X4 = (randn(generator, *shape, 3) for _ in range(4))
    line = pluecker_from_points(X1, X2)
    torch.testing.assert_close((line[..., :3] * line[..., 3:]).sum(-1), torch.zeros(shape, dtype=F64))
    for t in (-1.0, 0.0, 0.4, 3.0):
        torch.testing.assert_close(point_to_line_distance(X1 + t * (X2 - X1), line), torch.zeros(shape, dtype=F64))
    planes = [torch.cat((n := torch.linalg.cross(X2 - X1, X - X1), -(n * X1).sum(-1, keepdim=True)), -1) for X in (X3, X4)]
    met = pluecker_from_planes(*planes)
    assert met.shape == (*shape, 6)
    assert bool((parallel(met, line) < 1e-9).all())
    # The direction is the cross product of the normals.
    torch.testing.assert_close(met[..., :3], torch.linalg.cross(planes[0][..., :3], planes[1][..., :3]))
    plane = randn(generator, *shape, 4)
    point = intersect_line_plane(line, plane)
    inside = point[..., :3] / point[..., 3:]
    assert bool(((to_homogeneous(inside) * plane).sum(-1).abs() < 1e-8 * (1 + inside.norm(dim=-1))).all())
    assert bool((point_to_line_distance(inside, line) < 1e-9 * (1 + inside.norm(dim=-1))).all())
    torch.testing.assert_close(intersect_line_plane(met, planes[0]), torch.zeros(*shape, 4, dtype=F64))


def test_images_have_the_sign_and_scale_of_the_points(generator: torch.Generator) -> None:
    P = cameras(generator, 5) * randn(generator, 5, 1, 1)
    X1, X2 = randn(generator, 5, 7, 3), randn(generator, 5, 7, 3)
    line = project_lines(P, pluecker_from_points(X1, X2))
    y1, y2 = ((to_homogeneous(X) @ P.mT) for X in (X1, X2))
    torch.testing.assert_close(line, torch.linalg.cross(y1, y2))
    for X in (X1, 2 * X1 - X2):
        plane = viewing_planes(P, line)
        torch.testing.assert_close((plane * to_homogeneous(X)).sum(-1) / plane.norm(dim=-1), torch.zeros(5, 7, dtype=F64))
    L = pluecker_from_points(X1[0], X2[0])
    planes = [viewing_planes(camera, project_lines(camera, L)) for camera in P[:2]]
    assert bool((parallel(pluecker_from_planes(*planes), L) < 1e-8).all())


def test_points_come_back_from_their_images(generator: torch.Generator) -> None:
    P, X1, X2 = cameras(generator, 6), randn(generator, 6, 9, 3), randn(generator, 6, 9, 3)
    L = pluecker_from_points(X1, X2)
    x = project_points(P, X1)
    line = project_lines(P, L)
    normal = line[..., :2] / line[..., :2].norm(dim=-1, keepdim=True)
    # Off the line's image the foot counts.
    for away in (0.0, 5.0):
        back = unproject_onto_lines(x + away * normal, P, L)
        torch.testing.assert_close(back[..., :3] / back[..., 3:], X1, rtol=1e-6, atol=1e-7)
    # Batches broadcast, also those of the points alone.
    several = unproject_onto_lines(torch.stack((x, x)), P, L)
    torch.testing.assert_close(several, unproject_onto_lines(x, P, L).expand_as(several))


@pytest.mark.parametrize("shape", SHAPES)
def test_distances(shape: tuple[int, ...], generator: torch.Generator) -> None:
    X, p, d, q, e = (randn(generator, *shape, 3) for _ in range(5))
    line, other = pluecker_from_points(p, p + d), pluecker_from_points(q, q + e)
    foot = nearest_on_line(X, line)
    assert bool((((foot - X) * d).sum(-1).abs() < 1e-10).all())
    assert bool((point_to_line_distance(foot, line) < 1e-10).all())
    torch.testing.assert_close(point_to_line_distance(X, line), (foot - X).norm(dim=-1))
    # The shortest connection by least squares over both parameters.
    normal = torch.linalg.cross(d, e)
    wanted = ((q - p) * normal).sum(-1).abs() / normal.norm(dim=-1)
    torch.testing.assert_close(line_to_line_distance(line, other), wanted)
    torch.testing.assert_close(line_to_line_distance(-2 * other, line), wanted)
    beside = pluecker_from_points(X, X - 3 * d)
    torch.testing.assert_close(line_to_line_distance(line, beside), point_to_line_distance(X, line), rtol=1e-6, atol=1e-9)
    assert bool((line_to_line_distance(line, line) < 1e-9).all())


def test_nearest_lines(generator: torch.Generator) -> None:
    L = randn(generator, 200, 6)
    near = nearest_pluecker(L)
    d, m = near[..., :3], near[..., 3:]
    assert float((d * m).sum(-1).abs().max()) < 1e-13
    # Nothing that is a line is nearer: the difference is normal to the quadric, along (m, d), and the smaller of both roots.
    off = L - near
    assert float(parallel(off, torch.cat((m, d), -1)).max()) < 1e-7
    some = pluecker_from_points(randn(generator, 200, 500, 3), randn(generator, 200, 500, 3))
    some = some * ((some * L[:, None]).sum(-1) / some.square().sum(-1))[..., None]
    assert bool(((some - L[:, None]).norm(dim=-1).amin(-1) >= off.norm(dim=-1) - 1e-12).all())
    line = pluecker_from_points(randn(generator, 50, 3), randn(generator, 50, 3))
    torch.testing.assert_close(nearest_pluecker(line), line)
    same = torch.cat((torch.eye(3, dtype=F64), torch.eye(3, dtype=F64)), -1)
    for L in (same, torch.cat((same[:, :3], -same[:, 3:]), -1), torch.zeros(1, 6, dtype=F64)):
        found = nearest_pluecker(L)
        assert bool(found.isfinite().all())
        assert float((found[:, :3] * found[:, 3:]).sum(-1).abs().max()) == 0


def test_maps_of_space_move_points_and_lines_alike(generator: torch.Generator) -> None:
    H = randn(generator, 4, 4, 4)
    X1, X2 = randn(generator, 4, 6, 3), randn(generator, 4, 6, 3)
    L = pluecker_from_points(X1, X2)
    y1, y2 = ((to_homogeneous(X) @ H.mT) for X in (X1, X2))
    moved = transform_lines(H, L)
    scale = y1[..., 3:] * y2[..., 3:]
    torch.testing.assert_close(moved, scale * pluecker_from_points(y1[..., :3] / y1[..., 3:], y2[..., :3] / y2[..., 3:]))
    # What a camera sees does not change when world and camera move together.
    P = cameras(generator, 4)
    torch.testing.assert_close(project_lines(P @ torch.linalg.inv(H), moved), project_lines(P, L), rtol=1e-6, atol=1e-6)


def test_derivatives(generator: torch.Generator) -> None:
    P, X, Y = cameras(generator, 2), randn(generator, 2, 3, 3), randn(generator, 2, 3, 3)
    x = randn(generator, 2, 3, 2)
    inputs = [v.requires_grad_() for v in (P, X, Y, x)]

    def everything(P: Tensor, X: Tensor, Y: Tensor, x: Tensor) -> tuple[Tensor, ...]:
        L = pluecker_from_points(X, Y)
        other = L.roll(1, -2)
        l = 1e-5 * project_lines(P, L)  # noqa: E741
        return (
            l, point_line_distance(x, l), nearest_on_line(Y + X, L), line_to_line_distance(L, other),
            nearest_pluecker(L + 0.1 * X.repeat(1, 1, 2)), line_from_points(x, x.roll(1, -2)),
        )  # fmt: skip

    assert torch.autograd.gradcheck(everything, inputs, atol=1e-4, rtol=1e-4)
    zero = torch.zeros(6, dtype=F64, requires_grad=True)
    total = line_to_line_distance(zero, zero) + nearest_on_line(zero[:3], zero).sum() + nearest_pluecker(zero).sum()
    total = total + point_to_line_distance(zero[:3], zero) + point_line_distance(zero[:2], zero[:3])
    (slope,) = torch.autograd.grad(total + line_from_points(zero[:2], zero[:2]).sum(), zero)
    assert bool(slope.isfinite().all())


@pytest.mark.usefixtures("unchecked")
def test_errors_name_the_argument() -> None:
    with pytest.raises(ValueError, match="L: wanted shape"):
        project_lines(torch.zeros(3, 4), torch.zeros(5))
    with pytest.raises(ValueError, match="X2"):
        pluecker_from_points(torch.zeros(3), torch.zeros(2))
    with pytest.raises(ValueError, match="plane2: wanted dtype"):
        pluecker_from_planes(torch.zeros(4), torch.zeros(4).double())
