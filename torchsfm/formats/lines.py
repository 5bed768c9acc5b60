"""Lines of a model: PLY and OBJ for viewers, and a plain text with the segments that show them."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.files import whole_file
from torchsfm.reconstruction.model.lines import Lines
from torchsfm.reconstruction.model.reconstruction import Reconstruction

HEAD = """# Lines in space and the image segments that show them, one line of the model on each line of text:
# X1 Y1 Z1 X2 Y2 Z2 red green blue count, then for each segment: image x1 y1 x2 y2 weight
# World coordinates of both ends, colours from 0 to 1, images by number from 0, pixels with the centre of the top-left one at
# (0, 0), weights as inverse variances across the segment in pixels^-2.
"""


@on_the_cpu
def write_lines(model: Reconstruction, path: str | Path) -> None:
    """Write the lines of a model, in the format that the name ends with.

    `.ply` has their ends as vertices with colours, and edges (`vertex1`, `vertex2`), as MeshLab and Blender read them; `.obj`
    has vertices and line elements `l`; `.txt` is for people and `read_lines`: everything, in decimal digits that lose nothing.

    Args:
        model: A model with lines.
        path: The file to write; its folder must be there.

    Raises:
        ValueError: The model has no lines, or the name ends otherwise.
        OSError: The file cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> from dataclasses import replace
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> model, index = torchsfm.read_model("model.npz"), torch.zeros(0, dtype=torch.int64)
        >>> ends, empty = model.X[:10].reshape(5, 2, 3), torch.zeros(0, dtype=torch.float64)
        >>> lines = torchsfm.Lines(ends, torch.ones_like(ends[:, 0]), empty.reshape(0, 2, 2), empty, index, index)
        >>> torchsfm.write_lines(replace(model, lines=lines), "lines.txt")
        >>> torchsfm.read_lines("lines.txt").ends.shape
        torch.Size([5, 2, 3])
    """
    path = Path(path)
    if model.lines is None:
        raise ValueError("model: wanted one with lines, got one in which none were looked for")
    writers = {".ply": _ply, ".obj": _obj, ".txt": _text}
    if path.suffix not in writers:
        raise ValueError(f"path: wanted a name that ends with one of {', '.join(writers)}, got {path.name!r}")
    content = writers[path.suffix](model.lines.select(model.lines.ends.isfinite().flatten(1).all(1)).detached())
    with whole_file(path) as file:
        file.write(content)


@on_the_cpu
def read_lines(path: str | Path) -> Lines:
    """Read what `write_lines` wrote as text.

    Args:
        path: The file.

    Returns:
        The lines with their segments, in float64.

    Raises:
        ValueError: The file is no such text; one line that says where.
        OSError: It cannot be read.

    Example:
        >>> import torch, torchsfm
        >>> from dataclasses import replace
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> model, index = torchsfm.read_model("model.npz"), torch.zeros(0, dtype=torch.int64)
        >>> ends, empty = model.X[:10].reshape(5, 2, 3), torch.zeros(0, dtype=torch.float64)
        >>> lines = torchsfm.Lines(ends, torch.ones_like(ends[:, 0]), empty.reshape(0, 2, 2), empty, index, index)
        >>> torchsfm.write_lines(replace(model, lines=lines), "lines.txt")
        >>> len(torchsfm.read_lines("lines.txt")), torchsfm.read_lines("lines.txt").support()  # seen in no image
        (5, tensor([0, 0, 0, 0, 0]))
    """
    ends, color, segments, line = [], [], [], []
    for number, text in enumerate(Path(path).read_bytes().decode("ascii", "replace").splitlines(), 1):
        words = text.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            values = [float(word) for word in words]
            count = int(words[9])
            if count < 0 or len(values) != 10 + 6 * count:
                raise ValueError(f"wanted {10 + 6 * count} numbers, got {len(values)}")
            ends.append(values[:6])
            color.append(values[6:9])
            for k in range(count):
                some = values[10 + 6 * k : 16 + 6 * k]
                if int(words[10 + 6 * k]) < 0:
                    raise ValueError("wanted image numbers from 0")
                segments.append(some)
                line.append(len(ends) - 1)
        except (ValueError, IndexError) as error:
            raise ValueError(f"{path} is not a text of lines (line {number}: {error})") from None
    seen = torch.tensor(segments, dtype=torch.float64).reshape(-1, 6)
    return Lines(
        ends=torch.tensor(ends, dtype=torch.float64).reshape(-1, 2, 3),
        color=torch.tensor(color, dtype=torch.float64).reshape(-1, 3),
        x=seen[:, 1:5].reshape(-1, 2, 2),
        weight=seen[:, 5],
        view=seen[:, 0].long(),
        line=torch.tensor(line, dtype=torch.long),
    )


def _ply(lines: Lines) -> bytes:
    return pieces_as_ply(lines.ends, lines.color)


def pieces_as_ply(ends: Float[Tensor, "l 2 3"], color: Float[Tensor, "l 3"]) -> bytes:
    """A PLY file of pieces of straight lines."""
    real = "<f8" if ends.dtype == torch.float64 else "<f4"
    vertices = np.empty(2 * len(ends), [(a, real) for a in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")])
    edges = np.empty(
        len(ends),
        [(name, t) for t, names in (("<i4", ("vertex1", "vertex2")), ("u1", ("red", "green", "blue"))) for name in names],
    )
    levels = _levels(color)
    for i, axis in enumerate("xyz"):
        vertices[axis] = ends[..., i].reshape(-1).numpy()
    for i, channel in enumerate(("red", "green", "blue")):
        vertices[channel], edges[channel] = levels[:, i].repeat(2), levels[:, i]
    edges["vertex1"], edges["vertex2"] = np.arange(0, 2 * len(ends), 2), np.arange(1, 2 * len(ends), 2)
    words = {"<f8": "double", "<f4": "float", "|u1": "uchar", "<i4": "int"}
    header = ["ply", "format binary_little_endian 1.0"]
    for name, records in (("vertex", vertices), ("edge", edges)):
        header.append(f"element {name} {len(records)}")
        header += [f"property {words[records.dtype[field].str]} {field}" for field in records.dtype.names or ()]
    return ("\n".join([*header, "end_header"]) + "\n").encode("ascii") + vertices.tobytes() + edges.tobytes()


def _obj(lines: Lines) -> bytes:
    return pieces_as_obj(lines.ends, lines.color)


def pieces_as_obj(ends: Float[Tensor, "l 2 3"], color: Float[Tensor, "l 3"]) -> bytes:
    """An OBJ file of pieces of straight lines."""
    rows = ["# lines of a model: vertices with colours, and line elements"]
    for (a, b), shade in zip(ends.tolist(), color.clamp(0, 1).tolist(), strict=True):
        rows += ["v " + " ".join(map(repr, [*end, *(round(c, 4) for c in shade)])) for end in (a, b)]
    rows += [f"l {2 * k + 1} {2 * k + 2}" for k in range(len(ends))]
    return ("\n".join(rows) + "\n").encode("ascii")


def _text(lines: Lines) -> bytes:
    rows: list[list[float]] = [
        [*end, *color] for end, color in zip(lines.ends.flatten(1).tolist(), lines.color.tolist(), strict=True)
    ]
    seen: list[list[str]] = [[] for _ in rows]
    for k, view, x, weight in zip(
        lines.line.tolist(), lines.view.tolist(), lines.x.flatten(1).tolist(), lines.weight.tolist(), strict=True
    ):
        seen[k] += [str(view), *map(repr, x), repr(weight)]
    texts = [" ".join([*map(repr, row), str(len(some) // 6), *some]) for row, some in zip(rows, seen, strict=True)]
    return (HEAD + "\n".join(texts) + "\n").encode("ascii")


def _levels(color: Tensor) -> npt.NDArray[np.uint8]:
    return (color.nan_to_num(0).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
