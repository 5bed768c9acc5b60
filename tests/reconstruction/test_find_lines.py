"""Lines of models: found in simulated segments, adjusted with points, kept in files."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import small_model
import torch
from chance import assert_share
from torch import Tensor

from torchsfm.bundle import bundle_adjust_model
from torchsfm.geometry import (
    Camera,
    Pose,
    Radial,
    Similarity,
    intrinsics,
    pluecker_from_points,
    point_to_line_distance,
    rotation_from_rotvec,
)
from torchsfm.reconstruction import Reconstruction
from torchsfm.reconstruction.lines.find_lines import FoundSegments, adjust_with_lines, find_lines
from torchsfm.reconstruction.mapping.adjust import adjust
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.matching.track_graph import graph_from_tracks
from torchsfm.reconstruction.model.lines import Lines

F64 = torch.float64
VIEWS, POINTS, LINES = 6, 40, 25


@dataclasses.dataclass(frozen=True)
class Scene:
    mapping: Mapping
    """The truth, but for the noise of image points."""
    found: FoundSegments
    ends: Tensor
    """Of the lines, (l, 2, 3)."""
    line: Tensor
    """Line of each segment, -1 for those of none."""


def make_scene(generator: torch.Generator, noise: float = 0.2, k1: float = -0.05) -> Scene:
    """Views on an arc through a lens; segments of lines, of which each view misses some, and others of nothing."""

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=F64)

    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=F64)

    angle = torch.linspace(-0.5, 0.5, VIEWS, dtype=F64)
    turn = torch.stack((0.15 * torch.cos(4 * angle), angle, 0.1 * torch.sin(5 * angle)), -1)
    poses = Pose(rotation_from_rotvec(turn), torch.tensor([[0.1, -0.1, 4.0]], dtype=F64).repeat(VIEWS, 1))
    K = intrinsics(torch.tensor([700.0], dtype=F64), torch.tensor([[320.0, 240.0]], dtype=F64))
    cameras = Camera(K, Radial(torch.tensor([k1], dtype=F64), torch.tensor([0.0], dtype=F64)))
    X, ends = 2 * rand(POINTS, 3) - 1, 2 * rand(LINES, 2, 3) - 1
    d = ends[:, 1] - ends[:, 0]
    ends[:, 1] = ends[:, 0] + d * (0.8 / d.norm(dim=-1, keepdim=True))
    look = torch.nn.functional.normalize(randn(LINES, 20), dim=-1)
    segments: list[list[Tensor]] = []
    for v in range(VIEWS):
        seen = (rand(LINES) < 0.8).nonzero()[:, 0]
        share = torch.stack((0.2 * rand(len(seen)), 0.8 + 0.2 * rand(len(seen))), -1)[..., None]
        on = ends[seen, None, 0] * (1 - share) + ends[seen, None, 1] * share
        x = cameras[0].project(poses[v].transform(on.reshape(-1, 3))).reshape(-1, 2, 2)
        start = torch.tensor([640.0, 480.0], dtype=F64) * rand(15, 2)
        wrong = torch.stack((start, start + 40 * randn(15, 2)), 1)
        kinds = torch.cat((look[seen] + 0.03 * randn(len(seen), 20), randn(15, 20)))
        line = torch.cat((seen, torch.full((15,), -1)))
        order = torch.randperm(len(line), generator=generator)
        x = torch.cat((x + noise * randn(*x.shape), wrong))
        segments.append([t[order] for t in (x, torch.nn.functional.normalize(kinds, dim=-1), line)])
    x, descriptor, line = (torch.cat(parts) for parts in zip(*segments, strict=True))
    count = torch.tensor([len(part[0]) for part in segments])
    found = FoundSegments(x, torch.full((len(x),), max(noise, 0.1) ** -2, dtype=F64), rand(len(x), 3), descriptor, count)
    view, point = torch.cartesian_prod(torch.arange(VIEWS), torch.arange(POINTS)).unbind(1)
    at = cameras[0].project(poses[view].transform(X[point, None])[:, 0]) + noise * randn(len(view), 2)
    size, names = torch.tensor([[640, 480]] * VIEWS), tuple(f"{v}.jpg" for v in range(VIEWS))
    graph, track = graph_from_tracks(names, size, at, view, point, rand(len(view), 3), generator=generator)
    index = torch.zeros(VIEWS, dtype=torch.long)
    start = Mapping.start(graph, track, cameras, index)
    mapping = dataclasses.replace(start, poses=poses, registered=torch.ones(VIEWS, dtype=torch.bool), X=X, point=track)
    return Scene(mapping, found, ends, line)


def numbers(lines: Lines, scene: Scene) -> Tensor:
    """The true line of each segment, by its image points."""
    key = {tuple(x): int(n) for x, n in zip(scene.found.ends.flatten(1).tolist(), scene.line, strict=True)}
    return torch.tensor([key[tuple(x)] for x in lines.x.flatten(1).tolist()])


def test_lines_are_found_among_segments_of_nothing(generator: torch.Generator) -> None:
    tracked, pure, near = [], [], []
    for _ in range(2):
        scene = make_scene(generator)
        model, lines = find_lines(scene.mapping, scene.found, None)
        true = numbers(lines, scene)
        views = torch.zeros(LINES, VIEWS, dtype=torch.bool)
        view = torch.arange(VIEWS).repeat_interleave(scene.found.count)
        views[scene.line[scene.line >= 0], view[scene.line >= 0]] = True
        tracked.append(torch.isin(torch.arange(LINES), true)[views.sum(1) >= 4])
        # No line twice, and no two lines in one.
        pairs = torch.unique(torch.stack((lines.line, true)), dim=1)
        assert len(torch.unique(lines.line)) == len(lines)
        pure.append(torch.bincount(pairs[0]) == 1)
        assert (torch.bincount(pairs[1][pairs[1] >= 0]) <= 1).all()
        of_line = torch.zeros(len(lines), dtype=torch.long).index_copy(0, lines.line, true)
        gap = point_to_line_distance(lines.ends, pluecker_from_points(*scene.ends[of_line].unbind(1))[:, None])
        near.append((gap.amax(-1) < 0.03)[of_line >= 0])
        assert (lines.support() >= 3).all()
        assert len(model.X) == POINTS
    assert_share(torch.cat(tracked), 0.9)
    assert_share(torch.cat(pure), 0.95)
    assert_share(torch.cat(near), 0.9)


def test_lines_hold_what_few_points_leave_open(generator: torch.Generator) -> None:
    """Poses of exact segments and of three points, which alone determine none of them, come back from where they were moved."""
    scene = make_scene(generator, noise=0.0, k1=0.0)
    mapping = scene.mapping.without((scene.mapping.track >= 3).nonzero()[:, 0])
    step = 0.01 * torch.randn(VIEWS, 6, generator=generator, dtype=F64)
    step[0] = 0
    moved = dataclasses.replace(mapping, poses=mapping.poses.retract(step))
    limits = {"max_iterations": 100, "tolerance": 1e-14}
    alone = adjust(moved, **limits)
    both, lines = adjust_with_lines(moved, tracks(scene), None, **limits)
    assert relative_error(alone.poses, mapping.poses) > 1e-4
    assert relative_error(both.poses, mapping.poses) < 1e-6
    model = dataclasses.replace(both.reconstruction(), lines=lines)
    assert model.line_residuals().max() < 1e-4


def test_lines_that_points_contradict_move_no_cameras(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make_scene(generator)
    model = adjust(scene.mapping)
    free, _ = find_lines(model, scene.found, None)
    assert free is not model
    monkeypatch.setattr("torchsfm.reconstruction.lines.find_lines.points_agree", lambda mapping, moved: False)
    held, lines = find_lines(model, scene.found, None)
    assert held is model
    # The lines are where these cameras want them.
    poses, points = torch.ones(VIEWS, dtype=torch.bool), torch.ones(len(model.X), dtype=torch.bool)
    _, again = adjust_with_lines(model, lines, None, fixed_poses=poses, fixed_points=points)
    assert point_to_line_distance(again.ends.flatten(0, 1), lines.L.repeat_interleave(2, 0)).max() < 1e-4


def tracks(scene: Scene) -> Lines:
    """The true ones."""
    order = scene.line.argsort(stable=True)
    order = order[scene.line[order] >= 0]
    view = torch.arange(VIEWS).repeat_interleave(scene.found.count)
    x, weight, view, line = (t[order] for t in (scene.found.ends, scene.found.weight, view, scene.line))
    return Lines(scene.ends, scene.ends[:, 0], x, weight, view, line)


def relative_error(poses: Pose, true: Pose) -> float:
    """Mean angle of relative rotations from the first view, radians."""
    turn = (poses @ poses[0].inverse()).R @ (true @ true[0].inverse()).R.mT
    return float(((turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1).acos()[1:].mean())


def test_no_segments_change_nothing(generator: torch.Generator) -> None:
    scene = make_scene(generator)
    none = FoundSegments(*(t[:0] for t in (scene.found.ends, scene.found.weight, scene.found.color, scene.found.descriptor)),
                         torch.zeros(VIEWS, dtype=torch.long))  # fmt: skip
    model, lines = find_lines(scene.mapping, none, None)
    assert len(lines) == 0
    assert model is scene.mapping


def with_lines(generator: torch.Generator) -> Reconstruction:
    scene = make_scene(generator)
    model, lines = find_lines(scene.mapping, scene.found, None)
    return dataclasses.replace(model.reconstruction(), lines=lines)


def test_saved_and_loaded(generator: torch.Generator, tmp_path: Path) -> None:
    model = with_lines(generator)
    model.save(tmp_path / "model.npz")
    back = Reconstruction.load(tmp_path / "model.npz")
    assert model.lines is not None
    assert back.lines is not None
    for field in dataclasses.fields(Lines):
        assert torch.equal(getattr(back.lines, field.name), getattr(model.lines, field.name))
    assert f"{len(model.lines)} lines" in back.summary()
    assert Reconstruction.load(saved(small_model.make(), tmp_path / "plain.npz")).lines is None


def saved(model: Reconstruction, path: Path) -> Path:
    model.save(path)
    return path


@pytest.mark.parametrize(("name", "change"), [("line_line", 1000), ("line_view", -1)])
def test_damaged_files_are_named(generator: torch.Generator, tmp_path: Path, name: str, change: int) -> None:
    path = saved(with_lines(generator), tmp_path / "model.npz")
    arrays = dict(np.load(path))
    arrays[name] = arrays[name] + change
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match=f"{name}: there is no number"):
        Reconstruction.load(path)
    del arrays[name]
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match=f"no array '{name}'"):
        Reconstruction.load(path)


def test_other_worlds_and_types(generator: torch.Generator) -> None:
    model = with_lines(generator)
    world = Similarity(torch.tensor(2.5, dtype=F64), rotation_from_rotvec(torch.tensor([0.3, -1.0, 2.0], dtype=F64)),
                       torch.tensor([5.0, -3.0, 1.0], dtype=F64))  # fmt: skip
    moved = model.transform(world)
    torch.testing.assert_close(moved.line_residuals(), model.line_residuals(), rtol=0, atol=1e-8)
    single = model.to(torch.float32)
    assert single.lines is not None
    assert single.lines.ends.dtype == torch.float32
    torch.testing.assert_close(single.line_residuals().double(), model.line_residuals(), rtol=0, atol=0.05)


def test_some_of_the_lines(generator: torch.Generator) -> None:
    model = with_lines(generator)
    assert model.lines is not None
    keep = torch.arange(len(model.lines)) % 3 == 1
    some = dataclasses.replace(model, lines=model.lines.select(keep))
    assert some.lines is not None
    assert torch.equal(some.lines.support(), model.lines.support()[keep])
    assert torch.equal(some.line_residuals(), model.line_residuals()[keep[model.lines.line]])
    assert torch.allclose(model.lines.moved_to(model.lines.L).ends, model.lines.ends, rtol=0, atol=1e-12)


def test_whole_models_are_adjusted_with_their_lines(generator: torch.Generator) -> None:
    model = with_lines(generator)
    assert model.lines is not None
    step = 0.0005 * torch.randn(VIEWS, 6, generator=generator, dtype=F64)
    moved = dataclasses.replace(model, poses=model.poses.retract(step))
    assert moved.line_residuals().mean() > 1.2 * model.line_residuals().mean()
    adjusted = bundle_adjust_model(moved, free=()).model
    assert adjusted.line_residuals().mean() < 1.1 * model.line_residuals().mean()
    assert adjusted.residuals().mean() < 1.1 * model.residuals().mean()
    assert adjusted.lines is not None
    # Each is still as long as it was seen.
    length = [(lines.ends[:, 1] - lines.ends[:, 0]).norm(dim=-1) for lines in (model.lines, adjusted.lines)]
    torch.testing.assert_close(length[1] / length[1].mean(), length[0] / length[0].mean(), rtol=0.05, atol=0)
