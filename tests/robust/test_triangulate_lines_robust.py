"""Robust triangulation of lines: wrong segments are found, ragged tracks are separate problems."""

import pytest
import torch
from chance import assert_share, seeded
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import (
    line_from_points,
    pluecker_from_points,
    point_line_distance,
    project_lines,
    project_points,
    rotation_from_rotvec,
)
from torchsfm.triangulation import LineFault, triangulate_lines, triangulate_lines_robust

F64 = torch.float64


def ring(v: int, n: int, wrong: float, generator: torch.Generator, noise: float = 0.5) -> tuple[Tensor, ...]:
    """Cameras around the middle, segments of lines there, of which some are anywhere in the image; |d| = 1."""
    kind = {"generator": generator, "dtype": F64}
    turn = torch.stack((torch.linspace(-0.5, 0.5, v).double().cos() - 0.8, torch.linspace(-0.7, 0.7, v).double()), -1)
    R = rotation_from_rotvec(torch.cat((turn, 0.1 * torch.randn(v, 1, **kind)), -1))
    K = torch.tensor([[800.0, 0, 500], [0, 800, 500], [0, 0, 1]], dtype=F64)
    P = K @ torch.cat((R, torch.tensor([0.0, 0, 6], dtype=F64).expand(v, 3)[..., None]), -1)
    ends = 2 * torch.rand(n, 2, 3, **kind) - 1
    ends[:, 1] = ends[:, 0] + torch.nn.functional.normalize(torch.randn(n, 3, **kind), dim=-1)
    at = torch.tensor([0.0, 1.0], dtype=F64) + 0.2 * torch.randn(v, n, 2, **kind)
    X = ends[:, :1] + at[..., None] * (ends[:, 1:] - ends[:, :1])
    l = project_points(P[:, None], X) + noise * torch.randn(v, n, 2, 2, **kind)  # noqa: E741
    bad = torch.rand(v, n, generator=generator) < wrong
    return torch.where(bad[..., None, None], 1000 * torch.rand(v, n, 2, 2, **kind), l), P, ends, bad


def truth(ends: Tensor) -> Tensor:
    return pluecker_from_points(ends[:, 0], ends[:, 1])


def test_wrong_segments_are_found(generator: torch.Generator) -> None:
    l, P, ends, bad = ring(10, 300, 0.3, generator)  # noqa: E741
    result = triangulate_lines_robust(l, P, threshold=2.5, generator=seeded())
    enough = (~bad).sum(0) >= 5
    assert_share(result.status[enough] == Status.OK, 0.98)
    good = enough & (result.status == Status.OK)
    assert (result.inliers == ~bad)[:, good].double().mean() > 0.98
    error = (result.model - truth(ends)).norm(dim=-1)[good]
    ideal = (triangulate_lines(l, P, visible=~bad).model - truth(ends)).norm(dim=-1)[good]
    assert error.median() < 1.1 * ideal.median()
    assert error.quantile(0.9) < 1.3 * ideal.quantile(0.9)


def test_clean_tracks_are_those_of_least_squares(generator: torch.Generator) -> None:
    l, P, _, _ = ring(6, 60, 0.0, generator, noise=0.2)  # noqa: E741
    result = triangulate_lines_robust(l, P, threshold=5.0, generator=seeded())
    plain = triangulate_lines(l, P)
    whole = result.inliers.all(0) & (result.status == Status.OK)
    assert_share(whole, 0.95)
    for name in ("model", "covariance", "end_covariance", "ends", "angle", "error"):
        torch.testing.assert_close(getattr(result, name)[whole], getattr(plain, name)[whole])


def test_scale_and_sign_of_cameras_and_world_do_not_matter(generator: torch.Generator) -> None:
    l, P, _, _ = ring(6, 40, 0.2, generator)  # noqa: E741
    plain = triangulate_lines_robust(l, P, threshold=2.5, generator=seeded())
    factor = torch.tensor([-2.0, 0.1, 5, -1, 1, 30], dtype=F64)[:, None, None]
    H = torch.eye(4, dtype=F64)
    H[:3, :3], H[:3, 3] = 0.01 * H[:3, :3], torch.tensor([300.0, -200.0, 50.0])
    for other in (P * factor, P @ torch.linalg.inv(H)):
        found = triangulate_lines_robust(l, other, threshold=2.5, generator=seeded())
        assert torch.equal(plain.inliers, found.inliers)
        assert torch.equal(plain.status, found.status)
        torch.testing.assert_close(plain.error, found.error, rtol=1e-5, atol=1e-7)


def test_ragged_tracks_with_cameras_of_their_own(generator: torch.Generator) -> None:
    """Lines as the batch: each gets the answer it gets alone."""
    l, P, _, _ = ring(9, 12, 0.2, generator)  # noqa: E741
    visible = torch.rand(9, 12, generator=generator) < 0.7
    plain = triangulate_lines_robust(l, P, threshold=2.5, visible=visible, generator=seeded())
    assert not (plain.inliers & ~visible).any()
    packed = triangulate_lines_robust(
        l.transpose(0, 1)[:, :, None], P.expand(12, 9, 3, 4), threshold=2.5, visible=visible.mT[..., None], generator=seeded()
    )
    for i in range(12):
        alone = triangulate_lines_robust(l[:, i : i + 1], P, threshold=2.5, visible=visible[:, i : i + 1], generator=seeded())
        for name in ("model", "inliers", "status", "error", "covariance"):
            a, b, c = (getattr(r, name) for r in (plain, packed, alone))
            axis = 1 if name == "inliers" else 0
            torch.testing.assert_close(a.select(axis, i), c.select(axis, 0), rtol=1e-8, atol=1e-10)
            torch.testing.assert_close(b[i].select(axis, 0), c.select(axis, 0), rtol=1e-8, atol=1e-10)


def test_two_views_and_fewer(generator: torch.Generator) -> None:
    l, P, ends, _ = ring(4, 30, 0.0, generator, noise=0.0)  # noqa: E741
    result = triangulate_lines_robust(l[::3], P[::3], threshold=1.0, generator=seeded())
    good = result.status == Status.OK
    assert_share(good, 0.8)
    torch.testing.assert_close(result.model[good], truth(ends)[good], rtol=1e-5, atol=1e-5)
    assert (triangulate_lines_robust(l[:1], P[:1], threshold=1.0).status == Status.TOO_FEW).all()
    same = triangulate_lines_robust(l[:1].expand(3, -1, -1, -1), P[:1].expand(3, 3, 4), threshold=1.0, generator=seeded())
    assert (same.status == Status.DEGENERATE).all()
    # Of three views that do not agree no two make a line, though their planes meet.
    wrong = l[:3].clone()
    wrong[2] += 40 * torch.randn(30, 1, 2, generator=generator, dtype=F64).sign()
    torn = triangulate_lines_robust(wrong, P[:3], threshold=1.0, generator=seeded())
    assert_share(torn.status != Status.OK, 0.9)


def test_lines_in_an_epipolar_plane_are_told(generator: torch.Generator) -> None:
    """Planes of sight that are one determine nothing, however many segments agree."""
    _, P, ends, _ = ring(5, 20, 0.0, generator)
    M, p = P[..., :3], P[..., 3:]
    centre = -torch.linalg.solve(M, p)[..., 0]
    P = P[:2]
    share = torch.rand(20, 1, generator=generator, dtype=F64)
    ends[:, 1] = ends[:, 0] + share * (centre[1] - centre[0])
    result = triangulate_lines_robust(project_points(P[:, None], ends.expand(2, 20, 2, 3)), P, threshold=1.0)
    assert (result.status != Status.OK).all()
    fault = result.fault[(result.status == Status.DEGENERATE) & result.inliers.all(0)]
    assert (fault == LineFault.EPIPOLAR_PLANE).all()


def test_no_line_through_the_one_centre_is_called_good(generator: torch.Generator) -> None:
    """All planes of sight of one centre pass through it, and so do the lines in which they meet."""
    kind = {"generator": generator, "dtype": F64}
    K = torch.tensor([[800.0, 0, 500], [0, 800, 500], [0, 0, 1]], dtype=F64)
    M = K @ rotation_from_rotvec(0.3 * torch.randn(4, 3, **kind))
    P = torch.cat((M, M @ torch.randn(3, 1, **kind)), -1)
    l = 1000 * torch.rand(4, 400, 2, 2, **kind)  # noqa: E741
    for views in (2, 3, 4):
        robust = triangulate_lines_robust(l[:views], P[:views], threshold=2.0, generator=seeded())
        assert (robust.status != Status.OK).all()
        assert (triangulate_lines(l[:views], P[:views]).status != Status.OK).all()


def test_units_of_image_coordinates_may_differ_by_far(generator: torch.Generator) -> None:
    """A camera that magnifies one coordinate beyond measure sees no segment where it is."""
    l, P, _, _ = ring(4, 40, 0.0, generator)  # noqa: E741
    P[2, 1:] *= torch.tensor([1e-105, 1e-108], dtype=F64)[:, None]
    result = triangulate_lines_robust(l, P, threshold=2.5, generator=seeded())
    assert not result.inliers[2].any()
    assert_share(result.status == Status.OK, 0.9)


def test_bad_observations_count_for_nothing(generator: torch.Generator) -> None:
    l, P, _, _ = ring(7, 20, 0.1, generator)  # noqa: E741
    absent = torch.zeros(7, 20, dtype=torch.bool)
    absent[2, ::3], absent[5, 1::3] = True, True
    plain = triangulate_lines_robust(l, P, threshold=2.5, visible=~absent, generator=seeded())
    spoiled = l.clone()
    spoiled[2, ::3, 0] = torch.nan
    spoiled[5, 1::3, 1, 1] = torch.inf
    found = triangulate_lines_robust(spoiled, P, threshold=2.5, generator=seeded())
    for name in ("model", "inliers", "status"):
        assert torch.equal(getattr(found, name), getattr(plain, name)), name
    spoiled[:, 4] = torch.nan
    ruined = triangulate_lines_robust(spoiled, P, threshold=2.5, generator=seeded())
    others = torch.arange(20) != 4
    assert ruined.status[4] == Status.NOT_FINITE
    assert ruined.model.isfinite().all()
    assert torch.equal(ruined.model[others], found.model[others])


def test_image_lines_without_ends(generator: torch.Generator) -> None:
    segments, P, ends, bad = ring(9, 60, 0.2, generator, noise=0.2)
    l = -7 * line_from_points(segments[..., 0, :], segments[..., 1, :])  # noqa: E741
    result = triangulate_lines_robust(l, P, threshold=15.0, generator=seeded())
    good = (result.status == Status.OK) & ((~bad).sum(0) >= 5)
    assert_share(good[(~bad).sum(0) >= 5], 0.95)
    L = truth(ends)[good]
    gap = torch.minimum((result.model[good] - L).norm(dim=-1), (result.model[good] + L).norm(dim=-1))
    assert gap.median() < 0.05


def test_derivatives_are_those_of_the_inliers(generator: torch.Generator) -> None:
    l, P, _, _ = ring(6, 5, 0.1, generator)  # noqa: E741
    leaves = [t.clone().requires_grad_() for t in (l, P)]
    result = triangulate_lines_robust(*leaves, threshold=2.5, generator=seeded())
    good = result.status == Status.OK
    weights = torch.randn(5, 6, generator=generator, dtype=F64) * good[:, None]
    grads = torch.autograd.grad((result.model * weights).sum(), leaves)
    plain = triangulate_lines(*leaves, visible=result.inliers)
    expected = torch.autograd.grad((plain.model * weights).sum(), leaves)
    for a, b in zip(grads, expected, strict=True):
        assert a.isfinite().all()
        torch.testing.assert_close(a, b)


@pytest.mark.usefixtures("unchecked")
def test_wrong_arguments(generator: torch.Generator) -> None:
    l, P, _, _ = ring(4, 9, 0.0, generator)  # noqa: E741
    for arguments, options, name in (
        ((l, P[:3]), {}, "P: wanted|l: wanted"), ((l[..., 0], P), {}, "l: wanted"),
        ((l, P), {"visible": torch.ones(4, 8, dtype=torch.bool)}, "visible: wanted"),
        ((l, P), {"threshold": -1.0}, "threshold"), ((l, P), {"weights": torch.ones(9, dtype=F64)}, "weights"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=name):
            triangulate_lines_robust(*arguments, **{"threshold": 1.0} | options)


def test_lines_that_single_precision_does_not_hold(generator: torch.Generator) -> None:
    """A million units from the origin, where numbers are a sixteenth of a unit apart."""
    l, P, _, _ = ring(6, 50, 0.0, generator)  # noqa: E741
    P = torch.cat((P[..., :3], P[..., 3:] - 1e6 * P[..., :3].sum(-1, keepdim=True)), -1)
    found = triangulate_lines_robust(l.float(), P.float(), threshold=2.5, generator=seeded())
    image = project_lines(P.float().double(), found.model.double()[None])
    off = point_line_distance(l, image[..., None, :]).amax(-1)
    assert not ((found.status == Status.OK) & found.inliers & (off > 2.1 * 2.5)).any()
    assert_share(triangulate_lines_robust(l, P, threshold=2.5, generator=seeded()).status == Status.OK, 0.98)
