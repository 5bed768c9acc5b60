import math

import pytest
import torch
from chance import assert_share
from torch import Tensor

from bench.cases.resection import coplanar_conics
from torchsfm import Ellipse, Status
from torchsfm.geometry import conic_from_ellipse, dual_conic, rotation_angle, transform_conic
from torchsfm.geometry.conics import shape_of_dual_conic
from torchsfm.resection import camera_circle, camera_conics
from torchsfm.resection.ellipse_poses import ellipse_poses

F64 = torch.float64


def shape(C: Tensor) -> tuple[Tensor, Tensor]:
    return shape_of_dual_conic(dual_conic(C))[:2]


@pytest.mark.parametrize(("family", "exact"), [("random", 1e-8), ("narrow view", 1e-8), ("circles", 1e-3)])
def test_the_ellipse_looks_right_from_all_and_one_is_near_the_true_pose(
    family: str, exact: float, generator: torch.Generator
) -> None:
    """A circle, which has a turn more, is taken for an ellipse that is round to one in ten thousand."""
    (C, drawn), P = coplanar_conics(family, 300, generator, F64)
    seen, known = C[:, 0], drawn[:, 0]
    R, t = ellipse_poses(*shape(seen), *shape(known))
    torch.testing.assert_close(R.mT @ R, torch.eye(3, dtype=F64).expand_as(R))
    assert bool((torch.linalg.det(R) > 0).all())
    H = torch.cat((R[..., :2], t[..., None]), -1)
    centre, D = shape(transform_conic(H, known[:, None, None, None]))
    wanted, D_wanted = (v[:, None, None, None] for v in shape(seen))
    size = D_wanted.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None]
    torch.testing.assert_close(centre / size.sqrt(), (wanted / size.sqrt()).expand_as(centre), rtol=0, atol=exact)
    torch.testing.assert_close(D / size[..., None], (D_wanted / size[..., None]).expand_as(D), rtol=0, atol=exact)
    off = rotation_angle(R.flatten(1, 3) @ P[:, None, :, :3].mT).amin(-1)
    assert float(off.max()) < math.radians(6)


def test_circles_lean_as_their_closed_form_says(generator: torch.Generator) -> None:
    (C, drawn), _ = coplanar_conics("circles", 100, generator, F64)
    centre, D = shape(drawn[:, 0])
    R, t = ellipse_poses(*shape(C[:, 0]), torch.zeros_like(centre), D)
    normal = R[..., 2] * (R[..., 2] * t).sum(-1, keepdim=True).sign()
    right = camera_circle(C[:, 0], D[:, 0, 0].sqrt()).model[..., 2]
    gap = (normal.flatten(1, 3)[:, :, None] - right[:, None]).norm(dim=-1).amin(-1)
    assert float(gap.max()) < math.radians(1.5)


def concentric(batch: int, kind: str, apart: float, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Two ellipses that are nearly one, larger and smaller: what tells their poses apart is small."""

    def uniform(*size: int) -> Tensor:
        return torch.rand(*size, generator=generator, dtype=F64)

    _, P = coplanar_conics("random", batch, generator, F64)
    axes = 0.2 + 0.8 * uniform(batch, 1, 2)
    inner = axes * (0.3 + 0.6 * uniform(batch, 1, 1))
    if kind == "of other shape":
        inner = inner * (1 + apart * (2 * uniform(batch, 1, 2) - 1))
    angle = 3 * uniform(batch, 1).expand(batch, 2)
    if kind == "turned":
        angle = angle + torch.cat((torch.zeros(batch, 1, dtype=F64), apart * (2 * uniform(batch, 1) - 1)), 1)
    centre = torch.randn(batch, 1, 2, generator=generator, dtype=F64).expand(batch, 2, 2)
    if kind == "shifted":
        centre = centre + apart * torch.randn(batch, 2, 2, generator=generator, dtype=F64)
    drawn = conic_from_ellipse(Ellipse(centre, torch.cat((axes, inner), 1), angle))
    return transform_conic(P[:, None][..., [0, 1, 3]], drawn), drawn, P


@pytest.mark.parametrize("apart", [0.3, 0.01])
@pytest.mark.parametrize("kind", ["of other shape", "turned", "shifted"])
def test_no_pose_of_ellipses_about_nearly_one_centre_is_missed(kind: str, apart: float, generator: torch.Generator) -> None:
    C, drawn, P = concentric(150, kind, apart, generator)
    found = camera_conics(C, drawn)
    near = (found.model - P[:, None]).abs().amax((-2, -1)) < 1e-4
    assert_share(found.status == Status.OK, 0.999)
    assert bool((near & found.valid).any(-1)[found.status == Status.OK].all())
