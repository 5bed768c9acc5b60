"""Ellipses in space as a part of models."""

import dataclasses
from pathlib import Path

import pytest
import torch

from torchsfm.bundle import bundle_adjust_model
from torchsfm.formats.pictures import registered_only, undistorted_model
from torchsfm.geometry import Camera, Ellipse, NoDistortion, Pose, Similarity, rotation_from_rotvec
from torchsfm.images import fit_ellipse
from torchsfm.plot import write_page
from torchsfm.reconstruction import Conics, Reconstruction
from torchsfm.simulation import simulate_conics

F64 = torch.float64


@pytest.fixture
def model(generator: torch.Generator) -> Reconstruction:
    """Five ellipses and thirty points in four views, half a pixel of noise, everything a little off; a fifth has no pose."""
    scene = simulate_conics((), conics=5, views=4, noise=0.5, generator=generator)
    K = torch.tensor([[800.0, 0, 500], [0, 800, 400], [0, 0, 1]], dtype=F64)
    Rt = torch.linalg.solve(K, scene.P)
    poses = Pose(Rt[..., :3], Rt[..., 3])
    X = 2 * torch.rand(30, 3, generator=generator, dtype=F64) - 1
    camera = Camera(K[None], NoDistortion())
    view, point = torch.cartesian_prod(torch.arange(4), torch.arange(30)).unbind(1)
    x = camera[torch.zeros(120, dtype=torch.long)].project(poses[view].transform(X[point, None]))[:, 0]
    fit = fit_ellipse(scene.x.flatten(0, 1))
    seen, conic = torch.cartesian_prod(torch.arange(4), torch.arange(5)).unbind(1)
    conics = Conics.of(scene.model, fit.model, 0.25 * fit.covariance, seen, conic)
    step = 0.002 * torch.randn(4, 6, generator=generator, dtype=F64)
    off = poses.retract(step)
    return Reconstruction(
        names=tuple(f"{k}.jpg" for k in range(5)), image_size=torch.tensor([[1000, 800]] * 5), cameras=camera,
        camera_index=torch.zeros(5, dtype=torch.long),
        poses=Pose(torch.cat((off.R, torch.eye(3, dtype=F64)[None])), torch.cat((off.t, torch.zeros(1, 3, dtype=F64)))),
        registered=torch.arange(5) < 4, X=X, color=torch.full_like(X, 0.5),
        x=x + 0.5 * torch.randn(x.shape, generator=generator, dtype=F64), view=view, point=point, conics=conics,
    )  # fmt: skip


def test_adjusted_with_the_points(model: Reconstruction) -> None:
    assert model.conics is not None
    adjusted = bundle_adjust_model(model, free=()).model
    assert adjusted.conics is not None
    # The residuals of 16 points an ellipse are those of the fit: sixty edge points leave a tenth of a pixel.
    assert adjusted.conic_residuals().mean() < 0.3
    assert adjusted.conic_residuals().mean() < 0.3 * model.conic_residuals().mean()
    assert adjusted.residuals().mean() < model.residuals().mean()
    # Without them the poses come out otherwise.
    apart = bundle_adjust_model(dataclasses.replace(model, conics=None), free=()).model
    assert not torch.allclose(apart.poses.t, adjusted.poses.t, rtol=0, atol=1e-7)


def test_files_keep_them(model: Reconstruction, tmp_path: Path) -> None:
    model.save(tmp_path / "model.npz")
    back = Reconstruction.load(tmp_path / "model.npz").conics
    assert back is not None
    for field in dataclasses.fields(Conics):
        assert torch.equal(getattr(back, field.name), getattr(model.conics, field.name)), field.name


def test_another_world_shows_the_same(model: Reconstruction, generator: torch.Generator) -> None:
    R = rotation_from_rotvec(torch.randn(3, generator=generator, dtype=F64))
    moved = model.transform(Similarity(torch.tensor(3.0, dtype=F64), R, torch.tensor([1.0, -2.0, 5.0], dtype=F64)))
    assert moved.conics is not None
    assert model.conics is not None
    torch.testing.assert_close(moved.conic_residuals(), model.conic_residuals(), rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(moved.conics.axes.norm(dim=-1), 3 * model.conics.axes.norm(dim=-1))


def test_residuals_are_distances_along_normals(model: Reconstruction) -> None:
    """Of ellipses measured a pixel too large."""
    assert model.conics is not None
    exact = bundle_adjust_model(model, free=()).model
    assert exact.conics is not None
    larger = exact.conics.x + torch.tensor([0, 0, 1, 1, 0], dtype=F64)
    grown = dataclasses.replace(exact, conics=dataclasses.replace(exact.conics, x=larger))
    assert (grown.conic_residuals() - 1).abs().max() < 0.5
    assert (grown.conic_residuals() - 1).abs().mean() < 0.2


def test_some_of_them(model: Reconstruction) -> None:
    assert model.conics is not None
    keep = torch.tensor([True, False, False, True, True])
    some = model.conics.select(keep)
    assert len(some) == 3
    assert some.support().tolist() == [4, 4, 4]
    assert torch.equal(some.centre[some.conic], model.conics.centre[model.conics.conic[keep[model.conics.conic]]])
    assert len(model.conics.select(torch.zeros(5, dtype=torch.bool)).x) == 0


def test_without_images_that_have_no_pose(model: Reconstruction) -> None:
    assert model.conics is not None
    registered = model.registered.clone()
    registered[0] = False
    less = registered_only(dataclasses.replace(model, registered=registered))
    assert less.conics is not None
    assert sorted(set(less.conics.view.tolist())) == [0, 1, 2]
    torch.testing.assert_close(less.conic_residuals(), model.conic_residuals()[model.conics.view > 0])
    flat = undistorted_model(model).conics
    assert flat is not None
    assert len(flat) == 5
    assert len(flat.x) == 0


def test_the_page_shows_them(model: Reconstruction, tmp_path: Path) -> None:
    assert "5 ellipses, in 4.0 images" in model.summary().replace("4.00", "4.0")
    write_page(model, tmp_path / "with.html")
    write_page(dataclasses.replace(model, conics=None), tmp_path / "without.html")
    texts = [(tmp_path / name).read_text() for name in ("with.html", "without.html")]
    assert "5 ellipses" in texts[0]
    assert [f'"ellipses":{5 * 64}' in text for text in texts] == [True, False]
    assert "5 ellipses" not in texts[1]
    # 64 pieces of two ends each, in single precision and base 64.
    assert len(texts[0]) - len(texts[1]) > 5 * 64 * 6 * 4


def test_measured_ellipses_are_what_they_were(model: Reconstruction) -> None:
    assert model.conics is not None
    ellipse = model.conics.ellipse
    assert isinstance(ellipse, Ellipse)
    assert torch.equal(torch.cat((ellipse.centre, ellipse.semi_axes, ellipse.angle[:, None]), -1), model.conics.x)
