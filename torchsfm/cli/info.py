"""`torchsfm info`: saved models in words and numbers."""

from pathlib import Path
from typing import Annotated

import torch
import typer

from torchsfm.cli.export import load
from torchsfm.cli.job import Job, UserError, told
from torchsfm.cli.output import finish_replacing, output_folder, unfinished
from torchsfm.formats.registry import model_files
from torchsfm.reconstruction.messages import printable


def info(
    folder: Annotated[Path, typer.Argument(help="Folder written by `torchsfm reconstruct`, or a model of any format.")],
) -> None:
    """Describe saved models: cameras, points and how well each image fits."""
    with told(Job(folder)) as job:
        if unfinished(folder):
            with output_folder(folder):
                finish_replacing(folder)
        try:
            found = model_files(folder)
        except ValueError as error:
            raise UserError(" ".join(str(error).split())) from None
        models = job.voice.record.setdefault("models", [])
        for kind, file in found:
            model = load(file)
            typer.echo(f"{file}\n{model.summary()}\n")
            counts = torch.bincount(model.view, minlength=len(model.names)).tolist()
            # A format without observations says nothing of how well images fit: no error is not an error of zero.
            errors = [error if count else None for error, count in zip(model.view_errors().tolist(), counts, strict=True)]
            names = [printable(name) for name in model.names]
            width = max(map(len, ("image", *names)))
            typer.echo(f"{'image':<{width}}  observations  mean error, px")
            for name, registered, count, mean in zip(names, model.registered.tolist(), counts, errors, strict=True):
                fit = "" if mean is None else f"{mean:.3f}"
                typer.echo(f"{name:<{width}}  " + (f"{count:>12}  {fit:>14}".rstrip() if registered else "not registered"))
            typer.echo("")
            rows = zip(model.names, model.registered.tolist(), counts, errors, strict=True)
            keys = ("name", "registered", "observations", "mean_error_px")
            models.append(
                {"file": str(file), "format": kind.name, "points": model.num_points}
                | {"images": [dict(zip(keys, row, strict=True)) for row in rows]}
            )
