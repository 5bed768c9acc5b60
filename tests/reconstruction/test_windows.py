"""Films in windows: local models, joined over what they share."""

import math
from dataclasses import replace

import pytest
import torch
from chance import seeded
from test_reconstruct_tracks import Scene, make_scene, run

from torchsfm.geometry import Camera, Pose, Similarity, intrinsics, random_rotation
from torchsfm.reconstruction.mappers.incremental import MappingOptions
from torchsfm.reconstruction.mappers.windows import Window, join_windows, map_windows
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.matching.track_graph import graph_from_tracks
from torchsfm.reconstruction.matching.view_graph import ViewGraph
from torchsfm.reconstruction.model.evaluation import pose_errors
from torchsfm.reconstruction.model.similarities import robust_similarity
from torchsfm.simulation import orbit_poses

FRAMES, NEXT = 16, 10
"""Of windows smaller than those of films, which show the same in less time."""
VIEWS = 2 * NEXT + FRAMES - 4
"""Three windows."""


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(poses=orbit_poses(VIEWS, radius=5.0, sweep=2 * math.pi * (1 - 1 / VIEWS)), points=100, outliers=0.05)


@pytest.fixture(scope="module")
def graph(scene: Scene) -> tuple[ViewGraph, torch.Tensor]:
    color = torch.full((len(scene.x), 3), 0.5).double()
    names = [f"{i:03d}" for i in range(VIEWS)]
    return graph_from_tracks(names, scene.image_size, scene.x, scene.view, scene.track, color, generator=seeded())


@pytest.fixture(scope="module")
def windows(graph: tuple[ViewGraph, torch.Tensor]) -> list[Window]:
    camera = Camera(intrinsics(torch.tensor([Scene.focal]), torch.tensor([[499.5, 374.5]])).double())
    options = MappingOptions(free=("focal",), expected=camera, focal_sigma=torch.tensor([0.1]).double(), generator=seeded(1))
    mapping = Mapping.start(*graph, camera, torch.zeros(VIEWS, dtype=torch.long))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torchsfm.reconstruction.mappers.windows.FRAMES", FRAMES)
        patch.setattr("torchsfm.reconstruction.mappers.windows.NEXT", NEXT)
        return map_windows(mapping, torch.ones(VIEWS, dtype=torch.bool), options)


@pytest.mark.slow
def test_a_ring_comes_out_as_well_as_image_by_image(scene: Scene) -> None:
    found, other = (run(scene, method=method).model for method in ("windows", "incremental"))
    assert bool(found.registered.all())
    error, wanted = (pose_errors(m.poses, scene.poses, m.registered).pose for m in (found, other))
    assert float(error.max()) < 1.2 * float(wanted.max()) + 0.05


def test_windows_overlap_and_have_models_of_their_own(windows: list[Window]) -> None:
    first = [int(window.images[0]) for window in windows]
    assert first == [0, NEXT, 2 * NEXT]
    assert [len(window.images) for window in windows] == [FRAMES, FRAMES, VIEWS - 2 * NEXT]
    assert all(bool(window.model.registered.all()) for window in windows)


def test_poses_of_joined_windows(windows: list[Window], graph: tuple[ViewGraph, torch.Tensor], scene: Scene) -> None:
    world, kept = join_windows(windows, len(graph[1]), graph[0].match)
    assert bool(kept.all())
    for number, window in enumerate(windows):
        similarity = Similarity(world.scale[number], world.R[number], world.t[number])
        poses = similarity.transform_pose(window.model.poses)
        # The world is that of the first window; the turn from it to the truth is one for all.
        first = windows[0].model.poses.R[0]
        turned = poses.R @ first.mT @ scene.poses.R[0] @ scene.poses.R[window.images].mT
        angle = ((turned.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(max=1).arccos()
        assert float(angle.max().rad2deg()) < 1.0


def test_the_worlds_of_windows_do_not_matter(windows: list[Window], graph: tuple[ViewGraph, torch.Tensor]) -> None:
    g, nodes = seeded(2), len(graph[1])
    moves = [
        Similarity(
            3 * torch.rand((), generator=g, dtype=torch.float64) + 0.3,
            random_rotation(generator=g, dtype=torch.float64),
            torch.randn(3, generator=g, dtype=torch.float64),
        )
        for _ in windows
    ]
    moved = [
        replace(
            window,
            model=replace(window.model, poses=move.transform_pose(window.model.poses), X=move.transform(window.model.X)),
            deviation=window.deviation * move.scale,
        )
        for window, move in zip(windows, moves, strict=True)
    ]

    def places(some: list[Window]) -> list[torch.Tensor]:
        world, kept = join_windows(some, nodes, graph[0].match)
        assert bool(kept.all())
        # The world is the first window's.
        return [Similarity(world.scale[i], world.R[i], world.t[i]).transform(window.model.X) for i, window in enumerate(some)]

    for X, Y in zip(places(windows), places(moved), strict=True):
        extent = (X - X.mean(0)).norm(dim=-1).max()
        assert float((moves[0].transform(X) - Y).norm(dim=-1).max()) < 0.01 * float(moves[0].scale * extent)


def test_a_window_that_shares_nothing_is_left_out(windows: list[Window]) -> None:
    nodes = max(int(window.nodes.max()) for window in windows) + 1
    alone = replace(windows[2], nodes=windows[2].nodes + nodes)
    _, kept = join_windows([*windows[:2], alone], 2 * nodes, torch.zeros(0, 2, dtype=torch.long))
    assert kept.tolist() == [True, True, False]


def test_part_of_a_graph(graph: tuple[ViewGraph, torch.Tensor]) -> None:
    whole, _ = graph
    images = torch.tensor([3, 4, 7, 20])
    part, node = whole.part(images)
    assert part.names == tuple(whole.names[i] for i in images.tolist())
    assert torch.equal(part.x, whole.x[node])
    assert torch.equal(images[part.view], whole.view[node])
    assert torch.equal(part.view[part.match], part.pairs[part.match_pair])
    # Every match between these images, of the same pair.
    inside = torch.isin(whole.view[whole.match], images).all(1)
    assert torch.equal(node[part.match], whole.match[inside])
    assert torch.equal(part.F[part.match_pair], whole.F[whole.match_pair[inside]])


def test_uncertain_pairs_count_less() -> None:
    """Of two points in three, the places are a hundred times as uncertain; all together they would say next to nothing."""
    g = seeded(3)
    X = torch.randn(90, 3, generator=g, dtype=torch.float64)
    sigma = torch.where(torch.arange(90) < 30, 1e-3, 0.1).double()
    Y = 2 * X + sigma[:, None] * torch.randn(90, 3, generator=g, dtype=torch.float64)
    alike, _ = robust_similarity(X, Y)
    found, used = robust_similarity(X, Y, sigma=sigma)
    assert int(used.sum()) > 80
    off, before = (float((s.transform(X) - 2 * X).norm(dim=-1).max()) for s in (found, alike))
    assert off < 2e-3
    assert off < 0.2 * before


def test_nothing_to_see() -> None:
    empty = torch.zeros(0, dtype=torch.long)
    result = run(
        Scene(torch.zeros(0, 2).double(), empty, empty, Pose.identity(4), torch.tensor([[640, 480]] * 4)), method="windows"
    )
    assert not result.models
