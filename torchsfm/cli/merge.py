"""`torchsfm merge`: models that share images as one."""

from pathlib import Path
from typing import Annotated, Any

import typer

from torchsfm.cli.export import load, model_record
from torchsfm.cli.job import Job, UserError, told
from torchsfm.formats import write_model
from torchsfm.formats.registry import format_for
from torchsfm.reconstruction.merging.merge import merge_models


def merge(
    models: Annotated[
        list[Path],
        typer.Argument(help="Two models or more, of any format, each with images of one before it.", show_default=False),
    ],
    out: Annotated[
        Path, typer.Option(help="Where to write it; the name tells the format, as for `convert`.", show_default=False)
    ],
    fixed_cameras: Annotated[bool, typer.Option("--fixed-cameras", help="Hold the intrinsics of the cameras.")] = False,
) -> None:
    """Join models that share images, in the world frame of the first one, and adjust them together."""
    with told(Job(out)) as job:
        if len(models) < 2:
            raise UserError("wanted two models or more")
        try:
            kind = format_for(out)
        except ValueError as error:
            raise UserError(str(error)) from None
        first, *others = [load(path) for path in models]
        words: list[str] = []
        parts: list[dict[str, Any]] = []
        for path, other in zip(models[1:], others, strict=True):
            job.progress("merge", len(words), len(others))
            found = merge_models(first, other, fixed_cameras=fixed_cameras)
            if fault := found.fault():
                raise UserError(f"{path}: {fault}")
            first = found.model
            words.append(f"{path}: {found.summary()}")
            shared = {"shared_images": list(found.shared_images), "shared_points": found.shared_points}
            parts.append({"model": str(path), "adjustment": found.status.name} | shared)
        job.progress("merge", len(words), len(others))
        job.close()
        try:
            write_model(first, out, kind.name)
        except ValueError as error:
            raise UserError(f"{out}: {' '.join(str(error).split())}") from None
        typer.echo("\n".join([*words, f"written: {out}"]))
        job.voice.record.update(model_record(first, out, kind.name), merged=parts)
