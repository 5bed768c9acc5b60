"""Wrong matches of two views that lie along epipolar lines should not move the cameras."""

from dataclasses import replace

import pytest
import torch
from chance import stream_seed
from outline_scenes import VIEWS, outline_scene, rotation_error
from torch import Tensor

from torchsfm import Cauchy, bundle_adjust_model, random_bundle_problem
from torchsfm.bundle import match_weights
from torchsfm.geometry import BundleProblem

LOSS = Cauchy(1.0)
FEW, LONG = 4, 30
"""Observations of each point that is in two views of the last four alone come from this many views; points seen by all."""


def facade(g: torch.Generator, share: float) -> tuple[BundleProblem, BundleProblem, Tensor]:
    """A scene whose last views have few long tracks, and many matches of two of them, a share of which is wrong: anywhere along
    the line, and off to one side of it. Also the truth, and which points are such matches.
    """
    problem, truth, _ = outline_scene(g, 0.0)
    last = torch.randint(VIEWS - FEW, VIEWS, (len(truth.X),), generator=g)
    other = VIEWS - FEW + (last - (VIEWS - FEW) + torch.randint(1, FEW, (len(truth.X),), generator=g)) % FEW
    pair = (problem.view == last[problem.point]) | (problem.view == other[problem.point])
    short = problem.point >= LONG
    early = short & (problem.point % 2 == 0)
    kept = ~short | torch.where(early, problem.view < VIEWS - FEW, pair)
    wrong = (torch.rand(len(truth.X), generator=g) < share) & (torch.arange(len(truth.X)) >= LONG)
    wrong &= torch.arange(len(truth.X)) % 2 == 1
    # The cameras go around: lines are nearly level.
    shift = torch.stack((60 * torch.rand(len(truth.X), generator=g), 0.6 + 0.6 * torch.rand(len(truth.X), generator=g)), -1)
    moved = (wrong[:, None] * shift).to(problem.x.dtype)[problem.point]
    x = torch.where((problem.view == torch.maximum(last, other)[problem.point])[:, None], problem.x + moved, problem.x)
    few = [replace(p, x=x[kept], view=problem.view[kept], point=problem.point[kept]) for p in (problem, truth)]
    return few[0], few[1], wrong


def adjusted(problem: BundleProblem, weighed: bool) -> BundleProblem:
    """At the minimum, all alike; or nearly without matches, then by how likely they are right."""
    weights = None
    if weighed:
        weights = torch.where(torch.bincount(problem.point, minlength=len(problem.X)) == 2, 0.01, 1.0)[problem.point].double()
    for _ in range(3 if weighed else 1):
        problem = bundle_adjust_model(problem, loss=LOSS, weights=weights, tolerance=1e-8).model
        weights = match_weights(problem) if weighed else None
    return problem


def test_wrong_matches_hardly_move_cameras() -> None:
    """From where right ones alone would have them."""
    plain, weighted, told, trusted = 0.0, 0.0, 0.0, 0.0
    for k in range(5):
        problem, _, wrong = facade(torch.Generator().manual_seed(stream_seed() + k), 0.5)
        right = ~wrong[problem.point]
        alone = replace(problem, x=problem.x[right], view=problem.view[right], point=problem.point[right])
        wanted = adjusted(alone, False)
        plain += rotation_error(adjusted(problem, False), wanted)
        found = adjusted(problem, True)
        weighted += rotation_error(found, wanted)
        weights, match = match_weights(found), (torch.bincount(problem.point) == 2)[problem.point]
        told += float(weights[~right].mean()) / 5
        trusted += float(weights[match & right].mean()) / 5
        assert bool((weights[~match] == 1).all())
    assert weighted < 0.3 * plain, (plain, weighted)
    assert told < 0.05 < 0.6 < trusted, (told, trusted)


def test_where_all_are_right_little_is_lost() -> None:
    plain, weighted = 0.0, 0.0
    for k in range(8):
        problem, truth, _ = facade(torch.Generator().manual_seed(stream_seed() + k), 0.0)
        plain += rotation_error(adjusted(problem, False), truth) ** 2
        weighted += rotation_error(adjusted(problem, True), truth) ** 2
    assert weighted < 1.05 * plain, (plain, weighted)


def test_a_match_is_judged_by_its_pair(generator: torch.Generator) -> None:
    """The same distance is little beside right matches, and much beside wrong ones."""
    scene = outline_scene(generator, 0.0)[0]
    second = 1 + torch.arange(len(scene.X)) % 2
    kept = (scene.view == 0) | (scene.view == second[scene.point])
    problem = replace(scene, x=scene.x[kept], view=scene.view[kept], point=scene.point[kept])
    wrong = (torch.arange(len(scene.X)) % 4 == 1)[problem.point]
    x = problem.x + wrong[:, None] * 1.5 * torch.randn(len(problem.x), 2, generator=generator, dtype=torch.float64)
    point = problem.poses[problem.view].transform(problem.X[problem.point][:, None])
    exact = problem.cameras[problem.camera_index[problem.view]].project(point)[:, 0]
    x = torch.where((problem.point < 2)[:, None], exact + 0.5, x)
    weights = match_weights(replace(problem, x=x))
    beside_right, beside_wrong = (weights[problem.point == p] for p in (0, 1))
    assert bool((beside_right > beside_wrong + 0.1).all()), (beside_right, beside_wrong)
    order = torch.randperm(len(x), generator=generator)
    mixed = replace(problem, x=x[order], view=problem.view[order], point=problem.point[order])
    torch.testing.assert_close(match_weights(mixed), weights[order])


def test_an_extent_of_nothing_is_named() -> None:
    truth = random_bundle_problem(4, 50, 160, generator=torch.Generator().manual_seed(0)).truth
    with pytest.raises(ValueError, match="extent"):
        match_weights(truth, extent=0.0)
