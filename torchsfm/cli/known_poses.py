"""`torchsfm triangulate` and `torchsfm register`: photographs and a model that has poses for them, or for some of them."""

from pathlib import Path
from typing import Annotated, Any

import typer

from torchsfm.cli.export import load
from torchsfm.cli.inputs import photograph_folder
from torchsfm.cli.job import Job, UserError, told
from torchsfm.cli.output import output_folder
from torchsfm.cli.results import finish
from torchsfm.formats import read_features
from torchsfm.images import MAX_PIXELS
from torchsfm.reconstruction import (
    KnownFeatures,
    Reconstruction,
    ReconstructionError,
    register_photographs,
    saved_features,
    triangulate_photographs,
)
from torchsfm.reconstruction.matching.sources import Sources

Images = Annotated[list[Path], typer.Argument(help="A folder of images, or image files.", show_default=False)]
Masks = Annotated[
    Path | None,
    typer.Option(
        help="Folder of masks: nothing is looked for where the mask of an image, a.jpg.png for a.jpg, is black.",
        show_default=False,
    ),
]
Out = Annotated[Path, typer.Option(help="Folder for the model, the page, the report and the finished stages.")]
Sequence = Annotated[bool, typer.Option("--sequence", help="The images are frames of a video, in order.")]
Features = Annotated[int, typer.Option(min=100, help="Most features per image.")]
Pixels = Annotated[int, typer.Option(min=1, help="Leave out images that have more pixels.")]
Seed = Annotated[int, typer.Option(help="The same seed gives the same model.")]
Resume = Annotated[bool, typer.Option("--resume", help="Go on where an earlier run into the same folder stopped.")]
Threads = Annotated[int | None, typer.Option(min=1, help="Processor threads; all by default.")]


def triangulate(
    images: Images,
    poses: Annotated[
        Path, typer.Option(help="A model of any format with the poses and cameras of the images, by their names.")
    ],
    out: Out,
    refine_poses: Annotated[
        bool, typer.Option("--refine-poses", help="Adjust the poses too; cameras, world frame and scale stay.")
    ] = False,
    masks: Masks = None,
    sequence: Sequence = False,
    max_features: Features = 8192,
    max_pixels: Pixels = MAX_PIXELS,
    seed: Seed = 0,
    resume: Resume = False,
    threads: Threads = None,
) -> None:
    """Find the 3D points of photographs whose poses are known."""
    _run(images, poses, out, threads, refine_poses=refine_poses, masks=masks, sequence=sequence, max_features=max_features,
         max_pixels=max_pixels, seed=seed, resume=resume)  # fmt: skip


def register(
    images: Annotated[
        list[Path],
        typer.Argument(
            help="A folder of images, or image files: new ones, and those of the model where their features were not kept.",
            show_default=False,
        ),
    ],
    into: Annotated[Path, typer.Option(help="The model, of any format, to place the new images in.")],
    out: Out,
    features: Annotated[
        Path | None,
        typer.Option(
            help="The features of the model's photographs, where these are not given: the folder that `torchsfm reconstruct`"
            " wrote, or COLMAP's database.db. By default those beside the model.",
            show_default=False,
        ),
    ] = None,
    masks: Masks = None,
    sequence: Sequence = False,
    max_features: Features = 8192,
    max_pixels: Pixels = MAX_PIXELS,
    seed: Seed = 0,
    resume: Resume = False,
    threads: Threads = None,
) -> None:
    """Place new photographs in an old model, whose poses and cameras stay as they are."""
    _run(images, into, out, threads, register=True, features=features, masks=masks, sequence=sequence,
         max_features=max_features, max_pixels=max_pixels, seed=seed, resume=resume)  # fmt: skip


def _run(
    images: list[Path], model: Path, out: Path, threads: int | None, *, max_pixels: int, features: Path | None = None,
    **options: Any,
) -> None:  # fmt: skip
    with told(Job(out)) as job, output_folder(out):
        poses = load(model)
        job.set_threads(threads)
        common: dict[str, Any] = {"out": out, "progress": job.progress, "max_pixels": max_pixels}
        try:
            if options.get("register") and (features is not None or not _holds_photographs(images, poses)):
                known = find_features(features, model, poses)
                wanted = ("masks", "max_features", "seed", "resume")
                chosen = {name: options[name] for name in wanted}
                result = register_photographs(images, poses, known, **common, **chosen)
            else:
                result = triangulate_photographs(images, poses, **common, **options)
        except (ReconstructionError, ValueError) as error:
            raise UserError(" ".join(str(error).split())) from None
        finish(job, result, photograph_folder(images), {}, max_pixels)


def _holds_photographs(images: list[Path], model: Reconstruction) -> bool:
    """Whether photographs of the model are among the images, which two suffice for."""
    names = set(Sources.of(images, least=1).names)
    posed = [name for name, there in zip(model.names, model.registered.tolist(), strict=True) if there]
    return sum(name in names for name in posed) >= 2


def find_features(given: Path | None, model: Path, poses: Reconstruction) -> KnownFeatures:
    """The features of a model's photographs, from where they are said to be or from beside the model.

    Raises:
        UserError: There are none.
        ReconstructionError: They are damaged, or of other photographs.
        ValueError: It is a database, and a damaged one.
        OSError: They cannot be read.
    """
    folder = model if model.is_dir() else model.parent
    places = (
        [given] if given is not None else [folder, *(up / "database.db" for up in (folder, *folder.absolute().parents[:3]))]
    )
    for place in places:
        if place.is_file():
            return read_features(place)
        found = saved_features(place, poses) if place.is_dir() else None
        if found is not None:
            return found
    if given is not None:
        raise UserError(f"{given}: no folder with the stages of a run, and no database")
    raise UserError(
        f"{model}: the features of its photographs were not kept; give these photographs too, or say with --features where a"
        " run's folder or COLMAP's database.db is"
    )
