"""`torchsfm align`: a saved model in another world frame, or at another scale."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch
import typer

from torchsfm.cli.export import find_photographs, load, model_record
from torchsfm.cli.job import Job, UserError, told
from torchsfm.formats import write_model
from torchsfm.formats.registry import format_for
from torchsfm.geometry import Similarity
from torchsfm.reconstruction import Reconstruction
from torchsfm.reconstruction.messages import printable
from torchsfm.reconstruction.model.alignment import Alignment, ControlPoints, align_models, align_to_points
from torchsfm.reconstruction.model.control import adjust_to_points
from torchsfm.reconstruction.model.gps import align_to_gps
from torchsfm.reconstruction.model.upright import align_to_ground, align_upright


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
    gps: Annotated[
        bool, typer.Option("--gps", help="To metres east, north and up, by the positions in the photographs' Exif tags or XMP.")
    ] = False,
    up: Annotated[bool, typer.Option("--up", help="So that z points up, by how the cameras were held.")] = False,
    ground: Annotated[bool, typer.Option("--ground", help="So that z points up and z = 0 is the ground.")] = False,
    images: Annotated[
        Path | None,
        typer.Option(help="For --gps: the folder of the photographs, unless they lie where they did.", show_default=False),
    ] = None,
    bend: Annotated[
        float | None,
        typer.Option(
            metavar="SIGMA",
            help="For --points: adjust the model to them; SIGMA is how well they were measured, in their unit.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Move a model to the frame and scale of another one, of GPS, of measured points or of the ground; or scale it."""
    with told(Job(out)) as job:
        if sum((to is not None, points is not None, scale is not None, gps, up, ground)) != 1:
            raise UserError("wanted one of --to, --gps, --points, --up, --ground and --scale")
        if bend is not None and (points is None or not 0 < bend < float("inf")):
            raise UserError("--bend: wanted a positive number, together with --points")
        try:
            kind = format_for(out)
        except ValueError as error:
            raise UserError(str(error)) from None
        source = load(model)
        if scale is not None:
            if not 0 < scale < float("inf"):
                raise UserError(f"--scale: wanted a positive number, got {scale:g}")
            one = torch.ones((), dtype=torch.float64)
            similarity = Similarity(scale * one, torch.eye(3, dtype=one.dtype), torch.zeros(3, dtype=one.dtype))
            found = _Found(similarity, f"scale {scale:g}")
        elif bend is not None and points is not None:
            job.progress("bundle", 0, 1)
            found = _bent(source, points, bend)
        else:
            found = _aligned(source, model, to, points, images, gps=gps, ground=ground)
        moved = found.model or source.to(torch.float64).transform(found.similarity)
        job.close()
        try:
            write_model(moved, out, kind.name)
        except ValueError as error:
            raise UserError(f"{out}: {' '.join(str(error).split())}") from None
        typer.echo(f"{out}: {found.words}")
        s = found.similarity
        parts = {"scale": float(s.scale), "rotation": s.R.tolist(), "translation": s.t.tolist()}
        job.voice.record.update(model_record(moved, out, kind.name), similarity=parts, **found.record)


@dataclass(frozen=True)
class _Found:
    """Where a model goes, in words and, with what is known of that, for programs; the model itself where it was bent."""

    similarity: Similarity
    words: str
    record: dict[str, Any] = field(default_factory=dict)
    model: Reconstruction | None = None


def _bent(source: Reconstruction, points: Path, sigma: float) -> _Found:
    """The model adjusted to measured points.

    Raises:
        UserError: They do not determine it, or contradict it.
    """
    bent = adjust_to_points(source, read_points(points), sigma=sigma)
    words = _good(points, bent.fault(), bent.summary)
    rows = zip(bent.control.names, bent.apart.norm(dim=-1).tolist(), bent.deviation.tolist(), strict=True)
    record = {"aligned": [{"name": name, "apart": apart, "deviation": deviation} for name, apart, deviation in rows]}
    return _Found(bent.alignment.similarity, words, record, bent.model)


def _aligned(
    source: Reconstruction, model: Path, to: Path | None, points: Path | None, images: Path | None, *, gps: bool, ground: bool
) -> _Found:
    """Where the model goes, and how well that is known.

    Raises:
        UserError: It is not known.
    """
    if gps:
        folder = images or find_photographs(model, source)
        if folder is None:
            raise UserError(f"{model}: the photographs were not found; say with --images where they lie")
        placed = align_to_gps(source, folder)
        words = _good(folder, placed.fault(), placed.summary)
        return _Found(placed.alignment.similarity, words, {"origin": placed.origin.tolist()} | _record(placed.alignment))
    if to is not None or points is not None:
        found = align_models(source, load(to)) if to is not None else align_to_points(source, read_points(points or model))
        words = _good(to or points or model, found.fault(), lambda: found.summary("images" if to is not None else "points"))
        aside = [f"{name} ({d:.3g} off)" for name, d, used in
                 zip(found.names, found.distance.tolist(), found.used.tolist(), strict=True) if not used]  # fmt: skip
        words += f"; left aside: {', '.join(map(printable, aside[:5]))}" if aside else ""
        return _Found(found.similarity, words, _record(found))
    level = align_to_ground(source) if ground else align_upright(source)
    words = _good(model, level.fault(), level.summary)
    record = {"sigma_deg": math.degrees(level.sigma), "level_cameras": int(level.held.sum())}
    return _Found(
        level.similarity, words, record | ({} if level.ground is None else {"ground_points": int(level.ground.sum())})
    )


def _record(found: Alignment) -> dict[str, Any]:
    """For programs: how far off each image or point is that both worlds have."""
    rows = zip(found.names, found.distance.tolist(), found.used.tolist(), strict=True)
    return {"aligned": [{"name": name, "apart": apart, "used": used} for name, apart, used in rows]}


def _good(source: Path, fault: str, summary: Callable[[], str]) -> str:
    """What to say of an alignment that is determined.

    Raises:
        UserError: It is not.
    """
    if fault:
        raise UserError(f"{source}: {fault}")
    return summary()


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
