"""Tracks that are no points, but move over the scene as the camera does, should not move the cameras."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from chance import stream_seed
from outline_scenes import POINTS, outline_scene, rotation_error

from torchsfm import Cauchy, bundle_adjust_model, random_bundle_problem
from torchsfm.bundle import match_weights, track_weights
from torchsfm.geometry import BundleProblem

LOSS = Cauchy(1.0)


def adjusted(problem: BundleProblem, rounds: int) -> BundleProblem:
    """At the minimum with all alike, then by tracks."""
    free = ("focal", "principal_point")
    problem = bundle_adjust_model(problem, free=free, loss=LOSS, tolerance=1e-8).model
    for _ in range(rounds):
        weights = track_weights(problem, loss=LOSS)
        problem = bundle_adjust_model(problem, free=free, loss=LOSS, weights=weights, tolerance=1e-8).model
    return problem


def test_tracks_that_drift_hardly_move_cameras() -> None:
    plain, weighted, share = [], [], []
    for k in range(5):
        problem, truth, bad = outline_scene(torch.Generator().manual_seed(stream_seed() + k), 0.25)
        plain.append(rotation_error(adjusted(problem, 0), truth))
        found = adjusted(problem, 2)
        weighted.append(rotation_error(found, truth))
        weights = track_weights(found, loss=LOSS)
        share.append(float(weights[bad[found.point]].mean() / weights[~bad[found.point]].mean()))
    assert sum(weighted) < 0.8 * sum(plain), (plain, weighted)
    assert max(share) < 0.3, share


def test_where_all_are_points_little_is_lost() -> None:
    plain, weighted = 0.0, 0.0
    for k in range(8):
        problem, truth, _ = outline_scene(torch.Generator().manual_seed(stream_seed() + k), 0.0)
        plain += rotation_error(adjusted(problem, 0), truth) ** 2
        weighted += rotation_error(adjusted(problem, 1), truth) ** 2
    assert weighted < 1.15 * plain, (plain, weighted)


def test_single_wrong_observations_take_less_of_their_track_with_a_robust_loss() -> None:
    problem, truth, _ = outline_scene(torch.Generator().manual_seed(stream_seed()), 0.0)
    wrong = torch.zeros(len(truth.x), dtype=torch.bool)
    wrong[torch.arange(0, POINTS, 10)] = True
    x = problem.x + torch.where(wrong[:, None], 300.0, 0.0)
    of_them = torch.zeros(POINTS, dtype=torch.bool)
    of_them[truth.point[wrong]] = True
    others = of_them[truth.point] & ~wrong
    squares, robust = (float(track_weights(replace(problem, x=x), loss=loss)[others].mean()) for loss in (None, LOSS))
    assert squares < 1e-4 < 0.05 < robust, (squares, robust)


@pytest.mark.parametrize(("weigh", "views", "seen"), [(track_weights, 4, 160), (match_weights, 2, 100)])
def test_exact_missing_and_hidden_observations(
    weigh: Callable[[BundleProblem], torch.Tensor], views: int, seen: int, generator: torch.Generator
) -> None:
    truth = random_bundle_problem(views, 50, seen, noise=0.0, generator=generator).truth
    assert bool((weigh(truth) > 0.5).all())
    x, X = truth.x.clone(), truth.X.clone()
    x[3] = torch.nan
    X[7] = truth.poses.centre[0] - 5 * truth.poses.R[0, 2]
    weights = weigh(replace(truth, x=x, X=X))
    assert float(weights[3]) == 0.0
    assert bool((weights[(truth.point == 7) & (truth.view == 0)] == 0).all())
    assert bool(weights.isfinite().all())
    none = replace(truth, x=x[:0], view=truth.view[:0], point=truth.point[:0])
    assert weigh(none).shape == (0,)


@pytest.mark.parametrize("weigh", [track_weights, match_weights])
def test_bad_options_and_indices_are_named(weigh: Callable[..., torch.Tensor]) -> None:
    truth = random_bundle_problem(4, 50, 160, generator=torch.Generator().manual_seed(0)).truth
    with pytest.raises(ValueError, match="dof"):
        weigh(truth, dof=0.0)
    with pytest.raises(ValueError, match="least_noise"):
        weigh(truth, least_noise=-1.0)
    with pytest.raises(ValueError, match="point"):
        weigh(replace(truth, X=truth.X[:10]))
