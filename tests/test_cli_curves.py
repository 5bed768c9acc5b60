"""`torchsfm curves`: from photographs and a model to curves in files, and one line where the user errs."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from command_line import assert_one_line, torchsfm
from painted_box import SIZE, camera, orbit, photograph, true_curves

from torchsfm.formats import read_ply, write_colmap
from torchsfm.geometry import Pose
from torchsfm.images import save_image
from torchsfm.reconstruction import Reconstruction

VIEWS = 8


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs in `images`, and a model without points in `model.npz` and `colmap`."""
    folder = tmp_path_factory.mktemp("box")
    (folder / "images").mkdir()
    names = tuple(f"view{i}.png" for i in range(VIEWS))
    for name, image in zip(names, photograph(orbit(VIEWS)), strict=True):
        save_image(folder / "images" / name, image)
    none = torch.zeros(0, dtype=torch.long)
    model = Reconstruction(
        names=names,
        image_size=torch.full((VIEWS, 2), SIZE),
        cameras=camera(1),
        camera_index=torch.zeros(VIEWS, dtype=torch.long),
        poses=orbit(VIEWS),
        registered=torch.ones(VIEWS, dtype=torch.bool),
        X=torch.zeros(0, 3).double(),
        color=torch.zeros(0, 3).double(),
        x=torch.zeros(0, 2).double(),
        view=none,
        point=none,
    )
    model.save(folder / "model.npz")
    write_colmap(model, folder / "colmap")
    return folder


@pytest.mark.parametrize("model", ["model.npz", "colmap"])
def test_curves_of_a_box(box: Path, model: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    status, stdout, stderr = torchsfm("curves", box / "images", "--poses", box / model, "--out", out)
    assert status == 0
    assert f"{VIEWS} of {VIEWS} images" in stdout
    X = read_ply(out / "curves.ply").X
    gap = torch.cdist(X, torch.cat(list(true_curves().values()))).amin(-1)
    assert (gap < 0.03).float().mean() > 0.97
    records = json.loads((out / "curves.json").read_text())["curves"]
    assert {record["closed"] for record in records} == {False, True}
    assert f"{len(records)} curves" in (out / "page.html").read_text()
    assert "poses" not in stderr.replace("checking the poses", "")
    assert "doubtful" not in stderr


def test_images_may_be_smaller_than_the_model_says_or_missing(box: Path, tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for file in sorted((box / "images").iterdir())[:-1]:
        (folder / file.name).write_bytes(file.read_bytes())
    first = folder / "view0.png"
    first.write_bytes(first.read_bytes()[:500])
    status, stdout, stderr = torchsfm(
        "curves", folder, "--poses", box / "model.npz", "--out", tmp_path / "out", "--max-size", 160
    )
    assert status == 0
    assert f"{VIEWS - 2} of {VIEWS} images" in stdout
    assert "view0.png" in stderr
    X = read_ply(tmp_path / "out" / "curves.ply").X
    gap = torch.cdist(X, torch.cat(list(true_curves().values()))).amin(-1)
    assert (gap < 0.05).float().mean() > 0.95


def test_what_the_user_can_put_right(box: Path, tmp_path: Path) -> None:
    words = ("--out", tmp_path / "out")
    for images, model, said in (
        (tmp_path / "nowhere", box / "model.npz", "no such folder"),
        (box / "images", tmp_path / "nowhere", "nowhere"),
        (box / "colmap", box / "model.npz", "three images"),
    ):
        status, _, stderr = torchsfm("curves", images, "--poses", model, *words)
        assert status == 2
        assert_one_line(stderr, said)


def test_photographs_of_another_size_are_not_those_of_the_model(box: Path, tmp_path: Path) -> None:
    """They were taken for such, and hardly any curve was found."""
    half = tmp_path / "half"
    half.mkdir()
    for name, image in zip((f"view{i}.png" for i in range(VIEWS)), photograph(orbit(VIEWS)), strict=True):
        save_image(half / name, torch.nn.functional.avg_pool2d(image[None], 2)[0])
    status, _, stderr = torchsfm("curves", half, "--poses", box / "model.npz", "--out", tmp_path / "out")
    assert status == 2
    assert f"view0.png: {SIZE // 2} x {SIZE // 2} pixels, in the model of the poses {SIZE} x {SIZE}" in stderr


def test_no_curves(box: Path, tmp_path: Path) -> None:
    model = replace(Reconstruction.load(box / "model.npz"))
    folder = tmp_path / "images"
    folder.mkdir()
    for name in model.names:
        save_image(folder / name, torch.full((1, SIZE, SIZE), 0.5))
    status, stdout, stderr = torchsfm("curves", folder, "--poses", box / "model.npz", "--out", tmp_path / "out")
    assert status == 1
    assert "no curves found" in stderr
    assert "0 curves" in stdout


def test_wrong_poses_are_told(box: Path, tmp_path: Path) -> None:
    """Few curves came out, and no word. Of one image with the pose of another it is said, and where the page shows it."""
    model = Reconstruction.load(box / "model.npz")
    R, t = model.poses.R.clone(), model.poses.t.clone()
    R[2], t[2] = R[3], t[3]
    replace(model, poses=Pose(R, t)).save(tmp_path / "one.npz")
    status, stdout, stderr = torchsfm("curves", box / "images", "--poses", tmp_path / "one.npz", "--out", tmp_path / "out")
    assert status == 0
    assert_one_line("\n".join(line for line in stderr.splitlines() if "..." not in line), "doubtful: view2.png (it shows ")
    assert "1 doubtful image, drawn in red" in (tmp_path / "out" / "page.html").read_text()
    replace(model, poses=model.poses[torch.tensor([3, 6, 1, 4, 7, 2, 5, 0])]).save(tmp_path / "all.npz")
    words = ("--poses", tmp_path / "all.npz", "--out", tmp_path / "other", "--json")
    _, stdout, stderr = torchsfm("curves", box / "images", *words)
    record = json.loads(stdout)
    assert not record["poses_fit"]
    assert len(record["doubts"]) == 1
    assert "the poses" in record["doubts"][0]
    assert record["doubts"][0] in stderr
