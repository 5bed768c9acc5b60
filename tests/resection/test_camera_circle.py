import pytest
import torch
from torch import Tensor

from torchsfm.geometry import rotation_from_rotvec
from torchsfm.resection import camera_circle

F64 = torch.float64


def scenes(generator: torch.Generator, *shape: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Normals, centres and radii of circles in front of cameras, and the conics of their rays."""
    turn = 0.9 * (2 * torch.rand(*shape, 3, generator=generator, dtype=F64) - 1)
    R = rotation_from_rotvec(turn)
    place = torch.cat((torch.randn(*shape, 2, generator=generator, dtype=F64), torch.full((*shape, 1), 6.0, dtype=F64)), -1)
    radius = 0.3 + torch.rand(shape, generator=generator, dtype=F64)
    return R[..., 2], place, radius, cone(R, place, radius)


def cone(R: Tensor, t: Tensor, radius: Tensor) -> Tensor:
    """From the plane's points (x, y, 1) to rays: [r1 r2 t]."""
    H = torch.cat((R[..., :2], t[..., None]), -1)
    circle = torch.diag_embed(torch.stack((torch.ones_like(radius), torch.ones_like(radius), -radius.square()), -1))
    inverse = torch.linalg.inv(H)
    return inverse.mT @ circle @ inverse


def test_one_of_two_is_the_camera_and_both_see_the_circle(generator: torch.Generator) -> None:
    n, centre, radius, C = scenes(generator, 1000)
    scale = torch.randn(1000, 1, 1, generator=generator, dtype=F64)
    found = camera_circle(scale * C, radius)
    assert bool(found.valid.all())
    R, t = found.model[..., :3], found.model[..., 3]
    away = (R[..., 2] - n[:, None]).norm(dim=-1) + (t - centre[:, None]).norm(dim=-1)
    # A circle has no front: the normal that leads away from the camera is told.
    turned = (R[..., 2] + n[:, None]).norm(dim=-1) + (t - centre[:, None]).norm(dim=-1)
    assert float(torch.minimum(away, turned).amin(-1).max()) < 1e-7
    assert bool((t[..., 2] > 0).all())
    assert bool(((R[..., 2] * t).sum(-1) > 0).all())
    torch.testing.assert_close(R.mT @ R, torch.eye(3, dtype=F64).expand_as(R))
    assert bool((torch.linalg.det(R) > 0).all())
    again = cone(R, t, radius[:, None].expand(1000, 2))
    again = again / again.flatten(-2).norm(dim=-1)[..., None, None]
    C = C[:, None] / C[:, None].flatten(-2).norm(dim=-1)[..., None, None]
    assert float(torch.minimum((again - C).abs().amax((-2, -1)), (again + C).abs().amax((-2, -1))).max()) < 1e-8


def test_a_circle_seen_from_its_axis_has_one_camera() -> None:
    C = torch.diag(torch.tensor([1.0, 1.0, -0.25], dtype=F64))
    found = camera_circle(C, torch.tensor(1.0, dtype=F64))
    assert found.valid.tolist() == [True, False]
    torch.testing.assert_close(
        found.model[0], torch.eye(3, 4, dtype=F64) + torch.tensor([[0.0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 2]])
    )


def test_what_is_no_cone_has_none_and_spoils_none(generator: torch.Generator) -> None:
    *_, radius, C = scenes(generator, 6)
    good = camera_circle(C, radius)
    bad, r = C.clone(), radius.clone()
    bad[1], bad[2], bad[3] = torch.nan, torch.eye(3), torch.diag(torch.tensor([1.0, 0, -1]))
    r[4] = -1
    found = camera_circle(bad, r)
    assert found.valid.any(-1).tolist() == [True, False, False, False, False, True]
    assert bool(found.model.isfinite().all())
    assert torch.equal(found.model[[0, 5]], good.model[[0, 5]])


def test_derivatives_are_those_of_the_solutions(generator: torch.Generator) -> None:
    *_, radius, C = scenes(generator, 3)
    assert torch.autograd.gradcheck(
        lambda C, r: camera_circle(0.5 * (C + C.mT), r).model, (C.requires_grad_(), radius.requires_grad_())
    )


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_batch_is_its_elements(shape: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator) -> None:
    *_, radius, C = scenes(generator, *shape)
    found = camera_circle(C.to(dtype), radius.to(dtype))
    assert found.model.shape == (*shape, 2, 3, 4)
    assert found.model.dtype == dtype
    flat = C.reshape(-1, 3, 3), radius.reshape(-1)
    for i, (c, r) in enumerate(zip(*flat, strict=True)):
        torch.testing.assert_close(camera_circle(c.to(dtype), r.to(dtype)).model, found.model.reshape(-1, 2, 3, 4)[i])
