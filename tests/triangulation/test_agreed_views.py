"""Whatever a robust search called inliers, what the answer is made of agrees with the answer."""

import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import point_line_distance, project_lines, reprojection_distance
from torchsfm.triangulation import triangulate_lines_robust, triangulate_points, triangulate_points_robust


def spoilt(x: Tensor, sigma: float, generator: torch.Generator) -> Tensor:
    """Noise not much less than a threshold of 2, and one view in five wrong."""
    wrong = torch.rand(x.shape[:3], generator=generator) < 0.2
    noise = sigma * torch.randn(x.shape, generator=generator, dtype=x.dtype)
    return x + torch.where(wrong.reshape(wrong.shape + (1,) * (x.ndim - 3)), 25, 1) * noise


def test_points_are_the_least_squares_of_views_that_agree(make_scene, generator):
    x, P, _ = make_scene(2, v=7, n=300)
    x = spoilt(x, 1.5, generator).requires_grad_()
    found = triangulate_points_robust(x, P, threshold=2.0, generator=generator)
    good = found.status == Status.OK
    distance = reprojection_distance(P, found.model[..., None, :, :], x)
    assert good.double().mean() > 0.5
    assert (distance <= 2.0)[found.inliers & good[:, None]].all()
    again = triangulate_points(x, P, visible=found.inliers)
    torch.testing.assert_close(found.model[good], again.model[good], rtol=1e-12, atol=1e-12)
    (slope,) = torch.autograd.grad(found.model[good].sum(), x, retain_graph=True)
    (wanted,) = torch.autograd.grad(again.model[good].sum(), x)
    torch.testing.assert_close(slope, wanted, rtol=1e-9, atol=1e-12)


def test_lines_are_the_least_squares_of_views_that_agree(make_scene, generator):
    x, P, _ = make_scene(2, v=7, n=600)
    l = spoilt(x.unflatten(-2, (300, 2)), 1.0, generator)  # noqa: E741
    found = triangulate_lines_robust(l, P, threshold=2.0, generator=generator)
    good = found.status == Status.OK
    image = project_lines(P, found.model[..., None, :, :])
    distance = point_line_distance(l, image[..., None, :]).norm(dim=-1)
    assert good.double().mean() > 0.5
    assert (distance <= 2.002)[found.inliers & good[:, None]].all()
