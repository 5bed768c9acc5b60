"""Two models that share images as one."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import small_model
import torch
from command_line import assert_one_line, torchsfm
from torch import Tensor

from torchsfm.geometry import Camera, NoDistortion, Pose, Similarity, intrinsics, random_rotation
from torchsfm.images import fit_ellipse
from torchsfm.reconstruction import Conics, Lines, Reconstruction
from torchsfm.reconstruction.merging.merge import merge_models
from torchsfm.reconstruction.model.evaluation import pose_errors
from torchsfm.reconstruction.model.parts import part_of_model
from torchsfm.simulation import look_at, random_points

F64 = torch.float64
VIEWS = 10


def whole_model(generator: torch.Generator, *, points: int = 250, noise: float = 0.3) -> Reconstruction:
    """Cameras around points; each image shows two thirds of them."""
    angle = torch.linspace(0, 3, VIEWS, dtype=F64)
    centre = torch.stack((6 * angle.cos(), 6 * angle.sin(), angle.sin()), -1)
    X = random_points(points, generator=generator)
    seen = torch.rand(points, VIEWS, generator=generator) < 0.66
    seen[:, :2] |= (seen.sum(1) < 2)[:, None]
    point, view = seen.nonzero(as_tuple=True)
    K = intrinsics(torch.tensor([900.0], dtype=F64), torch.tensor([[399.5, 299.5]], dtype=F64))
    model = Reconstruction(
        names=tuple(f"image {i}.jpg" for i in range(VIEWS)),
        image_size=torch.tensor([[800, 600]] * VIEWS),
        cameras=Camera(K, NoDistortion()),
        camera_index=torch.zeros(VIEWS, dtype=torch.long),
        poses=look_at(centre, torch.zeros(3, dtype=F64)),
        registered=torch.ones(VIEWS, dtype=torch.bool),
        X=X,
        color=torch.rand(points, 3, generator=generator, dtype=F64),
        x=torch.zeros(len(view), 2, dtype=F64),
        view=view,
        point=point,
    )
    exact = model.projections()
    return replace(model, x=exact + noise * torch.randn(exact.shape, generator=generator, dtype=F64))


def halves(model: Reconstruction, shared: int, generator: torch.Generator) -> tuple[Reconstruction, Reconstruction]:
    """The first and the last images, some of them in both, the second part in a world of its own."""
    v = len(model.names)
    end = (v + shared) // 2
    first, second = torch.arange(v) < end, torch.arange(v) >= end - shared
    R = random_rotation(1, generator=generator, dtype=F64)[0]
    s = Similarity(torch.tensor(0.3, dtype=F64), R, torch.randn(3, generator=generator, dtype=F64))
    return part_of_model(model, first), part_of_model(model, second).transform(s)


def with_lines(model: Reconstruction, seen: Tensor, generator: torch.Generator) -> Reconstruction:
    """The model with lines through pairs of its points, of which each image sees another part."""
    line, view = seen.nonzero(as_tuple=True)
    ends = model.X[: 2 * len(seen)].reshape(-1, 2, 3)
    part = torch.rand(len(line), 2, 1, generator=generator, dtype=F64) * 0.3 + torch.tensor([[0.0], [0.7]], dtype=F64)
    x = model.cameras[model.camera_index[view]].project(
        model.poses[view].transform(torch.lerp(ends[line, :1], ends[line, 1:], part))
    )
    low = part[:, 0, 0].new_ones(len(seen)).scatter_reduce(0, line, part[:, 0, 0], "amin")
    high = part[:, 0, 0].new_zeros(len(seen)).scatter_reduce(0, line, part[:, 1, 0], "amax")
    ends = torch.lerp(ends[:, :1], ends[:, 1:], torch.stack((low, high), -1)[..., None])
    color = torch.rand(len(seen), 3, generator=generator, dtype=F64)
    return replace(model, lines=Lines(ends, color, x, torch.ones(len(x), dtype=F64), view, line))


def with_conics(model: Reconstruction, seen: Tensor, generator: torch.Generator) -> Reconstruction:
    """The model with ellipses, half of them circles, exactly as the images show them."""
    n = len(seen)
    axes = torch.linalg.qr(torch.randn(n, 3, 2, generator=generator, dtype=F64)).Q.mT.clone()
    axes[: n // 2, 1] *= 0.5
    conic, view = seen.nonzero(as_tuple=True)
    color, none = torch.rand(n, 3, generator=generator, dtype=F64), torch.zeros(len(view), 5, dtype=F64)
    covariance = 0.01 * torch.eye(5, dtype=F64).expand(len(view), 5, 5)
    conics = Conics(torch.randn(n, 3, generator=generator, dtype=F64), 0.3 * axes, color, none, covariance, view, conic)
    x = model.cameras[model.camera_index[view]].project(model.poses[view].transform(conics.outlines()[conic]))
    shown = fit_ellipse(x).model
    return replace(model, conics=replace(conics, x=torch.cat((shown.centre, shown.semi_axes, shown.angle[:, None]), -1)))


@pytest.mark.parametrize("shared", [1, 2, 4])
def test_parts_become_the_whole(shared: int, generator: torch.Generator) -> None:
    model = whole_model(generator, noise=0.0)
    a, b = halves(model, shared, generator)
    found = merge_models(a, b)
    assert not found.fault()
    assert found.model.names == model.names
    assert found.shared_images == tuple(name for name in a.names if name in b.names)
    assert bool(found.model.registered.all())
    assert len(found.model.cameras.K) == 1
    assert found.model.num_observations == a.num_observations + b.num_observations - int(
        (torch.isin(model.view, torch.tensor([i for i, name in enumerate(model.names) if name in found.shared_images]))
         & torch.isin(model.point, in_both(model, a, b))).sum()
    )  # fmt: skip
    assert float(found.model.residuals().max()) < 1e-5
    # The frame is that of the first one.
    torch.testing.assert_close(found.model.poses.centre, model.poses.centre, rtol=0, atol=1e-5)
    key = torch.unique(found.model.point * VIEWS + found.model.view)
    assert len(key) == found.model.num_observations


def test_lines_and_ellipses_of_both_become_one(generator: torch.Generator) -> None:
    model = whole_model(generator, noise=0.0)
    seen = torch.ones(24, VIEWS, dtype=torch.bool)
    seen[8:16, 5:], seen[16:, :5] = False, False  # in one of the parts alone
    seen[:8, 3] = False
    model = with_conics(with_lines(model, seen, generator), seen, generator)
    found = merge_models(*halves(model, 3, generator))
    assert not found.fault()
    whole = found.model
    assert whole.lines is not None
    assert whole.conics is not None
    assert model.lines is not None
    assert model.conics is not None
    assert float(whole.line_residuals().max()) < 1e-4
    assert float(whole.conic_residuals().max()) < 1e-4
    for mine, theirs, place, other in (
        (whole.lines, model.lines, whole.lines.ends.mean(1), model.lines.ends.mean(1)),
        (whole.conics, model.conics, whole.conics.centre, model.conics.centre),
    ):
        assert len(mine) == len(theirs)
        # Those of the first part come first, in order; each measurement is there once.
        order = torch.cdist(other, place).argmin(1)
        assert order.sort().values.equal(torch.arange(24))
        torch.testing.assert_close(place[order], other, rtol=0, atol=1e-4)
        assert len(mine.x) == len(theirs.x)
        assert mine.support()[order].equal(theirs.support())
    # As far as either part saw them.
    order = torch.cdist(model.lines.ends.mean(1), whole.lines.ends.mean(1)).argmin(1)
    torch.testing.assert_close(whole.lines.ends[order], model.lines.ends, rtol=0, atol=1e-4)


def test_segments_that_contradict_the_whole_are_left_out(generator: torch.Generator) -> None:
    model = whole_model(generator, noise=0.0)
    model = with_lines(model, torch.ones(10, VIEWS, dtype=torch.bool), generator)
    a, b = halves(model, 3, generator)
    assert a.lines is not None
    x = a.lines.x.clone()
    x[0] += 40 * torch.stack((x[0, 1, 1] - x[0, 0, 1], x[0, 0, 0] - x[0, 1, 0])) / (x[0, 1] - x[0, 0]).norm()
    found = merge_models(replace(a, lines=replace(a.lines, x=x)), b).model
    assert found.lines is not None
    assert len(found.lines) == 10
    assert len(found.lines.x) == 10 * VIEWS - 1
    assert float(found.line_residuals().max()) < 0.1


def true_distance(X: Tensor) -> Tensor:
    """From the circle and from the helix of `with_curves`, the nearer one."""
    t = torch.linspace(-0.1, 2 * math.pi, 20000, dtype=F64)
    circle = torch.stack((0.6 * t.cos(), 0.6 * t.sin(), 0 * t), -1)
    helix = torch.stack((0.5 * t.cos(), 0.5 * t.sin(), 0.3 * t), -1)[t < 3.1]
    return torch.cdist(X, torch.cat((circle, helix))).amin(-1)


@pytest.mark.parametrize("overlap", [True, False])
def test_curves_of_both_become_one(overlap: bool, generator: torch.Generator) -> None:
    """Each part has samples of its own; of the helix the one may have the beginning and the other the end."""
    model = whole_model(generator, noise=0.0)
    both = [small_model.with_curves(model, finer=24, shift=shift).curves for shift in (0.0, 0.4)]
    count = []
    parts = []
    for k, curves in enumerate(both):
        assert curves is not None
        curves = curves.select(torch.tensor([True, True, False]))
        if not overlap:
            turn = curves.X[:, 2] / 0.3
            curves = curves.runs_where((curves.curve == 0) | ((turn > 1.4) if k else (turn < 1.6)))
        parts.append(halves(replace(model, curves=curves), 3, generator)[k])
        count.append(len(curves.X))
    a, b = parts
    found = merge_models(a, b).model.curves
    assert found is not None
    assert sorted(found.closed.tolist()) == [False, True]
    assert float(true_distance(found.X).max()) < 2e-3
    # Neither twice nor in part: from one end to the other.
    assert len(found.X) < 1.1 * max(count[0], 24 * 28)
    lengths = torch.tensor([3 * math.hypot(0.5, 0.3), 1.2 * math.pi], dtype=F64)
    torch.testing.assert_close(found.length().sort().values, lengths, rtol=0.01, atol=0)
    # Both parts' images show them, each image a sample once.
    assert found.view.unique().numel() == VIEWS
    assert len(torch.unique(found.sample * VIEWS + found.view)) == len(found.sample)


def test_what_one_model_alone_has_is_carried(generator: torch.Generator) -> None:
    model = whole_model(generator, noise=0.0)
    model = with_lines(model, torch.ones(10, VIEWS, dtype=torch.bool), generator)
    a, b = halves(model, 3, generator)
    for first, second in ((a, replace(b, lines=None)), (replace(a, lines=None), b)):
        found = merge_models(first, second).model
        assert found.lines is not None
        assert found.conics is None
        assert len(found.lines) == 10
        assert float(found.line_residuals().max()) < 1e-4


def test_a_model_merged_with_itself_stays(generator: torch.Generator) -> None:
    """Also one with features of several orientations, at one place each."""
    model = whole_model(generator)
    again = model.point < 40
    model = replace(
        model,
        X=torch.cat((model.X, model.X[:40])),
        color=torch.cat((model.color, model.color[:40])),
        x=torch.cat((model.x, model.x[again])),
        view=torch.cat((model.view, model.view[again])),
        point=torch.cat((model.point, model.point[again] + len(model.X))),
    )
    found = merge_models(model, model)
    assert not found.fault()
    assert found.shared_points == found.model.num_points == model.num_points
    assert found.model.num_observations == model.num_observations


def in_both(model: Reconstruction, a: Reconstruction, b: Reconstruction) -> torch.Tensor:
    """Points of the whole that both parts have."""
    kept = []
    for part in (a, b):
        images = torch.tensor([model.names.index(name) for name in part.names])
        mine = torch.isin(model.view, images)
        kept.append((torch.bincount(model.point[mine], minlength=model.num_points) >= 2).nonzero()[:, 0])
    return kept[0][torch.isin(kept[0], kept[1])]


def test_noise_and_errors_of_the_parts_are_adjusted_away(generator: torch.Generator) -> None:
    model = whole_model(generator)
    a, b = halves(model, 3, generator)
    # The parts were estimated by themselves: one is a little wrong in its camera and poses.
    K = b.cameras.K.clone()
    K[..., :2, :2] *= 1.01
    shaken = b.poses.t + 0.3 * 0.01 * torch.randn(b.poses.t.shape, generator=generator, dtype=F64)
    b = replace(b, cameras=Camera(K, NoDistortion()), poses=Pose(b.poses.R, shaken))
    found = merge_models(a, b)
    assert not found.fault()
    errors = pose_errors(found.model.poses, model.poses)
    assert float(errors.pose.max()) < 0.3  # degrees; the shaken ones are up to a degree
    assert abs(float(found.model.cameras.K[0, 0, 0]) / 900 - 1) < 5e-3
    assert float(found.model.residuals().square().mean().sqrt()) < 1.2 * 0.3 * math.sqrt(2)
    held = merge_models(a, replace(b, cameras=a.cameras), fixed_cameras=True)
    assert torch.equal(held.model.cameras.K, a.cameras.K)


def test_what_cannot_be_merged(generator: torch.Generator) -> None:
    model = whole_model(generator)
    a, b = halves(model, 4, generator)
    strangers = replace(b, names=tuple(f"other {name}" for name in b.names))
    assert "no image" in merge_models(a, strangers).fault()
    assert merge_models(a, strangers).model is not None
    other_size = replace(b, image_size=2 * b.image_size)
    assert "another size" in merge_models(a, other_size).fault()
    # The photographs are the same, but one model of them is wrong.
    wrong = halves(model, 4, generator)[1]
    turned = Pose(random_rotation(len(wrong.names), generator=generator, dtype=F64), wrong.poses.t)
    wrong = replace(wrong, X=wrong.X + torch.randn(wrong.X.shape, generator=generator, dtype=F64), poses=turned)
    assert "contradict" in merge_models(a, wrong).fault()
    # The names are the same, but the photographs are of something else.
    g = whole_model(generator)
    lie = halves(g, 4, generator)[1]
    turned = Pose(random_rotation(len(lie.names), generator=generator, dtype=F64), lie.poses.t)
    lie = replace(lie, X=lie.X + torch.randn(lie.X.shape, generator=generator, dtype=F64), poses=turned)
    # A few of so many image points are at the same place by chance.
    why = merge_models(a, lie).fault()
    assert "contradict" in why or "too little" in why
    one, other = halves(model, 1, generator)
    few = part_of_model(other, torch.ones(len(other.names), dtype=torch.bool))
    none = replace(few, x=few.x + 100.0)
    assert "too little" in merge_models(one, none).fault()


def test_the_command(tmp_path: Path, generator: torch.Generator) -> None:
    model = whole_model(generator)
    a, b = halves(model, 4, generator)
    for name, part in (("a", a), ("b", b)):
        part.save(tmp_path / f"{name}.npz")
    status, text, stderr = torchsfm("merge", tmp_path / "a.npz", tmp_path / "b.npz", "--out", tmp_path / "out.npz")
    assert status == 0, stderr
    assert "10 images" in text
    assert "4 images and" in text
    merged = Reconstruction.load(tmp_path / "out.npz")
    assert float(pose_errors(merged.poses, model.poses).pose.max()) < 0.3
    replace(b, names=tuple(f"other {name}" for name in b.names)).save(tmp_path / "b.npz")
    for words, message in (
        ((tmp_path / "a.npz", tmp_path / "b.npz"), "no image"),
        ((tmp_path / "a.npz",), "two models"),
        ((tmp_path / "a.npz", tmp_path / "none.npz"), "no such file"),
    ):
        status, _, stderr = torchsfm("merge", *words, "--out", tmp_path / "no.npz")
        assert status == 2
        assert_one_line(stderr.strip().splitlines()[-1], message)
    assert not (tmp_path / "no.npz").exists()
