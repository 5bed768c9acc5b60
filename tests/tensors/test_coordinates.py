import torch
from chance import assert_share
from multiview_scenes import F64, cameras, images, points, up_to_scale

from torchsfm.geometry import transform_points
from torchsfm.tensors import (
    basis_homography,
    fundamental_from_cameras,
    quadrifocal_from_cameras,
    reduced_fundamental,
    reduced_quadrifocal,
    reduced_trifocal,
    transform_fundamental,
    transform_quadrifocal,
    transform_trifocal,
    trifocal_from_cameras,
)


def test_tensors_in_other_coordinates_are_those_of_moved_cameras(generator: torch.Generator) -> None:
    P = torch.randn(20, 4, 3, 4, generator=generator, dtype=F64)
    H = torch.randn(20, 4, 3, 3, generator=generator, dtype=F64)
    moved = H @ P
    F = transform_fundamental(fundamental_from_cameras(P[:, 0], P[:, 1]), H[:, 0], H[:, 1])
    assert up_to_scale(F, fundamental_from_cameras(moved[:, 0], moved[:, 1]), 2).max() < 1e-9
    T = transform_trifocal(trifocal_from_cameras(*P[:, :3].unbind(1)), *H[:, :3].unbind(1))
    assert up_to_scale(T, trifocal_from_cameras(*moved[:, :3].unbind(1)), 3).max() < 1e-9
    Q = transform_quadrifocal(quadrifocal_from_cameras(*P.unbind(1)), *H.unbind(1))
    torch.testing.assert_close(Q, quadrifocal_from_cameras(*moved.unbind(1)))


def test_four_points_become_the_basis(generator: torch.Generator) -> None:
    x = 600 * torch.rand(50, 4, 2, generator=generator, dtype=F64)
    H = basis_homography(x)
    y = torch.nn.functional.pad(x, (0, 1), value=1.0) @ H.mT
    y = y / y.norm(dim=-1, keepdim=True)
    basis = torch.cat((torch.eye(3, dtype=F64), torch.full((1, 3), 3**-0.5, dtype=F64)))
    assert ((y * basis).sum(-1).abs() - 1).abs().max() < 1e-7
    x[0, 2] = 0.5 * (x[0, 0] + x[0, 1])
    x[1, 0, 0] = torch.nan
    bad = basis_homography(x.requires_grad_())
    assert torch.isfinite(bad).all()
    assert torch.equal(bad[2:], H[2:])
    other = torch.rand(3, 2, generator=generator, dtype=F64) * 600
    assert torch.isfinite(transform_points(bad.detach(), other.expand(50, 3, 2))).all()
    assert torch.autograd.gradcheck(basis_homography, x[2:4].detach().requires_grad_())


def test_reduced_tensors(generator: torch.Generator) -> None:
    P = cameras(30, v=4, generator=generator)
    x = images(P, points(30, n=4, generator=generator))
    F = reduced_fundamental(fundamental_from_cameras(P[:, 0], P[:, 1]), x[:, 0], x[:, 1])
    assert F.diagonal(dim1=-2, dim2=-1).abs().median() < 1e-12
    assert F.sum((-2, -1)).abs().median() < 1e-12
    T = reduced_trifocal(trifocal_from_cameras(*P[:, :3].unbind(1)), x[:, :3])
    Q = reduced_quadrifocal(quadrifocal_from_cameras(*P.unbind(1)), x)
    index = torch.cartesian_prod(*(torch.arange(3),) * 4).reshape(3, 3, 3, 3, 4)
    complete = torch.stack([(index == k).any(-1) for k in range(3)]).all(0)
    assert int(complete.sum()) == 36
    assert Q[:, ~complete].abs().median() < 1e-12
    assert_share(Q[:, complete].abs() > 1e-9, 0.95)
    i, j, k = torch.cartesian_prod(*(torch.arange(3),) * 3).reshape(3, 3, 3, 3).unbind(-1)
    free = (i == j) | (i == k)
    assert int(free.sum()) == 15
    assert T[:, ~free].abs().median() < 1e-12
    assert_share(T[:, free].abs() > 1e-9, 0.95)
