"""The reader of Oxford's multi-view data sets."""

from pathlib import Path

import pytest
import torch

from torchsfm.formats import read_vgg
from torchsfm.geometry import project_points


def write(folder: Path, *, lines: bool = True) -> None:
    (folder / "2D").mkdir(parents=True)
    (folder / "3D").mkdir()
    for view in range(2):
        (folder / "3D" / f"toy.{view:03d}.P").write_text("1 0 0 0\n0 1 0 0\n0 0 1 2\n")
        (folder / "2D" / f"toy.{view:03d}.corners").write_text("1 2\n3.5 4\n")
        if lines:
            (folder / "2D" / f"toy.{view:03d}.lines").write_text("0 1 2 3 20.5 1.4\n")
    (folder / "2D" / "toy.nview-corners").write_text("0 1\n1 *\n-1 0\n")
    (folder / "3D" / "toy.p3d").write_text("0 0 1\n0 1 1\n1 1 1\n")
    if lines:
        (folder / "2D" / "toy.nview-lines").write_text("0 *\n")
        (folder / "3D" / "toy.l3d").write_text("0 0 1 1 1 1\n")


def test_matches_are_put_in_order(tmp_path: Path) -> None:
    write(tmp_path)
    scene = read_vgg(tmp_path)
    assert scene.visible.tolist() == [[True, True, False], [True, False, True]]
    assert scene.x.tolist() == [[[1, 2], [3.5, 4], [0, 0]], [[3.5, 4], [0, 0], [1, 2]]]
    assert scene.segments.tolist() == [[[[0, 1], [2, 3]]], [[[0, 0], [0, 0]]]]
    assert scene.segments_visible.tolist() == [[True], [False]]
    assert scene.L.shape == (1, 2, 3)
    assert scene.P.dtype == torch.float64


def test_lines_may_be_absent(tmp_path: Path) -> None:
    write(tmp_path, lines=False)
    scene = read_vgg(str(tmp_path))
    assert scene.segments.shape == (2, 0, 2, 2)
    assert scene.L.shape == (0, 2, 3)


@pytest.mark.parametrize(
    ("file", "text", "match"),
    [
        ("3D/toy.001.P", None, "as many cameras"),
        ("3D/toy.000.P", "1 0 0\n", "wanted 4 numbers"),
        ("3D/toy.000.P", "1 0 0 0\n", "three rows"),
        ("2D/toy.000.corners", "1\n", "wanted 2 numbers"),
        ("2D/toy.000.corners", "1 2\n", "is not in toy.000.corners"),
        ("2D/toy.nview-corners", "0 1 2\n", "wanted 2 numbers"),
        ("2D/toy.nview-corners", "0 x\n", "wanted 2 numbers"),
        ("2D/toy.nview-corners", "0 1 1 0\n", "wanted 2 numbers"),
        ("2D/toy.nview-corners", "0 -7\n", "feature -7 is none"),
        ("2D/toy.nview-corners", "0 99999999999999999999\n", "wanted 2 numbers"),
        ("2D/toy.000.corners", "1 nan\n", "not finite"),
        ("3D/toy.000.P", "1 0 0 0\n0 1 0 0\n0 0 inf 0\n", r"toy\.000\.P: line 3 of numbers is not finite"),
        ("3D/toy.p3d", "0 0 1\n", "as many points"),
        ("3D/toy.l3d", None, "wanted one file"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, file: str, text: str | None, match: str) -> None:
    write(tmp_path)
    if text is None:
        (tmp_path / file).unlink()
    else:
        (tmp_path / file).write_text(text)
    with pytest.raises(ValueError, match=match):
        read_vgg(tmp_path)


@pytest.mark.parametrize(
    ("name", "views", "points", "lines", "rms"),
    [
        ("model_house", 10, 672, 30, 0.625),
        ("corridor", 11, 737, 69, 0.554),
        ("merton1", 3, 717, 295, 0.168),
        ("library", 3, 667, 253, 0.245),
    ],
)
def test_published_cameras_fit_the_published_points(
    data: Path, name: str, views: int, points: int, lines: int, rms: float
) -> None:
    scene = read_vgg(data / "vgg" / name)
    assert scene.x.shape == (views, points, 2)
    assert scene.segments.shape == (views, lines, 2, 2)
    error = torch.linalg.vector_norm(project_points(scene.P, scene.X.expand(views, -1, -1)) - scene.x, dim=-1)
    assert error[scene.visible].square().mean().sqrt().item() == pytest.approx(rms, abs=6e-4)
