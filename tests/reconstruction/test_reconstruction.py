"""The `Reconstruction` object: saving, moving, transforming, measuring."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from chance import seeded

from torchsfm.geometry import DISTORTION_MODELS, Camera, Pose, Similarity, intrinsics, random_rotation
from torchsfm.reconstruction import Reconstruction
from torchsfm.simulation import orbit_poses, random_points


def make(model: str = "radial") -> Reconstruction:
    g = seeded()
    v, n = 4, 30
    poses = orbit_poses(v, radius=5.0)
    X = random_points(n, generator=g)
    distortion = DISTORTION_MODELS[model]
    parameters = 0.01 * torch.rand(1, distortion.num_parameters, generator=g, dtype=torch.float64)
    f, c = torch.tensor([900.0], dtype=torch.float64), torch.tensor([[399.5, 299.5]], dtype=torch.float64)
    cameras = Camera(intrinsics(f, c), distortion.from_parameters(parameters))
    view, point = torch.arange(v - 1).repeat(n), torch.arange(n).repeat_interleave(v - 1)
    registered = torch.tensor([True, True, True, False])
    poses = Pose(torch.where(registered[:, None, None], poses.R, torch.eye(3).double()), poses.t * registered[:, None])
    empty = Reconstruction(
        names=("a.jpg", "b ä.jpg", "c.jpg", "d.jpg"),
        image_size=torch.tensor([[800, 600]] * v),
        cameras=cameras,
        camera_index=torch.zeros(v, dtype=torch.long),
        poses=poses,
        registered=registered,
        X=X,
        color=torch.rand(n, 3, generator=g, dtype=torch.float64),
        x=torch.zeros(len(view), 2, dtype=torch.float64),
        view=view,
        point=point,
    )
    noise = torch.randn(len(view), 2, generator=g, dtype=torch.float64)
    return replace(empty, x=empty.projections() + noise)


@pytest.mark.parametrize("model", list(DISTORTION_MODELS))
def test_saved_and_loaded_is_the_same(tmp_path: Path, model: str) -> None:
    before = make(model)
    before.save(tmp_path / "model.npz")
    after = Reconstruction.load(tmp_path / "model.npz")
    assert after.names == before.names
    assert type(after.cameras.distortion) is type(before.cameras.distortion)
    assert torch.equal(after.residuals(), before.residuals())
    assert torch.equal(after.registered, before.registered)
    assert torch.equal(after.color, before.color)


def test_other_files_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "x.npz"
    file.write_text("no model")
    with pytest.raises(ValueError, match="not a saved reconstruction"):
        Reconstruction.load(file)
    make().save(file)
    file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(ValueError, match="not a saved reconstruction"):
        Reconstruction.load(file)
    with pytest.raises(FileNotFoundError):
        Reconstruction.load(tmp_path / "missing.npz")


def test_dtype_moves_floats_only() -> None:
    model = make().to(torch.float32)
    assert model.X.dtype == model.poses.R.dtype == model.cameras.K.dtype == torch.float32
    assert model.view.dtype == torch.long
    assert model.registered.dtype == torch.bool


def test_a_similarity_changes_no_residual() -> None:
    model = make()
    g = seeded(1)
    R, t = random_rotation(generator=g, dtype=torch.float64), torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
    similarity = Similarity(torch.tensor(2.5, dtype=torch.float64), R, t)
    moved = model.transform(similarity)
    assert torch.allclose(moved.residuals(), model.residuals(), atol=1e-9)
    assert torch.equal(moved.poses.R[3], torch.eye(3).double())
    assert not torch.allclose(moved.X, model.X)


def test_errors_agree_with_a_loop() -> None:
    model = make()
    residuals = model.residuals()
    for i in range(3):
        assert torch.isclose(model.view_errors()[i], residuals[model.view == i].mean())
    assert float(model.view_errors()[3]) == 0
    for j in (0, 17, 29):
        assert torch.isclose(model.point_errors()[j], residuals[model.point == j].mean())
    assert model.track_lengths().tolist() == [3] * 30


def test_summary_names_the_numbers() -> None:
    text = make().summary()
    assert "3 of 4 images" in text
    assert "30 points, 90 observations, mean track length 3.00" in text
    assert "f = 900.00" in text
    assert "k1 = " in text
