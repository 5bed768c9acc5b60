"""Sequences by their edges alone: what is refused, and why; and a rendered one from images to cameras."""

import math
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from command_line import torchsfm
from painted_box import photograph
from torch import Tensor

from torchsfm.geometry import Camera, Pose, intrinsics, project_points, rotation_angle, rotation_from_rotvec
from torchsfm.geometry.distortion import Radial
from torchsfm.images import detect_edges, read_image, save_image
from torchsfm.linalg import nearest_rotation
from torchsfm.reconstruction import ReconstructionError, reconstruct
from torchsfm.reconstruction.curves import sequence as curve_sequence
from torchsfm.reconstruction.curves.chains import Chain
from torchsfm.reconstruction.curves.frames import Frames
from torchsfm.reconstruction.curves.image_edges import ImageEdges
from torchsfm.reconstruction.curves.sequence import Expected, map_sequence
from torchsfm.reconstruction.curves.start import FirstCameras
from torchsfm.reconstruction.curves.windows import Window, as_edges, window_at
from torchsfm.simulation import orbit_poses, paint_shapes

F64 = torch.float64
FOCAL = 360.0


def test_edges_of_frames_are_those_that_are_followed() -> None:
    images = photograph(orbit_poses(3, radius=5.5, sweep=0.1))
    straight = detect_edges(images)
    again = as_edges([ImageEdges.of(image) for image in images])
    for i in range(len(images)):
        good = straight.valid[i]
        n = int(good.sum())
        assert again.valid[i].sum() == n
        assert torch.equal(again.x[i, :n], straight.x[i, good])
        assert torch.equal(again.chain[i, :n], straight.chain[i, good])
        cosine = torch.nn.functional.cosine_similarity(again.gradient[i, :n], straight.gradient[i, good], dim=-1)
        assert (cosine > 0.7).float().mean() > 0.95
        assert (again.closed[i, :n] == straight.closed[i, good]).float().mean() > 0.9


def painted(folder: Path, frames: int, generator: torch.Generator) -> Pose:
    """Photographs of flat shapes without a corner, each in a plane of its own, the camera on an arc around them."""

    def rand(*shape: int) -> Tensor:
        return 2 * torch.rand(*shape, dtype=F64, generator=generator) - 1

    t = torch.arange(72, dtype=F64) * (2 * math.pi / 72)
    r = 0.5 * (1 + 0.12 * (2 * t + 3 * rand(9, 1)).cos() + 0.05 * (3 * t + 3 * rand(9, 1)).cos())
    flat = torch.stack((r * t.cos(), r * t.sin(), 0 * r), -1)
    place = torch.tensor([[x, y] for y in (-1.25, 0.0, 1.25) for x in (-1.5, 0.0, 1.5)], dtype=F64)
    depth = 0.8 * torch.tensor([1, -1, 0.3, -0.5, 0.8, -1, 0.5, -0.2, 1], dtype=F64)[:, None]
    shapes = flat @ rotation_from_rotvec(0.5 * rand(9, 3)).mT + torch.cat((place, depth), -1)[:, None]
    turn = math.radians(4.0) * (torch.arange(frames, dtype=F64)[:, None] - frames // 2)
    R = rotation_from_rotvec(turn * torch.tensor([0.3, 1.0, 0.0], dtype=F64) + 0.005 * rand(frames, 3))
    poses = Pose(R, torch.tensor([0.0, 0.0, 6.0], dtype=F64) + 0.05 * rand(frames, 3))
    K = intrinsics(torch.tensor(FOCAL, dtype=F64), torch.tensor([159.5, 119.5], dtype=F64))
    outlines = project_points(K @ poses.matrix(), shapes.flatten(0, 1)).unflatten(1, (9, -1))
    grey = torch.tensor([0.5, 0.9, 0.1, 0.8, 0.2, 0.95, 0.15, 0.85, 0.1, 0.9], dtype=F64)
    for i, x in enumerate(outlines):
        image = paint_shapes(list(x), grey, width=320, height=240, fine=4)
        save_image(folder / f"{i}.png", image + 0.005 * torch.randn(image.shape, dtype=F64, generator=generator))
    return poses


def test_windows_are_joined_with_one_focal_length(
    tmp_path: Path, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Windows that found 0.88, 1 and 1.12 times the focal length have about one before cameras of all frames begin there."""
    poses = painted(tmp_path, 8, generator)
    frames = Frames([ImageEdges.of(read_image(tmp_path / f"{i}.png").pixels) for i in range(8)])
    centre, zero = torch.tensor([159.5, 119.5], dtype=F64), torch.zeros((), dtype=F64)
    zooms = dict(enumerate((0.88, 1.0, 1.12)))
    windows = []
    for first, zoom in zooms.items():
        views = torch.arange(first, first + 5)
        own = poses[views] @ poses[first + 2].inverse()
        true = Window(views, FirstCameras(own, zero, zero.new_zeros(0, 3), ""))
        K = intrinsics(zoom * torch.tensor(FOCAL, dtype=F64), centre)
        windows.append(window_at(frames, first, K, 1e-4, true))
    # One of which the frames show another motion.
    roll = rotation_from_rotvec(torch.tensor([[0.0, 0.0, 0.3 * (-1) ** k] for k in range(5)], dtype=F64))
    lost = replace(windows[1], found=replace(windows[1].found, poses=Pose(roll, windows[1].found.poses.t)))
    joined: list[Window] = []

    def chains(given: Sequence[Window]) -> list[Chain]:
        joined.extend(given)
        return []

    monkeypatch.setattr(curve_sequence, "all_windows", lambda *given: [*windows, lost])
    monkeypatch.setattr(curve_sequence, "chains", chains)
    K = intrinsics(torch.tensor(FOCAL, dtype=F64), centre)
    expected = Expected(Camera(K, Radial(zero, zero)), ("focal",), {"focal": 0.5})
    assert map_sequence(frames, (240, 320), expected, lambda *news: None)[0] == []
    *alike, other = joined
    assert other is lost

    def off(some: Sequence[Window]) -> Tensor:
        return torch.stack(
            [
                rotation_angle(one.found.poses.R @ (poses.R[one.views] @ poses.R[one.middle].mT).mT).rad2deg().amax()
                for one in (some[0], some[2])
            ]
        )

    assert [float(one.found.focal) / FOCAL for one in windows] == pytest.approx(list(zooms.values()), abs=0.01)
    assert [float(one.found.focal) / FOCAL for one in alike] == pytest.approx([1.0] * 3, abs=0.04)
    assert bool((off(alike) < 0.7 * off(windows)).all())
    given = replace(expected, free=())
    joined.clear()
    map_sequence(frames, (240, 320), given, lambda *news: None)
    assert all(one is before for one, before in zip(joined, windows, strict=False))


@pytest.mark.slow
def test_cameras_and_curves_without_points(tmp_path: Path, generator: torch.Generator) -> None:
    poses = painted(tmp_path, 8, generator)
    found = reconstruct(tmp_path, method="curves", camera="pinhole")
    model = found.model
    assert bool(model.registered.all())
    turn = nearest_rotation((poses.R.mT @ model.poses.R).mean(0))
    assert rotation_angle(model.poses.R @ (poses.R @ turn).mT).rad2deg().max() < 1.0
    assert abs(float(model.cameras.K[0, 0, 0]) / FOCAL - 1) < 0.05
    assert {image.doubt for image in found.report.images} == {""}
    (known,) = found.report.calibrations
    assert known.names == ("focal", "cx", "cy")
    assert known.estimated.tolist() == [[True, False, False]]
    assert 0.002 * FOCAL < float(known.deviation[0, 0]) < 0.05 * FOCAL
    assert bool((known.deviation[0, 1:] <= known.prior[0, 1:]).all())
    assert bool((known.deviation[0, 1:] > 0.3 * known.prior[0, 1:]).all())
    assert model.curves is not None
    assert len(model.curves) >= 6
    assert model.curve_residuals().median() < 0.3


@pytest.mark.slow
def test_a_real_turntable_by_a_long_lens(data: Path, tmp_path: Path) -> None:
    """18 photographs 7.7 degrees apart, the lens twice as long as expected and its centre 17 px beside the middle."""
    folder = data / "images" / "temple_ring"
    rows = {name: numbers for name, *numbers in map(str.split, (folder / "templeR_par.txt").read_text().splitlines()[1:])}
    names = [f"templeR{k:04d}.png" for k in range(13, 31)]
    for name in names:
        shutil.copy(folder / name, tmp_path)
    numbers = torch.tensor([[float(n) for n in rows[name]] for name in names], dtype=F64)
    R = numbers[:, 9:18].unflatten(1, (3, 3))
    found = reconstruct(tmp_path, method="curves")
    model = found.model
    assert bool(model.registered.all())
    turn = nearest_rotation((R.mT @ model.poses.R).mean(0))
    assert rotation_angle(model.poses.R @ (R @ turn).mT).rad2deg().max() < 1.0
    assert abs(float(model.cameras.K[0, 0, 0]) / float(numbers[0, 0]) - 1) < 0.1
    assert {image.doubt for image in found.report.images} == {""}


@pytest.fixture
def blank(tmp_path: Path, generator: torch.Generator) -> Path:
    for i in range(5):
        save_image(tmp_path / f"{i}.png", 0.5 + 0.01 * torch.randn(1, 60, 80, generator=generator))
    return tmp_path


def test_frames_without_curves_are_refused(blank: Path) -> None:
    told = list[tuple[str, int, int]]()
    found = reconstruct(blank, method="curves", progress=lambda *news: told.append(news))
    assert ("follow", 1, 1) in told
    assert found.models == ()
    assert "curves could be followed" in found.report.refusal
    assert {image.reason for image in found.report.images} == {found.report.refusal}
    with pytest.raises(ReconstructionError, match="curves could be followed"):
        _ = found.model


def test_few_frames_are_refused(blank: Path) -> None:
    found = reconstruct([blank / f"{i}.png" for i in range(3)], method="curves")
    assert found.report.refusal.startswith("3 frames")


def test_frames_of_two_sizes_and_files_that_are_no_images(blank: Path) -> None:
    (blank / "a.png").write_bytes(b"no image")
    assert reconstruct(blank, method="curves").report.images[-1].reason == "cannot be read as an image"
    save_image(blank / "b.png", torch.zeros(1, 50, 80))
    with pytest.raises(ReconstructionError, match="one size"):
        reconstruct(blank, method="curves")
    with pytest.raises(ReconstructionError, match="finds no lines"):
        reconstruct(blank, method="curves", lines=True)


def test_command_line_says_why(blank: Path, tmp_path: Path) -> None:
    status, _, stderr = torchsfm("reconstruct", blank, "--method", "curves", "--out", tmp_path / "out")
    assert status != 0
    assert "curves could be followed" in stderr
