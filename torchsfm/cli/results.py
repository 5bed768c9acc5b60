"""What the user gets: models in all formats, the page, the report, and the true errors where the truth is known."""

import json
import shlex
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import typer

from torchsfm.cli.export import PHOTOGRAPHS
from torchsfm.cli.job import NOTHING, Job
from torchsfm.cli.output import replacing_results
from torchsfm.formats import write_colmap, write_curves, write_lines, write_ply
from torchsfm.images import MAX_PIXELS
from torchsfm.plot import write_page
from torchsfm.reconstruction import Reconstruction, SfmResult
from torchsfm.reconstruction.model.files import write_whole_files
from torchsfm.reconstruction.written_report import report_markdown, report_record

VERSION = metadata.version("torchsfm")


def finish(job: Job, result: SfmResult, folder: Path | None, truth: dict[str, str], max_pixels: int = MAX_PIXELS) -> None:
    """Write everything there is to `job.out`, all or nothing, and say in a few lines what came out and where to look.

    Args:
        job: The run.
        result: What it found.
        folder: Where the photographs lie, for the page; None where they do not lie together.
        truth: True errors, if known.
        max_pixels: The most that a photograph on the page may have.
    """
    more: dict[str, Any] = {"version": VERSION, "command": shlex.join(sys.argv[1:])}
    more[PHOTOGRAPHS] = None if folder is None else str(folder.absolute())
    if not result.models:
        more["failure"] = result.failure()
    with replacing_results(job.out) as out:
        written = write_models(job, result, folder, out, max_pixels)
        record = report_record(result, peak_memory_mb=peak_memory(), truth=truth, **more)
        texts = {"report.json": json.dumps(record, indent=1), "report.md": report_markdown(record)}
        write_whole_files({out / name: text.encode() for name, text in texts.items()})
    job.close()
    files = [str(job.out / name) for name in (*dict(written), "report.md", "report.json") if (job.out / name).exists()]
    job.voice.record.update(record | {"out": str(job.out), "files": files})
    for i, model in enumerate(result.models):
        typer.echo(("" if len(result.models) == 1 else f"model {i}: ") + model.summary())
    typer.echo(result.report.summary())
    for key, value in truth.items():
        typer.echo(f"{key}: {value}")
    for name, what in [*written, ("report.md", "what happened to each image and pair (report.json: the same for programs)")]:
        typer.echo(f"{job.out / name}  {what}")
    if not result.models:
        job.fail(f"nothing could be reconstructed: {result.failure()}")
        raise typer.Exit(NOTHING)


def write_models(job: Job, result: SfmResult, folder: Path | None, out: Path, max_pixels: int) -> list[tuple[str, str]]:
    """Write the page of all models, and each model in all formats that can hold it; return what to look at."""
    if not result.models:
        return []
    total = 1 + sum(3 + 2 * (model.lines is not None) + 2 * (model.curves is not None) for model in result.models)
    job.progress("write", 0, total)
    write_page(
        result.models,
        out / "page.html",
        title=job.out.resolve().name,
        report=result.report,
        images=folder,
        max_pixels=max_pixels,
    )
    written = [("page.html", "open it in a browser and turn the model with the mouse")]
    formats: list[tuple[str, str, Callable[[Reconstruction, Path], Any], str]] = [
        ("model", ".npz", Reconstruction.save, "the model, for Reconstruction.load and torchsfm info"),
        ("points", ".ply", write_ply, "coloured points and cameras for viewers"),
        ("colmap", "", write_colmap, "the model for COLMAP"),
    ]
    of_lines = [
        ("lines", ".ply", write_lines, "coloured lines for viewers"),
        ("lines", ".txt", write_lines, "the lines and the segments that show them, for torchsfm.formats.read_lines"),
    ]
    of_curves: list[tuple[str, str, Callable[[Reconstruction, Path], Any], str]] = [
        ("curves", ".ply", write_curves, "samples of the curves, coloured, and edges between them"),
        ("curves", ".json", write_curves, "the curves as cubic B-splines"),
    ]
    for i, model in enumerate(result.models):
        wanted = formats + (of_lines if model.lines is not None else []) + (of_curves if model.curves is not None else [])
        for stem, suffix, write, what in wanted:
            job.progress("write", len(written), total)
            name = f"{stem}{suffix}" if i == 0 else f"{stem}-{i}{suffix}"
            try:
                write(model, out / name)
            except ValueError as error:
                written.append((name, f"not written: {error}"))
                continue
            written.append((name, what if i == 0 else f"the same of model {i}"))
    job.progress("write", total, total)
    return written


def peak_memory() -> float | None:
    """The most memory this process ever held, in MB, where the system tells."""
    try:
        import resource
    except ImportError:
        return None
    # Linux counts in kilobytes, macOS in bytes.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
