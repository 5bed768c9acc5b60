"""The `Reconstruction` object: saving, moving, transforming, measuring."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from chance import seeded
from small_model import make, with_curves

from torchsfm.geometry import DISTORTION_MODELS, Similarity, random_rotation
from torchsfm.reconstruction import Lines, Reconstruction


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


def test_the_summary_of_what_no_image_shows_has_no_numbers_that_are_none() -> None:
    model = with_curves(make())
    assert model.curves is not None
    none, empty = model.view[:0], model.x.new_zeros(0)
    lines = Lines(model.X[:4].reshape(2, 2, 3), model.color[:2], empty.reshape(0, 2, 2), empty, none, none)
    curves = model.curves.seen_where(torch.zeros_like(model.curves.view, dtype=torch.bool))
    bare = replace(model, x=model.x[:0], view=none, point=none, lines=lines, curves=curves)
    text = bare.summary()
    assert "nan" not in text
    assert "30 points, no observations\n2 lines, 0 segments\n3 curves, 30 samples\n" in text


def test_summary_names_the_numbers() -> None:
    text = make().summary()
    assert "3 of 4 images" in text
    assert "30 points, 90 observations, mean track length 3.00" in text
    assert "f = 900.00" in text
    assert "k1 = " in text
