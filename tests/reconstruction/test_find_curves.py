"""Cameras by points and curves together: few points and the edges of photographs of a box, and edges that contradict points."""

from dataclasses import dataclass, replace
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from painted_box import HALF, SIZE, camera, orbit, photograph
from torch import Tensor

from torchsfm.bundle import bundle_adjust
from torchsfm.bundle.curves import edge_distances
from torchsfm.bundle.lines import segment_distances
from torchsfm.geometry import Pose
from torchsfm.reconstruction import models
from torchsfm.reconstruction.curves import noise as curve_noise
from torchsfm.reconstruction.curves.adjustment import WithCurves, adjust_with_curves
from torchsfm.reconstruction.curves.find_curves import FoundEdges, find_curves
from torchsfm.reconstruction.curves.from_edges import no_curves, reconstruct_curves
from torchsfm.reconstruction.curves.image_edges import ImageEdges
from torchsfm.reconstruction.lines.find_lines import FoundSegments, lines_of_cameras
from torchsfm.reconstruction.mappers.growth import Component
from torchsfm.reconstruction.mappers.incremental import MappingOptions
from torchsfm.reconstruction.mapping.adjust import LOSS, adjust, points_agree
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.matching.stages import Stages
from torchsfm.reconstruction.matching.track_graph import graph_from_tracks
from torchsfm.reconstruction.model.curves import Curves
from torchsfm.reconstruction.model.lines import Lines

F64 = torch.float64
VIEWS = 12


@dataclass(frozen=True)
class Seen:
    """What is the same in all tests, as it takes a while."""

    images: Tensor
    edges: tuple[ImageEdges, ...]
    curves: Curves
    """By the true cameras."""

    def found(self) -> FoundEdges:
        """All edges, of images as they were read."""
        sizes = torch.full((VIEWS, 2), SIZE)
        return FoundEdges(self.edges, sizes, torch.ones(VIEWS, 2, dtype=F64), torch.zeros(VIEWS, dtype=F64))


@pytest.fixture(scope="module")
def seen() -> Seen:
    images = photograph(orbit(VIEWS))
    edges = tuple(ImageEdges.of(image) for image in images)
    return Seen(images, edges, reconstruct_curves(images, camera(VIEWS), orbit(VIEWS)))


def with_points(number: int, noise: float, generator: torch.Generator) -> Mapping:
    """The true cameras, adjusted to noisy image points of so many points about the box."""
    X = 2 * HALF * (torch.rand(number, 3, generator=generator, dtype=F64) - 0.5)
    view, point = torch.cartesian_prod(torch.arange(VIEWS), torch.arange(number)).unbind(1)
    x = camera(VIEWS)[view].project(orbit(VIEWS)[view].transform(X[point, None]))[:, 0]
    x = x + noise * torch.randn(x.shape, generator=generator, dtype=F64)
    names, sizes = tuple(f"{i}.png" for i in range(VIEWS)), torch.full((VIEWS, 2), SIZE)
    graph, track = graph_from_tracks(names, sizes, x, view, point, torch.ones(len(x), 3, dtype=F64), generator=generator)
    start = Mapping.start(graph, track, camera(1), torch.zeros(VIEWS, dtype=torch.long))
    start = replace(start, poses=orbit(VIEWS), registered=torch.ones(VIEWS, dtype=torch.bool), X=X, point=track)
    return adjust(start, max_iterations=50, tolerance=1e-9)


def turned(poses: Pose) -> Tensor:
    """Angles of relative rotations to the next view, off the true ones, degrees."""
    true = orbit(VIEWS)

    def steps(own: Pose) -> Tensor:
        return own.R[1:] @ own.R[:-1].mT

    trace = (steps(poses) @ steps(true).mT).diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.rad2deg(((trace - 1) / 2).clamp(-1, 1).acos())


def silent(stage: str, done: int, total: int) -> None:
    """Says nothing."""


def test_curves_place_cameras_that_few_points_place_badly(
    seen: Seen, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Adjusted once, samples are still where cameras that were off had them: 0.6 of the errors are left, 0.2 to 0.7 later."""
    steps: list[WithCurves] = []

    def watched(*args: Any, **options: Any) -> WithCurves | None:
        moved = adjust_with_curves(*args, **options)
        assert moved is not None
        steps.append(moved)
        return moved

    monkeypatch.setattr("torchsfm.reconstruction.curves.find_curves.adjust_with_curves", watched)
    before, once, after, by_those, by_these = [], [], [], [], []
    for _ in range(2):
        model = with_points(12, 0.2, generator)
        steps.clear()
        better = find_curves(model, seen.found(), None, silent)
        assert better.mapping is not model
        before.append(turned(model.poses).mean())
        once.append(turned(steps[0].mapping.poses).mean())
        after.append(turned(better.mapping.poses).mean())
        # The curves are those of the new cameras.
        curves = better.curves.bundle()
        by_those.append(edge_distances(model.poses, camera(VIEWS), curves).abs().median())
        by_these.append(edge_distances(better.mapping.poses, camera(VIEWS), curves).abs().median())
    assert sum(once) < 0.95 * sum(before)
    assert sum(after) < 0.85 * sum(once)
    assert sum(by_these) < 0.95 * sum(by_those)


def test_edges_that_lie_aside_leave_cameras_where_many_points_have_them(
    seen: Seen, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In each image all of them by the same, as those of what is round do more or less: that is one error, not hundreds.

    Where they count as hundreds, points contradict the cameras.
    """
    model = with_points(40, 0.1, generator)
    aside = torch.randn(VIEWS, 2, generator=generator, dtype=F64)
    aside = 0.3 * aside / aside.norm(dim=-1, keepdim=True)
    wrong = replace(seen.curves, x=seen.curves.x + aside[seen.curves.view])
    for curves, most in ((seen.curves, 0.95), (wrong, 1.2)):
        moved = adjust_with_curves(model, curves, None)
        assert moved is not None
        assert turned(moved.mapping.poses).mean() < most * turned(model.poses).mean()
    monkeypatch.setattr(curve_noise, "moved_alike", lambda *_: 1.0)
    assert adjust_with_curves(model, wrong, None) is None


def upright_edges(noise: float, generator: torch.Generator) -> Lines:
    """Those of the box, and where the true cameras see their ends."""
    x, y, z = HALF.tolist()
    ends = torch.tensor([[(a * x, b * y, c * z) for c in (-1, 1)] for a in (-1, 1) for b in (-1, 1)], dtype=F64)
    line, view = torch.cartesian_prod(torch.arange(4), torch.arange(VIEWS)).unbind(1)
    shown = camera(VIEWS)[view].project(orbit(VIEWS)[view].transform(ends[line]))
    shown = shown + noise * torch.randn(shown.shape, generator=generator, dtype=F64)
    return Lines(ends, torch.ones(4, 3, dtype=F64), shown, torch.full((len(line),), noise**-2, dtype=F64), view, line)


def test_lines_are_adjusted_with_points_and_curves(seen: Seen, generator: torch.Generator) -> None:
    """The upright edges of the box, which fit the cameras of few points worse than those of all together."""
    model = with_points(12, 0.2, generator)
    lines = upright_edges(0.02, generator)
    moved = adjust_with_curves(model, seen.curves, None, lines)
    assert moved is not None
    assert moved.lines is not None
    before = segment_distances(model.poses, camera(VIEWS), lines.bundle()).abs().mean()
    after = segment_distances(moved.mapping.poses, camera(VIEWS), moved.lines.bundle()).abs().mean()
    assert after < 0.5 * before


def test_lines_that_points_contradict_move_no_cameras_beside_curves(seen: Seen, generator: torch.Generator) -> None:
    """Segments of cameras that are elsewhere; the lines come to rest where the cameras of points and curves want them."""
    model = with_points(40, 0.1, generator)
    lines = upright_edges(0.02, generator)
    aside = torch.randn(VIEWS, 2, generator=generator, dtype=F64)
    wrong = replace(lines, x=lines.x + (1.5 * aside / aside.norm(dim=-1, keepdim=True))[lines.view, None])
    alone = find_curves(model, seen.found(), None, silent)
    beside = find_curves(model, seen.found(), None, silent, lines=wrong, lines_agree=False)
    assert torch.equal(beside.mapping.poses.t, alone.mapping.poses.t)
    assert beside.mapping is not model
    assert beside.lines is not None
    held = lines_of_cameras(alone.mapping, wrong)
    torch.testing.assert_close(beside.lines.ends, held.ends)
    assert (beside.lines.ends - wrong.ends).abs().max() > 1e-4


@pytest.mark.parametrize("agree", [False, True])
def test_lines_that_have_moved_no_camera_are_such(
    agree: bool, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = with_points(12, 0.2, generator)
    options = MappingOptions((), model.cameras, torch.tensor([0.1], dtype=F64))
    told = Mock(return_value=WithCurves(model, None, no_curves(model.X)))
    monkeypatch.setattr(models, "find_lines", lambda *_: (replace(model) if agree else model, upright_edges(0.02, generator)))
    monkeypatch.setattr(models, "find_curves", told)
    component = Component(model, options, off_centre=False)
    models._with_lines_and_curves(
        component, lambda: Mock(FoundSegments), lambda: Mock(FoundEdges), Stages(None, False, ""), silent
    )
    assert told.call_args.kwargs["lines_agree"] is agree


def test_cameras_are_refused_that_points_contradict(generator: torch.Generator) -> None:
    """Those that are true are not, whatever the noise of points."""
    model = with_points(30, 0.3, generator)

    def at(poses: Pose) -> Mapping:
        other, held = replace(model, poses=poses), torch.ones(VIEWS, dtype=torch.bool)
        return replace(other, X=bundle_adjust(other.problem(), fixed_poses=held, free=(), loss=LOSS).X)

    assert points_agree(model, at(orbit(VIEWS)))
    off = (0.004 * torch.randn(VIEWS, 6, generator=generator, dtype=F64)) * torch.tensor([1, 1, 1, 5, 5, 5], dtype=F64)
    other = at(orbit(VIEWS).retract(off))
    assert not points_agree(model, other)
    # Points that are off alike say less.
    assert points_agree(model, other, excess=1e6)


def test_no_edges_change_nothing(generator: torch.Generator) -> None:
    model = with_points(30, 0.3, generator)
    none = (ImageEdges.none(),) * VIEWS
    found = FoundEdges(none, torch.full((VIEWS, 2), SIZE), torch.ones(VIEWS, 2, dtype=F64), torch.zeros(VIEWS, dtype=F64))
    same = find_curves(model, found, None, silent)
    assert same.mapping is model
    assert len(same.curves) == 0


def test_samples_that_few_edges_hold_stay_beside_the_others(seen: Seen, generator: torch.Generator) -> None:
    """Two images next to each other alone show every tenth sample, by edges a fifth of a pixel to either side."""
    model, curves = with_points(40, 0.1, generator), seen.curves
    number = curves.support()
    rank = torch.arange(len(curves.x)) - (number.cumsum(0) - number)[curves.sample]
    lone = curves.sample % 10 == 5
    aside = torch.where(lone & (rank % 2 > 0), 0.2, torch.where(lone, -0.2, 0.0))
    few = replace(curves, x=curves.x + aside[:, None] * curves.normal).seen_where(~lone | (rank < 2))
    moved = adjust_with_curves(model, few, None)
    assert moved is not None
    assert ((moved.curves.X - curves.X).norm(dim=-1) / curves.sigma).max() < 2.5
