"""`torchsfm curves`: the curves that photographs with known cameras show."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch
import typer
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.cli.job import NOTHING, Job, UserError, told
from torchsfm.cli.output import output_folder, replacing_results
from torchsfm.formats import write_curves
from torchsfm.formats.problem import as_reconstruction
from torchsfm.formats.registry import read_model_or_problem
from torchsfm.geometry import Camera, Pose
from torchsfm.images import MAX_PIXELS, ImageError, read_image
from torchsfm.plot import write_page
from torchsfm.reconstruction import Curves, ImageReport, PoseCheck, Reconstruction, Report
from torchsfm.reconstruction.curves.find_curves import scaled
from torchsfm.reconstruction.curves.from_edges import SeenEdges, curves_of_edges, edges_of_images
from torchsfm.reconstruction.curves.pose_check import check_by_edges
from torchsfm.reconstruction.messages import Progress, printable
from torchsfm.reconstruction.report import pair_report


def curves(
    images: Annotated[Path, typer.Argument(help="The folder of the photographs, under their names in the model.")],
    poses: Annotated[
        Path, typer.Option(help="The model with their cameras: a COLMAP folder, or a saved model (.npz).", show_default=False)
    ],
    out: Annotated[Path, typer.Option(help="Folder for the curves and the page.", show_default=False)],
    neighbours: Annotated[int, typer.Option(min=2, help="Images in which the edges of an image are sought.")] = 10,
    threshold: Annotated[float, typer.Option(min=0.1, help="Pixels that an edge may be off.")] = 2.0,
    max_size: Annotated[int, typer.Option(min=100, help="Larger images are scaled down to this longer side.")] = 1600,
    max_pixels: Annotated[int, typer.Option(min=1, help="Leave out images that have more pixels.")] = MAX_PIXELS,
    threads: Annotated[int | None, typer.Option(min=1, help="Processor threads; all by default.")] = None,
) -> None:
    """Find the curves in space whose images are the edges of photographs with known cameras.

    Where the poses do not fit the photographs, or those of some images do not, that is said.
    """
    with told(Job(out)) as job, output_folder(out):
        job.set_threads(threads)
        model = load(poses)
        known = model.registered.nonzero()[:, 0]
        if not images.is_dir():
            raise UserError(f"{images}: no such folder")
        files = [images / model.names[i] for i in known.tolist()]
        there = [file.is_file() for file in files]
        if sum(there) < 3:
            raise UserError(f"{images}: wanted three images of {poses} or more, found {sum(there)}")
        known = known[torch.tensor(there)]
        files = [file for file, found in zip(files, there, strict=True) if found]
        read: list[bool] = []
        share = shares(model.image_size[known], max_size)
        pixels = photographs(files, model.image_size[known], max_size, max_pixels, read)
        found, check = find(
            pixels, scaled(model.cameras[model.camera_index[known]], share), model.poses[known],
            model.X[torch.isfinite(model.X).all(-1)], neighbours, threshold, job.progress,
        )  # fmt: skip
        found = found.in_images(known, 1 / share)
        names = [model.names[i] for i in known.tolist()]
        job.progress("write", 0, 1)
        with replacing_results(out) as folder:
            written = write(found, model, images, folder, max_pixels, told_of(check, names))
        job.progress("write", 1, 1)
        job.close()
        number, length = len(found), float(found.length().sum())
        typer.echo(f"{number} curves of length {length:.6g} in all, from {sum(read)} of {model.num_registered} images")
        doubts = [printable(line) for line in check.doubts(names)]
        job.voice.record.update(
            curves=number, length=length, poses_fit=not doubts, doubts=doubts, files=[str(out / name) for name, _ in written]
        )
        for name, what in written:
            typer.echo(f"{out / name}  {what}")
        for line in doubts:
            typer.echo(f"torchsfm: {line}", err=True)
        if not number:
            job.fail("no curves found")
        elif check.refuted:
            job.voice.record["error"] = doubts[0]
        if check.refuted or not number:
            raise typer.Exit(NOTHING)


def find(
    images: Iterator[Tensor | None],
    cameras: Camera,
    poses: Pose,
    points: Float[Tensor, "n 3"],
    neighbours: int,
    threshold: float,
    progress: Progress,
) -> tuple[Curves, PoseCheck]:
    """`reconstruct_curves` and `check_poses`, with edges found once."""
    edges, size = edges_of_images(images, len(poses.R), progress)
    seen = SeenEdges.of(edges, size, cameras)
    found = curves_of_edges(
        edges, size, cameras, poses, points=points, neighbours=neighbours, threshold=threshold, seen=seen, progress=progress
    )
    check = check_by_edges(seen, size, cameras, poses, found, points=points, neighbours=neighbours, progress=progress)
    return found, check


def told_of(check: PoseCheck, names: list[str]) -> Report:
    """What the page tells of the images."""
    images = tuple(ImageReport(name, 0, doubt=doubt) for name, doubt in zip(names, check.image_doubts(), strict=True))
    none = torch.zeros(0, dtype=torch.long)
    return Report(images, pair_report(none.reshape(0, 2), none, none, none, none), {})


def load(path: Path) -> Reconstruction:
    """The model that the path holds.

    Raises:
        UserError: It is not there or no model with image names.
    """
    try:
        return as_reconstruction(read_model_or_problem(path))
    except ValueError as error:
        raise UserError(" ".join(str(error).split())) from None


def shares(size: Int[Tensor, "v 2"], max_size: int) -> Float[Tensor, "v 2"]:
    """How many pixels along x and y images are read in for one that they have."""
    size = size.double()
    small = (size * (max_size / size.amax(-1, keepdim=True)).clamp(max=1)).round().clamp(min=1)
    return small / size


def photographs(
    files: list[Path], sizes: Int[Tensor, "v 2"], max_size: int, max_pixels: int, read: list[bool]
) -> Iterator[Tensor | None]:
    """The images one after another, None and a word to the user for one that cannot be read; `read` tells which can.

    Raises:
        UserError: One has another size than the model says: its camera is not that of these pixels.
    """
    for file, wanted in zip(files, sizes.tolist(), strict=True):
        try:
            photograph = read_image(file, max_size=max_size, max_pixels=max_pixels)
        except (ImageError, OSError) as error:
            typer.echo(f"torchsfm: left out: {printable(str(error))}", err=True)
            read.append(False)
            yield None
            continue
        if list(photograph.size) != wanted:
            told_sizes = (
                f"{photograph.size[0]} x {photograph.size[1]} pixels, in the model of the poses {wanted[0]} x {wanted[1]}"
            )
            raise UserError(f"{printable(str(file))}: {told_sizes}")
        read.append(True)
        yield photograph.pixels


def write(
    found: Curves, model: Reconstruction, images: Path, folder: Path, max_pixels: int, report: Report
) -> list[tuple[str, str]]:
    """Write the curves in all forms; names and what they are."""
    write_curves(found, folder / "curves.ply")
    write_curves(found, folder / "curves.json")
    none = torch.zeros(0, dtype=torch.long)
    # The page shows the samples as points that no image has observed.
    shown = replace(
        model, X=found.X.to(model.X), color=found.color.to(model.X), x=model.x[:0], view=none, point=none, curves=found
    )
    write_page(shown, folder / "page.html", title="Curves", report=report, images=images, max_pixels=max_pixels)
    return [
        ("page.html", "open it in a browser and turn the curves with the mouse"),
        ("curves.ply", "samples, coloured, and edges between them"),
        ("curves.json", "cubic B-splines"),
    ]
