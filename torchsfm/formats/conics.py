"""Ellipses in space of a model: PLY and OBJ for viewers, and a plain text with the measured ellipses that show them."""

from pathlib import Path

import torch
from torch import Tensor

from torchsfm.formats.lines import pieces_as_obj, pieces_as_ply
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.conics import Conics
from torchsfm.reconstruction.model.files import whole_file
from torchsfm.reconstruction.model.reconstruction import Reconstruction

HEAD = """# Ellipses in space and what images show of them, one ellipse of the model on each line of text:
# centre X Y Z, semi-axes aX aY aZ bX bY bZ, red green blue, count, then for each measured ellipse:
# image x y a b angle, and the 15 numbers of the upper triangle of the covariance of these five, row by row
# World coordinates, colours from 0 to 1, images by number from 0, pixels (the centre of the top-left one at (0, 0)), radians
"""
_SEEN = 21
_ROWS, _COLUMNS = torch.triu_indices(5, 5)


@on_the_cpu
def write_conics(model: Reconstruction, path: str | Path) -> None:
    """Write the ellipses of a model, in the format that the name ends with.

    `.ply` and `.obj` have their outlines as 64 edges each, as `write_lines` has lines; `.txt` is for people and `read_conics`:
    everything, in decimal digits that lose nothing.

    Args:
        model: A model with ellipses in `conics`.
        path: The file to write; its folder must be there.

    Raises:
        ValueError: The model has no ellipses, or the name ends otherwise.
        OSError: The file cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> from dataclasses import replace
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> disc = torchsfm.Ellipsoid(torch.zeros(1, 3).double(), torch.diag(torch.tensor([2.0, 1.0, 0.0]))[None].double())
        >>> none, index = torch.zeros(0, 5).double(), torch.zeros(0, dtype=torch.int64)  # measured nowhere
        >>> seen, covariance = torchsfm.Ellipse(none[:, :2], none[:, :2], none[:, 0]), torch.zeros(0, 5, 5).double()
        >>> conics = torchsfm.reconstruction.Conics.of(disc, seen, covariance, index, index)
        >>> torchsfm.formats.write_conics(replace(torchsfm.read_model("model.npz"), conics=conics), "conics.txt")
        >>> torchsfm.formats.read_conics("conics.txt").axes.norm(dim=-1)
        tensor([[2., 1.]], dtype=torch.float64)
    """
    path = Path(path)
    if model.conics is None:
        raise ValueError("model: wanted one with ellipses in 'conics', got one with None")
    writers = {".ply": _ply, ".obj": _obj, ".txt": _text}
    if path.suffix not in writers:
        raise ValueError(f"path: wanted a name that ends with one of {', '.join(writers)}, got {path.name!r}")
    conics = model.conics.detached()
    sound = conics.centre.isfinite().all(1) & conics.axes.isfinite().flatten(1).all(1)
    content = writers[path.suffix](conics.select(sound))
    with whole_file(path) as file:
        file.write(content)


@on_the_cpu
def read_conics(path: str | Path) -> Conics:
    """Read what `write_conics` wrote as text.

    Args:
        path: The file.

    Returns:
        The ellipses with what images show of them, in float64.

    Raises:
        ValueError: The file is no such text; one line that says where.
        OSError: It cannot be read.

    Example:
        >>> import torch, torchsfm
        >>> from dataclasses import replace
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> disc = torchsfm.Ellipsoid(torch.zeros(1, 3).double(), torch.diag(torch.tensor([2.0, 1.0, 0.0]))[None].double())
        >>> none, index = torch.zeros(0, 5).double(), torch.zeros(0, dtype=torch.int64)  # measured nowhere
        >>> seen, covariance = torchsfm.Ellipse(none[:, :2], none[:, :2], none[:, 0]), torch.zeros(0, 5, 5).double()
        >>> conics = torchsfm.reconstruction.Conics.of(disc, seen, covariance, index, index)
        >>> torchsfm.formats.write_conics(replace(torchsfm.read_model("model.npz"), conics=conics), "conics.txt")
        >>> torchsfm.formats.read_conics("conics.txt").centre
        tensor([[0., 0., 0.]], dtype=torch.float64)
    """
    rows: list[list[float]] = []
    seen: list[list[float]] = []
    conic: list[int] = []
    for number, text in enumerate(Path(path).read_bytes().decode("ascii", "replace").splitlines(), 1):
        words = text.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            values = [float(word) for word in words]
            count = int(words[12])
            if count < 0 or len(values) != 13 + _SEEN * count:
                raise ValueError(f"wanted {13 + _SEEN * count} numbers, got {len(values)}")
            for start in range(13, len(values), _SEEN):
                if not 0 <= int(words[start]) < 2**31:
                    raise ValueError("wanted image numbers from 0")
                seen.append(values[start : start + _SEEN])
                conic.append(len(rows))
            rows.append(values[:12])
        except (ValueError, IndexError) as error:
            raise ValueError(f"{path} is not a text of ellipses (line {number}: {error})") from None
    model = torch.tensor(rows, dtype=torch.float64).reshape(-1, 12)
    found = torch.tensor(seen, dtype=torch.float64).reshape(-1, _SEEN)
    covariance = found.new_zeros(len(found), 5, 5)
    covariance[:, _ROWS, _COLUMNS] = covariance[:, _COLUMNS, _ROWS] = found[:, 6:]
    return Conics(
        centre=model[:, :3],
        axes=model[:, 3:9].reshape(-1, 2, 3),
        color=model[:, 9:],
        x=found[:, 1:6],
        covariance=covariance,
        view=found[:, 0].long(),
        conic=torch.tensor(conic, dtype=torch.long),
    )


def _ply(conics: Conics) -> bytes:
    return pieces_as_ply(*_pieces(conics))


def _obj(conics: Conics) -> bytes:
    return pieces_as_obj(*_pieces(conics))


def _pieces(conics: Conics) -> tuple[Tensor, Tensor]:
    """Chords of the outlines, and their colours."""
    chords = conics.chords()
    return chords, conics.color.repeat_interleave(len(chords) // max(len(conics), 1), 0)


def _text(conics: Conics) -> bytes:
    rows = torch.cat((conics.centre, conics.axes.flatten(1), conics.color), 1).tolist()
    numbers = torch.cat((conics.x, conics.covariance[:, _ROWS, _COLUMNS]), 1).tolist()
    seen: list[list[str]] = [[] for _ in rows]
    for k, view, values in zip(conics.conic.tolist(), conics.view.tolist(), numbers, strict=True):
        seen[k] += [str(view), *map(repr, values)]
    texts = [" ".join([*map(repr, row), str(len(some) // _SEEN), *some]) for row, some in zip(rows, seen, strict=True)]
    return (HEAD + "\n".join(texts) + "\n").encode("ascii")
