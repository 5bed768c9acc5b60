"""Folders for other programs: what is in them, that it fits together, and that nothing is lost or half there."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_model
import torch
from chance import seeded
from command_line import assert_one_line, torchsfm
from full_disk import full_disk

from torchsfm.formats import TARGETS, export_model, read_colmap, read_model, read_nerfstudio, undistorted_model
from torchsfm.geometry import Camera, NoDistortion
from torchsfm.images import read_image, save_image
from torchsfm.reconstruction import Lines, Reconstruction

LENSES = ("pinhole", "radial", "opencv", "fisheye")


def model_of(lens: str) -> Reconstruction:
    return small_model.make(lens)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A smooth picture under each of the model's names."""
    folder = tmp_path_factory.mktemp("photographs")
    row, column = torch.meshgrid(torch.linspace(0, 1, 600), torch.linspace(0, 1, 800), indexing="ij")
    for i, name in enumerate(small_model.make().names):
        image = torch.stack([0.5 + 0.4 * torch.sin(5 * row + i), 0.5 + 0.4 * torch.cos(6 * column), row * column])
        save_image(folder / name, image, quality=100)
    return folder


@pytest.mark.parametrize("centred", [False, True])
@pytest.mark.parametrize("alpha", [0.0, 1.0])
@pytest.mark.parametrize("lens", LENSES)
def test_undistorted_models_have_the_same_rays(lens: str, alpha: float, centred: bool) -> None:
    model = model_of(lens)
    new = undistorted_model(model, alpha=alpha, centred=centred)
    assert isinstance(new.cameras.distortion, NoDistortion)
    assert new.names == tuple(name for name, kept in zip(model.names, model.registered.tolist(), strict=True) if kept)
    assert bool(new.registered.all())
    assert new.X.equal(model.X)
    camera = new.cameras[new.camera_index[new.view]]
    x = camera.unproject(new.x[:, None])[0]
    old = model.cameras[model.camera_index[:3][new.view]].project(x)[:, 0]
    # Which observations they were: by their image and point.
    key, wanted = new.point * 10 + new.view, model.point * 10 + model.view
    place = torch.searchsorted(wanted, key)
    assert wanted[place].equal(key)
    torch.testing.assert_close(old, model.x[place], rtol=0, atol=1e-9)
    assert len(new.x) > 0.8 * len(model.x)
    if centred:
        middle = (new.image_size[0] - 1).double() / 2
        torch.testing.assert_close(new.cameras.K[0, :2, 2], middle)


def test_segments_of_lines_move_with_the_pictures() -> None:
    model, n = model_of("radial"), 20
    ends = torch.stack([model.X[:n], model.X[n // 2 : n + n // 2]], 1)
    view, line = torch.arange(3).repeat(n), torch.arange(n).repeat_interleave(3)
    x = model.poses[view].transform(ends[line])
    x = model.cameras[model.camera_index[view]].project(x)
    lines = Lines(ends, torch.rand(n, 3, generator=seeded(), dtype=x.dtype), x, torch.ones(3 * n, dtype=x.dtype), view, line)
    # The image without a pose stands in front, so that all others get other numbers.
    order = torch.tensor([3, 0, 1, 2])
    moved = replace(
        model,
        names=tuple(model.names[i] for i in order),
        image_size=model.image_size[order],
        camera_index=model.camera_index[order],
        poses=model.poses[order],
        registered=model.registered[order],
        view=model.view + 1,
        lines=replace(lines, view=view + 1),
    )
    new = undistorted_model(moved)
    assert new.lines is not None
    assert new.lines.view.equal(view)
    torch.testing.assert_close(new.line_residuals(), torch.zeros(3 * n, 2, dtype=x.dtype), rtol=0, atol=1e-9)
    projected = new.cameras[new.camera_index[view]].project(new.poses[view].transform(ends[line]))
    torch.testing.assert_close(new.lines.x, projected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_gsplat_gets_pinholes_and_pictures_that_fit(lens: str, photographs: Path, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model = model_of(lens)
    out = export_model(model, "gsplat", tmp_path / "scene", images=photographs)
    assert {path.name for path in out.iterdir()} == {"images", "sparse", ".torchsfm-export"}
    scene = pycolmap.Reconstruction(out / "sparse" / "0")
    assert {camera.model.name for camera in scene.cameras.values()} <= {"PINHOLE", "SIMPLE_PINHOLE"}
    assert {image.name for image in scene.images.values()} == {path.name for path in (out / "images").iterdir()}
    again, wanted = read_colmap(out / "sparse" / "0"), undistorted_model(model)
    torch.testing.assert_close(again.residuals(), wanted.residuals(), rtol=0, atol=1e-9)
    for image in scene.images.values():
        picture = read_image(out / "images" / image.name)
        assert picture.size == (scene.cameras[image.camera_id].width, scene.cameras[image.camera_id].height)
        for seen in image.points2D:
            projected = image.project_point(scene.points3D[seen.point3D_id].xyz)
            row = (wanted.point == seen.point3D_id - 1) & (wanted.view == image.image_id - 1)
            ours = wanted.projections()[row][0]
            assert np.abs(projected - 0.5 - ours.numpy()).max() < 1e-6


def test_pictures_as_taken_are_the_same_files(photographs: Path, tmp_path: Path) -> None:
    model = small_model.make("radial")
    out = export_model(model, "gsplat", tmp_path / "scene", images=photographs, undistort=False)
    for name in model.names[:3]:
        assert (out / "images" / name).read_bytes() == (photographs / name).read_bytes()
    torch.testing.assert_close(read_model(out).residuals(), model.residuals(), rtol=0, atol=1e-9)


@pytest.mark.reference
@pytest.mark.parametrize("lens", ["pinhole", "simple_radial", "radial", "opencv", "fisheye"])
def test_gsplat_gets_lenses_as_opencv_has_them(lens: str, photographs: Path, tmp_path: Path) -> None:
    """Its parser takes k1, k2 and p1, p2 or k3, k4 from pycolmap, and projects as OpenCV does; pixel centres are at halves."""
    pycolmap, cv2 = pytest.importorskip("pycolmap"), pytest.importorskip("cv2")
    model = model_of(lens)
    if lens == "opencv":
        k = model.cameras.distortion.parameters().clone()
        k[:, model.cameras.distortion.parameter_names.index("k3")] = 0
        model = replace(model, cameras=Camera(model.cameras.K, type(model.cameras.distortion).from_parameters(k)))
    scene = pycolmap.Reconstruction(
        export_model(model, "gsplat", tmp_path / "scene", images=photographs, undistort=False) / "sparse" / "0"
    )
    where = {"SIMPLE_PINHOLE": (), "PINHOLE": (), "SIMPLE_RADIAL": (3,), "RADIAL": (3, 4)}
    where |= dict.fromkeys(("OPENCV", "OPENCV_FISHEYE"), (4, 5, 6, 7))
    projections, count = model.projections().numpy(), 0
    for image in scene.images.values():
        camera = scene.cameras[image.camera_id]
        K = camera.calibration_matrix()
        numbers = np.zeros(4)
        for place, index in enumerate(where[camera.model.name]):
            numbers[place] = camera.params[index]
        pose = image.cam_from_world().matrix()
        rows = (model.view == model.names.index(image.name)).nonzero()[:, 0].numpy()
        X = model.X[model.point[rows]].numpy().reshape(-1, 1, 3)
        project = cv2.fisheye.projectPoints if camera.model.name == "OPENCV_FISHEYE" else cv2.projectPoints
        x = project(X, cv2.Rodrigues(pose[:, :3])[0], pose[:, 3], K, numbers)[0]
        assert np.abs(x.reshape(-1, 2) - 0.5 - projections[rows]).max() < 1e-6
        count += len(rows)
    assert count == len(model.x)


def test_cameras_that_gsplat_refuses_are_not_written(photographs: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="k3"):
        export_model(small_model.make("opencv"), "gsplat", tmp_path / "scene", images=photographs, undistort=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("undistort", [True, False])
@pytest.mark.parametrize("lens", LENSES)
def test_transforms_json_projects_as_its_documentation_says(
    lens: str, undistort: bool, photographs: Path, tmp_path: Path
) -> None:
    """World from camera with OpenGL's axes, pixel centres at halves, OPENCV distortion, fisheye by the angle."""
    model = model_of(lens)
    out = export_model(model, "nerfstudio", tmp_path / "scene", images=photographs, undistort=undistort)
    wanted = undistorted_model(model) if undistort else model
    content = json.loads((out / "transforms.json").read_text())
    frames = {frame["file_path"]: frame for frame in content["frames"]}
    assert set(frames) == {f"images/{path.name}" for path in (out / "images").iterdir()}
    projections = wanted.projections()
    for row in range(len(wanted.x)):
        frame = frames[f"images/{wanted.names[int(wanted.view[row])]}"]
        X = np.linalg.inv(np.array(frame["transform_matrix"])) @ [*wanted.X[wanted.point[row]].tolist(), 1]
        x, y = X[0] / -X[2], -X[1] / -X[2]
        k1, k2, k3, k4, p1, p2 = (frame.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
        r = np.hypot(x, y)
        if frame["camera_model"] == "OPENCV_FISHEYE":
            theta = np.arctan(r)
            scale = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8) / r
            u, v = x * scale, y * scale
        else:
            radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6 + k4 * r**8
            u = x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x * x)
            v = y * radial + 2 * p2 * x * y + p1 * (r**2 + 2 * y * y)
        pixel = np.array([frame["fl_x"] * u + frame["cx"], frame["fl_y"] * v + frame["cy"]])
        assert np.abs(pixel - 0.5 - projections[row].numpy()).max() < 1e-6
    again = read_nerfstudio(out / "transforms.json")
    assert again.names == wanted.names[:3]
    assert again.X.equal(model.X)
    torch.testing.assert_close(again.poses.matrix(), wanted.poses[:3].matrix(), rtol=0, atol=1e-9)
    K, wanted_K = again.cameras.K[again.camera_index], wanted.cameras.K[wanted.camera_index[:3]]
    torch.testing.assert_close(K, wanted_K, rtol=0, atol=1e-9)
    assert type(again.cameras.distortion) is type(wanted.cameras.distortion)
    torch.testing.assert_close(again.cameras.distortion.parameters(), wanted.cameras.distortion.parameters(), rtol=0, atol=0)


def test_the_pictures_are_those_of_the_pinhole(photographs: Path, tmp_path: Path) -> None:
    """OpenCV's undistortion of the files, within one grey level; the PNG of an undistorted file is not packed anew."""
    cv2 = pytest.importorskip("cv2")
    folder = tmp_path / "png"
    folder.mkdir()
    model = small_model.make("opencv")
    model = replace(model, names=tuple(f"{i}.png" for i in range(4)))
    for old, new in zip(small_model.make().names, model.names, strict=True):
        save_image(folder / new, read_image(photographs / old).pixels)
    out = export_model(model, "gsplat", tmp_path / "scene", images=folder)
    target = read_colmap(out / "sparse" / "0")
    lens = model.cameras.distortion.parameters()[0].numpy()
    for i, name in enumerate(target.names):
        size = tuple(target.image_size[i].tolist())
        K, K2 = model.cameras.K[0].numpy(), target.cameras.K[target.camera_index[i]].numpy()
        maps = cv2.initUndistortRectifyMap(K, lens, None, K2, size, cv2.CV_32FC1)
        theirs = cv2.remap(cv2.imread(str(folder / name)), *maps, cv2.INTER_LINEAR)
        mine = cv2.imread(str(out / "images" / name))
        assert mine.shape == theirs.shape
        assert np.abs(mine.astype(int) - theirs).max() <= 1


@pytest.mark.parametrize("target", ["bundler", "nvm", "openmvg", "opensfm", "colmap", "colmap-text"])
def test_what_is_exported_comes_back(target: str, photographs: Path, tmp_path: Path) -> None:
    """With the sizes of the pictures, where the format does not tell them."""
    model = small_model.make("radial")
    out = export_model(model, target, tmp_path / "scene", images=photographs)
    wanted = undistorted_model(model, centred=True) if TARGETS[target].pictures else model
    again = read_model(out)
    assert again.num_registered == 3
    assert again.image_size[:3].equal(wanted.image_size[:3])
    for name in ("X", "x", "view", "point"):
        torch.testing.assert_close(getattr(again, name), getattr(wanted, name), rtol=0, atol=1e-9)
    torch.testing.assert_close(again.projections(), wanted.projections(), rtol=0, atol=1e-9)


def test_an_export_replaces_an_earlier_one_and_nothing_else(photographs: Path, tmp_path: Path) -> None:
    model, out = small_model.make("radial"), tmp_path / "scene"
    export_model(model, "nerfstudio", out, images=photographs)
    export_model(model, "gsplat", out, images=photographs)
    assert {path.name for path in out.iterdir()} == {"images", "sparse", ".torchsfm-export"}
    (out / "results").mkdir()
    (out / "results" / "weights.pt").write_bytes(b"x")
    before = sorted(path for path in tmp_path.rglob("*"))
    with pytest.raises(ValueError, match=r"weights\.pt"):
        export_model(model, "gsplat", out, images=photographs)
    mine = tmp_path / "mine"
    (mine / "images").mkdir(parents=True)
    (mine / "images" / "a.jpg").write_bytes(b"x")
    with pytest.raises(ValueError, match=r"holds images.a\.jpg"):
        export_model(model, "gsplat", mine, images=photographs)
    assert sorted(path for path in tmp_path.rglob("*") if mine not in (path, *path.parents)) == before


def test_nothing_is_there_half(photographs: Path, tmp_path: Path) -> None:
    model, out = small_model.make("radial"), tmp_path / "scene"
    with full_disk(20_000), pytest.raises((OSError, ValueError)):
        export_model(model, "gsplat", out, images=photographs)
    assert not list(tmp_path.iterdir())
    for names, words in (
        (("a.jpg", "../b.jpg", "c.jpg", "d.jpg"), "leads out"),
        (("/a.jpg", "b.jpg", "c.jpg", "d.jpg"), "leads out"),
        (("a.jpg", "missing.jpg", "c.jpg", "d.jpg"), "no such file"),
        (("a.jpg", "a.jpg", "c.jpg", "d.jpg"), "two images"),
    ):
        with pytest.raises(ValueError, match=words):
            export_model(replace(model, names=names), "gsplat", out, images=photographs)
    half = replace(model, image_size=model.image_size // 2)
    with pytest.raises(ValueError, match=r"800 x 600 pixels, in the model 400 x 300"):
        export_model(half, "gsplat", out, images=photographs)
    with pytest.raises(ValueError, match="wants pictures"):
        export_model(model, "gsplat", out)
    with pytest.raises(ValueError, match="there is no 'blendr'"):
        export_model(model, "blendr", out)
    assert not list(tmp_path.iterdir())


def test_names_of_pictures_that_cannot_be_kept(tmp_path: Path) -> None:
    model = small_model.make("radial")
    model = replace(model, names=("left/a.pgm", "right/a.pgm", "c.tif", "d.jpg"))
    for name in model.names[:3]:
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        save_image(tmp_path / "in" / name, torch.rand(1, 600, 800, generator=seeded()))
    out = export_model(model, "nerfstudio", tmp_path / "scene", images=tmp_path / "in")
    assert read_model(out).names == ("left/a.pgm.png", "right/a.pgm.png", "c.tif")


@pytest.mark.parametrize("target", TARGETS)
def test_the_command(target: str, photographs: Path, tmp_path: Path) -> None:
    small_model.make("radial").save(tmp_path / "model.npz")
    status, text, stderr = torchsfm(
        "export", tmp_path / "model.npz", "--for", target, "--out", tmp_path / "out", "--images", photographs
    )
    assert status == 0, stderr
    assert TARGETS[target].what in text
    status, _, stderr = torchsfm("export", tmp_path / "model.npz", "--for", "blendr", "--out", tmp_path / "out")
    assert status == 2
    assert "gsplat" in stderr


def test_the_command_in_trouble(tmp_path: Path) -> None:
    small_model.make("radial").save(tmp_path / "model.npz")
    words = ("export", tmp_path / "model.npz", "--for", "gsplat", "--out", tmp_path / "out")
    status, _, stderr = torchsfm(*words)
    assert status == 2
    assert "say in which folder the photographs lie" in stderr
    status, _, stderr = torchsfm(*words, "--images", tmp_path / "nowhere")
    assert status == 2
    assert "no such file" in stderr
    status, _, stderr = torchsfm("export", tmp_path / "none", "--for", "colmap", "--out", tmp_path / "out")
    assert status == 2
    assert_one_line(stderr, "no such file or folder")


def test_convert_there_and_back(tmp_path: Path) -> None:
    model = small_model.make("radial")
    model.save(tmp_path / "model.npz")
    source = tmp_path / "model.npz"
    for name, options in (("colmap", ()), ("text", ("--to", "colmap-text")), ("back.npz", ())):
        status, text, stderr = torchsfm("convert", source, tmp_path / name, *options)
        assert status == 0, stderr
        assert "3 images, 30 points" in text
        source = tmp_path / name
        status, text, _ = torchsfm("info", source)
        assert status == 0
        assert "3 of 4 images registered" in text
    torch.testing.assert_close(read_model(source).residuals(), model.residuals(), rtol=0, atol=1e-9)
    status, _, stderr = torchsfm("convert", source, tmp_path / "model.unknown")
    assert status == 2
    assert "tells no format" in stderr
