"""New photographs into a model by the features that were kept of its own."""

import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
import torch
from command_line import assert_one_line, copies, photograph, torchsfm
from exif_blocks import FOCAL_35MM, MAKE, MODEL, encode, into_jpeg, tiff_block
from test_known_poses import truth

from torchsfm.cli.known_poses import find_features
from torchsfm.formats import read_features, write_colmap, write_database
from torchsfm.geometry import rotation_angle
from torchsfm.images import detect_features, read_image, save_image
from torchsfm.images.matching import match_descriptors
from torchsfm.reconstruction import (
    KnownFeatures,
    MatchedImages,
    Reconstruction,
    ReconstructionError,
    register_photographs,
    saved_features,
    triangulate_photographs,
)

NEW = "view2.png"
OLD = ("view0.png", "view1.png", "view3.png", "view4.png")


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return photograph(tmp_path_factory.mktemp("photographs"))


@pytest.fixture(scope="module")
def run(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over four of five photographs, which are gone afterwards."""
    folder = tmp_path_factory.mktemp("run")
    old = copies(photographs, folder / "images", *OLD)
    poses = truth()
    kept = torch.tensor([0, 1, 3, 4])
    some = replace(
        poses, names=OLD, image_size=poses.image_size[kept], camera_index=poses.camera_index[kept], poses=poses.poses[kept],
        registered=poses.registered[kept],
    )  # fmt: skip
    triangulate_photographs(old, some, out=folder).model.save(folder / "model.npz")
    shutil.rmtree(old)
    return folder


def assert_placed(model: Reconstruction, old: Reconstruction) -> None:
    poses = truth()
    assert model.names == (*OLD, NEW)
    assert bool(model.registered.all())
    assert torch.equal(model.poses.R[:4], old.poses.R)
    assert torch.equal(model.poses.t[:4], old.poses.t)
    assert torch.equal(model.cameras.K, old.cameras.K)
    assert float(rotation_angle(model.poses.R[4:] @ poses.poses.R[2:3].mT)) < 0.003
    assert float((model.poses.centre[4] - poses.poses.centre[2]).norm()) < 0.02
    seen = model.point[model.view == 4]
    assert len(seen) > 100
    assert model.num_points > 0.9 * old.num_points
    assert float(model.residuals().median()) < 0.5


def test_one_photograph_by_the_stages_of_a_run(photographs: Path, run: Path) -> None:
    old = Reconstruction.load(run / "model.npz")
    known = saved_features(run, old)
    assert known is not None
    result = register_photographs([photographs / NEW], old, known)
    assert_placed(result.model, old)
    # With the whole folder, what is old is passed over; and the same seed gives the same poses.
    assert torch.equal(register_photographs(photographs, old, known).model.poses.t, result.model.poses.t)


def test_the_photographs_of_the_model_are_not_judged_by_the_new_one(photographs: Path, run: Path) -> None:
    old = Reconstruction.load(run / "model.npz")
    known = saved_features(run, old)
    assert known is not None
    # Of each of them one pair is known here, that with the new one.
    report = register_photographs([photographs / NEW], old, known).report
    assert [image.doubt for image in report.images] == [""] * 5


@pytest.mark.parametrize(("along_x", "along_y", "cropped"), [(1.0, 1.15, True), (1.12, 1.0, True), (0.9, 1.2, False)])
def test_a_photograph_that_was_stretched_says_so_itself(
    photographs: Path, run: Path, tmp_path: Path, along_x: float, along_y: float, cropped: bool
) -> None:
    old = Reconstruction.load(run / "model.npz")
    known = saved_features(run, old)
    assert known is not None
    image = read_image(photographs / NEW).pixels
    h, w = image.shape[-2:]
    size = (round(along_y * h), round(along_x * w))
    image = torch.nn.functional.interpolate(image[None], size=size, mode="bilinear", antialias=True)[0]
    if cropped:
        top, left = ((now - before) // 2 for now, before in zip(size, (h, w), strict=True))
        image = image[:, top : top + h, left : left + w]
    save_image(tmp_path / NEW, image)
    result = register_photographs(tmp_path, old, known)
    poses, K = truth(), result.model.cameras.K[result.model.camera_index[4]]
    assert float(K[1, 1] / K[0, 0]) == pytest.approx(size[0] * w / (size[1] * h), rel=0.01)
    assert float(rotation_angle(result.model.poses.R[4] @ poses.poses.R[2].mT)) < 0.01
    assert torch.equal(result.model.poses.t[:4], old.poses.t)
    assert not result.report.images[4].doubt


def test_a_photograph_that_was_cropped_says_so_itself(photographs: Path, run: Path, tmp_path: Path) -> None:
    old = Reconstruction.load(run / "model.npz")
    known = saved_features(run, old)
    assert known is not None
    image = read_image(photographs / NEW).pixels
    h, w = image.shape[-2:]
    save_image(tmp_path / NEW, image[:, : round(0.85 * h), round(0.2 * w) :])
    result = register_photographs(tmp_path, old, known)
    poses, K = truth(), result.model.cameras.K
    shift = K[result.model.camera_index[4], :2, 2] - K[old.camera_index[0], :2, 2] + torch.tensor([round(0.2 * w), 0])
    assert float(shift.norm()) < 0.03 * w
    assert float((result.model.poses.centre[4] - poses.poses.centre[2]).norm()) < 0.05
    assert float(rotation_angle(result.model.poses.R[4] @ poses.poses.R[2].mT)) < 0.02
    assert not result.report.images[4].doubt


def test_photographs_cropped_by_a_program_that_keeps_their_tags(photographs: Path, run: Path, tmp_path: Path) -> None:
    """Of one camera and one size, with the focal length of the whole in millimetres, and cut out at different places."""
    old = Reconstruction.load(run / "model.npz")
    known = saved_features(run, old)
    assert known is not None
    f = float(old.cameras.K[0, 0, 0])
    for name, source, top, left in (("a.jpg", NEW, 0.0, 0.15), ("b.jpg", "view1.png", 0.15, 0.0)):
        image = cv2.imread(str(photographs / source))
        h, w = image.shape[:2]
        a, b = round(top * h), round(left * w)
        tags = tiff_block({MAKE: "Acme", MODEL: "Ix 1"}, {FOCAL_35MM: round(36 * f / w)})
        cropped = encode(image[a : a + round(0.85 * h), b : b + round(0.85 * w)], ".jpg")
        (tmp_path / name).write_bytes(into_jpeg(cropped, tags))
    assert read_image(tmp_path / "a.jpg").focal is not None
    model, poses = register_photographs(tmp_path, old, known).model, truth().poses
    assert bool(model.registered.all())
    for i, true in ((4, 2), (5, 1)):
        assert float(model.cameras.K[model.camera_index[i], 0, 0]) == pytest.approx(f, rel=0.02)
        assert float((model.poses.centre[i] - poses.centre[true]).norm()) < 0.05


def cut_out(photograph: Path, top: float, left: float, share: float, out: Path) -> None:
    """A part of a photograph, half as large as the whole."""
    image = read_image(photograph).pixels
    h, w = image.shape[-2:]
    a, b, height, width = (round(s * size) for s, size in ((top, h), (left, w), (share, h), (share, w)))
    part = image[None, :, a : a + height, b : b + width]
    save_image(out, torch.nn.functional.interpolate(part, size=(h // 2, w // 2), mode="bilinear", antialias=True)[0])


@pytest.mark.parametrize("zoomed", [True, False])
def test_photographs_of_one_size_need_not_have_one_camera(photographs: Path, run: Path, tmp_path: Path, zoomed: bool) -> None:
    old = Reconstruction.load(run / "model.npz")
    known = saved_features(run, old)
    assert known is not None
    cut_out(photographs / NEW, 0, 0, 1, tmp_path / "a.png")
    cut_out(photographs / "view1.png", *((0.15, 0.15, 0.7) if zoomed else (0, 0, 1)), tmp_path / "b.png")
    model, poses = register_photographs(tmp_path, old, known).model, truth().poses
    assert bool(model.registered.all())
    K = model.cameras.K[model.camera_index[4:], 0, 0] / float(old.cameras.K[0, 0, 0])
    assert K.tolist() == pytest.approx([0.5, 0.5 / 0.7 if zoomed else 0.5], rel=0.02)
    assert (int(model.camera_index[4]) != int(model.camera_index[5])) == zoomed
    for i, true in ((4, 2), (5, 1)):
        assert float((model.poses.centre[i] - poses.centre[true]).norm()) < 0.05


def test_the_command(photographs: Path, run: Path, tmp_path: Path) -> None:
    new = copies(photographs, tmp_path / "new", NEW)
    status, text, stderr = torchsfm("register", new, "--into", run, "--out", tmp_path / "out")
    assert status == 0, stderr
    assert "5 of 5 images registered" in text
    assert_placed(Reconstruction.load(tmp_path / "out" / "model.npz"), Reconstruction.load(run / "model.npz"))
    write_colmap(Reconstruction.load(run / "model.npz"), tmp_path / "sparse")
    status, _, stderr = torchsfm("register", new, "--into", tmp_path / "sparse", "--out", tmp_path / "bare")
    assert status == 2
    assert_one_line(stderr, "were not kept", "--features")
    assert not (tmp_path / "bare" / "model.npz").exists()
    status, _, stderr = torchsfm(
        "register", new, "--into", tmp_path / "sparse", "--features", new, "--out", tmp_path / "bare"
    )  # fmt: skip
    assert status == 2
    assert_one_line(stderr, "no folder with the stages of a run")
    model = Reconstruction.load(run / "model.npz")
    assert find_features(run, tmp_path / "sparse", model).names == model.names


def write_descriptors(known: KnownFeatures, path: Path, size: torch.Tensor) -> None:
    """COLMAP's database with these features."""
    nothing = torch.zeros(0, 2, dtype=torch.long)
    write_database(MatchedImages(known.names, size, known.x, nothing, ()), path)
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB)")
        for i, d in enumerate(known.descriptors):
            data = (2 * d.int()).clamp(max=255).to(torch.uint8).numpy().tobytes()
            database.execute("INSERT INTO descriptors VALUES (?, ?, 128, ?)", (i + 1, len(d), data))
    database.close()


def test_by_the_database_of_colmap(photographs: Path, run: Path, tmp_path: Path) -> None:
    old = Reconstruction.load(run / "model.npz")
    known = saved_features(run, old)
    assert known is not None
    write_descriptors(known, tmp_path / "database.db", old.image_size)
    found = read_features(tmp_path / "database.db")
    assert found.names == known.names
    for a, b in zip(found.descriptors, known.descriptors, strict=True):
        assert torch.equal(a, b)
    write_colmap(old, tmp_path / "sparse" / "0")
    assert find_features(None, tmp_path / "sparse" / "0", old).names == known.names
    new = copies(photographs, tmp_path / "new", NEW)
    status, _, stderr = torchsfm("register", new, "--into", tmp_path / "sparse" / "0", "--out", tmp_path / "out")
    assert status == 0, stderr
    model = Reconstruction.load(tmp_path / "out" / "model.npz")
    assert bool(model.registered.all())
    assert float((model.poses.centre[4] - truth().poses.centre[2]).norm()) < 0.02
    with sqlite3.connect(tmp_path / "database.db") as database:
        database.execute("UPDATE descriptors SET rows = rows - 1 WHERE image_id = 2")
    database.close()
    status, _, stderr = torchsfm("register", new, "--into", tmp_path / "sparse" / "0", "--out", tmp_path / "no")
    assert status == 2
    assert_one_line(stderr, "database")
    assert not (tmp_path / "no" / "model.npz").exists()


def test_wrong_input_is_told(photographs: Path, run: Path, tmp_path: Path) -> None:
    old = Reconstruction.load(run / "model.npz")
    known = saved_features(run, old)
    assert known is not None
    assert saved_features(tmp_path, old) is None
    with pytest.raises(ReconstructionError, match="nothing is new"):
        register_photographs([photographs / name for name in OLD], old, known)
    with pytest.raises(ReconstructionError, match="not the model's"):
        register_photographs([photographs / NEW], old, replace(known, x=tuple(x + 3.3 for x in known.x)))
    with pytest.raises(ReconstructionError, match=r"no features of view4\.png"):
        register_photographs([photographs / NEW], old, replace(known, names=(*OLD[:3], "another.png")))
    with pytest.raises(ReconstructionError, match="other photographs"):
        saved_features(run, replace(old, image_size=2 * old.image_size))
    with pytest.raises(ReconstructionError, match="no such f"):
        register_photographs([tmp_path / "none.png"], old, known)
    shutil.copytree(run / "stages", tmp_path / "stages")
    for path in (tmp_path / "stages" / "features").glob("*.npz"):
        path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ReconstructionError, match="not the features of a run"):
        saved_features(tmp_path, old)


def test_a_photograph_of_something_else_finds_no_pose(run: Path, tmp_path: Path, generator: torch.Generator) -> None:
    old = Reconstruction.load(run / "model.npz")
    known = saved_features(run, old)
    assert known is not None
    noise = torch.rand(3, 75, 100, generator=generator)
    save_image(
        tmp_path / "noise.png", torch.nn.functional.interpolate(noise[None], scale_factor=4, mode="bicubic")[0].clamp(0, 1)
    )
    result = register_photographs(tmp_path, old, known)
    assert result.model.registered.tolist() == [True] * 4 + [False]
    assert result.report.images[4].reason
    assert torch.equal(result.model.poses.t[:4], old.poses.t)


@pytest.mark.reference
def test_colmap_describes_features_alike(photographs: Path, tmp_path: Path) -> None:
    """Its features match those found here as these match each other, at the same places, the half pixel included."""
    pycolmap = pytest.importorskip("pycolmap")
    old = copies(photographs, tmp_path / "old", "view0.png")
    pycolmap.extract_features(tmp_path / "database.db", old)
    theirs = read_features(tmp_path / "database.db")
    first, second = (detect_features(read_image(photographs / f"view{i}.png")) for i in range(2))
    same = match_descriptors(theirs.descriptors[0], first.descriptors)
    assert len(same) > 0.5 * len(theirs.x[0])
    assert float((theirs.x[0][same[:, 0]] - first.x[same[:, 1]]).norm(dim=-1).median()) < 0.1
    across = match_descriptors(theirs.descriptors[0], second.descriptors)
    assert len(across) > 0.8 * len(match_descriptors(first.descriptors, second.descriptors))
