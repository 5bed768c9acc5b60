"""Models in the frame of others, of measured points, and at other scales."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from chance import seeded
from command_line import assert_one_line, torchsfm

from torchsfm._types import Status
from torchsfm.geometry import DISTORTION_MODELS, Camera, Pose, Similarity, intrinsics, random_rotation
from torchsfm.reconstruction import Reconstruction
from torchsfm.reconstruction.model.alignment import ControlPoints, align_models, align_to_points
from torchsfm.simulation import look_at, random_points

F64 = torch.float64


def make(centres: torch.Tensor, *, points: int = 12) -> Reconstruction:
    """Cameras at these places that look at points around the origin; every image shows all points exactly."""
    g = seeded(3)
    v = len(centres)
    X = random_points(points, generator=g)
    f, c = torch.tensor([900.0], dtype=F64), torch.tensor([[399.5, 299.5]], dtype=F64)
    lens = DISTORTION_MODELS["radial"].from_parameters(torch.tensor([[0.05, -0.01]], dtype=F64))
    view, point = torch.arange(v).repeat(points), torch.arange(points).repeat_interleave(v)
    model = Reconstruction(
        names=tuple(f"image {i}.jpg" for i in range(v)),
        image_size=torch.tensor([[800, 600]] * v),
        cameras=Camera(intrinsics(f, c), lens),
        camera_index=torch.zeros(v, dtype=torch.long),
        poses=look_at(centres, torch.zeros(3, dtype=F64)),
        registered=torch.ones(v, dtype=torch.bool),
        X=X,
        color=torch.full_like(X, 0.5),
        x=torch.zeros(v * points, 2, dtype=F64),
        view=view,
        point=point,
    )
    return replace(model, x=model.projections())


def places(v: int, seed: int = 0, *, line: bool = False) -> torch.Tensor:
    g = seeded(seed)
    spread = torch.randn(v, 3, generator=g, dtype=F64)
    if line:
        spread = spread[:, :1] * torch.tensor([1.0, 0.3, 0.1], dtype=F64)
    return spread + torch.tensor([0.0, -6.0, 1.0], dtype=F64)


def other_frame(seed: int = 0) -> Similarity:
    g = seeded(seed)
    R = random_rotation(1, generator=g, dtype=F64)[0]
    return Similarity(torch.tensor(3.7, dtype=F64), R, torch.randn(3, generator=g, dtype=F64))


@pytest.mark.parametrize(("v", "line"), [(2, False), (3, False), (4, True), (9, False)])
def test_the_frame_of_another_model(v: int, line: bool) -> None:
    model, s = make(places(v, line=line)), other_frame()
    other = model.transform(s)
    # The other one has its images in another order.
    order = torch.randperm(v, generator=seeded())
    other = replace(other, names=tuple(other.names[i] for i in order), poses=other.poses[order])
    found = align_models(model, other)
    assert not found.fault()
    assert found.names == model.names
    assert bool(found.used.all())
    torch.testing.assert_close(found.similarity.matrix(), s.matrix(), rtol=0, atol=1e-8)


def test_misplaced_images_are_left_aside() -> None:
    model, s = make(places(11)), other_frame()
    other = model.transform(s)
    g = seeded(9)
    bad = torch.tensor([1, 4, 6, 9])
    R, t = other.poses.R.clone(), other.poses.t.clone()
    R[bad] = random_rotation(len(bad), generator=g, dtype=F64)
    t[bad] += 20 * torch.randn(len(bad), 3, generator=g, dtype=F64)
    found = align_models(model, replace(other, poses=Pose(R, t)))
    assert (~found.used).nonzero()[:, 0].tolist() == bad.tolist()
    torch.testing.assert_close(found.similarity.matrix(), s.matrix(), rtol=0, atol=1e-8)


def test_what_does_not_tell_the_frame() -> None:
    model = make(places(3))
    strangers = replace(model, names=("a", "b", "image 2.jpg"))
    assert align_models(model, strangers).similarity.status == Status.TOO_FEW
    assert "1 in common" in align_models(model, strangers).fault()
    still = make(places(1).expand(3, 3).clone())
    assert align_models(model, still).similarity.status == Status.DEGENERATE
    unposed = replace(model, registered=torch.tensor([True, False, False]))
    assert align_models(model, unposed).similarity.status == Status.TOO_FEW


def control(model: Reconstruction, X: torch.Tensor, count: int) -> ControlPoints:
    """Some of the model's points as if they had been measured."""
    rows = model.point < count
    images = tuple(model.names[i] for i in model.view[rows].tolist())
    return ControlPoints(tuple(f"p{k}" for k in range(count)), X[:count], images, model.x[rows], model.point[rows])


def test_measured_points() -> None:
    model, s = make(places(4)), other_frame()
    found = align_to_points(model, control(model, s.transform(model.X), 5))
    assert not found.fault()
    torch.testing.assert_close(found.similarity.matrix(), s.matrix(), rtol=0, atol=1e-7)
    assert float(found.distance.max()) < 1e-7
    few = align_to_points(model, control(model, s.transform(model.X), 2))
    assert few.similarity.status == Status.TOO_FEW
    # A point that one image alone shows says nothing, nor does an image without a pose.
    one = control(model, s.transform(model.X), 5)
    strange = replace(one, images=tuple(name if p < 4 or i % 4 else "?" for i, (name, p) in enumerate(zip(one.images, one.point.tolist(), strict=True))))  # fmt: skip # noqa: E501
    torch.testing.assert_close(align_to_points(model, strange).similarity.matrix(), s.matrix(), rtol=0, atol=1e-7)
    line = torch.arange(5, dtype=F64)[:, None] * torch.ones(3, dtype=F64)
    assert "on one line" in align_to_points(model, control(model, line, 5)).fault()


def test_the_command(tmp_path: Path) -> None:
    model, s = make(places(4)), other_frame()
    target = model.transform(s)
    model.save(tmp_path / "model.npz")
    target.save(tmp_path / "target.npz")
    measured = control(model, target.X, 4)
    lines = ["# measured"]
    for image, (x, y), k in zip(measured.images, measured.x.tolist(), measured.point.tolist(), strict=True):
        lines.append(" ".join(map(str, [measured.names[k], *measured.X[k].tolist(), image, x, y])))
    (tmp_path / "points.txt").write_text("\n".join(lines))
    for words in (("--to", tmp_path / "target.npz"), ("--points", tmp_path / "points.txt")):
        status, text, stderr = torchsfm("align", tmp_path / "model.npz", *words, "--out", tmp_path / "out.npz")
        assert status == 0, stderr
        assert "4 of 4" in text
        moved = Reconstruction.load(tmp_path / "out.npz")
        torch.testing.assert_close(moved.X, target.X, rtol=0, atol=1e-7)
        torch.testing.assert_close(moved.residuals(), model.residuals(), rtol=0, atol=1e-7)
    status, _, stderr = torchsfm("align", tmp_path / "model.npz", "--scale", 2.5, "--out", tmp_path / "big.npz")
    assert status == 0, stderr
    torch.testing.assert_close(Reconstruction.load(tmp_path / "big.npz").X, 2.5 * model.X)
    (tmp_path / "bad.txt").write_text("p 1 2 3 a.jpg 4\n")
    for words, message in (
        (("--scale", -1), "positive"),
        ((), "wanted one of"),
        (("--scale", 1, "--to", tmp_path / "target.npz"), "wanted one of"),
        (("--points", tmp_path / "bad.txt"), "line 1: wanted NAME X Y Z IMAGE x y"),
        (("--points", tmp_path / "none.txt"), "cannot be read"),
        (("--to", tmp_path / "none"), "no such file"),
    ):
        status, _, stderr = torchsfm("align", tmp_path / "model.npz", *words, "--out", tmp_path / "no.npz")
        assert status == 2
        assert_one_line(stderr, message)
    assert not (tmp_path / "no.npz").exists()
