"""Points of a growing model: what is triangulated, completed, merged and dropped, against a known scene."""

from dataclasses import replace

import pytest
import torch
from chance import seeded
from torch import Tensor

from torchsfm.geometry import Camera, NoDistortion, Pose, intrinsics
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.structure import (
    complete_tracks,
    filter_points,
    merge_points,
    triangulate_tracks,
    visible_points,
    widest_angle,
)
from torchsfm.reconstruction.matching.view_graph import ViewGraph
from torchsfm.simulation import orbit_poses, random_points, simulate_images

SIZE = (1000, 800)
VIEWS = 5


def make(*, noise: float = 0.0, wrong: float = 0.0, points: int = 60, seed: int = 0) -> tuple[Mapping, Tensor, Tensor]:
    """A mapping with true cameras and no points, the true points, and the true point of each image point."""
    g = seeded(seed)
    X = random_points(points, generator=g)
    poses = orbit_poses(VIEWS, radius=5.0, sweep=1.2)
    K = intrinsics(torch.tensor(1000.0, dtype=torch.float64), torch.tensor([499.5, 399.5], dtype=torch.float64))
    seen = simulate_images(X, poses, Camera(K.expand(VIEWS, 3, 3)), image_size=SIZE, noise=noise, outliers=wrong, generator=g)
    view, label = seen.visible.nonzero(as_tuple=True)
    node = torch.full((VIEWS, points), -1)
    node[view, label] = torch.arange(len(view))
    pairs = torch.combinations(torch.arange(VIEWS))
    match, owner = [], []
    for q, (i, j) in enumerate(pairs.tolist()):
        both = (node[i] >= 0) & (node[j] >= 0)
        match.append(torch.stack([node[i][both], node[j][both]], 1))
        owner.append(torch.full((int(both.sum()),), q))
    q = len(pairs)
    zeros = torch.zeros(q, dtype=torch.long)
    graph = ViewGraph(
        names=tuple(f"{i}.png" for i in range(VIEWS)),
        image_size=torch.tensor([SIZE] * VIEWS),
        x=seen.x[view, label],
        view=view,
        color=torch.rand(len(view), 3, generator=g, dtype=torch.float64),
        pairs=pairs,
        num_matches=zeros,
        F=torch.zeros(q, 3, 3, dtype=torch.float64),
        H=torch.zeros(q, 3, 3, dtype=torch.float64),
        fundamental_inliers=zeros,
        homography_inliers=zeros,
        match=torch.cat(match),
        match_pair=torch.cat(owner),
    )
    mapping = Mapping.start(graph, label.clone(), Camera(K[None], NoDistortion()), torch.zeros(VIEWS, dtype=torch.long))
    mapping = replace(mapping, poses=poses, registered=torch.ones(VIEWS, dtype=torch.bool))
    return mapping, X, label


def triangulated(mapping: Mapping, *, threshold: float = 3.0, min_angle: float = 0.02) -> Mapping:
    return triangulate_tracks(mapping, threshold=threshold, min_angle=min_angle)


def truth_of_points(mapping: Mapping, label: Tensor) -> Tensor:
    """The true point each 3D point stands for, by its first observation."""
    node = mapping.observations()
    result = torch.full((len(mapping.X),), -1)
    result[mapping.point[node.flip(0)]] = label[node.flip(0)]
    return result


def test_exact_data_give_exact_points() -> None:
    mapping, X, label = make()
    mapping = triangulated(mapping)
    assert len(mapping.X) == 60
    assert bool((mapping.point >= 0).all())
    assert float((mapping.X - X[truth_of_points(mapping, label)]).norm(dim=-1).max()) < 1e-8


def test_wrong_image_points_are_left_out() -> None:
    mapping, X, label = make(noise=0.3, wrong=0.15, points=200)
    result = triangulated(mapping)
    node = result.observations()
    exact, _, _ = make(noise=0.0, wrong=0.0, points=200)
    projected, _ = replace(exact, X=X).project(label, mapping.graph.view)
    wrong = (projected - mapping.graph.x).norm(dim=-1) > 10
    assert int(wrong.sum()) > 50
    assert float((wrong[node]).double().mean()) < 0.01
    assert len(node) > 0.9 * int((~wrong).sum())
    error = (result.X - X[truth_of_points(result, label)]).norm(dim=-1)
    assert float(error.median()) < 0.005


def test_points_without_parallax_are_not_made() -> None:
    mapping, _, _ = make()
    same = Pose(mapping.poses.R[:1].expand(VIEWS, 3, 3), mapping.poses.t[:1].expand(VIEWS, 3))
    seen = mapping.graph.x.clone()
    first = mapping.graph.view == 0
    seen[~first] = seen[first].repeat(VIEWS, 1)[: int((~first).sum())]
    still = replace(mapping, poses=same, graph=replace(mapping.graph, x=seen))
    assert len(triangulated(still).X) == 0


def test_completion_returns_what_was_taken_away() -> None:
    mapping, _, _ = make(noise=0.3)
    full = triangulated(mapping)
    taken = full.observations()[full.graph.view[full.observations()] == 2]
    part = full.without(taken)
    again = complete_tracks(part, threshold=3.0)
    assert torch.equal(again.point >= 0, full.point >= 0)


def test_completion_never_gives_a_point_two_observations_in_one_image() -> None:
    mapping, _, _ = make(noise=0.3, points=150)
    # Every image point is matched with a random one of the next image as well.
    graph = mapping.graph
    g = seeded(1)
    extra = torch.randint(len(graph.x), (3000, 2), generator=g)
    match = torch.cat([graph.match, extra])
    owner = torch.cat([graph.match_pair, torch.zeros(3000, dtype=torch.long)])
    mapping = replace(mapping, graph=replace(graph, match=match, match_pair=owner))
    result = complete_tracks(triangulated(mapping).without(torch.arange(0, len(graph.x), 3)), threshold=50.0)
    node = result.observations()
    key = result.point[node] * VIEWS + graph.view[node]
    assert len(torch.unique(key)) == len(key)


def test_split_points_are_merged() -> None:
    mapping, _, label = make(noise=0.2)
    # The two halves of each track become points of their own.
    split = replace(mapping, track=mapping.track * 2 + (mapping.graph.view >= 3).long())
    double = triangulated(split)
    assert len(double.X) > 100
    merged = merge_points(double, threshold=3.0)
    assert len(merged.X) == 60
    assert torch.equal(merged.point >= 0, double.point >= 0)
    assert len(torch.unique(truth_of_points(merged, label))) == 60


def test_filter_drops_moved_observations_and_narrow_points() -> None:
    mapping, _, _ = make(noise=0.2)
    mapping = triangulated(mapping)
    x = mapping.graph.x.clone()
    x[7] += 40.0
    moved = replace(mapping, graph=replace(mapping.graph, x=x))
    result = filter_points(moved, threshold=4.0, min_angle=0.02)
    assert int(result.point[7]) == -1
    assert int((result.point >= 0).sum()) >= len(x) - 2
    assert len(filter_points(moved, threshold=4.0, min_angle=3.0).X) == 0


def test_widest_angle_is_between_half_and_all_of_the_truth() -> None:
    mapping, _, _ = make()
    mapping = triangulated(mapping)
    ray = torch.nn.functional.normalize(mapping.X[:, None] - mapping.poses.centre, dim=-1)
    everyone = torch.arccos((ray[:, :, None] * ray[:, None]).sum(-1).clamp(-1, 1)).amax((-2, -1))
    # All points are seen by all cameras here.
    found = widest_angle(mapping)
    assert bool((found <= everyone + 1e-9).all())
    assert bool((found >= everyone / 2 - 1e-9).all())


def test_visible_points_of_an_unregistered_image() -> None:
    mapping, _, label = make()
    registered = mapping.registered.clone()
    registered[4] = False
    part = triangulated(replace(mapping, registered=registered))
    node, point = visible_points(part, ~registered)
    assert bool((part.graph.view[node] == 4).all())
    assert torch.equal(truth_of_points(part, label)[point], label[node])
    assert len(node) == int((mapping.graph.view == 4).sum())


@pytest.mark.parametrize("registered", [0, 1])
def test_too_few_images_make_no_points(registered: int) -> None:
    mapping, _, _ = make()
    mapping = replace(mapping, registered=torch.arange(VIEWS) < registered)
    assert len(triangulated(mapping).X) == 0
    assert len(filter_points(mapping, threshold=4.0, min_angle=0.1).X) == 0


def test_the_finished_model_averages_colours_and_sorts_observations() -> None:
    mapping, _, _ = make()
    model = triangulated(mapping).reconstruction()
    assert float(model.residuals().max()) < 1e-8
    key = model.point * VIEWS + model.view
    assert torch.equal(key, key.sort().values)
    lengths = model.track_lengths()
    assert int(lengths.sum()) == model.num_observations
    assert bool(((model.color >= 0) & (model.color <= 1)).all())
