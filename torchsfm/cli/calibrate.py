"""`torchsfm calibrate`: intrinsics of a camera from photographs of a chessboard or of circles in a grid."""

import json
import shlex
import sys
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import torch
import typer
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Status
from torchsfm.autocalibration import PlaneCalibration
from torchsfm.autocalibration.board_shape import BOARD, NAMES
from torchsfm.autocalibration.plane_models import LENSES, calibrate_unknown_planes
from torchsfm.cli.calibration_remarks import remarks
from torchsfm.cli.job import NOTHING, Job, UserError, told
from torchsfm.cli.output import output_folder
from torchsfm.cli.results import VERSION
from torchsfm.geometry import DISTORTION_MODELS
from torchsfm.geometry.intrinsic_parameters import HEAD, intrinsic_labels, row_from_camera
from torchsfm.images import (
    ImageError,
    detect_chessboard,
    detect_circles_grid,
    list_images,
    read_image,
    save_image,
    undistort_images,
    undistorted_cameras,
)
from torchsfm.images.board_sizes import chessboard_size, circles_grid_size
from torchsfm.optim import Huber
from torchsfm.reconstruction.messages import printable
from torchsfm.reconstruction.model.files import write_whole_files

_FAR = 3.0
"""How many times the median error of photographs is an error worth a remark."""
_LOOKED_AT = 8
"""Photographs in which boards of other sizes are looked for."""
_FREE = "focal,aspect,principal_point"


class Pattern(StrEnum):
    """Patterns of `--pattern`."""

    chessboard = "chessboard"
    circles = "circles"


@dataclass
class _Photograph:
    """One file, and what became of it."""

    path: Path
    size: tuple[int, int] = (0, 0)
    x: Float[Tensor, "n 2"] | None = None
    """Corners, or centres of the outlines of circles."""
    radius: float | None = None
    """Of the circles, in units of the distance between neighbours."""
    rms: float | None = None
    problem: str = ""


def calibrate(
    images: Annotated[list[Path], typer.Argument(help="A folder of photographs, or image files.", show_default=False)],
    out: Annotated[Path, typer.Option(help="Folder for the camera, the report and undistorted pictures.")],
    board: Annotated[
        str, typer.Option(metavar="COLUMNSxROWS", help="Inner corners of the chessboard, or circles, in a row and in a column.")
    ] = "9x6",
    pattern: Annotated[Pattern, typer.Option(help="What the board shows.")] = Pattern.chessboard,
    size: Annotated[float, typer.Option(help="Distance between neighbouring corners or centres, in any unit.")] = 1.0,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar=f"[{'|'.join(DISTORTION_MODELS)}]",
            help="Lens distortion; radial, opencv or fisheye by what the photographs say.",
            show_default=False,
        ),
    ] = None,
    free: Annotated[
        str | None,
        typer.Option(
            help="What to find besides the distortion: focal, aspect, skew, principal_point, and board, its stretch and bend,"
            f" with commas; {_FREE}, and board where the photographs say so.",
            show_default=False,
        ),
    ] = None,
    loss_scale: Annotated[float, typer.Option(min=1e-6, help="Pixels from which on errors count less.")] = 1.0,
    previews: Annotated[int, typer.Option(min=0, help="Most undistorted pictures to write.")] = 4,
    threads: Annotated[int | None, typer.Option(min=1, help="Processor threads; all by default.")] = None,
) -> None:
    """Calibrate a camera from photographs of a flat pattern, and say how sure the result is.

    The camera file `camera.txt` is what `--intrinsics` of other commands takes.
    """
    with told(Job(out)) as job, output_folder(out):
        job.set_threads(threads)
        columns, rows = _board(board)
        if camera is not None and camera not in DISTORTION_MODELS:
            raise UserError(f"--camera: {camera!r} is not one of {', '.join(map(repr, DISTORTION_MODELS))}")
        if not 0 < size < float("inf"):
            raise UserError(f"--size: wanted a length greater than 0, got {size:g}")
        photographs = _find(job, images, pattern, columns, rows)
        seen = [p for p in photographs if p.x is not None]
        if not seen:
            job.close()
            for p in photographs:
                typer.echo(f"{printable(p.path.name)}: {p.problem}", err=True)
            job.fail(f"no photograph shows the whole {board} {pattern.value} pattern{_seen_instead(photographs, pattern)}")
            raise typer.Exit(NOTHING)
        place = torch.arange(columns * rows)
        X = size * torch.stack((place % columns, place // columns), -1).double()
        x = torch.stack([p.x for p in seen if p.x is not None]).double()
        try:
            words = tuple(word.strip() for word in (free or _FREE).split(","))
            options: dict[str, Any] = {
                "boards": (False, True) if free is None else (BOARD in words,),
                "free": tuple(word for word in words if word != BOARD),
                "loss": Huber(loss_scale),
                "radius": _radius(seen, size),
                "image_size": (float(seen[0].size[0]), float(seen[0].size[1])),
            }
            lenses = LENSES if camera is None else (camera, *(lens for lens in LENSES if lens != camera))
            likeliest, found = calibrate_unknown_planes(x, X, lenses=lenses, **options)
            better = ""
            if camera not in (None, likeliest):
                better = f"Doubtful: a lens of the kind {likeliest} explains the photographs better: {float(found.rms):.3f} px."
                found = calibrate_unknown_planes(x, X, lenses=[camera], **options)[1]
            else:
                camera = likeliest
        except ValueError as error:
            raise UserError(" ".join(str(error).split())) from None
        typical = float(found.view_rms.median())
        for p, rms, first in zip(seen, found.view_rms.tolist(), [seen[i] for i in found.copy_of.tolist()], strict=True):
            p.rms = rms
            if first is not p:
                p.x, p.problem = None, f"is {printable(first.path.name)} once more"
            elif rms > _FAR * typical:
                p.problem = f"fits badly: {rms / typical:.1f} times the median error"
        known = {name: options[name] for name in ("loss", "radius", "image_size")}
        bent = (BOARD,) if NAMES[0] in found.parameter_names else ()
        known |= {"distortion": DISTORTION_MODELS[camera], "free": (*options["free"], *bent)}
        said = remarks(found, x, X, known, [printable(p.path.name) for p in seen], size)
        pattern_said = {"board": board, "pattern": pattern.value, "size": size}
        record = _record(found, photographs, camera, seen[0].size, pattern_said, [better, *said] if better else said)
        texts = {"calibration.json": json.dumps(record, indent=1), "calibration.md": _markdown(record)}
        if found.status == Status.OK:
            texts["camera.txt"] = _camera_file(record, found.camera.K)
            _write_previews(job, found, [p for p in seen if not p.problem][:previews])
        else:
            (out / "camera.txt").unlink(missing_ok=True)
        write_whole_files({out / name: text.encode() for name, text in texts.items()})
        job.close()
        job.voice.record["calibration"] = record
        typer.echo(_markdown(record))
        if found.status != Status.OK:
            job.fail(f"the photographs do not determine the camera ({record['status']}). {' '.join(said)}".rstrip())
            raise typer.Exit(NOTHING)
        typer.echo(f"{out / 'camera.txt'}  the matrix K, for --intrinsics")


def _board(text: str) -> tuple[int, int]:
    words = text.lower().split("x")
    if len(words) != 2 or not all(word.strip().isdigit() and 3 <= int(word) <= 200 for word in words):
        raise UserError(f"--board: wanted COLUMNSxROWS, such as 9x6, got {text!r}")
    return int(words[0]), int(words[1])


def _find(job: Job, images: list[Path], pattern: Pattern, columns: int, rows: int) -> list[_Photograph]:
    """All photographs, with the points of the pattern where it is seen, those of another size than most left out."""
    try:
        paths = [path for given in images for path in (list_images(given) if given.is_dir() else [given])]
    except ImageError as error:
        raise UserError(str(error)) from None
    if not paths:
        raise UserError(f"{images[0]}: holds no images")
    detect = detect_chessboard if pattern is Pattern.chessboard else detect_circles_grid
    photographs = [_Photograph(path) for path in paths]
    for i, p in enumerate(photographs):
        job.progress("pattern", i, len(photographs))
        try:
            image = read_image(p.path, gray=True).pixels
        except (ImageError, OSError) as error:
            p.problem = " ".join(str(error).split())
            continue
        p.size = image.shape[-1], image.shape[-2]
        if min(p.size) < 8:
            p.problem = "too small"
            continue
        points = detect(image, columns, rows)
        if bool(points.found):
            p.x = points.x if points.outlines is None else points.outlines
            p.radius = None if points.radius is None else float(points.radius)
        else:
            p.problem = "the pattern is not found, or not all of it"
    job.progress("pattern", len(photographs), len(photographs))
    sizes = [p.size for p in photographs if p.x is not None]
    usual = max(sizes, key=sizes.count, default=(0, 0))
    for p in photographs:
        if p.x is not None and p.size != usual:
            turned = ", as if turned by a quarter" if p.size == usual[::-1] else ""
            p.x, p.problem = None, f"has {p.size[0]} x {p.size[1]} pixels{turned}, most have {usual[0]} x {usual[1]}"
    return photographs


def _seen_instead(photographs: list[_Photograph], pattern: Pattern) -> str:
    """What boards the first of the photographs show, where none shows the one that was asked for."""
    some = [p.path for p in photographs if min(p.size) >= 8][:_LOOKED_AT]
    readable = [read_image(path, gray=True).pixels for path in some]
    for shown in sorted(Pattern, key=lambda other: other is not pattern):
        size_of = chessboard_size if shown is Pattern.chessboard else circles_grid_size
        sizes = [size for size in map(size_of, readable) if size is not None]
        if sizes:
            columns, rows = max(sizes, key=lambda size: (sizes.count(size), size))
            words = f"--board {columns}x{rows}" + ("" if shown is pattern else f" --pattern {shown.value}")
            return f"; {sizes.count((columns, rows))} of {len(readable)} seem to show what {words} stands for"
    return ""


def _radius(seen: list[_Photograph], size: float) -> float | None:
    """Of the circles of the board, as most photographs show it."""
    shown = sorted(p.radius for p in seen if p.radius is not None)
    return size * shown[len(shown) // 2] if shown else None


def _record(
    found: PlaneCalibration,
    photographs: list[_Photograph],
    camera: str,
    size: tuple[int, int],
    board: dict[str, Any],
    remarks: list[str],
) -> dict[str, Any]:
    K = found.camera.K
    model = DISTORTION_MODELS[camera]
    values = {"fx": K[0, 0], "fy": K[1, 1], "skew": K[0, 1], "cx": K[0, 2], "cy": K[1, 2]}
    values |= dict(zip(intrinsic_labels(model)[HEAD:], row_from_camera(found.camera)[HEAD:], strict=True))
    sigma = dict(zip(found.parameter_names, found.deviation.tolist(), strict=True))
    shape = dict(zip(NAMES, found.board_shape.tolist(), strict=True)) if NAMES[0] in sigma else {}
    return {
        "torchsfm": VERSION,
        "command": shlex.join(sys.argv[1:]),
        "status": Status(int(found.status)).name,
        "pattern": board,
        "image_size": list(size),
        "camera": camera,
        "intrinsics": {name: {"value": float(value), "sigma": sigma.get(name)} for name, value in values.items()},
        "rms": float(found.rms),
        "disagreement": float(found.disagreement),
        "board": {name: {"value": value, "sigma": sigma[name]} for name, value in shape.items()},
        "remarks": remarks,
        "photographs": [
            {"name": p.path.name, "used": p.x is not None, "rms": p.rms, "problem": p.problem} for p in photographs
        ],
    }


def _markdown(record: dict[str, Any]) -> str:
    used = sum(p["used"] for p in record["photographs"])
    width, height = record["image_size"]
    lines = [
        f"# Calibration: {record['status']}",
        "",
        f"{used} of {len(record['photographs'])} photographs of {width} x {height} pixels used, root mean square error"
        f" {record['rms']:.3f} px, lens: {record['camera']}",
        "",
        *(line for remark in record["remarks"] for line in (remark, "")),
        "| intrinsic | value | standard deviation |",
        "|---|---|---|",
    ]
    for name, entry in record["intrinsics"].items():
        sigma = "held" if entry["sigma"] is None else f"{entry['sigma']:.3g}"
        lines.append(f"| {name} | {entry['value']:.6g} | {sigma} |")
    lines += ["", "| photograph | error, px | remark |", "|---|---|---|"]
    for p in record["photographs"]:
        rms = "" if p["rms"] is None else f"{p['rms']:.3f}"
        lines.append(f"| {printable(p['name'])} | {rms} | {printable(p['problem'])} |")
    return "\n".join(lines) + "\n"


def _camera_file(record: dict[str, Any], K: Float[Tensor, "3 3"]) -> str:
    width, height = record["image_size"]
    matrix = ("fx", "fy", "skew", "cx", "cy")
    lens = [f"{name}={entry['value']:.10g}" for name, entry in record["intrinsics"].items() if name not in matrix]
    lines = [
        f"# K in pixels of images of {width} x {height}, (0, 0) being the centre of the first pixel",
        " ".join(["#", record["camera"], *lens]),
        *(" ".join(f"{v:.10g}" for v in row) for row in K.tolist()),
    ]
    return "\n".join(lines) + "\n"


def _write_previews(job: Job, found: PlaneCalibration, photographs: list[_Photograph]) -> None:
    """Photographs as a pinhole camera would have taken them."""
    if not photographs:
        return
    folder = job.out / "undistorted"
    folder.mkdir(exist_ok=True)
    pinholes = undistorted_cameras(found.camera, torch.tensor(photographs[0].size))
    width, height = pinholes.size.tolist()
    for i, p in enumerate(photographs):
        job.progress("write", i, len(photographs))
        image = read_image(p.path).pixels
        save_image(folder / f"{p.path.stem}.png", undistort_images(image, found.camera, pinholes.cameras, (width, height)))
    job.progress("write", len(photographs), len(photographs))
