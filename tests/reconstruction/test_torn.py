"""A ring of images whose two ends are one place, and do not meet in the model."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from chance import seeded
from test_pair_poses import mapping_of
from test_reconstruct_tracks import SIZE, Scene

from torchsfm.geometry import Camera, Pose, intrinsics
from torchsfm.reconstruction.evidence.consistency import PairAgreement, pair_agreement
from torchsfm.reconstruction.mappers.global_start import close_tears, fill, tighten
from torchsfm.reconstruction.mappers.incremental import MappingOptions
from torchsfm.reconstruction.mappers.torn import join_torn
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.model.evaluation import pose_errors
from torchsfm.simulation import orbit_poses, simulate_images

VIEWS, FOCAL = 40, 700.0


def told(model: Mapping) -> PairAgreement:
    return pair_agreement(model, threshold=4.0, poses_alone=True)


def ring(stream: int) -> tuple[Mapping, Mapping, MappingOptions]:
    """A ball seen from all around, each side by few images: the model, and one torn so far that pairs contradict it."""
    right, torn, options = _ring(stream)
    return right, torn, replace(options, generator=seeded(stream))


@cache
def _ring(stream: int) -> tuple[Mapping, Mapping, MappingOptions]:
    g = seeded(stream)
    # In no order, so that of pairs across the tear either side comes first.
    turn = torch.randperm(VIEWS, generator=g)
    poses = orbit_poses(VIEWS, radius=4.0, sweep=2 * math.pi * (1 - 1 / VIEWS))[turn]
    out = torch.nn.functional.normalize(torch.randn(5000, 3, generator=g, dtype=torch.float64), dim=-1)
    X = out * (1 + 0.3 * torch.rand(5000, 1, generator=g, dtype=torch.float64))
    K = intrinsics(torch.tensor(FOCAL), torch.tensor([499.5, 374.5])).double().expand(VIEWS, 3, 3)
    seen = simulate_images(X, poses, Camera(K), image_size=SIZE, noise=0.5, outliers=0.05, dropout=0.2, generator=g)
    towards = torch.nn.functional.normalize(poses.centre[:, None] - X, dim=-1)
    view, track = (seen.visible & ((towards * out).sum(-1) > 0.8)).nonzero(as_tuple=True)
    scene = Scene(seen.x[view, track], view, track, poses, torch.tensor([SIZE] * VIEWS), FOCAL)
    empty, options = mapping_of(scene, FOCAL)
    every = torch.ones(VIEWS, dtype=torch.bool)
    right = fill(replace(empty, poses=poses, registered=every), options)
    aside = poses.R[:, 1].mean(0)
    for gap in (0.8, 1.0, 1.2, 1.4, 1.7):
        centre = poses.centre + gap * torch.linspace(-0.5, 0.5, VIEWS).double()[turn, None] * aside
        torn = replace(empty, poses=Pose(poses.R, -(poses.R @ centre[..., None])[..., 0]), registered=every)
        torn = fill(tighten(fill(torn, options), 1.0, options), options)
        if int(told(torn).contradicts.sum()) >= 5:
            break
    return right, torn, options


@pytest.mark.parametrize("stream", [0, pytest.param(21, marks=pytest.mark.slow)])
def test_a_torn_ring_closes(stream: int) -> None:
    right, torn, options = ring(stream)
    assert int(told(torn).contradicts.sum()) >= 5
    model = close_tears(torn, told(torn), options)
    assert not bool(told(model).contradicts.any())
    assert told(model).explained > 0.99 * told(right).explained > told(torn).explained
    error = [float(pose_errors(m.poses, right.poses).image_rotation.max()) for m in (torn, model)]
    assert error[1] < min(error[0], 1.2)
    assert close_tears(right, told(right), options) is right


def test_like_things_that_are_two_stay_two() -> None:
    """Matches between images of different sides say that these show one thing: what that would bend counts more."""
    right, _, options = ring(0)
    graph = right.graph
    nodes = [(right.point >= 0).nonzero()[:, 0] for _ in range(2)]
    far = int((right.poses.centre - right.poses.centre[0]).norm(dim=-1).argmax())
    first, second = (own[graph.view[own] == v] for own, v in zip(nodes, (0, far), strict=True))
    count = min(len(first), len(second))

    def with_last(values: torch.Tensor) -> torch.Tensor:
        return torch.cat((values, values[-1:]))

    more = replace(
        graph,
        pairs=torch.cat((graph.pairs, torch.tensor([[0, far]]))),
        match=torch.cat((graph.match, torch.stack((first[:count], second[:count]), 1))),
        match_pair=torch.cat((graph.match_pair, torch.full((count,), len(graph.pairs)))),
        **{
            name: with_last(getattr(graph, name))
            for name in ("num_matches", "F", "H", "fundamental_inliers", "homography_inliers")
        },
    )
    model = replace(right, graph=more)
    assert bool(told(model).contradicts.any())
    assert join_torn(model, told(model)) is None
    assert close_tears(model, told(model), options) is model


def test_what_is_one_already_is_not_joined() -> None:
    """Pairs may contradict cameras that see the same points: adjusting these again would change nothing."""
    right, torn, _ = ring(0)
    point = right.point[right.graph.match]
    seen = (point[:, 0] >= 0) & (point[:, 0] == point[:, 1])
    clean = replace(right.graph, match=right.graph.match[seen], match_pair=right.graph.match_pair[seen])
    matches = torch.bincount(clean.match_pair, minlength=len(clean.pairs))
    none = torch.zeros_like(matches)
    says = PairAgreement(clean.pairs, matches, none, torch.arange(len(matches)), none)
    assert join_torn(replace(right, graph=clean), says) is None
    assert join_torn(replace(torn, graph=clean), says) is not None


def test_points_are_joined_whichever_side_comes_first() -> None:
    """Of each point there are two, one for images of even and one for those of odd numbers."""
    right, _, _ = ring(0)
    graph, odd = right.graph, right.graph.view % 2 == 1
    node = right.observations()
    split = torch.where(odd & (right.point >= 0), right.point + len(right.X), right.point)
    track = torch.where(odd & (right.track >= 0), right.track + len(graph.view), right.track)
    two = replace(right, X=right.X.repeat(2, 1), point=split, track=track).compacted()
    across = (graph.pairs % 2).sum(1) == 1
    matches = torch.bincount(graph.match_pair, minlength=len(graph.pairs))[across]
    none = torch.zeros_like(matches)
    says = PairAgreement(graph.pairs[across], matches, none, across.nonzero()[:, 0], none)
    one = join_torn(two, says)
    assert one is not None
    # Of a point that enough matches show, all image points are of one again.
    both = (one.point[graph.match] >= 0).all(1) & (right.point[graph.match] >= 0).all(1)
    good = both & (right.point[graph.match[:, 0]] == right.point[graph.match[:, 1]]) & (two.point[graph.match] >= 0).all(1)
    same = one.point[graph.match[good]]
    assert len(node) > 5000
    assert float((same[:, 0] == same[:, 1]).double().mean()) > 0.95
