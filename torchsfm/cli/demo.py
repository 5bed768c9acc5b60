"""`torchsfm demo`: a synthetic scene, photographed and reconstructed."""

from pathlib import Path
from typing import Annotated

import torch
import typer

from torchsfm.cli.compare import true_errors
from torchsfm.cli.job import Job, told
from torchsfm.cli.known_poses import Seed, Threads
from torchsfm.cli.output import output_folder
from torchsfm.cli.results import finish
from torchsfm.images import save_image
from torchsfm.simulation import render_sequence


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the rendered images and all results.")] = Path("torchsfm-demo"),
    views: Annotated[int, typer.Option(min=3, max=100, help="Number of photographs to render.")] = 12,
    width: Annotated[int, typer.Option(min=320, max=4000, help="Their width in pixels.")] = 960,
    seed: Seed = 0,
    threads: Threads = None,
) -> None:
    """Photograph a synthetic scene, reconstruct it knowing nothing, and compare with the truth."""
    with told(Job(out)) as job, output_folder(out):
        folder = out / "images"
        folder.mkdir(exist_ok=True)
        job.set_threads(threads)
        generator = torch.Generator().manual_seed(seed)
        # One image at a time would show progress, but the rays are shared by all of them.
        job.progress("render", 0, views)
        truth = render_sequence(views=views, width=width, height=3 * width // 4, generator=generator)
        names = [f"view{i:02d}.jpg" for i in range(views)]
        for i, name in enumerate(names):
            save_image(folder / name, truth.images[i])
            job.progress("render", i + 1, views)
        result = job.run([folder / name for name in names], threads, seed=seed, resume=False)
        compared = {}
        if result.models:
            model = result.models[0]
            K = model.cameras.K[model.camera_index]
            compared = true_errors(model.poses, model.registered, K, truth.poses, truth.cameras.K)
        finish(job, result, folder, compared)
