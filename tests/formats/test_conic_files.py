"""Ellipses in files: everything comes back from text, viewers get outlines."""

import dataclasses
from pathlib import Path

import pytest
import small_model
import torch

from torchsfm.formats import read_conics, read_ply, write_conics
from torchsfm.reconstruction import Conics, Reconstruction

F64 = torch.float64


@pytest.fixture
def model(generator: torch.Generator) -> Reconstruction:
    """Four ellipses, the third of which nothing shows."""

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=F64)

    factor = rand(6, 5, 5)
    covariance = factor @ factor.mT
    axes = torch.linalg.qr(rand(4, 3, 3)).Q[:, :2] * rand(4, 2, 1)
    conic, view = torch.tensor([0, 0, 0, 1, 3, 3]), torch.tensor([0, 1, 2, 0, 2, 1])
    conics = Conics(rand(4, 3), axes, rand(4, 3), 100 * rand(6, 5), (covariance + covariance.mT) / 2, view, conic)
    return dataclasses.replace(small_model.make(), conics=conics)


def test_text_gives_everything_back(model: Reconstruction, tmp_path: Path) -> None:
    write_conics(model, tmp_path / "conics.txt")
    back = read_conics(tmp_path / "conics.txt")
    for field in dataclasses.fields(Conics):
        assert torch.equal(getattr(back, field.name), getattr(model.conics, field.name)), field.name


def test_viewers_get_outlines(model: Reconstruction, tmp_path: Path) -> None:
    assert model.conics is not None
    write_conics(model, tmp_path / "conics.ply")
    write_conics(model, tmp_path / "conics.obj")
    cloud = read_ply(tmp_path / "conics.ply")
    words = [text.split() for text in (tmp_path / "conics.obj").read_text().splitlines()]
    vertices = torch.tensor([[float(w) for w in some[1:4]] for some in words if some[0] == "v"], dtype=F64)
    assert torch.equal(cloud.X, vertices)
    assert b"element edge 256\n" in (tmp_path / "conics.ply").read_bytes()
    # All on the ellipses.
    x = vertices.reshape(4, -1, 3) - model.conics.centre[:, None]
    axes = model.conics.axes
    w = x @ (axes / axes.square().sum(-1, keepdim=True)).mT
    torch.testing.assert_close(w.norm(dim=-1), torch.ones(4, 128, dtype=F64))
    torch.testing.assert_close(w @ axes, x)


def test_ellipses_that_are_not_finite_are_left_out(model: Reconstruction, tmp_path: Path) -> None:
    assert model.conics is not None
    centre = model.conics.centre.clone()
    centre[1] = torch.nan
    broken = dataclasses.replace(model, conics=dataclasses.replace(model.conics, centre=centre))
    for name in ("a.txt", "a.ply", "a.obj"):
        write_conics(broken, tmp_path / name)
        assert b"nan" not in (tmp_path / name).read_bytes()
    back = read_conics(tmp_path / "a.txt")
    assert torch.equal(back.centre, centre[[0, 2, 3]])
    assert back.conic.tolist() == [0, 0, 0, 2, 2]


def test_what_cannot_be_written(model: Reconstruction, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\.stl"):
        write_conics(model, tmp_path / "conics.stl")
    with pytest.raises(ValueError, match="conics"):
        write_conics(dataclasses.replace(model, conics=None), tmp_path / "conics.ply")


@pytest.mark.parametrize("text", ["1 2 3", "a" * 9, " ".join(["1"] * 13), " ".join(["1"] * 12 + ["1", "-1"] + ["1"] * 20)])
def test_no_text_of_ellipses(tmp_path: Path, text: str) -> None:
    path = tmp_path / "conics.txt"
    path.write_text(text + "\n")
    with pytest.raises(ValueError, match="line 1"):
        read_conics(path)
