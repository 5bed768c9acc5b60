"""All images at once: rotations, centres, points, then the finish that all roads share."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from chance import seeded
from test_pair_poses import mapping_of
from test_reconstruct_tracks import SIZE, Scene, make_scene, run, turning

from torchsfm.geometry import Camera, Pose, intrinsics, rotation_from_rotvec
from torchsfm.reconstruction.evidence.consistency import pair_agreement
from torchsfm.reconstruction.mappers import global_start
from torchsfm.reconstruction.mappers.choose_mapper import choose_mapper
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.model.evaluation import pose_errors
from torchsfm.simulation import orbit_poses, simulate_images


@pytest.mark.parametrize("seed", range(2))
def test_poses_are_as_good_as_those_of_the_incremental_road(seed: int) -> None:
    scene = make_scene(seed=seed, outliers=0.1)
    found, other = run(scene, method="global").model, run(scene).model
    assert bool(found.registered.all())
    error, wanted = (pose_errors(m.poses, scene.poses, m.registered).pose for m in (found, other))
    # Both end in the same minimum, of points that may differ at the threshold.
    assert float(error.max()) < 1.2 * float(wanted.max()) + 0.05
    assert abs(float(found.residuals().mean()) - float(other.residuals().mean())) < 0.05


@pytest.mark.parametrize("stream", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_a_ring_seen_from_far_closes(stream: int) -> None:
    """Only neighbours see the same side: what the focal length is off is off in all their turns, which add up."""
    views, g = 40, seeded(stream)
    poses = orbit_poses(views, radius=10.0, sweep=2 * math.pi * (1 - 1 / views))
    out = torch.nn.functional.normalize(torch.randn(1500, 3, generator=g, dtype=torch.float64), dim=-1)
    X = out * (1 + 0.3 * torch.rand(1500, 1, generator=g, dtype=torch.float64))
    K = intrinsics(torch.tensor(2400.0), torch.tensor([499.5, 374.5])).double().expand(views, 3, 3)
    seen = simulate_images(X, poses, Camera(K), image_size=SIZE, noise=0.5, outliers=0.05, dropout=0.2, generator=g)
    towards = torch.nn.functional.normalize(poses.centre[:, None] - X, dim=-1)
    view, track = (seen.visible & ((towards * out).sum(-1) > 0.8)).nonzero(as_tuple=True)
    scene = Scene(seen.x[view, track], view, track, poses, torch.tensor([SIZE] * views), 2400.0)
    model = run(scene, method="global", focal=2400.0).model
    assert bool(model.registered.all())
    assert float(pose_errors(model.poses, poses, model.registered).image_rotation.max()) < 3


def test_all_is_done_once_where_pairs_agree_with_what_comes_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """A focal length that was far off is mended by adjusting; only a model that its pairs contradict is made anew."""
    scene, count = make_scene(), list[int]()
    start = global_start.relative_poses

    def counted(*given: Any) -> Any:
        count.append(1)
        return start(*given)

    monkeypatch.setattr(global_start, "relative_poses", counted)
    model = run(scene, method="global", focal=850.0).model
    assert len(count) == 1
    assert bool(model.registered.all())
    assert abs(float(model.cameras.K[0, 0, 0]) / 1100 - 1) < 0.02
    monkeypatch.setattr(global_start, "_holds", lambda *given: False)
    other = run(scene, method="global", focal=850.0).model
    assert len(count) >= 3
    assert (
        float(pose_errors(model.poses, scene.poses).pose.max())
        < 1.2 * float(pose_errors(other.poses, scene.poses).pose.max()) + 0.05
    )


def test_a_model_that_its_pairs_contradict_does_not_hold() -> None:
    views = 12
    scene = make_scene(orbit_poses(views, radius=5.0, sweep=2.0), distortion=0.0)
    mapping, options = mapping_of(scene, 1100.0)
    right = replace(mapping, poses=scene.poses, registered=torch.ones(views, dtype=torch.bool))
    right = global_start.fill(right, options)
    every = torch.ones(views, dtype=torch.bool)

    def holds(model: Mapping) -> bool:
        return global_start._holds(model, every, pair_agreement(model, threshold=4.0))

    assert holds(right)
    turn = rotation_from_rotvec(torch.tensor([0.0, 0.0, 0.1]).double())
    some = torch.arange(views) > 7
    turned = replace(scene.poses, R=torch.where(some[:, None, None], turn @ scene.poses.R, scene.poses.R))
    assert not holds(replace(right, poses=turned))
    assert not holds(replace(right, registered=~(torch.arange(views) == 3)))


def test_two_unrelated_scenes_give_two_models() -> None:
    one, two = make_scene(seed=1), make_scene(orbit_poses(6, radius=4.0, sweep=1.2), seed=2)
    v, n = len(one.image_size), int(one.track.max()) + 1
    both = Scene(
        torch.cat((one.x, two.x)), torch.cat((one.view, two.view + v)), torch.cat((one.track, two.track + n)),
        Pose(torch.cat((one.poses.R, two.poses.R)), torch.cat((one.poses.t, two.poses.t))),
        torch.cat((one.image_size, two.image_size)),
    )  # fmt: skip
    result = run(both, method="global")
    assert [model.registered.nonzero()[:, 0].tolist() for model in result.models] == [[*range(8)], [*range(8, 14)]]
    for model, scene in zip(result.models, (one, two), strict=True):
        own = model.registered
        assert float(pose_errors(model.poses[own], scene.poses).pose.max()) < 1.5


def test_known_intrinsics_are_kept_and_the_same_seed_gives_the_same_model() -> None:
    scene = make_scene(distortion=0.0)
    K = torch.tensor([[1100.0, 0, 499.5], [0, 1100, 374.5], [0, 0, 1]]).double()
    first, second = (run(scene, method="global", K=K).model for _ in range(2))
    assert torch.equal(first.cameras.K[0], K)
    assert torch.equal(first.X, second.X)
    assert float(pose_errors(first.poses, scene.poses).pose.max()) < 0.5


def test_what_has_no_depth_is_refused() -> None:
    assert not run(make_scene(turning(6)), method="global").models
    scene = make_scene()
    few = replace(scene, x=scene.x[:9], view=scene.view[:9], track=scene.track[:9])
    assert not run(few, method="global").models


def ring_of_pairs(views: int, reach: int) -> torch.Tensor:
    start = torch.arange(views)
    return torch.cat([torch.stack((start, (start + k) % views), 1) for k in range(1, reach + 1)])


@pytest.mark.parametrize(
    ("views", "reach", "sigma", "wanted"),
    [
        (800, 4, 0.05, "global"),
        (100, 4, 0.05, "incremental"),  # few
        (800, 1, 0.05, "incremental"),  # a chain
        (800, 4, 0.5, "incremental"),  # unknown focal lengths
        (0, 1, 0.05, "incremental"),
    ],
)
def test_mapper_for_a_view_graph(views: int, reach: int, sigma: float, wanted: str, generator: torch.Generator) -> None:
    pairs = ring_of_pairs(views, reach)
    inliers = torch.full((len(pairs),), 60)
    focal = torch.full((views,), sigma, dtype=torch.float64)
    assert choose_mapper(pairs, inliers, focal) == wanted
    # The order of images, and pairs that are not related, say nothing.
    order = torch.randperm(views, generator=generator)
    more = torch.cat((order[pairs], torch.randint(max(views, 1), (views, 2), generator=generator)))
    assert choose_mapper(more, torch.cat((inliers, torch.zeros(views).long())), focal) == wanted


def test_parts_that_nothing_connects_are_looked_at_each_by_itself() -> None:
    pairs, focal = ring_of_pairs(800, 4), torch.full((800,), 0.05, dtype=torch.float64)
    apart = pairs[(pairs // 300 == pairs[:, :1] // 300).all(1)]
    assert choose_mapper(pairs, torch.full((len(pairs),), 60), focal) == "global"
    assert choose_mapper(apart, torch.full((len(apart),), 60), focal) == "incremental"


def test_auto_says_which_mapper_it_took() -> None:
    scene = make_scene(points=150)
    result = run(scene, method="auto", focal=1100.0)
    assert result.report.method == "incremental"
    assert torch.equal(result.model.X, run(scene, focal=1100.0).model.X)
