"""Lines in files: everything comes back from text, viewers get vertices and edges."""

import dataclasses
from pathlib import Path

import pytest
import small_model
import torch

from torchsfm.formats import read_lines, read_ply, write_lines
from torchsfm.reconstruction import Reconstruction
from torchsfm.reconstruction.model.lines import Lines

F64 = torch.float64


@pytest.fixture
def model(generator: torch.Generator) -> Reconstruction:
    """Five lines, the third of which nothing shows."""

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=F64)

    line = torch.tensor([0, 0, 0, 1, 1, 3, 4, 4])
    view = torch.tensor([0, 1, 2, 0, 2, 1, 0, 0])
    lines = Lines(rand(5, 2, 3), rand(5, 3), 800 * rand(8, 2, 2), 10 * rand(8), view, line)
    return dataclasses.replace(small_model.make(), lines=lines)


def test_text_gives_everything_back(model: Reconstruction, tmp_path: Path) -> None:
    write_lines(model, tmp_path / "lines.txt")
    back = read_lines(tmp_path / "lines.txt")
    for field in dataclasses.fields(Lines):
        assert torch.equal(getattr(back, field.name), getattr(model.lines, field.name)), field.name


def test_ply_has_edges(model: Reconstruction, tmp_path: Path) -> None:
    assert model.lines is not None
    write_lines(model, tmp_path / "lines.ply")
    cloud = read_ply(tmp_path / "lines.ply")
    assert torch.equal(cloud.X, model.lines.ends.reshape(-1, 3))
    assert cloud.color is not None
    assert (cloud.color - model.lines.color.repeat_interleave(2, 0)).abs().max() <= 0.5 / 255 + 1e-12
    data = (tmp_path / "lines.ply").read_bytes()
    header, _, body = data.partition(b"end_header\n")
    assert b"element edge 5\nproperty int vertex1\nproperty int vertex2\n" in header
    first = torch.frombuffer(bytearray(body[10 * 27 :]), dtype=torch.uint8).reshape(5, 11)[:, :8].contiguous().view(torch.int32)
    assert torch.equal(first, torch.arange(10, dtype=torch.int32).reshape(5, 2))


def test_obj_has_line_elements(model: Reconstruction, tmp_path: Path) -> None:
    assert model.lines is not None
    write_lines(model, tmp_path / "lines.obj")
    words = [text.split() for text in (tmp_path / "lines.obj").read_text().splitlines()]
    vertices = torch.tensor([[float(w) for w in some[1:4]] for some in words if some[0] == "v"], dtype=F64)
    pairs = torch.tensor([[int(w) - 1 for w in some[1:]] for some in words if some[0] == "l"])
    assert torch.equal(vertices[pairs], model.lines.ends)


def test_lines_that_are_not_finite_are_left_out(model: Reconstruction, tmp_path: Path) -> None:
    assert model.lines is not None
    ends = model.lines.ends.clone()
    ends[1, 0, 2] = torch.nan
    broken = dataclasses.replace(model, lines=dataclasses.replace(model.lines, ends=ends))
    for name in ("a.ply", "a.obj", "a.txt"):
        write_lines(broken, tmp_path / name)
        assert b"nan" not in (tmp_path / name).read_bytes()
    back = read_lines(tmp_path / "a.txt")
    assert torch.equal(back.ends, ends[[0, 2, 3, 4]])
    assert back.line.tolist() == [0, 0, 0, 2, 3, 3]


def test_what_cannot_be_written(model: Reconstruction, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"path: wanted a name that ends with one of \.ply, \.obj, \.txt"):
        write_lines(model, tmp_path / "lines.stl")
    with pytest.raises(ValueError, match="wanted one with lines"):
        write_lines(dataclasses.replace(model, lines=None), tmp_path / "lines.ply")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "text",
    [
        "1 2 3",
        "1 2 3 4 5 6 0 0 0 1 0 1 2 3 4",
        "1 2 3 4 5 6 0 0 0 x",
        "1 2 3 4 5 6 0 0 0 -1",
        "1 2 3 4 5 6 0 0 0 1.5",
        "1 2 3 4 5 6 0 0 0 1 -2 1 2 3 4 5",
        "\xff\xfe",
    ],
)
def test_texts_that_are_none(text: str, tmp_path: Path) -> None:
    path = tmp_path / "lines.txt"
    path.write_bytes(b"# lines\n" + text.encode("latin-1") + b"\n")
    with pytest.raises(ValueError, match=r"is not a text of lines \(line 2: "):
        read_lines(path)


def test_no_lines(tmp_path: Path) -> None:
    (tmp_path / "lines.txt").write_text("# nothing\n")
    assert len(read_lines(tmp_path / "lines.txt")) == 0
