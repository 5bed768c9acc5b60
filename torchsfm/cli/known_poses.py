"""`torchsfm triangulate` and `torchsfm register`: photographs and a model that has poses for them, or for some of them."""

from pathlib import Path
from typing import Annotated, Any

import typer

from torchsfm.cli.export import load
from torchsfm.cli.inputs import photograph_folder
from torchsfm.cli.job import Job, UserError, told
from torchsfm.cli.output import output_folder
from torchsfm.cli.results import finish
from torchsfm.images import MAX_PIXELS
from torchsfm.reconstruction import ReconstructionError, triangulate_photographs

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
        typer.Argument(help="A folder of images, or image files: those of the model, and new ones.", show_default=False),
    ],
    into: Annotated[Path, typer.Option(help="The model, of any format, to place the new images in.")],
    out: Out,
    masks: Masks = None,
    sequence: Sequence = False,
    max_features: Features = 8192,
    max_pixels: Pixels = MAX_PIXELS,
    seed: Seed = 0,
    resume: Resume = False,
    threads: Threads = None,
) -> None:
    """Place new photographs in an old model, whose poses and cameras stay as they are; its photographs must be given too."""
    _run(images, into, out, threads, register=True, masks=masks, sequence=sequence, max_features=max_features,
         max_pixels=max_pixels, seed=seed, resume=resume)  # fmt: skip


def _run(images: list[Path], model: Path, out: Path, threads: int | None, *, max_pixels: int, **options: Any) -> None:
    with told(Job(out)) as job, output_folder(out):
        poses = load(model)
        job.set_threads(threads)
        try:
            result = triangulate_photographs(
                images, poses, out=out, progress=job.progress, max_pixels=max_pixels,
                **options,
            )  # fmt: skip
        except ReconstructionError as error:
            raise UserError(" ".join(str(error).split())) from None
        finish(job, result, photograph_folder(images), {}, max_pixels)
