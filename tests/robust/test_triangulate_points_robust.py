"""Robust triangulation: wrong observations are found, ragged tracks are separate problems."""

import pytest
import torch
from chance import assert_share, seeded
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import project_points, rotation_from_rotvec
from torchsfm.triangulation import triangulate_points, triangulate_points_robust


def ring(v: int, n: int, wrong: float, generator: torch.Generator) -> tuple[Tensor, ...]:
    """Cameras on an arc, points in the middle, some observations anywhere in the image."""
    kind = {"generator": generator, "dtype": torch.float64}
    angle = torch.linspace(-0.7, 0.7, v, dtype=torch.float64)
    zero = torch.zeros_like(angle)
    R = rotation_from_rotvec(torch.stack((zero, angle, zero), -1))
    K = torch.tensor([[800.0, 0, 500], [0, 800, 500], [0, 0, 1]], dtype=torch.float64)
    P = K @ torch.cat((R, torch.stack((zero, zero, 6 + zero), -1)[..., None]), -1)
    X = torch.rand(n, 3, **kind) * 2 - 1
    x = project_points(P, X.expand(v, n, 3)) + 0.5 * torch.randn(v, n, 2, **kind)
    bad = torch.rand(v, n, generator=generator) < wrong
    return torch.where(bad[..., None], torch.rand(v, n, 2, **kind) * 1000, x), P, X, bad


def test_wrong_observations_are_found(generator: torch.Generator) -> None:
    x, P, X, bad = ring(10, 300, 0.3, generator)
    result = triangulate_points_robust(x, P, threshold=2.5, generator=seeded())
    enough = (~bad).sum(0) >= 4
    assert (result.status[enough] == Status.OK).all()
    assert ((result.inliers == ~bad)[:, enough].double().mean()) > 0.98
    error = (result.model - X).norm(dim=-1)[enough]
    ideal = (triangulate_points(x, P, visible=~bad).model - X).norm(dim=-1)[enough]
    assert error.median() < 1.1 * ideal.median()
    assert error.quantile(0.98) < 1.5 * ideal.quantile(0.98)


def test_clean_tracks_are_those_of_least_squares(generator: torch.Generator) -> None:
    x, P, _, _ = ring(5, 50, 0.0, generator)
    result = triangulate_points_robust(x, P, threshold=5.0, generator=seeded())
    assert result.inliers.all()
    plain = triangulate_points(x, P)
    for name in ("model", "covariance", "parallax", "error"):
        torch.testing.assert_close(getattr(result, name), getattr(plain, name))
    # The noise is half a pixel, and three of the ten coordinates of a point are spent on it.
    assert abs((result.error.square().mean() * 10 / 7 / 2).sqrt() - 0.5) < 0.05


def test_scale_and_sign_of_cameras_do_not_matter(generator: torch.Generator) -> None:
    x, P, _, _ = ring(6, 40, 0.2, generator)
    plain = triangulate_points_robust(x, P, threshold=2.5, generator=seeded())
    factor = torch.tensor([-2.0, 0.1, 5, -1, 1, 30], dtype=torch.float64)[:, None, None]
    other = triangulate_points_robust(x, P * factor, threshold=2.5, generator=seeded())
    assert torch.equal(plain.inliers, other.inliers)
    torch.testing.assert_close(plain.model, other.model)


def test_ragged_tracks_with_cameras_of_their_own(generator: torch.Generator) -> None:
    """Points as the batch: each gets the answer it gets alone."""
    x, P, _, _ = ring(8, 12, 0.2, generator)
    visible = torch.rand(8, 12, generator=generator) < 0.8
    visible[:, 0] = False
    visible[1:, 1] = False
    visible[2:, 2] = False
    visible[:2, 2] = True
    xs, Ps, seen = x.transpose(0, 1)[:, :, None], P.expand(12, 8, 3, 4), visible.mT[..., None]
    packed = triangulate_points_robust(xs, Ps, threshold=2.5, visible=seen, generator=seeded())
    plain = triangulate_points_robust(x, P, threshold=2.5, visible=visible, generator=seeded())
    assert packed.inliers.shape == (12, 8, 1)
    assert torch.equal(packed.inliers[..., 0].mT, plain.inliers)
    assert torch.equal(packed.status[:, 0], plain.status)
    torch.testing.assert_close(packed.model[:, 0], plain.model)
    assert plain.status[:2].tolist() == [Status.TOO_FEW] * 2
    assert not (plain.inliers & ~visible).any()
    for i in range(2, 12):
        alone = triangulate_points_robust(x[:, i : i + 1], P, threshold=2.5, visible=visible[:, i : i + 1], generator=seeded())
        assert torch.equal(alone.inliers[:, 0], plain.inliers[:, i])


def test_bad_values_stay_where_they_are(generator: torch.Generator) -> None:
    x, P, X, _ = ring(6, 20, 0.0, generator)
    x[:, 3] = torch.nan
    x[2, 5] = torch.inf
    x[1, 7, 0] = torch.nan
    result = triangulate_points_robust(x, P, threshold=2.5, generator=seeded())
    assert result.status[3] == Status.NOT_FINITE
    assert torch.isfinite(result.model).all()
    rest = torch.arange(20) != 3
    assert (result.status[rest] == Status.OK).all()
    assert ((result.model - X).norm(dim=-1)[rest] < 0.1).all()
    assert not result.inliers[2, 5]


def test_one_camera_alone_is_degenerate(generator: torch.Generator) -> None:
    x, P, _, _ = ring(2, 10, 0.0, generator)
    result = triangulate_points_robust(x[:1].expand(2, 10, 2), P[:1].expand(2, 3, 4), threshold=2.5, generator=seeded())
    assert (result.status == Status.DEGENERATE).all()


def test_nonsense_has_no_consensus(generator: torch.Generator) -> None:
    x, P, _, _ = ring(6, 60, 1.0, generator)
    result = triangulate_points_robust(x, P, threshold=2.5, generator=seeded())
    assert_share(result.status == Status.NO_CONSENSUS, 0.9)
    lost = result.status != Status.OK
    for value in (result.covariance, result.parallax, result.error):
        assert (value[lost] == 0).all()


@pytest.mark.usefixtures("unchecked")
def test_wrong_shapes_raise() -> None:
    x, P = torch.rand(4, 10, 2), torch.rand(4, 3, 4)
    with pytest.raises(ValueError, match="P"):
        triangulate_points_robust(x, P[:3], threshold=1.0)
    with pytest.raises(ValueError, match="visible"):
        triangulate_points_robust(x, P, threshold=1.0, visible=torch.ones(4, 9, dtype=torch.bool))
