"""Two models that share images as one."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from command_line import assert_one_line, torchsfm

from torchsfm.geometry import Camera, NoDistortion, Pose, Similarity, intrinsics, random_rotation
from torchsfm.reconstruction import Reconstruction
from torchsfm.reconstruction.evaluation import pose_errors
from torchsfm.reconstruction.merge import merge_models, part_of_model
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
    # The names are the same, but the photographs are of something else.
    g = whole_model(generator)
    lie = halves(g, 4, generator)[1]
    assert "contradict" in merge_models(a, replace(lie, X=lie.X + torch.randn(lie.X.shape, generator=generator, dtype=F64),
                                                   poses=Pose(random_rotation(len(lie.names), generator=generator, dtype=F64),
                                                              lie.poses.t))).fault()  # fmt: skip
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
