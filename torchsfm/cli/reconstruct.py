"""`torchsfm reconstruct`: photographs, a film, or matches of other programs to models."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from torchsfm.cli.export import check_exports, known_targets, write_export
from torchsfm.cli.inputs import (
    FRAMES,
    film_among,
    photograph_folder,
    read_film,
    read_intrinsics,
    read_matched,
    warn_about_intrinsics,
)
from torchsfm.cli.job import Job, UserError, told
from torchsfm.cli.known_poses import Masks, Seed, Threads
from torchsfm.cli.output import output_folder
from torchsfm.cli.ranks import Started
from torchsfm.cli.results import finish
from torchsfm.formats import TARGETS
from torchsfm.geometry import DISTORTION_MODELS
from torchsfm.images import MAX_PIXELS


class Method(StrEnum):
    """Ways to reconstruct of `--method`."""

    incremental = "incremental"
    projective = "projective"
    all_at_once = "global"
    windows = "windows"
    auto = "auto"
    curves = "curves"


def known_camera(name: str | None) -> str | None:
    """See that there is a distortion model of this name.

    Raises:
        BadParameter: There is none.
    """
    if name is not None and name not in DISTORTION_MODELS:
        raise typer.BadParameter(f"{name!r} is not one of {', '.join(map(repr, DISTORTION_MODELS))}.")
    return name


def reconstruct(
    images: Annotated[
        list[Path],
        typer.Argument(
            help="A folder of images with its subfolders, image files, a text file that lists images, or a film; or keypoints"
            " and matches of other programs: COLMAP's database.db, or hloc's two files, features.h5 and matches.h5.",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the model, the page, the report and the finished stages.")],
    masks: Masks = None,
    sequence: Annotated[bool, typer.Option("--sequence", help="The images are frames of a video, in order.")] = False,
    fps: Annotated[
        float | None,
        typer.Option(
            min=1e-3, help="Frames a second to take of a film, the sharpest of each moment; 2 if not given.", show_default=False
        ),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            callback=known_camera,
            metavar=f"[{'|'.join(DISTORTION_MODELS)}]",
            help="Lens distortion; radial or fisheye by what the images say, or pinhole with --intrinsics.",
            show_default=False,
        ),
    ] = None,
    intrinsics: Annotated[
        Path | None, typer.Option(help="Text file with the known 3x3 matrix K of all images, in pixels.", show_default=False)
    ] = None,
    shared_camera: Annotated[
        bool | None,
        typer.Option(
            "--shared-camera/--own-cameras",
            help="Whether one camera took all images of a size; by default as folders, Exif data and the images suggest.",
            show_default=False,
        ),
    ] = None,
    free_principal_point: Annotated[
        bool,
        typer.Option(
            "--free-principal-point/--centred-principal-point",
            help="Estimate the principal point too, or hold it at the middle of the image.",
        ),
    ] = True,
    method: Annotated[
        Method,
        typer.Option(
            "--method",
            "--mapper",
            help="incremental: from two images on; projective: all together without calibration, then autocalibration; global: "
            "rotations of all images, then all places; windows: a film, some frames at a time; auto: incremental or global, by "
            "the number of images, what holds them together and what comes of it; curves: a sequence by its edges alone, where "
            "there is little else to see.",
        ),
    ] = Method.auto,
    lines: Annotated[
        bool, typer.Option("--lines", help="Find straight lines too, and adjust cameras by points and lines together.")
    ] = False,
    curves: Annotated[
        bool, typer.Option("--curves", help="Find curves in space too, from edges of the images, and adjust cameras by both.")
    ] = False,
    max_features: Annotated[int, typer.Option(min=100, help="Most features per image.")] = 8192,
    max_pixels: Annotated[int, typer.Option(min=1, help="Leave out images that have more pixels.")] = MAX_PIXELS,
    targets: Annotated[
        list[str] | None,
        typer.Option(
            "--for",
            callback=known_targets,
            metavar=f"[{'|'.join(TARGETS)}]",
            help="Also write a folder of this name for a program, as `torchsfm export` does; may be given several times.",
            show_default=False,
        ),
    ] = None,
    seed: Seed = 0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where an earlier run into the same folder stopped.")] = False,
    threads: Threads = None,
) -> None:
    """Turn photographs into calibrated cameras and coloured 3D points."""
    started = Started.by()
    shown = {"masks": masks, "sequence": sequence, "max_features": max_features, "max_pixels": max_pixels}
    if started.rank > 0:
        with told(Job(out)) as job:
            film = film_among(images, fps)
            if film is not None or read_matched(images) is None:
                started.begin(out, resume)
                source = images if film is None else [out / FRAMES]
                job.help(source, threads, started, seed=seed, **shown | {"sequence": sequence or film is not None})
        return
    with told(Job(out)) as job, output_folder(out):
        film = film_among(images, fps)
        if film is not None:
            read_film(job, film, fps, max_pixels)
            images, shown["sequence"] = [out / FRAMES], True
        matched = read_matched(images)
        folder = photograph_folder(images) if matched is None else None
        if targets and folder is None:
            raise UserError("--for: wants a folder of images; torchsfm export has the option --images")
        if lines and matched is not None:
            raise UserError("--lines: wants images, in which line segments are found")
        if curves and matched is not None:
            raise UserError("--curves: wants images, in which edges are found")
        check_exports(out, targets or [])
        K = None if intrinsics is None else read_intrinsics(intrinsics)
        options = {
            "camera": camera, "K": K, "shared_camera": shared_camera, "free_principal_point": free_principal_point,
            "method": method.value, "seed": seed,
        }  # fmt: skip
        if matched is not None:
            result = job.run_matched(matched, threads, **options)
        else:
            result = job.run(images, threads, lines=lines, curves=curves, resume=started.begin(out, resume), **shown, **options)
        if K is not None and result.models:
            warn_about_intrinsics(K, result.models[0])
        finish(job, result, folder, {}, max_pixels)
        for target in targets or []:
            write_export(job, result.models[0], target, out / target, folder)
