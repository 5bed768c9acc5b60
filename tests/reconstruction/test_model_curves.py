"""Curves of a model: carried, saved, moved, chosen, adjusted; and edges found in photographs as a stage."""

import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_model
import torch

from torchsfm.bundle import bundle_adjust_model
from torchsfm.formats import undistorted_model
from torchsfm.geometry import Similarity, rotation_from_rotvec
from torchsfm.images import save_image
from torchsfm.reconstruction import Curves, Reconstruction
from torchsfm.reconstruction.curves.find_curves import FoundEdges, detect_all_edges
from torchsfm.reconstruction.curves.image_edges import ImageEdges
from torchsfm.reconstruction.matching.masks import Masks

F64 = torch.float64
WORLD = Similarity(
    torch.tensor(2.5, dtype=F64), rotation_from_rotvec(torch.tensor([0.3, -1.0, 2.0], dtype=F64)),
    torch.tensor([5.0, -3.0, 1.0], dtype=F64),
)  # fmt: skip


@pytest.fixture
def model() -> Reconstruction:
    return small_model.with_curves(small_model.make())


def of(model: Reconstruction) -> Curves:
    assert model.curves is not None
    return model.curves


def test_samples_links_and_lengths(model: Reconstruction) -> None:
    curves = of(model)
    assert len(curves) == 3
    assert curves.number.tolist() == [16, 12, 2]
    assert curves.support().tolist() == [3] * 30
    rows = curves.rows()
    assert torch.equal(rows.x[rows.valid], curves.X)
    assert torch.equal(rows.closed, curves.closed)
    # Of two samples there is but one piece, closed or not.
    torch.testing.assert_close(curves.length()[:2], rows.length[:2])
    assert curves.length()[2] == (curves.X[29] - curves.X[28]).norm()
    ahead = curves.X[curves.links()[:, 1]] - curves.X[curves.links()[:, 0]]
    assert ((ahead * curves.tangents()[curves.links()[:, 0]]).sum(-1) > 0).all()


def test_saved_and_loaded(model: Reconstruction, tmp_path: Path) -> None:
    model.save(tmp_path / "model.npz")
    back = Reconstruction.load(tmp_path / "model.npz")
    for field in dataclasses.fields(Curves):
        assert torch.equal(getattr(of(back), field.name), getattr(of(model), field.name))
    assert "3 curves, 30 samples, in 3.00 images each" in back.summary()
    small_model.make().save(tmp_path / "plain.npz")
    assert Reconstruction.load(tmp_path / "plain.npz").curves is None


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("curve_view", -1, "curve_view: there is no number"),
        ("curve_sample", 1000, "curve_sample: there is no number"),
        ("curve_curve", 1, "curve_curve: there is no number"),
        ("curve_curve", None, "no array 'curve_curve'"),
        ("curve_curve", "reversed", "curve_curve: not ascending"),
    ],
)
def test_damaged_files_are_named(model: Reconstruction, tmp_path: Path, name: str, change: int | str | None, said: str) -> None:
    model.save(tmp_path / "model.npz")
    arrays = dict(np.load(tmp_path / "model.npz"))
    if change is None:
        del arrays[name]
    else:
        arrays[name] = arrays[name][::-1] if isinstance(change, str) else arrays[name] + change
    np.savez(tmp_path / "model.npz", **arrays)
    with pytest.raises(ValueError, match=said):
        Reconstruction.load(tmp_path / "model.npz")


def test_other_worlds_and_types(model: Reconstruction) -> None:
    before = model.curve_residuals()
    assert 0 < before.max() < 0.02
    moved = model.transform(WORLD)
    torch.testing.assert_close(moved.curve_residuals(), before, rtol=0, atol=1e-8)
    torch.testing.assert_close(of(moved).length(), 2.5 * of(model).length())
    torch.testing.assert_close(of(moved).sigma, 2.5 * of(model).sigma)
    single = model.to(torch.float32)
    assert of(single).X.dtype == torch.float32
    torch.testing.assert_close(single.curve_residuals().double(), before, rtol=0, atol=0.05)


def test_some_of_the_curves(model: Reconstruction) -> None:
    keep = torch.tensor([False, True, True])
    some = replace(model, curves=of(model).select(keep))
    assert of(some).number.tolist() == [12, 2]
    assert of(some).closed.tolist() == [False, True]
    own = keep[of(model).curve]
    assert torch.equal(of(some).X, of(model).X[own])
    assert torch.equal(some.curve_residuals(), model.curve_residuals()[own[of(model).sample]])


def test_images_of_another_size_show_the_same(model: Reconstruction) -> None:
    """Also where pixels are no squares afterwards: distances shrink as edges do, across."""
    for zoom in (torch.tensor([0.5, 0.5]), torch.tensor([2.0, 1.5])):
        zoom = zoom.double().expand(4, 2)
        order = torch.tensor([2, 0, 1, 3])
        K = model.cameras.K.clone()
        K[:, :2] *= zoom[0, :, None]
        K[:, :2, 2] += (zoom[0] - 1) / 2
        poses = replace(model.poses, R=model.poses.R[order.argsort()], t=model.poses.t[order.argsort()])
        cameras = replace(model.cameras, K=K)
        other = replace(model, cameras=cameras, poses=poses, curves=of(model).in_images(order, zoom))
        assert other.curve_residuals().max() < 0.03
        curves = of(other)
        ahead = torch.stack((of(model).normal[:, 1], -of(model).normal[:, 0]), -1) * zoom[0]
        assert ((curves.normal * ahead).sum(-1).abs() < 1e-9).all()
        if zoom[0, 0] == zoom[0, 1]:
            torch.testing.assert_close(curves.weight, of(model).weight / 0.25)
            torch.testing.assert_close(curves.curvature, of(model).curvature / 0.5)


def test_edges_move_with_the_pictures(model: Reconstruction) -> None:
    new = undistorted_model(model)
    assert len(of(new).x) == len(of(model).x)
    assert new.curve_residuals().max() < 0.02
    assert (of(new).x - of(model).x).abs().max() > 0.1


def test_whole_models_are_adjusted_with_their_curves(model: Reconstruction, generator: torch.Generator) -> None:
    model = replace(model, x=model.projections())
    step = 0.002 * torch.randn(4, 6, generator=generator, dtype=F64)
    moved = replace(model, poses=model.poses.retract(step * model.registered[:, None]))
    assert moved.curve_residuals().mean() > 0.3
    adjusted = bundle_adjust_model(moved, free=()).model
    assert adjusted.curve_residuals().mean() < 0.02
    assert adjusted.residuals().mean() < 0.02
    assert not torch.equal(of(adjusted).X, of(model).X)


def test_edges_of_photographs(tmp_path: Path) -> None:
    """A disc, as large as images are read and larger; a mask; a file that cannot be read."""
    files, masks = [], tmp_path / "masks"
    masks.mkdir()
    for name, width in (("small.png", 200), ("large.png", 2400)):
        scale = width / 200
        y, x = torch.meshgrid((torch.arange(0.75 * width) + 0.5) / scale, (torch.arange(width) + 0.5) / scale, indexing="ij")
        inside = ((40 - ((x - 90).square() + (y - 75).square()).sqrt()) * scale + 0.5).clamp(0, 1)
        save_image(tmp_path / name, torch.stack((0.2 + 0.6 * inside, 0.2 * inside, 0.3 + 0 * inside)))
        files.append(tmp_path / name)
    (tmp_path / "broken.png").write_bytes(b"no picture")
    mask = torch.ones(1, 150, 200)
    mask[..., :90] = 0
    save_image(masks / "small.png.png", mask)
    told: list[tuple[str, int, int]] = []
    arrays = detect_all_edges(
        [*files, tmp_path / "broken.png"], 10**8, lambda *state: told.append(state), Masks(masks, tmp_path)
    )
    found = FoundEdges.of(arrays)
    assert told[-1] == ("edges", 3, 3)
    assert [len(edges) > 50 for edges in found.edges] == [True, True, False]
    assert found.size.tolist()[:2] == [[200, 150], [1000, 750]]
    torch.testing.assert_close(found.zoom[:2], torch.tensor([[1.0, 1.0], [2.4, 2.4]], dtype=F64))
    for edges, zoom, scale in zip(found.edges, found.zoom[:, 0], (1, 12), strict=False):
        middle = torch.tensor([90 * scale - 0.5, 75 * scale - 0.5])
        away = ((edges.x + 0.5) * zoom - 0.5 - middle) / scale
        assert (away.norm(dim=-1) - 40).abs().max() < 0.1
        # Bent to the middle, with a normal that points there or away from it.
        inwards = -(away * edges.normal).sum(-1) / 40
        assert inwards.abs().min() > 0.98
        torch.testing.assert_close((edges.curvature * inwards / zoom).median(), torch.tensor(1 / 40 / scale), rtol=0.1, atol=0)
    assert (found.edges[0].x[:, 0] > 88).all()
    assert len(found.edges[0].where(torch.zeros(len(found.edges[0]), dtype=torch.bool))) == 0


def test_what_is_taken_out_of_a_chain_leaves_two() -> None:
    n = torch.arange(10.0)
    x = torch.stack((n, n), -1)
    edges = ImageEdges(x, x, n, n, torch.stack((n, n, n), -1), torch.tensor([0] * 6 + [1] * 4))
    some = edges.where(torch.tensor([1, 1, 0, 1, 1, 1, 1, 1, 1, 0], dtype=torch.bool))
    assert some.chain.tolist() == [0, 0, 1, 1, 1, 2, 2, 2]


def test_runs_of_samples(generator: torch.Generator) -> None:
    """By hand, curve by curve: neighbours that are kept stay neighbours, around the end of a closed curve, too."""
    curves = of(small_model.with_curves(small_model.make()))
    for _ in range(20):
        keep = torch.rand(len(curves.X), generator=generator) < torch.rand((), generator=generator) ** 0.3
        found = curves.runs_where(keep)
        links = [(a, b) for a, b in curves.links().tolist() if bool(keep[a]) and bool(keep[b])]
        assert len(found.X) == int(keep.sum())
        name = {tuple(x): i for i, x in enumerate(curves.X.tolist())}
        old = torch.tensor([name[tuple(x)] for x in found.X.tolist()], dtype=torch.long)
        assert sorted(map(tuple, old[found.links()].tolist())) == sorted(links)
        assert torch.equal(found.color, curves.color[old])
        assert torch.equal(found.sigma, curves.sigma[old])
        shown = keep[curves.sample]
        assert torch.equal(old[found.sample], curves.sample[shown])
        assert torch.equal(found.x, curves.x[shown])
    whole = curves.runs_where(torch.ones(len(curves.X), dtype=torch.bool))
    assert torch.equal(whole.X, curves.X)
    assert torch.equal(whole.closed, curves.closed)
    assert len(curves.runs_where(torch.zeros(len(curves.X), dtype=torch.bool))) == 0
