"""Photographs to a model, the model to every program and format, and back: the same model."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchsfm.formats import TARGETS, export_model, read_model, read_ply, undistorted_model, write_model
from torchsfm.formats.pictures import registered_only
from torchsfm.formats.registry import FORMATS
from torchsfm.images import read_image
from torchsfm.reconstruction import Reconstruction, reconstruct

pytestmark = pytest.mark.slow
SCENES = ("opensfm_berlin", "sacre_coeur", "entry-P10", "lund_door", "castle-P19")
WITHOUT_OBSERVATIONS = ("nerfstudio",)
"""What has no place for image points."""
CENTRED = ("bundler", "nvm", "blender")
"""What has principal points at the centre of the picture alone."""


@pytest.mark.parametrize("scene", SCENES)
def test_nothing_is_lost_on_the_way_out_and_back(scene: str, data: Path, tmp_path: Path) -> None:
    folder = data / "images" / scene / "images"
    model = reconstruct(folder, seed=0).model
    assert bool(model.registered.all()), f"{model.num_registered} of {len(model.names)} images"
    assert_comes_back(model, folder, tmp_path)


def assert_comes_back(model: Reconstruction, folder: Path, tmp_path: Path) -> None:
    """Every export with its pictures, and every format that is read and written."""
    for name, target in TARGETS.items():
        out = export_model(model, name, tmp_path / name, images=folder)
        wanted = undistorted_model(model, centred=name in CENTRED) if target.pictures else registered_only(model)
        if name == "meshlab":
            assert read_ply(out / "points.ply").X.double().equal(model.X.double())
        elif name != "blender":
            assert_same(read_model(out), wanted, name)
        for image, size in zip(wanted.names, wanted.image_size.tolist(), strict=True):
            if target.pictures:
                assert list(read_image(out / "images" / image).size) == size
    straight = undistorted_model(model, centred=True)
    for kind in FORMATS:
        if kind.read is None or kind.write is None or kind.name == "bal":
            continue  # BAL numbers images and holds no sizes
        wanted = straight if kind.name in CENTRED else registered_only(model)
        place = tmp_path / f"as {kind.name}"
        place.mkdir()
        if kind.name in CENTRED:  # these tell no sizes: the pictures beside them do
            wanted = replace(wanted, names=tuple(f"../bundler/images/{name}" for name in wanted.names))
        file = place / (kind.files[0] if kind.files and kind.files[0][0] != "." else f"model{(*kind.files, '')[0]}")
        write_model(wanted, file, kind.name)
        assert_same(read_model(file), wanted, kind.name)


def assert_same(found: Reconstruction, wanted: Reconstruction, kind: str) -> None:
    """Images in any order, points in the same: equal to rounding."""
    names = [name.removeprefix("images/") for name in found.names]
    assert sorted(names) == sorted(wanted.names), kind
    place = torch.tensor([names.index(name) for name in wanted.names])
    close = {"rtol": 1e-9, "atol": 1e-9, "check_dtype": False, "msg": lambda text: f"{kind}: {text}"}
    assert bool(found.registered.all())
    assert found.image_size[place].equal(wanted.image_size), kind
    torch.testing.assert_close(found.poses.matrix()[place], wanted.poses.matrix(), **close)
    torch.testing.assert_close(found.cameras.K[found.camera_index[place]], wanted.cameras.K[wanted.camera_index], **close)
    torch.testing.assert_close(found.X, wanted.X, **close)
    if kind in WITHOUT_OBSERVATIONS:
        return
    back = torch.argsort(place)
    key = found.point * len(names) + back[found.view]
    order, other = torch.argsort(key), torch.argsort(wanted.point * len(names) + wanted.view)
    assert key[order].equal((wanted.point * len(names) + wanted.view)[other]), kind
    torch.testing.assert_close(found.x[order], wanted.x[other], **close)
    torch.testing.assert_close(found.projections()[order], wanted.projections()[other], **close)
