"""`torchsfm export` and `torchsfm convert`: saved models for other programs."""

import json
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from torchsfm.cli.job import Job, UserError, told
from torchsfm.formats import FORMATS, TARGETS, export_model, read_model, write_model
from torchsfm.formats.export import check_replaceable
from torchsfm.formats.registry import format_for
from torchsfm.reconstruction import Reconstruction

PHOTOGRAPHS = "photographs"
"""The entry of `report.json` that names the folder of the photographs."""


def known_targets(names: list[str] | None) -> list[str]:
    """See that there are programs of these names.

    Raises:
        BadParameter: There is one of none.
    """
    for name in names or []:
        if name not in TARGETS:
            raise typer.BadParameter(f"{name!r} is not one of {', '.join(map(repr, TARGETS))}.")
    return names or []


def known_format(name: str | None) -> str | None:
    """See that a format of this name is written.

    Raises:
        BadParameter: There is none.
    """
    writable = [kind.name for kind in FORMATS if kind.write is not None]
    if name is not None and name not in writable:
        raise typer.BadParameter(f"{name!r} is not one of {', '.join(map(repr, writable))}.")
    return name


Images = Annotated[
    Path | None,
    typer.Option(
        help="Folder with the photographs under their names; by default where `torchsfm reconstruct` read them, or a folder"
        " `images` beside the model.",
        show_default=False,
    ),
]
Undistort = Annotated[
    bool | None,
    typer.Option(
        "--undistort/--as-taken",
        help="Write pictures without distortion and pinhole cameras, or pictures as they were taken. By default undistorted"
        " where the program wants pictures.",
        show_default=False,
    ),
]
Alpha = Annotated[
    float, typer.Option(min=0, max=1, help="Undistorted pictures: 0 crops to what is full, 1 keeps all, with black borders.")
]
Centred = Annotated[bool, typer.Option("--centred", help="Undistorted pictures: the principal point at the centre.")]


def export(
    model: Annotated[
        Path, typer.Argument(help="Folder written by `torchsfm reconstruct`, or a model of any format.", show_default=False)
    ],
    target: Annotated[
        list[str],
        typer.Option(
            "--for",
            callback=known_targets,
            metavar=f"[{'|'.join(TARGETS)}]",
            help="The program to write for. " + "; ".join(f"{name}: {kind.what}" for name, kind in TARGETS.items()) + ".",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option(help="The folder to write: new, empty, or an earlier export.", show_default=False)],
    images: Images = None,
    undistort: Undistort = None,
    alpha: Alpha = 0.0,
    centred: Centred = False,
) -> None:
    """Write a folder that another program can be pointed at: model and, where it wants them, undistorted pictures."""
    with told(Job(out)) as job:
        if len(target) != 1:
            raise UserError("--for: one program at a time")
        found = load(model)
        folder = images or find_photographs(model, found)
        write_export(job, found, target[0], out, folder, undistort=undistort, alpha=alpha, centred=centred)


def convert(
    source: Annotated[Path, typer.Argument(help="A model of any format, or a folder that holds one.", show_default=False)],
    target: Annotated[
        Path, typer.Argument(help="Where to write it; the name tells the format, one without ending is COLMAP's folder.")
    ],
    to: Annotated[
        str | None,
        typer.Option(
            callback=known_format,
            metavar=f"[{'|'.join(kind.name for kind in FORMATS if kind.write)}]",
            help="The format, where the name does not tell it.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Write a model in another format."""
    with told(Job(target)) as job:
        model = load(source)
        job.progress("write", 0, 1)
        try:
            kind = format_for(target, to)
            write_model(model, target, kind.name)
        except ValueError as error:
            raise UserError(f"{target}: {' '.join(str(error).split())}") from None
        job.progress("write", 1, 1)
        job.close()
        typer.echo(f"{target}: {kind.what}, {model.num_registered} images, {model.num_points} points")
        job.voice.record.update(model_record(model, target, kind.name))


def load(path: Path) -> Reconstruction:
    """Read the model, the largest where there are several.

    Raises:
        UserError: It cannot be read.
    """
    try:
        return read_model(path)
    except ValueError as error:
        raise UserError(" ".join(str(error).split())) from None


def model_record(model: Reconstruction, out: Path, kind: str) -> dict[str, Any]:
    """What programs are told of a model that was written: where, in which format, and how much it has of what."""
    more = {"lines": model.lines, "ellipses": model.conics, "curves": model.curves}
    counts = {"images": model.num_registered, "points": model.num_points, "observations": model.num_observations}
    return {"out": str(out), "format": kind} | counts | {key: len(some) for key, some in more.items() if some is not None}


def find_photographs(path: Path, model: Reconstruction) -> Path | None:
    """The folder in which the photographs of a model lie; None where they are not found."""
    folder = path if path.is_dir() else path.parent
    candidates: list[Any] = []
    with suppress(OSError, ValueError, TypeError, KeyError):
        candidates.append(json.loads((folder / "report.json").read_bytes())[PHOTOGRAPHS])
    candidates += [place / "images" for place in (folder, *list(folder.absolute().parents)[:2])]
    for candidate in candidates:
        with suppress(OSError, ValueError, TypeError):
            if model.names and (Path(candidate) / model.names[0]).is_file():
                return Path(candidate)
    return None


def check_exports(out: Path, targets: list[str]) -> None:
    """See that exports can be written into a folder of results, before the work.

    Raises:
        UserError: There are other files in their place.
    """
    for target in targets:
        try:
            check_replaceable(out / target)
        except ValueError as error:
            raise UserError(str(error)) from None


def write_export(job: Job, model: Reconstruction, target: str, out: Path, images: Path | None, **options: Any) -> None:
    """Write one export and say what it is.

    Raises:
        UserError: It cannot be written.
    """
    undistort = options.get("undistort")
    stage = "pictures" if (TARGETS[target].pictures if undistort is None else undistort) else "write"
    job.progress(stage, 0, 1)

    def progress(done: int, total: int) -> None:
        job.progress(stage, done, total)

    try:
        export_model(model, target, out, images=images, progress=progress, **options)
        if stage == "write":
            job.progress(stage, 1, 1)
    except ValueError as error:
        raise UserError(" ".join(str(error).split())) from None
    job.close()
    typer.echo(f"{out}  for {target}: {TARGETS[target].what}")
    job.voice.record.setdefault("exports", []).append({"for": target, "out": str(out), "images": model.num_registered})
