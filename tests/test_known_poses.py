"""Photographs with known poses: points for them, refined poses, and new photographs placed among them."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from command_line import FOCAL, HEIGHT, VIEWS, WIDTH, arc, assert_one_line, torchsfm

from torchsfm.formats import write_colmap
from torchsfm.geometry import Camera, Pose, intrinsics, rotation_angle, rotation_from_rotvec
from torchsfm.images import ImageError, save_image
from torchsfm.reconstruction import Reconstruction, ReconstructionError, triangulate_photographs

F64 = torch.float64


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Features and matches are found once."""
    return tmp_path_factory.mktemp("run")


def truth() -> Reconstruction:
    """The cameras and poses of the photographs, without points."""
    none = torch.zeros(0, dtype=torch.long)
    c = torch.tensor([(WIDTH - 1) / 2, (HEIGHT - 1) / 2], dtype=F64)
    return Reconstruction(
        names=tuple(f"view{i}.png" for i in range(VIEWS)),
        image_size=torch.tensor([[WIDTH, HEIGHT]] * VIEWS),
        cameras=Camera(intrinsics(torch.tensor([FOCAL], dtype=F64), c[None])),
        camera_index=torch.zeros(VIEWS, dtype=torch.long),
        poses=arc(VIEWS, 40),
        registered=torch.ones(VIEWS, dtype=torch.bool),
        X=torch.zeros(0, 3, dtype=F64),
        color=torch.zeros(0, 3, dtype=F64),
        x=torch.zeros(0, 2, dtype=F64),
        view=none,
        point=none,
    )


def shaken(model: Reconstruction) -> Reconstruction:
    """Poses a tenth of a degree and a hundredth of the distance off."""
    g = torch.Generator().manual_seed(5)
    R = rotation_from_rotvec(0.002 * torch.randn(VIEWS, 3, generator=g, dtype=F64)) @ model.poses.R
    centre = model.poses.centre + 0.02 * torch.randn(VIEWS, 3, generator=g, dtype=F64)
    return replace(model, poses=Pose(R, -(R @ centre[..., None])[..., 0]))


def test_points_for_poses_that_stay(courtyard: Path, run: Path) -> None:
    poses = truth()
    result = triangulate_photographs(courtyard, poses, out=run, resume=True)
    model = result.model
    assert model.names == poses.names
    assert torch.equal(model.poses.R, poses.poses.R)
    assert torch.equal(model.poses.t, poses.poses.t)
    assert torch.equal(model.cameras.K, poses.cameras.K)
    assert model.num_points > 100
    assert float(model.residuals().median()) < 0.5
    assert float(model.residuals().max()) <= 4
    # The scene is a court of some metres around the origin, and the points are in front of the cameras that see them.
    depth = model.poses[model.view].transform(model.X[model.point, None])[:, 0, 2]
    assert bool((depth > 0).all())
    again = triangulate_photographs(courtyard, poses, out=run, resume=True).model
    assert torch.equal(again.X, model.X)


def test_refined_poses_are_better_and_in_place(courtyard: Path, run: Path) -> None:
    poses, rough = truth(), shaken(truth())
    fixed = triangulate_photographs(courtyard, rough, out=run, resume=True).model
    model = triangulate_photographs(courtyard, rough, refine_poses=True, out=run, resume=True).model
    assert model.num_points > fixed.num_points
    assert float(model.residuals().median()) < 0.5 * float(fixed.residuals().median())
    before = rotation_angle(rough.poses.R @ poses.poses.R.mT)
    turned = poses.poses.R.mT @ model.poses.R
    # Up to the turn of the whole that nothing but the rough poses holds.
    assert float(rotation_angle(turned @ turned[:1].mT).max()) < 0.5 * float(before.max())
    assert float((model.poses.centre - rough.poses.centre).norm(dim=-1).max()) < 0.1
    assert torch.equal(model.cameras.K, rough.cameras.K)


def test_a_new_photograph_is_placed(courtyard: Path, run: Path) -> None:
    poses = truth()
    registered = torch.tensor([True, True, False, True, True])
    some = replace(poses, registered=registered)
    result = triangulate_photographs(courtyard, some, register=True, out=run, resume=True)
    model = result.model
    assert bool(model.registered.all())
    assert torch.equal(model.poses.R[registered], poses.poses.R[registered])
    assert torch.equal(model.poses.t[registered], poses.poses.t[registered])
    assert torch.equal(model.cameras.K, poses.cameras.K)
    assert bool((model.camera_index == 0).all())
    assert float(rotation_angle(model.poses.R[2:3] @ poses.poses.R[2:3].mT)) < 0.003
    assert float((model.poses.centre[2] - poses.poses.centre[2]).norm()) < 0.02
    # Without that wish it stays outside, and the report says why.
    left = triangulate_photographs(courtyard, some, out=run, resume=True)
    assert left.model.registered.tolist() == registered.tolist()
    assert left.report.images[2].reason == "has no pose in the given model"


def test_a_camera_of_its_own_is_estimated(courtyard: Path, tmp_path: Path) -> None:
    """The new photograph has another size, so another camera: its focal length is found, those given stay."""
    from torchsfm.images import read_image

    for i in range(VIEWS):
        photo = read_image(courtyard / f"view{i}.png").pixels
        save_image(tmp_path / f"view{i}.png", photo[:, :, 20:-20] if i == 2 else photo)
    some = replace(truth(), registered=torch.tensor([True, True, False, True, True]))
    model = triangulate_photographs(tmp_path, some, register=True).model
    assert bool(model.registered.all())
    assert len(model.cameras.K) == 2
    assert torch.equal(model.cameras.K[model.camera_index[0]], some.cameras.K[0])
    assert abs(float(model.cameras.K[model.camera_index[2], 0, 0]) - FOCAL) < 0.05 * FOCAL
    assert float((model.poses.centre[2] - some.poses.centre[2]).norm()) < 0.2


@pytest.mark.parametrize(("zoom", "off"), [(1.06, 0.08), (1.3, 0.08), (2.0, 0.2)])
def test_a_zoomed_photograph_has_a_camera_of_its_own(zoom: float, off: float, courtyard: Path, tmp_path: Path) -> None:
    """No file tells the lens: it was taken for the camera of the model, and placed aside, by 1.2 where it zooms 1.3 times."""
    from torchsfm.images import read_image

    for i in range(VIEWS):
        photo = read_image(courtyard / f"view{i}.png").pixels
        if i == 2:
            across = [torch.linspace(-1, 1, n) * (n - 1) / (n * zoom) for n in (WIDTH, HEIGHT)]
            place = torch.stack(torch.meshgrid(*across, indexing="xy"), -1)
            photo = torch.nn.functional.grid_sample(photo[None], place[None], mode="bicubic", align_corners=False)[0].clamp(
                0, 1
            )
        save_image(tmp_path / f"view{i}.png", photo)
    some = replace(truth(), registered=torch.tensor([True, True, False, True, True]))
    model = triangulate_photographs(tmp_path, some, register=True).model
    assert bool(model.registered.all())
    assert len(model.cameras.K) == 2
    assert torch.equal(model.cameras.K[model.camera_index[[0, 1, 3, 4]]], some.cameras.K.expand(4, 3, 3))
    assert float(model.cameras.K[model.camera_index[2], 0, 0] / (zoom * FOCAL)) == pytest.approx(1, abs=0.02)
    assert float((model.poses.centre[2] - some.poses.centre[2]).norm()) < off


def test_wrong_input_is_told(courtyard: Path, run: Path, tmp_path: Path) -> None:
    poses = truth()
    with pytest.raises(ReconstructionError, match="0 of 5 photographs have a pose"):
        triangulate_photographs(courtyard, replace(poses, names=("a", "b", "c", "d", "e")), out=run, resume=True)
    with pytest.raises(ReconstructionError, match=r"400 x 300 pixels, in the model of the poses 800 x 600"):
        triangulate_photographs(courtyard, replace(poses, image_size=2 * poses.image_size), out=run, resume=True)
    with pytest.raises((ReconstructionError, ImageError), match="no such folder"):
        triangulate_photographs(tmp_path / "nowhere", poses)


def test_the_commands(courtyard: Path, tmp_path: Path) -> None:
    write_colmap(truth(), tmp_path / "poses")
    status, text, stderr = torchsfm("triangulate", courtyard, "--poses", tmp_path / "poses", "--out", tmp_path / "out")
    assert status == 0, stderr
    assert "5 of 5 images registered" in text
    write_colmap(replace(truth(), registered=torch.tensor([True, True, False, True, True])), tmp_path / "some")
    status, text, stderr = torchsfm("register", courtyard, "--into", tmp_path / "some", "--out", tmp_path / "out", "--resume")
    assert status == 0, stderr
    assert "5 of 5 images registered" in text
    status, _, stderr = torchsfm("triangulate", courtyard, "--poses", tmp_path / "none", "--out", tmp_path / "out")
    assert status == 2
    assert_one_line(stderr, "no such file or folder")
