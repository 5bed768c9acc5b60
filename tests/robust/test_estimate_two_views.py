"""The doors for F, E and H: accuracy, units, ragged batches, real pairs and other programs."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from chance import seeded
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import rotation_angle, rotation_from_rotvec, sampson_distance
from torchsfm.motion import HomographyEstimator, estimate_essential, estimate_fundamental, estimate_homography
from torchsfm.robust import constant_weights
from torchsfm.tensors import essential_from_fundamental, essential_from_pose, pose_from_essential

FOCAL, CENTRE = 800.0, 500.0
K = torch.tensor([[FOCAL, 0, CENTRE], [0, FOCAL, CENTRE], [0, 0, 1]], dtype=torch.float64)


def pixels(X: Tensor) -> Tensor:
    return X[..., :2] / X[..., 2:] * FOCAL + CENTRE


def rays(x: Tensor) -> Tensor:
    return torch.cat(((x - CENTRE) / FOCAL, torch.ones_like(x[..., :1])), -1)


def pairs(
    p: int, n: int, inliers: float, generator: torch.Generator, plane: bool = False, noise: float = 0.5
) -> tuple[Tensor, ...]:
    """Image points x1, x2, which of them are wrong, and R, t and the normal of the plane over its distance."""
    kind = {"generator": generator, "dtype": torch.float64}
    X = torch.rand(p, n, 3, **kind) * 4 - 2 + torch.tensor([0.0, 0, 6])
    R = rotation_from_rotvec((torch.rand(p, 3, **kind) - 0.5) * 0.6)
    t = torch.randn(p, 3, **kind)
    t = t / t.norm(dim=-1, keepdim=True)
    normal = torch.randn(p, 3, **kind) * 0.2 + torch.tensor([0.0, 0, 1])
    normal = normal / normal.norm(dim=-1, keepdim=True) / 6
    if plane:
        X = X / (X @ normal[..., None])
    x1 = pixels(X) + noise * torch.randn(p, n, 2, **kind)
    x2 = pixels(X @ R.mT + t[:, None]) + noise * torch.randn(p, n, 2, **kind)
    wrong = torch.rand(p, n, generator=generator) > inliers
    x2 = torch.where(wrong[..., None], torch.rand(p, n, 2, **kind) * 1000, x2)
    return x1, x2, wrong, R, t, normal


def pose_error(E: Tensor, x1: Tensor, x2: Tensor, wrong: Tensor, R: Tensor, t: Tensor) -> Tensor:
    """The larger of the errors of rotation and of the direction of translation, in degrees."""
    pose = pose_from_essential(E, rays(x1), rays(x2), (~wrong).double()).model
    turn = rotation_angle(pose[..., :3] @ R.mT)
    aside = torch.arccos((pose[..., 3] * t).sum(-1).clamp(-1, 1))
    return torch.rad2deg(torch.maximum(turn, aside))


def transfer_error(H: Tensor, R: Tensor, t: Tensor, normal: Tensor) -> Tensor:
    """Largest distance in pixels between the images of a grid of points under H and under the truth."""
    truth = K @ (R + t[..., :, None] * normal[..., None, :]) @ K.inverse()
    side = torch.linspace(0, 1000, 7, dtype=torch.float64)
    grid = torch.stack((*torch.meshgrid(side, side, indexing="ij"), torch.ones(7, 7)), -1).reshape(-1, 3)
    images = [(h := grid @ M.mT)[..., :2] / h[..., 2:] for M in (H, truth)]
    return (images[0] - images[1]).norm(dim=-1).amax(-1)


def test_fundamental_is_right(generator: torch.Generator) -> None:
    x1, x2, wrong, R, t, _ = pairs(32, 300, 0.6, generator)
    result = estimate_fundamental(x1, x2, threshold=1.5, generator=seeded())
    F = result.model
    assert (result.status == Status.OK).all()
    torch.testing.assert_close(F.flatten(-2).norm(dim=-1), torch.ones(32, dtype=torch.float64))
    assert (torch.linalg.det(K.mT @ F @ K).abs() < 1e-12 * (K.mT @ F @ K).flatten(-2).norm(dim=-1) ** 3).all()
    error = pose_error(essential_from_fundamental(F, K, K), x1, x2, wrong, R, t)
    assert error.median() < 0.8
    assert error.quantile(0.9) < 3
    assert (result.inliers & wrong).sum() < 0.03 * wrong.sum()
    distance = sampson_distance(F, x1, x2)
    assert (distance[result.inliers] < 1.5).all()


def test_essential_is_right(generator: torch.Generator) -> None:
    x1, x2, wrong, R, t, _ = pairs(24, 300, 0.5, generator)
    scale = torch.rand(24, 300, 1, generator=generator, dtype=torch.float64) + 0.5
    result = estimate_essential(rays(x1) * scale, rays(x2), threshold=1.5 / FOCAL, generator=seeded())
    assert (result.status == Status.OK).all()
    values = torch.linalg.svdvals(result.model)
    torch.testing.assert_close(values, torch.tensor([1.0, 1, 0], dtype=torch.float64).expand(24, 3), atol=1e-9, rtol=0)
    error = pose_error(result.model, x1, x2, wrong, R, t)
    assert error.median() < 0.4
    assert error.max() < 4
    assert ((result.inliers & ~wrong).sum(-1) > 0.9 * (~wrong).sum(-1)).all()
    # Cheirality: wrong matches on their epipolar line but behind a camera are no inliers, however few there may be.
    pose = pose_from_essential(result.model, rays(x1), rays(x2), result.inliers).pose
    d1, d2 = (torch.nn.functional.normalize(d, dim=-1) for d in (rays(x1) @ pose.R.mT, rays(x2)))
    cosine, (along1, along2) = (d1 * d2).sum(-1), ((d @ pose.t[..., None])[..., 0] for d in (d1, d2))
    ahead = torch.minimum(along2 * cosine - along1, along2 - along1 * cosine)
    assert (ahead[result.inliers] > -1.5 / FOCAL - 1e-9).all()


def test_homography_is_right(generator: torch.Generator) -> None:
    x1, x2, wrong, R, t, normal = pairs(32, 200, 0.5, generator, plane=True)
    result = estimate_homography(x1, x2, threshold=1.5, generator=seeded())
    assert (result.status == Status.OK).all()
    error = transfer_error(result.model, R, t, normal)
    assert error.median() < 2
    assert error.max() < 8
    assert ((result.inliers == ~wrong).double().mean(-1) > 0.97).all()


def test_homography_refinement_reaches_the_bound(generator: torch.Generator) -> None:
    """The error is that of the optimum over the true inliers alone, whether the threshold is two or five times the noise."""
    x1, x2, wrong, R, t, normal = pairs(100, 200, 0.6, generator, plane=True)
    T = torch.tensor([[1 / 500, 0, -1], [0, 1 / 500, -1], [0, 0, 1]], dtype=torch.float64)
    y1, y2 = (x1 - 500) / 500, (x2 - 500) / 500
    H = T @ K @ (R + t[..., :, None] * normal[..., None, :]) @ K.inverse() @ T.inverse()
    H = H / H.flatten(-2).norm(dim=-1)[:, None, None]
    for _ in range(4):
        H = HomographyEstimator().step(H, y1, y2, weigh=constant_weights((~wrong).double()))
    ideal = transfer_error(T.inverse() @ H @ T, R, t, normal)
    for threshold in (1.0, 2.5):
        found = estimate_homography(x1, x2, threshold=threshold, generator=seeded()).model
        ratio = transfer_error(found, R, t, normal) / ideal
        assert ratio.log().mean().exp() < 1.1


def test_essential_refinement_nears_the_bound(generator: torch.Generator) -> None:
    x1, x2, wrong, R, t, _ = pairs(100, 200, 0.8, generator)
    best = estimate_essential(rays(x1), rays(x2), threshold=3 / FOCAL, mask=~wrong, generator=seeded()).model
    ideal = pose_error(best, x1, x2, wrong, R, t)
    found = estimate_essential(rays(x1), rays(x2), threshold=1.5 / FOCAL, generator=seeded()).model
    ratio = pose_error(found, x1, x2, wrong, R, t).clamp(min=1e-4) / ideal.clamp(min=1e-4)
    assert ratio.log().mean().exp() < 1.25


DOORS: dict[str, Any] = {
    "fundamental": lambda x1, x2, s=1.0, **o: estimate_fundamental(x1, x2, threshold=1.5 * s, **o),
    "homography": lambda x1, x2, s=1.0, **o: estimate_homography(x1, x2, threshold=1.5 * s, **o),
    "essential": lambda x1, x2, s=1.0, **o: estimate_essential(
        torch.cat((x1 / s - CENTRE, torch.full_like(x1[..., :1], FOCAL)), -1),
        torch.cat((x2 / s - CENTRE, torch.full_like(x2[..., :1], FOCAL)), -1),
        threshold=1.5 / FOCAL,
        **o,
    ),
}


@pytest.mark.parametrize("door", ["fundamental", "homography"])
def test_the_unit_does_not_matter(door: str, generator: torch.Generator) -> None:
    x1, x2, *_ = pairs(8, 200, 0.6, generator, plane=door == "homography")
    plain = DOORS[door](x1, x2, generator=seeded())
    for scale in (1000.0, 1e-3):
        scaled = DOORS[door](x1 * scale, x2 * scale, scale, generator=seeded())
        assert torch.equal(plain.inliers, scaled.inliers)
        S = torch.diag(torch.tensor([scale, scale, 1.0], dtype=torch.float64))
        back = S @ scaled.model @ S if door == "fundamental" else S.inverse() @ scaled.model @ S
        back = back / back.flatten(-2).norm(dim=-1)[:, None, None]
        difference = torch.minimum((back - plain.model).abs().amax((-2, -1)), (back + plain.model).abs().amax((-2, -1)))
        assert (difference < 1e-6).all()


@pytest.mark.parametrize("door", DOORS)
def test_float32_and_thresholds_per_pair(door: str, generator: torch.Generator) -> None:
    x1, x2, wrong, *_ = pairs(6, 200, 0.7, generator, plane=door == "homography")
    s = torch.linspace(0.7, 2, 6)
    result = (
        estimate_essential(rays(x1).float(), rays(x2).float(), threshold=1.5 * s / FOCAL, generator=seeded())
        if door == "essential"
        else DOORS[door](x1.float(), x2.float(), s, generator=seeded())
    )
    assert result.model.dtype == torch.float32
    assert (result.status == Status.OK).all()
    kept = (result.inliers & ~wrong).double().sum(-1) / (~wrong).sum(-1)
    assert (kept > 0.8).all()
    assert kept[0] < kept[-1]


@pytest.mark.parametrize("door", DOORS)
def test_ragged_extremes_in_one_batch(door: str, generator: torch.Generator) -> None:
    """0, 1, 4, 7, 50 and 2000 points, wrong ones alone, coinciding ones, NaN rows: each as if it were alone."""
    x1, x2, *_ = pairs(9, 2000, 0.6, generator, plane=door == "homography")
    count = torch.tensor([0, 1, 4, 7, 50, 2000, 500, 500, 500])
    mask = torch.arange(2000) < count[:, None]
    x2[6] = torch.rand(2000, 2, generator=generator, dtype=torch.float64) * 1000
    x1[7], x2[7] = x1[7, :1], x2[7, :1]
    x1[8, ::3] = torch.nan
    x2[8, 1::3, 1] = torch.inf
    # What lies outside the mask must not matter, not even where it is no number.
    x1 = torch.where(mask[..., None], x1, torch.nan)
    before = x1.clone(), x2.clone(), mask.clone()
    result = DOORS[door](x1, x2, mask=mask, generator=seeded(), max_iterations=4000)
    assert torch.equal(x1.nan_to_num(), before[0].nan_to_num())
    assert torch.equal(x2.nan_to_num(), before[1].nan_to_num())
    assert torch.equal(mask, before[2])
    status = result.status.tolist()
    assert status[:2] == [Status.TOO_FEW] * 2
    assert status[4:6] == [Status.OK] * 2
    assert status[6] == Status.NO_CONSENSUS
    assert status[7] == Status.DEGENERATE
    assert status[8] == Status.OK
    assert torch.isfinite(result.model).all()
    assert not (result.inliers & ~mask).any()
    assert not result.inliers[8, ::3].any()
    assert not result.inliers[8, 1::3].any()
    for i in range(9):
        n = int(count[i])
        alone = DOORS[door](x1[i, :n], x2[i, :n], generator=seeded(), max_iterations=4000)
        assert alone.status == result.status[i]
        assert torch.equal(alone.inliers, result.inliers[i, :n])
        torch.testing.assert_close(alone.model, result.model[i], rtol=1e-9, atol=1e-12)


def test_points_of_a_plane_leave_fundamental_no_better_than_homography(generator: torch.Generator) -> None:
    x1, x2, *_ = pairs(6, 300, 0.7, generator, plane=True)
    F = estimate_fundamental(x1, x2, threshold=1.5, generator=seeded())
    H = estimate_homography(x1, x2, threshold=1.5, generator=seeded())
    assert (H.inliers.sum(-1) > 0.85 * F.inliers.sum(-1)).all()
    assert torch.isfinite(F.model).all()


def test_scores_are_accepted_everywhere(generator: torch.Generator) -> None:
    x1, x2, wrong, *_ = pairs(4, 400, 0.25, generator)
    trust = (~wrong).double() + 0.3 * torch.randn(4, 400, generator=generator)
    for door in ("fundamental", "essential"):
        blind = DOORS[door](x1, x2, generator=seeded(), max_iterations=128)
        guided = DOORS[door](x1, x2, generator=seeded(), max_iterations=128, quality=trust)
        assert guided.inliers.sum() > blind.inliers.sum()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("door", [estimate_fundamental, estimate_homography, estimate_essential])
def test_wrong_shapes_raise(door: Any) -> None:
    d = 3 if door is estimate_essential else 2
    x = torch.rand(3, 20, d)
    with pytest.raises(ValueError, match=r"[xd]2"):
        door(x, x[:, :10], threshold=1.0)
    with pytest.raises(ValueError, match=r"[xd]1"):
        door(torch.rand(3, 20, 5 - d), x, threshold=1.0)
    with pytest.raises(ValueError, match="mask"):
        door(x, x, threshold=1.0, mask=torch.ones(3, 20))


# ---- real pairs ----


def labelled(path: Path) -> tuple[Tensor, Tensor, Tensor]:
    rows = torch.from_numpy(np.loadtxt(path))
    return rows[:, :2], rows[:, 3:5], rows[:, 6] > 0


def true_points(path: Path) -> tuple[Tensor, Tensor]:
    import scipy.io

    u = torch.from_numpy(np.array(scipy.io.loadmat(path)["validation"]["pts"][0, 0], dtype=np.float64))
    u = u if u.shape[0] == 6 else u.mT
    return (u[:2] / u[2]).mT, (u[3:5] / u[5]).mT


@pytest.mark.parametrize(
    ("name", "bound"),
    [("booksh", 0.6), ("corr", 0.4), ("kampa", 1.0), ("leafs", 1.2), ("plant", 1.2), ("wall", 0.6), ("zoom", 0.7)],
)
def test_real_fundamental_pairs(name: str, bound: float, data: Path) -> None:
    folder = data / "two_view" / "fundamental_matrix"
    x1, x2, _ = labelled(folder / f"{name}_pts.txt")
    result = estimate_fundamental(x1, x2, threshold=1.0, generator=seeded())
    assert result.status == Status.OK
    assert sampson_distance(result.model, *true_points(folder / f"{name}_vpts.mat")).square().mean().sqrt() < bound


@pytest.mark.parametrize(
    ("name", "bound"), [("Boston", 0.8), ("Eiffel", 0.8), ("LePoint1", 2.0), ("LePoint3", 2.0), ("adam", 0.6), ("city", 0.4)]
)
def test_real_homography_pairs(name: str, bound: float, data: Path) -> None:
    folder = data / "two_view" / "homography"
    x1, x2, _ = labelled(folder / f"{name}_pts.txt")
    result = estimate_homography(x1, x2, threshold=2.0, generator=seeded())
    assert result.status == Status.OK
    distance = HomographyEstimator().squared_residual(result.model, *true_points(folder / f"{name}_vpts.mat")).sqrt()
    assert distance.square().mean().sqrt() < bound


def test_real_essential_pair(data: Path) -> None:
    folder = data / "two_view" / "essential_matrix"
    K1, K2 = (torch.from_numpy(np.loadtxt(folder / f"fountain{i}.K")) for i in (1, 2))
    rows = torch.from_numpy(np.loadtxt(folder / "fountain_pts.txt", skiprows=1))
    one = torch.ones_like(rows[:, :1])
    d1, d2 = (torch.cat((x, one), -1) @ C.inverse().mT for x, C in ((rows[:, :2], K1), (rows[:, 2:4], K2)))
    result = estimate_essential(d1, d2, threshold=2 / K1[0, 0], generator=seeded())
    assert result.status == Status.OK
    assert result.inliers.double().mean() > 0.5
    pose = pose_from_essential(result.model, d1, d2, result.inliers.double())
    assert (pose.in_front & result.inliers).sum() > 0.98 * result.inliers.sum()


# ---- other programs ----


@pytest.mark.reference
@pytest.mark.parametrize("model", ["fundamental", "homography", "essential"])
def test_no_worse_than_poselib(model: str, generator: torch.Generator) -> None:
    """On the same pairs and at the same thresholds, within what 144 pairs can tell."""
    poselib = pytest.importorskip("poselib")
    x1, x2, wrong, R, t, normal = pairs(144, 300, 0.6, generator, plane=model == "homography")
    options = {
        "max_epipolar_error": 1.5, "max_reproj_error": 2.1, "success_prob": 0.9999, "min_iterations": 100,
        "dyn_num_trials_mult": 1.0,
    }  # fmt: skip
    camera = {"model": "PINHOLE", "width": 1000, "height": 1000, "params": [FOCAL, FOCAL, CENTRE, CENTRE]}
    theirs = []
    for a, b in zip(x1.numpy(), x2.numpy(), strict=True):
        if model == "fundamental":
            M = poselib.estimate_fundamental(a, b, options, {})[0]
        elif model == "homography":
            M = poselib.estimate_homography(a, b, options, {})[0]
        else:
            pose = poselib.estimate_relative_pose(a, b, camera, camera, options, {})[0]
            M = essential_from_pose(torch.tensor(pose.R), torch.tensor(pose.t)).numpy()
        theirs.append(torch.from_numpy(np.asarray(M)))
    errors = []
    for M in (DOORS[model](x1, x2, generator=seeded()).model, torch.stack(theirs)):
        if model == "homography":
            errors.append(transfer_error(M, R, t, normal))
        else:
            E = essential_from_fundamental(M, K, K) if model == "fundamental" else M
            errors.append(pose_error(E, x1, x2, wrong, R, t))
    ours, peers = errors
    assert (ours / peers).log().mean().exp() < 1.15
    assert ours.quantile(0.9) < 1.5 * peers.quantile(0.9)
