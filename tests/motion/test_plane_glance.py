"""A glance at a few points must not clear scenes with a plane, and should clear most of those without."""

import pytest
import torch
from chance import assert_share
from torch import Tensor

from torchsfm.geometry import rotation_from_rotvec
from torchsfm.motion.two_views.epipolar_fit import cross_rows
from torchsfm.motion.two_views.plane_glance import plane_suspected
from torchsfm.robust.degeneracy import GLANCE

F64 = torch.float64


def scene(p: int, plane: float, generator: torch.Generator, baseline: float = 1.0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rotation, translation, and points in both images with noise of 1 / 800, a part of them in a plane."""
    kind = {"generator": generator, "dtype": F64}
    X = torch.rand(p, 3, GLANCE, **kind) * 4 - 2
    X[:, 2] += 6
    n = torch.nn.functional.normalize(torch.randn(p, 3, **kind) * 0.3 + torch.tensor([0.0, 0, 1]), dim=-1)
    flat = X * (6 / (n[:, None] @ X))
    X = torch.where(torch.rand(p, 1, GLANCE, generator=generator) < plane, flat, X)
    R = rotation_from_rotvec((torch.rand(p, 3, **kind) - 0.5) * 0.6)
    t = torch.nn.functional.normalize(torch.randn(p, 3, **kind), dim=-1)
    h = []
    for Y in (X, R @ X + baseline * t[..., None]):
        y = Y / Y[:, 2:]
        y[:, :2] += torch.randn(p, 2, GLANCE, **kind) / 800
        h.append(y)
    return R, t, h[0], h[1]


def suspected(
    R: Tensor, t: Tensor, h1: Tensor, h2: Tensor, noises: float, inliers: Tensor | None = None, how: str = "pose"
) -> Tensor:
    limit = torch.full((len(R),), 4 * (noises / 800) ** 2, dtype=F64)
    inliers = torch.ones(h1.shape[0], h1.shape[2], dtype=torch.bool) if inliers is None else inliers
    A = R
    if how == "pose":
        h1, h2 = (h / h.norm(dim=1, keepdim=True) for h in (h1, h2))
    else:
        A = cross_rows(t, cross_rows(t, R))
    return plane_suspected(A, t, h1, h2, inliers, limit, torch.full_like(limit, 4.0))


@pytest.mark.parametrize("how", ["pose", "fundamental"])
@pytest.mark.parametrize("noises", [2.0, 3.0])
def test_planes_are_suspected(how: str, noises: float, generator: torch.Generator) -> None:
    for plane, least in ((0.5, 0.95), (0.65, 0.995), (1.0, 1.0)):
        case = scene(400, plane, generator)
        assert suspected(*case, noises, how=how).double().mean() >= least
        # Among half as many wrong ones, which are no inliers.
        wrong = torch.rand(400, GLANCE, generator=generator) < 0.5
        case[3][:, :2] = torch.where(wrong[:, None], torch.rand(400, 2, GLANCE, generator=generator, dtype=F64), case[3][:, :2])
        assert suspected(*case, noises, ~wrong, how=how).double().mean() >= least - 0.03


@pytest.mark.parametrize("how", ["pose", "fundamental"])
def test_most_scenes_without_a_plane_are_cleared(how: str, generator: torch.Generator) -> None:
    case = scene(400, 0.0, generator)
    assert_share(~suspected(*case, 1.0, how=how), 0.95)
    assert_share(~suspected(*case, 2.0, how=how), 0.85)


def test_rotations_are_suspected(generator: torch.Generator) -> None:
    """Without parallax, the plane at infinity holds all points, whatever the translation is said to be."""
    R, _, h1, h2 = scene(400, 0.0, generator, baseline=0.0)
    t = torch.nn.functional.normalize(torch.randn(400, 3, generator=generator, dtype=F64), dim=-1)
    assert suspected(R, t, h1, h2, 2.0).all()


def test_a_few_points_clear_nothing(generator: torch.Generator) -> None:
    case = scene(50, 0.0, generator)
    for number in range(6):
        few = (torch.rand(50, GLANCE, generator=generator).argsort(dim=-1)) < number
        assert suspected(*case, 2.0, few).all()
    short = [*case[:2], *(h[..., :4] for h in case[2:])]
    assert suspected(*short, 2.0).all()


def test_points_at_the_epipole_and_in_one_place_prove_nothing(generator: torch.Generator) -> None:
    R, t, h1, h2 = scene(50, 0.0, generator)
    good = suspected(R, t, h1, h2, 2.0)
    assert not good.all()
    h2[:10, :, ::2] = t[:10, :, None]
    h1[10:20] = h1[10:20, :, :1]
    h2[10:20] = h2[10:20, :, :1]
    bad = suspected(R, t, h1, h2, 2.0)
    assert bad[:20].all()
    assert torch.equal(bad[20:], good[20:])
    assert torch.equal(suspected(R[7:9], t[7:9], h1[7:9], h2[7:9], 2.0), bad[7:9])
