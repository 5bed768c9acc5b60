"""`torchsfm align`: a saved model in another world frame, or at another scale."""

from pathlib import Path
from typing import Annotated

import torch
import typer

from torchsfm.cli.export import load
from torchsfm.cli.job import Job, UserError, told
from torchsfm.formats import write_model
from torchsfm.formats.registry import format_for
from torchsfm.geometry import Similarity
from torchsfm.reconstruction.alignment import ControlPoints, align_models, align_to_points


def align(
    model: Annotated[
        Path, typer.Argument(help="Folder written by `torchsfm reconstruct`, or a model of any format.", show_default=False)
    ],
    out: Annotated[
        Path, typer.Option(help="Where to write it; the name tells the format, as for `convert`.", show_default=False)
    ],
    to: Annotated[
        Path | None, typer.Option(help="A model of some of the same images, in the frame wanted.", show_default=False)
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option(
            help="Text file of measured points, a line for each image that shows one: NAME X Y Z IMAGE x y, with x, y in pixels"
            " from the centre of the top-left one. Three points or more, each in two images or more.",
            show_default=False,
        ),
    ] = None,
    scale: Annotated[float | None, typer.Option(help="Multiply all lengths.", show_default=False)] = None,
) -> None:
    """Move a model to the frame and scale of another one or of measured points, or scale it."""
    with told(Job(out)):
        if sum(option is not None for option in (to, points, scale)) != 1:
            raise UserError("wanted one of --to, --points and --scale")
        try:
            kind = format_for(out)
        except ValueError as error:
            raise UserError(str(error)) from None
        source = load(model)
        if scale is not None:
            if not 0 < scale < float("inf"):
                raise UserError(f"--scale: wanted a positive number, got {scale:g}")
            one = torch.ones((), dtype=source.X.dtype)
            similarity = Similarity(scale * one, torch.eye(3, dtype=one.dtype), torch.zeros(3, dtype=one.dtype))
            words = f"scale {scale:g}"
        else:
            found = align_models(source, load(to)) if to is not None else align_to_points(source, read_points(points or out))
            if fault := found.fault():
                raise UserError(f"{to or points}: {fault}")
            similarity, words = found.similarity, found.summary("images" if to is not None else "points")
        try:
            write_model(source.to(torch.float64).transform(similarity), out, kind.name)
        except ValueError as error:
            raise UserError(f"{out}: {' '.join(str(error).split())}") from None
        typer.echo(f"{out}: {words}")


def read_points(path: Path) -> ControlPoints:
    """Read measured points and where images show them.

    Raises:
        UserError: The file cannot be read, or a line is not what it should be.
    """
    try:
        text = path.read_bytes().decode("utf-8", "surrogateescape")
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None
    places: dict[str, tuple[float, ...]] = {}
    images, x, point = [], [], []
    for number, line in enumerate(text.split("\n"), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            name, image = words[0], " ".join(words[4:-2])
            place, pixel = tuple(map(float, words[1:4])), tuple(map(float, words[-2:]))
            if len(words) < 7 or not bool(torch.tensor([*place, *pixel]).isfinite().all()):
                raise ValueError
        except ValueError:
            raise UserError(f"{path}, line {number}: wanted NAME X Y Z IMAGE x y, got {line.strip()[:60]!r}") from None
        if places.setdefault(name, place) != place:
            raise UserError(f"{path}, line {number}: the point {name} has another place than before")
        images.append(image)
        x.append(pixel)
        point.append(list(places).index(name))
    return ControlPoints(
        tuple(places),
        torch.tensor(list(places.values()), dtype=torch.float64).reshape(-1, 3),
        tuple(images),
        torch.tensor(x, dtype=torch.float64).reshape(-1, 2),
        torch.tensor(point, dtype=torch.long),
    )
