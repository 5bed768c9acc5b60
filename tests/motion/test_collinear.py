"""Points on a line in an image leave the geometry of views open, and are said to."""

import pytest
import torch
from torch import Tensor

from torchsfm import Degeneracy
from torchsfm._types import Status
from torchsfm.motion import estimate_fundamental, estimate_fundamentals, estimate_homographies, estimate_trifocal
from torchsfm.simulation import random_poses

F64 = torch.float64


def on_lines(batch: int, views: int, n: int, noise: float, generator: torch.Generator) -> Tensor:
    """Points anywhere on a line of each image, (batch, view, n, 2): any two lines may be epipolar lines of each other."""
    ends = 1000 * torch.rand(batch, views, 2, 2, generator=generator, dtype=F64)
    along = torch.rand(batch, views, n, 1, generator=generator, dtype=F64)
    x = ends[..., :1, :] + along * (ends[..., 1:, :] - ends[..., :1, :])
    return x + noise * torch.randn(x.shape, generator=generator, dtype=F64)


def images(batch: int, views: int, n: int, generator: torch.Generator) -> Tensor:
    """A scene in general, (batch, view, n, 2), with noise."""
    X = torch.rand(batch, n, 3, generator=generator, dtype=F64) * 4 - 2
    poses = random_poses(batch, views, generator=generator, dtype=F64)
    Y = X[:, None] @ poses.R.mT + poses.t[..., None, :]
    x = 800 * Y[..., :2] / Y[..., 2:] + 500
    return x + 0.5 * torch.randn(x.shape, generator=generator, dtype=F64)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_fundamental_matrices_of_lines(noise: float, dtype: torch.dtype, generator: torch.Generator) -> None:
    x1, x2 = on_lines(20, 2, 40, noise, generator).to(dtype).unbind(1)
    found = estimate_fundamental(x1, x2, threshold=2.0, max_iterations=64, generator=generator)
    assert (found.degeneracy == Degeneracy.COLLINEAR).all()


def test_a_line_in_one_image_will_do(generator: torch.Generator) -> None:
    lines, scene = on_lines(20, 2, 40, 0.3, generator), images(20, 3, 40, generator)
    # A plane through the first camera's centre: any points of the second image agree.
    found = estimate_fundamental(scene[:, 0], lines[:, 1], threshold=2.0, max_iterations=64, generator=generator)
    good = found.status == Status.OK
    assert (found.degeneracy[good] != Degeneracy.NONE).all()


def test_three_views_of_lines(generator: torch.Generator) -> None:
    x = on_lines(6, 3, 30, 0.0, generator)
    x = x[:, :1, :1] + (x[:, :, :1] - x[:, :, 1:2]) * torch.rand(6, 1, 30, 1, generator=generator, dtype=F64)
    x = x + 0.3 * torch.randn(x.shape, generator=generator, dtype=F64)
    found = estimate_trifocal(x, threshold=2.0, max_iterations=64, generator=generator)
    good = found.status == Status.OK
    assert (found.degeneracy[good] == Degeneracy.COLLINEAR).all()


def test_general_scenes_are_not_lines(generator: torch.Generator) -> None:
    x = images(20, 3, 40, generator)
    pair = estimate_fundamental(x[:, 0], x[:, 1], threshold=2.0, max_iterations=256, generator=generator)
    assert (pair.degeneracy != Degeneracy.COLLINEAR).all()
    triplet = estimate_trifocal(x, threshold=3.0, max_iterations=64, generator=generator)
    assert (triplet.degeneracy != Degeneracy.COLLINEAR).all()


def test_lines_are_no_structures(generator: torch.Generator) -> None:
    x1, x2 = on_lines(4, 2, 40, 0.3, generator).unbind(1)
    bodies = estimate_fundamentals(x1, x2, threshold=2.0, slots=2, generator=generator)
    planes = estimate_homographies(x1, x1 + 5, threshold=2.0, slots=2, generator=generator)
    for found in (bodies, planes):
        assert not found.valid.any()
        assert (found.label == -1).all()
        assert (found.found == 0).all()
        assert (found.status == Status.NO_CONSENSUS).all()
