"""Which pairs the rotations of all images are taken from, and what the relative poses of pairs cost."""

from collections.abc import Callable
from itertools import combinations
from types import ModuleType

import pytest
import torch
from chance import seeded
from hypothesis import given, settings
from hypothesis import strategies as st
from test_reconstruct_tracks import Scene, make_scene, run
from torch import Tensor

from torchsfm.geometry import BundleProblem, Camera, Radial, intrinsics
from torchsfm.reconstruction.mappers import global_start, pair_poses
from torchsfm.reconstruction.mappers.incremental import MappingOptions
from torchsfm.reconstruction.mappers.pair_poses import FORESTS, relative_poses, strongest_pairs
from torchsfm.reconstruction.mapping import adjust
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.matching.track_graph import graph_from_tracks
from torchsfm.simulation import orbit_poses


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.integers(2, 8), st.integers(0, 30), st.integers(1, 4))
def test_every_cut_keeps_its_strongest_pairs(seed: int, views: int, count: int, forests: int) -> None:
    g = seeded(seed)
    pairs = torch.randint(views, (count, 2), generator=g)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    strength = torch.randperm(len(pairs), generator=g)
    kept = strongest_pairs(pairs, strength, views, forests)
    assert int(kept.sum()) <= forests * (views - 1)
    for size in range(1, views // 2 + 1):
        for part in combinations(range(views), size):
            across = torch.isin(pairs, torch.tensor(part)).sum(1) == 1
            strongest = strength[across].sort(descending=True).values[:forests]
            assert torch.isin(strongest, strength[kept]).all()


def mapping_of(scene: Scene, focal: float) -> tuple[Mapping, MappingOptions]:
    g, v = seeded(0), len(scene.image_size)
    color = torch.zeros(len(scene.x), 3).double()
    names = [str(i) for i in range(v)]
    graph, track = graph_from_tracks(names, scene.image_size, scene.x, scene.view, scene.track, color, generator=g)
    zero = torch.zeros(1).double()
    camera = Camera(intrinsics(torch.tensor([focal]), torch.tensor([[499.5, 374.5]])).double(), Radial(zero, zero))
    options = MappingOptions(("focal",), camera, torch.tensor([0.05]).double(), generator=g)
    return Mapping.start(graph, track, camera, torch.zeros(v, dtype=torch.long)), options


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """For how many pairs samples of matches were drawn, call by call."""
    numbers: list[int] = []
    ransac: Callable[..., object] = pair_poses.ransac

    def counted(estimator: object, d1: Tensor, *data: Tensor, **options: object) -> object:
        numbers.append(len(d1))
        return ransac(estimator, d1, *data, **options)

    monkeypatch.setattr(pair_poses, "ransac", counted)
    return numbers


def angles(motion: Tensor, scene: Scene, mapping: Mapping) -> Tensor:
    i, j = mapping.graph.pairs.unbind(1)
    apart = motion[..., :3] @ (scene.poses.R[j] @ scene.poses.R[i].mT).mT
    return torch.linalg.matrix_norm(apart - torch.eye(3).double()) / 2**0.5


def test_what_verification_found_is_not_searched_for_again(searched: list[int]) -> None:
    scene = make_scene(outliers=0.1, distortion=0.0)
    mapping, options = mapping_of(scene, 1100.0)
    motion, spread, good = relative_poses(mapping, torch.arange(len(mapping.graph.pairs)), options)
    assert not searched
    assert good.all()
    deviation = spread.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    error = angles(motion, scene, mapping)
    # Rotations by their own standard deviations: the root mean square of so many that depend on each other is not far from 1.
    assert 0.4 < float((error / deviation).square().mean().sqrt()) < 2.5
    assert float(error.max()) < 0.05


def test_what_epipolar_geometry_leaves_open_is_searched_for(searched: list[int]) -> None:
    """Points of a plane fit many fundamental matrices, most of which say nothing true of the cameras."""
    scene = make_scene(kind="plane", distortion=0.0, outliers=0.0)
    mapping, options = mapping_of(scene, 1100.0)
    motion, _, good = relative_poses(mapping, torch.arange(len(mapping.graph.pairs)), options)
    assert searched
    assert int(good.sum()) > 0.5 * len(good)
    assert motion.isfinite().all()


def test_work_before_cameras_stand_is_in_proportion_to_the_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """However many pairs and points there are, rotations and first adjustments are of few of them."""
    pairs: list[int] = []
    points: list[int] = []
    poses, fill = global_start.relative_poses, global_start._filled
    adjusts = {room: room.bundle_adjust for room in (global_start, adjust)}

    def counted_poses(mapping: Mapping, chosen: Tensor, options: MappingOptions) -> object:
        pairs.append(len(chosen))
        return poses(mapping, chosen, options)

    def counted(room: ModuleType) -> Callable[..., object]:
        def counted_adjust(problem: BundleProblem, **options: object) -> object:
            if -1 not in points:
                points.append(len(problem.X))
            return adjusts[room](problem, **options)

        return counted_adjust

    def counted_fill(model: Mapping, *given: object) -> object:
        points.append(-1)
        return fill(model, *given)

    monkeypatch.setattr(global_start, "relative_poses", counted_poses)
    for room in adjusts:
        monkeypatch.setattr(room, "bundle_adjust", counted(room))
    monkeypatch.setattr(global_start, "_filled", counted_fill)
    monkeypatch.setattr(global_start, "TRACKS_PER_VIEW", 30)
    views = 24
    scene = make_scene(orbit_poses(views, radius=5.0, sweep=2.0), points=300)
    result = run(scene, method="global", focal=1130.0)
    assert result.model.registered.all()
    mapping, _ = mapping_of(scene, 1100.0)
    assert len(mapping.graph.pairs) == views * (views - 1) // 2
    # Once, with a focal length nearly right; and all points are triangulated once, in the end.
    assert len(pairs) == 1
    assert points.count(-1) == 1
    assert pairs[0] <= FORESTS * (views - 1)
    assert points[-1] == -1
    assert 0 < max(points) <= 30 * views / 2
